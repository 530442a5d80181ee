"""Lookup: trilinear reading of a gridded field, with gradient, as fast as the number of poses allows.

One pose is a microsecond of plain Python, some thousand are numpy's, many are compiled code's on several
threads. The three do the same operations in the same order, so a pose gives the same bytes whichever
works on it, alone or among others. Opening the compiled code costs as much as twenty million poses in
numpy, so that is done after as many of them, or by `warm_up`.
"""

import contextlib
import math
import os
from bisect import bisect_right
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TURN = 2 * math.pi

EDGE = 1e-9
"""Rounding that a lookup forgives, in cells at the border and as weight of a masked node."""

FEW = 24
"""Poses up to which plain Python, one after the other, is faster than numpy."""

BLOCK = 8192
"""Poses that numpy works on at a time: their temporaries stay in the second-level cache."""

PAYS = 20_000_000
"""Poses in numpy that take as long as opening the compiled code; whoever had as many will have more."""

AS_MANY = 25
"""Poses in numpy that take as long as one in plain Python does beyond one in compiled code."""

SHARE = 65_536
"""Poses that a thread of compiled code takes at a time; fewer are not worth its start."""

MOST_THREADS = 8
"""Beyond, memory is what one waits for."""

MOST_INDEXED = 2**31
"""Nodes that compiled code can number."""

Corners = Sequence[Any]
"""Nodes of a cell, numbers or arrays of them; x changes first, then y, then heading."""


def warm_up() -> None:
    """Have every lookup compiled from now on, as pays before a loop that will ask for millions of poses.

    Takes half a second where the machine code has been kept from an earlier time, else a few.

    Raises:
        ImportError: numba does not work here. Lookups stay in numpy then, and give the same bytes.
    """
    from magtwin.field import compiled

    Lookup.compiled = compiled


