"""Cases from magnetic-data: on recordings made by formula, and on the real ones."""

import math
from dataclasses import replace

import magpylib as magpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

import magtwin.bench.recorded_noise as recorded_noise
from magtwin.bench.draws import noisy_odometry
from magtwin.bench.magnetic_data import (
    HELD_OUT,
    KAPPA,
    NOISE,
    TRAINING,
    course,
    fit_iron,
    magnetic_data_case,
    read_recording,
)
from magtwin.bench.recorded_noise import Candidate, choose, likeliest_noise, preferred
from magtwin.errors import InputError
from magtwin.localization.bounds import bounds
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import OdometryModel
from magtwin.localization.readings import ONBOARD
from magtwin.localization.scores import score
from magtwin.localization.track import track

IRON_NT, ARM_M = (-2500.0, 700.0), -0.03


def drive(seed, n=2500):
    """A drive of 50 s at 50 Hz over 3 x 3 m, either way round: positions [m] and headings [rad]."""
    rng = np.random.default_rng(seed)
    s = np.arange(n) / 50
    angle = rng.choice([-1, 1]) * 0.4 * s + rng.uniform(0, 6)
    far = 0.9 + 0.5 * np.sin(rng.uniform(0.1, 0.25) * s + rng.uniform(0, 6))
    p = far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    way = np.gradient(p, axis=0)
    return s + 3, p, np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five recordings above magnets of magpylib, by a robot with iron and a sensor behind its middle."""
    made = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(0)
    magnets = magpy.Collection(
        *(
            magpy.misc.Dipole(moment=rng.normal(0, 8, 3), position=(*rng.uniform(-2, 2, 2), -0.7))
            for _ in range(25)
        )
    )
    for number in range(1, 6):
        t, p, yaw = drive(number)
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.column_stack([p + ARM_M * np.column_stack([c, s]), np.zeros(len(p))])
        field = 1e6 * magnets.getB(at) + (18.0, 0.0, -42.0)
        ahead, left = 1e-3 * np.array(IRON_NT)
        field[:, :2] += np.column_stack([c * ahead - s * left, s * ahead + c * left])
        field += rng.normal(0, 0.1, field.shape)
        for what, table in (("time", t), ("loc", p), ("mag", field)):
            np.savetxt(made / f"{number}-{what}.csv", table, delimiter=",")
    return made


def test_the_course_of_a_circle_is_its_tangent_and_of_a_standstill_the_last_one():
    angle = np.linspace(0, 3 * np.pi, 3000)
    p = np.column_stack([np.cos(angle), np.sin(angle)])
    yaw = course(p)
    inner = slice(40, -40)  # the ends have a chord to one side only
    assert_allclose(yaw[inner], angle[inner] + np.pi / 2, atol=2e-3)
    assert np.ptp(yaw) > 2.9 * np.pi  # continuous over more than a turn
    stop = np.concatenate([p[:1500], np.repeat(p[1499:1500], 300, axis=0), p[1500:]])
    assert_allclose(course(stop)[1500:1800], angle[1499] + np.pi / 2, atol=2e-3)


def test_iron_and_the_place_of_the_sensor_are_found_again(folder):
    (ahead, left), arm = fit_iron([read_recording(folder, number) for number in TRAINING])
    assert ahead == pytest.approx(IRON_NT[0], abs=100)
    assert left == pytest.approx(IRON_NT[1], abs=100)
    assert arm == pytest.approx(ARM_M, abs=2e-3)


def test_a_recording_begins_and_ends_in_motion(folder):
    t, p, yaw = drive(1)
    part = read_recording(folder, 1)
    assert part.t[0] > t[0]
    assert part.t[-1] < t[-1]
    rows = np.searchsorted(t, part.t)
    assert_allclose(part.p, p[rows])
    off = np.angle(np.exp(1j * (part.yaw - yaw[rows])))
    assert np.sqrt(np.mean(off**2)) < 0.02


def test_odometry_without_noise_is_the_true_motion():
    t, p, yaw = drive(2)
    pose = np.column_stack([p, yaw])[::10]
    silent = OdometryModel().scaled(0.0)
    made = noisy_odometry(pose, t[::10], silent, np.random.default_rng(0))
    c, s = math.cos(pose[0, 2]), math.sin(pose[0, 2])
    back = (pose[:, :2] - pose[0, :2]) @ np.array([[c, -s], [s, c]])
    assert_allclose(made[:, :2], back, atol=1e-12)
    assert_allclose(made[:, 2], pose[:, 2] - pose[0, 2], atol=1e-12)


def test_the_noise_of_odometry_is_that_of_its_model():
    n, step = 101, 0.04
    pose = np.column_stack([step * np.arange(n), np.zeros(n), np.zeros(n)])
    t = 0.2 * np.arange(n)
    model = OdometryModel(position_std=0.02, yaw_std=0.03, turn_std=0.5, yaw_std_s=0.002, scale_std=0.05)
    rng = np.random.default_rng(1)
    ends = np.array([noisy_odometry(pose, t, model, rng)[-1] for _ in range(4000)])
    length = step * (n - 1)
    tolerance = 4 / math.sqrt(2 * 4000)  # four standard deviations of a standard deviation
    assert np.std(ends[:, 2]) == pytest.approx(math.sqrt(0.03**2 * length + 0.002**2 * t[-1]), rel=tolerance)
    along = math.sqrt((0.05 * length) ** 2 + 0.02**2 * length)
    assert np.std(ends[:, 0]) == pytest.approx(along, rel=tolerance + 0.01)  # and what turning shortens


def test_a_case_tells_a_localizer_no_truth(folder):
    case = magnetic_data_case(folder, 2, 7)
    assert set(case.readings) <= set(ONBOARD)
    assert not case.readings.metadata
    assert case.truth.pose.shape == (case.readings.rows, 3)
    assert_allclose(np.diff(case.readings["t"]), 0.2, atol=0.021)
    assert_allclose(case.readings["odom_p"][0], 0)
    assert case.problem.sensor.lever_arm_m[0] == pytest.approx(ARM_M, abs=2e-3)
    again = magnetic_data_case(folder, 2, 7)
    assert again.readings["odom_p"].tobytes() == case.readings["odom_p"].tobytes()
    assert again.problem.prior == case.problem.prior
    other = magnetic_data_case(folder, 2, 8)
    assert not np.array_equal(other.readings["odom_p"], case.readings["odom_p"])
    assert np.array_equal(other.readings["b_measured_nt"], case.readings["b_measured_nt"])


def test_priors_err_as_they_state(folder):
    first = magnetic_data_case(folder, 2, 0).truth.pose[0]
    priors = [magnetic_data_case(folder, 2, seed).problem.prior for seed in range(60)]
    off = np.array([prior.mean for prior in priors]) - first
    assert_allclose(off.std(axis=0), priors[0].sd, rtol=4 / math.sqrt(120))
    headings = [magnetic_data_case(folder, 2, seed, start="heading").problem.prior for seed in range(30)]
    away = np.degrees(np.array([prior.mean[2] for prior in headings]) - first[2])
    assert headings[0].is_global
    assert 5 < np.abs(away).max() <= 10
    assert all(map(math.isinf, magnetic_data_case(folder, 2, 0, start="global").problem.prior.sd))


def test_the_factor_of_odometry_is_in_the_noise_and_in_what_is_told(folder):
    plain, rough = (magnetic_data_case(folder, 4, 1, odometry_factor=f) for f in (1.0, 3.0))
    assert rough.problem.odometry == plain.problem.odometry.scaled(3.0)
    true = magnetic_data_case(folder, 4, 1, odometry_factor=1e-9).readings["odom_p"]
    off = [np.linalg.norm((case.readings["odom_p"] - true)[-1]) for case in (plain, rough)]
    assert off[1] > 1.5 * off[0]


def test_a_robot_is_followed_on_a_map_of_other_drives(folder):
    # of these recordings the map is better than of real ones: only 0.1 uT of noise
    for number in HELD_OUT:
        case = magnetic_data_case(folder, number, 0)
        made = track(load_localizer("rbpf"), case.problem, case.readings)
        scores = score(made, case.truth.pose, bounds=bounds(case.problem, case.truth.pose, case.truth.t))
        assert scores.rmse_m < 0.1
        assert scores.rmse_m < 0.3 * scores.bound_m["dead_reckoning"]


def test_wrong_files_and_runs_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"run 3 is one of the map's \(1, 3, 5\)"):
        magnetic_data_case(folder, 3, 0)
    with pytest.raises(InputError, match=r"9-time.csv: no such file of magnetic-data"):
        read_recording(folder, 9)
    for what, columns in (("time", 1), ("loc", 2), ("mag", 3)):
        np.savetxt(tmp_path / f"1-{what}.csv", np.ones((5 + columns, columns)), delimiter=",")
    with pytest.raises(InputError, match=r"1-loc.csv: has shape \(7, 2\)"):
        read_recording(tmp_path, 1)


def test_the_likeliest_noise_is_that_from_which_residuals_were_drawn(monkeypatch):
    true = replace(NOISE, white_nt=200.0, drift_nt=600.0, drift_s=3.0, map_factor=1.2, map_length_m=0.4)
    rng = np.random.default_rng(0)

    def drawn(folder, training, number):
        t, p, _ = drive(number)
        t, p = t[::10], p[::10]
        sd = rng.uniform(500, 1000, len(t))
        far = np.linalg.norm(p[:, None] - p, axis=2)
        S = true.map_factor**2 * np.outer(sd, sd) * np.exp(-0.5 * (far / true.map_length_m) ** 2)
        S += true.drift_nt**2 * np.exp(-np.abs(t[:, None] - t) / true.drift_s)
        S += true.white_nt**2 * np.eye(len(t)) + recorded_noise.OFFSET_NT**2
        return t, p, np.linalg.cholesky(S) @ rng.standard_normal(len(t)), sd

    monkeypatch.setattr(recorded_noise, "residuals", drawn)
    monkeypatch.setattr(recorded_noise, "STEPS", 400)
    found = likeliest_noise("", training=(1, 2, 3, 4))
    assert found.white_nt == pytest.approx(true.white_nt, rel=0.1)
    assert found.map_factor == pytest.approx(true.map_factor, rel=0.33)  # 4 sd: some 70 independent values
    assert found.map_length_m == pytest.approx(true.map_length_m, rel=0.1)
    assert found.drift_nt == pytest.approx(true.drift_nt, rel=0.3)  # some 100 independent values of it
    assert likeliest_noise("", training=(1, 2), drift=False).drift_nt == 0


@pytest.mark.slow
def test_the_choice_is_ordered_and_uses_no_run_to_localize(folder, monkeypatch):
    monkeypatch.setattr(recorded_noise, "KAPPAS", (2.0, 1000.0))
    monkeypatch.setattr(recorded_noise, "STARTS", ("tracking",))
    seen = []

    def seeing(folder, number, seed, **options):
        seen.append((options["training"], number))
        return magnetic_data_case(folder, number, seed, **options)

    monkeypatch.setattr(recorded_noise, "magnetic_data_case", seeing)
    made = choose(folder, seeds=1)
    assert set(seen) == {((3, 5), 1), ((1, 5), 3), ((1, 3), 5)}
    assert len(made) == 4
    assert [c.log_loss for c in made] == sorted(c.log_loss for c in made)
    assert made[-1].kappa == 1000  # a filter that ignores its readings
    assert made[-1].rmse_m > made[0].rmse_m


def test_the_least_tempering_within_a_standard_error_is_preferred():
    def candidate(kappa, loss, error=0.2):
        return Candidate(NOISE, kappa, loss, error, 0.1)

    best, near, far = candidate(16.0, -2.0), candidate(8.0, -1.81), candidate(4.0, -1.79, 5.0)
    assert preferred([far, near, best]) is near
    twin = candidate(8.0, -1.9)
    assert preferred([near, twin, best, far]) is twin
    assert preferred([best]) is best


@pytest.mark.slow
def test_the_choice_on_the_real_runs_is_the_recorded_one(real_data):
    best = preferred(choose(real_data / "magnetic-data"))
    assert best.noise == NOISE
    assert best.kappa == KAPPA


@pytest.mark.slow
def test_real_runs_are_followed_within_7_cm(real_data):
    squares, bound = [], []
    for number in HELD_OUT:
        for seed in range(3):
            case = magnetic_data_case(real_data / "magnetic-data", number, seed)
            algorithm = load_localizer("rbpf", {"kappa": KAPPA, "map_correlated": 1.0})
            made = track(algorithm, case.problem, case.readings)
            limits = bounds(case.problem, case.truth.pose, case.truth.t)
            scores = score(made, case.truth.pose, bounds=limits)
            squares.append(scores.rmse_m**2)
            bound.append(scores.bound_m["correlated"] ** 2)
            assert not scores.diverged
    rmse = math.sqrt(np.mean(squares))
    assert rmse < 0.07
    assert rmse < 1.6 * math.sqrt(np.mean(bound))
