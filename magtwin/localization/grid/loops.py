"""Compiled loops of the point-mass filter, which `point_mass.LOOPS` opens; `state` explains their arrays."""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps import loops  # noqa: F401 -- marks the formulas of `trilinear` as inlined
from magtwin.field.maps.trilinear import at, sd_at
from magtwin.localization.elementary import whole
from magtwin.localization.grid.state import CUT, OUTSIDE, WHITE_SHARE, Known, Lattice, Sums

Array = NDArray[np.float64]

MOST_STATES = 5
"""Offset, drift, map error, and the two iron coefficients."""

IN = types.Array(types.float64, 1, "C", readonly=True)
OUT = types.Array(types.float64, 1, "C")
REAL = types.float64
KNOWN = types.NamedUniTuple(REAL, len(Known._fields), Known)
_LATTICE = types.NamedTuple([*[OUT] * 3, *[REAL] * 5, *[types.int64] * 2], Lattice)

for _part in (at, sd_at):
    inlined(_part)


@whole
def expected(
    table: Array, spreads: Array, known: Known, x: float, y: float, yaw: float, c: float, s: float, h: Array
) -> tuple[float, float, bool]:
    """Field at a pose, variance of a reading's white part, and whether the map is known; h of the map."""
    px, py = x + c * known.arm_x - s * known.arm_y, y + s * known.arm_x + c * known.arm_y
    field, noise = at(table, px, py, yaw, False), known.white
    seen = field == field
    if not seen:
        field, noise = known.wide_mean, known.white + known.wide_variance
    if known.mapped > 0:
        sd = 0.0
        if seen:
            sd = sd_at(table, spreads, px, py, yaw, False)
            sd = sd if sd == sd else 0.0
        noise += WHITE_SHARE * sd * sd
        h[2] = math.sqrt(1 - WHITE_SHARE) * sd
    return field, noise, seen


@whole
def predict(state: Array, m: int, decay: Array, added: Array) -> None:
    """Predict the linear states of the node whose states begin at m."""
    n = decay.shape[0]
    p = m + n
    for a in range(n):
        state[m + a] *= decay[a]
        for b in range(a, n):
            state[p] *= decay[a] * decay[b]
            if a == b:
                state[p] += added[a]
            p += 1


@whole
def innovation_of(
    state: Array, m: int, n: int, h: Array, ph: Array, away: float, noise: float
) -> tuple[float, float]:
    """Nu and S of a node from the reading less the field, and P h'."""
    for a in range(n):
        away -= h[a] * state[m + a]
        ph[a] = 0.0
    p = m + n
    for a in range(n):
        for b in range(a, n):
            ph[a] += state[p] * h[b]
            if b > a:
                ph[b] += state[p] * h[a]
            p += 1
    for a in range(n):
        noise += h[a] * ph[a]
    return away, noise


@whole
def correct(state: Array, m: int, n: int, ph: Array, innovation: float, variance: float) -> None:
    """Update the linear states of a node."""
    p = m + n
    for a in range(n):
        state[m + a] += ph[a] * innovation / variance
        for b in range(a, n):
            state[p] -= ph[a] * ph[b] / variance
            p += 1


@whole
def log_likelihood_of(known: Known, innovation: float, variance: float, x: float, y: float) -> float:
    """Log likelihood of a reading at a pose, which costs more outside the extent."""
    value = -0.5 * (innovation * innovation / variance + math.log(variance))
    inside = known.x0 <= x <= known.x1 and known.y0 <= y <= known.y1
    return value if inside else value - OUTSIDE


@whole
def normalise(logw: Array, most: float) -> None:
    """Drop what has little mass, and scale the mass to 1."""
    total = 0.0
    for k in range(logw.shape[0]):
        if logw[k] < most - CUT:
            logw[k] = -np.inf
        elif logw[k] > -np.inf:
            total += math.exp(logw[k] - most)
    level = most + math.log(total)
    for k in range(logw.shape[0]):
        if logw[k] > -np.inf:
            logw[k] -= level


@whole
def nearest_turn(angle: float) -> float:
    """An angle less whole turns, in [-pi, pi]."""
    return angle - 2 * math.pi * math.floor(angle / (2 * math.pi) + 0.5)


