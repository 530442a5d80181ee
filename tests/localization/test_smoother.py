import math

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose
from scipy.optimize import approx_fprime, least_squares

from magtwin.errors import InputError
from magtwin.localization.grid.point_mass import PointMass
from magtwin.localization.odometry import Odometry
from magtwin.localization.problem import OdometryModel, Problem, SensorModel
from magtwin.localization.smoother import Arrow, Graph, MapSmoother
from magtwin.localization.track import track


def random_arrow(seed, n=7, b=4, g=3):
    """An arrow matrix and the same one dense, its border last."""
    rng = np.random.default_rng(seed)
    size = n * b + g
    dense = np.zeros((size, size))
    for k in range(n):  # sums of squares of rows that touch two neighbouring blocks and the border
        rows = np.zeros((3 * b, size))
        rows[:, k * b : min(k + 2, n) * b] = rng.standard_normal((3 * b, b * (min(k + 2, n) - k)))
        rows[:, n * b :] = rng.standard_normal((3 * b, g))
        dense += rows.T @ rows
    blocks = dense[: n * b, : n * b].reshape(n, b, n, b)
    diagonal = np.array([blocks[k, :, k] for k in range(n)])
    below = np.array([blocks[k + 1, :, k] for k in range(n - 1)])
    return Arrow(diagonal, below, dense[: n * b, n * b :].reshape(n, b, g), dense[n * b :, n * b :]), dense


def test_the_selected_inverse_has_the_blocks_of_the_dense_inverse():
    arrow, dense = random_arrow(0)
    inverse = np.linalg.inv(dense)
    blocks, corner = arrow.covariances()
    for k in range(7):
        assert_allclose(blocks[k], inverse[4 * k : 4 * k + 4, 4 * k : 4 * k + 4], rtol=1e-8, atol=1e-12)
    assert_allclose(corner, inverse[28:, 28:], rtol=1e-8, atol=1e-12)
    last, determinant = arrow.last_covariance()
    assert_allclose(last, inverse[24:28, 24:28], rtol=1e-8, atol=1e-12)
    assert_allclose(determinant, np.linalg.slogdet(dense)[1], rtol=1e-10)


def test_the_banded_solution_is_the_dense_one():
    arrow, dense = random_arrow(1)
    right = np.random.default_rng(2).standard_normal(31)
    local, corner = arrow.solve(right[:28].reshape(7, 4), right[28:])
    assert_allclose(np.append(local, corner), np.linalg.solve(dense, right), rtol=1e-8)


def short_case(**options):
    sensor = SensorModel(iron_nt=100.0, lever_arm_m=(0.05, -0.02))
    return synthetic.drive(synthetic.wavy_map(1, **options), 1, seconds=3, sensor=sensor)


def packed(graph, local, common):
    return np.concatenate([local.ravel(), common])


def split(graph, x):
    cut = len(x) - len(graph.common_sd)
    return x[:cut].reshape(-1, graph.local), x[cut:]


@pytest.mark.parametrize("variance", [None, 2500.0])
def test_the_normal_equations_are_those_of_the_residuals(variance):
    case = short_case(variance=variance)
    graph = Graph(case.problem, case.readings)
    rng = np.random.default_rng(0)
    # amid cells of the map, whose slope jumps between cells
    poses = case.truth.copy()
    poses[:, :2] = (np.floor(poses[:, :2] / 0.05) + 0.4) * 0.05
    local, common = graph.start(poses)
    local[:, 3:] = rng.normal(0, 1, local[:, 3:].shape)
    common += rng.normal(0, 0.01, len(common))
    ones = np.ones(len(local)), np.ones(len(local) - 1)
    matrix, gradient, common_gradient = graph.normal_equations(local, common, *ones)
    x = packed(graph, local, common)
    steps = np.full(len(x), 1e-6)
    # forward differences of step h err by h f''/2; the residuals' second derivatives reach 1e3
    jacobian = approx_fprime(x, lambda v: graph.residuals(*split(graph, v)), steps)
    r = graph.residuals(local, common)
    assert_allclose(
        np.append(gradient, common_gradient),
        jacobian.T @ r,
        rtol=1e-3,
        atol=1e-3 * np.abs(jacobian.T @ r).max(),
    )
    n, b = gradient.shape
    dense = np.zeros((len(x), len(x)))
    for k in range(n):
        dense[k * b : (k + 1) * b, k * b : (k + 1) * b] = matrix.diagonal[k]
        if k + 1 < n:
            dense[(k + 1) * b : (k + 2) * b, k * b : (k + 1) * b] = matrix.below[k]
            dense[k * b : (k + 1) * b, (k + 1) * b : (k + 2) * b] = matrix.below[k].T
    dense[: n * b, n * b :] = matrix.border.reshape(n * b, -1)
    dense[n * b :, : n * b] = dense[: n * b, n * b :].T
    dense[n * b :, n * b :] = matrix.corner
    size = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
    assert_allclose(jacobian.T @ jacobian / size, dense / size, atol=1e-3)


