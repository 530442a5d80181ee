"""Live: a robot that is being driven, in the Rerun viewer while it goes on."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from magtwin.io.layout import lab_eye
from magtwin.io.recording import APPLICATION
from magtwin.io.series import TIMELINE
from magtwin.io.viewer import live_viewer
from magtwin.io.world import mesh_of
from magtwin.spec import Scene
from magtwin.usd.geometry import open_stage, read_links, read_shapes
from magtwin.usd.maps import HEAT_MAP

Show = Callable[[float, tuple[float, float, float]], None]
"""Takes the time [s] and x [m], y [m], yaw [rad] of base_link."""

TRAIL_M = 0.02
"""Way between the points of the line that a robot draws on the floor [m]."""


@contextmanager
def live_view(scene: Scene, scene_file: Path) -> Iterator[Show]:
    """The lab and the robot in a window, which is closed with the block.

    Raises:
        RefusedError: No window can be opened here.
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
    stage = open_stage(scene_file)
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
