"""Recording: a Run as a Rerun file with a ready layout, the lab and the robot in 3D beside its series."""

import hashlib
import json
import math
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from magtwin.field.map import AnomalyMap
from magtwin.files import existing, output
from magtwin.frames import quat_multiply, rotate, wrap_angle
from magtwin.io.layout import PANELS, STATES, TIMELINE, known_series, layout
from magtwin.io.tables import read_parquet
from magtwin.io.viewer import show
from magtwin.names import RefusedError, find
from magtwin.path import Path
from magtwin.run import Run
from magtwin.sim.lidar import Scans
from magtwin.spec import RobotSpec, Scene
from magtwin.usd.geometry import BASE_LINK, Link, Shape, open_stage, read_links, read_shapes, srgb_from_linear
from magtwin.usd.maps import HEAT_MAP, HEAT_MAP_HEIGHT_M

Array = NDArray[np.float64]

APPLICATION = "magtwin"
BLOCK = 8192
"""Rows sent in one chunk: few enough for the viewer to skip what it does not show."""

SCAN = "world/scan"
"""Entity of what the LiDAR sees."""

SCANS = 64
"""Scans sent in one chunk."""

POSE_HZ = 50.0
"""Poses a second, at most: above this no eye sees a difference."""

DOT_HZ = 10.0
"""Readings a second that are drawn along the path."""

SCALE_HEIGHT_M = 1.0
"""Height of the colour bar: above desks and chairs, which would hide it on the floor."""

ARROW_M_PER_NT = 1.4e-5
"""Length of the field's arrow: 70 cm for 50 uT."""


def write_rrd(
    run: Run,
    path: str | os.PathLike[str],
    *,
    scene: Scene,
    scene_file: FilePath,
    field: AnomalyMap,
    planned: Path | None,
    scans: Scans | None = None,
    force: bool = False,
) -> None:
    """Write a run as a Rerun recording that opens in a ready layout.

    Series are at full rate, poses at `POSE_HZ` or less, on the timeline `sim_time`. The recording's id
    comes from the run's content, so two files of one run hold the same recording; only what Rerun stamps
    itself varies between them (ids of chunks, rows and views), which `rerun rrd compare --unordered`
    does not look at.

    Args:
        run: What happened.
        path: The .rrd file to make.
        scene: What it happened in.
        scene_file: The composed stage of the scene, whose shapes are shown.
        field: The map that was driven over, drawn on the floor.
        planned: The path that was to be driven; none where there was none.
        scans: What the LiDAR saw, drawn as points in world; none draws none.
        force: Whether a file that exists is replaced.

    Raises:
        RefusedError: The file exists and `force` was not given, the stage cannot be read, or the run
            has no rows.
    """
    _check_rows(run, path)
    heading = _nearest_heading(field, run)
    with _recording(run, path, layout(run, scene.lab, heading=heading), force=force) as rec:
        stage = open_stage(scene_file)
        scale = _Scale.over(field, run)
        _log_map(rec, field, scale, heading)
        _log_scale(rec, field, scale)
        _log_bodies(rec, run, scene, read_shapes(stage), read_links(stage))
        _log_paths(rec, run, scene, scale, planned)
        _log_series(rec, run)
        if scans is not None and len(scans.t):
            _log_scans(rec, scans)


def view(path: str | os.PathLike[str]) -> None:
    """Show a recording in the Rerun viewer, and return when it is closed.

    Args:
        path: A .rrd file, or the Parquet file of a run, whose series are then shown.

    Raises:
        RefusedError: The file is missing, is of another kind, or the viewer cannot run here.
    """
    path = existing(path, "recording")
    if path.suffix == ".rrd":
        show(path)
        return
    find("kind of recording", path.suffix, {".rrd": None, ".parquet": None})
    run = read_parquet(path)
    _check_rows(run, path)
    if not any(known_series(run, panel) for panel in PANELS):
        plotted = ", ".join(series.column for panel in PANELS for series in panel.series)
        raise RefusedError(f"{path}: holds none of the columns that are plotted: {plotted}")
    with tempfile.TemporaryDirectory() as folder:
        rrd = FilePath(folder) / f"{path.stem}.rrd"
        with _recording(run, rrd, layout(run)) as rec:
            _log_series(rec, run)
        show(rrd, shown=path)


