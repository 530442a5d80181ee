"""Inversion of a survey: the dipoles, the uniform field and the platform that explain its readings.

What is fitted are the moments of dipoles on layers below and above the sensor (equivalent sources: Dampney
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
  expectation-maximization. How wide the intervals are is learnt from places left out in turn, and
  between headings that are far apart from headings left out in turn: iron is not all that a robot changes.

The magnitude is not linear in the field; Gauss-Newton steps, halved until the posterior grows, solve it. Each
costs one factorisation, of a matrix as large as the readings where they are few, so that layers may be
fine, else as the unknowns.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.bins import spacing_m as survey_spacing_m
from magtwin.field.forward import SOFT, Forward, Reading
from magtwin.field.grid import TURN
from magtwin.field.harmonic import HarmonicField
from magtwin.field.model import FittedModel
from magtwin.field.posterior import Posterior
from magtwin.field.readings import Readings, checked_earth_nt
from magtwin.field.roughness import NINETY
from magtwin.frames import wrap_angle
from magtwin.names import RefusedError

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

LADDERS = ((1.0, 2.0, 4.0), (1.0, 2.0, 4.0, -2.0))
"""Depths of the layers below the sensor, in those of the first: each tells of sources twice as large. The
last of the second is above, for what stands beside; the likelier of the two is taken, by the evidence."""

WEAK = 0.1
"""Strength of layers above in those of layers below, to begin with: what both can tell is below."""

DEPTH_SPACINGS = 1.8
"""Depth of the first layer in spacings of the survey: a layer nearer than about one tells of
waves that the readings do not resolve (Dampney 1969)."""

DRIVE_SPACINGS = 0.9
"""The same for a drive, whose readings are dense along it."""

LEAST_DEPTH_M = 0.3
"""Least depth of the first layer below the sensor [m]; a robot's sensor is not nearer to the floor's iron."""

SHEET = 0.6
"""Distance of the dipoles of a layer in its depth: e^(-2 pi / 0.6) of their field is ripple, 3e-5."""

MARGIN = 1.2
"""Width by which a layer goes beyond the readings, in its depth."""

REACH = 0.6
"""Distance over which dipoles share one strength, in their layer's depth."""

DRAWN = 0.005
"""Weight of the layer's strength beside that of the dipoles around, as a part of theirs."""

MOST_DIPOLES = 1500
"""Dipoles beyond which the layers are thinned."""

FEW_ROWS = 2700
"""Readings, parts of vectors counted each, up to which their matrix is factored; beyond, the unknowns' is."""

DIPOLES_OF_MANY = 800
"""Dipoles beyond which the layers are thinned where readings are many."""

MOST_ROWS = 2700
"""Readings beyond which those of a drive are averaged over longer ways."""

CELL = 1 / 6
"""Way along which the readings of a drive are averaged, in the first layer's depth."""

TURN_M = 0.1
"""Way that a turn of 1 rad counts as [m]."""

LEAST_READINGS = 8

BEGINNINGS, BEGUN_DIP = 4, np.radians(60.0)
"""Directions of the compass, and dip, that a fit begins with beside straight down where nothing tells the
Earth's field: several fields explain magnitudes, and steps find the one that is near."""

EARTH_SD_NT = 1000.0
"""How far the uniform part may lie from `earth_nt` [nT], each way."""

HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M = 3000.0, 0.03, 0.05
"""How large the parts of a platform may be: one standard deviation of their priors, about 0."""

ONE_HEADING = 0.99
"""Length of the headings' mean vector from which they are one: they spread by 8 deg at most."""

TAILS = np.geomspace(4.0, 48.0, 13)
"""Degrees of freedom of Student's t that are tried."""

ROUNDS = 30
"""Rounds in which the figures settle."""

LAYERWISE = 4
"""First rounds, in which a layer has one strength."""

SETTLED = 0.2
"""Change of the logarithm of the posterior below which Gauss-Newton has arrived."""

STEPS = 30

FIRST_STEPS = 4
"""Gauss-Newton steps under the first figures, before learning begins."""

STILL = 0.03
"""Change of the logarithms of figures in a round, in the mean over strengths, below which they are learnt."""

WIDTHS = np.linspace(-np.log(16), np.log(16), 161)
"""Logarithms of the widths of intervals that are tried, as factors of the posterior's variances."""

WIDTH_SD = np.log(2)
"""How far the width is thought to lie from 1, as a logarithm, before places are left out."""

