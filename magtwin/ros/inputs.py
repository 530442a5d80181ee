"""Inputs: what a node hears, joined by stamp: of each topic the newest message not from the future."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import quat_conjugate, rotate
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import SENSOR_DATA, Topic
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Message, Subscription
from magtwin.ros.diagnostics import Status

Columns = dict[str, NDArray[Any]]

KEPT = 64
"""Messages of a topic that are kept to be joined."""

JUMP_S = 1.0
"""A stamp that is older than the last one by more begins anew: the robot was started again, or time was."""

AHEAD_S = 0.05
"""How far stamps may be ahead of the node's clock before that is said [s]."""

OTHER_S = 1e7
"""Stamps that are further from the node's clock are another clock's: sim time begins at 0 [s]."""

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""

SETTLE = 50
"""Accelerations after which it is known whether gravity is in them."""


class Input:
    """A topic that is heard as soon as somebody offers it, in any of the types that it can have."""

    def __init__(
        self, bus: Bus, topic: Topic, *, max_age_s: float, wanted: frozenset[str] | None = None
    ) -> None:
        """Begin to look for it.

        Args:
            bus: The node.
            topic: What it is called, and what its messages give.
            max_age_s: Age at which its newest message is stale [s].
            wanted: Columns that are read, all unless given; what stands in the others is nothing to it.
        """
        self.topic, self.max_age_s, self._bus, self._wanted = topic, max_age_s, bus, wanted
        self.name = bus.resolve(topic.name)
        """Its name on the network."""
        self._kind = ""
        self._subscription: Subscription | None = None
        self._kept: deque[tuple[int, Columns]] = deque(maxlen=KEPT)
        self.heard, self.broken, self.jumps, self.ahead = 0, 0, 0, 0
        self.sent_ns = 0
        self._heard_before, self._reported_ns = 0, 0
        self._trouble = ""
        self.silence = ""
        """What it means that nothing fresh is heard, where that is an answer too."""
        self._gravity: Gravity | None = Gravity() if "imu_a" in topic.needs else None

    def look(self) -> None:
        """Listen, if it is offered and was not heard yet."""
        kinds = self._bus.types(self.topic.name)
        known = [kind for kind in (self.topic.kind, *self.topic.reads) if kind in kinds]
        if self._subscription is not None:
            other = kinds and self._kind not in kinds
            self._trouble = f"offered as {', '.join(kinds)} now: start this node anew" if other else ""
        elif known:
            self._trouble = ""
            self._kind = known[0]
            self._subscription = self._bus.subscribe(self.topic.name, self._kind, self._hear, SENSOR_DATA)
        elif kinds:
            self._trouble = f"offered as {', '.join(kinds)}; {' or '.join(self.topic.reads)} can be read"

    def at(self, now_ns: int) -> tuple[Columns, float] | None:
        """Columns of the newest message that was taken by a time, one row, and its age [s]; none without."""
        for stamp, columns in reversed(self._kept):
            if stamp <= now_ns:
                return columns, (now_ns - stamp) / NS
        return None

    def forget(self) -> None:
        """Forget what was heard: time began anew."""
        self._kept.clear()

    def fresh(self, now_ns: int) -> Columns | None:
        """Columns as for `at`, none where they are stale."""
        found = self.at(now_ns)
        return None if found is None or found[1] > self.max_age_s else found[0]

    def missing(self, now_ns: int) -> str:
        """What to say where nothing is fresh."""
        return f"no fresh {self.name}{self._other_clock(now_ns)}"

    def _other_clock(self, now_ns: int) -> str:
        """A word on stamps that are years from this node's clock; "" where they are not."""
        if not self._kept or abs(now_ns - self._kept[-1][0]) < OTHER_S * NS:
            return ""
        simulated = self._kept[-1][0] < now_ns
        hint = "it is simulated: --sim-time, use_sim_time:=true" if simulated else "this node goes by /clock"
        return f", whose stamps are of another clock ({hint})"

    def status(self, now_ns: int) -> Status:
        """How it fares since this was asked last."""
        found = self.at(now_ns)
        span = (now_ns - self._reported_ns) / NS
        rate = (self.heard - self._heard_before) / span if 0 < span < 60 else 0.0
        self._heard_before, self._reported_ns = self.heard, now_ns
        senders = self._subscription.publishers() if self._subscription else 0
        level: Any = "ok"
        words = []
        if self._subscription is None:
            level, words = "stale", [self._trouble or "nobody offers it"]
        elif found is None:
            level = "stale"
            words.append("nothing heard yet" if not self._kept else "every stamp is ahead of the clock")
        elif found[1] > self.max_age_s:
            level = "stale"
            words.append(f"its newest is {found[1]:.2f} s old, more than {self.max_age_s:g} s")
            words[-1] += self._other_clock(now_ns)
        if level == "stale" and self.silence and not self._trouble:
            level, words = "ok", [self.silence]
        troubles = (
            (bool(self._trouble and self._subscription), self._trouble),
            (senders > 1, f"{senders} publishers; the newest message counts"),
            (bool(self.broken), f"{self.broken} messages could not be used"),
            (bool(self.jumps), f"stamps jumped back {self.jumps} times"),
            (bool(self.ahead), f"{self.ahead} stamps were ahead of this node's clock"),
        )
        for there, text in troubles:
            if there:
                level = "warn" if level == "ok" else level
                words.append(text)
        values = {
            "topic": self.name,
            "type": self._kind,
            "age [s]": "" if found is None else f"{found[1]:.3f}",
            "rate [Hz]": f"{rate:.1f}",
            "publishers": str(senders),
        }
        self.broken = self.jumps = self.ahead = 0
        return Status(f"input {self.name}", level, "; ".join(words) or "fresh", values)

    def _hear(self, message: Message) -> None:
        self.heard += 1
        try:
            stamp, columns = self._read(message)
        except InputError:
            self.broken += 1
            return
        wanted = columns.keys() if self._wanted is None else self._wanted & columns.keys()
        if not all(_is_told(name, columns[name]) for name in wanted):
            self.broken += 1
            return
        now = self._bus.now_ns()
        if now and stamp > now + AHEAD_S * NS:  # before the first of /clock all are
            self.ahead += 1
        if self._kept and stamp < self._kept[-1][0]:
            if stamp >= self._kept[-1][0] - JUMP_S * NS:
                return  # late or doubled: what is newer is known
            self.jumps += 1
            self._kept.clear()
        self.sent_ns = message.sent_ns
        self._kept.append((stamp, columns))

    def _read(self, message: Message) -> tuple[int, Columns]:
        stamped = layout(message.kind)[0].name == "header.stamp"
        wanted = (*self.topic.leaves(message.kind), *(("header.stamp",) if stamped else ()))
        fields = message.read(wanted)
        stamp = int(fields.pop("header.stamp")) if stamped else self._bus.now_ns()
        columns = self.topic.read(message.kind, {name: np.asarray(v)[None] for name, v in fields.items()})
        if self._gravity is not None:
            columns = self._gravity.without(columns)
        return stamp, columns


