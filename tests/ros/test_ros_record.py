"""The recorder: topics of any type, of any clock, and what it says of those that it could not record."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from nodes import SLOWEST_S, spin
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from magtwin.errors import InputError
from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.topics import CLOCK, LATCHED, MAGNITUDE, ODOMETRY, Qos
from magtwin.io.bags.types import definition_of
from magtwin.io.formats import read_run
from magtwin.ros.bus import Bus, Message, to_bytes
from magtwin.ros.record import Player, Recorder
from magtwin.ros.simulate import Simulator
from magtwin.twin import Twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

COMMON = (
    *("std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "diagnostic_msgs", "shape_msgs", "stereo_msgs"),
    *("trajectory_msgs", "visualization_msgs"),
)
"""common_interfaces but std_srvs, which has no messages."""


def filled(store, described, rng):  # type: ignore[no-untyped-def]
    """A value of a field, as rosbags takes it: two elements in each sequence."""
    node, content = described
    if node is Nodetype.NAME:
        fields = store.fielddefs[content][1]
        return store.types[content](**{name: filled(store, inner, rng) for name, inner in fields})
    if node is Nodetype.BASE:
        name = content[0]
        if name == "string":
            return "".join(map(chr, rng.integers(97, 123, rng.integers(0, 9))))
        if name == "bool":
            return bool(rng.integers(2))
        return float(np.float32(rng.normal())) if name.startswith("float") else int(rng.integers(0, 100))
    element, count = content
    count = count if node is Nodetype.ARRAY else 2
    values = [filled(store, element, rng) for _ in range(count)]
    if element[0] is Nodetype.NAME or element[1][0] == "string":
        return values
    return np.array(values, {"byte": np.uint8, "char": np.uint8}.get(element[1][0], element[1][0]))


def test_every_type_of_common_interfaces_is_recorded_and_read_by_mcap_and_rosbags(
    nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    store, rng = get_typestore(Stores.ROS2_HUMBLE), np.random.default_rng(0)
    kinds = sorted(kind for kind in store.fielddefs if kind.split("/")[0] in COMMON)
    assert len(kinds) == 115
    sent = {
        kind: bytes(store.serialize_cdr(filled(store, (Nodetype.NAME, kind), rng), kind)) for kind in kinds
    }
    robot, ear = nodes("robot"), nodes("recorder")
    publishers = {kind: robot.publisher(f"/{kind}", kind, Qos()) for kind in kinds}
    writer = RawBagWriter(tmp_path / "all.mcap")
    recorder = Recorder(ear, writer, [f"/{kind}" for kind in kinds])
    last = time.monotonic() + SLOWEST_S
    recorder.run(lambda: all(p.subscribers() for p in publishers.values()) or time.monotonic() > last)
    for kind, publisher in publishers.items():
        publisher.publish(sent[kind])
    recorder.run(lambda: not recorder.missing() or time.monotonic() > last)
    assert not recorder.missing()
    writer.close()
    with (tmp_path / "all.mcap").open("rb") as file:
        read = {schema.name: (schema, message) for schema, _, message in make_reader(file).iter_messages()}
    assert sorted(read) == kinds
    for kind, (schema, message) in read.items():
        assert message.data[: len(sent[kind])] == sent[kind]
        assert schema.data.decode() == definition_of(kind)[0]
    with AnyReader([tmp_path / "all.mcap"]) as bag:  # by the definitions in the bag
        for connection, _, data in bag.messages():
            kind = connection.msgtype
            bag.deserialize(data, kind)
            again = store.deserialize_cdr(data, kind)
            assert bytes(store.serialize_cdr(again, kind)) == sent[kind]


def test_topics_that_cannot_be_recorded_are_named_with_the_reason(
    nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    robot, ear = nodes("robot"), nodes("recorder")
    own = make_idl_struct("Own_", "my_robot::msg::dds_::Own_", {"data": uint32})
    kept = DataWriter(robot._participant, Topic(robot._participant, "rt/robot/own", own))  # type: ignore[attr-defined]
    quiet = robot.publisher("quiet", "std_msgs/msg/Empty", Qos())
    lines: list[str] = []
    writer = RawBagWriter(tmp_path / "bag.mcap")
    recorder = Recorder(ear, writer, ["own", "quiet", "/odomm"], say=lines.append)
    recorder.run(lambda: bool(lines and quiet.subscribers()), duration_s=20)
    why = "it is published as my_robot/msg/Own, which is not known here"
    assert lines == [f"own is not recorded: {why}"]
    assert recorder.missing() == {
        "own": why,
        "quiet": "no message came",
        "/odomm": "nobody publishes it",
    }
    writer.close()
    assert not list(tmp_path.iterdir())
    del kept


def test_the_definition_is_that_of_the_publishers_distribution() -> None:
    kind = "sensor_msgs/msg/Range"  # has a variance since Iron
    humble, jazzy = (get_typestore(s) for s in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY))
    assert "variance" not in definition_of(kind, "")[0]
    assert "variance" in definition_of(kind, jazzy.hash_rihs01(kind))[0]
    assert definition_of(kind, humble.hash_rihs01(kind)) == definition_of(kind)
    with pytest.raises(InputError, match="sensor_msgs/msg/Range is defined in another way"):
        definition_of(kind, "RIHS01_0")


@pytest.mark.parametrize("sim_time", [True, False])
def test_a_recording_ends_where_time_jumps_back(
    twin: Twin, nodes: Callable[..., Bus], tmp_path: Path, sim_time: bool
) -> None:
    simulator = Simulator(twin, nodes("sim"), seed=3, speed=4.0)
    writer = RawBagWriter(tmp_path / "drive.mcap")
    lines: list[str] = []
    recorder = Recorder(nodes("recorder", sim_time=sim_time), writer, sim_time=sim_time, say=lines.append)
    recorder.run(duration_s=0.6)
    asked = [False]

    def ended() -> bool:
        if simulator.online.t > 1.0 and not asked[0]:
            asked[0] = True
            simulator.reset()
        return asked[0] and 0.5 < simulator.online.t < 1.0

    simulated = threading.Thread(target=simulator.run, args=(ended,))
    simulated.start()
    recorder.run(duration_s=60.0)
    simulated.join()
    writer.close()
    assert recorder.ended
    assert ["jumped back" in line for line in lines] == [True]
    assert read_run(tmp_path / "drive.mcap")["t"][-1] > 0.9


def test_a_replay_by_the_wall_has_stamps_and_clock_of_now(
    twin: Twin, nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    from magtwin.twin import simulate

    run = simulate(twin, "sine", duration_s=1.5, seed=1)
    heard: dict[str, list[Message]] = {ODOMETRY.name: [], CLOCK.name: []}
    player, ear = Player(run, nodes("player"), stamps="wall"), nodes("ear")
    for topic in (ODOMETRY, CLOCK):
        ear.subscribe(topic.name, topic.kind, heard[topic.name].append, Qos(depth=1000))
    played = threading.Thread(target=player.run)
    played.start()
    spin(lambda: not played.is_alive(), ear)
    ear.spin_once(0.1)
    for name, leaf in ((ODOMETRY.name, "header.stamp"), (CLOCK.name, "clock")):
        late = np.array([m.sent_ns - m.read([leaf])[leaf] for m in heard[name]]) * 1e-9
        assert len(late) > 50
        assert np.median(np.abs(late)) < 0.1


def test_topics_that_are_named_are_recorded_beside_those_of_the_drive(
    nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    robot, ear = nodes("robot"), nodes("recorder")
    kinds = {ODOMETRY.name: ODOMETRY.kind, MAGNITUDE.name: MAGNITUDE.kind, "/notes": "std_msgs/msg/String"}
    publishers = [robot.publisher(name, kind, Qos()) for name, kind in kinds.items()]
    writer = RawBagWriter(tmp_path / "bag.mcap")
    recorder = Recorder(ear, writer, ["/notes", "odom"])
    recorder.run(lambda: all(p.subscribers() for p in publishers), duration_s=20)
    for publisher in publishers:
        publisher.publish(to_bytes(publisher.kind, {}))
    recorder.run(lambda: sum(writer.counts.values()) == 3, duration_s=20)
    assert recorder.missing() == {}
    writer.close()
    assert writer.counts == dict.fromkeys(kinds, 1)


def test_a_latched_topic_of_another_node_is_recorded_although_it_was_sent_before(
    nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    robot, ear = nodes("robot"), nodes("recorder")
    text = robot.publisher("/notes", "std_msgs/msg/String", LATCHED)
    text.publish(to_bytes("std_msgs/msg/String", {"data": "once"}))
    writer = RawBagWriter(tmp_path / "bag")
    recorder = Recorder(ear, writer, ["/notes"])
    recorder.run(lambda: not recorder.missing(), duration_s=15)
    writer.close()
    assert writer.counts == {"/notes": 1}
