"""Scenery: a run ready to be drawn: the lab, the robot that moves in it, and its trail."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.figures import pictures
from magtwin.figures.runs import Trail
from magtwin.files.outputs import output
from magtwin.frames import matrix_from_quat, quat_from_yaw
from magtwin.run.compare import FIELDS, HEADINGS, POSITIONS
from magtwin.run.run import Run
from magtwin.spec.base import Vec3
from magtwin.spec.scene import Scene
from magtwin.usd.geometry import ColourScale, Link, Shape, read_colour_scale, read_links, read_shapes
from magtwin.usd.scene import open_scene

Array = NDArray[np.float64]

ORBIT_DEG_S = 5.0
"""Angular speed of the orbit camera in the film [deg/s]."""

TRAIL_STEP_M = 0.01
"""Step of the trail [m]."""

TRAIL = ((0.067, 0.008, (32, 38, 45)), (0.053, 0.011, (255, 255, 255)), (0.029, 0.014, None))
"""Half width [m], height above the floor [m] and colour of the trail's dark edge, white edge and middle. The
middle tells what the map lacks; one of the two edges differs from any colour of the map below."""

NEAR_M = 2.5
"""Distance from a path up to which all that stands there is in view, whole [m]."""

BEHIND_M, ABOVE_M, AHEAD_M = 1.8, 1.1, 0.8
"""Place of the chase camera behind and above the robot, and of its target ahead of it [m]."""

_ABOVE = np.array([0.0, 0.0, 0.2])

TRAIL_SPAN_M = 6.0
"""Extent of a path above which its trail is wider, to stay visible from farther away [m]."""

UNKNOWN = (150, 150, 150)
"""Colour of the trail where the field is unknown."""

LABEL: Any = {"position": (0.02, 0.965), "viewport": True, "color": pictures.INK}
"""Place of the top and colour of the line of text at the upper left."""

SAMPLES = 4
"""Samples per pixel in frames of a film."""


@dataclass(frozen=True)
class View:
    """A camera for a run."""

    kind: str
    """"orbit", "top", "chase", or "fixed"."""

    place: Vec3 = (0.0, 0.0, 0.0)
    """Position of a fixed camera [m]."""

    target: Vec3 = (0.0, 0.0, 0.0)
    """Target of a fixed camera [m]."""

    @classmethod
    def of(cls, text: str) -> "View":
        """The view that a text names: top, orbit, or `x,y,z:x,y,z`, place and target in world [m].

        Raises:
            InputError: The text names no view.
        """
        if text in KINDS:
            return cls(text)
        words = re.split("[,:]", text)
        try:
            x, y, z, tx, ty, tz = (float(word) for word in words)
        except ValueError:
            x = math.nan
        if not (text.count(":") == 1 and math.isfinite(x) and all(map(math.isfinite, (y, z, tx, ty, tz)))):
            known = f"known: {', '.join(KINDS)}; or x,y,z:x,y,z, from where to where"
            raise InputError(f"no camera {text!r}; {known}", parameter="camera")
        if (x, y, z) == (tx, ty, tz):
            said = f"the camera {text!r} looks at its own place; give another target"
            raise InputError(said, parameter="camera")
        return cls("fixed", (x, y, z), (tx, ty, tz))

    def camera(self, seen_s: float = 0.0) -> pictures.Camera:
        """The camera over a lab, `seen_s` [s] into the film."""
        if self.kind == "top":
            return pictures.Camera(azimuth_deg=-90.0, elevation_deg=90.0)
        if self.kind == "fixed":
            return pictures.Camera.between(self.place, self.target)
        if self.kind == "chase":
            raise InputError("the camera chase is for a run; a stage has none", parameter="camera")
        return pictures.Camera(
            azimuth_deg=40.0 + ORBIT_DEG_S * seen_s, elevation_deg=pictures.LAB_ELEVATION_DEG
        )

    @staticmethod
    def behind(p: Array, q_xyzw: ArrayLike) -> pictures.Camera:
        """The chase camera of a robot at p [m], shape (3,)."""
        forward = matrix_from_quat(q_xyzw)[:, 0] * (1, 1, 0)
        place, target = p - BEHIND_M * forward + (0, 0, ABOVE_M), p + AHEAD_M * forward
        return pictures.Camera.between(place, target, 50.0)


KINDS = ("orbit", "top", "chase")
"""From above at a slant, slowly round the lab; straight from above, x to the right; behind the robot."""


class Scenery:
    """A run in its lab in front of a camera.

    The lab is built once, as one body per look. Between frames, only the robot's bodies and the camera move,
    and the trail grows.
    """

    def __init__(
        self,
        run: Run,
        scene_file: str | os.PathLike[str],
        times: ArrayLike,
        *,
        view: View,
        size: tuple[int, int],
        speed: float = 1.0,
        fine: bool = False,
    ) -> None:
        """Build the scenery.

        The run has t and a position: the truth, motion capture or odometry. The times of the frames ascend on
        its clock [s]. `fine` draws smoother edges and shadows in corners, which takes seconds per frame.

        Raises:
            InputError: A column is missing, a time lies outside the run, the stage shows nothing or has no
                robot, or the machine has no OpenGL.
        """
        pictures.check_size(size)
        self._times, self._speed, self._view, self._size = np.asarray(times, float), speed, view, size
        known = (n for n in POSITIONS if n in run and np.isfinite(run[n]).all(axis=1).any())
        self._position = next(known, "")
        if not self._position:
            raise InputError(f"the run has no positions: it has none of {', '.join(POSITIONS)}")
        self._pose(run)
        opened = open_scene(scene_file, check_network=False, lab=str(run.metadata.get("lab", "")))
        stage, scene = opened.stage, opened.scene
        shapes, links = read_shapes(stage), read_links(stage)
        moving = links_of(links, [placed.robot.name for placed in scene.robots], run)
        self._sides = sides_of(scene, run)
        if not shapes:
            raise InputError(f"{scene_file}: shows nothing")
        self.plotter = pictures.plotter_of(size)
        try:
            scale = read_colour_scale(stage)
            still = [s for s in shapes if s.link not in moving]
            self._build(still, links, scale, baked=not fine)
            self._links, self._actors = dict[str, Link](), dict[str, Any]()
            for name, link in moving.items():
                own = (s for s in shapes if s.link == name and s.vertex_colours is None)
                if meshes := [pictures.mesh_of(s, s.vertices) for s in own]:
                    self._links[name] = link
                    self._actors[name] = self.plotter.add_mesh(
                        pictures.joined(meshes), **pictures.style_of(False)
                    )
            self._build_trail(run, scale)
            pictures.light(self.plotter, self._everything, soft=fine)
            if not fine:
                self.plotter.disable_anti_aliasing()
                self.plotter.enable_anti_aliasing("msaa", multi_samples=SAMPLES)
            self._label = self.plotter.add_text(" ", font_size=max(8, round(size[1] / 60)), **LABEL)
            self._label.prop.SetVerticalJustificationToTop()
            self._label.prop.background_color, self._label.prop.background_opacity = pictures.BACKGROUND, 0.7
            self._cutaway = pictures.Cutaway(self.plotter, size, self._screens, list(self._actors.values()))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Scenery":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the plotter."""
        self.plotter.close()

    def frame(self, k: int, *, whole: bool = False) -> NDArray[np.uint8]:
        """Draw frame k, shape (height, width, 3); objects hide the floor and the robot if `whole`."""
        for name, T_world_link in self.poses(k).items():
            self._actors[name].user_matrix = T_world_link
        quads = max(0, int(np.searchsorted(self._trail_t, self._times[k], side="right")) - 1)
        for mesh, actor, faces in self._ribbons:
            actor.visibility = quads > 0
            if quads:
                mesh.faces = faces[:quads].ravel()
        self._label.input = self._words[k]
        self._aim(k)
        return self._cutaway.image(whole=whole)

    def poses(self, k: int) -> dict[str, Array]:
        """Poses of the robot's visible links in frame k: T_world_link, shape (4, 4), by link name."""
        base = _matrix(self._p[k], self._q[k])
        poses = {}
        for name, link in self._links.items():
            T_base_link = _matrix(link.p_base_link, link.q_base_link_xyzw)
            side = self._sides.get(link.joint)
            if side is not None and link.rolling_axis is not None:
                half = self._wheels[k, side] / 2
                turn = (*np.multiply(link.rolling_axis, np.sin(half)), np.cos(half))
                T_base_link = T_base_link @ _matrix((0, 0, 0), turn)
            poses[name] = base @ T_base_link
        return poses

    def _pose(self, run: Run) -> None:
        """Pose, wheel angles and caption of each frame."""
        position, orientation = self._position, HEADINGS[self._position]
        facing = (orientation,) if orientation in run else ("yaw",) if "yaw" in run else ()
        names = [n for n in ("wheel_angle", "v_base") if n in run]
        field = next((n for n in FIELDS if n in run and np.isfinite(run[n]).any()), None)
        self._field = field
        if not facing:
            raise InputError(f"the run has positions but no headings: no {orientation}")
        if run.rows < 2:
            raise InputError(f"the run has {run.rows} readings; two or more are needed to show it")
        columns = run.select("t", position, *facing, *names, *([field] if field else []))
        seen = columns.resample(self._times)
        self._p = seen[position]
        self._q = seen[orientation] if orientation in seen else quat_from_yaw(seen["yaw"])
        for name, values in ((position, self._p), (facing[0], self._q)):
            if not np.isfinite(values).all():
                raise InputError(f"{name} of the run is unknown for a part of the time to show")
        self._wheels = seen["wheel_angle"] if "wheel_angle" in seen else np.zeros((len(self._times), 2))
        fast = f"   x{self._speed:.3g}" if self._speed != 1 else ""
        words = [f"{t - run['t'][0]:.1f} s" for t in self._times]
        if field:
            words = [f"{w}   {b:,.0f} nT" for w, b in zip(words, seen[field], strict=True)]
        if "v_base" in seen:
            speeds = np.round(seen["v_base"][:, 0], 2) + 0.0  # no "-0.00"
            words = [f"{w}   {v:.2f} m/s" for w, v in zip(words, speeds, strict=True)]
        self._words = [w + fast for w in words]

    def _build(
        self, still: Sequence[Shape], links: Mapping[str, Link], scale: ColourScale | None, *, baked: bool
    ) -> None:
        """Build the lab, one body per look."""
        standing = [placed(s.vertices, links[s.link]) if s.link else s.vertices.astype(float) for s in still]
        self._subjects = [v for s, v in zip(still, standing, strict=True) if pictures.is_subject(s, scale)]
        drawn = pictures.add_still(self.plotter, still, standing, scale, baked=baked)
        self._screens, self._walls, self._points = drawn
        self._things = pictures.inside(still, standing)
        self._everything = np.vstack([*standing, self._p]).astype(float)

    def _build_trail(self, run: Run, scale: ColourScale | None) -> None:
        """Build the whole trail, coloured as in a chart; a frame shows the part driven so far."""
        import pyvista
        from matplotlib import colormaps

        p_xy = run[self._position][:, :2]
        rows = _steps(p_xy)
        box = pictures.room_above(np.column_stack([p_xy[rows], np.zeros(len(rows))]))
        low, high = box.min(axis=0) - NEAR_M, box.max(axis=0) + NEAR_M
        reach = [(v, (v.max(axis=0) > low) & (v.min(axis=0) < high)) for v in self._things]
        near = [v for v, overlaps in reach if overlaps[:2].all()]
        self._around = np.vstack([box, *near])
        wider = max(1.0, float(np.max(np.ptp(p_xy[rows], axis=0))) / TRAIL_SPAN_M)
        rows = rows[: int(np.searchsorted(run["t"][rows], self._times[-1], side="right"))]
        self._trail_t, self._ribbons = run["t"][rows], []
        self._bar = len(rows) >= 2 and self._field is not None
        if len(rows) < 2:
            return
        colours = np.tile(np.array(UNKNOWN, np.uint8), (len(rows), 1))
        limits = None if scale is None else (scale.least, scale.greatest)
        if self._field:
            trail = Trail.of(run, limits)
            low, high = trail.limits
            known = np.isfinite(trail.values[rows])
            share = (trail.values[rows][known] - low) / max(high - low, 1e-9)
            colours[known] = (255 * colormaps[trail.colours](share)[:, :3]).round().astype(np.uint8)
            two, title = limits not in (None, trail.limits), trail.name.replace(" − ", "\n− ")
            pictures.add_bar(self.plotter, trail.colours, trail.limits, title, "lower" * two)
            if scale is not None and limits is not None and two:
                pictures.add_bar(self.plotter, scale.name, limits, scale.title("map"), "upper")
        along = np.gradient(p_xy[rows], axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        left = np.column_stack([-along[:, 1], along[:, 0]])
        first = 2 * np.arange(len(rows) - 1)[:, None]
        faces = np.hstack([np.full_like(first, 4), first, first + 2, first + 3, first + 1])
        for half_m, z_m, rgb in TRAIL:
            half = wider * half_m * left
            edges = np.stack([p_xy[rows] + half, p_xy[rows] - half], axis=1).reshape(-1, 2)
            points = np.column_stack([edges, np.full(len(edges), wider * z_m)])
            mesh = pyvista.PolyData(points, faces=faces.ravel())
            mesh["rgb"] = np.repeat(colours if rgb is None else np.full_like(colours, rgb), 2, axis=0)
            actor = self.plotter.add_mesh(mesh, scalars="rgb", rgb=True, lighting=False)
            self._ribbons.append((mesh, actor, faces))

    def _aim(self, k: int) -> None:
        around = self._around
        if self._view.kind == "chase":
            camera = self._view.behind(self._p[k], self._q[k])
        else:
            camera = self._view.camera((self._times[k] - self._times[0]) / self._speed)
        if self._view.kind == "top":  # with the whole map, like a picture of the stage
            around = np.vstack([around, *self._subjects])
        pictures.aim(self.plotter, camera, around, self._size, bar=self._bar)
        self._walls.cut(self.plotter.camera.position, np.vstack([self._points, self._p[k] + _ABOVE]))


def picture_of_run(
    run: Run,
    scene_file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    time_s: float | None = None,
    camera: str = "orbit",
    size: tuple[int, int] = (1600, 1000),
    force: bool = False,
) -> Path:
    """Draw a moment of a run in its lab, with the trail so far, and write a PNG of a `size` in pixels.

    Default of the time on the run's clock [s]: its end. `camera` is as for `View.of`.

    Raises:
        InputError: As for `Scenery`; or `out` is not a PNG or exists.
    """
    out, view = pictures.check_png(out), View.of(camera)
    if not run.rows or "t" not in run:
        raise InputError("the run has no readings, so there is nothing to show")
    t = float(run["t"][-1]) if time_s is None else time_s
    if not run["t"][0] <= t <= run["t"][-1]:
        ends = f"the run goes from {run['t'][0]:g} to {run['t'][-1]:g} s"
        raise InputError(f"{ends}; there is no {t:g} s in it", parameter="time_s")
    with (
        output(out, force=force) as aside,
        Scenery(run, scene_file, [t], view=view, size=size, fine=True) as scenery,
    ):
        pictures.write_png(scenery.frame(0), aside)
    return out


def links_of(links: Mapping[str, Link], robots: Sequence[str], run: Run) -> dict[str, Link]:
    """Links of the robot of a run; other robots of the scene stand still.

    Raises:
        InputError: There is no robot, or several and the run does not name one of them.
    """
    bases = list(dict.fromkeys(link.base for link in links.values() if link.joint))
    if not bases:
        raise InputError("the scene has no robot with joints")
    name = str(run.metadata.get("robot", robots[0] if len(robots) == 1 else ""))
    if len(robots) > 1 and name not in robots:
        raise InputError(f"the metadata of the run name no robot of the scene, which has {', '.join(robots)}")
    base = bases[robots.index(name)] if len(robots) == len(bases) and name in robots else bases[0]
    return {name: link for name, link in links.items() if link.base == base}


def sides_of(scene: Scene, run: Run) -> Mapping[str, int]:
    """Columns of `wheel_angle` by the names of the joints of the driven wheels of a run's robot."""
    led = scene.led_by(str(run.metadata["robot"])) if scene.others else scene
    return led.robot.drive.sides


def _steps(p_xy: Array) -> NDArray[np.intp]:
    """Rows at which the path has moved a step further."""
    rows: list[int] = []
    x0 = y0 = math.inf
    for i, (x, y) in enumerate(p_xy.tolist()):
        if not (x - x0) ** 2 + (y - y0) ** 2 < TRAIL_STEP_M**2 and math.isfinite(x + y):
            rows.append(i)
            x0, y0 = x, y
    return np.array(rows, np.intp)


def placed(points: ArrayLike, link: Link, *, in_base: bool = False) -> Array:
    """Points of a link in world, or in the base of its robot at rest [m], shape (N, 3)."""
    base, world = (link.p_base_link, link.q_base_link_xyzw), (link.p_world_link, link.q_world_link_xyzw)
    T = _matrix(*(base if in_base else world))
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def _matrix(p: ArrayLike, q_xyzw: ArrayLike) -> Array:
    """Transform of a pose, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_quat(q_xyzw), p
    return T
