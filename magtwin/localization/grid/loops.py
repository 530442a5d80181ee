"""Compiled loops of the point-mass filter and of sequence matching, which `point_mass.LOOPS` opens.

A grid is a stack of layers, one per heading. Node (h, j, i) lies at origin_h + A (i, j), with the same axes A
in all layers. `layers` has heading, origin x and origin y of each layer, shape (3 H,); `axes` has A by rows
and the distance between layers, shape (5,); `shape` has H, rows, columns and the number n of linear states,
int64 (4,). `logw` has the logarithm of each node's mass, shape (H Y X,), -inf if the node has none. `state`
has mean and upper triangle of the covariance of its n linear states, shape (H Y X (n + n (n + 1) / 2),).
"""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps import loops  # noqa: F401 -- marks the formulas of `trilinear` as inlined
from magtwin.field.maps.trilinear import at, sd_at

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

MOST_STATES = 5
"""Offset, drift, map error, and the two iron coefficients."""

_IN = types.Array(types.float64, 1, "C", readonly=True)
_OUT = types.Array(types.float64, 1, "C")
_SHAPE = types.Array(types.int64, 1, "C", readonly=True)
_REAL = types.float64

for _part in (at, sd_at):
    inlined(_part)


@compiled(_IN, _IN, _OUT, _OUT, _IN, _IN, _SHAPE, _IN, _OUT)
def update(
    table: Array,
    spreads: Array,
    logw: Array,
    state: Array,
    layers: Array,
    axes: Array,
    shape: Numbers,
    numbers: Array,
    stats: Array,
) -> None:
    """Predict the linear states of all nodes, use one reading, normalise, and sum up.

    `numbers`: reading [nT] (nan: none), lever arm x, y [m], white variance, white share of the map's
    variance, exponent of the likelihood, whether there are a map state and iron states, mean and variance of
    an unknown field, extent (4), penalty outside it, cut, reference x, y, yaw; then the decay and the noise
    variance of each linear state.

    `stats`: log of the evidence, nodes with mass, the node of most mass, sums of mass, dx, dy, dyaw, dx dx,
    dx dy, dx dyaw, dy dy, dy dyaw, dyaw dyaw and offset [nT] over the nodes, with d from the reference.
    """
    layers_, rows, columns, n = shape[0], shape[1], shape[2], shape[3]
    size = n + n * (n + 1) // 2
    z, lx, ly, white, share, power = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    mapped, iron = numbers[6] > 0, numbers[7] > 0
    wide_mean, wide_variance = numbers[8], numbers[9]
    x0, x1, y0, y1 = numbers[10], numbers[11], numbers[12], numbers[13]
    penalty, cut = numbers[14], numbers[15]
    x_ref, y_ref, yaw_ref = numbers[16], numbers[17], numbers[18]
    decay, added = numbers[19 : 19 + n], numbers[19 + n : 19 + 2 * n]
    read = z == z
    most, evidence = -np.inf, 0.0
    h_row, ph = np.zeros(MOST_STATES), np.zeros(MOST_STATES)
    h_row[0] = h_row[1] = 1.0
    first_iron = 3 if mapped else 2
    for h in range(layers_):
        yaw = layers[3 * h]
        c, s = math.cos(yaw), math.sin(yaw)
        ox, oy = layers[3 * h + 1], layers[3 * h + 2]
        if iron:
            h_row[first_iron], h_row[first_iron + 1] = c, s
        for j in range(rows):
            for i in range(columns):
                k = (h * rows + j) * columns + i
                if logw[k] == -np.inf:
                    continue
                m = k * size
                p = m + n
                for a in range(n):
                    state[m + a] *= decay[a]
                    for b in range(a, n):
                        state[p] *= decay[a] * decay[b]
                        if a == b:
                            state[p] += added[a]
                        p += 1
                if not read:
                    most = max(most, logw[k])
                    continue
                x, y = ox + axes[0] * i + axes[1] * j, oy + axes[2] * i + axes[3] * j
                sx, sy = x + c * lx - s * ly, y + s * lx + c * ly
                field = at(table, sx, sy, yaw, False)
                known = field == field
                noise = white
                if not known:
                    field, noise = wide_mean, white + wide_variance
                if mapped:
                    sd = 0.0
                    if known:
                        sd = sd_at(table, spreads, sx, sy, yaw, False)
                        sd = sd if sd == sd else 0.0
                    noise += share * sd * sd
                    h_row[2] = math.sqrt(1 - share) * sd
                innovation, variance = z - field, noise
                for a in range(n):
                    innovation -= h_row[a] * state[m + a]
                    ph[a] = 0.0
                p = m + n
                for a in range(n):
                    for b in range(a, n):
                        ph[a] += state[p] * h_row[b]
                        if b > a:
                            ph[b] += state[p] * h_row[a]
                        p += 1
                for a in range(n):
                    variance += h_row[a] * ph[a]
                log_likelihood = -0.5 * (innovation * innovation / variance + math.log(variance))
                if not (x0 <= x <= x1 and y0 <= y <= y1):
                    log_likelihood -= penalty
                evidence += math.exp(max(logw[k] + log_likelihood, -700.0))
                logw[k] += power * log_likelihood
                most = max(most, logw[k])
                if known:
                    p = m + n
                    for a in range(n):
                        state[m + a] += ph[a] * innovation / variance
                        for b in range(a, n):
                            state[p] -= ph[a] * ph[b] / variance
                            p += 1
    stats[:] = 0.0
    stats[0] = math.log(evidence) if evidence > 0 else -700.0
    if most == -np.inf:
        return
    total = 0.0
    for k in range(logw.shape[0]):
        if logw[k] < most - cut:
            logw[k] = -np.inf
        elif logw[k] > -np.inf:
            total += math.exp(logw[k] - most)
    level = most + math.log(total)
    best = -np.inf
    for h in range(layers_):
        yaw = layers[3 * h]
        dyaw = yaw - yaw_ref
        dyaw -= 2 * math.pi * math.floor(dyaw / (2 * math.pi) + 0.5)
        ox, oy = layers[3 * h + 1], layers[3 * h + 2]
        for j in range(rows):
            for i in range(columns):
                k = (h * rows + j) * columns + i
                if logw[k] == -np.inf:
                    continue
                logw[k] -= level
                if logw[k] > best:
                    best, stats[2] = logw[k], k
                w = math.exp(logw[k])
                dx = ox + axes[0] * i + axes[1] * j - x_ref
                dy = oy + axes[2] * i + axes[3] * j - y_ref
                bias = state[k * size]
                stats[1] += 1
                stats[3] += w
                stats[4] += w * dx
                stats[5] += w * dy
                stats[6] += w * dyaw
                stats[7] += w * dx * dx
                stats[8] += w * dx * dy
                stats[9] += w * dx * dyaw
                stats[10] += w * dy * dy
                stats[11] += w * dy * dyaw
                stats[12] += w * dyaw * dyaw
                stats[13] += w * bias


