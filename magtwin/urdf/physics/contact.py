"""Contact: the thin cylinders on which driven wheels roll, as a variant of their robot.

A flat cylinder or a hull touches the floor at its outer edge in one engine and at its inner in another, so
that a turn is short by up to a quarter. In the variant `guide` the colliders of a driven wheel are disabled,
and a cylinder of `THICK_M` about its axis, as far as they reach, stands in the plane from which the drive is
computed, or as near to it as they are wide. The variant `described` keeps the colliders.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.usd.attributes import write_pose
from magtwin.usd.geometry import axis_of, read_vertices

CONTACT, DESCRIBED, GUIDED = "wheelContact", "described", "guide"
"""Variant set of a robot with driven wheels, and its variants; `GUIDED` is the default."""

THICK_M = 0.002
"""Thickness of the cylinder on which a driven wheel rolls [m]."""

ACROSS = 0.5
"""Least share of the robot's y in an axis along which a cylinder is moved."""


def define_contacts(robot: Usd.Prim, planes: Mapping[Usd.Prim, float | None]) -> None:
    """Author the variants, unless the robot has them.

    Args:
        robot: Prim of the robot.
        planes: y of the plane in the robot's frame, by joint of a wheel [m]; None for that of the joint.
    """
    stage, cache = robot.GetStage(), UsdGeom.XformCache()
    axes, colliders = dict[Usd.Prim, NDArray](), dict[Usd.Prim, list[Usd.Prim]]()
    for joint in planes:
        axis = axis_of(UsdPhysics.Joint(joint))
        (path,) = UsdPhysics.Joint(joint).GetBody1Rel().GetTargets()
        solid = [p for p in Usd.PrimRange(stage.GetPrimAtPath(path)) if _collides(p)]
        if axis is not None and solid:
            axes[joint], colliders[joint] = np.array(axis), solid
    variants = robot.GetVariantSets()
    if not colliders or variants.HasVariantSet(CONTACT):
        return
    order = robot.GetChildrenNames()  # else the names in a variant come first
    contact = variants.AddVariantSet(CONTACT)
    owner = {prim.GetPath(): joint for joint, prims in colliders.items() for prim in prims}
    seen = read_vertices(stage, purposes=(UsdGeom.Tokens.guide,), wanted=lambda p, _: p.GetPath() in owner)
    points: dict[Usd.Prim, list[NDArray]] = {}
    for path, (_, corners) in seen.items():
        points.setdefault(owner[path], []).append(corners.astype(float))
        stage.GetPrimAtPath(path).RemoveProperty(UsdPhysics.Tokens.physicsCollisionEnabled)
    for variant in (DESCRIBED, GUIDED):
        contact.AddVariant(variant)
        contact.SetVariantSelection(variant)
        with contact.GetVariantEditContext():
            for path in owner:
                enabled = UsdPhysics.CollisionAPI(stage.GetPrimAtPath(path)).CreateCollisionEnabledAttr()
                enabled.Set(variant == DESCRIBED)
            for joint in points if variant == GUIDED else ():
                body = stage.GetPrimAtPath(UsdPhysics.Joint(joint).GetBody1Rel().GetTargets()[0])
                T, _ = cache.ComputeRelativeTransform(body, robot)
                across, y = T.TransformDir(Gf.Vec3d(*map(float, axes[joint])))[1], planes[joint]
                stays = y is None or abs(across) < ACROSS
                along = 0.0 if stays else (y - T.ExtractTranslation()[1]) / across
                _define_disc(np.concatenate(points[joint]), axes[joint], along, colliders[joint][0])
    robot.SetChildrenReorder(order)


def _collides(prim: Usd.Prim) -> bool:
    """Whether a prim is an enabled collider."""
    return bool(prim.HasAPI(UsdPhysics.CollisionAPI)) and bool(
        UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get()
    )


def _define_disc(points: NDArray, axis: NDArray, along: float, like: Usd.Prim) -> None:
    """Author a thin cylinder about an axis through a body's origin, with the surface of a collider beside it.

    Args:
        points: Corners of the body's colliders [m], shape (N, 3).
        axis: Unit axis, shape (3,).
        along: Place of the cylinder on the axis [m]; it stays within `points`.
        like: A collider of the body.
    """
    low, high = float((points @ axis).min()), float((points @ axis).max())
    half = min(THICK_M, high - low) / 2
    radius = float(np.linalg.norm(points - np.outer(points @ axis, axis), axis=1).max())
    disc = UsdGeom.Cylinder.Define(like.GetStage(), like.GetPath().GetParentPath().AppendChild(CONTACT))
    prim, turn = disc.GetPrim(), np.cross((0.0, 0.0, 1.0), axis)
    q = np.array([*turn, 1 + axis[2]]) if axis[2] > -1 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
    x, y, z = (round(float(v), 9) + 0.0 for v in np.clip(along, low + half, high - half) * axis)
    i, j, k, w = (round(float(v), 15) + 0.0 for v in q / np.linalg.norm(q))
    write_pose(prim, (x, y, z), (i, j, k, w))
    disc.CreateAxisAttr(UsdGeom.Tokens.z)
    disc.CreateRadiusAttr(round(radius, 7))
    disc.CreateHeightAttr(round(2 * half, 7))
    disc.CreateExtentAttr([Gf.Vec3f(-radius, -radius, -half), Gf.Vec3f(radius, radius, half)])
    disc.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(prim).CreateCollisionEnabledAttr(True)
    for material in UsdShade.MaterialBindingAPI(like).GetDirectBindingRel("physics").GetTargets():
        surface = UsdShade.Material(like.GetStage().GetPrimAtPath(material))
        bound = UsdShade.MaterialBindingAPI.Apply(prim)
        bound.Bind(surface, UsdShade.Tokens.weakerThanDescendants, "physics")
