"""Compiled loops of the particle filters: one step of a range of blocks of particles, and resampling.

**State.** A particle is a column: the rows X, Y, YAW, SCALE, LOG_WEIGHT and WEIGHT, then the means of its n
linear states, and their covariance P by rows of its lower triangle. `kinds` has the n linear states in
ascending order: CONSTANT, DRIFT, COSINE, SINE, MAP_SD. A block of 256 particles is copied to `work` and back,
which has the first six rows too, then rows for all linear states (MEAN, COVARIANCE, GAIN = P h') and for what
lies between (C to SLOPE). Its shape is fixed, which tells the compiler that rows do not overlap.

**Step.** A particle moves by the distance d (1 + s) + along_sd e1 in the direction yaw + turned / 2 +
direction and by across_sd e2 across it, and turns by turned + yaw_sd e3. Its mean scale error s moves by
scale_gain along_sd e1. The linear states z follow z' = decay z + noise, and a Kalman filter updates them by
the reading, with h = (1, 1, cos(yaw), sin(yaw), the map's standard deviation):

    nu = field - map - h z,  S = h P h' + white + map_white v
    z' = z + P h' nu / S,  P' = P - P h' h P / S

with v the variance of the map. log likelihood = -(nu^2 / S + log S) / 2; log weights change by it divided by
kappa. Where the map is not known, its value is `elsewhere`, with variance `elsewhere_variance`, all white.

**Same bytes.** Random numbers belong to a particle and a step, and sums are taken block by block, in lanes of
a fixed order, so that any number of threads gives the same bytes. Importing this module opens numba.
"""

import math
from typing import NamedTuple

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

MEAN = LINEAR
COVARIANCE = MEAN + STATES
GAIN = COVARIANCE + _TRIANGLE

C, S, E1, E2, E3, B, V, HOLE, BIG_S, MISFIT, LIKE, SD, WX, WY, WH, SLOPE = range(
    GAIN + STATES, GAIN + STATES + 16
)
"""Rows of `work` after those of the linear states: cos(yaw) and sin(yaw); random numbers; field of the map,
its variance, and its mask; S, then its inverse; nu; log likelihood; standard deviation of the map, 0 where it
is not known; and what the lookup in the map needs."""


class Step(NamedTuple):
    """Numbers of a step; see the module's text."""

    distance: float  # [m]
    direction: float  # of the motion from the heading halfway [rad]
    turned: float  # [rad]
    along_sd: float  # noise along the motion, across it [m] and of the heading [rad]
    across_sd: float
    yaw_sd: float
    scale_gain: float  # of the scale error by the noise along the motion [1/m]
    arm_x: float  # sensor in base_link [m]
    arm_y: float
    shift: float  # subtracted from the log weights, so that the weights before this step add up to 1
    used: float  # 1 if there is a reading, else 0
    field: float  # the reading [nT]
    white: float  # variance of its white noise [nT^2]
    map_white: float  # share of the map's variance that is white
    kappa: float  # divisor of the log likelihood
    elsewhere: float  # field where the map is not known [nT]
    elsewhere_variance: float  # its variance [nT^2]
    x_ref: float  # pose from which the sums are taken [m, rad]
    y_ref: float
    yaw_ref: float


class Table(NamedTuple):
    """A table of the map's field, and its variance; see `magtwin.field.maps.trilinear`."""

    table: Array
    values: Array
    masks: Array
    variance: Array
    """Of the nodes; of length 0 if the map has none."""

    in_layer: int
    row: np.uint64
    up: np.uint64


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


@whole
def fetch(
    before: Array, chosen: NDArray[np.int64], start: int, m: int, count: int, work: Array,
    places: NDArray[np.int64],
) -> None:  # fmt: skip
    """Copy the m particles from `start` on; the rest of the block has no weight."""
    for k in range(before.shape[0]):
        to = work[places[k]]
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
        work[LOG_WEIGHT] = -math.log(count)
        work[WEIGHT] = 1.0
    work[LOG_WEIGHT, m:] = -np.inf
    work[WEIGHT, m:] = 0.0


