"""Loops over poses, compiled with numba: what `lookup.py` opens where they pay, and nobody else.

They do, operation by operation, what the numpy and the plain Python of `lookup.py` and the numpy of
`plane.py` do, so that all give
the same bytes: no fused multiplication, no reordered sum, nothing shared between poses. Machine code is
kept where numba keeps it, in `__pycache__` beside this file or, where that cannot be written to, in the
user's cache folder; where neither can, each process compiles anew.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

Array = NDArray[np.float64]
Nodes = NDArray[np.int32]
Numbers = NDArray[np.int64]

TURN = 2 * np.pi

HEADER = 10
"""Figures of a map before its headings in a table; see `lookup`."""

BLOCK = 512
"""Poses worked on at a time: their weights stay in the first-level cache."""

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

_IN = types.Array(types.float64, 1, "C", readonly=True)
_OUT = types.Array(types.float64, 1, "C")
_CUBE, _CUBE_OUT = types.Array(types.float64, 3, "C", readonly=True), types.Array(types.float64, 3, "C")
_NEXT = np.uint64(1)  # unsigned: numba would else look for indices from the end, and not vectorise


def compiled(*signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile for one signature, at import, or take the machine code that was kept."""

    def compile_or_take(function: Callable[..., Any]) -> Any:
        try:
            return njit(signature, cache=True, **OPTIONS)(function)
        except (RuntimeError, OSError):  # nowhere to keep it, or no room there
            return njit(signature, **OPTIONS)(function)

    return compile_or_take


