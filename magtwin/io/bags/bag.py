"""Bag: the reading layer of all bags: storage files, topics, types, stamps, and the unit of the field."""

import json
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.units import GREATEST_MEAN_NT, LEAST_MEAN_NT, NT_PER, Unit, check_unit
from magtwin.files import existing, existing_file, read_text, yaml_loader
from magtwin.io.bags.cdr import Messages, decode
from magtwin.io.bags.compression import Room
from magtwin.io.bags.db3 import Db3Reader, custom_data
from magtwin.io.bags.mcap import McapReader
from magtwin.io.bags.topics import Topic
from magtwin.io.bags.types import layout
from magtwin.io.bags.writer import CUSTOM, NOTE
from magtwin.io.recorder import PARTIAL, partial_of
from magtwin.run.arrow import check_metadata
from magtwin.run.resample import linear, quaternion
from magtwin.run.run import Metadata

Array = NDArray[np.float64]

LONGEST_LINE = 2000
"""Most characters of an error message."""

GAP = 5.0
"""Poses further apart than this multiple of their median interval are not interpolated between."""

LEAST_GAP_S = 0.1
"""Poses closer than this are always interpolated between [s]."""

UNIT_WITHIN = 0.01
"""Largest error of the length of a quaternion."""


class Bag:
    """An open bag: all of its storage files as one.

    Args:
        path: Folder of a rosbag2, or a storage file (.mcap, .db3).
        recover: Read a truncated file up to its last whole chunk. Always done if the name is partial.

    Attributes:
        path: As given.
        files: Its storage files.
        kinds: Message type of each topic.

    Raises:
        InputError: There is no bag, or it is damaged or truncated.
    """

    def __init__(self, path: Path, *, recover: bool = False) -> None:
        self.path = existing(path, "bag")
        self.kinds: dict[str, str] = {}
        self._readers: list[McapReader | Db3Reader] = []
        with _one_line(self.path), ExitStack() as opened:
            self.files, self._custom, self._packed = _files(self.path)
            files = [existing_file(file, "storage file of a bag", "bag") for file in self.files]
            if self._packed == "file":
                folder, room = Path(opened.enter_context(TemporaryDirectory())), Room(self.path, files)
                files = [room.file(file, folder) for file in files]
            for file in files:
                reader = (McapReader if file.suffix.lower() == ".mcap" else Db3Reader)(file)
                opened.callback(reader.close)
                self._readers.append(reader)
                for topic in reader.topics:
                    if self.kinds.setdefault(topic.topic, topic.kind) != topic.kind:
                        kinds = f"{self.kinds[topic.topic]} and {topic.kind}"
                        raise InputError(f"topic {topic.topic} has two types, {kinds}")
                if isinstance(reader, McapReader):
                    self._custom |= {CUSTOM + key: value for key, value in reader.notes.get(NOTE, {}).items()}
                else:
                    self._custom |= reader.notes
            if not (all(reader.whole for reader in self._readers) or recover or PARTIAL in self.path.name):
                raise InputError(
                    f"{self.path}: cut short: its end is missing; copy it again, or rename it such as "
                    f"{partial_of(self.path).name} to read the whole part"
                )
            self._opened = opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        self._opened.close()
        if error is not None:
            with _one_line(self.path):
                raise error

    def metadata(self) -> Metadata:
        """The metadata of the run that magtwin wrote; empty for other bags."""
        texts = {key.removeprefix(CUSTOM): t for key, t in self._custom.items() if key.startswith(CUSTOM)}
        return check_metadata({key: json.loads(text) for key, text in texts.items()})

    def messages(self, topics: Iterable[str]) -> dict[str, Messages]:
        """The messages of topics, each in the order of receipt."""
        wanted, room = set(topics), Room(self.path, self.files)
        parts: dict[str, list[Messages]] = {topic: [] for topic in wanted}
        for reader in self._readers:
            chosen = {topic.id: topic for topic in reader.topics if topic.topic in wanted}
            for number, messages in reader.messages(chosen.keys()).items():
                topic = chosen[number]
                if len(messages) and topic.encoding != "cdr":
                    raise InputError(f"topic {topic.topic} is encoded as {topic.encoding!r}, not cdr")
                whole = room.messages(messages) if self._packed == "message" else messages
                parts[topic.topic].append(whole)
        return {topic: _joined(found) for topic, found in parts.items()}

    def signal(self, name: str, topic: Topic, messages: Messages) -> "Signal":
        """The messages of a topic, decoded; `name` is the topic's name in this bag."""
        kind = self.kinds[name]
        leaves = layout(kind)
        stamped = leaves[0].name == "header.stamp"
        wanted = [*topic.leaves(kind), *(["header.stamp"] if stamped else [])]
        try:
            fields = decode(leaves, messages, wanted)
        except InputError as error:
            raise InputError(f"{self.path}: topic {name}: {error}") from error
        stamps = fields.pop("header.stamp", None) if stamped else None
        # A single stamp of 0 is the first moment of a simulation; several mean that there are no stamps.
        if stamps is not None and np.count_nonzero(stamps == 0) > 1:
            stamps = None
        return Signal(name, topic, kind, messages.received, fields, stamps)

    def missing(self, name: str) -> InputError:
        """The refusal of a topic that is not in the bag."""
        near = hint(name, self.kinds)
        near = near + "; " if near.startswith("did you mean") else ""
        return InputError(f"{self.path}: no topic {name}; {near}topics in it: {self.listed()}")

    def listed(self) -> str:
        """The topics with their types."""
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.kinds.items())) or "none"


