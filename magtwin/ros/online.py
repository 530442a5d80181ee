"""Online: a mixed model that follows its session in a node, from poses that become known late.

The node keeps its inputs and the measured field for a while. A pose whose stamp lies in the past is joined
with the inputs and the reading of that time, and updates the effects of the session.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap, Outside
from magtwin.field.units import LEAST_USUAL_NT, MOST_USUAL_NT, NT_PER
from magtwin.frames import yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.frames import role_of
from magtwin.io.bags.topics import MAGNITUDE, POSE, Qos
from magtwin.io.bags.types import layout
from magtwin.ros.bus import Bus, Handler, Message, Subscription, is_name
from magtwin.ros.diagnostics import Level, Status, status_of
from magtwin.ros.inputs import AHEAD_S, JUMP_S, MOST_KEPT, OTHER_S, LiveFrames, frames_in

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Reading, Signals
    from magtwin.learn.mixed.effects import FollowedEffects
    from magtwin.learn.models.predictor import Predictor

QUIET_S = 30.0
"""Time without a used pose after which a warning is given [s]."""

NEAREST_S = 0.1
"""Longest time between a pose and the measured field that is joined with it [s]."""

AGES = 50
"""Number of poses whose median age is the delay of poses."""

QUEUE = Qos(depth=200, reliable=False)
"""Late poses may come in bursts; the measured field comes at a high rate."""


class Online:
    """The effects of the session, followed from late poses and a measured field."""

    def __init__(
        self,
        bus: Bus,
        model: "Predictor",
        field: AnomalyMap,
        settings: Mapping[str, Any],
        *,
        frames: LiveFrames,
        poses: str,
        measured: str,
        seconds: Callable[[int], float],
        signals: Callable[[int], "Signals | str"],
        say: Callable[[str], None],
    ) -> None:
        """Search for its two topics.

        Args:
            bus: The node.
            model: A mixed model.
            field: The map that it was trained on.
            settings: Current values of the node's parameters.
            frames: Frames of the robot.
            poses: Topic of the poses.
            measured: Topic of the measured field.
            seconds: Time of the model [s] by that of the node [ns].
            signals: Signals at a time of the node [ns], or what is missing.
            say: Called with messages for the user.

        Raises:
            InputError: The model is of another kind, or a type of a topic is not supported.
        """
        from magtwin.learn.data.alignment import alignment_of
        from magtwin.learn.inference.calibrate import mixed_of_kind

        self._bus, self._model, self._field, self._settings = bus, mixed_of_kind(model), field, settings
        self._seconds, self._signals, self._say, self._frames = seconds, signals, say, frames
        self._alignment = alignment_of(model.metadata, "the model")
        self._late_ns = round(self._alignment.latency_s * NS)
        self.poses = _Source(bus, "online", poses, tuple(POSE.reads), self._pose_heard)
        """Their topic."""
        self.measured = Measured(bus, measured)
        self.used = 0
        """Number of poses that updated the effects."""
        self._unused: Counter[str] = Counter()
        self._ages_s: deque[float] = deque(maxlen=AGES)
        self._newest_s = math.nan
        self.forget()
        self.look()

    @property
    def effects(self) -> "FollowedEffects":
        """The effects of the session."""
        return self._online.effects

    def forget(self) -> None:
        """Begin again with the effects of the model, after a restart of time."""
        from magtwin.learn.inference.online import OnlineMagnetometer

        self._online = OnlineMagnetometer(self._model, self._field, lever_arm_m=self._alignment.lever_arm_m)
        self.measured.forget()
        self._ages_s.clear()
        self._quiet_ns = 0

    def look(self) -> None:
        """Subscribe to topics that are published and not subscribed to yet.

        Raises:
            InputError: A topic is published in a type that is not supported.
        """
        self.poses.look()
        self.measured.look()

    def read(
        self, t: float, p_xy: Sequence[float], yaw: float, signals: "Signals", *, outside: Outside
    ) -> "Reading":
        """As for `magtwin.learn.inference.online.OnlineMagnetometer`."""
        return self._online.read(t, p_xy, yaw, signals, outside=outside)

    def _pose_heard(self, message: Message) -> None:
        self.poses.heard += 1
        now = self._bus.now_ns()
        fields = self._fields(message)
        if fields is None:
            self._unused["were not valid"] += 1
            return
        frame = str(fields["header.frame_id"]).lstrip("/")
        if frame not in ("", self._settings["map_frame"]):
            if not self.used:
                raise InputError(
                    f"`online={self.poses.name}`: its poses are in frame {frame!r}, and the map is in "
                    f"{self._settings['map_frame']!r}; transform them, or set map_frame:={frame} if the two "
                    "are the same"
                )
            self._unused[f"were in frame {frame!r}"] += 1
            return
        role = role_of(POSE.needs)
        assert role is not None
        pose = {name: fields[key][None] for name, key in zip(POSE.needs, ("p", "q_xyzw"), strict=True)}
        pose, fault = self._frames.in_base(role, (frame, str(fields.get("child_frame_id", ""))), pose)
        if fault:
            self._unused[f"were refused, {fault}"] += 1
            return
        p, q = (pose[name][0] for name in POSE.needs)
        fields |= {"p": p, "q_xyzw": q}
        stamp = int(fields["header.stamp"])
        self._newest_s = (now - stamp) / NS
        if why := self._use(stamp, fields):
            self._unused[why] += 1

    def _fields(self, message: Message) -> dict[str, Any] | None:
        """Fields of a pose; None if they are damaged, not finite or no rotation."""
        wanted = ["header.stamp", *frames_in(message.kind), *POSE.leaves(message.kind)]
        known = {leaf.name for leaf in layout(message.kind)}
        try:
            fields = message.read([*wanted, *(["pose.covariance"] if "pose.covariance" in known else [])])
        except InputError:
            return None
        p, q = (np.asarray(fields[leaf], float) for leaf in POSE.leaves(message.kind))
        if not np.isfinite([*p, *q]).all() or abs(np.linalg.norm(q) - 1) > 0.1:
            return None
        return fields | {"p": p, "q_xyzw": q}

    def _use(self, stamp: int, fields: Mapping[str, Any]) -> str:
        """Update the effects by the reading at a pose; the reason if it could not be used, else ""."""
        if self._newest_s < -AHEAD_S:
            return f"were ahead of this node's clock{self._other_clock()}"
        buffer_s = self._settings["buffer_s"]
        if self._newest_s > buffer_s:
            return f"were older than the buffer of {buffer_s:g} s{self._other_clock()}"
        taken = stamp + self._late_ns  # the reading of this pose
        t = self._seconds(taken)
        if not self.effects.due(t):
            return ""
        b_nt = self.measured.nearest(taken)
        if b_nt is None:
            return f"had no measured field within {NEAREST_S:g} s"
        signals = self._signals(taken)
        if isinstance(signals, str):
            return f"had {signals}"
        x, y = fields["p"][:2].tolist()
        yaw = float(yaw_from_quat(fields["q_xyzw"]))
        if not self._online.update(t, (x, y), yaw, signals, b_nt, pose_sd_m=self._sd_m(fields)):
            return "were off the map"
        if not self.used:
            self._say(f"following the session by poses {self._newest_s:.1f} s old")
        self.used += 1
        self._quiet_ns = self._bus.now_ns()
        self._ages_s.append(max(self._newest_s, 0.0))
        self.effects.delay_s = self._delay_s
        return ""

    @property
    def _delay_s(self) -> float:
        return float(np.median(self._ages_s or [math.nan]))

    def _other_clock(self) -> str:
        return ", whose stamps are of another clock" if abs(self._newest_s) > OTHER_S else ""

    def _sd_m(self, fields: Mapping[str, Any]) -> float:
        """Standard deviation of each axis of a position, from its covariance if that is known [m]."""
        if "pose.covariance" in fields:
            variance = float(np.mean(np.asarray(fields["pose.covariance"])[[0, 7]]))
            if 0 < variance < math.inf:
                return math.sqrt(variance)
        return float(self._settings["pose_sd_m"])

    def statuses(self, now_ns: int) -> list[Status]:
        """State of the two topics since the previous call."""
        self._quiet_ns = self._quiet_ns or now_ns
        quiet_s = (now_ns - self._quiet_ns) / NS
        why = "" if self.poses.subscription else ": nobody publishes it"
        problems = (
            (quiet_s > QUIET_S, f"no pose was used for {quiet_s:.0f} s{why}"),
            *((count, f"{count} poses {reason}") for reason, count in self._unused.items()),
            (self.poses.publishers > 1, f"{self.poses.publishers} publishers"),
        )
        values = {
            **self.poses.values,
            "poses": str(self.poses.heard),
            "poses used": str(self.used),
            "age of the newest [s]": f"{self._newest_s:.2f}",
            "median age [s]": f"{self._delay_s:.2f}",
            "interval factor": f"{self.effects.widening:.2f}",
        }
        self._unused.clear()
        fine = "following the session" if self.used else "no pose yet: the effects are those of the model"
        name = f"online {self.poses.name}"
        return [status_of(name, problems, fine=fine, values=values), self.measured.status(now_ns)]


class Measured:
    """The field that a real sensor measures, kept for a while."""

    def __init__(self, bus: Bus, topic: str) -> None:
        """Prepare to subscribe; types are those of the magnetometer's topic in a bag."""
        self._bus = bus
        self._topic = _Source(bus, "measured", topic, tuple(MAGNITUDE.reads), self._hear)
        self._kept: deque[tuple[int, float]] = deque(maxlen=MOST_KEPT)
        self.history_s = 0.0
        """As for `magtwin.ros.inputs.Input`."""
        self._broken = 0

    def look(self) -> None:
        """As for `Online`."""
        self._topic.look()

    def forget(self) -> None:
        """Drop all readings."""
        self._kept.clear()

    def nearest(self, at_ns: int) -> float | None:
        """The reading nearest to a time [nT]; None if there is none within `NEAREST_S`."""
        best = None
        for stamp, b_nt in reversed(self._kept):
            if best is not None and abs(stamp - at_ns) >= abs(best[0] - at_ns):
                break
            best = stamp, b_nt
        return best[1] if best is not None and abs(best[0] - at_ns) <= NEAREST_S * NS else None

    def status(self, now_ns: int) -> Status:
        """Its state since the previous call."""
        age_s = (now_ns - self._kept[-1][0]) / NS if self._kept else math.nan
        stale = ""
        if self._topic.subscription is None:
            stale = "nobody publishes it"
        elif not self._kept:
            stale = "nothing received yet"
        elif abs(age_s) > 1.0:
            stale = f"its newest is {age_s:.2f} s old"
        problems = (
            (self._broken, f"{self._broken} messages could not be used"),
            (self._topic.publishers > 1, f"{self._topic.publishers} publishers"),
        )
        values = {**self._topic.values, "age [s]": f"{age_s:.3f}", "readings": str(self._topic.heard)}
        self._broken = 0
        level: Level = "stale" if stale else "ok"
        words = [stale] if stale else []
        name = f"input {self._topic.name}"
        return status_of(name, problems, fine="fresh", level=level, words=words, values=values)

    def _hear(self, message: Message) -> None:
        self._topic.heard += 1
        stamped = layout(message.kind)[0].name == "header.stamp"
        leaf = MAGNITUDE.reads[message.kind]["magnetic_field"]
        try:
            fields = message.read([str(leaf), *(["header.stamp"] if stamped else [])])
        except InputError:
            self._broken += 1
            return
        # a magnitude, a magnitude in x, or a vector; in T, or in nT as on APRILab's robot
        size = float(np.linalg.norm(fields[str(leaf)]))
        b_nt = next((size * NT_PER[u] for u in ("T", "nT") if _is_earths(size * NT_PER[u])), math.nan)
        stamp = int(fields["header.stamp"]) if stamped else self._bus.now_ns()
        if math.isnan(b_nt):
            self._broken += 1
            return
        if self._kept and stamp <= self._kept[-1][0]:
            if stamp >= self._kept[-1][0] - JUMP_S * NS:
                return  # late or repeated
            self._kept.clear()
        self._kept.append((stamp, b_nt))
        while self._kept[0][0] < stamp - round(self.history_s * NS):
            self._kept.popleft()


