"""Scores: figures that add up, and intervals that are as wide as days differ."""

import numpy as np
import pytest

from magtwin.learn.evaluation.scores import Errors, scores


def some_errors(error, session="a", group="A", sd=np.nan, rate_hz=10.0):
    """Errors of models (M, N) on a run."""
    error = np.atleast_2d(np.asarray(error, float))
    t = np.arange(error.shape[1]) / rate_hz
    return Errors(session, group, t, error, np.full(error.shape, sd), np.zeros(error.shape, bool))


def scored(runs, seed=0, draws=400):
    return scores(runs, rng=np.random.default_rng(seed), draws=draws)


def test_figures_are_those_of_the_errors_themselves():
    rng = np.random.default_rng(1)
    parts = [rng.normal([[50.0], [10.0]], [[100.0], [40.0]], (2, n)) for n in (137, 60)]
    runs = [some_errors(part, session) for part, session in zip(parts, "ab", strict=True)]
    _, (naive, one), _ = scored(runs)
    every = np.concatenate(parts, axis=1)
    assert one.rows == 197
    assert one.mae_nt == pytest.approx(np.abs(every[1]).mean())
    assert one.rmse_nt == pytest.approx(np.sqrt((every[1] ** 2).mean()))
    assert one.bias_nt == pytest.approx(every[1].mean())
    assert one.ratio == pytest.approx(one.mae_nt / naive.mae_nt)
    assert naive.ratio == 1.0
    assert naive.ratio_interval == (1.0, 1.0)


def test_the_mean_of_cases_counts_each_path_alike():
    runs = [some_errors(np.full((1, 900), 100.0), group="A"), some_errors(np.full((1, 50), 10.0), group="B")]
    by_case, (every,), (mean,) = scored(runs)
    assert list(by_case) == ["A", "B"]
    assert mean.mae_nt == pytest.approx(55.0)
    assert every.mae_nt == pytest.approx((900 * 100 + 50 * 10) / 950)


def test_intervals_are_as_wide_as_sessions_differ_however_many_rows_there_are():
    rng = np.random.default_rng(2)
    offsets = rng.normal(200, 50, 12)
    few = [some_errors(np.full((1, 100), o), str(k)) for k, o in enumerate(offsets)]
    many = [some_errors(np.full((1, 5000), o), str(k)) for k, o in enumerate(offsets)]
    (a,), (b,) = scored(few)[1], scored(many)[1]
    assert a.mae_interval_nt == pytest.approx(b.mae_interval_nt)
    low, high = a.mae_interval_nt
    assert high - low == pytest.approx(2 * 1.96 * offsets.std() / np.sqrt(12), rel=0.15)  # 400 draws


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(3)
    held = []
    for trial in range(60):
        offsets = rng.normal(0, 1, 30)
        runs = [some_errors(200 + 50 * o + np.zeros((1, 60)), str(k)) for k, o in enumerate(offsets)]
        low, high = scored(runs, trial, 200)[1][0].mae_interval_nt
        held.append(low < 200 < high)
    assert 0.84 <= np.mean(held) <= 1.0  # 0.95 less three standard deviations of 60 trials
