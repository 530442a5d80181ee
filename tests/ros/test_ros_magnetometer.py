"""The magnetometer's node: what it reads, and what it does when its inputs fail."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from nodes import DOMAINS, from_message, spin
from test_predictor import a_predictor

from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.frames import into_base, quat_from_yaw
from magtwin.io.bags.topics import BATTERY, CLOCK, IMU, MAGNITUDE, ODOMETRY, POSE, Qos, Topic
from magtwin.learn.data.features import SETS
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.ros.bus import Bus, Message, Publisher, Subscription, open_bus, to_bytes
from magtwin.ros.diagnostics import KIND, Status
from magtwin.ros.inputs import GRAVITY, Gravity, Input, LiveFrames
from magtwin.ros.magnetometer import PARAMETERS, Magnetometer
from magtwin.ros.parameters import settings
from magtwin.run.run import Run
from magtwin.twin import Twin, open_twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

NS = 10**9
TICK_S = 1 / 125


@pytest.fixture(scope="module")
def twin() -> Twin:
    return open_twin(shipped("scenes", "lab", "lab.usda"))


class World:
    """A robot whose every message and every tick of whose clock the test sends, and a node that hears it."""

    def __init__(self, twin: Twin, domain: int) -> None:
        self.twin, self.domain = twin, domain
        self.robot = self.bus("robot")
        topics = (CLOCK, POSE, ODOMETRY, IMU, BATTERY)
        self.senders = {topic: self.send_on(topic) for topic in topics}
        self.ear = self.bus("ear")
        self.readings: list[Message] = []
        self.totals: list[Message] = []
        self.said: list[dict[str, Status]] = []
        many = Qos(depth=1000)
        self.ear.subscribe(MAGNITUDE.name, MAGNITUDE.kind, self.readings.append, many)
        self.ear.subscribe("qtfm/total_field_nt", "std_msgs/msg/Float64", self.totals.append, many)
        self.ear.subscribe("/diagnostics", KIND, self._hear, many)
        self.t, self.pose, self.begun = 5.0, (0.2, 0.1, 0.7), 0.0
        self.nodes: list[Magnetometer] = []
        self.lines: list[str] = []

    def bus(self, name: str, **rest: object) -> Bus:
        bus = open_bus(name, backend="cyclonedds", domain=self.domain, **rest)  # type: ignore[arg-type]
        self.buses = [*getattr(self, "buses", []), bus]
        return bus

    def send_on(self, topic: Topic) -> Publisher:
        return self.robot.publisher(topic.name, topic.kind, Qos(depth=100))

    def start(self, *given: str) -> Bus:
        """A node, which has found all that is offered."""
        values = settings(PARAMETERS, ("use_sim_time:=true", "rate_hz:=125", "lidar:=off", *given))
        bus = self.bus("magnetometer", sim_time=True)
        for topic in self.senders:
            spin(lambda topic=topic: bus.types(topic.name), bus)
        node = Magnetometer(self.twin, bus, values, say=self.lines.append)
        self.nodes.append(node)
        spin(lambda: all(p.subscribers() for p in self.senders.values()), bus)
        spin(lambda: self.ear.types(MAGNITUDE.name), self.ear)
        return bus

    def tick(self, bus: Bus, times: int = 1, *, quiet: tuple[Topic, ...] = (), ahead_s: float = 0.0) -> None:
        """Let time go on, with a message of each topic at each tick but those that are quiet."""
        for _ in range(times):
            self.t += TICK_S
            for topic in (POSE, ODOMETRY, IMU, BATTERY):
                if topic not in quiet:
                    self.send(topic, ahead_s=ahead_s)
            now = round(self.t * NS)
            self.senders[CLOCK].publish(to_bytes(CLOCK.kind, {"clock": np.int64(now)}))
            spin(lambda now=now: bus.now_ns() == now, bus)
            self.ear.spin_once(0.0)

    def send(self, topic: Topic, *, ahead_s: float = 0.0, **over: object) -> None:
        x, y, yaw = self.pose
        fields = {
            POSE: {"pose.position": [x, y, 0.0], "pose.orientation": quat_from_yaw(yaw)},
            ODOMETRY: {
                "pose.pose.orientation": [0, 0, 0, 1],
                "twist.twist.linear": [0.2, 0, 0],
                "twist.twist.angular": [0, 0, 0.1],
            },
            IMU: {"orientation": quat_from_yaw(yaw), "angular_velocity": [0, 0, 0.1]},
            BATTERY: {"voltage": 15.5, "current": -1.0, "percentage": 0.8},
        }[topic]
        stamp = {"header.stamp": np.int64(round((self.t + ahead_s) * NS))}
        self.senders[topic].publish(to_bytes(topic.kind, {**fields, **stamp, **over}))

    def heard(self, bus: Bus) -> int:
        """How many readings have come in all, once none is under way."""
        for _ in range(10):
            self.ear.spin_once(0.002)
        return len(self.readings)

    def diagnose(self, bus: Bus, **how: object) -> dict[str, Status]:
        """What is said next of how the node fares."""
        self.ear.spin_once(0.0)
        before = len(self.said)
        for _ in range(4):
            if len(self.said) > before:
                break
            self.tick(bus, 65, **how)  # type: ignore[arg-type]
            self.heard(bus)
        return self.said[-1]

    def expected(self) -> tuple[float, float]:
        """What map and network say of the messages, and the standard deviation of that [nT]."""
        assert self.twin.magnetometer is not None
        x, y, yaw = self.pose
        b_map, slopes = self.twin.field.lookup_with_gradient(np.array([[x, y]]), np.array([yaw]))
        row = {
            "t": [self.t - self.begun],
            "yaw": [yaw],
            "v_cmd": [0.0],
            "w_cmd": [0.0],
            "odom_v": [[0.2, 0, 0]],
            "odom_w": [[0, 0, 0.1]],
            "imu_q_xyzw": [quat_from_yaw(yaw)],
            "imu_w": [[0, 0, 0.1]],
            "imu_a": [[0.0, 0, 0]],
            "battery_v": [15.5],
            "battery_a": [1.0],
            "battery_fraction": [np.float32(0.8)],
            "lidar_on": [False],
            "b_map_gradient_nt_m": into_base(slopes[:, :2], np.array([yaw])),
        }
        run = Run({name: np.array(values) for name, values in row.items()}, {})
        (read,) = self.twin.magnetometer.read([run])  # names no platform: another robot
        noise = self.twin.scene.robot.magnetometer.noise_density_nt * np.sqrt(125 / 2)
        return float(b_map[0] + read.disturbance_nt[0]), float(np.hypot(read.stated_sd_nt[0], noise))

    def _hear(self, message: Message) -> None:
        self.said.append({s.name.removeprefix("magnetometer: "): s for s in from_message(message)})


@pytest.fixture
def world(twin: Twin) -> Iterator[World]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.delenv("CYCLONEDDS_URI", raising=False)
        patch.setattr("magtwin.ros.diagnostics.LEAST_S", 0.0)  # the clock runs faster than the wall
        made = World(twin, next(DOMAINS))
        yield made
        for bus in made.buses:
            bus.close()


def test_a_reading_is_map_and_network_at_what_was_heard(world: World) -> None:
    bus = world.start()
    world.tick(bus, 3)
    assert world.heard(bus) >= 2
    read = world.readings[-1].read(
        ["header.stamp", "header.frame_id", "magnetic_field", "magnetic_field_covariance"]
    )
    assert read["header.stamp"] == round(world.t * NS)
    assert read["header.frame_id"] == "magnetometer_link"
    nt = float(world.totals[-1].read(["data"])["data"])
    expected_nt, expected_sd_nt = world.expected()
    assert nt == pytest.approx(expected_nt, abs=0.01)
    np.testing.assert_allclose(read["magnetic_field"], [1e-9 * nt, 0, 0], rtol=1e-12)
    sd_nt = 1e9 * np.sqrt(read["magnetic_field_covariance"][0])
    assert sd_nt == pytest.approx(expected_sd_nt, rel=1e-6)


def test_a_calibrated_model_is_read_with_the_time_since_the_first_reading(world: World) -> None:
    mixed = a_predictor("mixed", SETS["session"])
    world.twin = replace(world.twin, magnetometer=NeuralMagnetometer(mixed))
    bus = world.start("max_age_s:=5")
    world.tick(bus, 400)
    assert world.heard(bus) >= 2
    world.begun = world.readings[0].read(["header.stamp"])["header.stamp"] / NS
    assert world.t - world.begun > 1
    nt = float(world.totals[-1].read(["data"])["data"])
    assert nt == pytest.approx(world.expected()[0], abs=0.01)


def test_in_nt_it_says_so(world: World) -> None:
    bus = world.start("units:=nT")
    world.tick(bus, 3)
    assert world.heard(bus)
    assert world.readings[-1].read(["magnetic_field"])["magnetic_field"][0] > 2e4
    assert any("published in nT" in line for line in world.lines)


def test_before_its_inputs_it_waits_and_says_for_what(world: World) -> None:
    bus = world.start()
    said = world.diagnose(bus, quiet=(BATTERY,))
    assert not world.heard(bus)
    assert said["readings"].level == "error"
    assert said["readings"].message == "no reading: no fresh /robot/battery_state"
    assert said["input /robot/battery_state"].level == "stale"
    assert said["input /robot/odom"].level == "ok"
    assert said["input /robot/cmd_vel"].message == "no commands: the robot is assumed to stand"
    assert said["input /robot/cmd_vel"].level == "ok"
    world.tick(bus, 3)
    assert world.heard(bus)


def test_a_stale_input_is_never_read_as_fresh_and_what_comes_back_is_read_again(world: World) -> None:
    bus = world.start("max_age_s:=0.1")
    world.tick(bus, 3)
    before, last = world.heard(bus), world.t
    said = world.diagnose(bus, quiet=(ODOMETRY,))
    stamps = [m.read(["header.stamp"])["header.stamp"] / NS for m in world.readings]
    assert len(stamps) > before
    assert max(stamps) <= last + 0.1 + 1e-9
    assert "no fresh /robot/odom" in said["readings"].message
    assert "more than 0.1 s" in said["input /robot/odom"].message
    here = world.heard(bus)
    world.tick(bus, 3)
    assert world.heard(bus) > here
    assert any("reading again" in line for line in world.lines)


def test_outside_the_map_it_is_silent_and_inside_again_it_reads(world: World) -> None:
    bus = world.start()
    world.tick(bus, 3)
    world.pose = (40.0, 0.0, 0.0)
    world.tick(bus, 2)
    before = world.heard(bus)
    said = world.diagnose(bus)
    assert world.heard(bus) == before
    assert "outside the map" in said["readings"].message
    world.pose = (0.0, 0.0, 0.0)
    world.tick(bus, 3)
    assert world.heard(bus) > before


def test_a_message_that_is_no_number_is_not_used(world: World) -> None:
    bus = world.start("max_age_s:=0.05")
    world.tick(bus, 3)
    for _ in range(20):
        world.send(POSE, **{"pose.position": [np.nan, 0.0, 0.0]})
        world.tick(bus, quiet=(POSE,))
    readings = [m.read(["magnetic_field"])["magnetic_field"] for m in world.readings]
    assert np.isfinite(readings).all()
    said = world.diagnose(bus, quiet=(POSE,))
    assert "20 messages could not be used" in said["input /robot/enu/pose"].message


def test_a_message_that_is_cut_short_is_not_used(world: World) -> None:
    bus = world.start()
    world.tick(bus, 3)
    for name, one in world.nodes[0].inputs.items():
        whole = to_bytes(one.topic.kind, {})
        for data in (whole[:9], whole[:40], b"", b"\xff" * len(whole)):  # DDS stops them, not every RMW does
            one._hear(Message(one.topic.kind, data, 0, 0))
        assert one.broken == 4, name
    said = world.diagnose(bus)
    assert world.heard(bus)
    for topic in (POSE, ODOMETRY, IMU, BATTERY):
        assert "messages could not be used" in said[f"input {topic.name}"].message


@pytest.mark.parametrize(
    ("stamp_s", "sent_s", "line"),
    [
        (-3.0, -3.0, "the clock of its sender is 3.0 s behind this machine's: synchronize them (chrony)"),
        (3.0, 3.0, "the clock of its sender is 3.0 s ahead of this machine's: synchronize them (chrony)"),
        (-3.0, 0.0, "its stamps are 3.0 s behind this node's clock when they are sent: correct its driver"),
        (-0.9, -0.9, ""),
    ],
)
def test_a_skewed_clock_is_explained_once_and_does_not_matter_by_arrival(
    world: World, stamp_s: float, sent_s: float, line: str
) -> None:
    bus, lines = world.bus("node"), list[str]()
    one = Input(bus, BATTERY, frames=LiveFrames(bus), max_age_s=0.5, say=lines.append)
    two = Input(bus, BATTERY, frames=LiveFrames(bus), max_age_s=0.5, stamps="arrival", say=lines.append)
    for source in (one, two):
        source._kind = BATTERY.kind
        source._subscription = Subscription(source.name, lambda: 1)
        for _ in range(5):
            now = bus.now_ns()
            fields = {"header.stamp": np.int64(now + round(stamp_s * NS)), "voltage": 15.0}
            sent = now + round(sent_s * NS)
            source._hear(Message(BATTERY.kind, to_bytes(BATTERY.kind, fields), sent, now))
    assert [text.startswith(f"{one.name}: {line}") for text in lines] == ([True] if line else [])
    now = bus.now_ns()
    assert one.fresh(now) is None
    assert line in one.status(now).message
    assert two.fresh(now) is not None
    assert two.status(now).message == "fresh"


def test_a_clock_that_stands_still_is_said_by_the_wall(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("magtwin.ros.diagnostics.WATCH_S", 0.05)
    bus = world.start()

    def told(text: str) -> bool:
        world.ear.spin_once(0.0)
        return bool(world.said) and world.said[-1]["readings"].message == f"no reading: {text}"

    spin(lambda: told("nobody publishes /clock"), bus)
    world.tick(bus, 3)
    before = world.heard(bus)
    spin(lambda: told("/clock stands still"), bus)
    assert world.heard(bus) == before
    world.tick(bus, 3)
    assert world.heard(bus) > before


def test_stamps_from_the_future_wait_until_it_is_their_time(world: World) -> None:
    bus = world.start()
    world.tick(bus, 10, ahead_s=0.5)
    assert not world.heard(bus)
    said = world.diagnose(bus, ahead_s=2.0)
    assert "ahead of" in said["input /robot/enu/pose"].message


def test_an_input_that_comes_back_in_another_type_is_told_of(world: World) -> None:
    topic = replace(BATTERY, name="/robot/pack")
    bus, first, again = (world.bus(name) for name in ("node", "first", "again"))
    one = Input(bus, topic, frames=LiveFrames(bus), max_age_s=1.0)
    first.publisher(topic.name, topic.kind, topic.qos)
    spin(lambda: one.look() or one._subscription, bus)
    world.buses.remove(first)
    first.close()
    again.publisher(topic.name, "std_msgs/msg/Float64", topic.qos)
    told = "nothing received yet; published as std_msgs/msg/Float64 now: restart this node"
    spin(lambda: one.look() or one.status(bus.now_ns()).message == told, bus)


def test_where_time_jumps_back_it_begins_anew(world: World) -> None:
    bus = world.start()
    world.tick(bus, 5)
    before = world.heard(bus)
    world.t = 1.0
    world.tick(bus, 5)
    assert world.heard(bus) >= before + 3
    stamps = [m.read(["header.stamp"])["header.stamp"] / NS for m in world.readings]
    assert stamps[-1] == pytest.approx(world.t)
    assert any("time jumped back" in line for line in world.lines)


def test_what_a_network_reads_and_no_topic_tells_is_refused(world: World, twin: Twin) -> None:
    physical = open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    bus = world.bus("magnetometer")
    with pytest.raises(InputError, match="is physical, which needs the lab itself"):
        Magnetometer(physical, bus, settings(PARAMETERS, ()))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("rate_hz:=0", "parameter rate_hz must be from 1 to 1000, got 0"),
        ("rate_hz:=nan", "parameter rate_hz must be from 1 to 1000, got nan"),
        ("rate_hz:=fast", "parameter rate_hz is a number, got 'fast'"),
        ("unit:=T", "no parameter 'unit'; did you mean 'units'"),
        ("units:=uT", "parameter units is T or nT, got 'uT'"),
        ("use_sim_time:=1", "parameter use_sim_time is true or false, got '1'"),
        ("rate_hz=5", "a parameter is set by name:=value"),
    ],
)
def test_a_wrong_parameter_is_refused_by_name_and_range(given: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        settings(PARAMETERS, (given,))


def test_gravity_in_accelerations_is_taken_off() -> None:
    q = quat_from_yaw(0.3)[None]
    freed = Gravity().without({"imu_a": np.array([[0.1, 0.0, GRAVITY]]), "imu_q_xyzw": q})
    np.testing.assert_allclose(freed["imu_a"], [[0.1, 0, 0]], atol=1e-12)
    free = Gravity().without({"imu_a": np.array([[0.1, 0.0, 0.2]]), "imu_q_xyzw": q})
    np.testing.assert_array_equal(free["imu_a"], [[0.1, 0.0, 0.2]])
