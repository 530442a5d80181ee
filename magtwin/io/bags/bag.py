"""Bag: the reading layer of all bags: storage files, topics, message types and messages."""

import json
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
import yaml

from magtwin.errors import InputError, RepairWarning, hint
from magtwin.files.file import existing, existing_file, read_text
from magtwin.files.settings import yaml_loader
from magtwin.io.bags.cdr import Index, Leaf, Messages
from magtwin.io.bags.compression import Room
from magtwin.io.bags.db3 import Db3Reader, custom_data
from magtwin.io.bags.mcap import McapReader
from magtwin.io.bags.ros1 import Ros1Reader
from magtwin.io.bags.storage import PARTIAL, StoredTopic
from magtwin.io.bags.types import Types
from magtwin.io.bags.writer import CUSTOM, NOTE
from magtwin.run.arrow import check_metadata
from magtwin.run.run import Metadata

SUFFIXES: dict[str, Any] = {".mcap": McapReader, ".db3": Db3Reader, ".bag": Ros1Reader}  # Readers by suffix
LONGEST_LINE = 2000  # Most characters of an error message


class Bag:
    """An open bag: all of its storage files as one. What is damaged in it is left out, with a warning.

    It is the folder of a rosbag2, or a storage file (.mcap, .db3, or .bag of ROS 1). A truncated file is read
    up to its last whole chunk. `kinds` are the message types of its `topics`, "" if not known; `packed` tells
    how rosbag2 compressed it: "file", "message" or "".
    """

    def __init__(self, path: Path) -> None:
        self.path = existing(path, "bag")
        self.kinds: dict[str, str] = {}
        self.topics: dict[str, StoredTopic] = {}
        self.types = Types()
        self.readers: list[McapReader | Db3Reader | Ros1Reader] = []
        self._told = 0
        with _one_line(self.path), ExitStack() as opened:
            self.files, about = _files(self.path)
            self._custom, self.packed = about.custom, about.packed
            files = [existing_file(file, "storage file of a bag", "bag") for file in self.files]
            if self.packed == "file":
                folder, room = Path(opened.enter_context(TemporaryDirectory())), Room(self.path, files)
                files = [room.file(file, folder) for file in files]
            for file in files:
                reader = SUFFIXES[file.suffix.lower()](file)
                opened.callback(reader.close)
                self.readers.append(reader)
                self._take(reader, about.kinds)
            if not (all(reader.whole for reader in self.readers) or PARTIAL in self.path.name):
                text = "cut short: its end is missing; it is read up to its last whole chunk"
                warnings.warn(f"{self.path}: {text}", RepairWarning, stacklevel=2)
            self._tell()
            self._opened = opened.pop_all()

    def _take(self, reader: "McapReader | Db3Reader | Ros1Reader", kinds: Mapping[str, str]) -> None:
        """The topics, types and metadata of a storage file."""
        for topic in reader.topics:
            known = self.topics.setdefault(topic.topic, topic)
            kind = topic.kind or kinds.get(topic.topic, "")
            if (first := self.kinds.setdefault(topic.topic, kind)) != kind:
                raise InputError(f"topic {topic.topic} has two types, {first} and {kind}")
            if known.encoding != topic.encoding:
                raise InputError(f"topic {topic.topic} is encoded as {known.encoding} and {topic.encoding}")
        for kind, (encoding, text) in reader.definitions.items():
            self.types.learn(kind, text, ros1=encoding == "ros1msg")
        if isinstance(reader, McapReader):
            self._custom |= {CUSTOM + key: value for key, value in reader.notes.get(NOTE, {}).items()}
        else:
            self._custom |= reader.notes

    def _tell(self) -> None:
        """Warn of parts that were found to be damaged since the last time."""
        if self.damaged > self._told:
            self._told = self.damaged
            of = f" of {self.chunks}" if self.chunks else ""
            text = (
                f"{self.damaged}{of} chunks or records are damaged and are left out; copy it again if you can"
            )
            warnings.warn(f"{self.path}: {text}", RepairWarning, stacklevel=4)

    @property
    def chunks(self) -> int:
        """Number of chunks of its messages."""
        return sum(reader.chunks for reader in self.readers)

    @property
    def damaged(self) -> int:
        """How many chunks or records could not be read so far."""
        return sum(len(reader.damaged) for reader in self.readers)

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

    def messages(self, topics: Iterable[str], most: int | None = None) -> dict[str, Messages]:
        """The messages of topics, each in the order of receipt; of about its first `most` bytes."""
        wanted, room = set(topics), Room(self.path, self.files)
        parts: dict[str, list[Messages]] = {topic: [] for topic in wanted}
        for reader in self.readers if wanted else ():
            chosen = {topic.id: topic for topic in reader.topics if topic.topic in wanted}
            for number, messages in reader.messages(chosen.keys(), most).items():
                topic = chosen[number]
                if len(messages) and topic.encoding not in ("cdr", "ros1"):
                    raise InputError(f"topic {topic.topic} is encoded as {topic.encoding!r}, not cdr")
                whole = room.messages(messages) if self.packed == "message" else messages
                parts[topic.topic].append(replace(whole, packed=topic.encoding == "ros1"))
        self._tell()
        return {topic: _joined(found) for topic, found in parts.items()}

    def times(self) -> dict[str, Index]:
        """Times of receipt of the messages of each topic [ns], ascending; from the index if there is one."""
        found: dict[str, list[Index]] = {topic: [] for topic in self.topics}
        for reader in self.readers:
            times = reader.times()
            for topic in reader.topics:
                found[topic.topic].append(times.get(topic.id, np.zeros(0, np.int64)))
        return {topic: np.sort(np.concatenate(parts)) for topic, parts in found.items()}

    def layout(self, name: str, counts: Mapping[str, Any] | None = None) -> tuple[Leaf, ...]:
        """The leaves of a topic's type, as `magtwin.io.bags.types.layout`, which the bag may define."""
        return self.types.layout(self.kinds[name], counts, ros1=self.topics[name].encoding == "ros1")

    def missing(self, name: str) -> InputError:
        """The refusal of a topic that is not in the bag."""
        near = f"{hint(name, self.kinds)}; "
        near = near if near.startswith("did you mean") else ""
        return InputError(f"{self.path}: no topic {name}; {near}topics in it: {self.listed()}")

    def listed(self) -> str:
        """The topics with their types."""
        none = "of unknown type, as its schema is missing"
        return ", ".join(f"{topic} ({kind or none})" for topic, kind in sorted(self.kinds.items())) or "none"


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn any fault of damaged bytes into one line; rosbags, SQLite and YAML raise errors of many kinds."""
    try:
        yield
    except (MemoryError, Warning):
        raise
    except Exception as error:
        text, prefix = str(error), f"{path}: "
        if isinstance(error, InputError) and text.startswith(prefix):
            text = _printable(text.removeprefix(prefix))
        else:
            missing = isinstance(error, KeyError) and not isinstance(error, InputError)
            reason = f"{text} is missing" if missing else text or type(error).__name__
            limit = LONGEST_LINE if isinstance(error, InputError) else 200
            text = f"damaged bag, or none ({_printable(reason)[:limit]})"
        raise InputError(prefix + text) from error


def _printable(text: str) -> str:
    """A text in one line of limited length; names in a bag may hold any bytes."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= LONGEST_LINE else f"{text[:LONGEST_LINE]} ..."


class _About(NamedTuple):
    """What metadata.yaml tells of a bag."""

    custom: dict[str, str]
    packed: str = ""
    kinds: Mapping[str, str] = MappingProxyType({})  # Message types of topics


def _files(path: Path) -> tuple[list[Path], _About]:
    """The storage files of a bag, and what else its metadata.yaml tells."""
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{path}: no bag: a folder with metadata.yaml is one, or a .mcap or .db3 file")
        return [path], _About({})
    found = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    description = path / "metadata.yaml"
    if not description.is_file():
        if not found:
            raise InputError(f"{path}: no bag: metadata.yaml is missing; give the folder that holds it")
        return found, _About({})
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
        if Path(name if packed != "file" else Path(name).stem).suffix.lower() not in SUFFIXES:
            raise InputError(f"{name} is neither a .mcap nor a .db3 file")
    told = [each.get("topic_metadata") for each in about.get("topics_with_message_count") or ()]
    kinds = {str(each["name"]): str(each["type"]) for each in told if isinstance(each, dict)}
    return [path / name for name in names], _About(custom_data(about), packed, kinds)


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
        any(part.packed for part in parts),
    ).in_order()
