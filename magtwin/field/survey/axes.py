"""A survey's own axes and order, in which maps are fitted.

A fit chooses cells, lattices, folds and draws. Chosen in world axes or by row, they would differ when the
survey is moved, turned or stored in another order, and the field with them. In its own axes and order, a
survey has the same numbers wherever it lies.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.grid import TURN, Grid
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

DIGITS = 10  # Decimals of a position in its own axes, in powers of ten below the survey's extent
STEPS = 2.0**36  # Headings in a turn, to which headings in own axes are rounded
# Sum of the edges' directions to the fourth power below which a survey has no sides, in its perimeter
ROUND = 0.05
MAIN = 0.5  # Mean of the headings' directions to the fourth power below which there are no four main ones
NEXT = 3.0  # Longest time between two runs that are one, in the usual time between readings


@dataclass(frozen=True)
class SurveyAxes:
    """Axes along a survey's sides, with their origin in its middle.

    Their first axis is the one of four nearest to the gradient of the readings over the floor.
    """

    origin_m: tuple[float, float] = (0.0, 0.0)  # World x and y of their origin [m]
    yaw_rad: float = 0.0  # Their turn from the world's axes [rad]

    @classmethod
    def of(cls, readings: Readings) -> "SurveyAxes":
        """The axes of a survey without exact duplicates (`distinct`)."""
        rows = readings.good if readings.good.any() else np.ones(len(readings), bool)
        p, b = readings.p_xy[rows] @ np.array([1, 1j]), readings.b_nt[rows]
        rise = np.angle(np.sum((b - b.mean()) * (p - p.mean())))
        if readings.grid is not None:
            x0, x1, y0, y1 = readings.grid.extent
            return cls(((x0 + x1) / 2, (y0 + y1) / 2), float(_quarter(0.0, rise) % TURN))
        corners = _corners(readings.p_xy[rows]) @ np.array([1, 1j])
        edges = np.roll(corners, -1) - corners
        length = np.maximum(np.abs(edges), np.finfo(float).tiny)
        square = np.sum(length * (edges / length) ** 4)
        sides = np.angle(square) / 4 if np.abs(square) > ROUND * length.sum() else rise
        yaw = _quarter(sides, rise)
        own = corners * np.exp(-1j * yaw)
        middle = complex(np.ptp(own.real) / 2 + own.real.min(), np.ptp(own.imag) / 2 + own.imag.min())
        origin = middle * np.exp(1j * yaw)
        return cls((float(origin.real), float(origin.imag)), float(yaw))

    @property
    def turn(self) -> Array:
        """Rotation from these axes to the world's, shape (2, 2)."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, -s], [s, c]])

    def own_poses(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Poses (..., 2), (...) in world, in these axes."""
        return (np.asarray(p_xy, float) - self.origin_m) @ self.turn, np.asarray(yaw, float) - self.yaw_rad

    def world_xy(self, p_xy: ArrayLike) -> Array:
        """Positions in these axes, in world, shape (..., 2)."""
        return np.asarray(np.asarray(p_xy, float) @ self.turn.T + self.origin_m)

    def own_vector(self, v_world: tuple[float, float, float]) -> tuple[float, float, float]:
        """A vector along the world's x, y and z, in these axes."""
        x, y = (np.array(v_world[:2]) @ self.turn).tolist()
        return x, y, v_world[2]

    def own_readings(self, readings: Readings) -> Readings:
        """The survey in these axes, in an order that depends on its readings alone.

        Positions and headings are rounded, so that a rotation's last digits move no reading across the edge
        of a cell. Runs whose times follow each other are one.
        """
        p, yaw = self.own_poses(readings.p_xy, readings.yaw)
        extent = float(np.ptp(p, axis=0).max()) or 1.0
        p = np.round(p, DIGITS - int(np.ceil(np.log10(extent))))
        yaw = np.mod(np.rint(yaw / TURN * STEPS), STEPS) / STEPS * TURN
        earth = None if readings.earth_nt is None else self.own_vector(readings.earth_nt)
        grid, node = readings.grid, readings.node
        if grid is not None and node is not None:
            grid, node = _turned(grid, node, self)
        return in_order(readings.with_(p_xy=p, yaw=yaw, earth_nt=earth, grid=grid, node=node))

    def main_heading_rad(self, own: Readings) -> float:
        """Heading in world from which even headings of a map count, in whole degrees [rad].

        If the survey's headings have four main directions, it is one of these, else that of the axes. `own`
        is the survey in these axes.
        """
        mean = np.mean(np.exp(4j * own.yaw[own.good]))
        main = np.angle(mean) / 4 if np.abs(mean) > MAIN else 0.0
        return float(np.radians(np.rint(np.degrees(main + self.yaw_rad)) % 360))


WORLD = SurveyAxes()


def in_own_axes(readings: Readings, axes: SurveyAxes | None = None) -> tuple[Readings, SurveyAxes]:
    """A survey in its own axes (or `axes`) and order, without copies of readings, and these axes."""
    kept = distinct(readings)
    axes = SurveyAxes.of(kept) if axes is None else axes
    return axes.own_readings(kept), axes


def distinct(readings: Readings) -> Readings:
    """The readings without those that equal another in every number and in time: copies, not measurements."""
    columns = [*_columns(readings), readings.run]
    order = np.lexsort(columns[::-1])
    again = np.logical_and.reduce([np.diff(column[order]) == 0 for column in columns[:-1]])
    return readings.take(np.sort(order[np.append(True, ~again)])) if again.any() else readings


def in_order(readings: Readings) -> Readings:
    """The readings by run, node, time and place. Runs are in the order of their first readings.

    A run that begins, by its times, where another ends is a part of it.
    """
    run = _continued(readings)
    order = np.lexsort(_columns(readings)[::-1])
    some, first = np.unique(run[order], return_index=True)
    ranked, rank = some[np.argsort(first)], np.zeros(len(readings.runs), np.intp)
    rank[ranked] = np.arange(len(ranked))
    order = order[np.argsort(rank[run[order]], kind="stable")]
    return readings.with_(run=rank[run], runs=tuple(readings.runs[k] for k in ranked)).take(order)


def _columns(readings: Readings) -> list[NDArray[np.generic]]:
    """What tells readings apart, beside their run."""
    columns: list[NDArray[np.generic]] = [] if readings.node is None else [*readings.node.T]
    columns += [] if readings.t is None else [readings.t]
    columns += [*readings.p_xy.T, readings.yaw, readings.b_nt]
    columns += [] if readings.b_body_nt is None else [*readings.b_body_nt.T]
    return [*columns, readings.good.astype(np.int8)]


def _continued(readings: Readings) -> Rows:
    """The run of each reading, the first of several that follow each other in time, shape (N,)."""
    if readings.t is None or readings.grid is not None:
        return readings.run
    times = {int(r): np.sort(readings.t[readings.run == r]) for r in np.unique(readings.run)}
    step = {r: float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for r, t in times.items()}
    order = sorted(times, key=lambda r: (times[r][0], times[r][-1]))
    of = np.arange(len(readings.runs))
    for before, after in pairwise(order):
        if 0 <= times[after][0] - times[before][-1] <= NEXT * max(step[before], step[after]):
            of[after] = of[before]
    return of[readings.run]


def _corners(p_xy: Array) -> Array:
    """Corners of the convex hull of points, in its order, shape (C, 2); the points if they lie on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(p_xy[ConvexHull(p_xy - p_xy.mean(axis=0)).vertices])
    except (QhullError, ValueError):
        return p_xy


def _quarter(sides: float, rise: float) -> float:
    """The direction along the sides that is nearest to `rise` [rad]."""
    return float(sides + TURN / 4 * np.rint((rise - sides) / (TURN / 4)))


def _turned(grid: Grid, node: Rows, axes: SurveyAxes) -> tuple[Grid, Rows]:
    """A grid and nodes in axes that are turned by quarters."""
    quarter = int(np.rint(axes.yaw_rad / (TURN / 4))) % 4
    headings = np.asarray(grid.headings_rad) - quarter * TURN / 4
    headings = np.where(headings < -1e-9, headings + TURN, np.maximum(headings, 0.0))
    order = np.argsort(headings)
    h, j, i = node.T
    h = np.argsort(order)[h]
    rows, columns, cell = grid.rows, grid.columns, grid.cell_m
    j, i = ((j, i), (columns - 1 - i, j), (rows - 1 - j, columns - 1 - i), (i, rows - 1 - j))[quarter]
    if quarter % 2:
        rows, columns, cell = columns, rows, cell[::-1]
    origin = (-(columns - 1) * cell[0] / 2, -(rows - 1) * cell[1] / 2)
    turned = Grid(
        origin_m=origin, cell_m=cell, headings_rad=tuple(headings[order].tolist()), rows=rows, columns=columns
    )
    return turned, np.column_stack([h, j, i])
