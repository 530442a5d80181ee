"""A robot that steers like a car: no motion is tighter than its turning radius."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magtwin.errors import InputError
from magtwin.path import Path
from magtwin.sim.motion.drive import limiter
from magtwin.sim.motion.follow import follow, play
from magtwin.spec.drive import DriveSpec

RADIUS = 0.6
CAR = DriveSpec(turning_radius_m=RADIUS, v_max=1.0, yaw_slip=0.0, slip_s2_m=0.0)
STILL = 1e-6
"""Rounding of a ratio of two speeds."""


def circle(radius: float) -> Path:
    angle = np.linspace(0, 2 * np.pi, 400)
    return Path("circle", radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)]), closed=True)


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1))
@settings(deadline=None)
def test_the_limiter_keeps_the_curvature(v_wanted, w_wanted, v, w):
    limited_v, limited_w = limiter(CAR, 0.02)(v_wanted, w_wanted, v, w)
    assert abs(limited_w) * RADIUS <= abs(limited_v) * (1 + STILL)
    free = DriveSpec(v_max=1.0, yaw_slip=0.0, slip_s2_m=0.0)
    same_v, same_w = limiter(free, 0.02)(v_wanted, w_wanted, v, w)
    assert limited_v == same_v
    assert abs(limited_w) <= abs(same_w)


def test_a_hard_turn_at_speed_is_a_circle_of_the_turning_radius():
    commands = [[t, 0.3, 5.0] for t in np.arange(0, 4, 0.25)]
    motion = play(commands, CAR)
    steady = slice(100, 180)
    np.testing.assert_allclose(motion.v[steady] / motion.w[steady], RADIUS, rtol=STILL)
    assert (np.abs(motion.w) * RADIUS <= np.abs(motion.v) * (1 + STILL) + 1e-12).all()


def test_a_car_follows_a_path_that_it_can_drive():
    motion = follow(circle(0.8), CAR, speed=0.2)
    off = np.abs(np.hypot(motion.poses[:, 0], motion.poses[:, 1] - 0.8) - 0.8)
    assert off.max() < 0.01  # the exact pose is known; a robot that turns on the spot keeps 2 mm
    assert (np.abs(motion.w) * RADIUS <= np.abs(motion.v) * (1 + STILL) + 1e-12).all()


@pytest.mark.parametrize(
    "path", [circle(0.5), Path("square", np.array([[0, 0], [3, 0], [3, 3], [0, 3], [0.0, 0]]))]
)
def test_a_path_that_turns_more_tightly_is_refused_with_the_place(path):
    with pytest.raises(
        InputError, match=rf"path {path.name}: it turns with a radius of .* m at .*0\.6; take"
    ):
        follow(path, CAR, speed=0.2)
    follow(path, DriveSpec(), speed=0.2)
