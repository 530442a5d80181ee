"""LiDAR: its schedule, and scans against closed forms and a plain ray caster."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.frames import quat_from_rpy, quat_from_yaw, rotate
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import lidar_on, ray_angles, scan, scans_of
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import LidarSpec

QUIET = LidarSpec(range_noise_std_m=0.0, latency_s=0.0, jitter_s=0.0)
FACES = ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
         (0, 6, 4), (1, 5, 7), (1, 7, 3))  # fmt: skip


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1])
                        for z in (low[2], high[2])])  # fmt: skip
    return corners[np.array(FACES)]


def room(*boxes: np.ndarray) -> Obstacles:
    return Obstacles(triangles=np.concatenate(boxes))


def square(side: float) -> Obstacles:
    """The inside of a box: its walls, seen from within."""
    return room(box((-side / 2, -side / 2, 0.0), (side / 2, side / 2, 0.5)))


def cast_plainly(triangles: np.ndarray, p: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Each ray against each triangle, after Moeller and Trumbore (1997)."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    ranges = np.full(len(directions), np.inf)
    for i, d in enumerate(directions):
        h = np.cross(d, v)
        det = np.sum(u * h, axis=1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            s = np.sum((p - a) * h, axis=1) / det
            q = np.cross(p - a, u)
            t = q @ d / det
            r = np.sum(v * q, axis=1) / det
            hit = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9) & (r > 0)
        ranges[i] = r[hit].min(initial=np.inf)
    return ranges


def directions(spec: LidarSpec, q) -> np.ndarray:
    angle = ray_angles(spec.rays)
    return rotate(np.asarray(q), np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))]))


def test_a_schedule_without_a_part_is_constant_and_modes_override_it():
    t = np.linspace(0, 200, 1001)
    assert not lidar_on(LidarSpec(on_s=0.0), t).any()
    assert lidar_on(LidarSpec(off_s=0.0), t).all()
    assert not lidar_on(LidarSpec(on_s=0.0, off_s=0.0), t).any()
    assert lidar_on(LidarSpec(), t, "on").all()
    assert not lidar_on(LidarSpec(), t, "off").any()
    with pytest.raises(InputError, match='must be "schedule", "on" or "off", got \'sometimes\''):
        lidar_on(LidarSpec(), t, "sometimes")  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None)
@given(x=st.floats(-1.9, 1.9), y=st.floats(-1.9, 1.9), yaw=st.floats(-7, 7), rays=st.integers(1, 500))
def test_ranges_in_a_square_room_are_the_closed_form(x, y, yaw, rays):
    spec = dataclasses.replace(QUIET, rays=rays, range_min_m=0.0)
    ranges = scan(square(4.0), ((x, y, 0.2), quat_from_yaw(yaw)), spec)
    angle = ray_angles(spec.rays) + yaw
    cos, sin = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore", over="ignore"):
        wanted = np.minimum((np.copysign(2.0, cos) - x) / cos, (np.copysign(2.0, sin) - y) / sin)
    assert_allclose(ranges, wanted, rtol=1e-7)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), tilt=st.integers(-300, 300).map(lambda mrad: mrad / 1000))
def test_a_scan_among_boxes_is_what_a_plain_ray_caster_sees_however_the_lidar_leans(seed, tilt):
    rng = np.random.default_rng(seed)
    low = rng.uniform(-3, 2.5, (8, 3)) * (1, 1, 0.02)
    size = rng.uniform(0.1, 1.0, (8, 3))
    obstacles = room(*(box(tuple(a), tuple(a + b)) for a, b in zip(low, size, strict=True)))
    spec = dataclasses.replace(QUIET, rays=90, range_min_m=0.0)
    p, q = rng.uniform(-1, 1, 3) * (1, 1, 0.1) + (0, 0, 0.3), quat_from_rpy([tilt, -tilt / 2, seed])
    ranges = scan(obstacles, (p, q), spec)
    wanted = cast_plainly(obstacles.triangles, p, directions(spec, q))
    wanted[wanted > spec.range_max_m] = np.inf
    # A ray that grazes an edge may go either way.
    agree = np.isclose(ranges, wanted, rtol=1e-6) | (np.isinf(ranges) & np.isinf(wanted))
    assert np.count_nonzero(~agree) <= 1
    assert np.isfinite(wanted).any() or not np.isfinite(ranges).any()


def a_run(lidar: np.ndarray | None = None) -> Run:
    t = np.arange(1350) / 135.0
    x, yaw = -0.5 + 0.1 * t, 0.3 * t
    return Run({
        "t": t,
        "p_world_base": np.column_stack([x, np.zeros_like(x), np.zeros_like(x)]),
        "yaw": (yaw + np.pi) % (2 * np.pi) - np.pi,
        "lidar_on": np.ones(len(t), bool) if lidar is None else lidar,
    })  # fmt: skip


ROBOT = RobotSpec(
    name="robot",
    asset=Path("robot.usda"),
    lidar=QUIET,
    p_base_lidar=(-0.04, 0.01, 0.19),
    q_base_lidar_link_xyzw=(0.0, 0.0, 0.5**0.5, 0.5**0.5),
)


def test_a_runs_scans_are_those_at_its_poses_once_a_turn():
    run = a_run()
    scans = scans_of(run, ROBOT, square(4.0), np.random.default_rng(0))
    assert_allclose(np.diff(scans.t), 1 / 7.5)
    assert len(scans.t) == 75
    for i in (0, 17, 74):
        yaw = 0.3 * scans.t[i]
        q = quat_from_yaw(yaw + np.pi / 2)
        p = np.array([-0.5 + 0.1 * scans.t[i], 0, 0]) + rotate(quat_from_yaw(yaw), ROBOT.p_base_lidar)
        assert_allclose(scans.ranges_m[i], scan(square(4.0), (p, q), QUIET), rtol=1e-6)


def test_scans_come_while_the_lidar_spins_and_late_in_order():
    on = np.arange(1350) >= 675
    spec = dataclasses.replace(QUIET, latency_s=0.14, jitter_s=0.1)
    scans = scans_of(a_run(on), dataclasses.replace(ROBOT, lidar=spec), square(4.0), np.random.default_rng(0))
    assert scans.t.min() >= 5.0
    assert len(scans.t) == 37
    assert np.all(scans.arrival - scans.t >= 0.14)
    assert np.all(np.diff(scans.arrival) >= 0)
    none = scans_of(a_run(np.zeros(1350, bool)), ROBOT, square(4.0), np.random.default_rng(0))
    assert none.ranges_m.shape == (0, QUIET.rays)