def test_a_short_problem_has_the_minimum_of_scipy():
    case = short_case(cell=0.01)  # the slope of a coarse map jumps, and both solvers stop at its jumps
    graph = Graph(case.problem, case.readings)
    start = graph.start(case.truth + 0.01)
    local, common, cost, _ = MapSmoother().minimise(graph, *start)
    peer = least_squares(
        lambda v: graph.residuals(*split(graph, v)),
        packed(graph, *start),
        method="lm",
        xtol=1e-12,
        ftol=1e-12,
    )
    assert cost < 2 * peer.cost * (1 + 1e-4)
    covariance, _ = graph.normal_equations(local, common, np.ones(15), np.ones(14))[0].covariances()
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
    for seed in range(8):
        case = synthetic.drive(synthetic.wavy_map(seed), seed)
        _, score = synthetic.scored(MapSmoother(), case)
        smoothed.append(score.error)
        nees.append(score.nees.mean())
        filtered.append(synthetic.scored(PointMass(), case)[1].error)
    rmse, forward = (math.sqrt(np.mean(np.square(v))) for v in (smoothed, filtered))
    assert rmse < 0.7 * forward
    assert 0.6 < np.mean(nees) < 1.5  # sd of the mean over 8 correlated drives is about 0.2


def test_a_global_start_is_smoothed_back_to_the_first_reading():
    case = synthetic.drive(synthetic.wavy_map(2), 2, prior=synthetic.UNKNOWN)
    made, score = synthetic.scored(MapSmoother(), case)
    assert not made.lost.any()
    assert score.error.max() < 0.25


@pytest.mark.parametrize("robust", ["huber", "gnc"])
def test_robust_losses_resist_outliers(robust):
    case = synthetic.drive(synthetic.wavy_map(4), 4, seconds=25)
    b = case.readings["b_measured_nt"].copy()
    rng = np.random.default_rng(0)
    rows = rng.choice(len(b), 12, replace=False)
    b[rows] += rng.choice([-3000.0, 3000.0], 12)
    case.readings = case.readings.with_columns(b_measured_nt=b)
    plain = synthetic.scored(MapSmoother(start=Odometry()), case)[1].rmse
    resistant = synthetic.scored(MapSmoother(start=Odometry(), robust=robust), case)[1].rmse
    assert resistant < 0.06
    assert resistant < 0.7 * plain


def test_readings_without_a_value_and_off_the_map_are_left_out():
    case = synthetic.drive(synthetic.wavy_map(5), 5, seconds=20, margin=-0.3)
    b = case.readings["b_measured_nt"].copy()
    b[~np.isfinite(b)] = 41_000.0
    b[50:60] = np.nan
    case.readings = case.readings.with_columns(b_measured_nt=b)
    made = track(MapSmoother(), case.problem, case.readings)  # refuses what is not finite
    assert np.isfinite(made.covariance).all()


def test_wrong_options_and_a_problem_without_map_are_refused():
    with pytest.raises(InputError, match='must be "huber", "gnc" or None'):
        MapSmoother(robust="cauchy")
    with pytest.raises(InputError, match="iterations of MapSmoother"):
        MapSmoother(iterations=0)
    case = synthetic.drive(synthetic.wavy_map(5), 5, seconds=2)
    with pytest.raises(InputError, match="needs a map"):
        MapSmoother().run(Problem(belief=None, extent=synthetic.EXTENT), case.readings)
