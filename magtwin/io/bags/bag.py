"""Bag: what the two storages of a rosbag2, MCAP and sqlite3, have in common."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.io.bags.cdr import Bytes, Index
from magtwin.io.bags.messages import Qos

VERSION = 8
"""Version of metadata.yaml: of those that rosbag2 has had the newest one that Humble reads."""

ROOM = 31
"""Bytes before each message of a batch that are a storage's own: the head of a message record of MCAP."""

_PLAIN = re.compile(r"(?!true$|null$|false$)[a-z_]\w{3,}")
"""Keys that need no quotes in YAML."""

INFINITE = {"sec": 9223372036, "nsec": 854775807}
"""What stands for no limit in a quality of service."""


@dataclass(frozen=True)
class Connection:
    """A topic of a bag that is written."""

    id: int
    topic: str
    kind: str
    """Type of its messages."""

    definition: str
    """That type in text, with those that it is made of."""

    digest: str
    """Hash of it, as REP 2011 has it."""

    qos: Qos

    @property
    def offered(self) -> str:
        """Its quality of service as rosbag2 keeps it: a list in YAML, names as rmw numbers them."""
        unlimited = "".join(f"\n    {key}: {value}" for key, value in INFINITE.items())
        return "\n".join(
            (
                "- history: 1",
                f"  depth: {self.qos.depth}",
                f"  reliability: {1 if self.qos.reliable else 2}",
                f"  durability: {1 if self.qos.latched else 2}",
                f"  deadline:{unlimited}",
                f"  lifespan:{unlimited}",
                "  liveliness: 1",
                f"  liveliness_lease_duration:{unlimited}",
                "  avoid_ros_namespace_conventions: false",
            )
        )


class Batch(NamedTuple):
    """Messages of one topic and one size, in the order of their times; a topic may have several batches."""

    connection: Connection
    received: Index
    """When each was received [ns], shape (M,)."""

    rows: Bytes
    """A message a row, after `ROOM` free bytes, shape (M, ROOM + size)."""

    arrival: Index | None = None
    """Rank of each message among messages with the same time, shape (M,). None: the order of the batches."""


class Heard(NamedTuple):
    """A topic of a bag that is read."""

    id: int
    topic: str
    kind: str
    encoding: str
    """How its messages are encoded; "cdr" is read."""


@dataclass
class Tally:
    """What has been written, for the metadata."""

    counts: dict[int, int]
    first: int = 2**63 - 1
    last: int = 0

    def add(self, batches: Sequence[Batch]) -> None:
        """Count messages."""
        for batch in batches:
            if len(batch.received):
                self.counts[batch.connection.id] += len(batch.received)
                self.first = min(self.first, int(batch.received[0]))
                self.last = max(self.last, int(batch.received[-1]))


def metadata(
    storage: str,
    files: Sequence[str],
    connections: Sequence[Connection],
    tally: Tally,
    custom: Mapping[str, str],
) -> dict[str, Any]:
    """What metadata.yaml says of a bag, under `rosbag2_bagfile_information`.

    Args:
        storage: "mcap" or "sqlite3".
        files: Names of its storage files.
        connections: Its topics.
        tally: What has been written.
        custom: What else it is to say.
    """
    count = sum(tally.counts.values())
    begin = {"nanoseconds_since_epoch": tally.first if count else 0}
    span = {"nanoseconds": max(0, tally.last - tally.first) if count else 0}
    return {
        "version": VERSION,
        "storage_identifier": storage,
        "duration": dict(span),
        "starting_time": dict(begin),
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": c.topic,
                    "type": c.kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": c.offered,
                    "type_description_hash": c.digest,
                },
                "message_count": tally.counts[c.id],
            }
            for c in connections
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(files),
        "files": [
            {"path": name, "starting_time": dict(begin), "duration": dict(span), "message_count": count}
            for name in files
        ],
        "custom_data": dict(custom) or None,
        "ros_distro": "humble",
    }


def yaml_of(content: Mapping[str, Any] | Sequence[Any], indent: str = "") -> str:
    """Metadata as YAML: a line an entry, every scalar as JSON has it, which YAML has too.

    A hundred times as fast as a library for all of YAML, for it is written at every flush of a recording.
    """
    named = isinstance(content, Mapping)
    lines = []
    for key, value in content.items() if named else enumerate(content):  # type: ignore[union-attr]
        word = str(key) if _PLAIN.fullmatch(str(key)) else json.dumps(key, ensure_ascii=False)
        head = f"{indent}{word}:" if named else f"{indent}-"
        if not isinstance(value, Mapping | list) or not value:
            lines.append(f"{head} {json.dumps(value, ensure_ascii=False)}\n")
        elif named:
            lines.append(f"{head}\n{yaml_of(value, indent + '  ')}")
        else:
            lines.append(f"{head} {yaml_of(value, indent + '  ').lstrip(' ')}")
    return "".join(lines)


def in_time(batches: Sequence[Batch]) -> tuple[Index, NDArray[np.intp]]:
    """Times of all messages of batches, ascending [ns], and of which batch each is; both shape (M,)."""
    times = np.concatenate([b.received for b in batches]) if batches else np.zeros(0, np.int64)
    which = np.repeat(np.arange(len(batches)), [len(b.received) for b in batches])
    ranks = [np.zeros(len(b.received), np.int64) if b.arrival is None else b.arrival for b in batches]
    order = np.lexsort((np.concatenate(ranks), times)) if batches else np.zeros(0, np.int64)
    return times[order], which[order]
