import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose

from magtwin.localization.belief import table_of
from magtwin.localization.bounds import bounds
from magtwin.localization.grid import point_mass
from magtwin.localization.grid.bank import Bank, Likelihood
from magtwin.localization.grid.point_mass import Grid, PointMass
from magtwin.localization.particles import RaoBlackwell
from magtwin.localization.problem import OdometryModel, SensorModel
from magtwin.localization.readings import readings_of
from magtwin.localization.track import track

CODE = point_mass.LOOPS.open()


def unpacked(state):
    """Means (K, 2) and covariances (K, 2, 2) of the linear states of all nodes."""
    rows = state.reshape(-1, 5)
    return rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def random_grid(seed, n=2, count=6):
    rng = np.random.default_rng(seed)
    grid = Grid(np.array([0.2, -0.1, 0.4]), np.diag([0.02, 0.01, 0.003]) + 0.001, count, n)
    grid.logw[:] = np.where(rng.random(grid.logw.shape) < 0.8, rng.normal(0, 2, grid.logw.shape), -np.inf)
    grid.normalise()
    roots = rng.normal(0, 10, (len(grid.logw), n, n))
    a, b = np.triu_indices(n)
    rows = grid.state.reshape(len(grid.logw), -1)
    rows[:, :n] = rng.normal(0, 100, (len(rows), n))
    rows[:, n:] = (roots @ roots.transpose(0, 2, 1))[:, a, b]
    return grid


def test_the_convolution_is_that_of_a_plain_loop_over_gaussian_mixtures():
    grid = random_grid(0)
    rng = np.random.default_rng(1)
    count = len(grid.lattice.yaw)
    taps = rng.uniform(0.01, 0.1, (count, 3, 3))
    taps[:, 1, 1] = 1 - (taps.sum(axis=(1, 2)) - taps[:, 1, 1])
    turn = 0.07
    logw, state = np.empty_like(grid.logw), np.empty_like(grid.state)
    CODE.mix(grid.logw, grid.state, logw, state, grid.lattice, 2, taps.ravel(), turn)

    w = np.exp(grid.logw).reshape(count, count, count)
    means, covariances = unpacked(grid.state)
    origins = np.column_stack([grid.lattice.x, grid.lattice.y])
    for h, j, i in rng.integers(0, count, (60, 3)):
        sources = [
            (h, j + dj, i + di, (1 - 2 * turn) * taps[h, 1 - dj, 1 - di])
            for dj in (-1, 0, 1)
            for di in (-1, 0, 1)
        ]
        for g in (h - 1, h + 1):
            if not 0 <= g < count:
                continue
            u, v = np.linalg.solve(grid.cell, origins[h] + grid.cell @ (i, j) - origins[g])
            sources += [
                (g, jj, ii, turn * (1 - abs(u - ii)) * (1 - abs(v - jj)))
                for jj in (math.floor(v), math.floor(v) + 1)
                for ii in (math.floor(u), math.floor(u) + 1)
            ]
        mass, first, second = 0.0, np.zeros(2), np.zeros((2, 2))
        for g, jj, ii, share in sources:
            if 0 <= jj < count and 0 <= ii < count:
                k = (g * count + jj) * count + ii
                part = share * w[g, jj, ii]
                mass += part
                first += part * means[k]
                second += part * (covariances[k] + np.outer(means[k], means[k]))
        k = (h * count + j) * count + i
        assert_allclose(np.exp(logw[k]), mass, rtol=1e-10, atol=1e-300)
        if mass > 0:
            got_mean, got_covariance = (part[k] for part in unpacked(state))
            mean = first / mass
            assert_allclose(got_mean, mean, rtol=1e-9, atol=1e-9)
            # the plain sum subtracts squares of 1e4 to 1e5 nT^2: rounding of 1e-10 of them
            assert_allclose(got_covariance, second / mass - np.outer(mean, mean), rtol=1e-6, atol=1e-5)


def test_in_a_linear_field_the_filter_agrees_with_a_kalman_filter(monkeypatch):
    monkeypatch.setattr(point_mass, "RESET_AT", math.inf)
    gradient = (3000.0, -1500.0)
    field = synthetic.linear_map(*gradient)
    model = OdometryModel(scale_std=0.0, turn_std=0.0, yaw_std=math.radians(0.5))
    sensor = SensorModel(offset_nt=100.0)
    case = synthetic.drive(field, 3, seconds=12, sd=(0.05, 0.05, 0.05), odometry=model, sensor=sensor)
    made = track(PointMass(), case.problem, case.readings)
    means, covariances = synthetic.kalman(case, gradient)
    sd = np.sqrt(covariances[:, range(3), range(3)])
    # the window cuts tails beyond 3.6 sd, 1 % of the variance, again and again; the filter's headings are
    # not linearised
    assert np.abs((made.pose - means[:, :3]) / sd).max() < 0.2
    assert_allclose(made.covariance[:, range(3), range(3)] / sd**2, 1.0, atol=0.12)


