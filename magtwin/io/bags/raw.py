"""Bags of messages as they come: whatever topics, in bytes, one after the other."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magtwin.errors import InputError
from magtwin.files import check_free, output
from magtwin.io.bags.bag import ROOM, VERSION, Batch, Connection, Tally, metadata, yaml_of
from magtwin.io.bags.db3 import Db3Writer
from magtwin.io.bags.mcap import McapWriter
from magtwin.io.bags.messages import Qos
from magtwin.io.bags.writer import Storage, definition_of, refused, storage_of
from magtwin.io.recorder import PARTIAL, partial_of
from magtwin.version import __version__


class RawBagWriter:
    """A bag that grows by messages in CDR; one that is killed leaves all that was flushed.

    It grows as `magtwin.io.bags.writer.BagWriter` has it: under another name, its own at the end.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, storage: Storage | None = None, force: bool = False
    ) -> None:
        """Begin.

        Args:
            path: The folder to make; or a single storage file, where it ends in .mcap or .db3.
            storage: "mcap" or "sqlite3"; None takes what the path ends in, or else MCAP.
            force: Whether what exists is replaced.

        Raises:
            InputError: The path exists and `force` was not given, or cannot be written.
        """
        self._path, self._force = Path(path), force
        self._storage = storage_of(self._path, storage)
        check_free(self._path, force=force)
        self.partial = partial_of(self._path)
        """Where it lies while it grows."""
        check_free(self.partial, force=force)
        self._folder = None if self._path.suffix else self.partial
        with refused(self._path):
            self.partial.parent.mkdir(parents=True, exist_ok=True)
            file = self.partial
            if self._folder is not None:
                self._folder.mkdir(exist_ok=True)
                for old in self._folder.iterdir():
                    old.unlink()
                ending = ".mcap" if self._storage == "mcap" else ".db3"
                file = self._folder / f"{self.partial.name.removesuffix(PARTIAL)}_0{ending}"
            elif file.exists():
                file.unlink()
            self._file = file
            self._store: McapWriter | Db3Writer = (
                McapWriter(file, f"magtwin {__version__}")
                if self._storage == "mcap"
                else Db3Writer(file, live=True)
            )
        self._connections: dict[str, Connection] = {}
        self._tally = Tally({})
        self._waiting: dict[str, list[tuple[int, int, bytes]]] = {}
        self._arrived = 0

    def add(self, topic: str, kind: str, qos: Qos) -> None:
        """Tell of a topic, before its first message.

        Raises:
            InputError: Its type is none of ROS that is known here.
        """
        if topic in self._connections:
            return
        try:
            definition, digest = definition_of(kind)
        except Exception as error:  # rosbags raises of many kinds
            raise InputError(f"{topic}: no definition of messages {kind} is known ({error})") from error
        number = len(self._connections) + 1
        self._connections[topic] = Connection(number, topic, kind, definition, digest, qos)
        self._tally.counts[number] = 0
        with refused(self._path):
            self._store.add([self._connections[topic]])

    def write(self, topic: str, received_ns: int, data: bytes) -> None:
        """Take a message of a topic that was told of; it is in the file at the next `flush`."""
        self._waiting.setdefault(topic, []).append((received_ns, self._arrived, data))
        self._arrived += 1

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages so far, by topic."""
        return {
            topic: self._tally.counts[c.id] + len(self._waiting.get(topic, ()))
            for topic, c in self._connections.items()
        }

    def flush(self) -> None:
        """Have all that was taken outlive this process."""
        batches = [
            batch
            for topic, messages in self._waiting.items()
            for batch in _batches(self._connections[topic], messages)
        ]
        self._waiting.clear()
        with refused(self._path):
            self._store.write(batches)
            self._tally.add(batches)
            if isinstance(self._store, Db3Writer):
                self._store.note(VERSION, yaml_of(self._metadata()))
            self._store.flush()
            self._write_metadata()

    def close(self) -> None:
        """End the bag and give it its name; of a bag to which nothing was written there is none."""
        self.flush()
        with refused(self._path):
            if isinstance(self._store, McapWriter):
                self._store.note("rosbag2", {"serialized_metadata": yaml_of(self._metadata())})
            self._store.close()
            self._write_metadata()
            if not sum(self._tally.counts.values()):
                self._remove()
                return
            check_free(self._path, force=self._force)
            with output(self._path, force=self._force) as aside:
                self.partial.rename(aside)

    def _remove(self) -> None:
        if self._folder is None:
            self.partial.unlink()
            return
        for file in self._folder.iterdir():
            file.unlink()
        self._folder.rmdir()

    def _metadata(self) -> dict[str, object]:
        connections = list(self._connections.values())
        return metadata(self._storage, [self._file.name], connections, self._tally, {})

    def _write_metadata(self) -> None:
        if self._folder is not None:
            aside = self._folder / "metadata.yaml.new"
            aside.write_text(yaml_of({"rosbag2_bagfile_information": self._metadata()}), encoding="utf-8")
            aside.replace(self._folder / "metadata.yaml")


def _batches(connection: Connection, messages: list[tuple[int, int, bytes]]) -> list[Batch]:
    """Messages of a topic (time, arrival, content) as a batch for each size."""
    by_size: dict[int, list[tuple[int, int, bytes]]] = {}
    for message in sorted(messages, key=lambda m: m[:2]):
        by_size.setdefault(len(message[2]), []).append(message)
    batches = []
    for size, chosen in by_size.items():
        times, arrivals, contents = zip(*chosen, strict=True)
        rows = np.zeros((len(chosen), ROOM + size), np.uint8)
        rows[:, ROOM:] = np.frombuffer(b"".join(contents), np.uint8).reshape(len(chosen), size)
        batches.append(Batch(connection, np.array(times, np.int64), rows, np.array(arrivals, np.int64)))
    return batches
