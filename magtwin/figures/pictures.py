"""Pictures: a stage as a PNG or in a window, drawn with or without a graphics card."""

import ctypes
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.statistics import apart
from magtwin.figures.canvas import evenly
from magtwin.figures.style import PALETTE
from magtwin.files.file import read_bytes
from magtwin.files.outputs import output
from magtwin.frames import rotate
from magtwin.parallel import check_room
from magtwin.spec.base import Vec3
from magtwin.urdf.meshes.texture import opened_image
from magtwin.usd.geometry import (
    ColourScale,
    Shape,
    linear_from_srgb,
    read_colour_scale,
    read_links,
    read_shapes,
    srgb_from_linear,
)
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.solids import corner_normals
from magtwin.usd.units import upright

Array = NDArray[np.float64]

MARGIN = 1.08
"""Distance of the camera, relative to the least distance from which everything is visible."""

AROUND_M = 0.7
"""Margin around and above a path that a camera over the lab keeps in view [m]."""

TALL_M, WIDE_M, CEILING_M = 1.0, 1.2, 1.8
"""Least height and width of a wall, and least height of a ceiling [m]. Furniture of that size counts."""

PILLAR_M, BESIDE_M = 2.2, 0.25
"""Height from which what stands on the heat-map is a veil in front of it, and how far beside still counts as
on it [m]. Lower furniture is solid."""

STUMP_M = 0.12
"""Height down to which a wall is cut that hides the room [m]."""

MOST_RAYS, MOST_FACES = 1000, 1000
"""Points by which a wall is found to hide the room, and its faces, the largest first."""

LOW_M = 0.05
"""What is no higher than this is the ground, which need not be in view [m]."""

LAB_ELEVATION_DEG = 36.0
"""Elevation of a camera over a lab above its target's horizon [deg]."""

BAR_SHARE = 0.12
"""Share of a picture's width, at its right, that the colour bar takes."""

GL_PACKAGES = "libegl1 libgl1-mesa-dri libx11-6"
"""Debian packages for drawing without a screen: EGL, Mesa's drivers, and the library that VTK loads first."""

BACKGROUND = "#e9edf1"

INK = PALETTE["ink"][0]

LIGHTS = (((0.6, 0.9, 1.4), 0.75), ((0.9, -1.0, 0.5), 0.45), ((-0.9, 0.2, 0.6), 0.4), ((0.1, 0.0, -1.0), 0.3))
"""Direction towards each light in world, and its strength."""

VEIL = 0.3
"""Opacity of an object where it stands in front of the heat-map, the robot or the trail."""

BYTES_PER_PIXEL = 400
"""Memory that a picture takes while it is drawn, with smooth edges and shadows."""

MOST_TEXELS = 2048
"""Texels along the longer side of a texture as drawn; larger images are scaled down."""

FACES_AT_A_POINT = 1000
"""Faces that share a point; of meshes with more, every face is flat, since VTK compares each two of them."""

AMBIENT, DIFFUSE = 0.22, 0.8
"""Share of an object's colour visible without light, and share added by light at normal incidence."""


@dataclass(frozen=True)
class Camera:
    """A camera."""

    azimuth_deg: float = 40.0
    """Direction from the target to the camera about world z, from x towards y [deg]."""

    elevation_deg: float = 22.0
    """Elevation of the camera above the target's horizon [deg]."""

    distance_m: float | None = None
    """Distance from the target [m]. None: everything just fits."""

    target: Vec3 | None = None
    """Point in the middle of the picture, in world [m]. None: the middle of everything."""

    view_angle_deg: float = 30.0
    """Angle between the upper and the lower edge [deg]."""

    @classmethod
    def between(cls, place: ArrayLike, target: ArrayLike, view_angle_deg: float = 40.0) -> "Camera":
        """A camera at a place that looks at a target [m]."""
        back = np.subtract(place, target)
        distance = float(np.linalg.norm(back))
        turn, rise = np.degrees([np.arctan2(back[1], back[0]), np.arcsin(back[2] / distance)]).tolist()
        x, y, z = np.asarray(target, float).tolist()
        return cls(turn, rise, distance, (x, y, z), view_angle_deg)

    def axes(self) -> Array:
        """Right, up and back axes in world, as rows, shape (3, 3)."""
        a, e = np.radians([self.azimuth_deg, self.elevation_deg])
        back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.array([right, np.cross(back, right), back])


