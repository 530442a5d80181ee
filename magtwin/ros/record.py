"""Record and replay: topics to a bag, which is a run; and a run to topics."""

import heapq
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.sender import Unit, sender_for
from magtwin.io.bags.stream import Stream
from magtwin.io.bags.topics import Qos
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Message, Publisher
from magtwin.ros.topics import READ, RECORDED, SAMPLED
from magtwin.run.run import Run
from magtwin.twin import Twin

FLUSH_S = 1.0
"""Time between flushes, by the wall [s]."""

LOOK_S = 0.5
"""Time between looks for topics that were not offered before [s]."""

DEPTH = 1000
"""Messages of a topic that may wait to be taken in: none is lost while a file is written."""

SETTLE_S = 1.5
"""Time that others have to find topics before the first message is said, by the wall [s]."""

AT_A_TIME = 1024
"""Rows of a run that are turned into messages at a time."""


class Recorder:
    """What records topics, each as soon as somebody offers it."""

    def __init__(
        self,
        bus: Bus,
        writer: RawBagWriter,
        topics: Iterable[str] = (),
        *,
        sim_time: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Begin to listen.

        Args:
            bus: The node; its clock dates the messages.
            writer: Where they go.
            topics: Names of those to record; none takes all of the robot's.
            sim_time: Whether that clock is /clock's, which may go back.
            say: Takes lines for people.
        """
        self._bus, self._writer, self._say, self._sim_time = bus, writer, say, sim_time
        known = {topic.name: topic for topic in RECORDED}
        names = list(topics) or list(known)
        self._waited = {name: known.get(name) for name in names}
        self._looked, self._flushed = 0.0, time.monotonic()
        self._last_ns = -1

    def run(self, until: Callable[[], bool] = lambda: False, *, duration_s: float | None = None) -> None:
        """Record until that says so, or for a time by the wall [s]."""
        begin = time.monotonic()
        while not until() and (duration_s is None or time.monotonic() - begin < duration_s):
            self.step()
            self._bus.spin_once(0.05)

    def step(self) -> None:
        """Look for topics, and write what came, each in its time; to be called often while the bus spins."""
        now = time.monotonic()
        if now - self._looked > LOOK_S:
            self._looked = now
            self._look()
        if now - self._flushed > FLUSH_S:
            self._flushed = now
            self._writer.flush()

    def _look(self) -> None:
        """Listen to what is offered now and was not before."""
        for name, topic in list(self._waited.items()):
            kinds = [kind for kind in self._bus.types(name) if self._bus.knows(kind)]
            if not kinds:
                continue
            del self._waited[name]
            kind = topic.kind if topic is not None and topic.kind in kinds else kinds[0]
            if len(kinds) > 1:
                self._say(f"{name} is offered as {' and as '.join(kinds)}; {kind} is recorded")
            latched = topic is not None and topic.qos.latched
            qos = Qos(
                depth=DEPTH, reliable=latched or (topic is not None and topic.qos.reliable), latched=latched
            )
            self._writer.add(name, kind, qos)
            self._bus.subscribe(name, kind, partial(self._heard, name), qos)

    def _heard(self, name: str, message: Message) -> None:
        now = self._bus.now_ns()
        if self._sim_time and now < self._last_ns:
            raise InputError(
                f"time jumped back from {self._last_ns / NS:.3f} to {now / NS:.3f} s, as after a reset: the "
                "recording ends here; record anew"
            )
        self._last_ns = now = max(now, self._last_ns)  # a clock that was set is not followed back
        self._writer.write(name, now, message.data)


class Player:
    """What says a run again, as its robot would have."""

    def __init__(
        self,
        run: Run,
        bus: Bus,
        twin: Twin | None = None,
        *,
        units: Unit = "T",
        topics: Sequence[str] = (),
    ) -> None:
        """Offer its topics.

        Args:
            run: What happened.
            bus: The node.
            twin: What it happened in: gives frames, covariances, /tf_static and the robot's description.
            units: Unit of fields.
            topics: Names of those to say; none says all.

        Raises:
            InputError: The run has none of them.
        """
        self._run = run
        who = sender_for(twin, units, run.metadata.get("rate_hz"))
        self._stream = Stream(run, who, None, topics=(*READ, *SAMPLED.values()), whole=True)
        said = [t for t in self._stream.topics if bus.knows(t.kind) and (not topics or t.name in topics)]
        if not said:
            raise InputError(f"the run has no columns of {', '.join(topics) or 'any topic'}")
        self._publishers: dict[str, Publisher] = {t.name: bus.publisher(t.name, t.kind, t.qos) for t in said}
        self._bus, self._begun = bus, time.monotonic()

    def run(self, until: Callable[[], bool] = lambda: False, *, speed: float = 1.0) -> int:
        """Say it, `speed` times as fast as it was, once others had `SETTLE_S`; how many messages."""
        first = float(self._run["t"][0])
        begin = max(time.monotonic(), self._begun + SETTLE_S)
        count = 0
        for row in range(0, self._run.rows, AT_A_TIME):
            rows = self._run.take(slice(row, row + AT_A_TIME))
            for t, publisher, data in self._messages(rows):
                while (left := begin + (t / NS - first) / speed - time.monotonic()) > 0:
                    self._bus.spin_once(left)
                if until():
                    return count
                publisher.publish(data)
                count += 1
        return count

    def _messages(self, rows: Run) -> list[tuple[int, Publisher, bytes]]:
        events: list[tuple[int, int, Publisher, bytes]] = []
        for topic, times, fields in self._stream.messages(rows):
            if topic.name in self._publishers and len(times):
                encoded = encode(layout(topic.kind, fields), fields, len(times))
                for t, data in zip(np.asarray(times).tolist(), encoded, strict=True):
                    heapq.heappush(events, (t, len(events), self._publishers[topic.name], data.tobytes()))
        return [(t, publisher, data) for t, _, publisher, data in sorted(events, key=lambda e: e[:2])]
