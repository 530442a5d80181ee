"""Shapes and links of a stage: triangles that a viewer shows, and the rigid bodies that carry them."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.errors import InputError
from magtwin.files.budget import CORNERS, SHAPES
from magtwin.frames import IDENTITY_XYZW, canonical, rotate
from magtwin.spec.base import ZERO3, Quat, Vec3
from magtwin.usd.attributes import read_axis
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.schema import place
from magtwin.usd.solids import Solid, solid_of
from magtwin.usd.trial import check_named

GREY = (0.5, 0.5, 0.5, 1.0)
"""Colour of a shape without one."""

SHOWN = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
"""USD purposes that a viewer shows."""

FARTHEST_M = 1e9
"""Farthest that a vertex of a face may lie from the origin [m]."""

ACROSS = 1e-6
"""Least component of a wheel's axis along -y of its base at which the axis points right."""

BASE_LINK = "base_link"
"""Name of the link whose frame is the robot's, as in REP-105."""


@dataclass(frozen=True)
class Texture:
    """An image on the triangles of a shape."""

    file: Path
    """The image."""

    uvs: NDArray[np.float32]
    """Texture coordinates at the corners of the triangles, from the image's lower left, shape (F, 3, 2)."""

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear colour that multiplies it."""

    see_through: bool = False
    """Whether its alpha is the opacity."""


@dataclass(frozen=True)
class Shape:
    """Triangles of one colour, or coloured by vertex, in the frame of their body."""

    prim: str
    """Path of the gprim, or of the GeomSubset of a mesh with several materials."""

    link: str
    """Name of the rigid body that carries it; "" if it stands still."""

    vertices: NDArray[np.float32]
    """Vertices in the link's frame, or in world if nothing carries it [m], shape (V, 3)."""

    faces: NDArray[np.int32]
    """Corners of the triangles, counter-clockwise from outside, shape (F, 3)."""

    colour: tuple[float, float, float, float]
    """Red, green, blue, opacity, 0 to 1, linear."""

    vertex_colours: NDArray[np.float32] | None = None
    """Red, green, blue of each vertex, 0 to 1, linear, shape (V, 3); None for a single colour."""

    texture: Texture | None = None
    """Its colour texture, of which `colour` is the mean; None if it has none that can be read."""


@dataclass(frozen=True)
class Link:
    """A rigid body: its pose at rest, and the joint that moves it."""

    name: str
    """Name of its prim, or its path if another body has the name."""

    p_base_link: Vec3
    """Origin in the base link of its robot, at rest [m]."""

    q_base_link_xyzw: Quat
    """Axes in the base link of its robot, at rest."""

    axis_link: Vec3 | None = None
    """Axis of rotation in the link's frame, unit length; None if it does not turn."""

    joint: str = ""
    """Name of the joint to its parent; "" for a base."""

    p_world_link: Vec3 = ZERO3
    """Origin in world on the stage [m]."""

    q_world_link_xyzw: Quat = IDENTITY_XYZW
    """Axes in world on the stage."""

    base: str = ""
    """Name of the base of its robot; its own name if it has no joint."""

    @property
    def sense(self) -> int:
        """-1 if a wheel rolls backward as its joint's angle grows, since its axis points right; else 1."""
        if self.axis_link is None:
            return 1
        return -1 if rotate(self.q_base_link_xyzw, self.axis_link)[1] < -ACROSS else 1

    @property
    def rolling_axis(self) -> Vec3 | None:
        """Axis in the link's frame about which a wheel that rolls forward turns by a positive angle."""
        if self.axis_link is None or self.sense > 0:
            return self.axis_link
        x, y, z = (0.0 - v for v in self.axis_link)
        return x, y, z


