"""Gaussian process over position and heading, conditioned on a survey."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.fit.covariance import Covariance, Kernel
from magtwin.field.fit.interpolation import check_readings
from magtwin.field.fit.methods import FittedModel, in_own_axes
from magtwin.field.fit.nodes import variance_at_nodes
from magtwin.field.fit.passes import by_pass
from magtwin.field.fit.roughness import local_mean, tail
from magtwin.field.survey.axes import WORLD, SurveyAxes
from magtwin.field.survey.bins import GRAIN_M, Bins, bin_readings, spacing_m
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Progress = Callable[[int, int, str], Any]

MOST = 2500  # Most readings, or means of adjacent ones, in the conditioning: 50 MB of covariance
MOST_LEARNT = 800  # Most of these from which the hyperparameters are learnt
MOST_TRIED = 240  # Most of these on which the starts are tried
STARTS = (1.0, 0.4, 2.5)  # Initial reaches of the optimisation, as factors of the first guess
START_STEPS = 30  # Steps of L-BFGS from each start
STEPS = 60  # Most steps of L-BFGS from the best start
RESUMED_STEPS = 8  # The same from an earlier fit
PATCHES = 8  # Most patches along the longer side of the floor, each with its own field strength
# Least distance between patches, in spacings of the readings: smaller ones cannot tell strength from noise
PATCH_SPACINGS = 3.0
# Largest change of a hyperparameter from its first guess: a factor of 400 for logarithms, 0.2 m for the arm
WIDEST = 6.0
SECTORS = 24  # Heading sectors in which adjacent readings are averaged separately
FINEST = 8  # Averaging cells per spacing for readings of a drive, at least
BLOCK = 256  # Poses predicted at a time: their covariances stay in the cache
COARSE = 0.6  # Largest distance between nodes at which the variance is computed, in spacings of the readings


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class GpModel(FittedModel):
    """A Gaussian process conditioned on readings."""

    parameters: Mapping[str, Any]  # Hyperparameters and data, by name with unit
    noise_nt2: float  # Variance of a reading about the field [nT^2]: sensor, headings, positions, and runs
    covariance: Covariance  # Form of the covariance
    figures: Array  # Its hyperparameters, shape (covariance.size,)
    mean_nt: float  # Mean of the readings [nT]
    # Positions [m], shape (N, 2), and headings [rad], shape (N,), of the conditioning
    poses: tuple[Array, Array]
    lower: Array  # Cholesky factor of the readings' covariance, shape (N, N)
    alpha: Array  # Inverse of that covariance times the readings minus their mean, shape (N,)
    # Positions left out in turn, a cKDTree, and the mean squared residual over the variance at each
    missed: tuple[Any, Array]
    spacing_m: float  # Spacing of the readings [m]
    method: str = "gp"  # Name of the method
    axes: SurveyAxes = WORLD  # Axes of `poses` and `missed`

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field [nT] and its variance [nT^2] at poses; nan if a pose is nan. See `FieldModel`.

        The variance is that of the process (Rasmussen & Williams 2006, eq. 2.26), scaled by the local
        residuals of positions left out, since real fields are rougher in some places, and so that 90 % of all
        readings left out lie in their 90 % intervals.
        """
        p, angle, shape = self.own_poses(p_xy, yaw)
        mean, variance = self._at(p, angle)
        return mean.reshape(shape), variance.reshape(shape)

    def predict_values(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """The field of `predict` alone [nT]."""
        p, angle, shape = self.own_poses(p_xy, yaw)
        return self._at(p, angle, sure=False)[0].reshape(shape)

    def predict_nodes(self, p_xy: Array, yaw: float) -> tuple[Array, Array]:
        """`predict` on evenly spaced nodes at one heading, shape (Y, X, 2), several times faster.

        On a fine grid the variance is computed only at nodes `COARSE` apart, and interpolated.
        """
        value = self.predict_values(p_xy, yaw)
        return value, variance_at_nodes(p_xy, COARSE * self.spacing_m, lambda p: self.predict(p, yaw)[1])

    def _at(self, p: Array, angle: Array, *, sure: bool = True) -> tuple[Array, Array]:
        """Field [nT] and, if `sure`, its variance [nT^2] at poses (N, 2), (N,)."""
        from scipy.linalg import solve_triangular

        mean, variance = np.full(len(p), np.nan), np.full(len(p), np.nan)
        finite = np.flatnonzero(np.isfinite(p).all(axis=1) & np.isfinite(angle))
        for start in range(0, len(finite), BLOCK):
            rows = finite[start : start + BLOCK]
            across = self.covariance.between(self.figures, self.poses, (p[rows], angle[rows]))
            mean[rows] = self.mean_nt + across.T @ self.alpha
            if not sure:
                continue
            half = solve_triangular(self.lower, across, lower=True, overwrite_b=True, check_finite=False)
            prior = self.covariance.variance_nt2(self.figures, p[rows])
            own = np.maximum(prior - np.einsum("ij,ij->j", half, half), 0.0)
            variance[rows] = own * local_mean(*self.missed, p[rows])
        return mean, variance


@in_own_axes
def fit_gp(
    readings: Readings,
    *,
    kernel: Kernel = "poisson",
    like: GpModel | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
) -> GpModel:
    """Condition a Gaussian process on the good readings, with the likeliest hyperparameters.

    Recorded headings are used. More than `MOST` readings, and those of a drive, are averaged per run, cell
    and sector of heading; their scatter adds to the noise. The hyperparameters, including the field's
    strength in each patch of the floor, maximise the marginal likelihood by L-BFGS from several starts.

    `like` is a fit with the same kernel to other readings of the same survey. The optimisation starts from
    its hyperparameters, which saves the starts. `steps` are the most of the optimisation; by default `STEPS`,
    or `RESUMED_STEPS` from an earlier fit.
    """
    if kernel not in ("matern", "poisson"):
        raise InputError(f'kernel must be "matern" or "poisson", got {kernel!r}')
    check_readings(readings)
    say = progress or (lambda done, total, what: None)
    total = len(STARTS) + 3
    say(0, total, "averaging")
    bins, within = _data(by_pass(readings))
    mean = float(bins.b_nt.mean())
    poses, b = (bins.p_xy, bins.yaw), bins.b_nt - mean
    several = readings.grid is None and len(np.unique(bins.run)) > 1
    turned = np.ptp(np.abs(np.angle(np.exp(1j * (bins.yaw - bins.yaw[0]))))) > 1e-6
    spacing = spacing_m(readings)
    covariance = Covariance(kernel, 3 if turned else 1, several, *_patches(bins.p_xy, spacing))
    order = np.random.default_rng(0).permutation(len(b))  # a fixed draw: which rows are learnt from
    figures = _learn(
        covariance, bins, b, order, spacing, like, steps, lambda done, what: say(done, total, what)
    )
    say(total - 2, total, "conditioning")
    lower = _factor(covariance, figures, bins)
    from scipy.linalg import cho_solve

    alpha = cho_solve((lower, True), b)
    say(total - 1, total, "leaving out")
    missed = _missed(covariance, figures, bins, b, order, lower, spacing)
    noise = covariance.noise_nt2(figures) + covariance.run_nt2(figures) + within
    say(total, total, "done")
    return GpModel(
        parameters=_parameters(covariance, figures, readings, len(b), noise),
        noise_nt2=noise,
        covariance=covariance,
        figures=figures,
        mean_nt=mean,
        poses=poses,
        lower=lower,
        alpha=alpha,
        missed=missed,
        spacing_m=spacing,
    )


def _data(readings: Readings) -> tuple[Bins, float]:
    """Data of the conditioning, and the variance of a reading within a mean [nT^2]."""
    good = readings.good
    cell = GRAIN_M if readings.grid is not None else spacing_m(readings) / FINEST
    while True:
        bins, index = bin_readings(readings, cell, sectors=SECTORS, by_run=True)
        if len(bins.b_nt) <= MOST:
            break
        cell = max(1.2 * cell, GRAIN_M)
    freedom = len(index) - len(bins.b_nt)
    away = readings.b_nt[good] - bins.b_nt[index]
    return bins, float(away @ away / freedom) if freedom else 0.0


def _patches(p_xy: Array, spacing: float) -> tuple[Array, float]:
    """Centres of even patches over the readings, and their spacing [m]."""
    low, high = p_xy.min(axis=0), p_xy.max(axis=0)
    apart = max(float((high - low).max()) / PATCHES, PATCH_SPACINGS * spacing)
    axes = [np.linspace(a, b, round((b - a) / apart) + 1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2), apart


def _learn(
    covariance: Covariance,
    bins: Bins,
    b: Array,
    order: Rows,
    least_m: float,
    like: GpModel | None,
    steps: int | None,
    say: Callable[[int, str], Any],
) -> Array:
    """The likeliest hyperparameters: the best of several starts on few readings, then on more.

    An earlier fit with as many hyperparameters is the only start. The others have one strength everywhere. No
    reach is below the readings' spacing: such a part would be noise.
    """
    from scipy.optimize import minimize

    guess, h = _guess(covariance, bins, b), covariance.harmonics
    least = guess - WIDEST
    reaches = [*range(h, 2 * h), *([3 * h + 2] * covariance.runs)]
    least[reaches] = np.minimum(np.log(least_m), guess[reaches])
    bounds = list(zip(least, guess + WIDEST, strict=True))

    even = bounds.copy()
    even[covariance.of_patches] = [(0.0, 0.0)] * len(covariance.patches)

    def descend(start: Array, rows: Rows, steps: int, bounds: Any, turn: int) -> tuple[float, Array]:
        data = (bins.p_xy[rows], bins.yaw[rows], bins.run[rows], b[rows])
        result = minimize(
            covariance.loss,
            np.maximum(start, least),
            (guess, *data),
            "L-BFGS-B",
            jac=True,
            bounds=bounds,
            options={"maxiter": steps},
            callback=lambda _: say(turn, "learning"),
        )
        return float(result.fun), np.asarray(result.x)

    if (
        like is not None
        and like.covariance.size == covariance.size
        and like.covariance.runs == covariance.runs
    ):
        best, most = like.figures, RESUMED_STEPS
    else:
        tried = np.sort(order[:MOST_TRIED])
        starts = []
        for k, factor in enumerate(STARTS):
            say(k, "starts")
            start = guess.copy()
            start[h : 2 * h] += np.log(factor)
            starts.append(descend(start, tried, START_STEPS, even, k))
        best, most = min(starts, key=lambda start: start[0])[1], STEPS
    say(len(STARTS), "figures")
    return descend(best, np.sort(order[:MOST_LEARNT]), steps or most, bounds, len(STARTS))[1]


def _guess(covariance: Covariance, bins: Bins, b: Array) -> Array:
    """First guess: the readings' spread and an eighth of the floor."""
    h, spread = covariance.harmonics, float(b.std())
    extent = float(np.ptp(bins.p_xy, axis=0).max())
    waves = [np.log(spread)] + [np.log(spread / 20)] * (h - 1)
    even = [np.log(spread)] + [np.log(spread / 10)] * (h - 1)
    guess = [*waves, *[np.log(extent / 8)] * h, *even, np.log(spread / 50)]
    guess += [np.log(spread / 20), np.log(extent / 16)] * covariance.runs
    guess += [0.0] * (len(covariance.patches) + 2 * (h > 1))
    return np.array(guess)


def _factor(covariance: Covariance, figures: Array, bins: Bins, rows: Any = slice(None)) -> Array:
    """Cholesky factor of the covariance of the readings, with noise and runs."""
    from scipy.linalg import cholesky

    poses, run = (bins.p_xy[rows], bins.yaw[rows]), bins.run[rows]
    matrix = covariance.between(figures, poses, poses)
    if covariance.runs:
        matrix += covariance.within_runs(figures, covariance.places(figures, *poses), run)
    matrix[np.diag_indices_from(matrix)] += covariance.noise_nt2(figures)
    return np.asarray(cholesky(matrix, lower=True, overwrite_a=True, check_finite=False))


def _missed(
    covariance: Covariance, figures: Array, bins: Bins, b: Array, order: Rows, lower: Array, side_m: float
) -> tuple[Any, Array]:
    """Leave out each cell of the floor in turn: its centre, and its mean squared residual over the variance.

    With P the inverse of the covariance, the residual of a block is P_bb^-1 (P b)_b, with covariance P_bb^-1
    (Rasmussen & Williams 2006, eq. 5.12, for blocks).
    """
    from scipy.linalg.lapack import dpotri
    from scipy.spatial import cKDTree

    rows = np.arange(len(b))
    if len(b) > 2 * MOST_LEARNT:
        rows = np.sort(order[: 2 * MOST_LEARNT])
        lower = _factor(covariance, figures, bins, rows)
    inverse = np.tril(dpotri(lower, lower=1)[0])
    inverse += np.tril(inverse, -1).T
    pull = inverse @ b[rows]
    cell = np.floor((bins.p_xy[rows] - bins.p_xy.min(axis=0)) / side_m + 0.5).astype(np.int64)
    _, block = np.unique(cell, axis=0, return_inverse=True)
    block = block.ravel()
    places: list[Array] = []
    squares, each, place = [], [], []
    for members in np.split(np.argsort(block, kind="stable"), np.cumsum(np.bincount(block))[:-1]):
        spread = np.linalg.inv(inverse[np.ix_(members, members)])
        miss = spread @ pull[members]
        squares.append(float(miss @ pull[members]) / len(members))
        each.append(miss**2 / np.diag(spread))
        place.append(np.full(len(members), len(places)))
        places.append(bins.p_xy[rows][members].mean(axis=0))
    tree, squared = cKDTree(np.array(places)), np.array(squares)
    return tree, squared * tail(tree, squared, np.concatenate(each), np.concatenate(place))


def _parameters(
    covariance: Covariance, figures: Array, readings: Readings, count: int, noise: float
) -> dict[str, Any]:
    h = covariance.harmonics
    size, uneven = np.exp(figures[: 3 * h]), np.exp(figures[covariance.of_patches])
    parameters: dict[str, Any] = {
        "kernel": covariance.kernel,
        "readings": int(readings.good.sum()),
        "conditioned_on": count,
        "sd_nt": [round(float(v), 3) for v in size[:h]],
        "reach_m": [round(float(v), 5) for v in size[h : 2 * h]],
        "uniform_sd_nt": [round(float(v), 3) for v in size[2 * h :]],
        "strength_of_patches": [round(float(uneven.min()), 3), round(float(uneven.max()), 3)],
        "noise_nt": round(float(np.sqrt(noise)), 3),
    }
    if covariance.runs:
        parameters["run_sd_nt"] = round(float(np.sqrt(covariance.run_nt2(figures))), 3)
        parameters["run_reach_m"] = round(float(np.exp(figures[3 * h + 2])), 5)
    if h > 1:
        parameters["p_base_sensor_m"] = [round(float(v), 5) for v in covariance.arm_m(figures)]
    return parameters
