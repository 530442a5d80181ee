"""Diagnostics: how a node fares, on /diagnostics, as ROS's own monitors read it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from magtwin.io.bags.messages import Qos, diagnostics
from magtwin.ros.bus import Bus, Message, to_bytes

Level = Literal["ok", "warn", "error", "stale"]

LEVELS: Mapping[str, int] = {"ok": 0, "warn": 1, "error": 2, "stale": 3}
"""Numbers of levels in diagnostic_msgs/msg/DiagnosticStatus."""

KIND = "diagnostic_msgs/msg/DiagnosticArray"
TOPIC = "/diagnostics"

REPORT_S = 1.0
"""Time between diagnostics [s]."""

WATCH_S = 1.5
"""Wall time after which a clock that did not move stands still [s]."""


@dataclass(frozen=True)
class Status:
    """How one thing fares."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def to_fields(statuses: Sequence[Status], stamp_ns: int, hardware: str = "") -> dict[str, Any]:
    """Fields of a DiagnosticArray."""
    fields: dict[str, Any] = {
        "form": diagnostics([len(status.values) for status in statuses]),
        "header.stamp": np.int64(stamp_ns),
        "count": len(statuses),
    }
    for k, status in enumerate(statuses):
        fields |= {
            f"{k}.level": LEVELS[status.level],
            f"{k}.name": status.name,
            f"{k}.message": status.message,
            f"{k}.hardware_id": hardware,
            f"{k}.values": len(status.values),
        }
        for n, (key, value) in enumerate(status.values.items()):
            fields |= {f"{k}.{n}.key": key, f"{k}.{n}.value": value}
    return fields


def from_message(message: Message) -> list[Status]:
    """What a DiagnosticArray says."""
    names, counts = list(LEVELS), list[int]()
    total = int(message.read(["count"], diagnostics([]))["count"])
    for k in range(total):
        form = diagnostics([*counts, 0])
        counts.append(int(message.read([f"{k}.values"], form)[f"{k}.values"]))
    form = diagnostics(counts)
    wanted = [f"{k}.{part}" for k in range(total) for part in ("level", "name", "message")]
    wanted += [f"{k}.{n}.{part}" for k in range(total) for n in range(counts[k]) for part in ("key", "value")]
    read = message.read(wanted, form) if wanted else {}
    return [
        Status(
            read[f"{k}.name"],
            names[int(read[f"{k}.level"])],  # type: ignore[arg-type]
            read[f"{k}.message"],
            {read[f"{k}.{n}.key"]: read[f"{k}.{n}.value"] for n in range(counts[k])},
        )
        for k in range(total)
    ]


class Reporter:
    """Where a node's diagnostics go."""

    def __init__(self, bus: Bus) -> None:
        """Offer /diagnostics."""
        self._bus, self._publisher = bus, bus.publisher(TOPIC, KIND, Qos())
        self._watched_ns = -1

    def each(self, report: Callable[[str], None]) -> None:
        """Have `report` called each `REPORT_S` of the node's clock, and by the wall while that stands still.

        It is given what is wrong with the clock; "" for nothing.
        """

        def watch() -> None:
            now = self._bus.now_ns()
            if now == self._watched_ns:
                report("/clock stands still" if now else "nobody says /clock")
            self._watched_ns = now

        self._bus.timer(REPORT_S, lambda: report(""))
        self._bus.timer(WATCH_S, watch, wall=True)

    def report(self, statuses: Sequence[Status], stamp_ns: int) -> None:
        """Say how things fare; names are put behind the node's."""
        named = [Status(f"{self._bus.name}: {s.name}", s.level, s.message, s.values) for s in statuses]
        self._publisher.publish(to_bytes(KIND, to_fields(named, stamp_ns, self._bus.name)))
