"""Compiled loops of the particle filters: one step of a range of blocks of particles, and resampling.

Importing this module opens numba (see `magtwin.compiled`). Random numbers belong to a particle and a step,
and sums are taken block by block, in lanes of a fixed order, so that any number of threads gives the same
bytes. Particles are copied to memory of fixed shape, a block at a time, which the compiler needs to know that
rows do not overlap.
"""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled
from magtwin.field.maps.loops import blends, climb, place
from magtwin.field.maps.trilinear import planes
from magtwin.localization.elementary import (
    centred,
    cosine_sine,
    exponential,
    logarithm,
    normals,
    stream,
    whole,
)

Array = NDArray[np.float64]

BLOCK = 256
"""Particles worked on at a time: their states and factors stay in the cache."""

LANES, PARTS = 64, BLOCK // 64
"""Partial sums of a block, and particles in each."""

_QUARTER = LANES // 4

X, Y, YAW, SCALE, LOG_WEIGHT, WEIGHT, LINEAR = range(7)
"""Rows of the state: pose, mean of the odometry's scale error, log weight, weight relative to its block; then
the means of the linear states, and their covariance by rows of its lower triangle."""

CONSTANT, DRIFT, COSINE, SINE, MAP_SD = range(5)
"""Linear states, which enter the reading by the factors 1, 1, cos(yaw), sin(yaw) and the map's standard
deviation."""

STATES, _TRIANGLE = 5, 15

_MEAN = (
    LINEAR  # rows of the memory of a block: those of the state with all linear states, then those in between
)
_COVARIANCE = _MEAN + STATES
_GAIN = _COVARIANCE + _TRIANGLE
_FREE = _GAIN + STATES
_ROWS = _FREE + 16

(
    DISTANCE,
    DIRECTION,
    TURNED,
    ALONG_SD,
    ACROSS_SD,
    YAW_SD,
    SCALE_GAIN,
    ARM_X,
    ARM_Y,
    SHIFT,
    USED,
    FIELD,
    WHITE,
    MAP_WHITE,
    KAPPA,
    ELSEWHERE,
    ELSEWHERE_VARIANCE,
    X_REF,
    Y_REF,
    YAW_REF,
) = range(20)
"""Numbers of a step, in this order in its array: see `step`."""

(
    TOP,
    SUM,
    SUM_X,
    SUM_Y,
    SUM_YAW,
    XX,
    XY,
    X_YAW,
    YY,
    Y_YAW,
    YAW_YAW,
    SQUARES,
    COS,
    SIN,
    OFFSET,
    NU,
    NU_NU,
    PRIOR_S,
    PLAIN_TOP,
    PLAIN_SUM,
) = range(20)
"""Sums of a block, in this order in its row: greatest log weight; sum of the weights relative to it, and of
weight times offsets from the reference pose, their products; sum of squared weights; of weight times
cos(yaw), sin(yaw), mean of the first linear state; sum of the weights before the step times nu, nu^2 and S;
greatest log weight and sum of the weights without KAPPA."""


@whole
def add_moments(
    weight: Array, x: Array, y: Array, yaw: Array, x_ref: float, y_ref: float, yaw_ref: float, lanes: Array
) -> None:
    """Sums of the weights, and of weight times the offsets from a pose and their products, by lane."""
    for k in range(LANES):
        total = sx = sy = sa = xx = xy = xa = yy = ya = aa = 0.0
        for part in range(PARTS):
            n = part * LANES + k
            w, dx, dy, a = weight[n], x[n] - x_ref, y[n] - y_ref, centred(yaw[n] - yaw_ref) * (2 * math.pi)
            wx, wy, wa = w * dx, w * dy, w * a
            total += w
            sx += wx
            sy += wy
            sa += wa
            xx += wx * dx
            xy += wx * dy
            xa += wx * a
            yy += wy * dy
            ya += wy * a
            aa += wa * a
        lanes[SUM, k], lanes[SUM_X, k], lanes[SUM_Y, k], lanes[SUM_YAW, k] = total, sx, sy, sa
        lanes[XX, k], lanes[XY, k], lanes[X_YAW, k] = xx, xy, xa
        lanes[YY, k], lanes[Y_YAW, k], lanes[YAW_YAW, k] = yy, ya, aa