@whole
def move(work: Array, step: Step, key: np.uint64, start: int) -> None:
    """Move the particles by the odometry and its noise."""
    first_draw, second_draw = stream(key, 0), stream(key, 1)
    half = step.turned / 2 + step.direction
    for n in range(BLOCK):
        work[E1, n], work[E2, n] = normals(first_draw, np.uint64(start) + np.uint64(n))
    for n in range(BLOCK):
        work[E3, n], _ = normals(second_draw, np.uint64(start) + np.uint64(n))
    for n in range(BLOCK):
        cos, sin = cosine_sine(centred(work[YAW, n] + half))
        along, across = step.along_sd * work[E1, n], step.across_sd * work[E2, n]
        far = step.distance * (1 + work[SCALE, n]) + along
        work[X, n] += far * cos - across * sin
        work[Y, n] += far * sin + across * cos
        work[SCALE, n] += step.scale_gain * along
    for n in range(BLOCK):
        yaw = work[YAW, n] + (step.turned + step.yaw_sd * work[E3, n])
        work[YAW, n] = yaw
        work[C, n], work[S, n] = cosine_sine(centred(yaw))
        work[LOG_WEIGHT, n] -= step.shift


@whole
def draw_errors(work: Array, noise: Array, kinds: NDArray[np.int64], key: np.uint64, start: int) -> None:
    """Draw the noise of linear states that are sampled."""
    for k in range(noise.shape[0]):
        if noise[k] > 0:
            drawn, sd, to = stream(key, 2 + k), math.sqrt(noise[k]), work[MEAN + kinds[k]]
            for n in range(BLOCK):
                to[n] += sd * normals(drawn, np.uint64(start) + np.uint64(n))[0]


@whole
def look_up(work: Array, step: Step, field: Table, q: Array, node: NDArray[np.int64], few: bool) -> None:
    """nu, the white part of S, and the map's standard deviation at the sensor of each particle."""
    b, v = work[B, :BLOCK], work[V, :BLOCK]
    wx, wy, wh = work[WX, :BLOCK], work[WY, :BLOCK], work[WH, :BLOCK]
    for n in range(BLOCK):
        q[2 * n] = work[X, n] + step.arm_x * work[C, n] - step.arm_y * work[S, n]
        q[2 * n + 1] = work[Y, n] + step.arm_x * work[S, n] + step.arm_y * work[C, n]
    place(field.table, q, work[YAW, :BLOCK], False, wx, wy, wh, node)
    climb(field.table, field.in_layer, wh, work[SLOPE, :BLOCK], node)
    blends(field.values, field.row, field.up, node, wx, wy, wh, b)
    if field.masks.shape[0] > 0:
        hole, edge = work[HOLE, :BLOCK], field.table[5]
        blends(field.masks, field.row, field.up, node, wx, wy, wh, hole)
        for n in range(BLOCK):
            b[n] = np.nan if hole[n] > edge else b[n]
    if field.variance.shape[0] > 0:
        blends(field.variance, field.row, field.up, node, wx, wy, wh, v)
    else:
        v[:] = 0.0
    for n in range(BLOCK):
        known = b[n] == b[n]
        work[BIG_S, n] = step.white + (step.map_white * v[n] if known else step.elsewhere_variance)
        work[SD, n] = math.sqrt(v[n]) if known else 0.0
        away = step.field - (b[n] if known else step.elsewhere)
        work[MISFIT, n] = away - (work[MEAN, n] + work[MEAN + 1, n])
    if not few:
        for n in range(BLOCK):
            iron = work[C, n] * work[MEAN + 2, n] + work[S, n] * work[MEAN + 3, n]
            work[MISFIT, n] -= iron + work[SD, n] * work[MEAN + 4, n]


@whole
def add_variance(work: Array, few: bool) -> None:
    """Add h P h' to S."""
    for n in range(BLOCK):
        work[BIG_S, n] += work[GAIN, n] + work[GAIN + 1, n]
    if not few:
        for n in range(BLOCK):
            iron = work[GAIN + 2, n] * work[C, n] + work[GAIN + 3, n] * work[S, n]
            work[BIG_S, n] += iron + work[GAIN + 4, n] * work[SD, n]