def test_one_start_of_the_bank_is_an_extended_kalman_filter():
    gradient = (3000.0, -1500.0)
    field = synthetic.linear_map(*gradient)
    model = OdometryModel(scale_std=0.0)
    case = synthetic.drive(field, 3, seconds=8, sd=(0.02, 0.02, 0.02), odometry=model)  # one start
    prior = case.problem.prior
    table, spreads = table_of(field, field.extent)
    bank = Bank(
        Likelihood(case.problem, table, spreads, 1.0), prior.mean, prior.sd, cell_m=0.08, step_rad=0.13
    )
    means, covariances = synthetic.kalman(case, gradient)
    last = None
    for k, reading in enumerate(readings_of(case.readings)):
        bank.step(last, reading, np.zeros(3))
        last = reading
        assert len(bank.logw) == 1
        kept = [0, 1, 2, 4, 5]
        assert_allclose(bank.means[0, kept], means[k], rtol=1e-6, atol=1e-6)
        assert_allclose(bank.covariances[0][np.ix_(kept, kept)], covariances[k], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("variance", [None, 150.0**2])
def test_tracking_is_consistent_and_as_good_as_a_particle_filter(variance):
    errors, others, nees, limits = [], [], [], []
    for seed in range(8):
        truth = synthetic.wavy_map(seed)
        case = synthetic.drive(truth, seed)
        if variance is not None:
            error = synthetic.waves(100 + seed, sd=math.sqrt(variance), length=0.3)
            base = synthetic.waves(seed)
            belief = synthetic.tabulated(
                lambda x, y, base=base, error=error: 41_000 + base(x, y) + error(x, y), variance=variance
            )
            case.problem = replace(case.problem, belief=belief)
        _, score = synthetic.scored(PointMass(), case)
        errors.append(score.error[25:])
        nees.append(score.nees[25:].mean())
        others.append(synthetic.scored(RaoBlackwell(), case)[1].error[25:])
        limit = bounds(case.problem, case.truth, case.readings["t"], truth)
        limits.append((limit.exact if variance is None else limit.correlated)[25:])
    rmse, other, limit = (math.sqrt(np.mean(np.square(v))) for v in (errors, others, limits))
    assert rmse > limit
    assert rmse < 1.1 * other
    assert 0.7 < np.mean(nees) < 1.4  # sd of the mean over 8 correlated drives is about 0.15


@pytest.mark.parametrize("seed", range(2))
def test_a_global_start_finds_the_pose(seed):
    case = synthetic.drive(synthetic.wavy_map(seed), seed, prior=synthetic.UNKNOWN, seconds=30)
    made, score = synthetic.scored(PointMass(), case)
    assert made.lost[0]
    assert not made.lost[-50:].any()
    assert score.error[-50:].max() < 0.25


def test_readings_without_a_value_widen_the_estimate():
    case = synthetic.drive(synthetic.wavy_map(3), 3, seconds=30)
    b = case.readings["b_measured_nt"].copy()
    b[75:125] = np.nan
    case.readings = case.readings.with_columns(b_measured_nt=b)
    made, score = synthetic.scored(PointMass(), case)
    spread = made.covariance[:, 0, 0] + made.covariance[:, 1, 1]
    assert spread[124] > 2 * spread[74]
    assert score.error[-20:].max() < 0.25


def test_a_robot_off_the_map_gets_finite_estimates():
    field = synthetic.wavy_map(5, extent=(-2.0, 2.0, -1.5, 1.5))
    case = synthetic.drive(field, 5, seconds=20, margin=-0.6)
    b = np.where(np.isfinite(case.readings["b_measured_nt"]), case.readings["b_measured_nt"], 41_000.0)
    case.readings = case.readings.with_columns(b_measured_nt=b)
    assert (np.abs(case.truth[:, 0]) > 2).any() or (np.abs(case.truth[:, 1]) > 1.5).any()
    made = track(PointMass(), case.problem, case.readings)  # refuses what is not finite
    assert len(made.t) == 100


def test_the_same_problem_gives_the_same_bytes():
    case = synthetic.drive(synthetic.wavy_map(6), 6, seconds=8, prior=synthetic.UNKNOWN)
    first, second = (track(PointMass(), case.problem, case.readings) for _ in range(2))
    assert first.pose.tobytes() == second.pose.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()
