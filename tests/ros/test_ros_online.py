"""The magnetometer's node with a mixed model that follows its session by late poses."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes import from_message, in_a_domain, spin
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
from magtwin.ros.bus import Bus, Message, Publisher, to_bytes
from magtwin.ros.diagnostics import KIND, Status
from magtwin.ros.inputs import LiveFrames, Scanning
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


class Following:
    """A recorded drive, published row by row with its clock, and a node that follows it."""

    def __init__(self, run: Run, nodes: Callable[..., Bus], lines: list[str]) -> None:
        self.run, self.lines = run, lines
        self.stamps = np.rint((100 + run["t"]) * NS).astype(np.int64)
        self.robot, self.ear, self.bus = nodes("robot"), nodes("ear"), nodes("magnetometer", sim_time=True)
        self.senders: dict[str, Publisher] = {}
        self.read: dict[int, tuple[float, float]] = {}
        self.said: list[dict[str, Status]] = []
        self.ear.subscribe("/diagnostics", KIND, self._diagnosed, MANY)
        self.ear.subscribe("predicted/magnitude", MAGNITUDE.kind, self._heard, MANY)

    def start(self, twin: Twin, *given: str, kind: str = SLAM) -> None:
        """A node with its topics discovered, one period before the first row."""
        topics = {topic.name: topic.kind for topic in (*ROBOT, CLOCK, MAGNITUDE)} | {LATE: kind}
        for name, of in topics.items():
            self.senders[name] = self.robot.publisher(name, of, Qos(depth=100))
            spin(lambda name=name: self.bus.types(name), self.bus)
        values = settings(PARAMETERS, ("use_sim_time:=true", f"rate_hz:={RATE_HZ}", "lidar:=off", *given))
        self.node = Magnetometer(twin, self.bus, values, online=LATE, say=self.lines.append)
        spin(lambda: all(sender.subscribers() for sender in self.senders.values()), self.bus)
        spin(lambda: self.ear.publishers("predicted/magnitude"), self.ear)
        assert self.node.online is not None
        self.online = self.node.online
        self.tick(int(self.stamps[0]) - NS // RATE_HZ)

    def tell(self, row: int, topics: tuple[Topic, ...] = (*ROBOT, MAGNITUDE)) -> None:
        """The messages of a row."""
        c, stamp = self.run.take(slice(row, row + 1)), self.stamps[row : row + 1]
        for topic in topics:
            fields = topic.write(c, stamp, Sender())
            if topic.name == COMMAND.name:
                twist = {"twist.linear": [c["v_cmd"][0], 0, 0], "twist.angular": [0, 0, c["w_cmd"][0]]}
                fields = {"header.stamp": stamp, **twist}
            one = {n: v[0] if isinstance(v, np.ndarray) and len(v) == 1 else v for n, v in fields.items()}
            self.senders[topic.name].publish(to_bytes(topic.kind, one))

    def play(self, rows: range, poses: Callable[[int], None] | None = None) -> None:
        """Rows of the drive; the pose of a row is sent `DELAY_S` later, by `poses`."""
        late = round(DELAY_S * NS)
        for row in rows:
            now = int(self.stamps[row])
            then = int(np.searchsorted(self.stamps, now - 0.05 * NS - late + 1000)) - 1
            if poses is not None and then >= 0:
                self.tick(int(self.stamps[then]) + late)
                poses(then)
            self.tell(row)
            self.tick(now)

    def pose(self, row: int, kind: str = SLAM, *, frame: str = "map", sd_m: float = 0.0) -> None:
        """Send the pose of a row, in one of the types, until the node has it."""
        prefix, before = "pose." if kind == SLAM else "pose.pose.", self.online.heard
        fields: dict[str, Any] = {
            "header.stamp": self.stamps[row],
            "header.frame_id": frame,
            f"{prefix}position": self.run["mocap_p"][row],
            f"{prefix}orientation": self.run["mocap_q_xyzw"][row],
        }
        if sd_m:
            fields["pose.covariance"] = np.diag([sd_m**2] * 6).ravel()
        self.senders[LATE].publish(to_bytes(kind, fields))
        spin(lambda: self.online.heard > before, self.bus)

    def tick(self, now_ns: int) -> None:
        self.senders[CLOCK.name].publish(to_bytes(CLOCK.kind, {"clock": np.int64(now_ns)}))
        spin(lambda: self.bus.now_ns() == now_ns, self.bus)
        self.ear.spin_once(0.0)

    def status(self) -> Status:
        """The next status of the late poses."""
        before = len(self.said)
        self.tick(self.bus.now_ns() + 2 * NS)
        spin(lambda: len(self.said) > before, self.bus, self.ear)
        return self.said[-1][f"input {LATE}"]

    def _heard(self, message: Message) -> None:
        fields = message.read(["header.stamp", "magnetic_field", "magnetic_field_covariance"])
        sd = float(np.sqrt(fields["magnetic_field_covariance"][0]))
        self.read[int(fields["header.stamp"])] = float(fields["magnetic_field"][0]) * 1e9, sd * 1e9

    def _diagnosed(self, message: Message) -> None:
        self.said.append({s.name.partition(": ")[2]: s for s in from_message(message)})


@pytest.fixture
def following(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> Iterator[Following]:
    monkeypatch.setattr("magtwin.ros.diagnostics.LEAST_S", 0.0)  # the clock runs faster than the wall
    with in_a_domain() as node:
        yield Following(drive.run, node, [])


@pytest.mark.parametrize(("kind", "sd_m"), [(SLAM, 0.0), ("nav_msgs/msg/Odometry", 0.05)])
def test_online_readings_are_those_of_the_recorded_run(
    drive: Drive, following: Following, kind: str, sd_m: float
) -> None:
    following.start(drive.twin, kind=kind)
    following.play(range(drive.run.rows), lambda row: following.pose(row, kind, sd_m=sd_m))
    spin(lambda: len(following.read) == drive.run.rows, following.ear)
    nt, sd_nt = np.array([following.read[int(stamp)] for stamp in following.stamps]).T

    model, field = load_predictor(drive.weights), drive.twin.field
    run = Run({**drive.run, "t": drive.run["t"] - drive.run["t"][0]}, {})
    direct = read_online(model, run, field, delay_s=DELAY_S, pose_sd_m=sd_m)
    labels = labelled(run, field, ARM)
    noise_nt = drive.twin.scene.robot.magnetometer.noise_density_nt * np.sqrt(RATE_HZ / 2)
    np.testing.assert_allclose(nt - labels["b_map_nt"], direct.disturbance_nt, atol=0.01)
    np.testing.assert_allclose(sd_nt, np.hypot(direct.sd_nt, noise_nt), atol=0.01)  # also of its widening

    late = run["t"] > run["t"][-1] - 30
    error = np.abs(nt - run["b_measured_nt"])[late].mean()
    before = NeuralMagnetometer(model).read([labels])[0].disturbance_nt - labels["label_nt"]
    assert error < 0.7 * np.abs(before)[late].mean()
    status = following.status()
    assert status.level == "ok"
    assert status.values["poses used"] == str((run.rows - 10 * RATE_HZ) // 2)  # at most 4 Hz
    assert float(status.values["median age [s]"]) == pytest.approx(DELAY_S, abs=0.01)
    assert status.values["interval factor"] != "1.00"


def test_with_a_latency_a_pose_is_joined_with_the_reading_that_much_later(
    drive: Drive, following: Following
) -> None:
    model = load_predictor(drive.weights)
    model.metadata = {**model.metadata, "latency_s": 1 / RATE_HZ}
    following.start(replace(drive.twin, magnetometer=NeuralMagnetometer(model)))
    following.play(range(40))
    following.pose(20)
    following.play(range(40, 42))
    spin(lambda: int(following.stamps[41]) in following.read, following.ear)

    direct = OnlineMagnetometer(model, drive.twin.field, lever_arm_m=ARM.lever_arm_m)
    yaw = yaw_from_quat(drive.run["mocap_q_xyzw"])

    def at(row: int) -> tuple[float, Any, float, dict[str, Any]]:
        """The time of a row since the first with a pose, the pose before it, and its signals."""
        t = float(drive.run["t"][row] - drive.run["t"][1])
        signals = {name: drive.run[name][row] for name in direct.signals if name != "t"}
        return t, drive.run["mocap_p"][row - 1, :2], float(yaw[row - 1]), signals | {"t": t}

    assert direct.update(*at(21), float(drive.run["b_measured_nt"][21]))
    nt = direct.read(*at(41)).b_total_nt
    assert min(following.read) == following.stamps[1]
    assert following.read[int(following.stamps[41])][0] == pytest.approx(nt, abs=0.01)


def test_poses_that_cannot_be_used_are_reported_with_their_reasons(
    drive: Drive, following: Following
) -> None:
    following.start(drive.twin, "buffer_s:=5", "map_frame:=vicon")
    following.play(range(64))
    now = int(following.stamps[63])
    following.pose(56, frame="odom")
    following.pose(10, frame="vicon")
    following.stamps[70] = now + NS
    following.pose(70, frame="vicon")
    for row in range(80, 96):
        following.stamps[row] = now + (row - 79) * NS // RATE_HZ
        following.tell(row, (POSE, MAGNITUDE))  # no other input
        following.tick(int(following.stamps[row]))
    following.pose(95, frame="vicon")
    status = following.status()
    assert (status.level, status.values["poses used"]) == ("warn", "0")
    told = "; ".join(said[f"input {LATE}"].message for said in following.said)
    for reason in (
        "were in frame 'odom', and the map is in 'vicon'",
        "were older than the buffer of 5 s",
        "were ahead of this node's clock",
        "had no fresh /robot/odom",
    ):
        assert f"1 poses {reason}" in told
        assert any(f"{LATE}: poses {reason}" in line for line in following.lines)
    following.stamps[63] = following.bus.now_ns()  # no reading is that new
    following.pose(63, frame="vicon")
    assert "1 poses had no measured field within 0.1 s" in following.status().message
    following.tick(following.bus.now_ns() + 31 * NS)
    assert "no pose was used for" in following.status().message


def test_after_a_jump_back_the_effects_are_those_of_the_model(drive: Drive, following: Following) -> None:
    following.start(drive.twin)
    following.play(range(40))
    start = following.online.magnetometer.effects.mean.copy()
    following.pose(20, frame="/map")
    assert following.online.used == 1
    assert "following the session by poses 2.4 s old" in following.lines
    assert np.abs(following.online.magnetometer.effects.mean - start).max() > 1
    following.stamps -= 50 * NS
    following.play(range(8))
    np.testing.assert_array_equal(following.online.magnetometer.effects.mean, start)


def test_a_type_that_is_no_pose_is_reported(drive: Drive, following: Following) -> None:
    sender = following.robot.publisher(LATE, "std_msgs/msg/String", Qos())
    spin(lambda: following.bus.types(LATE), following.bus)
    node = Magnetometer(drive.twin, following.bus, settings(PARAMETERS, ()), online=LATE)
    assert node.online is not None
    told = node.online.status(following.bus.now_ns())
    assert (told.level, "published as std_msgs/msg/String; readable:" in told.message) == ("stale", True)
    assert not sender.subscribers()


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
    nodes: Callable[..., Bus], kind: str, field: dict[str, Any], nt: float | None
) -> None:
    bus = nodes("node")
    measured = Measured(bus, MAGNITUDE, frames=LiveFrames(bus), max_age_s=1.0)
    now = bus.now_ns()
    stamp = {} if kind.startswith("std") else {"header.stamp": np.int64(now)}
    measured._hear(Message(kind, to_bytes(kind, {**field, **stamp}), 0, 0))
    assert measured.nearest(now) == (nt if nt is None else pytest.approx(nt))
    assert measured.nearest(now + NS) is None
    assert measured.broken == (nt is None)


def test_histories_last_as_long_as_they_are_told(
    nodes: Callable[..., Bus], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = nodes("node")
    measured = Measured(bus, MAGNITUDE, frames=LiveFrames(bus), max_age_s=1.0, history_s=8.0)
    for k in range(200):
        fields = {"header.stamp": np.int64(k * NS // 20), "magnetic_field": [(40e3 + k) * 1e-9, 0, 0]}
        measured._hear(Message(MAGNITUDE.kind, to_bytes(MAGNITUDE.kind, fields), 0, 0))
    assert measured.nearest(round(2.52 * NS)) == pytest.approx(40e3 + 50)
    assert measured.nearest(round(2.53 * NS)) == pytest.approx(40e3 + 51)
    assert measured.nearest(round(1.5 * NS)) is None

    scans = Scanning(bus, SCAN, gap_s=0.5, history_s=10.0)
    for t in (1.0, 1.2, 5.0):
        monkeypatch.setattr(bus, "now_ns", lambda t=t: round(t * NS))
        scans._hear(Message(SCAN.kind, b"", 0, 0))
    spun = [scans.on(round(t * NS)) for t in (0.9, 1.1, 1.6, 1.8, 4.9, 5.4, 5.6)]
    assert spun == [False, True, True, False, False, True, False]


@pytest.mark.parametrize(
    ("kind", "options", "text"),
    [
        ("mlp", {}, "kind 'mlp' has no effects of a session; take the one that ships"),
        (None, {}, "this magnetometer has no network"),
        ("mixed", {"measured": "predicted/magnitude"}, "is published by this node; name the topic of a real"),
        ("mixed", {"online": "a pose"}, "is not a topic's name"),
        ("mixed", {"online": None, "measured": "b"}, "`measured` is of use only with `online`"),
    ],
)
def test_what_cannot_be_followed_is_refused(
    twin: Twin, nodes: Callable[..., Bus], kind: str | None, options: dict[str, Any], text: str
) -> None:
    if kind is not None:
        twin = replace(twin, magnetometer=NeuralMagnetometer(a_predictor(kind, FEATURES)))
    with pytest.raises(InputError, match=text):
        Magnetometer(twin, nodes("node"), settings(PARAMETERS, ()), **{"online": LATE, **options})


def test_the_command_refuses_in_its_flags(
    nodes: Callable[..., Bus], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["ros", "magnetometer", "lab", "--measured", "b", "--domain", str(nodes.domain)])  # type: ignore[attr-defined]
    assert "--measured is of use only with --online" in capsys.readouterr().err