@whole
def add_surprise(work: Array, lanes: Array) -> None:
    """Sums of nu, nu^2 and S with the weights before the step, by lane."""
    for k in range(LANES):
        sum_nu = sum_nu_nu = sum_s = 0.0
        for part in range(PARTS):
            n = part * LANES + k
            w_nu = work[WEIGHT, n] * work[MISFIT, n]
            sum_nu += w_nu
            sum_nu_nu += w_nu * work[MISFIT, n]
            sum_s += work[WEIGHT, n] * work[BIG_S, n]
        lanes[NU, k], lanes[NU_NU, k], lanes[PRIOR_S, k] = sum_nu, sum_nu_nu, sum_s


@whole
def add_plain(work: Array, lanes: Array) -> float:
    """Sum of the weights without kappa, by lane; returns the greatest log weight without it."""
    for n in range(BLOCK):
        work[E1, n] = work[LOG_WEIGHT, n] + work[LIKE, n]
    top = greatest(work[E1], lanes[TOP])
    for n in range(BLOCK):
        work[E1, n] = exponential(work[E1, n] - top)
    for k in range(LANES):
        total = 0.0
        for part in range(PARTS):
            total += work[E1, part * LANES + k]
        lanes[PLAIN_SUM, k] = total
    return top


@whole
def add_means(work: Array, lanes: Array) -> None:
    """Sums of squared weights, and of weight times cos(yaw), sin(yaw) and the offset, by lane."""
    for k in range(LANES):
        squares = cosines = sines = offsets = 0.0
        for part in range(PARTS):
            n = part * LANES + k
            w = work[WEIGHT, n]
            squares += w * w
            cosines += w * work[C, n]
            sines += w * work[S, n]
            offsets += w * work[MEAN, n]
        lanes[SQUARES, k], lanes[COS, k], lanes[SIN, k] = squares, cosines, sines
        lanes[OFFSET, k] = offsets


@whole
def weigh(
    work: Array, p: Array, mean: Array, g: Array, kappa: float, few: bool, sampled: bool, lanes: Array
) -> tuple[float, float]:
    """Weigh by the reading and update the linear states; returns the greatest log weights.

    These are that with kappa, and that without it, which `add_plain` gives only if kappa is not 1.
    """
    if not sampled:
        add_variance(work, few)
    add_surprise(work, lanes)
    for n in range(BLOCK):
        log_s = logarithm(work[BIG_S, n])
        work[BIG_S, n] = 1 / work[BIG_S, n]
        work[LIKE, n] = -0.5 * (work[MISFIT, n] * work[MISFIT, n] * work[BIG_S, n] + log_s)
    if not sampled:
        if few:
            update_two(p, mean, g, work[MISFIT], work[BIG_S])
        else:
            update_five(p, mean, g, work[MISFIT], work[BIG_S])
    plain_top = add_plain(work, lanes) if kappa != 1 else 0.0
    for n in range(BLOCK):
        work[LOG_WEIGHT, n] += work[LIKE, n] / kappa
    return greatest(work[LOG_WEIGHT], lanes[TOP]), plain_top


