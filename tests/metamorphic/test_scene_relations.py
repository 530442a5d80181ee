"""Relations between scenes, their surveys and their runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from relations import rotation, turned_map

from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_yaw
from magtwin.path.polyline import Path as Way
from magtwin.sim.at_rest import field_at_rest_nt
from magtwin.sim.interference import ambient_field_nt
from magtwin.sim.runs.simulate import simulate
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import MagnetometerSpec

EARTH = EarthFieldSpec(
    b_world_nt=(-2_745.6, 24_067.1, -38_418.4),
    latitude_deg=29.65,
    longitude_deg=-82.35,
    height_m=50.0,
    date="2026-11-21",
)
SOURCES = (
    SourceSpec(name="chair", p_world=(0.5, 0.3, -0.5), m_world=(5.0, -3.0, 20.0)),
    SourceSpec(name="desk", p_world=(-1.0, 0.8, -0.4), m_world=(-9.0, 4.0, -12.0)),
    SourceSpec(
        name="beam",
        p_world=(0.2, -0.9, -0.4),
        shape="cuboid",
        size_m=(0.4, 0.1, 0.1),
        magnetization=(2_000.0, -500.0, 900.0),
    ),
)
PLATFORM = PlatformFieldSpec(hard_iron_nt=(620.0, -430.0, 900.0))
BARE = RobotSpec(
    name="robot",
    asset=Path("robot.usda"),
    p_base_magnetometer=(0.05, -0.02, 0.36),
    magnetometer=MagnetometerSpec(kind="physical"),
    # the pose that the controller knows errs along world x and y
    drive=DriveSpec(localization_std_m=0.0, localization_yaw_std=0.0, localization_latency_s=0.0),
)
SCENE = Scene(
    name="room",
    map_layer=Path("room.usdc"),
    robot=replace(BARE, platform=PLATFORM),
    earth=EARTH,
    sources=SOURCES,
)
ANGLE = np.radians(30.0)
TURN = np.eye(3)
TURN[:2, :2] = rotation(ANGLE)
# A cuboid's field is a sum of terms of either sign, and loses digits far from it
ROUNDING_NT = 0.02


def triple(v):
    x, y, z = (float(part) for part in v)
    return x, y, z


def poses():
    rng = np.random.default_rng(0)
    p = np.column_stack([rng.uniform(-2, 2, (50, 2)), np.zeros(50)])
    return p, rng.uniform(0, 2 * np.pi, 50)


def with_sources(change):
    return replace(SCENE, sources=tuple(change(source) for source in SOURCES))


def strengthened(source, factor):
    moment, density = (triple(factor * np.array(v)) for v in (source.m_world, source.magnetization))
    return replace(source, m_world=moment, magnetization=density)


def test_a_scene_that_is_moved_reads_the_same():
    p, yaw = poses()
    shift = np.array([0.3, -0.2, 0.0])
    other = with_sources(lambda s: replace(s, p_world=triple(s.p_world + shift)))
    assert_allclose(
        field_at_rest_nt(other, p + shift, yaw), field_at_rest_nt(SCENE, p, yaw), rtol=0, atol=ROUNDING_NT
    )


def test_a_scene_that_is_turned_with_the_earths_field_reads_the_same():
    p, yaw = poses()

    def turn(source):
        placed = {"p_world": triple(TURN @ source.p_world)}
        if source.shape == "point":
            return replace(source, m_world=triple(TURN @ source.m_world), **placed)
        return replace(source, q_world_xyzw=tuple(quat_from_yaw(ANGLE).tolist()), **placed)

    earth = replace(EARTH, b_world_nt=triple(TURN @ EARTH.b_world_nt))
    other = replace(with_sources(turn), earth=earth)
    assert_allclose(
        field_at_rest_nt(other, p @ TURN.T, yaw + ANGLE),
        field_at_rest_nt(SCENE, p, yaw),
        rtol=0,
        atol=ROUNDING_NT,
    )


def test_an_anomaly_at_twice_the_distance_needs_eight_times_the_moment():
    p = poses()[0] + (0.0, 0.0, 0.4)

    def twice(source):
        far, large = (triple(2 * np.array(v)) for v in (source.p_world, source.size_m))
        return replace(
            strengthened(source, 8.0 if source.shape == "point" else 1.0), p_world=far, size_m=large
        )

    assert_allclose(
        ambient_field_nt(with_sources(twice), 2 * p), ambient_field_nt(SCENE, p), rtol=0, atol=ROUNDING_NT
    )


@pytest.fixture(scope="session")
def room_map():
    values = 41_000 + 1_000 * np.random.default_rng(5).standard_normal((4, 15, 15))
    return AnomalyMap(
        values_nt=values,
        headings_rad=np.pi / 2 * np.arange(4),
        origin_m=(-1.75, -1.75),
        cell_m=(0.25, 0.25),
    )


def driven(field, points, shift=(0.0, 0.0), seed=0, **options):
    scene = replace(SCENE, earth=None, sources=(), robot=BARE)
    way = Way("way", points + np.array(shift))
    options = {"lidar": "off", "duration_s": 12.0} | options
    return simulate(scene, way, anomaly_map=field, rng=np.random.default_rng(seed), **options)


WAY = np.array([(-1.0, -0.8), (0.6, -0.8), (0.9, 0.4), (-0.6, 0.9)])


@pytest.fixture(scope="session")
def run(room_map):
    return driven(room_map, WAY)


def test_a_drive_through_a_turned_room_is_turned_and_reads_the_same(room_map, run):
    other = driven(turned_map(room_map), WAY @ rotation(np.pi / 2).T)
    p = run["p_world_base"][:, :2] @ rotation(np.pi / 2).T
    assert_allclose(other["p_world_base"][:, :2], p, atol=1e-9)
    assert_allclose(other["b_truth_nt"], run["b_truth_nt"], rtol=1e-9)
    assert_allclose(other["odom_p"], run["odom_p"], atol=1e-9)


def test_a_drive_without_errors_there_and_back_reads_the_same_field_at_the_same_places(room_map):
    field = replace(room_map, values_nt=room_map.values_nt[:1], valid=None, headings_rad=np.zeros(1))
    line = np.array([(-1.2, 0.1), (1.2, 0.1)])
    there, back = (driven(field, way, duration_s=None) for way in (line, line[::-1]))
    x = np.linspace(-1.0, 1.0, 41)
    order = np.argsort(back["p_world_base"][:, 0])
    forth = np.interp(x, there["p_world_base"][:, 0], there["b_map_nt"])
    again = np.interp(x, back["p_world_base"][order, 0], back["b_map_nt"][order])
    # readings are millimetres apart, and the robots millimetres off the line, in a field of 4 uT/m
    assert_allclose(again, forth, atol=40.0)


def test_a_field_that_is_stronger_by_a_constant_is_read_stronger_by_it(room_map, run):
    other = driven(replace(room_map, values_nt=room_map.values_nt + 500.0), WAY)
    assert_array_equal(other["p_world_base"], run["p_world_base"])
    assert_allclose(other["b_truth_nt"], run["b_truth_nt"] + 500.0, rtol=1e-12)
