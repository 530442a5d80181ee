"""The magnetometer as a node: what a robot's sensors say, through map and network, to what it would read.

It runs against any source of its inputs: the real robot, Isaac Sim, magtwin's own simulator. At each step of
its rate it joins, of every input, the newest message whose stamp is not ahead of its clock, as a Run of
magtwin does. It gives a reading only where all of them are fresh and the map knows the place; else it says on
/diagnostics what is missing, and goes on as soon as that is there again.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import canonical, into_base, yaw_from_quat
from magtwin.io.bags.messages import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    POSE,
    SCAN,
    TOTAL_FIELD,
    Topic,
    sender_of,
)
from magtwin.ros.bus import NS, Bus, Timer, to_bytes
from magtwin.ros.diagnostics import Reporter, Status
from magtwin.ros.inputs import Input, Scanning, newest_sent_ns
from magtwin.ros.network import Following
from magtwin.ros.parameters import Parameter
from magtwin.run.run import Run
from magtwin.twin import Twin

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Reader, Reading

PARAMETERS: Mapping[str, Parameter] = MappingProxyType(
    {
        "rate_hz": Parameter(135.0, "readings a second [Hz]", 1.0, 1000.0),
        "units": Parameter("T", "unit of the field: T, or nT as APRILab's robot has it", words=("T", "nT")),
        "use_sim_time": Parameter(False, "whether time is /clock's"),
        "max_age_s": Parameter(0.5, "age at which pose, odometry and IMU are stale [s]", 0.01, 60.0),
        "battery_max_age_s": Parameter(30.0, "age at which the battery's state is stale [s]", 0.1, 3600.0),
        "lidar": Parameter(
            "scan", "whether the LiDAR spins: as scans come, on or off", words=("scan", "on", "off")
        ),
        "outside": Parameter(
            "silent", "beyond the map: no reading, or the map's border's", words=("silent", "clamp")
        ),
    }
)
"""What the node can be set to."""

INPUTS: tuple[Topic, ...] = (POSE, ODOMETRY, IMU, BATTERY, COMMAND)
"""What it can hear, beside scans."""

_ALWAYS = frozenset(("mocap_p", "mocap_q_xyzw"))
"""Columns that are read whatever the network reads: the map's."""

MADE = frozenset(("t", "yaw", "b_map_nt", "b_map_gradient_nt_m", "lidar_on"))
"""Columns that it makes of those."""

LOOK_S = 0.5
"""Time between looks for topics that were not offered before [s]."""

BACK_S = 0.2
"""A clock that went back by more began anew [s]."""


