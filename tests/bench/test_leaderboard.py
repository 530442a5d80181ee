"""Leaderboard and report: intervals, verdicts, paired differences, and a page that says so."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.bench.leaderboard import compare_rows, letters, standings
from magtwin.bench.report import page_of_results
from magtwin.errors import InputError
from magtwin.figures.page import to_html

RUNS = 40


def rows_of(localizer, rmse, *, anees=1.0, failed=0, diverged=0, scenario="tracking", seed=0):
    rng = np.random.default_rng(seed)
    n = RUNS
    bad = np.arange(n) < failed
    return {
        "scenario": np.full(n, scenario),
        "localizer": np.full(n, localizer),
        "run": np.arange(n),
        "seed": 100 + np.arange(n),
        "session": np.arange(n) % 10,
        "status": np.where(bad, "failed", "ok"),
        "reason": np.where(bad, "step raised ZeroDivisionError", ""),
        "smoother": np.zeros(n, bool),
        "global_start": np.full(n, scenario == "global"),
        "recovered_in_time": np.zeros(n, int),
        "kidnapped": np.zeros(n, int),
        "rmse_m": np.where(bad, np.nan, rmse * (1 + 0.1 * rng.standard_normal(n))),
        "heading_rad": np.where(bad, np.nan, 0.02),
        "anees": np.where(bad, np.nan, anees),
        "anees_low": np.where(bad, np.nan, 0.7),
        "anees_high": np.where(bad, np.nan, 1.4),
        "coverage": np.where(bad, np.nan, 0.9),
        "diverged": (np.arange(n) >= failed) & (np.arange(n) < failed + diverged),
        "converged_s": np.where(np.arange(n) < 36, 10.0, np.nan),
        "lost_share": np.zeros(n),
        "bound_correlated_m": np.full(n, 0.05),
        "bound_smoothed_m": np.full(n, 0.03),
        "bound_oracle_m": np.full(n, 0.02),
    }


def joined(*parts):
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def test_a_standing_pools_its_runs_and_counts_failures_as_diverged():
    (standing,) = standings(rows_of("f", 0.1, failed=4, diverged=2))
    assert standing.runs == RUNS
    assert standing.failed == 4
    assert_allclose(standing.rmse_m.value, 0.1, rtol=0.1)
    assert standing.rmse_m.low < standing.rmse_m.value < standing.rmse_m.high
    assert_allclose(standing.ratio, 2.0, rtol=0.1)
    assert standing.diverged.value == 6 / RUNS
    assert standing.converged is None
    assert "4 of 40 runs failed" in standing.verdict()
    assert "diverges in 15 % of runs" in standing.verdict()


@pytest.mark.parametrize(
    ("anees", "text"), [(4.0, "too sure of itself: errors are 2.0 times"), (0.25, "too cautious"), (1.0, "")]
)
def test_the_verdict_says_whether_the_covariance_is_right(anees, text):
    (standing,) = standings(rows_of("f", 0.1, anees=anees))
    assert text in standing.verdict()
    assert bool(standing.verdict()) == bool(text)


def test_an_unknown_start_counts_as_found_within_30_s_and_no_later():
    (standing,) = standings(rows_of("f", 0.1, scenario="global"))
    assert standing.converged.value == 0.9
    assert standing.converged.low < 0.9 < standing.converged.high


def test_a_smoother_is_measured_by_its_own_bound():
    rows = rows_of("f", 0.1)
    rows["smoother"][:] = True
    assert standings(rows)[0].bound_m == pytest.approx(0.03)


def test_a_localizer_with_a_compensator_is_measured_by_the_bound_of_a_known_own_field():
    rows = rows_of("f", 0.1)
    assert standings(rows, compensated=["f"])[0].bound_m == pytest.approx(0.02)
    rows["smoother"][:] = True
    assert np.isnan(standings(rows, compensated=["f"])[0].bound_m)


def test_one_lost_run_does_not_carry_the_anees():
    rows = rows_of("f", 0.1)
    rows["anees"] = np.linspace(0.9, 1.1, RUNS)
    rows["anees"][7] = 1e5
    (standing,) = standings(rows)
    assert standing.anees.value == pytest.approx(1.0, abs=0.01)
    assert (standing.anees.low, standing.anees.high) == pytest.approx((0.95, 1.05), abs=0.01)
    assert standing.anees_inside == (RUNS - 1) / RUNS
    assert standing.verdict() == ""


def test_paired_differences_find_a_small_change_that_intervals_hide():
    before, after = rows_of("f", 0.10, seed=1), rows_of("f", 0.10, seed=1)
    after["rmse_m"] = after["rmse_m"] - 0.004 + 0.001 * np.random.default_rng(2).standard_normal(RUNS)
    (difference,) = compare_rows(after, before)
    assert_allclose(difference.rmse_m.difference, -0.004, atol=0.001)
    assert difference.rmse_m.p < 0.05
    assert difference.runs == RUNS
    one, other = standings(after)[0].rmse_m, standings(before)[0].rmse_m
    assert one.high > other.low  # the intervals of the two overlap


def test_only_runs_that_both_finished_are_compared_and_none_is_an_error():
    (difference,) = compare_rows(rows_of("f", 0.1, failed=4), rows_of("f", 0.1))
    assert difference.runs == RUNS - 4
    assert (difference.failed_a, difference.failed_b) == (4, 0)
    with pytest.raises(InputError, match="share no scenario, localizer and seed"):
        compare_rows(rows_of("f", 0.1), rows_of("g", 0.1))


def test_the_page_names_failures_and_escapes_names():
    rows = joined(rows_of("<b>f</b>", 0.1, failed=2), rows_of("odometry", 0.5))
    page = page_of_results(rows, None, [], {}, title="Benchmark small")
    assert "<b>f</b>" not in to_html(page)
    titles = [table.title for table in page.sections[1].tables]
    assert titles == ["Accuracy", "Reliability", "Paired differences", "Failures"]
    assert "step raised ZeroDivisionError" in to_html(page)


def test_localizers_share_a_letter_if_no_difference_is_shown():
    """b and c err alike; a is better, and d is worse."""
    parts = {"c": rows_of("c", 0.1, seed=1), "b": rows_of("b", 0.1, seed=2), "a": rows_of("a", 0.05, seed=3)}
    parts["d"] = rows_of("d", 0.2, seed=4)
    rows = {key: np.concatenate([each[key] for each in parts.values()]) for key in parts["a"]}
    found = letters(rows, standings(rows))
    assert found["a"] == "a"
    assert found["b"] == found["c"] == "b"
    assert found["d"] == "c"
    assert letters(rows_of("only", 0.1), standings(rows_of("only", 0.1))) == {"only": "a"}
