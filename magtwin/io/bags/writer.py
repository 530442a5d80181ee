"""Writing bags: a Run as the messages that its robot would have sent."""

import contextlib
import dataclasses
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.files import check_free, output
from magtwin.io.bags.bag import ROOM, VERSION, Batch, Connection, Tally, metadata, yaml_of
from magtwin.io.bags.cdr import NS, Index, encode, leaves
from magtwin.io.bags.db3 import Db3Writer
from magtwin.io.bags.mcap import McapWriter
from magtwin.io.bags.messages import (
    DESCRIPTION,
    NAMES,
    READING,
    SCAN,
    TF_STATIC,
    TOPICS,
    TYPES,
    Columns,
    Fixed,
    Sender,
    Topic,
    Unit,
    sender_of,
    transforms,
)
from magtwin.io.recorder import PARTIAL, partial_of
from magtwin.run.arrow import check_clock, metadata_to_json
from magtwin.run.run import Run
from magtwin.version import __version__

if TYPE_CHECKING:
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.twin import Twin

Array = NDArray[np.float64]
Storage = Literal["mcap", "sqlite3"]

STORAGES: Mapping[str, str] = {"mcap": ".mcap", "sqlite3": ".db3"}
"""What a storage's file is called at its end."""

FACTS = "magtwin."
"""Before the name of a fact in a bag's custom data; what it says is JSON."""

NOTE = "magtwin"
"""Record of metadata in an MCAP file that holds the metadata."""

BLOCK = 16_384
"""Rows that are written at a time."""

LATEST_S = 2.0**31
"""First moment that no stamp of ROS holds [s]."""


def write_bag(
    run: Run,
    path: str | os.PathLike[str],
    twin: "Twin | None" = None,
    *,
    storage: Storage | None = None,
    units: Unit = "T",
    scans: "Scans | None" = None,
    force: bool = False,
) -> None:
    """Write a run as a rosbag2; `read_bag` gives it back.

    `magtwin.io.bags.messages.TOPICS` says which topics there are and what each of them carries. A slower
    signal is
    sent when the readings first see its value, and again where it stands. Stamps are sim time: t = 0 is 0 ns.

    Args:
        run: What happened; its t rises from 0 or later.
        path: The folder to make; or a single storage file, where it ends in .mcap or .db3.
        twin: What it happened in: gives frames, covariances, /tf_static and the robot's description.
        storage: "mcap", compressed, or "sqlite3"; None takes what the path ends in, or else MCAP.
        units: Unit of fields: "T", as ROS has them, or "nT", as APRILab's robot publishes them.
        scans: What the LiDAR saw.
        force: Whether what exists is replaced.

    Raises:
        InputError: The path exists and `force` was not given, or cannot be written; the run has no t, its
            time does not rise, or a column cannot stand in a bag.
    """
    path = Path(path)
    storage = storage_of(path, storage)
    check_free(path, force=force)
    who = sender_for(twin, units, run.metadata.get("rate_hz"))
    with output(path, force=force) as aside, refused(path):
        sink = _Sink(aside, storage, who, scans, live=False)
        try:
            for first in range(0, max(run.rows, 1), BLOCK):
                sink.append(run.take(slice(first, first + BLOCK)))
            sink.close()
        except BaseException:
            sink.abort()
            raise


def _arrived(scans: "Scans", t: float) -> "tuple[Scans, Scans]":
    """Scans that arrived by a time [s], and those that did later."""
    k = int(np.searchsorted(scans.arrival, t, side="right"))
    parts = [
        {f.name: getattr(scans, f.name)[rows] for f in dataclasses.fields(scans)}
        for rows in (slice(k), slice(k, None))
    ]
    return type(scans)(**parts[0]), type(scans)(**parts[1])


