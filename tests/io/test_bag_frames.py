"""Frames of a recording: vectors and poses of parts of a robot become those of base_link by /tf_static."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from recordings import UPRIGHT, inertial, magnetic, moved, pose, record, stamped
from scipy.spatial.transform import Rotation

from magtwin.errors import InputError, MismatchWarning, RepairWarning
from magtwin.io.bags import read_bag
from magtwin.io.recording.frames import StaticFrames
from magtwin.io.surveys.readings import read_readings
from magtwin.run.run import Run
from magtwin.tasks.localizing import check_lever_arm, lever_arm_of

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*by its size.*:magtwin.errors.RepairWarning"),
    pytest.mark.filterwarnings("ignore:.* joins .*:magtwin.errors.RepairWarning"),
]
GRAVITY = np.array([0.0, 0.0, 9.80665])
FIELD = np.array([12_000.0, 20_000.0, -38_000.0])
RATE, AHEAD = np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.04, 0.0])
T = np.arange(200) / 50
MOUNTS = {
    "upright": UPRIGHT,
    "upside down": Rotation.from_euler("x", np.pi),
    "turned": Rotation.from_euler("zyx", (0.7, 0.3, -0.4)),
}
ARM = np.array([0.1, -0.05, 0.2])
CENTRE = (np.zeros(3), UPRIGHT)
ODOMETRY, PLACED = "nav_msgs/msg/Odometry", {"/robot/enu/pose": "/pose"}


def true_pose(t):
    """On a circle of 1 m."""
    return np.array([np.cos(0.2 * t), np.sin(0.2 * t), 0.0]), Rotation.from_euler("z", 0.2 * t + np.pi / 2)


def static(*transforms):
    return {"/tf_static": [(0.0, *moved(0.0, *transforms))]}


def drive(mount=UPRIGHT, frame="sensor_link", child="base_link", part=CENTRE, oriented=True):
    """A field and an IMU in the axes of a mount, and poses of a part of the robot."""
    field, imu, poses = [], [], []
    back, (v, w) = mount.inv(), ((0.3, 0, 0), (0, 0, 0.5))
    v, w = part[1].inv().apply([v + np.cross(w, part[0]), w])
    for t in T:
        p, q = true_pose(t)
        field.append((t, *magnetic(t, *(back.apply(FIELD) * 1e-9), frame=frame)))
        seen = q * mount if oriented else q
        imu.append((t, *inertial(t, seen, back.apply(RATE), back.apply(GRAVITY + AHEAD), frame)))
        there = (p + q.apply(part[0]), q * part[1])
        poses.append((t, *pose(t, *there, ODOMETRY, child=child, v=v, w=w)))
    return {"/mag": field, "/imu": imu, "/pose": poses}


def both(bag):
    """The recording as a run and as readings."""
    return read_bag(bag, topics=PLACED), read_readings(bag, pose_topic="/pose")


@pytest.mark.parametrize("mount", MOUNTS)
def test_vectors_of_a_mounted_sensor_are_those_of_base_link(tmp_path, mount):
    frames = static(
        ("base_link", "plate", ARM, MOUNTS[mount]), ("plate", "sensor_link", np.zeros(3), UPRIGHT)
    )
    run, readings = both(record(tmp_path / "a.mcap", drive(MOUNTS[mount]) | frames))
    assert_allclose(run["b_vector_measured_nt"], np.tile(FIELD, (200, 1)), atol=1e-6)
    assert_allclose(readings.b_body_nt, np.tile(FIELD, (200, 1)), atol=1e-6)
    assert_allclose(run["imu_w"], np.tile(RATE, (200, 1)), atol=1e-12)
    assert_allclose(run["imu_a"], np.tile([0, 0.04, 0], (200, 1)), atol=1e-12)
    turned = Rotation.from_quat(run["imu_q_xyzw"]) * Rotation.from_quat(run["q_world_base_xyzw"]).inv()
    assert_allclose(turned.magnitude(), 0, atol=1e-7)
    degrees = np.degrees(MOUNTS[mount].magnitude())
    text = f"'sensor_link' to 'base_link', which has it at (0.1, -0.05, 0.2) m, turned by {degrees:.3g} deg"
    assert f"field of /mag from {text}, by /tf_static" in run.metadata["taken"]
    assert f"IMU of /imu from {text}" in run.metadata["taken"]
    assert f"taken field of /mag from {text}" in readings.source
    assert run.metadata["tf_sensor_m"] == "0.1, -0.05, 0.2"


def test_an_orientation_that_gravity_shows_to_be_that_of_the_base_is_kept(tmp_path):
    mount = MOUNTS["upside down"]
    topics = drive(mount, oriented=False) | static(("base_link", "sensor_link", ARM, mount))
    run, _ = both(record(tmp_path / "a.mcap", topics))
    assert_allclose(run["imu_a"], np.tile([0, 0.04, 0], (200, 1)), atol=1e-12)
    assert_allclose(np.abs(np.sum(run["imu_q_xyzw"] * run["q_world_base_xyzw"], axis=1)), 1, atol=1e-9)


def test_without_a_transform_a_sensor_is_taken_as_upright_and_that_is_told(tmp_path):
    bag, text = (
        record(tmp_path / "a.mcap", drive()),
        "joins 'sensor_link' to base_link: vectors of /mag{} are",
    )
    with pytest.warns(RepairWarning, match=text.format(", /imu")) as told:
        read_bag(bag, topics=PLACED)
    assert len(told) == 1
    with pytest.warns(RepairWarning, match=text.format("")):
        read_readings(bag, pose_topic="/pose")
    run, readings = both(record(tmp_path / "b.mcap", drive(frame="")))
    assert run.metadata["taken"] == "field /mag, IMU /imu by their types"
    assert readings.source.endswith("; taken field /mag by its type")


@pytest.mark.parametrize("frame", ["map", "/odom", "ann/world"])
def test_a_vector_in_a_frame_that_stands_still_is_warned_of(tmp_path, frame):
    bag = record(tmp_path / "a.mcap", drive(frame=frame))
    with pytest.warns(RepairWarning, match=f"field of /mag: '{frame.strip('/')}' is no frame of a sensor"):
        read_readings(bag, pose_topic="/pose")


@pytest.mark.parametrize("root", ["base_link", "base_footprint"])
def test_pose_and_velocity_of_a_camera_become_those_of_the_base(tmp_path, root):
    part = (ARM, MOUNTS["turned"])
    topics = drive(child="camera_link", part=part) | static((root, "camera_link", *part))
    bag = record(tmp_path / "a.mcap", topics)
    run, readings = both(bag)
    straight, _ = both(record(tmp_path / "b.mcap", drive()))
    assert_allclose(run["p_world_base"], straight["p_world_base"], atol=1e-12)
    assert_allclose(run["yaw"], straight["yaw"], atol=1e-12)
    assert_allclose(readings.p_xy, straight["p_world_base"][:, :2], atol=1e-12)
    assert f"taken pose of /pose from 'camera_link' to '{root}'" in readings.source
    odometry = read_bag(bag)
    assert_allclose(odometry["odom_p"], straight["p_world_base"], atol=1e-12)
    assert_allclose(odometry["odom_v"], np.tile([0.3, 0, 0], (200, 1)), atol=1e-12)
    assert_allclose(odometry["odom_w"], np.tile([0, 0, 0.5], (200, 1)), atol=1e-12)


def test_the_pose_of_a_camera_whose_place_is_unknown_is_warned_of(tmp_path):
    bag = record(tmp_path / "a.mcap", drive(child="camera_link"))
    with pytest.warns(RepairWarning, match="pose of 'camera_link', and no tree of frames has the way"):
        read_readings(bag, pose_topic="/pose")


@pytest.mark.parametrize(
    "child", ["", "base_link", "base_footprint", "ann/base_link", "tb3_base_footprint", "turtlebot"]
)
def test_names_of_robots_in_use_pass_without_a_warning(tmp_path, child):
    topics = drive(child=child, frame="") | static(("base_footprint", "base_link", [0, 0, 0.01], UPRIGHT))
    assert " of /pose" not in both(record(tmp_path / "a.mcap", topics))[1].source


def test_a_ring_of_transforms_or_a_damaged_one_ends_no_reader():
    known, one = StaticFrames(), np.array([0.0, 0.0, 0.0, 1.0])
    known.add("a", "b", np.ones(3), one)
    known.add("b", "a", np.ones(3), one)
    known.add("base_link", "imu_link", np.full(3, np.nan), one)
    known.add("base_link", "mag_link", np.ones(3), np.zeros(4))
    assert [known.mount(name) for name in ("a", "b", "imu_link", "mag_link", "none")] == [None] * 5
    known.add("base_link", "mag_link", np.ones(3), 1.01 * one)
    mount = known.mount("/mag_link")
    assert mount is not None
    assert_array_equal(mount.q_xyzw, one)


def test_readings_are_placed_at_the_sensor_also_after_conversion(tmp_path):
    frames = static(("base_link", "sensor_link", ARM, MOUNTS["turned"]))
    bag = record(tmp_path / "a.mcap", drive(MOUNTS["turned"]) | frames)
    run, readings = both(bag)
    sensor = np.array([p + q.apply(ARM) for p, q in map(true_pose, T)])
    assert_allclose(readings.p_xy, sensor[:, :2], atol=1e-6)
    assert "positions at the magnetometer, at (0.1, -0.05, 0.2) m in base_link" in readings.source
    run.save(tmp_path / "run.parquet")
    assert_allclose(read_readings(tmp_path / "run.parquet").p_xy, readings.p_xy)
    assert lever_arm_of(run) == (0.1, -0.05)


def test_a_path_gives_the_poses_by_their_stamps(tmp_path):
    def path(count, stamped_poses=True):
        fields = {**stamped(T[count - 1], "map"), "poses": count}
        for k, (p, q) in enumerate(map(true_pose, T[:count])):
            each = stamped(T[k] if stamped_poses else 0.0, "map")
            each |= {"pose.position": p, "pose.orientation": q.as_quat()}
            fields |= {f"poses.{k}.{name}": value for name, value in each.items()}
        return T[count - 1], "nav_msgs/msg/Path", fields

    topics = {"/mag": drive()["/mag"], "/trajectory": [path(50), path(len(T))]}
    readings = read_readings(record(tmp_path / "a.mcap", topics))
    assert_allclose(readings.p_xy, [true_pose(t)[0][:2] for t in T], atol=1e-9)
    plan = topics | {"/trajectory": [path(len(T), False)]}
    with pytest.raises(InputError, match="no stamps of their own, as that of a plan"):
        read_readings(record(tmp_path / "b.mcap", plan))


def test_a_lever_arm_other_than_that_of_tf_static_is_warned_of():
    run = Run({"t": np.arange(3.0)}, {"tf_sensor_m": "0.1, -0.05, 0.2"})
    with pytest.warns(
        MismatchWarning, match=r"lever arm is 0.000, 0.000 m; give --sensor lever_arm_m=\[0.100,-0.050\]"
    ):
        check_lever_arm(run, (0.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_lever_arm(run, (0.11, -0.05))
        check_lever_arm(Run({"t": np.arange(3.0)}), (0.11, -0.05))
