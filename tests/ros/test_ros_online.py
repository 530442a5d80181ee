"""The magnetometer's node with a mixed model: calibrated before a drive, or following it by late poses."""

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes import DOMAINS, from_message, spin
from test_predictor import a_predictor

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.frames import yaw_from_quat
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.topics import BATTERY, CLOCK, COMMAND, IMU, MAGNITUDE, ODOMETRY, POSE, SCAN, Qos, Topic
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.features import CIRCULAR, GRADIENT, LAGS
from magtwin.learn.data.labels import labelled
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.online import OnlineMagnetometer, read_online
from magtwin.learn.models.predictor import load_predictor
from magtwin.ros.bus import Bus, Message, Publisher, open_bus, to_bytes
from magtwin.ros.diagnostics import KIND, Status
from magtwin.ros.inputs import Scanning
from magtwin.ros.magnetometer import PARAMETERS, Magnetometer
from magtwin.ros.online import Measured
from magtwin.ros.parameters import settings
from magtwin.run.run import Run
from magtwin.twin import Twin, open_twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

NS = 10**9
RATE_HZ = 8
DELAY_S = 9.95
"""Age of late poses; no row is that old, so that rounding decides nothing."""

ARM = Alignment((0.055, -0.03))
"""Lever arm of the labels."""

FEATURES = (*CIRCULAR, *GRADIENT, *LAGS, "warm_100")
"""Inputs that need every topic, the map and the time, and that few sessions suffice for."""

LATE = "/slam/pose"
SLAM = "geometry_msgs/msg/PoseStamped"
ROBOT = (POSE, ODOMETRY, IMU, BATTERY, replace(COMMAND, kind="geometry_msgs/msg/TwistStamped"))
MANY = Qos(depth=1000)


@dataclass
class Drive:
    """A recorded drive of a plant that no model saw, and a mixed model of other sessions."""

    twin: Twin
    weights: Path
    run: Run


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    folder = tmp_path_factory.mktemp("mixed")
    twin = open_twin("lab", network="none")
    runs = {}
    counts = {"nominal": 8, "hysteresis:1": 4, "warm-up:2": 4, "nonlinear:3": 4, "moving-part:4": 4}
    for plant, count in counts.items():
        swept = mt.sweep(twin, seeds=count, sessions=count, plant=plant, duration_s=120, rate_hz=RATE_HZ)
        runs |= {f"{plant[:4]}_{k}": run for k, run in enumerate(swept)}
    data = mt.build_dataset(runs, out=folder / "set", anomaly_map=twin.field, alignment=ARM)
    weights = folder / "mixed.safetensors"
    mt.train(data, out=weights, model="mixed", features=FEATURES, seed=0)
    path = mt.simulate(twin, "random", seed=76, plant="all", duration_s=80, rate_hz=RATE_HZ, lidar="off")
    told = [name for topic in (*ROBOT, MAGNITUDE) for name in topic.needs]  # no truth, as on a robot
    return Drive(open_twin("lab", network=weights), weights, Run(dict(path.select(*told, "lidar_on")), {}))


