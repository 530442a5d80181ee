"""Inputs of a node, joined by stamp: of each topic the newest message that is not in the future."""

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import quat_conjugate, quat_multiply, rotate
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import DESCRIPTION, LATCHED, SENSOR_DATA, TF_STATIC, Topic
from magtwin.io.bags.types import layout
from magtwin.io.recording.frames import LEAVES, Mount, StaticFrames, in_base, mount_of
from magtwin.io.recording.roles import Role, role_of
from magtwin.ros.bus import Bus, Message, Subscription
from magtwin.ros.diagnostics import Level, Problems, Status, status_of
from magtwin.spec.base import Quat

Columns = dict[str, NDArray[Any]]

Stamps = Literal["header", "arrival"]
"""Time of a message: the stamp of its header, or its arrival at this node."""

KEPT = 64
"""Messages kept per topic, beside those of its history."""

MOST_KEPT = 50_000
"""Most messages kept per topic."""

JUMP_S = 1.0
"""A stamp older than the last one by more than this means a restart of the robot or the clock [s]."""

AHEAD_S = 0.05
"""Stamps further ahead of the node's clock than this are reported [s]."""

OTHER_S = 1e7
"""Stamps further from the node's clock than this belong to another clock: simulated time begins at 0 [s]."""

SKEW_S = 1.0
"""Difference between the stamps of an input and the node's clock above which it is explained [s]."""

SKEWED = 3
"""Number of messages in a row whose stamps must differ so."""

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""

SETTLE = 50
"""Number of accelerations after which it is decided whether they contain gravity."""


STATICS = 100
"""Queue of /tf_static, which has a latched message of each of its publishers."""


class LiveFrames:
    """The frames of a robot, by /tf_static, and by its description where that has none."""

    def __init__(self, bus: Bus, axes: Mapping[str, Quat] | None = None) -> None:
        """Listen.

        Args:
            bus: The node.
            axes: Axes in base_link of the columns, by the noun of their role. Default: those of base_link.
        """
        self._known, self._axes = StaticFrames(), dict(axes or {})
        self._mounts: dict[tuple[str, ...], tuple[Mount | None, str]] = {}
        if bus.knows(TF_STATIC.kind):
            bus.subscribe(TF_STATIC.name, TF_STATIC.kind, self._hear, replace(LATCHED, depth=STATICS))
        if bus.knows(DESCRIPTION.kind):
            bus.subscribe(DESCRIPTION.name, DESCRIPTION.kind, self._described, LATCHED)

    def in_base(self, role: Role, frames: tuple[str, str], columns: Columns) -> tuple[Columns, str]:
        """Columns of a message in these frames as those of base_link; and what is wrong with the frames."""
        key = (role.noun, *frames)
        if key not in self._mounts:
            self._mounts[key] = mount_of(role, frames, self._known)
        mount, fault = self._mounts[key]
        if mount is not None:
            wanted = self._axes.get(role.noun)
            q = mount.q_xyzw if wanted is None else quat_multiply(quat_conjugate(wanted), mount.q_xyzw)
            columns = in_base(role, columns, mount._replace(q_xyzw=q))
        return columns, fault

    def _described(self, message: Message) -> None:
        with suppress(InputError):
            self._known.describe(str(message.read(["data"])["data"]))
        self._mounts.clear()

    def _hear(self, message: Message) -> None:
        parts = ("header.frame_id", "child_frame_id", "transform.translation", "transform.rotation")
        try:
            for k in range(message.read(["transforms"])["transforms"]):
                self._known.add(*message.read([f"transforms.{k}.{part}" for part in parts]).values())
        except InputError:
            return  # damaged
        self._mounts.clear()


