"""The path follower and the hand as nodes: they drive the twin, and stand where they do not know where."""

import math
import threading
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest
from nodes import from_message, spin

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.io.bags.topics import CLOCK, COMMAND, ODOMETRY, POSE, Qos
from magtwin.path import PATHS, Path
from magtwin.ros.bus import Bus, Message, to_bytes
from magtwin.ros.commands import Commands
from magtwin.ros.diagnostics import KIND, Status
from magtwin.ros.follow import MARKER_M, Follower, MarkerGuide
from magtwin.ros.simulate import Simulator
from magtwin.sim.motion.closed_loop import Chassis, ClosedLoop
from magtwin.sim.motion.controllers import Guide, guide_along
from magtwin.spec.drive import DriveSpec
from magtwin.twin import Twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

NS = 10**9
TICK_S = 0.02
LINE = Path("line", np.array([[0.0, 0.0], [0.3, 0.0], [0.5, 0.1]]))
CORNERED = {
    "figure8": PATHS["figure8"](),
    "corner": Path("corner", np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 0.5]])),
    "rectangle": Path("rectangle", np.array([[0.0, 0.0], [1, 0], [1, 0.6], [0, 0.6], [0, 0]]), True),
    "zigzag": Path("zigzag", np.array([[0, 0], [0.3, 0], [0.1, 0.25], [0.5, 0.3], [0.2, 0.6]])),
}
LATE = 4
"""Steps by which the poses of a marker are late."""


class Ideal:
    """A robot that does at once what it is commanded, and says where it is at each tick of its clock."""

    def __init__(self, nodes: Callable[..., Bus], kind: str = COMMAND.kind) -> None:
        self.bus = nodes("robot")
        self.clock, self.poses, self.twists = (
            self.bus.publisher(t.name, t.kind, Qos(depth=100)) for t in (CLOCK, POSE, ODOMETRY)
        )
        self.kind, self.commands = kind, list[tuple[float, float]]()
        self.bus.subscribe(COMMAND.name, kind, self._hear, Qos(depth=100))
        self.t, self.x, self.y, self.yaw = 3.0, 0.0, 0.0, 0.0
        self.track: list[tuple[float, float]] = []

    def tick(self, follower: Bus, times: int = 1, *, silent: bool = False) -> None:
        for _ in range(times):
            self.t += TICK_S
            stamp = np.int64(round(self.t * NS))
            v, w = self.commands[-1] if self.commands else (0.0, 0.0)
            self.yaw += w * TICK_S
            self.x += v * TICK_S * np.cos(self.yaw)
            self.y += v * TICK_S * np.sin(self.yaw)
            self.track.append((self.x, self.y))
            if not silent:
                place = {
                    "header.stamp": stamp,
                    "pose.position": [self.x, self.y, 0.0],
                    "pose.orientation": quat_from_yaw(self.yaw),
                }
                self.poses.publish(to_bytes(POSE.kind, place))
                moving = {"twist.twist.linear": [v, 0, 0], "twist.twist.angular": [0, 0, w]}
                turned = {"pose.pose.orientation": quat_from_yaw(self.yaw)}
                self.twists.publish(to_bytes(ODOMETRY.kind, {"header.stamp": stamp, **turned, **moving}))
            self.clock.publish(to_bytes(CLOCK.kind, {"clock": stamp}))
            spin(lambda stamp=stamp: follower.now_ns() == stamp, follower)
            self.bus.spin_once(0.001)

    def _hear(self, message: Message) -> None:
        linear, angular = COMMAND.leaves(self.kind)
        read = message.read([linear, angular])
        self.commands.append((float(read[linear][0]), float(read[angular][2])))


def started(robot: Ideal, nodes: Callable[..., Bus], **how: object) -> tuple[Follower, Bus]:
    bus = nodes("follower", sim_time=True)
    for topic in (POSE, ODOMETRY):
        spin(lambda topic=topic: bus.types(topic.name), bus)
    node = Follower(LINE, DriveSpec(), bus, **how)  # type: ignore[arg-type]
    senders = (robot.clock, robot.poses)
    spin(lambda: all(p.subscribers() for p in senders), bus, robot.bus)
    return node, bus


def driven(
    twin: Twin, nodes: Callable[..., Bus], path: Path, *, clock: float, **how: object
) -> tuple[Follower, np.ndarray]:
    """A follower that has driven the twin along a path, and each step's true x, y, yaw."""
    simulator = Simulator(twin, nodes("sim"), session="survey", speed=clock)  # poses without an offset
    bus = nodes("follower", sim_time=True)
    node = Follower(path, twin.scene.robot.drive, bus, **how)  # type: ignore[arg-type]
    track: list[tuple[float, float, float]] = []

    def ended() -> bool:
        track.append(simulator.online.pose)
        return node.done

    most_s = 30.0 + 2 * path.length / 0.2
    simulated = threading.Thread(target=simulator.run, args=(ended,), kwargs={"duration_s": most_s})
    simulated.start()
    while simulated.is_alive():
        bus.spin_once(0.01)
    assert node.done
    return node, np.array(track)


