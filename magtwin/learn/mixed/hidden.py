"""Hidden parts: fields of the robot that no signal explains, as hypotheses about how they change with time.

A part that is moved on a schedule, such as a turret, adds a field that is fixed to the robot. With psi = (1,
cos yaw, sin yaw), or what spans the same, each hypothesis adds to phi' beta one of

    0,   sum_h psi' (g_h cos(2 pi h t / T) + k_h sin(2 pi h t / T)),   psi' g(t)

with periods T and harmonics h = 1, 2, 3, or with a field g(t) that wanders. Their coefficients have mean 0,
and are estimated with the effects of the session. The labels decide between hypotheses by Bayes' rule.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIODS_S = tuple(np.geomspace(18.0, 90.0, 24).tolist())
"""Periods of a moved part [s]."""

HARMONICS = 3
"""Number of harmonics: a schedule has rests and turns."""

WANDERING_S = (4.0, 15.0, 60.0)
"""Times over which a field that follows no period wanders [s]."""

HIDDEN_SD_NT = 100.0
"""Standard deviation of a hidden field; of the h-th harmonic it is 1 / h of that [nT]."""

NOTHING, PERIODIC = 0.5, 0.35
"""Probabilities beforehand of no hidden part, and of a periodic one."""

PHASE_S = 240.0
"""Time over which a schedule keeps its phase: periods lie between those of the hypotheses [s]."""


@dataclass(frozen=True)
class Hypotheses:
    """K hypotheses, each with S coefficients of mean 0."""

    ways: NDArray[np.intp]
    """Columns of the regressors phi that multiply each coefficient's cosine, shape (S,)."""

    rate: Array
    """Angular frequencies [rad/s], shape (K, S); 0 for a field that wanders."""

    phase: Array
    """Phases of the cosines at t = 0, 0 or pi / 2 [rad], shape (S,)."""

    variance: Array
    """Variances of the coefficients beforehand [nT^2], shape (K, S); 0 for those that a hypothesis leaves
    out."""

    memory_s: Array
    """Time over which the coefficients return to 0 [s], shape (K,)."""

    log_prior: Array
    """Logarithms of their probabilities beforehand, shape (K,)."""

    def regressors(self, t: Array, phi: Array) -> Array:
        """Rows that multiply the coefficients, shape (K, N, S), at times [s], (N,), with regressors, (N,
        P).
        """
        turning = np.cos(self.rate[:, None, :] * t[None, :, None] - self.phase)
        return np.asarray(turning * phi[None, :, self.ways])


def hypotheses(ways: Sequence[int]) -> Hypotheses:
    """Nothing, periods and wandering fields along columns of the regressors; without columns, nothing
    only.
    """
    count = 1 + len(PERIODS_S) + len(WANDERING_S) if ways else 1
    h, k, part = (
        each.ravel()
        for each in np.meshgrid(np.arange(1, HARMONICS + 1), range(len(ways)), (0, 1), indexing="ij")
    )
    rate, variance = np.zeros((count, len(h))), np.zeros((count, len(h)))
    memory, prior = np.full(count, PHASE_S), np.ones(count)
    if ways:
        periodic, wandering = slice(1, 1 + len(PERIODS_S)), slice(1 + len(PERIODS_S), None)
        rate[periodic] = 2 * math.pi * h / np.array(PERIODS_S)[:, None]
        variance[periodic] = (HIDDEN_SD_NT / h) ** 2
        variance[wandering] = np.where((h == 1) & (part == 0), HIDDEN_SD_NT**2, 0.0)
        memory[wandering] = WANDERING_S
        prior[0] = NOTHING
        prior[periodic] = PERIODIC / len(PERIODS_S)
        prior[wandering] = (1 - NOTHING - PERIODIC) / len(WANDERING_S)
    return Hypotheses(
        np.array(ways, np.intp)[k.astype(np.intp)],
        rate,
        part * (math.pi / 2),
        variance,
        memory,
        np.log(prior),
    )


def block_diag(first: Array, second: Array) -> Array:
    """Two square matrices as blocks of one."""
    n = len(first)
    whole = np.zeros((n + len(second),) * 2)
    whole[:n, :n], whole[n:, n:] = first, second
    return whole