class Input:
    """A topic, subscribed to when it is first published, in any of its readable types."""

    qos = SENSOR_DATA
    """QoS of the subscription."""

    def __init__(
        self,
        bus: Bus,
        topic: Topic,
        *,
        frames: LiveFrames,
        max_age_s: float,
        wanted: frozenset[str] | None = None,
        stamps: Stamps = "header",
        history_s: float = 0.0,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Start to search for it.

        Args:
            bus: The node.
            topic: Its name, and the columns of its messages.
            frames: Frames of the robot; its columns become those of base_link.
            max_age_s: Age at which its newest message is stale [s].
            wanted: Columns that must be valid. Default: all.
            stamps: Time of its messages.
            history_s: Time for which messages are kept [s], to be joined with a time that long ago.
            say: Called with messages for the user.
        """
        self.topic, self.max_age_s, self._bus, self._wanted = topic, max_age_s, bus, wanted
        self._frames, self._fault, self._told = frames, "", ""
        self.name = bus.resolve(topic.name)
        """Its name on the network."""
        self._kind = ""
        self._subscription: Subscription | None = None
        self._kept: deque[tuple[int, Columns]] = deque(maxlen=MOST_KEPT)
        self._history_ns = round(history_s * NS)
        self.heard, self.broken, self.jumps, self.ahead = 0, 0, 0, 0
        self.sent_ns = 0
        self._heard_before, self._reported_ns = 0, 0
        self._trouble = ""
        self._stamps, self._say = stamps, say
        self._behind_s: deque[tuple[float, float]] = deque(maxlen=SKEWED)
        self._skewed = False
        self.silence = ""
        """Meaning of silence, if silence is not a fault."""
        self._gravity: Gravity | None = Gravity() if "imu_a" in topic.needs else None

    def look(self) -> None:
        """Subscribe if it is published and not subscribed to yet."""
        kinds = self._bus.types(self.topic.name)
        known = [kind for kind in (self.topic.kind, *self.topic.reads) if kind in kinds]
        if self._subscription is not None:
            other = kinds and self._kind not in kinds
            self._trouble = f"published as {', '.join(kinds)} now: restart this node" if other else ""
        elif known:
            self._trouble = ""
            self._kind = known[0]
            self._subscription = self._bus.subscribe(self.topic.name, self._kind, self._hear, self.qos)
        elif kinds:
            self._trouble = f"published as {', '.join(kinds)}; readable: {', '.join(self.topic.reads)}"

    def at(self, now_ns: int) -> tuple[Columns, float] | None:
        """Columns of the newest message not after a time, one row, and its age [s]; None if there is none."""
        for stamp, columns in reversed(self._kept):
            if stamp <= now_ns:
                return columns, (now_ns - stamp) / NS
        return None

    def forget(self) -> None:
        """Drop all messages, after a restart of time."""
        self._kept.clear()
        self._behind_s.clear()

    def _clock(self) -> str:
        """What is wrong with the last stamps against the node's clock, and what to do; "" if they are near.

        A sender whose clock differs also sends at another time than that of receipt. Otherwise the stamps are
        wrong, or late, by themselves.
        """
        if self._stamps == "arrival" or len(self._behind_s) < SKEWED:
            return ""
        behind, sent = min(self._behind_s, key=lambda pair: abs(pair[0]))
        if abs(behind) < SKEW_S or len({late > 0 for late, _ in self._behind_s}) > 1:
            return ""
        if abs(behind) > OTHER_S:
            how = "--sim-time, use_sim_time:=true" if behind > 0 else "this node goes by /clock"
            return f"its stamps are of another clock ({how})"
        instead = "or count from arrival (stamps)"
        if abs(sent) > SKEW_S / 2:
            off = f"{abs(sent):.1f} s {'behind' if sent > 0 else 'ahead of'}"
            return f"the clock of its sender is {off} this machine's: synchronize them (chrony), {instead}"
        off = f"{abs(behind):.1f} s {'behind' if behind > 0 else 'ahead of'}"
        return f"its stamps are {off} this node's clock when they are sent: correct its driver, {instead}"

    def fresh(self, now_ns: int) -> Columns | None:
        """Columns as for `at`; None if they are stale."""
        latest = self.at(now_ns)
        return None if latest is None or latest[1] > self.max_age_s else latest[0]

    def missing(self) -> str:
        """Message if nothing is fresh."""
        why = self._fault or self._clock()
        return f"no fresh {self.name}{f': {why}' if why else ''}"

    def status(self, now_ns: int) -> Status:
        """Its state since the previous call."""
        latest = self.at(now_ns)
        span = (now_ns - self._reported_ns) / NS
        rate = (self.heard - self._heard_before) / span if 0 < span < 60 else 0.0
        self._heard_before, self._reported_ns = self.heard, now_ns
        if self._fault and self._fault != self._told:
            self._say(f"{self.name}: {self._fault}")
        self._told = self._fault
        senders = self._subscription.publishers() if self._subscription else 0
        stale = ""
        if self._subscription is None:
            stale = self._trouble or "nobody publishes it"
        elif latest is None:
            stale = "every stamp is ahead of the clock" if self._kept else "nothing received yet"
        elif latest[1] > self.max_age_s:
            stale = f"its newest is {latest[1]:.2f} s old, more than {self.max_age_s:g} s"
        expected = bool(stale and self.silence and not self._trouble)
        more, told = self._more(now_ns)
        problems = (
            (bool(self._trouble and self._subscription), self._trouble),
            (bool(self._fault), self._fault),
            (senders > 1, f"{senders} publishers; the newest message counts"),
            (bool(self.broken), f"{self.broken} messages could not be used"),
            (bool(self.jumps), f"stamps jumped back {self.jumps} times"),
            (bool(self.ahead), f"{self.ahead} stamps were ahead of this node's clock"),
            (bool(self._clock()), self._clock()),
            *more,
        )
        values = {
            "topic": self.name,
            "type": self._kind,
            "age [s]": "" if latest is None else f"{latest[1]:.3f}",
            "rate [Hz]": f"{rate:.1f}",
            "publishers": str(senders),
            **told,
        }
        self.broken = self.jumps = self.ahead = 0
        words = [self.silence if expected else stale] if stale else []
        level: Level = "stale" if stale and not expected else "ok"
        name = f"input {self.name}"
        return status_of(name, problems, fine="fresh", level=level, words=words, values=values)

    def _more(self, now_ns: int) -> tuple[Problems, dict[str, str]]:
        """Further problems since the previous call, and values."""
        return (), {}

    def _hear(self, message: Message) -> None:
        self.heard += 1
        try:
            stamp, columns = self._read(message)
        except InputError:
            self.broken += 1
            return
        wanted = columns.keys() if self._wanted is None else self._wanted & columns.keys()
        for name in wanted:  # trackers send a zero rotation for a lost robot
            unit = not name.endswith("_xyzw") or abs(np.linalg.norm(columns[name]) - 1) < 0.1
            if not (unit and np.isfinite(columns[name]).all()):
                self.broken += 1
                return
        self._take(message, stamp, columns)

    def _take(self, message: Message, stamp: int, columns: Columns) -> None:
        """Use a valid message."""
        now = self._bus.now_ns()
        self._compare(now, stamp, message)
        if now and stamp > now + AHEAD_S * NS:  # before the first /clock, all stamps are ahead
            self.ahead += 1
        if self._kept and stamp < self._kept[-1][0]:
            if stamp >= self._kept[-1][0] - JUMP_S * NS:
                return  # late or repeated: a newer one is known
            self.jumps += 1
            self._kept.clear()
        self.sent_ns = message.sent_ns
        if self._kept and stamp == self._kept[-1][0]:
            self._kept.pop()
        self._kept.append((stamp, columns))
        while len(self._kept) > KEPT and self._kept[1][0] < stamp - self._history_ns:
            self._kept.popleft()

    def _compare(self, now: int, stamp: int, message: Message) -> None:
        """Compare a stamp with the node's clock; reports a large difference once."""
        if not now:
            return
        self._behind_s.append(((now - stamp) / NS, (message.received_ns - message.sent_ns) / NS))
        if bool(fault := self._clock()) != self._skewed:
            self._skewed = bool(fault)
            self._say(f"{self.name}: {fault or 'its stamps are near the clock again'}")

    def _read(self, message: Message) -> tuple[int, Columns]:
        stamped = layout(message.kind)[0].name == "header.stamp"
        role = role_of(self.topic.reads[message.kind])
        framed = [leaf.name for leaf in layout(message.kind) if role and leaf.name in LEAVES]
        wanted = (*self.topic.leaves(message.kind), *framed, *(("header.stamp",) if stamped else ()))
        fields = message.read(wanted)
        header, child = (str(fields.pop(leaf, "")) for leaf in LEAVES)
        stamp = int(fields.pop("header.stamp")) if stamped else self._bus.now_ns()
        if self._stamps == "arrival":
            stamp = self._bus.now_ns()
        columns = self.topic.read(message.kind, {name: np.asarray(v)[None] for name, v in fields.items()})
        if role:
            columns, self._fault = self._frames.in_base(role, (header, child), columns)
            if self._fault and role.position:
                self._fault += ": publish that transform, or the pose of base_link"
                raise InputError(self._fault)
        if self._gravity is not None:
            columns = self._gravity.without(columns)
        return stamp, columns


class Gravity:
    """Subtracts gravity from accelerations that contain it, which their mean shows.

    Until that is decided, accelerations are refused.
    """

    def __init__(self) -> None:
        self._sum, self._count = np.zeros(3), 0
        self.inside: bool | None = None

    def without(self, columns: Columns) -> Columns:
        """The columns with `imu_a` without gravity.

        Raises:
            InputError: Not decided yet whether they contain it.
        """
        if self.inside is None:
            self._sum += columns["imu_a"][0]
            self._count += 1
            mean = float(np.linalg.norm(self._sum)) / self._count
            self.inside = abs(mean - GRAVITY) < GRAVITY / 10
            if self._count < SETTLE and not self.inside and mean > 1.0:
                self.inside = None  # in motion; a longer mean decides
                raise InputError("not decided yet whether its accelerations contain gravity")
        if not self.inside:
            return columns
        up = (0.0, 0.0, GRAVITY)
        return columns | {"imu_a": columns["imu_a"] - rotate(quat_conjugate(columns["imu_q_xyzw"]), up)}


class Scanning:
    """Whether a LiDAR spins: it does while scans arrive."""

    def __init__(self, bus: Bus, topic: Topic, *, gap_s: float, history_s: float = 0.0) -> None:
        """Start to search for scans.

        Args:
            bus: The node.
            topic: Their topic.
            gap_s: Longest time between two while it spins [s].
            history_s: As for `Input`.
        """
        self._bus, self._topic, self._gap_s = bus, topic, gap_s
        self._subscription: Subscription | None = None
        self._times_ns: deque[int] = deque(maxlen=MOST_KEPT)
        self._kept_ns = round((history_s + gap_s) * NS)
        self.heard = 0

    def look(self) -> None:
        """As for `Input`."""
        name, kind = self._topic.name, self._topic.kind
        if self._subscription is None and kind in self._bus.types(name):
            self._subscription = self._bus.subscribe(name, kind, self._hear, SENSOR_DATA)

    def on(self, now_ns: int) -> bool:
        """Whether it spins at a time [ns]."""
        last = next((t_ns for t_ns in reversed(self._times_ns) if t_ns <= now_ns), None)
        return last is not None and now_ns - last < self._gap_s * NS

    def forget(self) -> None:
        """As for `Input`."""
        self._times_ns.clear()

    def status(self, now_ns: int) -> Status:
        """As for `Input`; silence means that it does not spin, so it is never stale."""
        text = "spins" if self.on(now_ns) else "no scans: taken as off"
        return Status(f"input {self._bus.resolve(self._topic.name)}", "ok", text, {"scans": str(self.heard)})

    def _hear(self, message: Message) -> None:
        self.heard += 1
        self._times_ns.append(self._bus.now_ns())
        while self._times_ns[0] < self._times_ns[-1] - self._kept_ns:
            self._times_ns.popleft()