def _check_rows(run: Run, path: str | os.PathLike[str]) -> None:
    if not run.rows:
        raise RefusedError(f"{path}: the run has no rows, there is nothing to record")


@contextmanager
def _recording(
    run: Run, path: str | os.PathLike[str], views: rrb.Blueprint, *, force: bool = False
) -> Iterator[rr.RecordingStream]:
    """A stream into a file beside `path`, with the facts of the run in it; whole at the end, or not there."""
    strict = rr.strict_mode()
    with output(path, force=force) as aside:
        rec = rr.RecordingStream(APPLICATION, recording_id=_content_id(run), send_properties=False)
        if not rr.is_enabled(rec):
            raise RefusedError(f"{path}: Rerun is switched off by the environment variable RERUN; unset it")
        rr.set_strict_mode(True)
        try:
            rec.save(aside, default_blueprint=views)
            rec.send_recording_name(_name(run) or FilePath(path).stem)
            facts: dict[str, Any] = {key: [value] for key, value in run.facts.items()}
            if facts:
                rec.send_property("run", rr.AnyValues(**facts))
            rec.log("facts", rr.TextDocument(_facts(run), media_type=rr.MediaType.MARKDOWN), static=True)
            yield rec
        finally:
            rr.set_strict_mode(strict)
            rec.flush()
            rec.disconnect()


def _name(run: Run) -> str:
    """What the viewer calls the recording: path and seed."""
    return ", ".join(f"{key} {run.facts[key]}" for key in ("path", "seed") if key in run.facts)


def _content_id(run: Run) -> str:
    """An id that the same run always gets, and no other."""
    digest = hashlib.sha256(json.dumps(dict(run.facts), sort_keys=True).encode())
    for name, values in run.items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()[:32]


