"""The differential drive: closed forms of its motion, wheels and limits."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from magtwin.sim.motion.drive import Motion, integrate_twist, limiter, wheel_rates
from magtwin.spec.drive import DriveSpec

DRIVE = DriveSpec()
speeds, turns = st.floats(-0.5, 0.5), st.floats(-3, 3)


def test_a_constant_twist_goes_round_a_circle_of_radius_v_over_w_whatever_the_step():
    v, w = 0.3, 0.7
    for steps in (7, 1000):
        poses = integrate_twist([v] * steps, [w] * steps, 2 * np.pi / w / steps)
        assert_allclose(np.hypot(poses[:, 0], poses[:, 1] - v / w), v / w, rtol=1e-12)
        assert_allclose(poses[-1], [0, 0, 2 * np.pi], atol=1e-12)


def test_the_wheels_of_a_circle_roll_along_circles_half_a_separation_apart():
    v, w = 0.2, 0.8
    motion = Motion(DRIVE, 0.02, np.full(500, v), np.full(500, w))
    angle = motion.at([9.99]).wheel_angle[0]
    radii = v / w + np.array([-1, 1]) * DRIVE.wheel_separation_m / 2
    assert_allclose(angle * DRIVE.wheel_radius_m, w * 9.99 * radii, rtol=1e-12)


def test_a_motion_between_its_steps_is_exact():
    rng = np.random.default_rng(0)
    v, w = rng.uniform(0, 0.3, 40), rng.uniform(-1.9, 1.9, 40)
    coarse = Motion(DRIVE, 0.02, v, w, (0.5, 0.6, 0.7))
    fine = Motion(DRIVE, 0.002, np.repeat(v, 10), np.repeat(w, 10), (0.5, 0.6, 0.7))
    t = np.arange(400) * 0.002 + 1e-9  # just inside the fine steps
    assert_allclose(coarse.at(t).pose, fine.at(t).pose, atol=1e-12)
    assert_allclose(coarse.at(t).wheel_angle, fine.at(t).wheel_angle, atol=1e-10)


@given(
    wanted=st.tuples(st.floats(-9, 9), st.floats(-99, 99)),
    last=st.tuples(st.floats(-0.306, 0.306), st.floats(-1.9, 1.9)),
)
def test_a_limited_twist_keeps_every_limit_and_comes_as_near_as_they_let_it(wanted, last):
    dt, drive = 0.02, replace(DRIVE, wheel_rate_max=100.0)
    twist = limiter(drive, dt)(*wanted, *last)
    for got, want, was, top, rate in zip(
        twist, wanted, last, (DRIVE.v_max, DRIVE.w_max), (DRIVE.a_max, DRIVE.alpha_max), strict=True
    ):
        assert got == np.clip(want, max(was - rate * dt, -top), min(was + rate * dt, top))


@given(
    wanted=st.tuples(st.floats(-9, 9), st.floats(-99, 99)),
    last=st.tuples(st.floats(-0.5, 0.5), st.floats(-1.9, 1.9)),
)
def test_no_wheel_turns_faster_than_it_can_and_turning_goes_before_speed(wanted, last):
    dt, drive = 0.02, replace(DRIVE, v_max=0.5)
    if np.abs(wheel_rates(*last, drive)).max() > drive.wheel_rate_max:
        return
    v, w = limiter(drive, dt)(*wanted, *last)
    free_v, free_w = limiter(replace(drive, wheel_rate_max=100.0), dt)(*wanted, *last)
    top = np.abs(wheel_rates(v, w, drive)).max()
    assert top <= drive.wheel_rate_max * (1 + 1e-12)
    assert abs(v - last[0]) <= drive.a_max * dt + 1e-12
    assert abs(w - last[1]) <= drive.alpha_max * dt + 1e-12
    if (v, w) != (free_v, free_w):
        assert top >= drive.wheel_rate_max * (1 - 1e-12)
    if w != free_w:  # only where speed already gives way as quickly as it may
        assert abs(v) <= max(abs(last[0]) - drive.a_max * dt, 0.0) + 1e-12
