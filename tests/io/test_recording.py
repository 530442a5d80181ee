"""Recordings of other tools: roles, frames, timeline, damage, and what info says of them."""

import json
import re
from importlib.resources import files
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.testing import assert_allclose, assert_array_equal
from recordings import START, UPRIGHT, as_db3, inertial, magnetic, moved, pose, record
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags import read_bag, write_bag
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import TOPICS
from magtwin.io.info import info_of
from magtwin.io.recording.timeline import in_order
from magtwin.learn.data.inputs import inputs_of

pytestmark = [
    pytest.mark.filterwarnings(f"ignore:.*{words}.*:magtwin.errors.RepairWarning")
    for words in ("by its size", " joins ", "damaged and are left out", "cut short")
]
T = np.arange(200) / 50
FIELD = np.array([12_000.0, 20_000.0, -38_000.0])


def turned(t):
    return Rotation.from_euler("z", 0.2 * t + np.pi / 2)


def place(t):
    return np.array([np.cos(0.2 * t), np.sin(0.2 * t), 0.0])


def field(mount=UPRIGHT, frame="mag_link", count=200):
    return [(t, *magnetic(t, *(mount.inv().apply(FIELD) * 1e-9), frame=frame)) for t in T[:count]]


def poses():
    return [(t, *pose(t, place(t), turned(t))) for t in T]


def axes():
    """The 24 rotations of a cube."""
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.eye(3)[list(order)] * signs
        if np.linalg.det(matrix) > 0:
            yield Rotation.from_matrix(matrix)


@pytest.mark.filterwarnings("ignore:Gimbal lock")
def test_24_mounts_give_equal_vectors_by_every_way_to_tell_frames(tmp_path):
    for k, mount in enumerate(axes()):
        rpy = " ".join(map(repr, mount.as_euler("xyz").tolist()))
        origin = f'<origin xyz="0.1 0 0.2" rpy="{rpy}"/>'
        ends = '<parent link="base_link"/><child link="mag_link"/>'
        urdf = f'<robot name="a"><joint name="j" type="fixed">{ends}{origin}</joint></robot>'
        edge = ("base_link", "mag_link", (0.1, 0, 0.2), mount)
        told = [
            {"/tf_static": [(0.0, *moved(0.0, edge))]},
            {"/robot_description": [(0.0, "std_msgs/msg/String", {"data": urdf})]},
            {"/tf": [(t, *moved(t, edge)) for t in T[::20]]},  # as static_transform_publisher of ROS 1
        ][k % 3]
        run = read_bag(record(tmp_path / f"{k}.mcap", {"/imu/mag": field(mount), "/pose": poses(), **told}))
        assert_allclose(run["b_vector_measured_nt"], np.tile(FIELD, (200, 1)), atol=1e-9 * 40_000)
        assert run.metadata["tf_sensor_m"] == "0.1, 0, 0.2"


def test_poses_by_tf_equal_those_of_a_topic(tmp_path):
    drift = np.array([0.3, -0.2, 0.0])
    chain = [("map", "odom", drift, UPRIGHT)]
    steps = [(t, *moved(t, *chain, ("odom", "base_footprint", place(t) - drift, turned(t)))) for t in T]
    static = [(0.0, *moved(0.0, ("base_footprint", "base_link", (0, 0, 0), UPRIGHT)))]
    topics = {"/mag": field(), "/truth": poses(), "/tf": steps, "/tf_static": static}
    bag = record(tmp_path / "a.mcap", topics)
    by_topic, by_tf = read_bag(bag), read_bag(bag, topics={"/robot/enu/pose": "tf"})
    assert by_tf.metadata["truth"] == "'map' to 'base_link' by /tf"
    for name in ("p_world_base", "q_world_base_xyzw", "yaw"):
        assert_allclose(by_tf[name], by_topic[name], atol=1e-9)
    del topics["/truth"]
    alone = read_bag(record(tmp_path / "b.mcap", topics))
    assert_array_equal(alone["p_world_base"], by_tf["p_world_base"])
    with pytest.raises(InputError, match="/tf does not move a base of the robot in a map"):
        read_bag(record(tmp_path / "c.mcap", {"/mag": field()}), topics={"/robot/enu/pose": "tf"})


