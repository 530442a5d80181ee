"""Residuals: the errors of a model on recordings that it never saw, as a session's offset and a slow process.

The error of a neural magnetometer is not white: a session's iron shifts all readings alike, and what the map
and the network miss changes over seconds. A simulated magnetometer draws its error from these
statistics (`magtwin.sim.sensors.model_error`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.learn.data.recording import Recording, Rows

Array = NDArray[np.float64]

PRIOR_SHARE, PRIOR_SESSIONS = 0.5, 2.0
"""Prior of the session's share of the variance, and the number of sessions that it counts for."""

LAG_HZ = 10.0  # Highest rate of the autocorrelation [Hz]
LONGEST_LAG_S = 20.0  # Longest lag of the autocorrelation [s]; at most a third of a recording is used


@dataclass(frozen=True)
class HeldOut:
    """Errors of a model on a recording that it was not fitted to."""

    session: str
    """Session of the recording."""

    t: Array
    """Times of the rows, ascending [s], shape (N,)."""

    error_nt: Array
    """Predicted minus measured [nT], shape (N,)."""


def held_out_errors(rows: Rows, error_nt: Array, recordings: Sequence[Recording]) -> list[HeldOut]:
    """Split errors [nT], shape (N,), of rows by their recordings."""
    by_name = {recording.name: recording for recording in recordings}
    errors = []
    for number, name in enumerate(rows.names):
        mask = rows.recording == number
        if mask.any():
            recording = by_name[name]
            step = recording.duration_s / max(recording.rows - 1, 1)
            errors.append(HeldOut(recording.session, rows.row[mask] * step, error_nt[mask]))
    return errors


def residuals(held: Sequence[HeldOut]) -> dict[str, float | int]:
    """Estimate offset, remainder and correlation time of errors by moments.

    C(lag) is the mean product of errors a lag apart in a recording. Its expectation is

        C(lag) = offset^2 + within^2 exp(-lag / time).

    offset^2 is the mean product of the means of two recordings of one session. If no session has two
    recordings, it follows from the mean square M of the recordings' means, M = offset^2 + within^2 g with
    g = 2 x - 2 x^2 (1 - exp(-1 / x)), x = time / duration (Priestley 1981, eq. 5.3.5, for an exponential).
    Errors are not centred, because a bias of all sessions is part of the next session's error. The share of
    offset^2 in C(0) is drawn towards `PRIOR_SHARE`, more so with few sessions. The time is fitted to C by
    least squares, with a free level at long lags.

    Args:
        held: Errors on recordings that the model was not fitted to.

    Returns:
        By their names in a weights file: residual_offset_sd_nt and residual_within_sd_nt, the standard
        deviations of offset and remainder [nT]; residual_time_s, the correlation time of the remainder [s];
        and residual_sessions, the number of sessions. {} if all errors are 0 or there are none.
    """
    from scipy.optimize import minimize_scalar

    held = [errors for errors in held if len(errors.error_nt)]
    total = np.concatenate([errors.error_nt for errors in held]) if held else np.zeros(0)
    variance = float(np.mean(total**2)) if len(total) else 0.0
    if not variance > 0:
        return {}
    lags, products = _autocovariance(held)
    means = np.array([errors.error_nt.mean() for errors in held])
    lengths = np.array([errors.t[-1] - errors.t[0] for errors in held])
    sessions = sorted({errors.session for errors in held})
    crossed = _crossed(held, means)

    def shrunk_offset(time_s: float) -> float:
        if crossed is not None:
            offset_nt2 = crossed
        else:
            x = np.divide(time_s, lengths, out=np.full(len(lengths), np.inf), where=lengths > 0)
            x = np.clip(x, 1e-9, 1e3)  # at 1e3 the process is constant within a recording
            g = float(np.mean(2 * x - 2 * x**2 * -np.expm1(-1 / x)))
            offset_nt2 = (float(np.mean(means**2)) - variance * g) / max(1 - g, 1e-3)
        share = min(max(offset_nt2 / variance, 0.0), 1.0)
        count = len(sessions)
        return variance * (count * share + PRIOR_SESSIONS * PRIOR_SHARE) / (count + PRIOR_SESSIONS)

    def told(offset_nt2: float, time_s: float) -> dict[str, float | int]:
        return {
            "residual_offset_sd_nt": offset_nt2**0.5,
            "residual_within_sd_nt": max(variance - offset_nt2, 0.0) ** 0.5,
            "residual_time_s": time_s,
            "residual_sessions": len(sessions),
        }

    step_s = float(lags[1] - lags[0]) if len(lags) > 1 else 0.0
    if not step_s > 0:
        return told(shrunk_offset(0.0), 0.0)
    longest = max(float(lags[-1]), 2 * step_s)  # a slower process looks like an offset

    known = np.isfinite(products)

    def cost(log_time: float) -> float:
        """Relative mean square distance of C from an exponential that falls to the best level."""
        fallen = -np.expm1(-lags[known] / np.exp(log_time))
        drop = variance - products[known]
        depth = float(drop @ fallen) / max(float(fallen @ fallen), 1e-300)
        return float(np.mean((drop - depth * fallen) ** 2)) / variance**2

    best = minimize_scalar(cost, bounds=(np.log(step_s / 10), np.log(longest)), method="bounded")
    time_s = float(np.exp(best.x))
    return told(shrunk_offset(time_s), time_s)


