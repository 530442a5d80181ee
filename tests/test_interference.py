from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.field.sources import dipole_field_nt
from magtwin.names import RefusedError
from magtwin.sim.interference import ambient_field_nt, excess_current_a, platform_field_nt
from magtwin.spec import BatterySpec, EarthFieldSpec, PlatformFieldSpec, RobotSpec, Scene, SourceSpec

EARTH = EarthFieldSpec(
    b_world_nt=(-2_745.6, 24_067.1, -38_418.4),
    latitude_deg=29.65,
    longitude_deg=-82.35,
    height_m=50.0,
    date="2026-11-21",
)
SCENE = Scene(name="hall", map_layer=Path("hall.usdc"), robot=RobotSpec(name="r", asset=Path("r.usda")))
REST = {"b_rate": np.zeros((4, 3)), "wheel_rate": np.zeros((4, 2)), "lidar_on": np.zeros(4, bool)}
QUIET = {**REST, "battery_a": np.zeros(4)}
B = np.random.default_rng(0).normal(scale=25_000, size=(4, 3))


def test_without_sources_the_ambient_field_is_the_earths_everywhere():
    field = ambient_field_nt(replace(SCENE, earth=EARTH), np.zeros((2, 5, 3)))
    assert_array_equal(field, np.broadcast_to(EARTH.b_world_nt, (2, 5, 3)))


def test_sources_add_their_dipole_fields_to_the_earths():
    source = SourceSpec(name="pipe", p_world=(0.5, 0.0, -0.6), m_world=(1.0, -2.0, 3.0))
    scene = replace(SCENE, earth=EARTH, sources=(source, replace(source, name="beam", p_world=(0, 0, -1.0))))
    p = np.array([[0.0, 0.0, 0.4], [1.0, 1.0, 0.4]])
    want = dipole_field_nt(p, [[0.5, 0, -0.6], [0, 0, -1.0]], [[1.0, -2.0, 3.0]] * 2) + EARTH.b_world_nt
    assert_allclose(ambient_field_nt(scene, p), want, rtol=0, atol=1e-9)


def test_a_scene_without_the_earths_field_has_no_exact_field():
    with pytest.raises(RefusedError, match=r"scene 'hall' has no Earth's field.*\[earth\]"):
        ambient_field_nt(SCENE, np.zeros(3))


def test_a_robot_without_magnetism_adds_nothing():
    moving = {"b_rate": B, "wheel_rate": B[:, :2], "lidar_on": np.ones(4), "battery_a": np.ones(4)}
    assert_array_equal(platform_field_nt(PlatformFieldSpec(), B, **moving), B)


def test_each_part_of_the_robots_field_enters_by_its_own_law():
    matrix = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    square, v = np.reshape(matrix, (3, 3)), np.array([30.0, -20.0, 10.0])
    rate, wheels, on, amperes = B / 7, B[:, :2] / 1e4, np.array([1, 0, 1, 0]), np.array([0.1, 0.2, 0.0, 0.3])
    parts = {
        "hard_iron_nt": (tuple(v), {}, np.broadcast_to(v, (4, 3))),
        "soft_iron": (matrix, {}, np.array([square @ b for b in B])),
        "eddy_s": (matrix, {"b_rate": rate}, np.array([square @ r for r in rate])),
        "left_motor_nt_s": (tuple(v), {"wheel_rate": wheels}, np.outer(wheels[:, 0], v)),
        "right_motor_nt_s": (tuple(v), {"wheel_rate": wheels}, np.outer(wheels[:, 1], v)),
        "lidar_nt": (tuple(v), {"lidar_on": on}, np.outer(on, v)),
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


def test_a_sphere_of_soft_iron_alone_does_not_make_the_magnitude_depend_on_heading():
    platform = PlatformFieldSpec(soft_iron=(0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01))
    yaw = np.linspace(0, 2 * np.pi, 4, endpoint=False)
    b = np.column_stack([24_000 * np.cos(yaw), -24_000 * np.sin(yaw), np.full(4, -38_000.0)])
    size = np.linalg.norm(platform_field_nt(platform, b, **QUIET), axis=1)
    assert_allclose(size, 1.01 * np.linalg.norm(b, axis=1), rtol=1e-12)


def test_hard_iron_makes_one_wave_a_turn_of_the_expected_amplitude():
    platform = PlatformFieldSpec(hard_iron_nt=(300.0, 400.0, 0.0))
    yaw = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    b = np.column_stack([24_000 * np.cos(yaw), -24_000 * np.sin(yaw), np.full(360, -38_000.0)])
    still = {k: np.zeros((360, *v.shape[1:])) for k, v in QUIET.items()}
    size = np.linalg.norm(platform_field_nt(platform, b, **still), axis=1)
    wave = np.abs(np.fft.rfft(size)) / 180
    # |b + h| = |b| + h . b / |b| + O(h^2 / |b|); the last is 500^2 / 45,000 = 6 nT
    assert wave[1] == pytest.approx(500 * 24_000 / np.hypot(24_000, 38_000), abs=6)
    assert np.all(wave[2:] < 6)


def test_two_equal_and_opposite_wheels_cancel_where_their_motors_are_alike():
    platform = PlatformFieldSpec(left_motor_nt_s=(5.0, 3.0, 1.0), right_motor_nt_s=(5.0, 3.0, 1.0))
    turning = {**QUIET, "wheel_rate": np.tile([4.0, -4.0], (4, 1))}
    assert_allclose(platform_field_nt(platform, B, **turning), B, rtol=0, atol=1e-9)


def test_the_supply_draws_more_current_as_the_battery_empties():
    battery = BatterySpec(load_w=15.0, voltage_full_v=16.24)
    assert excess_current_a(battery, 16.24) == 0
    assert_allclose(excess_current_a(battery, [12.0, 15.0]), [1.25 - 15 / 16.24, 1 - 15 / 16.24], rtol=1e-12)
