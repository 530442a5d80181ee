"""Effects: coefficients that differ between sessions, their prior by EM and their posterior in one session:
from a labelled drive at its start.

The model of a session s is (Laird and Ware 1982, Biometrics 38, 963)

    y = phi' beta_s + e,   beta_s ~ N(mu, Lambda),   Var e = v

Errors of neighbouring readings are correlated. A reading therefore counts for a share w < 1 of an independent
one, so that its likelihood is taken to the power w. With weights w and variances v the posterior is

    V = (Lambda^-1 + sum w phi phi' / v)^-1,   m = V (Lambda^-1 mu + sum w phi y / v)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.mixed.hidden import block_diag, hypotheses
from magtwin.learn.models.calibration import quantile_factor

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

CORRELATION_S = 2.5
"""Time over which errors are correlated [s]: a reading counts for its share of it, at 4 Hz for a tenth."""

RATE_HZ = 4.0
"""Highest rate of the readings that effects are estimated from [Hz]."""

BLOCK_S = 10.0
"""Length of the blocks that are left out of a drive in turn [s]."""

LEAST_WIDENING, MOST_WIDENING = 0.7, 4.0
"""Least and largest factor by which a session's own errors change its intervals."""


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

    def take(self, at: NDArray[np.intp]) -> "Effects":
        """Some of the coefficients, whatever the others are."""
        return Effects(self.mean[at], self.covariance[np.ix_(at, at)])


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
    """Sums of readings: regressors (N, P), labels [nT], (N,), and variances of their errors [nT^2].

    `weight` is the share of an independent reading that each counts for.
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


def shares(t: Array) -> float:
    """Share of an independent reading that each reading counts for, from their times [s], shape (N,)."""
    if len(t) < 2:
        return 1.0
    steps = np.diff(t)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else CORRELATION_S
    return min(step / CORRELATION_S, 1.0)


def thinned_rows(t: Array, rate_hz: float = RATE_HZ) -> NDArray[np.intp]:
    """Indices of rows at most `rate_hz` apart, from ascending times [s], shape (N,)."""
    kept, last = [], -math.inf
    for i, now in enumerate(t.tolist()):
        if now - last >= 0.99 / rate_hz or now < last:
            kept.append(i)
            last = now
    return np.array(kept, np.intp)


class DriveEffects(NamedTuple):
    """What a labelled drive tells about its session."""

    effects: Effects
    """Posterior of the session's effects."""

    widening: float = 1.0
    """Factor z of standard deviations with which 90 % of the readings of a block lie in 90 % intervals that
    are predicted from the other blocks."""

    left_out_nt: float = math.nan
    """Root mean square error of these predictions [nT]; nan if there is one block."""

    hidden_nt2: float = 0.0
    """Variance of a field that no signal explains [nT^2]; at another time its phase is unknown."""

    period_s: float = math.nan
    """Period of its strongest harmonic [s]; nan if there is probably none."""


class _Hypothesis(NamedTuple):
    """A hypothesis about hidden parts, with what blocks of a drive tell by it."""

    prior: Effects
    sums: list[Sums]
    log_prior: float
    rate: Array
    """Angular frequencies of its coefficients [rad/s], shape (S,)."""

    def given(self, left: int = -1) -> tuple[Effects, float]:
        """Posterior and logarithm of the probability, up to a constant, by the blocks other than one left
        out.
        """
        blocks = [sums for k, sums in enumerate(self.sums) if k != left]
        sums = sum(blocks[1:], start=blocks[0])
        after = posterior(self.prior, sums)
        away = after.mean - self.prior.mean
        precise = np.linalg.solve(self.prior.covariance, away)
        misfit = sums.square - 2 * sums.sloped @ after.mean + after.mean @ sums.curved @ after.mean
        volumes = np.linalg.slogdet(after.covariance)[1] - np.linalg.slogdet(self.prior.covariance)[1]
        return after, self.log_prior + 0.5 * float(volumes - misfit - away @ precise)


def _mixture(hypotheses: Sequence[_Hypothesis], own: int, left: int = -1) -> DriveEffects:
    """The first `own` effects by all hypotheses, and what remains hidden, by the blocks other than one left
    out.
    """
    found, log = zip(*(each.given(left) for each in hypotheses), strict=True)
    odds = np.exp(np.array(log) - max(log))
    odds /= odds.sum()
    means, spreads = (
        np.stack([each[:own] for each in parts])
        for parts in ([of.mean for of in found], [of.covariance[:, :own] for of in found])
    )
    mean = odds @ means
    away = means - mean
    covariance = np.einsum("k,kij->ij", odds, spreads + away[:, :, None] * away[:, None, :])
    squares = [float(np.sum(of.mean[own:] ** 2 + np.diag(of.covariance)[own:])) for of in found]
    best = int(np.argmax(odds))
    rates, number = np.unique(hypotheses[best].rate, return_inverse=True)
    strength = np.bincount(number, found[best].mean[own:] ** 2)
    period_s = 2 * math.pi / float(rates[np.argmax(strength)]) if len(rates) else math.nan
    effects = Effects(mean, (covariance + covariance.T) / 2)
    return DriveEffects(effects, hidden_nt2=float(odds @ squares) / 2, period_s=period_s)


def effects_of_drive(
    prior: Effects, phi: Array, y: Array, variance_nt2: Array, t: Array, *, ways: Sequence[int] = ()
) -> DriveEffects:
    """Effects of a session from a labelled drive.

    Its rows are regressors (N, P), labels [nT], variances of their errors [nT^2], and ascending times [s].
    `ways` are the columns that periodic hidden parts follow; see `magtwin.learn.mixed.hidden`.
    """
    weight, own = shares(t), phi.shape[1]
    block = ((t - t[0]) // BLOCK_S).astype(np.intp)
    if block[-1] > 0 and (t[-1] - t[0]) % BLOCK_S < BLOCK_S / 2:
        block[block == block[-1]] -= 1  # a short last block joins the one before
    hidden, rows = hypotheses(ways), [block == k for k in np.unique(block)]
    tried = []
    for k, moved in enumerate(hidden.regressors(t, phi)):
        if k and not hidden.rate[k].any():
            continue  # a field that wanders widens
        more = hidden.variance[k] > 0
        covariance = block_diag(prior.covariance, np.diag(hidden.variance[k][more]))
        whole = Effects(np.append(prior.mean, np.zeros(more.sum())), covariance)
        x = np.column_stack([phi, moved[:, more]])
        sums = [sums_of(x[at], y[at], variance_nt2[at], weight) for at in rows]
        tried.append(_Hypothesis(whole, sums, float(hidden.log_prior[k]), hidden.rate[k][more]))
    drive = _mixture(tried, own)
    if len(rows) < 2:
        return drive
    error, sd = np.empty(len(y)), np.empty(len(y))
    for k, at in enumerate(rows):
        others = _mixture(tried, own, left=k)
        mean, variance = others.effects.predict(phi[at])
        error[at], sd[at] = mean - y[at], np.sqrt(variance_nt2[at] + variance + others.hidden_nt2)
    z = quantile_factor(error, sd, block)
    widening = float(np.clip(z, LEAST_WIDENING, MOST_WIDENING))
    return drive._replace(widening=widening, left_out_nt=float(np.sqrt(np.mean(error**2))))