def _crossed(held: Sequence[HeldOut], means: Array) -> float | None:
    """Mean product of the means of two recordings of a session [nT^2]; None if no session has two."""
    products = []
    for session in sorted({errors.session for errors in held}):
        own = means[[errors.session == session for errors in held]]
        if len(own) > 1:
            pairs = len(own) * (len(own) - 1)
            products.append((own.sum() ** 2 - np.sum(own**2)) / pairs)
    return float(np.mean(products)) if products else None


def _autocovariance(held: Sequence[HeldOut]) -> tuple[Array, Array]:
    """Lags [s] and the mean product of errors a lag apart in a recording [nT^2], each (L,)."""
    steps = [float(np.median(np.diff(errors.t))) for errors in held if len(errors.t) > 1]
    if not steps:
        return np.zeros(1), np.zeros(1)
    step = max(float(np.median(steps)), 1 / LAG_HZ)
    longest = min(LONGEST_LAG_S, max(errors.t[-1] - errors.t[0] for errors in held) / 3)
    count = max(int(longest / step), 1) + 1
    sums, pairs = np.zeros(count), np.zeros(count)
    for errors in held:
        slot = np.rint(np.minimum((errors.t - errors.t[0]) / step, 2.0**53)).astype(np.intp)
        taken, first = np.unique(slot, return_index=True)
        if taken[-1] > 2 * len(errors.t) + count:  # long gaps, whose empty slots need not be stored
            _add_products(taken, errors.error_nt[first], sums, pairs)
            continue
        e, known = np.zeros(taken[-1] + 1), np.zeros(taken[-1] + 1)
        e[taken], known[taken] = errors.error_nt[first], 1.0
        for k in range(min(count, len(e))):
            sums[k] += float(e[: len(e) - k] @ e[k:])
            pairs[k] += float(known[: len(e) - k] @ known[k:])
    with np.errstate(invalid="ignore", divide="ignore"):
        products = sums / pairs
    return np.asarray(np.arange(count) * step, np.float64), np.asarray(products, np.float64)


def _add_products(taken: NDArray[np.intp], e: Array, sums: Array, pairs: Array) -> None:
    """Add the products of errors in slots a lag apart, and their number, to those of each lag, in place."""
    for k in range(len(sums)):
        after = np.minimum(np.searchsorted(taken, taken + k), len(taken) - 1)
        both = taken[after] == taken + k
        sums[k] += float(e[both] @ e[after[both]])
        pairs[k] += float(np.count_nonzero(both))
