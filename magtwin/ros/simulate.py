"""The simulator as a node: the robots of a twin in real time, with the topics of real ones."""

import heapq
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from magtwin.errors import InputError
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.sender import Transforms, Unit, prefixed
from magtwin.io.bags.stream import Sent
from magtwin.io.bags.topics import Qos, Topic
from magtwin.io.bags.twin_sender import sender_for
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Publisher
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.diagnostics import Reporter, status_of
from magtwin.ros.robot import SimulatedRobot
from magtwin.ros.topics import OCCUPANCY, TICKS
from magtwin.ros.views import publish_lab
from magtwin.sim.runs.live import LiveRobot
from magtwin.twin import Session, Twin, in_session, led_by

RESET = "/robot/reset"
"""Topic (std_msgs/Empty) that resets robots and time."""

LEAD_S = 0.006
"""Time by which a control step is computed ahead, so that its first message is not late [s]."""

SLIP_S = 0.1
"""Delay after which a slow machine gives up real time [s]."""

MOST_HZ = 1000.0
"""Highest rate of readings [Hz], that of the magnetometer node."""

REPORT_S = 1.0
"""Wall time between diagnostics [s]."""


@dataclass
class Pace:
    """Relation of simulated time to wall time."""

    speed: float
    """Simulated seconds per second."""

    begin_s: float
    """Wall time of simulated time 0 [s]."""

    def due_s(self, t: float) -> float:
        """Wall time of a simulated time [s]."""
        return self.begin_s + t / self.speed

    def slip(self, t: float, now_s: float) -> bool:
        """Give up a delay above `SLIP_S`; whether there was one."""
        behind = now_s - self.due_s(t)
        if behind < SLIP_S:
            return False
        self.begin_s += behind
        return True


