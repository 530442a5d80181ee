"""Interpolation of a survey, trilinear (as in the paper) and cubic: the baselines of all other methods.

A gridded survey is interpolated on its nodes and nominal headings. A scattered one is split into a wave over
heading, the same everywhere, and a part that depends on the position, interpolated over triangles.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.fit.methods import FittedModel, in_own_axes
from magtwin.field.fit.passes import by_pass
from magtwin.field.fit.roughness import Interpolation, Roughness
from magtwin.field.grid import TURN, Grid
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.trilinear import spread
from magtwin.field.survey.axes import WORLD, SurveyAxes
from magtwin.field.survey.bins import Bins, bin_readings, spacing_m
from magtwin.field.survey.node_errors import node_errors
from magtwin.field.survey.readings import Readings, masked_words

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

EDGE = 1e-9  # Rounding forgiven at a node, in cells; also the weight from which an unknown node counts
BINS_A_SPACING = 4  # Averaging cells per spacing of a scattered survey
FLATTEST = 0.05  # Least relative spread of a heading wave within cells; waves with less are not fitted
LEAST = 4  # Fewest readings of a map
# Squared error of a periodic cubic spline midway between four headings over that of a line, for a cosine
CUBIC_TURN = 0.009


@in_own_axes
def fit_trilinear(readings: Readings, *, fill: bool = False) -> "GridInterpolation | ScatterInterpolation":
    """Linear interpolation in x, y and heading; exact at the nodes of a gridded survey.

    On a gridded survey as `AnomalyMap.lookup`: B = sum of w_h w_y w_x B_hyx over the eight nodes around.
    Recorded headings are not used, as in the paper. A scattered survey is interpolated over Delaunay
    triangles.

    `fill`: nodes of a gridded survey that have no good reading are filled from the nearest good ones on both
    sides in row and column of the same heading: linear between each two, weighted by 1 / (a b)^2 with
    distances a and b. Otherwise cells at such a node are unknown.

    The variance is that of a reading (`magtwin.field.survey.node_errors`; for a scattered survey, that of
    readings at one place), plus the interpolation error: from the second differences of the nodes
    (`magtwin.field.maps.curvature`), or, if nodes are filled and for a scattered survey, that at positions
    left out in turn (`Roughness`).
    """
    return _fit(readings, "trilinear", fill)


@in_own_axes
def fit_cubic(readings: Readings, *, fill: bool = False) -> "GridInterpolation | ScatterInterpolation":
    """Cubic interpolation in x and y, periodic cubic splines in heading; smooth, and exact at nodes.

    Bicubic splines (not-a-knot; de Boor 1978) on a gridded survey, Clough-Tocher triangles on a scattered
    one. Arguments, result and errors are those of `fit_trilinear`, but missing nodes are filled by
    Clough-Tocher triangles, and the interpolation error is always that at positions left out.
    """
    return _fit(readings, "cubic", fill)


def check_readings(readings: Readings) -> None:
    """Refuse readings from which no method can make a map."""
    good = readings.good
    count, of = int(np.count_nonzero(good)), f"of {len(readings)} in {readings.name or 'the survey'}"
    if count < LEAST:
        raise InputError(f"{count} good readings {of}{masked_words(readings)}; a map needs {LEAST} at least")
    p, b = readings.p_xy[good], readings.b_nt[good]
    if np.ptp(b if readings.b_body_nt is None else readings.b_body_nt[good], axis=0).max() == 0:
        raise InputError(f"all {count} good readings {of} are {b[0]:.10g} nT: a stuck sensor; survey again")
    spans = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    if not spans[1] > 1e-6 * spans[0] + EDGE:
        raise InputError(f"the {count} good readings {of} lie on one line; a map needs an area")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class GridInterpolation(FittedModel):
    """Values on the nodes of a survey, interpolated."""

    method: str  # "trilinear" or "cubic"
    parameters: Mapping[str, Any]  # Parameters of the fit
    noise_nt2: float  # Variance of a reading about the field of its node, mean over the survey [nT^2]
    grid: Grid  # The nodes
    values_nt: Array  # Field at the nodes [nT], shape (H, Y, X); 0 where not `known`
    known: Flags  # Nodes that were read or filled, shape (H, Y, X)
    node_nt2: Array  # Variance of the value of each node [nT^2], shape (H, Y, X)
    roughness: Roughness  # Error of interpolation between nodes
    turned_nt2: float  # Mean squared error of interpolating a heading that is left out [nT^2]
    # Mean squared error of interpolation in the middle of a cell and midway between headings [nT^2], shape
    # (2, H, Y, X); None: that of `roughness` and `turned_nt2`
    between_nt2: Array | None
    axes: SurveyAxes = WORLD  # Axes of the nodes

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field [nT] and its variance [nT^2] at poses; nan off the grid and in unknown cells. See
        `FieldModel`.
        """
        from scipy.interpolate import RectBivariateSpline

        p, angle, shape = self.own_poses(p_xy, yaw)
        u = (p - self.grid.origin_m) / self.grid.cell_m
        last = np.array([self.grid.columns - 1, self.grid.rows - 1])
        inside = np.all((u >= -EDGE) & (u <= last + EDGE), axis=1) & np.isfinite(angle)
        u = np.where(inside[:, None], np.clip(u, 0, last), 0.0)
        u = np.where(np.abs(u - np.rint(u)) < EDGE, np.rint(u), u)
        low = np.minimum(u.astype(np.intp), last - 1)
        part, angle = u - low, np.where(inside, angle, 0.0)
        linear, between = _heading_weights(self.grid.headings_rad, angle)
        weights = _periodic_cubic(self.grid.headings_rad, angle) if self.method == "cubic" else linear
        mean, unknown, nodes = np.zeros(len(p)), np.zeros(len(p)), np.zeros(len(p))
        both = np.zeros((2, len(p)))
        splines = None
        if self.method == "cubic":
            rows, columns = np.arange(self.grid.rows), np.arange(self.grid.columns)
            ky, kx = min(3, self.grid.rows - 1), min(3, self.grid.columns - 1)
            splines = [RectBivariateSpline(rows, columns, b, kx=ky, ky=kx, s=0) for b in self.values_nt]
        for h, (layer, known) in enumerate(zip(self.values_nt, self.known, strict=True)):
            if self.between_nt2 is None:
                nodes += weights[:, h] ** 2 * _bilinear(self.node_nt2[h], low, part, squared=True)
            else:
                nodes += weights[:, h] * _bilinear(self.node_nt2[h], low, part)
                for total, error in zip(both, self.between_nt2[:, h], strict=True):
                    total += weights[:, h] * _bilinear(error, low, part)
            unknown += np.abs(weights[:, h]) * _bilinear((~known).astype(float), low, part)
            if splines is None:
                mean += weights[:, h] * _bilinear(layer, low, part)
            else:
                mean += weights[:, h] * splines[h].ev(u[:, 1], u[:, 0])
        if self.between_nt2 is None:
            at = np.where(inside[:, None], p, self.grid.origin_m)
            variance = self.roughness.variance_nt2(at) + (between * (1 - between)) ** 2 * self.turned_nt2
            if splines is not None:
                nodes *= np.prod(_cubic_share(part), axis=1)
            variance += nodes  # a node's value is a reading, and errs as one
        else:  # as `AnomalyMap.lookup_with_sd`
            variance = spread(nodes, both[0], both[1], part[:, 0], part[:, 1], between)
        hole = ~inside | (unknown > EDGE)
        mean[hole] = variance[hole] = np.nan
        return mean.reshape(shape), variance.reshape(shape)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ScatterInterpolation(FittedModel):
    """A surface over triangles of scattered readings, and a wave over heading."""

    method: str  # "trilinear" or "cubic"
    parameters: Mapping[str, Any]  # Parameters of the fit
    noise_nt2: float  # Variance of readings at one place, within and between runs [nT^2]
    p_xy: Array  # Positions of the surface's vertices [m], shape (M, 2)
    b_nt: Array  # Values at the vertices [nT], shape (M,)
    place_nt2: Array  # Variance of these values [nT^2], shape (M,)
    wave_nt: Array  # Coefficients of cos yaw, sin yaw, cos 2 yaw, sin 2 yaw [nT], shape (4,)
    roughness: Roughness  # Error of interpolation between the vertices
    axes: SurveyAxes = WORLD  # Axes of the vertices and of the wave

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field [nT] and its variance [nT^2] at poses; nan outside the convex hull. See `FieldModel`."""
        p, angle, shape = self.own_poses(p_xy, yaw)
        finite = np.all(np.isfinite(p), axis=1)
        at = np.where(finite[:, None], p, self.p_xy[0])
        mean = _triangles(self.method)(self.p_xy, self.b_nt, at) + _waves(angle) @ self.wave_nt
        variance = self.roughness.variance_nt2(at) + self.place_nt2[self.roughness.tree.query(at)[1]]
        mean[~finite] = np.nan
        variance[~np.isfinite(mean)] = np.nan
        return mean.reshape(shape), variance.reshape(shape)


def _fit(readings: Readings, method: str, fill: bool) -> GridInterpolation | ScatterInterpolation:
    from scipy.spatial import cKDTree

    check_readings(readings)
    grid, good = readings.grid, readings.good
    if grid is None:
        return _fit_scattered(readings, method)
    node = np.ravel_multi_index(tuple(np.asarray(readings.node)[good].T), grid.shape)
    count = np.bincount(node, minlength=int(np.prod(grid.shape))).reshape(grid.shape)
    total = np.bincount(node, weights=readings.b_nt[good], minlength=count.size).reshape(grid.shape)
    values: Array = np.asarray(total / np.maximum(count, 1), float)
    read = count > 0
    places = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1)
    between = _triangles(method)
    filled, known = values.copy(), read.copy()
    for h, there in enumerate(read):
        if there.all():
            continue
        p = places[there]
        if len(p) < 3 or np.linalg.svd(p - p.mean(axis=0), compute_uv=False)[1] <= EDGE:
            raise InputError(
                f"heading {np.degrees(grid.headings_rad[h]):g} deg has {len(p)} nodes with a good reading, "
                "not three off one line; leave the heading out, or survey it again"
            )
        if method == "trilinear":
            filled[h][~there] = _across(values[h], there)[~there]
            known[h] = np.isfinite(filled[h])
        else:
            filled[h][~there] = between(p, values[h][there], places[~there])
            known[h] = np.isfinite(filled[h])
            # the spline needs a whole grid: beyond the hull, the nearest value
            _, nearest = cKDTree(places[known[h]]).query(places[~known[h]])
            filled[h][~known[h]] = filled[h][known[h]][nearest]
    errors = node_errors(readings, grid, np.where(known, filled, np.nan), read)
    node_nt2 = np.where(read, errors.variance_nt2 / np.maximum(count, 1), errors.mean_nt2)
    known = known if fill else read
    filled = np.where(np.isfinite(filled), filled, 0.0)
    parts = [
        Roughness.of(places[there], values[h][there], node_nt2[h][there], min(grid.cell_m), between)
        for h, there in enumerate(read)
    ]
    return GridInterpolation(
        method=method,
        parameters={
            "nodes": count.size,
            "nodes_read": int(read.sum()),
            "nodes_filled": int((known & ~read).sum()),
            "noise_nt": round(float(np.sqrt(errors.mean_nt2)), 3),
            f"place_error_m_{'estimated' if errors.estimated else 'assumed'}": round(errors.place_m, 5),
        },
        noise_nt2=errors.mean_nt2,
        grid=grid,
        values_nt=filled,
        known=known,
        node_nt2=node_nt2,
        roughness=Roughness.joined(parts),
        turned_nt2=_turned_nt2(grid, filled, read) * (CUBIC_TURN if method == "cubic" else 1.0),
        between_nt2=None
        if fill or method == "cubic"
        else interpolation_error_nt2(filled, read, grid.headings_rad, node_nt2),
    )


def _turned_nt2(grid: Grid, values: Array, read: Flags) -> float:
    """Mean squared error of interpolating a heading from the two beside it [nT^2]."""
    headings = np.asarray(grid.headings_rad)
    whole = read & np.roll(read, 1, axis=0) & np.roll(read, -1, axis=0)
    if len(headings) < 3 or not whole.any():
        return 0.0
    before, after = np.roll(values, 1, axis=0), np.roll(values, -1, axis=0)
    gap0 = np.mod(headings - np.roll(headings, 1), TURN)[:, None, None]
    gap1 = np.mod(np.roll(headings, -1) - headings, TURN)[:, None, None]
    chord = (before * gap1 + after * gap0) / (gap0 + gap1)
    return float(np.mean((chord - values)[whole] ** 2))


def _heading_weights(headings_rad: tuple[float, ...], yaw: Array) -> tuple[Array, Array]:
    """Weight of each layer, linear on the circle, shape (N, H); position between two, 0 to 1, shape (N,)."""
    count, rows = len(headings_rad), np.arange(len(yaw))
    if count == 1:
        return np.ones((len(yaw), 1)), np.zeros(len(yaw))
    knots = np.append(headings_rad, headings_rad[0] + TURN)
    angle = np.mod(yaw - knots[0], TURN) + knots[0]
    low = np.clip(np.searchsorted(knots, angle, side="right") - 1, 0, count - 1)
    part = (angle - knots[low]) / np.diff(knots)[low]
    part = np.where(np.abs(part - np.rint(part)) < EDGE, np.rint(part), part)
    weights = np.zeros((len(yaw), count))
    weights[rows, low] = 1 - part
    weights[rows, (low + 1) % count] += part
    return weights, part


def _periodic_cubic(headings_rad: tuple[float, ...], yaw: Array) -> Array:
    """Weight of each layer by the periodic cubic spline through them, shape (N, H)."""
    from scipy.interpolate import CubicSpline

    count = len(headings_rad)
    if count == 1:
        return np.ones((len(yaw), 1))
    knots = np.append(headings_rad, headings_rad[0] + TURN)
    layers = np.eye(count)
    spline = CubicSpline(knots, np.vstack([layers, layers[:1]]), bc_type="periodic")
    weights = np.asarray(spline(np.mod(yaw - knots[0], TURN) + knots[0]))
    return np.where(np.abs(weights) < EDGE, 0.0, weights)


def _bilinear(layer: Array, low: NDArray[np.intp], part: Array, *, squared: bool = False) -> Array:
    """Bilinear sums, exact at nodes; with squared weights for variances."""
    (i, j), (u, v) = low.T, part.T
    left, right, below, above = (w * w if squared else w for w in (1 - u, u, 1 - v, v))
    lower = layer[j, i] * left + layer[j, i + 1] * right
    upper = layer[j + 1, i] * left + layer[j + 1, i + 1] * right
    return np.asarray(lower * below + upper * above)


def _cubic_share(part: Array) -> Array:
    """Sum of squared weights of the cubic through four nodes in a row, over that of the line through two."""
    t = part
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    return np.asarray(sum(w * w for w in weights) / ((1 - t) ** 2 + t**2))


def _fit_scattered(readings: Readings, method: str) -> ScatterInterpolation:
    spacing = spacing_m(readings)
    cell = spacing / BINS_A_SPACING
    wave = _wave(readings, spacing)
    still = readings.b_nt - _waves(readings.yaw) @ wave
    bins, noise, place_nt2 = _binned(readings, still, cell)
    between = _triangles(method)
    return ScatterInterpolation(
        method=method,
        parameters={
            "readings": int(readings.good.sum()),
            "places": len(bins.p_xy),
            "bin_m": cell,
            "wave_nt": [float(np.hypot(*pair)) for pair in wave.reshape(2, 2)],
            "noise_nt": round(float(np.sqrt(noise)), 3),
        },
        noise_nt2=noise,
        p_xy=bins.p_xy,
        b_nt=bins.b_nt,
        place_nt2=place_nt2,
        wave_nt=wave,
        roughness=Roughness.of(bins.p_xy, bins.b_nt, place_nt2, spacing, between),
    )


def _binned(readings: Readings, still: Array, cell_m: float) -> tuple[Bins, float, Array]:
    """Bins of the position's part; variance of a reading, and of the mean of each bin [nT^2].

    Readings of one pass in a bin have variance w about their mean, and the passes' means vary by r more. If
    no two passes met, r is unknown, and a bin is no more certain than a reading.
    """
    bins, index = bin_readings(readings, cell_m)
    rows = np.flatnonzero(readings.good)
    mean = np.bincount(index, still[rows]) / bins.count
    apart, own = bin_readings(by_pass(readings), cell_m, by_run=True)
    means = np.bincount(own, still[rows]) / apart.count
    freedom = len(rows) - len(means)
    within = float(np.sum((still[rows] - means[own]) ** 2) / freedom) if freedom else 0.0
    place = np.zeros(len(means), np.intp)
    place[own] = index
    runs = np.bincount(place)
    freedom = len(means) - len(runs)
    if not freedom:
        return replace(bins, b_nt=mean), within, np.full(len(runs), within)
    middle, several = np.bincount(place, means) / runs, runs[place] > 1
    variance = float(np.sum((means - middle[place]) ** 2) / freedom)
    between = max(variance - within * float(np.mean(1 / apart.count[several])), 0.0)
    return replace(bins, b_nt=mean), within + between, between / runs + within / bins.count


def _wave(readings: Readings, cell_m: float) -> Array:
    """The heading's part, by least squares over differences within cells.

    Combinations of coefficients that the headings in a cell do not determine stay 0.
    """
    bins, index = bin_readings(readings, cell_m)
    rows = np.flatnonzero(readings.good)
    every = np.column_stack([_waves(readings.yaw[rows]), readings.b_nt[rows]])
    means = np.stack([np.bincount(index, c) / bins.count for c in every.T], axis=-1)
    away = every - means[index]
    left, size, right = np.linalg.svd(away[:, :4], full_matrices=False)
    determined = size > FLATTEST * np.sqrt(len(rows))
    return np.asarray(right[determined].T @ ((left[:, determined].T @ away[:, 4]) / size[determined]))


def _waves(yaw: Array) -> Array:
    return np.column_stack([np.cos(yaw), np.sin(yaw), np.cos(2 * yaw), np.sin(2 * yaw)])


def _triangles(method: str) -> Interpolation:
    from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator
    from scipy.spatial import QhullError

    kind = LinearNDInterpolator if method == "trilinear" else CloughTocher2DInterpolator

    def between(p_xy: Array, b_nt: Array, at: Array) -> Array:
        middle = p_xy.mean(axis=0)
        try:
            return np.asarray(kind(p_xy - middle, b_nt)(at - middle))
        except QhullError:
            return np.full(len(at), np.nan)

    return between


def _across(values: Array, known: Flags) -> Array:
    """Values linear between the nearest known nodes in row and column; nan if neither has two."""
    total, weight = np.zeros(values.shape), np.zeros(values.shape)
    for axis in (0, 1):
        lines, there = np.moveaxis(values, axis, -1), np.moveaxis(known, axis, -1)
        sums, weights = np.moveaxis(total, axis, -1), np.moveaxis(weight, axis, -1)
        for k, (line, on) in enumerate(zip(lines, there, strict=True)):
            at = np.flatnonzero(on)
            if len(at) < 2:
                continue
            between = np.flatnonzero(~on[: at[-1]])
            between = between[between > at[0]]
            after = np.searchsorted(at, between)
            a, b = between - at[after - 1], at[after] - between
            w = 1.0 / (a * b) ** 2
            sums[k, between] += w * (line[at[after - 1]] * b + line[at[after]] * a) / (a + b)
            weights[k, between] += w
    return np.divide(total, weight, out=np.full(values.shape, np.nan), where=weight > 0)
