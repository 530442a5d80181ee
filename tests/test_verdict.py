"""Verdicts: what they call better, worse and too narrow."""

import math

import numpy as np

from magtwin.report.verdict import coverage, recordings_text, verdict


def test_a_verdict_says_by_how_much_and_whether_the_intervals_hold():
    good = verdict(100.0, 400.0, coverage=0.93, judged_on="3 runs")
    assert good == (
        "Better than the naive mean: mean error 100 nT against 400 nT, a ratio of 0.25. Its 90 % intervals "
        "hold 93% of the readings. Judged on 3 runs."
    )
    assert verdict(460.0, 400.0, coverage=0.63).startswith(
        "WORSE than the naive mean: mean error 460 nT against 400 nT, a ratio of 1.15"
    )
    assert "63% of the readings: they are TOO NARROW." in verdict(460.0, 400.0, coverage=0.63)
    assert verdict(100.0, 400.0, coverage=0.99).endswith("99% of the readings: they are too wide.")


def test_models_are_equal_where_the_interval_of_their_ratio_holds_one():
    assert verdict(380.0, 400.0).startswith("Better")
    assert verdict(380.0, 400.0, interval=(0.85, 1.05)).startswith(
        "No better than the naive mean: mean error 380 nT against 400 nT, a ratio of 0.95"
    )
    assert verdict(440.0, 400.0, interval=(0.9, 1.3)).startswith("No better")
    assert verdict(440.0, 400.0, interval=(1.02, 1.3)).startswith("WORSE")
    assert verdict(396.0, 400.0, interval=(math.nan, math.nan)).startswith("No better")


def test_without_errors_there_is_no_verdict():
    assert verdict(math.nan, 400.0) == verdict(0.0, 0.0) == "No verdict: no reading has a known error."


def test_coverage_of_normal_errors_is_ninety_per_cent():
    error = np.random.default_rng(1).normal(0.0, 7.0, 100_000)
    assert abs(coverage(error, np.full(len(error), 7.0)) - 0.9) < 0.004  # 4 sigma of a binomial share
    assert math.isnan(coverage(error, np.full(len(error), np.nan)))


def test_what_a_model_never_saw_is_counted():
    text = recordings_text(15, ["0-1", "0-2", "0-1"], ["A", "B"], ["0-1", "7-1"], ["B"])
    assert text == "15 recordings; 1 of 2 sessions and 1 of 2 paths are new to it"
    assert recordings_text(2, ["a"], ["A"], None, None).endswith(
        "the weights do not say what they were trained on"
    )
