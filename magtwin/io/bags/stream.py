"""Stream: the messages that a robot sends as a run goes on."""

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags.cdr import NS, Index
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.topics import DESCRIPTION, NAMES, READING, SCAN, TF_STATIC, TOPICS, Columns, Topic
from magtwin.run.arrow import check_clock
from magtwin.run.run import Run, check_numbers

if TYPE_CHECKING:
    from magtwin.sim.sensors.lidar import Scans

Array = NDArray[np.float64]

LATEST_S = 2.0**31  # First time that ROS stamps cannot hold [s]


@dataclass
class _Last:
    """State of a topic at the end of the previous rows."""

    values: dict[str, Any] = field(default_factory=dict)  # Its columns in the last row; empty before it
    changed_s: float = 0.0  # When they last changed [s]
    times: int = 0  # How often they were sent again since


Sent = tuple[Topic, Index, dict[str, Any]]  # A topic, times of some of its messages [ns], and their fields


class Stream:
    """The messages of a run, rows after rows; remembers what was sent last.

    The rows of `run` define the columns. `lab` are fields of messages about the lab, which are sent once;
    `scans` the LiDAR's of the whole run. A `whole` stream puts every column into /magtwin/reading, not only
    those that no other topic carries, and the run's metadata into /magtwin/columns: a recorder of live topics
    has no other source for them.
    """

    def __init__(
        self,
        run: Run,
        sender: Sender,
        scans: "Scans | None",
        *,
        topics: Iterable[Topic] = tuple(TOPICS.values()),
        lab: Mapping[Topic, Mapping[str, Any]] = MappingProxyType({}),
        whole: bool = False,
    ) -> None:
        self._sender, self._scans, self._lab = sender, scans, lab
        self._t, self._stamp = -np.inf, -1
        self.later_s = _later_s(run)  # Time by which stamps are later than t, so that none is below 0 [s]
        self._last: dict[str, _Last] = {}
        columns = set(run)
        sent = [t for t in topics if t.needs and columns.issuperset(t.needs)]
        carried = [] if whole else [topic for topic in sent if topic.carried]
        self._carried = {column: topic for topic in carried for column in topic.needs}
        self._rest = [name for name in run if name not in self._carried]
        self._columns = {name: (values.dtype, values.shape[1:]) for name, values in run.items()}
        self._table = self._columns_json(run, run.metadata if whole else {})
        for name, values in run.items():
            check_numbers(name, values, "stand in a bag")
        self._once = once = [
            NAMES,
            *[TF_STATIC] * bool(sender.links),
            *[DESCRIPTION] * bool(sender.description),
            *lab,
        ]
        self.topics = [*once, *sent, *([] if scans is None else [SCAN]), READING]  # Topics that are sent

    def messages(self, run: Run) -> Iterator[Sent]:
        """The messages of some rows, which have the same columns as the first and later times."""
        if {name: (values.dtype, values.shape[1:]) for name, values in run.items()} != self._columns:
            raise InputError(f"rows of a bag must have the same columns, {', '.join(self._columns)}")
        t, stamps = self._checked(run)
        once, self._once = self._once, []
        for topic in once:
            first = stamps[:1] if len(stamps) else np.zeros(1, np.int64)
            fields = {"data": self._table} if topic is NAMES else topic.write({}, first, self._sender)
            if topic in self._lab:
                fields = {"header.stamp": first, **self._lab[topic]}
            yield topic, first, fields
        for topic in self.topics:
            if topic.needs:
                rows = self._rows(topic, run, t)
                names = dict.fromkeys((*topic.needs, *topic.by, "wheel_angle", "odom_v", "b_sd_nt"))
                for some in _alike(run, topic.by, rows):
                    part: Any = slice(None) if len(some) == len(t) else some
                    chosen = {name: run[name][part] for name in names if name in run}
                    yield topic, stamps[part], topic.write(chosen, stamps[part], self._sender)
        data = np.column_stack([np.asarray(run[name], float) for name in self._rest])
        yield READING, stamps, {"data": data}
        if len(t):
            self._t = float(t[-1])
            yield from self._scanned(self._t)

    def last(self) -> Iterator[Sent]:
        """The messages after the last row: scans that arrive later."""
        yield from self._scanned(np.inf)

    def _scanned(self, until_s: float) -> Iterator[Sent]:
        """The scans that arrived by a time and were not sent yet."""
        if self._scans is None:
            return
        k = int(np.searchsorted(self._scans.arrival, until_s, side="right"))
        arrived, self._scans = self._scans.take(slice(k)), self._scans.take(slice(k, None))
        times = (arrived.t, arrived.arrival)
        moments, came = (np.rint((t + self.later_s) * NS).astype(np.int64) for t in times)
        fields = SCAN.write({"ranges_m": arrived.ranges_m}, moments, self._sender)
        yield SCAN, came, fields

    def _checked(self, run: Run) -> tuple[Array, Index]:
        """Times of rows, and their stamps [ns], if they ascend and ROS can hold them."""
        check_clock(run, "the run to write")
        t = np.asarray(run["t"], float)
        if len(t) and t[0] <= self._t:
            raise InputError(f"time runs backwards: rows at {t[0]:.9g} s come after rows at {self._t:.9g} s")
        if len(t) and not t[-1] + self.later_s < LATEST_S:
            held = f"stamps of ROS hold 0 to {LATEST_S:.0f} s: subtract the first time from t"
            raise InputError(f"t runs from {t[0]:.9g} to {t[-1]:.9g} s, but {held}")
        # Rows of the same nanosecond are stamped 1 ns apart; their t is in /magtwin/reading.
        count = np.arange(len(t))
        stamps = np.rint((t + self.later_s) * NS).astype(np.int64) - count
        stamps = np.maximum(np.maximum.accumulate(stamps), self._stamp + 1) + count
        self._stamp = int(stamps[-1]) if len(t) else self._stamp
        return t, stamps

    def _rows(self, topic: Topic, run: Columns, t: Array) -> NDArray[np.intp]:
        """Rows at which a topic is sent."""
        if not len(t):
            return np.zeros(0, np.intp)
        if topic.sent == "each":
            known = np.isfinite(run[topic.needs[0]])
            return np.flatnonzero(known if known.ndim == 1 else known.any(axis=1))
        last = self._last.setdefault(topic.name, _Last(changed_s=float(t[0])))
        if topic.sent == "ticks":
            steps = np.floor(t / topic.every_s + 1e-6).astype(np.int64)
            sent = np.diff(steps, prepend=last.times if last.values else steps[0] - 1) > 0
            last.times, last.values = int(steps[-1]), {"t": t[-1]}
            return np.flatnonzero(sent & _finite(run, topic.needs))
        changed = np.zeros(len(t), bool)
        changed[0] = not last.values
        for name in topic.needs:
            values = run[name]
            changed[1:] |= _differ(values[1:], values[:-1])
            if name in last.values:
                changed[:1] |= _differ(values[:1], last.values[name][None])
        last.values = {name: run[name][-1].copy() for name in topic.needs}
        latest = np.maximum.accumulate(np.where(changed, np.arange(len(t)), -1))
        since = np.where(latest >= 0, t[np.maximum(latest, 0)], last.changed_s)
        times = np.floor((t - since) / topic.every_s + 1e-6).astype(np.int64)
        again = np.diff(times, prepend=last.times) > 0
        if topic.lost in run:
            again &= ~run[topic.lost]
        last.changed_s, last.times = float(since[-1]), int(times[-1])
        sent = changed | again
        if not topic.carried:
            sent &= _finite(run, topic.needs)
        return np.flatnonzero(sent)

    def _columns_json(self, run: Run, metadata: Mapping[str, Any]) -> str:
        """The content of /magtwin/columns: the columns, and where each of them is."""
        columns, first = [], 0
        for name, (dtype, shape) in self._columns.items():
            spec = run.spec(name)
            entry: dict[str, Any] = {"name": name, "unit": spec.unit, "frame": spec.frame, "doc": spec.doc}
            entry |= {"parts": spec.parts, "interpolation": spec.interpolation}
            entry |= {"dtype": dtype.name, "width": shape[0] if shape else None, "own": name in run.specs}
            if name in self._carried:
                entry["topic"] = self._carried[name].name
            else:
                entry["first"] = first
                first += shape[0] if shape else 1
            columns.append(entry)
        table: dict[str, Any] = {"unit": self._sender.unit, "columns": columns}
        table |= {"facts": dict(metadata)} if metadata else {}
        return json.dumps(table, ensure_ascii=False, indent=1)