@whole
def _summed(logw: Array, state: Array, grid: Lattice, known: Known, size: int, evidence: float) -> Sums:
    """Sums over the nodes."""
    count, best = 0, 0
    top = -np.inf
    mass = sx = sy = sa = xx = xy = xa = yy = ya = aa = offset = 0.0
    for h in range(grid.yaw.shape[0]):
        a = nearest_turn(grid.yaw[h] - known.yaw_ref)
        for j in range(grid.rows):
            for i in range(grid.columns):
                k = (h * grid.rows + j) * grid.columns + i
                if logw[k] == -np.inf:
                    continue
                if logw[k] > top:
                    top, best = logw[k], k
                w = math.exp(logw[k])
                dx = grid.x[h] + grid.x_i * i + grid.x_j * j - known.x_ref
                dy = grid.y[h] + grid.y_i * i + grid.y_j * j - known.y_ref
                count += 1
                mass += w
                sx += w * dx
                sy += w * dy
                sa += w * a
                xx += w * dx * dx
                xy += w * dx * dy
                xa += w * dx * a
                yy += w * dy * dy
                ya += w * dy * a
                aa += w * a * a
                offset += w * state[k * size]
    return Sums(evidence, count, best, mass, sx, sy, sa, xx, xy, xa, yy, ya, aa, offset)


