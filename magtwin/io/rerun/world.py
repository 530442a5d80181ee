"""World: the lab, the robots and their paths in a Rerun recording, in 3D and from above."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_multiply, rotate, wrap_angle
from magtwin.io.rerun.layout import Colour
from magtwin.io.rerun.series import TIMELINE, entity_of, send, send_clouds
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.spec.robot import RobotSpec
from magtwin.twin.opening import geometry
from magtwin.twin.twin import Twin
from magtwin.usd.geometry import BASE_LINK, Link, Shape, srgb_from_linear
from magtwin.usd.maps.heat_map import HEAT_MAP, HEAT_MAP_HEIGHT_M

Array = NDArray[np.float64]

SCAN = "world/scan"  # Entity of the LiDAR scans
SCANS = 64  # Scans per chunk
POSE_HZ = 50.0  # Greatest rate of poses. No eye sees a difference above it.
DOT_HZ = 10.0  # Greatest rate of readings drawn along the path
SCALE_HEIGHT_M = 1.0  # Height of the colour bar [m]: above desks and chairs, which would hide it on the floor
ARROW_M_PER_NT = 1.4e-5  # Length of the field arrow: 70 cm for 50 uT
DRIVEN: Colour = (230, 60, 60)  # Colour of a driven path
UPWARDS = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]  # Turn of axes: pictures have y downwards


@dataclass(frozen=True)
class Scale:
    """Colours of field magnitudes: viridis between two values."""

    low_nt: float
    high_nt: float
    table: NDArray[np.uint8]  # Red, green, blue, opacity in sRGB, shape (256, 4)

    @classmethod
    def over(cls, field: AnomalyMap, readings_nt: Array) -> "Scale":
        """A common scale of map and readings: whole uT, saturated for the outermost 1 % of each."""
        from matplotlib import colormaps

        table = (colormaps["viridis"](np.arange(256)) * 255).round().astype(np.uint8)
        known = readings_nt[np.isfinite(readings_nt)]
        known = known[:: max(1, len(known) // 10_000)]  # enough for a percentile
        ends = [np.percentile(v, [1, 99]) for v in (field.values_nt[field.valid], known) if v.size]
        low, high = np.floor(np.min(ends or 0) / 1000) * 1000, np.ceil(np.max(ends or 0) / 1000) * 1000
        return cls(float(low), float(max(high, low + 1000)), table)

    def colours(self, b_nt: Array) -> NDArray[np.uint8]:
        """Colours of field magnitudes [nT], shape (...) -> (..., 4); transparent where nan."""
        share = (np.clip(b_nt, self.low_nt, self.high_nt) - self.low_nt) / (self.high_nt - self.low_nt)
        known = np.isfinite(share)
        out = self.table[np.where(known, share * 255, 0).round().astype(np.uint8)]
        out[~known] = 0
        return out


def heading_of(field: AnomalyMap, run: Run) -> float:
    """Heading of the map layer nearest to the first heading of a run [rad]."""
    if not run.rows or "yaw" not in run.columns:
        return float(field.headings_rad[0])
    away = np.abs(wrap_angle(field.headings_rad - run["yaw"][0]))
    return float(field.headings_rad[np.argmin(away)])


@dataclass(frozen=True)
class Interior:
    """A lab and its robot, read from a stage."""

    robot: RobotSpec
    shapes: Sequence[Shape]
    links: dict[str, Link]

    @classmethod
    def of(cls, twin: Twin) -> "Interior":
        """The lab and the first robot of a twin."""
        shapes, links = geometry(twin)
        return cls(twin.scene.robot, shapes, links)

    def size(self, field: AnomalyMap) -> int:
        """Upper bound of its bytes in a recording: corners, normals and colours; the map twice."""
        corners = 3 * sum(len(shape.faces) for shape in self.shapes)
        _, width, height = _pixels(field)
        return 28 * corners + 8 * width * height


def send_room(
    rec: rr.RecordingStream, interior: Interior, field: AnomalyMap, known: Run, planned: Path | None
) -> Scale:
    """Send the map on the floor, its legend, walls, furniture and the planned path; returns its colours.

    The run `known` gives the range of readings and the first heading.
    """
    scale = Scale.over(field, known.get("b_total_nt", np.empty(0)))
    send_map(rec, field, scale, heading_of(field, known))
    _send_scale(rec, field, scale)
    send_still(rec, interior.shapes)
    if planned is not None:
        strip = np.column_stack([planned.p_xy, np.full(len(planned.p_xy), 0.012)])
        white: dict[str, Any] = {"colors": (255, 255, 255)}
        rec.log("world/planned", rr.LineStrips3D([strip], radii=0.004, **white), static=True)
        flat = rr.LineStrips2D([planned.p_xy], radii=0.01, draw_order=1.0, **white)
        rec.log("floor/paths/planned", flat, static=True)
    return scale


def send_map(rec: rr.RecordingStream, field: AnomalyMap, scale: Scale, heading: float) -> None:
    """The floor in the colours of the map at a heading [rad], interpolated between nodes."""
    x0, x1, y0, y1 = field.extent
    cell, width, height = _pixels(field)
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height  # the first row of an image is its top
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = scale.colours(field.lookup(grid, heading))
    _send_image(rec, "world/map", pixels, cell, (x0, y0, HEAT_MAP_HEIGHT_M), opacity=0.75)
    place = rr.Transform3D(translation=(x0, -y1, 0), scale=((x1 - x0) / width, (y1 - y0) / height, 1))
    rec.log("floor/map", place, static=True)
    rec.log("floor/map", rr.Image(pixels, draw_order=-1.0), static=True)
    rec.log("floor/paths", rr.Transform3D(mat3x3=UPWARDS), static=True)


def _pixels(field: AnomalyMap) -> tuple[float, int, int]:
    """Size of a pixel of the floor [m], and the number of pixels along x and y."""
    x0, x1, y0, y1 = field.extent
    cell = max(0.02, (x1 - x0) / 1024, (y1 - y0) / 1024)
    width, height = (max(1, round((b - a) / cell)) for a, b in ((x0, x1), (y0, y1)))
    return cell, width, height


def _send_scale(rec: rr.RecordingStream, field: AnomalyMap, scale: Scale) -> None:
    """A colour bar with its values, in front of the map and above the furniture."""
    x0, x1, y0, _ = field.extent
    length, breadth = 0.6 * (x1 - x0), 0.03 * (x1 - x0)
    cell = length / 256
    corner = ((x0 + x1 - length) / 2, y0 - 0.3 - breadth, SCALE_HEIGHT_M)
    bar = np.broadcast_to(scale.table, (max(1, round(breadth / cell)), 256, 4))
    _send_image(rec, "world/scale", bar, cell, corner)
    share = np.linspace(0, 1, 5)
    at = np.column_stack([corner[0] + share * length, np.full(5, corner[1] - 0.08), np.full(5, corner[2])])
    texts = [f"{v:g} µT" for v in (scale.low_nt + share * (scale.high_nt - scale.low_nt)) / 1000]
    values = rr.Points3D(at, labels=texts, radii=0.0, colors=(255, 255, 255), show_labels=True)
    rec.log("world/scale/values", values, static=True)


def _send_image(
    rec: rr.RecordingStream,
    entity: str,
    rgba: NDArray[np.uint8],
    cell: float,
    corner: tuple[float, float, float],
    *,
    opacity: float = 1.0,
) -> None:
    """A level image with its lower left corner at `corner` in world [m] and pixels of size `cell` [m]."""
    height, width = rgba.shape[:2]
    pixels = {"width": width, "height": height, "color_model": "RGBA", "channel_datatype": "U8"}
    grid = rr.GridMap(
        data=np.ascontiguousarray(rgba).tobytes(),
        format=rr.components.ImageFormat(**pixels),
        cell_size=cell,
        translation=corner,
        opacity=opacity,
    )
    rec.log(entity, grid, static=True)


class Feed:
    """Sends LiDAR scans in time with a run. A scan is shown until the next one, or until the LiDAR stops."""

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
        """Send the scans up to a time [s]."""
        end = int(np.searchsorted(self._t, t, side="right"))
        for start in range(self._sent, end, SCANS):
            rows = slice(start, min(end, start + SCANS))
            part = [self._points[k] for k in self._order[rows]]
            send_clouds(self._rec, SCAN, self._t[rows], part, rr.Points3D)
        self._sent = max(self._sent, end)

    def clear(self, t: float) -> None:
        """Remove the last scan after its turn, or at the end of the run t [s] if that is later."""
        if self._sent and len(self._points[self._order[self._sent - 1]]):
            end = max(t, float(self._t[self._sent - 1]) + self._turn)
            self._rec.set_time(TIMELINE, duration=np.timedelta64(round(end * 1e9), "ns"))
            self._rec.log(SCAN, rr.Points3D(np.empty((0, 3))))
            self._rec.reset_time()


@dataclass
class Robot:
    """A robot in a recording: its body, its sensors, its path and the readings along it."""

    rec: rr.RecordingStream
    interior: Interior
    scale: Scale | None = None  # Colours of the readings along its path. None: only the path.
    name: str = ""
    colour: Colour = DRIVEN  # Colour of its path
    rate_hz: float = 0.0  # Rows per second. 0: the rate of the first rows.
    _rows: int = 0
    _strides: tuple[int, int] | None = None
    _last: Run | None = None
    _wheels: list[tuple[str, int, Any, Any, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rec, root = self.rec, entity_of("world/robot", self.name)
        sides, links = self.interior.robot.drive.sides, self.interior.links
        bases = [name for name, link in links.items() if not link.joint] or [""]
        base = BASE_LINK if BASE_LINK in links else bases[0]
        for name, link in links.items():
            carried = [shape for shape in self.interior.shapes if shape.link == name]
            if not (carried or link.joint in sides):
                continue
            if not link.joint and name != base:  # a separate body that stands still
                entity, p, q = f"world/lab/{_entity(name)}", link.p_world_link, link.q_world_link_xyzw
            else:
                entity, p, q = f"{root}/{_entity(name)}", link.p_base_link, link.q_base_link_xyzw
            if carried:
                rec.log(entity, mesh_of(carried), static=True)
            if link.joint in sides and link.rolling_axis is not None:
                self._wheels.append((entity, sides[link.joint], p, q, link.rolling_axis))
            else:
                rec.log(entity, _transform(p, q), static=True)
        if self.name:
            label = rr.Points3D([[0, 0, 0.5]], labels=[self.name], radii=0.0, colors=self.colour)
            rec.log(f"{root}/name", label, static=True)
        else:
            self._send_sensors(root)

    def _send_sensors(self, root: str) -> None:
        """The axes of each sensor, forward red, left green, up blue, with its name."""
        spec = self.interior.robot
        for name, p, q in (
            ("magnetometer", spec.p_base_magnetometer, spec.q_base_magnetometer_xyzw),
            ("LiDAR", spec.p_base_lidar, spec.q_base_lidar_xyzw),
            ("IMU", (0.0, 0.0, 0.0), spec.q_base_imu_xyzw),
        ):
            entity = f"{root}/sensors/{name}"
            self.rec.log(entity, _transform(p, q), static=True)
            self.rec.log(entity, rr.TransformAxes3D(0.07), static=True)
            label = rr.Points3D([[0, 0, 0]], labels=[name], radii=0.005, colors=(255, 255, 255))
            self.rec.log(f"{entity}/name", label, static=True)

    def append(self, run: Run) -> None:
        """Add the next rows."""
        if self._strides is None:
            rate = self.rate_hz or ((run.rows - 1) / run.duration_s if run.duration_s else 0.0)
            self._strides = _stride(rate, POSE_HZ), _stride(rate, DOT_HZ)
            if self.scale is not None and np.isfinite(run.get("b_vector_nt", np.nan)).any():
                # The field arrow in sensor axes, with its middle at the sensor
                entity, robot = f"{entity_of('world/robot', self.name)}/magnetometer", self.interior.robot
                place = _transform(robot.p_base_magnetometer, robot.q_base_magnetometer_xyzw)
                self.rec.log(entity, place, static=True)
                style = rr.Arrows3D.from_fields(colors=[(255, 255, 255)], radii=[0.006])
                self.rec.log(f"{entity}/field", style, static=True)
        first, poses, dots = self._rows, *self._strides
        self._rows += run.rows
        self._pose(run, np.arange(-first % poses, run.rows, poses))
        self._trail(run, np.arange(-first % dots, run.rows, dots))

    def close(self, last: Run) -> None:
        """End the path with `last`, the last row of the run."""
        for stride, send_rows in zip(self._strides or (), (self._pose, self._trail), strict=False):
            if (self._rows - 1) % stride:
                send_rows(last, np.array([0]))

    def _pose(self, run: Run, rows: NDArray[np.intp]) -> None:
        """Poses of base and wheels at some rows, and the field vector at the sensor."""
        if not len(rows):
            return
        rec, root, t = self.rec, entity_of("world/robot", self.name), run["t"][rows]
        p, q = run["p_world_base"][rows], run["q_world_base_xyzw"][rows]
        pose = {"translation": p.astype(np.float32), "quaternion": q.astype(np.float32)}
        send(rec, root, t, rr.Transform3D, **pose)
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

    def _trail(self, run: Run, rows: NDArray[np.intp]) -> None:
        """The path on the floor, and above it a ribbon of the readings at the sensor's positions."""
        if not len(rows):
            return
        rec, t = self.rec, run["t"][rows]
        base, q = run["p_world_base"][rows], run["q_world_base_xyzw"][rows]
        before = self._last
        if before is None:
            paint: dict[str, Any] = {"colors": [self.colour]}
            for entity, style in (
                ("world/driven", rr.LineStrips3D.from_fields(radii=[0.012], **paint)),
                ("floor/paths/driven", rr.LineStrips2D.from_fields(radii=[0.012], draw_order=2.0, **paint)),
                ("floor/paths/robot", rr.Arrows2D.from_fields(radii=[0.05], draw_order=3.0, **paint)),
            ):
                rec.log(entity_of(entity, self.name), style, static=True)
            if self.scale is not None and "b_total_nt" in run.columns:
                rec.log("world/readings", rr.LineStrips3D.from_fields(radii=[0.017]), static=True)
        here = np.column_stack([base[:, :2], np.full(len(base), 0.016)])  # seen from above, over the plan
        start = here[:1] if before is None else [[*before["p_world_base"][0, :2], 0.016]]
        line = np.stack([np.vstack([start, here[:-1]]), here], axis=1).astype(np.float32)
        send(rec, entity_of("world/driven", self.name), t, rr.LineStrips3D, strips=line)
        send(rec, entity_of("floor/paths/driven", self.name), t, rr.LineStrips2D, strips=line[:, :, :2])
        if self.scale is not None and "b_total_nt" in run.columns:
            sensor = (base + rotate(q, self.interior.robot.p_base_magnetometer)).astype(np.float32)
            start = sensor[:1]
            if before is not None:
                lift = rotate(before["q_world_base_xyzw"], self.interior.robot.p_base_magnetometer)
                start = (before["p_world_base"] + lift).astype(np.float32)
            ribbon = np.stack([np.vstack([start, sensor[:-1]]), sensor], axis=1)
            colours = self.scale.colours(run["b_total_nt"][rows])
            packed = colours.astype(np.uint32) @ np.array([1 << 24, 1 << 16, 1 << 8, 1], np.uint32)
            send(rec, "world/readings", t, rr.LineStrips3D, strips=ribbon, colors=packed)
        row = rows[-1:]
        self._last = Run({name: run[name][row] for name in ("p_world_base", "q_world_base_xyzw")})


