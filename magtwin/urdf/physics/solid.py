"""Solid: volume, centre and second moment of evenly filled shapes, for mass and inertia."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd, UsdGeom

from magtwin.urdf.meshes.collider import hull_faces
from magtwin.urdf.physics.inertia import MassProperties

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A filled shape in some frame."""

    volume: float
    """Volume [m3]."""

    centre: Array
    """Centre of volume [m], shape (3,)."""

    second: Array
    """Integral of x x^T over the volume, x from the centre [m5], shape (3, 3)."""

    def mapped(self, A: ArrayLike, t: ArrayLike) -> "Solid":
        """The solid after x -> A x + t: volumes scale by |det A|, second moments by |det A| A (.) A^T.

        Args:
            A: Linear map, shape (3, 3).
            t: Translation [m], shape (3,).
        """
        A, t = np.asarray(A, float), np.asarray(t, float)
        factor = abs(float(np.linalg.det(A)))
        return Solid(self.volume * factor, A @ self.centre + t, factor * A @ self.second @ A.T)

    def mass_properties(self, density: float) -> MassProperties:
        """Mass, centre and inertia at a density [kg/m3]: I = density (tr(C) 1 - C), C the second moment."""
        inertia = density * (np.trace(self.second) * np.eye(3) - self.second)
        return MassProperties(density * self.volume, self.centre, inertia)


def box(size: ArrayLike) -> Solid:
    """A box at the origin with edges `size` [m], shape (3,)."""
    edges = np.asarray(size, float)
    volume = float(edges.prod())
    return Solid(volume, np.zeros(3), volume / 12 * np.diag(edges**2))


def sphere(radius: float) -> Solid:
    """A ball at the origin [m]."""
    volume = 4 / 3 * np.pi * radius**3
    return Solid(volume, np.zeros(3), volume * radius**2 / 5 * np.eye(3))


def cylinder(radius: float, length: float) -> Solid:
    """A cylinder along z at the origin [m]."""
    volume = np.pi * radius**2 * length
    return Solid(volume, np.zeros(3), volume * np.diag([radius**2 / 4, radius**2 / 4, length**2 / 12]))


def capsule(radius: float, length: float) -> Solid:
    """A cylinder along z at the origin with half a ball on each end; `length` is the cylinder's [m]."""
    middle, ends = cylinder(radius, length), sphere(radius)
    along = ends.volume * (length**2 / 4 + 3 / 8 * length * radius)  # the halves are apart
    return Solid(
        middle.volume + ends.volume, np.zeros(3), middle.second + ends.second + np.diag([0, 0, along])
    )


def polyhedron(points: ArrayLike, faces: ArrayLike) -> Solid:
    """The volume inside a closed surface of triangles, as a sum of tetrahedra from its middle.

    With corners a, b, c and the apex at 0: v = a . (b x c) / 6, centre (a + b + c) / 4, and
    second moment v / 20 (a a^T + b b^T + c c^T + s s^T), s = a + b + c (Tonon 2005).

    Args:
        points: Corners [m], shape (V, 3).
        faces: Triangles, counter-clockwise from outside, shape (F, 3).
    """
    points = np.asarray(points, float)
    middle = points.mean(0)
    corners = (points - middle)[np.asarray(faces, int)]
    a, b, c = np.moveaxis(corners, 1, 0)
    s = a + b + c
    v = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    volume = float(v.sum())
    centre = (v[:, None] * s).sum(0) / 4 / volume
    second = np.einsum("f,fci,fcj->ij", v, corners, corners) + np.einsum("f,fi,fj->ij", v, s, s)
    return Solid(volume, middle + centre, second / 20 - volume * np.outer(centre, centre))


def total(solids: Iterable[Solid]) -> Solid:
    """Several solids as one; overlaps count twice."""
    solids = list(solids)
    volume = sum(s.volume for s in solids)
    centre = sum((s.volume * s.centre for s in solids), np.zeros(3)) / volume
    away = [s.centre - centre for s in solids]
    second = [s.second + s.volume * np.outer(d, d) for s, d in zip(solids, away, strict=True)]
    return Solid(volume, centre, np.sum(second, axis=0))


def read_solid(prims: Iterable[Usd.Prim], frame: Usd.Prim) -> Solid | None:
    """The total solid of gprims in the frame of a prim above them; None if they have no volume.

    A mesh that is not closed counts as its convex hull.

    Args:
        prims: Gprims, or prims above gprims.
        frame: Prim whose frame is used.
    """
    cache, solids = UsdGeom.XformCache(), []
    to_frame = cache.GetLocalToWorldTransform(frame).GetInverse()
    for top in prims:
        for prim in Usd.PrimRange(top, Usd.TraverseInstanceProxies()):
            solid = _read_gprim(prim)
            if solid is not None and solid.volume > 0:
                T = np.array(cache.GetLocalToWorldTransform(prim) * to_frame)  # row vectors
                solids.append(solid.mapped(T[:3, :3].T, T[3, :3]))
    return total(solids) if solids else None


def _read_gprim(prim: Usd.Prim) -> Solid | None:
    """The solid of a gprim in its own frame."""
    if prim.IsA(UsdGeom.Cube):
        return box(np.full(3, UsdGeom.Cube(prim).GetSizeAttr().Get()))
    if prim.IsA(UsdGeom.Sphere):
        return sphere(UsdGeom.Sphere(prim).GetRadiusAttr().Get())
    for schema, shape in ((UsdGeom.Cylinder, cylinder), (UsdGeom.Capsule, capsule)):
        if prim.IsA(schema):
            gprim = schema(prim)
            turn = np.roll(np.eye(3), {"X": 1, "Y": 2, "Z": 0}[gprim.GetAxisAttr().Get()], axis=0)
            solid = shape(gprim.GetRadiusAttr().Get(), gprim.GetHeightAttr().Get())
            return solid.mapped(turn, np.zeros(3))
    if prim.IsA(UsdGeom.Mesh):
        return _read_mesh(UsdGeom.Mesh(prim))
    return None


def _read_mesh(mesh: UsdGeom.Mesh) -> Solid | None:
    """The solid of a closed mesh of triangles, or of its hull; None if that is flat."""
    points = np.array(mesh.GetPointsAttr().Get() or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [])
    index = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [])
    if len(points) < 4:
        return None
    if (counts == 3).all() and _is_closed(points, index.reshape(-1, 3)):
        solid = polyhedron(points, index.reshape(-1, 3))
        if solid.volume > 0:
            return solid
    faces = hull_faces(points)
    return None if faces is None else polyhedron(points, faces)


def _is_closed(points: Array, faces: NDArray) -> bool:
    """Whether each edge occurs once in each direction; equal points count as one."""
    _, same = np.unique(np.round(points, 7), axis=0, return_inverse=True)
    edges = same.reshape(-1)[faces][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, times = np.unique(edges, axis=0, return_counts=True)
    back = np.unique(edges[:, ::-1], axis=0)
    return bool((times == 1).all() and np.array_equal(there, back))