@dataclass(frozen=True)
class ColourScale:
    """The colour scale of a stage's heat map."""

    name: str
    """Name of matplotlib's colour map."""

    least: float
    """Value of the first colour."""

    greatest: float
    """Value of the last colour."""

    unit: str
    """Unit of both."""

    prim: str = ""
    """Path of the heat map's mesh."""

    heading: str = ""
    """Heading of the map that is shown [deg]."""

    def title(self, what: str) -> str:
        """The name of a colour bar."""
        return f"{what} [{self.unit}]" + (f"\nheading {self.heading}°" if self.heading else "")


@translates
def read_shapes(stage: Usd.Stage | str | os.PathLike[str], *, purposes: Sequence[str] = SHOWN) -> list[Shape]:
    """All visible shapes of a stage as triangles, in order of the prims.

    Meshes, cubes, spheres, cylinders, cones, capsules and planes count, also inside instances. Colliders
    (purpose guide) and proxies are left out by default. Subdivision surfaces become their control mesh.

    Args:
        stage: A stage, or the path of a USD file.
        purposes: USD purposes to read.

    Raises:
        InputError: The file is missing or not USD, or has too many shapes; or a mesh is inconsistent, whose
            prim the text names.
    """
    stage = stage if isinstance(stage, Usd.Stage) else open_stage(stage)
    _check_amount(stage)
    return [shape for shown in _shown(stage, purposes) for shape in _shapes(*shown)]


def read_vertices(
    stage: Usd.Stage,
    *,
    purposes: Sequence[str] = SHOWN,
    wanted: Callable[[Usd.Prim, bool], bool] = lambda prim, carried: True,
) -> dict[Sdf.Path, tuple[str, NDArray[np.float32]]]:
    """The vertices of the shapes that `read_shapes` reads, which is faster.

    Args:
        stage: A stage.
        purposes: USD purposes to read.
        wanted: Function of a prim, and of whether a rigid body carries it: whether to read it.

    Returns:
        By path of the gprim: the name of its body ("" for none), and the vertices of its faces in the body's
        frame or else in world [m], shape (V, 3).
    """
    found = {}
    for gprim, solid, to_frame, name in _shown(stage, purposes, wanted):
        used = np.zeros(len(solid.points), bool)
        used[solid.corners] = True
        if used.any():
            found[gprim.GetPath()] = name, _placed(gprim, solid, to_frame)[used].astype(np.float32)
    return found


def read_triangles(
    stage: Usd.Stage, *, purposes: Sequence[str], wanted: Callable[[Usd.Prim, bool], bool]
) -> dict[Sdf.Path, NDArray[np.float64]]:
    """The triangles of the shapes that `read_shapes` reads, without colours.

    Args:
        stage: A stage.
        purposes: USD purposes to read.
        wanted: Function of a prim, and of whether a rigid body carries it: whether to read it.

    Returns:
        By path of the gprim: its triangles in its body's frame or else in world [m], shape (T, 3, 3).
    """
    found = {}
    for gprim, solid, to_frame, _ in _shown(stage, purposes, wanted):
        points = _placed(gprim, solid, to_frame).astype(np.float32)
        found[gprim.GetPath()] = points[solid.corners[solid.triangles]].astype(float)
    return found


@translates
def read_links(stage: Usd.Stage | str | os.PathLike[str]) -> dict[str, Link]:
    """The rigid bodies of a stage by name, with their poses at rest in the base of their robot.

    The base is the body called `base_link`, or else the root of the tree of joints. A body without a joint is
    its own base.

    Args:
        stage: A stage, or the path of a USD file.

    Raises:
        InputError: The file is missing or not USD, or joints form a loop.
    """
    stage = stage if isinstance(stage, Usd.Stage) else open_stage(stage)
    cache, bodies = UsdGeom.XformCache(), _bodies(stage)
    whole = {path: cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)) for path in bodies}
    world = {path: matrix.RemoveScaleShear() for path, matrix in whole.items()}
    above = {child: (joint, parent) for joint, parent, child in _joints(stage, bodies)}
    roots = _roots(bodies, above)
    named = {roots[path]: path for path in bodies if path.name == BASE_LINK}
    links = {}
    for path, name in bodies.items():
        joint = above[path][0] if path in above else None
        base = named.get(roots[path], roots[path])
        p, q = _pose(world[path] * world[base].GetInverse())
        p_world, q_world = _pose(world[path])
        links[name] = Link(
            name=name,
            p_base_link=p,
            q_base_link_xyzw=q,
            axis_link=None if joint is None else axis_of(joint),
            joint="" if joint is None else joint.GetPrim().GetName(),
            p_world_link=p_world,
            q_world_link_xyzw=q_world,
            base=bodies[base],
        )
    return links


