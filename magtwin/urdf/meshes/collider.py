"""Collider: the solids of a mesh collider: its convex hull, convex parts, or the mesh itself."""

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.urdf.meshes.mesh import Mesh, UnreadableMeshError, has_area
from magtwin.urdf.options import Collision

EXTRA = 'pip install "magtwin[decomposition]"'

CONCAVITY = 0.05
"""Largest depth of a hollow, relative to the mesh, that a convex part may fill (coacd's threshold)."""

FLAT = 1e-13
"""Volume of a hull, relative to the cube of its longest side, that counts as none."""

Solid = tuple[NDArray[np.float32], NDArray[np.int64]]
"""Vertices [m], shape (V, 3), and triangles, counter-clockwise from outside, shape (F, 3)."""


PLATE = 0.005
"""Thickness of the plate that replaces a flat mesh, relative to the mesh's diagonal."""


def solids_of(mesh: Mesh, collision: Collision) -> tuple[tuple[Solid, ...], float]:
    """The solids of a mesh: one, or the parts of a convex decomposition.

    The decomposition is coacd's (Wei et al. 2022, doi:10.1145/3528223.3530103). A hull has its faces in a
    fixed order and none without an area. A flat mesh, which has no hull, is thickened to a plate.

    Returns:
        The solids; and the thickness of the plate in the unit of the file, 0 if the mesh is not flat.

    Raises:
        InputError: coacd is not installed, or finds no parts.
    """
    if collision == "mesh":
        return ((mesh.points, mesh.faces),), 0.0
    if collision == "decomposition":
        try:
            import coacd
        except ImportError as error:
            raise InputError(
                f"a convex decomposition needs coacd, which is not installed: {EXTRA}"
            ) from error
        coacd.set_log_level("off")
        whole = coacd.Mesh(mesh.points.astype(float), mesh.faces.astype(np.int32))
        parts = coacd.run_coacd(whole, threshold=CONCAVITY, seed=0)
        if not parts:
            raise InputError(f"{mesh.path}: coacd finds no convex parts in it; use --collision hull")
        return tuple((np.asarray(v, np.float32), np.asarray(f, np.int64)) for v, f in parts), 0.0
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
    return ((points[used], (np.cumsum(used) - 1)[faces]),), thickness


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
