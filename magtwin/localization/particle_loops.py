"""Compiled loops of the particle filters: one step of a range of blocks of particles, and resampling.

Importing this module opens numba (see `magtwin.compiled`). Random numbers are a function of a key, the number
of the particle and the number of the draw, and sums are taken block by block, so that any number of threads
gives the same bytes. Logarithms, exponentials, sines and cosines are polynomials here, which the compiler
turns into vector code; their errors are below 1e-13.
"""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps.loops import blends, climb, place
from magtwin.field.maps.trilinear import planes

Array = NDArray[np.float64]
Words = NDArray[np.uint64]

BLOCK = 256
"""Particles worked on at a time: their states and factors stay in the cache."""

X, Y, YAW, SCALE, LOG_WEIGHT, LIKELIHOOD, WEIGHT, LINEAR = range(8)
"""Rows of the state: pose, mean of the odometry's scale error, log weight, log likelihood of the last
reading, weight relative to its block; then the means of the linear states, and their covariance by rows of
its lower triangle."""

CONSTANT, COSINE, SINE, MAP_SD = range(4)
"""Factors by which a linear state enters the reading: 1, cos(yaw), sin(yaw), the map's standard deviation."""

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

GOLDEN, MIX_1, MIX_2 = (np.uint64(k) for k in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_S20, _S27, _S30, _S31, _S32, _S52 = (np.uint64(k) for k in (20, 27, 30, 31, 32, 52))
_LOW = np.uint64(0xFFFFFFFF)
_MANTISSA, _ONE_BITS, _WHOLE_BITS = (
    np.uint64(k) for k in (0x000FFFFFFFFFFFFF, 0x3FF0000000000000, 0x4330000000000000)
)
_WHOLE = 2.0**52  # The float of _WHOLE_BITS: an integer in its lowest bits is the float plus that integer
_LN2, _SQRT2, _TURN = math.log(2), math.sqrt(2), 2 * math.pi

_SIN = tuple((-1) ** k * _TURN ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(10))
_EXP = tuple(1 / math.factorial(k) for k in range(13))


@inlined
def mix(z: np.uint64) -> np.uint64:
    """A hash of 64 bits (the finalizer of splitmix64: Steele, Lea and Flood 2014)."""
    z = (z ^ (z >> _S30)) * MIX_1
    z = (z ^ (z >> _S27)) * MIX_2
    return z ^ (z >> _S31)


@inlined
def sine_of_turns(u: float) -> float:
    """sin(2 pi u) for u in [-1/4, 1/4]."""
    z = u * u
    (c0, c1, c2, c3, c4, c5, c6, c7, c8, c9) = _SIN
    p = c5 + z * (c6 + z * (c7 + z * (c8 + z * c9)))
    return u * (c0 + z * (c1 + z * (c2 + z * (c3 + z * (c4 + z * p)))))


@inlined
def logarithms(x: Array, bits: Words, exponent: Words, mantissa: Words, e: Array, m: Array) -> None:
    """Replace x by log(x), for x > 0 and not subnormal.

    `bits` are those of x; `e` and `m` share memory with `exponent` and `mantissa`.
    """
    for n in range(x.shape[0]):
        exponent[n] = (bits[n] >> _S52) | _WHOLE_BITS
        mantissa[n] = (bits[n] & _MANTISSA) | _ONE_BITS
    for n in range(x.shape[0]):
        big = m[n] > _SQRT2
        v = 0.5 * m[n] if big else m[n]
        k = e[n] - (_WHOLE + 1022 if big else _WHOLE + 1023)
        t = (v - 1) / (v + 1)
        z = t * t
        p = 1 / 9 + z * (1 / 11 + z * (1 / 13 + z * (1 / 15 + z / 17)))
        x[n] = k * _LN2 + 2 * t * (1 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * p))))


