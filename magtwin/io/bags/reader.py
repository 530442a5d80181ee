"""Reading bags as runs: those that magtwin wrote, and recordings of a robot."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.units import NT_PER, Unit, check_factor
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import Index, decode
from magtwin.io.bags.topics import NAMES, READING, TOPICS, VECTOR, Topic
from magtwin.io.bags.types import layout
from magtwin.io.recording.roles import check_roles
from magtwin.io.recording.run import Recording, taken
from magtwin.io.recording.signal import Signal, read_signal
from magtwin.run.arrow import check_metadata, spec_said
from magtwin.run.run import Column, Run

_DTYPES = {"bool", "float32", "float64", *(f"{k}int{n}" for k in ("", "u") for n in (8, 16, 32, 64))}


def read_bag(
    path: str | os.PathLike[str],
    *,
    topics: Mapping[str, str] | None = None,
    unit: Unit | None = None,
    scale: float | None = None,
    survey: bool = False,
) -> Run:
    """The run in a bag: one that magtwin wrote, or a robot's recording.

    A bag of `write_bag` gives back the columns and metadata of its run: fields to 1 part in 10^15, the
    battery's columns in single precision, all others to the last bit.

    In a robot's recording the magnetometer's topic is the clock, one row per message; t begins at 0. Other
    topics may be missing. A topic with a name of `magtwin.io.bags.topics.TOPICS`, or that `topics` names, is
    the one of its role; else it is the only one of a fitting type. Slower signals are held causally by the
    stamps of their headers, and are nan before their first message. A topic without stamps goes by time of
    receipt, less the median delay of the magnetometer's messages. p_world_base, q_world_base_xyzw and yaw are
    interpolated between poses; without poses, they are odometry if /tf moves it in the map. Vectors and poses
    of parts of the robot become those of base_link by /tf_static. Gravity is subtracted from accelerations
    that contain it. The metadata name the topics, the unit, how it was found, and what was deduced, turned,
    sorted or left out (`taken`).

    Args:
        path: Folder of a rosbag2, or its storage file (.mcap, .db3). A truncated file is read up to its last
            whole chunk if its name is partial, as that of a killed recording.
        topics: Topics of roles in a robot's recording, by their names in `TOPICS`, such as
            `{"/robot/enu/pose": "/vrpn/robot/pose"}`.
        unit: Unit of the field. Default: the unit that makes it the Earth's field: 1e-5..1e-4 is T, 10..100
            is uT, 10,000..100,000 is nT.
        scale: Factor from the bag's values to nT, in place of a unit.
        survey: Read the field and the poses only. Odometry gives them if nothing else does, and a recording
            without poses is refused.

    Raises:
        InputError: There is no bag, or it is damaged or truncated; a topic is missing or of another type, or
            there are several of a role; stamps run backwards; no unit makes the field the Earth's; or the
            scale is not above 0, or is given beside a unit.
    """
    check_factor(unit, scale)
    check_roles(topics or ())
    with Bag(Path(path)) as bag, np.errstate(over="ignore", invalid="ignore"):
        if READING.name in bag.kinds and NAMES.name in bag.kinds and not topics:
            if unit or scale is not None:
                raise InputError(f"{bag.path}: magtwin wrote it, with its unit; drop {unit or scale!r}")
            if (run := _own(bag)) is not None:
                return run
        recording = Recording(bag, topics or {}, survey=survey)
        recording.read(unit, scale)
        return recording.run


def _own(bag: Bag) -> Run | None:
    """The run that magtwin wrote; None if the names of its columns were damaged."""
    _check_kinds(bag, (READING, NAMES))
    carriers = {name for name, topic in TOPICS.items() if topic.carried} & bag.kinds.keys()
    messages = bag.messages((READING.name, NAMES.name, *carriers))
    rows = messages[READING.name]
    texts = decode(layout(NAMES.kind), messages[NAMES.name], ["data"])["data"]
    if not texts:
        if bag.damaged:
            return None
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
        signal = read_signal(bag, topic.name, topic, messages[topic.name])
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
    return {name: taken(array, at, known) for name, array in values.items()}


def _check_kinds(bag: Bag, topics: Iterable[Topic]) -> None:
    """Refuse topics that are missing or of another type."""
    for topic in topics:
        if topic.name not in bag.kinds:
            raise bag.missing(topic.name)
        if bag.kinds[topic.name] != topic.kind:
            kind = bag.kinds[topic.name]
            raise InputError(f"{bag.path}: topic {topic.name} is a {kind}, not a {topic.kind}")