FAR_TURN = np.radians(60.0)
"""Gap between headings from which what lies in it counts as not surveyed."""

TURN_SECTORS = 24
"""Sectors into which headings are parted to see where a scattered survey has none."""

STRAY = 0.05
"""Part of the readings up to which a heading of its own is none that was surveyed."""

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
    """Prior standard deviation of each part of each dipole's moment [A m^2], shape (D,)."""

    def change(self, before: "Figures") -> float:
        """How far the figures are from others, as a logarithm: the noise's, or the strengths' in the mean."""
        moved = np.sqrt(np.mean(np.log(self.strength / before.strength) ** 2))
        return float(max(abs(np.log(self.noise_nt / before.noise_nt)), moved))

    def variance(self, reading: Reading) -> Array:
        """Squared scale of each part of readings [nT^2], shape (N, C)."""
        return np.asarray(self._terms(reading).sum(axis=-1))

    def _terms(self, reading: Reading) -> Array:
        """What noise, place and heading add to it, shape (N, C, 3)."""
        place = self.position_m**2 * np.sum(reading.by_place**2, axis=-1)
        heading = self.heading_rad**2 * reading.by_yaw**2
        return np.stack([np.full_like(place, self.noise_nt**2), place, heading], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HarmonicModel(FittedModel):
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

    learnt: Array
    """What the readings tell of the unknowns, in units of `prior_sd`: the posterior's covariance is
    1 - learnt learnt^T there, shape (P, K)."""

    @property
    def method(self) -> str:
        """Name of the method."""
        return "harmonic"

    width: float
    """Factor of the magnitude's posterior variance where that is large beside the noise, see `_widened`."""

    headings_rad: Array
    """Headings that were surveyed, ascending, where they are few and far apart; else none, shape (H,)."""

    turned: float
    """Variance that headings between them add, over (d g)^2 with d and g the angles to the two beside,
    as headings left out in turn show it [nT^2/rad^4]: a platform is more than iron. Few headings tell it
    loosely: of the APRILab survey's four, each left out, 73 % lie in the 90 % intervals that the other three
    give; `magtwin map check --split heading` says so of any survey."""

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
            variance[part] = _widened(self._variance(read.jacobian[:, 0]), self.noise_nt2, self.width)
            variance[part] += self.turned * _between(self.headings_rad, yaw[part])
        return value.reshape(shape), variance.reshape(shape)

    def predict_vector(self, p_world: ArrayLike) -> tuple[Array, Array]:
        """The field without the robot, at any height between the layers of dipoles, and its variance.

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
        scaled = jacobian * self.prior_sd
        told = scaled @ self.learnt
        left = np.einsum("np,np->n", scaled, scaled) - np.einsum("nk,nk->n", told, told)
        return np.asarray(np.maximum(left, 0))


def _widened(variance_nt2: Array, noise_nt2: Array | float, width: Array | float) -> Array:
    """Posterior variances as places left out in turn show them to be.

    Beside readings, where the variance is small against the noise, the posterior is right. Away from
    them it is too modest, or too bold, by a factor, for the prior's layers are not the floor's iron.
    """
    return np.asarray(variance_nt2 * (noise_nt2 + width * variance_nt2) / (noise_nt2 + variance_nt2))


def _between(headings_rad: Array, yaw: Array) -> Array:
    """(d g)^2, d and g the angles from headings to the nearest of some on either side [rad^4]."""
    if not len(headings_rad):
        return np.zeros(len(yaw))
    up = np.mod(headings_rad[:, None] - yaw, TURN).min(axis=0)
    down = np.mod(yaw - headings_rad[:, None], TURN).min(axis=0)
    return np.asarray((up * down) ** 2)


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

    Vectors are fitted where the survey has them, else magnitudes. A platform is fitted where the headings
    differ; else it counts as part of the field. Readings of a drive that follow each
    other within a short way count as one, their mean.

    Magnitudes alone leave the field's sign open: B and -B read the same, with the hard iron turned too.
    Where the Earth's field is unknown the uniform part is thought to point down with the readings' median
    magnitude, give or take half of it each way, as nowhere but in the northern hemisphere; the fit is begun
    in several directions, and goes on from the likeliest. Name the Earth's field where it is known
    (`magtwin.field.earth`), above all where vectors are wanted. Where vectors are read it is thought to be
    their mean, as loosely.

    Args:
        readings: A survey; those that are not `good` count for nothing.
        depth_m: Depth of the dipoles' layers below the sensor [m], negative for layers above. Unless
            given, 1.8 spacings of the survey (0.9 of a drive), no nearer than `LEAST_DEPTH_M` or the floor,
            twice and four times that, and, if the evidence is for it, a layer above at twice that.
        spacing_m: Distance between the dipoles of the first layer [m]; 0.6 of a layer's depth unless
            given, and in every layer in proportion to its depth.
        earth_nt: The Earth's field in world axes [nT]; that of the readings unless given.
        earth_sd_nt: How far the uniform part of the lab's may lie from it, each way [nT].
        height_m: Height of the sensor above the floor [m]; that of the readings unless given, and 0
            where unknown: heights then count from the sensor.
        like: A model whose layers and figures are taken as they are, and its field to begin with; nothing but
            the field is learnt then.
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
    earth_nt = earth_nt if earth_nt is not None else readings.earth_nt
    _check(earth_nt, earth_sd_nt, height, spacing_m)
    if like is not None:
        if depth_m is not None or spacing_m is not None:
            raise RefusedError("like brings its own layers; leave out depth_m and spacing_m")
        problem = _Problem.of(good, _of_model(like), like.forward.height_m, earth_nt, earth_sd_nt)
        return problem.solve(like, progress).model(good)
    ladders = _ladders(depth_m, good, max(height, 0.0))
    fits: list[_State] = []
    for k, depths in enumerate(ladders):
        problem = _Problem.of(good, _layers(good, depths, spacing_m, height), height, earth_nt, earth_sd_nt)
        told = _part(progress, k, len(ladders))
        fits.append(problem.solve(None, told, [fits[0].uniform] if fits else None))
    return max(fits, key=_State.evidence).model(good)


def _tilted(magnitude_nt: float) -> list[Array]:
    """Fields that dip by `BEGUN_DIP` towards each of some directions of the compass."""
    level, down = magnitude_nt * np.cos(BEGUN_DIP), magnitude_nt * np.sin(BEGUN_DIP)
    angles = 2 * np.pi * np.arange(BEGINNINGS) / BEGINNINGS
    return [np.array([level * np.cos(a), level * np.sin(a), -down]) for a in angles]


def _part(progress: Progress | None, k: int, count: int) -> Progress | None:
    """Progress of the k-th of some fits, as a part of all."""
    if progress is None:
        return None
    return lambda done, total, what: progress(k * total + done, count * total, what)


def _check(
    earth_nt: Sequence[float] | None, earth_sd_nt: float, height: float, spacing_m: float | None
) -> None:
    if earth_nt is not None:
        checked_earth_nt(earth_nt)
    for name, value in (("earth_sd_nt", earth_sd_nt), ("spacing_m", spacing_m)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise RefusedError(f"{name} must be above 0, got {value!r}")
    if not np.isfinite(height):
        raise RefusedError(f"height_m must be a number, got {height!r}")


def _ladders(
    depth_m: float | Sequence[float] | None, good: Readings, height: float
) -> list[tuple[float, ...]]:
    """The sets of layers to try."""
    if depth_m is None:
        spacings = DRIVE_SPACINGS if good.grid is None else DEPTH_SPACINGS
        first = max(spacings * survey_spacing_m(good), LEAST_DEPTH_M, height)
        return [tuple(first * step for step in ladder) for ladder in LADDERS]
    depths = tuple(float(d) for d in np.atleast_1d(np.asarray(depth_m, float)))
    if not depths or not all(np.isfinite(d) and d != 0 for d in depths):
        raise RefusedError(f"depth_m must be depths below the sensor [m], other than 0, got {depth_m!r}")
    return [depths]


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
    parts = 1 if good.b_body_nt is None else 3
    rows = parts * (1 + int(_cells(good, CELL * min(map(abs, depths)), MOST_ROWS // parts).max()))
    most = MOST_DIPOLES if rows <= FEW_ROWS else DIPOLES_OF_MANY
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
        if count <= most:
            return _Layers(np.concatenate(places), np.concatenate(areas), np.concatenate(layer), depths)
        if spacing_m is not None:
            raise RefusedError(
                f"spacing_m {spacing_m:g} makes {count:,} dipoles, more than {most:,}; widen it"
            )
        part *= max(np.sqrt(count / most), 1.02)


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
    begins: list[Array]  # uniform fields to begin with

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
        cell = _cells(good, CELL * min(map(abs, layers.depths)), MOST_ROWS // read.shape[1])
        size = np.bincount(cell)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(cell, values) / size)

        read = np.column_stack([mean(part) for part in read.T])
        p = np.column_stack([mean(good.p_xy[:, 0]), mean(good.p_xy[:, 1])])
        yaw = np.arctan2(mean(np.sin(good.yaw)), mean(np.cos(good.yaw)))
        typical = float(np.median(good.b_nt))
        uniform, sd = np.array([0.0, 0.0, -typical]), typical / 2
        begins = [uniform, *_tilted(typical)]
        if earth_nt is not None:
            uniform, sd = np.asarray(earth_nt, float), earth_sd_nt
            begins = [uniform]
        elif good.b_body_nt is not None:
            c, s = np.cos(yaw), np.sin(yaw)
            turned = [c * read[:, 0] - s * read[:, 1], s * read[:, 0] + c * read[:, 1], read[:, 2]]
            uniform = np.array([part.mean() for part in turned])
            begins = [uniform]
        forward = Forward(layers.p_world_dipole, height)
        prior = np.zeros(forward.size)
        count = 3 * len(layers.p_world_dipole)
        prior[count : count + 3] = uniform
        rest = np.repeat([sd, HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M], [3, 3, 8, 2])
        if abs(np.mean(np.exp(1j * yaw))) > ONE_HEADING:
            rest[3:] = 0.0  # a platform that never turned cannot be told from the field
        return cls(forward, layers, p, yaw, read, cell, prior, rest, begins)

    @property
    def vectors(self) -> bool:
        return self.read_nt.shape[1] == 3

    def places(self) -> list[NDArray[np.intp]]:
        """Rows of the parts of readings that lie together: at one node, or within a spacing."""
        side = abs(self.layers.depths[0]) / DEPTH_SPACINGS
        square = np.floor(self.p_xy / side + 0.5).astype(np.int64)
        _, place = np.unique(square, axis=0, return_inverse=True)
        rows = np.arange(self.read_nt.size).reshape(self.read_nt.shape)
        order = np.argsort(place.ravel(), kind="stable")
        ends = np.flatnonzero(np.diff(place.ravel()[order])) + 1
        return [rows[part].ravel() for part in np.split(order, ends)]

    def at(self, unknowns: Array) -> Reading:
        return self.forward.read(unknowns, self.p_xy, self.yaw, vectors=self.vectors)

    def solve(
        self, like: HarmonicModel | None, progress: Progress | None, begins: list[Array] | None = None
    ) -> "_State":
        """Fit, and learn the figures unless a model brings them; begun with these uniform fields."""
        if like is not None:
            return _State(self, like.figures, like.unknowns, self.at(like.unknowns)).settle()
        begun = [_State.start(self, self._first(), uniform) for uniform in begins or self.begins]
        if len(begun) > 1:
            for _ in range(LAYERWISE):
                begun = [state.learnt(None).step() for state in begun]
        state = max(begun, key=_State.evidence) if len(begun) > 1 else begun[0]
        shares, rounds = _shares(self.layers), ROUNDS
        for done in range(rounds):
            if progress is not None:
                progress(done, rounds, "learning")
            before = state.figures
            state = state.learnt(shares if done >= LAYERWISE else None).step()
            if done > LAYERWISE and state.figures.change(before) < STILL:
                break
        state = state.settle()
        if progress is not None:
            progress(rounds, rounds, "learning")
        return state

    def _first(self) -> Figures:
        """Figures to begin with: strengths that make the field's spread, noises of a small part of it."""
        spread = float(self.read_nt.std(axis=0).max())
        depth = np.array(self.layers.depths)[self.layers.layer]
        above = depth < 0
        # a white layer of density s per metre makes a field of variance 3 (1e2 s)^2 pi / (8 d^4) or so
        density = max(spread, 1.0) * depth**2 / 100
        return Figures(
            noise_nt=max(spread / 50, 1e-3),
            position_m=0.01,
            heading_rad=0.02 if np.any(self.rest_sd[3:]) else 0.0,
            freedom=8.0,
            strength=density * np.sqrt(self.layers.area_m2) * np.where(above, WEAK, 1.0),
        )


def _cells(good: Readings, way_m: float, most: int) -> NDArray[np.intp]:
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
        if np.count_nonzero(new) < most:
            break
        way_m *= 1.1
    cell = np.empty(len(good), np.intp)
    cell[order] = np.concatenate([[0], np.cumsum(new)])
    return cell


def _headings(yaw: Array) -> tuple[Array, NDArray[np.intp]]:
    """Means of headings that lie together, ascending, and which of them each belongs to, -1 for a stray one.

    None where the headings are all around, or fewer than three.
    """
    angle = np.mod(yaw, TURN)
    sorted_angles = np.sort(angle)
    gap = np.diff(np.append(sorted_angles, sorted_angles[0] + TURN))
    wide = gap > TURN / TURN_SECTORS
    none = np.empty(0), np.full(len(yaw), -1)
    if gap.max() < FAR_TURN:
        return none
    edges = np.sort(np.mod(sorted_angles[wide] + gap[wide] / 2, TURN))
    group = np.searchsorted(edges, angle) % len(edges)
    count = np.bincount(group, minlength=len(edges))
    whole = np.flatnonzero(count > STRAY * len(yaw))
    if len(whole) < 3:
        return none
    mean = np.array([np.angle(np.exp(1j * angle[group == k]).sum()) for k in whole]) % TURN
    order = np.argsort(mean)
    rank = np.full(len(edges), -1)
    rank[whole[order]] = np.arange(len(whole))
    return mean[order], rank[group]


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
    def start(cls, problem: _Problem, figures: Figures, uniform: Array) -> "_State":
        """Steps from a uniform field, in the first of which all readings are trusted alike and little."""
        unknowns = problem.mean.copy()
        count = 3 * len(figures.strength)
        unknowns[count : count + 3] = uniform
        state = cls(problem, figures, unknowns, problem.at(unknowns))
        off = problem.read_nt - state.reading.values_nt
        coarse = np.full(off.shape, max(float(np.mean(off**2)) / 100, figures.noise_nt**2))
        state = state._moved(state._towards(1 / coarse), 1.0)
        for _ in range(FIRST_STEPS):
            state = state.step()
        return state

    @property
    def uniform(self) -> Array:
        """The uniform part of the field [nT]."""
        count = 3 * len(self.figures.strength)
        return self.unknowns[count : count + 3]

    @property
    def prior_sd(self) -> Array:
        return np.concatenate([np.repeat(self.figures.strength, 3), self.problem.rest_sd])

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
        moved = self._scaled()
        return float((freedom + parts) / 2 * surprise.sum() + moved @ moved / 2)

    def posterior(self, precision: Array) -> Posterior:
        """What the readings, of these precisions (N, C), tell of the unknowns in units of their priors."""
        return Posterior.of(self._rows() * np.sqrt(precision).reshape(-1, 1))

    def _rows(self) -> Array:
        return self.reading.jacobian.reshape(-1, self.reading.jacobian.shape[-1]) * self.prior_sd

    def _scaled(self) -> Array:
        """The unknowns from their priors' means, in units of their standard deviations; 0 where held."""
        sd = self.prior_sd
        return np.divide(self.unknowns - self.problem.mean, sd, out=np.zeros_like(sd), where=sd > 0)

    def _towards(self, precision: Array) -> Array:
        """The unknowns that solve the problem made linear here."""
        posterior, root = self.posterior(precision), np.sqrt(precision).ravel()
        best = posterior.mean(root * self.off.ravel() + posterior.rows @ self._scaled())
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
        from scipy.special import gammaln, psi

        figures, layers = self.figures, self.problem.layers
        variance = figures.variance(self.reading)
        weights = self.weights(variance)
        precision = weights[:, None] / variance
        posterior = self.posterior(precision)
        count = len(figures.strength)
        known = posterior.known()[: 3 * count].reshape(count, 3).mean(axis=1)
        known = np.clip(known, 1e-9, 1)
        square = np.mean(self.unknowns[: 3 * count].reshape(count, 3) ** 2, axis=1) / layers.area_m2
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
        left = posterior.fitted().reshape(variance.shape) / precision
        size = (self.off**2 + left) * weights[:, None] / variance
        share = figures._terms(self.reading) / variance[..., None]
        whole_share = np.maximum(np.sum(share, axis=(0, 1)), np.finfo(float).tiny)  # 0 for what is held at 0
        scale = np.sqrt(np.sum(share * size[..., None], axis=(0, 1)) / whole_share)
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
        return float(fit - self.posterior(precision).half_log_det())

    def model(self, good: Readings) -> HarmonicModel:
        """The fitted model."""
        figures, problem = self.figures, self.problem
        variance = figures.variance(self.reading)
        precision = self.weights(variance)[:, None] / variance
        posterior = self.posterior(precision)
        learnt, width = posterior.directions(), self._width(posterior, precision)
        headings, turned = self._turned(posterior, precision)
        field = problem.forward.field(self.unknowns)
        slopes = problem.forward.read(self.unknowns, problem.p_xy, problem.yaw, vectors=False)
        wide = figures.freedom / (figures.freedom - 2)
        noise = wide * float(np.mean(figures.variance(slopes)))
        off = good.b_nt - field.magnitude_nt(good.p_xy, good.yaw)
        within = off - (np.bincount(problem.cell, off) / np.bincount(problem.cell))[problem.cell]
        noise += float(np.mean(within**2))
        return HarmonicModel(
            field=field,
            parameters=self._parameters(learnt, width, len(good))
            | {"added between headings [nT/rad^2]": round(float(np.sqrt(turned)), 2)},
            noise_nt2=noise,
            figures=figures,
            forward=problem.forward,
            unknowns=self.unknowns,
            prior_sd=self.prior_sd,
            learnt=learnt,
            width=width,
            headings_rad=headings,
            turned=turned,
        )

    def _width(self, posterior: Posterior, precision: Array) -> float:
        """See `HarmonicModel.width`.

        The likeliest under Student's t, a place counting once; where readings tell nothing of it, near 1.
        """
        root, places = np.sqrt(precision).ravel(), self.problem.places()
        target = root * self.off.ravel() + posterior.rows @ self._scaled()
        off, field = posterior.left_out(target, places)
        share = np.empty(len(root))
        for rows in places:
            share[rows] = 1 / len(rows)
        noise, freedom = self.figures.variance(self.reading).ravel(), self.figures.freedom
        square, field = (off / root) ** 2, field / root**2
        scale = _widened(field, noise, np.exp(WIDTHS)[:, None]) + noise
        surprise = (freedom + 1) / 2 * np.log1p(square / (freedom * scale)) + np.log(scale) / 2
        return float(np.exp(WIDTHS[np.argmin(surprise @ share + (WIDTHS / WIDTH_SD) ** 2 / 2)]))

    def _turned(self, posterior: Posterior, precision: Array) -> tuple[Array, float]:
        """See `HarmonicModel.headings_rad` and `HarmonicModel.turned`."""
        from scipy.special import stdtrit

        heading, group = _headings(self.problem.yaw)
        if not len(heading) or not np.any(self.problem.rest_sd[3:]):
            return np.empty(0), 0.0
        root = np.sqrt(precision).ravel()
        target = root * self.off.ravel() + posterior.rows @ self._scaled()
        rows = np.arange(len(root)).reshape(precision.shape)
        groups = [rows[group == h].ravel() for h in range(len(heading))]
        off, field = posterior.left_out(target, groups)
        beyond, away = 0.0, 0.0
        for h, part in enumerate(groups):
            beyond += float(np.sum((off[part] ** 2 - field[part] - 1) / root[part] ** 2))
            away += len(part) * float(_between(np.delete(heading, h), heading[h : h + 1])[0])
        few = float(stdtrit(len(heading), 0.95)) / NINETY  # so many headings tell it: Student's t
        return heading, max(beyond / away, 0.0) * few**2

    def _parameters(self, learnt: Array, width: float, count: int) -> dict[str, Any]:
        figures, problem = self.figures, self.problem
        last = learnt[-len(problem.rest_sd) :]
        sd = problem.rest_sd * np.sqrt(np.maximum(1 - np.sum(last**2, axis=1), 0))
        uniform, hard, soft, lever = np.split(self.unknowns[-len(problem.rest_sd) :], [3, 6, 14])
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
            "soft iron": np.round(np.tensordot(soft, SOFT, 1).ravel(), 5).tolist(),
            "soft iron, sd": np.round(np.sqrt(np.tensordot(sd[6:14] ** 2, SOFT**2, 1)).ravel(), 5).tolist(),
            "lever arm [m]": np.round(lever, 5).tolist(),
            "lever arm, sd [m]": np.round(sd[14:], 5).tolist(),
            "width of variances": round(width, 4),
            "log evidence": round(self.evidence(), 2),
        }
