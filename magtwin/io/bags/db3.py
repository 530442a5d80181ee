"""db3: bags in sqlite3, and bags compressed as a whole or message by message, through rosbags."""

import shutil
import sqlite3
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from magtwin.io.bags.cdr import Messages
from magtwin.io.bags.storage import ROOM, VERSION, Batch, Connection, StoredTopic, in_time


class Db3Writer:
    """A sqlite3 bag, which is complete once it is closed.

    Args:
        path: The folder of a bag to make, or its storage file, which ends in .db3.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = path.with_suffix("") if path.suffix else path
        self._writer = Writer(self._folder, version=VERSION, storage_plugin=StoragePlugin.SQLITE3)
        self._writer.open()
        self._connections: dict[int, Any] = {}

    def add(self, connection: Connection) -> None:
        """Register a topic."""
        self._connections[connection.id] = self._writer.add_connection(
            connection.topic,
            connection.kind,
            msgdef=connection.definition,
            rihs01=connection.digest,
            offered_qos_profiles=[connection.rosbags_qos],
        )

    def write(self, batches: Sequence[Batch]) -> None:
        """Write messages in the order of their times."""
        rows = [iter(batch.rows) for batch in batches]
        for t, k in zip(*(array.tolist() for array in in_time(batches)), strict=True):
            data = next(rows[k])[ROOM:].tobytes()
            self._writer.write(self._connections[batches[k].connection.id], t, data)

    def close(self, custom: Mapping[str, str]) -> None:
        """Complete the bag; `custom` is its custom data."""
        for key, value in custom.items():
            self._writer.set_custom_data(key, value)
        self._writer.close()
        if self._folder != self._path:
            next(self._folder.glob("*.db3")).rename(self._path)
            shutil.rmtree(self._folder)

    def abort(self) -> None:
        """Give up; nothing can be read."""
        self._writer.abort()


class RosbagsReader:
    """A bag that rosbags reads: a .db3 file, or a folder.

    Attributes:
        topics: Its topics.
        notes: The custom data that a .db3 file holds.
    """

    whole = True

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        self._reader.open()
        self.topics = [
            StoredTopic(c.id, c.topic, c.msgtype, getattr(c.ext, "serialization_format", ""))
            for c in self._reader.connections
        ]
        self.notes: dict[str, str] = {} if path.is_dir() else _custom_data(path)

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def messages(self, ids: Collection[int]) -> dict[int, Messages]:
        """The messages of some topics in the order of receipt."""
        found: dict[int, tuple[list[int], list[bytes]]] = {number: ([], []) for number in ids}
        connections = [c for c in self._reader.connections if c.id in found]
        for connection, received, data in self._reader.messages(connections) if connections else ():
            times, contents = found[connection.id]
            times.append(received)
            contents.append(data)
        joined = {}
        for number, (times, contents) in found.items():
            size = np.array([len(content) for content in contents], np.int64)
            buffer = np.frombuffer(b"".join(contents), np.uint8)
            moments = np.array(times, np.int64)
            joined[number] = Messages(moments, buffer, np.cumsum(size) - size, size).in_order()
        return joined


def _custom_data(path: Path) -> dict[str, str]:
    """The custom data that a .db3 file holds beside its messages; empty if it holds none."""
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'metadata'").fetchone():
            return {}
        row = database.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
    return custom_data(yaml.safe_load(row[0])) if row else {}


def custom_data(metadata: Any) -> dict[str, str]:
    """The custom data in a bag's metadata."""
    custom = metadata.get("custom_data") if isinstance(metadata, dict) else None
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
