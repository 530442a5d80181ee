"""Node: what the nodes that read a robot's topics have in common."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import SCAN, Topic
from magtwin.ros.bus import Bus
from magtwin.ros.diagnostics import Level, Problems, Reporter, Status, status_of
from magtwin.ros.inputs import Input, LiveFrames, Scanning, Stamps
from magtwin.spec.base import Quat
from magtwin.spec.sensors import LidarSpec

LOOK_S = 0.5
"""Time between searches for new topics [s]."""

BACK_S = 0.2
"""A clock that went back by more than this was restarted [s]."""


@dataclass(eq=False)
class Node:
    """Its inputs, what it says, and its state on /diagnostics. It works only while the bus spins."""

    bus: Bus
    """The node in the ROS network."""

    say: Callable[[str], None]
    """Called with messages for the user."""

    report: Callable[[str, int], list[Status]]
    """Gives the state of the node since the last call: called with the problem of the clock, "" if there is
    none, and with the time [ns]."""

    stamps: Stamps = "header"
    """Time of the inputs."""

    axes: Mapping[str, Quat] | None = None
    """As for `LiveFrames`."""

    inputs: dict[str, Input] = field(default_factory=dict)
    late: list[Input] = field(default_factory=list)
    """Inputs that are not joined with the present."""

    scans: Scanning | None = None
    missing: str = ""
    """What the node lacks to do its work; "" if nothing."""

    skipped: int = 0
    """Steps without a result since the last report."""

    resets: int = 0
    """How often time jumped back since the last report."""

    done: int = 0
    """Results so far."""

    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    """Latency of the last results [s]."""

    def __post_init__(self) -> None:
        self.frames = LiveFrames(self.bus, self.axes)
        self._reporter = Reporter(self.bus)
        self._reported = (0, 0)  # time [ns] and results at the last report

    def listen(self, topic: Topic, *, max_age_s: float, **more: Any) -> Input:
        """Subscribe to a topic when it is first published; options are those of `Input`."""
        told: dict[str, Any] = {"frames": self.frames, "stamps": self.stamps, "say": self.say, **more}
        self.inputs[topic.name] = Input(self.bus, topic, max_age_s=max_age_s, **told)
        return self.inputs[topic.name]

    def listen_to_scans(self, lidar: LidarSpec, history_s: float = 0.0) -> Scanning:
        """Find out from scans whether the LiDAR spins."""
        gap_s = lidar.latency_s + 2.5 / max(lidar.scan_rate_hz, 0.1)
        self.scans = Scanning(self.bus, SCAN, gap_s=gap_s, history_s=history_s)
        return self.scans

    def begin(self) -> None:
        """Search for the inputs and report, from now on."""
        self.look()
        self.bus.timer(LOOK_S, self.look, wall=True)  # also before the first /clock
        self._reporter.each(self._report)

    def look(self) -> None:
        """Subscribe to inputs that are new."""
        for source in self._sources():
            source.look()

    def skip(self, why: str, noun: str) -> None:
        """Note that a step has no result, and say why once."""
        self.skipped += 1
        if why != self.missing:
            self.say(f"no {noun}: {why}")
        self.missing = why

    def forget(self) -> None:
        """Drop all messages, after a restart of time."""
        self.resets += 1
        for source in self._sources():
            source.forget()

    def status(
        self,
        name: str,
        doing: str,
        silent: str,
        problems: Problems,
        values: dict[str, str],
    ) -> Status:
        """The state of the node's work: an error if it is `silent`, with the reason."""
        half, most = 1e3 * np.percentile(self.latencies_s or [np.nan], (50, 99))
        shared = {"median latency [ms]": f"{half:.2f}", "p99 latency [ms]": f"{most:.2f}"}
        values = {**values, **shared, "skipped": str(self.skipped), "time jumps": str(self.resets)}
        problems = (*problems, (self.resets, f"time jumped back {self.resets} times"))
        level: Level = "error" if silent else "ok"
        words = [f"no {name.removesuffix('s')}: {silent}"] if silent else []
        return status_of(name, problems, fine=doing, level=level, words=words, values=values)

    def rate_hz(self, now_ns: int) -> float | None:
        """Results per second since the last report; None if that is not known."""
        since_ns, before = self._reported
        span = (now_ns - since_ns) / NS
        return (self.done - before) / span if 0 < span < 60 else None

    def _report(self, clock: str) -> None:
        now = self.bus.now_ns()
        statuses = [*self.report(clock, now), *(source.status(now) for source in self._sources())]
        self._reporter.report(statuses, now)
        self._reported = (now, self.done)
        self.skipped = self.resets = 0

    def _sources(self) -> "list[Input | Scanning]":
        scans = [] if self.scans is None else [self.scans]
        return [*self.inputs.values(), *self.late, *scans]
