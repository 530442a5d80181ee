"""Follow: drive a robot along a path over ROS, with the controllers of `simulate`."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from magtwin.errors import InputError, find
from magtwin.frames import yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import COMMAND, ODOMETRY, POSE, Topic
from magtwin.path import Path
from magtwin.ros.bus import Bus
from magtwin.ros.commands import Commands, CommandType
from magtwin.ros.diagnostics import Level, Status
from magtwin.ros.inputs import Stamps
from magtwin.ros.node import BACK_S, Node
from magtwin.sim.motion.controllers import Guide, guide_along
from magtwin.sim.motion.follow import CONTROL_RATE_HZ
from magtwin.sim.motion.loop import RELEASE
from magtwin.sim.motion.plan import NODE_M
from magtwin.spec.drive import DriveSpec

ESTIMATE = replace(POSE, name="/robot/estimate/pose")
"""The pose by a localizer."""

SOURCES: Mapping[str, tuple[Topic, str, str]] = MappingProxyType(
    {
        "truth": (POSE, "mocap_p", "mocap_q_xyzw"),
        "estimate": (ESTIMATE, "mocap_p", "mocap_q_xyzw"),
        "odometry": (ODOMETRY, "odom_p", "odom_q_xyzw"),
    }
)
"""Sources of the pose, with the columns of position and orientation; odometry starts at 0."""

MAX_AGE_S = 0.3
"""Age at which a pose is stale [s]."""

COASTED_M = 0.3
"""Distance that a robot may coast after its pose is lost [m]."""

MARKER_M = 0.1
"""Distance from the robot's centre that the marker of its pose may have [m]."""

STAND_S = 1.0
"""Time for which standing is commanded at the end [s]."""


class MarkerGuide(Guide):
    """A guide by the pose of a marker, which may be up to `MARKER_M` off the robot's centre.

    As the robot turns on the spot, a marker at a distance r from its centre moves by up to 2 r. A robot that
    has reached its path is therefore lost only if it is farther away than that; else it would turn and return
    by turns at a corner, or at the first point, without end. Within that distance the law of
    `magtwin.sim.motion.loop.along_path` still has one heading to turn to: its wanted heading changes by at
    most r / SETTLE_M < 1 per radian of the turn.
    """

    def __init__(self, guide: Guide) -> None:
        """Take over a guide that has not been used."""
        super().__init__(guide.law, guide.table, guide.gains, guide.timeout_s, guide.pose0)
        self._reached_m = 2 * MARKER_M
        """Distance from the first point within which the path counts as reached [m]; 0 when it was."""

    def command(self, t: float, x: float, y: float, yaw: float, v: float, w: float) -> tuple[float, float]:
        """As for `Guide`; a robot that first stands near the path begins from there."""
        if self._reached_m:
            away = math.hypot(x - self.table[0, 0], y - self.table[1, 0])
            if away < self._reached_m:
                self.gains, self._reached_m = self.gains_within(2 * MARKER_M), 0.0
            else:
                self._reached_m = self.lost_m
        return super().command(t, x, y, yaw, v, w)


