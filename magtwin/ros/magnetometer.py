"""The magnetometer as a node: predicts its readings from map, network and the robot's other sensors.

It runs with any source of its inputs: the real robot, Isaac Sim, or magtwin's simulator. At each step it
joins the newest message of every input whose stamp is not ahead of its clock, as a Run does. It publishes a
reading only if all of them are fresh and the map covers the place. Otherwise it reports on /diagnostics
what is missing, and resumes when that is back.
"""

import time
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
from magtwin.io.bags.topics import BATTERY, COMMAND, IMU, MAGNITUDE, ODOMETRY, POSE, Topic
from magtwin.learn.data.inputs import MANY
from magtwin.ros.bus import Bus, to_bytes
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.diagnostics import Status
from magtwin.ros.inputs import Columns, Input
from magtwin.ros.node import BACK_S, Node
from magtwin.ros.parameters import Parameter
from magtwin.ros.topics import TOTAL_FIELD

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Reader, Reading
    from magtwin.learn.models.predictor import Predictor
    from magtwin.ros.online import Online
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
                With `online`: the model is of another kind, or a name is not that of a topic.
        """
        from magtwin.learn.data.features import columns_of
        from magtwin.learn.inference.calibrate import mixed_of_kind

        robot = twin.scene.robot
        if twin.magnetometer is None and robot.magnetometer.kind != "map-only":
            raise InputError(
                f"the magnetometer of scene {twin.scene.name!r} is {robot.magnetometer.kind}, which needs "
                "the lab itself; name the weights of a network, or a scene with a neural magnetometer"
            )
        self._twin, self._bus, self._settings, self._say = twin, bus, settings, say
        sender = sender_of(robot, unit=settings["units"], rate_hz=settings["rate_hz"])
        self._sender = prefixed(sender, checked_prefix(frame_prefix))
        self._noise_nt = float(robot.magnetometer.noise_density_nt * np.sqrt(settings["rate_hz"] / 2))
        self._node = Node(bus, say, self._statuses, settings["stamps"], axes={"IMU": robot.q_base_imu_xyzw})
        self.inputs = self._node.inputs
        self.latencies_s = self._node.latencies_s
        """Latency of the last readings [s], from when the step was due or its newest input was sent."""
        self._net = None if twin.magnetometer is None else twin.magnetometer.net
        if self._net is not None and self._net.kind == "mixed":  # it does without signals
            self._net = mixed_of_kind(self._net).reading(MADE.union(*(topic.needs for topic in INPUTS)))
        columns = frozenset(() if self._net is None else columns_of(self._net.features))
        history_s = 0.0 if online is None else settings["buffer_s"]
        self._listen(columns - MADE, history_s)
        if "lidar_on" in columns and settings["lidar"] == "scan":
            self._node.listen_to_scans(robot.lidar, history_s)
        outputs = [MAGNITUDE, TOTAL_FIELD]
        if online is not None:  # the other names are the real sensor's
            outputs = [replace(topic, name=topic.name.replace("/qtfm/", "/predicted/")) for topic in outputs]
        self._outputs = [(bus.publisher(topic.name, topic.kind, topic.qos), topic) for topic in outputs]
        self._last_ns, self._begun_ns = 0, 0
        self._outside, self._strange, self._given = 0, 0, 0
        self._reader: Reader | None = None  # None: the map alone
        self._pose_late_ns = 0
        if self._net is not None:
            self._reader, self._pose_late_ns = _reader_of(self._net, twin.field)
        self.online = self._followed(online, measured)
        """The session that a mixed model follows."""
        if settings["units"] == "nT":
            say("fields are published in nT, as APRILab's robot does; ROS means tesla")
        bus.timer(1 / settings["rate_hz"], self._read)
        self._node.begin()

    def _followed(self, poses: str | None, measured: str | None) -> "Online | None":
        """The session, followed by late poses."""
        if poses is None and measured is not None:
            raise InputError("`measured` is of use only with `online`, the topic of late poses")
        if poses is None:
            return None
        from magtwin.ros.online import Online

        if self._net is None:
            raise InputError(
                "`online` follows the session of a mixed model, and this magnetometer has no network"
            )
        measured = measured or MAGNITUDE.name
        if self._bus.resolve(measured) in [publisher.topic for publisher, _ in self._outputs]:
            raise InputError(
                f"`measured={measured}` is published by this node; name the topic of a real sensor"
            )
        return Online(
            self._node,
            self._net,
            self._twin.field,
            self._settings,
            poses=poses,
            measured=measured,
            seconds=self._seconds,
            signals=self._signals_then,
        )

    def _listen(self, needed: frozenset[str], history_s: float) -> None:
        """Subscribe to the inputs that have the columns of the network."""
        if beyond := sorted(needed - {column for topic in INPUTS for column in topic.needs}):
            raise InputError(
                f"the network reads {', '.join(beyond)}, which no input of this node has; train it without"
            )
        read = needed | ({"imu_q_xyzw"} if "imu_a" in needed else frozenset())  # to subtract gravity
        for topic in INPUTS:
            if topic is POSE or needed & set(topic.needs):
                age = self._settings["battery_max_age_s" if topic is BATTERY else "max_age_s"]
                source = self._node.listen(topic, max_age_s=age, wanted=read | _ALWAYS, history_s=history_s)
                if topic is COMMAND:
                    source.silence = "no commands: the robot is assumed to stand"

    def _read(self) -> None:
        """One step: publish a reading, if its inputs are there."""
        now = self._bus.now_ns()
        if now < self._last_ns:
            if now > self._last_ns - BACK_S * NS:
                return  # a small step back: keep what was published
            self._say("time jumped back: earlier inputs are dropped")
            self._node.forget()
            self._last_ns, self._begun_ns = 0, 0
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
        self._given += 1
        if not np.isfinite(reading.b_total_nt):
            self._skip("the network gave no number")
            return
        values = {"b_measured_nt": np.array([reading.b_total_nt]), "b_sd_nt": np.array([reading.b_sd_nt])}
        for publisher, topic in self._outputs:
            publisher.publish(to_bytes(topic.kind, topic.write(values, np.array([now]), self._sender)))
        begun = max(self._bus.due_wall_ns(), *(source.sent_ns for source in self.inputs.values()))
        self.latencies_s.append((time.time_ns() - begun) / NS)
        if self._node.missing:
            self._say(f"reading again, after: {self._node.missing}")
            self._node.missing = ""
        self._last_ns = now
        self._node.done += 1

    def _skip(self, why: str) -> None:
        if self._node.done:
            self._node.skip(why, "reading")
        else:  # at the start, inputs are missing until all nodes are found
            self._node.skipped += 1
            self._node.missing = why

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
            reading = self.online.magnetometer.read(signals["t"], (x, y), yaw, signals, outside=outside)
        else:
            reading = self._reader.read((x, y), yaw, signals, outside=outside)
        sd = reading.b_sd_nt
        return reading._replace(b_sd_nt=float(np.hypot(sd, self._noise_nt)) if np.isfinite(sd) else 0.0)

    def _seconds(self, at_ns: int) -> float:
        """Time since the first reading [s], which stands for the time since the robot was switched on."""
        self._begun_ns = self._begun_ns or at_ns
        return (at_ns - self._begun_ns) / NS

    def _signals(self, at_ns: int, columns: Columns) -> dict[str, Any]:
        """Signals of the network: one row of the columns, the time, and whether the LiDAR spins."""
        scans = self._node.scans
        spins = self._settings["lidar"] == "on" or (scans is not None and scans.on(at_ns))
        signals: dict[str, Any] = {name: column[0] for name, column in columns.items()}
        return signals | {"t": self._seconds(at_ns), "lidar_on": float(spins)}

    def _signals_then(self, at_ns: int) -> dict[str, Any] | str:
        """Signals at an earlier time, or what is missing."""
        columns = self._joined(at_ns, (s for s in self.inputs.values() if s.topic is not POSE))
        return columns if isinstance(columns, str) else self._signals(at_ns, columns)

    def _joined(self, at_ns: int, sources: Iterable[Input]) -> Columns | str:
        """Columns of some inputs at a time, or what is missing."""
        columns: Columns = {}
        for source in sources:
            fresh = source.fresh(at_ns - self._pose_late_ns if source.topic is POSE else at_ns)
            if fresh is None and source.topic is COMMAND:
                fresh = {"v_cmd": np.zeros(1), "w_cmd": np.zeros(1)}  # a robot without commands stands
            if fresh is None:
                return source.missing()
            columns |= fresh
        return columns

    def _statuses(self, clock: str, now: int) -> list[Status]:
        rate, wanted = self._node.rate_hz(now), self._settings["rate_hz"]
        silent = clock or self._node.missing
        magnitude, topic = self._outputs[0]
        others = self._bus.publishers(topic.name) - 1
        problems = (
            (
                not silent and rate is not None and rate < 0.9 * wanted,
                f"{rate or 0:.0f} readings a second in place of {wanted:g}",
            ),
            (self._outside, f"{self._outside} poses were outside the map"),
            (
                self._strange > MANY * self._given,
                f"{self._strange} of {self._given} readings were outside the network's training range",
            ),
            (others > 0, f"{others} others publish {magnitude.topic} too"),
        )
        values = {
            "rate [Hz]": f"{rate or 0:.1f}",
            "outside map": str(self._outside),
            "out of distribution": str(self._strange),
            "units": self._sender.unit,
        }
        self._outside = self._strange = self._given = 0
        return [self._node.status("readings", "reading", silent, problems, values)]


def following(twin: "Twin") -> "Twin":
    """The twin with a mixed model, that which ships if its own network is another."""
    from magtwin.learn.inference.calibrate import shipped_mixed
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

    if twin.magnetometer is not None and twin.magnetometer.net.kind == "mixed":
        return twin
    path = shipped_mixed()
    return replace(twin, magnetometer=NeuralMagnetometer.load(path))


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
