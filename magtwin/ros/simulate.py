"""The simulator as a node: a twin's robot in real time, with the topics of the real one."""

import heapq
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.sender import Unit, sender_for
from magtwin.io.bags.stream import Sent, Stream
from magtwin.io.bags.topics import COMMAND, IMU, MAGNITUDE, SCAN, TOTAL_FIELD, VECTOR, Qos, Topic
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Message, Publisher
from magtwin.ros.diagnostics import Reporter, status_of
from magtwin.ros.topics import READ, SAMPLED, TICKS
from magtwin.run.run import Run
from magtwin.sim.exact import check_field
from magtwin.sim.runs.live import LiveRobot
from magtwin.sim.sensors.clock import Samples
from magtwin.twin import Session, Twin, in_session, model_error_of

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

RESET = "/robot/reset"
"""Topic (std_msgs/Empty), and with rclpy service (std_srvs/Empty), that resets robot and time."""

LEAD_S = 0.006
"""Time by which a control step is computed ahead, so that its first message is not late [s]."""

SLIP_S = 0.1
"""Delay after which a slow machine gives up real time [s]."""

MOST_HZ = 1000.0
"""Highest rate of readings [Hz], that of the magnetometer node."""

WARM = 5
"""Steps of a second robot at the start. They load libraries and determine the topics."""

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
    """A robot simulated in real time; the same commands in the same steps give the same messages."""

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
        stamps: Literal["sim", "wall"] = "sim",
        stamped_commands: bool = False,
        magnetometer: bool = True,
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
            stamps: Stamp messages with simulated time, from 0 on, or with wall time.
            stamped_commands: cmd_vel is a TwistStamped, not a Twist.
            magnetometer: Publish the magnetometer's readings; else another node does.
            say: Called with messages for the user.

        Raises:
            InputError: The robot starts in an obstacle, or an option is out of range.
        """
        if not 0 < speed <= 100:
            raise InputError(f"speed must be above 0 and at most 100 times real time, got {speed!r}")
        if rate_hz is not None and rate_hz > MOST_HZ:
            raise InputError(f"rate_hz must be at most {MOST_HZ:g} Hz live, got {rate_hz!r}")
        twin = in_session(twin, session, seed=seed)
        self._twin, self._bus, self._seed, self._rate, self._lidar = twin, bus, seed, rate_hz, lidar
        self._speed, self._wall, self._say = speed, stamps == "wall", say
        self._reads = magnetometer
        self._units: Unit = units
        self.online = self._online()
        self._sender = sender_for(twin, units, self.online.rate_hz)
        self._publishers: dict[str, Publisher] = {}
        self._events: list[tuple[int, int, Publisher, bytes]] = []
        self._count = 0
        self._command: tuple[float, float] | None = None
        self._commands, self._refused, self._resets, self._slips = 0, 0, 0, 0
        self._kind = "geometry_msgs/msg/TwistStamped" if stamped_commands else COMMAND.kind
        self._input = bus.subscribe(COMMAND.name, self._kind, self._commanded, COMMAND.qos)
        bus.subscribe(RESET, "std_msgs/msg/Empty", lambda message: self.reset(), Qos())
        bus.service(RESET, self.reset)
        self._reporter = Reporter(bus)
        self._stream: Stream | None = None
        self._moved: NDArray[np.float64] | None = None
        warm = self._online()
        rows = [warm.step() for _ in range(WARM)]
        for topic in (*self._streamed(rows[0]).topics, *SAMPLED.values(), SCAN):
            if bus.knows(topic.kind):
                self._publishers[topic.name] = bus.publisher(topic.name, topic.kind, topic.qos)
            else:
                say(f"{topic.name} is left out: {topic.kind} is not installed")
        self._begin_ns = 0
        self._reset = False
        if units == "nT":
            say("fields are published in nT, as APRILab's robot does; ROS means tesla")

    def reset(self) -> None:
        """Put the robot back to its start, and time to 0, before the next step."""
        self._reset = True

    def run(self, until: Callable[[], bool] = lambda: False, *, duration_s: float | None = None) -> None:
        """Simulate.

        Args:
            until: Ends the run when true; called at each step.
            duration_s: Simulated duration [s]. Default: no end.
        """
        pace = self._begun()
        reported, factor_from = time.monotonic(), (time.monotonic(), 0.0)
        while not until() and (duration_s is None or self.online.t < duration_s - 1e-9):
            if self._reset:
                self._reset, self._resets = False, self._resets + 1
                self.online = self._online()
                pace, self._stream = self._begun(), None
                factor_from = (time.monotonic(), 0.0)
                self._say("reset: the robot is at its start, time is 0")
            self._publish_until(pace, pace.due_s(self.online.t) - LEAD_S)
            if pace.slip(self.online.t, time.monotonic()):
                self._slips += 1
            command, self._command = self._command, None
            self._tell(self.online.step(command))
            now = time.monotonic()
            if now - reported > REPORT_S:
                factor = (self.online.t - factor_from[1]) / max(now - factor_from[0], 1e-9)
                reported, factor_from = now, (now, self.online.t)
                self._report(factor)
        self._publish_until(pace, pace.due_s(self.online.t))

    def _online(self) -> LiveRobot:
        twin = self._twin
        check_field(twin.scene, twin.field)
        return LiveRobot(
            twin.scene,
            anomaly_map=twin.field,
            rng=np.random.default_rng(self._seed),
            obstacles=twin.obstacles,
            rate_hz=self._rate,
            network=partial(_read_rows, twin.magnetometer) if twin.magnetometer else None,
            model_error=model_error_of(twin, self._seed),
            lidar=self._lidar,
        )

    def _begun(self) -> Pace:
        self._events.clear()
        self._begin_ns = time.time_ns() if self._wall else 0
        return Pace(self._speed, time.monotonic() + LEAD_S)

    def _tell(self, rows: Run) -> None:
        """Queue the messages of a step."""
        if self._stream is None:
            self._stream = self._streamed(rows)
        for sent in self._stream.messages(rows):
            self._queue(sent)
        if rows.rows:
            self._moved = rows["odom_v"][-1:]
        for name, parts in self.online.samples().items():
            for part in parts:
                self._sampled(SAMPLED[name], part)
        scans = self.online.scans()
        if len(scans.t):
            moments, came = (np.rint(t * NS).astype(np.int64) for t in (scans.t, scans.arrival))
            fields = SCAN.write({"ranges_m": scans.ranges_m}, moments, self._sender)
            self._queue((SCAN, came, fields))

    def _streamed(self, rows: Run) -> Stream:
        silent = () if self._reads else (MAGNITUDE, VECTOR, TOTAL_FIELD)
        topics = [topic for topic in READ if topic not in silent]
        return Stream(rows, self._sender, None, topics=topics, whole=True)

    def _sampled(self, topic: Topic, samples: Samples) -> None:
        """Queue samples at their arrival; those before the start are dropped."""
        taken = samples.t >= 0
        if topic.lost:
            taken &= ~samples.columns[topic.lost]
        columns = {name: values[taken] for name, values in samples.columns.items()}
        if topic is IMU and self._moved is not None:  # its covariances depend on the speed
            columns["odom_v"] = np.repeat(self._moved, taken.sum(), axis=0)
        stamps, arrivals = (np.rint(t[taken] * NS).astype(np.int64) for t in (samples.t, samples.arrival))
        self._queue((topic, arrivals, topic.write(columns, stamps, self._sender)))

    def _queue(self, sent: Sent) -> None:
        topic, times, fields = sent
        publisher = self._publishers.get(topic.name)
        if publisher is None or not len(times):
            return
        if self._begin_ns:
            fields = {
                name: value + self._begin_ns if name.endswith("stamp") or name == "clock" else value
                for name, value in fields.items()
            }
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
                _, _, publisher, data = heapq.heappop(self._events)
                publisher.publish(data)
            else:
                self._bus.spin_once(0.0)
                return

    def _commanded(self, message: Message) -> None:
        linear, angular = COMMAND.leaves(self._kind)
        try:
            read = message.read([linear, angular])
            v, w = float(read[linear][0]), float(read[angular][2])
        except InputError:
            v = w = math.nan
        if not (math.isfinite(v) and math.isfinite(w)):
            self._refused += 1
            return
        self._command = (v, w)
        self._commands += 1

    def _report(self, factor: float) -> None:
        senders = self._input.publishers()
        others = [kind for kind in self._bus.types(COMMAND.name) if kind != self._kind]
        topics = (TICKS, MAGNITUDE) if self._reads else (TICKS,)
        counts = {self._bus.resolve(topic.name): self._bus.publishers(topic.name) for topic in topics}
        problems = [
            (self._slips, f"slower than {self._speed:g} x real time"),
            (senders > 1, f"{senders} publishers on {self._input.topic}: the last command wins"),
            (self._refused, f"{self._refused} commands were not finite"),
            (others, f"commands of type {', '.join(others)} are ignored; {self._kind} is expected"),
            *((count > 1, f"{count} publishers on {name}") for name, count in counts.items()),
        ]
        values = {
            "sim time [s]": f"{self.online.t:.2f}",
            "real-time factor": f"{factor:.3f}",
            "commands": str(self._commands),
            "commands refused": str(self._refused),
            "publishers of commands": str(senders),
            "resets": str(self._resets),
        }
        stamp = self._begin_ns + round(self.online.t * NS)
        self._reporter.report([status_of("simulator", problems, fine="running", values=values)], stamp)
        self._slips = self._refused = 0


def _read_rows(
    magnetometer: "NeuralMagnetometer", run: Run
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None]:
    """Disturbances, their standard deviations [nT], and whether the rows are outside the training range."""
    if not run.rows:
        return np.zeros(0), np.zeros(0), np.zeros(0, bool)
    (read,) = magnetometer.read([run.select("t", *sorted(magnetometer.columns - {"t"}))])
    return read.disturbance_nt, read.sd_nt, read.outside
