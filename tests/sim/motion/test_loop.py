"""The closed loop: plain Python and machine code give the same bits; drive and contact have closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.path import Path, path_named
from magtwin.sim.motion import closed_loop as courses
from magtwin.sim.motion.closed_loop import Chassis, ClosedLoop, run_loops
from magtwin.sim.motion.controllers import CONTROLLERS
from magtwin.sim.motion.drive import Motion, draw_wheel_errors
from magtwin.sim.motion.follow import follow, loop_along, play
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles

REAL = DriveSpec()
IDEAL = dataclasses.replace(REAL, motor_lag_s=0.0, slip_s2_m=0.0, yaw_slip=0.0)
PROMPT = dataclasses.replace(IDEAL, a_max=1e6, alpha_max=1e6)
"""A drive that does at once what it is told."""

RADIUS = 0.171
COLUMNS = ("v", "w", "wheel_v", "wheel_w", "v_cmd", "w_cmd", "bump", "poses", "wheel_angles")


def box(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def wall(x: float) -> Obstacles:
    return Obstacles(("wall",), (box(x, -9.0, x + 0.1, 9.0),))


ROOM = Obstacles(
    ("north", "south", "east", "west", "desk"),
    (
        box(-3, 1.75, 3, 1.8),
        box(-3, -1.8, 3, -1.75),
        box(3, -2, 3.1, 2),
        box(-3.1, -2, -3, 2),
        box(-0.3, -0.2, 0.3, 0.2),
    ),
)


@pytest.fixture(params=["plain", "compiled"])
def way(request, monkeypatch):
    """Plain and compiled."""
    monkeypatch.setattr(courses.LOOPS, "code", None)
    monkeypatch.setattr(courses.LOOPS, "pays", math.inf)
    if request.param == "compiled":
        courses.warm_up()
    return request.param


@pytest.fixture
def both(monkeypatch):
    """A function that runs courses in both ways."""

    def run(
        chosen: list[ClosedLoop], obstacles: Obstacles | None = None
    ) -> tuple[list[Motion], list[Motion]]:
        monkeypatch.setattr(courses.LOOPS, "pays", math.inf)
        monkeypatch.setattr(courses.LOOPS, "code", None)
        plain = run_loops(chosen, obstacles)
        courses.warm_up()
        return plain, run_loops(chosen, obstacles)

    return run


def assert_same(one: Motion, other: Motion) -> None:
    for column in COLUMNS:
        assert_array_equal(getattr(one, column), getattr(other, column), err_msg=column)


def held(v: float, w: float, seconds: float) -> np.ndarray:
    """A command said ten times a second."""
    t = np.arange(0.0, seconds, 0.1)
    return np.column_stack([t, np.full(len(t), v), np.full(len(t), w)])


# --- one source, two ways ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONTROLLERS)
def test_plain_python_and_machine_code_drive_to_the_same_bits(both, name):
    rng = np.random.default_rng(3)
    chosen = [
        loop_along(
            path_named(path),
            drive,
            speed=0.25,
            duration_s=60.0,
            controller=name,
            footprint_radius_m=RADIUS,
            wheel_errors=draw_wheel_errors(drive, rng),
        )
        for path in ("figure8", "lawnmower", "narrow_figure8", "fast_sine")
        for drive in (REAL, IDEAL)
    ]
    walls = Obstacles(ROOM.names[:4], ROOM.outlines[:4])
    for obstacles in (None, walls):
        for plain, compiled in zip(*both(chosen, obstacles), strict=True):
            assert_same(plain, compiled)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_any_script_among_obstacles_is_driven_to_the_same_bits(seed):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.exponential(0.3, 60))
    script = np.column_stack([t, rng.uniform(-0.6, 0.6, 60), rng.uniform(-3, 3, 60)])
    kept, courses.LOOPS.code = courses.LOOPS.code, None
    try:
        plain = play(script, REAL, start=(-1.0, 0.5, 0.3), obstacles=ROOM, footprint_radius_m=RADIUS)
        courses.warm_up()
        compiled = play(script, REAL, start=(-1.0, 0.5, 0.3), obstacles=ROOM, footprint_radius_m=RADIUS)
    finally:
        courses.LOOPS.code = kept
    assert_same(plain, compiled)
    distance, _ = ROOM.clearance(plain.poses[:, :2])
    assert distance.min() > RADIUS - 1e-5


def test_a_robot_drives_to_the_same_bits_alone_in_blocks_and_among_others(both, monkeypatch):
    rng = np.random.default_rng(1)
    chosen = [
        loop_along(
            path_named(path),
            REAL,
            speed=speed,
            controller=name,
            footprint_radius_m=RADIUS,
            wheel_errors=draw_wheel_errors(REAL, rng),
        )
        for path, speed, name in (
            ("curvilinear", 0.2, "follower"),
            ("figure8", 0.3, "release"),
            ("sine", 0.1, "follower"),
        )
    ]
    plain, together = both(chosen)
    monkeypatch.setattr(courses, "BLOCK", 333)
    plain_in_blocks, in_blocks = both(chosen)
    backward = run_loops(chosen[::-1])[::-1]
    monkeypatch.setattr(courses, "RECORDED", 1)
    one_by_one = run_loops(chosen)
    monkeypatch.setattr(courses, "SHARE", 1)
    in_threads = run_loops(chosen)
    for n, first in enumerate(plain):
        for other in (together, plain_in_blocks, in_blocks, backward, one_by_one, in_threads):
            assert_same(first, other[n])


# --- the drive --------------------------------------------------------------------------------------------


def test_a_prompt_drive_goes_the_closed_ways_of_its_commands(way):
    line = play(held(0.2, 0.0, 5.0), PROMPT, start=(1.0, 2.0, 0.5), duration_s=5.0)
    assert_allclose(line.poses[-1], [1 + math.cos(0.5), 2 + math.sin(0.5), 0.5], atol=1e-12)
    arc = play(held(0.2, 0.8, 5.0), PROMPT, duration_s=5.0)
    assert_allclose(arc.poses[-1], [0.25 * math.sin(4), 0.25 * (1 - math.cos(4)), 4.0], atol=1e-12)
    spin = play(held(0.0, -1.5, 4.0), PROMPT, duration_s=4.0)
    assert_allclose(spin.poses[-1], [0.0, 0.0, -6.0], atol=1e-12)


def test_the_motors_lag_is_the_closed_form_of_first_order(way):
    lagging = dataclasses.replace(PROMPT, motor_lag_s=0.15)
    motion = play(held(0.3, 0.9, 2.0), lagging, duration_s=2.0)
    t = np.arange(101) * 0.02
    share = t - 0.15 * (1 - np.exp(-t / 0.15))
    assert_allclose(motion.poses[:, 2], 0.9 * share, atol=1e-12)
    way_m = np.concatenate([[0.0], np.cumsum(motion.v) * 0.02])
    assert_allclose(way_m, 0.3 * share, atol=1e-12)
    # v and w rise together, so it drives along one circle.
    assert_allclose(np.hypot(motion.poses[:, 0], motion.poses[:, 1] - 1 / 3), 1 / 3, rtol=1e-12)


@pytest.mark.parametrize("ahead", [1, -1])
def test_slip_takes_its_share_of_what_speeds_up_and_gives_it_back_where_it_slows(way, ahead):
    slipping = dataclasses.replace(IDEAL, slip_s2_m=0.1)
    motion = play(held(0.3 * ahead, 0.0, 2.0), slipping)
    rolled, went = ahead * np.asarray(motion.wheel_v), ahead * motion.v
    gain = np.diff(rolled, prepend=0.0) / motion.dt
    assert_allclose(went, rolled * (1 - 0.1 * gain), atol=1e-15)
    faster = gain > 0.899
    assert_allclose(went[faster], rolled[faster] * (1 - 0.1 * 0.9), rtol=1e-12)
    assert (went[gain < -0.1] > rolled[gain < -0.1]).any()


def test_scrubbing_and_wheels_of_another_size_scale_the_twist(way):
    scrubbing = dataclasses.replace(PROMPT, yaw_slip=0.05)
    motion = play(held(0.2, 1.0, 2.0), scrubbing, duration_s=2.0, wheel_errors=(0.01, -0.02))
    assert_allclose(motion.v, 0.2 * 1.01, rtol=1e-14)
    assert_allclose(motion.w, 1.0 * 1.01 / 0.98 * 0.95, rtol=1e-14)
    assert_allclose(motion.wheel_rates[10], [(0.2 - 0.1165) / 0.03575, (0.2 + 0.1165) / 0.03575], rtol=1e-12)


# --- contact ----------------------------------------------------------------------------------------------


def test_a_robot_that_drives_at_a_wall_stands_when_it_touches(way):
    motion = play(held(0.25, 0.0, 6.0), PROMPT, obstacles=wall(1.0), footprint_radius_m=RADIUS)
    assert_allclose(motion.poses[-1], [1.0 - RADIUS, 0.0, 0.0], atol=1e-9)
    touched = int(np.flatnonzero(motion.bump)[0])
    assert touched == int((1.0 - RADIUS) / (0.25 * 0.02))
    assert motion.bump[touched:].all()
    assert not motion.bump[:touched].any()
    assert_allclose(motion.wheel_rates[touched + 1 :], 0.0, atol=1e-9)  # the motors stall
    assert_allclose(motion.v_cmd[touched + 1], 0.25)


@pytest.mark.parametrize("aside", [-0.15, -0.02, 0.0, 0.1, 0.17])
def test_it_stops_where_its_circle_meets_a_corner(way, aside):
    wedge = Obstacles(("wedge",), (np.array([[1.0, 0.0], [2.0, -1e-3], [2.0, 1e-3]]),))
    motion = play(
        held(0.25, 0.0, 6.0), PROMPT, start=(0.0, aside, 0.0), obstacles=wedge, footprint_radius_m=RADIUS
    )
    assert_allclose(motion.poses[-1, :2], [1.0 - math.sqrt(RADIUS**2 - aside**2), aside], atol=2e-3)
    assert_allclose(wedge.clearance(motion.poses[-1:, :2])[0], RADIUS, atol=1e-9)
    assert motion.bump[-1]


def test_at_a_wall_it_can_turn_on_the_spot_and_drive_away(way):
    script = np.vstack(
        [
            held(0.25, 0.0, 6.0),
            np.add(held(0.25, 1.0, 2.0), [6.0, 0.0, 0.0]),
            np.add(held(0.25, 0.0, 2.0), [8.0, 0.0, 0.0]),
        ]
    )
    motion = play(script, PROMPT, obstacles=wall(1.0), footprint_radius_m=RADIUS, duration_s=10.0)
    at_wall = motion.poses[300]
    assert_allclose(motion.poses[375, :2], at_wall[:2], atol=1e-6)  # turned by 1.5 rad it stands there still
    assert_allclose(motion.poses[375, 2], 1.5, atol=1e-9)
    away = 300 + math.ceil(math.pi / 2 / 0.02)  # when it faces away from the wall
    assert motion.bump[170:away].all()
    assert not motion.bump[away + 2 :].any()
    assert wall(1.0).clearance(motion.poses[:, :2])[0].min() > RADIUS - 1e-6


def test_a_fast_robot_does_not_jump_through_a_thin_wall(way):
    fast = dataclasses.replace(PROMPT, v_max=100.0, wheel_rate_max=1e6)
    thin = Obstacles(("sheet",), (box(1.0, -9.0, 1.001, 9.0),))
    motion = play(held(90.0, 0.0, 1.0), fast, obstacles=thin, footprint_radius_m=RADIUS, duration_s=1.0)
    assert_allclose(motion.poses[-1, 0], 1.0 - RADIUS, atol=1e-9)


# --- step by step -----------------------------------------------------------------------------------------


class Straight:
    """A controller of somebody's own, which speaks only now and then."""

    def __init__(self, every: int = 1, speed: float = 0.2):
        self.calls, self.every, self.speed, self.done = 0, every, speed, False

    def command(self, t, x, y, yaw, v, w):
        assert t == pytest.approx(self.calls * 0.02)
        self.calls += 1
        self.done = x > 1.0
        if self.done:
            return 0.0, 0.0
        return (self.speed, 0.0) if (self.calls - 1) % self.every == 0 else None


