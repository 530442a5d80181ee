"""Frames of a recording: vectors and poses of parts of a robot become those of base_link by /tf_static."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from magtwin.errors import MismatchWarning, RepairWarning
from magtwin.io.bags import RawBagWriter, read_bag, read_bag_readings
from magtwin.io.bags.frames import StaticFrames, kind_of
from magtwin.io.bags.topics import Qos
from magtwin.localizing import check_lever_arm
from magtwin.ros.bus import to_bytes
from magtwin.run.run import Run

START, NS = 1_700_000_000, 10**9
GRAVITY = np.array([0.0, 0.0, 9.80665])
FIELD = np.array([12_000.0, 20_000.0, -38_000.0])
RATE, AHEAD = np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.04, 0.0])
T = np.arange(200) / 50
TOPICS = {"/robot/qtfm/magnitude": "/mag", "/robot/imu": "/imu", "/robot/enu/pose": "/pose"}
MOUNTS = {
    "upright": Rotation.identity(),
    "upside down": Rotation.from_euler("x", np.pi),
    "turned": Rotation.from_euler("zyx", (0.7, 0.3, -0.4)),
}
ARM = np.array([0.1, -0.05, 0.2])
CENTRE = (np.zeros(3), MOUNTS["upright"])


def stamped(t, frame):
    return {"header.stamp": np.int64(START * NS + round(t * NS)), "header.frame_id": frame}


def true_pose(t):
    """On a circle of 1 m."""
    return np.array([np.cos(0.2 * t), np.sin(0.2 * t), 0.0]), Rotation.from_euler("z", 0.2 * t + np.pi / 2)


def static(*transforms):
    """One TFMessage of transforms: parent, child, place and rotation."""
    fields = {"transforms": len(transforms)}
    for k, (parent, child, p, rotation) in enumerate(transforms):
        each = stamped(0, parent) | {"child_frame_id": child, "transform.translation": p}
        each |= {"transform.rotation": rotation.as_quat()}
        fields |= {f"transforms.{k}.{name}": value for name, value in each.items()}
    return [(0.0, "tf2_msgs/msg/TFMessage", fields)]


def record(path, topics):
    """A bag of messages: by topic a list of time [s], type and fields."""
    writer = RawBagWriter(path)
    for topic, said in topics.items():
        for t, kind, fields in said:
            writer.add(topic, kind, Qos())
            writer.write(topic, START * NS + round(t * NS), to_bytes(kind, fields))
    writer.close()
    return path


def drive(mount=MOUNTS["upright"], frame="sensor_link", child="base_link", part=CENTRE):
    """A field and an IMU in the axes of a mount, and poses of a part of the robot."""
    field, imu, poses = [], [], []
    to_sensor = mount.inv()
    for t in T:
        p, q = true_pose(t)
        field.append(
            (
                t,
                "sensor_msgs/msg/MagneticField",
                {**stamped(t, frame), "magnetic_field": to_sensor.apply(FIELD) * 1e-9},
            )
        )
        imu.append(
            (
                t,
                "sensor_msgs/msg/Imu",
                {
                    **stamped(t, frame),
                    "orientation": (q * mount).as_quat(),
                    "angular_velocity": to_sensor.apply(RATE),
                    "linear_acceleration": to_sensor.apply(GRAVITY + AHEAD),
                },
            )
        )
        there, turned = p + q.apply(part[0]), q * part[1]
        pose = {
            "pose.pose.position": there,
            "pose.pose.orientation": turned.as_quat(),
            "child_frame_id": child,
        }
        poses.append((t, "nav_msgs/msg/Odometry", {**stamped(t, "map"), **pose}))
    return {"/mag": field, "/imu": imu, "/pose": poses}


@pytest.mark.parametrize("mount", MOUNTS)
def test_vectors_of_a_mounted_sensor_are_those_of_base_link(tmp_path, mount):
    frames = static(
        ("base_link", "plate", ARM, MOUNTS[mount]), ("plate", "sensor_link", np.zeros(3), MOUNTS["upright"])
    )
    bag = record(tmp_path / "a.mcap", {**drive(MOUNTS[mount]), "/tf_static": frames})
    run, readings = read_bag(bag, topics=TOPICS), read_bag_readings(bag)
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
    topics = drive(mount) | {"/tf_static": static(("base_link", "sensor_link", ARM, mount))}
    for t, _, fields in topics["/imu"]:
        fields["orientation"] = true_pose(t)[1].as_quat()
    run = read_bag(record(tmp_path / "a.mcap", topics), topics=TOPICS)
    assert_allclose(run["imu_a"], np.tile([0, 0.04, 0], (200, 1)), atol=1e-12)
    assert_allclose(np.abs(np.sum(run["imu_q_xyzw"] * run["q_world_base_xyzw"], axis=1)), 1, atol=1e-9)


def test_without_a_transform_a_sensor_is_taken_as_upright_and_that_is_said(tmp_path):
    bag = record(tmp_path / "a.mcap", drive())
    text = "field of /mag in the axes of 'sensor_link' as in those of base_link"
    assert text in read_bag(bag, topics=TOPICS).metadata["taken"]
    assert f"taken {text}" in read_bag_readings(bag).source
    silent = record(tmp_path / "b.mcap", drive(frame=""))
    assert "taken" not in read_bag(silent, topics=TOPICS).metadata
    assert "taken" not in read_bag_readings(silent).source


@pytest.mark.parametrize("frame", ["map", "/odom", "ann/world"])
def test_a_vector_in_a_frame_that_stands_still_is_warned_of(tmp_path, frame):
    bag = record(tmp_path / "a.mcap", drive(frame=frame))
    with pytest.warns(RepairWarning, match=f"field of /mag: '{frame.strip('/')}' is no frame of a sensor"):
        read_bag_readings(bag)


@pytest.mark.parametrize("root", ["base_link", "base_footprint"])
def test_the_pose_of_a_camera_becomes_that_of_the_base(tmp_path, root):
    part = (ARM, MOUNTS["turned"])
    frames = static((root, "camera_link", *part))
    bag = record(tmp_path / "a.mcap", {**drive(child="camera_link", part=part), "/tf_static": frames})
    run, readings = read_bag(bag, topics=TOPICS), read_bag_readings(bag)
    straight = read_bag(record(tmp_path / "b.mcap", drive()), topics=TOPICS)
    assert_allclose(run["p_world_base"], straight["p_world_base"], atol=1e-12)
    assert_allclose(run["yaw"], straight["yaw"], atol=1e-12)
    assert_allclose(readings.p_xy, straight["p_world_base"][:, :2], atol=1e-12)
    assert f"taken pose of /pose from 'camera_link' to '{root}'" in readings.source


def test_the_velocity_of_a_camera_becomes_that_of_the_base(tmp_path):
    mount, w, v = MOUNTS["turned"], np.array([0.0, 0.0, 0.5]), np.array([0.3, 0.0, 0.0])
    topics = drive(child="camera_link", part=(ARM, mount))
    for _, _, fields in topics["/pose"]:
        fields["twist.twist.linear"] = mount.inv().apply(v + np.cross(w, ARM))
        fields["twist.twist.angular"] = mount.inv().apply(w)
    topics["/tf_static"] = static(("base_link", "camera_link", ARM, mount))
    bag = record(tmp_path / "a.mcap", topics)
    run = read_bag(
        bag,
        topics={"/robot/qtfm/magnitude": "/mag", "/robot/odom": "/pose"},
    )
    assert_allclose(run["odom_v"], np.tile(v, (200, 1)), atol=1e-12)
    assert_allclose(run["odom_w"], np.tile(w, (200, 1)), atol=1e-12)
    assert_allclose(run["odom_p"][:, 0], np.cos(0.2 * T), atol=1e-12)


def test_the_pose_of_a_camera_whose_place_is_unknown_is_warned_of(tmp_path):
    bag = record(tmp_path / "a.mcap", drive(child="camera_link"))
    with pytest.warns(RepairWarning, match="it is the pose of 'camera_link', and no /tf_static has the way"):
        read_bag_readings(bag)


@pytest.mark.parametrize(
    "child", ["", "base_link", "base_footprint", "ann/base_link", "tb3_base_footprint", "turtlebot"]
)
def test_names_of_robots_in_use_pass_without_a_warning(tmp_path, child):
    frames = static(("base_footprint", "base_link", [0, 0, 0.01], MOUNTS["upright"]))
    readings = read_bag_readings(
        record(tmp_path / "a.mcap", {**drive(child=child, frame=""), "/tf_static": frames})
    )
    assert "taken" not in readings.source


def test_without_a_pose_odometry_and_transforms_from_the_map_give_it(tmp_path):
    topics, moved = drive(frame=""), []
    topics["/odom"] = topics.pop("/pose")
    for t, _, fields in topics["/odom"]:
        back = -0.01 * t
        fields["header.frame_id"] = "odom"
        fields["pose.pose.position"] = fields["pose.pose.position"] - [back, 0, 0]
        each = {"header.stamp": fields["header.stamp"], "header.frame_id": "map", "child_frame_id": "odom"}
        each |= {"transform.translation": [back, 0.0, 0.0], "transform.rotation": [0.0, 0.0, 0.0, 1.0]}
        moved.append(
            (
                t,
                "tf2_msgs/msg/TFMessage",
                {"transforms": 1} | {f"transforms.0.{k}": v for k, v in each.items()},
            )
        )
    bag = record(tmp_path / "a.mcap", {**topics, "/tf": moved})
    run = read_bag(bag, topics={"/robot/qtfm/magnitude": "/mag", "/robot/odom": "/odom"})
    assert_allclose(run["p_world_base"][:, 0], np.cos(0.2 * T), atol=1e-12)
    assert_allclose(run["odom_p"][:, 0], np.cos(0.2 * T) + 0.01 * T, atol=1e-12)
    assert (
        run.metadata["truth"] == "poses of /odom from 'odom' to 'map', by /tf (by up to 0.0398 m and 0 deg)"
    )


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("map", "fixed"),
        ("camera_odom_frame", "fixed"),
        ("ann/odom", "fixed"),
        ("base_link", "base"),
        ("/ann/base_footprint", "base"),
        ("base_laser", "part"),
        ("camera1_optical_frame", "part"),
        ("gripper_link", "part"),
        ("turtlebot", ""),
    ],
)
def test_frames_are_known_by_the_words_of_their_names(name, kind):
    assert kind_of(name) == kind


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