class Robot:
    """Publishes a recorded drive row by row, and its clock; hears what a node makes of it."""

    def __init__(self, run: Run, domain: int) -> None:
        self.run, self.domain = run, domain
        self.stamps = np.rint((100 + run["t"]) * NS).astype(np.int64)
        self.buses: list[Bus] = []
        self.robot, self.ear = self.bus("robot"), self.bus("ear")
        self.senders: dict[str, Publisher] = {}
        for topic in (*ROBOT, CLOCK):
            self.sends(topic.name, topic.kind)
        self.read: dict[int, tuple[float, float]] = {}
        self.said: list[dict[str, Status]] = []
        self.ear.subscribe("/diagnostics", KIND, self._diagnosed, MANY)

    def bus(self, name: str, **rest: Any) -> Bus:
        self.buses.append(open_bus(name, backend="cyclonedds", domain=self.domain, **rest))
        return self.buses[-1]

    def sends(self, name: str, kind: str) -> None:
        self.senders[name] = self.robot.publisher(name, kind, Qos(depth=100))

    def hears(self, name: str) -> None:
        self.ear.subscribe(name, MAGNITUDE.kind, self._heard, MANY)

    def tick(self, now_ns: int) -> None:
        self.senders[CLOCK.name].publish(to_bytes(CLOCK.kind, {"clock": np.int64(now_ns)}))

    def tell(self, row: int, topics: tuple[Topic, ...] = ROBOT) -> None:
        """The messages of a row."""
        c = {name: values[row : row + 1] for name, values in self.run.items()}
        for topic in topics:
            stamp = self.stamps[row : row + 1]
            if topic.name == COMMAND.name:
                zero = np.zeros(1)
                turn = np.column_stack([zero, zero, c["w_cmd"]])
                fields = {"twist.linear": np.column_stack([c["v_cmd"], zero, zero]), "twist.angular": turn}
                fields["header.stamp"] = stamp
            else:
                fields = topic.write(c, stamp, Sender())
            one = {
                name: value[0] if isinstance(value, np.ndarray) and value.shape[:1] == (1,) else value
                for name, value in fields.items()
            }
            self.senders[topic.name].publish(to_bytes(topic.kind, one))

    def late_pose(self, row: int, kind: str = SLAM, *, frame: str = "map", sd_m: float = 0.0) -> None:
        """The pose of a row, in one of the types."""
        prefix = "pose." if kind == SLAM else "pose.pose."
        fields: dict[str, Any] = {
            "header.stamp": self.stamps[row],
            "header.frame_id": frame,
            f"{prefix}position": self.run["mocap_p"][row],
            f"{prefix}orientation": self.run["mocap_q_xyzw"][row],
        }
        if sd_m:
            fields["pose.covariance"] = np.diag([sd_m**2] * 6).ravel()
        self.senders[LATE].publish(to_bytes(kind, fields))

    def _heard(self, message: Message) -> None:
        fields = message.read(["header.stamp", "magnetic_field", "magnetic_field_covariance"])
        sd = float(np.sqrt(fields["magnetic_field_covariance"][0]))
        self.read[int(fields["header.stamp"])] = float(fields["magnetic_field"][0]) * 1e9, sd * 1e9

    def _diagnosed(self, message: Message) -> None:
        self.said.append({s.name.partition(": ")[2]: s for s in from_message(message)})


@pytest.fixture
def robot(drive: Drive) -> Iterator[Robot]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.delenv("CYCLONEDDS_URI", raising=False)
        patch.setattr("magtwin.ros.diagnostics.LEAST_S", 0.0)  # the clock runs faster than the wall
        made = Robot(drive.run, next(DOMAINS))
        yield made
        for bus in made.buses:
            bus.close()


@dataclass
class Following:
    """A node that follows the drive of a robot."""

    robot: Robot
    node: Magnetometer
    bus: Bus

    def play(self, rows: range, poses: Callable[[int], None] | None = None, *, measured: bool = True) -> None:
        """Rows of the drive; the pose of a row is sent `DELAY_S` later, by `poses`."""
        robot, late = self.robot, round(DELAY_S * NS)
        for row in rows:
            now = int(robot.stamps[row])
            then = int(np.searchsorted(robot.stamps, now - 0.05 * NS - late + 1000)) - 1
            if poses is not None and then >= 0:
                self.tick(int(robot.stamps[then]) + late)
                self.send(lambda then=then: poses(then))
            robot.tell(row, (*ROBOT, MAGNITUDE) if measured else ROBOT)
            self.tick(now)

    def send(self, pose: Callable[[], None]) -> None:
        """A late pose, until the node has it."""
        assert self.node.online is not None
        before = self.node.online.poses.heard
        pose()
        spin(lambda: self.node.online.poses.heard > before, self.bus)

    def tick(self, now: int) -> None:
        self.robot.tick(now)
        spin(lambda: self.bus.now_ns() == now, self.bus)
        self.robot.ear.spin_once(0.0)

    def status(self, name: str = f"online {LATE}") -> Status:
        """The next status."""
        before = len(self.robot.said)
        self.tick(self.bus.now_ns() + 2 * NS)
        spin(lambda: len(self.robot.said) > before, self.bus, self.robot.ear)
        return self.robot.said[-1][name]


