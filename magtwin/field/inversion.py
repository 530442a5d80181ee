"""Inversion of a survey: the dipoles, the uniform field and the platform that explain its readings.

What is fitted are the moments of vertical dipoles on layers below the sensor (equivalent sources: Dampney
1969; Blakely 1995, section 12.1), a uniform field and the robot's hard iron, soft iron and lever arm. The
moments have normal priors, which is a Gaussian process with curl- and divergence-free covariance
(Wahlstrom et al. 2013; Solin et al. 2018). Three things make it honest on a real floor:

- Places and headings are recorded with errors, so a reading's variance is noise^2 + position^2 |grad|^2 +
  heading^2 (d/dyaw)^2 at the field's own slopes (noisy-input processes: McHutchon & Rasmussen 2011), about
  which it follows Student's t, by reweighting (Lange et al. 1989).
- Iron lies in some places and not in others, so every dipole's prior strength is that of the dipoles
  around it in its layer, drawn a little towards the layer's.
- All these figures follow from the readings: strengths by MacKay's (1992) fixed point of the evidence
  (Rasmussen & Williams 2006, section 5.4, with Laplace's approximation), noises and tail by
  expectation-maximization.

The magnitude is not linear in the field; Gauss-Newton steps, halved until the posterior grows, solve it. Each
costs one factorisation of a P x P matrix, whatever the number of readings N.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.bins import spacing_m as survey_spacing_m
from magtwin.field.forward import Forward, Reading
from magtwin.field.harmonic import HarmonicField
from magtwin.field.readings import Readings
from magtwin.frames import wrap_angle
from magtwin.names import RefusedError

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

LADDER = (1.0, 2.0, 4.0)
"""Depths of the layers below the sensor, in those of the first: each tells of sources twice as large."""

DEPTH_SPACINGS = 1.6
"""Depth of the first layer in spacings of the survey: a layer nearer than about one tells of
waves that the readings do not resolve (Dampney 1969)."""

LEAST_DEPTH_M = 0.3
"""Least depth of the first layer below the sensor [m]; a robot's sensor is not nearer to the floor's iron."""

SHEET = 0.5
"""Distance of the dipoles of a layer in its depth: e^(-2 pi / 0.5) of their field is ripple, 3e-6."""

MARGIN = 1.2
"""Width by which a layer goes beyond the readings, in its depth."""

REACH = 0.8
"""Distance over which dipoles share one strength, in their layer's depth."""

DRAWN = 0.02
"""Weight of the layer's strength beside that of the dipoles around, as a part of theirs."""

MOST_DIPOLES = 2500
"""Dipoles beyond which the layers are thinned: 50 MB a matrix."""

MOST_CELLS = 4000
"""Readings beyond which those of a drive are averaged over longer ways."""

CELL = 1 / 6
"""Way along which the readings of a drive are averaged, in the first layer's depth."""

TURN_M = 0.1
"""Way that a turn of 1 rad counts as [m]."""

LEAST_READINGS = 8

EARTH_SD_NT = 1000.0
"""How far the uniform part may lie from `earth_nt` [nT], each way."""

HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M = 3000.0, 0.03, 0.05
"""How large the parts of a platform may be: one standard deviation of their priors, about 0."""

TAILS = np.geomspace(3.0, 48.0, 13)
"""Degrees of freedom of Student's t that are tried."""

ROUNDS = 30
"""Rounds in which the figures settle."""

LAYERWISE = 4
"""First rounds, in which a layer has one strength."""

SETTLED = 0.05
"""Change of the logarithm of the posterior below which Gauss-Newton has arrived."""

STEPS = 30

