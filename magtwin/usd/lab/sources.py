"""Magnetised things on a stage, authored as shapes with materials."""

from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from magtwin.errors import InputError, about
from magtwin.field.sources.magnets import body_of
from magtwin.field.sources.moments import mesh_moments
from magtwin.frames import IDENTITY_XYZW, canonical, quat_conjugate, quat_multiply, rotate, xyzw_from_wxyz
from magtwin.spec.base import ZERO3, Quat, Vec3
from magtwin.spec.magnetics import SourceSpec
from magtwin.usd.attributes import check_prim_name, plain_value, read_axis, read_number, write_pose
from magtwin.usd.lab.looks import define_looks, define_visual, hide, visual_path, wear
from magtwin.usd.layers import WORLD
from magtwin.usd.schema import apply_api, attribute_name, author, has_api, place, require_api
from magtwin.usd.solids import define_triangles, mesh_solid

SOURCES = WORLD.AppendChild("Sources")
LOOK = "Steel"
"""Material of a body that is no furniture."""

LOOKS = "Looks"
TYPES = {"point": "Xform", "cuboid": "Cube", "cylinder": "Cylinder", "sphere": "Sphere", "mesh": "Mesh"}
SHAPES = {kind: shape for shape, kind in TYPES.items()}

SQUARE = 1e-6
"""Largest cosine between perpendicular axes, and largest relative difference between equal widths."""

PARALLEL = 1e-12
"""Largest sine of half the angle between parallel axes."""

TURNS: dict[str, Quat] = {"X": (0.5, 0.5, 0.5, 0.5), "Y": (-0.5, -0.5, -0.5, 0.5), "Z": IDENTITY_XYZW}
"""Rotations from a cylinder's z to the axis of its prim."""

POSED = (["translate"], ["translate", "orient"], ["translate", "scale"], ["translate", "orient", "scale"])
"""Transforms that are read back exactly."""

Transform = tuple[Vec3, Quat, Vec3]
"""Position [m], orientation and scale."""


def define_source(
    stage: Usd.Stage, parent: str | Sdf.Path, spec: SourceSpec, *, look: str = LOOK, shown: bool = True
) -> Usd.Prim:
    """Author a magnetised thing as the child `spec.name` of a prim; its pose is in that prim's axes.

    Its cube, cylinder or sphere is a guide with the exact shape; a mesh below `Visuals` shows it.

    Args:
        stage: Written to in its edit target.
        parent: A prim with materials under `Looks`.
        spec: What to author: an Xform for a point, otherwise a prim of the shape.
        look: Name of its material.
        shown: Whether viewers show it.

    Raises:
        InputError: Its name cannot name a prim.
    """
    path = Sdf.Path(str(parent)).AppendChild(check_prim_name(spec.name, "source"))
    prim = stage.DefinePrim(path, TYPES[spec.shape])
    figures: dict[str, Any] = {"magnetization": spec.magnetization, "susceptibility": spec.susceptibility}
    if spec.shape == "point":
        write_pose(prim, spec.p_world)
        figures = {"moment": spec.m_world}
    else:
        _define_shape(prim, spec)
        material = path.GetParentPath().AppendChild(LOOKS).AppendChild(look)
        if spec.shape == "mesh" and shown:
            wear(UsdGeom.Gprim(prim), material)
        else:
            hide(UsdGeom.Gprim(prim), material)
        if spec.shape != "mesh" and shown:
            where = spec.p_world, spec.size_m, material
            define_visual(stage, visual_path(path), spec.shape, *where, q_xyzw=_turn(spec))
    apply_api(prim, "source")
    for name, value in figures.items():
        author(prim.GetAttribute(attribute_name("source", name)), value)
    return prim


def define_sources(stage: Usd.Stage, sources: tuple[SourceSpec, ...]) -> None:
    """Author magnetised things under /World/Sources, which is at the origin.

    Those below the floor, z = 0, are guides: no one sees them, and they would enlarge the bounding box.
    """
    UsdGeom.Xform.Define(stage, SOURCES)
    if any(source.shape != "point" for source in sources):
        define_looks(stage, SOURCES.AppendChild(LOOKS), [LOOK])
    for source in sources:
        define_source(stage, SOURCES, source, shown=top_of(source) > 0)


def top_of(spec: SourceSpec) -> float:
    """Height of the top of a source, or of the box around it [m]."""
    corners = np.array(spec.vertices_m or [spec.size_m]) * (1 if spec.vertices_m else 0.5)
    up = rotate(quat_conjugate(spec.q_world_xyzw), (0.0, 0.0, 1.0))
    heights = corners @ up if spec.vertices_m else np.abs(corners) @ np.abs(up)
    return float(spec.p_world[2] + heights.max())


