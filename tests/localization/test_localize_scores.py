"""Scores, on tracks whose errors are made by hand."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from magtwin.localization.scores import anees_interval, independent, score
from magtwin.localization.track import Track

RATE = 5


def truth(n):
    t = np.arange(n) / RATE
    return np.column_stack([np.cos(t / 9), np.sin(t / 9), t / 9 + np.pi / 2])


def track(error, sd=0.05, lost=None, turn=None):
    """A track that is off by `error` along x and y, shape (N, 2)."""
    n = len(error)
    pose = truth(n)
    pose[:, :2] += error
    pose[:, 2] += 0.0 if turn is None else turn
    covariance = np.broadcast_to(np.diag([sd**2, sd**2, 0.02**2]), (n, 3, 3))
    lost = np.zeros(n, bool) if lost is None else lost
    return Track(np.arange(n) / RATE, pose, covariance, np.full(n, np.nan), lost, 12e-6)


def far(n, rows, by=1.0):
    error = np.zeros((n, 2))
    error[rows, 0] = by
    return error


def test_errors_are_those_of_numpy_and_never_aligned():
    error = np.random.default_rng(0).normal(0, 0.05, (400, 2))
    shifted = error + np.array([0.06, -0.08])
    made = score(track(shifted, turn=2 * np.pi + 0.01), truth(400))
    size = np.linalg.norm(shifted, axis=1)
    assert made.rmse_m == pytest.approx(np.sqrt(np.mean(size**2)))
    assert made.median_m == pytest.approx(np.median(size))
    assert made.p95_m == pytest.approx(np.quantile(size, 0.95))
    assert made.end_m == pytest.approx(size[-1])
    assert made.heading_rad == pytest.approx(0.01)
    assert made.step_us == pytest.approx(12)
    assert made.rmse_m > 0.1  # the offset of 0.1 m is an error


def test_a_right_covariance_has_anees_1_and_covers_90_percent():
    rng = np.random.default_rng(1)
    error = rng.normal(0, 0.05, (20000, 2))
    made = score(track(error, turn=rng.normal(0, 0.02, 20000)), truth(20000))
    assert made.anees == pytest.approx(1, abs=4 * math.sqrt(2 / 60000))  # four standard deviations
    assert made.anees_position == pytest.approx(1, abs=4 * math.sqrt(2 / 40000))
    assert made.coverage == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / 20000))
    assert made.anees_low < made.anees < made.anees_high
    half = score(track(error, sd=0.025), truth(20000))
    assert half.anees_position == pytest.approx(4 * made.anees_position)


def test_the_chi_square_interval_is_scipys_for_independent_errors_and_wider_for_others():
    rng = np.random.default_rng(3)
    squares = chi2.rvs(3, size=2000, random_state=rng)
    assert independent(squares) == pytest.approx(2000, rel=0.1)
    low, high = anees_interval(squares, 3)
    freedom = 3 * independent(squares)
    assert_allclose([low, high], chi2.interval(0.95, freedom) / np.array(freedom), rtol=1e-9)
    # of a first-order process with coefficient a, N (1 - a) / (1 + a) values are independent
    a, walk = 0.9, np.empty(200000)
    noise = rng.normal(size=len(walk))
    walk[0] = noise[0]
    for k in range(1, len(walk)):
        walk[k] = a * walk[k - 1] + noise[k]
    assert independent(walk) == pytest.approx(len(walk) * (1 - a) / (1 + a), rel=0.1)


def test_convergence_must_be_held_for_10_s():
    n = 60 * RATE
    error = far(n, slice(0, 100))
    error[60:70] = 0.01  # 2 s below 0.25 m do not count
    made = score(track(error), truth(n), global_start=True)
    assert made.converged_s == pytest.approx(100 / RATE)
    assert made.rmse_m == 0  # only rows after it count
    assert not made.diverged
    never = score(track(far(n, slice(0, n))), truth(n), global_start=True)
    assert math.isnan(never.converged_s)
    assert never.rmse_m == 1
    assert never.diverged
    late = score(track(far(n, slice(0, n - 40))), truth(n), global_start=True)
    assert math.isnan(late.converged_s)  # 8 s are left


@pytest.mark.parametrize(("rows", "diverged"), [(26, False), (27, True)])
def test_divergence_is_half_a_metre_for_more_than_5_s(rows, diverged):
    n = 300
    assert score(track(far(n, slice(100, 100 + rows))), truth(n)).diverged is diverged
    assert not score(track(far(n, slice(100, 200), by=0.49)), truth(n)).diverged
    flagged = np.zeros(n, bool)
    flagged[100:200] = True
    told = score(track(far(n, slice(100, 100 + rows)), lost=flagged), truth(n))
    assert told.diverged is diverged
    assert not told.diverged_unflagged


def test_recovery_is_timed_from_each_kidnapping():
    n = 90 * RATE
    error = far(n, slice(150, 180))
    error[300:, 1] = 2.0
    made = score(track(error), truth(n), kidnapped_s=(30.0, 60.0))
    assert_allclose(made.recovery_s, [6.0, math.nan])
    assert made.recovered == 1
    assert made.diverged  # after the second, which it never got over, all readings count
    assert math.isnan(made.row()["recovery_s"])
    once = score(track(far(n, slice(150, 180))), truth(n), kidnapped_s=(30.0,))
    assert once.rmse_m == 0
    assert once.row()["recovery_s"] == pytest.approx(6.0)