def follow(
    robot: Robot, twin: Twin, *given: str, kind: str = SLAM, lines: list[str] | None = None
) -> Following:
    """A node with its topics discovered, one period before the first row."""
    for name, of in ((LATE, kind), (MAGNITUDE.name, MAGNITUDE.kind)):
        robot.sends(name, of)
    bus = robot.bus("magnetometer", sim_time=True)
    for name in robot.senders:
        spin(lambda name=name: bus.types(name), bus)
    values = settings(PARAMETERS, ("use_sim_time:=true", f"rate_hz:={RATE_HZ}", "lidar:=off", *given))
    say = lambda text: lines.append(text) if lines is not None else None  # noqa: E731
    node = Magnetometer(twin, bus, values, online=LATE, say=say)
    spin(lambda: all(sender.subscribers() for sender in robot.senders.values()), bus)
    robot.hears("predicted/magnitude")
    spin(lambda: robot.ear.publishers("predicted/magnitude"), robot.ear)
    following = Following(robot, node, bus)
    following.tick(int(robot.stamps[0]) - NS // RATE_HZ)
    return following


@pytest.mark.parametrize(("kind", "sd_m"), [(SLAM, 0.0), ("nav_msgs/msg/Odometry", 0.05)])
def test_online_readings_are_those_of_the_recorded_run(
    drive: Drive, robot: Robot, kind: str, sd_m: float
) -> None:
    following = follow(robot, drive.twin, kind=kind)
    following.play(range(drive.run.rows), lambda row: robot.late_pose(row, kind, sd_m=sd_m))
    spin(lambda: len(robot.read) == drive.run.rows, robot.ear)
    nt, sd_nt = np.array([robot.read[int(stamp)] for stamp in robot.stamps]).T

    model, field = load_predictor(drive.weights), drive.twin.field
    run = Run({**drive.run, "t": drive.run["t"] - drive.run["t"][0]}, {})
    direct = read_online(model, run, field, delay_s=DELAY_S, pose_sd_m=sd_m)
    labels = labelled(run, field, ARM)
    noise_nt = drive.twin.scene.robot.magnetometer.noise_density_nt * np.sqrt(RATE_HZ / 2)
    np.testing.assert_allclose(nt - labels["b_map_nt"], direct.disturbance_nt, atol=0.01)
    np.testing.assert_allclose(sd_nt, np.hypot(direct.sd_nt, noise_nt), atol=0.01)

    late = run["t"] > run["t"][-1] - 30
    error = np.abs(nt - run["b_measured_nt"])[late].mean()
    before = NeuralMagnetometer(model).read([labels])[0].disturbance_nt - labels["label_nt"]
    assert error < 0.7 * np.abs(before)[late].mean()
    poses = following.status()
    assert poses.level == "ok"
    assert poses.values["poses used"] == str((run.rows - 10 * RATE_HZ) // 2)  # at most 4 Hz
    assert float(poses.values["median age [s]"]) == pytest.approx(DELAY_S, abs=0.01)


def test_a_calibrated_model_reads_as_directly(
    drive: Drive, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a recorded drive through `magtwin calibrate` to `magtwin ros magnetometer`, by their commands."""
    drive.run.save(tmp_path / "drive.parquet")
    drive.twin.field.save(tmp_path / "map.usdc")
    today = tmp_path / "today.safetensors"
    files = [str(drive.weights), str(tmp_path / "drive.parquet"), "--map", str(tmp_path / "map.usdc")]
    main(["calibrate", *files, "--duration-s", "60", "--out", str(today)])
    rows = range(120)
    robot.hears(MAGNITUDE.name)
    ended = threading.Event()

    def play() -> None:
        spin(lambda: all(sender.subscribers() for sender in robot.senders.values()), robot.robot)
        spin(lambda: robot.ear.types(MAGNITUDE.name), robot.ear)
        robot.tick(int(robot.stamps[0]) - NS // RATE_HZ)
        for row in rows:
            robot.tell(row)
            robot.tick(int(robot.stamps[row]))
            spin(lambda row=row: row == 0 or int(robot.stamps[row]) in robot.read, robot.ear)
        ended.set()

    def spin_until_played(bus: Bus, duration_s: float | None) -> None:
        spin(ended.is_set, bus)

    monkeypatch.setattr("magtwin.cli.ros.spin", spin_until_played)
    player = threading.Thread(target=play)
    player.start()
    given = ["use_sim_time:=true", f"rate_hz:={RATE_HZ}", "lidar:=off", "--network", str(today)]
    where = ["--backend", "cyclonedds", "--domain", str(robot.domain)]
    main(["ros", "magnetometer", "lab", *given, *where])
    player.join()
    first = int(np.searchsorted(robot.stamps, min(robot.read)))
    run = drive.run.with_columns(t=drive.run["t"] - drive.run["t"][first])
    run = labelled(run, drive.twin.field, ARM)
    direct = NeuralMagnetometer(load_predictor(today)).read([run])[0]
    noise_nt = drive.twin.scene.robot.magnetometer.noise_density_nt * np.sqrt(RATE_HZ / 2)
    heard = [row for row in rows if int(robot.stamps[row]) in robot.read]
    assert len(heard) >= len(rows) - 1
    nt, sd_nt = np.array([robot.read[int(robot.stamps[row])] for row in heard]).T
    np.testing.assert_allclose(nt, (run["b_map_nt"] + direct.disturbance_nt)[heard], atol=0.01)
    np.testing.assert_allclose(sd_nt, np.hypot(direct.sd_nt, noise_nt)[heard], atol=0.01)


def test_with_a_latency_a_pose_is_joined_with_the_reading_that_much_later(drive: Drive, robot: Robot) -> None:
    model = load_predictor(drive.weights)
    model.metadata = {**model.metadata, "latency_s": 1 / RATE_HZ}
    following = follow(robot, replace(drive.twin, magnetometer=NeuralMagnetometer(model)))
    following.play(range(40))
    following.send(lambda: robot.late_pose(20))
    following.play(range(40, 42))
    spin(lambda: int(robot.stamps[41]) in robot.read, robot.ear)

    direct = OnlineMagnetometer(model, drive.twin.field, lever_arm_m=ARM.lever_arm_m)
    yaw = yaw_from_quat(drive.run["mocap_q_xyzw"])

    def at(row: int) -> tuple[float, Any, float, dict[str, Any]]:
        """The time of a row since the first with a pose, the pose before it, and its signals."""
        t = float(drive.run["t"][row] - drive.run["t"][1])
        signals = {name: drive.run[name][row] for name in direct.signals if name != "t"}
        return t, drive.run["mocap_p"][row - 1, :2], float(yaw[row - 1]), signals | {"t": t}

    assert direct.update(*at(21), float(drive.run["b_measured_nt"][21]))
    nt = direct.read(*at(41)).b_total_nt
    assert min(robot.read) == robot.stamps[1]
    assert robot.read[int(robot.stamps[41])][0] == pytest.approx(nt, abs=0.01)


def test_without_poses_for_30_s_there_is_a_warning(drive: Drive, robot: Robot) -> None:
    following = follow(robot, drive.twin)
    following.play(range(80))
    status = following.status()
    assert (status.level, status.message) == ("ok", "no pose yet: the effects are those of the model")
    following.tick(following.bus.now_ns() + 31 * NS)
    status = following.status()
    assert status.level == "warn"
    assert "no pose was used for 44 s" in status.message


def test_a_pose_that_cannot_be_used_is_reported_with_its_reason(drive: Drive, robot: Robot) -> None:
    following = follow(robot, drive.twin, "buffer_s:=5")
    following.play(range(64))
    now = int(robot.stamps[63])
    following.send(lambda: robot.late_pose(10))
    robot.stamps[70] = now + NS
    following.send(lambda: robot.late_pose(70))
    message = following.status().message
    assert "1 poses were older than the buffer of 5 s" in message
    assert "1 poses were ahead of this node's clock" in message

    following.tick(now + 10 * NS)
    robot.stamps[63] = now + 9 * NS  # no input and no reading is that new
    following.send(lambda: robot.late_pose(63))
    assert "1 poses had no measured field within 0.1 s" in following.status().message


def test_a_pose_without_inputs_of_its_time_is_reported(drive: Drive, robot: Robot) -> None:
    following = follow(robot, drive.twin)
    following.play(range(8))
    for row in range(8, 24):
        robot.tell(row, (POSE, MAGNITUDE))
        following.tick(int(robot.stamps[row]))
    following.send(lambda: robot.late_pose(20))
    status = following.status()
    assert "1 poses had no fresh /robot/odom" in status.message
    assert status.values["poses used"] == "0"


def test_poses_in_another_frame_are_refused_unless_it_is_the_maps(drive: Drive, robot: Robot) -> None:
    lines: list[str] = []
    following = follow(robot, drive.twin, "map_frame:=vicon", lines=lines)
    following.play(range(16))
    with pytest.raises(
        InputError, match=r"its poses are in frame 'odom', and the map is in 'vicon'"
    ) as error:
        following.send(lambda: robot.late_pose(4, frame="odom"))
    assert "\n" not in str(error.value)
    following.send(lambda: robot.late_pose(4, frame="/vicon"))
    assert lines == ["following the session by poses 1.4 s old"]
    following.send(lambda: robot.late_pose(8, frame="odom"))
    assert "1 poses were in frame 'odom'" in following.status().message


def test_after_a_jump_back_the_effects_are_those_of_the_model(drive: Drive, robot: Robot) -> None:
    following = follow(robot, drive.twin)
    online = following.node.online
    assert online is not None
    following.play(range(40))
    start = online.effects.mean.copy()
    following.send(lambda: robot.late_pose(20))
    assert online.used == 1
    assert np.abs(online.effects.mean - start).max() > 1
    robot.stamps -= 50 * NS
    following.play(range(8))
    np.testing.assert_array_equal(online.effects.mean, start)


@pytest.mark.parametrize(
    ("kind", "field", "nt"),
    [
        ("sensor_msgs/msg/MagneticField", {"magnetic_field": [4.9e-5, 0, 0]}, 49e3),
        ("sensor_msgs/msg/MagneticField", {"magnetic_field": [3e-5, 0, -4e-5]}, 50e3),
        ("sensor_msgs/msg/MagneticField", {"magnetic_field": [4.9e4, 0, 0]}, 49e3),
        ("std_msgs/msg/Float64", {"data": 4.9e4}, 49e3),
        ("std_msgs/msg/Float64", {"data": 4.9e-5}, 49e3),
        ("std_msgs/msg/Float64", {"data": 0.0}, None),
        ("std_msgs/msg/Float64", {"data": np.nan}, None),
    ],
)
def test_the_measured_field_is_read_in_any_type_and_unit(
    robot: Robot, kind: str, field: Mapping[str, Any], nt: float | None
) -> None:
    measured = Measured(robot.robot, MAGNITUDE.name)
    stamp = {} if kind.startswith("std") else {"header.stamp": np.int64(robot.robot.now_ns())}
    measured._hear(Message(kind, to_bytes(kind, {**field, **stamp}), 0, 0))
    now = robot.robot.now_ns()
    assert measured.nearest(now) == (nt if nt is None else pytest.approx(nt))
    assert measured.nearest(now + NS) is None
    assert ("could not be used" in measured.status(now).message) == (nt is None)


def test_the_nearest_reading_counts_and_old_ones_are_dropped(robot: Robot) -> None:
    measured = Measured(robot.robot, MAGNITUDE.name)
    measured.history_s = 1.0
    for k in range(40):
        fields = {"header.stamp": np.int64(k * NS // 20), "magnetic_field": [(40e3 + k) * 1e-9, 0, 0]}
        measured._hear(Message(MAGNITUDE.kind, to_bytes(MAGNITUDE.kind, fields), 0, 0))
    assert measured.nearest(round(1.52 * NS)) == pytest.approx(40e3 + 30)
    assert measured.nearest(round(1.53 * NS)) == pytest.approx(40e3 + 31)
    assert measured.nearest(round(0.5 * NS)) is None


def test_a_lidar_spins_as_long_as_it_did(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = Scanning(robot.robot, SCAN, gap_s=0.5)
    scans.history_s = 10.0
    for t in (1.0, 1.2, 5.0):
        monkeypatch.setattr(robot.robot, "now_ns", lambda t=t: round(t * NS))
        scans._hear(Message(SCAN.kind, b"", 0, 0))
    spun = [scans.on(round(t * NS)) for t in (0.9, 1.1, 1.6, 1.8, 4.9, 5.4, 5.6)]
    assert spun == [False, True, True, False, False, True, False]


def test_at_the_border_of_the_map_a_clamped_reading_is_that_of_the_border(drive: Drive, robot: Robot) -> None:
    following = follow(robot, drive.twin, "outside:=clamp")
    robot.run = drive.run.with_columns(mocap_p=drive.run["mocap_p"] + [40.0, 0, 0])
    following.play(range(8))
    spin(lambda: robot.read, robot.ear)
    assert all(2e4 < nt < 9e4 for nt, _ in robot.read.values())


@pytest.mark.parametrize(
    ("kind", "options", "text"),
    [
        ("mlp", {}, "kind 'mlp' has no effects of a session; train one with --model mixed"),
        (None, {}, "this magnetometer has no network"),
        ("mixed", {"measured": "predicted/magnitude"}, "is published by this node; name the topic of a real"),
        ("mixed", {"online": "a pose"}, "is not a topic's name"),
        ("mixed", {"online": None, "measured": "b"}, "`measured` is of use only with `online`"),
    ],
)
def test_what_cannot_be_followed_is_refused_in_a_line(
    drive: Drive, robot: Robot, kind: str | None, options: dict[str, Any], text: str
) -> None:
    if kind is None:
        twin = open_twin("lab", magnetometer="map-only")
    else:
        twin = replace(drive.twin, magnetometer=NeuralMagnetometer(a_predictor(kind, FEATURES)))
    with pytest.raises(InputError, match=text) as error:
        Magnetometer(twin, robot.bus("node"), settings(PARAMETERS, ()), **{"online": LATE, **options})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["online", "measured"])
def test_a_type_that_is_not_supported_is_refused_in_a_line(drive: Drive, robot: Robot, name: str) -> None:
    robot.sends("odd", "std_msgs/msg/String")
    bus = robot.bus("node")
    spin(lambda: bus.types("odd"), bus)
    with pytest.raises(InputError, match=f"`{name}=/robot/odd` is published as std_msgs/msg/String; supp"):
        Magnetometer(drive.twin, bus, settings(PARAMETERS, ()), **{"online": LATE, name: "odd"})


def test_the_command_refuses_in_its_flags(robot: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["ros", "magnetometer", "lab", "--measured", "b", "--domain", str(robot.domain)])
    assert "--measured is of use only with --online" in capsys.readouterr().err