def _stride(rate_hz: float, most_hz: float) -> int:
    """Step between rows that reduces a rate to `most_hz` at most."""
    return max(1, math.ceil(min(rate_hz / most_hz, 1e9) - 1e-6))


def _transform(p: Any, q_xyzw: Any) -> rr.Transform3D:
    return rr.Transform3D(translation=p, quaternion=rr.Quaternion(xyzw=q_xyzw))


def send_still(rec: rr.RecordingStream, shapes: Sequence[Shape]) -> None:
    """Send the axes of the world, walls and furniture: one mesh per object."""
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    objects: dict[str, list[Shape]] = {}  # a desk, not its legs
    for shape in shapes:
        if not shape.link and shape.prim != str(HEAT_MAP):  # send_map draws the map with more pixels
            parent = shape.prim.rpartition("/")[0]
            prim = parent if parent.count("/") > 1 else shape.prim  # below the root: an object itself
            objects.setdefault(prim, []).append(shape)
    for prim, parts in objects.items():
        rec.log(f"world/lab/{_entity(prim)}", mesh_of(parts), static=True)


def mesh_of(shapes: Sequence[Shape]) -> rr.Mesh3D:
    """Shapes as one mesh of flat triangles in the colours of their materials."""
    corners = np.concatenate([shape.vertices[shape.faces] for shape in shapes])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    rgba = []
    for shape in shapes:
        own = shape.colour[:3] if shape.vertex_colours is None else shape.vertex_colours[shape.faces.ravel()]
        linear = np.broadcast_to(srgb_from_linear(own), (3 * len(shape.faces), 3))
        rgba.append(np.hstack([linear, np.full((len(linear), 1), shape.colour[3])]))
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        vertex_colors=(np.concatenate(rgba) * 255).round().astype(np.uint8),
    )


def _entity(name: str) -> str:
    """A prim's name or path as an entity path, which may contain letters, digits, _ and -."""
    return re.sub(r"[^\w/-]", "_", name, flags=re.ASCII).strip("/")
