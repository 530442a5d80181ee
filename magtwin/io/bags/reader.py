"""Reading bags as runs: those that magtwin wrote, and recordings of a robot."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.units import NT_PER, Unit
from magtwin.files import sha256
from magtwin.frames import canonical, quat_conjugate, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag, Signal, check_poses, field_nt, poses_at, unit_of
from magtwin.io.bags.cdr import NS, Index, decode
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.topics import (
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
    VECTOR,
    Topic,
)
from magtwin.io.bags.types import layout
from magtwin.run.arrow import check_metadata, spec_said
from magtwin.run.run import COLUMNS, Column, Run

Array = NDArray[np.float64]

SCAN_S = 0.5
"""Time after a scan during which a LiDAR counts as on [s]."""

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""

RECORDED = (MAGNITUDE, POSE, ODOMETRY, IMU, BATTERY, COMMAND, JOINTS, SCAN, VECTOR)
"""Topics that are read from a robot's recording."""

_DTYPES = {"bool", "float32", "float64", *(f"{k}int{n}" for k in ("", "u") for n in (8, 16, 32, 64))}


def read_bag(
    path: str | os.PathLike[str],
    *,
    topics: Mapping[str, str] | None = None,
    unit: Unit | None = None,
    recover: bool = False,
) -> Run:
    """The run in a bag: one that magtwin wrote, or a robot's recording.

    A bag of `write_bag` gives back the columns and metadata of its run: fields to 1 part in 10^15, the
    battery's columns in single precision, all others to the last bit.

    In a robot's recording the magnetometer's topic is the clock, one row per message; t begins at 0. The
    topics are in `magtwin.io.bags.topics.TOPICS`; all but the magnetometer's may be missing. Slower signals
    are held causally by the stamps of their headers, and are nan before their first message. A topic without
    stamps goes by time of receipt, less the median delay of the magnetometer's messages. p_world_base,
    q_world_base_xyzw and yaw are motion capture, interpolated between poses. Gravity is subtracted from
    accelerations that contain it. The metadata name the topics, the unit, and how the unit was found.

    Args:
        path: Folder of a rosbag2, or its storage file (.mcap, .db3).
        topics: Topic names in a robot's recording that differ from `TOPICS`, such as
            `{"/robot/enu/pose": "/vrpn/robot/pose"}`.
        unit: Unit of the field. Default: the unit that makes it the Earth's field: 1e-5..1e-4 is T, 10..100
            is uT, 10,000..100,000 is nT.
        recover: Read a truncated file up to its last whole chunk. Always done for names that are partial,
            such as those of killed recordings.

    Raises:
        InputError: There is no bag, or it is damaged or truncated; a topic is missing or of another type;
            stamps run backwards; no unit makes the field the Earth's.
    """
    known = {topic.name: topic for topic in RECORDED}
    for name in topics or ():
        find("topic", name, known)
    with Bag(Path(path), recover=recover) as bag, np.errstate(over="ignore", invalid="ignore"):
        if READING.name in bag.kinds and NAMES.name in bag.kinds and not topics:
            if unit:
                raise InputError(f"{bag.path}: magtwin wrote it and it holds its unit; drop {unit!r}")
            return _own(bag)
        return _recorded(bag, topics or {}, unit)


def _own(bag: Bag) -> Run:
    """The run that magtwin wrote."""
    _check_kinds(bag, (READING, NAMES))
    carriers = {name for name, topic in TOPICS.items() if topic.carried} & bag.kinds.keys()
    messages = bag.messages((READING.name, NAMES.name, *carriers))
    rows = messages[READING.name]
    texts = decode(layout(NAMES.kind), messages[NAMES.name], ["data"])["data"]
    if not texts:
        raise InputError(f"{bag.path}: a recording into which nothing was written yet")
    table = json.loads(texts[0])
    data = decode(layout(READING.kind), rows, ["data"])["data"]
    if not len(rows):
        data = np.zeros((0, sum(int(column["width"] or 1) for column in table["columns"])))
    names = {str(column["topic"]) for column in table["columns"] if "topic" in column}
    topics = [find("topic", name, TOPICS) for name in names]
    _check_kinds(bag, topics)
    carried: dict[str, NDArray[Any]] = {}
    for topic in topics:
        signal = bag.signal(topic.name, topic, messages[topic.name])
        carried |= _carried(signal, rows.received, str(table["unit"]))
    columns: dict[str, NDArray[Any]] = {}
    specs: dict[str, Column] = {}
    for column in table["columns"]:
        name, width, dtype = str(column["name"]), column["width"], str(column["dtype"])
        if "topic" in column:
            values = carried[name]
        else:
            first = int(column["first"])
            last = first + (1 if width is None else int(width))
            if not 0 <= first <= last <= data.shape[1]:
                raise InputError(f"column {name!r} is not in the readings of {data.shape[1]} numbers")
            values = data[:, first] if width is None else data[:, first:last]
        if dtype not in _DTYPES:
            raise InputError(f"column {name!r} has an unknown type {dtype!r}")
        columns[name] = np.ascontiguousarray(values).astype(dtype, copy=False)
        if column["own"]:
            texts = {key: str(column[key]) for key in ("unit", "frame", "doc", "interpolation")}
            specs[name] = spec_said(texts, tuple(map(str, column["parts"])))
    if "t" in columns:
        _check_order(bag.path, READING.name, columns["t"])
    return Run(columns, {**check_metadata(table.get("facts", {})), **bag.metadata()}, specs)