def by_marker(
    path: Path, arm: tuple[float, float], start: tuple[float, float, float], controller: str = "follower"
) -> tuple[Guide, float, np.ndarray]:
    """Drive by late poses of a marker, for at most four times the time of the path.

    Args:
        path: The path.
        arm: Place of the marker in the robot's frame [m].
        start: First pose of the robot.
        controller: As for `guide_along`.

    Returns:
        The guide, the duration [s], and the robot's x, y from when it was on the path [m], shape (K, 2).
    """
    drive = DriveSpec()
    guide = MarkerGuide(guide_along(controller, path, drive, speed=0.2, dt=TICK_S))
    robot = Chassis(ClosedLoop(drive=drive, guide=guide, dt=TICK_S, pose0=start, steps=1))
    poses: deque[tuple[float, float, float]] = deque(maxlen=LATE + 1)
    track: list[tuple[float, float]] = []
    while not guide.done and robot.t < 4 * path.length / 0.2:
        x, y, yaw = robot.pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        poses.append((x + arm[0] * cos - arm[1] * sin, y + arm[0] * sin + arm[1] * cos, yaw))
        robot.step(guide.command(robot.t, *poses[0], *robot.twist))
        if guide.node > 0:
            track.append(robot.pose[:2])
    return guide, robot.t, np.array(track).reshape(-1, 2)


@pytest.mark.parametrize(
    ("name", "controller", "start"),
    [
        ("figure8", "follower", None),
        *((name, "follower", None) for name in ("corner", "rectangle", "zigzag")),
        ("corner", "follower", (0.05, -0.04, math.pi)),
        ("rectangle", "follower", (-0.5, 0.7, 2.0)),
    ],
)
def test_a_path_is_driven_by_a_marker_off_centre(
    name: str, controller: str, start: tuple[float, float, float] | None
) -> None:
    path = CORNERED[name]
    x, y = path.p_xy[0].tolist()
    start = start or (x, y, float(path.heading(0.0)))
    _, centred_s, _ = by_marker(path, (0.0, 0.0), start, controller)
    for reach, turns in ((0.05, 4), (MARKER_M, 8)):
        for angle in np.arange(turns) * 2 * math.pi / turns:
            arm = (reach * math.cos(angle), reach * math.sin(angle))
            guide, seconds, track = by_marker(path, arm, start, controller)
            assert guide.done, arm
            assert seconds < 2 * centred_s
            _, off = path.nearest(track)
            assert np.sqrt(np.mean(off**2)) < reach + 0.01  # the marker is on the path, the robot beside it
            assert np.abs(off).max() < 2 * MARKER_M + 0.01  # as it first turns, or turns at a corner


def test_the_twin_is_driven_along_a_path_over_ros_and_stands_at_its_end(
    twin: Twin, nodes: Callable[..., Bus]
) -> None:
    x, y, yaw = twin.scene.start
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    bend = np.array([[0, 0], [0.2, 0.0], [0.35, 0.05], [0.45, 0.15]])
    path = Path("bend", bend @ turn.T + [x, y])
    lines: list[str] = []
    node, track = driven(twin, nodes, path, clock=2.0, speed=0.25, say=lines.append)
    _, off = path.nearest(track[:, :2])
    assert np.sqrt(np.mean(off**2)) < 0.01  # the standard is 0.06 m
    assert node.rms_m < 0.01
    np.testing.assert_allclose(track[-1, :2], path.p_xy[-1], atol=0.03)
    assert np.ptp(track[-20:], axis=0).max() < 1e-3
    assert lines[-1] == "the end is reached"


