"""Writing bags: a Run at once, or raw messages as they come, as a rosbag2."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtwin.errors import InputError
from magtwin.files.outputs import check_free, output, why_full
from magtwin.io.bags.cdr import encode
from magtwin.io.bags.lab import lab_fields
from magtwin.io.bags.mcap import McapWriter
from magtwin.io.bags.sender import Unit
from magtwin.io.bags.storage import PARTIAL, ROOM, Batch, Connection, bag_metadata, partial_of, to_yaml
from magtwin.io.bags.stream import Sent, Stream
from magtwin.io.bags.topics import Qos
from magtwin.io.bags.twin_sender import sender_for
from magtwin.io.bags.types import definition_of, layout
from magtwin.run.arrow import metadata_to_json
from magtwin.run.run import Run
from magtwin.run.spool import blocks
from magtwin.version import __version__

if TYPE_CHECKING:
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.twin import Twin

CUSTOM = "magtwin."  # Prefix of a run's metadata in a bag's custom data; the values are JSON
NOTE = "magtwin"  # Metadata record of an MCAP file that holds a run's metadata
BLOCK = 16_384  # Rows written at a time
INSIDE = "run.mcap"  # Name that a single file gives itself: its bytes do not depend on the one that it has


def write_bag(
    run: Run,
    path: str | os.PathLike[str],
    twin: "Twin | None" = None,
    *,
    units: Unit = "T",
    scans: "Scans | None" = None,
    force: bool = False,
) -> None:
    """Write a run as a rosbag2; `read_bag` gives it back.

    `magtwin.io.bags.topics.TOPICS` lists the topics and what each carries. A slower signal is sent when the
    readings first have its value, and again while it stays. Stamps are simulation time: t = 0 is 0 ns.

    Args:
        run: The run; its t ascends. Whole seconds are added to a t below 0, with a warning.
        path: The folder to make, or a single file, which ends in .mcap.
        twin: The twin of the run: gives frames, covariances, /tf_static and the robot's description.
        units: Unit of magnetic fields: "T", as in ROS, or "nT", as APRILab's robot publishes them.
        scans: The LiDAR's scans.
        force: Replace an existing bag.

    Raises:
        InputError: The path exists and `force` is not set, or cannot be written; the run has no t, its time
            does not ascend, or a column cannot stand in a bag.
    """
    path = Path(path)
    check_suffix(path)
    check_free(path, force=force)
    sender = sender_for(twin, units, run.metadata.get("rate_hz"))
    with output(path, force=force) as aside, one_line(path):
        bag = _Bag(aside)
        try:
            lab = {} if twin is None else lab_fields(twin, sender.map_frame)
            stream = Stream(run, sender, scans, lab=lab)
            bag.note(run)
            for topic in stream.topics:
                bag.add(topic.name, topic.kind, topic.qos)
            for block in blocks(run, BLOCK):
                bag.send(stream.messages(block))
            bag.send(stream.last())
            bag.close()
        except BaseException:
            bag.abort()
            raise


class _Bag:
    """A bag at exactly the given path; an MCAP bag is a file, or a folder with metadata.yaml."""

    def __init__(self, path: Path) -> None:
        self.connections: dict[str, Connection] = {}
        self.custom: dict[str, str] = {}
        self._folder = None if path.suffix.lower() == ".mcap" else path
        if self._folder is not None:
            path.mkdir()
            path = path / f"{path.name.removesuffix(PARTIAL)}_0.mcap"
        self._file = path
        self.store = McapWriter(path, f"magtwin {__version__}")

    def add(self, topic: str, kind: str, qos: Qos, digest: str = "") -> None:
        """Register a topic, before its first message."""
        definition, digest = definition_of(kind, digest)
        connection = Connection(len(self.connections) + 1, topic, kind, definition, digest, qos)
        self.connections[topic] = connection
        self.store.add(connection)

    def send(self, sent: Iterator[Sent]) -> None:
        """Write messages of a stream."""
        batches = []
        for topic, times, fields in sent:
            rows = encode(layout(topic.kind, fields), fields, len(times), room=ROOM)
            batches.append(Batch(self.connections[topic.name], times, rows))
        self.store.write(batches)

    def note(self, run: Run) -> None:
        """Keep the metadata of a run."""
        entries = {name: json.dumps(value) for name, value in json.loads(metadata_to_json(run)).items()}
        self.custom = {CUSTOM + name: value for name, value in entries.items()}
        self.store.note(NOTE, entries)

    def flush(self) -> None:
        """Make everything outlive this process."""
        self.store.flush()
        if self._folder is not None:
            aside = self._folder / "metadata.yaml.new"
            about = {"rosbag2_bagfile_information": self._metadata(self._file.name)}
            aside.write_text(to_yaml(about), encoding="utf-8")
            aside.replace(self._folder / "metadata.yaml")

    def close(self) -> None:
        """Complete the bag."""
        self.store.note("rosbag2", {"serialized_metadata": to_yaml(self._metadata())})
        self.flush()
        self.store.close()

    def abort(self) -> None:
        """Leave the bag as it is."""
        with suppress(OSError):
            self.store.abort()

    def _metadata(self, file: str = INSIDE) -> dict[str, Any]:
        store, connections = self.store, list(self.connections.values())
        return bag_metadata(file, connections, store.counts, (store.first, store.last), self.custom)


class RawBagWriter:
    """A bag that grows by messages in CDR, of any topics; a killed process leaves all that was flushed.

    The path is that of a folder to make, or of a single file that ends in .mcap. Until the bag ends it has
    another name: `run.partial.mcap` for `run.mcap`, `bag.partial` for a folder `bag`; `read_bag` reads it at
    any time. `force` replaces an existing bag, and the rest of an earlier recording.
    """

    def __init__(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        self.path, self._force = Path(path), force
        check_suffix(self.path)
        check_free(self.path, force=force)
        self.partial = partial_of(self.path)  # Path until it ends
        if self.partial.exists() and not force:
            text = "left by a recording that did not end; read and remove it, or give --force"
            raise InputError(f"{self.partial}: {text}")
        with one_line(self.path):
            self._clear()
            self.partial.parent.mkdir(parents=True, exist_ok=True)
            self._bag = _Bag(self.partial)
        self._waiting: dict[str, list[tuple[int, int, bytes]]] = {}
        self._arrived = 0

    def add(self, topic: str, kind: str, qos: Qos, *, digest: str = "") -> None:
        """Register a topic, before its first message; `digest` as for `types.definition_of`."""
        if topic not in self._bag.connections:
            try:
                with one_line(self.path):
                    self._bag.add(topic, kind, qos, digest)
            except InputError as error:
                raise InputError(f"{topic}: {error}") from error

    def write(self, topic: str, received_ns: int, data: bytes) -> None:
        """Take a message of a registered topic; the next `flush` writes it."""
        self._waiting.setdefault(topic, []).append((received_ns, self._arrived, data))
        self._arrived += 1

    @property
    def counts(self) -> dict[str, int]:
        """Messages so far, by topic."""
        stored, waiting = self._bag.store.counts, self._waiting
        return {t: stored[c.id] + len(waiting.get(t, ())) for t, c in self._bag.connections.items()}

    def flush(self) -> None:
        """Make all messages outlive this process."""
        waiting, self._waiting = self._waiting, {}
        batches: list[Batch] = []
        with one_line(self.path):
            for topic, messages in waiting.items():
                batches += _batches(self._bag.connections[topic], messages)
            self._bag.store.write(batches)
            self._bag.flush()

    def close(self) -> None:
        """End the bag and give it its name. Nothing is left if nothing was written."""
        self.flush()
        with one_line(self.path):
            if any(self.counts.values()):
                self._bag.close()
                with output(self.path, force=self._force) as aside:
                    self.partial.rename(aside)
            else:
                self._bag.abort()
                self._clear()

    def _clear(self) -> None:
        if self.partial.is_dir():
            shutil.rmtree(self.partial)
        self.partial.unlink(missing_ok=True)


def check_suffix(path: Path) -> None:
    """Refuse a path that is no bag's to be written."""
    if path.suffix.lower() not in ("", ".mcap", PARTIAL):
        text = (
            "a bag is a folder, without a suffix, or ends in .mcap; ros2 bag convert makes a .db3 of either"
        )
        raise InputError(f"{path}: {text}")


@contextmanager
def one_line(path: Path) -> Iterator[None]:
    """Turn faults of the disk into one line."""
    try:
        yield
    except OSError as error:
        reason = why_full(path.parent, error) or error.strerror or str(error)
        raise InputError(f"{path}: cannot be written ({reason})") from error


def _batches(connection: Connection, messages: list[tuple[int, int, bytes]]) -> list[Batch]:
    """Messages of a topic (time, arrival, content) as one batch per size."""
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