LINE = Path("line", np.array([[0.0, 0.0], [2.0, 0.0]]))


def test_a_controller_that_falls_silent_is_obeyed_until_the_drive_loses_patience():
    spoken = follow(LINE, PROMPT, speed=0.2, controller=Straight(every=20), duration_s=3.0)
    assert_allclose(spoken.v, 0.2)
    silent = follow(LINE, PROMPT, speed=0.2, controller=Straight(every=10**6), duration_s=3.0)
    assert_allclose(silent.v[:26], 0.2)
    assert_allclose(silent.v[26:], 0.0)


def test_a_guide_asked_step_by_step_drives_as_the_loop_does():
    course = loop_along(path_named("figure8"), REAL, speed=0.25, duration_s=40.0, footprint_radius_m=RADIUS)
    chassis, rows = Chassis(course), []
    guide = dataclasses.replace(course.guide)
    while not guide.done and chassis.t < 40.0 - 1e-9:
        rows.append(chassis.step(guide.command(chassis.t, *chassis.pose, *chassis.twist)))
    assert_same(courses.motion_of(course, np.array(rows).T), run_loops([course])[0])


# --- refusals ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ([[0.0, math.nan, 0.0]], r"command 1 of 1 is not finite: t, v, w = \[0\.0, nan, 0\.0\]"),
        ([[0.0, 0.1, 0.0], [0.1, 0.1, math.inf]], "command 2 of 2 is not finite"),
        ([[0.0, 0.1, 0.0], [0.2, 0.1, 0.0], [0.1, 0.1, 0.0]], r"command 3 of 3 has t = 0\.1 s after 0\.2 s"),
        ([[-1.0, 0.1, 0.0]], r"from 0 s up: command 1 of 1 has t = -1 s"),
        ([[0.0, 0.1]], r"of shape \(K, 3\), got \(1, 2\)"),
        (np.empty((0, 3)), r"of shape \(K, 3\), got \(0, 3\)"),
    ],
)
def test_a_script_that_cannot_be_played_is_refused(script, says):
    with pytest.raises(InputError, match=says):
        play(script, REAL)


def test_a_start_in_a_wall_is_refused_with_its_place():
    says = r"begin in wall: at \(0\.000, 0\.000\) m its footprint of radius 0\.171 m is 0\.071 m too near"
    with pytest.raises(InputError, match=says):
        play(held(0.1, 0.0, 1.0), REAL, obstacles=wall(0.1), footprint_radius_m=RADIUS)