@njit(**OPTIONS)
def _place(
    table: Array, q: Array, yaw: Array, clamp: bool, wx: Array, wy: Array, wh: Array, node: Nodes
) -> None:
    """Lowest node of each pose in the first layer, weights of the higher ones, angles above that layer.

    The x weight is nan where the field is not known. Angles are in [0, 2 pi], in the place of weights.
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
        node[n] = np.int32(j * columns + i)


@njit(**OPTIONS)
def _even(layers: float, per_rad: float, layer: float, wh: Array, node: Nodes) -> None:
    """Up from the first layer to that below each angle, where layers are evenly apart."""
    for n in range(wh.shape[0]):
        u = wh[n] * per_rad
        low = min(np.floor(u), layers - 1)
        wh[n] = u - low
        node[n] += np.int32(low * layer)


@njit(**OPTIONS)
def _uneven(knots: Array, gaps: Array, layer: float, wh: Array, slope: Array, node: Nodes) -> None:
    """The same where they are not; `slope` is that of each heading weight."""
    for n in range(wh.shape[0]):
        low, high = 0, knots.shape[0]
        while high - low > 1:
            middle = (low + high) // 2
            if wh[n] >= knots[middle]:
                low = middle
            else:
                high = middle
        wh[n] = (wh[n] - knots[low]) / gaps[low]
        slope[n] = 1 / gaps[low]
        node[n] += np.int32(low * layer)


@njit(**OPTIONS)
def _one(t: Array, k: np.uint64, row: np.uint64, layer: np.uint64, x: float, y: float, h: float) -> float:
    """Trilinear sum over flat values; k is the lowest of the 8 nodes, x, y and h weigh the higher ones."""
    m, lx, ly = k + layer, 1 - x, 1 - y
    low = (t[k] * lx + t[k + _NEXT] * x) * ly + (t[k + row] * lx + t[k + row + _NEXT] * x) * y
    high = (t[m] * lx + t[m + _NEXT] * x) * ly + (t[m + row] * lx + t[m + row + _NEXT] * x) * y
    return low * (1 - h) + high * h


@njit(**OPTIONS)
def _blend(
    t: Array, row: np.uint64, layer: np.uint64, node: Nodes, wx: Array, wy: Array, wh: Array, out: Array
) -> None:
    """Trilinear sums of many poses."""
    for n in range(out.shape[0]):
        out[n] = _one(t, np.uint64(node[n]), row, layer, wx[n], wy[n], wh[n])


@njit(**OPTIONS)
def _sides_of_one(
    t: Array, k: np.uint64, row: np.uint64, layer: np.uint64, x: float, y: float, h: float, sign: float
) -> tuple[float, float, float]:
    """High side of the cell plus `sign` times the low one, along x, y and heading."""
    m, lx, ly, lh = k + layer, 1 - x, 1 - y, 1 - h
    b000, b001, b010, b011 = t[k], t[k + _NEXT], t[k + row], t[k + row + _NEXT]
    b100, b101, b110, b111 = t[m], t[m + _NEXT], t[m + row], t[m + row + _NEXT]
    b00, b01 = b000 * lx + b001 * x, b010 * lx + b011 * x
    b10, b11 = b100 * lx + b101 * x, b110 * lx + b111 * x
    x0 = (b001 + sign * b000) * ly + (b011 + sign * b010) * y
    x1 = (b101 + sign * b100) * ly + (b111 + sign * b110) * y
    return (
        x0 * lh + x1 * h,
        (b01 + sign * b00) * lh + (b11 + sign * b10) * h,
        (b10 * ly + b11 * y) + sign * (b00 * ly + b01 * y),
    )


@njit(**OPTIONS)
def _sides(
    t: Array,
    row: np.uint64,
    layer: np.uint64,
    node: Nodes,
    wx: Array,
    wy: Array,
    wh: Array,
    sign: float,
    out: Array,
) -> None:
    """The same of many poses, shape (3 N,)."""
    for n in range(wx.shape[0]):
        along = _sides_of_one(t, np.uint64(node[n]), row, layer, wx[n], wy[n], wh[n], sign)
        out[3 * n], out[3 * n + 1], out[3 * n + 2] = along


@compiled(_IN, _IN, _IN, types.boolean, _OUT, _OUT)
def lookup(table: Array, q: Array, yaw: Array, clamp: bool, out: Array, gradient: Array) -> None:
    """Field at poses, and its gradient where `gradient` is not empty.

    Args:
        table: A map: x and y of the first node, spacing along x and y, first heading, rounding that is
            forgiven, number of layers, rows, columns, layers a radian (below 0 where they are not
            evenly apart); for each layer its angle above the first; for each layer the angle to the
            next; the values, with the first layer once more at the end; in the same order 1 for each
            masked node and 0 for the others, where any is masked.
        q: Points x, y, x, y, ... in world [m], shape (2 N,).
        yaw: Headings [rad], shape (N,).
        clamp: Whether points off the grid count as the nearest on it.
        out: Takes the field [nT], shape (N,).
        gradient: Takes dB/dx, dB/dy [nT/m], dB/dyaw [nT/rad] pose by pose, shape (3 N,) or (0,).
    """
    x0, y0, dx, dy, edge = table[0], table[1], table[2], table[3], table[5]
    layers, layer, per_rad = int(table[6]), table[7] * table[8], table[9]
    nodes = int((table[6] + 1) * layer)
    knots, gaps = table[HEADER : HEADER + layers], table[HEADER + layers : HEADER + 2 * layers]
    values = table[HEADER + 2 * layers : HEADER + 2 * layers + nodes]
    masked = table[HEADER + 2 * layers + nodes :]
    row, up = np.uint64(table[8]), np.uint64(layer)
    wxs, wys, whs, nodes_at = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.int32)
    slopes, holes, sides = np.full(BLOCK, per_rad), np.empty(BLOCK), np.empty(3 * BLOCK)
    for start in range(0, yaw.shape[0], BLOCK):
        stop = min(start + BLOCK, yaw.shape[0])
        count = stop - start
        at, b = q[2 * start : 2 * stop], out[start:stop]
        wx, wy, wh, node, hole = wxs[:count], wys[:count], whs[:count], nodes_at[:count], holes[:count]
        _place(table, at, yaw[start:stop], clamp, wx, wy, wh, node)
        if per_rad >= 0:
            _even(table[6], per_rad, layer, wh, node)
        else:
            _uneven(knots, gaps, layer, wh, slopes, node)
        _blend(values, row, up, node, wx, wy, wh, b)
        if masked.shape[0] > 0:
            _blend(masked, row, up, node, wx, wy, wh, hole)
            for n in range(count):
                b[n] = np.nan if hole[n] > edge else b[n]
        if gradient.shape[0] == 0:
            continue
        g = gradient[3 * start : 3 * stop]
        _sides(values, row, up, node, wx, wy, wh, -1.0, g)
        if masked.shape[0] > 0:
            _sides(masked, row, up, node, wx, wy, wh, 1.0, sides)
        else:
            sides[:] = 0
        for n in range(count):
            u, v = (at[2 * n] - x0) / dx, (at[2 * n + 1] - y0) / dy
            sx = 1 / dx if (u >= -edge) & (u <= table[8] - 1 + edge) else 0.0
            sy = 1 / dy if (v >= -edge) & (v <= table[7] - 1 + edge) else 0.0
            sh = slopes[n]
            known = b[n] == b[n]
            g[3 * n] = g[3 * n] * sx if known & ((sx == 0) | (sides[3 * n] <= edge)) else np.nan
            g[3 * n + 1] = g[3 * n + 1] * sy if known & ((sy == 0) | (sides[3 * n + 1] <= edge)) else np.nan
            g[3 * n + 2] = g[3 * n + 2] * sh if known & ((sh == 0) | (sides[3 * n + 2] <= edge)) else np.nan


@njit(**OPTIONS)
def _find(table: Array, x: float, y: float, yaw: float) -> tuple[float, float, float, float, float]:
    """Lowest node of a pose, below 0 off the grid, weights of the higher ones, slope of the heading's."""
    edge, layers, rows, columns, per_rad = table[5], table[6], table[7], table[8], table[9]
    u, v, a = (x - table[0]) / table[2], (y - table[1]) / table[3], yaw - table[4]
    known = (u >= -edge) & (u <= columns - 1 + edge) & (v >= -edge) & (v <= rows - 1 + edge)
    if not (known & (a - a == 0)):
        return -1.0, 0.0, 0.0, 0.0, 0.0
    u, v = min(max(u, 0.0), columns - 1), min(max(v, 0.0), rows - 1)
    i, j = min(np.floor(u), columns - 2), min(np.floor(v), rows - 2)
    a -= TURN * np.floor(a / TURN)
    a = min(max(a, 0.0), TURN)
    if per_rad >= 0:
        h = min(np.floor(a * per_rad), layers - 1)
        return (h * rows + j) * columns + i, u - i, v - j, a * per_rad - h, per_rad
    count = int(layers)
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        if a >= table[HEADER + middle]:
            low = middle
        else:
            high = middle
    gap = table[HEADER + count + low]
    return (low * rows + j) * columns + i, u - i, v - j, (a - table[HEADER + low]) / gap, 1 / gap


