"""The localizer as a node: estimates the pose from the robot's topics by any method of `magtwin localize`.

The method gets the same readings as from a recorded run: at each tick of `rate_hz`, the magnetometer's latest
reading, and with it the newest message of every other topic that had come before. Its estimates are
published with the stamp of their reading. While the magnetometer is silent, the method gets odometry alone.
"""

import math
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from magtwin.errors import InputError, is_termination
from magtwin.field.units import NT_PER
from magtwin.frames import quat_from_yaw, yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import prefixed, sender_of
from magtwin.io.bags.topics import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    TF,
    VECTOR,
    Qos,
    Topic,
    map_to_odom,
    transform_fields,
)
from magtwin.io.recording.unit import unit_of
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Array, Localizer, Prior, Problem, Reading
from magtwin.localization.track import LocalizerError, checked_estimates
from magtwin.ros.bus import Bus, Message, Subscription, poses_bytes, to_bytes
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.diagnostics import Status
from magtwin.ros.inputs import JUMP_S
from magtwin.ros.localization.poses import (
    CLOUD,
    CLOUD_KIND,
    ESTIMATE,
    INITIAL,
    LOST,
    LOST_KIND,
    PATH,
    PATH_KIND,
    POSE_KIND,
    START_SD,
    cloud_bytes,
    pose_bytes,
    prior_from,
)
from magtwin.ros.node import LOOK_S, Node
from magtwin.ros.parameters import Parameter
from magtwin.ros.views import Trail
from magtwin.twin import Twin

PARAMETERS: Mapping[str, Parameter] = MappingProxyType(
    {
        "rate_hz": Parameter(5.0, "readings per second that the method gets [Hz]", 0.1, 1000.0),
        "use_sim_time": Parameter(False, "use the time of /clock"),
        "prior": Parameter("wait", "start: wait for /initialpose, global, or a pose x,y,yaw [m, m, rad]"),
        "max_age_s": Parameter(0.5, "age at which odometry is stale [s]", 0.01, 60.0),
        "stamps": Parameter(
            "header",
            "time of the inputs: the stamps of their headers, or their arrival",
            words=("header", "arrival"),
        ),
        "silent_s": Parameter(
            0.5, "silence of the magnetometer after which odometry is used alone [s]", 0.05, 60.0
        ),
        "tf_broadcast": Parameter(True, "publish the transform from map to odom on /tf"),
        "tf_ahead_s": Parameter(
            0.2,
            "time by which this transform is stamped after its reading, so that it holds on [s]",
            0.0,
            10.0,
        ),
        "cloud_hz": Parameter(1.0, "rate of the particle cloud, 0 for none [Hz]", 0.0, 100.0),
        "particles": Parameter(500, "largest number of particles in a cloud", 1, 100_000),
    }
)
"""Parameters of the node."""

OTHERS: tuple[Topic, ...] = (IMU, BATTERY, COMMAND, VECTOR)
"""Topics that are passed on to the method if they are there."""

QUEUE = Qos(depth=1000, reliable=False)
"""Readings that arrive during a step are kept."""

PATH_S = 1.0
"""Time between messages of the estimated path [s]."""

HELD_S = 30.0
"""Age up to which slow topics, such as the battery's, are passed on [s]."""


