"""Followed: effects of a session that change slowly, and its hidden parts, reading by reading."""

import itertools
import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from magtwin.compiled import Loops
from magtwin.learn.mixed.effects import (
    CORRELATION_S,
    LEAST_WIDENING,
    MOST_WIDENING,
    RATE_HZ,
    Array,
    Effects,
)
from magtwin.learn.mixed.hidden import block_diag, hypotheses

MEMORY_S = 1200.0
"""Time over which followed effects return to their prior mean [s]."""

DELAY_S = 10.0
"""Age of the newest pose when a prediction is made online [s]."""

WIDENING_PRIOR_S = 30.0
"""Time that the prior, a factor of 1, counts for in the factor of followed effects [s]."""

LOOPS = Loops("magtwin.learn.mixed.compiled_step", pays=0)

WIDENING_MEMORY_S = 120.0
"""Time over which earlier errors count in the factor of followed effects [s]."""


class State(NamedTuple):
    """What is known after a reading, by K hypotheses with D coefficients each."""

    t: float
    mean: Array
    """Shape (K, D) [nT]."""
    covariance: Array
    """Shape (K, D, D) [nT^2]."""
    weight: Array
    """Probabilities, shape (K,)."""


class FollowedEffects:
    """Effects that change slowly, updated reading by reading: a Kalman filter for each hypothesis.

    Between readings beta is an Ornstein-Uhlenbeck process about its prior,

        m <- mu + a (m - mu),   V <- a^2 V + (1 - a^2) Lambda,   a = exp(-dt / memory)

    and so are the coefficients of hidden parts (`magtwin.learn.mixed.hidden`), about 0. Predictions are means
    over hypotheses. Readings closer than 1 / `RATE_HZ` to the last are skipped.
    """

    def __init__(
        self,
        prior: Effects,
        *,
        start: Effects | None = None,
        memory_s: float = MEMORY_S,
        delay_s: float = DELAY_S,
        ways: Sequence[int] = (),
    ) -> None:
        """Begin at the prior.

        Args:
            prior: Effects of all sessions.
            start: Effects to begin with, such as those of a drive. Default: the prior.
            memory_s: Time over which effects return to their prior mean [s].
            delay_s: Age of the newest pose when a prediction is made [s]; `widening` is that of predictions
                made so far ahead.
            ways: Columns of the regressors that fields fixed to the robot follow: the constant, and cosine
                and
                sine of the heading. Without them no hidden part is looked for.
        """
        start = start or prior
        self.delay_s = delay_s
        self.hidden = hypotheses(ways)
        kinds, more = self.hidden.variance.shape
        self._own = own = len(prior.mean)
        self._prior = Effects(prior.mean, np.ascontiguousarray(prior.covariance))
        self._mean = np.concatenate([prior.mean, np.zeros(more)])
        self._memory_s = np.full((kinds, own + more), memory_s)
        self._memory_s[:, own:] = self.hidden.memory_s[:, None]
        self.mean = np.tile(np.concatenate([start.mean, np.zeros(more)]), (kinds, 1))
        each = [block_diag(start.covariance, np.diag(variance)) for variance in self.hidden.variance]
        self.covariance = np.stack(each)
        self._log = self.hidden.log_prior.copy()
        self.t = math.nan
        """Time of the last update [s]; nan before the first."""
        self.count = 0
        """Number of readings used."""
        self._past: deque[State] = deque()
        self._square, self._weight = 0.0, 0.0

    @property
    def widening(self) -> float:
        """Factor of the standard deviations, by the errors of predictions `delay_s` ahead in this session."""
        square = (WIDENING_PRIOR_S + self._square) / (WIDENING_PRIOR_S + self._weight)
        return min(max(math.sqrt(square), LEAST_WIDENING), MOST_WIDENING)

    @property
    def probabilities(self) -> Array:
        """Probabilities of the hypotheses, shape (K,)."""
        odds = np.exp(self._log - self._log.max())
        return np.asarray(odds / odds.sum())

    def predict(self, t: Array, phi: Array) -> tuple[Array, Array]:
        """Mean [nT] and variance [nT^2] of the field, each (N,), at ascending times [s] soon after the last
        update.

        Rows phi have the shape (N, P).
        """
        return self._predict(State(self.t, self.mean, self.covariance, self.probabilities), t, phi)

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
        self._judge(t, phi, y, variance_nt2, weight)
        ahead = 0.0 if first else step
        a, x = np.exp(-ahead / self._memory_s), self._whole(np.array([t]), phi[None])[:, 0]
        self._log = self.hidden.log_prior + math.exp(-ahead / MEMORY_S) * (self._log - self.hidden.log_prior)
        LOOPS.open().step(
            *(
                self.mean,
                self.covariance,
                self._log,
                self._mean,
                self._prior.covariance,
                self.hidden.variance,
            ),
            *(a, x, float(y), float(variance_nt2 / weight)),
        )
        self._log -= self._log.max()
        self.t, self.count = t, self.count + 1
        if not self._past or t - self._past[-1].t >= 1.0:
            self._past.append(State(t, self.mean.copy(), self.covariance.copy(), self.probabilities))
        return True

    def _judge(self, t: float, phi: Array, y: float, variance_nt2: float, weight: float) -> None:
        """Compare a label with its prediction from readings that were `delay_s` older."""
        while len(self._past) > 1 and self._past[1].t <= t - self.delay_s:
            self._past.popleft()
        if not self._past or self._past[0].t > t - self.delay_s:
            return
        mean, spread = (float(each[0]) for each in self._predict(self._past[0], np.array([t]), phi[None]))
        fade = math.exp(-weight * CORRELATION_S / WIDENING_MEMORY_S)
        square = (y - mean) ** 2 / (variance_nt2 + spread)
        self._square = fade * self._square + weight * CORRELATION_S * square
        self._weight = fade * self._weight + weight * CORRELATION_S

    def _whole(self, t: Array, phi: Array) -> Array:
        """Regressors of all coefficients, shape (K, N, D)."""
        hidden = self.hidden.regressors(t, phi)
        return np.concatenate([np.broadcast_to(phi, (len(hidden), *phi.shape)), hidden], axis=2)

    def _predict(self, state: State, t: Array, phi: Array) -> tuple[Array, Array]:
        """Mean and variance of a mixture; a V + (1 - a) Lambda without a product of whole matrices."""
        x = self._whole(t, phi)
        ahead = 0.0 if math.isnan(state.t) else max(float(t[0]) - state.t, 0.0)
        a = np.exp(-ahead / self._memory_s)
        shrunk = x * a[:, None, :]
        each = x @ self._mean + (shrunk @ (state.mean - self._mean)[:, :, None])[:, :, 0]
        kept = np.sum((shrunk @ state.covariance) * shrunk, axis=2)
        own = phi @ self._prior.covariance
        back = (1 - a[0, 0] ** 2) * np.sum(own * phi, axis=1)
        hidden = x[:, :, self._own :] ** 2 * (1 - a[:, None, self._own :] ** 2)
        spread = kept + back + (hidden @ self.hidden.variance[:, :, None])[:, :, 0]
        mean = state.weight @ each
        return mean, np.maximum(state.weight @ (spread + (each - mean) ** 2), 0.0)


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
        mean[start:stop], variance = effects.predict(t[start:stop], phi[start:stop])
        sd[start:stop] = effects.widening * np.sqrt(noise[start:stop] + variance)
    return mean, sd
