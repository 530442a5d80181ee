"""Inertia: mass properties of bodies and of filled shapes; inertia tensors as principal moments and axes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd, UsdGeom

from magtwin.field.sources.moments import mesh_moments
from magtwin.frames import canonical
from magtwin.urdf.meshes.collider import hull_faces
from magtwin.urdf.meshes.mesh_layer import primitive_of

ROUNDING = 1e-6
"""Relative excess of the largest moment over the sum of the others that single precision can cause."""

SLIMMEST = 1e-3
"""Smallest principal moment of a repaired tensor, relative to the largest: engines divide by it."""

SAME = 1e-8
"""Points of a mesh that are nearer to each other than about this are one [m]."""

WATER = 1000.0
"""Density of a body whose size or mass is unknown [kg/m3]; engines assume it too."""


@dataclass(frozen=True)
class MassProperties:
    """Mass, centre of mass and inertia of a body in some frame."""

    mass: float
    """Mass [kg]."""

    centre: NDArray[np.float64]
    """Centre of mass [m], shape (3,)."""

    inertia: NDArray[np.float64]
    """Tensor about the centre of mass, in the frame's axes [kg m2], shape (3, 3)."""

    def moved(self, T: ArrayLike) -> "MassProperties":
        """The body in another frame, in which its present frame has pose T, shape (4, 4)."""
        T = np.asarray(T, float)
        R = T[:3, :3]
        return MassProperties(self.mass, R @ self.centre + T[:3, 3], R @ self.inertia @ R.T)


def combined(bodies: Sequence[MassProperties]) -> MassProperties:
    """Bodies in one frame joined to one, by the parallel axis theorem (Goldstein 2002, section 5.3).

    I = sum_b I_b + m_b (|d_b|^2 1 - d_b d_b^T), d_b = c_b - c, c the common centre.
    """
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.centre for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        d = body.centre - centre
        inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return MassProperties(mass, centre, inertia)


def nearest_possible(inertia: ArrayLike) -> NDArray[np.float64] | None:
    """The possible inertia tensor that is nearest to a given one in the Frobenius norm.

    Real bodies have I_i > 0 and I_i + I_j >= I_k (Goldstein 2002, section 5.4), that is, second moments of
    mass p_i = (I_1 + I_2 + I_3) / 2 - I_i >= 0. The norm and the conditions do not depend on the axes, so the
    nearest tensor has the same ones, and its moments are I = A p with A = 1 1^T - 1 and p >= 0 nearest to the
    given moments: a projection to a cone with three edges, found by trying every set of edges.

    Args:
        inertia: Tensor about the centre of mass [kg m2], shape (3, 3).

    Returns:
        The tensor, shape (3, 3): the given one if it is possible. Its least moment is at least `SLIMMEST`
        of the largest. None if the nearest tensor is 0, which tells nothing.
    """
    given = np.asarray(inertia, float)
    moments, R = np.linalg.eigh((given + given.T) / 2)
    if moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * (1 + ROUNDING):
        return given
    A, best, least = np.ones((3, 3)) - np.eye(3), np.zeros(3), float(moments @ moments)
    for edges in ([0], [1], [2], [0, 1], [0, 2], [1, 2]):
        p, *_ = np.linalg.lstsq(A[:, edges], moments, rcond=None)
        distance = float(np.sum((A[:, edges] @ p - moments) ** 2))
        if (p >= 0).all() and distance < least:
            best, least = A[:, edges] @ p, distance
    if not best.max() > 0:
        return None
    best = np.maximum(best, SLIMMEST * best.max())
    return np.asarray(R @ np.diag(best) @ R.T)