def read_colour_scale(stage: Usd.Stage) -> ColourScale | None:
    """The scale of the first visible heat map of a stage; None if there is none."""
    for prim in _prims(stage):
        data = prim.GetCustomDataByKey("magtwin")
        shown = isinstance(data, dict) and "colourMap" in data
        if not shown or UsdGeom.Imageable(prim).ComputeVisibility() == "invisible":
            continue
        texts = [x for x in map(data.get, ("colourMap", "unit")) if isinstance(x, str)]
        numbers = [x for x in map(data.get, ("least", "greatest")) if isinstance(x, int | float)]
        if len(texts) < 2 or len(numbers) < 2 or not np.isfinite(numbers).all():
            raise InputError(
                f"{place(prim)}: the colour scale in its customData wants colourMap and unit as texts, "
                "least and greatest as numbers; correct it"
            )
        heading = prim.GetVariantSet("heading").GetVariantSelection().replace("_", ".")
        return ColourScale(texts[0], numbers[0], numbers[1], texts[1], str(prim.GetPath()), heading)
    return None


def _prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Every prim, also inside instances."""
    return iter(stage.Traverse(Usd.TraverseInstanceProxies()))


_PLAIN = {"Cube": 36, "Plane": 6, "Cone": 192, "Cylinder": 384}
"""Corners of the triangles of primitives; of a sphere or capsule at most `_ROUND`."""

_ROUND = 3072


def _check_amount(stage: Usd.Stage) -> None:
    """Refuse a stage with too many shapes, those of instances counted in each place, before they are read."""
    amounts: dict[Sdf.Path, tuple[int, int]] = {}
    held = 0

    def amount(top: Usd.Prim) -> tuple[int, int]:
        """Shapes and corners below a prim."""
        nonlocal held
        shapes = corners = 0
        for prim in Usd.PrimRange(top):
            if prim.IsA(UsdGeom.Gprim):
                own = _PLAIN.get(prim.GetTypeName(), _ROUND)
                if prim.IsA(UsdGeom.Mesh):
                    own = len(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get() or ())
                    held += own
                shapes, corners = shapes + 1, corners + own
            if prim.IsInstance():
                prototype = prim.GetPrototype()
                if prototype.GetPath() not in amounts:
                    amounts[prototype.GetPath()] = amount(prototype)
                more = amounts[prototype.GetPath()]
                shapes, corners = shapes + more[0], corners + more[1]
        return shapes, corners

    shapes, corners = amount(stage.GetPseudoRoot())
    for count, most, noun in ((shapes, SHAPES, "shapes"), (corners - held, CORNERS, "corners of faces")):
        if count > most:
            raise InputError(
                f"{stage.GetRootLayer().identifier}: has {count:,} {noun} with those of instances; at most "
                f"{most:,} are drawn or exported; deactivate some"
            )


def _shown(
    stage: Usd.Stage,
    purposes: Sequence[str],
    wanted: Callable[[Usd.Prim, bool], bool] = lambda prim, carried: True,
) -> Iterator[tuple[UsdGeom.Gprim, Solid, NDArray, str]]:
    """Visible gprims with a surface, their transform to the frame of their body (4, 4), and its name."""
    cache, bodies = UsdGeom.XformCache(), _bodies(stage)
    for prim in _prims(stage):
        gprim = UsdGeom.Gprim(prim)
        if not gprim or gprim.ComputePurpose() not in purposes:
            continue
        if gprim.ComputeVisibility() == UsdGeom.Tokens.invisible:
            continue
        body = prim
        while body and body.GetPath() not in bodies:
            body = body.GetParent()
        body = body or None
        if not wanted(prim, body is not None):
            continue
        solid = solid_of(gprim)
        if solid is None:
            continue
        to_frame = cache.GetLocalToWorldTransform(prim)
        if body is not None:
            to_frame *= cache.GetLocalToWorldTransform(body).RemoveScaleShear().GetInverse()
        yield gprim, solid, np.array(to_frame), "" if body is None else bodies[body.GetPath()]


def _bodies(stage: Usd.Stage) -> dict:
    """Unique names of the rigid bodies by path."""
    names: dict = {}
    for prim in _prims(stage):
        if prim.HasAPI(UsdPhysics.RigidBodyAPI):
            taken = prim.GetName() in names.values()
            names[prim.GetPath()] = str(prim.GetPath()) if taken else prim.GetName()
    return names


def _joints(stage: Usd.Stage, bodies: dict) -> Iterator[tuple]:
    """Joint, parent body and child body of every joint between two bodies."""
    for prim in _prims(stage):
        joint = UsdPhysics.Joint(prim)
        if not joint:
            continue
        ends = [rel.GetTargets() for rel in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        if all(len(end) == 1 and end[0] in bodies for end in ends):
            yield joint, ends[0][0], ends[1][0]


def _roots(bodies: dict, above: dict) -> dict:
    """The root of the tree of joints above each body."""
    roots: dict = {}
    for path in bodies:
        seen = [path]
        known = {path}
        while seen[-1] in above and seen[-1] not in roots:
            parent = above[seen[-1]][1]
            if parent in known:
                loop = " -> ".join(map(str, seen[seen.index(parent) :]))
                raise InputError(f"{parent}: its joints form a loop: {loop}")
            seen.append(parent)
            known.add(parent)
        root = roots.get(seen[-1], seen[-1])
        roots.update(dict.fromkeys(seen, root))
    return roots


def axis_of(joint: UsdPhysics.Joint) -> Vec3 | None:
    """The axis of a revolute joint in the frame of its second body; None for another joint."""
    revolute = UsdPhysics.RevoluteJoint(joint.GetPrim())
    if not revolute:
        return None
    axis = Gf.Vec3d(*("XYZ".index(read_axis(revolute.GetPrim(), "physics:axis")) == i for i in range(3)))
    turned = Gf.Rotation(joint.GetLocalRot1Attr().Get()).TransformDir(axis)
    x, y, z = (round(float(c), 9) + 0.0 for c in turned)
    return (x, y, z)


def _pose(matrix: Gf.Matrix4d) -> tuple[Vec3, Quat]:
    """Position and quaternion xyzw (w >= 0) of a rigid transform."""
    q, (px, py, pz) = matrix.ExtractRotationQuat(), matrix.ExtractTranslation()
    x, y, z, w = (float(v) for v in canonical([*q.GetImaginary(), q.GetReal()]))
    return (float(px), float(py), float(pz)), (x, y, z, w)


def _shapes(gprim: UsdGeom.Gprim, solid: Solid, to_frame: NDArray, link: str) -> list[Shape]:
    """The shapes of one gprim: one, plus one for each subset with its own material."""
    prim = gprim.GetPrim()
    points = _placed(gprim, solid, to_frame)
    mirrored = np.linalg.det(to_frame[:3, :3]) < 0
    parts = [prim]
    part_of = np.zeros(solid.origin.max(initial=-1) + 1, np.int32)  # of each face
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        faces = np.array(subset.GetIndicesAttr().Get() or [], int)
        part_of[faces[(faces >= 0) & (faces < len(part_of))]] = len(parts)
        parts.append(subset.GetPrim())
    part_of = part_of[solid.origin]
    order = np.argsort(part_of, kind="stable")
    ends = np.searchsorted(part_of[order], np.arange(len(parts) + 1))
    shapes = []
    for part, begin, end in zip(parts, ends, ends[1:], strict=False):
        rows = order[begin:end]
        if not len(rows):
            continue
        material = _material_colour(part)
        vertices, corners = points, solid.corners[solid.triangles[rows]]
        colours = None if material is not None else _display_colours(gprim, solid, rows)
        texture = None if material is not None else _texture(part, gprim, solid.triangles[rows], mirrored)
        if texture is not None and colours is not None:
            r, g, b = map(float, colours.mean(axis=0))
            material, colours = (r, g, b, 1.0), None
        if colours is not None and len(colours) != len(points):  # each corner has its own
            vertices, corners = points[corners.ravel()], np.arange(corners.size).reshape(-1, 3)
        used, faces = np.unique(corners[:, ::-1] if mirrored else corners, return_inverse=True)
        shapes.append(
            Shape(
                prim=str(part.GetPath()),
                link=link,
                vertices=vertices[used].astype(np.float32),
                faces=faces.reshape(-1, 3).astype(np.int32),
                colour=_display_colour(gprim) if material is None else material,
                vertex_colours=None if colours is None else colours[used].astype(np.float32),
                texture=texture,
            )
        )
    return shapes


def _placed(gprim: UsdGeom.Gprim, solid: Solid, to_frame: NDArray) -> NDArray[np.float64]:
    """Points of a solid, transformed by a matrix for row vectors (4, 4), shape (V, 3)."""
    points = np.column_stack([solid.points, np.ones(len(solid.points))]) @ to_frame[:, :3]
    far = ~(np.abs(points).max(axis=1, initial=0) <= FARTHEST_M)
    if far.any() and far[solid.corners].any():
        first = points[solid.corners[far[solid.corners]][0]]
        raise InputError(
            f"{place(gprim.GetPrim())}: a vertex is at ({', '.join(f'{x:.4g}' for x in first)}) m, which "
            f"is not finite or over {FARTHEST_M:.0e} m away; correct the shape or its transform"
        )
    return points


def _surface(prim: Usd.Prim) -> UsdShade.Shader | None:
    """The surface shader of the bound material."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return material.ComputeSurfaceSource()[0] if material else None


