"""db3: bags in sqlite3, the older storage of rosbag2. They are read, not written."""

import sqlite3
from array import array
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS
from magtwin.files.settings import yaml_loader
from magtwin.io.bags.cdr import Index, Messages
from magtwin.io.bags.storage import StoredTopic, gathered

_STEPS, _STEP = 1_000_000, 10_000  # Steps of sqlite's machine that any file may take, and between counts

_STEPS_PER_BYTE = 5
"""Further steps for each byte of a file. A message takes about 20 and has 20 bytes or more, but pages of a
damaged file can lead to each other again and again."""

_ROWS = 10_000  # Most topics of a bag
MOST_QOS = 4_000  # Characters of the quality of service of a topic that are read


class Db3Reader:
    """A .db3 file: its topics, and its messages on demand; attributes as those of `McapReader`."""

    whole, chunks = True, 0
    compression = frozenset[str]()
    damaged = frozenset[int]()

    def __init__(self, path: Path) -> None:
        self._path, self._size, self._steps = path, path.stat().st_size, 0
        self._database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            self._database.set_progress_handler(self._spent, _STEP)
            longest = self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, BUDGETS["text"].file)
            tables = _tables(self._database)
            self.notes = _custom_data(self._database) if "metadata" in tables else {}
            self.topics = _topics(self._database)
            self.definitions = _definitions(self._database)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the bag."""
        self._database.close()

    def times(self) -> dict[int, Index]:
        """Times of receipt of the messages of each topic [ns]."""
        found = {topic.id: array("q") for topic in self.topics}
        self._steps = 0
        for number, received in self._database.execute("SELECT topic_id, timestamp FROM messages"):
            found.setdefault(number, array("q")).append(received)
        return {number: np.sort(np.array(times, np.int64)) for number, times in found.items()}

    def messages(self, ids: Collection[int], most: int | None = None) -> dict[int, Messages]:
        """The messages of some topics in the order of receipt; of about the first `most` bytes."""
        marks = ", ".join("?" * len(ids))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
        self._steps = 0
        return gathered(self._path, self._database.execute(query, list(ids)), ids, most)

    def _spent(self) -> bool:
        """Whether sqlite has to give up."""
        self._steps += _STEP
        return self._steps > _STEPS + _STEPS_PER_BYTE * self._size


def _tables(database: sqlite3.Connection) -> set[str]:
    """Names of its tables, in lower case; computed ones are refused: they can have rows without end."""
    tables = set()
    for name, sql in database.execute("SELECT CAST(name AS BLOB), sql FROM sqlite_master"):
        name = (name or b"").decode(errors="replace").lower()
        if name in ("messages", "topics", "metadata"):
            hidden = database.execute("SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden", (name,))
            if not str(sql).startswith("CREATE TABLE ") or hidden.fetchone() != (0,):
                raise InputError(f"{name} is computed; a bag has plain tables only")
            tables.add(name)
    if not {"messages", "topics"} <= tables:
        raise InputError("missing tables: a bag has messages and topics")
    return tables


def _topics(database: sqlite3.Connection) -> list[StoredTopic]:
    """Its topics."""
    qos = "offered_qos_profiles" if "offered_qos_profiles" in _columns(database, "topics") else "''"
    columns = "CAST(id AS INTEGER), CAST(name AS TEXT), CAST(type AS TEXT), "
    columns += f"CAST(serialization_format AS TEXT), substr(CAST({qos} AS TEXT), 1, {MOST_QOS})"
    topics, held = [], 0
    for number, *texts in database.execute(f"SELECT {columns} FROM topics WHERE id IS NOT NULL"):
        topics.append(StoredTopic(number, *(text or "" for text in texts)))
        held += sum(map(len, topics[-1][1:]))  # rows of a damaged file can share their pages
        if len(topics) > _ROWS or held > BUDGETS["text"].file:
            raise InputError(f"it has over {_ROWS:,} topics, or they are too long; write it again with fewer")
    return sorted(topics)


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    """Names of the columns of a table; empty if there is none."""
    return {str(name) for (name,) in database.execute("SELECT name FROM pragma_table_info(?)", (table,))}


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Encoding and text of the definition of each message type, which ROS 2 Iron and later store."""
    names = "topic_type", "encoding", "encoded_message_definition"
    if not _columns(database, "message_definitions").issuperset(names):
        return {}
    rows = database.execute(f"SELECT {', '.join(names)} FROM message_definitions LIMIT {_ROWS}")
    return {str(kind): (str(encoding), str(text)) for kind, encoding, text in rows}


def _custom_data(database: sqlite3.Connection) -> dict[str, str]:
    """The custom data that a .db3 file holds beside its messages; empty if it holds none."""
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
