"""db3: bags in sqlite3, through rosbags."""

import shutil
import sqlite3
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from magtwin.budget import BUDGETS, check_decoded
from magtwin.errors import InputError
from magtwin.files import yaml_loader
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
    """A .db3 file, read by rosbags.

    Attributes:
        topics: Its topics.
        notes: The custom data that a .db3 file holds.
    """

    whole = True

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            _check_tables(database)
            self.notes = _custom_data(database)
        self._reader = Reader(path)
        self._reader.open()
        self.topics = [
            StoredTopic(c.id, c.topic, c.msgtype, getattr(c.ext, "serialization_format", ""))
            for c in self._reader.connections
        ]

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def messages(self, ids: Collection[int]) -> dict[int, Messages]:
        """The messages of some topics in the order of receipt."""
        found: dict[int, tuple[list[int], list[bytes]]] = {number: ([], []) for number in ids}
        connections, held = [c for c in self._reader.connections if c.id in found], 0
        for connection, received, data in self._reader.messages(connections) if connections else ():
            times, contents = found[connection.id]
            held += len(data)  # rows of a damaged file can share their pages
            check_decoded(self._path, self._size, held)
            times.append(received)
            contents.append(data)
        joined = {}
        for number, (times, contents) in found.items():
            size = np.array([len(content) for content in contents], np.int64)
            buffer = np.frombuffer(b"".join(contents), np.uint8)
            moments = np.array(times, np.int64)
            joined[number] = Messages(moments, buffer, np.cumsum(size) - size, size).in_order()
        return joined


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse contents that are computed, as a few bytes can make rows without end.

    Raises:
        InputError: There is a view, a virtual table or a computed column; or topics share a number, so that
            joining them with their messages multiplies both.
    """
    contents = database.execute("SELECT name, type, sql FROM sqlite_master").fetchall()
    for name, kind, sql in contents:
        if kind == "view" or (kind == "table" and str(sql).upper().startswith("CREATE VIRTUAL")):
            raise InputError(f"{name} is computed; a bag has plain tables only")
        columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
        if kind == "table" and any(hidden for (hidden,) in columns):
            raise InputError(f"table {name} has a computed column; a bag has plain tables only")
    if "topics" not in {name for name, _, _ in contents}:
        return  # rosbags refuses it
    topics, numbers = database.execute("SELECT count(id), count(DISTINCT id) FROM topics").fetchone()
    if topics != numbers:
        raise InputError(f"{topics} topics have {numbers} numbers; each needs its own")


def _custom_data(database: sqlite3.Connection) -> dict[str, str]:
    """The custom data that a .db3 file holds beside its messages; empty if it holds none."""
    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'metadata'").fetchone():
        return {}
    row = database.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
    if row and len(row[0]) > BUDGETS["YAML"].file:
        raise InputError(f"its metadata have {len(row[0]):,} bytes; write it again")
    return custom_data(yaml.load(row[0], yaml_loader())) if row else {}


def custom_data(metadata: Any) -> dict[str, str]:
    """The custom data in a bag's metadata."""
    custom = metadata.get("custom_data") if isinstance(metadata, dict) else None
    plain = str, int, float, bool  # aliases of lists would multiply as texts
    if not isinstance(custom, dict):
        return {}
    return {str(key): str(value) for key, value in custom.items() if isinstance(value, plain)}
