"""Storage: topics and messages as a storage file of a rosbag2 holds them, and its metadata.yaml."""

from array import array
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from magtwin.files.budget import check_decoded
from magtwin.io.bags.cdr import Bytes, Index, Messages
from magtwin.io.bags.topics import Qos

VERSION = 8  # Version of metadata.yaml: the newest one that ROS 2 Humble reads
ROOM = 31  # Bytes left free before each message of a batch, for the head of an MCAP message record
PARTIAL = ".partial"  # Inserted before the suffix of a bag until it ends


def partial_of(path: Path) -> Path:
    """Path of a bag until it ends: run.partial.mcap for run.mcap."""
    return path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")


@dataclass(frozen=True)
class Connection:
    """A topic of a bag that is written."""

    id: int
    topic: str
    kind: str  # Message type
    definition: str  # Definition of the type and of the types in it, as text
    digest: str  # REP 2011 hash of the definition
    qos: Qos

    @cached_property
    def offered_qos(self) -> str:
        """The quality of service as YAML, as rosbag2 stores it, with infinite durations."""
        from rosbags import interfaces as ros
        from rosbags.rosbag2.metadata import dump_qos_v8

        infinite, qos = ros.QosTime(9223372036, 854775807), self.qos
        reliability = ros.QosReliability.RELIABLE if qos.reliable else ros.QosReliability.BEST_EFFORT
        durability = ros.QosDurability.TRANSIENT_LOCAL if qos.latched else ros.QosDurability.VOLATILE
        kept = (ros.QosHistory.KEEP_LAST, qos.depth, reliability, durability)
        return dump_qos_v8([ros.Qos(*kept, infinite, infinite, ros.QosLiveliness.AUTOMATIC, infinite, False)])


class Batch(NamedTuple):
    """Messages of one topic and one size, sorted by time. A topic may have several batches."""

    connection: Connection
    received: Index  # Time of receipt [ns], shape (M,)
    rows: Bytes  # One message per row, after `ROOM` free bytes, shape (M, ROOM + size)
    arrival: Index | None = None  # Rank among messages of one time, (M,). Default: the order of the batches.


class StoredTopic(NamedTuple):
    """A topic of a bag that is read."""

    id: int
    topic: str
    kind: str
    encoding: str  # Encoding of its messages; "cdr" and "ros1" can be read
    qos: str = ""  # Quality of service that its publishers offered, as YAML; "" if unknown


def bag_metadata(
    file: str,
    connections: Sequence[Connection],
    counts: Mapping[int, int],
    span: tuple[int, int],
    custom: Any,
) -> dict[str, Any]:
    """`rosbag2_bagfile_information` of metadata.yaml; `span` are the first and last time [ns]."""
    count = sum(counts.values())
    begin = {"nanoseconds_since_epoch": span[0] if count else 0}
    duration = {"nanoseconds": span[1] - span[0] if count else 0}
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": begin,
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": c.topic,
                    "type": c.kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": c.offered_qos,
                    "type_description_hash": c.digest,
                },
                "message_count": counts[c.id],
            }
            for c in connections
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [
            {"path": file, "starting_time": dict(begin), "duration": dict(duration), "message_count": count}
        ],
        "custom_data": dict(custom) or None,
        "ros_distro": "humble",
    }


def to_yaml(content: Any) -> str:
    """YAML text of plain data."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return yaml.dump(content, Dumper=dumper, sort_keys=False, allow_unicode=True, width=2**30)


def gathered(
    path: Path, rows: Iterable[tuple[int, int, bytes]], ids: Collection[int], most: int | None, **rest: Any
) -> dict[int, Messages]:
    """The messages of some topics of a file, from rows of topic, time of receipt [ns] and content.

    They are about the first `most` bytes; too many for the size of the file are refused.
    """
    found = {number: (array("q"), array("q"), bytearray()) for number in ids}
    size, held = path.stat().st_size, 0
    for number, received, data in rows:
        held += len(data)  # rows of a damaged file can share their pages
        if most is not None and held > most:
            break
        check_decoded(path, size, held)
        times, sizes, contents = found[number]
        times.append(received)
        sizes.append(len(data))
        contents += data
    return {number: Messages.of(*parts, **rest) for number, parts in found.items()}


def in_time(batches: Sequence[Batch]) -> tuple[Index, NDArray[np.intp]]:
    """Times of all messages, ascending [ns], and the batch that each belongs to; both of shape (M,)."""
    if not batches:
        return np.zeros(0, np.int64), np.zeros(0, np.intp)
    times = np.concatenate([b.received for b in batches])
    which = np.repeat(np.arange(len(batches)), [len(b.received) for b in batches])
    ranks = [np.zeros(len(b.received), np.int64) if b.arrival is None else b.arrival for b in batches]
    order = np.lexsort((np.concatenate(ranks), times))
    return times[order], which[order]
