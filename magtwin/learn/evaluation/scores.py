"""Scores: errors of models, with intervals that account for correlated readings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.report.verdict import Z_90

Array = NDArray[np.float64]
Interval = tuple[float, float]

BLOCK_S = 5.0
"""Length of the blocks of time that are resampled [s]: the robot's own field changes within seconds, and the
map's error within 1 m."""

DRAWS = 1000  # Number of resamples
LEVEL = 0.95  # Confidence level of intervals
COVERED = 0.9  # Nominal coverage of a predicted interval

_ABS, _SQUARE, _SUM, _KNOWN, _WITHIN, _OUTSIDE = range(6)


@dataclass(frozen=True)
class Score:
    """Errors of one model on some readings, with intervals of level `LEVEL`."""

    rows: int
    """Number of readings."""

    mae_nt: float
    """Mean absolute error [nT]."""
    mae_interval_nt: Interval
    """Its interval [nT]."""

    ratio: float
    """`mae_nt` divided by that of the naive model on the same readings."""
    ratio_interval: Interval
    """Its interval; both errors are resampled together."""

    rmse_nt: float
    """Root mean square error [nT]."""

    bias_nt: float
    """Mean error, predicted minus measured [nT]."""

    coverage: float
    """Share of the readings in the predicted 90 % interval; nan if none is predicted."""
    coverage_interval: Interval
    """Its interval."""

    outside: float
    """Share of the readings with an input outside the training ranges."""


class Errors(NamedTuple):
    """Errors of several models on the readings of one run.

    Its session, its row of the table, times [s], shape (N,), predicted minus measured [nT], shape (M, N),
    predicted standard deviations [nT], nan if there is none, and whether an input is outside the training
    ranges.
    """

    session: str
    group: str
    t: Array
    error_nt: Array
    sd_nt: Array
    outside: NDArray[np.bool_]

    def sums(self) -> tuple[Array, Array]:
        """Readings in each block of `BLOCK_S`, (K,), and the sums that scores are computed from, (K, M,
        6).
        """
        block = ((self.t - self.t[0]) // BLOCK_S).astype(int)
        block = np.unique(block, return_inverse=True)[1]
        size = np.abs(self.error_nt)
        known = np.isfinite(self.sd_nt)
        within = known & (size <= Z_90 * np.where(known, self.sd_nt, 0.0))
        parts = (size, size**2, self.error_nt, known, within, self.outside)
        count = int(block.max()) + 1
        made: Array = np.array([[np.bincount(block, row, count) for row in part] for part in parts], float)
        return np.bincount(block, minlength=count).astype(float), np.moveaxis(made, (0, 1, 2), (2, 1, 0))


def scores(
    runs: Sequence[Errors], *, rng: np.random.Generator, draws: int = DRAWS
) -> tuple[dict[str, tuple[Score, ...]], tuple[Score, ...], tuple[Score, ...]]:
    """Scores of each model in each group, on all readings, and in the mean of the groups; the first is naive.

    Intervals are percentiles of a hierarchical bootstrap: sessions, then runs within each group of a session,
    then blocks of time within each run, all with replacement (Davison and Hinkley 1997, section 3.8; Künsch
    1989 for blocks). With one session or one run only the lower levels are resampled, and the interval does
    not cover other sessions.

    Returns:
        Scores of each model by group, in order of first appearance; on all readings; and in the mean over
        groups.
    """
    groups = list(dict.fromkeys(run.group for run in runs))
    children = iter(rng.spawn(len(groups) + 1))
    by_group: dict[str, tuple[Score, ...]] = {}
    for group in groups:
        own = [run for run in runs if run.group == group]
        rows, whole, drawn = _resampled(own, [group], next(children), draws)
        by_group[group] = _scores(rows[0], _figures(whole[0]), _figures(drawn[0]))
    rows, whole, drawn = _resampled(runs, groups, next(children), draws)
    every = _scores(rows.sum(), _figures(whole.sum(axis=0)), _figures(drawn.sum(axis=0)))
    if len(groups) == 1:
        return by_group, every, every
    mean, spread = (
        [np.mean(parts, axis=0) for parts in zip(*map(_figures, sums), strict=True)]
        for sums in (whole, drawn)
    )
    return by_group, every, _scores(rows.sum(), mean, spread)


def _resampled(
    runs: Sequence[Errors], groups: Sequence[str], rng: np.random.Generator, draws: int
) -> tuple[NDArray[np.intp], Array, Array]:
    """Rows (C,), sums (C, M, 7), and resampled sums (C, D, M, 7); the last of the seven is the rows."""
    sessions = list(dict.fromkeys(run.session for run in runs))
    models = len(runs[0].error_nt)
    rows = np.zeros(len(groups), np.intp)
    whole, drawn = np.zeros((len(groups), models, 7)), np.zeros((len(groups), draws, models, 7))
    often = rng.multinomial(len(sessions), np.full(len(sessions), 1 / len(sessions)), draws)
    for s, session in enumerate(sessions):
        for g, group in enumerate(groups):
            own = [run for run in runs if (run.session, run.group) == (session, group)]
            if not own:
                continue
            of_runs = rng.multinomial(often[:, s] * len(own), np.full(len(own), 1 / len(own)))
            for r, run in enumerate(own):
                count, sums = run.sums()
                sums = np.concatenate([sums, np.broadcast_to(count[:, None, None], (*sums.shape[:2], 1))], 2)
                of_blocks = rng.multinomial(of_runs[:, r] * len(count), np.full(len(count), 1 / len(count)))
                rows[g] += len(run.t)
                whole[g] += sums.sum(axis=0)
                drawn[g] += np.tensordot(of_blocks, sums, axes=1)
    return rows, whole, drawn


def _figures(sums: Array) -> list[Array]:
    """MAE, ratio, RMSE, bias, coverage and share outside, each (..., M), from sums (..., M, 7).

    They are nan for a draw without readings.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        count = sums[..., 6]
        mae = sums[..., _ABS] / count
        coverage = np.where(sums[..., _KNOWN] == count, sums[..., _WITHIN] / count, np.nan)
        return [
            mae,
            mae / mae[..., :1],
            np.sqrt(sums[..., _SQUARE] / count),
            sums[..., _SUM] / count,
            coverage,
            sums[..., _OUTSIDE] / count,
        ]


def _scores(rows: np.intp, figures: Sequence[Array], spreads: Sequence[Array]) -> tuple[Score, ...]:
    """A Score for each model from its figures (M,) and those of the draws (D, M)."""
    scores = []
    for m in range(len(figures[0])):
        mae, ratio, rmse, bias, coverage, outside = (float(values[m]) for values in figures)
        of_mae, of_ratio, of_coverage = (_interval(spreads[k][:, m]) for k in (0, 1, 4))
        scores.append(
            Score(int(rows), mae, of_mae, ratio, of_ratio, rmse, bias, coverage, of_coverage, outside)
        )
    return tuple(scores)


def _interval(values: Array) -> Interval:
    """The central `LEVEL` of the draws that have readings."""
    known = values[np.isfinite(values)]
    if not len(known):
        return math.nan, math.nan
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)
