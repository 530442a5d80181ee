"""Compiled loops of maps: lookups of many poses, and the polynomials of a plane.

They do the operations of `lookup.py`, `trilinear.py` and `plane.py` in the same order, so that all give the
same bytes. `lookup.LOOPS` opens this module when that pays.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps import trilinear
from magtwin.field.maps.trilinear import HEADER, TURN, blend, corners, planes, sides, spread

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

BLOCK = 512  # Poses worked on at a time: their weights stay in the first-level cache

_IN = types.Array(types.float64, 1, "C", readonly=True)
_OUT = types.Array(types.float64, 1, "C")
_CUBE, _CUBE_OUT = types.Array(types.float64, 3, "C", readonly=True), types.Array(types.float64, 3, "C")
_ONE = np.uint64(1)  # unsigned: numba would otherwise support negative indices, and not vectorise

for _part in (blend, corners, planes, sides, spread, trilinear.find):
    inlined(_part)

_POSE = (_IN, types.float64, types.float64, types.float64, types.boolean)
at = compiled(*_POSE)(trilinear.at)
at_with_gradient = compiled(*_POSE)(trilinear.at_with_gradient)


@inlined
def place(
    table: Array, q: Array, yaw: Array, clamp: bool, wx: Array, wy: Array, wh: Array, node: Numbers
) -> None:
    """Lowest node of each pose in the first layer, weights of the higher ones, angles above that layer.

    The x weight is nan where the field is not known; `wh` takes the angles, in [0, 2 pi].
    """
    x0, y0, dx, dy, first, edge = table[0], table[1], table[2], table[3], table[4], table[5]
    columns, right, top = table[8], table[8] - 1, table[7] - 1
    for n in range(yaw.shape[0]):
        u = (q[2 * n] - x0) / dx
        v = (q[2 * n + 1] - y0) / dy
        a = yaw[n] - first
        inside = (u >= -edge) & (u <= right + edge) & (v >= -edge) & (v <= top + edge)
        known = ((u == u) & (v == v) if clamp else inside) & (a - a == 0)
        u = min(max(u if known else 0.0, 0.0), right)
        v = min(max(v if known else 0.0, 0.0), top)
        a = a if known else 0.0
        a -= TURN * np.floor(a / TURN)
        i, j = min(np.floor(u), right - 1), min(np.floor(v), top - 1)
        wx[n] = u - i if known else np.nan
        wy[n] = v - j
        wh[n] = min(max(a, 0.0), TURN)
        node[n] = np.int64(j * columns + i)


@inlined
def climb(table: Array, layer: int, wh: Array, slope: Array, node: Numbers) -> None:
    """Go up from the first layer to the one below each angle; `slope` takes the slope of its weight."""
    layers, per_rad = int(table[6]), table[9]
    if per_rad >= 0:
        for n in range(wh.shape[0]):
            u = wh[n] * per_rad
            low = min(np.floor(u), table[6] - 1)
            wh[n] = u - low
            node[n] += np.int64(low * layer)
        return
    knots, gaps = table[HEADER : HEADER + layers], table[HEADER + layers : HEADER + 2 * layers]
    for n in range(wh.shape[0]):
        low, high = 0, layers
        while high - low > 1:
            middle = (low + high) // 2
            if wh[n] >= knots[middle]:
                low = middle
            else:
                high = middle
        wh[n] = (wh[n] - knots[low]) / gaps[low]
        slope[n] = 1 / gaps[low]
        node[n] += low * layer


@inlined
def blends(
    t: Array, row: np.uint64, layer: np.uint64, node: Numbers, wx: Array, wy: Array, wh: Array, out: Array
) -> None:
    """`trilinear.blend` at the cells that `place` and `climb` found."""
    for n in range(out.shape[0]):
        out[n] = blend(corners(t, np.uint64(node[n]), _ONE, row, layer), wx[n], wy[n], wh[n])


@inlined
def _sides(
    t: Array,
    row: np.uint64,
    layer: np.uint64,
    node: Numbers,
    wx: Array,
    wy: Array,
    wh: Array,
    sign: float,
    out: Array,
) -> None:
    for n in range(wx.shape[0]):
        along = sides(corners(t, np.uint64(node[n]), _ONE, row, layer), wx[n], wy[n], wh[n], sign)
        out[3 * n], out[3 * n + 1], out[3 * n + 2] = along


@compiled(_IN, _IN, _IN, _IN, types.boolean, _OUT, _OUT, _OUT)
def lookup(
    table: Array, spreads: Array, q: Array, yaw: Array, clamp: bool, out: Array, sd: Array, gradient: Array
) -> None:
    """`Lookup.lookup` at points x, y, x, y, ... in `q`, shape (2 N,).

    `out` takes the field [nT], shape (N,), `sd` its standard deviation, shape (N,) or (0,), and `gradient`
    its derivatives pose by pose, shape (3 N,) or (0,).
    """
    x0, y0, dx, dy, edge = table[0], table[1], table[2], table[3], table[5]
    begin, end, in_row, in_layer = planes(table)
    values, masked = table[begin:end], table[end:]
    row, up = np.uint64(in_row), np.uint64(in_layer)
    wxs, wys, whs, nodes_at = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.int64)
    cells, turns = np.empty(BLOCK), np.empty(BLOCK)
    slopes, holes, hole_sides = np.full(BLOCK, table[9]), np.empty(BLOCK), np.zeros(3 * BLOCK)
    for start in range(0, yaw.shape[0], BLOCK):
        stop = min(start + BLOCK, yaw.shape[0])
        count = stop - start
        p, b = q[2 * start : 2 * stop], out[start:stop]
        wx, wy, wh, node, hole = wxs[:count], wys[:count], whs[:count], nodes_at[:count], holes[:count]
        place(table, p, yaw[start:stop], clamp, wx, wy, wh, node)
        climb(table, in_layer, wh, slopes, node)
        blends(values, row, up, node, wx, wy, wh, b)
        if masked.shape[0] > 0:
            blends(masked, row, up, node, wx, wy, wh, hole)
            for n in range(count):
                b[n] = np.nan if hole[n] > edge else b[n]
        if sd.shape[0] > 0:
            one, plane = sd[start:stop], end - begin
            blends(spreads[:plane], row, up, node, wx, wy, wh, one)
            if spreads.shape[0] > plane:
                blends(spreads[plane : 2 * plane], row, up, node, wx, wy, wh, cells[:count])
                blends(spreads[2 * plane :], row, up, node, wx, wy, wh, turns[:count])
                for n in range(count):
                    one[n] = spread(one[n], cells[n], turns[n], wx[n], wy[n], wh[n])
            for n in range(count):
                one[n] = np.sqrt(one[n])
        if gradient.shape[0] == 0:
            continue
        g = gradient[3 * start : 3 * stop]
        _sides(values, row, up, node, wx, wy, wh, -1.0, g)
        if masked.shape[0] > 0:
            _sides(masked, row, up, node, wx, wy, wh, 1.0, hole_sides)
        for n in range(count):
            u, v = (p[2 * n] - x0) / dx, (p[2 * n + 1] - y0) / dy
            sx = 1 / dx if (u >= -edge) & (u <= table[8] - 1 + edge) else 0.0
            sy = 1 / dy if (v >= -edge) & (v <= table[7] - 1 + edge) else 0.0
            for axis, rate in enumerate((sx, sy, slopes[n])):
                k = 3 * n + axis
                known = (b[n] == b[n]) & ((rate == 0) | (hole_sides[k] <= edge))
                g[k] = g[k] * rate if known else np.nan


@compiled(_CUBE, types.Array(types.int64, 1, "C", readonly=True), _IN, _IN, types.float64, _CUBE_OUT)
def polynomials(table: Array, slot: Numbers, u: Array, w: Array, scale: float, out: Array) -> None:
    """Polynomials in u and w (N,), three at a time, and their slopes times `scale`, all by Horner's rule.

    `table` has the coefficients of each square by the power of u, and in a row by the power of w and by which
    of the three it is, shape (S, K, 3 K). `slot` is the square of each point. `out` takes the three values,
    their slopes along u and those along w, shape (N, 3, 3).
    """
    powers, width = table.shape[1], table.shape[2]
    a, slope = np.empty(width), np.empty(width)
    for n in range(slot.shape[0]):
        square, x, y = table[slot[n]], u[n], w[n]
        for k in range(width):
            a[k], slope[k] = square[powers - 1, k], 0.0
        for i in range(powers - 2, -1, -1):
            row = square[i]
            for k in range(width):
                slope[k] = slope[k] * x + a[k]
                a[k] = a[k] * x + row[k]
        for c in range(3):
            f, along_u, along_w = a[width - 3 + c], slope[width - 3 + c], 0.0
            for k in range(width - 6 + c, -1, -3):
                along_w = along_w * y + f
                f = f * y + a[k]
                along_u = along_u * y + slope[k]
            out[n, 0, c], out[n, 1, c], out[n, 2, c] = f, along_u * scale, along_w * scale
