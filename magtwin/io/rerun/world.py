"""World: the lab, the robots and where they drove, in 3D and from above, in a Rerun recording."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from magtwin.author.scene import open_alone
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_multiply, rotate, wrap_angle
from magtwin.io.rerun.layout import Colour
from magtwin.io.rerun.series import TIMELINE, entity_of, nanoseconds, send
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.spec.robot import RobotSpec
from magtwin.twin import Twin
from magtwin.usd.geometry import BASE_LINK, Link, Shape, read_links, read_shapes, srgb_from_linear
from magtwin.usd.maps import HEAT_MAP, HEAT_MAP_HEIGHT_M

Array = NDArray[np.float64]

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

DRIVEN: Colour = (230, 60, 60)
"""Colour of the path that was driven."""


@dataclass(frozen=True)
class Scale:
    """The colours of field magnitudes: viridis between two values."""

    low_nt: float
    high_nt: float
    table: NDArray[np.uint8]
    """Red, green, blue, opacity in sRGB, shape (256, 4)."""

    @classmethod
    def over(cls, field: AnomalyMap, readings_nt: Array) -> "Scale":
        """The scale that map and readings share: whole uT, the outermost 1 % of either left to saturate."""
        from matplotlib import colormaps

        table = (colormaps["viridis"](np.arange(256)) * 255).round().astype(np.uint8)
        known = readings_nt[np.isfinite(readings_nt)]
        known = known[:: max(1, len(known) // 10_000)]  # a per cent of so many is as good
        ends = [np.percentile(v, [1, 99]) for v in (field.values_nt[field.valid], known) if v.size]
        low, high = np.floor(np.min(ends or 0) / 1000) * 1000, np.ceil(np.max(ends or 0) / 1000) * 1000
        return cls(float(low), float(max(high, low + 1000)), table)

    def colours(self, b_nt: Array) -> NDArray[np.uint8]:
        """Colours of field magnitudes [nT], shape (...) -> (..., 4); see-through where nan."""
        share = (np.clip(b_nt, self.low_nt, self.high_nt) - self.low_nt) / (self.high_nt - self.low_nt)
        known = np.isfinite(share)
        out = self.table[np.where(known, share * 255, 0).round().astype(np.uint8)]
        out[~known] = 0
        return out


def heading_of(field: AnomalyMap, run: Run) -> float:
    """The heading of the map's layer that is nearest to the run's first one [rad]."""
    if not run.rows or "yaw" not in run.columns:
        return float(field.headings_rad[0])
    away = np.abs(wrap_angle(field.headings_rad - run["yaw"][0]))
    return float(field.headings_rad[np.argmin(away)])


@dataclass(frozen=True)
class Interior:
    """What a twin's stage shows, read and not yet sent."""

    twin: Twin
    shapes: Sequence[Shape]
    links: dict[str, Link]

    @classmethod
    def of(cls, twin: Twin) -> "Interior":
        """Read it.

        Raises:
            InputError: The stage cannot be read.
        """
        stage = open_alone(twin.scene_file, twin.scene.robot.name)  # of the others nothing is known here
        return cls(twin, list(read_shapes(stage)), read_links(stage))

    @property
    def size(self) -> int:
        """Bytes that it takes in a recording, or more: corners, normals and colours; the map twice."""
        corners = 3 * sum(len(shape.faces) for shape in self.shapes)
        _, width, height = _pixels(self.twin.field)
        return 28 * corners + 8 * width * height


