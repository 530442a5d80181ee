import math

import numpy as np
import synthetic
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from magtwin.localization.grid.point_mass import PointMass
from magtwin.localization.problem import OdometryModel, SensorModel
from magtwin.localization.smoother import Graph, MapSmoother
from magtwin.localization.track import track


def short_case(**options):
    sensor = SensorModel(iron_nt=100.0, lever_arm_m=(0.05, -0.02))
    return synthetic.drive(synthetic.wavy_map(1, **options), 1, seconds=3, sensor=sensor)


def residuals(graph, x):
    """All residuals, whitened."""
    local, common = split(graph, x)
    parts = graph.fields(local, common)[0], graph.motions(local, common)[0].ravel()
    return np.concatenate([*parts, graph.walks(local)[0], graph.prior(local, common)])


def split(graph, x):
    cut = len(x) - len(graph.common_sd)
    return x[:cut].reshape(-1, graph.local), x[cut:]


def test_a_short_problem_has_the_minimum_of_scipy():
    case = short_case(cell=0.01)  # the slope of a coarse map jumps, and both solvers stop at its jumps
    graph = Graph(case.problem, case.readings)
    start = graph.start(case.truth + 0.01)
    local, common, cost = MapSmoother().minimise(graph, *start)
    peer = least_squares(
        lambda v: residuals(graph, v),
        np.concatenate([start[0].ravel(), start[1]]),
        method="lm",
        xtol=1e-12,
        ftol=1e-12,
    )
    assert cost < 2 * peer.cost * (1 + 1e-4)
    covariance = graph.normal_equations(local, common).solve().pose_covariances()
    away = local[:, :3] - split(graph, peer.x)[0][:, :3]
    assert np.abs(away / np.sqrt(covariance[:, range(3), range(3)])).max() < 0.05


def test_in_a_linear_field_it_agrees_with_the_rts_smoother():
    gradient = (3000.0, -1500.0)
    # odometry without errors of heading and scale: the problem is linear
    model = OdometryModel(scale_std=0.0, yaw_std=0.0, turn_std=0.0, yaw_std_s=1e-7)
    case = synthetic.drive(
        synthetic.linear_map(*gradient), 2, seconds=20, sd=(0.1, 0.1, 1e-6), odometry=model
    )
    made = track(MapSmoother(), case.problem, case.readings)
    means, covariances = synthetic.kalman(case, gradient, smooth=True)
    # the smoother gives each step of odometry 0.1 mm and 0.1 mrad more than the model has
    assert_allclose(made.pose[:, :2], means[:, :2], atol=0.02 * 0.1)
    assert_allclose(made.covariance[:, :2, :2], covariances[:, :2, :2], rtol=0.03, atol=3e-5)


def test_it_is_consistent_and_better_than_its_forward_pass():
    smoothed, filtered, nees = [], [], []
    for seed in range(5):
        case = synthetic.drive(synthetic.wavy_map(seed), seed)
        _, score = synthetic.scored(MapSmoother(), case)
        smoothed.append(score.error)
        nees.append(score.nees.mean())
        filtered.append(synthetic.scored(PointMass(), case)[1].error)
    rmse, forward = (math.sqrt(np.mean(np.square(v))) for v in (smoothed, filtered))
    assert rmse < 0.7 * forward
    assert 0.6 < np.mean(nees) < 1.5  # sd of the mean over 5 correlated drives is about 0.25


def test_a_global_start_is_smoothed_back_to_the_first_reading():
    case = synthetic.drive(synthetic.wavy_map(2), 2, prior=synthetic.UNKNOWN)
    made, score = synthetic.scored(MapSmoother(), case)
    assert not made.lost.any()
    assert score.error.max() < 0.25


def test_readings_without_a_value_and_off_the_map_are_left_out():
    case = synthetic.drive(synthetic.wavy_map(5), 5, seconds=20, margin=-0.3)
    b = case.readings["b_measured_nt"].copy()
    b[~np.isfinite(b)] = 41_000.0
    b[50:60] = np.nan
    case.readings = case.readings.with_columns(b_measured_nt=b)
    made = track(MapSmoother(), case.problem, case.readings)  # refuses what is not finite
    assert np.isfinite(made.covariance).all()
