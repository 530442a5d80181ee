"""Effects: coefficients that differ between sessions, their prior by EM and their posterior in one session.

The model of a session s is (Laird and Ware 1982, Biometrics 38, 963)

    y = phi' beta_s + e,   beta_s ~ N(mu, Lambda),   Var e = v

Errors of neighbouring readings are correlated. A reading therefore counts for a share w < 1 of an independent
one, so that its likelihood is taken to the power w. With weights w and variances v the posterior is

    V = (Lambda^-1 + sum w phi phi' / v)^-1,   m = V (Lambda^-1 mu + sum w phi y / v)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ROUNDS = 60
"""Most rounds of EM."""

SETTLED = 1e-3
"""Relative change of the noise factor and of the trace of Lambda below which EM ends."""

PRIOR_SESSIONS = 4.0
"""Number of sessions that the diagonal of Lambda counts for when correlations are estimated."""

LEAST_SD_NT = 0.1
"""Least standard deviation of an effect [nT]."""

_BLOCK = 256
"""Rows whose products are in memory at once."""


@dataclass(frozen=True)
class Effects:
    """A normal distribution of coefficients."""

    mean: Array
    """Means [nT], shape (P,)."""

    covariance: Array
    """Covariance [nT^2], shape (P, P)."""

    def predict(self, phi: Array) -> tuple[Array, Array]:
        """Mean [nT] and variance [nT^2] of phi' beta, each (N,), for rows phi, shape (N, P).

        No row depends on another, to the bit.
        """
        mean, variance = np.empty(len(phi)), np.empty(len(phi))
        for start in range(0, len(phi), _BLOCK):
            rows = np.ascontiguousarray(phi[start : start + _BLOCK])
            mean[start : start + _BLOCK] = (rows * self.mean).sum(axis=1)
            turned = (rows[:, None, :] * self.covariance).sum(axis=2)
            variance[start : start + _BLOCK] = (rows * turned).sum(axis=1)
        return mean, np.maximum(variance, 0.0)


@dataclass(frozen=True)
class Sums:
    """What some readings tell about the effects: sums over rows of w phi phi' / v and the like."""

    curved: Array
    """Sum of w phi phi' / v, shape (P, P)."""

    sloped: Array
    """Sum of w phi y / v, shape (P,)."""

    square: float
    """Sum of w y^2 / v."""

    count: float
    """Sum of w: the number of independent readings."""

    def __add__(self, other: "Sums") -> "Sums":
        return Sums(
            self.curved + other.curved,
            self.sloped + other.sloped,
            self.square + other.square,
            self.count + other.count,
        )


def sums_of(phi: Array, y: Array, variance_nt2: ArrayLike, weight: ArrayLike = 1.0) -> Sums:
    """Sums of readings.

    Args:
        phi: Regressors, shape (N, P).
        y: Labels [nT], shape (N,).
        variance_nt2: Variance of each error [nT^2], shape (N,) or one for all.
        weight: Share of an independent reading that each counts for, shape (N,) or one for all.
    """
    weight = np.broadcast_to(np.asarray(weight, float), y.shape)
    share = weight / np.broadcast_to(np.asarray(variance_nt2, float), y.shape)
    weighted = phi * share[:, None]
    return Sums(phi.T @ weighted, weighted.T @ y, float(share @ y**2), float(weight.sum()))


def posterior(prior: Effects, sums: Sums) -> Effects:
    """Effects of the session of some readings."""
    precision = np.linalg.inv(prior.covariance)
    covariance = np.linalg.inv(precision + sums.curved)
    covariance = (covariance + covariance.T) / 2
    return Effects(covariance @ (precision @ prior.mean + sums.sloped), covariance)


def fit_effects(
    sessions: Sequence[Sums], mean: Array, *, start_nt2: Array, rounds: int = ROUNDS
) -> tuple[Effects, float]:
    """Fit Lambda and the noise factor to sessions by EM; mu stays as given.

    The E-step is the posterior of each session under N(mu, Lambda) and variances s^2 v. The M-step is

        Lambda = (sum_s V_s + (m_s - mu)(m_s - mu)' + k D) / (S + k),   s^2 = sum w E[e^2] / v / sum w

    with D the diagonal of the first term's mean and k = `PRIOR_SESSIONS`, which shrinks correlations that few
    sessions cannot tell.

    Args:
        sessions: Sums of each session, with variances that are known up to a common factor.
        mean: mu [nT], shape (P,).
        start_nt2: Variances of the effects to start from [nT^2], shape (P,).
        rounds: Most rounds.

    Returns:
        The prior of effects, and the factor s^2 of the variances.
    """
    curved, sloped = np.stack([s.curved for s in sessions]), np.stack([s.sloped for s in sessions])
    square, count = sum(s.square for s in sessions), sum(s.count for s in sessions)
    covariance, factor = np.diag(np.maximum(start_nt2, LEAST_SD_NT**2)), 1.0
    for _ in range(rounds):
        precision = np.linalg.inv(covariance)
        spread = np.linalg.inv(precision + curved / factor)
        centre = np.einsum("sij,sj->si", spread, precision @ mean + sloped / factor)
        away = centre - mean
        second = spread + away[:, :, None] * away[:, None, :]
        errors = square - 2 * np.sum(centre * sloped)
        errors += np.sum(curved * (spread + centre[:, :, None] * centre[:, None, :]))
        before = factor, np.trace(covariance)
        factor = max(float(errors) / count, 1e-9)
        wanted = second.mean(axis=0)
        share = PRIOR_SESSIONS / (len(sessions) + PRIOR_SESSIONS)
        diagonal = np.diag(np.maximum(np.diag(wanted), LEAST_SD_NT**2))
        covariance = (1 - share) * (wanted + wanted.T) / 2 + share * diagonal
        now = factor, np.trace(covariance)
        if all(abs(a - b) <= SETTLED * b for a, b in zip(now, before, strict=True)):
            break
    return Effects(np.asarray(mean, float), covariance), factor