@whole
def greatest(row: Array, lane: Array) -> float:
    """Greatest entry of a row."""
    for k in range(LANES):
        top = row[k]
        for part in range(1, PARTS):
            top = max(top, row[part * LANES + k])
        lane[k] = top
    for k in range(_QUARTER):
        lane[k] = max(max(lane[k], lane[k + _QUARTER]), max(lane[k + 2 * _QUARTER], lane[k + 3 * _QUARTER]))
    top = lane[0]
    for k in range(1, _QUARTER):
        top = max(top, lane[k])
    return top


@whole
def add_up(lanes: Array, out: Array) -> None:
    """Sum of each row of lanes."""
    for row in range(lanes.shape[0]):
        lane = lanes[row]
        for k in range(_QUARTER):
            lane[k] = (lane[k] + lane[k + _QUARTER]) + (lane[k + 2 * _QUARTER] + lane[k + 3 * _QUARTER])
        total = 0.0
        for k in range(_QUARTER):
            total += lane[k]
        out[row] = total


@whole
def predict_two(p: Array, g: Array, both: Array, noise: Array) -> None:
    """P of two constants after a step, and g = P h."""
    for n in range(BLOCK):
        p00 = p[0, n] * both[0] + noise[0]
        p10 = p[1, n] * both[1]
        p11 = p[2, n] * both[2] + noise[1]
        p[0, n], p[1, n], p[2, n] = p00, p10, p11
        g[0, n], g[1, n] = p00 + p10, p10 + p11


@whole
def predict_five(p: Array, g: Array, both: Array, noise: Array, c: Array, s: Array, r: Array) -> None:
    """P of all linear states after a step, and g = P h with h = (1, 1, c, s, r)."""
    for n in range(BLOCK):
        h2, h3 = c[n], s[n]
        p00 = p[0, n] * both[0] + noise[0]
        p10 = p[1, n] * both[1]
        p11 = p[2, n] * both[2] + noise[1]
        p20, p21 = p[3, n] * both[3], p[4, n] * both[4]
        p22 = p[5, n] * both[5] + noise[2]
        p30, p31, p32 = p[6, n] * both[6], p[7, n] * both[7], p[8, n] * both[8]
        p33 = p[9, n] * both[9] + noise[3]
        p[0, n], p[1, n], p[2, n], p[3, n], p[4, n], p[5, n] = p00, p10, p11, p20, p21, p22
        p[6, n], p[7, n], p[8, n], p[9, n] = p30, p31, p32, p33
        g[0, n] = p00 + p10 + p20 * h2 + p30 * h3
        g[1, n] = p10 + p11 + p21 * h2 + p31 * h3
        g[2, n] = p20 + p21 + p22 * h2 + p32 * h3
        g[3, n] = p30 + p31 + p32 * h2 + p33 * h3
    for n in range(BLOCK):
        h4 = r[n]
        p40, p41, p42, p43 = (
            p[10, n] * both[10], p[11, n] * both[11], p[12, n] * both[12], p[13, n] * both[13]
        )  # fmt: skip
        p44 = p[14, n] * both[14] + noise[4]
        p[10, n], p[11, n], p[12, n], p[13, n], p[14, n] = p40, p41, p42, p43, p44
        g[4, n] = p40 + p41 + p42 * c[n] + p43 * s[n] + p44 * h4
        g[0, n] += p40 * h4
        g[1, n] += p41 * h4
        g[2, n] += p42 * h4
        g[3, n] += p43 * h4


@whole
def update_two(p: Array, mean: Array, g: Array, nu: Array, inverse: Array) -> None:
    """Add g nu / S to z and subtract g g' / S from P of two constants."""
    for n in range(BLOCK):
        g0, g1 = g[0, n], g[1, n]
        u0, u1 = g0 * inverse[n], g1 * inverse[n]
        mean[0, n] += u0 * nu[n]
        mean[1, n] += u1 * nu[n]
        p[0, n] -= u0 * g0
        p[1, n] -= u1 * g0
        p[2, n] -= u1 * g1


