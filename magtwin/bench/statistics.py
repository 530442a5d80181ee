"""Statistics of benchmarks: intervals over sessions, intervals of rates, and paired differences."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LEVEL = 0.95
"""Probability of the intervals."""

RESAMPLES = 4000

MOST_DRAWS, FEWEST = 10**8, 200
"""Most sessions that are drawn in all resamples together, and the fewest resamples: of 1,000,000 sessions,
whose intervals are narrow, 4000 resamples would take minutes."""

BLOCK = 1 << 20
"""Signs of sessions that are in memory at once."""


class Interval(NamedTuple):
    """An estimate and its interval."""

    value: float
    low: float
    high: float


class Paired(NamedTuple):
    """A mean difference between two methods on the same runs."""

    difference: float
    low: float
    high: float
    p: float
    """Two-sided p-value that there is no difference."""


def rms(values: Array) -> float:
    """Root mean square: that of the RMSEs of equally long runs is the pooled RMSE."""
    return float(np.sqrt(np.mean(np.square(values))))


def bootstrap(
    values: ArrayLike,
    sessions: ArrayLike,
    statistic: Callable[[Array], float],
    *,
    resamples: int = RESAMPLES,
) -> Interval:
    """Percentile interval of a statistic by the bootstrap over sessions.

    Runs of a session share its errors, so whole sessions are drawn with replacement (Davison and Hinkley
    1997, Bootstrap Methods and their Application, section 3.8). If all runs are of one session, as those of
    one recording are, single runs are drawn: the interval is then that of the session. One run has none.

    Args:
        values: One finite figure per run, shape (N,), N > 0. Failed runs have none.
        sessions: Session of each run, shape (N,).
        statistic: Function of the figures of all runs drawn.
        resamples: Number of draws; fewer beyond `MOST_DRAWS` sessions in all.
    """
    v, (index, count) = np.asarray(values, float), _sessions(sessions)
    if count == 1:
        return Interval(statistic(v), np.nan, np.nan)
    rng = np.random.default_rng(0)
    sorted_v, sizes = v[np.argsort(index, kind="stable")], np.bincount(index)
    starts = np.cumsum(sizes) - sizes
    drawn = np.empty(_affordable(resamples, count))
    for k in range(len(drawn)):
        picked = rng.integers(count, size=count)
        ends = np.cumsum(sizes[picked])
        drawn[k] = statistic(
            sorted_v[np.repeat(starts[picked] - ends + sizes[picked], sizes[picked]) + np.arange(ends[-1])]
        )
    low, high = np.percentile(drawn, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return Interval(statistic(v), float(low), float(high))


def rate(successes: int, trials: int) -> Interval:
    """A rate of independent trials with its exact interval (Clopper and Pearson 1934, Biometrika 26(4))."""
    from scipy.special import betaincinv

    def least(count: int) -> float:
        """Rate at which so many successes or more have the probability of a tail."""
        return float(betaincinv(count, trials - count + 1, (1 - LEVEL) / 2)) if count else 0.0

    return Interval(successes / trials, least(successes), 1 - least(trials - successes))


def paired(a: Array, b: Array, sessions: ArrayLike) -> Paired:
    """Mean of a - b over runs that both methods made, with its interval and p-value.

    The interval is that of `bootstrap`. The p-value is that of the permutation test that swaps the methods in
    whole sessions: all swaps if there are no more than `RESAMPLES`, else as many drawn at random, with the
    one that was seen (Phipson and Smyth 2010, SAGMB 9(1)).

    Args:
        a: Figures of one method, shape (N,).
        b: Figures of the other on the same runs, shape (N,).
        sessions: Session of each run, shape (N,).
    """
    v, (index, count) = a - b, _sessions(sessions)
    interval = bootstrap(v, index, lambda values: float(np.mean(values)))
    sums = np.bincount(index, weights=v)
    least = abs(sums.sum()) * (1 - 1e-12)
    if 2**count <= RESAMPLES:
        signs = 1 - 2 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
        as_far, total, extra = int(np.count_nonzero(np.abs(signs @ sums) >= least)), len(signs), 0
    else:
        rng, total, as_far, extra = np.random.default_rng(0), _affordable(RESAMPLES, count), 0, 1
        rows = max(1, BLOCK // count)
        for first in range(0, total, rows):
            signs = rng.choice(np.array([-1, 1]), (min(rows, total - first), count))
            as_far += int(np.count_nonzero(np.abs(signs @ sums) >= least))
    return Paired(interval.value, interval.low, interval.high, (as_far + extra) / (total + extra))


def _affordable(resamples: int, count: int) -> int:
    """The number of resamples, fewer if there are very many sessions."""
    return min(resamples, max(FEWEST, MOST_DRAWS // count))


def _sessions(sessions: ArrayLike) -> tuple[NDArray[np.intp], int]:
    """Number of the session of each run, and number of sessions; one session is split into its runs."""
    names, index = np.unique(np.asarray(sessions), return_inverse=True)
    return (np.arange(len(index)), len(index)) if len(names) == 1 else (index, len(names))