def _facts(run: Run) -> str:
    """The facts of a run as a Markdown table."""
    said = {"readings": f"{run.rows:,} in {run.duration_s:.1f} s", **run.facts}
    cells = [(key, str(value).replace("|", r"\|")) for key, value in said.items()]
    return "\n".join(["| fact | value |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)])


@dataclass(frozen=True)
class _Scale:
    """The colours of field magnitudes: viridis between two values."""

    low_nt: float
    high_nt: float
    table: NDArray[np.uint8]
    """Red, green, blue, opacity in sRGB, shape (256, 4)."""

    @classmethod
    def over(cls, field: AnomalyMap, run: Run) -> "_Scale":
        """The scale that map and readings share: whole uT, the outermost 1 % of either left to saturate."""
        from matplotlib import colormaps

        table = (colormaps["viridis"](np.arange(256)) * 255).round().astype(np.uint8)
        readings = run["b_total_nt"][np.isfinite(run["b_total_nt"])]
        ends = [np.percentile(v, [1, 99]) for v in (field.values_nt[field.valid], readings) if v.size]
        low, high = np.floor(np.min(ends or 0) / 1000) * 1000, np.ceil(np.max(ends or 0) / 1000) * 1000
        return cls(float(low), float(max(high, low + 1000)), table)

    def colours(self, b_nt: Array) -> NDArray[np.uint8]:
        """Colours of field magnitudes [nT], shape (...) -> (..., 4); see-through where nan."""
        share = (np.clip(b_nt, self.low_nt, self.high_nt) - self.low_nt) / (self.high_nt - self.low_nt)
        known = np.isfinite(share)
        out = self.table[np.where(known, share * 255, 0).round().astype(np.uint8)]
        out[~known] = 0
        return out


def _log_map(rec: rr.RecordingStream, field: AnomalyMap, scale: _Scale, heading: float) -> None:
    """The floor in the colours of the map at a heading [rad], linear between nodes."""
    x0, x1, y0, y1 = field.extent
    cell = max(0.02, (x1 - x0) / 1024, (y1 - y0) / 1024)
    width, height = (max(1, round((b - a) / cell)) for a, b in ((x0, x1), (y0, y1)))
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height  # images begin at the top
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = scale.colours(field.lookup(grid, heading))
    _log_image(rec, "world/map", pixels, cell, (x0, y0, HEAT_MAP_HEIGHT_M), opacity=0.75)


def _nearest_heading(field: AnomalyMap, run: Run) -> float:
    """The heading of the map's layer that is nearest to the run's first one [rad]."""
    away = np.abs(wrap_angle(field.headings_rad - run["yaw"][0]))
    return float(field.headings_rad[np.argmin(away)])


def _log_scale(rec: rr.RecordingStream, field: AnomalyMap, scale: _Scale) -> None:
    """A colour bar with its values, in front of the map and above what stands there."""
    x0, x1, y0, _ = field.extent
    length, breadth = 0.6 * (x1 - x0), 0.03 * (x1 - x0)
    cell = length / 256
    corner = ((x0 + x1 - length) / 2, y0 - 0.3 - breadth, SCALE_HEIGHT_M)
    bar = np.broadcast_to(scale.table, (max(1, round(breadth / cell)), 256, 4))
    _log_image(rec, "world/scale", bar, cell, corner)
    share = np.linspace(0, 1, 5)
    at = np.column_stack([corner[0] + share * length, np.full(5, corner[1] - 0.08), np.full(5, corner[2])])
    value_ut = (scale.low_nt + share * (scale.high_nt - scale.low_nt)) / 1000
    rec.log(
        "world/scale/values",
        rr.Points3D(
            at,
            labels=[f"{v:g} µT" for v in value_ut],
            radii=0.0,
            colors=(255, 255, 255),
            show_labels=True,
        ),
        static=True,
    )


def _log_image(
    rec: rr.RecordingStream,
    entity: str,
    rgba: NDArray[np.uint8],
    cell: float,
    corner: tuple[float, float, float],
    *,
    opacity: float = 1.0,
) -> None:
    """An image lying level, its lower left corner at `corner` in world [m], `cell` [m] a pixel."""
    height, width = rgba.shape[:2]
    rec.log(
        entity,
        rr.GridMap(
            data=np.ascontiguousarray(rgba).tobytes(),
            format=rr.components.ImageFormat(
                width=width, height=height, color_model="RGBA", channel_datatype="U8"
            ),
            cell_size=cell,
            translation=corner,
            opacity=opacity,
        ),
        static=True,
    )


def _log_bodies(
    rec: rr.RecordingStream, run: Run, scene: Scene, shapes: Sequence[Shape], links: dict[str, Link]
) -> None:
    """What stands still, and the robot: one entity a link, the base posed by the run, its wheels turning."""
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in shapes:
        if not shape.link and shape.prim != str(HEAT_MAP):  # the map is drawn finer, see _log_map
            rec.log(f"world/lab/{_entity(shape.prim)}", mesh_of([shape]), static=True)
    rows = _thinned(run, POSE_HZ)
    _send(
        rec,
        "world/robot",
        run["t"][rows],
        rr.Transform3D,
        translation=run["p_world_base"][rows].astype(np.float32),
        quaternion=run["q_world_base_xyzw"][rows].astype(np.float32),
    )
    drive = scene.robot.drive
    wheels = {drive.left_wheel_joint: 0, drive.right_wheel_joint: 1}
    base = BASE_LINK if BASE_LINK in links else next((n for n, link in links.items() if not link.joint), "")
    for name, link in links.items():
        carried = [shape for shape in shapes if shape.link == name]
        if not (carried or link.joint in wheels):
            continue
        if not link.joint and name != base:  # a body of its own that nothing moves
            entity, p, q = f"world/lab/{_entity(name)}", link.p_world_link, link.q_world_link_xyzw
        else:
            entity, p, q = f"world/robot/{_entity(name)}", link.p_base_link, link.q_base_link_xyzw
        if carried:
            rec.log(entity, mesh_of(carried), static=True)
        if link.joint in wheels and link.axis_link is not None:
            half = run["wheel_angle"][rows, wheels[link.joint]][:, None] / 2
            turn = np.hstack([np.sin(half) * link.axis_link, np.cos(half)])
            turned = quat_multiply(q, turn).astype(np.float32)
            at = np.broadcast_to(np.asarray(p, np.float32), (len(turned), 3))
            _send(rec, entity, run["t"][rows], rr.Transform3D, translation=at, quaternion=turned)
        else:
            rec.log(entity, rr.Transform3D(translation=p, quaternion=rr.Quaternion(xyzw=q)), static=True)
    if np.isfinite(run["b_vector_nt"]).any():
        _log_vector(rec, run, scene.robot, rows)


def _log_vector(rec: rr.RecordingStream, run: Run, robot: RobotSpec, rows: NDArray[np.intp]) -> None:
    """The field vector through the magnetometer, in its axes, where it is known.

    The sensor is at the middle of the arrow: whichever way the field dips, half of it is not in the robot.
    It is placed in the robot's axes, as the link that carries it may be a mere frame that shows nothing.
    """
    entity = "world/robot/magnetometer"
    rec.log(
        entity,
        rr.Transform3D(
            translation=robot.p_base_magnetometer,
            quaternion=rr.Quaternion(xyzw=robot.q_base_magnetometer_xyzw),
        ),
        static=True,
    )
    rows = rows[np.isfinite(run["b_vector_nt"][rows]).all(axis=1)]
    arrows = (run["b_vector_nt"][rows] * ARROW_M_PER_NT).astype(np.float32)
    rec.log(f"{entity}/field", rr.Arrows3D.from_fields(colors=[(255, 255, 255)], radii=[0.006]), static=True)
    _send(rec, f"{entity}/field", run["t"][rows], rr.Arrows3D, vectors=arrows, origins=-arrows / 2)


def _log_paths(rec: rr.RecordingStream, run: Run, scene: Scene, scale: _Scale, planned: Path | None) -> None:
    """The path planned and the path driven on the floor, the readings above it where they were taken."""
    if planned is not None:
        plan = np.column_stack([planned.p_xy, np.full(len(planned.p_xy), 0.012)])
        rec.log("world/planned", rr.LineStrips3D([plan], colors=(255, 255, 255), radii=0.008), static=True)
    rows = _thinned(run, DOT_HZ)
    base, q = run["p_world_base"][rows], run["q_world_base_xyzw"][rows]
    driven = np.column_stack([base[:, :2], np.full(len(base), 0.016)])  # as seen from above, over the plan
    rec.log("world/driven", rr.LineStrips3D([driven], colors=(230, 60, 60), radii=0.006), static=True)
    sensor = (base + rotate(q, scene.robot.p_base_magnetometer)).astype(np.float32)
    rec.log("world/readings", rr.Points3D.from_fields(radii=[0.017]), static=True)
    colours = scale.colours(run["b_total_nt"][rows])
    packed = colours.astype(np.uint32) @ np.array([1 << 24, 1 << 16, 1 << 8, 1], np.uint32)
    _send(rec, "world/readings", run["t"][rows], rr.Points3D, positions=sensor, colors=packed)


def _log_scans(rec: rr.RecordingStream, scans: Scans) -> None:
    """What each scan hit, at its moment, until the next; cleared when the LiDAR stops."""
    rec.log(SCAN, rr.Points3D.from_fields(radii=[0.012], colors=[(255, 90, 90)]), static=True)
    points = scans.points_world()
    turn = float(np.diff(scans.t).min(initial=1.0))
    last = np.append(np.diff(scans.t) > 1.5 * turn, True)
    t = np.concatenate([scans.t, scans.t[last] + turn])
    order = np.argsort(t, kind="stable")
    points += [np.empty((0, 3))] * int(last.sum())
    for start in range(0, len(t), SCANS):
        rows = order[start : start + SCANS]
        part = [points[row] for row in rows]
        times = np.rint(t[rows] * 1e9).astype("timedelta64[ns]")
        columns = rr.Points3D.columns(positions=np.concatenate(part).astype(np.float32))
        rec.send_columns(
            SCAN, [rr.TimeColumn(TIMELINE, duration=times)], columns.partition([len(p) for p in part])
        )


def _log_series(rec: rr.RecordingStream, run: Run) -> None:
    """Every plot's series at full rate, and the flags where they change."""
    for panel in PANELS:
        series = known_series(run, panel)
        if not series:
            continue
        style = rr.SeriesLines(
            names=[s.name for s in series],
            colors=[s.colour for s in series],
            widths=[s.width for s in series],
        )
        rec.log(panel.entity, style, static=True)
        values = np.column_stack([run[s.column].reshape(run.rows, -1)[:, s.part] for s in series])
        _send(rec, panel.entity, run["t"], rr.Scalars, scalars=values)
    for column, (name, *words) in STATES.items():
        if column not in run.columns:
            continue
        entity, flag = f"states/{name}", run[column]
        rows = np.flatnonzero(np.append(True, flag[1:] != flag[:-1]))
        rec.log(
            entity, rr.StateConfiguration(values=words, colors=[(70, 70, 76), (255, 158, 64)]), static=True
        )
        state = np.where(flag[rows], words[1], words[0]).tolist()
        _send(rec, entity, run["t"][rows], rr.StateChange, state=state)


def _send(rec: rr.RecordingStream, entity: str, t: Array, archetype: Any, **values: Any) -> None:
    """Columns of an archetype at times t [s], in blocks."""
    times = np.rint(t * 1e9).astype("timedelta64[ns]")
    for start in range(0, len(t), BLOCK):
        part = slice(start, start + BLOCK)
        columns = archetype.columns(**{key: array[part] for key, array in values.items()})
        rec.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=times[part])], columns)


