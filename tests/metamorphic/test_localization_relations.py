"""Relations between localizations: moved, turned, scaled and biased problems."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from relations import SHIFT, rotation, turned_map
from synthetic import drive, wavy_map

from magtwin.localization.localizers import load_localizer
from magtwin.localization.track import track

EXACT = ("ekf", "odometry", "smoother")  # Methods without random draws
METHODS = (*EXACT, "rbpf")


@pytest.fixture(scope="session")
def case():
    return drive(wavy_map(0), 3, seconds=12.0)


@pytest.fixture(scope="session")
def tracks(case):
    return {method: followed(method, case.problem, case.readings) for method in METHODS}


def followed(method, problem, readings):
    return track(load_localizer(method), problem, readings)


@pytest.mark.parametrize("method", METHODS)
def test_a_moved_problem_has_a_moved_track(method, case, tracks):
    problem = case.problem
    x0, x1, y0, y1 = problem.extent
    origin = np.array(problem.belief.origin_m) + SHIFT
    x, y, yaw = problem.prior.mean
    other = replace(
        problem,
        belief=replace(problem.belief, origin_m=tuple(origin.tolist())),
        extent=(x0 + SHIFT[0], x1 + SHIFT[0], y0 + SHIFT[1], y1 + SHIFT[1]),
        prior=replace(problem.prior, mean=(x + SHIFT[0], y + SHIFT[1], yaw)),
    )
    again = followed(method, other, case.readings).pose
    assert_allclose(again - (*SHIFT, 0.0), tracks[method].pose, atol=1e-5)


@pytest.mark.parametrize("method", EXACT)
def test_a_turned_problem_has_a_turned_track(method, case, tracks):
    problem, turn = case.problem, rotation(np.pi / 2)
    x0, x1, y0, y1 = problem.extent
    x, y, yaw = problem.prior.mean
    other = replace(
        problem,
        belief=turned_map(problem.belief),
        extent=(-y1, -y0, x0, x1),
        prior=replace(problem.prior, mean=(-y, x, yaw + np.pi / 2)),
    )
    again = followed(method, other, case.readings).pose
    assert_allclose(again[:, :2], tracks[method].pose[:, :2] @ turn.T, atol=1e-5)


@pytest.mark.parametrize("method", ["ekf", "odometry"])
def test_a_problem_ten_times_as_large_has_a_track_ten_times_as_large(method, case, tracks):
    problem, odometry = case.problem, case.problem.odometry
    x, y, yaw = problem.prior.mean
    sd = problem.prior.sd
    belief = problem.belief
    other = replace(
        problem,
        belief=replace(
            belief,
            origin_m=tuple(10 * v for v in belief.origin_m),
            cell_m=tuple(10 * v for v in belief.cell_m),
        ),
        extent=tuple(10 * v for v in problem.extent),
        prior=replace(problem.prior, mean=(10 * x, 10 * y, yaw), sd=(10 * sd[0], 10 * sd[1], sd[2])),
        odometry=replace(
            odometry,
            position_std=np.sqrt(10) * odometry.position_std,
            position_std_s=10 * odometry.position_std_s,
            yaw_std=odometry.yaw_std / np.sqrt(10),
        ),
        map_length_m=10 * problem.map_length_m,
    )
    readings = case.readings.with_columns(odom_p=10 * case.readings["odom_p"])
    again = followed(method, other, readings).pose
    assert_allclose(again / (10, 10, 1), tracks[method].pose, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_bias_of_the_map_and_the_readings_changes_nothing(method, case, tracks):
    belief = case.problem.belief
    other = replace(case.problem, belief=replace(belief, values_nt=belief.values_nt + 500.0))
    readings = case.readings.with_columns(b_measured_nt=case.readings["b_measured_nt"] + 500.0)
    assert_allclose(followed(method, other, readings).pose, tracks[method].pose, atol=1e-5)


def test_a_bias_of_the_readings_alone_is_taken_for_the_offset_of_the_sensor(case, tracks):
    readings = case.readings.with_columns(b_measured_nt=case.readings["b_measured_nt"] + 100.0)
    again = followed("ekf", case.problem, readings).pose
    # 100 nT are a fifth of the offset's prior standard deviation, which the drive soon finds out
    assert np.hypot(*(again - tracks["ekf"].pose)[-1, :2]) < 0.02
