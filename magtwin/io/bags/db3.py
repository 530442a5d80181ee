"""db3: bags in sqlite3, through rosbags."""

import shutil
import sqlite3
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from magtwin.budget import BUDGETS, check_decoded
from magtwin.errors import InputError
from magtwin.files import yaml_loader
from magtwin.io.bags.cdr import Messages
from magtwin.io.bags.storage import ROOM, VERSION, Batch, Connection, StoredTopic, in_time

_HEAD = 100
"""Bytes of the header of an sqlite file, which its first page begins with."""

_ROWS = 10_000
"""Most topics and definitions of a bag."""


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


class _Reader(Reader):
    """A reader of a .db3 file with its suffix in any case; rosbags knows it in lower case only."""

    def __init__(self, path: Path) -> None:
        self.STORAGE_PLUGINS = {path.suffix: Reader.STORAGE_PLUGINS[".db3"]}
        super().__init__(path)


class RosbagsReader:
    """A .db3 file, read by rosbags.

    Attributes:
        topics: Its topics.
        notes: The custom data that a .db3 file holds.
    """

    whole = True

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        pages = _Pages(path)
        pages.check([1])  # the list of tables, before sqlite reads it
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            longest = database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, BUDGETS["text"].file)
            roots = "SELECT CAST(rootpage AS INTEGER) FROM sqlite_master WHERE rootpage > 0"
            pages.check([root for (root,) in database.execute(roots)])
            _check_tables(database)
            _check_rows(database)
            self.notes = _custom_data(database)
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
            _check_messages(database, path)
        self._reader = _Reader(path)
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


class _Pages:
    """The pages of an sqlite file, which are trees. sqlite follows a page as often as others point to it."""

    def __init__(self, path: Path) -> None:
        content = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.empty(0, np.uint8)
        size = int.from_bytes(content[16:18].tobytes())
        size = 1 << 16 if size == 1 else max(size, 512)  # sqlite refuses a smaller one
        count = len(content) // size
        self._pages = content[: count * size].reshape(count, size)
        self._used = np.zeros(count + 1, bool)

    def check(self, roots: Sequence[int]) -> None:
        """Refuse trees that use a page twice, or one of an earlier tree.

        Raises:
            InputError: They do.
        """
        level = np.array(roots, np.int64)
        while len(level := level[(level > 0) & (level < len(self._used))]):  # sqlite refuses others
            if len(np.unique(level)) < len(level) or self._used[level].any():
                raise InputError("its tables use a page twice; get the file again")
            self._used[level] = True
            kinds = self._pages[level - 1, np.where(level == 1, _HEAD, 0)]
            inner = level[(kinds == 2) | (kinds == 5)]
            level = np.concatenate([np.empty(0, np.int64), *map(self._below, inner.tolist())])

    def _below(self, number: int) -> NDArray[np.int64]:
        """The pages to which an inner page points."""
        page, head = self._pages[number - 1], _HEAD if number == 1 else 0
        count = int.from_bytes(page[head + 3 : head + 5].tobytes())
        cells = np.frombuffer(page[head + 12 : head + 12 + 2 * count].tobytes(), ">u2") & (len(page) - 1)
        at = np.append(cells[cells <= len(page) - 4], head + 8).astype(np.int64)
        return page[at[:, None] + np.arange(4)].view(">u4")[:, 0].astype(np.int64)


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


def _check_rows(database: sqlite3.Connection) -> None:
    """Refuse topics that are too many or too large together, as rows of a damaged file can share their pages.

    Raises:
        InputError: They are.
    """
    rows, held = 0, 0
    database.text_factory = bytes
    for table in sorted({"schema", "metadata", "topics", "message_definitions"} & _tables(database)):
        for row in database.execute(f"SELECT * FROM {table}"):
            rows, held = rows + 1, held + sum(len(value) for value in row if isinstance(value, bytes))
            if rows > _ROWS or held > BUDGETS["text"].file:
                raise InputError(
                    f"its topics have {rows:,} rows of {held:,} bytes; write it again with fewer"
                )
    database.text_factory = str


def _check_messages(database: sqlite3.Connection, path: Path) -> None:
    """Refuse messages that are too large together, which sqlite would sort on the disk.

    Raises:
        InputError: They are.
    """
    if "messages" not in _tables(database):
        return  # rosbags refuses it
    sizes = "total(CASE typeof(data) WHEN 'blob' THEN length(data) END), total(typeof(data) <> 'blob')"
    size, others = database.execute(f"SELECT {sizes} FROM messages").fetchone()
    if others:
        raise InputError(f"{others:.0f} of its messages are not bytes; write it again")
    check_decoded(path, path.stat().st_size, int(size))


def _tables(database: sqlite3.Connection) -> set[str]:
    """Names of its tables, of which sqlite ignores the case."""
    names = database.execute("SELECT CAST(name AS BLOB) FROM sqlite_master")
    return {name.decode(errors="replace").lower() for (name,) in names if name is not None}


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
