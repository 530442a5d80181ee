"""The localizer as a node, and a node as a localizer."""

import math
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes import from_message, spin

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw, rotate, wrap_angle, yaw_from_quat
from magtwin.io.bags.topics import CLOCK, COMMAND, MAGNITUDE, ODOMETRY, TF, Qos
from magtwin.io.bags.types import typestore
from magtwin.localization.problem import Prior
from magtwin.localization.track import LocalizerError
from magtwin.ros.bus import Message, to_bytes
from magtwin.ros.commands import command_bytes
from magtwin.ros.diagnostics import KIND
from magtwin.ros.localization.localize import PARAMETERS, LocalizerNode
from magtwin.ros.localization.poses import (
    CLOUD,
    CLOUD_KIND,
    ESTIMATE,
    INITIAL,
    POSE_KIND,
    cloud_bytes,
    pose_bytes,
    prior_from,
    read_pose,
)
from magtwin.ros.parameters import settings
from magtwin.ros.simulate import Simulator
from magtwin.run.run import Run
from magtwin.tasks.localizing import live_problem, localization, localize, new_localizer
from magtwin.twin import Twin, simulate

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

NS = 10**9
MANY = Qos(depth=1000)
Nodes = Any
"""As `nodes` of conftest.py."""


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The particle filter that `magtwin new` writes."""
    folder = tmp_path_factory.mktemp("method")
    new_localizer(folder / "live_filter.py")
    sys.path.insert(0, str(folder))
    yield "live_filter:MyLocalizer"
    sys.path.remove(str(folder))


def poses(heard: list[Message]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, poses and covariances of estimates."""
    read = [read_pose(message) for message in heard]
    return (
        np.array([stamp / NS for stamp, *_ in read]),
        np.array([pose for _, _, pose, _ in read]),
        np.array([np.full((3, 3), np.nan) if c is None else c for *_, c in read]),
    )


def test_a_simulated_drive_is_localized_live_as_offline(nodes: Nodes, twin: Twin, method: str) -> None:
    told = ["prior:=0,0,0", "use_sim_time:=true", "cloud_hz:=2", "tf_broadcast:=false"]
    bus, ear, robot = nodes("localizer", sim_time=True), nodes("ear"), nodes("robot")
    rows: list[Run] = []
    sim = Simulator(twin, robot, seed=3, speed=3.0)
    read = sim.online.read
    sim.online.read = lambda: (rows.append(read()), rows[-1])[1]  # type: ignore[method-assign]
    spin(lambda: bus.types(MAGNITUDE.name) and bus.types(ODOMETRY.name), bus)
    values = settings(PARAMETERS, told)
    problem = live_problem(twin, seed=4)
    node = LocalizerNode(twin, bus, values, method=method, options={"particles": 300}, problem=problem)
    heard: list[Message] = []
    clouds: list[Message] = []
    ear.subscribe(ESTIMATE, POSE_KIND, heard.append, MANY)
    ear.subscribe(CLOUD, CLOUD_KIND, clouds.append, MANY)
    commands = ear.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    spin(lambda: commands.subscribers() and sim._publishers[MAGNITUDE.name].subscribers(), ear, robot)
    spin(lambda: ear.publishers(ESTIMATE), ear)

    def others() -> bool:
        if len(commands_at) <= sim.online.t / 0.2:
            commands_at.append(sim.online.t)
            commands.publish(command_bytes(COMMAND.kind, 0.2, 0.35, 0))
        bus.spin_once(0.0)
        return False

    commands_at: list[float] = []
    sim.run(others, duration_s=9.0)
    for _ in range(20):
        bus.spin_once(0.01)
        ear.spin_once(0.01)
    t, pose, covariance = poses(heard)
    whole = Run.concat([part for part in rows if part.rows])
    whole = whole.take(whole["t"] > t[0] - 1e-6)  # it begins with the first reading that has odometry
    offline = localization(
        whole, twin.field, method=method, options={"particles": 300}, prior="0,0,0", seed=4
    )
    assert len(t) >= 43
    np.testing.assert_allclose(t, offline.track.t[: len(t)], atol=1e-9)
    np.testing.assert_allclose(pose[:, :2], offline.track.pose[: len(t), :2], atol=1e-7)
    np.testing.assert_allclose(wrap_angle(pose - offline.track.pose[: len(t)])[:, 2], 0, atol=1e-7)
    np.testing.assert_allclose(covariance, offline.track.covariance[: len(t)], atol=1e-9)
    assert np.hypot(*(pose[-1] - offline.truth[len(t) - 1])[:2]) < 0.3
    assert node.latencies_s
    assert 10 <= len(clouds) <= 20


