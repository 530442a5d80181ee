"""Recording: a Run in a Rerun stream, whole or block by block, to a file or a viewer."""

import atexit
import errno
import hashlib
import json
import os
import shutil
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.outputs import why_full
from magtwin.io.rerun.layout import layout
from magtwin.io.rerun.series import COLUMNS_ENTITY, ROWS, Flags, entity_of, send_columns, send_metadata
from magtwin.io.rerun.world import Feed, Interior, Robot, heading_of, send_room
from magtwin.path import Path
from magtwin.report.summary import in_markdown
from magtwin.run import mapped
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import Twin

APPLICATION = "magtwin"

PATIENCE_S = 60.0  # Time that Rerun may take to write its data [s]
NEVER = timedelta(days=1)  # Time after which Rerun writes what it has, however little
END = b"RRF2FOOT"  # Bytes at the end of a complete file
ROOM = 1 << 20  # Upper bound of the bytes of a layout, the metadata and the column names
_stuck = threading.Event()  # Set once Rerun waits for ever, for a thread that a full disk has ended
POSED = frozenset(("p_world_base", "q_world_base_xyzw"))  # Columns that place a robot


def check_room(file: FilePath, size: int, final: FilePath | None = None) -> None:
    """Refuse a recording of up to `size` bytes for which the disk has no room; errors name `final`.

    Rerun writes from its own thread, and waits for it for ever after a full disk ended it. So this comes
    first.
    """
    try:
        with tempfile.TemporaryFile(dir=file.parent) as probe:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(probe.fileno(), 0, size)
            elif shutil.disk_usage(file.parent).free < size:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        text = f"cannot be written ({error.strerror}): up to {size / 1e6:.1f} MB are needed; make room"
        raise InputError(f"{final or file}: {text}") from error


def size_of(run: Run, scans: Scans | None = None) -> int:
    """Upper bound of the bytes of a run's rows in a recording, and of the scans in the same time."""
    size = sum(values.nbytes + 4 * run.rows for values in run.values()) + 136 * run.rows
    if scans is not None and run.rows:
        first, last = np.searchsorted(scans.t, run["t"][[0, -1]])
        size += (int(last - first) + 2) * (16 * scans.ranges_m.shape[1] + 64)
    return size


@contextmanager
def stream(
    recording_id: str,
    name: str,
    views: rrb.Blueprint,
    *,
    file: FilePath | None = None,
    address: str | None = None,
    final: FilePath | None = None,
    room: int = ROOM,
) -> Iterator[rr.RecordingStream]:
    """A stream to a file, or to the viewer at an address; completed and closed with the block.

    The viewer merges recordings of one `recording_id`. `views` is the layout that it opens with, `final` the
    file that errors name, and `room` an upper bound of the file's size [bytes]. The file can be read at any
    time up to the last flush.
    """
    final = final or file
    if file is not None:
        check_room(file, room, final)
    folder = None if file is None else file.parent
    strict = rr.strict_mode()
    if not _stuck.is_set():  # the threads of recordings that nothing uses any more end when Rerun is asked
        await_rerun(rerun_bindings.flush_and_cleanup_orphaned_recordings, folder)
    # What is written together must not depend on the speed of the machine; a viewer gets it as it comes.
    batches = None if file is None else rr.ChunkBatcherConfig(flush_tick=NEVER)
    options: Any = {"send_properties": False, "batcher_config": batches}
    rec = rr.RecordingStream(APPLICATION, recording_id=recording_id, **options)
    if not rr.is_enabled(rec):
        raise InputError(f"{final}: Rerun is switched off by the environment variable RERUN; unset it")
    rr.set_strict_mode(True)
    try:
        sink: Any = rr.GrpcSink(address) if file is None else rr.FileSink(str(file))
        await_rerun(lambda: _open(rec, sink, views), folder)
        rec.send_recording_name(name)
        yield rec
        flush(rec, folder)
    except RuntimeError as error:
        raise unwritten(final, error) from error
    finally:
        rr.set_strict_mode(strict)
        with suppress(RuntimeError):
            await_rerun(rec.disconnect, folder)
    if file is not None:
        with open(file, "rb") as written:  # Rerun does not report a disk that was full at the end
            written.seek(-min(64, file.stat().st_size), 2)
            if END not in written.read():
                raise unwritten(final, "its end is missing")


def _open(rec: rr.RecordingStream, sink: Any, views: rrb.Blueprint) -> None:
    """As `rec.set_sinks(sink, default_blueprint=views)`, which keeps the threads of the layout for ever."""
    options = {"make_default": False, "make_thread_default": False, "default_enabled": True}
    shown = rr.RecordingStream._from_native(rerun_bindings.new_blueprint(APPLICATION, **options))
    shown.set_time("blueprint", sequence=0)
    views._log_to_stream(shown)
    held = shown.memory_recording().storage
    rerun_bindings.set_sinks([sink], default_blueprint=held, recording=rec.to_native())
    shown.disconnect()


def flush(rec: rr.RecordingStream, folder: FilePath | None) -> None:
    """Wait until the data of a stream is written; RuntimeError if it cannot be."""
    await_rerun(lambda: rec.flush(timeout_sec=PATIENCE_S), folder)


def await_rerun(work: Callable[[], object], folder: FilePath | None) -> None:
    """Call a function of Rerun that waits for its writing thread, which a full disk has ended.

    Rerun then waits for ever. So it works in a thread, while this one looks whether the disk of `folder` is
    full. It is a RuntimeError if it fails, or has not ended after `PATIENCE_S`.
    """
    if folder is None:
        work()
        return
    done: Future[object] = Future()

    def call() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    full = ""
    for _ in range(int(PATIENCE_S)):
        with suppress(TimeoutError):
            done.result(timeout=1.0)
            return
        if full := why_full(folder):
            break
    atexit.unregister(rr.rerun_shutdown)  # it would wait too
    _stuck.set()
    raise RuntimeError(full or "Rerun does not end")


