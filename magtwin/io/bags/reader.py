"""Reading bags: a Run from what magtwin wrote, or from a robot's own recording."""

import contextlib
import json
import os
import sqlite3
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import yaml
from numpy.typing import NDArray

from magtwin.errors import InputError, find, hint
from magtwin.field.units import NT_PER, check_unit
from magtwin.files import existing, sha256
from magtwin.frames import canonical, quat_conjugate, rotate, yaw_from_quat
from magtwin.io.bags.bag import Heard
from magtwin.io.bags.cdr import NS, Index, Messages, decode, leaves
from magtwin.io.bags.db3 import Db3Reader
from magtwin.io.bags.mcap import McapReader
from magtwin.io.bags.messages import (
    BATTERY,
    COMMAND,
    IMU,
    JOINTS,
    MAGNITUDE,
    NAMES,
    ODOMETRY,
    POSE,
    READING,
    SCAN,
    TOPICS,
    TYPES,
    VECTOR,
    Sender,
    Topic,
)
from magtwin.io.bags.readings import poses_at, unit_of
from magtwin.io.bags.writer import FACTS, NOTE
from magtwin.io.recorder import PARTIAL, partial_of
from magtwin.run.arrow import spec_said
from magtwin.run.run import COLUMNS, Column, Run

Array = NDArray[np.float64]
Metadata = dict[str, str | int | float | bool]
FieldUnit = Literal["nT", "uT", "T", "mG", "G"]

LARGEST_METADATA = 1 << 24
"""Bytes of the largest metadata.yaml that is read."""

LONGEST_LINE = 2000
"""Most characters that are said of a bag."""

SCAN_S = 0.5
"""How long a LiDAR counts as on after a scan [s]."""

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""

_DTYPES = (
    "bool",
    *(f"{kind}{size}" for kind in ("int", "uint") for size in (8, 16, 32, 64)),
    "float32",
    "float64",
)


def read_bag(
    path: str | os.PathLike[str],
    *,
    topics: Mapping[str, str] | None = None,
    unit: FieldUnit | None = None,
    recover: bool = False,
) -> Run:
    """The run that a bag holds: one that magtwin wrote, or what a robot recorded.

    A bag of `write_bag` gives back the columns and metadata of its run: fields to a part in 10^15, the
    battery's columns in single precision, all others to the last bit.

    Of a robot's recording the magnetometer's topic is the clock, a row a message; t begins at 0. The topics
    are those of `magtwin.io.bags.messages.TOPICS`, and all but the magnetometer's may be missing. Slower
    signals
    are held causally by the stamps of their headers, and are nan before their first; a topic whose messages
    have none is taken as received, less what the magnetometer's messages took. p_world_base,
    q_world_base_xyzw and yaw are motion capture's too, between two poses interpolated. Gravity is taken off
    accelerations that hold it. The metadata say which topics were read, the unit and how it was told.

    Messages that the index of an MCAP file lacks are read too; the fact `messages_not_indexed` counts them.

    Args:
        path: Folder of a rosbag2, or its storage file (.mcap, .db3).
        topics: What topics are called in a robot's recording, where not as in `TOPICS`:
            `{"/robot/enu/pose": "/vrpn/robot/pose"}`.
        unit: Unit of the field; that which makes it the Earth's unless given: 1e-5..1e-4 is T, 10..100 uT,
            10,000..100,000 nT.
        recover: Whether what is whole of a file that was cut short is read. Where a name says that it is
            partial, as that of a recording that was killed, it always is.

    Raises:
        InputError: There is no bag, it is damaged or was cut short; a topic is missing or of another type;
            stamps run backwards; the unit cannot be.
    """
    path = existing(path, "bag")
    for name in topics or ():
        find("topic", name, {topic.name: topic for topic in _RECORDED})
    with _refusing(path), _Bag(path) as bag, np.errstate(over="ignore", invalid="ignore"):
        if not bag.whole and not recover and PARTIAL not in path.name:
            raise InputError(
                f"{path}: cut short: its end is missing; copy it again, or give it a name such as "
                f"{partial_of(path).name}, under which what is whole is read"
            )
        if READING.name in bag.kinds and NAMES.name in bag.kinds and not topics:
            if unit:
                raise InputError(f"{path}: magtwin wrote it and it says its unit itself; drop {unit!r}")
            run = _own(bag)
        else:
            run = _recorded(bag, topics or {}, unit)
        return run.with_metadata(messages_not_indexed=bag.unindexed) if bag.unindexed else run


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """What damaged bytes make of a reader, in a line."""
    try:
        yield
    except InputError as error:
        said = str(error).removeprefix(f"{path}: ")
        text = _line(said) if said != str(error) else f"damaged bag, or none ({_line(said)})"
        raise InputError(f"{path}: {text}") from error
    except (
        *(OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError),
        *(struct.error, sqlite3.Error, pa.ArrowException, yaml.YAMLError, RecursionError),
    ) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise InputError(f"{path}: damaged bag, or none ({_line(reason)[:200]})") from error


