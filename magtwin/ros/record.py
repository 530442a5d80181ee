"""Record topics to a bag, which is a run; replay a run to topics."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.sender import Transforms, Unit, prefixed, sender_for
from magtwin.io.bags.stream import Stream
from magtwin.io.bags.topics import Qos
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Message, Publisher
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.topics import READ, RECORDED, SAMPLED
from magtwin.run.run import Run
from magtwin.twin import Twin

FLUSH_S = 1.0
"""Wall time between flushes [s]."""

LOOK_S = 0.5
"""Time between searches for new topics [s]."""

DEPTH = 1000
"""Queue of a topic, so that no message is lost while a file is written."""

SETTLE_S = 1.5
"""Wall time for discovery before the first message [s]."""

AT_A_TIME = 1024
"""Rows of a run that are encoded at a time."""


class Recorder:
    """Records topics, each from when it is first published."""

    def __init__(
        self,
        bus: Bus,
        writer: RawBagWriter,
        topics: Iterable[str] = (),
        *,
        sim_time: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Start to listen.

        Args:
            bus: The node; its clock gives times of receipt.
            writer: The bag.
            topics: Names of topics to record. Default: all of the robot's.
            sim_time: Whether the clock is /clock, which may jump back.
            say: Called with messages for the user.
        """
        self._bus, self._writer, self._say, self._sim_time = bus, writer, say, sim_time
        known = {topic.name: topic for topic in RECORDED}
        names = list(topics) or list(known)
        self._waited = {name: known.get(name) for name in names}
        self._looked, self._flushed = 0.0, time.monotonic()
        self._last_ns = -1

    def run(self, until: Callable[[], bool] = lambda: False, *, duration_s: float | None = None) -> None:
        """Record until `until` is true, or for a wall time [s]."""
        begin = time.monotonic()
        while not until() and (duration_s is None or time.monotonic() - begin < duration_s):
            self.step()
            self._bus.spin_once(0.05)

    def step(self) -> None:
        """Search for topics and flush, each at its interval; call it often while the bus spins."""
        now = time.monotonic()
        if now - self._looked > LOOK_S:
            self._looked = now
            self._look()
        if now - self._flushed > FLUSH_S:
            self._flushed = now
            self._writer.flush()

    def _look(self) -> None:
        """Subscribe to new topics."""
        for name, topic in list(self._waited.items()):
            kinds = [kind for kind in self._bus.types(name) if self._bus.knows(kind)]
            if not kinds:
                continue
            del self._waited[name]
            kind = topic.kind if topic is not None and topic.kind in kinds else kinds[0]
            if len(kinds) > 1:
                self._say(f"{name} is published as {' and as '.join(kinds)}; recording {kind}")
            latched = topic is not None and topic.qos.latched
            qos = Qos(depth=DEPTH, reliable=latched or self._bus.reliable(name), latched=latched)
            self._writer.add(name, kind, qos)
            self._bus.subscribe(name, kind, partial(self._heard, name), qos)

    def _heard(self, name: str, message: Message) -> None:
        now = self._bus.now_ns()
        if self._sim_time and now < self._last_ns:
            raise InputError(
                f"time jumped back from {self._last_ns / NS:.3f} to {now / NS:.3f} s, as after a reset: the "
                "recording ends here; start a new one"
            )
        self._last_ns = now = max(now, self._last_ns)  # times in the bag never go back
        self._writer.write(name, now, message.data)


class Player:
    """Publishes a run as its robot would have."""

    def __init__(
        self,
        run: Run,
        bus: Bus,
        twin: Twin | None = None,
        *,
        units: Unit = "T",
        topics: Sequence[str] = (),
        frame_prefix: str = "",
        tf: Transforms = "odom",
    ) -> None:
        """Advertise its topics.

        Args:
            run: The run.
            bus: The node.
            twin: The twin of the run: gives frames, covariances, /tf_static and the robot's description.
            units: Unit of magnetic fields.
            topics: Names of topics to publish. Default: all.
            frame_prefix: Prefix of the names of frames, such as "tb4/".
            tf: Transforms of the drive on /tf, as for `magtwin.ros.simulate.Simulator`.

        Raises:
            InputError: The run has no column of these topics.
        """
        self._run = run
        sender = sender_for(twin, units, run.metadata.get("rate_hz"))
        sender = replace(prefixed(sender, checked_prefix(frame_prefix)), transforms=tf)
        self._stream = Stream(run, sender, None, topics=(*SAMPLED.values(), *READ), whole=True)
        chosen = [t for t in self._stream.topics if bus.knows(t.kind) and (not topics or t.name in topics)]
        if not chosen:
            raise InputError(f"the run has no columns of {', '.join(topics) or 'any topic'}")
        self._publishers: dict[str, Publisher] = {
            t.name: bus.publisher(t.name, t.kind, t.qos) for t in chosen
        }
        self._bus, self._begun = bus, time.monotonic()

    def run(self, until: Callable[[], bool] = lambda: False, *, speed: float = 1.0) -> int:
        """Publish it at `speed` times real time, after `SETTLE_S`; returns the number of messages."""
        first = float(self._run["t"][0])
        begin = max(time.monotonic(), self._begun + SETTLE_S)
        count = 0
        for row in range(0, self._run.rows, AT_A_TIME):
            rows = self._run.take(slice(row, row + AT_A_TIME))
            messages: list[tuple[int, Publisher, bytes]] = []
            for topic, times, fields in self._stream.messages(rows):
                if topic.name in self._publishers and len(times):
                    encoded = encode(layout(topic.kind, fields), fields, len(times))
                    for t, data in zip(np.asarray(times).tolist(), encoded, strict=True):
                        messages.append((t, self._publishers[topic.name], data.tobytes()))
            for t, publisher, data in sorted(messages, key=lambda message: message[0]):
                while (left := begin + (t / NS - first) / speed - time.monotonic()) > 0:
                    self._bus.spin_once(left)
                if until():
                    return count
                publisher.publish(data)
                count += 1
        return count
