"""Live: runs in a Rerun viewer in step with the clock, and drives by hand."""

import socket
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import rerun as rr

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.io.rerun.layout import drive_layout
from magtwin.io.rerun.recording import APPLICATION, flush, recording_of, title_of
from magtwin.io.rerun.viewer import live_viewer
from magtwin.io.rerun.world import POSE_HZ, Interior, Robot, send_still
from magtwin.path import Path as Planned
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import Twin

TICK_S = 0.05  # Time between blocks of a run that is shown in step with the clock [s]
Show = Callable[[float, tuple[float, float, float]], None]  # Takes t [s] and x, y [m], yaw [rad]


def play(
    run: Run,
    twin: Twin,
    address: str,
    *,
    planned: Planned | None = None,
    scans: Scans | None = None,
    pace: float = 1.0,
    progress: Callable[[float, float, str], Any] = lambda done, total, what: None,
) -> None:
    """Show a run in step with the clock, in the layout of `write_rrd`.

    `address` is that of a Rerun viewer, such as rerun+http://127.0.0.1:9876/proxy; none there is refused.
    `pace` is simulated seconds per second; `progress` is called with seconds done, seconds in all and a word.
    """
    check_listens(address)
    t, rate_hz = run["t"], (run.rows - 1) / run.duration_s if run.duration_s else 0.0
    shown: dict[str, Any] = {"planned": planned, "scans": scans, "address": address, "final": Path(address)}
    title = title_of(run) or "live run"
    with recording_of(run, uuid.uuid4().hex, title, twin, rate_hz=rate_hz, **shown) as recording:
        begun, sent = time.monotonic(), 0
        while sent < run.rows:
            end = int(np.searchsorted(t, t[0] + (time.monotonic() - begun) * pace, side="right"))
            if end > sent:
                recording.append(run.take(slice(sent, end)))
                flush(recording.rec, None)
                progress(round(float(t[end - 1])), round(float(t[-1])), "Ctrl-C ends it")
                sent = end
            time.sleep(TICK_S)
        recording.close()


def check_listens(address: str) -> None:
    """Refuse an address at which no viewer listens: Rerun itself would wait for one."""
    parts = urlsplit(address)
    try:
        if not parts.scheme.startswith("rerun") or not parts.hostname or not parts.port:
            raise InputError(f"{address}: no address of a viewer; give one as rerun+http://HOST:PORT/proxy")
        socket.create_connection((parts.hostname, parts.port), timeout=5).close()
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no viewer listens there ({error}); start one with: rerun") from error


@contextmanager
def live_view(twin: Twin) -> Iterator[Show]:
    """The lab and the robot in a window, which is closed with the block."""
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
