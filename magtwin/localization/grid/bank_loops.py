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
