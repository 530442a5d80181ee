"""Diagnostics: the state of a node, on /diagnostics, for ROS monitors."""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from magtwin.io.bags.topics import Qos
from magtwin.ros.bus import Bus, to_bytes

Level = Literal["ok", "warn", "error", "stale"]

Problems = Iterable[tuple[Any, str]]
"""Whether each problem is present, and its text."""

LEVELS: Mapping[str, int] = {"ok": 0, "warn": 1, "error": 2, "stale": 3}
"""Values of levels in diagnostic_msgs/msg/DiagnosticStatus."""

KIND = "diagnostic_msgs/msg/DiagnosticArray"
TOPIC = "/diagnostics"

REPORT_S = 1.0
"""Time between diagnostics, of the node's clock [s]."""

LEAST_S = 0.9
"""Least wall time between diagnostics [s]: 1 Hz is usual in ROS, whatever the pace of simulated time."""

WATCH_S = 1.5
"""Wall time after which an unchanged clock counts as stopped, and a slow one is not waited for [s]."""


@dataclass(frozen=True)
class Status:
    """The state of one part of a node."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def status_of(
    name: str,
    problems: Problems,
    *,
    fine: str,
    level: Level = "ok",
    words: Sequence[str] = (),
    values: Mapping[str, str],
) -> Status:
    """A status with a warning for each problem that is present.

    Args:
        name: Of the part.
        problems: For each problem whether it is present, and its text.
        fine: Text without problems.
        level: Level before the problems; they raise "ok" to "warn".
        words: Texts before those of the problems.
        values: Further values.
    """
    texts = [text for present, text in problems if present]
    if texts and level == "ok":
        level = "warn"
    return Status(name, level, "; ".join([*words, *texts]) or fine, values)


def to_fields(statuses: Sequence[Status], stamp_ns: int, hardware: str = "") -> dict[str, Any]:
    """Fields of a DiagnosticArray."""
    fields: dict[str, Any] = {"header.stamp": np.int64(stamp_ns), "status": len(statuses)}
    for k, status in enumerate(statuses):
        parts = {"level": LEVELS[status.level], "name": status.name, "message": status.message}
        parts |= {"hardware_id": hardware, "values": len(status.values)}
        for n, (key, value) in enumerate(status.values.items()):
            parts |= {f"values.{n}.key": key, f"values.{n}.value": value}
        fields |= {f"status.{k}.{name}": value for name, value in parts.items()}
    return fields


class Reporter:
    """Publishes the diagnostics of a node."""

    def __init__(self, bus: Bus) -> None:
        """Advertise /diagnostics."""
        self._bus, self._publisher = bus, bus.publisher(TOPIC, KIND, Qos())
        self._watched_ns, self._reported_s = -1, -math.inf

    def each(self, report: Callable[[str], None]) -> None:
        """Call `report` every `REPORT_S` of the node's clock, but every `LEAST_S` to `WATCH_S` of wall time.

        Its argument is the problem of the clock, "" if there is none.
        """

        def due() -> None:
            if time.monotonic() - self._reported_s >= LEAST_S:
                self._reported_s = time.monotonic()
                report("")

        def watch() -> None:
            now, before = self._bus.now_ns(), self._watched_ns
            self._watched_ns = now
            if now == before:
                report("/clock stands still" if now else "nobody publishes /clock")
            elif time.monotonic() - self._reported_s >= WATCH_S:
                report("")

        self._bus.timer(REPORT_S, due)
        self._bus.timer(WATCH_S, watch, wall=True)

    def report(self, statuses: Sequence[Status], stamp_ns: int) -> None:
        """Publish statuses; their names are prefixed with the node's."""
        named = [Status(f"{self._bus.name}: {s.name}", s.level, s.message, s.values) for s in statuses]
        self._publisher.publish(to_bytes(KIND, to_fields(named, stamp_ns, self._bus.name)))