def _later_s(run: Run) -> float:
    """Whole seconds from a time before 0 at which a run begins to 0 [s]; 0 for other runs. Warns."""
    begin = float(run["t"][0]) if "t" in run and run.rows else 0.0
    if not -np.inf < begin < 0:
        return 0.0
    later = float(-np.floor(begin))
    text = f"stamps of ROS at 0: they are t + {later:g} s; magtwin reads t back"
    warnings.warn(f"t begins at {begin:.9g} s, and {text}", RepairWarning, stacklevel=4)
    return later


def _alike(run: Columns, flags: Iterable[str], rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Rows of a topic, those of equal flags together."""
    known = [np.asarray(run[name][rows], bool) for name in flags if name in run]
    if not known:
        return [rows]
    state = np.sum([values.astype(int) << k for k, values in enumerate(known)], axis=0)
    return [rows[state == each] for each in np.unique(state)]


def _finite(run: Columns, names: Iterable[str]) -> NDArray[np.bool_]:
    """Rows in which some columns are finite."""
    return np.all([np.isfinite(run[n]).reshape(len(run[n]), -1).all(axis=1) for n in names], axis=0)


def _differ(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Rows of float64 arrays that differ in any bit."""
    other = a.view(np.int64) != b.view(np.int64)
    return other if other.ndim == 1 else other.any(axis=1)
