"""Obstacles of a stage: its colliders that stand still, as a robot that drives among them meets them."""

import functools
import os

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.obstacles import Obstacles
from magtwin.usd.geometry import SHOWN, read_triangles
from magtwin.usd.layers import open_stage

LOWEST_M = 0.01
"""What does not rise above this is driven over, as a floor is, or its joints [m]."""

ROBOT_HEIGHT_M = 0.4
"""What hangs higher than this is driven under [m]; the TurtleBot 4 is 0.351 m high."""


def read_obstacles(
    stage: Usd.Stage | str | os.PathLike[str], *, height_m: float = ROBOT_HEIGHT_M
) -> Obstacles:
    """The colliders of a stage that no rigid body carries, in order of their prims.

    Each prim with CollisionAPI that is not switched off is an obstacle if any of it lies between the floor
    and `height_m`: its outline is the hull of what lies there, its surface all of it. Colliders need not be
    drawn: those of purpose guide and proxy count, those made invisible do not.

    Args:
        stage: A stage, or the path of a USD file.
        height_m: Height of the robot [m].

    Raises:
        RefusedError: The file is missing or is not USD, or a mesh contradicts itself; the text names
            the prim.
    """
    stage = stage if isinstance(stage, Usd.Stage) else open_stage(stage)
    purposes = (*SHOWN, UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)
    collider = functools.cache(_collider)
    things: dict[str, list[np.ndarray]] = {}
    for path, corners in read_triangles(
        stage, purposes=purposes, wanted=lambda prim, carried: not carried and bool(collider(prim))
    ).items():
        things.setdefault(collider(stage.GetPrimAtPath(path)), []).append(corners)
    names, outlines, triangles = [], [], []
    for name, parts in things.items():
        corners = np.concatenate(parts)
        triangles.append(corners)
        outline = _outline(corners, height_m)
        if outline is not None:
            names.append(name)
            outlines.append(outline)
    surface = np.concatenate(triangles) if triangles else np.empty((0, 3, 3))
    return Obstacles(tuple(names), tuple(outlines), surface)


def _collider(prim: Usd.Prim) -> str:
    """Path of the prim at or above a gprim that collides, "" for none."""
    while prim and not prim.IsPseudoRoot():
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            enabled = UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get()
            return str(prim.GetPath()) if enabled is not False else ""
        prim = prim.GetParent()
    return ""


def _outline(corners: np.ndarray, height_m: float) -> np.ndarray | None:
    """Points (K, 2) of triangles (T, 3, 3) within the robot's height; none if there is no area to them."""
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
    if len(found) < 3 or np.linalg.matrix_rank(found - found[0], tol=1e-6) < 2:
        return None
    return found