@dataclass(frozen=True)
class Room:
    """A twin's lab in a recording, in which robots can be set down."""

    rec: rr.RecordingStream
    spec: RobotSpec
    shapes: Sequence[Shape]
    links: dict[str, Link]
    scale: Scale

    @classmethod
    def enter(
        cls,
        rec: rr.RecordingStream,
        interior: Interior,
        known: Run,
        *,
        planned: Path | None = None,
    ) -> "Room":
        """Send what stands still: the map on the floor, its legend, walls and furniture.

        Args:
            rec: Where to.
            interior: What is there.
            known: What is known of the run: readings for the scale of colours, and its first heading.
            planned: The path that is to be driven.
        """
        twin = interior.twin
        scale = Scale.over(twin.field, known.get("b_total_nt", np.empty(0)))
        rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _send_map(rec, twin.field, scale, heading_of(twin.field, known))
        _send_scale(rec, twin.field, scale)
        for prim, things in _things(interior.shapes).items():
            rec.log(f"world/lab/{_entity(prim)}", mesh_of(things), static=True)
        if planned is not None:
            _send_planned(rec, planned)
        return cls(rec, twin.scene.robot, interior.shapes, interior.links, scale)

    def robot(self, rate_hz: float = 0.0) -> "Robot":
        """The robot of a run that is alone, its readings in the colours of the map."""
        return Robot(self.rec, self.spec, self.shapes, self.links, self.scale, rate_hz=rate_hz)

    def one_of_several(self, name: str, colour: Colour, offset_s: float) -> "Robot":
        """The robot of one of several runs, its path in a colour of its own."""
        return Robot(
            self.rec, self.spec, self.shapes, self.links, None, name=name, colour=colour, offset_s=offset_s
        )


def _send_planned(rec: rr.RecordingStream, planned: Path) -> None:
    """The path that is to be driven, on the floor."""
    strip = np.column_stack([planned.p_xy, np.full(len(planned.p_xy), 0.012)])
    rec.log("world/planned", rr.LineStrips3D([strip], colors=(255, 255, 255), radii=0.008), static=True)
    flat = rr.LineStrips2D([planned.p_xy], colors=(255, 255, 255), radii=0.01, draw_order=1.0)
    rec.log("floor/paths/planned", flat, static=True)


def _send_map(rec: rr.RecordingStream, field: AnomalyMap, scale: Scale, heading: float) -> None:
    """The floor in the colours of the map at a heading [rad], linear between nodes."""
    x0, x1, y0, y1 = field.extent
    cell, width, height = _pixels(field)
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height  # images begin at the top
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = scale.colours(field.lookup(grid, heading))
    _send_image(rec, "world/map", pixels, cell, (x0, y0, HEAT_MAP_HEIGHT_M), opacity=0.75)
    place = rr.Transform3D(translation=(x0, -y1, 0), scale=((x1 - x0) / width, (y1 - y0) / height, 1))
    rec.log("floor/map", place, static=True)
    rec.log("floor/map", rr.Image(pixels, draw_order=-1.0), static=True)
    upwards = rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # pictures have y downwards
    rec.log("floor/paths", upwards, static=True)


def _pixels(field: AnomalyMap) -> tuple[float, int, int]:
    """Side of a pixel of the floor [m], and how many there are along x and y."""
    x0, x1, y0, y1 = field.extent
    cell = max(0.02, (x1 - x0) / 1024, (y1 - y0) / 1024)
    width, height = (max(1, round((b - a) / cell)) for a, b in ((x0, x1), (y0, y1)))
    return cell, width, height


def _send_scale(rec: rr.RecordingStream, field: AnomalyMap, scale: Scale) -> None:
    """A colour bar with its values, in front of the map and above what stands there."""
    x0, x1, y0, _ = field.extent
    length, breadth = 0.6 * (x1 - x0), 0.03 * (x1 - x0)
    cell = length / 256
    corner = ((x0 + x1 - length) / 2, y0 - 0.3 - breadth, SCALE_HEIGHT_M)
    bar = np.broadcast_to(scale.table, (max(1, round(breadth / cell)), 256, 4))
    _send_image(rec, "world/scale", bar, cell, corner)
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