@inlined
def exponentials(x: Array, whole: Array, bits: Words, out: Array) -> None:
    """exp(x) for x <= 0, 0 below -700, in `out`; `bits` shares memory with `whole`."""
    (c0, c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, c11, c12) = _EXP
    for n in range(x.shape[0]):
        v = max(x[n], -700.0)
        k = np.floor(v / _LN2 + 0.5)
        r = v - k * _LN2
        p = c6 + r * (c7 + r * (c8 + r * (c9 + r * (c10 + r * (c11 + r * c12)))))
        p = c0 + r * (c1 + r * (c2 + r * (c3 + r * (c4 + r * (c5 + r * p)))))
        out[n] = p if x[n] > -700 else 0.0
        whole[n] = k + (_WHOLE + 1023)
    for n in range(x.shape[0]):
        bits[n] <<= _S52
    for n in range(x.shape[0]):
        out[n] *= whole[n]


@inlined
def normals(
    key: np.uint64, first: int, draw: int, a: Array, b: Array, w: Words, v: Words, e: Words,
    wf: Array, vf: Array, ef: Array, bits: Words,
) -> None:  # fmt: skip
    """Two standard normal numbers per particle in `a` and `b` (Box and Muller 1958).

    The first particle has the number `first`; `draw` counts the pairs of a particle. `bits` shares memory
    with `a`; the others are memory to work in, as integers and as floats.
    """
    start = key + mix(np.uint64(draw) * GOLDEN)
    for n in range(a.shape[0]):
        z = mix(start + (np.uint64(first) + np.uint64(n)) * GOLDEN)
        w[n] = ((z >> _S32) << _S20) | _ONE_BITS
        v[n] = ((z & _LOW) << _S20) | _ONE_BITS
    for n in range(a.shape[0]):
        a[n] = 2 - wf[n]
        b[n] = vf[n] - 1.5
    logarithms(a, bits, w, e, wf, ef)
    for n in range(a.shape[0]):
        radius, turn = math.sqrt(-2 * a[n]), b[n]
        far = abs(turn) > 0.25
        other = (0.5 if turn > 0 else -0.5) - turn
        a[n] = radius * sine_of_turns(0.25 - abs(turn))
        b[n] = radius * sine_of_turns(other if far else turn)


@inlined
def cosines_sines(yaw: Array, c: Array, s: Array) -> None:
    """cos(yaw) and sin(yaw)."""
    for n in range(yaw.shape[0]):
        u = yaw[n] / _TURN
        u -= np.floor(u + 0.5)
        other = (0.5 if u > 0 else -0.5) - u
        c[n] = sine_of_turns(0.25 - abs(u))
        s[n] = sine_of_turns(other if abs(u) > 0.25 else u)


@inlined
def add_moments(
    weight: Array, x: Array, y: Array, yaw: Array, x_ref: float, y_ref: float, yaw_ref: float, out: Array
) -> None:
    """Sums of the weights, and of weight times the offsets from a pose and their products."""
    total = sx = sy = sa = xx = xy = xa = yy = ya = aa = 0.0
    for n in range(weight.shape[0]):
        w, dx, dy, turns = weight[n], x[n] - x_ref, y[n] - y_ref, (yaw[n] - yaw_ref) / _TURN
        a = (turns - np.floor(turns + 0.5)) * _TURN
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
    out[SUM] += total
    out[SUM_X] += sx
    out[SUM_Y] += sy
    out[SUM_YAW] += sa
    out[XX] += xx
    out[XY] += xy
    out[X_YAW] += xa
    out[YY] += yy
    out[Y_YAW] += ya
    out[YAW_YAW] += aa


_IN, _OUT = types.Array(types.float64, 1, "C", readonly=True), types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
_KINDS = types.Array(types.int64, 1, "C", readonly=True)


