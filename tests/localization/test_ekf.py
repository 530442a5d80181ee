"""EKF: against batch Gaussian regression, numerical derivatives, bounds, and wrong sensors."""

import math
from dataclasses import replace

import numpy as np
from drives import circle, drive, estimates, poses, rough_map, squared_errors
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from magtwin.field.maps.map import AnomalyMap
from magtwin.localization.ekf import Ekf
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import OdometryModel, Prior, SensorModel

FIELD = rough_map(headings=24)


def plane_map():
    """A field that is linear in x and y."""
    corners = 40_000 + np.array([[-50, 50], [-50, 50]]) * 900.0 + np.array([[-50, -50], [50, 50]]) * 500.0
    return AnomalyMap(values_nt=corners[None], origin_m=(-50, -50), cell_m=(100, 100), headings_rad=[0.0])


def test_on_a_linear_field_it_is_gaussian_regression():
    """Straight ahead with a known heading everything is linear, and one batch gives the same."""
    model = OdometryModel(position_std=0.05, yaw_std=0, turn_std=0, yaw_std_s=0, scale_std=0)
    sensor = SensorModel(iron_nt=0.0)
    pose = np.column_stack([0.05 * np.arange(60), np.zeros(60), np.zeros(60)])
    problem, readings = drive(plane_map(), pose, 1, sensor=sensor, odometry=model, prior_sd=(0.2, 0.3, 1e-9))
    made = estimates(Ekf(), problem, readings)
    n, t = len(pose), np.array([r.t for r in readings])
    odom = np.array([r.odometry for r in readings])
    step = model.position_std**2 * np.hypot(*np.diff(odom[:, :2], axis=0).T)  # variance of each step
    walked = np.concatenate([[0.0], np.cumsum(step)])
    walk = np.minimum(walked[:, None], walked)
    along_x, along_y = 0.2**2 + walk, 0.3**2 + walk
    reading = 900.0**2 * along_x + 500.0**2 * along_y + sensor.offset_nt**2
    reading = reading + sensor.drift_nt**2 * np.exp(-np.abs(t[:, None] - t) / 5.0)
    reading[np.arange(n), np.arange(n)] += sensor.white_nt**2
    mean = np.array(problem.prior.mean)[:2] + odom[:, :2]
    nu = np.array([r.b_nt for r in readings]) - 40_000 - mean @ (900.0, 500.0)
    k = n - 1
    to_x, to_y = 900.0 * along_x[k], 500.0 * along_y[k]
    assert_allclose(made[k].x, mean[k, 0] + to_x @ np.linalg.solve(reading, nu), atol=1e-6)
    assert_allclose(made[k].y, mean[k, 1] + to_y @ np.linalg.solve(reading, nu), atol=1e-6)
    assert_allclose(
        made[k].covariance[0, 0], along_x[k, k] - to_x @ np.linalg.solve(reading, to_x), rtol=1e-5
    )
    assert_allclose(made[k].covariance[0, 1], -to_x @ np.linalg.solve(reading, to_y), rtol=1e-5)
    expected = sensor.offset_nt**2 * np.ones(n) @ np.linalg.solve(reading, nu)
    assert_allclose(made[k].bias_nt, expected, rtol=1e-6)


def test_it_tracks_with_covariances_of_the_right_size():
    smooth, last, off = rough_map(length_m=1.2, headings=24), [], []
    for seed in range(40):
        pose = circle(150, start=seed)
        problem, readings = drive(smooth, pose, seed, prior_sd=(0.03, 0.03, 0.02))
        made = estimates(Ekf(), problem, readings)
        last.append(squared_errors(made, pose)[-1])
        off.append(np.hypot(*(poses(made)[-1, :2] - pose[-1, :2])))
    low, high = stats.chi2(3 * len(last)).ppf([0.005, 0.995])
    assert low < sum(last) < high
    assert math.sqrt(np.mean(np.square(off))) < 0.12


def test_nan_stuck_and_off_map_readings_are_not_used():
    problem, readings = drive(FIELD, circle(60), 3)
    silent = [replace(r, b_nt=math.nan) if k > 30 else r for k, r in enumerate(readings)]
    stuck = [replace(r, b_nt=readings[30].b_nt) if k > 30 else r for k, r in enumerate(readings)]
    a, b = (poses(estimates(Ekf(), problem, rows)) for rows in (silent, stuck))
    assert_array_equal(a, b)
    away = replace(problem, prior=Prior(mean=(20.0, 0.0, 0.0)))
    made = estimates(Ekf(), away, readings)
    reckoned = estimates(load_localizer("odometry"), away, readings)
    assert_allclose(poses(made), poses(reckoned), atol=1e-9)


def test_it_knows_that_it_is_lost():
    problem, readings = drive(FIELD, circle(30), 5, prior_sd=(math.inf, math.inf, math.inf))
    assert all(e.lost for e in estimates(Ekf(), problem, readings))
    problem, readings = drive(FIELD, circle(100), 6)
    assert not any(e.lost for e in estimates(Ekf(), problem, readings))
    wrong = replace(problem, belief=rough_map(9, headings=24))
    assert any(e.lost for e in estimates(Ekf(), wrong, readings))
