"""Articulation: which prim is its root, and which of its bodies do not collide with each other."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.usd.geometry import read_vertices

NEWTON_API, PHYSX_API = "NewtonArticulationRootAPI", "PhysxArticulationAPI"
"""Applied schemas of Newton and PhysX; their plugins are not installed here."""

SELF_COLLISION = (
    (NEWTON_API, "newton:selfCollisionEnabled"),
    (PHYSX_API, "physxArticulation:enabledSelfCollisions"),
)
"""Attributes that enable collisions between links, with their schemas, without which PhysX ignores them."""

OVERLAP_M = 0.001
"""Colliders whose convex hulls overlap by less can touch, such as the closed fingers of a gripper [m]."""

COMPARED, POINTS = 20_000, 10_000
"""Most pairs of hulls that are compared; this many points count as one more pair."""


def define_articulation(root: Usd.Prim, *, self_collision: bool) -> None:
    """Make a prim the root of an articulation.

    The root of a floating robot is its base. If an ancestor of the base is the root, PhysX chooses the link
    in the middle of the tree, and root poses are poses of that link. The root of a fixed robot is the
    robot's prim; its base is the body on a joint to the world.

    Args:
        root: The base of a floating robot, or the prim of a fixed one.
        self_collision: Whether links that no joint connects collide with each other.
    """
    UsdPhysics.ArticulationRootAPI.Apply(root)
    for schema, attribute in SELF_COLLISION:
        root.AddAppliedSchema(schema)
        root.CreateAttribute(attribute, Sdf.ValueTypeNames.Bool, custom=False).Set(self_collision)


def filter_overlaps(
    bodies: Mapping[str, Usd.Prim], colliders: Mapping[str, Sequence[Usd.Prim]], joints: Sequence[Usd.Prim]
) -> None:
    """Author that bodies whose colliders overlap do not collide, since engines push such bodies apart.

    The hull of a bumper around a base, for example, contains the wheels. Colliders count as their convex
    hulls. Engines ignore the bodies of one joint already.

    Args:
        bodies: Prims by link name, at rest.
        colliders: Colliders of each body, in the same stage.
        joints: Prims of the joints.

    Raises:
        InputError: Too many colliders are in one place to compare them all.
    """
    left = COMPARED
    jointed = {frozenset(_ends(joint)) for joint in joints}
    for (first, second), near in _near(_hulls(bodies, colliders)).items():
        ends = bodies[first].GetPath(), bodies[second].GetPath()
        if frozenset(ends) in jointed:
            continue
        for a, b in near:
            left -= 1 + (a.num_vert() + b.num_vert()) // POINTS
            if left < 0:
                raise InputError(
                    f"link {first!r}: over {COMPARED:,} pairs of colliders are in one place; give its joints "
                    "origins, or merge colliders"
                )
            if not (a ^ b).is_empty():
                break
        else:
            continue
        UsdPhysics.FilteredPairsAPI.Apply(bodies[first]).CreateFilteredPairsRel().AddTarget(ends[1])


def _ends(joint: Usd.Prim) -> list[Sdf.Path]:
    """Paths of the bodies of a joint."""
    made = UsdPhysics.Joint(joint)
    return [*made.GetBody0Rel().GetTargets(), *made.GetBody1Rel().GetTargets()]


def _hulls(
    bodies: Mapping[str, Usd.Prim], colliders: Mapping[str, Sequence[Usd.Prim]]
) -> dict[str, list[Any]]:
    """Hull of each collider of each body, shrunk by half of `OVERLAP_M`; thinner ones are empty."""
    from manifold3d import Manifold

    hulls: dict[str, list[Any]] = {name: [] for name in bodies}
    if not bodies:
        return hulls
    owner = {prim.GetPath(): name for name, prims in colliders.items() for prim in prims}
    stage = next(iter(bodies.values())).GetStage()
    places = UsdGeom.XformCache()
    vertices = read_vertices(
        stage, purposes=(UsdGeom.Tokens.guide,), wanted=lambda prim, _: prim.GetPath() in owner
    )
    for path, (_, corners) in vertices.items():
        T = np.array(places.GetLocalToWorldTransform(bodies[owner[path]]))
        points = corners.astype(float) @ T[:3, :3] + T[3, :3]
        away = points - points.mean(axis=0)
        far = np.linalg.norm(away, axis=1, keepdims=True)
        shrunk = points - away * np.minimum(1.0, OVERLAP_M / 2 / np.maximum(far, 1e-12))
        hulls[owner[path]].append(Manifold.hull_points(np.ascontiguousarray(shrunk)))
    return hulls


def _near(hulls: Mapping[str, Sequence[Any]]) -> dict[tuple[str, str], list[tuple[Any, Any]]]:
    """Hulls of different bodies whose boxes meet, by pair of bodies, in the order of the bodies."""
    owner = [name for name, some in hulls.items() for _ in some]
    whole = [hull for some in hulls.values() for hull in some]
    boxes = np.array([hull.bounding_box() for hull in whole]).reshape(-1, 6)
    low, high = boxes[:, :3], boxes[:, 3:]
    ends = dict(zip(hulls, np.cumsum([len(some) for some in hulls.values()]), strict=True))
    near: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
    for i, name in enumerate(owner):
        end = ends[name]
        meets = ((low[end:] <= high[i]) & (low[i] <= high[end:])).all(axis=1)
        for j in end + np.flatnonzero(meets):
            near.setdefault((name, owner[j]), []).append((whole[i], whole[j]))
    order = {name: k for k, name in enumerate(hulls)}
    return {pair: near[pair] for pair in sorted(near, key=lambda pair: (order[pair[0]], order[pair[1]]))}