@whole
def update_five(p: Array, mean: Array, g: Array, nu: Array, inverse: Array) -> None:
    """Add g nu / S to z and subtract g g' / S from P of all linear states."""
    for n in range(BLOCK):
        g0, g1, g2, g3 = g[0, n], g[1, n], g[2, n], g[3, n]
        u0, u1, u2, u3 = g0 * inverse[n], g1 * inverse[n], g2 * inverse[n], g3 * inverse[n]
        mean[0, n] += u0 * nu[n]
        mean[1, n] += u1 * nu[n]
        mean[2, n] += u2 * nu[n]
        mean[3, n] += u3 * nu[n]
        p[0, n] -= u0 * g0
        p[1, n] -= u1 * g0
        p[2, n] -= u1 * g1
        p[3, n] -= u2 * g0
        p[4, n] -= u2 * g1
        p[5, n] -= u2 * g2
        p[6, n] -= u3 * g0
        p[7, n] -= u3 * g1
        p[8, n] -= u3 * g2
        p[9, n] -= u3 * g3
    for n in range(BLOCK):
        g4 = g[4, n]
        u4 = g4 * inverse[n]
        mean[4, n] += u4 * nu[n]
        p[10, n] -= u4 * g[0, n]
        p[11, n] -= u4 * g[1, n]
        p[12, n] -= u4 * g[2, n]
        p[13, n] -= u4 * g[3, n]
        p[14, n] -= u4 * g4


_IN, _OUT = types.Array(types.float64, 1, "C", readonly=True), types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
_KINDS = types.Array(types.int64, 1, "C", readonly=True)


