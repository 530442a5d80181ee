"""Bags that rosbags itself wrote, in both storages."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from magtwin.errors import InputError
from magtwin.io.bags import read_bag, read_bag_readings
from magtwin.io.surveys.readings import read_readings

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
WORLD = np.array([12_000.0, 20_000.0, -38_000.0])
START = 1_700_000_000.0


def make(kind, **parts):
    return STORE.types[kind](**parts)


def header(t, frame="map"):
    ns = round(t * 1e9)
    return make(
        "std_msgs/msg/Header",
        stamp=make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9),
        frame_id=frame,
    )


def pose(x, y, yaw, roll=0.0):
    c, s, cr, sr = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=c * sr, y=s * sr, z=s * cr, w=c * cr),
    )


def stamped(t, *where):
    return make("geometry_msgs/msg/PoseStamped", header=header(t), pose=pose(*where))


def odometry(t, *where):
    covariance = np.zeros(36)
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    return make(
        "nav_msgs/msg/Odometry",
        header=header(t, "odom"),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(*where), covariance=covariance),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
            covariance=covariance,
        ),
    )


def magnetic(t, x, y=0.0, z=0.0):
    return make(
        "sensor_msgs/msg/MagneticField",
        header=header(t),
        magnetic_field=make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z)),
        magnetic_field_covariance=np.zeros(9),
    )


def number(value):
    return make("std_msgs/msg/Float64", data=float(value))


def write_bag(folder, topics, storage="sqlite3"):
    """A bag of messages: by topic a list of (time of receipt [s], message)."""
    with Writer(folder, version=8, storage_plugin=STORAGES[storage]) as writer:
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__ if messages else "geometry_msgs/msg/PoseStamped"
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for t, message in messages:
                writer.write(connection, round(t * 1e9), STORE.serialize_cdr(message, kind))
    return folder


def drive(kind=stamped, count=41):
    """Poses at 10 Hz: 0.2 m/s along x, turning by 2.5 rad/s through the whole circle."""
    t = START + 0.1 * np.arange(count)
    return [(s + 0.003, kind(s, 0.02 * k, -0.01 * k, 0.25 * k)) for k, s in enumerate(t)]


def at_middle(values, late=0.05, count=40):
    t = START + 0.1 * np.arange(count) + late
    return [(s + 0.002, magnetic(s, *np.atleast_1d(v))) for s, v in zip(t, values, strict=True)]


def body_field(yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * WORLD[0] + s * WORLD[1], -s * WORLD[0] + c * WORLD[1], 0 * yaw + WORLD[2]])


MIDDLE = np.arange(40) + 0.5


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kind", [stamped, odometry])
def test_a_bag_gives_vectors_in_tesla_at_interpolated_poses(tmp_path, storage, kind):
    topics = {"/pose": drive(kind), "/mag": at_middle(body_field(0.25 * MIDDLE) * 1e-9)}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics, storage))
    assert_allclose(readings.p_xy, np.column_stack([0.02 * MIDDLE, -0.01 * MIDDLE]), atol=1e-7)
    assert_allclose(np.exp(1j * readings.yaw), np.exp(0.25j * MIDDLE), atol=1e-6)
    assert_allclose(readings.b_body_nt, body_field(0.25 * MIDDLE), atol=0.02)
    assert_allclose(readings.b_nt, np.linalg.norm(WORLD), atol=0.02)
    assert_allclose(np.diff(readings.t), 0.1, atol=1e-6)
    assert "field /mag in T, told by its size; stamps of header)" in readings.source
    assert readings.source.count("sha256:") == 2


@pytest.mark.parametrize("storage", STORAGES)
def test_a_storage_file_alone_is_a_bag_too(tmp_path, storage):
    topics = {"/pose": drive(), "/mag": at_middle(np.full(40, 41_000.0))}
    folder = write_bag(tmp_path / "bag", topics, storage)
    alone = next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap")).rename(
        tmp_path / ("b.db3" if storage == "sqlite3" else "b.mcap")
    )
    readings = read_readings(alone)
    assert len(readings) == 40
    assert_array_equal(readings.b_nt, 41_000)


def test_the_releases_nt_in_x_is_a_magnitude_and_not_41_tera_nt(tmp_path):
    topics = {"/pose": drive(), "/mag": at_middle(41_000 + MIDDLE)}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert readings.b_body_nt is None
    assert_allclose(readings.b_nt, 41_000 + MIDDLE)
    assert "field /mag in nT, told by its size" in readings.source


@pytest.mark.parametrize(
    ("factor", "unit"), [(1, "nT"), (1e-9, "T"), (1e-3, "uT"), (1e-2, "mG"), (1e-5, "G")]
)
def test_the_unit_is_told_by_size_or_by_option(tmp_path, factor, unit):
    topics = {"/pose": drive(), "/mag": at_middle(41_000 * factor * np.ones(40))}
    bag = write_bag(tmp_path / "bag", topics)
    assert_allclose(read_bag_readings(bag).b_nt, 41_000)
    assert_allclose(read_bag_readings(bag, unit=unit).b_nt, 41_000)
    other = "nT" if unit != "nT" else "T"
    with pytest.raises(InputError, match=f"the median of /mag .* in {unit} .* give --unit {unit}"):
        read_bag_readings(bag, unit=other)


def test_a_field_that_no_unit_makes_the_earths_is_refused(tmp_path):
    topics = {"/pose": drive(), "/mag": at_middle(np.full(40, 3.0))}
    with pytest.raises(InputError, match="the median of /mag is 3; in no unit is that the Earth's field"):
        read_bag_readings(write_bag(tmp_path / "bag", topics))


def test_a_tilted_robots_vector_is_made_level(tmp_path):
    roll = 0.2
    tilted = [(START + 0.1 * k, stamped(START + 0.1 * k, 0, 0, 0, roll)) for k in range(41)]
    c, s = np.cos(roll), np.sin(roll)
    body = np.array([WORLD[0], c * WORLD[1] + s * WORLD[2], -s * WORLD[1] + c * WORLD[2]])
    topics = {"/pose": tilted, "/mag": at_middle(np.tile(body * 1e-9, (40, 1)))}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert_allclose(readings.b_body_nt, np.tile(WORLD, (40, 1)), atol=0.02)


def test_plain_numbers_have_no_stamp_so_both_topics_go_by_receipt(tmp_path):
    late = [(START + 0.1 * k + 0.05, number(41_000 + k)) for k in range(40)]
    topics = {"/pose": drive(), "/mag": late}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert "stamps of receipt" in readings.source
    assert_allclose(readings.p_xy[:, 0], 0.02 * (np.arange(40) + 0.47), atol=1e-6)  # poses came 3 ms late


def test_poses_that_pause_are_not_bridged(tmp_path):
    poses = drive()
    topics = {"/pose": poses[:10] + poses[25:], "/mag": at_middle(np.full(40, 41_000.0))}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    kept = np.r_[0:9, 25:40]
    assert_allclose(readings.p_xy[:, 0], 0.02 * MIDDLE[kept], atol=1e-7)
    assert "16 of 40 fields not between poses or not a number left out" in readings.source


def test_fields_before_the_first_and_after_the_last_pose_are_left_out(tmp_path):
    topics = {"/pose": drive()[5:20], "/mag": at_middle(np.full(40, 41_000.0))}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert_allclose(readings.p_xy[:, 0], 0.02 * MIDDLE[5:19], atol=1e-7)


def test_a_field_on_another_clock_is_refused_with_both_spans(tmp_path):
    simulated = [(START, magnetic(0.1 * k + 1, 41_000)) for k in range(40)]
    topics = {"/pose": drive(), "/mag": simulated}
    with pytest.raises(
        InputError, match=r"no field lies between poses: .*1700000000\.000.*1\.000\.\.4\.900 s"
    ):
        read_bag_readings(write_bag(tmp_path / "bag", topics))


def test_messages_that_are_nan_are_left_out_and_counted(tmp_path):
    values = np.full(40, 41_000.0)
    values[7] = np.nan
    topics = {"/pose": drive(), "/mag": at_middle(values)}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert len(readings) == 39
    assert "1 of 40 fields" in readings.source


def test_messages_out_of_order_are_put_in_order(tmp_path):
    topics = {"/pose": drive()[::-1], "/mag": at_middle(41_000 + MIDDLE)[::-1]}
    readings = read_bag_readings(write_bag(tmp_path / "bag", topics))
    assert_allclose(readings.b_nt, 41_000 + MIDDLE)
    assert_allclose(readings.p_xy[:, 0], 0.02 * MIDDLE, atol=1e-7)


def test_of_several_topics_one_has_to_be_chosen_and_a_near_name_is_told(tmp_path):
    field = at_middle(np.full(40, 41_000.0))
    bag = write_bag(tmp_path / "bag", {"/pose": drive(), "/pose2": drive(), "/mag": field})
    with pytest.raises(InputError, match="2 topics of a pose, /pose, /pose2; choose with --pose-topic"):
        read_bag_readings(bag)
    assert len(read_bag_readings(bag, pose_topic="/pose2")) == 40
    with pytest.raises(InputError, match="no topic '/pos'; did you mean '/pose'"):
        read_bag_readings(bag, pose_topic="/pos")
    with pytest.raises(InputError, match="topic /mag is a sensor_msgs/msg/MagneticField; a pose is one of"):
        read_bag_readings(bag, pose_topic="/mag")


def test_a_pose_that_does_not_drift_is_taken_before_odometry(tmp_path):
    fields = at_middle(np.full(40, 41_000.0))
    bag = write_bag(tmp_path / "a", {"/odom": drive(odometry), "/pose": drive(), "/mag": fields})
    assert "poses /pose," in read_bag_readings(bag).source
    assert "poses /odom," in read_bag_readings(bag, pose_topic="/odom").source
    two = write_bag(tmp_path / "b", {"/odom": drive(odometry), "/odom2": drive(odometry), "/mag": fields})
    with pytest.raises(InputError, match="2 topics of a pose, /odom, /odom2; choose with --pose-topic"):
        read_bag_readings(two)


def transforms(t, *places):
    """A TFMessage of parent, child, x, y and yaw of each transform."""
    made = [
        make(
            "geometry_msgs/msg/TransformStamped",
            header=header(t, parent),
            child_frame_id=child,
            transform=make(
                "geometry_msgs/msg/Transform",
                translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0),
                rotation=pose(0, 0, yaw).orientation,
            ),
        )
        for parent, child, x, y, yaw in places
    ]
    return (t, make("tf2_msgs/msg/TFMessage", transforms=made))


@pytest.mark.parametrize("moved", [True, False])
def test_odometry_that_transforms_correct_is_reported(tmp_path, moved):
    wheel = ("base_link", "wheel", 9.0, 0.0, 0.0)
    said = [
        transforms(START, ("map", "odom", 0.0, 0.0, 0.0)),
        transforms(START + 1, wheel, ("map", "/odom", 3.0 * moved, 4.0 * moved, -0.5 * moved)),
    ]
    fields = at_middle(np.full(40, 41_000.0))
    bag = write_bag(tmp_path / "a", {"/odom": drive(odometry), "/mag": fields, "/tf": said})
    source = read_bag_readings(bag).source
    text = (
        "; taken poses of /odom in 'odom', though /tf moves it against 'map' by up to 5 m and 28.6 deg, which"
    )
    assert (text in source) == moved
    assert ("taken" in source) == moved


def test_poses_without_an_orientation_are_refused_as_such(tmp_path):
    poses, fields = drive(), at_middle(np.full(40, 41_000.0))
    for k, (_, message) in enumerate(poses):
        message.pose.orientation.w = message.pose.orientation.z = 0.0
        if k == 2:
            some = write_bag(tmp_path / "some", {"/pose": poses, "/mag": fields})
    assert (
        "; taken 3 of 41 poses as missing, whose quaternion is not of length 1"
        in read_bag_readings(some).source
    )
    bag = write_bag(tmp_path / "all", {"/pose": poses, "/mag": fields})
    text = (
        r"41 of 41 poses of /pose cannot be used, the first at 1700000000\.000 s: its quaternion is 0,0,0,0"
    )
    with pytest.raises(InputError, match=text):
        read_bag_readings(bag)
    with pytest.raises(InputError, match="its quaternion is 0,0,0,0"):
        read_bag(bag, topics={"/robot/enu/pose": "/pose", "/robot/qtfm/magnitude": "/mag"})


def test_a_bag_without_a_field_or_without_a_pose_is_refused_with_its_topics(tmp_path):
    with pytest.raises(InputError, match=r"no topic of a field .*; topics in it: /pose \(geometry_msgs"):
        read_bag_readings(write_bag(tmp_path / "a", {"/pose": drive()}))
    with pytest.raises(InputError, match=r"no topic of a pose .*; topics in it: /mag \(sensor_msgs"):
        read_bag_readings(write_bag(tmp_path / "b", {"/mag": at_middle(np.full(40, 41_000.0))}))
    with pytest.raises(InputError, match="topic /pose has no message"):
        read_bag_readings(write_bag(tmp_path / "c", {"/pose": [], "/mag": at_middle(np.full(40, 41_000.0))}))


def cut(path: Path, keep: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("keep", [0.0, 0.01, 0.5, 0.8])
def test_a_bag_that_was_cut_short_is_refused_in_one_line(tmp_path, storage, keep):
    topics = {"/pose": drive(), "/mag": at_middle(np.full(40, 41_000.0))}
    folder = write_bag(tmp_path / "bag", topics, storage)
    cut(next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap")), keep)
    with pytest.raises(InputError, match=r"bag: (damaged bag, or none|cut short)") as refusal:
        read_bag_readings(folder)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "rosbag2_bagfile_information: 1\n",
        "!!python/object/apply:os.system ['touch executed']\n",
        "rosbag2_bagfile_information:\n  version: 99\n",
    ],
)
def test_metadata_that_is_none_is_refused_and_not_run(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    topics = {"/pose": drive(), "/mag": at_middle(np.full(40, 41_000.0))}
    folder = write_bag(tmp_path / "bag", topics)
    (folder / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match="bag: damaged bag, or none"):
        read_bag_readings(folder)
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_metadata_that_points_outside_its_folder_reaches_nothing(tmp_path):
    topics = {"/pose": drive(), "/mag": at_middle(np.full(40, 41_000.0))}
    folder = write_bag(tmp_path / "bag", topics)
    storage = next(folder.glob("*.db3"))
    storage.rename(tmp_path / storage.name)
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace(storage.name, f"../{storage.name}"))
    with pytest.raises(InputError, match=r"bag: damaged bag, or none .*missing"):
        read_bag_readings(folder)


def test_a_folder_that_is_no_bag_is_refused(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(InputError, match=r"bag: no bag: metadata\.yaml is missing"):
        read_bag_readings(tmp_path / "bag")
    with pytest.raises(InputError, match=r"no such bag"):
        read_bag_readings(tmp_path / "nothing")