@compiled(IN, IN, OUT, OUT, _LATTICE, KNOWN, IN, IN)
def update(
    table: Array,
    spreads: Array,
    logw: Array,
    state: Array,
    grid: Lattice,
    known: Known,
    decay: Array,
    added: Array,
) -> Sums:
    """Predict the linear states of all nodes, use one reading, normalise, and sum up.

    Args:
        table: Table of the field.
        spreads: Table of its variance.
        logw: Log mass of the nodes.
        state: Their linear states.
        grid: Their places.
        known: The reading.
        decay: Factor of each linear state, shape (n,).
        added: Variance that is added to each, shape (n,).
    """
    n = decay.shape[0]
    size = n + n * (n + 1) // 2
    read = known.z == known.z
    most, evidence = -np.inf, 0.0
    h_row, ph = np.zeros(MOST_STATES), np.zeros(MOST_STATES)
    h_row[0] = h_row[1] = 1.0
    iron = 3 if known.mapped > 0 else 2
    for h in range(grid.yaw.shape[0]):
        yaw = grid.yaw[h]
        c, s = math.cos(yaw), math.sin(yaw)
        if known.iron > 0:
            h_row[iron], h_row[iron + 1] = c, s
        for j in range(grid.rows):
            for i in range(grid.columns):
                k = (h * grid.rows + j) * grid.columns + i
                if logw[k] == -np.inf:
                    continue
                predict(state, k * size, decay, added)
                if read:
                    x = grid.x[h] + grid.x_i * i + grid.x_j * j
                    y = grid.y[h] + grid.y_i * i + grid.y_j * j
                    field, noise, seen = expected(table, spreads, known, x, y, yaw, c, s, h_row)
                    nu, variance = innovation_of(state, k * size, n, h_row, ph, known.z - field, noise)
                    like = log_likelihood_of(known, nu, variance, x, y)
                    evidence += math.exp(max(logw[k] + like, -700.0))
                    logw[k] += known.power * like
                    if seen:
                        correct(state, k * size, n, ph, nu, variance)
                most = max(most, logw[k])
    evidence = math.log(evidence) if evidence > 0 else -700.0
    if most == -np.inf:
        return Sums(evidence, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    normalise(logw, most)
    return _summed(logw, state, grid, known, size, evidence)


@whole
def _add(weight: float, k: int, n: int, state: Array, origin: Array, total: Array) -> None:
    """Add a node to a mixture: its mass, and its moments about the mean of the first node."""
    m = k * (n + n * (n + 1) // 2)
    if total[0] == 0.0:
        for a in range(n):
            origin[a] = state[m + a]
    total[0] += weight
    p = n
    for a in range(n):
        da = state[m + a] - origin[a]
        total[1 + a] += weight * da
        for b in range(a, n):
            total[1 + p] += weight * (state[m + p] + da * (state[m + b] - origin[b]))
            p += 1


@whole
def _merged(total: Array, origin: Array, n: int, state_out: Array, m: int) -> None:
    """Moments of a mixture as linear states."""
    p = n
    for a in range(n):
        mean = total[1 + a] / total[0]
        state_out[m + a] = origin[a] + mean
        for b in range(a, n):
            state_out[m + p] = total[1 + p] / total[0] - mean * total[1 + b] / total[0]
            p += 1


@whole
def in_cells(grid: Lattice, dx: float, dy: float) -> tuple[float, float]:
    """A distance [m] in distances between nodes."""
    determinant = grid.x_i * grid.y_j - grid.x_j * grid.y_i
    return (grid.y_j * dx - grid.x_j * dy) / determinant, (grid.x_i * dy - grid.y_i * dx) / determinant


@whole
def _has_mass(full: NDArray[np.uint8], layer: int, rows: int, low: int, high: int) -> bool:
    """Whether one of some rows of a layer has mass."""
    near = False
    for j in range(max(low, 0), min(high, rows)):
        near = near or full[layer * rows + j] > 0
    return near


@whole
def _spread_within(
    w: Array, state: Array, grid: Lattice, taps: Array, stay: float, h: int, j: int, i: int, n: int,
    origin: Array, total: Array,
) -> None:  # fmt: skip
    """Add what the neighbours in a layer give to a node."""
    k = (h * grid.rows + j) * grid.columns + i
    for dj in range(-1, 2):
        for di in range(-1, 2):
            if 0 <= j + dj < grid.rows and 0 <= i + di < grid.columns:
                source = k + dj * grid.columns + di
                weight = stay * taps[9 * h + 3 * (1 - dj) + 1 - di] * w[source]
                if weight > 0:
                    _add(weight, source, n, state, origin, total)


@whole
def _spread_across(
    w: Array, state: Array, grid: Lattice, turn: float, layer: int, u: float, v: float, n: int,
    origin: Array, total: Array,
) -> None:  # fmt: skip
    """Add what another layer gives to the place (u, v) in it."""
    iu, jv = math.floor(u), math.floor(v)
    fu, fv = u - iu, v - jv
    for dj in range(2):
        for di in range(2):
            if 0 <= jv + dj < grid.rows and 0 <= iu + di < grid.columns:
                source = (layer * grid.rows + jv + dj) * grid.columns + iu + di
                weight = turn * (fu if di else 1 - fu) * (fv if dj else 1 - fv) * w[source]
                if weight > 0:
                    _add(weight, source, n, state, origin, total)


@compiled(IN, IN, OUT, OUT, _LATTICE, types.int64, IN, REAL)
def mix(
    logw: Array,
    state: Array,
    logw_out: Array,
    state_out: Array,
    grid: Lattice,
    n: int,
    taps: Array,
    turn: float,
) -> None:
    """Convolve the mass with the noise of a motion, and merge the linear states of the nodes that meet.

    Args:
        logw: Log mass of the nodes.
        state: Their linear states.
        logw_out: Takes the new log mass.
        state_out: Takes the new linear states.
        grid: Places of the nodes.
        n: Number of linear states.
        taps: Weights of a layer's 3 x 3 nodes, shape (9 H,).
        turn: Share that goes to each of the two next layers, at the same place.
    """
    layers, rows, columns = grid.yaw.shape[0], grid.rows, grid.columns
    size = n + n * (n + 1) // 2
    w = np.empty(logw.shape[0])
    full = np.zeros(layers * rows, np.uint8)  # rows with mass
    for k in range(w.shape[0]):
        w[k] = math.exp(logw[k]) if logw[k] > -np.inf else 0.0
        if w[k] > 0:
            full[k // columns] = 1
    total, origin = np.empty(1 + size), np.empty(MOST_STATES)
    shift_i, shift_j, stay = np.zeros(2), np.zeros(2), 1 - 2 * turn
    for h in range(layers):
        first, last = max(h - 1, 0), min(h + 1, layers - 1)
        if turn == 0:
            first = last = h
        for g in range(first, last + 1):  # places of this layer in the next ones
            if g != h:
                u, v = in_cells(grid, grid.x[h] - grid.x[g], grid.y[h] - grid.y[g])
                shift_i[(g > h) * 1], shift_j[(g > h) * 1] = u, v
        for j in range(rows):
            near = _has_mass(full, h, rows, j - 1, j + 2)
            for g in range(first, last + 1):
                if g != h:
                    v = math.floor(j + shift_j[(g > h) * 1])
                    near = near or _has_mass(full, g, rows, v - 1, v + 3)
            for i in range(columns):
                k = (h * rows + j) * columns + i
                total[:] = 0.0
                if near:
                    _spread_within(w, state, grid, taps, stay, h, j, i, n, origin, total)
                    for g in range(first, last + 1):
                        if g != h:
                            u, v = i + shift_i[(g > h) * 1], j + shift_j[(g > h) * 1]
                            _spread_across(w, state, grid, turn, g, u, v, n, origin, total)
                if total[0] < 1e-300:
                    logw_out[k] = -np.inf
                else:
                    logw_out[k] = math.log(total[0])
                    _merged(total, origin, n, state_out, k * size)


@whole
def _linear(
    logw: Array, state: Array, grid: Lattice, floor: float, low: int, jv: int, iu: int,
    cw: float, cv: float, cu: float, state_out: Array, m: int, size: int,
) -> tuple[float, float]:  # fmt: skip
    """Linear interpolation of log mass and of the linear states; the log mass and the sum of weights."""
    value, shares = 0.0, 0.0
    for a in range(size):
        state_out[m + a] = 0.0
    for corner in range(8):
        di, dj, dh = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (cu if di else 1 - cu) * (cv if dj else 1 - cv) * (cw if dh else 1 - cw)
        if weight <= 0:
            continue
        source = ((low + dh) * grid.rows + jv + dj) * grid.columns + iu + di
        value += weight * max(logw[source], floor)
        if logw[source] > -np.inf:
            shares += weight
            for a in range(size):
                state_out[m + a] += weight * state[source * size + a]
    if shares >= 1e-12:
        for a in range(size):
            state_out[m + a] /= shares
    return value, shares


@whole
def _quadratic(
    logw: Array, grid: Lattice, floor: float, level: float, v: float, u: float, around: Array
) -> tuple[float, bool]:
    """Log mass to second order about the nearest node; whether no node of the expansion is below `floor`."""
    ci = min(max(math.floor(u + 0.5), 1), grid.columns - 2)
    cj = min(max(math.floor(v + 0.5), 1), grid.rows - 2)
    ch = min(max(math.floor(level + 0.5), 1), grid.yaw.shape[0] - 2)
    smooth = True
    for near in range(27):
        ni, nj, nh = ci + near % 3 - 1, cj + near // 3 % 3 - 1, ch + near // 9 - 1
        around[near] = logw[(nh * grid.rows + nj) * grid.columns + ni]
        smooth = smooth and around[near] > floor
    if not smooth:
        return 0.0, False
    du, dv, dw = u - ci, v - cj, level - ch
    middle = around[13]
    gu, gv, gw = around[14] - around[12], around[16] - around[10], around[22] - around[4]
    quu = around[14] + around[12] - 2 * middle
    qvv = around[16] + around[10] - 2 * middle
    qww = around[22] + around[4] - 2 * middle
    quv = around[17] + around[9] - around[15] - around[11]
    quw = around[23] + around[3] - around[21] - around[5]
    qvw = around[25] + around[1] - around[19] - around[7]
    value = (
        middle
        + 0.5 * (gu * du + gv * dv + gw * dw + quu * du * du + qvv * dv * dv + qww * dw * dw)
        + 0.25 * (quv * du * dv + quw * du * dw + qvw * dv * dw)
    )
    return value, True


@compiled(IN, IN, _LATTICE, OUT, OUT, _LATTICE, types.int64, REAL)
def regrid(
    logw: Array,
    state: Array,
    grid: Lattice,
    logw_out: Array,
    state_out: Array,
    other: Lattice,
    n: int,
    floor: float,
) -> None:
    """Interpolate a grid at the nodes of another one.

    The logarithm of the mass is expanded to second order about the nearest node, exact for a Gaussian; where
    a node of that expansion lies below `floor`, it is interpolated linearly. Layers are interpolated at equal
    indices, so that a correlation of place and heading does not blur. Linear states: linearly.

    Args:
        logw: Log mass of the nodes.
        state: Their linear states.
        grid: Their places.
        logw_out: Takes the log mass of the other nodes.
        state_out: Takes their linear states.
        other: Their places.
        n: Number of linear states.
        floor: Log mass that counts as none.
    """
    layers, rows, columns = grid.yaw.shape[0], grid.rows, grid.columns
    size = n + n * (n + 1) // 2
    around = np.empty(27)
    for t in range(other.yaw.shape[0]):
        level = (other.yaw[t] - grid.yaw[0]) / grid.step
        inside = -1.0 <= level <= layers
        low = min(max(math.floor(level), 0), layers - 2)
        up = level - low
        ox = grid.x[low] + up * (grid.x[low + 1] - grid.x[low])
        oy = grid.y[low] + up * (grid.y[low + 1] - grid.y[low])
        for j in range(other.rows):
            for i in range(other.columns):
                k = (t * other.rows + j) * other.columns + i
                logw_out[k] = -np.inf
                dx = other.x[t] + other.x_i * i + other.x_j * j - ox
                dy = other.y[t] + other.y_i * i + other.y_j * j - oy
                u, v = in_cells(grid, dx, dy)
                if not (inside and -1 <= u <= columns and -1 <= v <= rows):
                    continue
                iu = min(max(math.floor(u), 0), columns - 2)
                jv = min(max(math.floor(v), 0), rows - 2)
                fu, fv = u - iu, v - jv
                cu, cv, cw = min(max(fu, 0.0), 1.0), min(max(fv, 0.0), 1.0), min(max(up, 0.0), 1.0)
                value, shares = _linear(
                    logw, state, grid, floor, low, jv, iu, cw, cv, cu, state_out, k * size, size
                )
                if shares < 1e-12:
                    continue
                curved, smooth = _quadratic(logw, grid, floor, level, v, u, around)
                if smooth:
                    value = curved
                elif abs(fu - cu) + abs(fv - cv) + abs(up - cw) > 0:
                    continue  # outside the nodes
                if value > floor:
                    logw_out[k] = value
