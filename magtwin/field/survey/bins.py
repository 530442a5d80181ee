"""Bins: average readings that lie together, and measure how dense a survey is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.survey.readings import Readings
from magtwin.frames import wrap_angle

Array = NDArray[np.float64]

PROBES = 40_000  # Points at which the distance to the nearest reading is measured
# Median distance to the nearest node of a square grid of spacing 1: circles of this radius cover half
MEDIAN_OF_GRID = (2 * np.pi) ** -0.5
GRAIN_M = 1e-4  # Readings closer than this are at one place


@dataclass(frozen=True, eq=False)
class Bins:
    """Means of readings that share a cell of the floor, a sector of heading and, optionally, a run."""

    p_xy: Array  # Mean positions [m], shape (M, 2)
    yaw: Array  # Mean headings, on the circle [rad], shape (M,)
    b_nt: Array  # Mean magnitudes [nT], shape (M,)
    count: NDArray[np.intp]  # Readings per bin, shape (M,)
    run: NDArray[np.intp]  # Run of each bin, shape (M,); 0 if runs are averaged


def bin_readings(
    readings: Readings, cell_m: float, *, sectors: int = 1, by_run: bool = False
) -> tuple[Bins, NDArray[np.intp]]:
    """Average the good readings that lie together.

    Cells of the floor have sides `cell_m`; 1 sector averages all headings. Returns the bins, ordered by run,
    sector, row and column; and the bin of each good reading, shape (good,).
    """
    rows = np.flatnonzero(readings.good)
    p, yaw, b = readings.p_xy[rows], readings.yaw[rows], readings.b_nt[rows]
    column, row = np.floor(p / cell_m).astype(np.int64).T
    sector = np.floor(yaw / (2 * np.pi) * sectors).astype(np.int64) % sectors
    run = readings.run[rows] if by_run else np.zeros(len(rows), np.intp)
    keys, index, count = np.unique(
        np.column_stack([run, sector, row, column]), axis=0, return_inverse=True, return_counts=True
    )
    index = index.ravel()
    mean = lambda values: np.bincount(index, values) / count  # noqa: E731
    turned = np.arctan2(mean(np.sin(yaw)), mean(np.cos(yaw)))
    return Bins(np.column_stack([mean(p[:, 0]), mean(p[:, 1])]), turned, mean(b), count, keys[:, 0]), index


def spacing_m(readings: Readings) -> float:
    """Spacing of the square grid that is as dense as a survey [m].

    For a gridded survey the shorter side of its cells. For a scattered one, the spacing at which the median
    distance from a point to the nearest node equals the measured median distance to the nearest good reading.
    Points are taken in the bounding box, at most a tenth of its longer side from a reading.
    """
    if readings.grid is not None:
        return min(readings.grid.cell_m)
    from scipy.spatial import cKDTree

    p = readings.p_xy[readings.good]
    low, high = p.min(axis=0), p.max(axis=0)
    longer = float((high - low).max())
    if not longer > GRAIN_M:
        raise InputError(f"all {len(p)} readings are at one place, ({low[0]:g}, {low[1]:g}) m; move about")
    step = max(float(np.sqrt(np.prod(high - low) / PROBES)), longer / PROBES)
    axes = [
        np.arange(a + step / 2, b, step) if b - a > step else np.array([(a + b) / 2])
        for a, b in zip(low, high, strict=True)
    ]
    probes = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    far = distance_m(cKDTree(p), probes)
    near = far[far <= longer / 10]
    return max(float(np.median(near if len(near) else far)) / MEDIAN_OF_GRID, GRAIN_M)


def distance_m(tree: object, p_xy: ArrayLike) -> Array:
    """Distance from points to the nearest point of a cKDTree [m], shape (...)."""
    return np.asarray(tree.query(np.asarray(p_xy, float))[0])  # type: ignore[attr-defined]


CELL = 1 / 6  # Distance along which readings of a drive are averaged, in depths of the first layer
TURN_M = 0.1  # Distance that a turn of 1 rad counts as [m]
MOST_MEANS = 900  # Most means along a drive; the distance grows until there are so few
# Longest averaging distance, in depths of the first layer; beyond, all passes of one place are averaged
LONGEST = 0.75
BIN = 2 / 3  # Side of the squares in which passes are averaged, in depths of the first layer
SECTORS = 4  # Heading sectors kept apart in a square
MOST_BINS = 1800  # Most means of squares and sectors; the squares grow until there are so few
WIDEN = 1.1  # Factor by which averaging distances grow


def means(good: Readings, depth_m: float) -> tuple[NDArray[np.intp], bool]:
    """Index of each reading's mean, (N,), and whether consecutive means are consecutive parts of a drive.

    A reading of a gridded survey stands alone. Readings of a drive are averaged along the way. A long drive
    passes each place often; its readings are averaged by place and heading instead, since longer means along
    the way would blur the field. So are readings without times, whose way is unknown. Distances count in
    `depth_m`, that of the first layer of dipoles.
    """
    if good.node is not None:
        return np.arange(len(good)), False
    side, most = CELL * depth_m, MOST_MEANS
    if good.t is not None:
        along = _along(good, good.t, side, LONGEST * depth_m)
        if along is not None:
            return along, True
        side, most = BIN * depth_m, MOST_BINS
    while True:
        bins, cell = bin_readings(good, side, sectors=SECTORS)
        if len(bins.count) <= most:
            return cell, False
        side *= WIDEN


def _along(good: Readings, t: Array, way_m: float, longest_m: float) -> NDArray[np.intp] | None:
    """Means along the way; None if they would be longer than `longest_m`."""
    order = np.lexsort((t, good.run))
    step = np.linalg.norm(np.diff(good.p_xy[order], axis=0), axis=1)
    step += TURN_M * np.abs(wrap_angle(np.diff(good.yaw[order])))
    other = np.diff(good.run[order]) != 0
    way = np.concatenate([[0.0], np.cumsum(step)])
    while way_m <= longest_m:
        stretch = np.floor(way / way_m).astype(np.int64)
        new = (np.diff(stretch) != 0) | other
        if np.count_nonzero(new) < MOST_MEANS:
            cell = np.empty(len(good), np.intp)
            cell[order] = np.concatenate([[0], np.cumsum(new)])
            return cell
        way_m *= WIDEN
    return None
