"""Compiled loops of the bank of Kalman filters, which `bank.LOOPS` opens; `state` explains their arrays."""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps.trilinear import at_with_gradient, sd_at
from magtwin.localization.elementary import whole
from magtwin.localization.grid.loops import (
    IN,
    KNOWN,
    OUT,
    log_likelihood_of,
    nearest_turn,
    normalise,
)
from magtwin.localization.grid.state import WHITE_SHARE, Known, Motion, Sums

Array = NDArray[np.float64]

_MOTION = types.NamedUniTuple(types.float64, len(Motion._fields), Motion)

inlined(at_with_gradient)

MOST_BANK = 9
"""x, y, yaw, scale, offset, drift, map error, and the two iron coefficients."""


@whole
def _predict(m: Array, p: Array, motion: Motion, decay: Array, added: Array) -> None:
    """Move a filter: its mean m and its covariance p by rows."""
    n = m.shape[0]
    middle = m[2] + motion.turn / 2
    c, s = math.cos(middle), math.sin(middle)
    dx, dy = motion.forward * c - motion.left * s, motion.forward * s + motion.left * c
    stretch = 1 + m[3]
    m[0] += stretch * dx
    m[1] += stretch * dy
    m[2] += motion.turn
    for b in range(n):  # rows, then columns, of F P F'
        p[b] += -stretch * dy * p[2 * n + b] + dx * p[3 * n + b]
        p[n + b] += stretch * dx * p[2 * n + b] + dy * p[3 * n + b]
    for b in range(n):
        p[b * n] += -stretch * dy * p[b * n + 2] + dx * p[b * n + 3]
        p[b * n + 1] += stretch * dx * p[b * n + 2] + dy * p[b * n + 3]
    for a in range(4, n):
        if decay[a - 4] != 1.0:
            m[a] *= decay[a - 4]
            for b in range(n):
                p[a * n + b] *= decay[a - 4]
            for b in range(n):
                p[b * n + a] *= decay[a - 4]
        p[a * n + a] += added[a - 4]
    p[0] += motion.place_variance
    p[n + 1] += motion.place_variance
    p[2 * n + 2] += motion.yaw_variance


@whole
def _expected(table: Array, spreads: Array, known: Known, m: Array, h: Array) -> tuple[float, float, bool]:
    """Field at the mean of a filter, variance of a reading's white part, whether the map is known, and h."""
    x, y, yaw = m[0], m[1], m[2]
    c, s = math.cos(yaw), math.sin(yaw)
    px, py = x + c * known.arm_x - s * known.arm_y, y + s * known.arm_x + c * known.arm_y
    field, gx, gy, gh = at_with_gradient(table, px, py, yaw, False)
    slopes = gx + gy + gh
    seen = field == field and slopes == slopes
    noise = known.white
    if not seen:
        field, gx, gy, gh = known.wide_mean, 0.0, 0.0, 0.0
        noise = known.white + known.wide_variance
    h[0], h[1] = gx, gy
    h[2] = gh + gy * (c * known.arm_x - s * known.arm_y) - gx * (s * known.arm_x + c * known.arm_y)
    if known.iron > 0:
        iron = 7 if known.mapped > 0 else 6
        h[iron], h[iron + 1] = c, s
        h[2] += c * m[iron + 1] - s * m[iron]
    if known.mapped > 0:
        sd = 0.0
        if seen:
            sd = sd_at(table, spreads, px, py, yaw, False)
            sd = sd if sd == sd else 0.0
        noise += WHITE_SHARE * sd * sd
        h[6] = math.sqrt(1 - WHITE_SHARE) * sd
    return field, noise, seen


@whole
def _innovation_of(m: Array, p: Array, h: Array, ph: Array, away: float, noise: float) -> tuple[float, float]:
    """Nu and S of a filter from the reading less the field, and P h'."""
    n = m.shape[0]
    for a in range(4, n):
        away -= h[a] * m[a]
    for a in range(n):
        ph[a] = 0.0
        for b in range(n):
            ph[a] += p[a * n + b] * h[b]
    for a in range(n):
        noise += h[a] * ph[a]
    return away, noise


@whole
def _summed(logw: Array, state: Array, known: Known, n: int, evidence: float) -> Sums:
    """Sums over the filters, with their covariances."""
    size = n + n * n
    count, best, top = 0, 0, -np.inf
    mass = sx = sy = sa = xx = xy = xa = yy = ya = aa = offset = 0.0
    for k in range(logw.shape[0]):
        if logw[k] == -np.inf:
            continue
        if logw[k] > top:
            top, best = logw[k], k
        w = math.exp(logw[k])
        m = state[k * size : k * size + n]
        p = state[k * size + n : (k + 1) * size]
        dx, dy, a = m[0] - known.x_ref, m[1] - known.y_ref, nearest_turn(m[2] - known.yaw_ref)
        count += 1
        mass += w
        sx += w * dx
        sy += w * dy
        sa += w * a
        xx += w * (dx * dx + p[0])
        xy += w * (dx * dy + p[1])
        xa += w * (dx * a + p[2])
        yy += w * (dy * dy + p[n + 1])
        ya += w * (dy * a + p[n + 2])
        aa += w * (a * a + p[2 * n + 2])
        offset += w * m[4]
    return Sums(evidence, count, best, mass, sx, sy, sa, xx, xy, xa, yy, ya, aa, offset)