BLOCK = 512
"""Poses predicted at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Figures:
    """What a fit learns beside the field itself."""

    noise_nt: float
    """Noise of a reading, or of the mean of some along a drive [nT]."""

    position_m: float
    """Error of a recorded place, each way [m]."""

    heading_rad: float
    """Error of a recorded heading [rad]."""

    freedom: float
    """Degrees of freedom of Student's t."""

    strength: Array
    """Prior standard deviation of each dipole's moment [A m^2], shape (D,)."""

    def variance(self, reading: Reading) -> Array:
        """Squared scale of each part of readings [nT^2], shape (N, C)."""
        return np.asarray(self._terms(reading).sum(axis=-1))

    def _terms(self, reading: Reading) -> Array:
        """What noise, place and heading add to it, shape (N, C, 3)."""
        place = self.position_m**2 * np.sum(reading.by_place**2, axis=-1)
        heading = self.heading_rad**2 * reading.by_yaw**2
        return np.stack([np.full_like(place, self.noise_nt**2), place, heading], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class HarmonicModel:
    """A harmonic field fitted to readings, and how sure it is."""

    field: HarmonicField
    """The field and the platform."""

    parameters: Mapping[str, Any]
    """Figures of the fit, by name with unit."""

    noise_nt2: float
    """Variance of one reading of the magnitude about the field, the mean over the survey [nT^2]."""

    figures: Figures
    """What was learnt beside the field."""

    forward: Forward
    """How readings follow from the unknowns."""

    unknowns: Array
    """The unknowns at the posterior's greatest, shape (P,)."""

    prior_sd: Array
    """Standard deviations of their priors, shape (P,)."""

    lower: Array
    """Cholesky factor of the posterior's precision, of unknowns in units of `prior_sd`, shape (P, P)."""

    @property
    def method(self) -> str:
        """Name of the method."""
        return "harmonic"

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field magnitude as the survey's robot reads it, and its variance.

        Args:
            p_xy: Where base_link is, in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.

        Returns:
            Magnitude [nT] and its variance [nT^2], that of `noise_nt2` left out, each of shape (...).
        """
        p, yaw = np.asarray(p_xy, float), np.asarray(yaw, float)
        if p.ndim == 0 or p.shape[-1] != 2:
            raise RefusedError(f"p_xy must have shape (..., 2), got {p.shape}")
        shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
        p = np.broadcast_to(p, (*shape, 2)).reshape(-1, 2)
        yaw = np.broadcast_to(yaw, shape).reshape(-1)
        value, variance = np.empty(len(p)), np.empty(len(p))
        for start in range(0, len(p), BLOCK):
            part = slice(start, start + BLOCK)
            read = self.forward.read(self.unknowns, p[part], yaw[part], vectors=False)
            value[part] = read.values_nt[:, 0]
            variance[part] = self._variance(read.jacobian[:, 0])
        return value.reshape(shape), variance.reshape(shape)

    def predict_vector(self, p_world: ArrayLike) -> tuple[Array, Array]:
        """The field without the robot, at any height above the dipoles, and its variance.

        Args:
            p_world: Points [m], shape (..., 3).

        Returns:
            Field [nT] and the variance of each part [nT^2], in world axes, each of shape (..., 3).
        """
        p = np.asarray(p_world, float)
        value = self.field.field_nt(p)
        points, variance = p.reshape(-1, 3), np.empty(p.shape)
        flat = variance.reshape(-1, 3)
        for start in range(0, len(points), BLOCK):
            part = slice(start, start + BLOCK)
            rows = self.forward.vectors(points[part])
            flat[part] = self._variance(rows.reshape(-1, rows.shape[-1])).reshape(-1, 3)
        return value, variance

    def _variance(self, jacobian: Array) -> Array:
        """Posterior variances of what changes by `jacobian` (N, P) with the unknowns, shape (N,)."""
        from scipy.linalg import solve_triangular

        scaled = solve_triangular(self.lower, (jacobian * self.prior_sd).T, lower=True, check_finite=False)
        return np.asarray(np.einsum("pn,pn->n", scaled, scaled))


def fit_harmonic(
    readings: Readings,
    *,
    depth_m: float | Sequence[float] | None = None,
    spacing_m: float | None = None,
    earth_nt: Sequence[float] | None = None,
    earth_sd_nt: float = EARTH_SD_NT,
    height_m: float | None = None,
    like: HarmonicModel | None = None,
    progress: Progress | None = None,
) -> HarmonicModel:
    """The field without curl or divergence, and the platform, that make a survey's readings likeliest.

    Vectors are fitted where the survey has them, else magnitudes. Readings of a drive that follow each
    other within a short way count as one, their mean.

    Magnitudes alone leave the field's sign open: B and -B read the same, with the hard iron turned too.
    Without `earth_nt` the uniform part is thought to point down with the readings' median magnitude, give
    or take half of it each way, as nowhere but in the northern hemisphere: name the Earth's field where
    it is known (`magtwin.field.earth`), above all where vectors are wanted. Where vectors are read it is
    thought to be their mean, as loosely.

    Args:
        readings: A survey; those that are not `good` count for nothing.
        depth_m: Depth of the dipoles' layers below the sensor [m], negative for layers above. Unless
            given, three: 1.6 spacings of the survey, no nearer than `LEAST_DEPTH_M` or the floor, twice
            and four times that.
        spacing_m: Distance between the dipoles of the first layer [m]; half of a layer's depth unless
            given, and in every layer in proportion to its depth.
        earth_nt: The Earth's field in world axes [nT].
        earth_sd_nt: How far the uniform part of the lab's may lie from it, each way [nT].
        height_m: Height of the sensor above the floor [m]; that of the readings unless given, and 0
            where unknown: heights then count from the sensor.
        like: A model whose layers and figures are taken as they are; nothing but the field is learnt then.
        progress: Called as progress(done, total, what), once a round.

    Returns:
        The model.

    Raises:
        RefusedError: There are too few good readings, all at one place, or an option is none.
    """
    good = readings.take(readings.good)
    if len(good) < LEAST_READINGS:
        raise RefusedError(
            f"{len(good)} of {len(readings)} readings of {readings.name!r} are good; "
            f"a harmonic fit needs {LEAST_READINGS} at least"
        )
    height = height_m if height_m is not None else (readings.height_m or 0.0)
    _check(earth_nt, earth_sd_nt, height, spacing_m)
    if like is None:
        depths = _depths(depth_m, good, height if height > 0 else 0.0)
        layers = _layers(good, depths, spacing_m, height)
    else:
        if depth_m is not None or spacing_m is not None:
            raise RefusedError("like brings its own layers; leave out depth_m and spacing_m")
        layers = _of_model(like)
        height = like.forward.height_m
    problem = _Problem.of(good, layers, height, earth_nt, earth_sd_nt)
    return problem.solve(None if like is None else like.figures, progress).model(good)


def _check(
    earth_nt: Sequence[float] | None, earth_sd_nt: float, height: float, spacing_m: float | None
) -> None:
    if earth_nt is not None:
        earth = np.asarray(earth_nt, float)
        if earth.shape != (3,) or not np.all(np.isfinite(earth)):
            raise RefusedError(f"earth_nt must be three numbers [nT], east, north, up, got {earth_nt!r}")
    for name, value in (("earth_sd_nt", earth_sd_nt), ("spacing_m", spacing_m)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise RefusedError(f"{name} must be above 0, got {value!r}")
    if not np.isfinite(height):
        raise RefusedError(f"height_m must be a number, got {height!r}")


def _depths(depth_m: float | Sequence[float] | None, good: Readings, height: float) -> tuple[float, ...]:
    if depth_m is None:
        first = max(DEPTH_SPACINGS * survey_spacing_m(good), LEAST_DEPTH_M, height)
        return tuple(first * step for step in LADDER)
    depths = tuple(float(d) for d in np.atleast_1d(np.asarray(depth_m, float)))
    if not depths or not all(np.isfinite(d) and d != 0 for d in depths):
        raise RefusedError(f"depth_m must be depths below the sensor [m], other than 0, got {depth_m!r}")
    return depths


@dataclass(frozen=True, eq=False)
class _Layers:
    """Where dipoles lie."""

    p_world_dipole: Array
    area_m2: Array
    layer: NDArray[np.intp]
    depths: tuple[float, ...]


def _layers(good: Readings, depths: tuple[float, ...], spacing_m: float | None, height: float) -> _Layers:
    """Layers below the readings' bounding box; thinned alike where there are too many dipoles."""
    low, high = good.p_xy.min(axis=0), good.p_xy.max(axis=0)
    part = SHEET if spacing_m is None else spacing_m / abs(depths[0])
    while True:
        places, areas, layer = [], [], []
        for k, depth in enumerate(depths):
            margin, step = MARGIN * abs(depth), part * abs(depth)
            counts = np.ceil((high - low + 2 * margin) / step).astype(int) + 1
            x, y = (np.linspace(a - margin, b + margin, n) for a, b, n in zip(low, high, counts, strict=True))
            grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            places.append(np.column_stack([grid, np.full(len(grid), height - depth)]))
            areas.append(np.full(len(grid), (x[1] - x[0]) * (y[1] - y[0])))
            layer.append(np.full(len(grid), k))
        count = sum(map(len, places))
        if count <= MOST_DIPOLES:
            return _Layers(np.concatenate(places), np.concatenate(areas), np.concatenate(layer), depths)
        if spacing_m is not None:
            raise RefusedError(
                f"spacing_m {spacing_m:g} makes {count:,} dipoles, more than {MOST_DIPOLES:,}; widen it"
            )
        part *= max(np.sqrt(count / MOST_DIPOLES), 1.02)


def _of_model(model: HarmonicModel) -> _Layers:
    """The layers of a model; their areas matter to learning only."""
    places = model.forward.p_world_dipole
    heights, layer = np.unique(-places[:, 2], return_inverse=True)
    depths = tuple(float(d) + model.forward.height_m for d in heights)
    return _Layers(places, np.ones(len(places)), layer.astype(np.intp), depths)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is read where, and the priors that are no figures."""

    forward: Forward
    layers: _Layers
    p_xy: Array
    yaw: Array
    read_nt: Array  # (N, C)
    cell: NDArray[np.intp]  # of each good reading
    mean: Array  # of the unknowns' priors
    rest_sd: Array  # standard deviations of the priors of all unknowns but the moments

    @classmethod
    def of(
        cls,
        good: Readings,
        layers: _Layers,
        height: float,
        earth_nt: Sequence[float] | None,
        earth_sd_nt: float,
    ) -> "_Problem":
        read = good.b_nt[:, None] if good.b_body_nt is None else good.b_body_nt
        cell = _cells(good, CELL * min(map(abs, layers.depths)))
        size = np.bincount(cell)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(cell, values) / size)

        read = np.column_stack([mean(part) for part in read.T])
        p = np.column_stack([mean(good.p_xy[:, 0]), mean(good.p_xy[:, 1])])
        yaw = np.arctan2(mean(np.sin(good.yaw)), mean(np.cos(good.yaw)))
        typical = float(np.median(good.b_nt))
        uniform, sd = np.array([0.0, 0.0, -typical]), typical / 2
        if earth_nt is not None:
            uniform, sd = np.asarray(earth_nt, float), earth_sd_nt
        elif good.b_body_nt is not None:
            c, s = np.cos(yaw), np.sin(yaw)
            turned = [c * read[:, 0] - s * read[:, 1], s * read[:, 0] + c * read[:, 1], read[:, 2]]
            uniform = np.array([part.mean() for part in turned])
        forward = Forward(layers.p_world_dipole, height)
        prior = np.zeros(forward.size)
        count = len(layers.p_world_dipole)
        prior[count : count + 3] = uniform
        rest = np.repeat([sd, HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M], [3, 3, 9, 2])
        return cls(forward, layers, p, yaw, read, cell, prior, rest)

    @property
    def vectors(self) -> bool:
        return self.read_nt.shape[1] == 3

    def at(self, unknowns: Array) -> Reading:
        return self.forward.read(unknowns, self.p_xy, self.yaw, vectors=self.vectors)

    def solve(self, known: Figures | None, progress: Progress | None) -> "_State":
        """Fit, and learn the figures unless they are known."""
        figures = self._first() if known is None else known
        state = _State.start(self, figures)
        state = state.settle()
        rounds = 0 if known is not None else ROUNDS
        shares = None if known is not None else _shares(self.layers)
        for done in range(rounds):
            if progress is not None:
                progress(done, rounds, "learning")
            state = state.learnt(shares if done >= LAYERWISE else None).step()
        state = state.settle()
        if progress is not None:
            progress(rounds, rounds, "learning")
        return state

    def _first(self) -> Figures:
        """Figures to begin with: strengths that make the field's spread, noises of a small part of it."""
        spread = float(self.read_nt.std(axis=0).max())
        depth = np.abs(np.array(self.layers.depths))[self.layers.layer]
        # a white layer of density s per metre makes a field of variance 3 (1e2 s)^2 pi / (8 d^4) or so
        density = max(spread, 1.0) * depth**2 / 100
        return Figures(
            noise_nt=max(spread / 50, 1e-3),
            position_m=0.01,
            heading_rad=0.02,
            freedom=8.0,
            strength=density * np.sqrt(self.layers.area_m2),
        )


def _cells(good: Readings, way_m: float) -> NDArray[np.intp]:
    """Which mean each reading belongs to: one a node, and along drives one a short way."""
    if good.node is not None:
        return np.arange(len(good))
    order = np.lexsort((np.arange(len(good)) if good.t is None else good.t, good.run))
    step = np.linalg.norm(np.diff(good.p_xy[order], axis=0), axis=1)
    step += TURN_M * np.abs(wrap_angle(np.diff(good.yaw[order])))
    other = np.diff(good.run[order]) != 0
    way = np.concatenate([[0.0], np.cumsum(step)])
    while True:
        stretch = np.floor(way / way_m).astype(np.int64)
        new = (np.diff(stretch) != 0) | other
        if np.count_nonzero(new) < MOST_CELLS:
            break
        way_m *= 1.1
    cell = np.empty(len(good), np.intp)
    cell[order] = np.concatenate([[0], np.cumsum(new)])
    return cell


def _shares(layers: _Layers) -> list[Array]:
    """How much dipoles of each layer tell of each other's strength, one matrix a layer."""
    shares = []
    for k, depth in enumerate(layers.depths):
        p = layers.p_world_dipole[layers.layer == k, :2]
        apart = np.sum((p[:, None] - p[None]) ** 2, axis=-1)
        shares.append(np.exp(-apart / (2 * (REACH * depth) ** 2)))
    return shares


@dataclass(frozen=True, eq=False)
class _State:
    """Unknowns, what they predict, and the figures that they were found under."""

    problem: _Problem
    figures: Figures
    unknowns: Array
    reading: Reading

    @classmethod
    def start(cls, problem: _Problem, figures: Figures) -> "_State":
        """One step from the prior's mean, all readings trusted alike and little."""
        state = cls(problem, figures, problem.mean, problem.at(problem.mean))
        off = problem.read_nt - state.reading.values_nt
        coarse = np.full(off.shape, max(float(np.mean(off**2)) / 100, figures.noise_nt**2))
        return state._moved(state._towards(1 / coarse), 1.0)

    @property
    def prior_sd(self) -> Array:
        return np.concatenate([self.figures.strength, self.problem.rest_sd])

    @property
    def off(self) -> Array:
        """What is read minus what is predicted (N, C)."""
        return self.problem.read_nt - self.reading.values_nt

    def weights(self, variance: Array) -> Array:
        """Expected precision of a reading's own scale under Student's t, (N,)."""
        freedom, parts = self.figures.freedom, variance.shape[1]
        return np.asarray((freedom + parts) / (freedom + np.sum(self.off**2 / variance, axis=1)))

    def objective(self, variance: Array) -> float:
        """Minus the logarithm of the posterior, but for a constant, for scales that are held."""
        freedom, parts = self.figures.freedom, variance.shape[1]
        surprise = np.log1p(np.sum(self.off**2 / variance, axis=1) / freedom)
        moved = (self.unknowns - self.problem.mean) / self.prior_sd
        return float((freedom + parts) / 2 * surprise.sum() + moved @ moved / 2)

    def factor(self, precision: Array) -> Array:
        """Cholesky factor of the posterior's precision, in units of the priors, (P, P)."""
        scaled = self._rows() * np.sqrt(precision).reshape(-1, 1)
        whole = scaled.T @ scaled
        whole[np.diag_indices(len(whole))] += 1
        return np.asarray(np.linalg.cholesky(whole))

    def _rows(self) -> Array:
        return self.reading.jacobian.reshape(-1, self.reading.jacobian.shape[-1]) * self.prior_sd

    def _towards(self, precision: Array) -> Array:
        """The unknowns that solve the problem made linear here."""
        from scipy.linalg import cho_solve

        moved = (self.unknowns - self.problem.mean) / self.prior_sd
        rows = self._rows()
        target = self.off.ravel() + rows @ moved
        best = cho_solve((self.factor(precision), True), rows.T @ (precision.ravel() * target))
        return np.asarray(self.problem.mean + self.prior_sd * best)

    def _moved(self, towards: Array, part: float) -> "_State":
        unknowns = self.unknowns + part * (towards - self.unknowns)
        return _State(self.problem, self.figures, unknowns, self.problem.at(unknowns))

    def _stepped(self) -> tuple["_State", float]:
        variance = self.figures.variance(self.reading)
        towards = self._towards(self.weights(variance)[:, None] / variance)
        before, part = self.objective(variance), 1.0
        while part > 0.05:
            after = self._moved(towards, part)
            gain = before - after.objective(variance)
            if gain >= 0:
                return after, gain
            part /= 2
        return self, 0.0

    def step(self) -> "_State":
        """One Gauss-Newton step, halved until the posterior grows."""
        return self._stepped()[0]

    def settle(self) -> "_State":
        """Steps until nothing is gained."""
        state = self
        for _ in range(STEPS):
            state, gain = state._stepped()
            if gain < SETTLED:
                break
        return state

    def learnt(self, shares: list[Array] | None) -> "_State":
        """The same with figures that these unknowns make likely."""
        from scipy.linalg import lapack
        from scipy.special import gammaln, psi

        figures, layers = self.figures, self.problem.layers
        variance = figures.variance(self.reading)
        weights = self.weights(variance)
        inverse = np.asarray(lapack.dtrtri(self.factor(weights[:, None] / variance), lower=1)[0])
        count = len(figures.strength)
        # how far the readings, not the prior, determine a moment: 1 - posterior over prior variance
        known = np.clip(1 - np.sum(inverse**2, axis=0)[:count], 1e-9, 1)
        square = self.unknowns[:count] ** 2 / layers.area_m2
        density = figures.strength**2 / layers.area_m2
        new = np.empty(count)
        for k in range(len(layers.depths)):
            own = layers.layer == k
            whole = square[own].sum() / known[own].sum()
            new[own] = whole
            if shares is not None:
                drawn = DRAWN * shares[k].sum(axis=1).mean() * known[own].mean()
                new[own] = (shares[k] @ square[own] + drawn * whole) / (shares[k] @ known[own] + drawn)
        new = np.clip(new, 0.3 * density, 3 * density)
        left = np.sum((self._rows() @ inverse.T) ** 2, axis=1).reshape(variance.shape)
        size = (self.off**2 + left) * weights[:, None] / variance
        share = figures._terms(self.reading) / variance[..., None]
        scale = np.sqrt(np.sum(share * size[..., None], axis=(0, 1)) / np.sum(share, axis=(0, 1)))
        parts = variance.shape[1]
        old = (figures.freedom + parts) / 2
        tail = np.mean(np.log(weights) - weights) + psi(old) - np.log(old)
        half = TAILS / 2
        freedom = float(TAILS[np.argmax(half * np.log(half) - gammaln(half) + half * tail)])
        learnt = Figures(
            noise_nt=float(figures.noise_nt * scale[0]),
            position_m=float(figures.position_m * scale[1]),
            heading_rad=float(figures.heading_rad * scale[2]),
            freedom=freedom,
            strength=np.sqrt(new * layers.area_m2),
        )
        return _State(self.problem, learnt, self.unknowns, self.reading)

    def evidence(self) -> float:
        """Logarithm of the evidence by Laplace's approximation (Rasmussen & Williams 2006, eq. 3.32)."""
        from scipy.special import gammaln

        variance = self.figures.variance(self.reading)
        freedom, parts = self.figures.freedom, variance.shape[1]
        constant = gammaln((freedom + parts) / 2) - gammaln(freedom / 2) - parts / 2 * np.log(freedom * np.pi)
        fit = len(variance) * constant - np.log(variance).sum() / 2 - self.objective(variance)
        precision = self.weights(variance)[:, None] / variance
        return float(fit - np.log(np.diag(self.factor(precision))).sum())

    def model(self, good: Readings) -> HarmonicModel:
        """The fitted model."""
        figures, problem = self.figures, self.problem
        variance = figures.variance(self.reading)
        lower = self.factor(self.weights(variance)[:, None] / variance)
        field = problem.forward.field(self.unknowns)
        slopes = problem.forward.read(self.unknowns, problem.p_xy, problem.yaw, vectors=False)
        wide = figures.freedom / (figures.freedom - 2)
        noise = wide * float(np.mean(figures.variance(slopes)))
        off = good.b_nt - field.magnitude_nt(good.p_xy, good.yaw)
        within = off - (np.bincount(problem.cell, off) / np.bincount(problem.cell))[problem.cell]
        noise += float(np.mean(within**2))
        return HarmonicModel(
            field=field,
            parameters=self._parameters(lower, len(good)),
            noise_nt2=noise,
            figures=figures,
            forward=problem.forward,
            unknowns=self.unknowns,
            prior_sd=self.prior_sd,
            lower=lower,
        )

    def _parameters(self, lower: Array, count: int) -> dict[str, Any]:
        from scipy.linalg import solve_triangular

        figures, problem = self.figures, self.problem
        last = np.zeros((len(lower), len(problem.rest_sd)))
        last[-len(problem.rest_sd) :] = np.diag(problem.rest_sd)
        sd = np.linalg.norm(solve_triangular(lower, last, lower=True), axis=0)
        uniform, hard, soft, lever = np.split(self.unknowns[-len(problem.rest_sd) :], [3, 6, 15])
        layers = problem.layers
        density = [
            float(
                np.sqrt(np.mean(figures.strength[layers.layer == k] ** 2 / layers.area_m2[layers.layer == k]))
            )
            for k in range(len(layers.depths))
        ]
        return {
            "readings": count,
            "means of readings": len(problem.p_xy),
            "parts of a reading": "vector" if problem.vectors else "magnitude",
            "dipoles": len(figures.strength),
            "depths below the sensor [m]": [round(d, 4) for d in layers.depths],
            "strengths of the layers [A m^2/m]": [round(d, 4) for d in density],
            "noise [nT]": round(figures.noise_nt, 3),
            "error of places [m]": round(figures.position_m, 5),
            "error of headings [rad]": round(figures.heading_rad, 5),
            "degrees of freedom": round(figures.freedom, 2),
            "uniform field [nT]": np.round(uniform, 1).tolist(),
            "uniform field, sd [nT]": np.round(sd[:3], 1).tolist(),
            "hard iron [nT]": np.round(hard, 1).tolist(),
            "hard iron, sd [nT]": np.round(sd[3:6], 1).tolist(),
            "soft iron": np.round(soft, 5).tolist(),
            "soft iron, sd": np.round(sd[6:15], 5).tolist(),
            "lever arm [m]": np.round(lever, 5).tolist(),
            "lever arm, sd [m]": np.round(sd[15:], 5).tolist(),
            "log evidence": round(self.evidence(), 2),
        }
