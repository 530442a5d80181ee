"""Lookup: interpolate a gridded field at poses, in plain Python, in numpy, or compiled.

A few poses are fastest in plain Python, some thousand in numpy, millions in compiled code on several threads.
All three do the same operations in the same order, so a pose gives the same bytes in any of them, alone or
among others.
"""

import numpy as np
from numpy.typing import NDArray

from magtwin.compiled import Loops, in_threads
from magtwin.field.maps import trilinear
from magtwin.field.maps.trilinear import EDGE, TURN, blend, sides, spread

Array = NDArray[np.float64]

FEW = 24  # Poses up to which plain Python is faster than numpy
BLOCK = 8192  # Poses that numpy works on at a time: their temporaries stay in the second-level cache
NONE = np.empty(0)  # No variance
AS_MANY = 25  # Poses in numpy that take as long as one in plain Python
SHARE = 65_536  # Poses that a thread of compiled code takes at a time
# Compiled loops of maps; work is counted in poses looked up in numpy
LOOPS = Loops("magtwin.field.maps.loops", pays=20_000_000)


def warm_up() -> None:
    """Compile lookups from now on, as pays before millions of poses. Takes half a second to a few seconds.

    Raises:
        ImportError: numba does not work here. Lookups then stay in numpy and give the same bytes.
    """
    LOOPS.open()


def _closed(plane: NDArray) -> NDArray:
    """Nodes (H, Y, X), flat, with the first heading repeated at the end."""
    return np.concatenate([plane.ravel(), plane[0].ravel()])