class BagWriter:
    """A bag that is written while a run goes on, in blocks; one that is killed leaves all that was appended.

    It grows under another name, `run.partial.mcap` for `run.mcap`, `bag.partial` for a folder `bag`, which
    `read_bag` reads at any time, and gets its own at the end.

    Args:
        path: As for `write_bag`, as all that follows.
        twin: What the run happens in.
        storage: "mcap" or "sqlite3".
        units: Unit of fields.
        scans: What the LiDAR will have seen; each is written when it has arrived.
        force: Whether what exists is replaced.

    Raises:
        InputError: As `write_bag`; or another recording has left its part there.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        twin: "Twin | None" = None,
        *,
        storage: Storage | None = None,
        units: Unit = "T",
        scans: "Scans | None" = None,
        force: bool = False,
    ) -> None:
        self._path, self._twin, self._units, self._force = Path(path), twin, units, force
        self._scans = scans
        self._storage = storage_of(self._path, storage)
        _check_units(units)
        check_free(self._path, force=force)
        self.partial = partial_of(self._path)
        """Where it lies while it grows."""
        self._sink: _Sink | None = None
        if self.partial.exists() and not force:
            raise InputError(
                f"{self.partial}: left by a recording that did not end; read and remove it, or give --force"
            )

    def append(self, run: Run) -> None:
        """Add rows of a run, later than those before and of the same columns; they outlive this process.

        Args:
            run: The rows; metadata that are new or other than before replace them.

        Raises:
            InputError: As `write_bag`.
        """
        with refused(self._path):
            if self._sink is None:
                self._sink = self._open(run)
            self._sink.append(run)
            self._sink.flush()

    def close(self) -> None:
        """End the bag and give it its name; of a bag to which nothing was appended there is none."""
        if self._sink is None:
            return
        with refused(self._path):
            self._sink.close()
            check_free(self._path, force=self._force)
            with output(self._path, force=self._force) as aside:
                self.partial.rename(aside)

    def abort(self) -> None:
        """Leave what there is under the name that says that it did not end."""
        if self._sink is not None:
            self._sink.abort()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _open(self, run: Run) -> "_Sink":
        who = sender_for(self._twin, self._units, run.metadata.get("rate_hz"))
        if self.partial.is_dir():
            for file in self.partial.iterdir():
                file.unlink()
            self.partial.rmdir()
        else:
            for log in ("", "-wal", "-shm"):
                self.partial.with_name(self.partial.name + log).unlink(missing_ok=True)
        self.partial.parent.mkdir(parents=True, exist_ok=True)
        return _Sink(self.partial, self._storage, who, self._scans, live=True)


def storage_of(path: Path, storage: str | None) -> Storage:
    """The storage of a bag that is to be written to a path."""
    if storage is not None and storage not in STORAGES:
        raise InputError(f"no storage {storage!r} of bags; {hint(storage, STORAGES)}")
    told = next((name for name, suffix in STORAGES.items() if path.suffix == suffix), None)
    if told and storage and told != storage:
        raise InputError(f"{path}: ends as a file of {told}; drop storage {storage!r}, or name a folder")
    if path.suffix and not told and path.suffix != PARTIAL:
        raise InputError(
            f"{path}: a bag is a folder, without an ending, or a file that ends in .mcap or .db3"
        )
    return told or storage or "mcap"  # type: ignore[return-value]


def _check_units(units: str) -> None:
    if units not in ("T", "nT"):
        raise InputError(f'units of a bag must be "T" or "nT", got {units!r}')


@contextlib.contextmanager
def refused(path: Path) -> Iterator[None]:
    """Faults of the disk in a line."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: cannot be written ({reason})") from error


def sender_for(twin: "Twin | None", units: Unit, rate_hz: Any = None) -> Sender:
    """What messages tell of a twin's robot, whose magnetometer reads at a rate [Hz]."""
    _check_units(units)
    if twin is None:
        return Sender(unit=units)
    from magtwin.author.robot import read_description
    from magtwin.usd.geometry import BASE_LINK, read_links

    robot = twin.scene.robot
    joints = (robot.drive.left_wheel_joint, robot.drive.right_wheel_joint)
    fixed, turning = [], {}
    for link in read_links(robot.asset).values():
        if link.name == BASE_LINK:
            continue
        axis = link.axis_link or (0.0, 0.0, 1.0)
        frame = Fixed(BASE_LINK, link.name, link.p_base_link, link.q_base_link_xyzw, axis)
        if link.joint in joints:
            turning[link.joint] = frame
        else:
            fixed.append(frame)
    return sender_of(
        robot,
        unit=units,
        rate_hz=float(rate_hz) if isinstance(rate_hz, int | float) and rate_hz > 0 else None,
        links=tuple(fixed),
        wheels=(turning[joints[0]], turning[joints[1]]) if len(turning) == 2 else None,
        description=read_description(robot.asset),
    )


class _Store(Protocol):
    """What both storages do."""

    def add(self, connections: Sequence[Connection]) -> None: ...
    def write(self, batches: Sequence[Batch]) -> None: ...
    def flush(self) -> None: ...
    def close(self) -> None: ...
    def abort(self) -> None: ...


