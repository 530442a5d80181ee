"""db3: the storage of rosbag2 that is a sqlite3 database."""

import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags.bag import ROOM, Batch, Connection, Heard, in_time
from magtwin.io.bags.cdr import Messages

MOST_BYTES = 1 << 30
"""Bytes of the largest message that is read."""

_TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(
    id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL,
    offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(
    id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(
    id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'humble');
"""


class Db3Writer:
    """A database of messages that grows; what has been flushed stays readable.

    Args:
        path: The file to make.
        live: Whether it is to outlive this process at each flush; otherwise only once it is closed.
    """

    def __init__(self, path: Path, *, live: bool) -> None:
        self._live = live
        self._database = sqlite3.connect(path, isolation_level=None)
        self._run("PRAGMA page_size = 32768")
        # The new file counts only once it is whole, or it keeps a log beside it that a crash leaves sound.
        self._run("PRAGMA journal_mode = WAL" if live else "PRAGMA journal_mode = OFF")
        self._run("PRAGMA synchronous = OFF")
        self._database.executescript(_TABLES)
        self._kinds: set[str] = set()

    def add(self, connections: Iterable[Connection]) -> None:
        """Tell of topics."""
        for c in connections:
            row = (c.id, c.topic, c.kind, "cdr", c.offered, c.digest)
            self._run("INSERT INTO topics VALUES(?, ?, ?, ?, ?, ?)", row)
            if c.kind not in self._kinds:
                self._kinds.add(c.kind)
                definition = (c.kind, "ros2msg", c.definition, c.digest)
                self._run("INSERT INTO message_definitions VALUES(NULL, ?, ?, ?, ?)", definition)

    def note(self, version: int, text: str) -> None:
        """Keep the metadata of the bag, in place of what was kept before."""
        self._run("INSERT OR REPLACE INTO metadata VALUES(1, ?, ?)", (version, text))

    def write(self, batches: Sequence[Batch]) -> None:
        """Write messages, in the order of their times."""
        times, which = in_time(batches)
        ids = np.array([batch.connection.id for batch in batches], np.int64)[which]
        messages = np.empty(len(times), object)
        for k, batch in enumerate(batches):
            messages[which == k] = _cut(batch)
        rows = zip(ids.tolist(), times.tolist(), messages.tolist(), strict=True)
        self._run("BEGIN")
        self._database.executemany("INSERT INTO messages VALUES(NULL, ?, ?, ?)", rows)
        self._run("COMMIT")

    def flush(self) -> None:
        """Bring everything into the file itself: it outlives this process."""
        if self._live:
            self._run("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Make the file whole."""
        self._run("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        if self._live:
            self._run("PRAGMA journal_mode = DELETE")
        self._database.close()

    def abort(self) -> None:
        """Leave the file as it is."""
        self._database.close()

    def _run(self, statement: str, values: Sequence[object] = ()) -> None:
        self._database.execute(statement, values).close()


def _cut(batch: Batch) -> list[bytes]:
    """The messages of a batch one after the other."""
    width = batch.rows.shape[1]
    raw = batch.rows.tobytes()
    return [raw[at + ROOM : at + width] for at in range(0, len(raw), width)]


class Db3Reader:
    """A database of messages: its topics, the metadata that it keeps, and its messages on demand.

    Attributes:
        topics: Its topics.
        note: The metadata that it keeps, in YAML; "" where it keeps none.
    """

    def __init__(self, path: Path) -> None:
        self._folder = None
        log = path.with_name(path.name + "-wal")
        if log.exists() and log.stat().st_size:
            # What a killed recording left is in its log yet; reading that writes, so a copy is read.
            self._folder = tempfile.TemporaryDirectory()
            path = Path(shutil.copy(path, self._folder.name))
            shutil.copy(log, path.with_name(path.name + "-wal"))
            place = path.as_uri()
        else:
            place = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        self._database = sqlite3.connect(place, uri=True, isolation_level=None)
        try:
            self._learn()
        except BaseException:
            self.close()
            raise

    def _learn(self) -> None:
        for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0"):
            self._database.execute(f"PRAGMA {pragma}").close()
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)  # of a message
        made = dict(self._all("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
        tables = {name for name in ("topics", "messages", "metadata") if name in made}
        if not {"topics", "messages"} <= tables:
            raise InputError("a database without the tables of a bag")
        for name in tables:  # what is computed when it is read could be of any size
            columns = self._all(f"SELECT hidden FROM pragma_table_xinfo('{name}')")
            if any(hidden for (hidden,) in columns) or not str(made[name]).upper().startswith("CREATE TABLE"):
                raise InputError(f"its table {name} is not one of plain columns")
        self.topics = [
            Heard(int(number), str(name), str(kind), str(encoding))
            for number, name, kind, encoding in self._all(
                "SELECT id, name, type, serialization_format FROM topics"
            )
        ]
        self.note = ""
        if "metadata" in tables:
            kept = self._all("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1")
            self.note = str(kept[0][0]) if kept else ""

    def close(self) -> None:
        """Close the database."""
        self._database.close()
        if self._folder is not None:
            self._folder.cleanup()

    def messages(self, ids: Collection[int]) -> dict[int, Messages]:
        """The messages of some topics, as they were received."""
        found: dict[int, tuple[list[int], list[bytes]]] = {number: ([], []) for number in ids}
        marks = ", ".join("?" * len(found))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        with closing(self._database.execute(query, tuple(found))) as rows:
            while block := rows.fetchmany(50_000):
                for number, received, data in block:
                    times, contents = found[number]
                    times.append(received)
                    contents.append(data)
        joined = {}
        for number, (times, contents) in found.items():
            try:
                received = np.array(times, np.int64)
                size = np.array([len(c) for c in contents], np.int64)
                buffer = np.frombuffer(b"".join(contents), np.uint8)
            except (TypeError, ValueError, OverflowError) as error:
                raise InputError("a message without a time or without bytes") from error
            joined[number] = Messages(received, buffer, np.cumsum(size) - size, size).in_order()
        return joined

    def _all(self, query: str) -> list[tuple[Any, ...]]:
        with closing(self._database.execute(query)) as rows:
            return rows.fetchall()