@inlined
def _add(weight: float, k: int, n: int, size: int, state: Array, origin: Array, total: Array) -> None:
    """Add a node to a mixture: its mass, and its moments about `origin`."""
    m = k * size
    total[0] += weight
    p = n
    for a in range(n):
        da = state[m + a] - origin[a]
        total[1 + a] += weight * da
        for b in range(a, n):
            total[1 + p] += weight * (state[m + p] + da * (state[m + b] - origin[b]))
            p += 1


@compiled(_IN, _IN, _OUT, _OUT, _IN, _IN, _SHAPE, _IN, _REAL)
def mix(
    logw: Array,
    state: Array,
    logw_out: Array,
    state_out: Array,
    layers: Array,
    axes: Array,
    shape: Numbers,
    taps: Array,
    turn: float,
) -> None:
    """Convolve the mass with the noise of a motion, and merge the linear states of the nodes that meet.

    `taps` has the weights of a layer's 3 x 3 nodes, shape (9 H,). A share `turn` goes to each of the two
    next layers, at the same place.
    """
    layers_, rows, columns, n = shape[0], shape[1], shape[2], shape[3]
    size = n + n * (n + 1) // 2
    w = np.empty(logw.shape[0])
    for k in range(w.shape[0]):
        w[k] = math.exp(logw[k]) if logw[k] > -np.inf else 0.0
    full = np.zeros(layers_ * rows, np.uint8)  # rows with mass
    for k in range(w.shape[0]):
        if w[k] > 0:
            full[k // columns] = 1
    total, origin = np.empty(1 + size), np.empty(MOST_STATES)
    determinant = axes[0] * axes[3] - axes[1] * axes[2]
    stay = 1 - 2 * turn
    for h in range(layers_):
        sources = np.full(2, -1)
        shift_i, shift_j = np.zeros(2), np.zeros(2)
        for side in range(2):
            g = h + 2 * side - 1
            if turn == 0 or not 0 <= g < layers_:
                continue
            dx = layers[3 * h + 1] - layers[3 * g + 1]
            dy = layers[3 * h + 2] - layers[3 * g + 2]
            sources[side] = g
            shift_i[side] = (axes[3] * dx - axes[1] * dy) / determinant
            shift_j[side] = (axes[0] * dy - axes[2] * dx) / determinant
        for j in range(rows):
            near = full[h * rows + j] > 0
            for dj in range(-1, 2):
                near = near or (0 <= j + dj < rows and full[h * rows + j + dj] > 0)
            for side in range(2):
                if sources[side] >= 0:
                    for dj in range(-1, 3):
                        v = math.floor(j + shift_j[side]) + dj
                        near = near or (0 <= v < rows and full[sources[side] * rows + v] > 0)
            if not near:
                for i in range(columns):
                    logw_out[(h * rows + j) * columns + i] = -np.inf
                continue
            for i in range(columns):
                k = (h * rows + j) * columns + i
                begun = False
                total[:] = 0.0
                for dj in range(-1, 2):
                    for di in range(-1, 2):
                        if not (0 <= j + dj < rows and 0 <= i + di < columns):
                            continue
                        weight = stay * taps[9 * h + 3 * (1 - dj) + 1 - di]
                        source = k + dj * columns + di
                        weight *= w[source]
                        if weight > 0:
                            if not begun:
                                begun = True
                                for a in range(n):
                                    origin[a] = state[source * size + a]
                            _add(weight, source, n, size, state, origin, total)
                for side in range(2):
                    if sources[side] < 0:
                        continue
                    u, v = i + shift_i[side], j + shift_j[side]
                    iu, jv = math.floor(u), math.floor(v)
                    fu, fv = u - iu, v - jv
                    for dj in range(2):
                        for di in range(2):
                            if not (0 <= jv + dj < rows and 0 <= iu + di < columns):
                                continue
                            source = (sources[side] * rows + jv + dj) * columns + iu + di
                            weight = turn * (fu if di else 1 - fu) * (fv if dj else 1 - fv) * w[source]
                            if weight > 0:
                                if not begun:
                                    begun = True
                                    for a in range(n):
                                        origin[a] = state[source * size + a]
                                _add(weight, source, n, size, state, origin, total)
                if not begun or total[0] < 1e-300:
                    logw_out[k] = -np.inf
                    continue
                logw_out[k] = math.log(total[0])
                m = k * size
                p = n
                for a in range(n):
                    mean = total[1 + a] / total[0]
                    state_out[m + a] = origin[a] + mean
                    for b in range(a, n):
                        state_out[m + p] = total[1 + p] / total[0] - mean * total[1 + b] / total[0]
                        p += 1


@compiled(_IN, _IN, _IN, _IN, _SHAPE, _OUT, _OUT, _IN, _IN, _SHAPE, _REAL)
def regrid(
    logw: Array,
    state: Array,
    layers: Array,
    axes: Array,
    shape: Numbers,
    logw_out: Array,
    state_out: Array,
    layers_out: Array,
    axes_out: Array,
    shape_out: Numbers,
    floor: float,
) -> None:
    """Interpolate a grid at the nodes of another one.

    The logarithm of the mass is expanded to second order about the nearest node, exact for a Gaussian; where
    a node of that expansion lies below `floor`, it is interpolated linearly. Layers are interpolated at equal
    indices, so that a correlation of place and heading does not blur. Linear states: linearly.
    """
    layers_, rows, columns, n = shape[0], shape[1], shape[2], shape[3]
    size = n + n * (n + 1) // 2
    determinant = axes[0] * axes[3] - axes[1] * axes[2]
    around = np.empty(27)
    for t in range(shape_out[0]):
        level = (layers_out[3 * t] - layers[0]) / axes[4]
        inside = -1.0 <= level <= layers_
        low = min(max(math.floor(level), 0), layers_ - 2)
        up, high = level - low, low + 1
        ox = layers[3 * low + 1] + up * (layers[3 * high + 1] - layers[3 * low + 1])
        oy = layers[3 * low + 2] + up * (layers[3 * high + 2] - layers[3 * low + 2])
        for j in range(shape_out[1]):
            for i in range(shape_out[2]):
                k = (t * shape_out[1] + j) * shape_out[2] + i
                logw_out[k] = -np.inf
                dx = layers_out[3 * t + 1] + axes_out[0] * i + axes_out[1] * j - ox
                dy = layers_out[3 * t + 2] + axes_out[2] * i + axes_out[3] * j - oy
                u = (axes[3] * dx - axes[1] * dy) / determinant
                v = (axes[0] * dy - axes[2] * dx) / determinant
                if not (inside and -1 <= u <= columns and -1 <= v <= rows):
                    continue
                iu = min(max(math.floor(u), 0), columns - 2)
                jv = min(max(math.floor(v), 0), rows - 2)
                fu, fv = u - iu, v - jv
                cu, cv, cw = min(max(fu, 0.0), 1.0), min(max(fv, 0.0), 1.0), min(max(up, 0.0), 1.0)
                # linear: of the states, and of the mass where the expansion fails
                value, shares = 0.0, 0.0
                m = k * size
                for a in range(size):
                    state_out[m + a] = 0.0
                for corner in range(8):
                    di, dj, dh = corner & 1, (corner >> 1) & 1, corner >> 2
                    weight = (cu if di else 1 - cu) * (cv if dj else 1 - cv) * (cw if dh else 1 - cw)
                    if weight <= 0:
                        continue
                    source = ((high if dh else low) * rows + jv + dj) * columns + iu + di
                    value += weight * max(logw[source], floor)
                    if logw[source] > -np.inf:
                        shares += weight
                        for a in range(size):
                            state_out[m + a] += weight * state[source * size + a]
                if shares < 1e-12:
                    continue
                for a in range(size):
                    state_out[m + a] /= shares
                # second order about the nearest node
                ci = min(max(math.floor(u + 0.5), 1), columns - 2)
                cj = min(max(math.floor(v + 0.5), 1), rows - 2)
                ch = min(max(math.floor(level + 0.5), 1), layers_ - 2)
                smooth = True
                for near in range(27):
                    ni, nj, nh = ci + near % 3 - 1, cj + near // 3 % 3 - 1, ch + near // 9 - 1
                    around[near] = logw[(nh * rows + nj) * columns + ni]
                    smooth = smooth and around[near] > floor
                if smooth:
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
                elif abs(fu - cu) + abs(fv - cv) + abs(up - cw) > 0:
                    continue  # outside the nodes
                if value > floor:
                    logw_out[k] = value


@compiled(_IN, _IN, _IN, _IN, _IN, _IN, _IN, _REAL, _OUT)
def match(
    table: Array,
    path: Array,
    residual: Array,
    whitening: Array,
    xs: Array,
    ys: Array,
    yaws: Array,
    margin: float,
    costs: Array,
) -> None:
    """Misfit of a sequence of readings at all placements of its path.

    Args:
        table: The map.
        path: x, y of the sensor and heading at each reading relative to the newest pose, shape (3 N,).
        residual: The readings [nT], shape (N,).
        whitening: Inverse of the Cholesky factor of the readings' covariance, by rows, shape (N N,).
        xs: Places of the newest pose.
        ys: The same along y.
        yaws: Headings of the newest pose.
        margin: A placement is given up once its misfit exceeds the least one by this.
        costs: Output by heading, y and x: squared Mahalanobis distance, infinite if given up.
    """
    n = residual.shape[0]
    misfit = np.empty(n)
    least = np.inf
    for h in range(yaws.shape[0]):
        c, s = math.cos(yaws[h]), math.sin(yaws[h])
        for j in range(ys.shape[0]):
            for i in range(xs.shape[0]):
                total = 0.0
                for k in range(n):
                    dx, dy = path[3 * k], path[3 * k + 1]
                    field = at(
                        table,
                        xs[i] + c * dx - s * dy,
                        ys[j] + s * dx + c * dy,
                        yaws[h] + path[3 * k + 2],
                        False,
                    )
                    if field == field:
                        misfit[k] = residual[k] - field
                        white = 0.0
                        for m in range(k + 1):
                            white += whitening[k * n + m] * misfit[m]
                    else:  # as a misfit of three standard deviations
                        white = 3.0
                        misfit[k] = misfit[k - 1] if k > 0 else 0.0
                    total += white * white
                    if total > least + margin:
                        break
                costs[(h * ys.shape[0] + j) * xs.shape[0] + i] = total if total <= least + margin else np.inf
                least = min(least, total)
