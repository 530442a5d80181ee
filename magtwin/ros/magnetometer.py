"""The magnetometer as a node: predicts its readings from map, network and the robot's other sensors.

It runs with any source of its inputs: the real robot, Isaac Sim, or magtwin's simulator. At each step it
joins the newest message of every input whose stamp is not ahead of its clock, as a Run does. It publishes a
reading only if all of them are fresh and the map covers the place. Otherwise it reports on /diagnostics
what is missing, and resumes when that is back.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import canonical, into_base, yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import sender_of
from magtwin.io.bags.topics import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    POSE,
    SCAN,
    TOTAL_FIELD,
    Topic,
)
from magtwin.ros.bus import Bus, Timer, to_bytes
from magtwin.ros.diagnostics import Level, Reporter, status_of
from magtwin.ros.inputs import Input, Scanning
from magtwin.ros.network import read_rows
from magtwin.ros.parameters import Parameter
from magtwin.run.run import Run
from magtwin.twin import Twin

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Reader, Reading

PARAMETERS: Mapping[str, Parameter] = MappingProxyType(
    {
        "rate_hz": Parameter(135.0, "rate of readings [Hz]", 1.0, 1000.0),
        "units": Parameter("T", "unit of the field: T, or nT like APRILab's robot", words=("T", "nT")),
        "use_sim_time": Parameter(False, "use the time of /clock"),
        "max_age_s": Parameter(0.5, "age at which pose, odometry and IMU are stale [s]", 0.01, 60.0),
        "battery_max_age_s": Parameter(30.0, "age at which the battery's state is stale [s]", 0.1, 3600.0),
        "lidar": Parameter(
            "scan",
            "whether the LiDAR spins: while scans arrive, always (on) or never (off)",
            words=("scan", "on", "off"),
        ),
        "outside": Parameter(
            "silent", "outside the map: no reading, or the reading at its border", words=("silent", "clamp")
        ),
    }
)
"""Parameters of the node."""

INPUTS: tuple[Topic, ...] = (POSE, ODOMETRY, IMU, BATTERY, COMMAND)
"""Its possible inputs, beside scans."""

_ALWAYS = frozenset(("mocap_p", "mocap_q_xyzw"))
"""Columns that are always read, for the map."""

MADE = frozenset(("t", "yaw", "b_map_nt", "b_map_gradient_nt_m", "lidar_on"))
"""Columns that the node derives."""

LOOK_S = 0.5
"""Time between searches for new topics [s]."""

BACK_S = 0.2
"""A clock that went back by more than this was restarted [s]."""


class Magnetometer:
    """The node; it works only while the bus spins."""

    def __init__(
        self,
        twin: Twin,
        bus: Bus,
        settings: Mapping[str, Any],
        *,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Advertise its topics, and search for its inputs.

        Args:
            twin: Gives map, network and the sensor's frame.
            bus: The node, whose clock follows `use_sim_time`.
            settings: Values of `PARAMETERS`.
            say: Called with messages for the user.

        Raises:
            InputError: The scene's magnetometer is physical, or its network reads columns that no input has.
        """
        spec = twin.scene.robot.magnetometer
        if twin.magnetometer is None and spec.kind != "map-only":
            raise InputError(
                f"the magnetometer of scene {twin.scene.name!r} is {spec.kind}, which needs the lab itself; "
                "this node needs a network: name weights, or a scene with a neural magnetometer"
            )
        self._twin, self._bus, self._settings, self._say = twin, bus, dict(settings), say
        needed = (twin.magnetometer.columns if twin.magnetometer else frozenset()) - MADE
        known = {column for topic in INPUTS for column in topic.needs}
        if beyond := sorted(needed - known):
            raise InputError(
                f"the network reads {', '.join(beyond)}, which no input of this node has; train it without"
            )
        chosen = [topic for topic in INPUTS if topic is POSE or needed & set(topic.needs)]
        read = needed | ({"imu_q_xyzw"} if "imu_a" in needed else frozenset())  # to subtract gravity
        self.inputs = {
            topic.name: Input(bus, topic, max_age_s=settings["max_age_s"], wanted=read | _ALWAYS)
            for topic in chosen
        }
        if COMMAND.name in self.inputs:
            self.inputs[COMMAND.name].silence = "no commands: the robot is assumed to stand"
        self._needed = needed
        self._scans: Scanning | None = None
        if twin.magnetometer and "lidar_on" in twin.magnetometer.columns:
            lidar = twin.scene.robot.lidar
            self._scans = Scanning(bus, SCAN, gap_s=lidar.latency_s + 2.5 / max(lidar.scan_rate_hz, 0.1))
        self._reader: Reader | None = None  # if no context and no map border is needed
        self._magnitude = bus.publisher(MAGNITUDE.name, MAGNITUDE.kind, MAGNITUDE.qos)
        self._total = bus.publisher(TOTAL_FIELD.name, TOTAL_FIELD.kind, TOTAL_FIELD.qos)
        self._reporter = Reporter(bus)
        self._last_ns, self._begun_ns = 0, 0
        self._published, self._published_before = 0, 0
        self._skipped, self._outside, self._strange, self._resets = 0, 0, 0, 0
        self._missing = ""
        self._reported_ns = 0
        self.latencies_s: deque[float] = deque(maxlen=10_000)
        """Latency of the last readings [s], from when the step was due or its newest input was sent."""
        self._timer: Timer | None = None
        self._rate, self._units = 0.0, "T"
        self._adopt()
        bus.settable(PARAMETERS, self._settings, self._set)
        self._look()
        bus.timer(LOOK_S, self._look)
        self._reporter.each(self._report)

    def _set(self, name: str, value: Any) -> None:
        """Change a setting while the node runs."""
        self._settings[name] = value
        self._say(f"{name} is now {value}")
        self._adopt()

    def _adopt(self) -> None:
        """Apply the settings."""
        settings, robot = self._settings, self._twin.scene.robot
        for source in self.inputs.values():
            source.max_age_s = settings["battery_max_age_s" if source.topic is BATTERY else "max_age_s"]
        self._sender = sender_of(robot, unit=settings["units"], rate_hz=settings["rate_hz"])
        if settings["rate_hz"] != self._rate:
            if self._timer is not None:
                self._timer.cancel()
            self._rate = float(settings["rate_hz"])
            self._timer = self._bus.timer(1 / self._rate, self._read)
        self._noise_nt = float(robot.magnetometer.noise_density_nt * np.sqrt(self._rate / 2))
        network = self._twin.magnetometer
        alone = network is not None and settings["outside"] == "silent"
        if not alone:
            self._reader = None
        elif self._reader is None and network is not None:
            from magtwin.learn.inference.reader import Reader

            self._reader = Reader(network.net, self._twin.field)
        if settings["units"] != self._units:
            self._units = settings["units"]
            if self._units == "nT":
                self._say("fields are published in nT, as APRILab's robot does; ROS means tesla")

    def _look(self) -> None:
        for source in self.inputs.values():
            source.look()
        if self._scans is not None and self._settings["lidar"] == "scan":
            self._scans.look()

    def _read(self) -> None:
        """One step: publish a reading, if its inputs are there."""
        now = self._bus.now_ns()
        if now < self._last_ns:
            if now > self._last_ns - BACK_S * NS:
                return  # a small step back: keep what was published
            self._restart()
        if now == self._last_ns or not now:
            return
        columns: dict[str, Any] = {}
        for source in self.inputs.values():
            fresh = source.fresh(now)
            if fresh is None and source.topic is COMMAND:
                fresh = {"v_cmd": np.zeros(1), "w_cmd": np.zeros(1)}  # a robot without commands stands
            if fresh is None:
                self._skip(source.missing(now))
                return
            columns |= fresh
        reading = self._reading(now, columns)
        if not np.isfinite(reading.b_map_nt):
            self._outside += 1
            self._skip("the pose is outside the map")
            return
        self._strange += reading.outside_training
        if not np.isfinite(reading.b_total_nt):
            self._skip("the network gave no number")
            return
        values = {"b_measured_nt": np.array([reading.b_total_nt]), "b_sd_nt": np.array([reading.b_sd_nt])}
        for publisher, topic in ((self._magnitude, MAGNITUDE), (self._total, TOTAL_FIELD)):
            publisher.publish(to_bytes(topic.kind, topic.write(values, np.array([now]), self._sender)))
        begun = max(self._bus.due_wall_ns(), *(source.sent_ns for source in self.inputs.values()))
        self.latencies_s.append((time.time_ns() - begun) / NS)
        if self._missing:
            self._say(f"reading again, after: {self._missing}")
            self._missing = ""
        self._last_ns = now
        self._published += 1

    def _reading(self, now: int, columns: dict[str, Any]) -> "Reading":
        """Map and prediction at this step; the sd includes the sensor's noise, and is 0 if unknown."""
        from magtwin.learn.inference.reader import Reading

        lidar = self._settings["lidar"]
        spins = lidar == "on" or (lidar == "scan" and self._scans is not None and self._scans.on(now))
        if self._reader is not None:
            signals = {name: column[0] for name, column in columns.items()}
            signals |= {"t": self._seconds(now), "lidar_on": float(spins)}
            x, y = columns["mocap_p"][0, :2].tolist()
            reading = self._reader.read((x, y), float(yaw_from_quat(columns["mocap_q_xyzw"])[0]), signals)
            return reading._replace(b_sd_nt=self._with_noise(reading.b_sd_nt))
        rows = self._rows(now, columns, spins)
        b_map = float(rows["b_map_nt"][0])
        if self._twin.magnetometer is None or not np.isfinite(b_map):
            return Reading(b_map, b_map, 0.0, self._noise_nt, outside_training=False)
        (gave,), (spread,), strange = read_rows(self._twin.magnetometer, rows)
        outside = bool(strange is not None and strange[0])
        return Reading(b_map + float(gave), b_map, float(gave), self._with_noise(float(spread)), outside)

    def _seconds(self, now: int) -> float:
        """Time since the first reading [s], which stands for the time since the robot was switched on."""
        self._begun_ns = self._begun_ns or now
        return (now - self._begun_ns) / NS

    def _with_noise(self, sd_nt: float) -> float:
        return float(np.hypot(sd_nt, self._noise_nt)) if np.isfinite(sd_nt) else 0.0

    def _rows(self, now: int, columns: dict[str, Any], spins: bool) -> Run:
        """One row of a Run, with the inputs of network and map."""
        yaw = yaw_from_quat(columns["mocap_q_xyzw"])
        xy = columns["mocap_p"][:, :2]
        outside: Literal["clamp", "nan"] = "clamp" if self._settings["outside"] == "clamp" else "nan"
        b_map, slopes = self._twin.field.lookup_with_gradient(xy, yaw, outside=outside)
        made = {
            "t": np.array([self._seconds(now)]),
            "yaw": yaw,
            "lidar_on": np.array([spins]),
            "b_map_nt": b_map,
            "b_map_gradient_nt_m": into_base(slopes[:, :2], yaw),
        }
        if "imu_q_xyzw" in columns:
            columns["imu_q_xyzw"] = canonical(columns["imu_q_xyzw"])
        return Run(made | {name: columns[name] for name in self._needed}, {"rate_hz": self._rate})

    def _skip(self, why: str) -> None:
        self._skipped += 1
        if why != self._missing and self._published:
            self._say(f"no reading: {why}")
        self._missing = why

    def _restart(self) -> None:
        """Forget all inputs, after a restart of time."""
        self._resets += 1
        self._say("time jumped back: earlier inputs are dropped")
        for source in self.inputs.values():
            source.forget()
        self._last_ns, self._begun_ns = 0, 0

    def _report(self, clock: str) -> None:
        now = self._bus.now_ns()
        span = (now - self._reported_ns) / NS
        rate = (self._published - self._published_before) / span if 0 < span < 60 else 0.0
        self._published_before = self._published
        self._reported_ns = now
        silent = clock or self._missing
        slow = not silent and 0 < span < 60 and rate < 0.9 * self._rate
        others = self._bus.publishers(MAGNITUDE.name) - 1
        problems = (
            (slow, f"{rate:.0f} readings a second in place of {self._rate:g}"),
            (self._outside, f"{self._outside} poses were outside the map"),
            (self._strange, f"{self._strange} readings were outside the network's training range"),
            (self._resets, f"time jumped back {self._resets} times"),
            (others > 0, f"{others} others publish {self._magnitude.topic} too"),
        )
        half, most = 1e3 * np.percentile(self.latencies_s or [np.nan], (50, 99))
        values = {
            "rate [Hz]": f"{rate:.1f}",
            "median latency [ms]": f"{half:.2f}",
            "p99 latency [ms]": f"{most:.2f}",
            "skipped": str(self._skipped),
            "outside map": str(self._outside),
            "out of distribution": str(self._strange),
            "time jumps": str(self._resets),
            "units": self._sender.unit,
        }
        level: Level = "error" if silent else "ok"
        words = [f"no reading: {silent}"] if silent else []
        statuses = [
            status_of("readings", problems, fine="reading", level=level, words=words, values=values),
            *(source.status(now) for source in self.inputs.values()),
        ]
        if self._scans is not None and self._settings["lidar"] == "scan":
            statuses.append(self._scans.status(now))
        self._reporter.report(statuses, now)
        self._skipped = self._outside = self._strange = self._resets = 0
