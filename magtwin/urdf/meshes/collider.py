"""Collider: the convex hull of a mesh, which collides in its place."""

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.meshes.mesh import Mesh, UnreadableMeshError, has_area

FLAT = 1e-13
"""Volume of a hull, relative to the cube of its longest side, that counts as none."""

Solid = tuple[NDArray[np.float32], NDArray[np.int64]]
"""Vertices [m], shape (V, 3), and triangles, counter-clockwise from outside, shape (F, 3)."""


PLATE = 0.005
"""Thickness of the plate that replaces a flat mesh, relative to the mesh's diagonal."""


def solid_of(mesh: Mesh) -> tuple[Solid, float]:
    """The hull of a mesh, its faces in a fixed order and none without an area.

    A flat mesh, which has no hull, is thickened to a plate.

    Returns:
        The solid; and the thickness of the plate in the unit of the file, 0 if the mesh is not flat.
    """
    points, thickness = mesh.points, 0.0
    faces = hull_faces(points.astype(float))
    if faces is None:
        points, thickness = _thickened(points)
        faces = hull_faces(points.astype(float))
    if faces is None:
        raise UnreadableMeshError(f"{mesh.path}: is flat and has no convex hull to collide with")
    first = np.argmin(faces, axis=1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    faces = faces[has_area(points, faces)]
    used = np.bincount(faces.ravel(), minlength=len(points)) > 0
    return (points[used], (np.cumsum(used) - 1)[faces]), thickness


def _thickened(points: NDArray) -> tuple[NDArray[np.float32], float]:
    """Points (V, 3) of a plane on both sides of a plate, shape (2 V, 3), and its thickness."""
    centred = points.astype(float) - points.mean(axis=0)
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]  # of least extent
    thickness = PLATE * float(np.linalg.norm(np.ptp(points.astype(float), axis=0)))
    half = thickness / 2 * normal
    return np.vstack([points + half, points - half]).astype(np.float32), thickness


def hull_faces(points: NDArray) -> NDArray[np.int64] | None:
    """Triangles of the convex hull, counter-clockwise from outside, shape (F, 3); None if it is flat."""
    from manifold3d import Manifold  # scipy's hull is as good, but importing it takes as long as a conversion

    points = np.ascontiguousarray(points, float) + 0.0  # + 0 makes -0 into 0
    hull = Manifold.hull_points(points)
    if hull.volume() <= FLAT * float(np.ptp(points, axis=0).max(initial=0.0)) ** 3:
        return None
    mesh = hull.to_mesh64()
    corners = np.ascontiguousarray(mesh.vert_properties[:, :3], float) + 0.0
    x = np.sort(corners[:, 0])
    alike = np.flatnonzero(x[np.searchsorted(x, points[:, 0]) % len(x)] == points[:, 0])
    rows = np.vstack([points[alike], corners])
    order = np.lexsort(rows.T)
    kind = np.empty_like(order)
    kind[order] = np.cumsum(np.append(0, (rows[order[1:]] != rows[order[:-1]]).any(axis=1)))
    last = np.full(len(rows), -1)
    np.maximum.at(last, kind[: len(alike)], alike)  # of equal points
    return last[kind[len(alike) :]][mesh.tri_verts]
