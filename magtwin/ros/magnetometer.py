"""The magnetometer as a node: predicts its readings from map, network and the robot's other sensors.

It runs with any source of its inputs: the real robot, Isaac Sim, or magtwin's simulator. At each step it
joins the newest message of every input whose stamp is not ahead of its clock, as a Run does. It publishes a
reading only if all of them are fresh and the map covers the place. Otherwise it reports on /diagnostics
what is missing, and resumes when that is back.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap, Outside
from magtwin.frames import yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import prefixed, sender_of
from magtwin.io.bags.topics import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    POSE,
    SCAN,
    Topic,
)
from magtwin.ros.bus import Bus, Timer, to_bytes
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.diagnostics import Level, Reporter, status_of
from magtwin.ros.inputs import Columns, Input, LiveFrames, Scanning
from magtwin.ros.online import Measured, Online
from magtwin.ros.parameters import Parameter
from magtwin.ros.topics import TOTAL_FIELD

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Reader, Reading
    from magtwin.learn.models.predictor import Predictor
    from magtwin.twin import Twin

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
        "stamps": Parameter(
            "header",
            "time of the inputs: the stamps of their headers, or their arrival",
            words=("header", "arrival"),
        ),
        "outside": Parameter(
            "silent", "outside the map: no reading, or the reading at its border", words=("silent", "clamp")
        ),
        "buffer_s": Parameter(60.0, "age at which a late pose is too old to be used [s]", 1.0, 300.0),
        "pose_sd_m": Parameter(
            0.0, "standard deviation of late positions without a covariance, each axis [m]", 0.0, 10.0
        ),
        "map_frame": Parameter("map", "frame of the map, in the headers of late poses"),
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
        twin: "Twin",
        bus: Bus,
        settings: Mapping[str, Any],
        *,
        online: str | None = None,
        measured: str | None = None,
        frame_prefix: str = "",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Advertise its topics, and search for its inputs.

        Args:
            twin: Gives map, network and the sensor's frame.
            bus: The node, whose clock follows `use_sim_time`.
            settings: Values of `PARAMETERS`.
            online: Topic of late poses by which a mixed model follows its session. Readings are then
                published on predicted/magnitude and predicted/total_field_nt.
            measured: Topic of the field that a real sensor measures. Default: qtfm/magnitude.
            frame_prefix: Prefix of the names of frames, such as "tb4/".
            say: Called with messages for the user.

        Raises:
            InputError: The scene's magnetometer is physical, or its network reads columns that no input has.
                With `online`: the model is of another kind, a topic is not supported, or late poses are in
                another frame than the map; the last two may also be raised while the bus spins.
        """
        spec = twin.scene.robot.magnetometer
        if twin.magnetometer is None and spec.kind != "map-only":
            raise InputError(
                f"the magnetometer of scene {twin.scene.name!r} is {spec.kind}, which needs the lab itself; "
                "this node needs a network: name weights, or a scene with a neural magnetometer"
            )
        self._twin, self._bus, self._settings, self._say = twin, bus, dict(settings), say
        self._prefix = checked_prefix(frame_prefix)
        needed = (twin.magnetometer.columns if twin.magnetometer else frozenset()) - MADE
        known = {column for topic in INPUTS for column in topic.needs}
        if beyond := sorted(needed - known):
            raise InputError(
                f"the network reads {', '.join(beyond)}, which no input of this node has; train it without"
            )
        chosen = [topic for topic in INPUTS if topic is POSE or needed & set(topic.needs)]
        read = needed | ({"imu_q_xyzw"} if "imu_a" in needed else frozenset())  # to subtract gravity
        self._frames = LiveFrames(bus, {"IMU": twin.scene.robot.q_base_imu_xyzw})
        self.inputs = {
            topic.name: Input(
                bus,
                topic,
                frames=self._frames,
                max_age_s=settings["max_age_s"],
                wanted=read | _ALWAYS,
                stamps=settings["stamps"],
                say=say,
            )
            for topic in chosen
        }
        if COMMAND.name in self.inputs:
            self.inputs[COMMAND.name].silence = "no commands: the robot is assumed to stand"
        self._scans: Scanning | None = None
        if twin.magnetometer and "lidar_on" in twin.magnetometer.columns:
            lidar = twin.scene.robot.lidar
            self._scans = Scanning(bus, SCAN, gap_s=lidar.latency_s + 2.5 / max(lidar.scan_rate_hz, 0.1))
        outputs = [MAGNITUDE, TOTAL_FIELD]
        if online is not None:  # the other names are the real sensor's
            outputs = [replace(topic, name=topic.name.replace("/qtfm/", "/predicted/")) for topic in outputs]
        self._outputs = [(bus.publisher(topic.name, topic.kind, topic.qos), topic) for topic in outputs]
        self._reporter = Reporter(bus)
        self._last_ns, self._begun_ns = 0, 0
        self._published, self._published_before = 0, 0
        self.online: Online | None = None
        """The session that a mixed model follows."""
        self._skipped, self._outside, self._strange, self._resets = 0, 0, 0, 0
        self._missing = ""
        self._reported_ns = 0
        self.latencies_s: deque[float] = deque(maxlen=10_000)
        """Latency of the last readings [s], from when the step was due or its newest input was sent."""
        self._timer: Timer | None = None
        self._rate, self._units = 0.0, "T"
        self._reader: Reader | None = None  # None: the map alone
        self._pose_late_ns = 0
        if twin.magnetometer is not None:
            self._reader, self._pose_late_ns = _reader_of(twin.magnetometer.net, twin.field)
        if online is not None:
            self.online = self._followed(online, measured or MAGNITUDE.name)
        elif measured is not None:
            raise InputError("`measured` is of use only with `online`, the topic of late poses")
        self._adopt()
        bus.settable(PARAMETERS, self._settings, self._set)
        self._look()
        bus.timer(LOOK_S, self._look)
        self._reporter.each(self._report)

    def _followed(self, poses: str, measured: str) -> Online:
        """The session, followed by late poses."""
        if self._twin.magnetometer is None:
            raise InputError(
                "`online` follows the session of a mixed model, and this magnetometer has no network"
            )
        if self._bus.resolve(measured) in [publisher.topic for publisher, _ in self._outputs]:
            raise InputError(
                f"`measured={measured}` is published by this node; name the topic of a real sensor"
            )
        return Online(
            self._bus,
            self._twin.magnetometer.net,
            self._twin.field,
            self._settings,
            frames=self._frames,
            poses=poses,
            measured=measured,
            seconds=self._seconds,
            signals=self._signals_then,
            say=self._say,
        )

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
            source.count_from(settings["stamps"])
        if self.online is not None:
            kept: list[Input | Scanning | Measured] = [self.online.measured]
            kept += [source for source in self.inputs.values() if source.topic is not POSE]
            kept += [self._scans] if self._scans is not None else []
            for buffer in kept:
                buffer.history_s = settings["buffer_s"]
        sender = sender_of(robot, unit=settings["units"], rate_hz=settings["rate_hz"])
        self._sender = prefixed(sender, self._prefix)
        if settings["rate_hz"] != self._rate:
            if self._timer is not None:
                self._timer.cancel()
            self._rate = float(settings["rate_hz"])
            self._timer = self._bus.timer(1 / self._rate, self._read)
        self._noise_nt = float(robot.magnetometer.noise_density_nt * np.sqrt(self._rate / 2))
        if settings["units"] != self._units:
            self._units = settings["units"]
            if self._units == "nT":
                self._say("fields are published in nT, as APRILab's robot does; ROS means tesla")

    def _look(self) -> None:
        for source in self.inputs.values():
            source.look()
        if self._scans is not None and self._settings["lidar"] == "scan":
            self._scans.look()
        if self.online is not None:
            self.online.look()

    def _read(self) -> None:
        """One step: publish a reading, if its inputs are there."""
        now = self._bus.now_ns()
        if now < self._last_ns:
            if now > self._last_ns - BACK_S * NS:
                return  # a small step back: keep what was published
            self._restart()
        if now == self._last_ns or not now:
            return
        columns = self._joined(now, self.inputs.values())
        if isinstance(columns, str):
            self._skip(columns)
            return
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
        for publisher, topic in self._outputs:
            publisher.publish(to_bytes(topic.kind, topic.write(values, np.array([now]), self._sender)))
        begun = max(self._bus.due_wall_ns(), *(source.sent_ns for source in self.inputs.values()))
        self.latencies_s.append((time.time_ns() - begun) / NS)
        if self._missing:
            self._say(f"reading again, after: {self._missing}")
            self._missing = ""
        self._last_ns = now
        self._published += 1

    def _reading(self, now: int, columns: Columns) -> "Reading":
        """Map and prediction at this step; the sd includes the sensor's noise, and is 0 if unknown."""
        from magtwin.learn.inference.reader import Reading

        (x, y), yaw = columns["mocap_p"][0, :2].tolist(), float(yaw_from_quat(columns["mocap_q_xyzw"])[0])
        outside: Outside = "clamp" if self._settings["outside"] == "clamp" else "nan"
        if self._reader is None:
            b_map = self._twin.field.at(x, y, yaw, outside=outside)
            return Reading(b_map, b_map, 0.0, self._noise_nt, outside_training=False)
        signals = self._signals(now, columns)
        if self.online is not None:
            reading = self.online.read(signals["t"], (x, y), yaw, signals, outside=outside)
        else:
            reading = self._reader.read((x, y), yaw, signals, outside=outside)
        return reading._replace(b_sd_nt=self._with_noise(reading.b_sd_nt))

    def _joined(self, at_ns: int, sources: Iterable[Input]) -> Columns | str:
        """Columns of some inputs at a time, or what is missing."""
        columns: Columns = {}
        for source in sources:
            fresh = source.fresh(at_ns - self._pose_late_ns if source.topic is POSE else at_ns)
            if fresh is None and source.topic is COMMAND:
                fresh = {"v_cmd": np.zeros(1), "w_cmd": np.zeros(1)}  # a robot without commands stands
            if fresh is None:
                return source.missing(at_ns)
            columns |= fresh
        return columns

    def _signals(self, at_ns: int, columns: Columns) -> dict[str, Any]:
        """Signals of the network: one row of the columns, the time, and whether the LiDAR spins."""
        lidar = self._settings["lidar"]
        spins = lidar == "on" or (lidar == "scan" and self._scans is not None and self._scans.on(at_ns))
        signals = {name: column[0] for name, column in columns.items()}
        return signals | {"t": self._seconds(at_ns), "lidar_on": float(spins)}

    def _signals_then(self, at_ns: int) -> dict[str, Any] | str:
        """Signals at an earlier time, or what is missing."""
        others = (source for source in self.inputs.values() if source.topic is not POSE)
        columns = self._joined(at_ns, others)
        return columns if isinstance(columns, str) else self._signals(at_ns, columns)

    def _seconds(self, now: int) -> float:
        """Time since the first reading [s], which stands for the time since the robot was switched on."""
        self._begun_ns = self._begun_ns or now
        return (now - self._begun_ns) / NS

    def _with_noise(self, sd_nt: float) -> float:
        return float(np.hypot(sd_nt, self._noise_nt)) if np.isfinite(sd_nt) else 0.0

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
        if self._scans is not None:
            self._scans.forget()
        if self.online is not None:
            self.online.forget()
        self._last_ns, self._begun_ns = 0, 0

    def _report(self, clock: str) -> None:
        now = self._bus.now_ns()
        span = (now - self._reported_ns) / NS
        rate = (self._published - self._published_before) / span if 0 < span < 60 else 0.0
        self._published_before = self._published
        self._reported_ns = now
        silent = clock or self._missing
        slow = not silent and 0 < span < 60 and rate < 0.9 * self._rate
        magnitude, topic = self._outputs[0]
        others = self._bus.publishers(topic.name) - 1
        problems = (
            (slow, f"{rate:.0f} readings a second in place of {self._rate:g}"),
            (self._outside, f"{self._outside} poses were outside the map"),
            (self._strange, f"{self._strange} readings were outside the network's training range"),
            (self._resets, f"time jumped back {self._resets} times"),
            (others > 0, f"{others} others publish {magnitude.topic} too"),
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
        if self.online is not None:
            statuses += self.online.statuses(now)
        self._reporter.report(statuses, now)
        self._skipped = self._outside = self._strange = self._resets = 0


def _reader_of(net: "Predictor", field: AnomalyMap) -> tuple["Reader", int]:
    """The reader of a network, and the age of the poses that it needs [ns].

    A mixed model is read where its labels were, as `magtwin.calibrate` does: their lever arm and latency are
    from the pose that the robot reports. Other networks take the pose as that of base_link.
    """
    from magtwin.learn.data.alignment import Alignment, alignment_of
    from magtwin.learn.inference.reader import Reader

    alignment = alignment_of(net.metadata, "the model") if net.kind == "mixed" else Alignment()
    reader = Reader(net, field, lever_arm_m=alignment.lever_arm_m)
    return reader, round(max(alignment.latency_s, 0.0) * NS)
