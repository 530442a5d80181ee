"""Online: a mixed model that follows its session in a node, from poses that become known late.

The node keeps its inputs and the measured field for a while. A pose whose stamp lies in the past is joined
with the inputs and the reading of that time, and updates the effects of the session.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.units import LEAST_USUAL_NT, MOST_USUAL_NT, NT_PER
from magtwin.frames import yaw_from_quat
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import MAGNITUDE, POSE, Qos
from magtwin.ros.bus import Message, is_name
from magtwin.ros.diagnostics import Problems
from magtwin.ros.inputs import AHEAD_S, Columns, Input
from magtwin.ros.node import Node

if TYPE_CHECKING:
    from magtwin.learn.inference.reader import Signals
    from magtwin.learn.models.predictor import Predictor

QUIET_S = 30.0
"""Time without a used pose after which a warning is given [s]."""

NEAREST_S = 0.1
"""Longest time between a pose and the measured field that is joined with it [s]."""

AGES = 50
"""Number of poses whose median age is the delay of poses."""


class Online(Input):
    """The topic of late poses, which update the effects of the session."""

    qos = Qos(depth=200, reliable=False)  # they may come in bursts

    def __init__(
        self,
        node: Node,
        model: "Predictor",
        field: AnomalyMap,
        settings: Mapping[str, Any],
        *,
        poses: str,
        measured: str,
        seconds: Callable[[int], float],
        signals: Callable[[int], "Signals | str"],
    ) -> None:
        """Search for its two topics.

        Args:
            node: What the topics are inputs of.
            model: A mixed model.
            field: The map that it was trained on.
            settings: Values of the node's parameters.
            poses: Topic of the poses.
            measured: Topic of the measured field.
            seconds: Time of the model [s] by that of the node [ns].
            signals: Signals at a time of the node [ns], or what is missing.

        Raises:
            InputError: The model is of another kind, or a name is not that of a topic.
        """
        from magtwin.learn.data.alignment import alignment_of
        from magtwin.learn.inference.calibrate import mixed_of_kind

        for parameter, name in (("online", poses), ("measured", measured)):
            if not is_name(name):
                raise InputError(f"`{parameter}={name}` is not a topic's name: use letters, digits, _ and /")
        how: dict[str, Any] = {"frames": node.frames, "say": node.say}
        super().__init__(node.bus, replace(POSE, name=poses), max_age_s=QUIET_S, **how)
        self.silence = "no recent pose: the effects tend to those of the model"
        self._model, self._field, self._settings = mixed_of_kind(model), field, settings
        self._seconds, self._signals = seconds, signals
        self._alignment = alignment_of(model.metadata, "the model")
        self.used = 0
        """Number of poses that updated the effects."""
        self._unused: Counter[str] = Counter()
        self._reasons: set[str] = set()
        self._ages_s: deque[float] = deque(maxlen=AGES)
        history_s = settings["buffer_s"]
        self.measured = Measured(
            node.bus, replace(MAGNITUDE, name=measured), max_age_s=1.0, history_s=history_s, **how
        )
        node.late += [self, self.measured]
        self.forget()

    def forget(self) -> None:
        """Begin again with the effects of the model, after a restart of time."""
        from magtwin.learn.inference.online import OnlineMagnetometer

        super().forget()
        self.magnetometer = OnlineMagnetometer(
            self._model, self._field, lever_arm_m=self._alignment.lever_arm_m
        )
        """Reads with the effects of the session."""
        self._ages_s.clear()
        self._quiet_ns = 0

    def _take(self, message: Message, stamp: int, columns: Columns) -> None:
        self._kept.clear()
        self._kept.append((stamp, columns))
        if why := self._use(message, stamp, columns):
            self._unused[why] += 1
            if (kind := why.partition(":")[0]) not in self._reasons:
                self._reasons.add(kind)
                self._say(f"{self.name}: poses {why}")

    def _use(self, message: Message, stamp: int, columns: Columns) -> str:
        """Update the effects by the reading at a pose; the reason if it could not be used, else ""."""
        frame, known = message.content.header.frame_id.lstrip("/"), self._settings["map_frame"]
        if frame not in ("", known):
            return f"were in frame {frame!r}, and the map is in {known!r}: transform them, or set map_frame"
        age_s, buffer_s = (self._bus.now_ns() - stamp) / NS, self._settings["buffer_s"]
        if age_s < -AHEAD_S:
            return "were ahead of this node's clock"
        if age_s > buffer_s:
            return f"were older than the buffer of {buffer_s:g} s"
        taken = stamp + round(self._alignment.latency_s * NS)  # the reading of this pose
        t, effects = self._seconds(taken), self.magnetometer.effects
        if not effects.due(t):
            return ""
        b_nt, signals = self.measured.nearest(taken), self._signals(taken)
        if b_nt is None:
            return f"had no measured field within {NEAREST_S:g} s"
        if isinstance(signals, str):
            return f"had {signals}"
        p_xy, yaw = columns["mocap_p"][0, :2].tolist(), float(yaw_from_quat(columns["mocap_q_xyzw"])[0])
        if not self.magnetometer.update(t, p_xy, yaw, signals, b_nt, pose_sd_m=self._sd_m(message)):
            return "were off the map"
        if not self.used:
            self._say(f"following the session by poses {age_s:.1f} s old")
        self.used += 1
        self._quiet_ns = self._bus.now_ns()
        self._ages_s.append(max(age_s, 0.0))
        effects.delay_s = float(np.median(self._ages_s))
        return ""

    def _sd_m(self, message: Message) -> float:
        """Standard deviation of each axis of a position, from its covariance if that is known [m]."""
        covariance = getattr(getattr(message.content, "pose", None), "covariance", None)
        variance = 0.0 if covariance is None else float(np.mean(np.asarray(covariance)[[0, 7]]))
        return math.sqrt(variance) if 0 < variance < math.inf else float(self._settings["pose_sd_m"])

    def _more(self, now_ns: int) -> tuple[Problems, dict[str, str]]:
        self._quiet_ns = self._quiet_ns or now_ns
        quiet_s = (now_ns - self._quiet_ns) / NS
        problems = (
            (quiet_s > QUIET_S, f"no pose was used for {quiet_s:.0f} s"),
            *((count, f"{count} poses {why}") for why, count in self._unused.items()),
        )
        self._unused.clear()
        values = {"poses": str(self.heard), "poses used": str(self.used)}
        values["median age [s]"] = f"{np.median(self._ages_s or [math.nan]):.2f}"
        values["interval factor"] = f"{self.magnetometer.effects.widening:.2f}"
        return problems, values


class Measured(Input):
    """The field that a real sensor measures: a magnitude or a vector, in T or nT."""

    def nearest(self, at_ns: int) -> float | None:
        """The reading nearest to a time [nT]; None if there is none within `NEAREST_S`."""
        near = [kept for kept in self._kept if abs(kept[0] - at_ns) <= NEAREST_S * NS]
        best = min(near, key=lambda kept: abs(kept[0] - at_ns), default=None)
        return None if best is None else float(best[1]["b_measured_nt"][0])

    def _read(self, message: Message) -> tuple[int, Columns]:
        stamp, columns = super()._read(message)
        size = float(np.linalg.norm(columns["magnetic_field"]))
        for b_nt in (size * NT_PER["T"], size):
            if LEAST_USUAL_NT <= b_nt < MOST_USUAL_NT:
                return stamp, {"b_measured_nt": np.array([b_nt])}
        raise InputError("a magnetic field that is not the Earth's")
