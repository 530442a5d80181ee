"""Compiled loops of the bank of Kalman filters, which `bank.LOOPS` opens."""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined
from magtwin.field.maps import loops  # noqa: F401 -- marks the formulas of `trilinear` as inlined
from magtwin.field.maps.trilinear import at_with_gradient, sd_at

Array = NDArray[np.float64]

_IN = types.Array(types.float64, 1, "C", readonly=True)
_OUT = types.Array(types.float64, 1, "C")

for _part in (at_with_gradient, sd_at):
    inlined(_part)

MOST_BANK = 9
"""x, y, yaw, scale, offset, drift, map error, and the two iron coefficients."""


@compiled(_IN, _IN, _OUT, _OUT, _IN, _OUT)
def update_bank(
    table: Array, spreads: Array, logw: Array, state: Array, numbers: Array, stats: Array
) -> None:
    """One step of a bank of extended Kalman filters: predict, use one reading, weigh, normalise, sum up.

    A filter has the mean and the full covariance of x, y, yaw, scale, offset, drift, then the map state and
    the iron states if there are any; `state` has them one after the other, shape (N (n + n n),).

    `numbers`: as for `loops.update`, but before decay and noise come forward, left and turn of the
    motion and its variances of x, y and yaw. `stats` has the sums of `loops.update`, over the filters.
    """
    z, lx, ly, white, share, power = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    mapped, iron = numbers[6] > 0, numbers[7] > 0
    wide_mean, wide_variance = numbers[8], numbers[9]
    x0, x1, y0, y1 = numbers[10], numbers[11], numbers[12], numbers[13]
    penalty, cut = numbers[14], numbers[15]
    x_ref, y_ref, yaw_ref = numbers[16], numbers[17], numbers[18]
    forward, left, turn = numbers[19], numbers[20], numbers[21]
    q_place, q_yaw = numbers[22], numbers[24]
    n = 6 + (1 if mapped else 0) + (2 if iron else 0)
    size = n + n * n
    decay, added = numbers[25 : 25 + n], numbers[25 + n : 25 + 2 * n]
    read = z == z
    most, evidence = -np.inf, 0.0
    h_row, ph = np.zeros(MOST_BANK), np.zeros(MOST_BANK)
    h_row[4] = h_row[5] = 1.0
    first_iron = 7 if mapped else 6
    for k in range(logw.shape[0]):
        m = state[k * size : k * size + n]
        p = state[k * size + n : (k + 1) * size]
        middle = m[2] + turn / 2
        c, s = math.cos(middle), math.sin(middle)
        dx, dy = forward * c - left * s, forward * s + left * c
        stretch = 1 + m[3]
        m[0] += stretch * dx
        m[1] += stretch * dy
        m[2] += turn
        for b in range(n):  # rows, then columns, of F P F'
            p[b] += -stretch * dy * p[2 * n + b] + dx * p[3 * n + b]
            p[n + b] += stretch * dx * p[2 * n + b] + dy * p[3 * n + b]
        for b in range(n):
            p[b * n] += -stretch * dy * p[b * n + 2] + dx * p[b * n + 3]
            p[b * n + 1] += stretch * dx * p[b * n + 2] + dy * p[b * n + 3]
        for a in range(4, n):
            if decay[a] != 1.0:
                m[a] *= decay[a]
                for b in range(n):
                    p[a * n + b] *= decay[a]
                for b in range(n):
                    p[b * n + a] *= decay[a]
            p[a * n + a] += added[a]
        p[0] += q_place
        p[n + 1] += q_place
        p[2 * n + 2] += q_yaw
        if read:
            x, y, yaw = m[0], m[1], m[2]
            c, s = math.cos(yaw), math.sin(yaw)
            sx, sy = x + c * lx - s * ly, y + s * lx + c * ly
            field, gx, gy, gh = at_with_gradient(table, sx, sy, yaw, False)
            slopes = gx + gy + gh
            known = field == field and slopes == slopes
            noise = white
            if not known:
                field, gx, gy, gh, noise = wide_mean, 0.0, 0.0, 0.0, white + wide_variance
            h_row[0], h_row[1] = gx, gy
            h_row[2] = gh + gy * (c * lx - s * ly) - gx * (s * lx + c * ly)
            if iron:
                h_row[first_iron], h_row[first_iron + 1] = c, s
                h_row[2] += c * m[first_iron + 1] - s * m[first_iron]
            if mapped:
                sd = 0.0
                if known:
                    sd = sd_at(table, spreads, sx, sy, yaw, False)
                    sd = sd if sd == sd else 0.0
                noise += share * sd * sd
                h_row[6] = math.sqrt(1 - share) * sd
            innovation, variance = z - field, noise
            for a in range(4, n):
                innovation -= h_row[a] * m[a]
            for a in range(n):
                ph[a] = 0.0
                for b in range(n):
                    ph[a] += p[a * n + b] * h_row[b]
            for a in range(n):
                variance += h_row[a] * ph[a]
            log_likelihood = -0.5 * (innovation * innovation / variance + math.log(variance))
            if not (x0 <= x <= x1 and y0 <= y <= y1):
                log_likelihood -= penalty
            evidence += math.exp(max(logw[k] + log_likelihood, -700.0))
            logw[k] += power * log_likelihood
            if known:
                for a in range(n):
                    gain = ph[a] / variance
                    m[a] += gain * innovation
                    for b in range(n):
                        p[a * n + b] -= gain * ph[b]
        most = max(most, logw[k])
    stats[:] = 0.0
    stats[0] = math.log(evidence) if evidence > 0 else -700.0
    total = 0.0
    for k in range(logw.shape[0]):
        if logw[k] < most - cut:
            logw[k] = -np.inf
        else:
            total += math.exp(logw[k] - most)
    level = most + math.log(total)
    best = -np.inf
    for k in range(logw.shape[0]):
        if logw[k] == -np.inf:
            continue
        logw[k] -= level
        if logw[k] > best:
            best, stats[2] = logw[k], k
        w = math.exp(logw[k])
        m = state[k * size : k * size + n]
        p = state[k * size + n : (k + 1) * size]
        dx, dy, dyaw = m[0] - x_ref, m[1] - y_ref, m[2] - yaw_ref
        dyaw -= 2 * math.pi * math.floor(dyaw / (2 * math.pi) + 0.5)
        stats[1] += 1
        stats[3] += w
        stats[4] += w * dx
        stats[5] += w * dy
        stats[6] += w * dyaw
        stats[7] += w * (dx * dx + p[0])
        stats[8] += w * (dx * dy + p[1])
        stats[9] += w * (dx * dyaw + p[2])
        stats[10] += w * (dy * dy + p[n + 1])
        stats[11] += w * (dy * dyaw + p[n + 2])
        stats[12] += w * (dyaw * dyaw + p[2 * n + 2])
        stats[13] += w * m[4]


@compiled(_IN, _IN, _IN, _IN, _IN, _OUT, _OUT)
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
