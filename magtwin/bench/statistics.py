"""Statistics of benchmarks: intervals over sessions, intervals of rates, and paired differences."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError

Array = NDArray[np.float64]

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


def mean(values: Array) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


def rms(values: Array) -> float:
    """Root mean square: that of the RMSEs of equally long runs is the pooled RMSE."""
    return float(np.sqrt(np.mean(np.square(values))))


def median(values: Array) -> float:
    """Median."""
    return float(np.median(values))


def bootstrap(
    values: ArrayLike,
    sessions: ArrayLike | None = None,
    *,
    statistic: Callable[[Array], float] = mean,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Percentile interval of a statistic by the bootstrap over sessions.

    Runs of a session share its errors, so whole sessions are drawn with replacement (Davison and Hinkley
    1997, Bootstrap Methods and their Application, section 3.8). If all runs are of one session, as those of
    one recording are, single runs are drawn: the interval is then that of the session. One run has none.

    Args:
        values: One figure per run, shape (N,). Failed runs have none: leave them out and report their rate.
        sessions: Session of each run, numbers or texts, shape (N,). Default: each run its own.
        statistic: Function of the figures of all runs drawn.
        level: Probability of the interval.
        resamples: Number of draws; fewer beyond `MOST_DRAWS` sessions in all.
        seed: Seed of the draws.

    Raises:
        InputError: There are no values, one is nan, or the sessions do not match.
    """
    v, index, count = _checked(values, sessions)
    if count == 1:
        return Interval(float(statistic(v)), math.nan, math.nan)
    rng = np.random.default_rng(seed)
    sorted_v, sizes = v[np.argsort(index, kind="stable")], np.bincount(index)
    starts = np.cumsum(sizes) - sizes
    drawn = np.empty(_affordable(resamples, count))
    for k in range(len(drawn)):
        picked = rng.integers(count, size=count)
        ends = np.cumsum(sizes[picked])
        drawn[k] = statistic(
            sorted_v[np.repeat(starts[picked] - ends + sizes[picked], sizes[picked]) + np.arange(ends[-1])]
        )
    low, high = np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])
    return Interval(float(statistic(v)), float(low), float(high))


def rate(successes: int, trials: int, level: float = 0.95) -> Interval:
    """A rate with its exact interval (Clopper and Pearson 1934, Biometrika 26(4)).

    Args:
        successes: Number of successes.
        trials: Number of independent trials, above 0.
        level: Probability of the interval.

    Raises:
        InputError: There are more successes than trials, or none of these.
    """
    _check_counts(successes, trials)
    return Interval(
        successes / trials,
        _least(successes, trials, (1 - level) / 2),
        1 - _least(trials - successes, trials, (1 - level) / 2),
    )


def proven_rate(successes: int, trials: int, confidence: float = 0.95) -> float:
    """The highest rate that the trials prove: the one-sided lower limit of `rate`.

    300 of 300 prove 99 % at 95 % confidence. Arguments and errors are those of `rate`.
    """
    _check_counts(successes, trials)
    return _least(successes, trials, 1 - confidence)


def paired(
    a: ArrayLike,
    b: ArrayLike,
    sessions: ArrayLike | None = None,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Paired:
    """Mean of a - b over runs that both methods made, with its interval and p-value.

    The interval is that of `bootstrap`. The p-value is that of the permutation test that swaps the methods in
    whole sessions: all swaps if there are no more than `resamples`, else as many drawn at random, with the
    one that was seen (Phipson and Smyth 2010, SAGMB 9(1)).

    Args:
        a: Figures of one method, shape (N,).
        b: Figures of the other on the same runs, shape (N,).
        sessions: Session of each run, shape (N,). Default: each run its own.
        level: Probability of the interval.
        resamples: Number of draws; fewer beyond `MOST_DRAWS` sessions in all.
        seed: Seed of the draws.

    Raises:
        InputError: The shapes differ; or an error of `bootstrap`.
    """
    one, other = np.asarray(a, float), np.asarray(b, float)
    if one.shape != other.shape:
        raise InputError(f"a and b of a paired difference must match, got {one.shape} and {other.shape}")
    v, index, count = _checked(one - other, sessions)
    interval = bootstrap(v, index, level=level, resamples=resamples, seed=seed)
    sums = np.bincount(index, weights=v)
    least = abs(sums.sum()) * (1 - 1e-12)
    if 2**count <= resamples:
        signs = 1 - 2 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
        as_far, total, extra = int(np.count_nonzero(np.abs(signs @ sums) >= least)), len(signs), 0
    else:
        rng, total, as_far, extra = np.random.default_rng(seed), _affordable(resamples, count), 0, 1
        rows = max(1, BLOCK // count)
        for first in range(0, total, rows):
            signs = rng.choice(np.array([-1, 1]), (min(rows, total - first), count))
            as_far += int(np.count_nonzero(np.abs(signs @ sums) >= least))
    return Paired(interval.value, interval.low, interval.high, (as_far + extra) / (total + extra))


def _affordable(resamples: int, count: int) -> int:
    """The number of resamples, fewer if there are very many sessions."""
    return min(resamples, max(FEWEST, MOST_DRAWS // count))


def _checked(values: ArrayLike, sessions: ArrayLike | None) -> tuple[Array, NDArray[np.intp], int]:
    """Values, number of the session of each, and number of sessions; one session is split into its runs."""
    v = np.asarray(values, float)
    if v.ndim != 1 or not len(v):
        raise InputError(f"statistics need one figure per run, got shape {v.shape}")
    if not np.isfinite(v).all():
        row = int(np.argmin(np.isfinite(v)))
        raise InputError(f"the figure of run {row} is {v[row]}; leave failed runs out and report their rate")
    if sessions is None:
        return v, np.arange(len(v)), len(v)
    given = np.asarray(sessions)
    if given.shape != v.shape:
        raise InputError(f"sessions must have shape {v.shape}, got {given.shape}")
    names, index = np.unique(given, return_inverse=True)
    if len(names) == 1:
        return v, np.arange(len(v)), len(v)
    return v, index, len(names)


def _check_counts(successes: int, trials: int) -> None:
    if not (trials > 0 and 0 <= successes <= trials):
        raise InputError(f"a rate needs 0 to N successes in N > 0 trials, got {successes} in {trials}")


def _least(successes: int, trials: int, tail: float) -> float:
    """Rate at which so many successes or more have the probability `tail`."""
    from scipy.special import betaincinv

    if successes == 0:
        return 0.0
    return float(betaincinv(successes, trials - successes + 1, tail))