def _define_shape(prim: Usd.Prim, spec: SourceSpec) -> None:
    """A body's geometry; a box is a scaled cube."""
    write_pose(prim, spec.p_world, _turn(spec))
    x, y, z = spec.size_m
    half = Gf.Vec3f(x / 2, y / 2, z / 2)
    extent = [-half, half]
    if spec.shape == "cuboid":
        UsdGeom.Cube(prim).CreateSizeAttr(1.0)
        UsdGeom.Cube(prim).AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*spec.size_m))
        extent = [Gf.Vec3f(-0.5), Gf.Vec3f(0.5)]
    elif spec.shape == "cylinder":
        UsdGeom.Cylinder(prim).CreateRadiusAttr(x / 2)
        UsdGeom.Cylinder(prim).CreateHeightAttr(z)
        UsdGeom.Cylinder(prim).CreateAxisAttr(UsdGeom.Tokens.z)
    elif spec.shape == "sphere":
        UsdGeom.Sphere(prim).CreateRadiusAttr(x / 2)
    else:
        define_triangles(UsdGeom.Mesh(prim), spec.vertices_m, spec.faces)
        return
    UsdGeom.Gprim(prim).CreateExtentAttr(Vt.Vec3fArray(extent))


def _turn(spec: SourceSpec) -> Quat | None:
    """Orientation of a source; None if it is not turned."""
    return None if spec.q_world_xyzw == IDENTITY_XYZW else spec.q_world_xyzw


def source_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every active prim that is a source, also invisible ones and those inside instances."""
    return [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if has_api(prim, "source")]


def read_source(prim: Usd.Prim, *, name: str | None = None, local: bool = False) -> SourceSpec:
    """The spec of a source.

    Args:
        prim: Has the schema.
        name: Name of the source. Default: the prim's name.
        local: Whether the pose is in the parent's axes instead of world.

    Raises:
        InputError: The prim is no source, is sheared or mirrored, its mesh is open, or a value is out of
            range.
    """
    require_api(prim, "source")
    shape = SHAPES.get(prim.GetTypeName())
    if shape is None:
        raise InputError(
            f"{place(prim)}: a {prim.GetTypeName() or 'prim without type'} cannot be a magnetic source; "
            f"put MagtwinMagneticSourceAPI on {', '.join(SHAPES)}"
        )
    above = map(prim.GetStage().GetPrimAtPath, prim.GetPath().GetParentPath().GetPrefixes())
    if any(parent.IsA(UsdGeom.PointInstancer) for parent in above):
        raise InputError(
            f"{place(prim)}: a magnetic source below a PointInstancer has no single place; reference it "
            "at its place, as an instance if needed"
        )
    keys = ("moment", "magnetization", "susceptibility")
    figures = {key: plain_value(prim.GetAttribute(attribute_name("source", key))) for key in keys}
    p, q, scale = read_transform(prim, local=local)
    with about(f"{place(prim)}:"):
        spec: dict[str, Any] = {"name": name or prim.GetName(), "p_world": p, "shape": shape}
        if shape == "point":
            return _point(spec, q, **figures)
        geometry, turn = _geometry(prim, shape, scale)
        own = {key: _vec3(rotate(quat_conjugate(turn), figures[key])) for key in ("moment", "magnetization")}
        spec |= geometry | {"q_world_xyzw": q if turn == IDENTITY_XYZW else _product(q, turn)}
        if own["moment"] != ZERO3:
            if own["magnetization"] != ZERO3:
                raise InputError("has both a moment and a magnetization; give one of them")
            volume_m3 = body_of(SourceSpec(**spec)).volume_m3
            own["magnetization"] = _vec3(part / volume_m3 for part in own["moment"])
        spec |= {"magnetization": own["magnetization"], "susceptibility": figures["susceptibility"]}
        return SourceSpec(**spec)


def _point(
    spec: dict[str, Any], q: Quat, *, moment: Vec3, magnetization: Vec3, susceptibility: float
) -> SourceSpec:
    """The dipole of an Xform, with its moment in world axes."""
    if magnetization != ZERO3 or susceptibility:
        raise InputError(
            "an Xform has no volume to be magnetised; give it a moment, or put the schema on its Cube, "
            "Cylinder, Sphere or Mesh"
        )
    return SourceSpec(**spec, m_world=moment if q == IDENTITY_XYZW else _vec3(rotate(q, moment)))


def _geometry(prim: Usd.Prim, shape: str, scale: Vec3) -> tuple[dict[str, Any], Quat]:
    """Size, or vertices and faces, in the body's axes, and the rotation from these to the prim's."""
    if shape == "mesh":
        points, faces = _triangles(UsdGeom.Mesh(prim), scale)
        if len(faces) and mesh_moments(points, faces)[0] < 0:
            faces = faces[:, ::-1]
        vertices, corners = (tuple(map(tuple, array.tolist())) for array in (points, faces))
        return {"vertices_m": vertices, "faces": corners}, IDENTITY_XYZW
    if shape == "cuboid":
        size = read_number(prim, "size")
        return {"size_m": (size * scale[0], size * scale[1], size * scale[2])}, IDENTITY_XYZW
    if shape == "sphere":
        wide = 2 * read_number(prim, "radius")
        _check_round(scale, "a sphere's scale")
        return {"size_m": (wide * scale[0],) * 3}, IDENTITY_XYZW
    axis = read_axis(prim)
    along = "XYZ".index(axis)
    across = [scale[k] for k in range(3) if k != along]
    _check_round(across, "a cylinder's scale across its axis")
    wide = 2 * read_number(prim, "radius") * across[0]
    return {"size_m": (wide, wide, read_number(prim, "height") * scale[along])}, TURNS[axis]


def _triangles(mesh: UsdGeom.Mesh, scale: Vec3) -> tuple[Any, Any]:
    """A mesh's distinct vertices, and its polygons as fans of triangles."""
    solid = mesh_solid(mesh)
    points, faces = solid.points, solid.corners[solid.triangles]
    points = np.asarray(points * scale, np.float32).astype(float)
    places, index = np.unique(points[faces.ravel()], axis=0, return_inverse=True)
    if len(places) < len(points):  # doubled, as at seams, or of no face
        points, faces = places, index.reshape(-1, 3)
        flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
        faces = faces[~flat]
    return points, faces


