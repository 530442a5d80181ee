import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.localization.grid.point_mass import LOOPS
from magtwin.localization.problem import Prior, Problem
from magtwin.localization.readings import readings_of
from magtwin.localization.sequence import Sequence
from magtwin.localization.track import track


def test_the_misfits_are_those_of_brute_force():
    field = synthetic.wavy_map(0)
    rng = np.random.default_rng(0)
    path = np.column_stack([-0.1 * np.arange(8), 0.05 * rng.standard_normal(8), 0.1 * rng.standard_normal(8)])
    z = 41_000 + 500 * rng.standard_normal(8)
    root = rng.normal(0, 50, (8, 8))
    covariance = root @ root.T + 1e4 * np.eye(8)
    xs, ys, yaws = np.linspace(-0.8, 0.8, 5), np.linspace(-0.6, 0.6, 4), np.linspace(0, 6, 6)
    costs = np.empty(120)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    code = LOOPS.open()
    code.match(field.tables()[0], path.ravel(), z, whitening.ravel(), xs, ys, yaws, 1e9, costs)
    for k, (h, j, i) in enumerate(np.ndindex(6, 4, 5)):
        c, s = math.cos(yaws[h]), math.sin(yaws[h])
        p = np.array([xs[i], ys[j]]) + path[:, :2] @ np.array([[c, s], [-s, c]])
        r = z - field.mean(p, yaws[h] + path[:, 2])
        assert_allclose(costs[k], r @ np.linalg.solve(covariance, r), rtol=1e-9)
    given_up = np.empty(120)
    code.match(field.tables()[0], path.ravel(), z, whitening.ravel(), xs, ys, yaws, 30.0, given_up)
    kept = np.isfinite(given_up)
    assert_allclose(given_up[kept], costs[kept])
    assert (costs[~kept] > costs.min() + 30).all()
    assert kept[np.argmin(costs)]


def filled(case, **options):
    algorithm = Sequence(every_m=1e6, **options)
    algorithm.reset(case.problem)
    for reading in readings_of(case.readings):
        algorithm.step(reading)
    return algorithm


def test_an_offset_drops_out():
    case = synthetic.drive(synthetic.wavy_map(1), 1, seconds=12, prior=synthetic.UNKNOWN)
    sensor = replace(case.problem.sensor, offset_nt=1e5)
    case.problem = replace(case.problem, sensor=sensor)
    before = filled(case)._placements()
    b = case.readings["b_measured_nt"] + 3000.0
    case.readings = case.readings.with_columns(b_measured_nt=b)
    after = filled(case)._placements()
    assert_allclose(before[0], after[0])
    away = case.truth[-1] - np.array(before)
    away[:, 2] = (away[:, 2] + math.pi) % (2 * math.pi) - math.pi
    assert (np.abs(away) < (0.15, 0.15, 0.2)).all(axis=1).any()  # the truth is among the minima


def test_the_window_keeps_the_last_metres():
    case = synthetic.drive(synthetic.wavy_map(1), 1, seconds=40)
    window = filled(case, length_m=2.0)._window
    p = np.array([r.odometry[:2] for r in window])
    length = np.hypot(*np.diff(p, axis=0).T).sum()
    assert 1.8 < length <= 2.06
    assert window[-1].t > 39


@pytest.mark.parametrize("seed", range(4))
def test_a_global_start_finds_the_pose(seed):
    case = synthetic.drive(synthetic.wavy_map(seed), seed, prior=synthetic.UNKNOWN, seconds=30)
    made, score = synthetic.scored(Sequence(), case)
    assert made.lost[0]
    assert not made.lost[-25:].any()
    assert score.error[-25:].max() < 0.3


def test_a_known_heading_limits_the_search():
    case = synthetic.drive(synthetic.wavy_map(1), 1, seconds=12)
    heading = float(case.truth[0, 2])
    prior = Prior(mean=(0.0, 0.0, heading), sd=(math.inf, math.inf, 0.1))
    case.problem = replace(case.problem, prior=prior)
    algorithm = filled(case)
    away = np.array([pose[2] for pose in algorithm._placements()]) - case.truth[-1, 2]
    away = (away + math.pi) % (2 * math.pi) - math.pi
    assert np.abs(away).max() < 0.8
    assert len(algorithm._headings()) < 18


def test_tracking_is_consistent():
    errors, nees = [], []
    for seed in range(5):
        _, score = synthetic.scored(Sequence(), synthetic.drive(synthetic.wavy_map(seed), seed))
        errors.append(score.error[25:])
        nees.append(score.nees[25:].mean())
    assert math.sqrt(np.mean(np.square(errors))) < 0.1
    assert 0.6 < np.mean(nees) < 1.7  # the last metres alone: linearised, and without earlier readings


def test_readings_without_a_value_and_off_the_map_are_left_out():
    case = synthetic.drive(synthetic.wavy_map(5), 5, seconds=20, margin=-0.3)
    b = case.readings["b_measured_nt"].copy()
    b[~np.isfinite(b)] = 41_000.0
    b[50:60] = np.nan
    case.readings = case.readings.with_columns(b_measured_nt=b)
    made = track(Sequence(), case.problem, case.readings)  # refuses what is not finite
    assert np.isfinite(made.covariance).all()


def test_wrong_options_and_a_problem_without_map_are_refused():
    with pytest.raises(InputError, match="length_m of Sequence must be above 0"):
        Sequence(length_m=0.0)
    with pytest.raises(InputError, match="needs a map"):
        Sequence().reset(Problem(belief=None, extent=synthetic.EXTENT))