@compiled(IN, IN, OUT, OUT, KNOWN, _MOTION, IN, IN)
def update_bank(
    table: Array,
    spreads: Array,
    logw: Array,
    state: Array,
    known: Known,
    motion: Motion,
    decay: Array,
    added: Array,
) -> Sums:
    """One step of a bank of extended Kalman filters: predict, use one reading, weigh, normalise, sum up.

    Args:
        table: Table of the field.
        spreads: Table of its variance.
        logw: Log mass of the filters.
        state: Their means and covariances.
        known: The reading.
        motion: The motion before it.
        decay: Factor of each linear state, shape (n - 4,).
        added: Variance that is added to each, shape (n - 4,).
    """
    n = 4 + decay.shape[0]
    size = n + n * n
    read = known.z == known.z
    most, evidence = -np.inf, 0.0
    h_row, ph = np.zeros(MOST_BANK), np.zeros(MOST_BANK)
    h_row[4] = h_row[5] = 1.0
    for k in range(logw.shape[0]):
        m = state[k * size : k * size + n]
        p = state[k * size + n : (k + 1) * size]
        _predict(m, p, motion, decay, added)
        if read:
            x, y = m[0], m[1]
            field, noise, seen = _expected(table, spreads, known, m, h_row)
            nu, variance = _innovation_of(m, p, h_row, ph, known.z - field, noise)
            like = log_likelihood_of(known, nu, variance, x, y)
            evidence += math.exp(max(logw[k] + like, -700.0))
            logw[k] += known.power * like
            if seen:
                for a in range(n):
                    gain = ph[a] / variance
                    m[a] += gain * nu
                    for b in range(n):
                        p[a * n + b] -= gain * ph[b]
        most = max(most, logw[k])
    evidence = math.log(evidence) if evidence > 0 else -700.0
    normalise(logw, most)
    return _summed(logw, state, known, n, evidence)


@compiled(IN, IN, IN, IN, IN, OUT, OUT)
def splat(
    weights: Array, means: Array, inverses: Array, linear: Array, poses: Array, logw: Array, state: Array
) -> None:
    """Evaluate a Gaussian mixture at the nodes of a grid, with the linear states given the pose.

    Args:
        weights: Logarithm of weight over the root of the covariance's determinant, shape (K,).
        means: x, y and yaw, shape (3 K,).
        inverses: Inverse covariances of the pose, shape (9 K,).
        linear: Per component, mean of the n linear states, their slopes by pose (n, 3), and the upper
            triangle of their covariance given the pose, shape (K (4 n + n (n + 1) / 2),).
        poses: x, y and yaw of the nodes, shape (3 N,).
        logw: Output, shape (N,).
        state: Output, shape (N (n + n (n + 1) / 2),).
    """
    count = weights.shape[0]
    size = state.shape[0] // logw.shape[0]
    n = 1
    while n + n * (n + 1) // 2 < size:
        n += 1
    width = linear.shape[0] // count
    total, each, values, shares = np.empty(size), np.empty(n), np.empty(count), np.empty(count)
    for k in range(logw.shape[0]):
        most = -np.inf
        for g in range(count):
            d0, d1, d2 = (
                poses[3 * k] - means[3 * g],
                poses[3 * k + 1] - means[3 * g + 1],
                poses[3 * k + 2] - means[3 * g + 2],
            )
            d2 -= 2 * math.pi * math.floor(d2 / (2 * math.pi) + 0.5)
            i = inverses[9 * g : 9 * g + 9]
            square = i[0] * d0 * d0 + i[4] * d1 * d1 + i[8] * d2 * d2
            square += 2 * (i[1] * d0 * d1 + i[2] * d0 * d2 + i[5] * d1 * d2)
            values[g] = weights[g] - 0.5 * square
            most = max(most, values[g])
        mass = 0.0
        for g in range(count):
            shares[g] = math.exp(values[g] - most)
            mass += shares[g]
        logw[k] = most + math.log(mass)
        total[:] = 0.0
        for second in range(2):  # means first, then covariances about them
            for g in range(count):
                share = shares[g] / mass
                if share < 1e-6:
                    continue
                o = g * width
                p = n
                for a in range(n):
                    slope = linear[o + n + 3 * a : o + n + 3 * a + 3]
                    turn = poses[3 * k + 2] - means[3 * g + 2]
                    turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
                    each[a] = (
                        linear[o + a]
                        + slope[0] * (poses[3 * k] - means[3 * g])
                        + slope[1] * (poses[3 * k + 1] - means[3 * g + 1])
                        + slope[2] * turn
                    )
                    if second == 0:
                        total[a] += share * each[a]
                if second == 0:
                    continue
                for a in range(n):
                    for b in range(a, n):
                        spread = (each[a] - total[a]) * (each[b] - total[b])
                        total[p] += share * (linear[o + 4 * n + p - n] + spread)
                        p += 1
        for a in range(size):
            state[k * size + a] = total[a]