@pytest.mark.slow
@pytest.mark.parametrize("name", PATHS)
def test_the_twin_is_driven_around_every_path_over_ros(
    twin: Twin, nodes: Callable[..., Bus], name: str
) -> None:
    path = PATHS[name]()
    node, track = driven(twin, nodes, path, clock=3.0)
    begun = int(np.argmin(np.hypot(*(track[:, :2] - path.p_xy[0]).T)[: len(track) // 3]))
    _, off = path.nearest(track[begun:, :2])
    assert np.sqrt(np.mean(off**2)) < 0.06
    assert node.rms_m < 0.06
    _, missed = Path("driven", track[begun:, :2]).nearest(path.p_xy)
    assert missed.max() < 0.1  # all of it was driven


def test_without_a_fresh_pose_it_stands_and_then_drives_on(nodes: Callable[..., Bus]) -> None:
    robot = Ideal(nodes)
    node, bus = started(robot, nodes)
    robot.tick(bus, 60)
    assert robot.commands[-1][0] > 0.1
    robot.tick(bus, 20, silent=True)
    assert robot.commands[-1] == (0.0, 0.0)
    here = robot.x
    robot.tick(bus, 25)
    assert max(v for v, _ in robot.commands[-20:]) > 0.1
    assert robot.x > here
    assert not node.done


def test_where_time_jumps_back_the_path_begins_anew(nodes: Callable[..., Bus]) -> None:
    robot = Ideal(nodes)
    node, bus = started(robot, nodes)
    robot.tick(bus, 100)
    assert robot.x > 0.2
    robot.t, robot.x, robot.y, robot.yaw = 0.1, 0.0, 0.0, 0.0  # as after a reset
    robot.track.clear()
    while not node.done and robot.t < 10:
        robot.tick(bus, 5)
    assert node.laps == 1
    assert min(x for x, _ in robot.track) > -0.01
    np.testing.assert_allclose((robot.x, robot.y), LINE.p_xy[-1], atol=0.03)


def test_another_who_commands_the_robot_is_told_of(nodes: Callable[..., Bus]) -> None:
    robot, said = Ideal(nodes), list[Status]()
    robot.bus.subscribe("/diagnostics", KIND, lambda m: said.extend(from_message(m)), Qos(depth=100))
    nodes("other").publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    _, bus = started(robot, nodes)
    robot.tick(bus, 60)
    spin(lambda: said, robot.bus)
    assert said[0].level == "warn"
    assert said[0].message == "driving; 1 others command the robot too"


def test_an_open_path_is_driven_back_and_forth(nodes: Callable[..., Bus]) -> None:
    robot = Ideal(nodes)
    node, bus = started(robot, nodes, laps=2, speed=0.3)
    while not node.done and robot.t < 30:
        robot.tick(bus, 5)
    assert node.laps == 2
    assert max(x for x, _ in robot.track) > 0.45
    np.testing.assert_allclose((robot.x, robot.y), LINE.p_xy[0], atol=0.03)
    assert node.rms_m < 0.02


def test_a_path_is_driven_with_stamped_commands(nodes: Callable[..., Bus]) -> None:
    robot = Ideal(nodes, "geometry_msgs/msg/TwistStamped")
    node, bus = started(robot, nodes, speed=0.3, commands="TwistStamped")
    while not node.done and robot.t < 20:
        robot.tick(bus, 5)
    np.testing.assert_allclose((robot.x, robot.y), LINE.p_xy[-1], atol=0.03)


@pytest.mark.parametrize(
    ("kinds", "distribution", "wanted"),
    [
        (["Twist"], "jazzy", "Twist"),
        (["TwistStamped"], "humble", "TwistStamped"),
        (["Twist", "TwistStamped"], "jazzy", "TwistStamped"),
        (["Twist", "TwistStamped"], "humble", "Twist"),
        (["Twist", "TwistStamped"], "", "Twist"),
    ],
)
def test_commands_have_the_type_that_the_robot_subscribes_to(
    nodes: Callable[..., Bus],
    monkeypatch: pytest.MonkeyPatch,
    kinds: list[str],
    distribution: str,
    wanted: str,
) -> None:
    monkeypatch.setenv("ROS_DISTRO", distribution)
    robot, hand = nodes("robot"), nodes("hand")
    heard: list[Message] = []
    for kind in kinds:
        robot.subscribe(COMMAND.name, f"geometry_msgs/msg/{kind}", heard.append, Qos())
    spin(lambda: len(hand.wants(COMMAND.name)) == len(kinds), hand)
    commands = Commands(hand)
    spin(lambda: commands.send(0.2, 0.1) or heard, hand, robot)
    assert {m.kind for m in heard} == {f"geometry_msgs/msg/{wanted}"}


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"laps": 0}, "laps must be 1 or more"),
        ({"source": "gps"}, "no source 'gps'"),
        ({"speed": 9.0}, "speed must be above 0"),
        ({"controller": "folower"}, "did you mean 'follower'"),
    ],
)
def test_what_cannot_be_driven_is_refused(nodes: Callable[..., Bus], how: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Follower(LINE, DriveSpec(), nodes("follower"), **how)


def test_a_simulated_robot_is_told_from_a_real_one_by_its_stamps(nodes: Callable[..., Bus]) -> None:
    robot, lines = Ideal(nodes), list[str]()
    bus = nodes("follower")
    for topic in (POSE, ODOMETRY):
        spin(lambda topic=topic: bus.types(topic.name), bus)
    Follower(LINE, DriveSpec(), bus, say=lines.append)
    spin(robot.poses.subscribers, bus)
    for _ in range(3):
        place = {"header.stamp": np.int64(3 * NS), "pose.orientation": quat_from_yaw(0.0)}
        robot.poses.publish(to_bytes(POSE.kind, place))
    spin(lambda: any("of another clock (--sim-time" in line for line in lines), bus)
    assert not robot.commands