def _line(text: str) -> str:
    """What is said of a bag in a line, as names in it may be of any bytes and any length."""
    text = "".join(c if c.isprintable() else " " for c in text)
    return text if len(text) <= LONGEST_LINE else f"{text[:LONGEST_LINE]} ..."


class _Bag:
    """A bag that is open: all of its storage files as one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files, custom = _files(path)
        self._readers: list[McapReader | Db3Reader] = []
        self.kinds: dict[str, str] = {}
        self.notes: dict[str, str] = dict(custom)
        try:
            for file in self.files:
                self._open(file)
        except BaseException:
            self.close()
            raise

    @property
    def whole(self) -> bool:
        """Whether every file has its end."""
        return all(r.whole for r in self._readers if isinstance(r, McapReader))

    @property
    def unindexed(self) -> int:
        """How many of the messages that were read are missing from the index of an MCAP file."""
        return sum(sum(r.unindexed.values()) for r in self._readers if isinstance(r, McapReader))

    def __enter__(self) -> "_Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        for reader in self._readers:
            reader.close()

    def _open(self, file: Path) -> None:
        reader = (McapReader if file.suffix == ".mcap" else Db3Reader)(file)
        self._readers.append(reader)
        for heard in reader.topics:
            if self.kinds.setdefault(heard.topic, heard.kind) != heard.kind:
                raise InputError(
                    f"topic {heard.topic} is of two types, {self.kinds[heard.topic]} and {heard.kind}"
                )
        if isinstance(reader, McapReader):
            told = {FACTS + key: value for key, value in reader.notes.get(NOTE, {}).items()}
            self.notes |= told
        elif reader.note:
            self.notes |= _custom(yaml.safe_load(reader.note))

    def metadata(self) -> Metadata:
        """What magtwin noted of the run."""
        notes = self.notes.items()
        return _plain({k.removeprefix(FACTS): json.loads(v) for k, v in notes if k.startswith(FACTS)})

    def messages(self, topics: Iterable[str]) -> dict[str, Messages]:
        """The messages of topics, each in the order in which they were received."""
        wanted = set(topics)
        parts: dict[str, list[Messages]] = {topic: [] for topic in wanted}
        for reader in self._readers:
            heard: dict[int, Heard] = {h.id: h for h in reader.topics if h.topic in wanted}
            for number, messages in reader.messages(heard.keys()).items():
                if len(messages) and heard[number].encoding != "cdr":
                    raise InputError(f"topic {heard[number].topic} is encoded as {heard[number].encoding!r}")
                parts[heard[number].topic].append(messages)
        return {topic: _joined(found) for topic, found in parts.items()}


def _files(path: Path) -> tuple[list[Path], dict[str, str]]:
    """The storage files of a bag, and its custom data."""
    if path.is_file():
        if path.suffix not in (".mcap", ".db3"):
            raise InputError(f"{path}: no bag: a folder with metadata.yaml is one, or a .mcap or .db3 file")
        return [path], {}
    lying = sorted(p for p in path.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file())
    told = path / "metadata.yaml"
    if not told.is_file():
        if not lying:
            raise InputError(f"{path}: no bag: metadata.yaml is missing; give the folder that holds it")
        return lying, {}
    if told.stat().st_size > LARGEST_METADATA:
        raise InputError("its metadata.yaml is too large")
    content = yaml.safe_load(told.read_text(encoding="utf-8"))
    about = content["rosbag2_bagfile_information"]
    mode = str(about.get("compression_mode") or "none").lower()
    if mode not in ("none", "storage"):
        raise InputError(f"{path}: compressed by {mode}; unpack it with `ros2 bag convert`")
    names = [Path(str(name)).name for name in about["relative_file_paths"]]  # never out of its folder
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise InputError(f"storage file {missing[0] if missing else ''} is missing")
    strange = [name for name in names if Path(name).suffix not in (".mcap", ".db3")]
    if strange:
        raise InputError(f"{strange[0]} is neither a .mcap nor a .db3 file")
    return [path / name for name in names], _custom(about)


def _plain(said: Any) -> Metadata:
    """Metadata, which are texts and numbers by name."""
    if not isinstance(said, dict):
        raise InputError("its metadata are no table")
    for key, value in said.items():
        if not isinstance(value, str | int | float | bool):
            raise InputError(f"fact {key!r} is neither a text nor a number")
    return said


def _custom(about: Any) -> dict[str, str]:
    custom = about.get("custom_data") if isinstance(about, dict) else None
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}


def _joined(parts: list[Messages]) -> Messages:
    """Messages of several files as those of one."""
    if len(parts) == 1:
        return parts[0]
    none = np.zeros(0, np.int64)
    if not parts:
        return Messages(none, np.zeros(0, np.uint8), none, none)
    bases = np.cumsum([0] + [len(p.buffer) for p in parts])
    return Messages(
        np.concatenate([p.received for p in parts]),
        np.concatenate([p.buffer for p in parts]),
        np.concatenate([p.start + base for p, base in zip(parts, bases, strict=False)]),
        np.concatenate([p.size for p in parts]),
    ).in_order()


def _own(bag: _Bag) -> Run:
    """The run that magtwin wrote."""
    _check_kinds(bag, (READING, NAMES))
    might = {name for name, topic in TOPICS.items() if topic.carries} & bag.kinds.keys()
    told = bag.messages((READING.name, NAMES.name, *might))
    rows = told[READING.name]
    texts = decode(leaves(TYPES[NAMES.kind]), told[NAMES.name], ["data"])["data"]
    if not texts:
        raise InputError(f"{bag.path}: a recording of which nothing had been written yet")
    table = json.loads(texts[0])
    data = decode(leaves(TYPES[READING.kind]), rows, ["data"])["data"]
    most = data.shape[1] if len(rows) else int(sum(int(c["width"] or 1) for c in table["columns"]))
    data = data if len(rows) else np.zeros((0, most))
    unit = str(table["unit"])
    carriers = {
        str(c["topic"]): find("topic", str(c["topic"]), TOPICS) for c in table["columns"] if "topic" in c
    }
    _check_kinds(bag, carriers.values())
    held: dict[str, NDArray[Any]] = {}
    for name, topic in carriers.items():
        held |= _held(topic, told[name], rows.received, unit)
    columns: dict[str, NDArray[Any]] = {}
    specs: dict[str, Column] = {}
    for column in table["columns"]:
        name, width = str(column["name"]), column["width"]
        if "topic" in column:
            values = held[name]
        else:
            first = int(column["first"])
            last = first + (1 if width is None else int(width))
            if not 0 <= first <= last <= most:
                raise InputError(f"column {name!r} is not in the readings, which have {most} numbers")
            values = data[:, first] if width is None else data[:, first:last]
        dtype = str(column["dtype"])
        if dtype not in _DTYPES:
            raise InputError(f"column {name!r} is of an unknown kind {dtype!r}")
        columns[name] = np.ascontiguousarray(values).astype(dtype, copy=False)
        if column["own"]:
            said = {key: str(column[key]) for key in ("unit", "frame", "doc", "interpolation")}
            specs[name] = spec_said(said, tuple(map(str, column["parts"])))
    if "t" in columns:
        _check_order(bag.path, READING.name, columns["t"])
    return Run(columns, {**_plain(table.get("facts", {})), **bag.metadata()}, specs)


def _held(topic: Topic, messages: Messages, rows: Index, unit: str) -> dict[str, NDArray[Any]]:
    """The columns that a topic of magtwin's own carries, at the times of rows [ns]."""
    fields = decode(leaves(TYPES[topic.kind]), messages, topic.leaves[topic.kind])
    values = topic.read[topic.kind](fields)
    if "magnetic_field" in values:
        b = values["magnetic_field"] * NT_PER[unit]
        values = {topic.carries[0]: b if topic is VECTOR else b[:, 0]}
    at = np.searchsorted(messages.received, rows, side="right") - 1
    known = at >= 0
    if topic.sent == "each":
        known &= messages.received[at] == rows if len(messages) else False
    return {name: _taken(array, at, known) for name, array in values.items()}