OWN = {
    "acme_msgs/msg/Total": (
        "uint64 timestamp\nfloat32 total_field\nuint8 status\n",
        lambda b: {"total_field": b},
    ),
    "acme_msgs/msg/Axes": (
        "std_msgs/Header header\nfloat64 field_x\nfloat64 field_y\nfloat64 field_z\nfloat32 heat\n",
        lambda b: {"field_x": b, "field_y": 0.0, "field_z": 1.0, "heat": 20.0},
    ),
}


@pytest.mark.parametrize("kind", OWN)
@pytest.mark.parametrize("version", [8, 9])
def test_a_field_of_a_type_that_only_the_bag_defines_is_read(tmp_path, kind, version):
    store, (text, values) = get_typestore(Stores.ROS2_HUMBLE), OWN[kind]
    store.register({k: v for k, v in get_types_from_msg(text, kind).items() if k not in store.fielddefs})
    with Writer(tmp_path / "bag", version=version, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection("/sensor/mag", kind, typestore=store)
        for k in range(50):
            more = {"timestamp": (START + k) * 10**6, "status": 0}
            stamp = store.types["builtin_interfaces/msg/Time"](sec=START + k, nanosec=0)
            head = {"header": store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="base_link")}
            message = store.types[kind](**values(41_000.0 + k), **(more if "Total" in kind else head))
            writer.write(link, (START + k) * NS, store.serialize_cdr(message, kind))
    run = read_bag(tmp_path / "bag")
    assert_allclose(run["b_measured_nt"], 41_000.0 + np.arange(50), rtol=1e-7)
    assert_array_equal(run["t"], np.arange(50))


@pytest.mark.parametrize(("size", "numbers"), product((32, 64), (1, 2, 3)))
def test_an_array_of_numbers_is_a_field_by_its_role(tmp_path, size, numbers):
    kind, b = f"std_msgs/msg/Float{size}MultiArray", [FIELD[:numbers], np.linalg.norm(FIELD)][numbers == 1]
    dims = {"layout.dim": 1, "layout.dim.0.label": "xyz", "layout.dim.0.size": np.uint32(numbers)}
    rows = [(t, kind, {**dims, "data": np.reshape(b, (1, -1))}) for t in T]
    bag = record(tmp_path / "a.mcap", {"/magnetometer": rows, "/truth": poses()})
    if numbers == 2:
        with pytest.raises(InputError, match="has 2 numbers; a magnitude is one, a vector x, y, z"):
            read_bag(bag)
        return
    run = read_bag(bag)
    assert_allclose(run["b_measured_nt"], np.linalg.norm(FIELD), rtol=1e-6)
    if numbers == 3:
        assert_allclose(run["b_vector_measured_nt"], np.tile(FIELD, (200, 1)), rtol=1e-6)


def test_a_bag_of_ros_1_is_read_like_that_of_ros_2(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    types, kind = store.types, "sensor_msgs/msg/MagneticField"
    with Writer1(tmp_path / "a.bag") as writer:
        link = writer.add_connection("/imu/mag", kind, typestore=store)
        for k, t in enumerate(T):
            stamp = types["builtin_interfaces/msg/Time"](sec=START + int(t), nanosec=round(t % 1 * 1e9))
            head = types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="base_link")
            b = types["geometry_msgs/msg/Vector3"](*(FIELD * 1e-9).tolist())
            raw = store.serialize_ros1(types[kind](head, b, np.zeros(9)), kind)
            writer.write(link, START * NS + round(t * 1e9), raw)
    run = read_bag(tmp_path / "a.bag")
    assert_allclose(run["t"], T, atol=1e-9)
    assert_allclose(run["b_vector_measured_nt"], np.tile(FIELD, (200, 1)), rtol=1e-12)
    assert mt.read_recording(tmp_path / "a.bag").roles == {"field": "/imu/mag"}


