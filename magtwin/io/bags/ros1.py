"""ros1: bags of ROS 1 (.bag), read by rosbags; their messages are decoded like those of ROS 2."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.io.bags.cdr import Index, Messages
from magtwin.io.bags.storage import StoredTopic, gathered

_NOW = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # Types that have another name today


class Ros1Reader:
    """A .bag file: its topics, and its messages on demand; attributes as those of `McapReader`."""

    whole = True
    damaged = frozenset[int]()

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader

        self._path = path
        self._bag: Any = Reader(path)
        self._bag.open()
        self.notes: dict[str, str] = {}
        self.topics, self.definitions = [], {}
        for connection in self._bag.connections:
            kind = _NOW.get(connection.msgtype, connection.msgtype)
            latching = getattr(connection.ext, "latching", 0)
            latched = "durability: transient_local" if latching else ""
            self.topics.append(StoredTopic(connection.id, connection.topic, kind, "ros1", latched))
            self.definitions[kind] = "ros1msg", connection.msgdef.data
        self.chunks = len(self._bag.chunks)
        self.compression = {_name(chunk.decompressor) for chunk in self._bag.chunks.values()}

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()

    def times(self) -> dict[int, Index]:
        """Times of receipt of the messages of each topic [ns], from its index."""
        indexes = self._bag.indexes.items()
        return {k: np.array([entry.time for entry in each], np.int64) for k, each in indexes}

    def messages(self, ids: Collection[int], most: int | None = None) -> dict[int, Messages]:
        """The messages of some topics in the order of receipt; of about the first `most` bytes."""
        chosen = [each for each in self._bag.connections if each.id in ids]
        found = self._bag.messages(chosen) if chosen else ()
        rows = ((connection.id, received, data) for connection, received, data in found)
        return gathered(self._path, rows, ids, most, packed=True)


def _name(decompressor: Any) -> str:
    """Name of the compression of a chunk."""
    text = f"{getattr(decompressor, '__module__', '')}.{getattr(decompressor, '__qualname__', '')}".lower()
    return next((name for name in ("bz2", "lz4") if name in text), "")