@njit(**OPTIONS)
def _planes(table: Array) -> tuple[int, int, int, int, bool]:
    """Where values begin in a table, and masks if there are any; nodes of a row and of a layer."""
    row, layer = int(table[8]), int(table[7] * table[8])
    values = HEADER + 2 * int(table[6])
    masked = values + (int(table[6]) + 1) * layer
    return values, masked, row, layer, table.shape[0] > masked


@compiled(_IN, types.float64, types.float64, types.float64)
def at(table: Array, x: float, y: float, yaw: float) -> float:
    """Field at one pose [nT], nan off the grid; arguments as those of `lookup`."""
    node, wx, wy, wh, _ = _find(table, x, y, yaw)
    if node < 0:
        return np.nan
    values, masked, row, layer, holes = _planes(table)
    n, r, up = int(node), np.uint64(row), np.uint64(layer)
    if holes and _one(table, np.uint64(masked + n), r, up, wx, wy, wh) > table[5]:
        return np.nan
    return _one(table, np.uint64(values + n), r, up, wx, wy, wh)


@compiled(_IN, types.float64, types.float64, types.float64)
def at_with_gradient(table: Array, x: float, y: float, yaw: float) -> tuple[float, float, float, float]:
    """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad]; all else as for `at`."""
    node, wx, wy, wh, sh = _find(table, x, y, yaw)
    if node < 0:
        return np.nan, np.nan, np.nan, np.nan
    values, masked, row, layer, holes = _planes(table)
    n, r, up = int(node), np.uint64(row), np.uint64(layer)
    bx, by, bh = _sides_of_one(table, np.uint64(values + n), r, up, wx, wy, wh, -1.0)
    sx, sy = 1 / table[2], 1 / table[3]
    bx, by, bh = bx * sx, by * sy, bh * sh
    if holes:
        k = np.uint64(masked + n)
        if _one(table, k, r, up, wx, wy, wh) > table[5]:
            return np.nan, np.nan, np.nan, np.nan
        hx, hy, hh = _sides_of_one(table, k, r, up, wx, wy, wh, 1.0)
        bx = np.nan if hx > table[5] else bx
        by = np.nan if hy > table[5] else by
        bh = np.nan if (hh > table[5]) & (sh != 0) else bh
    return _one(table, np.uint64(values + n), r, up, wx, wy, wh), bx, by, bh


@compiled(_CUBE, types.Array(types.int64, 1, "C", readonly=True), _IN, _IN, types.float64, _CUBE_OUT)
def polynomials(table: Array, slot: Numbers, u: Array, w: Array, scale: float, out: Array) -> None:
    """Polynomials in two variables, three at a time, and their slopes, all by Horner's rule.

    Args:
        table: Coefficients of each square by the power of u, and in a row by the power of w and by which of
            the three it is, shape (S, K, 3 K).
        slot: Which square each point is in, shape (N,).
        u: First variable, shape (N,).
        w: Second variable, shape (N,).
        scale: What the slopes are multiplied by.
        out: Takes the three values, their slopes along u and those along w, shape (N, 3, 3).
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
