"""The bus: what one node says another hears, over DDS and in rclpy, on this machine only."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from nodes import DOMAINS, spin
from places import ROOT

from magtwin.errors import InputError
from magtwin.io.bags.topics import LATCHED, ODOMETRY, SENSOR_DATA, TOPICS, Qos
from magtwin.io.bags.types import definition_of, layout, store_of
from magtwin.ros.bus import Bus, Message, names_of, open_bus, to_bytes
from magtwin.ros.bus.clock import Clock
from magtwin.ros.bus.names import Range, range_of

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

JAZZY = ROOT / "build" / "ros-jazzy" / "bin" / "python"
FIELD = "sensor_msgs/msg/MagneticField"


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain of a test's own, on loopback only."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    return next(DOMAINS)


@pytest.fixture
def pair(domain: int) -> Iterator[tuple[Bus, Bus]]:
    """Two nodes of cyclonedds."""
    nodes = tuple(open_bus(name, backend="cyclonedds", domain=domain) for name in ("one", "other"))
    yield nodes  # type: ignore[misc]
    for node in nodes:
        node.close()


def test_a_closed_node_leaves_no_publisher_behind_even_if_its_publishers_are_kept(domain: int) -> None:
    one, other = (open_bus(name, backend="cyclonedds", domain=domain) for name in ("one", "other"))
    kept = one.publisher("field", FIELD, Qos()), one.subscribe("other", FIELD, lambda m: None, Qos())
    spin(lambda: other.publishers("field") == 1, one, other)
    assert one.publishers("field") == 1
    one.close()
    spin(lambda: other.publishers("field") == 0, other)
    assert len(kept) == 2
    other.close()


KINDS = sorted(
    kind
    for kind in {kind for topic in TOPICS.values() for kind in (topic.kind, *topic.reads)}
    if not kind.startswith("px4_msgs/")  # which bags bring with them
)


def test_every_type_of_the_table_crosses_unchanged(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    heard: dict[str, Message] = {}
    said: dict[str, bytes] = {}
    offered = []
    for k, kind in enumerate(KINDS):
        offered.append(one.publisher(f"t{k}", kind, Qos()))
        other.subscribe(f"t{k}", kind, lambda m: heard.__setitem__(m.kind, m), Qos())
        some = {"header.frame_id": "base_link", "pose.position": [1.0, 2.0, 3.0]}
        known = {leaf.name for leaf in layout(kind)}
        said[kind] = to_bytes(kind, {name: value for name, value in some.items() if name in known})
    spin(lambda: all(p.subscribers() for p in offered), one, other)
    for publisher in offered:
        publisher.publish(said[publisher.kind])
    spin(lambda: len(heard) == len(KINDS), one, other)
    for kind, message in heard.items():
        assert message.data[: len(said[kind])] == said[kind]  # DDS pads to four bytes
        assert not any(message.data[len(said[kind]) :])


def test_our_bytes_are_those_that_cyclonedds_itself_writes() -> None:
    from cyclonedds.idl import IdlStruct

    from magtwin.ros.bus.types import _struct

    struct = _struct(FIELD)
    header, field = (struct.__annotations__[name] for name in ("header", "magnetic_field"))
    stamp = header.__annotations__["stamp"]
    sample = struct(
        header=header(stamp=stamp(sec=7, nanosec=5), frame_id="head"),
        magnetic_field=field(x=1e-5, y=-2e-5, z=3e-5),
        magnetic_field_covariance=[float(k) for k in range(9)],
    )
    assert isinstance(sample, IdlStruct)
    ours = to_bytes(
        FIELD,
        {
            "header.stamp": np.int64(7_000_000_005),
            "header.frame_id": "head",
            "magnetic_field": [1e-5, -2e-5, 3e-5],
            "magnetic_field_covariance": np.arange(9.0),
        },
    )
    assert sample.serialize(use_version_2=False)[4:] == ours[4:]


def test_who_comes_late_gets_what_is_latched_and_nothing_else(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    heard: list[str] = []
    for topic, qos in (("latched", LATCHED), ("passing", Qos())):
        one.publisher(topic, "std_msgs/msg/String", qos).publish(
            to_bytes("std_msgs/msg/String", {"data": topic})
        )
        other.subscribe(topic, "std_msgs/msg/String", lambda m: heard.append(m.read(["data"])["data"]), qos)
    spin(lambda: heard, one, other)
    for _ in range(10):
        other.spin_once(0.01)
    assert heard == ["latched"]


@pytest.mark.parametrize("offered", [Qos(), SENSOR_DATA])
def test_a_best_effort_subscription_hears_every_publisher_and_a_reliable_one_reliable_ones(
    pair: tuple[Bus, Bus], offered: Qos
) -> None:
    one, other = pair
    heard: list[str] = []
    talk = one.publisher("odom", "std_msgs/msg/String", offered)
    for name, qos in (("any", Qos().heard), ("strict", Qos())):
        other.subscribe("odom", "std_msgs/msg/String", lambda m, name=name: heard.append(name), qos)
    wanted = {"any", "strict"} if offered.reliable else {"any"}
    spin(lambda: talk.subscribers() == len(wanted), one, other)
    talk.publish(to_bytes("std_msgs/msg/String", {"data": "x"}))
    spin(lambda: set(heard) == wanted, one, other)


@pytest.mark.parametrize(
    ("environment", "wanted"),
    [
        ({}, "localhost"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "subnet"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"}, "localhost"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}, "subnet"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_LOCALHOST_ONLY": "1"}, "localhost"),
        ({"ROS_LOCALHOST_ONLY": "0"}, "subnet"),
    ],
)
def test_a_node_is_found_on_this_machine_alone_unless_the_environment_or_an_option_opens_it(
    environment: dict[str, str], wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert range_of() == wanted
    assert range_of("subnet") == "subnet"
    assert range_of("localhost") == "localhost"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists the sockets of a process")
@pytest.mark.parametrize(("reach", "device"), [("localhost", b"lo\0"), ("subnet", b"")])
def test_sockets_of_a_node_hear_this_machine_alone_unless_discovery_opens_them(
    domain: int, reach: Range, device: bytes
) -> None:
    from magtwin.ros.bus.dds import sockets_of

    bus = open_bus("one", backend="cyclonedds", domain=domain, discovery=reach)
    sockets = sockets_of(domain)
    devices = [held.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16) for held in sockets]
    for held in sockets:
        held.close()
    bus.close()
    assert len(devices) >= 2  # of discovery and of data
    assert set(devices) == {device}


@pytest.mark.parametrize("value", ["OFF", "world"])
def test_a_discovery_range_that_finds_nobody_or_is_unknown_is_refused(
    value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", value)
    with pytest.raises(InputError, match="LOCALHOST, SUBNET or SYSTEM_DEFAULT"):
        range_of()


def test_a_broken_message_tells_no_clock_and_wall_timers_go_on_without_it(domain: int) -> None:
    bus = open_bus("node", backend="cyclonedds", domain=domain, sim_time=True)
    due: list[str] = []
    bus.timer(0.01, lambda: due.append("sim"))
    bus.timer(0.01, lambda: due.append("wall"), wall=True)
    bus._tick(Message("rosgraph_msgs/msg/Clock", b"\0\1\0\0\5", 0, 0))
    spin(lambda: len(due) > 2, bus)
    assert bus.now_ns() == 0
    assert set(due) == {"wall"}
    bus.close()


def test_timers_of_sim_time_follow_slash_clock(domain: int) -> None:
    one = open_bus("one", backend="cyclonedds", domain=domain)
    other = open_bus("other", backend="cyclonedds", domain=domain, sim_time=True)
    due: list[int] = []
    other.timer(0.1, lambda: due.append(other.now_ns()))
    clock = one.publisher("/clock", "rosgraph_msgs/msg/Clock", TOPICS["/clock"].qos)
    spin(lambda: clock.subscribers(), one, other)
    for step in range(1, 11):
        now = step * 50_000_000
        clock.publish(to_bytes("rosgraph_msgs/msg/Clock", {"clock": np.int64(now)}))
        spin(lambda now=now: other.now_ns() == now, other)
    assert due == [150_000_000, 250_000_000, 350_000_000, 450_000_000]
    one.close()
    other.close()


def test_a_timer_begins_anew_where_time_jumps_back() -> None:
    clock, due = Clock(sim_time=True), []
    clock.timer(1.0, lambda: due.append(clock.now_ns() // 10**9))
    for t in (10, 11, 12, 2, 3, 4):
        clock.tell(t * 10**9)
        clock.run_due()
    assert due == [11, 12, 3, 4]


@pytest.mark.parametrize(
    ("namespace", "remaps", "name", "whole"),
    [
        ("robot", (), "/robot/odom", "/robot/odom"),
        ("tb4", (), "/robot/odom", "/tb4/odom"),
        ("", (), "odom", "/odom"),
        ("robot", (), "/clock", "/clock"),
        ("robot", ("odom:=/vicon/odom",), "/robot/odom", "/vicon/odom"),
        ("a/b", ("/a/b/odom:=wheel",), "/robot/odom", "/a/b/wheel"),
        ("robot", ("/tf:=tf",), "/tf", "/robot/tf"),
    ],
)
def test_names_stand_in_their_namespace_and_are_remapped(
    namespace: str, remaps: tuple[str, ...], name: str, whole: str
) -> None:
    assert names_of(namespace, remaps).resolve(name) == whole


def test_without_either_backend_one_line_tells_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"source an installation .*pip install 'magtwin\[ros\]'"):
        open_bus("node")


def test_where_rclpy_is_broken_cyclonedds_is_taken_and_who_asks_for_rclpy_is_told(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rclpy.py").write_text("raise ImportError('librcl.so: cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    node = open_bus("node", domain=domain)
    assert node.backend == "cyclonedds"
    node.close()
    with pytest.raises(InputError, match="rclpy is installed but cannot be imported: librcl"):
        open_bus("node", domain=domain, backend="rclpy")


def test_a_node_takes_a_topic_in_two_types(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    kinds = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
    heard: list[str] = []
    for kind in kinds:
        one.subscribe("cmd_vel", kind, lambda m: heard.append(m.kind), Qos().heard)
    sent = [other.publisher("cmd_vel", kind, Qos()) for kind in kinds]
    spin(lambda: all(p.subscribers() for p in sent) and len(other.wants("cmd_vel")) == 2, one, other)
    for publisher in sent:
        publisher.publish(to_bytes(publisher.kind, {}))
    spin(lambda: sorted(heard) == sorted(kinds), one, other)
    assert {end.kind for end in other.wants("cmd_vel")} == set(kinds)


def test_endpoints_carry_the_hash_of_their_type(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    one.publisher("field", FIELD, Qos())
    one.subscribe("odom", ODOMETRY.kind, lambda m: None, Qos())
    spin(lambda: other.offers("field") and other.wants("odom"), one, other)
    # as rclpy of Jazzy gives it in `topic_type_hash`
    wanted = "RIHS01_e80f32f56a20486c9923008fc1a1db07bbb273cbbf6a5b3bfa00835ee00e4dff"
    assert other.offers("field")[0].digest == definition_of(FIELD)[1] == wanted
    assert other.wants("odom")[0].digest == definition_of(ODOMETRY.kind)[1]


@pytest.mark.parametrize("form", ["humble", "jazzy"])
def test_a_node_is_listed_in_the_form_of_its_peers_and_not_among_both_forms(domain: int, form: str) -> None:
    from cyclonedds.core import Policy
    from cyclonedds.core import Qos as DdsQos
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from magtwin.ros.bus.graph import LISTS, LISTS_KIND
    from magtwin.ros.bus.types import struct_of

    def peer(bus: Bus, of: str) -> tuple[object, DataReader]:
        """A node of a distribution, as its middleware announces it."""
        store = store_of(of)
        digest = b"" if of == "humble" else f"typehash={store.hash_rihs01(LISTS_KIND)};".encode()
        qos = DdsQos(Policy.Reliability.Reliable(10**8), Policy.Durability.TransientLocal)
        topic = Topic(bus._participant, LISTS, struct_of(LISTS_KIND, store))  # type: ignore[attr-defined]
        writer = DataWriter(bus._participant, topic, qos + DdsQos(Policy.Userdata(digest)))  # type: ignore[attr-defined]
        return writer, DataReader(bus._participant, topic, qos)  # type: ignore[attr-defined]

    node, other, third = (
        open_bus(n, backend="cyclonedds", domain=domain) for n in ("node", "other", "third")
    )
    node.publisher("field", FIELD, Qos())
    writer, reader = peer(other, form)
    heard: list[bytes] = []
    spin(lambda: heard.extend(sample.cdr for sample in reader.take(10)) or heard, node)
    entry = store_of(form).deserialize_cdr(heard[-1], LISTS_KIND)
    (listed,) = entry.node_entities_info_seq
    assert (listed.node_namespace, listed.node_name) == ("/robot", "node")
    assert bytes(entry.gid.data)[:16] == node._participant.guid.bytes  # type: ignore[attr-defined]
    assert [bytes(gid.data)[:16] for gid in listed.writer_gid_seq] == [w.guid.bytes for w in node._writers]  # type: ignore[attr-defined]
    assert {len(gid.data) for gid in listed.writer_gid_seq} == {24 if form == "humble" else 16}
    kept = peer(third, "jazzy" if form == "humble" else "humble")
    spin(lambda: node._listed._writer is None, node)
    for bus in (node, other, third):
        bus.close()
    del writer, kept


@pytest.fixture(scope="module")
def jazzy() -> Path:
    """A Python with rclpy of Jazzy's wheels, whose environment is built apart."""
    if not JAZZY.exists():
        pytest.skip("no rclpy: `make ros` installs that of ROS 2 Jazzy into build/ros-jazzy")
    return JAZZY


