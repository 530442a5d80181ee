"""Effects: coefficients that differ between sessions, their prior by EM and their posterior in one session:
from a labelled drive at its start, or followed while it lasts.

The model of a session s is (Laird and Ware 1982, Biometrics 38, 963)

    y = phi' beta_s + e,   beta_s ~ N(mu, Lambda),   Var e = v

Errors of neighbouring readings are correlated. A reading therefore counts for a share w < 1 of an independent
one, so that its likelihood is taken to the power w. With weights w and variances v the posterior is

    V = (Lambda^-1 + sum w phi phi' / v)^-1,   m = V (Lambda^-1 mu + sum w phi y / v)
"""

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

MEMORY_S = 600.0
"""Time over which followed effects return to their prior mean [s]."""

DELAY_S = 10.0
"""Age of the newest pose when a prediction is made online [s]."""

LEAST_WIDENING, MOST_WIDENING = 0.7, 4.0
"""Least and largest factor by which a session's own errors change its intervals."""

WIDENING_PRIOR_S = 30.0
"""Time that the prior, a factor of 1, counts for in the factor of followed effects [s]."""

WIDENING_MEMORY_S = 120.0
"""Time over which earlier errors count in the factor of followed effects [s]."""


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

    widening: float
    """Factor z of standard deviations with which 90 % of the readings of a block lie in 90 % intervals that
    are predicted from the other blocks."""

    left_out_nt: float
    """Root mean square error of these predictions [nT]; nan if there is one block."""


