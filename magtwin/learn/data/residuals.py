"""Residuals: how a model errs on recordings that it never saw, as an offset of a session and a slow process.

What a filter sees of a neural magnetometer is not white: a session's iron shifts all readings alike, and what
the map and the network miss changes over seconds. A simulated magnetometer draws its error from these figures
(`magtwin.sim.sensors.model_error`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.learn.data.recording import Recording, Rows

Array = NDArray[np.float64]

PRIOR_SHARE, PRIOR_SESSIONS = 0.5, 2.0
"""Share of the variance that is taken to be the session's, and the number of sessions that this guess counts
for: the variance between two sessions is hardly an estimate. Ours."""

LAG_HZ = 10.0
"""Readings a second that the autocorrelation is taken of [Hz]; more are too alike to tell more."""

LONGEST_LAG_S = 20.0
"""Longest lag of the autocorrelation [s]; at most a third of a recording is used."""


@dataclass(frozen=True)
class Held:
    """Errors of a model on a recording that it was not fitted to."""

    session: str
    """Session of the recording."""

    t: Array
    """Times of the rows, ascending [s], shape (N,)."""

    error_nt: Array
    """Predicted less measured [nT], shape (N,)."""


@dataclass(frozen=True)
class Residuals:
    """Variance of errors by where it comes from: e(t) = offset of the session + u(t)."""

    offset_sd_nt: float
    """Standard deviation of the offset between sessions [nT]."""

    within_sd_nt: float
    """Standard deviation of u [nT]."""

    time_s: float
    """Correlation time of u [s]: its autocorrelation is exp(-lag / time)."""

    sessions: int
    """Sessions that this was estimated from."""

    def metadata(self) -> dict[str, float | int]:
        """The figures, by the names that a weights file has."""
        return {
            "residual_offset_sd_nt": self.offset_sd_nt,
            "residual_within_sd_nt": self.within_sd_nt,
            "residual_time_s": self.time_s,
            "residual_sessions": self.sessions,
        }


def held_of(rows: Rows, error_nt: Array, recordings: Sequence[Recording]) -> list[Held]:
    """Errors by recording.

    Args:
        rows: The rows that errors are of.
        error_nt: Predicted less measured, shape (N,) [nT].
        recordings: Those of the data set.
    """
    of = {one.name: one for one in recordings}
    found = []
    for number, name in enumerate(rows.names):
        here, one = rows.recording == number, of[name]
        if here.any():
            step = one.duration_s / max(one.rows - 1, 1)
            found.append(Held(one.session, rows.row[here] * step, error_nt[here]))
    return found


def residuals(held: Sequence[Held]) -> Residuals | None:
    """Offset, remainder and correlation time of errors, by moments.

    With C(lag) the mean product of errors a lag apart in a recording, whose expectation is zero,

        C(lag) = offset^2 + within^2 exp(-lag / time),

    and offset^2 is the mean product of the means of two recordings of one session. Where no session has two,
    it follows from the mean square M of the recordings' means, which is offset^2 + within^2 g with
    g = 2 x - 2 x^2 (1 - exp(-1 / x)), x = time / duration (Priestley 1981, eq. 5.3.5, for an exponential).
    Errors are not centred: a bias that all sessions have is part of what the next one can have. The share of
    offset^2 in C(0) is drawn towards `PRIOR_SHARE`, the more the fewer sessions there are. The time is fitted
    to C by least squares, all lags alike, with the level that C falls to left free: it is the offset of these
    few sessions.

    Args:
        held: Errors on recordings that the model was not fitted to.

    Returns:
        The figures; None where there is no error at all.
    """
    from scipy.optimize import minimize_scalar

    held = [one for one in held if len(one.error_nt)]
    total = np.concatenate([one.error_nt for one in held]) if held else np.zeros(0)
    variance = float(np.mean(total**2)) if len(total) else 0.0
    if not variance > 0:
        return None
    lags, products = _autocovariance(held)
    means = np.array([one.error_nt.mean() for one in held])
    lengths = np.array([one.t[-1] - one.t[0] for one in held])
    sessions = sorted({one.session for one in held})
    crossed = _crossed(held, means)

    def offset_nt2(time_s: float) -> float:
        if crossed is not None:
            found = crossed
        else:
            x = np.divide(time_s, lengths, out=np.full(len(lengths), np.inf), where=lengths > 0)
            x = np.clip(x, 1e-9, 1e3)  # at 1e3 the mean of a recording is as good as its every row
            g = float(np.mean(2 * x - 2 * x**2 * -np.expm1(-1 / x)))
            found = (float(np.mean(means**2)) - variance * g) / max(1 - g, 1e-3)
        share = min(max(found / variance, 0.0), 1.0)
        count = len(sessions)
        return variance * (count * share + PRIOR_SESSIONS * PRIOR_SHARE) / (count + PRIOR_SESSIONS)

    step_s = float(lags[1] - lags[0]) if len(lags) > 1 else 0.0
    if not step_s > 0:
        offset = offset_nt2(0.0)
        return Residuals(offset**0.5, (variance - offset) ** 0.5, 0.0, len(sessions))
    longest = max(float(lags[-1]), 2 * step_s)  # a slower process looks like an offset

    known = np.isfinite(products)

    def cost(log_time: float) -> float:
        """Mean square that C leaves about the exponential, from C(0) to the level that fits best."""
        fallen = -np.expm1(-lags[known] / np.exp(log_time))
        drop = variance - products[known]
        depth = float(drop @ fallen) / max(float(fallen @ fallen), 1e-300)
        return float(np.mean((drop - depth * fallen) ** 2)) / variance**2

    best = minimize_scalar(cost, bounds=(np.log(step_s / 10), np.log(longest)), method="bounded")
    time_s = float(np.exp(best.x))
    offset = offset_nt2(time_s)
    return Residuals(offset**0.5, max(variance - offset, 0.0) ** 0.5, time_s, len(sessions))


def _crossed(held: Sequence[Held], means: Array) -> float | None:
    """Mean product of the means of two recordings of a session [nT^2]; None where no session has two."""
    products = []
    for session in sorted({one.session for one in held}):
        own = means[[one.session == session for one in held]]
        if len(own) > 1:
            pairs = len(own) * (len(own) - 1)
            products.append((own.sum() ** 2 - np.sum(own**2)) / pairs)
    return float(np.mean(products)) if products else None


def _autocovariance(held: Sequence[Held]) -> tuple[Array, Array]:
    """Lags from 0 [s], and the mean product of errors so far apart in a recording [nT^2], each (L,)."""
    steps = [float(np.median(np.diff(one.t))) for one in held if len(one.t) > 1]
    if not steps:
        return np.zeros(1), np.zeros(1)
    step = max(float(np.median(steps)), 1 / LAG_HZ)
    longest = min(LONGEST_LAG_S, max(one.t[-1] - one.t[0] for one in held) / 3)
    count = max(int(longest / step), 1) + 1
    sums, pairs = np.zeros(count), np.zeros(count)
    for one in held:
        slot = np.rint((one.t - one.t[0]) / step).astype(np.intp)
        taken, first = np.unique(slot, return_index=True)
        e, known = np.zeros(taken[-1] + 1), np.zeros(taken[-1] + 1)
        e[taken], known[taken] = one.error_nt[first], 1.0
        for k in range(min(count, len(e))):
            sums[k] += float(e[: len(e) - k] @ e[k:])
            pairs[k] += float(known[: len(e) - k] @ known[k:])
    with np.errstate(invalid="ignore", divide="ignore"):
        products = sums / pairs
    return np.asarray(np.arange(count) * step, np.float64), np.asarray(products, np.float64)