@compiled(
    types.int64, types.int64, types.int64, _TABLE, _TABLE, _IN, _IN, _IN, _IN, _IN, _KINDS, types.uint64,
    types.boolean,
)  # fmt: skip
def step(
    first: int, last: int, count: int, state: Array, sums: Array, table: Array, variance: Array,
    numbers: Array, decay: Array, noise: Array, kinds: NDArray[np.int64], key: np.uint64, sampled: bool,
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
        state: Particles, one per column, with the rows X, Y, ... and at least `count` columns.
        sums: Takes the sums of each block, shape (blocks, 20).
        table: Table of the map's field; see `magtwin.field.maps.trilinear`.
        variance: Variance of the nodes, laid out as the values of the table; of length 0 if it has none.
        numbers: The numbers DISTANCE, ... of the step. USED is 0 if there is no reading. SHIFT is subtracted
            from the log weights, so that the weights before this step add up to 1.
        decay: Factor of each linear state, shape (n,).
        noise: Variance added to each, shape (n,).
        kinds: CONSTANT, COSINE, SINE or MAP_SD for each, shape (n,).
        key: Key of this step's random numbers.
        sampled: The linear states are not filtered but sampled: their noise is drawn, and P stays 0.
    """
    size = decay.shape[0]
    arrays = np.empty((18, BLOCK))
    words = np.empty((4, BLOCK), np.uint64)
    factor, gain = np.ones((max(size, 1), BLOCK)), np.empty((max(size, 1), BLOCK))
    q, nodes_at = np.empty(2 * BLOCK), np.empty(BLOCK, np.int64)
    slopes = np.empty(BLOCK)
    floats = words.view(np.float64)
    bit_rows = arrays.view(np.uint64)
    begin, end, in_row, in_layer = planes(table)
    values, masks = table[begin:end], table[end:]
    row, up, edge = np.uint64(in_row), np.uint64(in_layer), table[5]
    used, kappa = numbers[USED] > 0, numbers[KAPPA]
    triangle = LINEAR + size
    distance, turned, shift = numbers[DISTANCE], numbers[TURNED], numbers[SHIFT]
    half = turned / 2 + numbers[DIRECTION]
    along_sd, across_sd, yaw_sd = numbers[ALONG_SD], numbers[ACROSS_SD], numbers[YAW_SD]
    scale_gain, arm_x, arm_y = numbers[SCALE_GAIN], numbers[ARM_X], numbers[ARM_Y]
    field, white, map_white = numbers[FIELD], numbers[WHITE], numbers[MAP_WHITE]
    elsewhere, elsewhere_variance = numbers[ELSEWHERE], numbers[ELSEWHERE_VARIANCE]
    x_ref, y_ref, yaw_ref = numbers[X_REF], numbers[Y_REF], numbers[YAW_REF]
    for block in range(first, last):
        start = block * BLOCK
        stop = min(start + BLOCK, count)
        m = stop - start
        w0, w1, w2 = words[0, :m], words[1, :m], words[2, :m]
        f0, f1, f2 = floats[0, :m], floats[1, :m], floats[2, :m]
        e1, e2, e3, e4 = arrays[0, :m], arrays[1, :m], arrays[2, :m], arrays[3, :m]
        c, s, b, v, hole = arrays[4, :m], arrays[5, :m], arrays[6, :m], arrays[7, :m], arrays[8, :m]
        big_s, nu, log_s = arrays[9, :m], arrays[10, :m], arrays[11, :m]
        wx, wy, wh, slope, node = arrays[12, :m], arrays[13, :m], arrays[14, :m], slopes[:m], nodes_at[:m]
        x, y, yaw, scale = (
            state[X, start:stop],
            state[Y, start:stop],
            state[YAW, start:stop],
            state[SCALE, start:stop],
        )
        log_w, like, weight = (
            state[LOG_WEIGHT, start:stop],
            state[LIKELIHOOD, start:stop],
            state[WEIGHT, start:stop],
        )

        normals(key, start, 0, e1, e2, w0, w1, w2, f0, f1, f2, bit_rows[0, :m])
        normals(key, start, 1, e3, e4, w0, w1, w2, f0, f1, f2, bit_rows[2, :m])
        for n in range(m):
            e4[n] = yaw[n] + half
        cosines_sines(e4, c, s)
        for n in range(m):
            e1[n] *= along_sd
            e2[n] *= across_sd
            e4[n] = distance * (1 + scale[n]) + e1[n]
        for n in range(m):
            x[n] += e4[n] * c[n] - e2[n] * s[n]
        for n in range(m):
            y[n] += e4[n] * s[n] + e2[n] * c[n]
        for n in range(m):
            yaw[n] += turned + yaw_sd * e3[n]
            scale[n] += scale_gain * e1[n]
        for n in range(m):
            log_w[n] -= shift
        cosines_sines(yaw, c, s)
        for k in range(size):
            mean, a = state[LINEAR + k, start:stop], decay[k]
            for n in range(m):
                mean[n] *= a
            if sampled and noise[k] > 0:
                normals(key, start, 2 + k, e1, e2, w0, w1, w2, f0, f1, f2, bit_rows[0, :m])
                sd = math.sqrt(noise[k])
                for n in range(m):
                    mean[n] += sd * e1[n]

        if used:
            for n in range(m):
                q[2 * n] = x[n] + arm_x * c[n] - arm_y * s[n]
                q[2 * n + 1] = y[n] + arm_x * s[n] + arm_y * c[n]
            place(table, q[: 2 * m], yaw, False, wx, wy, wh, node)
            climb(table, in_layer, wh, slope, node)
            blends(values, row, up, node, wx, wy, wh, b)
            if masks.shape[0] > 0:
                blends(masks, row, up, node, wx, wy, wh, hole)
                for n in range(m):
                    b[n] = np.nan if hole[n] > edge else b[n]
            if variance.shape[0] > 0:
                blends(variance, row, up, node, wx, wy, wh, v)
            else:
                for n in range(m):
                    v[n] = 0.0
            for n in range(m):
                known = b[n] == b[n]
                big_s[n] = white + (map_white * v[n] if known else elsewhere_variance)
                nu[n] = field - (b[n] if known else elsewhere)
            for n in range(m):
                v[n] = v[n] if b[n] == b[n] else 0.0
            for k in range(size):
                h, mean = factor[k, :m], state[LINEAR + k, start:stop]
                if kinds[k] == COSINE:
                    for n in range(m):
                        h[n] = c[n]
                elif kinds[k] == SINE:
                    for n in range(m):
                        h[n] = s[n]
                elif kinds[k] == MAP_SD:
                    for n in range(m):
                        h[n] = math.sqrt(v[n])
                for n in range(m):
                    nu[n] -= h[n] * mean[n]
        if not sampled:
            for k in range(size):
                g, h = gain[k, :m], factor[k, :m]
                for n in range(m):
                    g[n] = 0.0
                for i in range(k + 1):
                    p, both = state[triangle + k * (k + 1) // 2 + i, start:stop], decay[k] * decay[i]
                    gi, hi = gain[i, :m], factor[i, :m]
                    added = noise[k] if i == k else 0.0
                    if both != 1 or added != 0:
                        for n in range(m):
                            p[n] = p[n] * both + added
                    for n in range(m):
                        g[n] += p[n] * hi[n]
                    if i < k:
                        for n in range(m):
                            gi[n] += p[n] * h[n]
        prior_nu = prior_nu_nu = prior_s = 0.0
        if used:
            if not sampled:
                for k in range(size):
                    g, h = gain[k, :m], factor[k, :m]
                    for n in range(m):
                        big_s[n] += g[n] * h[n]
            for n in range(m):
                prior_nu += weight[n] * nu[n]
                prior_nu_nu += weight[n] * nu[n] * nu[n]
                prior_s += weight[n] * big_s[n]
            for n in range(m):
                log_s[n] = big_s[n]
            for n in range(m):
                big_s[n] = 1 / big_s[n]
            logarithms(log_s, bit_rows[11, :m], w0, w1, f0, f1)
            for n in range(m):
                like[n] = -0.5 * (nu[n] * nu[n] * big_s[n] + log_s[n])
            for n in range(m):
                nu[n] *= big_s[n]
            if not sampled:
                for k in range(size):
                    g, mean = gain[k, :m], state[LINEAR + k, start:stop]
                    for n in range(m):
                        mean[n] += g[n] * nu[n]
                    for i in range(k + 1):
                        p, gi = state[triangle + k * (k + 1) // 2 + i, start:stop], gain[i, :m]
                        for n in range(m):
                            p[n] -= g[n] * gi[n] * big_s[n]
        else:
            for n in range(m):
                like[n] = 0.0

        out = sums[block]
        out[:] = 0.0
        out[NU], out[NU_NU], out[PRIOR_S] = prior_nu, prior_nu_nu, prior_s
        top = -np.inf
        for n in range(m):
            top = max(top, log_w[n] + like[n])
        if used and kappa != 1:
            out[PLAIN_TOP] = top
            for n in range(m):
                e1[n] = log_w[n] + like[n] - top
            exponentials(e1, f0, w0, e2)
            for n in range(m):
                out[PLAIN_SUM] += e2[n]
            top = -np.inf
            for n in range(m):
                log_w[n] += like[n] / kappa
                top = max(top, log_w[n])
        else:
            for n in range(m):
                log_w[n] += like[n]
        out[TOP] = top
        for n in range(m):
            e1[n] = log_w[n] - top
        exponentials(e1, f0, w0, weight)
        add_moments(weight, x, y, yaw, x_ref, y_ref, yaw_ref, out)
        squares = cos = sin = offset = 0.0
        for n in range(m):
            squares += weight[n] * weight[n]
            cos += weight[n] * c[n]
            sin += weight[n] * s[n]
        if size > 0:
            first_mean = state[LINEAR, start:stop]
            for n in range(m):
                offset += weight[n] * first_mean[n]
        out[SQUARES], out[COS], out[SIN], out[OFFSET] = squares, cos, sin, offset
        if kappa == 1 or not used:
            out[PLAIN_TOP], out[PLAIN_SUM] = out[TOP], out[SUM]


@compiled(types.int64, _TABLE, _IN, types.float64, types.float64, types.float64, _OUT)
def moments(
    count: int, state: Array, scales: Array, x_ref: float, y_ref: float, yaw_ref: float, out: Array
) -> None:
    """Sums SUM to YAW_YAW over all particles about another pose; `scales` are factors of blocks' weights."""
    out[:] = 0.0
    part = np.empty_like(out)
    for block in range(scales.shape[0]):
        start, stop = block * BLOCK, min((block + 1) * BLOCK, count)
        part[:] = 0.0
        add_moments(
            state[WEIGHT, start:stop], state[X, start:stop], state[Y, start:stop], state[YAW, start:stop],
            x_ref, y_ref, yaw_ref, part,
        )  # fmt: skip
        for k in range(out.shape[0]):
            out[k] += scales[block] * part[k]


_PLACES = types.Array(types.int64, 1, "C")


@compiled(types.int64, _TABLE, _IN, types.float64, _PLACES)
def choose(count: int, state: Array, scales: Array, start: float, chosen: NDArray[np.int64]) -> None:
    """Systematic resampling (Kitagawa 1996): the particles at weights (start + k) / K of their sum.

    Args:
        count: Number of particles.
        state: Particles, whose row WEIGHT is used.
        scales: Factor of the weights of each block, such that their sum is about 1.
        start: A number in [0, 1).
        chosen: Takes the numbers of the K chosen particles.
    """
    total = 0.0
    for n in range(count):
        total += state[WEIGHT, n] * scales[n // BLOCK]
    most = chosen.shape[0]
    done, below = 0, 0.0
    for n in range(count):
        below += state[WEIGHT, n] * scales[n // BLOCK]
        limit = below / total * most - start
        while done < most and done < limit:
            chosen[done] = n
            done += 1
    while done < most:
        chosen[done] = count - 1
        done += 1


@compiled(types.int64, types.int64, _TABLE, types.Array(types.int64, 1, "C", readonly=True), _TABLE)
def gather(first: int, last: int, state: Array, chosen: NDArray[np.int64], out: Array) -> None:
    """Copy the particles chosen[first:last] of `state` to their places in `out`, with equal weights."""
    weight = -math.log(chosen.shape[0])
    for row in range(state.shape[0]):
        if row == LOG_WEIGHT:
            out[row, first:last] = weight
        elif row == WEIGHT:
            out[row, first:last] = 1.0
        elif row != LIKELIHOOD:
            for n in range(first, last):
                out[row, n] = state[row, chosen[n]]
