"""The simulator as a node: what is recorded over ROS is what happened; it obeys, and says how it fares."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from nodes import from_message, in_a_domain, spin

from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import decode
from magtwin.io.bags.topics import COMMAND, LATCHED, MAGNITUDE, ODOMETRY, Qos
from magtwin.io.bags.types import layout
from magtwin.io.formats import read_run
from magtwin.ros.bus import Bus, Message, to_bytes
from magtwin.ros.commands import command_bytes
from magtwin.ros.diagnostics import KIND, Status, to_fields
from magtwin.ros.record import Player, Recorder
from magtwin.ros.simulate import RESET, Simulator
from magtwin.run.run import Run
from magtwin.sim.runs.simulate import simulate
from magtwin.twin import Twin, in_session, model_error_of, open_twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

SEED = 5
DURATION_S = 6.0


@pytest.fixture(scope="module")
def twin() -> Twin:
    return open_twin(shipped("scenes", "lab", "lab.usda"))


@dataclass
class Driven:
    """A simulated robot that was driven over ROS, and what was recorded of that."""

    node: Simulator
    bag: Path
    run: Run
    said: list[Status]


def command(v: float, w: float) -> bytes:
    return to_bytes(COMMAND.kind, {"linear": [v, 0.0, 0.0], "angular": [0.0, 0.0, w]})


@pytest.fixture(scope="module")
def driven(twin: Twin, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    """A robot that is driven for some seconds, at twice real time."""
    with in_a_domain() as node:
        return _driven(twin, node, tmp_path_factory.mktemp("recorded") / "bag")


def _driven(twin: Twin, node: Callable[..., Bus], bag: Path) -> Driven:
    simulator = Simulator(twin, node("sim"), seed=SEED, speed=2.0, lidar="on")
    listener, hand = node("recorder", sim_time=True), node("hand")
    writer = RawBagWriter(bag)
    recorder = Recorder(listener, writer)
    said: list[Status] = []
    hand.subscribe("/diagnostics", KIND, lambda m: said.extend(from_message(m)), Qos())
    drive = hand.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    recorder.run(duration_s=0.2)
    spin(drive.subscribers, hand)
    simulated = threading.Thread(target=simulator.run, kwargs={"duration_s": DURATION_S})
    sent = [time.monotonic()]

    def ended() -> bool:
        if time.monotonic() - sent[-1] > 0.06 and len(sent) < 30:
            sent.append(time.monotonic())
            drive.publish(command(0.25, 0.6 * np.sin(0.2 * len(sent))))
        hand.spin_once(0.0)
        return not simulated.is_alive()

    simulated.start()
    recorder.run(ended)
    recorder.run(duration_s=0.2)
    writer.close()
    return Driven(simulator, bag, read_run(bag), said)


def test_what_is_recorded_over_ros_is_the_direct_run_of_its_commands(driven: Driven, twin: Twin) -> None:
    net = twin.magnetometer
    assert net is not None
    twin = in_session(twin, seed=SEED)
    direct = simulate(
        twin.scene,
        driven.node.online.commands,
        anomaly_map=twin.field,
        rng=np.random.default_rng(SEED),
        duration_s=DURATION_S,
        lidar="on",
        network=True,
        finish=lambda sensed: sensed.predicted(
            lambda run: (net.read([run])[0].disturbance_nt, net.read([run])[0].sd_nt),
            model_error_of(twin, SEED),
        ),
        obstacles=twin.obstacles,
    )
    run = driven.run
    assert run.rows == direct.rows
    assert np.ptp(direct["p_world_base"][:, 0]) > 0.1
    resolution = twin.scene.robot.magnetometer.resolution_nt
    for name in direct.keys() - {"b_sd_nt", "flag_out_of_distribution"}:
        coarse = name in ("b_model_error_nt", "b_measured_nt", "b_noise_nt", "b_vector_measured_nt")
        np.testing.assert_allclose(
            run[name],
            direct[name],
            rtol=1e-12,
            atol=2.01 * resolution if coarse else 1e-10,
            err_msg=name,
        )


def test_every_topic_is_said_at_its_rate(driven: Driven, twin: Twin) -> None:
    with Bag(driven.bag) as bag:
        counts = {name: len(messages) for name, messages in bag.messages(bag.kinds).items()}
    robot = twin.scene.robot
    rates = {
        "/robot/qtfm/magnitude": robot.magnetometer.rate_hz,
        "/robot/qtfm/field": robot.magnetometer.rate_hz,
        "/robot/qtfm/total_field_nt": robot.magnetometer.rate_hz,
        "/clock": robot.magnetometer.rate_hz,
        "/robot/odom": robot.drive.odometry_rate_hz,
        "/robot/imu": robot.imu.rate_hz,
        "/robot/enu/pose": robot.mocap.rate_hz,
        "/robot/scan": robot.lidar.scan_rate_hz,
        "/tf": 62.0,
        "/robot/joint_states": 62.0,
    }
    for name, rate in rates.items():
        assert counts[name] == pytest.approx(rate * DURATION_S, rel=0.02, abs=2.0), name
    assert counts["/tf_static"] == counts["/robot/robot_description"] == 1


def test_samples_are_stamped_by_when_they_were_taken_and_say_what_the_run_holds(driven: Driven) -> None:
    with Bag(driven.bag) as bag:
        messages = bag.messages([ODOMETRY.name])[ODOMETRY.name]
    read = decode(layout(ODOMETRY.kind), messages, ["header.stamp", "pose.pose.position"])
    k = np.rint(read["header.stamp"] * 62e-9)
    np.testing.assert_allclose(read["header.stamp"], k / 62 * 1e9, atol=1)
    np.testing.assert_array_equal(np.diff(k), 1)
    held = np.unique(driven.run["odom_p"], axis=0)
    said = np.unique(read["pose.pose.position"], axis=0)
    assert len(held) > 100
    assert not set(map(tuple, held)) - set(map(tuple, said))


def test_without_commands_for_half_a_second_the_robot_stops(driven: Driven) -> None:
    t, v = driven.run["t"], driven.run["v_base"][:, 0]
    assert v.max() > 0.2
    assert not v[t > t[-1] - 0.5].any()  # the last command was sent long before


def test_fields_are_in_tesla_and_beside_them_in_nt(twin: Twin, nodes: Callable[..., Bus]) -> None:
    simulator, ear = Simulator(twin, nodes("sim"), speed=4.0), nodes("ear")
    heard: dict[str, list[Message]] = {"T": [], "nT": []}
    ear.subscribe(MAGNITUDE.name, MAGNITUDE.kind, heard["T"].append, MAGNITUDE.qos)
    ear.subscribe("/robot/qtfm/total_field_nt", "std_msgs/msg/Float64", heard["nT"].append, Qos())
    spin(lambda: ear.types(MAGNITUDE.name), ear)
    simulator.run(lambda: ear.spin_once(0.0) or len(heard["nT"]) > 5)
    (tesla,), nt = heard["T"][:1], heard["nT"][0].read(["data"])["data"]
    read = tesla.read(["magnetic_field", "magnetic_field_covariance", "header.frame_id"])
    assert read["header.frame_id"] == "magnetometer_link"
    assert 2e-5 < read["magnetic_field"][0] < 7e-5
    assert read["magnetic_field"][0] * 1e9 == pytest.approx(nt, abs=1e-6)
    assert twin.magnetometer is not None


def test_a_reset_begins_anew_from_the_same_seed(twin: Twin, nodes: Callable[..., Bus]) -> None:
    lines: list[str] = []
    simulator = Simulator(twin, nodes("sim"), seed=SEED, speed=4.0, say=lines.append)
    hand = nodes("hand", sim_time=True)
    heard: list[float] = []
    hand.subscribe("/robot/qtfm/total_field_nt", "std_msgs/msg/Float64",
                   lambda m: heard.append(float(m.read(["data"])["data"])), Qos(depth=500))  # fmt: skip
    knob = hand.publisher(RESET, "std_msgs/msg/Empty", Qos())
    spin(lambda: knob.subscribers() and hand.types("qtfm/total_field_nt"), hand)
    times: list[float] = []
    asked = [False]

    def ended() -> bool:
        hand.spin_once(0.0)
        times.append(simulator.online.t)
        if simulator.online.t > 0.8 and not asked[0]:
            asked[0] = True
            knob.publish(to_bytes("std_msgs/msg/Empty", {}))
        return bool(lines) and simulator.online.t > 0.5

    simulator.run(ended)
    spin(lambda: len(heard) > 150, hand)
    assert min(np.diff(times)) < -0.5
    assert lines == ["reset: the robot is at its start, time is 0"]
    begin = next(k for k in range(60, len(heard)) if heard[k : k + 20] == heard[:20])
    assert begin > 80


def test_a_command_that_is_no_number_is_not_obeyed_and_said(twin: Twin, nodes: Callable[..., Bus]) -> None:
    simulator, hand, other = Simulator(twin, nodes("sim"), speed=2.0), nodes("hand"), nodes("other")
    said: list[Status] = []
    hand.subscribe("/diagnostics", KIND, lambda m: said.extend(from_message(m)), Qos())
    pair = [n.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos) for n in (hand, other)]
    spin(lambda: all(p.subscribers() for p in pair), hand, other)

    def ended() -> bool:
        pair[0].publish(command(np.nan, 0.0))
        hand.spin_once(0.0)
        return bool(said)

    simulator.run(ended)
    assert said[0].level == "warn"
    assert "commands were not finite" in said[0].message
    assert "2 publishers on /robot/cmd_vel" in said[0].message
    assert simulator.online.commands.rows[:, 1:].any() == np.False_


@pytest.mark.parametrize("kind", ["Twist", "TwistStamped"])
def test_commands_of_both_types_are_obeyed(twin: Twin, nodes: Callable[..., Bus], kind: str) -> None:
    simulator, hand = Simulator(twin, nodes("sim"), speed=4.0), nodes("hand")
    drive = hand.publisher(COMMAND.name, f"geometry_msgs/msg/{kind}", COMMAND.qos)
    spin(drive.subscribers, hand)

    def ended() -> bool:
        drive.publish(command_bytes(drive.kind, 0.25, 0.0, 0))
        return bool(simulator.online.commands.rows[:, 1:].any())

    simulator.run(ended, duration_s=20.0)
    driven = simulator.online.commands.rows[:, 1:].tolist()
    assert [0.25, 0.0] in driven
    assert all(row in ([0.0, 0.0], [0.25, 0.0]) for row in driven)


def test_diagnostics_say_what_they_were_given() -> None:
    said = [Status("a", "warn", "hot", {"temperature": "90", "limit": "80"}), Status("b", "ok", "")]
    message = Message(KIND, to_bytes(KIND, to_fields(said, 7, "robot")), 0, 0)
    assert from_message(message) == said
    assert message.read(["header.stamp"])["header.stamp"] == 7


def test_a_run_is_said_again_as_its_robot_said_it(
    driven: Driven, nodes: Callable[..., Bus], tmp_path: Path
) -> None:
    part = driven.run.between(1.0, 2.0)
    player = Player(part, nodes("player"))
    listener = nodes("recorder")
    writer = RawBagWriter(tmp_path / "again.mcap")
    recorder = Recorder(listener, writer)
    said = threading.Thread(target=player.run, kwargs={"speed": 2.0})
    said.start()
    recorder.run(lambda: not said.is_alive())
    recorder.run(duration_s=0.2)
    writer.close()
    again = read_run(tmp_path / "again.mcap")
    assert again.rows == part.rows
    for name in ("t", "b_measured_nt", "odom_p", "imu_w", "p_world_base"):
        np.testing.assert_allclose(again[name], part[name], rtol=1e-12, err_msg=name)
    assert again.metadata == part.metadata


def test_a_recording_of_nothing_leaves_nothing(nodes: Callable[..., Bus], tmp_path: Path) -> None:
    writer = RawBagWriter(tmp_path / "bag")
    Recorder(nodes("recorder"), writer).run(duration_s=0.1)
    writer.close()
    assert not list(tmp_path.iterdir())


def test_a_speed_that_is_none_is_refused(twin: Twin, nodes: Callable[..., Bus]) -> None:
    with pytest.raises(InputError, match="speed must be above 0"):
        Simulator(twin, nodes("sim"), speed=0.0)


def test_what_is_latched_reaches_who_comes_late(twin: Twin, nodes: Callable[..., Bus]) -> None:
    Simulator(twin, nodes("sim"), speed=4.0).run(duration_s=0.2)
    ear, heard = nodes("late"), list[Message]()
    ear.subscribe("robot_description", "std_msgs/msg/String", heard.append, LATCHED)
    spin(lambda: heard, ear)
    assert "<robot" in heard[0].read(["data"])["data"]