def test_a_node_elsewhere_is_benchmarked_as_the_method_that_it_runs(
    nodes: Nodes, twin: Twin, method: str
) -> None:
    run = simulate(twin, "figure8", seed=2, duration_s=8.0)
    bus = nodes("localizer", sim_time=True)
    values = settings(PARAMETERS, ["use_sim_time:=true", "tf_broadcast:=false"])
    LocalizerNode(twin, bus, values, method=method, options={"particles": 200}, problem=live_problem(twin))
    stop = threading.Event()

    def live() -> None:
        while not stop.is_set():
            bus.spin_once(0.01)

    thread = threading.Thread(target=live)
    thread.start()
    try:
        options = {"domain": nodes.domain, "backend": "cyclonedds", "timeout_s": 10.0}
        far = [localize(run, twin.field, method="ros", options=options) for _ in range(2)]
    finally:
        stop.set()
        thread.join()
    here = localize(run, twin.field, method=method, options={"particles": 200})
    for name in ("est_p_world_base", "est_yaw", "est_covariance", "est_lost"):
        for other in far:  # the second run restarts the node's time
            np.testing.assert_allclose(other[name], here[name], atol=1e-7)


def test_without_the_node_its_benchmark_fails_in_time_with_the_reason(nodes: Nodes, twin: Twin) -> None:
    run = simulate(twin, "figure8", seed=2, duration_s=2.0)
    options = {"domain": nodes.domain, "backend": "cyclonedds", "connect_s": 0.3}
    with pytest.raises(LocalizerError, match=r"nobody publishes /robot/estimate/pose after 0.3 s"):
        localize(run, twin.field, method="ros", options=options)
    answer = nodes("silent")
    answer.publisher(ESTIMATE, POSE_KIND, Qos())
    for topic, kind in (
        (ODOMETRY.name, ODOMETRY.kind),
        (MAGNITUDE.name, MAGNITUDE.kind),
        (INITIAL, POSE_KIND),
    ):
        answer.subscribe(topic, kind, lambda message: None, MANY)
    options |= {"connect_s": 10.0, "timeout_s": 0.2}
    with pytest.raises(LocalizerError, match=r"no estimate with the stamp of this reading within 0.2 s"):
        localize(run, twin.field, method="ros", options=options)


class Hand:
    """A robot whose messages the test sends, and a localizer that hears it."""

    def __init__(self, nodes: Nodes, twin: Twin, *told: str) -> None:
        self.robot, self.bus = nodes("robot"), nodes("localizer", sim_time=True)
        self.senders = {
            topic: self.robot.publisher(topic.name, topic.kind, MANY)
            for topic in (CLOCK, ODOMETRY, MAGNITUDE)
        }
        self.initial = self.robot.publisher(INITIAL, POSE_KIND, Qos())
        self.heard, self.tf, self.said, self.lines = (
            list[Message](),
            list[Message](),
            list[Message](),
            list[str](),
        )
        self.robot.subscribe(ESTIMATE, POSE_KIND, self.heard.append, MANY)
        self.robot.subscribe(TF.name, TF.kind, self.tf.append, MANY)
        self.robot.subscribe("/diagnostics", KIND, self.said.append, MANY)
        spin(lambda: self.bus.types(ODOMETRY.name) and self.bus.types(MAGNITUDE.name), self.bus)
        values = settings(PARAMETERS, ("use_sim_time:=true", *told))
        problem = live_problem(twin)
        self.node = LocalizerNode(
            twin, self.bus, values, method="odometry", problem=problem, say=self.lines.append
        )
        spin(lambda: all(p.subscribers() for p in (*self.senders.values(), self.initial)), self.bus)
        spin(lambda: self.robot.publishers(ESTIMATE), self.robot)
        self.t = 5.0

    def tick(
        self, times: int = 1, *, field: bool = True, x: float = 0.0, step_s: float = 0.2, b_t: float = 4.2e-5
    ) -> None:
        for _ in range(times):
            self.t += step_s
            now = np.int64(round(self.t * NS))
            pose = {"pose.pose.position": [x, 0.0, 0.0], "pose.pose.orientation": quat_from_yaw(0.0)}
            self.senders[ODOMETRY].publish(to_bytes(ODOMETRY.kind, {"header.stamp": now, **pose}))
            if field:
                reading = {"header.stamp": now, "magnetic_field": [b_t, 0, 0]}
                self.senders[MAGNITUDE].publish(to_bytes(MAGNITUDE.kind, reading))
            self.senders[CLOCK].publish(to_bytes(CLOCK.kind, {"clock": now}))
            spin(lambda now=now: self.bus.now_ns() == now, self.bus)
            self.robot.spin_once(0.005)

    def settle(self) -> None:
        for _ in range(10):
            self.bus.spin_once(0.002)
            self.robot.spin_once(0.002)

    def set_pose(self, x: float, y: float, yaw: float) -> None:
        before = len(self.lines)
        self.initial.publish(pose_bytes(0, "map", (x, y, yaw), np.diag([0.04, 0.04, 0.01])))
        spin(lambda: len(self.lines) > before, self.bus)


