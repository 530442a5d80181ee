"""Solids: primitives and meshes of USD as triangles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Sdf, UsdGeom, Vt

from magtwin.errors import InputError, about
from magtwin.usd.attributes import read_axis, read_number

SEGMENTS = 32
"""Sides of the polygon that approximates a circle."""

CREASE = np.radians(35)
"""Faces that meet at a smaller angle than this are shaded as one smooth surface [rad]."""

FAN = 64
"""Where more faces than this meet, as at tips and in the middle of discs, each keeps its own normal."""

SMOOTH = np.cos(CREASE / 2) + 1e-5
"""Cosine of the angle to their common normal below which all faces of a point are within CREASE."""

PAIRS = 2**19
"""Most pairs of corners that are compared at once."""

Triangles = tuple[NDArray, NDArray]
"""Points [m], shape (V, 3), and the corners of triangles, counter-clockwise from outside, shape (F, 3)."""


@dataclass(frozen=True)
class Solid:
    """Points of a gprim, and the triangles between them, each with the face that it was cut from."""

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    """Corners of the triangles as indices into the face-vertex list, shape (F, 3)."""
    corners: NDArray[np.int64]
    """Index of the point at each entry of the face-vertex list."""
    origin: NDArray[np.int64]
    """Index of the face that each triangle is a part of, shape (F,)."""


def solid_of(gprim: UsdGeom.Gprim) -> Solid | None:
    """A gprim in its own space; None for kinds without a surface (points, curves).

    Raises:
        InputError: It is an inconsistent mesh, or its axis or a length is none; the text names the prim.
    """
    prim = gprim.GetPrim()
    if prim.IsA(UsdGeom.Mesh):
        with about(f"{prim.GetPath()}:"):
            return mesh_solid(UsdGeom.Mesh(prim))
    kind = prim.GetTypeName()
    if kind == "Cube":
        return _faces(*box(read_number(prim, "size")))
    if kind == "Sphere":
        return _faces(*sphere(read_number(prim, "radius")))
    if kind not in ("Plane", "Cone", "Cylinder", "Capsule"):
        return None
    axis = read_axis(prim)
    if kind == "Plane":
        return _faces(*_plane(read_number(prim, "width"), read_number(prim, "length"), axis))
    radius, height = read_number(prim, "radius"), read_number(prim, "height")
    if kind == "Cone":
        return _faces(*_revolved(np.array([[0, -height / 2], [radius, -height / 2], [0, height / 2]]), axis))
    return _faces(*(cylinder if kind == "Cylinder" else capsule)(radius, height, axis))


def mesh_solid(mesh: UsdGeom.Mesh) -> Solid:
    """A mesh's polygons as fans of triangles, without holes.

    Raises:
        InputError: Its indices, counts and points do not fit together.
    """
    points = np.array(mesh.GetPointsAttr().Get() or np.empty((0, 3)), float)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], int)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], int)
    if counts.min(initial=0) < 0:
        raise InputError(f"one of its faces has {counts.min()} corners; export the mesh again")
    outside = len(corners) and not 0 <= corners.min() <= corners.max() < len(points)
    if counts.sum() != len(corners) or outside:
        raise InputError(
            f"its {counts.sum()} corners, {len(corners)} indices and {len(points)} points do not fit together"
            "; export the mesh again"
        )
    cuts = np.maximum(counts - 2, 0)
    origin = np.repeat(np.arange(len(counts)), cuts)
    first = np.repeat(np.cumsum(counts) - counts, cuts)
    step = np.arange(len(origin)) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    triangles = np.column_stack([first, first + step + 1, first + step + 2])
    if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        triangles = triangles[:, ::-1]
    kept = ~np.isin(origin, np.array(mesh.GetHoleIndicesAttr().Get() or [], int))
    return Solid(points, triangles[kept], corners, origin[kept])


def _faces(points: NDArray, triangles: NDArray) -> Solid:
    """A solid made of triangles."""
    index = np.arange(triangles.size).reshape(-1, 3)
    return Solid(points, index, np.asarray(triangles, int).ravel(), np.arange(len(index)))


def box(size: float) -> Triangles:
    """A cube about the origin with edges of `size` [m]; points (V, 3) and triangles (F, 3), as all below."""
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), -1).reshape(8, 3) * size
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def sphere(radius: float) -> Triangles:
    """A sphere about the origin."""
    return _revolved(_arc(radius, -90, 90), "Z")


def cylinder(radius: float, height: float, axis: str = "Z") -> Triangles:
    """A cylinder about the origin, along an axis."""
    r, h = radius, height / 2
    return _revolved(np.array([[0, -h], [r, -h], [r, h], [0, h]]), axis)


def capsule(radius: float, height: float, axis: str = "Z") -> Triangles:
    """A capsule about the origin; its height is without the round ends."""
    lift = np.array([0, height / 2])
    halves = [_arc(radius, -90, 0) - lift, _arc(radius, 0, 90) + lift]
    return _revolved(np.vstack(halves), axis)


def _plane(width: float, length: float, axis: str) -> Triangles:
    """A rectangle with the normal `axis`; width and length as in UsdGeomPlane."""
    w, h = width / 2, length / 2
    across = {"X": ([0, 0, w], [0, h, 0]), "Y": ([w, 0, 0], [0, 0, h]), "Z": ([w, 0, 0], [0, h, 0])}[axis]
    u, v = np.array(across, float)
    points = np.array([-u - v, u - v, u + v, v - u])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    return points, triangles if np.cross(u, v)["XYZ".index(axis)] > 0 else triangles[:, ::-1]


def _arc(radius: float, start_deg: float, end_deg: float) -> NDArray:
    """Distance from the axis and height along it, of points on a circle, from below upwards."""
    steps = round((end_deg - start_deg) / 180 * SEGMENTS / 2)
    angle = np.radians(np.linspace(start_deg, end_deg, steps + 1))
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _revolved(profile: NDArray, axis: str) -> Triangles:
    """The surface of revolution of a profile of (distance, height) that begins and ends on the axis."""
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(SEGMENTS)])
    rings = [r * ring + [0, 0, z] for r, z in profile[1:-1]]
    points = np.vstack([[[0, 0, profile[0][1]]], *rings, [[0, 0, profile[-1][1]]]])
    here = np.arange(SEGMENTS)
    there = (here + 1) % SEGMENTS
    last = len(points) - 1
    triangles = [np.column_stack([np.zeros_like(here), 1 + there, 1 + here])]
    for k in range(len(rings) - 1):
        a, b = 1 + k * SEGMENTS, 1 + (k + 1) * SEGMENTS
        triangles += [np.column_stack([a + here, a + there, b + there])]
        triangles += [np.column_stack([a + here, b + there, b + here])]
    top = 1 + (len(rings) - 1) * SEGMENTS
    triangles += [np.column_stack([top + here, top + there, np.full_like(here, last)])]
    order = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}[axis]  # even permutations keep the winding
    return points[:, order], np.vstack(triangles)


def corner_normals(points: NDArray, faces: NDArray) -> NDArray[np.float32]:
    """Unit normals of each triangle's corners: smooth across shallow edges, sharp across creases.

    A corner's normal is the area-weighted mean of the faces around its point whose angle to its own face is
    below CREASE; where more than FAN faces meet, it is that of its own face.

    Args:
        points: Vertices [m], shape (V, 3).
        faces: Corners of the triangles, counter-clockwise from outside, shape (F, 3).

    Returns:
        Normals, shape (F, 3, 3).
    """
    area = _cross(points.astype(float), faces)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    area = (area / size.mean()).astype(np.float32)
    unit = area / np.linalg.norm(area, axis=1, keepdims=True)
    flat, own = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    count = np.bincount(flat, minlength=len(points))
    together = np.column_stack([np.bincount(flat, area[own, i], len(points)) for i in range(3)])
    length = np.maximum(np.linalg.norm(together, axis=1, keepdims=True), 1e-30)
    off = np.einsum("ij,ij->i", unit[own], (together / length).astype(np.float32)[flat]) < SMOOTH
    creased = np.bincount(flat[off], minlength=len(points)) > 0  # elsewhere, all faces are within CREASE
    normals = unit[own]
    shared = ~creased[flat] & (count[flat] <= FAN)
    normals[shared] = together.astype(np.float32)[flat[shared]]
    corner = np.flatnonzero(creased[flat] & (count[flat] <= FAN))
    corner = corner[np.argsort(flat[corner], kind="stable")]  # corners of one point stand together
    around = count[flat[corner]]
    for number in np.flatnonzero(np.bincount(around)):
        points_of = corner[around == number].reshape(-1, number)
        step = max(PAIRS // int(number) ** 2, 1)  # so that memory stays bounded
        for some in (points_of[i : i + step] for i in range(0, len(points_of), step)):
            directions, areas = unit[own[some]], area[own[some]].astype(float)
            near = directions @ directions.transpose(0, 2, 1) >= np.float32(np.cos(CREASE))
            normals[some] = near.astype(float) @ areas
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).reshape(-1, 3, 3)


def _cross(points: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Twice the area of each triangle times its normal, shape (F, 3); column by column, which is faster."""
    x, y, z = np.ascontiguousarray(points.T)
    a, b, c = np.ascontiguousarray(faces.T)
    (ux, vx), (uy, vy), (uz, vz) = ((p[b] - p[a], p[c] - p[a]) for p in (x, y, z))
    return np.column_stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])


