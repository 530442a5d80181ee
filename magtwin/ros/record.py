"""Record topics to a bag, which is a run; replay a run to topics."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Literal

from magtwin.errors import InputError
from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.sender import Transforms, Unit, prefixed
from magtwin.io.bags.stream import Stream
from magtwin.io.bags.topics import Qos
from magtwin.io.bags.twin_sender import sender_for
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Message
from magtwin.ros.bus.names import checked_prefix
from magtwin.ros.topics import READ, RECORDED, SAMPLED, TICKS
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
    """Records topics of any type, each from when it is first published.

    If time jumps back, as after a reset of a simulator, the recording ends.
    """

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
            topics: Names of topics to record beside those of the robot, without which a bag is no drive.
            sim_time: Whether the clock is /clock, which may jump back.
            say: Called with messages for the user.
        """
        self._bus, self._writer, self._say, self._sim_time = bus, writer, say, sim_time
        known = {topic.name: topic for topic in RECORDED}
        usual = {bus.resolve(name): name for name in known}
        self._named = {name: usual.get(bus.resolve(name), name) for name in topics}
        """Name in the bag of each topic asked for by name."""
        self._waited = {name: known.get(name) for name in (*known, *self._named.values())}
        self._refused: dict[str, str] = {}
        self._looked, self._flushed = 0.0, time.monotonic()
        self._last_ns, self._clock_ns = -1, -1
        self.ended = False
        """Whether time jumped back, which ends the recording."""

    def run(self, until: Callable[[], bool] = lambda: False, *, duration_s: float | None = None) -> None:
        """Record until `until` is true, for a wall time [s], or until time jumps back."""
        begin = time.monotonic()
        while not (self.ended or until()) and (duration_s is None or time.monotonic() - begin < duration_s):
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

    def missing(self) -> dict[str, str]:
        """The topics asked for by name of which nothing was recorded, each with the reason."""
        counts = self._writer.counts
        reasons = dict.fromkeys(self._waited, "nobody publishes it") | self._refused
        lost = {name: kept for name, kept in self._named.items() if not counts.get(kept)}
        return {name: reasons.get(kept, "no message came") for name, kept in lost.items()}

    def _look(self) -> None:
        """Subscribe to new topics."""
        for name, topic in list(self._waited.items()):
            offers = self._bus.offers(name)
            kinds = sorted({offer.kind for offer in offers if offer.kind and self._bus.knows(offer.kind)})
            if not kinds:
                others = sorted({offer.kind or "no ROS type" for offer in offers})
                if others:
                    self._refuse(name, f"it is published as {', '.join(others)}, which is not known here")
                continue
            kind = topic.kind if topic is not None and topic.kind in kinds else kinds[0]
            of_kind = [offer for offer in offers if offer.kind == kind]
            latched = all(offer.latched for offer in of_kind)
            qos = Qos(depth=DEPTH, reliable=all(offer.reliable for offer in of_kind), latched=latched)
            try:
                self._writer.add(name, kind, qos, digest=of_kind[0].digest)
            except InputError as error:
                self._refuse(name, str(error))
                continue
            del self._waited[name]
            self._refused.pop(name, None)
            if len(kinds) > 1:
                self._say(f"{name} is published as {' and as '.join(kinds)}; recording {kind}")
            self._bus.subscribe(name, kind, partial(self._heard, name), qos)

    def _refuse(self, name: str, why: str) -> None:
        if self._refused.get(name) != why:
            self._refused[name] = why
            self._say(f"{name} is not recorded: {why}")

    def _heard(self, name: str, message: Message) -> None:
        now = self._bus.now_ns()
        if self.ended or self._jumped(name, message, now):
            if not self.ended:
                self._say("time jumped back, as after a reset: the recording ends here; start another")
            self.ended = True
            return
        self._last_ns = now = max(now, self._last_ns)  # times in the bag never go back
        self._writer.write(name, now, message.data)

    def _jumped(self, name: str, message: Message, now_ns: int) -> bool:
        """Whether time jumped back: that of the node, or in the recorded /clock."""
        if self._sim_time:
            return now_ns < self._last_ns
        if name != TICKS.name:
            return False
        with suppress(InputError):  # a damaged message
            before, self._clock_ns = self._clock_ns, int(message.read(["clock"])["clock"])
            return self._clock_ns < before
        return False


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
        stamps: Literal["run", "wall"] = "run",
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
            stamps: Time of the messages and of /clock: that of the run, or wall time.
            frame_prefix: Prefix of the names of frames, such as "tb4/".
            tf: Transforms of the drive on /tf, as for `magtwin.ros.simulate.Simulator`.

        Raises:
            InputError: The run has no column of these topics.
        """
        self._run, self._bus, self._wall = run, bus, stamps == "wall"
        sender = sender_for(twin, units, run.metadata.get("rate_hz"))
        sender = replace(prefixed(sender, checked_prefix(frame_prefix)), transforms=tf)
        self._stream = Stream(run, sender, None, topics=(*SAMPLED.values(), *READ), whole=True)
        chosen = [t for t in self._stream.topics if bus.knows(t.kind) and (not topics or t.name in topics)]
        if not chosen:
            raise InputError(f"the run has no columns of {', '.join(topics) or 'any topic'}")
        self._publishers = {t.name: bus.publisher(t.name, t.kind, t.qos) for t in chosen}
        self._begun = time.monotonic()

    def run(self, until: Callable[[], bool] = lambda: False, *, speed: float = 1.0) -> int:
        """Publish it at `speed` times real time, after `SETTLE_S`; returns the number of messages."""
        first, count = round(self._run["t"][0] * NS), 0
        begin = max(time.monotonic(), self._begun + SETTLE_S)
        # at a pace other than 1, stamps run at that pace from the wall time of the beginning
        later = time.time_ns() + round((begin - time.monotonic()) * NS) - first if self._wall else 0
        for row in range(0, self._run.rows, AT_A_TIME):
            messages: list[tuple[int, str, bytes]] = []
            for topic, times, fields in self._stream.messages(self._run.take(slice(row, row + AT_A_TIME))):
                if topic.name in self._publishers and len(times):
                    stamped = {n: fields[n] + later for n in fields if n.endswith(("stamp", "clock"))}
                    data = encode(layout(topic.kind, fields), fields | stamped, len(times))
                    sent = zip(times.tolist(), data, strict=True)
                    messages += [(t, topic.name, one.tobytes()) for t, one in sent]
            for t, name, one in sorted(messages, key=lambda message: message[0]):
                while (left := begin + (t - first) / NS / speed - time.monotonic()) > 0:
                    self._bus.spin_once(left)
                if until():
                    return count
                self._publishers[name].publish(one)
                count += 1
        return count
