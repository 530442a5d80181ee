"""Collider: what a mesh collides as: its convex hull, convex parts of it, or itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.urdf.meshes.mesh import Mesh, has_area
from magtwin.urdf.options import Collision

EXTRA = 'pip install "magtwin[decomposition]"'

CONCAVITY = 0.05
"""Depth of hollows, against the mesh's size, that a convex part may bridge (coacd's threshold)."""


@dataclass(frozen=True)
class Solid:
    """Triangles that collide."""

    points: NDArray[np.float32]
    """Vertices [m], shape (V, 3)."""

    faces: NDArray[np.int64]
    """Corners of the triangles, counter-clockwise from outside, shape (F, 3)."""


def solids_of(mesh: Mesh, collision: Collision) -> tuple[Solid, ...]:
    """What a mesh collides as: one solid, or the parts of a convex decomposition.

    Raises:
        InputError: The mesh is flat and has no hull; or coacd is not installed.
    """
    if collision == "mesh":
        return (Solid(mesh.points, mesh.faces),)
    if collision == "decomposition":
        return _decomposition(mesh)
    return (_hull(mesh),)


def _hull(mesh: Mesh) -> Solid:
    """The convex hull of all points."""
    from scipy.spatial import ConvexHull, QhullError

    points = mesh.points.astype(float)
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise InputError(
            f"{mesh.path}: is flat and has no convex hull to collide with; use a box instead"
        ) from error
    faces, normals = hull.simplices.astype(np.int64), hull.equations[:, :3]
    a, b, c = (points[faces[:, i]] for i in range(3))
    inwards = np.sum(np.cross(b - a, c - a) * normals, axis=1) < 0
    faces = np.where(inwards[:, None], faces[:, ::-1], faces)
    first = np.argmin(faces, axis=1)[:, None]  # each from its least corner, then in order of corners
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return _used(mesh.points, faces[np.lexsort(faces.T[::-1])])


def _decomposition(mesh: Mesh) -> tuple[Solid, ...]:
    """Convex parts by coacd (Wei et al. 2022, "Approximate convex decomposition for 3D meshes with
    collision-aware concavity and tree search").
    """
    try:
        import coacd
    except ImportError as error:
        raise InputError(f"a convex decomposition needs coacd, which is not installed: {EXTRA}") from error
    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.points.astype(float), mesh.faces.astype(np.int32)), threshold=CONCAVITY, seed=0
    )
    if not parts:
        raise InputError(f"{mesh.path}: coacd finds no convex parts in it; use --collision hull")
    return tuple(Solid(np.asarray(v, np.float32), np.asarray(f, np.int64)) for v, f in parts)


def _used(points: NDArray, faces: NDArray) -> Solid:
    """The faces that have an area, and the points that they name."""
    faces = faces[has_area(points, faces)]
    used, index = np.unique(faces, return_inverse=True)
    return Solid(points[used], index.reshape(-1, 3))