def _carried(signal: Signal, rows: Index, unit: str) -> dict[str, NDArray[Any]]:
    """The columns that a topic of magtwin carries, at the times of rows [ns]."""
    values, topic, received = signal.columns(), signal.topic, signal.received
    if "magnetic_field" in values:
        b = values["magnetic_field"] * NT_PER[unit]
        values = {topic.needs[0]: b if topic is VECTOR else b[:, 0]}
    at = np.searchsorted(received, rows, side="right") - 1
    known = at >= 0
    if topic.sent == "each":
        known &= received[at] == rows if len(received) else False
    return {name: _taken(array, at, known) for name, array in values.items()}


def _taken(values: NDArray[Any], at: NDArray[np.intp], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows `at` of values; nan where they are not known."""
    if known.all() and len(values):
        return values[at]
    out = np.full((len(at), *values.shape[1:]), np.nan)
    out[known] = values[at[known]]
    return out


def _check_kinds(bag: Bag, topics: Iterable[Topic]) -> None:
    """Refuse topics that are missing or of another type."""
    for topic in topics:
        if topic.name not in bag.kinds:
            raise bag.missing(topic.name)
        if bag.kinds[topic.name] != topic.kind:
            raise InputError(
                f"{bag.path}: topic {topic.name} is a {bag.kinds[topic.name]}, not a {topic.kind}"
            )


def _check_order(path: Path, topic: str, t: Array) -> None:
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{path}: stamps of {topic} run backwards: {t[k + 1]:.6f} s after {t[k]:.6f} s, in message "
            f"{k + 2} of {len(t)}"
        )


def _recorded(bag: Bag, names: Mapping[str, str], unit: Unit | None) -> Run:
    """The run that a robot recorded."""
    path = bag.path
    signals = _signals(bag, names)
    if MAGNITUDE not in signals:
        raise bag.missing(names.get(MAGNITUDE.name, MAGNITUDE.name))
    clock = signals.pop(MAGNITUDE)
    by_header = clock.stamps is not None
    ns = clock.received if clock.stamps is None else clock.stamps
    delay = int(np.median(clock.received - ns)) if len(ns) else 0
    _check_order(path, clock.name, ns / NS)
    first = np.flatnonzero(np.diff(ns, prepend=ns[0] - 1) > 0)  # a repeated message counts once
    start = int(ns[0])
    t = (ns[first] - start) / NS
    field = field_nt(clock.columns()["magnetic_field"], str(path), clock.name, unit=unit)
    columns: dict[str, NDArray[Any]] = {"t": t, "b_measured_nt": field.b_nt[first]}
    if field.vector_nt is not None:
        columns["b_vector_measured_nt"] = field.vector_nt[first]
    metadata: dict[str, Any] = {"bag": path.name, "bag_sha256": " ".join(sha256(file) for file in bag.files)}
    metadata |= {"clock": clock.name, "stamps": "header" if by_header else "receipt", "start_ns": str(start)}
    metadata |= {"field_unit": field.label, "field_unit_told": "given" if unit else "by its size"}
    for signal in signals.values():
        taken = signal.received - delay if signal.stamps is None or not by_header else signal.stamps
        when = (taken - start) / NS
        _check_order(path, signal.name, when)
        if when[-1] < t[0] or when[0] > t[-1]:
            raise InputError(
                f"{path}: {signal.name} spans {when[0]:.3f}..{when[-1]:.3f} s since the first reading of "
                f"{clock.name}, which ends at {t[-1]:.3f} s; are they of one clock?"
            )
        columns |= _columns(signal, when, t, metadata, path)
    metadata["topics"] = " ".join(sorted(signal.name for signal in (clock, *signals.values())))
    return Run({name: columns[name] for name in COLUMNS if name in columns}, metadata)


def _signals(bag: Bag, names: Mapping[str, str]) -> dict[Topic, Signal]:
    """The topics in a recording."""
    chosen: dict[Topic, str] = {}
    for topic in RECORDED:
        name = names.get(topic.name, topic.name)
        if name not in bag.kinds:
            if topic.name in names:
                raise bag.missing(name)
            continue
        if bag.kinds[name] not in topic.reads:
            raise InputError(
                f"{bag.path}: topic {name} is a {bag.kinds[name]}; it must be {' or '.join(topic.reads)}"
            )
        chosen[topic] = name
    messages = bag.messages(chosen.values())
    signals = {}
    for topic, name in chosen.items():
        if len(messages[name]):
            signals[topic] = bag.signal(name, topic, messages[name])
        elif topic is MAGNITUDE or topic.name in names:
            raise InputError(f"{bag.path}: topic {name} has no message")
    return signals


def _columns(
    signal: Signal, when: Array, t: Array, metadata: dict[str, Any], path: Path
) -> dict[str, NDArray[Any]]:
    """The columns of a slower signal, held causally at the times of readings [s]."""
    at = np.searchsorted(when, t, side="right") - 1
    known = at >= 0
    if signal.topic is SCAN:
        since = np.where(known, t - when[np.maximum(at, 0)], np.inf)
        return {"lidar_on": since < SCAN_S}
    if signal.topic is JOINTS:
        return _wheels(signal, when, t)
    values = signal.columns()
    if signal.topic is VECTOR:
        size = np.linalg.norm(values["magnetic_field"], axis=1)
        size = size[np.isfinite(size)]
        if not len(size):
            return {}
        unit = unit_of(float(np.median(size)), str(path), signal.name)  # may differ from the clock's
        metadata["vector_unit"] = unit
        values = {"b_vector_measured_nt": values["magnetic_field"] * NT_PER[unit]}
    for name in values.keys() & {"mocap_q_xyzw", "imu_q_xyzw"}:
        values[name] = canonical(values[name])
    if signal.topic is IMU:
        a = values["imu_a"]
        finite = a[np.isfinite(a).all(axis=1)]
        mean = float(np.linalg.norm(finite.mean(axis=0))) if len(finite) else 0.0
        if abs(mean - GRAVITY) < GRAVITY / 10:
            values["imu_a"] = a - rotate(quat_conjugate(values["imu_q_xyzw"]), (0.0, 0.0, GRAVITY))
            metadata["imu_gravity"] = "removed"
    columns = {name: _taken(array, at, known) for name, array in values.items()}
    if signal.topic is POSE:
        once = np.flatnonzero(np.diff(when, prepend=-np.inf) > 0)
        pose = np.concatenate([values["mocap_p"], values["mocap_q_xyzw"]], axis=1)
        check_poses(when[once], pose[once], str(path), signal.name)
        p, q, inside = poses_at(t, when[once], pose[once])
        columns["p_world_base"] = np.where(inside[:, None], p, columns["mocap_p"])
        columns["q_world_base_xyzw"] = np.where(inside[:, None], q, columns["mocap_q_xyzw"])
        columns["yaw"] = yaw_from_quat(columns["q_world_base_xyzw"])
        columns["flag_pose_lost"] = ~inside
        metadata["truth"] = f"motion capture, {signal.name}"
    return columns


def _wheels(signal: Signal, when: Array, t: Array) -> dict[str, NDArray[Any]]:
    """The angles of the wheels, if the joints have the names of a TurtleBot's."""
    sides = [joint.name for joint in Sender().wheel_joints]
    joints = signal.fields["name"]
    rows = np.array([row for row, names in enumerate(joints) if set(sides) <= set(names)], np.intp)
    if not len(rows):
        return {}
    position = signal.fields["position"]
    places = np.array([[joints[row].index(side) for side in sides] for row in rows])
    if places.max() >= position.shape[1]:
        raise InputError(f"{signal.name} has fewer positions than names")
    angle = position[rows[:, None], places]
    at = np.searchsorted(when[rows], t, side="right") - 1
    return {"wheel_angle": _taken(angle, at, at >= 0)}
