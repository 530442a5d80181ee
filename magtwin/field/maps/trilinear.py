"""Trilinear interpolation in a map's table: the formulas, which plain Python, numpy and compiled code share.

A table is one flat array: a header (x and y of the first node [m], spacing along x and y [m], first heading
[rad], `EDGE`, number of layers, rows and columns, layers per radian, which is below 0 for uneven layers);
for each layer its angle above the first [rad]; for each layer the angle to the next [rad]; the values [nT] by
heading, row and column, with the first layer repeated at the end; and, if any node is masked, in the same
order 1 for masked nodes and 0 for the others.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

TURN = 2 * math.pi

EDGE = 1e-9  # Rounding that a lookup forgives: cells beyond the border, or weight of a masked node
HEADER = 10  # Numbers in the header of a table
# The 8 nodes of a cell, numbers or arrays of them; x changes first, then y, then heading
Corners = Sequence[Any]


def blend(corners: Corners, x: Any, y: Any, h: Any) -> Any:
    """Weighted sum of a cell's nodes; x, y and h are the weights of the higher ones. Exact at 0 and at 1."""
    b000, b001, b010, b011, b100, b101, b110, b111 = corners
    lx, ly = 1 - x, 1 - y
    low = (b000 * lx + b001 * x) * ly + (b010 * lx + b011 * x) * y
    high = (b100 * lx + b101 * x) * ly + (b110 * lx + b111 * x) * y
    return low * (1 - h) + high * h


def sides(corners: Corners, x: Any, y: Any, h: Any, sign: float) -> tuple[Any, Any, Any]:
    """High side of the cell plus `sign` times the low side, along x, y and heading."""
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


def corners(t: Any, k: Any, one: Any, row: Any, layer: Any) -> Corners:
    """Entries of a cell whose lowest node is entry k; `one` is 1, in the type of the other indices."""
    m = k + layer
    low = t[k], t[k + one], t[k + row], t[k + row + one]
    return low[0], low[1], low[2], low[3], t[m], t[m + one], t[m + row], t[m + row + one]


def find(t: Any, x: float, y: float, yaw: float, clamp: bool) -> tuple[int, float, float, float, float]:
    """Cell of a pose.

    Returns:
        Its lowest node, or -1 if the field is not known there; the weights of the higher nodes along x, y
        and heading; the slope of the heading's weight [1/rad].
    """
    edge, rows, columns, per_rad = t[5], t[7], t[8], t[9]
    u, v, a = (x - t[0]) / t[2], (y - t[1]) / t[3], yaw - t[4]
    right, top = columns - 1, rows - 1
    inside = -edge <= u <= right + edge and -edge <= v <= top + edge
    if not (inside or (clamp and u == u and v == v)) or a - a != 0:
        return -1, 0.0, 0.0, 0.0, 0.0
    u = 0.0 if u < 0 else right if u > right else u
    v = 0.0 if v < 0 else top if v > top else v
    i, j = int(u), int(v)
    i = i - 1 if i == right else i
    j = j - 1 if j == top else j
    if not 0 <= a < TURN:
        a -= TURN * float(np.floor(a / TURN))
        a = 0.0 if a < 0 else TURN if a > TURN else a
    layers = int(t[6])
    if per_rad >= 0:
        h = min(int(a * per_rad), layers - 1)
        w = a * per_rad - h
    else:
        h, high = 0, layers
        while high - h > 1:
            middle = (h + high) // 2
            if a >= t[HEADER + middle]:
                h = middle
            else:
                high = middle
        gap = t[HEADER + layers + h]
        w, per_rad = (a - t[HEADER + h]) / gap, 1 / gap
    return (h * int(rows) + j) * int(columns) + i, u - i, v - j, w, per_rad


def planes(t: Any) -> tuple[int, int, int, int]:
    """Where a table's values and masks begin, and its nodes in a row and in a layer."""
    layers, row = int(t[6]), int(t[8])
    layer = int(t[7]) * row
    values = HEADER + 2 * layers
    return values, values + (layers + 1) * layer, row, layer


def at(t: Any, x: float, y: float, yaw: float, clamp: bool) -> float:
    """Field at one pose [nT], nan where it is not known; the arguments are those of `at_with_gradient`."""
    node, wx, wy, wh, _ = find(t, x, y, yaw, clamp)
    if node < 0:
        return math.nan
    values, masks, row, layer = planes(t)
    if len(t) > masks and blend(corners(t, masks + node, 1, row, layer), wx, wy, wh) > t[5]:
        return math.nan
    field: float = blend(corners(t, values + node, 1, row, layer), wx, wy, wh)
    return field


def at_with_gradient(
    t: Any, x: float, y: float, yaw: float, clamp: bool
) -> tuple[float, float, float, float]:
    """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad]; nan where they are not known.

    `t` is a map's table. With `clamp`, a point off the grid takes the field of the nearest point on it.
    """
    nan = math.nan
    node, wx, wy, wh, h_rate = find(t, x, y, yaw, clamp)
    if node < 0:
        return nan, nan, nan, nan
    values, masks, row, layer = planes(t)
    edge = t[5]
    x_rate = 1 / t[2] if -edge <= (x - t[0]) / t[2] <= t[8] - 1 + edge else 0.0
    y_rate = 1 / t[3] if -edge <= (y - t[1]) / t[3] <= t[7] - 1 + edge else 0.0
    cell = corners(t, values + node, 1, row, layer)
    field = blend(cell, wx, wy, wh)
    dx, dy, dh = sides(cell, wx, wy, wh, -1.0)
    dx, dy, dh = dx * x_rate, dy * y_rate, dh * h_rate
    if len(t) > masks:
        masked = corners(t, masks + node, 1, row, layer)
        if blend(masked, wx, wy, wh) > edge:
            return nan, nan, nan, nan
        mx, my, mh = sides(masked, wx, wy, wh, 1.0)
        dx = nan if x_rate != 0 and mx > edge else dx
        dy = nan if y_rate != 0 and my > edge else dy
        dh = nan if h_rate != 0 and mh > edge else dh
    return field, dx, dy, dh
