"""Several robots of a scene in one simulator: topics, frames and commands of their own, one clock."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from nodes import DOMAINS, spin

from magtwin.author.scene import author_scene
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.io.bags.sender import prefixed
from magtwin.io.bags.topics import CLOCK, COMMAND, LATCHED, ODOMETRY, TF, TF_STATIC, Qos
from magtwin.io.bags.twin_sender import sender_for
from magtwin.ros.bus import Message, names_of, open_bus, to_bytes
from magtwin.ros.simulate import Simulator
from magtwin.spec.scene import PlacedRobot
from magtwin.twin import Twin, open_twin, scene_from_toml

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

OWN = ("odom", "imu", "enu/pose", "battery_state", "scan", "joint_states", "robot_description")
OWN = (*OWN, "qtfm/magnitude", "qtfm/field", "qtfm/total_field_nt", "magtwin/reading", "magtwin/columns")
OWN = (*OWN, "ground_truth", "ground_truth/readings", "ground_truth/path")
SHARED = ("/clock", "/tf", "/tf_static", "/diagnostics", "/map", "/anomaly_map")
DURATION_S = 4.0


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Twin:
    """The default lab with two robots 0.8 m apart."""
    lab = scene_from_toml(shipped("scenes", "lab.toml"))
    sensor = replace(lab.robot.magnetometer, kind="physical", network=None, network_sha256="", inputs=())
    ann, bob = (replace(lab.robot, name=name, magnetometer=sensor) for name in ("ann", "bob"))
    others = (PlacedRobot(robot=bob, start=(0.0, 0.8, 0.0)),)
    scene = replace(lab, robot=ann, start=(0.0, 0.0, 0.0), others=others)
    return open_twin(author_scene(scene, tmp_path_factory.mktemp("two") / "scene"))


@dataclass
class Heard:
    """What a listener heard of two robots, of which ann was driven."""

    counts: Counter[str] = field(default_factory=Counter)
    clock: list[int] = field(default_factory=list)
    x: dict[str, list[float]] = field(default_factory=lambda: {"ann": [], "bob": []})
    frames: set[tuple[str, str]] = field(default_factory=set)
    odometry: set[tuple[str, str]] = field(default_factory=set)
    publishers: dict[str, int] = field(default_factory=dict)
    poses: list[tuple[float, float, float]] = field(default_factory=list)
    reset: tuple[float, ...] = ()


@pytest.fixture(scope="module")
def heard(twin: Twin) -> Iterator[Heard]:
    """Two robots for some seconds, at twice real time."""
    domain, seen = next(DOMAINS), Heard()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
            patch.delenv(name, raising=False)
        bus, ear = (
            open_bus(name, backend="cyclonedds", domain=domain, names=names_of("")) for name in ("sim", "ear")
        )
    simulator = Simulator(twin, bus, speed=2.0, lidar="on")

    def odometry(name: str, message: Message) -> None:
        read = message.read(["header.frame_id", "child_frame_id", "pose.pose.position"])
        seen.x[name].append(float(read["pose.pose.position"][0]))
        seen.odometry.add((read["header.frame_id"], read["child_frame_id"]))

    def transforms(message: Message) -> None:
        seen.counts[message.kind] += 1
        count = int(message.read(["transforms"])["transforms"])
        names = [
            f"transforms.{k}.{end}" for k in range(count) for end in ("header.frame_id", "child_frame_id")
        ]
        read = message.read(names)
        seen.frames |= {(read[a], read[b]) for a, b in zip(names[::2], names[1::2], strict=True)}

    ear.subscribe(
        "/clock", CLOCK.kind, lambda m: seen.clock.append(int(m.read(["clock"])["clock"])), Qos(depth=1000)
    )
    ear.subscribe("/tf", TF.kind, transforms, Qos(depth=1000))
    ear.subscribe("/tf_static", TF_STATIC.kind, transforms, LATCHED)
    for name in seen.x:
        ear.subscribe(f"/{name}/odom", ODOMETRY.kind, lambda m, name=name: odometry(name, m), Qos(depth=1000))
    drive = ear.publisher("/ann/cmd_vel", COMMAND.kind, COMMAND.qos)
    spin(lambda: drive.subscribers() and ear.types("/bob/odom"), bus, ear)

    def ended() -> bool:
        drive.publish(to_bytes(COMMAND.kind, {"linear": [0.25, 0.0, 0.0]}))
        ear.spin_once(0.0)
        return False

    simulator.run(ended, duration_s=DURATION_S)
    spin(lambda: seen.clock and seen.clock[-1] > 0.95e9 * DURATION_S, ear)
    names = [*SHARED, *(f"/{robot}/{name}" for robot in seen.x for name in OWN)]
    seen.publishers = {name: ear.publishers(name) for name in names}
    seen.poses = [robot.live.pose for robot in simulator.robots]
    simulator.reset()
    simulator.run(lambda: simulator.online.t == pytest.approx(0.2))
    seen.reset = tuple(robot.live.t for robot in simulator.robots)
    yield seen
    ear.close()
    bus.close()


def test_each_topic_has_one_publisher_in_the_namespace_of_its_robot(heard: Heard) -> None:
    assert heard.publishers == dict.fromkeys(heard.publishers, 1)


def test_a_command_drives_its_robot_alone(heard: Heard) -> None:
    (x, _, _), still = heard.poses
    assert x > 0.5
    assert still == (0.0, 0.8, 0.0)
    assert heard.x["ann"][-1] > 0.3
    assert abs(heard.x["bob"][-1]) < 0.05


def test_robots_share_one_clock_that_never_goes_back(heard: Heard) -> None:
    before = [t for t in heard.clock if t > 0]
    assert len(before) > 100 * DURATION_S
    assert min(np.diff(before)) > 0
    assert heard.reset == pytest.approx((0.2, 0.2))  # both begin again together


def test_no_frame_of_either_has_two_parents_and_the_map_leaves_odom_to_a_localizer(heard: Heard) -> None:
    parents = {child: parent for parent, child in heard.frames}
    assert len(parents) == len(heard.frames)  # no frame has two parents
    for name in ("ann", "bob"):
        assert f"{name}/odom" not in parents  # a localizer is to publish it
        assert parents[f"{name}/ground_truth"] == "map"
        assert parents[f"{name}/base_footprint"] == f"{name}/base_link"
        assert parents[f"{name}/base_link"] == f"{name}/odom"
        assert parents[f"{name}/magnetometer_link"] == f"{name}/base_link"
    assert all(child.startswith(("ann/", "bob/")) for child in parents)
    assert heard.odometry == {("ann/odom", "ann/base_link"), ("bob/odom", "bob/base_link")}


def test_a_prefix_moves_frames_but_neither_the_map_nor_joints() -> None:
    twin = open_twin("lab", magnetometer="map-only")
    plain = sender_for(twin, "T")
    moved = prefixed(plain, "tb4/")
    assert (moved.map_frame, moved.wheel_joints) == (plain.map_frame, plain.wheel_joints)
    assert moved.base_frame == "tb4/base_link"
    assert [link.name for link in moved.links] == [f"tb4/{link.name}" for link in plain.links]
    assert moved.wheels is not None
    assert moved.wheels[0].parent.startswith("tb4/")
    with pytest.raises(InputError, match="a prefix of frames has letters"):
        Simulator(twin, open_bus("x", backend="cyclonedds", domain=next(DOMAINS)), frame_prefix="/tb4/")