RANKED = {
    "mocap before a localizer": (
        "pose",
        {"/amcl_pose": poses, "/vicon/base/pose": poses, "/goal_pose": poses},
    ),
    "filtered odometry": ("odometry", {"/odom": poses, "/odometry/filtered": poses, "/wheel/odom": poses}),
}


@pytest.mark.parametrize("case", RANKED)
def test_the_name_decides_between_topics_of_one_type_and_that_is_told(tmp_path, case):
    role, made = RANKED[case]
    kind = "nav_msgs/msg/Odometry" if role == "odometry" else "geometry_msgs/msg/PoseStamped"
    topics = {name: [(t, *pose(t, place(t), turned(t), kind)) for t in T] for name in made}
    found = mt.read_recording(record(tmp_path / "a.mcap", {"/mag": field(), **topics}))
    best = sorted(made)[-1] if role == "pose" else "/odometry/filtered"
    assert found.roles[role] == best
    assert any(f"{role} {best} (not " in doubt for doubt in found.doubts)


def test_a_stamp_far_off_is_left_out_and_a_clock_that_jumps_for_good_is_refused():
    ns = START * NS + np.arange(1000) * 20_000_000
    received, odd = ns + 5_000_000, ns.copy()
    odd[[300, 999]] += 3600 * NS
    odd[500] = odd[499]
    order = in_order(odd, received, Path("a"), "/mag")
    assert (order.outliers, order.repeated, len(order.rows)) == (2, 1, 998)
    assert (np.diff(order.ns) >= 0).all()
    pause = np.where(np.arange(1000) > 500, 600 * NS, 0)
    assert in_order(ns + pause, received + pause, Path("a"), "/mag").outliers == 0
    for jump in (7200 * NS, -30 * NS):
        later = ns + np.where(np.arange(1000) >= 600, jump, 0)
        with pytest.raises(InputError, match=r"for good, from 17\d*\.980000 s to .* in message 601 of 1000"):
            in_order(later, received, Path("a"), "/mag")