class Magnetometer:
    """The node. It hears and says nothing but when the bus spins."""

    def __init__(
        self,
        twin: Twin,
        bus: Bus,
        settings: Mapping[str, Any],
        *,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Offer its topics, and look for its inputs.

        Args:
            twin: Gives map, network and the sensor's frame; whatever else is in the scene is not read.
            bus: The node, whose clock is that of `use_sim_time`.
            settings: Values of `PARAMETERS`.
            say: Takes lines for people.

        Raises:
            InputError: The scene's magnetometer is physical, or its network reads what no input tells.
        """
        spec = twin.scene.robot.magnetometer
        if twin.magnetometer is None and spec.kind != "map-only":
            raise InputError(
                f"the magnetometer of scene {twin.scene.name!r} is {spec.kind}, which needs the lab itself; "
                "robots' sensors tell it to a network: name weights, or a scene with a neural magnetometer"
            )
        self._twin, self._bus, self._settings, self._say = twin, bus, dict(settings), say
        needed = (twin.magnetometer.columns if twin.magnetometer else frozenset()) - MADE
        told = {column for topic in INPUTS for column in _columns_of(topic)}
        if beyond := sorted(needed - told):
            raise InputError(
                f"the network reads {', '.join(beyond)}, which no topic of this node tells; train it without"
            )
        chosen = [topic for topic in INPUTS if topic is POSE or needed & _columns_of(topic)]
        read = needed | ({"imu_q_xyzw"} if "imu_a" in needed else frozenset())  # which frees it of gravity
        self.inputs = {
            topic.name: Input(bus, topic, max_age_s=settings["max_age_s"], wanted=read | _ALWAYS)
            for topic in chosen
        }
        if COMMAND.name in self.inputs:
            self.inputs[COMMAND.name].silence = "no commands: the robot is taken to stand"
        self._needed = needed
        self._scans: Scanning | None = None
        if twin.magnetometer and "lidar_on" in twin.magnetometer.columns:
            lidar = twin.scene.robot.lidar
            self._scans = Scanning(bus, SCAN, gap_s=lidar.latency_s + 2.5 / max(lidar.scan_rate_hz, 0.1))
        self._network = Following(twin.magnetometer) if twin.magnetometer else None
        self._reader: Reader | None = None  # where a row tells all, and nothing is asked of the map's border
        self._magnitude = bus.publisher(MAGNITUDE.name, MAGNITUDE.kind, MAGNITUDE.qos)
        self._total = bus.publisher(TOTAL_FIELD.name, TOTAL_FIELD.kind, TOTAL_FIELD.qos)
        self._reporter = Reporter(bus)
        self._last_ns = 0
        self._published, self._published_before = 0, 0
        self._skipped, self._outside, self._strange, self._resets = 0, 0, 0, 0
        self._missing = ""
        self._reported_ns = 0
        self.latencies_s: deque[float] = deque(maxlen=10_000)
        """From when its step was due, or the newest message of an input was sent if that was later, to when a
        reading went out [s], of the last readings."""
        self._timer: Timer | None = None
        self._rate, self._units = 0.0, "T"
        self._adopt()
        bus.settable(PARAMETERS, self._settings, self._set)
        self._look()
        bus.timer(LOOK_S, self._look)
        self._reporter.each(self._report)

    def _set(self, name: str, value: Any) -> None:
        """A setting that is changed while the node runs."""
        self._settings[name] = value
        self._say(f"{name} is {value} now")
        self._adopt()

    def _adopt(self) -> None:
        """Do as the settings say."""
        settings, robot = self._settings, self._twin.scene.robot
        for one in self.inputs.values():
            one.max_age_s = settings["battery_max_age_s" if one.topic is BATTERY else "max_age_s"]
        self._who = sender_of(robot, unit=settings["units"], rate_hz=settings["rate_hz"])
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
        for one in self.inputs.values():
            one.look()
        if self._scans is not None and self._settings["lidar"] == "scan":
            self._scans.look()

    def _read(self) -> None:
        """A step: a reading, if all that it takes is there."""
        now = self._bus.now_ns()
        if now < self._last_ns:
            if now > self._last_ns - BACK_S * NS:
                return  # a clock that is set back a little: what was said stays said
            self._restart()
        if now == self._last_ns or not now:
            return
        columns: dict[str, Any] = {}
        for one in self.inputs.values():
            fresh = one.fresh(now)
            if fresh is None and one.topic is COMMAND:
                fresh = {"v_cmd": np.zeros(1), "w_cmd": np.zeros(1)}  # a robot that is told nothing stands
            if fresh is None:
                self._skip(one.missing(now))
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
        self._publish(now, reading.b_total_nt, reading.b_sd_nt)
        begun = max(self._bus.due_wall_ns(), newest_sent_ns(self.inputs))
        self.latencies_s.append((time.time_ns() - begun) / NS)
        if self._missing:
            self._say(f"reading again, after: {self._missing}")
            self._missing = ""
        self._last_ns = now
        self._published += 1

    def _reading(self, now: int, columns: dict[str, Any]) -> "Reading":
        """What map and network say of this step; the sd has the sensor's noise in it, 0 where unknown."""
        from magtwin.learn.inference.reader import Reading

        told = self._settings["lidar"]
        spins = told == "on" or (told == "scan" and self._scans is not None and self._scans.on(now))
        if self._reader is not None:
            signals = {name: column[0] for name, column in columns.items()} | {"lidar_on": float(spins)}
            x, y = columns["mocap_p"][0, :2].tolist()
            found = self._reader.read((x, y), float(yaw_from_quat(columns["mocap_q_xyzw"])[0]), signals)
            return found._replace(b_sd_nt=self._with_noise(found.b_sd_nt))
        rows = self._rows(now, columns, spins)
        b_map = float(rows["b_map_nt"][0])
        if self._network is None or not np.isfinite(b_map):
            return Reading(b_map, b_map, 0.0, self._noise_nt, outside_training=False)
        (gave,), (spread,), strange = self._network(rows)
        outside = bool(strange is not None and strange[0])
        return Reading(b_map + float(gave), b_map, float(gave), self._with_noise(float(spread)), outside)

    def _with_noise(self, sd_nt: float) -> float:
        return float(np.hypot(sd_nt, self._noise_nt)) if np.isfinite(sd_nt) else 0.0

    def _rows(self, now: int, columns: dict[str, Any], spins: bool) -> Run:
        """One row of a Run, of what the network and the map read."""
        yaw = yaw_from_quat(columns["mocap_q_xyzw"])
        xy = columns["mocap_p"][:, :2]
        outside: Literal["clamp", "nan"] = "clamp" if self._settings["outside"] == "clamp" else "nan"
        b_map, slopes = self._twin.field.lookup_with_gradient(xy, yaw, outside=outside)
        made = {
            "t": np.array([now / NS]),
            "yaw": yaw,
            "lidar_on": np.array([spins]),
            "b_map_nt": b_map,
            "b_map_gradient_nt_m": into_base(slopes[:, :2], yaw),
        }
        if "imu_q_xyzw" in columns:
            columns["imu_q_xyzw"] = canonical(columns["imu_q_xyzw"])
        return Run(made | {name: columns[name] for name in self._needed}, {"rate_hz": self._rate})

    def _publish(self, now: int, total_nt: float, sd_nt: float) -> None:
        columns = {"b_measured_nt": np.array([total_nt]), "b_sd_nt": np.array([sd_nt])}
        stamp = np.array([now])
        for publisher, topic in ((self._magnitude, MAGNITUDE), (self._total, TOTAL_FIELD)):
            fields = topic.write(columns, stamp, self._who)
            publisher.publish(to_bytes(topic.kind, fields))

    def _skip(self, why: str) -> None:
        self._skipped += 1
        if why != self._missing and self._published:
            self._say(f"no reading: {why}")
        self._missing = why

    def _restart(self) -> None:
        """Time began anew: nothing that was heard counts any more."""
        self._resets += 1
        self._say("time jumped back: what was heard before is forgotten")
        for one in self.inputs.values():
            one.forget()
        if self._twin.magnetometer is not None:
            self._network = Following(self._twin.magnetometer)
        self._last_ns = 0

    def _report(self, clock: str) -> None:
        now = self._bus.now_ns()
        span = (now - self._reported_ns) / NS
        rate = (self._published - self._published_before) / span if 0 < span < 60 else 0.0
        self._published_before = self._published
        self._reported_ns = now
        level: Any = "ok"
        words = []
        if clock or self._missing:
            level = "error"
            words.append(f"no reading: {clock or self._missing}")
        elif 0 < span < 60 and rate < 0.9 * self._rate:
            level = "warn"
            words.append(f"{rate:.0f} readings a second in place of {self._rate:g}")
        troubles = (
            (self._outside, "poses were outside the map"),
            (self._strange, "readings were beyond what the network was trained on"),
            (self._resets, "times time jumped back"),
            (self._bus.publishers(MAGNITUDE.name) - 1, f"others say {self._magnitude.topic} too"),
        )
        for count, text in troubles:
            if count > 0:
                level = "warn" if level == "ok" else level
                words.append(f"{count} {text}")
        half, most = 1e3 * np.percentile(self.latencies_s or [np.nan], (50, 99))
        values = {
            "rate [Hz]": f"{rate:.1f}",
            "median latency [ms]": f"{half:.2f}",
            "p99 latency [ms]": f"{most:.2f}",
            "skipped": str(self._skipped),
            "outside map": str(self._outside),
            "out of distribution": str(self._strange),
            "time jumps": str(self._resets),
            "units": self._who.unit,
        }
        statuses = [Status("readings", level, "; ".join(words) or "reading", values)]
        statuses += [one.status(now) for one in self.inputs.values()]
        if self._scans is not None and self._settings["lidar"] == "scan":
            statuses.append(self._scans.status(now))
        self._reporter.report(statuses, now)
        self._skipped = self._outside = self._strange = self._resets = 0


def _columns_of(topic: Topic) -> frozenset[str]:
    """Columns that a topic's messages give."""
    return frozenset(topic.carries or topic.needs)