class Follower:
    """The node; the robot stands while its pose is unknown."""

    def __init__(
        self,
        path: Path,
        drive: DriveSpec,
        bus: Bus,
        *,
        speed: float = 0.2,
        controller: str = "follower",
        source: str = "truth",
        laps: int = 1,
        continuous: bool = False,
        commands: CommandType = "auto",
        stamps: Stamps = "header",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Plan the path, and search for the robot.

        Args:
            path: The path.
            drive: The robot's limits, and the lag of its motors.
            bus: The node.
            speed: Wanted forward speed [m/s].
            controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`; "release" steers with the
                gain of the released package.
            source: A name of `SOURCES`.
            laps: Number of laps; an open path is driven back and forth.
            continuous: Drive without end.
            commands: Message type of the commands, as for `magtwin.ros.commands.Commands`.
            stamps: Whether poses count from the stamps of their headers, or from their arrival.
            say: Called with messages for the user.

        Raises:
            InputError: The path cannot be driven at that speed, or a name is unknown.
        """
        if laps < 1:
            raise InputError(f"laps must be 1 or more, got {laps}")
        self.path, self._drive, self._bus, self._say = path, drive, bus, say
        self._speed, self._controller = speed, controller
        self._wanted = self._left = math.inf if continuous else laps
        self._begins = path
        self._now_ns = 0
        self._guide = self._guided(path)
        topic, self._p, self._q = find("source", source, SOURCES)
        self._node = Node(bus, say, self._statuses, stamps)
        self._twist = self._node.listen(ODOMETRY, max_age_s=MAX_AGE_S)
        self._pose = self._twist if topic is ODOMETRY else self._node.listen(topic, max_age_s=MAX_AGE_S)
        self._commands = Commands(bus, commands)
        self._state, self._stand_s = "", STAND_S
        self._last = (0.0, 0.0)
        self._begin_ns: int | None = None
        self.laps, self.off_m = 0, math.nan
        """How often the end was reached, and the distance from the path at the last step [m]."""
        self._squares, self._count = 0.0, 0
        self.done = False
        """Whether the end was reached and the robot stands."""
        bus.timer(1 / CONTROL_RATE_HZ, self._step)
        self._node.begin()

    @property
    def rms_m(self) -> float:
        """RMS distance since the path was reached [m]; nan before."""
        return math.sqrt(self._squares / self._count) if self._count else math.nan

    def stop(self) -> None:
        """Command the robot to stand; call it before the node ends."""
        self._command(0.0, 0.0)

    def _guided(self, path: Path) -> Guide:
        return MarkerGuide(
            guide_along(self._controller, path, self._drive, speed=self._speed, dt=1 / CONTROL_RATE_HZ)
        )

    def _step(self) -> None:
        """Send a command, by the newest pose."""
        now = self._bus.now_ns()
        if now < self._now_ns - BACK_S * NS:
            self._restart()
        self._now_ns = now
        if self._guide.done:
            self._stand_s -= 1 / CONTROL_RATE_HZ
            self.done = self.done or self._stand_s <= 0
            self._command(0.0, 0.0)
            return
        fresh = self._pose.fresh(now)
        if fresh is None:
            self._announce(f"standing: {self._pose.missing()}")
            if self._last != (0.0, 0.0):
                self._command(0.0, 0.0)
            return
        x, y = fresh[self._p][0, :2].tolist()
        if self._state.startswith("standing"):
            self._rejoin(x, y)
        self._announce("driving")
        if self._begin_ns is None:
            self._begin_ns = now
        yaw = float(yaw_from_quat(fresh[self._q])[0])
        twist = self._twist.fresh(now)
        v, w = self._last if twist is None else (float(twist["odom_v"][0, 0]), float(twist["odom_w"][0, 2]))
        wanted = self._guide.command((now - self._begin_ns) / NS, x, y, yaw, v, w)
        self._command(*wanted)
        if self._guide.node > 0:  # not on the way to the beginning
            self.off_m = float(self.path.nearest(np.array([[x, y]]))[1][0])
            self._squares += self.off_m**2
            self._count += 1
        if self._guide.done:
            self._lap()

    def _restart(self) -> None:
        """Start again, after a restart of time."""
        self._say("time jumped back: driving the path from its beginning")
        self._node.forget()
        self.path, self._left = self._begins, self._wanted
        self._guide = self._guided(self.path)
        self._begin_ns, self._stand_s = None, STAND_S
        self.laps, self.off_m, self._squares, self._count = 0, math.nan, 0.0, 0

    def _rejoin(self, x: float, y: float) -> None:
        """Continue where the robot stands now; it coasted before it stood."""
        guide = self._guide
        if guide.law == RELEASE or not guide.node:
            return
        ahead = guide.table[:, guide.node : guide.node + round(COASTED_M / NODE_M)]
        stops = np.flatnonzero(ahead[5] <= 0)
        count = int(stops[0]) if len(stops) else ahead.shape[1]
        if count:
            away = np.hypot(ahead[0, :count] - x, ahead[1, :count] - y)
            guide.node, guide.driven_m = guide.node + int(np.argmin(away)), 0.0

    def _lap(self) -> None:
        self.laps += 1
        self._left -= 1
        if self._left <= 0:
            self._say("the end is reached")
            return
        if not self.path.closed:
            self.path = Path(self.path.name, self.path.p_xy[::-1])
        self._guide = self._guided(self.path)

    def _command(self, v: float, w: float) -> None:
        drive = self._drive
        v = min(max(v, -drive.v_max), drive.v_max)
        w = min(max(w, -drive.w_max), drive.w_max)
        self._last = (v, w)
        self._commands.send(v, w)

    def _announce(self, text: str) -> None:
        if text != self._state:
            self._state = text
            self._say(text)

    def _statuses(self, clock: str, now: int) -> list[Status]:
        fares = not clock and (self._guide.done or self._pose.fresh(now) is not None)
        level: Level = "ok" if fares else "error"
        message = clock or ("at the end" if self._guide.done else self._state)
        if (others := self._bus.publishers(COMMAND.name) - self._commands.offered) > 0:
            level = "warn" if fares else level
            message += f"; {others} others command the robot too"
        values = {
            "path": self.path.name,
            "laps": str(self.laps),
            "off the path [m]": f"{self.off_m:.3f}",
            "RMS off the path [m]": f"{self.rms_m:.3f}",
        }
        return [Status("drive", level, message, values)]