class Simulator:
    """The robots of a twin in real time; the same commands in the same steps give the same messages.

    One robot has the topics of the bus's namespace. Of several, each has a namespace of its own below it, by
    its name, and its name as prefix of its frames. They share /clock, /tf, /tf_static, /diagnostics, reset.
    """

    def __init__(
        self,
        twin: Twin,
        bus: Bus,
        *,
        seed: int = 0,
        session: Session | None = None,
        speed: float = 1.0,
        rate_hz: float | None = None,
        units: Unit = "T",
        lidar: Literal["schedule", "on", "off"] = "schedule",
        magnetometer: bool = True,
        frame_prefix: str | None = None,
        tf: Transforms = "odom",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Advertise its topics; `run` starts it.

        Args:
            twin: The twin.
            bus: The node; its clock is not used.
            seed: Seed of all noise.
            session: As for `magtwin.simulate`.
            speed: Simulated seconds per second.
            rate_hz: Rate of the magnetometer [Hz]. Default: the scene's.
            units: Unit of magnetic fields: "T", as in ROS, or "nT", as APRILab's robot publishes them.
            lidar: Whether the LiDAR follows its schedule, or stays on or off.
            magnetometer: Publish the magnetometer's readings; else another node does.
            frame_prefix: Prefix of the names of frames, such as "tb4/". Default: none; for several robots the
                name of each, "ann/", which a given prefix precedes.
            tf: Transforms of the drive on /tf: "odom", odom to base_link, beside a localizer that publishes
                map to odom; "all", also map to odom, by the true pose; "none", beside a filter of both.
            say: Called with messages for the user.

        Raises:
            InputError: A robot starts in an obstacle, or an option is out of range.
        """
        if not 0 < speed <= 100:
            raise InputError(
                f"speed must be above 0 and at most 100 times real time, got {speed!r}", parameter="pace"
            )
        if rate_hz is not None and rate_hz > MOST_HZ:
            raise InputError(f"rate_hz must be at most {MOST_HZ:g} Hz live, got {rate_hz!r}")
        prefix = checked_prefix(frame_prefix or "")
        twin = in_session(twin, session, seed=seed)
        names = [placed.robot.name for placed in twin.scene.robots]
        several = len(names) > 1
        self._bus, self._speed, self._say = bus, speed, say
        self._publishers: dict[str, Publisher] = {}
        self._events: list[tuple[int, int, Publisher, bytes]] = []
        self._count, self._resets, self._slips = 0, 0, 0
        self._reset = False
        bus.subscribe(RESET, "std_msgs/msg/Empty", lambda message: self.reset(), Qos().heard)
        self._reporter = Reporter(bus)
        self.robots: list[SimulatedRobot] = []
        """The robots, in the order of the scene."""
        for k, name in enumerate(names):
            own = led_by(twin, name)
            sender = sender_for(own, units, rate_hz or own.scene.robot.magnetometer.rate_hz)
            robot = SimulatedRobot(
                own,
                bus,
                replace(prefixed(sender, f"{prefix}{name}/" if several else prefix), transforms=tf),
                within=name if several else "",
                which=k,
                seed=seed,
                rate_hz=rate_hz,
                lidar=lidar,
                magnetometer=magnetometer,
            )
            self.robots.append(robot)
        if several:  # one latched message has the links of all robots
            links = tuple(link for robot in self.robots for link in robot.sender.links)
            for robot in self.robots:
                robot.sender = replace(robot.sender, links=links if robot is self.robots[0] else ())
        for robot in self.robots:
            robot.restart()
            for topic in robot.topics():
                self._advertise(topic)
        self._restart()
        self._lab = publish_lab(twin, bus, self.robots[0].sender.map_frame)
        if units == "nT":
            say("fields are published in nT, as APRILab's robot does; ROS means tesla")

    @property
    def online(self) -> LiveRobot:
        """The first robot."""
        return self.robots[0].live

    def reset(self) -> None:
        """Put the robots back to their start, and time to 0, before the next step."""
        self._reset = True

    def run(self, until: Callable[[], bool] = lambda: False, *, duration_s: float | None = None) -> None:
        """Simulate.

        Args:
            until: Ends the run when true; called at each step.
            duration_s: Simulated time at which the run ends [s]. Default: no end.
        """
        pace = self._begun()
        reported, factor_from = time.monotonic(), (time.monotonic(), self.online.t)
        while not until() and (duration_s is None or self.online.t < duration_s - 1e-9):
            if self._reset:
                self._reset, self._resets = False, self._resets + 1
                self._restart()
                pace = self._begun()
                factor_from = (time.monotonic(), 0.0)
                which = (
                    "the robot is at its start" if len(self.robots) == 1 else "the robots are at their start"
                )
                self._say(f"reset: {which}, time is 0")
            self._publish_until(pace, pace.due_s(self.online.t) - LEAD_S)
            if pace.slip(self.online.t, time.monotonic()):
                self._slips += 1
            begin = round(self.online.t * NS)
            for robot in self.robots:
                robot.drive()
            for robot in self.robots:
                for sent in robot.messages():
                    self._publish_due(pace, begin)
                    self._queue(sent)
            now = time.monotonic()
            if now - reported > REPORT_S:
                factor = (self.online.t - factor_from[1]) / max(now - factor_from[0], 1e-9)
                reported, factor_from = now, (now, self.online.t)
                self._report(factor)
        self._publish_until(pace, pace.due_s(self.online.t))

    def _restart(self) -> None:
        """Put the robots to their start."""
        for robot in self.robots:
            robot.restart()
        for robot in self.robots:
            robot.live.beside(other.live for other in self.robots if other is not robot)

    def _begun(self) -> Pace:
        """The pace of a run that begins or goes on now."""
        now, t = time.monotonic() + LEAD_S, self.online.t
        if not t:
            self._events.clear()
        return Pace(self._speed, now - t / self._speed)

    def _advertise(self, topic: Topic) -> None:
        if topic.name in self._publishers:  # robots share /tf
            return
        if self._bus.knows(topic.kind):
            self._publishers[topic.name] = self._bus.publisher(topic.name, topic.kind, topic.qos)
        else:
            self._say(f"{topic.name} is left out: {topic.kind} is not installed")

    def _queue(self, sent: Sent) -> None:
        topic, times, fields = sent
        publisher = self._publishers.get(topic.name)
        if publisher is None or not len(times):
            return
        for t, data in zip(
            times.tolist(), encode(layout(topic.kind, fields), fields, len(times)), strict=True
        ):
            self._count += 1
            heapq.heappush(self._events, (t, self._count, publisher, data.tobytes()))

    def _publish_until(self, pace: Pace, due_s: float) -> None:
        """Publish messages until a wall time, each at its time, and receive others meanwhile."""
        while True:
            next_s = pace.due_s(self._events[0][0] / NS) if self._events else math.inf
            left = min(next_s, due_s) - time.monotonic()
            if left > 0:
                self._bus.spin_once(left)
            elif next_s <= due_s:
                self._publish_next()
            else:
                self._bus.spin_once(0.0)
                return

    def _publish_due(self, pace: Pace, end_ns: int) -> None:
        """Publish messages that are due by now and before a simulated time."""
        now = time.monotonic()
        while self._events and self._events[0][0] < end_ns and pace.due_s(self._events[0][0] / NS) <= now:
            self._publish_next()

    def _publish_next(self) -> None:
        _, _, publisher, data = heapq.heappop(self._events)
        publisher.publish(data)

    def _report(self, factor: float) -> None:
        stamp = round(self.online.t * NS)
        for robot in self.robots:
            name, path = robot.path(stamp)
            if name in self._publishers:
                self._publishers[name].publish(path)
        clock, maps = (self._bus.publishers(topic.name) for topic in (TICKS, OCCUPANCY))
        problems = [
            (self._slips, f"slower than {self._speed:g} x real time"),
            (clock > 1, f"{clock} publishers on {self._bus.resolve(TICKS.name)}"),
            (maps > 1, f"{maps} publishers on {self._bus.resolve(OCCUPANCY.name)}: remap that of one"),
        ]
        values = {
            "sim time [s]": f"{self.online.t:.2f}",
            "real-time factor": f"{factor:.3f}",
            "resets": str(self._resets),
        }
        if len(self.robots) == 1:
            more, own = self.robots[0].state()
            statuses = [status_of("simulator", [*problems, *more], fine="running", values=values | own)]
        else:
            statuses = [status_of("simulator", problems, fine="running", values=values)]
            for robot in self.robots:
                more, own = robot.state()
                statuses.append(status_of(robot.within, more, fine="running", values=own))
        self._reporter.report(statuses, stamp)
        self._slips = 0
