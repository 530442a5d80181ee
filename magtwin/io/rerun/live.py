"""Live: a run that goes on, in a Rerun file that grows and in the viewer."""

import math
import socket
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr
import rerun.blueprint as rrb

from magtwin.errors import InputError
from magtwin.files import check_free
from magtwin.io.recorder import partial_of
from magtwin.io.rerun.layout import lab_eye, layout
from magtwin.io.rerun.recording import (
    APPLICATION,
    ROOM,
    Recording,
    check_room,
    metadata_page,
    send_properties,
    size_of,
    stream,
    title_of,
)
from magtwin.io.rerun.series import STATES, TIMELINE
from magtwin.io.rerun.viewer import live_viewer
from magtwin.io.rerun.world import Interior, Room, heading_of, mesh_of
from magtwin.path import Path as Planned
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.spec.scene import Scene
from magtwin.twin import Twin
from magtwin.usd.geometry import read_links, read_shapes
from magtwin.usd.maps import HEAT_MAP
from magtwin.usd.scene import open_alone

Show = Callable[[float, tuple[float, float, float]], None]
"""Takes the time [s] and x [m], y [m], yaw [rad] of base_link."""

TRAIL_M = 0.02
"""Way between the points of the line that a robot draws on the floor [m]."""


class RrdWriter:
    """A recording that grows while its run goes on: a sink of a `Recorder`.

    Its layout is that of `write_rrd`. The file lies beside its place under the name `run.partial.rrd` until
    `close`; whatever ends the process, it can be read up to the last rows.
    """

    def __init__(
        self,
        path: str | Path,
        twin: Twin | None = None,
        *,
        expected: Run | None = None,
        planned: Planned | None = None,
        scans: Scans | None = None,
        force: bool = False,
    ) -> None:
        """Begin a file.

        Args:
            path: The .rrd file to make at the end.
            twin: As for `write_rrd`, as what follows.
            expected: The run, where it is known beforehand: it sets axes and colours.
            planned: The path that is to be driven.
            scans: What the LiDAR saw, or will have seen.
            force: Whether a file that exists is replaced, and what another recording left unfinished.

        Raises:
            InputError: The file exists and `force` was not given, or it cannot be written.
        """
        self.path, self._force = check_free(path, force=force), force
        self.partial = check_free(partial_of(self.path), force=force)
        """Where it lies while it grows."""
        try:
            self.partial.parent.mkdir(parents=True, exist_ok=True)
            self.partial.write_bytes(b"")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror})") from error
        self._growing = _Growing(twin, expected, planned, scans, file=self.partial, said=self.path)

    def append(self, run: Run) -> None:
        """The next rows; they are in the file when this returns.

        Raises:
            InputError: The disk is full, or the stage cannot be read.
        """
        self._growing.append(run)

    def close(self) -> None:
        """Complete the file and give it its name; without rows there is none."""
        rows = self._growing.close()
        if not rows:
            self.partial.unlink()
            return
        check_free(self.path, force=self._force)
        self.partial.replace(self.path)

    def abort(self) -> None:
        """Leave what there is under the name that says that it did not end; without rows nothing."""
        self._growing.abort()
        if not self._growing.rows:
            self.partial.unlink(missing_ok=True)


class LiveViewer:
    """A viewer that shows a run as it goes on: a sink of a `Recorder`; when it is gone, the run goes on."""

    def __init__(
        self,
        address: str,
        twin: Twin | None = None,
        *,
        expected: Run | None = None,
        planned: Planned | None = None,
        scans: Scans | None = None,
    ) -> None:
        """Begin.

        Args:
            address: Where it listens, such as rerun+http://127.0.0.1:9876/proxy.
            twin: As for `RrdWriter`, as what follows.
            expected: The run, where it is known beforehand.
            planned: The path that is to be driven.
            scans: What the LiDAR saw, or will have seen.

        Raises:
            InputError: Nothing listens there.
        """
        check_listens(address)
        self._address = address
        self._growing: _Growing | None = _Growing(twin, expected, planned, scans, address=address)

    @property
    def shown(self) -> bool:
        """Whether it is still there."""
        return self._growing is not None

    def append(self, run: Run) -> None:
        """The next rows."""
        if self._growing is None:
            return
        try:
            self._growing.append(run)
        except InputError:
            self.abort()

    def close(self) -> None:
        """Say that no rows come any more; the viewer stays as it is."""
        if self._growing is not None:
            with suppress(InputError):
                self._growing.close()

    def abort(self) -> None:
        """Let go of it."""
        if self._growing is not None:
            growing, self._growing = self._growing, None
            growing.abort()