def effects_of_drive(prior: Effects, phi: Array, y: Array, variance_nt2: Array, t: Array) -> DriveEffects:
    """Effects of a session from a labelled drive.

    Its rows are regressors (N, P), labels [nT], variances of their errors [nT^2], and ascending times [s].
    """
    weight = shares(t)
    block = ((t - t[0]) // BLOCK_S).astype(np.intp)
    if block[-1] > 0 and (t[-1] - t[0]) % BLOCK_S < BLOCK_S / 2:
        block[block == block[-1]] -= 1  # a short last block joins the one before
    sums = [
        sums_of(phi[at], y[at], variance_nt2[at], weight) for at in (block == k for k in np.unique(block))
    ]
    whole = sum(sums[1:], start=sums[0])
    effects = posterior(prior, whole)
    if len(sums) < 2:
        return DriveEffects(effects, 1.0, math.nan)
    error, sd = np.empty(len(y)), np.empty(len(y))
    for k, number in enumerate(np.unique(block)):
        at = block == number
        others = [other for j, other in enumerate(sums) if j != k]
        mean, variance = posterior(prior, sum(others[1:], start=others[0])).predict(phi[at])
        error[at], sd[at] = mean - y[at], np.sqrt(variance_nt2[at] + variance)
    z = quantile_factor(error, sd, block)
    widening = float(np.clip(z, LEAST_WIDENING, MOST_WIDENING))
    return DriveEffects(effects, widening, float(np.sqrt(np.mean(error**2))))


class FollowedEffects:
    """Effects that change slowly, updated reading by reading: a Kalman filter.

    Between readings beta is an Ornstein-Uhlenbeck process about its prior,

        m <- mu + a (m - mu),   V <- a^2 V + (1 - a^2) Lambda,   a = exp(-dt / memory)

    Readings closer than 1 / `RATE_HZ` to the last are skipped. An update takes some 20 us.
    """

    def __init__(
        self,
        prior: Effects,
        *,
        start: Effects | None = None,
        memory_s: float = MEMORY_S,
        delay_s: float = DELAY_S,
    ) -> None:
        """Begin at the prior.

        Args:
            prior: Effects of all sessions.
            start: Effects to begin with, such as those of a drive. Default: the prior.
            memory_s: Time over which effects return to their prior mean [s].
            delay_s: Age of the newest pose when a prediction is made [s]; `widening` is that of predictions
                made so far ahead.
        """
        start = start or prior
        self.prior, self.memory_s, self.delay_s = prior, memory_s, delay_s
        self.mean, self.covariance = start.mean.copy(), start.covariance.copy()
        self.t = math.nan
        """Time of the last update [s]; nan before the first."""
        self.count = 0
        """Number of readings used."""
        self._past: deque[tuple[float, Effects]] = deque()
        self._square, self._weight = 0.0, 0.0

    @property
    def widening(self) -> float:
        """Factor of the standard deviations, by the errors of predictions `delay_s` ahead in this session."""
        square = (WIDENING_PRIOR_S + self._square) / (WIDENING_PRIOR_S + self._weight)
        return min(max(math.sqrt(square), LEAST_WIDENING), MOST_WIDENING)

    def effects(self, t: float | None = None) -> Effects:
        """Effects at a time [s], not before the last update. Default: at the last update."""
        a = 1.0 if t is None or math.isnan(self.t) else math.exp(-max(t - self.t, 0.0) / self.memory_s)
        return self._aged(a)

    def due(self, t: float) -> bool:
        """Whether a reading at a time [s] is late enough after the last one to be used."""
        return math.isnan(self.t) or t - self.t >= 0.99 / RATE_HZ

    def update(self, t: float, phi: Array, y: float, variance_nt2: float) -> bool:
        """Use one reading with a label.

        Args:
            t: Its time [s], after that of the last update.
            phi: Regressors, shape (P,).
            y: Label: measured field minus the map [nT].
            variance_nt2: Variance of the label's error [nT^2].

        Returns:
            Whether it was used; not if it is too close to the last, before it, or nan.
        """
        first = math.isnan(self.t)
        step = 1 / RATE_HZ if first else t - self.t
        if not self.due(t) or not math.isfinite(y + variance_nt2 + float(phi.sum())):
            return False
        weight = min(step, CORRELATION_S) / CORRELATION_S
        if not first:
            aged = self._aged(math.exp(-step / self.memory_s))
            self.mean, self.covariance = aged.mean, aged.covariance
        self._judge(t, phi, y, variance_nt2, weight)
        turned = self.covariance @ phi
        gain = turned / (float(phi @ turned) + variance_nt2 / weight)
        self.mean = self.mean + gain * (y - float(phi @ self.mean))
        self.covariance = self.covariance - np.outer(gain, turned)
        self.covariance = (self.covariance + self.covariance.T) / 2
        self.t, self.count = t, self.count + 1
        if not self._past or t - self._past[-1][0] >= 1.0:
            self._past.append((t, Effects(self.mean, self.covariance)))
        return True

    def _judge(self, t: float, phi: Array, y: float, variance_nt2: float, weight: float) -> None:
        """Compare a label with its prediction from readings that were `delay_s` older."""
        while len(self._past) > 1 and self._past[1][0] <= t - self.delay_s:
            self._past.popleft()
        if not self._past or self._past[0][0] > t - self.delay_s:
            return
        then, effects = self._past[0]
        a = math.exp(-(t - then) / self.memory_s)
        mean = float(phi @ (self.prior.mean + a * (effects.mean - self.prior.mean)))
        spread = a * a * float(phi @ effects.covariance @ phi)
        spread += (1 - a * a) * float(phi @ self.prior.covariance @ phi)
        fade = math.exp(-weight * CORRELATION_S / WIDENING_MEMORY_S)
        self._square = fade * self._square + weight * CORRELATION_S * (y - mean) ** 2 / (
            variance_nt2 + spread
        )
        self._weight = fade * self._weight + weight * CORRELATION_S

    def _aged(self, a: float) -> Effects:
        mean = self.prior.mean + a * (self.mean - self.prior.mean)
        return Effects(mean, a * a * self.covariance + (1 - a * a) * self.prior.covariance)


def followed(
    effects: FollowedEffects,
    phi: Array,
    y: Array,
    variance_nt2: Array,
    t: Array,
    *,
    predicted_nt2: Array | None = None,
) -> tuple[Array, Array]:
    """Predictions of the rows of a drive whose poses become known `effects.delay_s` later.

    Its rows are regressors (N, P), labels [nT], nan if unknown, variances of their errors [nT^2], and
    ascending times [s]. `predicted_nt2` are the variances of the errors to predict, by default the same.

    Returns:
        Disturbances and their standard deviations [nT], with the filter's widening, each (N,).
    """
    noise = variance_nt2 if predicted_nt2 is None else predicted_nt2
    mean, sd, ready = np.empty(len(t)), np.empty(len(t)), 0
    known = np.searchsorted(t, t - effects.delay_s, side="right")
    starts = np.flatnonzero(np.diff(known, prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*starts, len(t)]):
        for k in range(ready, known[start]):
            effects.update(float(t[k]), phi[k], float(y[k]), float(variance_nt2[k]))
        ready = int(known[start])
        mean[start:stop], variance = effects.effects(float(t[start])).predict(phi[start:stop])
        sd[start:stop] = effects.widening * np.sqrt(noise[start:stop] + variance)
    return mean, sd