class Lookup:
    """A gridded field laid out for lookup, in the order heading, row, column, as `AnomalyMap` has it.

    B = sum over the 8 nodes of w_h w_y w_x B_hyx, and its derivatives within the cell. A cell has its
    lower borders but not its upper ones, other than the last of a row or a column. A derivative is nan
    where a masked node would have a part in it.
    """

    compiled: ClassVar[ModuleType | None] = None
    """The compiled code, once opened."""

    def __init__(
        self,
        values_nt: Array,
        valid: NDArray[np.bool_],
        origin_m: tuple[float, float],
        cell_m: tuple[float, float],
        headings_rad: Array,
    ) -> None:
        layers, rows, columns = values_nt.shape
        first = float(headings_rad[0])
        self.knots: Array = headings_rad - first
        """Angles of the layers above the first [rad], shape (H,)."""

        self.gaps: Array = np.diff(np.append(headings_rad, first + TURN))
        """Angles from each layer to the next [rad], the last one's to the first, shape (H,)."""

        even = np.abs(self.gaps - TURN / layers).max() < 1e-12
        per_rad = 0.0 if layers == 1 else layers / TURN if even else -1.0
        grids = [np.where(valid, values_nt, 0.0)]
        if not valid.all():
            grids.append((~valid).astype(float))
        header = [*origin_m, *cell_m, first, EDGE, layers, rows, columns, per_rad]
        closed = [part.ravel() for grid in grids for part in (grid, grid[:1])]
        self.table: Array = np.concatenate([header, self.knots, self.gaps, *closed])
        """The map in one array, as `compiled.lookup` describes it."""

        start, nodes = len(header) + 2 * layers, (layers + 1) * rows * columns
        self.values: Array = self.table[start : start + nodes]
        """Values [nT], 0 where masked, the first layer once more at the end."""

        self.holes: Array | None = self.table[start + nodes :] if len(grids) > 1 else None
        """In the same order, 1 at masked nodes and 0 elsewhere; none where no node is masked."""

        self.figures = (*origin_m, *cell_m, first, per_rad, layers, rows, columns)
        """The head of the table but for the rounding; `per_rad` is below 0 for layers unevenly apart."""

        self._cells = _Cells(self.values, self.holes, columns, rows * columns)
        self._poses = 0

    def lookup(self, p: Array, yaw: Array, *, clamp: bool, gradient: bool) -> tuple[Array, Array]:
        """Field at poses, and its gradient.

        Args:
            p: Points in world [m], shape (N, 2).
            yaw: Headings [rad], shape (N,).
            clamp: Whether points off the grid count as the nearest on it; else they give nan.
            gradient: Whether the gradient is wanted.

        Returns:
            Field [nT], shape (N,), and dB/dx, dB/dy [nT/m], dB/dyaw [nT/rad], shape (N, 3), or (0, 3)
            where that is not wanted.
        """
        out = np.empty(len(p))
        slopes = np.empty((len(p) if gradient else 0, 3))
        if len(p) <= FEW:
            for n, ((x, y), angle) in enumerate(zip(p.tolist(), yaw.tolist(), strict=True)):
                if gradient:
                    out[n], *slopes[n] = self.at_with_gradient(x, y, angle, clamp=clamp)
                else:
                    out[n] = self.at(x, y, angle, clamp=clamp)
        elif (compiled := self._opened(len(p))) is not None:
            self._in_threads(compiled, p, yaw, clamp, out, slopes)
        else:
            for start in range(0, len(p), BLOCK):
                part = slice(start, start + BLOCK)
                self._by_numpy(p[part], yaw[part], clamp, out[part], slopes[part])
        return out, slopes

    def at(self, x: float, y: float, yaw: float, *, clamp: bool = False) -> float:
        """Field at one pose [nT], as `lookup` gives it."""
        compiled = self.compiled or self._opened(AS_MANY)
        if compiled is not None and not clamp:
            return compiled.at(self.table, x, y, yaw)  # type: ignore[no-any-return]
        place = self._place(x, y, yaw, clamp)
        if place is None:
            return math.nan
        node, wx, wy, wh = place
        values, holes = self._cells[node]
        if holes is not None and blend(holes, wx, wy, wh) > EDGE:
            return math.nan
        return float(blend(values, wx, wy, wh))

    def at_with_gradient(
        self, x: float, y: float, yaw: float, *, clamp: bool = False
    ) -> tuple[float, float, float, float]:
        """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad], as `lookup` gives them."""
        compiled = self.compiled or self._opened(AS_MANY)
        if compiled is not None and not clamp:
            return compiled.at_with_gradient(self.table, x, y, yaw)  # type: ignore[no-any-return]
        place = self._place(x, y, yaw, clamp)
        if place is None:
            return math.nan, math.nan, math.nan, math.nan
        node, wx, wy, wh = place
        values, holes = self._cells[node]
        if holes is not None and blend(holes, wx, wy, wh) > EDGE:
            return math.nan, math.nan, math.nan, math.nan
        x0, y0, dx, dy, _, per_rad, _, rows, columns = self.figures
        rates = (
            1 / dx if -EDGE <= (x - x0) / dx <= columns - 1 + EDGE else 0.0,
            1 / dy if -EDGE <= (y - y0) / dy <= rows - 1 + EDGE else 0.0,
            per_rad if per_rad >= 0 else 1 / float(self.gaps[node // (rows * columns)]),
        )
        sides = sides_of(values, wx, wy, wh, -1.0)
        slopes = [side * rate for side, rate in zip(sides, rates, strict=True)]
        if holes is not None:
            for axis, hole in enumerate(sides_of(holes, wx, wy, wh, 1.0)):
                if rates[axis] and hole > EDGE:
                    slopes[axis] = math.nan
        return blend(values, wx, wy, wh), slopes[0], slopes[1], slopes[2]

    def _place(self, x: float, y: float, yaw: float, clamp: bool) -> tuple[int, float, float, float] | None:
        """Lowest node of a pose and the weights of the higher ones; none where no field is known."""
        x0, y0, dx, dy, first, per_rad, layers, rows, columns = self.figures
        u, v, a = (x - x0) / dx, (y - y0) / dy, yaw - first
        right, top = columns - 1.0, rows - 1.0
        if not (-EDGE <= u <= right + EDGE and -EDGE <= v <= top + EDGE) and not (
            clamp and u == u and v == v
        ):
            return None
        if a - a != 0:  # infinite, or nan
            return None
        u = 0.0 if u < 0 else right if u > right else u
        v = 0.0 if v < 0 else top if v > top else v
        i, j = int(u), int(v)
        if i == right:
            i -= 1
        if j == top:
            j -= 1
        a -= TURN * math.floor(a / TURN)
        a = 0.0 if a < 0 else TURN if a > TURN else a
        if per_rad < 0:
            h = bisect_right(self.knots, a) - 1  # type: ignore[type-var]
            w = (a - float(self.knots[h])) / float(self.gaps[h])
        else:
            w = a * per_rad
            h = int(w)
            if h == layers:
                h -= 1
            w -= h
        return (h * rows + j) * columns + i, u - i, v - j, w

    def _opened(self, poses: int) -> ModuleType | None:
        """The compiled code where it is open, or where it pays to open it for so many more poses."""
        if len(self.values) >= MOST_INDEXED:
            return None
        if self.compiled is None:
            before = self._poses
            self._poses += poses
            if before < PAYS <= self._poses:
                with contextlib.suppress(ImportError):
                    warm_up()
        return self.compiled

    def _in_threads(
        self, compiled: ModuleType, p: Array, yaw: Array, clamp: bool, out: Array, slopes: Array
    ) -> None:
        """Compiled code on shares of the poses; who works on a pose changes no byte."""
        q, yaw = _plain(p.reshape(-1)), _plain(yaw)
        flat = slopes.reshape(-1)
        shares = len(yaw) // SHARE
        threads = 1 if shares < 2 else min(shares, MOST_THREADS, os.cpu_count() or 1)
        if threads < 2:
            compiled.lookup(self.table, q, yaw, clamp, out, flat)
            return
        starts = iter(range(0, len(yaw), SHARE))  # whoever is free takes the next share

        def work() -> None:
            for start in starts:
                stop = start + SHARE
                at, some, g = q[2 * start : 2 * stop], yaw[start:stop], flat[3 * start : 3 * stop]
                compiled.lookup(self.table, at, some, clamp, out[start:stop], g)

        with ThreadPoolExecutor(threads - 1) as pool:
            others = [pool.submit(work) for _ in range(threads - 1)]
            work()
            for other in others:
                other.result()

    def _by_numpy(self, p: Array, yaw: Array, clamp: bool, out: Array, slopes: Array) -> None:
        """Numpy on a block of poses; `slopes` is empty where the gradient is not wanted."""
        x0, y0, dx, dy, first, per_rad, layers, rows, columns = self.figures
        unknown = ~np.isfinite(yaw)
        place, inside = [], []
        for axis, (origin, spacing, last) in enumerate(((x0, dx, columns - 1), (y0, dy, rows - 1))):
            u = (p[:, axis] - origin) / spacing
            inside.append((u >= -EDGE) & (u <= last + EDGE))
            unknown |= np.isnan(u) if clamp else ~inside[axis]
            u = np.clip(np.where(np.isnan(u), 0.0, u), 0, last)
            cell = np.minimum(u.astype(np.intp), last - 1)
            place.append((cell, u - cell))
        (i, wx), (j, wy) = place
        a = np.where(unknown, 0.0, yaw) - first
        a -= TURN * np.floor(a / TURN)
        a = np.clip(a, 0, TURN)
        if per_rad < 0:
            h = np.searchsorted(self.knots[1:], a, side="right")
            wh, rate = (a - self.knots[h]) / self.gaps[h], 1 / self.gaps[h]
        else:
            u = a * per_rad
            h = np.minimum(u.astype(np.intp), layers - 1)
            wh, rate = u - h, np.full(len(a), per_rad)
        node = (h * rows + j) * columns + i
        layer = rows * columns
        ways = [up + along for up in (0, layer) for along in (0, 1, columns, columns + 1)]
        values = [self.values.take(node + way) for way in ways]
        out[:] = blend(values, wx, wy, wh)
        holes = None
        if self.holes is not None:
            holes = [self.holes.take(node + way) for way in ways]
            unknown |= blend(holes, wx, wy, wh) > EDGE
        out[unknown] = np.nan
        if not len(slopes):
            return
        rates = (np.where(inside[0], 1 / dx, 0.0), np.where(inside[1], 1 / dy, 0.0), rate)
        for axis, side in enumerate(sides_of(values, wx, wy, wh, -1.0)):
            slopes[:, axis] = side * rates[axis]
        if holes is not None:
            for axis, hole in enumerate(sides_of(holes, wx, wy, wh, 1.0)):
                slopes[(rates[axis] != 0) & (hole > EDGE), axis] = np.nan
        slopes[unknown] = np.nan


def _plain(array: Array) -> Array:
    """The array, or a copy that lies as compiled code wants it."""
    flags = array.flags
    return array if flags.c_contiguous and flags.aligned else np.require(array, float, ["C", "A"])


class _Cells(dict[int, tuple[Corners, Corners | None]]):
    """Cells that were looked at, by lowest node: values of their nodes, and which are masked if any is."""

    def __init__(self, values: Array, holes: Array | None, columns: int, layer: int) -> None:
        self._values, self._holes = values, holes
        self._ways = [up + along for up in (0, layer) for along in (0, 1, columns, columns + 1)]

    def __missing__(self, node: int) -> tuple[Corners, Corners | None]:
        at = [node + way for way in self._ways]
        holes = None
        if self._holes is not None and self._holes[at].any():
            holes = tuple(self._holes[at].tolist())
        self[node] = cell = (tuple(self._values[at].tolist()), holes)
        return cell


def blend(corners: Corners, x: Any, y: Any, h: Any) -> Any:
    """Sum of the nodes weighed by nearness; x, y and h weigh the higher ones. Exact at 0 and at 1."""
    b000, b001, b010, b011, b100, b101, b110, b111 = corners
    lx, ly = 1 - x, 1 - y
    low = (b000 * lx + b001 * x) * ly + (b010 * lx + b011 * x) * y
    high = (b100 * lx + b101 * x) * ly + (b110 * lx + b111 * x) * y
    return low * (1 - h) + high * h


def sides_of(corners: Corners, x: Any, y: Any, h: Any, sign: float) -> tuple[Any, Any, Any]:
    """High side of the cell plus `sign` times the low one, along x, y and heading."""
    b000, b001, b010, b011, b100, b101, b110, b111 = corners
    lx, ly, lh = 1 - x, 1 - y, 1 - h
    b00, b01 = b000 * lx + b001 * x, b010 * lx + b011 * x
    b10, b11 = b100 * lx + b101 * x, b110 * lx + b111 * x
    x0 = (b001 + sign * b000) * ly + (b011 + sign * b010) * y
    x1 = (b101 + sign * b100) * ly + (b111 + sign * b110) * y
    return (
        x0 * lh + x1 * h,
        (b01 + sign * b00) * lh + (b11 + sign * b10) * h,
        (b10 * ly + b11 * y) + sign * (b00 * ly + b01 * y),
    )