@whole
def linear_places(
    kinds: NDArray[np.int64], decay: Array, noise: Array, decays: Array, added: Array, both: Array
) -> NDArray[np.int64]:
    """Rows in `work` of the rows of the state; decay and noise of all linear states."""
    size = decay.shape[0]
    places = np.arange(LINEAR + size + size * (size + 1) // 2)
    row = LINEAR + size
    for k in range(size):
        places[LINEAR + k] = MEAN + kinds[k]
        decays[kinds[k]], added[kinds[k]] = decay[k], noise[k]
        for i in range(k + 1):
            places[row] = COVARIANCE + kinds[k] * (kinds[k] + 1) // 2 + kinds[i]
            row += 1
    for k in range(STATES):
        for i in range(k + 1):
            both[k * (k + 1) // 2 + i] = decays[k] * decays[i]
    return places


_IN, _OUT = types.Array(types.float64, 1, "C", readonly=True), types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
_KINDS = types.Array(types.int64, 1, "C", readonly=True)
_STEP = types.NamedUniTuple(types.float64, len(Step._fields), Step)


@compiled(
    types.int64, types.int64, types.int64, _TABLE, _KINDS, _TABLE, _TABLE, _IN, _IN, _STEP, _IN, _IN, _KINDS,
    types.uint64, types.boolean,
)  # fmt: skip
def step(
    first: int, last: int, count: int, before: Array, chosen: NDArray[np.int64], state: Array, sums: Array,
    table: Array, variance: Array, numbers: Step, decay: Array, noise: Array, kinds: NDArray[np.int64],
    key: np.uint64, sampled: bool,
) -> None:  # fmt: skip
    """Move the particles of some blocks, weigh them by a reading, and sum over each block.

    Args:
        first: First block.
        last: Block after the last.
        count: Number of particles.
        before: Particles before the step, one per column.
        chosen: After resampling, the column in `before` of each particle, which all weigh the same; else of
            length 0.
        state: Takes the particles, at least `count` columns. Without `chosen` it may be `before`.
        sums: Takes the sums of each block, shape (blocks, 20).
        table: Table of the map's field.
        variance: Variance of the nodes, laid out as the values of the table; of length 0 if it has none.
        numbers: Numbers of the step.
        decay: Factor of each linear state, shape (n,).
        noise: Variance added to each, shape (n,).
        kinds: CONSTANT, ... for each in ascending order, shape (n,).
        key: Key of this step's random numbers.
        sampled: The linear states are not filtered but sampled: their noise is drawn, and P stays 0.
    """
    # Rows are wider than a block: rows a power of two apart would compete for the same cache lines
    work, lanes = np.empty((SLOPE + 1, BLOCK + 8)), np.empty((PLAIN_SUM + 1, LANES + 8))
    work[MEAN:C] = 0.0
    q, node = np.empty(2 * BLOCK), np.empty(BLOCK, np.int64)
    decays, added, both = np.ones(STATES), np.zeros(STATES), np.ones(_TRIANGLE)
    places = linear_places(kinds, decay, noise, decays, added, both)
    few = kinds.shape[0] == 0 or kinds[kinds.shape[0] - 1] < 2
    begin, end, in_row, in_layer = planes(table)
    row, up = np.uint64(in_row), np.uint64(in_layer)
    field = Table(table, table[begin:end], table[end:], variance, in_layer, row, up)
    used, tempered = numbers.used > 0, numbers.used > 0 and numbers.kappa != 1
    x, y, yaw, weight = work[X], work[Y], work[YAW], work[WEIGHT]
    p, mean, g = work[COVARIANCE:GAIN], work[MEAN:COVARIANCE], work[GAIN:C]
    c, s, sd, log_w, top_lane = work[C], work[S], work[SD], work[LOG_WEIGHT], lanes[TOP]
    for block in range(first, last):
        start = block * BLOCK
        m = min(start + BLOCK, count) - start
        fetch(before, chosen, start, m, count, work, places)
        lanes[:] = 0.0
        move(work, numbers, key, start)
        for k in range(2 if few else STATES):
            mean_k, a = mean[k], decays[k]
            for n in range(BLOCK):
                mean_k[n] *= a
        if sampled:
            draw_errors(work, noise, kinds, key, start)
        if used:
            look_up(work, numbers, field, q, node, few)
        if not sampled:
            if few:
                predict_two(p, g, both, added)
            else:
                predict_five(p, g, both, added, c, s, sd)
        if used:
            top, plain_top = weigh(work, p, mean, g, numbers.kappa, few, sampled, lanes)
        else:
            top, plain_top = greatest(log_w, top_lane), 0.0
        for n in range(BLOCK):
            work[WEIGHT, n] = exponential(work[LOG_WEIGHT, n] - top)
        x_ref, y_ref, yaw_ref = numbers.x_ref, numbers.y_ref, numbers.yaw_ref
        add_moments(weight, x, y, yaw, x_ref, y_ref, yaw_ref, lanes)
        add_means(work, lanes)
        add_up(lanes, sums[block])
        sums[block, TOP] = top
        sums[block, PLAIN_TOP] = plain_top if tempered else top
        if not tempered:
            sums[block, PLAIN_SUM] = sums[block, SUM]
        for k in range(places.shape[0]):
            to, source = state[k, start : start + m], work[places[k]]
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
