"""A path: a polyline on the floor, parametrised by arc length."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.report.summary import Summarized, Summary, rectangle

Array = NDArray[np.float64]

SAME_M = 1e-6  # Points nearer than this are equal, and a line whose ends are nearer is closed [m]


@dataclass(frozen=True, eq=False, repr=False)
class Path(Summarized):
    """A polyline in the plane of the floor, parametrised by its arc length.

    Equal neighbours are merged. A closed path repeats its first point at the end, which is added if needed.
    """

    name: str  # Name: one of `PATHS`, or that of a file
    p_xy: Array  # Points in world [m], shape (N, 2), N >= 2
    closed: bool = False  # Whether the path can be repeated from its end
    file: str = ""  # File that it was read from, or ""
    # Scale in x and y, then shift in x and y [m], which fitted the path to its floor; () means none
    placing: tuple[float, ...] = ()
    # Share of the free floor that it sweeps, of a path that was planned for or scaled to a room
    swept: float | None = None
    s: Array = field(init=False, repr=False)  # Arc length at each point, from 0 [m], shape (N,)

    def __post_init__(self) -> None:
        p = np.array(self.p_xy, float)
        if p.ndim != 2 or p.shape[1] != 2:
            raise InputError(f"path {self.name!r}: points must have shape (N, 2), got {p.shape}")
        if not np.isfinite(p).all():
            row = int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])
            raise InputError(f"path {self.name!r}: point {row} is not finite: {tuple(p[row].tolist())}")
        if self.closed and len(p) > 1 and math.dist(p[0], p[-1]) >= SAME_M:
            p = np.vstack([p, p[:1]])
        p = without_repeats(p)
        if len(p) < 2:
            raise InputError(f"path {self.name!r}: two different points are needed, got {len(p)}")
        if self.closed:
            p[-1] = p[0]
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
        for name, array in (("p_xy", p), ("s", s)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def length(self) -> float:
        """Arc length of the whole path [m]."""
        return float(self.s[-1])

    def at(self, s: ArrayLike) -> Array:
        """Points at arc lengths `s` [m], shape (...) -> (..., 2).

        A closed path repeats; an open one continues straight beyond its ends.
        """
        s, i = self._segment(s)
        along = ((s - self.s[i]) / (self.s[i + 1] - self.s[i]))[..., None]
        return self.p_xy[i] + along * (self.p_xy[i + 1] - self.p_xy[i])

    def heading(self, s: ArrayLike) -> Array:
        """Direction of travel at arc lengths `s` [rad], in [-pi, pi], shape (...).

        At a corner, it is the direction after it.
        """
        _, i = self._segment(s)
        step = self.p_xy[i + 1] - self.p_xy[i]
        return np.arctan2(step[..., 1], step[..., 0])

    def turn(self, s: ArrayLike, reach_m: float) -> Array:
        """Angle between the chords before and after `s`, left positive [rad], shape (...).

        Args:
            s: Arc lengths [m], shape (...).
            reach_m: Length of path that each chord spans [m].
        """
        s = np.asarray(s, float)
        here = self.at(s)
        x0, y0 = np.moveaxis(here - self.at(s - reach_m), -1, 0)
        x1, y1 = np.moveaxis(self.at(s + reach_m) - here, -1, 0)
        return np.arctan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)

    def curvature(self, s: ArrayLike, reach_m: float = 0.02) -> Array:
        """Mean curvature over `reach_m` before and after `s`, left positive [1/m], shape (...).

        The angle between two chords divided by the arc length between their middles; 1/R for a circle. Choose
        `reach_m` larger than the spacing of the points.
        """
        return self.turn(s, reach_m) / reach_m

    def nearest(self, p_xy: ArrayLike) -> tuple[Array, Array]:
        """The nearest point of the path to each of many points, exactly.

        Every segment is tried, which takes about 10 ns per point and segment.

        Args:
            p_xy: Points in world [m], shape (..., 2).

        Returns:
            Arc length of the nearest point [m], and signed distance from the path, left positive [m],
            each of shape (...).
        """
        q = np.asarray(p_xy, float)
        flat = q.reshape(-1, 2)
        step, ds = np.diff(self.p_xy, axis=0), np.diff(self.s)
        unit = step / ds[:, None]
        s, d = np.empty(len(flat)), np.empty(len(flat))
        block = max(1, 200_000 // len(ds))
        for first in range(0, len(flat), block):
            rows = slice(first, first + block)
            x = flat[rows, None, 0] - self.p_xy[:-1, 0]
            y = flat[rows, None, 1] - self.p_xy[:-1, 1]
            along = np.clip(x * unit[:, 0] + y * unit[:, 1], 0.0, ds)
            x -= along * unit[:, 0]
            y -= along * unit[:, 1]
            best = np.argmin(x * x + y * y, axis=1)
            pick = np.arange(len(best)), best
            s[rows] = self.s[best] + along[pick]
            left = unit[best, 0] * y[pick] - unit[best, 1] * x[pick]
            d[rows] = np.copysign(np.hypot(x[pick], y[pick]), left)
        return s.reshape(q.shape[:-1]), d.reshape(q.shape[:-1])

    def prolonged(self, length_m: float) -> "Path":
        """This path, repeated until it is at least `length_m` long; the result is open.

        A closed path gets further laps, an open one is driven back and forth.
        """
        times = max(1, math.ceil(length_m / self.length))
        there, back = self.p_xy[1:], (self.p_xy if self.closed else self.p_xy[::-1])[1:]
        parts = [self.p_xy[:1], *((there, back)[n % 2] for n in range(times))]
        return Path(self.name, np.vstack(parts))

    def placed(self, placing: tuple[float, float, float, float]) -> "Path":
        """This path scaled about the world's origin, then moved.

        Args:
            placing: Scale in x and in y, above 0, then shift in x and in y [m].
        """
        if len(placing) != 4 or not (min(placing[:2]) > 0 and all(map(math.isfinite, placing))):
            raise InputError(
                f"placing of path {self.name!r} must be two scales above 0 and two shifts, got {placing}"
            )
        points = self.p_xy * np.array(placing[:2]) + np.array(placing[2:])
        return Path(self.name, points, self.closed, self.file, tuple(map(float, placing)))

    def _segment(self, s: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        s = np.asarray(s, float)
        if self.closed:
            s = s % self.length
        return s, np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)

    def _summary(self) -> Summary:
        """Name, length, extent and ends."""
        (x0, y0), (x1, y1) = self.p_xy.min(axis=0), self.p_xy.max(axis=0)
        (ax, ay), (bx, by) = self.p_xy[0], self.p_xy[-1]
        ends = f"begins and ends at ({ax:z.2f}, {ay:z.2f}) m"
        if not self.closed:
            ends = f"({ax:z.2f}, {ay:z.2f}) to ({bx:z.2f}, {by:z.2f}) m"
        shape = f"{'closed' if self.closed else 'open'}, {len(self.p_xy):,} points"
        rows = ("over", rectangle(x0, x1, y0, y1)), ("ends", ends), ("file", self.file)
        return Summary(f"Path {self.name}: {self.length:.4g} m, {shape}", rows)


def without_repeats(p: Array) -> Array:
    """Points (N, 2) without equal neighbours."""
    first = np.ones(len(p), bool)
    first[1:] = np.hypot(*np.diff(p, axis=0).T) >= SAME_M
    return p[first]