ECHO = """
import sys
sys.path.insert(0, sys.argv[1])
from magtwin.io.bags.topics import LATCHED, Qos
from magtwin.ros.bus import open_bus
node = open_bus("echo", backend="rclpy")
there = node.publisher("back", "sensor_msgs/msg/MagneticField", Qos(depth=50))
node.subscribe("out", "sensor_msgs/msg/MagneticField", lambda m: there.publish(m.data), Qos(depth=50))
while True:
    node.spin_once(0.1)
"""


def test_rclpy_hears_what_cyclonedds_says_and_the_reverse(jazzy: Path, domain: int) -> None:
    env = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    echo = subprocess.Popen([jazzy, "-c", ECHO, str(ROOT)], env=env)
    node = open_bus("one", backend="cyclonedds", domain=domain)
    try:
        heard: list[Message] = []
        out = node.publisher("out", FIELD, Qos(depth=50))
        back = node.subscribe("back", FIELD, heard.append, Qos(depth=50))
        spin(lambda: out.subscribers() and back.publishers(), node)
        time.sleep(0.2)
        field = [1.2e-5, -3.4e-5, 5.6e-5]
        for k in range(20):
            stamp = np.int64(k * 10**9 + 7)
            fields = {"header.stamp": stamp, "header.frame_id": "head", "magnetic_field": field}
            out.publish(to_bytes(FIELD, fields))
        spin(lambda: len(heard) == 20, node)
    finally:
        echo.terminate()
        echo.wait()
        node.close()
    read = [m.read(["header.stamp", "header.frame_id", "magnetic_field"]) for m in heard]
    assert [one["header.stamp"] for one in read] == [k * 10**9 + 7 for k in range(20)]
    assert {one["header.frame_id"] for one in read} == {"head"}
    np.testing.assert_array_equal([one["magnetic_field"] for one in read], [field] * 20)


