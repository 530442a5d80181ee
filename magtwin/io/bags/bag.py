"""Bag: the reading layer of all bags: storage files, topics, types, stamps and frames."""

import json
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning, hint
from magtwin.files.file import existing, existing_file, read_text
from magtwin.files.settings import yaml_loader
from magtwin.io.bags.cdr import NS, Index, Messages, decode
from magtwin.io.bags.compression import Room
from magtwin.io.bags.db3 import Db3Reader, custom_data
from magtwin.io.bags.frames import (
    Frames,
    StaticFrames,
    Transform,
    frames_of,
    in_base,
    kind_of,
    mount_of,
    role_of,
    transforms,
)
from magtwin.io.bags.mcap import McapReader
from magtwin.io.bags.storage import PARTIAL, partial_of
from magtwin.io.bags.topics import TF, TF_STATIC, Topic
from magtwin.io.bags.types import layout
from magtwin.io.bags.writer import CUSTOM, NOTE
from magtwin.run.arrow import check_metadata
from magtwin.run.run import Metadata

Array = NDArray[np.float64]

LONGEST_LINE = 2000
"""Most characters of an error message."""

LATE_S = 1.0
"""Stamps further behind an earlier one than this are wrong, or those of another clock [s]."""

WRONG = 0.01
"""Share of messages with wrong stamps up to which they are left out."""

UNSET_NS = 10**7 * NS
"""Median of stamps from which a stamp of 0 was not set, and is not the beginning of a simulation [ns]."""


class Bag:
    """An open bag: all of its storage files as one.

    Args:
        path: Folder of a rosbag2, or a storage file (.mcap, .db3). A truncated file is read up to its last
            whole chunk if its name is partial.

    Attributes:
        path: As given.
        files: Its storage files.
        kinds: Message type of each topic.

    Raises:
        InputError: There is no bag, or it is damaged or truncated.
    """

    def __init__(self, path: Path) -> None:
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
            if not (all(reader.whole for reader in self._readers) or PARTIAL in self.path.name):
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
        # A single stamp of 0 is the first moment of a simulation; many mean that there are no stamps.
        if stamps is not None and np.count_nonzero(stamps == 0) > max(1, WRONG * len(stamps)):
            stamps = None
        return Signal(name, topic, kind, messages, fields, stamps)

    @cached_property
    def static(self) -> StaticFrames:
        """The transforms of /tf_static, also of one in a namespace."""
        known = StaticFrames()
        for each in self.transforms(TF_STATIC.name):
            for parent, child, p, q in zip(each.parents, each.children, each.p, each.q_xyzw, strict=True):
                known.add(parent, child, p, q)
        return known

    def transforms(self, *ends: str) -> list[Transform]:
        """The transforms of topics by the ends of their names; a damaged topic has none."""
        found: list[Transform] = []
        names = [name for name, kind in self.kinds.items() if kind == TF.kind and name.endswith(ends)]
        for messages in self.messages(names).values():
            with suppress(InputError), np.errstate(over="ignore", invalid="ignore"):
                found += transforms(messages)
        return found

    def in_base(
        self, signal: "Signal", columns: dict[str, NDArray[Any]]
    ) -> tuple[dict[str, NDArray[Any]], str]:
        """Columns of a signal as those of base_link, and what was done to them, in a line.

        Warns if its frame cannot be that of such a signal.
        """
        role, frames = role_of(columns), self.frames(signal)
        if role is None:
            return columns, ""
        mount, fault = mount_of(role, frames, self.static)
        about = f"{role.noun} of {signal.name}"
        if fault:
            text = f"{self.path}: {about}: {fault}; it is read as that of base_link"
            warnings.warn(text, RepairWarning, stacklevel=4)
        if mount is not None:
            return in_base(role, columns, mount), f"{about} from {mount}, by {TF_STATIC.name}"
        unknown = not role.position and frames[0] and kind_of(frames[0]) != "base"
        return columns, f"{about} in the axes of {frames[0]!r:.40} as in those of base_link" * bool(unknown)

    def frames(self, signal: "Signal") -> Frames:
        """The frames of a signal."""
        try:
            return frames_of(signal.messages, signal.kind)
        except InputError as error:
            raise InputError(f"{self.path}: topic {signal.name}: {error}") from error

    def missing(self, name: str) -> InputError:
        """The refusal of a topic that is not in the bag."""
        near = hint(name, self.kinds)
        near = near + "; " if near.startswith("did you mean") else ""
        return InputError(f"{self.path}: no topic {name}; {near}topics in it: {self.listed()}")

    def listed(self) -> str:
        """The topics with their types."""
        none = "of unknown type, as its schema is missing"
        return ", ".join(f"{topic} ({kind or none})" for topic, kind in sorted(self.kinds.items())) or "none"


class Signal(NamedTuple):
    """The decoded messages of a topic."""

    name: str
    """Name of the topic in the bag."""

    topic: Topic
    kind: str
    """Message type."""

    messages: Messages
    fields: dict[str, Any]
    """Values by leaf name."""

    stamps: NDArray[np.int64] | None
    """Stamps of the headers [ns], shape (M,). None: the messages have none."""

    @property
    def received(self) -> Index:
        """Times of receipt [ns], shape (M,)."""
        return self.messages.received

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns that the topic gives, one row a message."""
        return self.topic.read(self.kind, self.fields)

    def in_order(self, ns: Index, where: Path) -> tuple["Signal", Index, str]:
        """The messages in the order of their times, these times [ns], and what was repaired for that.

        Messages that overtook each other are sorted. The few whose stamp was not set, or lies more than
        `LATE_S` before an earlier one, are left out.

        Args:
            ns: Times of the messages [ns], shape (M,).
            where: The bag, for refusals.

        Raises:
            InputError: The times run backwards: most of them, or again and again by more than `LATE_S`.
        """
        behind = np.maximum.accumulate(ns) - ns
        unset = (ns == 0) if len(ns) and np.median(ns) > UNSET_NS else np.zeros(len(ns), bool)
        late, wrong = behind > 0, (behind > LATE_S * NS) | unset
        if not (late | wrong).any():
            return self, ns, ""
        left, overtaken = np.count_nonzero(wrong), np.count_nonzero(late & ~wrong)
        if 2 * np.count_nonzero(late) > len(ns) or left > max(1, WRONG * len(ns)):
            k = int(np.argmax(late))
            raise InputError(
                f"{where}: stamps of {self.name} run backwards: {ns[k] / NS:.6f} s after "
                f"{ns[k - 1] / NS:.6f} s, in message {k + 1} of {len(ns)}"
            )
        kept = np.flatnonzero(~wrong)
        rows = kept[np.argsort(ns[kept], kind="stable")]
        notes = [f"{overtaken} messages of {self.name} by their stamps, behind which they came"] * bool(
            overtaken
        )
        notes += [f"{left} of {len(ns)} messages of {self.name} as missing, whose stamps are wrong"] * bool(
            left
        )
        fields = {
            n: v[rows] if isinstance(v, np.ndarray) else [v[r] for r in rows] for n, v in self.fields.items()
        }
        stamps = None if self.stamps is None else self.stamps[rows]
        signal = self._replace(messages=self.messages.take(rows), fields=fields, stamps=stamps)
        return signal, ns[rows], ", ".join(notes)


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