def test_a_pose_on_initialpose_starts_the_method_and_starts_it_again(nodes: Nodes, twin: Twin) -> None:
    hand = Hand(nodes, twin)
    hand.tick(3)
    hand.settle()
    assert not hand.heard
    assert "no estimate: no pose on /initialpose yet" in hand.lines
    for x, y, yaw in ((1.0, 0.5, 0.3), (-1.0, 0.2, -2.0)):
        hand.set_pose(x, y, yaw)
        hand.tick(2)
        hand.settle()
        _, pose, covariance = poses(hand.heard)
        np.testing.assert_allclose(pose[-1], [x, y, yaw], atol=1e-6)
        np.testing.assert_allclose(covariance[-1].diagonal()[:2], 0.04, rtol=1e-2)
    hand.initial.publish(pose_bytes(0, "odom", (0.0, 0.0, 0.0), None))
    spin(lambda: any("'odom' is ignored" in line for line in hand.lines), hand.bus)


def test_map_to_odom_puts_base_link_at_the_estimate(nodes: Nodes, twin: Twin) -> None:
    hand = Hand(nodes, twin, "prior:=1,0.5,0.3")
    hand.tick(3, x=0.7)
    hand.settle()
    names = [f"transforms.0.{name}" for name in ("header.frame_id", "child_frame_id")]
    read = hand.tf[-1].read([*names, "transforms.0.transform.translation"])
    assert [read[name] for name in names] == ["map", "odom"]
    _, pose, _ = poses(hand.heard)
    origin = read["transforms.0.transform.translation"]
    np.testing.assert_allclose(
        origin[:2] + rotate(quat_from_yaw(0.3), [0.7, 0, 0])[:2], pose[-1, :2], atol=1e-9
    )


def test_while_the_magnetometer_is_silent_odometry_is_used_alone(nodes: Nodes, twin: Twin) -> None:
    hand = Hand(nodes, twin, "prior:=1,0.5,0.3")
    hand.tick(3)
    hand.settle()
    before = len(hand.heard)
    hand.tick(10, field=False, x=0.4)
    hand.settle()
    assert len(hand.heard) >= before + 5
    _, pose, _ = poses(hand.heard)
    np.testing.assert_allclose(pose[-1, :2], [1 + 0.4 * math.cos(0.3), 0.5 + 0.4 * math.sin(0.3)], atol=1e-6)
    levels = {s.name: s for message in hand.said for s in from_message(message)}
    assert "gives no field: odometry alone" in levels["localizer: estimates"].message