def _is_told(name: str, values: NDArray[Any]) -> bool:
    """Whether values are finite, and a rotation one: what tracks a robot says zeros where it lost it."""
    if name.endswith("_xyzw"):
        return bool(abs(np.linalg.norm(values) - 1) < 0.1)
    return bool(np.isfinite(values).all())


class Gravity:
    """Accelerations freed of gravity, if it is in them: their mean then is as long as it.

    Before that is known nothing is taken off, and nothing is given.
    """

    def __init__(self) -> None:
        self._sum, self._count = np.zeros(3), 0
        self.inside: bool | None = None

    def without(self, columns: Columns) -> Columns:
        """The same columns with `imu_a` free of gravity.

        Raises:
            InputError: It is not known yet whether it is.
        """
        if self.inside is None:
            self._sum += columns["imu_a"][0]
            self._count += 1
            mean = float(np.linalg.norm(self._sum)) / self._count
            self.inside = abs(mean - GRAVITY) < GRAVITY / 10
            if self._count < SETTLE and not self.inside and mean > 1.0:
                self.inside = None  # in motion; a mean of more tells
                raise InputError("it is not known yet whether gravity is in its accelerations")
        if not self.inside:
            return columns
        up = (0.0, 0.0, GRAVITY)
        return columns | {"imu_a": columns["imu_a"] - rotate(quat_conjugate(columns["imu_q_xyzw"]), up)}


class Scanning:
    """Whether a LiDAR spins, told by its scans: it does while they come."""

    def __init__(self, bus: Bus, topic: Topic, *, gap_s: float) -> None:
        """Begin to look for scans; `gap_s` is the longest time between two while it spins [s]."""
        self._bus, self._topic, self._gap_s = bus, topic, gap_s
        self._subscription: Subscription | None = None
        self._last_ns: int | None = None
        self.heard = 0

    def look(self) -> None:
        """As for `Input`."""
        if self._subscription is None and self._topic.kind in self._bus.types(self._topic.name):
            self._subscription = self._bus.subscribe(
                self._topic.name, self._topic.kind, self._hear, SENSOR_DATA
            )

    def on(self, now_ns: int) -> bool:
        """Whether it spins at a time."""
        return self._last_ns is not None and abs(now_ns - self._last_ns) < self._gap_s * NS

    def status(self, now_ns: int) -> Status:
        """As for `Input`; no scans are an answer too, so it is never stale."""
        told = "spins" if self.on(now_ns) else "no scans: it is taken as off"
        return Status(f"input {self._bus.resolve(self._topic.name)}", "ok", told, {"scans": str(self.heard)})

    def _hear(self, message: Message) -> None:
        self.heard += 1
        self._last_ns = self._bus.now_ns()


def newest_sent_ns(inputs: Mapping[str, Input]) -> int:
    """When the newest message of some inputs was sent, by the sender's wall clock [ns]; 0 before any."""
    return max((one.sent_ns for one in inputs.values()), default=0)