class Signal(NamedTuple):
    """The decoded messages of a topic."""

    name: str
    """Name of the topic in the bag."""

    topic: Topic
    kind: str
    """Message type."""

    received: NDArray[np.int64]
    """Times of receipt [ns], shape (M,)."""

    fields: dict[str, Any]
    """Values by leaf name."""

    stamps: NDArray[np.int64] | None
    """Stamps of the headers [ns], shape (M,). None: the messages have none."""

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns that the topic gives, one row a message."""
        return self.topic.read(self.kind, self.fields)


class Field(NamedTuple):
    """A magnetic field in nT."""

    b_nt: Array
    """Magnitude [nT], shape (N,)."""

    vector_nt: Array | None
    """Vector [nT], shape (N, 3). None: the messages hold a magnitude."""

    label: str
    """Unit of the messages."""


def field_nt(
    b: Array, where: str, topic: str, *, unit: Unit | None = None, scale: float | None = None
) -> Field:
    """The field of messages in nT.

    Args:
        b: Magnitudes, shape (N,), or vectors, shape (N, 3). Vectors whose y and z are all 0 are magnitudes in
            x, as APRILab's robot publishes them.
        where: The file, for refusals.
        topic: The topic, for refusals.
        unit: Their unit. Default: the unit that makes their median the Earth's field.
        scale: Factor to nT, in place of a unit.

    Raises:
        InputError: The mean cannot be the Earth's field, or no message holds a number.
    """
    vector = b if b.ndim == 2 and np.any(b[:, 1:] != 0) else None
    size = np.abs(b if b.ndim == 1 else b[:, 0]) if vector is None else np.linalg.norm(b, axis=1)
    finite = size[np.isfinite(size)]
    if not len(finite):
        raise InputError(f"{where}: no message of {topic} holds a number")
    told = unit is not None or scale is not None
    if scale is None:
        unit = unit or unit_of(float(np.median(finite)), where, topic)
    factor = NT_PER[unit] if unit else float(scale or 1.0)
    check_unit(factor * finite, where, topic, unit or "nT", scale=scale, told=told)
    label = unit or f"units of {scale:g} nT"
    return Field(factor * size, None if vector is None else factor * vector, label)


def unit_of(usual: float, where: str, topic: str) -> Unit:
    """The unit in which a median magnitude is the Earth's field; the ranges of the units do not overlap."""
    for unit, factor in NT_PER.items():
        if LEAST_MEAN_NT <= usual * factor < GREATEST_MEAN_NT:
            return unit  # type: ignore[return-value]
    raise InputError(f"{where}: the median of {topic} is {usual:.6g}; in no unit is that the Earth's field")