def _taken(values: NDArray[Any], at: NDArray[np.intp], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows `at` of values, nan where none is known."""
    if known.all() and len(values):
        return values[at]
    out = np.full((len(at), *values.shape[1:]), np.nan)
    out[known] = values[at[known]]
    return out


def _check_kinds(bag: _Bag, topics: Iterable[Topic]) -> None:
    """Refuse topics that are missing, or not of their type."""
    for topic in topics:
        if topic.name not in bag.kinds:
            raise _missing(bag, topic.name)
        if bag.kinds[topic.name] != topic.kind:
            raise InputError(
                f"{bag.path}: topic {topic.name} is a {bag.kinds[topic.name]}, not a {topic.kind}"
            )


def _missing(bag: _Bag, name: str) -> InputError:
    seen = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.kinds.items())) or "none"
    near = hint(name, bag.kinds)
    near = near + "; " if near.startswith("did you mean") else ""
    return InputError(f"{bag.path}: no topic {name}; {near}topics in it: {seen}")


def _check_order(path: Path, topic: str, t: Array) -> None:
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{path}: stamps of {topic} run backwards: {t[k + 1]:.6f} s after {t[k]:.6f} s, in message "
            f"{k + 2} of {len(t)}"
        )


class _Signal:
    """A topic of a robot's recording: its columns, and when they were taken [s since the first reading]."""

    def __init__(self, name: str, topic: Topic, kind: str, messages: Messages, path: Path) -> None:
        form = leaves(TYPES[kind])
        stamped = form[0].name == "header.stamp"
        wanted = [*topic.leaves[kind], *(["header.stamp"] if stamped else [])]
        self.name, self.topic, self.received = name, topic, messages.received
        try:
            self.fields = decode(form, messages, wanted)
        except InputError as error:
            raise InputError(f"{path}: topic {name}: {error}") from error
        self.read = topic.read.get(kind, dict)
        stamps = self.fields.pop("header.stamp", None) if stamped else None
        # One stamp of 0 is that of the first moment of a simulation; more of them are none at all.
        self.stamps = stamps if stamps is not None and np.count_nonzero(stamps == 0) <= 1 else None


def _recorded(bag: _Bag, names: Mapping[str, str], unit: FieldUnit | None) -> Run:
    """The run that a robot recorded."""
    path = bag.path
    signals = _signals(bag, names)
    if MAGNITUDE not in signals:
        raise _missing(bag, names.get(MAGNITUDE.name, MAGNITUDE.name))
    clock = signals[MAGNITUDE]
    by_header = clock.stamps is not None
    ns = clock.received if clock.stamps is None else clock.stamps
    transport = int(np.median(clock.received - ns)) if len(ns) else 0
    _check_order(path, clock.name, ns / NS)
    first = np.flatnonzero(np.diff(ns, prepend=ns[0] - 1) > 0)  # a message that came twice is one
    start = int(ns[0])
    t = (ns[first] - start) / NS
    columns: dict[str, NDArray[Any]] = {"t": t}
    told, vector = _field(clock, path, unit)
    columns["b_measured_nt"] = told[first]
    if vector is not None:
        columns["b_vector_measured_nt"] = vector[first]
    metadata: Metadata = {"bag": path.name, "bag_sha256": " ".join(sha256(file) for file in bag.files)}
    metadata |= {"clock": clock.name, "stamps": "header" if by_header else "receipt", "start_ns": str(start)}
    metadata |= {"field_unit": clock.fields["unit"], "field_unit_told": clock.fields["told"]}
    for topic, signal in signals.items():
        if topic is MAGNITUDE:
            continue
        taken = signal.received - transport if signal.stamps is None or not by_header else signal.stamps
        when = (taken - start) / NS
        _check_order(path, signal.name, when)
        if when[-1] < t[0] or when[0] > t[-1]:
            raise InputError(
                f"{path}: {signal.name} spans {when[0]:.3f}..{when[-1]:.3f} s since the first reading of "
                f"{clock.name}, which ends at {t[-1]:.3f} s; are they of one clock?"
            )
        columns |= _columns(signal, when, t, metadata, path)
    metadata["topics"] = " ".join(sorted(signal.name for signal in signals.values()))
    return Run({name: columns[name] for name in COLUMNS if name in columns}, metadata)


_RECORDED = (MAGNITUDE, POSE, ODOMETRY, IMU, BATTERY, COMMAND, JOINTS, SCAN, VECTOR)
"""Topics of a robot's recording that are read."""


def _signals(bag: _Bag, names: Mapping[str, str]) -> dict[Topic, _Signal]:
    """The topics that a recording has."""
    known = {topic.name: topic for topic in _RECORDED}
    chosen: dict[Topic, str] = {}
    for name, topic in known.items():
        here = names.get(name, name)
        if here not in bag.kinds:
            if name in names:
                raise _missing(bag, here)
            continue
        if bag.kinds[here] not in topic.leaves:
            raise InputError(
                f"{bag.path}: topic {here} is a {bag.kinds[here]}; read is {' or '.join(topic.leaves)}"
            )
        chosen[topic] = here
    messages = bag.messages(chosen.values())
    for topic, here in chosen.items():
        if not len(messages[here]) and (topic is MAGNITUDE or topic.name in names):
            raise InputError(f"{bag.path}: topic {here} has no message")
    return {
        topic: _Signal(here, topic, bag.kinds[here], messages[here], bag.path)
        for topic, here in chosen.items()
        if len(messages[here])
    }


def _field(signal: _Signal, path: Path, unit: FieldUnit | None) -> tuple[Array, Array | None]:
    """Magnitudes [nT], and vectors where the messages hold some; the unit is kept in the signal's fields."""
    b = signal.read(signal.fields)["magnetic_field"]
    vector = b if b.ndim == 2 and np.any(b[:, 1:] != 0) else None
    size = np.abs(b if b.ndim == 1 else b[:, 0]) if vector is None else np.linalg.norm(b, axis=1)
    finite = size[np.isfinite(size)]
    if not len(finite):
        raise InputError(f"{path}: no message of {signal.name} holds a number")
    signal.fields["told"] = "given" if unit else "by its size"
    unit = unit or unit_of(float(finite.mean()), path, signal.name)
    check_unit(NT_PER[unit] * finite, str(path), signal.name, unit)
    signal.fields["unit"] = unit
    return NT_PER[unit] * size, None if vector is None else NT_PER[unit] * vector


def _columns(
    signal: _Signal, when: Array, t: Array, metadata: Metadata, path: Path
) -> dict[str, NDArray[Any]]:
    """The columns that a slower signal gives, held causally at the times of readings [s]."""
    at = np.searchsorted(when, t, side="right") - 1
    known = at >= 0
    if signal.topic is SCAN:
        since = np.where(known, t - when[np.maximum(at, 0)], np.inf)
        return {"lidar_on": since < SCAN_S}
    if signal.topic is JOINTS:
        return _wheels(signal, when, t)
    values = signal.read(signal.fields)
    if signal.topic is VECTOR:
        size = np.linalg.norm(values["magnetic_field"], axis=1)
        if not np.isfinite(size).any():
            return {}
        unit = unit_of(float(size[np.isfinite(size)].mean()), path, signal.name)  # perhaps not the clock's
        metadata["vector_unit"] = unit
        values = {"b_vector_measured_nt": values["magnetic_field"] * NT_PER[unit]}
    for name in values.keys() & {"mocap_q_xyzw", "imu_q_xyzw"}:
        values[name] = canonical(values[name])
    if signal.topic is IMU:
        a = values["imu_a"]
        known_a = a[np.isfinite(a).all(axis=1)]
        mean = float(np.linalg.norm(known_a.mean(axis=0))) if len(known_a) else 0.0
        if abs(mean - GRAVITY) < GRAVITY / 10:
            values["imu_a"] = a - rotate(quat_conjugate(values["imu_q_xyzw"]), (0.0, 0.0, GRAVITY))
            metadata["imu_gravity"] = "removed"
    found = {name: _taken(array, at, known) for name, array in values.items()}
    if signal.topic is POSE:
        once = np.flatnonzero(np.diff(when, prepend=-np.inf) > 0)
        p, q, inside = poses_at(t, when[once], np.concatenate(list(values.values()), axis=1)[once])
        found["p_world_base"] = np.where(inside[:, None], p, found["mocap_p"])
        found["q_world_base_xyzw"] = np.where(inside[:, None], q, found["mocap_q_xyzw"])
        found["yaw"] = yaw_from_quat(found["q_world_base_xyzw"])
        found["flag_pose_lost"] = ~inside
        metadata["truth"] = f"motion capture, {signal.name}"
    return found


def _wheels(signal: _Signal, when: Array, t: Array) -> dict[str, NDArray[Any]]:
    """The wheels' angles, where the joints have the names that TurtleBot's have."""
    sides = Sender().wheel_joints
    has = np.array([set(sides) <= set(names) for names in signal.fields["name"]])
    if not has.any():
        return {}
    rows = np.flatnonzero(has)
    names = [signal.fields["name"][row] for row in rows]
    position = signal.fields["position"]
    places = np.array([[words.index(side) for side in sides] for words in names])
    if places.max() >= position.shape[1]:
        raise InputError(f"{signal.name} has fewer positions than names")
    angle = position[rows[:, None], places]
    at = np.searchsorted(when[rows], t, side="right") - 1
    return {"wheel_angle": _taken(angle, at, at >= 0)}
