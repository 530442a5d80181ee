"""Live: a run while it goes on, in a Rerun file that grows and in the viewer."""

import socket
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import rerun as rr

from magtwin.errors import InputError
from magtwin.files.outputs import check_free
from magtwin.frames import quat_from_yaw
from magtwin.io.recorder import Sink, partial_of
from magtwin.io.rerun.layout import drive_layout
from magtwin.io.rerun.recording import (
    APPLICATION,
    ROOM,
    Recording,
    check_room,
    flush,
    recording_of,
    size_of,
    title_of,
    unwritten,
)
from magtwin.io.rerun.series import STATES
from magtwin.io.rerun.viewer import live_viewer
from magtwin.io.rerun.world import POSE_HZ, Interior, Robot, send_still
from magtwin.path import Path as Planned
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import Twin

Show = Callable[[float, tuple[float, float, float]], None]
"""Takes the time [s] and x [m], y [m], yaw [rad] of base_link."""


class _Growing(Sink):
    """A recording that gets its rows block by block; the stream starts with the first of them."""

    def __init__(
        self,
        twin: Twin | None,
        *,
        expected: Run | None = None,
        planned: Planned | None = None,
        scans: Scans | None = None,
        final: Path,
        **sinks: Any,
    ) -> None:
        self._twin, self._expected, self._final, self._sinks = twin, expected, final, sinks
        self._shown: dict[str, Any] = {"planned": planned, "scans": scans}
        self._stack = ExitStack()
        self._recording: Recording | None = None
        self.rows = 0

    def append(self, run: Run) -> None:
        """Add the next rows; they are in the file or the viewer when this returns.

        Raises:
            InputError: The disk is full, or the stage cannot be read.
        """
        if self._recording is None:
            self._recording = self._stack.enter_context(self._begin(run))
        if file := self._sinks.get("file"):
            check_room(file, file.stat().st_size + size_of(run, self._shown["scans"]) + ROOM, self._final)
        try:
            self._recording.append(run)
            flush(self._recording.rec, file and file.parent)
        except RuntimeError as error:
            raise unwritten(self._final, error) from error
        self.rows += run.rows

    def _begin(self, run: Run) -> Any:
        rate, known = run.metadata.get("rate_hz", 0.0), self._expected
        layout = {"known": known, "events": None if known else list(STATES), "whole": known is not None}
        more: dict[str, Any] = {**layout, **self._shown, **self._sinks, "final": self._final}
        rate_hz = rate if isinstance(rate, float) else 0.0
        title = title_of(run) or "live run"
        return recording_of(run, uuid.uuid4().hex, title, self._twin, rate_hz=rate_hz, **more)

    def close(self) -> None:
        """Complete the recording."""
        if self._recording is not None:
            self._recording.close()
        self._stack.close()

    def abort(self) -> None:
        """Leave the recording as it is."""
        with suppress(InputError):
            self._stack.close()


class RrdWriter(_Growing):
    """A recording that grows while its run goes on: a sink of a `Recorder`.

    Its layout is that of `write_rrd`. Until `close`, the file has the name `run.partial.rrd` and can be read
    up to the last rows, even if the process was killed.

    Args:
        path: The .rrd file to make at the end.
        twin: Where the run takes place, as for `write_rrd`.
        force: Whether to replace an existing file, also an unfinished one.
        shown: `expected`, the run, if known beforehand, which sets axes and colours; `planned`, the planned
            path; `scans`, the LiDAR scans of the whole run.

    Raises:
        InputError: The file exists and `force` was not given, or it cannot be written.
    """

    def __init__(
        self, path: str | Path, twin: Twin | None = None, *, force: bool = False, **shown: Any
    ) -> None:
        self.path, self._force = check_free(path, force=force), force
        self.partial = check_free(partial_of(self.path), force=force)
        """The file while it grows."""
        try:
            self.partial.parent.mkdir(parents=True, exist_ok=True)
            self.partial.write_bytes(b"")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror})") from error
        super().__init__(twin, **shown, file=self.partial, final=self.path)

    def close(self) -> None:
        """Complete the file and give it its name; without rows, delete it."""
        super().close()
        if not self.rows:
            self.partial.unlink()
            return
        check_free(self.path, force=self._force)
        self.partial.replace(self.path)

    def abort(self) -> None:
        """Keep the rows so far under the unfinished name; without rows, delete the file."""
        super().abort()
        if not self.rows:
            self.partial.unlink(missing_ok=True)


class LiveViewer(_Growing):
    """A viewer that shows a run while it goes on: a sink of a `Recorder`. The run goes on without it.

    Args:
        address: Address of the viewer, such as rerun+http://127.0.0.1:9876/proxy.
        twin: Where the run takes place, as for `write_rrd`.
        shown: As for `RrdWriter`.

    Raises:
        InputError: No viewer listens there.
    """

    def __init__(self, address: str, twin: Twin | None = None, **shown: Any) -> None:
        check_listens(address)
        super().__init__(twin, **shown, address=address, final=Path(address))
        self.shown = True
        """Whether the viewer is still there."""

    def append(self, run: Run) -> None:
        """Show the next rows."""
        if self.shown:
            try:
                super().append(run)
            except InputError:
                self.abort()

    def close(self) -> None:
        """Complete the run; the viewer stays open."""
        if self.shown:
            with suppress(InputError):
                super().close()

    def abort(self) -> None:
        """Disconnect from the viewer."""
        if self.shown:
            self.shown = False
            super().abort()


def check_listens(address: str) -> None:
    """Refuse an address at which no viewer listens: Rerun itself would wait for one.

    Raises:
        InputError: It is not an address of a viewer, or no viewer is there.
    """
    parts = urlsplit(address)
    try:
        if not parts.scheme.startswith("rerun") or not parts.hostname or not parts.port:
            raise InputError(f"{address}: no address of a viewer; give one as rerun+http://HOST:PORT/proxy")
        socket.create_connection((parts.hostname, parts.port), timeout=5).close()
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no viewer listens there ({error}); start one with: rerun") from error


@contextmanager
def live_view(twin: Twin) -> Iterator[Show]:
    """The lab and the robot in a window, which is closed with the block.

    Raises:
        InputError: No window can be opened here.
    """
    with live_viewer() as (address, _), streamed(twin, address) as show:
        yield show


@contextmanager
def streamed(twin: Twin, address: str) -> Iterator[Show]:
    """The lab and the robot in the viewer at an address."""
    rec = rr.RecordingStream(APPLICATION, send_properties=False)
    rec.connect_grpc(address, default_blueprint=drive_layout(twin.scene.lab))
    rec.send_recording_name("manual drive")
    interior = Interior.of(twin)
    send_still(rec, interior.shapes)
    robot = Robot(rec, interior, rate_hz=POSE_HZ)

    def show(t: float, pose: tuple[float, float, float]) -> None:
        x, y, yaw = pose
        columns = {
            "t": np.array([t]),
            "p_world_base": np.array([[x, y, twin.scene.robot.base_height_m]]),
            "q_world_base_xyzw": quat_from_yaw(np.array([yaw])),
        }
        robot.append(Run(columns))

    try:
        yield show
    finally:
        rec.flush()
        rec.disconnect()
