"""Obstacles of a stage: its colliders that stand still."""

import functools
import os

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.spec.obstacles import Obstacles
from magtwin.usd.geometry import SHOWN, read_triangles
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.schema import prims_with

LOWEST_M = 0.01
"""A collider that is lower than this is no obstacle, such as a floor [m]."""

ROBOT_HEIGHT_M = 0.4
"""Least height up to which colliders are obstacles [m]; the TurtleBot 4 is 0.351 m high."""

SAME_M = 1e-5
"""Corners nearer than this coincide [m]."""

SHEET_M = 0.001
"""Thickness of a wall that is a single sheet [m]."""

MOST_FACES = 1000
"""A concave part of a mesh with more triangles counts as its convex hull, others face by face."""


@translates
def read_obstacles(stage: Usd.Stage | str | os.PathLike[str], *, height_m: float | None = None) -> Obstacles:
    """The colliders of a stage that no rigid body carries, in order of their prims.

    Each prim with an enabled CollisionAPI is an obstacle if a part of it is between the floor and `height_m`.
    It has one outline for each gprim and each connected part of a mesh: the hull of what is between these
    heights. A concave part, such as the walls of a room in one mesh, has one outline for each face. Its
    surface is complete. Colliders of purpose guide and proxy count; invisible ones do not.

    Args:
        stage: A stage, or the path of a USD file.
        height_m: Height of the robot [m]. Default: that of the tallest robot on the stage, at least
            `ROBOT_HEIGHT_M`.

    Raises:
        InputError: The file is missing or not USD, or a mesh is inconsistent; the text names the prim.
    """
    stage = stage if isinstance(stage, Usd.Stage) else open_stage(stage)
    purposes = (*SHOWN, UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)
    collider = functools.cache(_collider)
    if height_m is None:
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), list(purposes))
        bounds = map(cache.ComputeWorldBound, prims_with(stage.GetPseudoRoot(), "robot"))
        height_m = max([ROBOT_HEIGHT_M, *(bound.ComputeAlignedRange().GetMax()[2] for bound in bounds)])
    names, outlines, triangles = [], [], []
    for path, corners in read_triangles(
        stage, purposes=purposes, wanted=lambda prim, carried: not carried and bool(collider(prim))
    ).items():
        prim = stage.GetPrimAtPath(path)
        triangles.append(corners)
        for piece in _pieces(corners) if prim.IsA(UsdGeom.Mesh) else [corners]:
            outline = _outline(piece, height_m)
            if outline is not None:
                names.append(collider(prim))
                outlines.append(outline)
    surface = np.concatenate(triangles) if triangles else np.empty((0, 3, 3))
    return Obstacles(tuple(names), tuple(outlines), surface)


def _collider(prim: Usd.Prim) -> str:
    """Path of the prim with CollisionAPI at or above a gprim; "" if there is none."""
    while prim and not prim.IsPseudoRoot():
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            enabled = UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get()
            return str(prim.GetPath()) if enabled is not False else ""
        prim = prim.GetParent()
    return ""


def _pieces(corners: np.ndarray) -> list[np.ndarray]:
    """Triangles (T, 3, 3) as connected parts, or one by one for a concave part."""
    from scipy.sparse import coo_array  # takes 0.1 s
    from scipy.sparse.csgraph import connected_components

    flat = np.round(corners.reshape(-1, 3) / SAME_M).astype(np.int64)
    vertex = np.unique(flat, axis=0, return_inverse=True)[1].reshape(-1, 3)
    links = np.concatenate([vertex[:, :2], vertex[:, 1:]])
    count = int(vertex.max(initial=-1)) + 1
    graph = coo_array((np.ones(len(links)), links.T), shape=(count, count))
    which = connected_components(graph, directed=False)[1][vertex[:, 0]]
    first = np.unique(which, return_index=True)[1]
    pieces: list[np.ndarray] = []
    for k in np.sort(first):
        piece = corners[which == which[k]]
        pieces += list(piece[:, None]) if len(piece) <= MOST_FACES and not _convex(piece) else [piece]
    return pieces


def _convex(corners: np.ndarray) -> bool:
    """Whether all corners of triangles (T, 3, 3) lie on one side of each of them."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    normal, start = normal[size > 0] / size[size > 0, None], corners[size > 0, 0]
    off = np.unique(corners.reshape(-1, 3), axis=0) @ normal.T - np.einsum("ni,ni->n", start, normal)
    return bool(np.all((off.max(axis=0) < SAME_M) | (off.min(axis=0) > -SAME_M)))


def _outline(corners: np.ndarray, height_m: float) -> np.ndarray | None:
    """Points (K, 2) of triangles (T, 3, 3) within the robot's height; None if there is at most one point.

    A wall without thickness gets `SHEET_M`.
    """
    points = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        points.append(a[(a[:, 2] >= LOWEST_M) & (a[:, 2] <= height_m)][:, :2])
        for level in (LOWEST_M, height_m):
            rise = b[:, 2] - a[:, 2]
            crosses = (a[:, 2] - level) * (b[:, 2] - level) < 0
            part = ((level - a[crosses, 2]) / rise[crosses])[:, None]
            points.append((a[crosses] + part * (b[crosses] - a[crosses]))[:, :2])
    found = np.unique(np.round(np.concatenate(points), 9), axis=0)
    if len(found) < 2:
        return None
    away = found - found.mean(axis=0)
    along, across = np.linalg.svd(away, full_matrices=False)[2]
    if np.abs(away @ across).max() > SAME_M:
        return found
    ends = found[[np.argmin(away @ along), np.argmax(away @ along)]]
    side = across * (SHEET_M / 2)
    return np.concatenate([ends - side, ends + side])