def _material_colour(prim: Usd.Prim) -> tuple[float, float, float, float] | None:
    """Colour and opacity of the bound UsdPreviewSurface; None if a primvar gives its colour."""
    surface = _surface(prim)
    if not surface or surface.GetIdAttr().Get() != "UsdPreviewSurface":
        return None
    diffuse, opacity = surface.GetInput("diffuseColor"), surface.GetInput("opacity")
    if diffuse and diffuse.HasConnectedSource():
        return None
    colour = diffuse.Get() if diffuse else None
    r, g, b = Gf.Vec3f(0.18) if colour is None else Gf.Vec3f(colour)  # the schema's own fallback
    a = opacity.Get() if opacity else None
    if a is not None and not isinstance(a, int | float):
        raise InputError(f"{place(surface.GetPrim())}: inputs:opacity must be a number; correct it")
    return (float(r), float(g), float(b), 1.0 if a is None else float(a))


def _texture(prim: Usd.Prim, gprim: UsdGeom.Gprim, triangles: NDArray, mirrored: bool) -> Texture | None:
    """The texture of the bound material's colour, on triangles of face-vertex indices, shape (F, 3)."""
    triangles = triangles[:, ::-1] if mirrored else triangles
    surface = _surface(prim)
    shader, channel = _source(surface, "diffuseColor")
    reader, _ = _source(shader, "st")
    if channel != "rgb" or shader is None or reader is None or shader.GetIdAttr().Get() != "UsdUVTexture":
        return None
    asset, name = shader.GetInput("file"), reader.GetInput("varname")
    file = asset.Get() if asset else None
    path = file.resolvedPath if isinstance(file, Sdf.AssetPath) else ""
    if not name or not Path(path).is_file():  # missing, or within a .usdz
        return None
    if root := prim.GetStage().GetRootLayer().realPath:
        check_named(Path(root), Path(path), f"<{asset.GetAttr().GetPath()}>")
    primvar = UsdGeom.PrimvarsAPI(gprim).FindPrimvarWithInheritance(str(name.Get()))
    values = primvar.ComputeFlattened() if primvar else None
    uvs = np.array(values if values else np.empty((0, 2)), np.float32).reshape(-1, 2)
    by_corner = primvar and primvar.GetInterpolation() == UsdGeom.Tokens.faceVarying
    if not by_corner or triangles.max(initial=0) >= len(uvs):
        return None
    scale = shader.GetInput("scale").Get() if shader.GetInput("scale") else None
    r, g, b, _ = Gf.Vec4f(1) if scale is None else Gf.Vec4f(scale)
    cut_out, alpha = _source(surface, "opacity")
    return Texture(Path(path), uvs[triangles], (r, g, b), bool(cut_out) and alpha == "a")