def _thinned(run: Run, rate_hz: float) -> NDArray[np.intp]:
    """Rows at `rate_hz` or less, evenly spaced, and the last one."""
    rate = (run.rows - 1) / run.duration_s if run.duration_s else 0.0
    stride = max(1, math.ceil(rate / rate_hz - 1e-6))
    return np.unique(np.append(np.arange(0, run.rows, stride), run.rows - 1))


def mesh_of(shapes: Sequence[Shape]) -> rr.Mesh3D:
    """Shapes as one mesh, flat triangles in the colours of their materials."""
    corners = np.concatenate([shape.vertices[shape.faces] for shape in shapes])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    colours = np.concatenate([_colours(shape) for shape in shapes])
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        vertex_colors=colours,
    )


def _colours(shape: Shape) -> NDArray[np.uint8]:
    """Colour (sRGB) and opacity of each corner of a shape's triangles, shape (3 F, 4)."""
    rgba = np.empty((3 * len(shape.faces), 4))
    own = shape.colour[:3] if shape.vertex_colours is None else shape.vertex_colours[shape.faces.ravel()]
    rgba[:, :3], rgba[:, 3] = srgb_from_linear(own), shape.colour[3]
    return (rgba * 255).round().astype(np.uint8)


def _entity(name: str) -> str:
    """A prim's name or path as an entity path: only letters, digits, _ and - need no escape there."""
    return re.sub(r"[^\w/-]", "_", name, flags=re.ASCII).strip("/")
