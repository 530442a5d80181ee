from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rooms import EARTH, scene_of

from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.sim.interference import (
    ambient_at_sensor_nt,
    ambient_field_nt,
    ambient_gradient_nt_m,
    draw_platform,
    level_field_nt,
    level_gradient_nt_m,
    own_field_nt,
    platform_field_nt,
    rest_current_a,
    turning_iron_nt,
)
from magtwin.sim.motion.drive import Motion
from magtwin.spec.drive import DriveSpec
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.magnetics import PlatformFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import BatterySpec

SCENE = scene_of(RobotSpec(name="r", asset=Path("r.usda")))
QUIET = {
    "b_rate": np.zeros((4, 3)),
    "motor_nm": np.zeros((4, 2)),
    "lidar_on": np.zeros(4, bool),
    "lidar_angle": np.zeros(4),
    "battery_a": np.zeros(4),
}
LAB = replace(
    SCENE,
    earth=EARTH,
    sources=(
        SourceSpec(name="pipe", p_world=(0.5, 0.0, -0.6), m_world=(1.0, -2.0, 3.0)),
        SourceSpec(
            name="block",
            p_world=(-0.4, 0.3, -0.4),
            shape="cuboid",
            size_m=(0.2, 0.1, 0.1),
            magnetization=(0, 0, 4e3),
        ),
    ),
    furniture=(FurnitureSpec(name="desk", kind="desk", p_world=(0.0, 1.5, 0.0), magnetization=()),),
)
B = np.random.default_rng(0).normal(scale=25_000, size=(4, 3))


def test_sources_add_their_dipole_fields_to_the_earths():
    source = SourceSpec(name="pipe", p_world=(0.5, 0.0, -0.6), m_world=(1.0, -2.0, 3.0))
    scene = replace(SCENE, earth=EARTH, sources=(source, replace(source, name="beam", p_world=(0, 0, -1.0))))
    p = np.array([[0.0, 0.0, 0.4], [1.0, 1.0, 0.4]])
    want = dipole_field_nt(p, [[0.5, 0, -0.6], [0, 0, -1.0]], [[1.0, -2.0, 3.0]] * 2) + EARTH.b_world_nt
    assert_allclose(ambient_field_nt(scene, p), want, rtol=0, atol=1e-9)


def test_the_labs_field_has_neither_sources_nor_curls_where_the_robot_is():
    p, h = np.random.default_rng(1).uniform((-0.8, -0.8, 0.2), (0.8, 0.8, 0.6), (20, 3)), 1e-4
    ahead, behind = (ambient_field_nt(LAB, p[:, None] + s * h * np.eye(3)) for s in (1, -1))
    slope = (ahead - behind) / (2 * h)  # [point, along, component]
    size = np.abs(slope).max(axis=(1, 2))
    assert np.all(np.abs(np.trace(slope, axis1=1, axis2=2)) < 1e-4 * size)  # what dipoles for bodies leave
    assert np.all(np.abs(slope - slope.swapaxes(1, 2)).max(axis=(1, 2)) < 1e-4 * size)


def test_what_is_looked_up_at_one_height_is_the_exact_field_and_gradient_there():
    p = np.column_stack([np.random.default_rng(2).uniform(-0.9, 0.9, (200, 2)), np.full(200, 0.35)])
    field, slopes = level_field_nt(LAB, p[:, :2], 0.35)
    assert_allclose(field, ambient_field_nt(LAB, p), rtol=0, atol=0.01)
    assert slopes.shape == (200, 2, 3)
    gradient = level_gradient_nt_m(LAB, p[:, :2], 0.35)
    assert_allclose(gradient, ambient_gradient_nt_m(LAB, p), rtol=1e-4)  # what dipoles for bodies leave
    assert gradient.max() > 3 * gradient.min() > 0


def test_each_part_of_the_robots_field_enters_by_its_own_law():
    matrix = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    square, v = np.reshape(matrix, (3, 3)), np.array([30.0, -20.0, 10.0])
    rate, torque, on = B / 7, B[:, :2] / 1e4, np.array([1, 0, 1, 0])
    amperes, angle = np.array([0.1, 0.2, 0.0, 0.3]), np.array([0.3, 1.0, 4.0, 2.0])
    spins = {"lidar_on": on, "lidar_angle": angle}
    parts = {
        "hard_iron_nt": (tuple(v), {}, np.broadcast_to(v, (4, 3))),
        "soft_iron": (matrix, {}, np.array([square @ b for b in B])),
        "eddy_s": (matrix, {"b_rate": rate}, np.array([square @ r for r in rate])),
        "left_motor_nt_nm": (tuple(v), {"motor_nm": torque}, np.outer(torque[:, 0], v)),
        "right_motor_nt_nm": (tuple(v), {"motor_nm": torque}, np.outer(torque[:, 1], v)),
        "lidar_nt": (tuple(v), spins, np.outer(on, v)),
        "lidar_cos_nt": (tuple(v), spins, np.outer(on * np.cos(angle), v)),
        "lidar_sin_nt": (tuple(v), spins, np.outer(on * np.sin(angle), v)),
        "battery_nt": (tuple(v), {"battery_a": amperes}, np.outer(amperes, v)),
    }
    everything, state, total = PlatformFieldSpec(), dict(QUIET), np.array(B)
    for name, (value, changed, added) in parts.items():
        platform = replace(PlatformFieldSpec(), **{name: value})
        got = platform_field_nt(platform, B, **{**QUIET, **changed})
        assert_allclose(got - B, added, rtol=1e-12, atol=1e-7, err_msg=name)
        everything = replace(everything, **{name: value})
        state |= changed
        total = total + added
    assert_allclose(platform_field_nt(everything, B, **state), total, rtol=1e-12)


