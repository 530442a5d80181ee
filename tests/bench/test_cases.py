"""Cases of the twin: the errors that a scenario names are in the readings, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.bench import world
from magtwin.bench.draws import noisy_odometry
from magtwin.bench.suite import Scenario
from magtwin.bench.twin_case import fogm, twin_case
from magtwin.files.file import shipped
from magtwin.io.map_files import open_map
from magtwin.localization.problem import OdometryModel, SensorModel

LAB = str(shipped("scenes", "lab", "lab.usda"))
PLAIN = Scenario(name="plain", duration_s=20.0)


@pytest.fixture(scope="module")
def field():
    return open_map(LAB)


def disturbance(case):
    """Readings less the true field at the sensor [nT]."""
    pose = case.truth.pose
    return case.readings["b_measured_nt"] - case.truth.field.lookup(pose[:, :2], pose[:, 2])


def test_a_case_is_the_same_each_time_and_another_for_another_seed():
    one, same, other = (twin_case(PLAIN, LAB, seed, 0) for seed in (4, 4, 5))
    for name, values in one.readings.items():
        assert_array_equal(values, same.readings[name])
    assert one.problem.prior == same.problem.prior
    assert one.problem.seed != other.problem.seed
    assert not np.array_equal(
        one.readings["b_measured_nt"], other.readings["b_measured_nt"][: len(one.readings["t"])]
    )


def test_readings_have_the_noise_of_the_sensor_model():
    quiet = replace(PLAIN, sensor=SensorModel(white_nt=1e-6, drift_nt=0.0, offset_nt=500.0))
    errors = [disturbance(twin_case(quiet, LAB, seed, 0)) for seed in range(12)]
    assert max(np.ptp(error) for error in errors) < 1e-4  # an offset, and nothing else
    offsets = [error.mean() for error in errors]
    assert 250 < np.std(offsets) < 900


def test_iron_is_that_of_the_session_and_turns_with_the_robot():
    scenario = replace(PLAIN, sensor=SensorModel(white_nt=1e-6, drift_nt=0.0, offset_nt=0.0, iron_nt=400.0))
    fits = []
    for seed, session in ((0, 1), (5, 1), (0, 2)):
        case = twin_case(scenario, LAB, seed, session)
        yaw = case.truth.pose[:, 2]
        waves = np.column_stack([np.cos(yaw), np.sin(yaw)])
        iron, residual, *_ = np.linalg.lstsq(waves, disturbance(case), rcond=None)
        assert residual.sum() < 1e-3
        fits.append(iron)
    assert_allclose(fits[0], fits[1], rtol=1e-6)
    assert np.linalg.norm(fits[0] - fits[2]) > 20


def test_a_map_with_error_has_the_sd_and_the_length_that_the_localizer_is_told(field):
    rng = np.random.default_rng(0)
    errors = np.stack(
        [world.with_error(field, 150.0, 0.3, rng).values_nt[0] - field.values_nt[0] for _ in range(60)]
    )
    assert_allclose(errors.std(), 150, rtol=0.05)
    at = round(0.3 / field.cell_m[0])
    correlation = np.mean(errors[:, :, at:] * errors[:, :, :-at]) / errors.var()
    assert_allclose(correlation, np.exp(-0.5), atol=0.05)
    belief = world.with_error(field, 150.0, 0.3, rng)
    assert_allclose(belief.variance([[0.0, 0.0]], [0.0]), 150.0**2)
    same = belief.values_nt - field.values_nt
    assert_allclose(same[0], same[7], atol=1e-9)  # alike at all headings


def test_odometry_has_the_variances_of_its_model():
    pose = np.column_stack([np.linspace(0, 10, 501), np.zeros(501), np.zeros(501)])
    t = np.arange(501) / 5
    model = OdometryModel(position_std=0.05, yaw_std=0.0, turn_std=0.0, yaw_std_s=0.0, scale_std=0.03)
    ends = np.array([noisy_odometry(pose, t, model, np.random.default_rng(k))[-1] for k in range(600)])
    assert_allclose(ends[:, 0].std(), np.hypot(0.05 * np.sqrt(10), 0.03 * 10), rtol=0.1)
    assert_allclose(ends[:, 1].std(), 0.05 * np.sqrt(10), rtol=0.1)
    assert_allclose(ends[:, 2], 0, atol=1e-12)


def test_the_drift_is_a_stationary_gauss_markov_process():
    t = np.arange(2000) / 5
    sensor = SensorModel(drift_nt=100.0, drift_s=5.0)
    drifts = np.stack([fogm(t, sensor, np.random.default_rng(k)) for k in range(40)])
    assert_allclose(drifts[:, 0].std(), 100, rtol=0.3)
    assert_allclose(drifts.std(), 100, rtol=0.05)
    assert_allclose(np.mean(drifts[:, 25:] * drifts[:, :-25]) / drifts.var(), np.exp(-1), atol=0.05)


def test_a_kidnapping_moves_the_robot_and_not_its_odometry():
    case = twin_case(replace(PLAIN, duration_s=60.0, kidnaps=2), LAB, 3, 0)
    rows = np.searchsorted(case.truth.t, case.truth.kidnapped_s)
    assert len(rows) == 2
    for row in rows:
        jump = np.hypot(*(case.truth.pose[row] - case.truth.pose[row - 1])[:2])
        assert 0.5 <= jump <= 4.0
        assert np.hypot(*(case.readings["odom_p"][row] - case.readings["odom_p"][row - 1])[:2]) < 0.02
    assert (np.diff(case.truth.t) > 0).all()


def test_a_stuck_sensor_repeats_one_value_and_a_late_one_reads_where_the_robot_was():
    stuck = twin_case(replace(PLAIN, stuck_s=5.0), LAB, 3, 0).readings["b_measured_nt"]
    assert np.count_nonzero(np.diff(stuck) == 0) == 24
    exact = SensorModel(white_nt=1e-6, drift_nt=0.0, offset_nt=0.0)
    late, soon = (twin_case(replace(PLAIN, sensor=exact, offset_s=dt), LAB, 3, 0) for dt in (0.4, 0.0))
    assert_allclose(late.readings["b_measured_nt"][2:], soon.readings["b_measured_nt"][:-2], atol=60)
    assert np.abs(late.readings["b_measured_nt"] - soon.readings["b_measured_nt"]).max() > 100


def test_a_moved_object_changes_the_truth_and_not_the_map(field):
    case = twin_case(replace(PLAIN, moved_nt=2000.0), LAB, 3, 0)
    change = case.truth.field.values_nt[0] - field.values_nt[0]
    assert_allclose(np.abs(change).max(), 2000, rtol=0.25)
    assert_array_equal(case.problem.belief.values_nt, np.where(field.valid, field.values_nt, 0.0))


def test_a_scene_as_truth_reads_the_physical_magnetometer_after_a_labelled_drive():
    case = twin_case(replace(PLAIN, truth="scene", odometry="robot", calibration_s=10.0), LAB, 3, 1)
    assert disturbance(case).std() > 20
    drive = case.problem.calibration
    assert {"p_world_base", "yaw", "b_measured_nt"} <= set(drive)
    assert_allclose(drive.duration_s, 10, atol=0.5)
    assert case.problem.belief.variance([[0.0, 0.0]], [0.0]) > 0


@pytest.mark.parametrize(("prior", "unknown"), [("tracking", 0), ("heading", 2), ("global", 3)])
def test_the_prior_is_as_wide_as_the_scenario_says(prior, unknown):
    cases = [twin_case(replace(PLAIN, prior=prior, duration_s=2.0), LAB, seed, 0) for seed in range(20)]
    assert np.isinf(cases[0].problem.prior.sd).sum() == unknown
    yaws = np.array([case.problem.prior.mean[2] - case.truth.pose[0, 2] for case in cases])
    if prior == "heading":
        assert np.abs(yaws).max() <= np.radians(10)
    if prior == "tracking":
        off = np.array([np.subtract(case.problem.prior.mean, case.truth.pose[0])[:2] for case in cases])
        assert_allclose(off.std(), 0.1, rtol=0.5)