class _Sink:
    """A bag at the very path that is given: its storage file, and metadata.yaml where it is a folder."""

    def __init__(
        self, path: Path, storage: Storage, who: Sender, scans: "Scans | None", *, live: bool
    ) -> None:
        self._who, self._storage, self._scans = who, storage, scans
        self._folder = None if path.suffix in STORAGES.values() else path
        if self._folder is not None:
            path.mkdir()
            path = path / f"{path.name.removesuffix(PARTIAL)}_0{STORAGES[storage]}"
        self._file = path
        if storage == "mcap":
            self._store: _Store = McapWriter(path, f"magtwin {__version__}")
        else:
            self._store = Db3Writer(path, live=live)
        self._noted: dict[str, str] | None = None
        self._connections: dict[str, Connection] = {}
        self._tally = Tally({})
        self._stream: Stream | None = None

    def append(self, run: Run) -> None:
        """Write rows, and the scans that arrived by the last of them."""
        if self._stream is None:
            self._stream = Stream(run, self._who, self._scans)
            self._connect(self._stream.topics)
        metadata = {name: json.dumps(value) for name, value in json.loads(metadata_to_json(run)).items()}
        if metadata != self._noted:
            self._noted = metadata
            if isinstance(self._store, McapWriter):
                self._store.note(NOTE, metadata)
        self._write(self._stream.messages(run))

    def flush(self) -> None:
        """Have it outlive this process."""
        self._note()
        self._store.flush()
        self._write_metadata()

    def close(self) -> None:
        """Make it whole."""
        if self._stream is not None:
            self._write(self._stream.last())
        self._note()
        if isinstance(self._store, McapWriter):
            self._store.note("rosbag2", {"serialized_metadata": yaml_of(self._metadata())})
        self._store.close()
        self._write_metadata()

    def abort(self) -> None:
        """Leave it as it is."""
        with contextlib.suppress(OSError, sqlite3.Error):
            self._store.abort()

    def _write(self, said: Iterable["Said"]) -> None:
        batches = [
            Batch(self._connections[topic.name], t, encode(leaves(form), fields, len(t), room=ROOM))
            for topic, t, form, fields in said
        ]
        self._store.write(batches)
        self._tally.add(batches)

    def _connect(self, topics: Sequence[Topic]) -> None:
        for topic in topics:
            definition, digest = definition_of(topic.kind)
            number = len(self._connections) + 1
            self._connections[topic.name] = Connection(
                number, topic.name, topic.kind, definition, digest, topic.qos
            )
            self._tally.counts[number] = 0
        self._store.add(list(self._connections.values()))

    def _note(self) -> None:
        """Keep the metadata in a database itself, as rosbag2 does."""
        if isinstance(self._store, Db3Writer):
            self._store.note(VERSION, yaml_of(self._metadata()))

    def _metadata(self) -> dict[str, Any]:
        custom = {FACTS + name: value for name, value in (self._noted or {}).items()}
        connections = list(self._connections.values())
        return metadata(self._storage, [self._file.name], connections, self._tally, custom)

    def _write_metadata(self) -> None:
        if self._folder is not None:
            aside = self._folder / "metadata.yaml.new"
            aside.write_text(yaml_of({"rosbag2_bagfile_information": self._metadata()}), encoding="utf-8")
            aside.replace(self._folder / "metadata.yaml")