def test_a_flipped_byte_costs_at_most_one_chunk(tmp_path, monkeypatch):
    monkeypatch.setattr("magtwin.io.bags.mcap.CHUNK", 4000)
    bag, rng = record(tmp_path / "a.mcap", {"/mag": field(), "/pose": poses()}), np.random.default_rng(0)
    content = bag.read_bytes()
    chunk = -(-4000 // 120)  # most readings in one
    for _ in range(60):
        wrong = bytearray(content)
        wrong[rng.integers(len(wrong))] ^= 1 << rng.integers(8)
        bag.write_bytes(wrong)
        assert read_bag(bag).rows >= 200 - chunk
        assert info_of(bag).figures[0].name == "duration"


def test_info_counts_as_rosbags_does_and_ends_for_no_readable_bag(tmp_path):
    room = [(t, *magnetic(t, 41e-6 + 1e-6 * np.sin(t), 1e-6, 0.0)) for t in T]
    bag = record(tmp_path / "bag", {"/a/mag": room, "/b/mag": room[:150], "/pose": poses()})
    for path in (bag, as_db3(bag, tmp_path / "db3")):
        report = info_of(path)
        with Reader(path) as reader:
            counts = {c.topic: c.msgcount for c in reader.connections}
        assert next(f.value for f in report.figures if f.name == "messages") == sum(counts.values())
        for topic, line in report.metadata["topics"].items():
            assert f"  {counts[topic]:,}  50 Hz" in line
        assert report.metadata["fit for a map"] == "no, because 2 field topics, /a/mag"
        assert "choose with --field-topic TOPIC" in report.metadata["doubts"][0]
    chosen = info_of(bag, topics={"/robot/qtfm/magnitude": "/a/mag"})
    assert chosen.metadata["fit for a map"].startswith("yes")
    assert chosen.metadata["next"] == f"magtwin map fit {bag} --out map.usdc"
    assert chosen.metadata["topics"]["/a/mag"].endswith("after its stamp  reliable, depth 10  = field")
    empty = record(tmp_path / "none.mcap", {"/rosout": [(0.0, "std_msgs/msg/String", {"data": "a"})]})
    assert info_of(empty).metadata["fit for localization"] == "no, because no field topic"
    with pytest.warns(RepairWarning, match="not that of the Earth's field"):
        assert read_bag(bag, topics={"/robot/qtfm/magnitude": "/a/mag"}, unit="G").rows == 200


def test_each_option_in_a_message_is_one_of_the_commands_that_read_recordings(capsys):
    root = Path(mt.__file__).parent / "io" / "recording"
    words = {word for path in root.glob("*.py") for word in re.findall(r"--[a-z-]+", path.read_text())} - {
        "--out",
        "--map",
    }
    assert {"--field-topic", "--pose-topic", "--remap", "--unit", "--scale"} == words
    names = "info,view,convert,report,compare,plot,evaluate,localize,model calibrate,dataset build,ros replay"
    rooms = [root.parent / "surveys", root.parents[1] / "tables"]
    told = "".join(path.read_text() for room in rooms for path in room.glob("*.py"))
    others = {"--out", "--keep-stuck", "--created", "--map", "--method"}
    told = set(re.findall(r"(?<!-)--[a-z]+[a-z-]*", told)) - others
    for name in [*names.split(","), "map import"]:
        main([*name.split(), "--help"])
        shown = capsys.readouterr().out
        wanted = told if name == "map import" else words | (told if name == "info" else set())
        assert all(word in shown for word in wanted), name


def test_a_bag_numbers_its_messages_and_keeps_times_before_0_and_of_one_nanosecond(tmp_path):
    t = np.array([-2.5, -1.0, -1.0 + 2e-10, 3.0])
    run = mt.Run({"t": t, "b_measured_nt": np.full(4, 41_000.0)})
    with pytest.warns(RepairWarning, match=r"t begins at -2\.5 s, and stamps of ROS at 0: they are t \+ 3 s"):
        write_bag(run, tmp_path / "a.mcap")
    assert_array_equal(read_bag(tmp_path / "a.mcap")["t"], t)
    numbers: dict[str, list[int]] = {}
    with (tmp_path / "a.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            numbers.setdefault(channel.topic, []).append(message.sequence)
    assert all(each == list(range(len(each))) for each in numbers.values())
    assert numbers["/magtwin/reading"] == [0, 1, 2, 3]


def test_the_layouts_for_other_programs_name_topics_that_bags_have():
    layouts = files("magtwin.ros") / "layouts"
    foxglove = json.loads((layouts / "foxglove.json").read_text())
    texts = json.dumps(foxglove) + (layouts / "plotjuggler.xml").read_text()
    named = set(re.findall(r'"(/[a-z][^".]*)', texts))
    assert named
    for name in named:
        assert any(name == topic or name.startswith(f"{topic}/") for topic in TOPICS), name


def test_inputs_far_from_the_training_are_named_with_their_ranges_from_a_share_of_readings():
    rng = np.random.default_rng(0)
    inputs = inputs_of(rng.uniform(0, 1, (500, 2)), ["yaw_sin", "battery_a"])
    x = np.full((100, 2), 0.5)
    x[:5, 1] = 7.0
    assert inputs.worst(x) == ""
    x[:40, 1] = np.linspace(3, 9, 40)
    assert re.fullmatch(
        r"40% of 100 readings are outside the training range: battery_a 9 \(trained on .* to .*\) in 40%",
        inputs.worst(x),
    )


def test_an_imu_of_a_known_frame_warns_of_nothing(tmp_path):
    rest = [(t, *inertial(t, turned(t), (0, 0, 0.2), (0, 0.04, 9.81), "base_link")) for t in T]
    found = mt.read_recording(record(tmp_path / "a.mcap", {"/mag": field(frame="base_link"), "/imu": rest}))
    assert found.frames["IMU"] == ("base_link", "")
    assert found.timeline == {}