def unwritten(path: FilePath | None, why: object) -> InputError:
    """The error of a file that could not be written."""
    return InputError(
        f"{path}: cannot be written ({why}); is the disk full, or a limit of file sizes reached?"
    )


@dataclass
class Recording:
    """One run in a stream. Append its rows, once or as they come, then close it."""

    rec: rr.RecordingStream
    name: str = ""  # Its name among several runs; "" for a single run
    robot: Robot | None = None  # Its robot in the room. None: only series.
    scans: Scans | None = None  # Its LiDAR scans, drawn if there is a robot

    _rows: int = 0
    _last: Run | None = None
    _flags: Flags = field(init=False)
    _feed: Feed | None = None

    def __post_init__(self) -> None:
        self._flags = Flags(self.rec, self.name)
        if self.robot is not None and self.scans is not None and len(self.scans.t):
            self._feed = Feed(self.rec, self.scans)

    def append(self, run: Run) -> None:
        """Add the next rows."""
        if not run.rows:
            return
        if not self._rows:
            send_metadata(self.rec, run, self.name)
        send_columns(self.rec, run, run["t"], self.name)
        self._flags.append(run)
        if self.robot is not None and run.keys() >= POSED:
            self.robot.append(run)
        if self._feed is not None:
            self._feed.send_until(float(run["t"][-1]))
        self._rows += run.rows
        self._last = run.take(slice(-1, None))

    def close(self) -> None:
        """Complete the run; no rows can follow."""
        if self._last is None:
            return
        self._flags.close()
        if self.robot is not None and self._last.keys() >= POSED:
            self.robot.close(self._last)
        if self._feed is not None:
            self._feed.clear(float(self._last["t"][-1]))
        rows: dict[str, Any] = {ROWS: [self._rows]}  # marks a complete run
        self.rec.log(entity_of(COLUMNS_ENTITY, self.name), rr.AnyValues(**rows), static=True)
        page = metadata_page(self._last.metadata, self._rows)
        self.rec.log(entity_of("metadata", self.name), page, static=True)


def send_whole(rec: rr.RecordingStream, run: Run, name: str = "", robot: Robot | None = None) -> None:
    """Send all rows of a run."""
    recording = Recording(rec, name, robot)
    recording.append(run)
    recording.close()


@contextmanager
def recording_of(
    run: Run,
    recording_id: str,
    name: str,
    twin: Twin | None = None,
    *,
    known: Run | None = None,
    planned: Path | None = None,
    scans: Scans | None = None,
    events: Sequence[str] | None = None,
    room: int = 0,
    rate_hz: float = 0.0,
    **sinks: Any,
) -> Iterator[Recording]:
    """A recording of one run with its layout, metadata and lab; it holds no rows yet.

    `known` sets axes and colours; default: `run`. No twin: only series. `room` is an upper bound of the size
    of the rows [bytes]; a `rate_hz` of 0 is taken from the first rows; `sinks` are `file`, `address` and
    `final` of `stream`.
    """
    known = run if known is None else known
    lab, heading = (None, 0.0) if twin is None else (twin.scene.lab, heading_of(twin.field, known))
    views = layout(known, lab, heading=heading, events=events)
    room += ROOM
    if twin is not None:
        interior = Interior.of(twin)
        room += interior.size(twin.field)
    with stream(recording_id, name, views, room=room, **sinks) as rec:
        named = {k: v for k, v in run.metadata.items() if k}  # a property without a name cannot be sent
        kept = {k: v for k, v in named.items() if not isinstance(v, int) or -(2**63) <= v < 2**63}
        properties: dict[str, Any] = {key: [value] for key, value in kept.items()}
        if properties:
            rec.send_property("run", rr.AnyValues(**properties))
        rec.log("metadata", metadata_page(run.metadata), static=True)
        recording = Recording(rec)
        if twin is not None:
            scale = send_room(rec, interior, twin.field, known, planned)
            recording = Recording(rec, "", Robot(rec, interior, scale, rate_hz=rate_hz), scans)
        yield recording


def title_of(run: Run) -> str:
    """Name of a run in the viewer: its path and seed."""
    return ", ".join(f"{key} {run.metadata[key]}" for key in ("path", "seed") if key in run.metadata)


def content_id(*runs: Run) -> str:
    """An id that depends only on the content of the runs."""
    digest = hashlib.sha256()
    for run in runs:
        sums = {name: (str(values.dtype), values.shape, _crc(values)) for name, values in run.items()}
        digest.update(json.dumps([sums, dict(run.metadata)], sort_keys=True).encode())
    return digest.hexdigest()[:32]


def _crc(values: NDArray[Any]) -> int:
    """CRC-32 of an array's content, read block by block."""
    crc = 0
    for first in range(0, len(values), mapped.BLOCK):
        crc = zlib.crc32(np.ascontiguousarray(values[first : first + mapped.BLOCK]).data, crc)
    mapped.release()
    return crc


def metadata_page(metadata: Mapping[str, Any], rows: int | None = None) -> rr.TextDocument:
    """The metadata of a run as a page with a table."""
    values = {**({} if rows is None else {"readings": f"{rows:,}"}), **metadata}
    cells = [[in_markdown(" ".join(str(text).split())) for text in pair] for pair in values.items()]
    lines = ["| metadata | value |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)]
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