def _check_round(scales: Any, what: str) -> None:
    if max(scales) - min(scales) > SQUARE * max(scales):
        seen = ", ".join(f"{s:g}" for s in scales)
        raise InputError(f"{what} must be the same each way, got {seen}; use a Mesh for an ellipsoid or oval")


def read_transform(prim: Usd.Prim, *, local: bool = False) -> Transform:
    """Position [m], orientation and scale of a prim in world, or in its parent.

    A transform that magtwin wrote is read back exactly, another one is composed.

    Raises:
        InputError: The transform is mirrored, sheared, flat or not finite.
    """
    xformable = UsdGeom.Xformable(prim)
    ops = xformable.GetOrderedXformOps()
    cache = UsdGeom.XformCache()
    plain = local or cache.GetParentToWorldTransform(prim) == Gf.Matrix4d(1)
    if plain and [op.GetOpName().removeprefix("xformOp:") for op in ops] in (*POSED, []):
        values = {op.GetOpName(): value for op in ops if (value := op.Get()) is not None}
        turn = values.get("xformOp:orient", Gf.Quatd(1))
        turn = turn if isinstance(turn, Gf.Quatd) else Gf.Quatd(turn).GetNormalized()
        p = Gf.Vec3d(values.get("xformOp:translate", Gf.Vec3d(0)))
        scale = Gf.Vec3d(values.get("xformOp:scale", Gf.Vec3d(1)))
        if min(scale) > 0:
            return _vec3(p), _quat(turn), _vec3(scale)
    matrix = xformable.GetLocalTransformation() if local else cache.GetLocalToWorldTransform(prim)
    rows = np.array(matrix)[:3, :3]
    lengths = np.sqrt(np.square(rows).sum(axis=1))
    if not (np.isfinite(np.array(matrix)).all() and lengths.min() > 0):
        text = "its transform flattens it or is not finite; a source needs its size"
        raise InputError(f"{place(prim)}: {text}")
    rows = rows / lengths[:, None]
    if np.abs(rows @ rows.T - np.eye(3)).max() > SQUARE:
        raise InputError(
            f"{place(prim)}: it is sheared, by a scale above a turn; scale it along its own axes, or bake "
            "the transform into a mesh"
        )
    if np.linalg.det(rows) < 0:
        text = "it is mirrored by a negative scale, so its magnetization is ambiguous; turn it instead"
        raise InputError(f"{place(prim)}: {text}")
    turned = Gf.Matrix4d(1)
    turned.SetRotateOnly(Gf.Matrix3d(*rows.ravel().tolist()))
    x, y, z = matrix.ExtractTranslation()
    q = turned.ExtractRotationQuat().GetNormalized()
    straight = q.GetImaginary().GetLength() <= PARALLEL
    return (x, y, z), IDENTITY_XYZW if straight else _quat(q), _vec3(lengths)


def _quat(turn: Gf.Quatd) -> Quat:
    """A quaternion as xyzw."""
    x, y, z, w = xyzw_from_wxyz((turn.GetReal(), *turn.GetImaginary())).tolist()
    return (x, y, z, w)


def _product(a: Quat, b: Quat) -> Quat:
    x, y, z, w = canonical(quat_multiply(a, b)).tolist()
    return (x, y, z, w)


def _vec3(v: Any) -> Vec3:
    x, y, z = (float(c) + 0.0 for c in v)
    return (x, y, z)