BOTH = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
from magtwin.io.bags.topics import Qos
from magtwin.ros.bus import open_bus
node, heard = open_bus("peer", backend="rclpy"), set()
for kind in ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"):
    node.subscribe("cmd_vel", kind, lambda m: heard.add(m.kind), Qos())
last = time.monotonic() + 120
while time.monotonic() < last:
    node.spin_once(0.05)
    names = node._node.get_node_names_and_namespaces()
    if len(heard) == 2 and ("one", "/robot") in names:
        break
names = [name for name, _ in names]
print(json.dumps([sorted(heard), names, {end.kind: end.digest for end in node.offers("cmd_vel")}]))
"""


def test_rclpy_takes_both_types_of_commands_and_lists_nodes_of_cyclonedds(jazzy: Path, domain: int) -> None:
    env = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    peer = subprocess.Popen([jazzy, "-c", BOTH, str(ROOT)], env=env, stdout=subprocess.PIPE, text=True)
    node = open_bus("one", backend="cyclonedds", domain=domain)
    kinds = ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"]
    sent = [node.publisher("cmd_vel", kind, Qos()) for kind in kinds]
    try:
        while peer.poll() is None:
            for publisher in sent:
                publisher.publish(to_bytes(publisher.kind, {}))
            node.spin_once(0.05)
        heard, names, digests = json.loads(peer.communicate()[0])
    finally:
        peer.kill()
        node.close()
    assert heard == kinds
    assert "one" in names
    assert digests == {kind: definition_of(kind)[1] for kind in kinds}