def poses_at(t: Array, pose_t: Array, pose: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interpolate poses; positions linearly, orientations by slerp.

    Args:
        t: Times [s], shape (N,).
        pose_t: Times of the poses, ascending [s], shape (M,).
        pose: Positions and orientations xyzw, shape (M, 7).

    Returns:
        Positions (N, 3), orientations xyzw (N, 4), and whether each time lies between two poses (N,).
    """
    sound = sound_poses(pose)
    pose_t, pose = pose_t[sound], pose[sound]
    if len(pose_t) < 2:
        return np.zeros((len(t), 3)), np.zeros((len(t), 4)), np.zeros(len(t), bool)
    steps = np.diff(pose_t)
    widest = max(GAP * float(np.median(steps)), LEAST_GAP_S)
    low = np.clip(np.searchsorted(pose_t, t, side="right") - 1, 0, len(steps) - 1)
    part = (t - pose_t[low]) / steps[low]
    bridged = (steps[low] <= widest) | (part == 0) | (part == 1)
    inside = (part >= 0) & (part <= 1) & bridged
    share = np.clip(part, 0, 1)
    q = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return linear(pose[:, :3], low, share), quaternion(q, low, share), inside


def sound_poses(pose: Array) -> NDArray[np.bool_]:
    """Whether each pose is finite and its quaternion of length 1, shape (M, 7) -> (M,)."""
    return np.isfinite(pose).all(axis=1) & (np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1) < UNIT_WITHIN)


def check_poses(pose_t: Array, pose: Array, where: str, topic: str) -> None:
    """Refuse poses of which less than two are sound; arguments as for `poses_at` and `field_nt`.

    Raises:
        InputError: So it is; the text says what is wrong with the first.
    """
    bad = ~sound_poses(pose)
    if len(pose) < 2 or np.count_nonzero(~bad) >= 2:
        return
    first = int(np.argmax(bad))
    length = float(np.linalg.norm(pose[first, 3:]))
    fault = "its quaternion is 0,0,0,0" if length == 0 else f"the length of its quaternion is {length:.3g}"
    raise InputError(
        f"{where}: {np.count_nonzero(bad)} of {len(pose)} poses of {topic} cannot be used, the first at "
        f"{pose_t[first]:.3f} s: {fault}; record the orientation too, or choose another topic of poses"
    )


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn any fault of damaged bytes into one line; rosbags, SQLite and YAML raise errors of many kinds."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        text, prefix = str(error), f"{path}: "
        if isinstance(error, InputError) and text.startswith(prefix):
            text = _printable(text.removeprefix(prefix))
        else:
            reason = f"{text} is missing" if isinstance(error, KeyError) else text or type(error).__name__
            limit = LONGEST_LINE if isinstance(error, InputError) else 200
            text = f"damaged bag, or none ({_printable(reason)[:limit]})"
        raise InputError(prefix + text) from error


def _printable(text: str) -> str:
    """A text in one line of limited length; names in a bag may hold any bytes."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= LONGEST_LINE else f"{text[:LONGEST_LINE]} ..."


def _files(path: Path) -> tuple[list[Path], dict[str, str], str]:
    """The storage files of a bag, its custom data, and what rosbag2 compressed: "file", "message" or ""."""
    suffixes = (".mcap", ".db3")
    if path.is_file():
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: no bag: a folder with metadata.yaml is one, or a .mcap or .db3 file")
        return [path], {}, ""
    found = sorted(p for p in path.iterdir() if p.suffix.lower() in suffixes and p.is_file())
    description = path / "metadata.yaml"
    if not description.is_file():
        if not found:
            raise InputError(f"{path}: no bag: metadata.yaml is missing; give the folder that holds it")
        return found, {}, ""
    about = yaml.load(read_text(description, "description of a bag", "YAML"), yaml_loader())
    about = about["rosbag2_bagfile_information"]
    names = [Path(str(name)).name for name in about["relative_file_paths"]]  # never outside of the folder
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise InputError(f"storage file {missing[0] if missing else ''} is missing")
    packed = str(about.get("compression_mode") or "none").lower()
    packed = packed if packed in ("file", "message") else ""
    if packed and about.get("compression_format") != "zstd":
        raise InputError(f"compressed by {str(about.get('compression_format'))!r}; only zstd is read")
    for name in names:
        if Path(name if packed != "file" else Path(name).stem).suffix.lower() not in suffixes:
            raise InputError(f"{name} is neither a .mcap nor a .db3 file")
    return [path / name for name in names], custom_data(about), packed


def _joined(parts: Collection[Messages]) -> Messages:
    """The messages of several files as one."""
    if len(parts) == 1:
        return next(iter(parts))
    bases = np.cumsum([0] + [len(part.buffer) for part in parts])
    none = np.zeros(0, np.int64)
    return Messages(
        np.concatenate([none, *(part.received for part in parts)]),
        np.concatenate([np.zeros(0, np.uint8), *(part.buffer for part in parts)]),
        np.concatenate([none, *(part.start + base for part, base in zip(parts, bases, strict=False))]),
        np.concatenate([none, *(part.size for part in parts)]),
    ).in_order()