def _source(shader: UsdShade.Shader | None, name: str) -> tuple[UsdShade.Shader | None, str]:
    """The shader that is connected to an input, and its output."""
    given = shader.GetInput(name) if shader else None
    if not given or not given.HasConnectedSource():
        return None, ""
    source = given.GetConnectedSources()[0][0]
    return UsdShade.Shader(source.source.GetPrim()), source.sourceName


def _display_colour(gprim: UsdGeom.Gprim) -> tuple[float, float, float, float]:
    """The constant displayColor and displayOpacity, or the mean of varying ones."""
    colours, opacities = gprim.GetDisplayColorAttr().Get(), gprim.GetDisplayOpacityAttr().Get()
    if not colours:
        return GREY
    r, g, b = np.mean(np.array(colours, float), axis=0)
    return (float(r), float(g), float(b), float(np.mean(opacities)) if opacities else 1.0)


def _display_colours(gprim: UsdGeom.Gprim, solid: Solid, rows: NDArray) -> NDArray | None:
    """DisplayColor by point (P, 3), or by corner of the chosen triangles (3 F, 3); None if constant."""
    primvar = gprim.GetDisplayColorPrimvar()
    colours = primvar.ComputeFlattened()
    if not colours or len(colours) == 1:
        return None
    values: NDArray = np.array(colours, float)
    kind = primvar.GetInterpolation()
    if kind in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying) and len(values) == len(solid.points):
        return values
    if kind == UsdGeom.Tokens.faceVarying and len(values) == len(solid.corners):
        return values[solid.triangles[rows]].reshape(-1, 3)
    if kind == UsdGeom.Tokens.uniform and len(values) > solid.origin.max():
        return np.repeat(values[solid.origin[rows]], 3, axis=0)
    raise InputError(
        f"{gprim.GetPath()}: {len(values)} displayColor values of interpolation {kind!r} do not fit its "
        f"{len(solid.points)} points; author one for each"
    )


def srgb_from_linear(colour: ArrayLike) -> NDArray[np.float64]:
    """SRGB colours (IEC 61966-2-1) from linear ones as in USD, any shape, 0 to 1."""
    c = np.clip(np.nan_to_num(np.asarray(colour, float)), 0, 1)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


def linear_from_srgb(colour: ArrayLike) -> NDArray[np.float64]:
    """Linear colours as in USD from sRGB, any shape, 0 to 1: inverse of `srgb_from_linear`."""
    c = np.clip(np.nan_to_num(np.asarray(colour, float)), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