class _Growing:
    """A stream that gets its rows bit by bit; it begins with the first of them."""

    def __init__(
        self,
        twin: Twin | None,
        expected: Run | None,
        planned: Planned | None,
        scans: Scans | None,
        *,
        file: Path | None = None,
        address: str | None = None,
        said: Path | None = None,
    ) -> None:
        self._twin, self._expected, self._planned, self._scans = twin, expected, planned, scans
        self._file, self._address, self._said = file, address, said or Path(str(address))
        self._stack = ExitStack()
        self._recording: Recording | None = None
        self.rows = 0

    def append(self, run: Run) -> None:
        if self._recording is None:
            self._recording = self._begun(run)
        if self._file is not None:
            size = size_of(run, self._scans)
            check_room(self._file, self._file.stat().st_size + size + ROOM, self._said)
        try:
            self._recording.append(run)
            self._recording.rec.flush(timeout_sec=10.0)
        except RuntimeError as error:
            raise InputError(f"{self._said}: cannot be written ({error}); is the disk full?") from error
        self.rows += run.rows

    def close(self) -> int:
        """Complete it; gives the rows that it has."""
        if self._recording is not None:
            self._recording.close()
        self._stack.close()
        return self.rows

    def abort(self) -> None:
        with suppress(InputError):
            self._stack.close()

    def _begun(self, run: Run) -> Recording:
        twin, known = self._twin, self._expected or run
        lab, heading = (None, 0.0) if twin is None else (twin.scene.lab, heading_of(twin.field, known))
        events = None if self._expected else list(STATES)
        views = layout(known, lab, heading=heading, events=events, whole=self._expected is not None)
        interior = None if twin is None else Interior.of(twin)
        rec = self._stack.enter_context(
            stream(
                uuid.uuid4().hex,
                title_of(run) or "live run",
                views,
                file=self._file,
                address=self._address,
                said=self._said,
                room=ROOM + (interior.size if interior else 0),
            )
        )
        send_properties(rec, run.metadata)
        rec.log("metadata", metadata_page(run.metadata), static=True)
        robot = None
        if interior is not None:
            rate = run.metadata.get("rate_hz", 0.0)
            room = Room.enter(rec, interior, known, planned=self._planned)
            robot = room.robot(rate if isinstance(rate, float) else 0.0)
        return Recording(rec, robot=robot, scans=self._scans)


def check_listens(address: str) -> None:
    """Refuse an address at which no viewer listens: Rerun itself would wait for one.

    Raises:
        InputError: It is no address of a viewer, or nothing is there.
    """
    parts = urlsplit(address)
    try:
        if not parts.scheme.startswith("rerun") or not parts.hostname or not parts.port:
            raise InputError(f"{address}: no address of a viewer; give one as rerun+http://HOST:PORT/proxy")
        socket.create_connection((parts.hostname, parts.port), timeout=5).close()
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no viewer listens there ({error}); start one with: rerun") from error


@contextmanager
def live_view(scene: Scene, scene_file: Path) -> Iterator[Show]:
    """The lab and the robot in a window, which is closed with the block.

    Raises:
        InputError: No window can be opened here.
    """
    with live_viewer() as (address, _), streamed(scene, scene_file, address) as show:
        yield show


@contextmanager
def streamed(scene: Scene, scene_file: Path, address: str) -> Iterator[Show]:
    """The same into a viewer that listens at an address."""
    rec = rr.RecordingStream(APPLICATION, send_properties=False)
    position, target = lab_eye(scene.lab)
    lab = rrb.Spatial3DView(
        origin="world",
        name="Lab, driven by hand",
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1)),
    )
    rec.connect_grpc(address, default_blueprint=rrb.Blueprint(lab, collapse_panels=True))
    rec.send_recording_name("manual drive")
    stage = open_alone(scene_file, scene.robot.name)
    shapes, links = read_shapes(stage), read_links(stage)
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    still = [shape for shape in shapes if not shape.link and shape.prim != str(HEAT_MAP)]
    for n, shape in enumerate(still):
        rec.log(f"world/lab/{n}", mesh_of([shape]), static=True)
    for name, link in links.items():
        carried = [shape for shape in shapes if shape.link == name]
        if carried:
            rec.log(f"world/robot/{name}", mesh_of(carried), static=True)
            placed = rr.Transform3D(
                translation=link.p_base_link, quaternion=rr.Quaternion(xyzw=link.q_base_link_xyzw)
            )
            rec.log(f"world/robot/{name}", placed, static=True)
    trail: list[tuple[float, float, float]] = []

    def show(t: float, pose: tuple[float, float, float]) -> None:
        x, y, yaw = pose
        rec.set_time(TIMELINE, duration=t)
        turn = rr.Quaternion(xyzw=[0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
        rec.log("world/robot", rr.Transform3D(translation=[x, y, scene.robot.base_height_m], quaternion=turn))
        if not trail or math.dist(trail[-1][:2], (x, y)) > TRAIL_M:
            trail.append((x, y, 0.012))
            rec.log("world/driven", rr.LineStrips3D([trail], colors=(255, 160, 0), radii=0.008))

    try:
        yield show
    finally:
        rec.flush()
        rec.disconnect()