@cache
def definition_of(kind: str) -> tuple[str, str]:
    """A type of messages in text, and its hash."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    return store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind)


@dataclass
class _Last:
    """Where a topic stood at the end of the rows before."""

    values: dict[str, Any] = field(default_factory=dict)
    """Its columns in the last row; none before the first one."""

    changed_s: float = 0.0
    """When they last changed [s]."""

    times: int = 0
    """How often they have been sent again since."""


Said = tuple[Topic, Index, str, dict[str, Any]]
"""A topic with the times of some messages [ns], the leaves of their type, and their fields."""


class Stream:
    """What a robot says as a run goes on; it remembers what it said last."""

    def __init__(
        self,
        run: Run,
        who: Sender,
        scans: "Scans | None",
        *,
        topics: Iterable[Topic] = tuple(TOPICS.values()),
        whole: bool = False,
    ) -> None:
        """Begin.

        Args:
            run: Rows of it, which tell the columns.
            who: The robot.
            scans: What its LiDAR will have seen; none says nothing of it.
            topics: Those that are said, as far as the run has their columns.
            whole: Whether /magtwin/reading tells every column, and not only those that no other topic does,
                and /magtwin/columns the run's metadata, which who records live topics knows from nowhere
                else.
        """
        self._who, self._scans = who, scans
        self._t = -np.inf
        self._last: dict[str, _Last] = {}
        columns = set(run)
        sent = [t for t in topics if t.needs and columns.issuperset(t.needs)]
        carried = {} if whole else {column: topic for topic in sent for column in topic.carries}
        self._carried: dict[str, Topic] = carried
        self._rest = [name for name in run if name not in self._carried]
        self._columns = {name: (values.dtype, values.shape[1:]) for name, values in run.items()}
        self._table = self._told(run, run.metadata if whole else {})
        for name, values in run.items():
            if values.ndim > 2 or values.dtype.kind not in "bfiu":
                raise InputError(
                    f"column {name!r} cannot stand in a bag: numbers or flags of shape (N,) or (N, width) "
                    f"can, got {values.dtype} of shape {values.shape}"
                )
        once = [NAMES]
        if who.links:
            once.append(TF_STATIC)
        if who.description:
            once.append(DESCRIPTION)
        self._once = once
        self.topics = [*once, *sent, *([] if scans is None else [SCAN]), READING]
        """Topics that there are."""

    def messages(self, run: Run) -> Iterator["Said"]:
        """What is said in the time of some rows."""
        if {name: (values.dtype, values.shape[1:]) for name, values in run.items()} != self._columns:
            raise InputError(f"rows of a bag must have the same columns, {', '.join(self._columns)}")
        t = self._checked(run)
        stamps = np.rint(t * NS).astype(np.int64)
        once, self._once = self._once, []
        for topic in once:
            first = stamps[:1] if len(stamps) else np.zeros(1, np.int64)
            fields = {"data": self._table} if topic is NAMES else topic.write({}, first, self._who)
            yield topic, first, form_of(topic, fields), fields
        for topic in self.topics:
            if topic.needs:
                rows = self._rows(topic, run, t)
                chosen = (
                    run
                    if len(rows) == len(t)
                    else {name: run[name][rows] for name in self._wanted(topic, run)}
                )
                fields = topic.write(chosen, stamps[rows], self._who)
                yield topic, stamps[rows], form_of(topic, fields), fields
        data = np.column_stack([np.asarray(run[name], float) for name in self._rest])
        yield READING, stamps, TYPES[READING.kind], {"data": data}
        if len(t):
            self._t = float(t[-1])
            yield from self._scanned(self._t)

    def last(self) -> Iterator["Said"]:
        """What is said after the last row: scans that were on their way."""
        yield from self._scanned(np.inf)

    def _scanned(self, until_s: float) -> Iterator["Said"]:
        """The scans that arrived by a time and have not been told yet."""
        if self._scans is None:
            return
        arrived, self._scans = _arrived(self._scans, until_s)
        moments, came = (np.rint(t * NS).astype(np.int64) for t in (arrived.t, arrived.arrival))
        fields = SCAN.write({"ranges_m": arrived.ranges_m}, moments, self._who)
        yield SCAN, came, TYPES[SCAN.kind], fields

    def _checked(self, run: Run) -> Array:
        """Times of rows, which rise."""
        check_clock(run, "the run to write")
        t = np.asarray(run["t"], float)
        if len(t) and t[0] <= self._t:
            raise InputError(f"time runs backwards: rows of {t[0]:.9g} s after those of {self._t:.9g} s")
        if len(t) and not 0 <= t[0] <= t[-1] < LATEST_S:
            raise InputError(
                f"t of {t[0]:.9g} to {t[-1]:.9g} s: stamps of ROS hold 0 to {LATEST_S:.0f} s; begin at 0"
            )
        return t

    @staticmethod
    def _wanted(topic: Topic, run: Run) -> list[str]:
        """Columns that a topic's messages are made of."""
        also = {"wheel_angle", "odom_v", "b_sd_nt"} & set(run)
        return [*topic.needs, *(also - set(topic.needs))]

    def _rows(self, topic: Topic, run: Columns, t: Array) -> NDArray[np.intp]:
        """The rows at which a topic is sent."""
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
        if not topic.carries:
            sent &= _finite(run, topic.needs)
        return np.flatnonzero(sent)

    def _told(self, run: Run, metadata: Mapping[str, Any]) -> str:
        """What columns there are, and where each is: the content of /magtwin/columns."""
        columns, first = [], 0
        for name, (dtype, shape) in self._columns.items():
            spec = run.spec(name)
            told: dict[str, Any] = {"name": name, "unit": spec.unit, "frame": spec.frame, "doc": spec.doc}
            told |= {"parts": spec.parts, "interpolation": spec.interpolation}
            told |= {"dtype": dtype.name, "width": shape[0] if shape else None, "own": name in run.specs}
            if name in self._carried:
                told["topic"] = self._carried[name].name
            else:
                told["first"] = first
                first += shape[0] if shape else 1
            columns.append(told)
        table = {
            "unit": self._who.unit,
            "columns": columns,
            **({"facts": dict(metadata)} if metadata else {}),
        }
        return json.dumps(table, ensure_ascii=False, indent=1)


def form_of(topic: Topic, fields: Mapping[str, Any]) -> str:
    """The leaves of a topic's type."""
    return transforms(fields["count"]) if topic.kind.startswith("tf2_msgs") else TYPES[topic.kind]


def _finite(run: Columns, names: Iterable[str]) -> NDArray[np.bool_]:
    """Which rows of some columns are numbers."""
    return np.asarray(
        np.logical_and.reduce([np.isfinite(run[n]).reshape(len(run[n]), -1).all(1) for n in names])
    )


def _differ(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Which rows of float64 are not the same to the last bit."""
    other = a.view(np.int64) != b.view(np.int64)
    return other if other.ndim == 1 else other.any(axis=1)