def test_the_newest_message_with_a_field_before_a_tick_is_the_reading(nodes: Nodes, twin: Twin) -> None:
    hand = Hand(nodes, twin, "prior:=1,0.5,0.3")
    hand.tick()
    for _ in range(6):  # the last of four messages before each tick holds no field
        hand.tick(3, step_s=0.05)
        hand.tick(step_s=0.05, b_t=math.nan)
    hand.settle()
    t, *_ = poses(hand.heard)
    np.testing.assert_allclose(t, [5.2, *(5.2 + 0.2 * np.arange(6) + 0.15)], atol=1e-6)
    hand.tick(8, step_s=0.05, b_t=math.nan)  # no field at all: the last message before each tick
    hand.settle()
    t, *_ = poses(hand.heard)
    np.testing.assert_allclose(t[7:], [6.6, 6.8], atol=1e-6)


def test_time_that_jumps_back_begins_anew(nodes: Nodes, twin: Twin) -> None:
    hand = Hand(nodes, twin, "prior:=1,0.5,0.3")
    hand.tick(3, x=0.5)
    hand.t = 1.0
    hand.tick(3)
    hand.settle()
    t, pose, _ = poses(hand.heard)
    assert t[-1] == pytest.approx(1.6)
    np.testing.assert_allclose(pose[-1], [1, 0.5, 0.3], atol=1e-6)
    assert any("time jumped back" in line for line in hand.lines)


@pytest.mark.parametrize("frame", ["map", "a_map", ""])
def test_a_cloud_is_a_pose_array_to_the_reference_reader(frame: str) -> None:
    cloud = np.column_stack([np.arange(6.0), -np.arange(6.0), np.linspace(-3, 3, 6), np.full(6, 1 / 6)])
    read = typestore().deserialize_cdr(cloud_bytes(3_000_000_007, frame, cloud, 4), CLOUD_KIND)
    assert (read.header.frame_id, read.header.stamp.sec, read.header.stamp.nanosec) == (frame, 3, 7)
    assert [pose.position.x for pose in read.poses] == [0.0, 2.0, 3.0, 5.0]
    q = [[getattr(pose.orientation, k) for k in "xyzw"] for pose in read.poses]
    np.testing.assert_allclose(yaw_from_quat(np.array(q)), cloud[[0, 2, 3, 5], 2], atol=1e-12)
    whole = typestore().deserialize_cdr(cloud_bytes(0, frame, cloud, 500), CLOUD_KIND)
    assert len(whole.poses) == 6


def test_a_pose_crosses_with_its_covariance_and_zeros_are_unknown() -> None:
    covariance = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.02]])
    data = pose_bytes(5, "map", (1.0, -2.0, 3.0), covariance)
    stamp, frame, pose, back = read_pose(Message(POSE_KIND, data, 0, 0))
    assert (stamp, frame) == (5, "map")
    np.testing.assert_allclose(pose, [1, -2, 3], atol=1e-12)
    np.testing.assert_array_equal(back, covariance)
    assert read_pose(Message(POSE_KIND, pose_bytes(5, "map", (1.0, -2.0, 3.0), None), 0, 0))[3] is None
    assert prior_from(Message(POSE_KIND, data, 0, 0))[1].sd == pytest.approx(np.sqrt(covariance.diagonal()))
    assert isinstance(prior_from(Message(POSE_KIND, data, 0, 0))[1], Prior)
    with pytest.raises(InputError, match="not finite"):
        prior_from(Message(POSE_KIND, pose_bytes(5, "map", (math.nan, 0.0, 0.0), None), 0, 0))


def test_a_smoother_and_a_wrong_prior_are_refused(nodes: Nodes, twin: Twin) -> None:
    bus, problem = nodes("localizer"), live_problem(twin)
    with pytest.raises(InputError, match="prior is wait, global or x,y,yaw"):
        LocalizerNode(twin, bus, settings(PARAMETERS, ["prior:=here"]), method="odometry", problem=problem)
    with pytest.raises(InputError, match="did you mean 'odometry'"):
        LocalizerNode(twin, bus, settings(PARAMETERS, []), method="odometri", problem=problem)


def test_the_method_ros_is_known_by_name(tmp_path: Path) -> None:
    from magtwin.localization.localizers import load_localizer

    with pytest.raises(InputError, match="timeout_s of the localizer ros must be above 0 s"):
        load_localizer("ros", {"timeout_s": 0.0})