def principal_axes(inertia: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Principal moments of an inertia tensor, and the rotation to its principal axes.

    I = R diag(I_1, I_2, I_3) R^T, with the principal axes as columns of R. Of the 24 orders and signs, R is
    the one nearest to the identity, so that a diagonal tensor keeps its axes.

    Args:
        inertia: Possible tensor about the centre of mass [kg m2], shape (3, 3).

    Returns:
        Moments [kg m2], shape (3,), none above the sum of the others; the quaternion xyzw of R, shape (4,).
    """
    tensor = np.asarray(inertia, float)
    tensor = (tensor + tensor.T) / 2
    if np.count_nonzero(tensor - np.diag(np.diag(tensor))) == 0:
        moments, R = np.diag(tensor).copy(), np.eye(3)
    else:
        moments, R = np.linalg.eigh(tensor)
        best = max(permutations(range(3)), key=lambda order: np.abs(np.diag(R[:, order])).sum())
        moments, R = moments[list(best)], R[:, best]
        R = R * np.where(np.diag(R) < 0, -1, 1)
        if np.linalg.det(R) < 0:
            R[:, np.argmin(np.diag(R))] *= -1
    largest = int(np.argmax(moments))
    moments[largest] = min(moments[largest], moments.sum() - moments[largest])
    return moments, quaternion(R)


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion xyzw of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric form (2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return canonical(np.linalg.eigh(K)[1][:, -1])


def ball_of(mass: float) -> MassProperties:
    """A ball of water of some mass [kg] at the origin: a body whose size is unknown."""
    radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
    return MassProperties(mass, np.zeros(3), WATER * sphere(radius).inertia)


def box(size: ArrayLike) -> MassProperties:
    """A box at the origin of 1 kg/m3 with edges `size` [m], shape (3,)."""
    edges = np.asarray(size, float)
    mass, squares = float(edges.prod()), edges**2
    return MassProperties(mass, np.zeros(3), mass / 12 * np.diag(squares.sum() - squares))


def sphere(radius: float) -> MassProperties:
    """A ball at the origin of 1 kg/m3 [m]."""
    mass = 4 / 3 * np.pi * radius**3
    return MassProperties(mass, np.zeros(3), 2 / 5 * mass * radius**2 * np.eye(3))


def cylinder(radius: float, length: float) -> MassProperties:
    """A cylinder along z at the origin of 1 kg/m3 [m]."""
    mass, across = np.pi * radius**2 * length, radius**2 / 4 + length**2 / 12
    return MassProperties(mass, np.zeros(3), mass * np.diag([across, across, radius**2 / 2]))


def capsule(radius: float, length: float) -> MassProperties:
    """A `cylinder` with half a ball on each end, which `length` does not count [m]."""
    middle, ends = cylinder(radius, length), sphere(radius)
    apart = ends.mass * (length**2 / 4 + 3 / 8 * length * radius)
    inertia = middle.inertia + ends.inertia + np.diag([apart, apart, 0])
    return MassProperties(middle.mass + ends.mass, np.zeros(3), inertia)


def polyhedron(points: NDArray, faces: NDArray) -> MassProperties:
    """A closed surface of triangles, filled with 1 kg/m3.

    Args:
        points: Corners [m], shape (V, 3).
        faces: Triangles, counter-clockwise from outside, shape (F, 3).
    """
    volume, centre, spread = mesh_moments(points, faces)
    return MassProperties(volume, centre, volume * (np.trace(spread) * np.eye(3) - spread))


def is_closed(points: NDArray, faces: NDArray) -> bool:
    """Whether triangles bound a volume: each edge has two, which turn through it in opposite directions.

    Args:
        points: Corners [m], shape (V, 3); those that are equal to `SAME` count as one.
        faces: Triangles, shape (F, 3).
    """
    grid = np.round(points / SAME)
    order = np.lexsort(grid.T)
    kind = np.empty(len(points), np.int64)
    kind[order] = np.cumsum(np.append(0, (grid[order[1:]] != grid[order[:-1]]).any(axis=1)))
    start, end = kind[faces].ravel(), kind[faces[:, [1, 2, 0]]].ravel()
    forth, back = np.sort(start * len(points) + end), np.sort(end * len(points) + start)
    once = bool((forth[1:] != forth[:-1]).all() and (start != end).all())
    return once and np.array_equal(forth, back)


def read_solid(prims: Iterable[Usd.Prim], frame: Usd.Prim) -> MassProperties | None:
    """Gprims filled with 1 kg/m3, in the frame of a prim above them; None if they have no volume.

    Overlaps count twice. A mesh that is not closed counts as its convex hull.

    Args:
        prims: Gprims, or prims above gprims.
        frame: Prim whose frame is used.
    """
    cache, solids = UsdGeom.XformCache(), []
    to_frame = cache.GetLocalToWorldTransform(frame).GetInverse()
    for top in prims:
        for prim in Usd.PrimRange(top, Usd.TraverseInstanceProxies()):
            T = np.array(cache.GetLocalToWorldTransform(prim) * to_frame).T
            solid = _read_gprim(prim, T)
            if solid is not None and solid.mass > 0:
                solids.append(solid)
    return combined(solids) if solids else None


def _read_gprim(prim: Usd.Prim, T: NDArray) -> MassProperties | None:
    """The solid of a gprim with pose T, shape (4, 4); boxes and meshes may be scaled."""
    form = primitive_of(prim)
    if form is None:
        return _read_mesh(UsdGeom.Mesh(prim), T) if prim.IsA(UsdGeom.Mesh) else None
    scale = np.linalg.norm(T[:3, :3], axis=0)
    T = T @ np.diag([*1 / scale, 1])
    if form.kind == "box":
        return box(scale * form.size).moved(T)
    if form.kind == "sphere":
        return sphere(form.radius).moved(T)
    return (cylinder if form.kind == "cylinder" else capsule)(form.radius, form.length).moved(T)


def _read_mesh(mesh: UsdGeom.Mesh, T: NDArray) -> MassProperties | None:
    """The solid of a closed mesh of triangles under T, or of its hull; None if that is flat."""
    points = np.array(mesh.GetPointsAttr().Get(), float) @ T[:3, :3].T + T[:3, 3]
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    solid = polyhedron(points, faces) if is_closed(points, faces) else None
    if solid is not None and solid.mass > 0:
        return solid
    hull = hull_faces(points)
    return None if hull is None else polyhedron(points, hull)