@compiled(
    types.int64, types.int64, types.int64, _TABLE, _KINDS, _TABLE, _TABLE, _IN, _IN, _IN, _IN, _IN, _KINDS,
    types.uint64, types.boolean,
)  # fmt: skip
def step(
    first: int, last: int, count: int, before: Array, chosen: NDArray[np.int64], state: Array, sums: Array,
    table: Array, variance: Array, numbers: Array, decay: Array, noise: Array, kinds: NDArray[np.int64],
    key: np.uint64, sampled: bool,
) -> None:  # fmt: skip
    """Move the particles of some blocks, weigh them by a reading, and sum over each block.

    A particle moves by the distance d (1 + s) + ALONG_SD e1 in the direction yaw + TURNED / 2 + DIRECTION and
    by ACROSS_SD e2 across it, and turns by TURNED + YAW_SD e3. Its mean scale error s moves by SCALE_GAIN
    ALONG_SD e1. The linear states z of covariance P follow z' = decay z + noise, and a Kalman filter updates
    them by the reading:

        nu = FIELD - map - h z,  S = h P h' + WHITE + MAP_WHITE v
        z' = z + P h' nu / S,  P' = P - P h' h P / S

    with v the variance of the map. log likelihood = -(nu^2 / S + log S) / 2; log weights change by it divided
    by KAPPA. Where the map is not known, its value is ELSEWHERE, with variance ELSEWHERE_VARIANCE, all white.

    Args:
        first: First block.
        last: Block after the last.
        count: Number of particles.
        before: Particles before the step, one per column, with the rows X, Y, ...
        chosen: After resampling, the column in `before` of each particle, which all weigh the same; else of
            length 0.
        state: Takes the particles, at least `count` columns. Without `chosen` it may be `before`.
        sums: Takes the sums of each block, shape (blocks, 20).
        table: Table of the map's field; see `magtwin.field.maps.trilinear`.
        variance: Variance of the nodes, laid out as the values of the table; of length 0 if it has none.
        numbers: The numbers DISTANCE, ... of the step. USED is 0 if there is no reading. SHIFT is subtracted
            from the log weights, so that the weights before this step add up to 1.
        decay: Factor of each linear state, shape (n,).
        noise: Variance added to each, shape (n,).
        kinds: CONSTANT, ... for each in ascending order, shape (n,).
        key: Key of this step's random numbers.
        sampled: The linear states are not filtered but sampled: their noise is drawn, and P stays 0.
    """
    size, inner = decay.shape[0], 0
    # Rows are wider than a block: rows a power of two apart would compete for the same cache lines
    work, lanes = np.empty((_ROWS, BLOCK + 8)), np.empty((PLAIN_SUM + 1, LANES + 8))
    work[_MEAN:_GAIN] = 0.0
    places = np.zeros(STATES + _TRIANGLE, np.int64)  # rows of the linear states in `work`
    decays, added, both = np.ones(STATES), np.zeros(STATES), np.ones(_TRIANGLE)
    for k in range(size):
        places[k] = k_mean = _MEAN + kinds[k]
        decays[k_mean - _MEAN], added[k_mean - _MEAN] = decay[k], noise[k]
        for i in range(k + 1):
            places[size + inner] = _COVARIANCE + kinds[k] * (kinds[k] + 1) // 2 + kinds[i]
            inner += 1
    for k in range(STATES):
        for i in range(k + 1):
            both[k * (k + 1) // 2 + i] = decays[k] * decays[i]
    few = size == 0 or kinds[size - 1] < 2
    filtered = 2 if few else STATES
    x, y, yaw, scale = work[X, :BLOCK], work[Y, :BLOCK], work[YAW, :BLOCK], work[SCALE, :BLOCK]
    log_w, weight = work[LOG_WEIGHT, :BLOCK], work[WEIGHT, :BLOCK]
    mean, p, g = work[_MEAN:_COVARIANCE], work[_COVARIANCE:_GAIN], work[_GAIN:_FREE]
    free = work[_FREE:]
    c, s, e1, e2 = free[0, :BLOCK], free[1, :BLOCK], free[2, :BLOCK], free[3, :BLOCK]
    e3, b, v, hole = free[4, :BLOCK], free[5, :BLOCK], free[6, :BLOCK], free[7, :BLOCK]
    big_s, nu, like, r = free[8, :BLOCK], free[9, :BLOCK], free[10, :BLOCK], free[11, :BLOCK]
    wx, wy, wh, slope = free[12, :BLOCK], free[13, :BLOCK], free[14, :BLOCK], free[15, :BLOCK]
    q, node = np.empty(2 * BLOCK), np.empty(BLOCK, np.int64)
    begin, end, in_row, in_layer = planes(table)
    values, masks = table[begin:end], table[end:]
    row, up, edge = np.uint64(in_row), np.uint64(in_layer), table[5]
    used, kappa = numbers[USED] > 0, numbers[KAPPA]
    tempered = used and kappa != 1
    distance, turned, shift = numbers[DISTANCE], numbers[TURNED], numbers[SHIFT]
    half = turned / 2 + numbers[DIRECTION]
    along_sd, across_sd, yaw_sd = numbers[ALONG_SD], numbers[ACROSS_SD], numbers[YAW_SD]
    scale_gain, arm_x, arm_y = numbers[SCALE_GAIN], numbers[ARM_X], numbers[ARM_Y]
    field, white, map_white = numbers[FIELD], numbers[WHITE], numbers[MAP_WHITE]
    elsewhere, elsewhere_variance = numbers[ELSEWHERE], numbers[ELSEWHERE_VARIANCE]
    x_ref, y_ref, yaw_ref = numbers[X_REF], numbers[Y_REF], numbers[YAW_REF]
    equal = -math.log(count)
    for block in range(first, last):
        start = block * BLOCK
        m = min(start + BLOCK, count) - start
        for k in range(LINEAR + size + inner):
            to = work[k if k < LINEAR else places[k - LINEAR]]
            if chosen.shape[0] == 0:
                source = before[k, start : start + m]  # no negative index, which would not vectorise
                for n in range(m):
                    to[n] = source[n]
            elif k != LOG_WEIGHT and k != WEIGHT:
                row_before, place_before = before[k], chosen[start : start + m]
                for n in range(m):
                    to[n] = row_before[np.uint64(place_before[n])]
            for n in range(m, BLOCK):
                to[n] = to[0]
        if chosen.shape[0] > 0:
            log_w[:] = equal
            weight[:] = 1.0
        log_w[m:] = -np.inf
        weight[m:] = 0.0
        lanes[:] = 0.0

        first_draw, second_draw = stream(key, 0), stream(key, 1)
        for n in range(BLOCK):
            e1[n], e2[n] = normals(first_draw, np.uint64(start) + np.uint64(n))
        for n in range(BLOCK):
            e3[n], _ = normals(second_draw, np.uint64(start) + np.uint64(n))
        for n in range(BLOCK):
            cos, sin = cosine_sine(centred(yaw[n] + half))
            along, across = along_sd * e1[n], across_sd * e2[n]
            far = distance * (1 + scale[n]) + along
            x[n] += far * cos - across * sin
            y[n] += far * sin + across * cos
            scale[n] += scale_gain * along
        for n in range(BLOCK):
            yaw[n] += turned + yaw_sd * e3[n]
            c[n], s[n] = cosine_sine(centred(yaw[n]))
            log_w[n] -= shift
        for k in range(filtered):
            mean_k, a = mean[k], decays[k]
            for n in range(BLOCK):
                mean_k[n] *= a
        if sampled:
            for k in range(size):
                if noise[k] > 0:
                    drawn, sd, to = stream(key, 2 + k), math.sqrt(noise[k]), mean[kinds[k]]
                    for n in range(BLOCK):
                        to[n] += sd * normals(drawn, np.uint64(start) + np.uint64(n))[0]

        if used:
            for n in range(BLOCK):
                q[2 * n] = x[n] + arm_x * c[n] - arm_y * s[n]
                q[2 * n + 1] = y[n] + arm_x * s[n] + arm_y * c[n]
            place(table, q, yaw, False, wx, wy, wh, node)
            climb(table, in_layer, wh, slope, node)
            blends(values, row, up, node, wx, wy, wh, b)
            if masks.shape[0] > 0:
                blends(masks, row, up, node, wx, wy, wh, hole)
                for n in range(BLOCK):
                    b[n] = np.nan if hole[n] > edge else b[n]
            if variance.shape[0] > 0:
                blends(variance, row, up, node, wx, wy, wh, v)
            else:
                v[:] = 0.0
            for n in range(BLOCK):
                known = b[n] == b[n]
                big_s[n] = white + (map_white * v[n] if known else elsewhere_variance)
                r[n] = math.sqrt(v[n]) if known else 0.0
                nu[n] = field - (b[n] if known else elsewhere) - (mean[0, n] + mean[1, n])
            if not few:
                for n in range(BLOCK):
                    nu[n] -= c[n] * mean[2, n] + s[n] * mean[3, n] + r[n] * mean[4, n]
        if not sampled:
            if few:
                predict_two(p, g, both, added)
            else:
                predict_five(p, g, both, added, c, s, r)
        top = greatest(log_w, lanes[TOP])
        if used:
            if not sampled:
                for n in range(BLOCK):
                    big_s[n] += g[0, n] + g[1, n]
                if not few:
                    for n in range(BLOCK):
                        big_s[n] += g[2, n] * c[n] + g[3, n] * s[n] + g[4, n] * r[n]
            for k in range(LANES):
                sum_nu = sum_nu_nu = sum_s = 0.0
                for part in range(PARTS):
                    n = part * LANES + k
                    w_nu = weight[n] * nu[n]
                    sum_nu += w_nu
                    sum_nu_nu += w_nu * nu[n]
                    sum_s += weight[n] * big_s[n]
                lanes[NU, k], lanes[NU_NU, k], lanes[PRIOR_S, k] = sum_nu, sum_nu_nu, sum_s
            for n in range(BLOCK):
                log_s = logarithm(big_s[n])
                big_s[n] = 1 / big_s[n]
                like[n] = -0.5 * (nu[n] * nu[n] * big_s[n] + log_s)
            if not sampled:
                if few:
                    update_two(p, mean, g, nu, big_s)
                else:
                    update_five(p, mean, g, nu, big_s)
            if tempered:
                for n in range(BLOCK):
                    e1[n] = log_w[n] + like[n]
                plain_top = greatest(e1, lanes[TOP])
                for n in range(BLOCK):
                    e1[n] = exponential(e1[n] - plain_top)
                for k in range(LANES):
                    plain = 0.0
                    for part in range(PARTS):
                        plain += e1[part * LANES + k]
                    lanes[PLAIN_SUM, k] = plain
            for n in range(BLOCK):
                log_w[n] += like[n] / kappa
            top = greatest(log_w, lanes[TOP])
        for n in range(BLOCK):
            weight[n] = exponential(log_w[n] - top)
        add_moments(weight, x, y, yaw, x_ref, y_ref, yaw_ref, lanes)
        for k in range(LANES):
            squares = cosines = sines = offsets = 0.0
            for part in range(PARTS):
                n = part * LANES + k
                w = weight[n]
                squares += w * w
                cosines += w * c[n]
                sines += w * s[n]
                offsets += w * mean[0, n]
            lanes[SQUARES, k], lanes[COS, k], lanes[SIN, k] = squares, cosines, sines
            lanes[OFFSET, k] = offsets
        add_up(lanes, sums[block])
        sums[block, TOP] = top
        if tempered:
            sums[block, PLAIN_TOP] = plain_top
        else:
            sums[block, PLAIN_TOP], sums[block, PLAIN_SUM] = top, sums[block, SUM]
        for k in range(LINEAR + size + inner):
            to, source = state[k, start : start + m], work[k if k < LINEAR else places[k - LINEAR]]
            for n in range(m):
                to[n] = source[n]


@compiled(types.int64, _TABLE, _IN, types.float64, types.float64, types.float64, _OUT)
def moments(
    count: int, state: Array, scales: Array, x_ref: float, y_ref: float, yaw_ref: float, out: Array
) -> None:
    """Sums SUM to YAW_YAW over all particles about another pose; `scales` are factors of blocks' weights."""
    out[:] = 0.0
    work, lanes, part = np.zeros((4, BLOCK)), np.zeros((PLAIN_SUM + 1, LANES)), np.empty(PLAIN_SUM + 1)
    for block in range(scales.shape[0]):
        start = block * BLOCK
        m = min(start + BLOCK, count) - start
        for n in range(m):
            work[0, n], work[1, n] = state[WEIGHT, start + n], state[X, start + n]
            work[2, n], work[3, n] = state[Y, start + n], state[YAW, start + n]
        work[0, m:] = 0.0
        lanes[:] = 0.0
        add_moments(work[0], work[1], work[2], work[3], x_ref, y_ref, yaw_ref, lanes)
        add_up(lanes, part)
        for k in range(out.shape[0]):
            out[k] += scales[block] * part[k]


_PLACES = types.Array(types.int64, 1, "C")


@whole
def _first_of(limit: float, least: int, most: int) -> int:
    """Least whole number not below a limit, between two others."""
    return int(min(max(np.ceil(limit), float(least)), float(most)))


@compiled(types.int64, types.int64, types.int64, _TABLE, _IN, _IN, types.float64, _PLACES)
def choose(
    first: int, last: int, count: int, state: Array, scales: Array, below: Array, start: float,
    chosen: NDArray[np.int64],
) -> None:  # fmt: skip
    """Systematic resampling (Kitagawa 1996): the particles at weights (start + k) / K of their sum.

    Args:
        first: First block.
        last: Block after the last.
        count: Number of particles.
        state: Particles, whose row WEIGHT is used.
        scales: Factor of the weights of each block.
        below: Sum of the weights of all blocks before each block, and of all at the end, shape (blocks + 1,).
        start: A number in [0, 1).
        chosen: Takes the numbers of the K chosen particles, those in the blocks.
    """
    most, blocks = chosen.shape[0], scales.shape[0]
    each = most / below[blocks]
    done = _first_of(below[first] * each - start, 0, most)
    for block in range(first, last):
        begin, end = block * BLOCK, min((block + 1) * BLOCK, count)
        stop = most if block == blocks - 1 else _first_of(below[block + 1] * each - start, done, most)
        if stop == done:
            continue
        for k in range(done, stop):
            chosen[k] = begin
        place, total, factor = done, below[block] * each - start, scales[block] * each
        for n in range(begin, end):  # the last particle that is written to a place is the one chosen there
            chosen[place] = n
            total += state[WEIGHT, n] * factor
            place = _first_of(total, done, stop)
            if place == stop:
                break
        latest = begin
        for k in range(done, stop):
            latest = max(latest, chosen[k])
            chosen[k] = latest
        done = stop
