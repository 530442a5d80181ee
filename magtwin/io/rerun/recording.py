"""Recording: a Run on its way into a Rerun stream, whole or block by block, to a file, a viewer, or both."""

import errno
import hashlib
import json
import os
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magtwin.errors import InputError
from magtwin.io.rerun.series import Flags, entity_of, send_columns, send_metadata, send_rows
from magtwin.io.rerun.world import Feed, Robot
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans

APPLICATION = "magtwin"

PATIENCE_S = 60.0
"""How long Rerun may take to write what it was given [s]."""

END = b"RRF2FOOT"
"""What stands at the end of a file that Rerun finished."""

ROOM = 1 << 20
"""Bytes that a layout, the metadata and what names all columns take, or more."""

POSED = frozenset(("p_world_base", "q_world_base_xyzw"))
"""Columns that place a robot."""


def check_room(file: FilePath, size: int, said: FilePath | None = None) -> None:
    """Refuse to begin what the disk has no room for.

    It is asked beforehand, as Rerun writes from a thread of its own, and waits for that thread for ever where
    a full disk has ended it.

    Args:
        file: The file that grows; nothing is done to it.
        size: Bytes that it will have, or more.
        said: The file that a refusal names, where that is another.

    Raises:
        InputError: There is no room, or its folder cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=file.parent) as probe:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(probe.fileno(), 0, size)
            elif shutil.disk_usage(file.parent).free < size:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        raise InputError(
            f"{said or file}: cannot be written ({error.strerror}): up to {size / 1e6:.1f} MB are needed; "
            "make room"
        ) from error


def size_of(run: Run, scans: Scans | None = None) -> int:
    """Bytes that the rows of a run take in a recording, or more, and the scans while it lasts."""
    own = sum(values.nbytes + 4 * run.rows for values in run.values())
    seen = 0
    if scans is not None and run.rows:
        first, last = np.searchsorted(scans.t, run["t"][[0, -1]])
        seen = (int(last - first) + 2) * (16 * scans.ranges_m.shape[1] + 64)
    return own + 24 * run.rows + 2 * (24 + 4 * 8) * run.rows + seen


@contextmanager
def stream(
    recording_id: str,
    name: str,
    views: rrb.Blueprint,
    *,
    file: FilePath | None = None,
    address: str | None = None,
    said: FilePath | None = None,
    room: int = ROOM,
) -> Iterator[rr.RecordingStream]:
    """A stream to a file, to the viewer at an address, or to both; complete and closed at the end.

    Args:
        recording_id: Recordings of one id are one to the viewer.
        name: What the viewer calls it.
        views: What it opens with.
        file: The file to make; it can be read at any time up to the last flush.
        address: Where a viewer listens.
        said: The file that a refusal names, where that is another.
        room: Bytes that the disk must have for it.

    Raises:
        InputError: Rerun is switched off, or the file cannot be written.
    """
    said = said or file
    if file is not None:
        check_room(file, room, said)
    strict = rr.strict_mode()
    rec = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
    if not rr.is_enabled(rec):
        raise InputError(f"{said}: Rerun is switched off by the environment variable RERUN; unset it")
    rr.set_strict_mode(True)
    try:
        sinks: list[Any] = [] if file is None else [rr.FileSink(str(file))]
        sinks += [] if address is None else [rr.GrpcSink(address)]
        rec.set_sinks(*sinks, default_blueprint=views)
        rec.send_recording_name(name)
        yield rec
        rec.flush(timeout_sec=PATIENCE_S)
    except RuntimeError as error:
        raise InputError(_unwritten(said, error)) from error
    finally:
        rr.set_strict_mode(strict)
        with suppress(RuntimeError):
            rec.disconnect()
    if file is not None:
        with open(file, "rb") as written:  # Rerun does not say when its last bytes met a full disk
            written.seek(-min(64, file.stat().st_size), 2)
            if END not in written.read():
                raise InputError(_unwritten(said, "its end is missing"))


def _unwritten(path: FilePath | None, why: object) -> str:
    return f"{path}: cannot be written ({why}); is the disk full, or a limit on file sizes reached?"


@dataclass
class Recording:
    """One run in a stream. Append its rows, once or as they come, then close it."""

    rec: rr.RecordingStream
    name: str = ""
    """What it is called among others in the same recording; "" where it is alone."""
    offset_s: float = 0.0
    """What is added to its times [s]."""
    robot: Robot | None = None
    """Its robot, in the room; none for series only."""
    scans: Scans | None = None
    """What its LiDAR saw; shown where there is a robot."""

    _rows: int = 0
    _last: Run | None = None
    _flags: Flags = field(init=False)
    _feed: Feed | None = None

    def __post_init__(self) -> None:
        self._flags = Flags(self.rec, self.name, self.offset_s)
        if self.robot is not None and self.scans is not None and len(self.scans.t):
            self._feed = Feed(self.rec, self.scans)

    def append(self, run: Run) -> None:
        """The next rows."""
        if not run.rows:
            return
        if not self._rows:
            send_metadata(self.rec, run, self.name)
        send_columns(self.rec, run, run["t"] + self.offset_s, self.name)
        self._flags.append(run)
        if self.robot is not None and run.keys() >= POSED:
            self.robot.append(run)
        if self._feed is not None:
            self._feed.send_until(float(run["t"][-1]))
        self._rows += run.rows
        self._last = run.take(slice(-1, None))

    def close(self) -> None:
        """No rows come any more."""
        if self._last is None:
            return
        self._flags.close()
        if self.robot is not None and self._last.keys() >= POSED:
            self.robot.close(self._last)
        if self._feed is not None:
            self._feed.clear(float(self._last["t"][-1]))
        send_rows(self.rec, self._rows, self.name)
        self.rec.log(
            entity_of("metadata", self.name), metadata_page(self._last.metadata, self._rows), static=True
        )


def send_properties(rec: rr.RecordingStream, metadata: Mapping[str, Any]) -> None:
    """The metadata of a run as properties of the recording, for the viewer and for catalogs."""
    known: dict[str, Any] = {key: [value] for key, value in metadata.items() if not _too_large(value)}
    if known:
        rec.send_property("run", rr.AnyValues(**known))


def _too_large(value: object) -> bool:
    return isinstance(value, int) and not -(2**63) <= value < 2**63


def title_of(run: Run) -> str:
    """What the viewer calls a run: path and seed."""
    return ", ".join(f"{key} {run.metadata[key]}" for key in ("path", "seed") if key in run.metadata)


def content_id(*runs: Run) -> str:
    """An id that the same runs always get, and no others."""
    digest = hashlib.sha256()
    for run in runs:
        sums = {
            name: (str(values.dtype), values.shape, zlib.crc32(np.ascontiguousarray(values).data))
            for name, values in run.items()
        }
        digest.update(json.dumps([sums, dict(run.metadata)], sort_keys=True).encode())
    return digest.hexdigest()[:32]


def metadata_page(metadata: Mapping[str, Any], rows: int | None = None) -> rr.TextDocument:
    """The metadata of a run as a page with a table."""
    said = {**({} if rows is None else {"readings": f"{rows:,}"}), **metadata}
    cells = [(_cell(key), _cell(value)) for key, value in said.items()]
    lines = ["| fact | value |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)]
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)


def _cell(value: object) -> str:
    return " ".join(str(value).replace("|", r"\|").split())
