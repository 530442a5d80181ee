"""A scene that has only a survey: its map is the field, and the robot adds what the map does not hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rooms import EARTH, SOURCES, scene_of, wavy_map

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.path import Path as Way
from magtwin.path import path_named
from magtwin.run.run import Run
from magtwin.sim.exact import check_field, check_read
from magtwin.sim.runs.simulate import simulate
from magtwin.sim.session import draw_session
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import MagnetometerSpec

PLATFORM = PlatformFieldSpec(
    hard_iron_nt=(620.0, -430.0, 900.0),
    soft_iron=(0.008, 0.001, 0.0, 0.001, -0.004, 0.0, 0.0, 0.0, 0.002),
    eddy_s=(0.004, 0.0, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0, 0.006),
    left_motor_nt_nm=(-2300.0, -4600.0, 3000.0),
    right_motor_nt_nm=(-3600.0, -2600.0, 4500.0),
    lidar_nt=(850.0, -500.0, -270.0),
    battery_nt=(120.0, 40.0, 1500.0),
    left_wheel_moment=0.012,
    hard_iron_drift_nt=(-150.0, -180.0, -830.0),
    hard_iron_std_nt=90.0,
    current_std=0.1,
)
ARM = (0.05, -0.02, 0.36)
SENSOR = MagnetometerSpec(kind="physical")
ROBOT = RobotSpec(
    name="robot",
    asset=Path("robot.usda"),
    p_base_magnetometer=ARM,
    platform=PLATFORM,
    magnetometer=SENSOR,
    drive=DriveSpec(localization_std_m=0.0, localization_yaw_std=0.0, localization_latency_s=0.0),
)
SURVEYED = scene_of(ROBOT, "surveyed")
KNOWN = replace(SURVEYED, name="known", earth=EARTH, sources=SOURCES)
BARE = replace(SURVEYED, robot=replace(ROBOT, platform=PlatformFieldSpec()))
MAP, ONE = wavy_map(), wavy_map(1)
FLAT = replace(MAP, values_nt=np.full((4, 15, 25), 41_000.0))


@pytest.fixture(scope="module")
def harmonic_map() -> AnomalyMap:
    """The map that a perfect survey of KNOWN gives, with its dipoles and the robot, on a fine grid."""
    field = HarmonicField(
        p_world_dipole=np.array([s.p_world for s in SOURCES]),
        m_world=np.array([s.m_world for s in SOURCES]),
        b_uniform_nt=np.array(EARTH.b_world_nt),
        hard_iron_nt=np.array(PLATFORM.hard_iron_nt),
        soft_iron=np.reshape(PLATFORM.soft_iron, (3, 3)),
        p_base_sensor=np.array(ARM),
    )
    x, y, yaw = np.linspace(-3, 3, 121), np.linspace(-1.75, 1.75, 71), 2 * np.pi * np.arange(36) / 36
    at = np.stack(np.broadcast_arrays(x[None, None, :], y[None, :, None]), axis=-1)
    values = np.array([field.magnitude_nt(at[0], h) for h in yaw])
    return AnomalyMap(
        values_nt=values,
        headings_rad=yaw,
        origin_m=(-3.0, -1.75),
        cell_m=(0.05, 0.05),
        height_m=ARM[2],
        harmonic=field,
    )


def drive(scene: Scene = SURVEYED, field: AnomalyMap = MAP, **options) -> Run:
    options = {"lidar": "off", "duration_s": 20.0} | options
    way = path_named("figure8")
    return simulate(scene, way, anomaly_map=field, rng=np.random.default_rng(2), **options)


def into_base(run: Run, v) -> np.ndarray:
    v = np.broadcast_to(np.asarray(v, float), (run.rows, 3))
    return rotate(quat_conjugate(quat_from_yaw(run["yaw"])), v)


@pytest.mark.parametrize("field", ["scalar", "harmonic"])
def test_a_robot_without_magnetism_of_its_own_reads_exactly_the_map(field, harmonic_map):
    run = drive(BARE, harmonic_map if field == "harmonic" else MAP)
    assert_array_equal(run["b_truth_nt"], run["b_map_nt"])
    assert not run["b_disturbance_nt"].any()
    assert np.ptp(run["b_total_nt"]) > 500
    assert_allclose(np.linalg.norm(run["b_vector_nt"], axis=1), run["b_truth_nt"], rtol=1e-12)


def test_what_has_changed_since_the_survey_is_added_along_the_earths_direction():
    change = (-150.0, 220.0, 400.0)
    later = PlatformFieldSpec(hard_iron_nt=(3e3, -2e3, 1e3), hard_iron_change_nt=change)
    scene = replace(SURVEYED, earth=EARTH, robot=replace(ROBOT, platform=later))
    run = drive(scene)
    unit = into_base(run, EARTH.b_world_nt) / np.linalg.norm(EARTH.b_world_nt)
    want = np.linalg.norm(run["b_map_nt"][:, None] * unit + change, axis=1)
    assert_allclose(run["b_truth_nt"], want, rtol=1e-12)
    assert np.ptp(run["b_disturbance_nt"]) > 100, "it depends on the heading"
    # |B + p| is |B| + p . u but for what lies across
    assert_allclose(run["b_disturbance_nt"], unit @ change, atol=np.dot(change, change) / 2 / 38_000)


def test_a_fit_that_is_far_off_the_earths_direction_is_not_believed(harmonic_map):
    change = PlatformFieldSpec(hard_iron_change_nt=(-150.0, 220.0, 400.0))
    scene = replace(SURVEYED, robot=replace(ROBOT, platform=change))
    turned = replace(harmonic_map.harmonic, b_uniform_nt=np.array(EARTH.b_world_nt)[[1, 0, 2]])
    wrong = replace(harmonic_map, harmonic=turned)
    known, none = replace(scene, earth=EARTH), replace(harmonic_map, harmonic=None)
    run = drive(known, wrong)
    assert_array_equal(run["b_truth_nt"], drive(known, none)["b_truth_nt"])
    assert "that of [earth], as that of the harmonic fit is" in str(run.metadata["truth"])
    near = drive(known, harmonic_map)
    assert_array_equal(near["b_truth_nt"], drive(scene, harmonic_map)["b_truth_nt"])
    assert str(near.metadata["truth"]).endswith("direction of the field from the harmonic fit")
    assert "unchecked, as there is no [earth]" in str(drive(scene, wrong).metadata["truth"])


@pytest.mark.parametrize("layers", [1, 6])
def test_a_map_without_headings_is_the_lab_at_the_sensor_and_the_whole_platform_is_added(layers):
    iron = PlatformFieldSpec(hard_iron_nt=(620.0, -430.0, 900.0), soft_iron=PLATFORM.soft_iron)
    same = replace(
        ONE,
        values_nt=np.repeat(ONE.values_nt, layers, axis=0),
        headings_rad=np.arange(layers) / 1.0,
        valid=np.ones((layers, 15, 25), bool),
    )
    run = drive(replace(SURVEYED, earth=EARTH, robot=replace(ROBOT, platform=iron)), same)
    at = run["p_world_base"] + rotate(quat_from_yaw(run["yaw"]), np.array(ARM))
    unit = into_base(run, EARTH.b_world_nt) / np.linalg.norm(EARTH.b_world_nt)
    b = ONE.lookup(at[:, :2], 0.0)[:, None] * unit
    want = np.linalg.norm(b + b @ np.reshape(iron.soft_iron, (3, 3)).T + iron.hard_iron_nt, axis=1)
    assert_allclose(run["b_truth_nt"], want, rtol=1e-12)
    assert "the whole platform field" in str(run.metadata["truth"])


@pytest.mark.parametrize("session", ["survey", "later"])
def test_a_survey_alone_gives_what_the_sources_that_it_was_made_of_give(session, harmonic_map):
    robot = ROBOT if session == "survey" else draw_session(ROBOT, np.random.default_rng(4))
    exact = drive(replace(KNOWN, robot=robot), harmonic_map, lidar="on", duration_s=40.0)
    alone = drive(replace(SURVEYED, robot=robot), harmonic_map, lidar="on", duration_s=40.0)
    off = alone["b_truth_nt"] - exact["b_truth_nt"]
    assert np.std(exact["b_disturbance_nt"]) > 100, "LiDAR, motors and supply add much"
    assert np.sqrt(np.mean(off**2)) < 5, "nT, interpolation between nodes included"
    assert np.abs(off).max() < 20
    apart = np.linalg.norm(alone["b_vector_nt"] - exact["b_vector_nt"], axis=1)
    assert np.sqrt(np.mean(apart**2)) < 10


def test_a_scene_of_a_constant_field_is_refused_with_what_to_do():
    for scene in (SURVEYED, replace(SURVEYED, earth=EARTH)):
        with pytest.raises(InputError, match=r"'surveyed' has a constant field.*41,000 nT at every.*survey"):
            check_field(scene, FLAT)
    check_field(SURVEYED, MAP)
    check_field(KNOWN, FLAT)


@pytest.mark.parametrize(
    ("outside", "says"),
    [
        ("nan", r"all \d+ readings are nan, as the robot drove x 1\.00\.\.1\.\d\d, y .* choose a path on it"),
        ("clamp", r"all \d+ readings are [\d,]+ nT, the map's nearest value, as the robot drove x 1\.00"),
    ],
)
def test_a_run_beside_its_map_is_refused(outside, says):
    corner = replace(MAP, origin_m=(-2.5, -1.0), cell_m=(1 / 24, 1 / 14), values_nt=MAP.values_nt)
    line = Way("line", np.array([[1.0, 0.3], [2.0, 0.3]]))
    scene = replace(SURVEYED, robot=replace(ROBOT, platform=PlatformFieldSpec()))
    values = np.array(corner.values_nt)
    values[:, :, -1] = 40_500.0  # one value along the border that is nearest
    corner = replace(corner, values_nt=values)
    rng = np.random.default_rng(0)
    run = simulate(scene, line, anomaly_map=corner, rng=rng, duration_s=4.0, outside=outside, lidar="off")
    with pytest.raises(InputError, match=says):
        check_read(run, corner)
    check_read(drive(), MAP)
