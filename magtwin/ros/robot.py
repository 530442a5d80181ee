"""A simulated robot on its topics: commands in, readings out."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.stream import Sent, Stream
from magtwin.io.bags.topics import COMMAND, IMU, MAGNITUDE, SCAN, VECTOR, Topic
from magtwin.ros.bus import Bus, Message
from magtwin.ros.bus.names import within
from magtwin.ros.topics import PATH, READ, READINGS, SAMPLED, TICKS, TOTAL_FIELD
from magtwin.ros.views import Truth
from magtwin.run.run import Run
from magtwin.sim.exact import check_field
from magtwin.sim.runs.live import LiveRobot
from magtwin.sim.runs.sensing import LidarMode
from magtwin.sim.sensors.clock import Samples
from magtwin.twin import Twin
from magtwin.twin.simulation import reader

WARM = 5
"""Steps of a robot before the first. They load libraries and determine the topics."""


class SimulatedRobot:
    """A live robot with its topics; `Simulator` gives it time and publishes its messages."""

    def __init__(
        self,
        twin: Twin,
        bus: Bus,
        sender: Sender,
        *,
        within: str,
        which: int,
        seed: int,
        rate_hz: float | None,
        lidar: LidarMode,
        magnetometer: bool,
    ) -> None:
        """Subscribe to its commands.

        Args:
            twin: The twin in its session, led by this robot.
            bus: The node.
            sender: Frames, covariances and unit of its messages; may be replaced before `restart`.
            within: Its namespace below the bus's; "" for the only robot.
            which: Its place in the scene, from 0; the first robot publishes /clock.
            seed: As for `Simulator`, like the rest.
            rate_hz: Rate of the magnetometer.
            lidar: Whether the LiDAR spins.
            magnetometer: Publish the magnetometer's readings.
        """
        self._twin, self._bus, self._which, self._seed = twin, bus, which, seed
        self._rate, self._lidar, self._reads = rate_hz, lidar, magnetometer
        self.sender, self.within = sender, within
        self._inputs = [
            bus.subscribe(self._name(COMMAND), kind, self.commanded, COMMAND.qos.heard)
            for kind in COMMAND.reads
        ]
        self._command: tuple[float, float] | None = None
        self._commands, self._refused = 0, 0
        self._stream: Stream | None = None
        self._moved: NDArray[np.float64] | None = None

    def restart(self) -> None:
        """Put it to its start, at time 0."""
        twin = self._twin
        check_field(twin.scene, twin.field)
        read_in = reader(twin, self._seed, which=self._which)
        self.live = LiveRobot(
            twin.scene,
            anomaly_map=twin.field,
            rng=np.random.default_rng((self._seed, 2, self._which) if self._which else self._seed),
            obstacles=twin.obstacles,
            rate_hz=self._rate,
            network=twin.magnetometer is not None,
            finish=lambda sensed: read_in(sensed)[0],
            lidar=self._lidar,
        )
        self._stream, self._moved = None, None
        self._truth = Truth(self.sender, self._twin.scene.robot.p_base_magnetometer)

    def topics(self) -> list[Topic]:
        """The topics that it publishes; it drives for some steps to find out, and must `restart`."""
        rows = [self.live.step() for _ in range(WARM)]
        shown = (PATH, *[READINGS] * self._reads)
        topics = (*self._streamed(rows[0]).topics, *SAMPLED.values(), SCAN, *shown)
        return [self._renamed(topic) for topic in topics]

    def drive(self) -> None:
        """Drive for a control step by the last command."""
        command, self._command = self._command, None
        self.live.drive(command)

    def messages(self) -> Iterator[Sent]:
        """The messages of the last step."""
        rows = self.live.read()
        if self._stream is None:
            self._stream = self._streamed(rows)
        for topic, times, fields in self._stream.messages(rows):
            yield self._renamed(topic), times, fields
        for topic, times, fields in self._truth.add(rows):
            yield self._renamed(topic), times, fields
        if rows.rows:
            self._moved = rows["odom_v"][-1:]
        for name, parts in self.live.samples().items():
            for part in parts:
                yield self._sampled(SAMPLED[name], part)
        scans = self.live.scans()
        if len(scans.t):
            moments, came = (np.rint(t * NS).astype(np.int64) for t in (scans.t, scans.arrival))
            yield self._renamed(SCAN), came, SCAN.write({"ranges_m": scans.ranges_m}, moments, self.sender)

    def path(self, stamp_ns: int) -> tuple[str, bytes]:
        """Topic and message of its true path so far."""
        return self._renamed(PATH).name, self._truth.path(stamp_ns)

    def commanded(self, message: Message) -> None:
        """Take a command, a Twist or a TwistStamped."""
        linear, angular = COMMAND.leaves(message.kind)
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

    def state(self) -> tuple[list[tuple[Any, str]], dict[str, str]]:
        """Problems since the last call, and values, for diagnostics."""
        senders = sum(source.publishers() for source in self._inputs)
        command = self._name(COMMAND)
        others = [kind for kind in self._bus.types(command) if kind not in COMMAND.reads]
        magnitude = self._name(MAGNITUDE)
        readers = self._bus.publishers(magnitude) if self._reads else 0
        problems = [
            (senders > 1, f"{senders} publishers on {self._inputs[0].topic}: the last command wins"),
            (self._refused, f"{self._refused} commands were not finite"),
            (
                others,
                f"commands of type {', '.join(others)} are ignored; {' or '.join(COMMAND.reads)} is expected",
            ),
            (readers > 1, f"{readers} publishers on {self._bus.resolve(magnitude)}"),
        ]
        values = {
            "commands": str(self._commands),
            "commands refused": str(self._refused),
            "publishers of commands": str(senders),
        }
        self._refused = 0
        return problems, values

    def _name(self, topic: Topic) -> str:
        return within(self.within, topic.name)

    def _renamed(self, topic: Topic) -> Topic:
        return replace(topic, name=self._name(topic)) if self.within else topic

    def _streamed(self, rows: Run) -> Stream:
        silent = [] if self._reads else [MAGNITUDE, VECTOR, TOTAL_FIELD]
        if self._which:
            silent.append(TICKS)
        topics = [topic for topic in READ if topic not in silent]
        return Stream(rows, self.sender, None, topics=topics, whole=True)

    def _sampled(self, topic: Topic, samples: Samples) -> Sent:
        """Messages of samples, at their arrival; those before the start are dropped."""
        taken = samples.t >= 0
        if topic.lost:
            taken &= ~samples.columns[topic.lost]
        columns = {name: values[taken] for name, values in samples.columns.items()}
        if topic is IMU and self._moved is not None:  # its covariances depend on the speed
            columns["odom_v"] = np.repeat(self._moved, taken.sum(), axis=0)
        stamps, arrivals = (np.rint(t[taken] * NS).astype(np.int64) for t in (samples.t, samples.arrival))
        return self._renamed(topic), arrivals, topic.write(columns, stamps, self.sender)