class LocalizerNode:
    """The node; it works only while the bus spins."""

    def __init__(
        self,
        twin: Twin,
        bus: Bus,
        settings: Mapping[str, Any],
        *,
        method: str,
        options: Mapping[str, Any] | None = None,
        problem: Problem,
        frame_prefix: str = "",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Advertise its topics, and search for its inputs.

        Args:
            twin: Gives the robot's frames.
            bus: The node, whose clock follows `use_sim_time`.
            settings: Values of `PARAMETERS`.
            method: As for `magtwin.localize`.
            options: Keyword arguments of the method's class.
            problem: Map and noise models; its prior and rate are replaced by the settings.
            frame_prefix: Prefix of the names of frames, such as "tb4/".
            say: Called with messages for the user.

        Raises:
            InputError: There is no such method, it needs a whole run, or `prior` is wrong.
        """
        self._bus, self._settings, self._say = bus, dict(settings), say
        self._method, self._options, self._problem = method, dict(options or {}), problem
        self._prior = prior_of(str(settings["prior"]))
        self._make()
        sender = sender_of(twin.scene.robot, unit="T", rate_hz=settings["rate_hz"])
        self._sender = prefixed(sender, checked_prefix(frame_prefix))
        robot = twin.scene.robot
        axes = {"IMU": robot.q_base_imu_xyzw, "field": robot.q_base_magnetometer_xyzw}
        self._node = Node(bus, say, self._statuses, settings["stamps"], axes)
        self.inputs, self.latencies_s = self._node.inputs, self._node.latencies_s
        self._odometry = self._node.listen(ODOMETRY, max_age_s=settings["max_age_s"])
        for topic in OTHERS:
            source = self._node.listen(topic, max_age_s=HELD_S)
            source.silence = "not there: the method gets none of it"
        self._scans = self._node.listen_to_scans(robot.lidar)
        self._field: Subscription | None = None
        self._field_kind = ""
        self._pose = bus.publisher(ESTIMATE, POSE_KIND, Qos())
        self._lost = bus.publisher(LOST, LOST_KIND, Qos())
        self._cloud = bus.publisher(CLOUD, CLOUD_KIND, Qos(depth=1))
        self._path = bus.publisher(PATH, PATH_KIND, Qos(depth=1))
        self._trail = Trail()
        self._tf = None
        if settings["tf_broadcast"] and bus.knows(TF.kind):
            self._tf = bus.publisher(TF.name, TF.kind, TF.qos)
        bus.subscribe(INITIAL, POSE_KIND, self._start_at, Qos().heard)
        self._algorithm: Localizer | None = None
        self._tick0, self._done = 0.0, 0
        self._heard_ns, self._stamp_ns, self._period_s = -1, -1, 0.0  # -1: none yet
        self._newest = (-1, math.nan)  # stamp and field of the newest message that holds a field
        self._yaw: float | None = None
        self._cloud_ns = self._path_ns = -NS * 10**6
        self._blind, self._broken = 0, 0
        self._is_lost = False
        self._look()
        bus.timer(LOOK_S, self._look, wall=True)
        bus.timer(1 / settings["rate_hz"], self._watch)
        self._node.begin()

    def _make(self) -> Localizer:
        """A new object of the method, as for each run."""
        made = load_localizer(self._method, self._options)
        if not isinstance(made, Localizer):
            raise InputError(
                f"localizer {self._method!r} is a smoother, which needs a whole run; use another"
            )
        return made

    def _look(self) -> None:
        if self._field is None:
            kinds = [kind for kind in MAGNITUDE.reads if kind in self._bus.types(MAGNITUDE.name)]
            if kinds:
                self._field_kind = kinds[0]
                self._field = self._bus.subscribe(MAGNITUDE.name, kinds[0], self._hear_field, QUEUE)

    def _start_at(self, message: Message) -> None:
        """Begin anew at a pose from /initialpose, with the next reading."""
        try:
            frame, prior = prior_from(message)
        except InputError as error:
            self._broken += 1
            self._say(f"{INITIAL}: {error}; it is ignored")
            return
        if frame not in ("", self._sender.map_frame):
            self._say(f"{INITIAL}: a pose in {frame!r} is ignored; {self._sender.map_frame!r} is expected")
            return
        self._prior, self._algorithm = prior, None
        x, y, yaw = prior.mean
        self._say(f"starts at x, y = {x:.2f}, {y:.2f} m, heading {math.degrees(yaw):.0f} deg")

    def _hear_field(self, message: Message) -> None:
        """A reading of the magnetometer; the method gets the newest one with a field before a tick."""
        arrived = time.monotonic()
        leaf = MAGNITUDE.leaves(message.kind)[0]
        headed = message.kind.startswith("sensor_msgs")
        stamped = headed and self._settings["stamps"] == "header"
        try:
            read = message.read([leaf, *(("header.stamp",) if headed else ())])
        except InputError:
            self._broken += 1
            return
        stamp = int(read["header.stamp"]) if stamped else self._bus.now_ns()
        if stamp <= self._heard_ns:
            if stamp > self._heard_ns - JUMP_S * NS:
                return  # late or repeated
            self._restart()
        if self._heard_ns >= 0:
            self._period_s = (stamp - self._heard_ns) / NS
        self._heard_ns = stamp
        b_nt = _in_nt(float(np.linalg.norm(np.atleast_1d(read[leaf]))))
        if math.isfinite(b_nt):
            self._newest = stamp, b_nt
        if self._algorithm is not None and not self._due(stamp):
            return
        begun = self._algorithm is not None
        self._step(*(self._newest if begun and self._newest[0] > self._stamp_ns else (stamp, b_nt)), arrived)

    def _due(self, stamp_ns: int) -> bool:
        """Whether the next reading will be after the tick."""
        tick = self._tick0 + self._done / self._settings["rate_hz"]
        return stamp_ns / NS + 0.99 * self._period_s > tick

    def _watch(self) -> None:
        """Step by odometry alone if the magnetometer is silent."""
        now = self._bus.now_ns()
        quiet = now - max(self._heard_ns, self._stamp_ns)
        if (
            self._algorithm is None
            or self._heard_ns < 0
            or now - self._heard_ns < self._settings["silent_s"] * NS
        ):
            return
        if quiet >= 0.99 * NS / self._settings["rate_hz"]:
            self._step(now, math.nan, time.monotonic())

    def _step(self, stamp_ns: int, b_nt: float, arrived: float) -> None:
        """Give the method a reading and publish its estimate."""
        if stamp_ns <= self._stamp_ns and self._algorithm is not None:
            return
        odometry = self._odometry.fresh(stamp_ns)
        if odometry is None:
            self._node.skip(self._odometry.missing(), "estimate")
            return
        if self._algorithm is None:
            if self._prior is None:
                self._node.skip(f"no pose on {INITIAL} yet", "estimate")
                return
            self._begin(stamp_ns)
        algorithm = self._algorithm
        assert algorithm is not None
        rate = self._settings["rate_hz"]
        t, end = stamp_ns / NS, max(stamp_ns, self._heard_ns) / NS
        self._done = (
            max(self._done, math.floor((end + 0.99 * self._period_s - self._tick0) * rate + 1e-6)) + 1
        )
        self._blind += math.isnan(b_nt)
        self._stamp_ns = stamp_ns
        reading = self._reading(t, b_nt, odometry, stamp_ns)
        try:
            estimate = algorithm.step(reading)
        except (Exception, SystemExit) as error:  # whatever the method does wrong
            if is_termination(error):
                raise
            raise LocalizerError(
                f"{self._method}.step raised {type(error).__name__} at t = {t:g} s: {error}"
            ) from error
        checked_estimates(self._method, [estimate], np.array([t]))
        if self._node.missing:
            self._say("localizing")
        self._node.missing, self._is_lost = "", bool(estimate.lost)
        pose = (estimate.x, estimate.y, estimate.yaw)
        frame = self._sender.map_frame
        self._lost.publish(to_bytes(LOST_KIND, {"data": self._is_lost}))
        self._pose.publish(pose_bytes(stamp_ns, frame, pose, estimate.covariance))
        self._node.done += 1
        self.latencies_s.append(time.monotonic() - arrived)
        if self._tf is not None:
            valid_ns = stamp_ns + round(self._settings["tf_ahead_s"] * NS)
            at = np.array([estimate.x, estimate.y, 0.0]), quat_from_yaw(estimate.yaw)
            moved = map_to_odom(*at, odometry["odom_p"][0], odometry["odom_q_xyzw"][0])
            fields = transform_fields(valid_ns, [(frame, self._sender.odom_frame, *moved)])
            self._tf.publish(to_bytes(TF.kind, fields))
        self._publish_path(stamp_ns, pose)
        self._publish_cloud(stamp_ns, algorithm)

    def _publish_path(self, stamp_ns: int, pose: tuple[float, float, float]) -> None:
        self._trail.add([*pose[:2], 0.0], quat_from_yaw(pose[2]))
        if stamp_ns - self._path_ns >= PATH_S * NS:
            self._path_ns = stamp_ns
            self._path.publish(poses_bytes(PATH_KIND, stamp_ns, self._sender.map_frame, self._trail.poses))

    def _publish_cloud(self, stamp_ns: int, algorithm: Localizer) -> None:
        rate = self._settings["cloud_hz"]
        if not rate or not hasattr(algorithm, "particles") or stamp_ns - self._cloud_ns < 0.99 * NS / rate:
            return
        cloud: Array = np.array(algorithm.particles(), float)
        if len(cloud) and np.isfinite(cloud).all() and cloud[:, 3].sum() > 0:
            self._cloud_ns = stamp_ns
            most = self._settings["particles"]
            self._cloud.publish(cloud_bytes(stamp_ns, self._sender.map_frame, cloud, most))

    def _reading(self, t: float, b_nt: float, odometry: dict[str, Any], stamp_ns: int) -> Reading:
        """The on-board columns, as `magtwin.localization.readings.readings_of` gives them."""
        signals: dict[str, Any] = {"t": t, "b_measured_nt": b_nt}
        for source in self.inputs.values():
            held = source.at(stamp_ns)
            if held is not None and held[1] <= source.max_age_s:
                for name, values in held[0].items():
                    value = values[0]
                    signals[name] = value.copy() if isinstance(value, np.ndarray) else float(value)
        if "b_vector_measured_nt" not in signals and "magnetic_field" in signals:
            vector = signals.pop("magnetic_field")
            signals["b_vector_measured_nt"] = vector * _factor(float(np.linalg.norm(vector)))
        signals["lidar_on"] = self._scans.on(self._bus.now_ns())
        yaw = float(yaw_from_quat(odometry["odom_q_xyzw"])[0])
        if self._yaw is not None:  # continuous, as np.unwrap makes it
            yaw = self._yaw + math.remainder(yaw - self._yaw, 2 * math.pi)
        self._yaw = yaw
        x, y = odometry["odom_p"][0, :2].tolist()
        return Reading(t, b_nt, (x, y, yaw), signals=signals)

    def _begin(self, stamp_ns: int) -> None:
        """A new run of the method from this reading on."""
        assert self._prior is not None
        told = {**vars(self._problem), "prior": self._prior, "rate_hz": self._settings["rate_hz"]}
        algorithm = self._make()
        try:
            algorithm.reset(Problem(**told))
        except (Exception, SystemExit) as error:
            if is_termination(error):
                raise
            raise LocalizerError(f"{self._method}.reset raised {type(error).__name__}: {error}") from error
        self._algorithm = algorithm
        self._tick0, self._done, self._stamp_ns, self._yaw = stamp_ns / NS, 0, -1, None
        self._cloud_ns = self._path_ns = -NS * 10**6
        self._trail = Trail()

    def _restart(self) -> None:
        """Begin anew, after a restart of time; the inputs notice it themselves."""
        self._node.resets += 1
        self._say("time jumped back: the method begins anew")
        self._algorithm, self._heard_ns, self._stamp_ns, self._period_s = None, -1, -1, 0.0
        self._newest = (-1, math.nan)

    def _statuses(self, clock: str, now: int) -> list[Status]:
        field = self._bus.resolve(MAGNITUDE.name)
        silent = clock or self._node.missing
        if not silent and not self._node.done:
            silent = "no reading yet" if self._field else f"nobody publishes {field}"
        problems = (
            (self._is_lost, "the method does not trust its pose"),
            (self._blind, f"{field} gives no field: odometry alone"),
            (self._broken, f"{self._broken} messages could not be used"),
        )
        values = {"method": self._method, "estimates": str(self._node.done)}
        self._blind = self._broken = 0
        return [self._node.status("estimates", "localizing", silent, problems, values)]


def prior_of(text: str) -> Prior | None:
    """The start that a setting names: None to wait for one, unknown ("global"), or a pose "x,y,yaw".

    Raises:
        InputError: It is none of these.
    """
    if text == "wait":
        return None
    if text == "global":
        return Prior(sd=(math.inf, math.inf, math.inf))
    try:
        x, y, yaw = map(float, text.split(","))
    except ValueError:
        x = y = yaw = math.nan
    if not all(map(math.isfinite, (x, y, yaw))):
        raise InputError(f"parameter prior is wait, global or x,y,yaw [m, m, rad], got {text!r}")
    return Prior(mean=(x, y, yaw), sd=START_SD)


def _in_nt(size: float) -> float:
    """A magnitude [nT] from a message, whose unit its size tells; nan stays nan."""
    return size * _factor(size)


def _factor(size: float) -> float:
    if not math.isfinite(size) or size == 0:
        return math.nan
    try:
        return NT_PER[unit_of(size, "", "")]
    except InputError:  # much weaker or stronger than the Earth's field
        return NT_PER["T"] if size < 1e-2 else 1.0
