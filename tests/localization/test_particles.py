"""Particle filters: against plain numpy, closed forms, bounds, and wrong sensors."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from drives import EXTENT, circle, drive, estimates, flat_map, poses, rough_map, squared_errors
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from plain_particles import PlainFilter
from scipy import stats

from magtwin import compiled
from magtwin.errors import InputError
from magtwin.localization.localizers import load_localizer
from magtwin.localization.particles import Bootstrap, RaoBlackwell, RaoBlackwellIron, RaoBlackwellNetwork
from magtwin.localization.problem import OdometryModel, Prior, Problem, Reading, SensorModel

FIELD = rough_map()
IRON = SensorModel(iron_nt=300.0, lever_arm_m=(0.1, -0.05))
UNKNOWN = (math.inf, math.inf, math.inf)


@pytest.mark.parametrize(
    ("method", "sensor", "variance"),
    [(RaoBlackwell, SensorModel(), None), (RaoBlackwellIron, IRON, 150.0**2), (Bootstrap, IRON, 150.0**2)],
)
def test_the_compiled_filter_agrees_with_plain_numpy(method, sensor, variance):
    belief = rough_map(variance_nt2=variance)
    problem, readings = drive(FIELD, circle(80), 3, sensor=sensor, belief=belief, prior_sd=(0.3, 0.3, 0.05))
    readings[20] = replace(readings[20], b_nt=math.nan)
    fast = method(particles=700, resets=False)
    fast.reset(problem)
    draws = copy.deepcopy(fast._rng)  # both resample at the same fractions
    plain = PlainFilter(fast, hashed=True)
    plain.uniform = draws.random
    for reading in readings:
        a, b = fast.step(reading), plain.step(reading)
        assert_allclose((a.x, a.y, a.yaw), (b.x, b.y, b.yaw), atol=1e-9)
        assert_allclose(a.covariance, b.covariance, atol=1e-9)
        assert_allclose(a.bias_nt, b.bias_nt, atol=1e-5)
    assert len(plain.x) == fast._count


@pytest.mark.parametrize("method", [RaoBlackwellIron, Bootstrap])
def test_two_threads_give_the_bytes_of_one(method, monkeypatch):
    problem, readings = drive(FIELD, circle(12), 5, sensor=IRON, prior_sd=UNKNOWN)

    def run(threads):
        monkeypatch.setattr(compiled.os, "cpu_count", lambda: threads)
        made = method(particles=40_000)
        return poses(estimates(made, problem, readings)), made.particles()

    for one, two in zip(run(1), run(2), strict=True):
        assert_array_equal(one, two)


def test_on_a_flat_field_the_offset_is_that_of_gaussian_regression():
    still = OdometryModel(position_std=0, yaw_std=0, turn_std=0, yaw_std_s=0, position_std_s=0, scale_std=0)
    pose, sensor = circle(40), SensorModel(iron_nt=300.0)
    problem, readings = drive(
        flat_map(), pose, 2, sensor=sensor, odometry=still, prior_sd=(1e-12, 1e-12, 1e-12)
    )
    made = estimates(RaoBlackwellIron(), problem, readings)
    t, b = (np.array([getattr(r, key) for r in readings]) for key in ("t", "b_nt"))
    apart = np.abs(t[:, None] - t)
    slow = np.exp(-apart / 1000.0)  # FORGET_S
    offset = sensor.offset_nt**2 * slow
    turned = pose[:, 2, None] - pose[:, 2]
    total = offset + sensor.iron_nt**2 * slow * np.cos(turned) + sensor.drift_nt**2 * np.exp(-apart / 5.0)
    for k in (0, 7, 39):
        known = slice(0, k + 1)
        covariance = total[known, known] + sensor.white_nt**2 * np.eye(k + 1)
        expected = offset[k, known] @ np.linalg.solve(covariance, b[known] - 40_000.0)
        assert_allclose(made[k].bias_nt, expected, rtol=1e-6)


@pytest.mark.parametrize("sensor", [SensorModel(), SensorModel(iron_nt=300.0)])
def test_covariances_fit_the_errors(sensor):
    last, position = [], []
    for seed in range(25):
        pose = circle(150, start=seed)
        problem, readings = drive(FIELD, pose, seed, sensor=sensor)
        made = estimates(RaoBlackwellIron(), problem, readings)
        last.append(squared_errors(made, pose)[-1])
        position.append(np.hypot(*(poses(made)[-1, :2] - pose[-1, :2])))
    low, high = stats.chi2(3 * len(last)).ppf([0.005, 0.995])
    assert low < sum(last) < high
    assert np.sqrt(np.mean(np.square(position))) < 0.08  # dead reckoning: 0.35 m


def test_nan_is_prediction_only():
    problem, readings = drive(FIELD, circle(60), 6, prior_sd=(0.02, 0.02, 0.01))
    blind = [replace(r, b_nt=math.nan) for r in readings]
    made = estimates(RaoBlackwell(), problem, blind)
    reckoned = estimates(load_localizer("odometry"), problem, blind)
    assert_allclose(poses(made)[:, :2], poses(reckoned)[:, :2], atol=0.02)
    assert_allclose(made[-1].covariance, reckoned[-1].covariance, atol=0.15 * reckoned[-1].covariance.max())
    assert made[-1].covariance[0, 0] > made[0].covariance[0, 0]


def test_particles_off_the_map_lose_weight_and_stay_finite():
    pose = np.column_stack([np.linspace(2.2, 2.9, 20), np.zeros(20), np.zeros(20)])
    problem, readings = drive(FIELD, pose, 9, prior_sd=(0.5, 0.1, 0.05))
    filter_ = RaoBlackwell(resets=False)
    made = estimates(filter_, problem, readings)
    cloud = filter_.particles()
    assert np.isfinite(poses(made)).all()
    assert np.isfinite(cloud).all()
    assert cloud[cloud[:, 0] > 3.0, 3].sum() < 0.01
    beyond = [Reading(r.t + 4, r.b_nt, (r.odometry[0] + 9.0, 0.0, 0.0)) for r in readings]
    left = [filter_.step(r) for r in beyond]  # all of them are off the map
    assert np.isfinite(poses(left)).all()
    assert left[-1].covariance[0, 0] > 0


@pytest.mark.parametrize("sd", [(math.inf, math.inf, 0.1), UNKNOWN])
def test_a_global_start_finds_the_pose(sd):
    for seed in range(2):
        pose = circle(120, start=2.0 * seed)
        problem, readings = drive(FIELD, pose, seed, prior_sd=sd)
        made = estimates(RaoBlackwellIron(), problem, readings)
        assert made[0].lost
        assert not made[-1].lost
        assert np.hypot(*(poses(made)[-25:, :2] - pose[-25:, :2]).T).max() < 0.25


def test_a_kidnapped_robot_is_found_and_others_are_not_looked_for():
    pose = circle(300)
    problem, readings = drive(FIELD, pose, 11)
    honest = RaoBlackwellIron()
    estimates(honest, problem, readings)
    assert honest.reset_count == 0
    elsewhere = circle(300, start=2.5)
    _, others = drive(FIELD, elsewhere, 12)
    last, first = np.array(readings[99].odometry), np.array(others[100].odometry)
    turn = last[2] - first[2]
    c, s = math.cos(turn), math.sin(turn)

    def joined(r):
        dx, dy = r.odometry[0] - first[0], r.odometry[1] - first[1]
        at = (last[0] + c * dx - s * dy, last[1] + s * dx + c * dy, r.odometry[2] + turn)
        return replace(r, odometry=at)

    moved = RaoBlackwellIron()
    made = estimates(moved, problem, readings[:100] + [joined(r) for r in others[100:]])
    assert moved.reset_count >= 1
    assert np.hypot(*(poses(made)[-25:, :2] - elsewhere[-25:, :2]).T).max() < 0.25
    stubborn = RaoBlackwellIron(resets=False)
    estimates(stubborn, problem, readings[:100] + [joined(r) for r in others[100:]])
    assert stubborn.reset_count == 0


def test_after_readings_of_another_place_odometry_leads_back_to_the_pose():
    pose, away, back = circle(240), range(100, 135), 0  # the map is wrong there: the robot goes on
    problem, readings = drive(FIELD, pose, 12)
    for start in (1.0, 2.5, 4.0, 5.0):
        _, others = drive(FIELD, circle(240, start=start), 12)
        mixed = [replace(r, b_nt=others[k].b_nt) if k in away else r for k, r in enumerate(readings)]
        fast = RaoBlackwellIron()
        made = estimates(fast, problem, mixed)
        error = np.hypot(*(poses(made)[:, :2] - pose[:, :2]).T)
        lost = np.array([e.lost for e in made])
        assert fast.reset_count >= 1
        assert np.count_nonzero(~lost & (error > 0.5)) < 25  # 5 s
        assert lost[np.argmax(lost) :][:25].all()  # for 5 s at least
        back += error[-25:].max() < 0.25
    assert back >= 3


@settings(max_examples=8)
@given(
    x=st.floats(-5, 5),
    y=st.floats(-5, 5),
    yaw=st.floats(-3, 3),
    turns=st.integers(-2, 2),
    more=st.floats(-900, 900),
)
def test_the_frame_of_odometry_and_the_level_of_the_field_do_not_matter(x, y, yaw, turns, more):
    problem, readings = drive(FIELD, circle(25), 13)
    c, s = math.cos(yaw), math.sin(yaw)
    higher = replace(FIELD, values_nt=FIELD.values_nt + more)
    rows = [
        Reading(
            r.t,
            r.b_nt + more,
            (
                x + c * r.odometry[0] - s * r.odometry[1],
                y + s * r.odometry[0] + c * r.odometry[1],
                r.odometry[2] + yaw + turns * 2 * math.pi,
            ),
        )
        for r in readings
    ]
    a = estimates(RaoBlackwell(particles=300), problem, readings)
    b = estimates(RaoBlackwell(particles=300), replace(problem, belief=higher), rows)
    assert_allclose(poses(a), poses(b), atol=1e-6)


def test_a_predicted_disturbance_is_subtracted_and_its_sd_added():
    problem, readings = drive(FIELD, circle(40), 14, sensor=IRON)
    rng = np.random.default_rng(0)
    known = [
        replace(r, b_nt=r.b_nt + d, disturbance_nt=d)
        for r, d in zip(readings, (800 * rng.standard_normal(len(readings))).tolist(), strict=True)
    ]
    plain = estimates(RaoBlackwellIron(), problem, readings)
    assert_allclose(poses(estimates(RaoBlackwellNetwork(), problem, known)), poses(plain), atol=1e-6)
    unsure = [replace(r, disturbance_sd_nt=300.0) for r in known]
    wide = estimates(RaoBlackwellNetwork(), problem, unsure)
    assert np.linalg.det(wide[-1].covariance) > 2 * np.linalg.det(plain[-1].covariance)


def test_names_options_and_refusals():
    names = {"bootstrap": Bootstrap, "rbpf": RaoBlackwell, "rbpf-iron": RaoBlackwellIron}
    for name, made in {**names, "rbpf-network": RaoBlackwellNetwork}.items():
        assert type(load_localizer(name)) is made
    for options in ({"particles": 1}, {"particles": 10.5}, {"kappa": 0.0}, {"map_correlated": 2.0}):
        with pytest.raises(InputError):
            RaoBlackwell(**options)
    with pytest.raises(InputError, match="did you mean 'particles'"):
        load_localizer("rbpf", {"particle": 5})


@pytest.mark.parametrize("name", ["rbpf", "ekf", "point-mass", "smoother"])
def test_what_needs_a_map_is_refused_without_one(name):
    method, blind = load_localizer(name), Problem(belief=None, extent=EXTENT, prior=Prior())
    with pytest.raises(InputError, match="a map"):
        method.run(blind, None) if name == "smoother" else method.reset(blind)