def _send_image(
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


class Feed:
    """What the LiDAR saw, sent as its time comes: each scan until the next, cleared when the LiDAR stops."""

    def __init__(self, rec: rr.RecordingStream, scans: Scans) -> None:
        self._rec, self._points = rec, scans.points_world()
        self._turn = turn = float(np.diff(scans.t).min(initial=1.0))
        last = np.append(np.diff(scans.t) > 1.5 * turn, True)[: len(scans.t)]
        t = np.concatenate([scans.t, scans.t[last] + turn])
        self._order = np.argsort(t, kind="stable")
        self._t = t[self._order]
        self._points += [np.empty((0, 3))] * int(last.sum())
        self._sent = 0
        rec.log(SCAN, rr.Points3D.from_fields(radii=[0.012], colors=[(255, 90, 90)]), static=True)

    def send_until(self, t: float) -> None:
        """All that there is up to a time [s] and was not sent yet."""
        end = int(np.searchsorted(self._t, t, side="right"))
        for start in range(self._sent, end, SCANS):
            rows = slice(start, min(end, start + SCANS))
            part = [self._points[k] for k in self._order[rows]]
            columns = rr.Points3D.columns(positions=np.concatenate(part).astype(np.float32))
            self._rec.send_columns(
                SCAN,
                [rr.TimeColumn(TIMELINE, duration=nanoseconds(self._t[rows]))],
                columns.partition([len(p) for p in part]),
            )
        self._sent = max(self._sent, end)

    def clear(self, t: float) -> None:
        """Take the last scan away, after its turn or at time t [s], whichever is later: the run has ended."""
        if self._sent and len(self._points[self._order[self._sent - 1]]):
            end = max(t, float(self._t[self._sent - 1]) + self._turn)
            self._rec.set_time(TIMELINE, duration=np.timedelta64(round(end * 1e9), "ns"))
            self._rec.log(SCAN, rr.Points3D(np.empty((0, 3))))
            self._rec.reset_time()


@dataclass
class Robot:
    """A robot that drives through a recording: its body, its sensors, and what it leaves behind."""

    rec: rr.RecordingStream
    spec: RobotSpec
    shapes: Sequence[Shape]
    links: dict[str, Link]
    scale: Scale | None
    """Colours of the readings along its path; none draws only the path."""
    name: str = ""
    offset_s: float = 0.0
    colour: Colour = DRIVEN
    """Colour of its path."""
    rate_hz: float = 0.0
    """Rows a second; 0 takes that of the first ones."""

    _rows: int = 0
    _strides: tuple[int, int] | None = None
    _last: Run | None = None
    _wheels: list[tuple[str, int, Any, Any, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rec, root = self.rec, entity_of("world/robot", self.name)
        drive = self.spec.drive
        sides = {drive.left_wheel_joint: 0, drive.right_wheel_joint: 1}
        links = self.links
        base = (
            BASE_LINK if BASE_LINK in links else next((n for n, link in links.items() if not link.joint), "")
        )
        for name, link in links.items():
            carried = [shape for shape in self.shapes if shape.link == name]
            if not (carried or link.joint in sides):
                continue
            if not link.joint and name != base:  # a body of its own that nothing moves
                entity, p, q = f"world/lab/{_entity(name)}", link.p_world_link, link.q_world_link_xyzw
            else:
                entity, p, q = f"{root}/{_entity(name)}", link.p_base_link, link.q_base_link_xyzw
            if carried:
                rec.log(entity, mesh_of(carried), static=True)
            if link.joint in sides and link.axis_link is not None:
                self._wheels.append((entity, sides[link.joint], p, q, link.axis_link))
            else:
                rec.log(entity, rr.Transform3D(translation=p, quaternion=rr.Quaternion(xyzw=q)), static=True)
        if self.name:
            label = rr.Points3D([[0, 0, 0.5]], labels=[self.name], radii=0.0, colors=self.colour)
            rec.log(f"{root}/name", label, static=True)
        else:
            self._send_sensors(root)

    def _send_sensors(self, root: str) -> None:
        """The axes of each sensor, forward red, left green, up blue, with its name."""
        spec = self.spec
        for name, p, q in (
            ("magnetometer", spec.p_base_magnetometer, spec.q_base_magnetometer_xyzw),
            ("LiDAR", spec.p_base_lidar, spec.q_base_lidar_xyzw),
            ("IMU", (0.0, 0.0, 0.0), spec.q_base_imu_xyzw),
        ):
            entity = f"{root}/sensors/{name}"
            self.rec.log(entity, rr.Transform3D(translation=p, quaternion=rr.Quaternion(xyzw=q)), static=True)
            self.rec.log(entity, rr.TransformAxes3D(0.07), static=True)
            label = rr.Points3D([[0, 0, 0]], labels=[name], radii=0.005, colors=(255, 255, 255))
            self.rec.log(f"{entity}/name", label, static=True)

    def append(self, run: Run) -> None:
        """The next rows of what it did."""
        if self._strides is None:
            rate = self.rate_hz or ((run.rows - 1) / run.duration_s if run.duration_s else 0.0)
            self._strides = _stride(rate, POSE_HZ), _stride(rate, DOT_HZ)
            if self.scale is not None and np.isfinite(run.get("b_vector_nt", np.nan)).any():
                self._send_vector_style()
        first, poses, dots = self._rows, *self._strides
        self._rows += run.rows
        self._pose(run, np.arange(-first % poses, run.rows, poses))
        self._trail(run, np.arange(-first % dots, run.rows, dots))

    def close(self, last: Run | None = None) -> None:
        """It drives no more; `last` is its last row."""
        if last is None or self._strides is None:
            return
        row = np.array([0])
        poses, dots = self._strides
        if (self._rows - 1) % poses:
            self._pose(last, row)
        if (self._rows - 1) % dots:
            self._trail(last, row)

    def _pose(self, run: Run, rows: NDArray[np.intp]) -> None:
        """Where base and wheels are at some rows, and the field through its sensor."""
        if not len(rows):
            return
        rec, root, t = self.rec, entity_of("world/robot", self.name), run["t"][rows] + self.offset_s
        p, q = run["p_world_base"][rows], run["q_world_base_xyzw"][rows]
        send(
            rec, root, t, rr.Transform3D,
            translation=p.astype(np.float32), quaternion=q.astype(np.float32),
        )  # fmt: skip
        for entity, side, at, rest, axis in self._wheels if "wheel_angle" in run.columns else ():
            half = run["wheel_angle"][rows, side][:, None] / 2
            turn = np.hstack([np.sin(half) * axis, np.cos(half)])
            turned = quat_multiply(rest, turn).astype(np.float32)
            where = np.broadcast_to(np.asarray(at, np.float32), (len(turned), 3))
            send(rec, entity, t, rr.Transform3D, translation=where, quaternion=turned)
        ahead = 0.25 * rotate(q, np.array([1.0, 0.0, 0.0]))[:, :2]
        arrow = {"origins": p[:, :2].astype(np.float32), "vectors": ahead.astype(np.float32)}
        send(rec, entity_of("floor/paths/robot", self.name), t, rr.Arrows2D, **arrow)
        if self.scale is not None and "b_vector_nt" in run.columns:
            known = np.isfinite(run["b_vector_nt"][rows]).all(axis=1)
            arrows = (run["b_vector_nt"][rows[known]] * ARROW_M_PER_NT).astype(np.float32)
            if len(arrows):
                entity = f"{root}/magnetometer/field"
                send(rec, entity, t[known], rr.Arrows3D, vectors=arrows, origins=-arrows / 2)

    def _send_vector_style(self) -> None:
        """The field vector through the magnetometer, in its axes, where it is known.

        The sensor is at the middle of the arrow: whichever way the field dips, half of it is outside the
        robot. It is placed in the robot's axes, as the link that carries it may be a mere frame that shows
        nothing.
        """
        entity = f"{entity_of('world/robot', self.name)}/magnetometer"
        place = rr.Transform3D(
            translation=self.spec.p_base_magnetometer,
            quaternion=rr.Quaternion(xyzw=self.spec.q_base_magnetometer_xyzw),
        )
        self.rec.log(entity, place, static=True)
        style = rr.Arrows3D.from_fields(colors=[(255, 255, 255)], radii=[0.006])
        self.rec.log(f"{entity}/field", style, static=True)

    def _trail(self, run: Run, rows: NDArray[np.intp]) -> None:
        """The path driven on the floor, and the readings above it where they were taken, as a ribbon."""
        if not len(rows):
            return
        rec, t = self.rec, run["t"][rows] + self.offset_s
        base, q = run["p_world_base"][rows], run["q_world_base_xyzw"][rows]
        before = self._last
        if before is None:
            paint: dict[str, Any] = {"colors": [self.colour]}
            for entity, style in (
                ("world/driven", rr.LineStrips3D.from_fields(radii=[0.012 if self.name else 0.006], **paint)),
                ("floor/paths/driven", rr.LineStrips2D.from_fields(radii=[0.012], draw_order=2.0, **paint)),
                ("floor/paths/robot", rr.Arrows2D.from_fields(radii=[0.05], draw_order=3.0, **paint)),
            ):
                rec.log(entity_of(entity, self.name), style, static=True)
            if self.scale is not None and "b_total_nt" in run.columns:
                rec.log("world/readings", rr.LineStrips3D.from_fields(radii=[0.017]), static=True)
        here = np.column_stack([base[:, :2], np.full(len(base), 0.016)])  # seen from above, over the plan
        line = here if before is None else np.vstack([[[*before["p_world_base"][0, :2], 0.016]], here])
        end = t[-1:]
        line = line.astype(np.float32)
        send(rec, entity_of("world/driven", self.name), end, rr.LineStrips3D, strips=line[None])
        send(rec, entity_of("floor/paths/driven", self.name), end, rr.LineStrips2D, strips=line[None, :, :2])
        if self.scale is not None and "b_total_nt" in run.columns:
            sensor = (base + rotate(q, self.spec.p_base_magnetometer)).astype(np.float32)
            start = sensor[:1]
            if before is not None:
                lift = rotate(before["q_world_base_xyzw"], self.spec.p_base_magnetometer)
                start = (before["p_world_base"] + lift).astype(np.float32)
            ribbon = np.stack([np.vstack([start, sensor[:-1]]), sensor], axis=1)
            colours = self.scale.colours(run["b_total_nt"][rows])
            packed = colours.astype(np.uint32) @ np.array([1 << 24, 1 << 16, 1 << 8, 1], np.uint32)
            send(rec, "world/readings", t, rr.LineStrips3D, strips=ribbon, colors=packed)
        row = rows[-1:]
        self._last = Run({name: run[name][row] for name in ("p_world_base", "q_world_base_xyzw")})


def _stride(rate_hz: float, most_hz: float) -> int:
    """Every how many rows, of so many a second, make `most_hz` or less."""
    return max(1, math.ceil(rate_hz / most_hz - 1e-6))


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


def _things(shapes: Sequence[Shape]) -> dict[str, list[Shape]]:
    """Shapes that stand still by the prim of the thing that they are part of: a desk, not its legs."""
    things: dict[str, list[Shape]] = {}
    for shape in shapes:
        if not shape.link and shape.prim != str(HEAT_MAP):  # the map is drawn finer, see _send_map
            parent, _, _ = shape.prim.rpartition("/")
            whole = parent if parent.count("/") > 1 else shape.prim  # a prim below the root is a thing itself
            things.setdefault(whole, []).append(shape)
    return things


def _entity(name: str) -> str:
    """A prim's name or path as an entity path: only letters, digits, _ and - need no escape there."""
    return re.sub(r"[^\w/-]", "_", name, flags=re.ASCII).strip("/")