def define_triangles(
    mesh: UsdGeom.Mesh, points: ArrayLike, faces: ArrayLike, *, shaded: bool = False
) -> None:
    """Author a mesh's geometry.

    Args:
        mesh: Written to in its stage's edit target.
        points: Vertices [m], in single precision, shape (V, 3).
        faces: Corners of the triangles, counter-clockwise from outside, shape (F, 3).
        shaded: Whether to author normals, see `corner_normals`.
    """
    points, faces = np.array(points, np.float32), np.array(faces, np.int32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(faces)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    extent = [Gf.Vec3f(*map(float, corner)) for corner in (points.min(axis=0), points.max(axis=0))]
    mesh.CreateExtentAttr(Vt.Vec3fArray(extent))
    if shaded:
        normals = np.round(corner_normals(points, faces), 4).reshape(-1, 3) + np.float32(0)
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying
        )
        order = np.lexsort(normals.T[::-1])  # as np.unique, which imports numpy.ma
        starts = np.append(True, (normals[order[1:]] != normals[order[:-1]]).any(axis=1))
        index = np.empty(len(order), np.int32)
        index[order] = np.cumsum(starts) - 1
        primvar.Set(Vt.Vec3fArray.FromNumpy(normals[order[starts]]))
        primvar.SetIndices(Vt.IntArray.FromNumpy(index))