ROLLING = RobotSpec(
    name="r",
    asset=Path("r.usda"),
    base_height_m=-0.004,
    p_base_magnetometer=(-0.02, 0.01, 0.35),
    drive=DriveSpec(wheel_radius_m=0.036, wheel_separation_m=0.23),
    platform=PlatformFieldSpec(p_base_caster=(0.125, 0.0, 0.014), caster_radius_m=0.012),
)


@pytest.mark.parametrize(
    ("part", "place", "share"),
    [
        ("left_wheel", (0.0, 0.115, 0.04), (1.0, 0.0)),
        ("right_wheel", (0.0, -0.115, 0.04), (0.0, 1.0)),
        ("caster", (0.125, 0.0, 0.014), (1.5, 1.5)),  # half of each wheel's way, on a third of the radius
    ],
)
def test_iron_turns_with_its_wheel_as_a_dipole_there(part, place, share):
    figures = {f"{part}_moment": 0.01, f"{part}_phase": 0.4}
    robot = replace(ROLLING, platform=replace(ROLLING.platform, **figures))
    angle = np.random.default_rng(2).uniform(-20, 20, (9, 2))
    field = turning_iron_nt(robot, angle)
    for row, b in zip(angle @ share + 0.4, field, strict=True):
        moment = 0.01 * np.array([[np.sin(row), 0.0, np.cos(row)]])  # turns about y from up to forwards
        assert_allclose(b, dipole_field_nt(robot.p_base_magnetometer, [place], moment), rtol=1e-12)


def test_a_robot_that_speeds_up_draws_more_torque_than_one_that_cruises():
    platform = PlatformFieldSpec(left_motor_nt_nm=(1e4, 0.0, 0.0), right_motor_nt_nm=(0.0, 1e4, 0.0))
    battery = BatterySpec(drag_n=2.0, mass_kg=4.0)
    scene = replace(SCENE, earth=EARTH, robot=replace(SCENE.robot, platform=platform, battery=battery))
    drive = scene.robot.drive
    motion = Motion(
        drive, 0.01, np.concatenate([np.arange(1, 101) * 0.003, np.full(100, 0.3)]), np.zeros(200)
    )
    t = np.array([0.5, 1.5])
    true = motion.at(t)
    rest = rest_current_a(battery)
    b_base, b_rate = ambient_at_sensor_nt(scene, true)
    known = {"true": true, "lidar_on": np.zeros(2), "supply_a": np.full(2, rest)}
    b = own_field_nt(scene.robot, motion, t, b_base, b_rate, **known)
    # r (F / 2 + m a / 2) = 0.03575 x (1 + 2 x 0.3) while it speeds up at 0.3 m/s2, then 0.03575 x 1
    added = (b - EARTH.b_world_nt)[:, :2] / 1e4
    assert_allclose(added, drive.wheel_radius_m * np.array([[1.6, 1.6], [1.0, 1.0]]), rtol=1e-9)


def test_days_differ_by_the_platforms_own_spreads_and_the_day_itself_by_none():
    platform = PlatformFieldSpec(
        hard_iron_nt=(100.0, 200.0, 300.0),
        lidar_nt=(10.0, 20.0, 30.0),
        battery_nt=(1.0, 0.0, 0.0),
        hard_iron_drift_nt=(0.0, 50.0, -500.0),
        hard_iron_std_nt=40.0,
        current_std=0.2,
    )
    rng = np.random.default_rng(3)
    days = [draw_platform(platform, rng) for _ in range(2000)]
    iron = np.array([day.hard_iron_nt for day in days])
    assert_allclose(iron.mean(axis=0), [100, 250, -200], atol=4 * 40 / np.sqrt(2000))
    assert_allclose(iron.std(axis=0), 40, rtol=4 / np.sqrt(4000))
    lidar = np.array([day.lidar_nt for day in days])
    assert_allclose(lidar / lidar[:, :1], np.tile([1.0, 2.0, 3.0], (2000, 1)))  # its direction stays
    assert lidar[:, 0].std() == pytest.approx(2.0, rel=4 / np.sqrt(4000))
    phases = np.array([[day.left_wheel_phase, day.right_wheel_phase, day.lidar_phase] for day in days])
    assert_allclose(phases.mean(axis=0), np.pi, atol=4 * 2 * np.pi / np.sqrt(12 * 2000))
    again = draw_platform(days[0], np.random.default_rng(4))
    assert again.hard_iron_nt == days[0].hard_iron_nt
    assert draw_platform(platform, np.random.default_rng(3)) == days[0]