class Lookup:
    """A gridded field laid out for lookup, in the order heading, row, column of `AnomalyMap`.

    B = sum over the 8 nodes of w_h w_y w_x B_hyx, and its derivatives within the cell. A cell includes its
    lower borders but not its upper ones, except for the last of a row or a column. A derivative is nan if a
    masked node would enter it.
    """

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
        self.gaps: Array = np.diff(np.append(headings_rad, first + TURN))
        even = np.abs(self.gaps - TURN / layers).max() < 1e-12
        per_rad = 0.0 if layers == 1 else layers / TURN if even else -1.0
        self.figures = (*origin_m, *cell_m, first, per_rad, layers, rows, columns)
        grids = [np.where(valid, values_nt, 0.0)]
        if not valid.all():
            grids.append((~valid).astype(float))
        header = [*origin_m, *cell_m, first, EDGE, layers, rows, columns, per_rad]
        self.table: Array = np.concatenate([header, self.knots, self.gaps, *map(_closed, grids)])
        """The map in one array, see `trilinear`."""

        begin, end, *_ = trilinear.planes(self.table)
        self._values = self.table[begin:end]
        self._holes = self.table[end:] if len(grids) > 1 else None  # 1 at masked nodes, 0 at others
        self._plain = memoryview(self.table.data)  # its entries are plain floats, which Python adds up faster

    def spreads(self, *layers: Array) -> Array:
        """Variances (H, Y, X) laid out for `lookup`: the nodes' own, and any errors of interpolation."""
        return np.concatenate([_closed(layer) for layer in layers])

    def lookup(
        self, p: Array, yaw: Array, *, clamp: bool, gradient: bool, spreads: Array = NONE
    ) -> tuple[Array, Array, Array]:
        """Field at poses (N, 2) and (N,) [nT], (N,), its gradient, (N, 3), and its standard deviation, (N,).

        The gradient is (0, 3) if not wanted, and the standard deviation (0,) without `spreads`. With `clamp`,
        a point off the grid takes the field of the nearest point on it, otherwise nan. The gradient is dB/dx,
        dB/dy [nT/m] and dB/dyaw [nT/rad].
        """
        out, sds = np.empty(len(p)), np.empty(len(p) if len(spreads) else 0)
        slopes = np.empty((len(p) if gradient else 0, 3))
        if len(p) <= FEW:
            for n, ((x, y), angle) in enumerate(zip(p.tolist(), yaw.tolist(), strict=True)):
                if len(sds):
                    sds[n] = trilinear.sd_at(self._plain, spreads, x, y, angle, clamp)
                if gradient:
                    out[n], *slopes[n] = self.at_with_gradient(x, y, angle, clamp=clamp)
                else:
                    out[n] = self.at(x, y, angle, clamp=clamp)
        elif (code := LOOPS.after(len(p))) is not None:
            q, yaw = (np.require(array, float, ["C", "A"]) for array in (p.reshape(-1), yaw))
            flat = slopes.reshape(-1)

            def work(rows: slice) -> None:
                at, g = q[2 * rows.start : 2 * rows.stop], flat[3 * rows.start : 3 * rows.stop]
                some = sds[rows] if len(sds) else sds
                code.lookup(self.table, spreads, at, yaw[rows], clamp, out[rows], some, g)

            in_threads(work, len(yaw), SHARE)
        else:
            planes = list(spreads.reshape(-1, self._values.size)) if len(spreads) else []
            for start in range(0, len(p), BLOCK):
                part = slice(start, start + BLOCK)
                self._by_numpy(p[part], yaw[part], clamp, planes, out[part], slopes[part], sds[part])
        sds[np.isnan(out[: len(sds)])] = np.nan
        return out, slopes, sds

    def at(self, x: float, y: float, yaw: float, *, clamp: bool = False) -> float:
        """Field at one pose [nT], as `lookup` gives it."""
        code = LOOPS.code or LOOPS.after(AS_MANY)
        if code is None:
            return trilinear.at(self._plain, x, y, yaw, clamp)
        return code.at(self.table, x, y, yaw, clamp)  # type: ignore[no-any-return]

    def at_with_gradient(
        self, x: float, y: float, yaw: float, *, clamp: bool = False
    ) -> tuple[float, float, float, float]:
        """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad], as `lookup` gives them."""
        code = LOOPS.code or LOOPS.after(AS_MANY)
        if code is None:
            return trilinear.at_with_gradient(self._plain, x, y, yaw, clamp)
        return code.at_with_gradient(self.table, x, y, yaw, clamp)  # type: ignore[no-any-return]

    def _cells(
        self, p: Array, clamp: bool
    ) -> tuple[tuple[NDArray[np.intp], ...], tuple[Array, ...], tuple[NDArray[np.bool_], ...], NDArray]:
        """Cells of points (N, 2) on the floor.

        Their columns and rows; the weights of the higher nodes along x and y; whether the points are inside
        along x and y; whether the field is unknown there.
        """
        x0, y0, dx, dy, _, _, _, rows, columns = self.figures
        unknown = np.zeros(len(p), bool)
        cells, weights, inside = [], [], []
        for axis, (origin, spacing, last) in enumerate(((x0, dx, columns - 1), (y0, dy, rows - 1))):
            u = (p[:, axis] - origin) / spacing
            inside.append((u >= -EDGE) & (u <= last + EDGE))
            unknown |= np.isnan(u) if clamp else ~inside[axis]
            u = np.clip(np.where(np.isnan(u), 0.0, u), 0, last)
            cells.append(np.minimum(u.astype(np.intp), last - 1))
            weights.append(u - cells[axis])
        return tuple(cells), tuple(weights), tuple(inside), unknown

    def _by_numpy(
        self, p: Array, yaw: Array, clamp: bool, planes: list[Array], out: Array, slopes: Array, sds: Array
    ) -> None:
        """Look up poses in numpy; `slopes` and `sds` are empty if they are not wanted.

        `planes` are the variances [nT^2]: of the nodes, and any errors of interpolation.
        """
        _, _, dx, dy, first, per_rad, layers, rows, columns = self.figures
        (i, j), (wx, wy), inside, unknown = self._cells(p, clamp)
        unknown |= ~np.isfinite(yaw)
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
        ways = [up + way for up in (0, rows * columns) for way in (0, 1, columns, columns + 1)]

        def corners(plane: Array) -> list[Array]:
            return [plane.take(node + way) for way in ways]

        values = corners(self._values)
        out[:] = blend(values, wx, wy, wh)
        holes = None
        if self._holes is not None:
            holes = corners(self._holes)
            unknown |= blend(holes, wx, wy, wh) > EDGE
        out[unknown] = np.nan
        if len(sds):
            parts = [blend(corners(plane), wx, wy, wh) for plane in planes]
            whole = parts[0] if len(parts) == 1 else spread(parts[0], parts[1], parts[2], wx, wy, wh)
            sds[:] = np.sqrt(whole)
        if not len(slopes):
            return
        rates = (np.where(inside[0], 1 / dx, 0.0), np.where(inside[1], 1 / dy, 0.0), rate)
        for axis, side in enumerate(sides(values, wx, wy, wh, -1.0)):
            slopes[:, axis] = side * rates[axis]
        if holes is not None:
            for axis, hole in enumerate(sides(holes, wx, wy, wh, 1.0)):
                slopes[(rates[axis] != 0) & (hole > EDGE), axis] = np.nan
        slopes[unknown] = np.nan
