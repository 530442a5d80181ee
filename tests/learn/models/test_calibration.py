import math

import numpy as np
import pytest

from magtwin.learn.models.calibration import (
    few_groups_factor,
    fit_spread,
    quantile_factor,
    transferred_factor,
    yardstick,
)
from magtwin.report.verdict import Z_90, coverage


def days(rng, count, rows, offset_nt=100.0, noise_nt=50.0):
    """Errors on days that have an offset each, and which day each row is of."""
    groups = np.repeat(np.arange(count), rows)
    return offset_nt * rng.normal(size=count)[groups] + noise_nt * rng.normal(size=len(groups)), groups


def test_the_spread_of_errors_that_grow_with_an_input_is_found():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(40_000, 3))
    error = rng.normal(size=len(z)) * np.sqrt(30.0**2 + (80.0 * z[:, 1]) ** 2)
    spread = fit_spread(z, error)
    assert math.sqrt(spread.floor_nt2) == pytest.approx(30, rel=0.05)
    assert np.sqrt(spread.slopes_nt2[1]) == pytest.approx(80, rel=0.05)
    assert np.all(np.sqrt(spread.slopes_nt2[[0, 2]]) < 8)


def test_the_factor_makes_nine_of_ten_rows_lie_within():
    rng = np.random.default_rng(1)
    error, sd, groups = rng.laplace(size=5000), rng.uniform(1, 2, 5000), np.arange(5000) % 7
    factor = quantile_factor(error, sd, groups)
    assert coverage(error, factor * sd) == pytest.approx(0.9, abs=0.002)


def test_a_long_recording_counts_as_much_as_a_short_one():
    error = np.concatenate([np.full(9900, 1.0), np.full(100, 50.0)])
    groups = np.repeat([0, 1], [9900, 100])
    assert quantile_factor(error, np.ones(10_000), groups) == pytest.approx(50.0 / Z_90)


def test_offsets_of_few_days_widen_by_students_t_and_noise_within_them_does_not():
    rng = np.random.default_rng(2)
    offsets, groups = days(rng, 3, 400, noise_nt=0.0)
    noise, _ = days(rng, 3, 400, offset_nt=0.0)
    assert few_groups_factor(offsets, groups) == pytest.approx(2.92 / Z_90, rel=1e-3)  # t of 2 at 0.95
    assert few_groups_factor(noise, groups) == pytest.approx(1.0, abs=0.01)
    assert few_groups_factor(offsets, np.zeros(len(groups), int)) == 1.0


def test_intervals_from_a_few_days_hold_nine_of_ten_rows_of_other_days():
    rng, held = np.random.default_rng(3), []
    for _ in range(200):
        error, groups = days(rng, 6, 50)
        sd = np.full(len(error), 70.0)
        factor = quantile_factor(error, sd, groups) * few_groups_factor(error, groups)
        fresh, _ = days(rng, 20, 50)
        held.append(coverage(fresh, np.full(len(fresh), 70.0 * factor)))
    assert np.mean(held) == pytest.approx(0.9, abs=0.02)


def test_the_luck_of_one_validation_day_is_cancelled_by_a_yardstick_held_against_many():
    rng, with_luck, without = np.random.default_rng(4), [], []
    for _ in range(100):
        error, groups = days(rng, 10, 50)
        sd, last = np.full(len(error), 70.0), groups == 9
        known = yardstick(error, sd, groups, last)
        model = 0.8 * error[last]  # a model that is a fifth better, on the same day
        without.append(transferred_factor(model, sd[last], groups[last], known))
        with_luck.append(quantile_factor(model, sd[last], groups[last]))
    spread = [np.std(factors) / np.mean(factors) for factors in (without, with_luck)]
    assert spread[0] < 0.5 * spread[1]