def _is_earths(b_nt: float) -> bool:
    return LEAST_USUAL_NT <= b_nt < MOST_USUAL_NT


class _Source:
    """A topic that is subscribed to when it is first published, in one of some types."""

    def __init__(self, bus: Bus, parameter: str, topic: str, kinds: Sequence[str], handler: Handler) -> None:
        if not is_name(topic):
            raise InputError(f"`{parameter}={topic}` is not a topic's name: use letters, digits, _ and /")
        self._bus, self._parameter, self._topic, self._kinds = bus, parameter, topic, kinds
        self._handler = handler
        self.name, self.kind, self.heard = bus.resolve(topic), "", 0
        self.subscription: Subscription | None = None

    def look(self) -> None:
        if self.subscription is not None:
            return
        offered = self._bus.types(self._topic)
        kind = next((kind for kind in self._kinds if kind in offered), None)
        if kind is not None:
            self.kind = kind
            self.subscription = self._bus.subscribe(self._topic, kind, self._handler, QUEUE)
        elif offered:
            raise InputError(
                f"`{self._parameter}={self.name}` is published as {', '.join(offered)}; supported are "
                f"{', '.join(self._kinds)}"
            )

    @property
    def publishers(self) -> int:
        return self.subscription.publishers() if self.subscription else 0

    @property
    def values(self) -> dict[str, str]:
        return {"topic": self.name, "type": self.kind, "publishers": str(self.publishers)}