def picture_of_stage(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    size: tuple[int, int] = (1600, 1000),
    camera: Camera | None = None,
    legend: bool = True,
    force: bool = False,
) -> Path:
    """Draw a stage and write a PNG. Objects in front of a heat-map or a robot are drawn as a veil.

    A stage of moving bodies only, a robot alone, gets a floor if the camera looks down on it.

    Args:
        path: USD file.
        out: PNG to write.
        size: Width and height [pixel].
        camera: The camera. Default: from the front left and above, with everything in view; of a lab, its
            heat-map.
        legend: Whether a stage with an anomaly map gets the colour bar of its heat-map.
        force: Whether to replace an existing file.

    Returns:
        `out`.

    Raises:
        InputError: The stage is missing, is not USD or shows nothing; `out` is not a PNG or exists; or the
            machine has no OpenGL (the packages are named).
    """
    out = check_png(out)
    check_size(size)
    with output(out, force=force) as aside:
        plotter = plotter_of(size)
        try:
            screens = _draw(plotter, path, size, camera, legend=legend)
            write_png(Cutaway(plotter, size, screens).image(), aside)
        finally:
            plotter.close()
    return out


def show_stage(path: str | os.PathLike[str], *, size: tuple[int, int] = (1600, 1000)) -> None:
    """Show a stage in a window, where the mouse turns it; returns when the window is closed.

    Raises:
        InputError: The stage is missing, is not USD or shows nothing; or there is no display.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        way = f"magtwin report {path} --out stage.html makes a page of it"
        raise InputError(f"{path}: there is no display to show it on; {way}")
    plotter = plotter_of(size, window=True)
    try:
        _draw(plotter, path, size, None)
        plotter.show(title=str(path))
    finally:
        plotter.close()


def is_subject(shape: Shape, scale: ColourScale | None) -> bool:
    """Whether a shape must not be hidden: a heat-map, or a part of a robot."""
    return bool(shape.link) or (scale is not None and shape.prim == scale.prim)


def inside(shapes: Sequence[Shape], worlds: Sequence[Array]) -> list[Array]:
    """Vertices in world [m] of the shapes that are no walls, without a ground that reaches far beyond."""
    rest = [v for s, v in zip(shapes, worlds, strict=True) if not is_wall(s, v)]
    things = [v for v in rest if v[:, 2].max() > LOW_M]
    if not things:
        return rest
    reach = 1.5 * np.ptp(np.vstack(things), axis=0)[:2]
    return [v for v in rest if v[:, 2].max() > LOW_M or (np.ptp(v, axis=0)[:2] <= reach).all()]


def room_above(points: ArrayLike) -> Array:
    """Corners of the box around points [m], with `AROUND_M` more on all sides and above, shape (8, 3)."""
    points = np.asarray(points, float)
    low, high = points.min(axis=0), points.max(axis=0)
    low[:2] -= AROUND_M
    high[:2] += AROUND_M
    ends = zip((*low[:2], min(low[2], 0.0)), (*high[:2], max(low[2] + AROUND_M, high[2])), strict=True)
    return np.array(list(itertools.product(*ends)))


class Walls:
    """Walls, ceilings and blocks of a building; those that hide the room are cut down to a stump."""

    def __init__(self, plotter: Any) -> None:
        """No wall yet; `add` adds one."""
        self._plotter = plotter
        self._walls: list[tuple[Array, list[Any]]] = []
        self._cut: list[bool] = []

    def add(self, shape: Shape, vertices: Array, *, baked: bool) -> list[Any]:
        """Add a wall with its vertices in world [m]; returns its actors, whole and cut."""
        low = vertices * (1, 1, 0) + np.minimum(vertices, STUMP_M) * (0, 0, 1)
        forms = [vertices] if vertices[:, 2].min() > CEILING_M else [vertices, low]
        actors = [add_shape(self._plotter, shape, form, baked=baked) for form in forms]
        corners = vertices[shape.faces]
        size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self._walls.append((corners[np.argsort(-size, kind="stable")[:MOST_FACES]], actors))
        self._cut.append(False)
        return actors

    def cut(self, place: ArrayLike, points: Array, *, more: bool = False) -> None:
        """Cut the walls that hide a point from a place [m], shapes (N, 3) and (3,); `more` keeps the cuts."""
        for k, (corners, (whole, *stump)) in enumerate(self._walls):
            inside = ((points > corners.min(axis=(0, 1))) & (points < corners.max(axis=(0, 1)))).all(axis=1)
            self._cut[k] = (more and self._cut[k]) or hides(corners, place, points[~inside])
            for actor, shown in ((whole, not self._cut[k]), *((low, self._cut[k]) for low in stump)):
                actor.visibility = shown

    def shown(self) -> list[Array]:
        """Corners of each wall as it is drawn [m], of shape (N, 3)."""
        ends = [STUMP_M if cut else np.inf for cut in self._cut]
        every = zip(self._walls, ends, strict=True)
        return [np.minimum(corners.reshape(-1, 3), (np.inf, np.inf, end)) for (corners, _), end in every]


def is_wall(shape: Shape, vertices: Array) -> bool:
    """Whether a shape with these vertices in world [m] is a wall, a ceiling or a block that is as large."""
    x, y, z = np.ptp(vertices, axis=0)
    ceiling = vertices[:, 2].min() > CEILING_M and min(x, y) >= WIDE_M
    return not shape.link and bool(ceiling or (z >= TALL_M and max(x, y) >= WIDE_M))


def hides(triangles: Array, place: ArrayLike, points: Array) -> bool:
    """Whether triangles, shape (T, 3, 3), lie between a place and any of the points, shape (N, 3).

    By Moeller and Trumbore (1997, Journal of Graphics Tools 2): place + t (point - place) lies in a triangle
    a + u e1 + v e2 if u, v >= 0 and u + v <= 1.
    """
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    eye = np.asarray(place, float)
    ray, off = (points - eye)[:, None], eye - a
    across = np.cross(ray, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 1.0 / (across * e1).sum(axis=-1)
        turned = np.cross(off, e1)
        products = (across * off, ray * turned, turned * e2)
        u, v, t = (product.sum(-1) * share for product in products)
        return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 0.999)).any())


def add_shape(plotter: Any, shape: Shape, vertices: NDArray, *, baked: bool = False) -> Any:
    """Draw a shape on its own; returns its actor."""
    if shape.texture is not None:
        return add_textured(plotter, shape, vertices)
    flat = baked or shape.vertex_colours is not None
    return plotter.add_mesh(mesh_of(shape, vertices, baked=baked), opacity=shape.colour[3], **style_of(flat))


def add_still(
    plotter: Any,
    shapes: Sequence[Shape],
    worlds: Sequence[Array],
    scale: ColourScale | None,
    *,
    baked: bool = False,
) -> tuple[list[Any], Walls, Array]:
    """Draw what stands still, by its vertices in world [m], as one body per look.

    If `baked`, light is put into the colours, so that no frame computes it.

    Returns:
        The actors that may hide heat-map and robot; the walls; and points of all that a wall must not hide
        [m], shape (N, 3).
    """
    bodies: dict[tuple[bool, bool, float], list[Any]] = {}
    screens, walls, seen = [], Walls(plotter), [np.empty((0, 3))]
    floors = [v for s, v in zip(shapes, worlds, strict=True) if scale is not None and s.prim == scale.prim]
    floor = np.vstack(floors) if floors else np.full((1, 3), np.nan)  # nothing stands on an unknown one
    low, high = floor.min(axis=0) - BESIDE_M, floor.max(axis=0) * (1, 1, 0) + (BESIDE_M, BESIDE_M, PILLAR_M)
    for shape, vertices in zip(shapes, worlds, strict=True):
        chosen, flat = is_subject(shape, scale), shape.vertex_colours is not None
        if not chosen and is_wall(shape, vertices):
            screens += walls.add(shape, vertices, baked=baked)
            continue
        if chosen or (vertices[:, 2].max() > LOW_M and np.sort(np.ptp(vertices, axis=0))[1] > LOW_M):
            seen.append(vertices[evenly(len(vertices), 400 if flat else 24)])
        hiding = not (chosen or ((vertices.mean(axis=0) > low) & (vertices.max(axis=0) < high)).all())
        if shape.texture is not None:
            actor = add_shape(plotter, shape, vertices)
            screens += [actor] if hiding else []
            continue
        mesh = mesh_of(shape, vertices, baked=baked)
        bodies.setdefault((hiding, flat or baked, shape.colour[3]), []).append(mesh)
    for (hiding, flat, opacity), meshes in bodies.items():
        actor = plotter.add_mesh(joined(meshes), opacity=opacity, **style_of(flat))
        screens += [actor] if hiding else []
    points = np.vstack(seen)
    return screens, walls, points[evenly(len(points), MOST_RAYS)] if len(points) else points


@translates
def _draw(
    plotter: Any,
    path: str | os.PathLike[str],
    size: tuple[int, int],
    camera: Camera | None,
    *,
    legend: bool = True,
) -> list[Any]:
    """Draw a stage, with lights and camera; returns the actors that may hide the subject."""
    stage = open_stage(path)
    shapes = read_shapes(stage)
    if not shapes:
        raise InputError(f"{path}: shows nothing; a picture needs at least one visible shape")
    links = read_links(stage)
    worlds = [
        rotate(links[s.link].q_world_link_xyzw, s.vertices) + links[s.link].p_world_link
        if s.link
        else s.vertices.astype(float)
        for s in shapes
    ]
    worlds = [upright(stage, vertices) for vertices in worlds]
    everything, scale = np.vstack(worlds), read_colour_scale(stage)
    subject = [is_subject(shape, scale) for shape in shapes]
    in_lab = scale is not None and any(s.prim == scale.prim for s in shapes)
    camera = camera or Camera(elevation_deg=LAB_ELEVATION_DEG if in_lab else Camera.elevation_deg)
    screens, walls, points = add_still(plotter, shapes, worlds, scale)
    if camera.elevation_deg > 0 and all(s.link for s in shapes):
        import pyvista

        # just below everything, in the colour of the background: only shadows on it are visible
        low, high = everything.min(axis=0), everything.max(axis=0)
        reach = 3 * float(np.max(high - low))
        middle = (*((low + high) / 2)[:2], low[2] - 1e-3 * reach)
        floor = pyvista.Disc(center=middle, inner=0, outer=reach, normal=(0, 0, 1), c_res=64)
        plotter.add_mesh(floor, color=BACKGROUND, ambient=1.0, diffuse=0.0, specular=0.0)
    light(plotter, everything)
    inner = inside(shapes, worlds)
    for more in (False, True):  # as walls are cut, the camera comes nearer
        around = np.vstack([*inner, *walls.shown()] or [everything])
        aim(plotter, camera, around, size, bar=scale is not None and legend)
        walls.cut(plotter.camera.position, points, more=more)
    if scale is not None and legend:
        add_bar(plotter, scale.name, (scale.least, scale.greatest), scale.title("field"))
    return screens if any(subject) else []


def view_distance(
    points: ArrayLike, target: ArrayLike, axes: ArrayLike, half_angles: tuple[float, float]
) -> float:
    """Least distance at which a camera sees all points.

    A point at (r, u, b) along the camera's right, up and back axes is D - b in front of it, and is visible
    if |r| <= (D - b) tan(h) and |u| <= (D - b) tan(v).

    The points, shape (N, 3), and the target in the middle of the view are in world [m]; the axes, right, up
    and back, are rows. `half_angles` h and v are half the horizontal and vertical angle of view [rad].
    """
    r, u, b = ((np.asarray(points, float) - target) @ np.asarray(axes, float).T).T
    h, v = half_angles
    return float(np.max(b + np.maximum(np.abs(r) / np.tan(h), np.abs(u) / np.tan(v))))


def plotter_of(size: tuple[int, int], *, window: bool = False) -> Any:
    """A plotter, off screen or in a window.

    Raises:
        InputError: The extra `view` is missing, or the machine has no OpenGL. VTK itself would end the
            process.
    """
    missing = [name for name in ("pyvista", "vtkmodules", "imageio_ffmpeg") if find_spec(name) is None]
    if missing:
        needed = ", ".join(missing)
        raise InputError(f"pictures and films of stages need {needed}: pip install 'magtwin[view]'")
    import vtkmodules.vtkRenderingOpenGL2
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    remedy = f"install it: apt-get install {GL_PACKAGES}"
    refusal = InputError(f"no OpenGL here, so no picture can be drawn; {remedy}")
    if sys.platform == "linux" and not _loads("libX11.so", "libX11.so.6"):  # needed without a screen too
        raise refusal
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # it reports each missing way to draw
    drawn_by = vtkRenderWindow()  # the first that works of a screen and EGL; else OSMesa, untested
    software = isinstance(drawn_by, vtkmodules.vtkRenderingOpenGL2.vtkOSOpenGLRenderWindow)
    if software and not _loads("libOSMesa.so", "libOSMesa.so.8", "libOSMesa.so.6"):
        raise refusal
    import pyvista

    plotter = pyvista.Plotter(off_screen=not window, window_size=list(size), lighting="none")
    plotter.set_background(BACKGROUND)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def _loads(*names: str) -> bool:
    """Whether one of the shared libraries can be loaded."""
    for name in names:
        with suppress(OSError):
            return bool(ctypes.CDLL(name))
    return False


def check_png(out: str | os.PathLike[str]) -> Path:
    """`out` if its name ends in .png."""
    out = Path(out)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: pictures are PNG; give it the suffix .png")
    return out


def check_size(size: tuple[int, int]) -> None:
    """Refuse a size that cannot be drawn."""
    if not (min(size) >= 16 and max(size) <= 16384):
        raise InputError(f"size must lie in 16..16384 pixels each way, got {size[0]} x {size[1]}")
    text = f"a picture of {size[0]} x {size[1]} pixels"
    check_room(BYTES_PER_PIXEL * size[0] * size[1], text, "take a smaller `size`", "size")


def write_png(image: NDArray[np.uint8], path: Path) -> None:
    """Write an image, shape (height, width, 3)."""
    from PIL import Image

    Image.fromarray(image).save(path, format="png", optimize=True)


def style_of(flat: bool) -> dict[str, Any]:
    """Shading of a mesh of `mesh_of`. Colours of a map are numbers, so light must not change them."""
    if flat:
        return {"scalars": "rgb", "rgb": True, "lighting": False}
    shading = {"ambient": AMBIENT, "diffuse": DIFFUSE, "specular": 0.25, "specular_power": 25}
    return {"scalars": "rgb", "rgb": True, "smooth_shading": True, **shading}


def mesh_of(shape: Shape, vertices: NDArray, *, baked: bool = False) -> Any:
    """A shape as a mesh with colours at its points; unless it is a map, with normals or its light."""
    import pyvista

    faces: NDArray[np.integer] = shape.faces
    if shape.vertex_colours is None and np.bincount(faces.ravel(), minlength=1).max() > FACES_AT_A_POINT:
        vertices, faces = vertices[faces.ravel()], np.arange(faces.size).reshape(faces.shape)
    mesh = pyvista.PolyData.from_regular_faces(np.asarray(vertices, np.float32), faces)
    if shape.vertex_colours is not None:
        mesh["rgb"] = (255 * srgb_from_linear(shape.vertex_colours)).round().astype(np.uint8)
        return mesh
    how: Any = {"cell_normals": False, "split_vertices": True, "consistent_normals": False}
    mesh = mesh.compute_normals(feature_angle=35, **how)
    colour = (255 * np.array(srgb_from_linear(shape.colour[:3]))).round().astype(np.uint8)
    mesh["rgb"] = np.tile(colour, (mesh.n_points, 1))
    if baked:
        bake(mesh)
    return mesh


def joined(meshes: Sequence[Any]) -> Any:
    """Meshes of `mesh_of` as one, which is drawn far faster."""
    return meshes[0] if len(meshes) == 1 else meshes[0].append_polydata(*meshes[1:])


def add_textured(plotter: Any, shape: Shape, vertices: NDArray) -> Any:
    """Draw a shape with its texture; returns its actor."""
    import pyvista

    texture = shape.texture
    assert texture is not None
    points = np.asarray(vertices, np.float32)
    corners = np.arange(shape.faces.size).reshape(-1, 3)
    mesh = pyvista.PolyData.from_regular_faces(points[shape.faces].reshape(-1, 3), corners)
    with np.errstate(invalid="ignore", divide="ignore"):  # a triangle without an area has no normal
        normals = np.nan_to_num(corner_normals(points, shape.faces)).reshape(-1, 3)
    mesh.point_data.active_normals = normals
    mesh.active_texture_coordinates = texture.uvs.reshape(-1, 2)
    with opened_image(read_bytes(texture.file, "texture", "image")) as image:
        image.thumbnail((MOST_TEXELS, MOST_TEXELS))
        texels = np.asarray(image.convert("RGBA" if texture.see_through else "RGB"))
    if texture.factor != (1.0, 1.0, 1.0):
        scaled = srgb_from_linear(linear_from_srgb(texels[..., :3] / 255) * texture.factor)
        texels = np.concatenate([(255 * scaled).round().astype(np.uint8), texels[..., 3:]], axis=-1)
    drawn = pyvista.Texture(texels)
    drawn.repeat, drawn.interpolate, drawn.mipmap = True, True, True
    style = {name: value for name, value in style_of(False).items() if name not in ("scalars", "rgb")}
    return plotter.add_mesh(mesh, texture=drawn, color="white", opacity=shape.colour[3], **style)


def bake(mesh: Any) -> None:
    """Put the light of `LIGHTS` into the colours of a still mesh, to draw it without lighting."""
    normals = np.asarray(mesh.point_data.active_normals, float)
    shade = np.full(len(normals), AMBIENT)
    for direction, strength in LIGHTS:
        towards = np.array(direction) / np.linalg.norm(direction)
        shade += DIFFUSE * strength * np.maximum(normals @ towards, 0.0)
    mesh["rgb"] = np.minimum(mesh["rgb"] * shade[:, None], 255).round().astype(np.uint8)


def light(plotter: Any, everything: NDArray, *, soft: bool = True) -> None:
    """Light from four sides, the strongest from the upper left, with soft shadows in corners if `soft`."""
    import pyvista

    middle = everything.mean(axis=0)
    reach = float(np.linalg.norm(np.ptp(everything, axis=0)))
    for direction, strength in LIGHTS:
        place = middle + 3 * reach * np.array(direction)
        lamp = pyvista.Light(position=place, focal_point=middle, intensity=strength)
        lamp.positional = False
        plotter.add_light(lamp)
    if soft:
        plotter.enable_ssao(radius=0.08 * reach, bias=0.002 * reach, kernel_size=64, blur=True)


def aim(
    plotter: Any, camera: Camera, everything: NDArray, size: tuple[int, int], *, bar: bool = False
) -> None:
    """Set the camera; without a distance, it sees all points [m], shape (N, 3).

    They are kept to the left of a colour bar, if there is one; a camera with a distance has its target in the
    middle all the same.
    """
    axes, target = camera.axes(), np.array(camera.target, float)
    if camera.target is None:
        target = (everything.min(axis=0) + everything.max(axis=0)) / 2
    v = np.radians(camera.view_angle_deg) / 2
    h = np.arctan(np.tan(v) * size[0] / size[1] * (1 - BAR_SHARE * bar))
    distance = camera.distance_m or MARGIN * view_distance(everything, target, axes, (h, v))
    for _ in range(3 * (camera.distance_m is None and camera.target is None)):  # perspective is uneven
        right, up, back = ((everything - target) @ axes.T).T
        off = [(ends.min() + ends.max()) / 2 for ends in (right / (distance - back), up / (distance - back))]
        target = target + distance * (off @ axes[:2])
        distance = MARGIN * view_distance(everything, target, axes, (h, v))
    plotter.camera.position = target + distance * axes[2]
    plotter.camera.SetWindowCenter(BAR_SHARE if bar and camera.distance_m is None else 0.0, 0.0)
    plotter.camera.focal_point = target
    plotter.camera.up = axes[1]
    plotter.camera.view_angle = camera.view_angle_deg
    plotter.renderer.ResetCameraClippingRange()


def add_bar(plotter: Any, colour_map: str, limits: tuple[float, float], title: str, half: str = "") -> None:
    """A colour bar at the right, of the whole height or the "upper" or "lower" half."""
    import pyvista
    from matplotlib import colormaps

    if colour_map not in colormaps:
        raise InputError(f"the heat map's colourMap {colour_map!r} is none of matplotlib; correct the stage")
    points = pyvista.PolyData(np.zeros((2, 3)))
    ends, limits = limits, apart(*limits)
    points["field"] = np.array(limits)
    table = pyvista.LookupTable(colour_map, scalar_range=limits)
    actor = plotter.add_mesh(points, scalars="field", cmap=table, opacity=0, show_scalar_bar=False)
    letters = max(8, round(min(plotter.window_size[1], plotter.window_size[0] / 1.6) / 42))
    low, high = {"": (0.2, 0.6), "upper": (0.54, 0.36), "lower": (0.06, 0.36)}[half]
    left = min(0.92, 0.975 - 3.6 * letters / plotter.window_size[0])  # numbers of a small picture are wide
    place = {"vertical": True, "position_x": left, "position_y": low, "height": high, "width": 0.05}
    font = {"fmt": "%.0f", "color": INK, "title_font_size": letters, "label_font_size": letters}
    font |= {} if ends == limits else {"n_labels": 1}
    bar = plotter.add_scalar_bar(title=title, mapper=actor.mapper, **place, **font)
    background = pyvista.Color(BACKGROUND).float_rgb
    bar.SetTextPad(max(2, letters // 3))  # keeps numbers off the bar
    bar.DrawBackgroundOn()  # keeps it readable in front of anything
    bar.GetBackgroundProperty().SetColor(background)
    bar.GetBackgroundProperty().SetOpacity(0.7)
    bar.GetTitleTextProperty().SetBackgroundColor(background)
    bar.GetTitleTextProperty().SetBackgroundOpacity(0.7)
    bar.SetVerticalTitleSeparation(round(plotter.window_size[1] / 60))  # keeps it off the top number


class Cutaway:
    """Takes pictures of a plotter in which objects in front of the subject are a veil over it.

    Each picture is drawn whole, and with the subject alone and the robot alone on a transparent ground, each
    laid over the one before, so that all stays solid where it hides nothing of the subject.
    A camera below the floor sees the floor from below, without a cutaway.
    """

    def __init__(
        self, plotter: Any, size: tuple[int, int], screens: Sequence[Any], robot: Sequence[Any] = ()
    ) -> None:
        """Pictures of a rendered plotter, whose actors `screens` may hide the subject, but not `robot`."""
        others = [a for a in plotter.renderer.actors.values() if not any(a is part for part in robot)]
        self._plotter, self._size = plotter, size
        self._hidden = [actors for actors in (list(screens), others if robot else []) if actors]
        window = plotter.render_window
        window.SetAlphaBitPlanes(1)
        self._whole, self._subject = _grabber(window, alpha=False), _grabber(window, alpha=True)

    def image(self, *, whole: bool = False) -> NDArray[np.uint8]:
        """The picture from the present camera, shape (height, width, 3); all solid if `whole`."""
        image = self._grab(self._whole)
        for hidden in [] if whole else self._hidden:
            with self._without(hidden):
                subject = self._grab(self._subject)
            colour = subject[..., :3].astype(np.uint32)  # already multiplied by alpha, as its ground is black
            alpha = subject[..., 3:].astype(np.uint32)
            share = round(256 * (1 - VEIL))
            mixed = (image * (256 - share * alpha // 255) + share * colour) >> 8
            image = np.minimum(mixed, 255).astype(np.uint8)
        return image

    @contextmanager
    def _without(self, hidden: Sequence[Any]) -> Iterator[None]:
        """The plotter without some actors, on a transparent ground."""
        renderer = self._plotter.renderer
        ground, shown = renderer.GetBackground(), [actor.GetVisibility() for actor in hidden]
        try:
            for actor in hidden:
                actor.SetVisibility(False)
            renderer.SetBackground(0.0, 0.0, 0.0)
            renderer.SetBackgroundAlpha(0.0)
            yield
        finally:
            renderer.SetBackground(*ground)
            renderer.SetBackgroundAlpha(1.0)
            for actor, visible in zip(hidden, shown, strict=True):
                actor.SetVisibility(visible)

    def _grab(self, grabber: Any) -> NDArray[np.uint8]:
        """Render the window and copy it, shape (height, width, 3 or 4)."""
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self._plotter.render_window.Render()
        grabber.Modified()
        grabber.Update()
        pixels = vtk_to_numpy(grabber.GetOutput().GetPointData().GetScalars())
        return np.array(pixels.reshape(self._size[1], self._size[0], -1)[::-1], np.uint8)


def _grabber(window: Any, *, alpha: bool) -> Any:
    """A filter that copies a window without rendering it again, as pyvista's own would."""
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    grabber = vtkWindowToImageFilter()
    grabber.SetInput(window)
    (grabber.SetInputBufferTypeToRGBA if alpha else grabber.SetInputBufferTypeToRGB)()
    grabber.ReadFrontBufferOff()
    grabber.ShouldRerenderOff()
    return grabber
