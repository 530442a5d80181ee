"""Units: a stage in centimetres, or with Y up, becomes one in metres with Z up, its points and all.

Every length that a layer holds is multiplied, whatever it is a length of: points, extents, places, sizes,
limits, and what has a length in its unit, such as inertia. Bodies, cameras and lights keep their own frames;
what stands in the world is turned as a whole. Composition needs no part in it, so layers, variants and
references stay.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from magtwin.errors import InputError
from magtwin.export.contents import dependencies
from magtwin.usd.layers import open_stage

LENGTHS: Mapping[str, float] = MappingProxyType(
    {
        **dict.fromkeys(("points", "extent", "extentsHint", "velocities", "accelerations", "widths"), 1),
        **dict.fromkeys(("radius", "height", "size", "width", "length", "radiusTop", "radiusBottom"), 1),
        **dict.fromkeys(("positions", "offsets", "translations"), 1),
        **dict.fromkeys(("bindTransforms", "restTransforms", "primvars:skel:geomBindTransform"), 1),
        **dict.fromkeys(("clippingRange", "focusDistance", "focalLength"), 1),
        **dict.fromkeys(("horizontalAperture", "verticalAperture"), 1),
        **dict.fromkeys(("horizontalApertureOffset", "verticalApertureOffset"), 1),
        **dict.fromkeys(
            ("inputs:radius", "inputs:width", "inputs:height", "inputs:length", "guideRadius"), 1
        ),
        **dict.fromkeys(("physics:gravityMagnitude", "physics:velocity", "physics:centerOfMass"), 1),
        **dict.fromkeys(("physics:localPos0", "physics:localPos1", "physics:minDistance"), 1),
        **dict.fromkeys(("physics:maxDistance", "physics:breakForce"), 1),
        **dict.fromkeys(("physics:diagonalInertia", "physics:breakTorque"), 2),
        "physics:density": -3,
        **dict.fromkeys(("physxCollision:contactOffset", "physxCollision:restOffset"), 1),
        **dict.fromkeys(("physxRigidBody:maxLinearVelocity", "physxRigidBody:maxContactImpulse"), 1),
        **dict.fromkeys(("physxRigidBody:sleepThreshold", "physxRigidBody:stabilizationThreshold"), 2),
        **dict.fromkeys(("physxArticulation:sleepThreshold",), 2),
        **dict.fromkeys(("physxArticulation:stabilizationThreshold",), 2),
        "physxScene:bounceThreshold": 1,
        "physxScene:frictionOffsetThreshold": 1,
    }
)
"""Power of length in an attribute's unit, by its name; OpenUSD's schemas and PhysX's.

A camera's focal length and apertures are tenths of a unit of the stage (`UsdGeomCamera`), lengths too.
"""

DRIVES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        "targetPosition": (1, 0),
        "targetVelocity": (1, 0),
        "maxForce": (1, 2),
        "stiffness": (0, 2),
        "damping": (0, 2),
    }
)
"""Power of length in a drive's figures, along an axis and about one (`UsdPhysicsDriveAPI`)."""

TURN = "zUp"
"""Suffix of the transform op that turns what stood with Y up: `xformOp:rotateX:zUp`."""

_FOREIGN = ("physx", "newton:", "mjc:")
"""Starts of names whose lengths only other programs know all of."""


def to_metres_z_up(root: Path) -> tuple[str, ...]:
    """Convert every layer of a stage, in place, to metres with Z up.

    A point (x, y, z) of a stage of Y up is (x, -z, y) of the same world with Z up, times metres a unit.

    Args:
        root: Root layer; every layer of the stage is written.

    Returns:
        Notes on what may need a look, a line each.

    Raises:
        InputError: The stage cannot be opened, or its unit is none.
    """
    stage = open_stage(root)
    metres, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    if not (math.isfinite(metres) and metres > 0):
        raise InputError(f"{root}: metersPerUnit is {metres!r}; it must be a length above 0")
    layers = dependencies(root)[0]
    foreign: set[str] = set()
    if metres != 1:
        with Sdf.ChangeBlock():
            for layer in layers:
                foreign |= _scale(layer, metres)
    if up != UsdGeom.Tokens.z:
        _turn(stage)
    for layer in layers:
        layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
        layer.pseudoRoot.SetInfo("upAxis", UsdGeom.Tokens.z)
        layer.Save()
    if foreign:
        some = ", ".join(sorted(foreign)[:4]) + (", ..." if len(foreign) > 4 else "")
        return (
            f"{len(foreign)} attributes of physics engines stay as they were; see whether {some} are lengths",
        )
    return ()


def _scale(layer: Sdf.Layer, factor: float) -> set[str]:
    """Multiply what a layer holds by a length; returns the names that may have been missed."""
    unknown: set[str] = set()

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path) if path.IsPropertyPath() else None
        if not isinstance(spec, Sdf.AttributeSpec):
            return
        power = _power(layer, spec)
        if power is None:
            if spec.name.startswith(_FOREIGN) and isinstance(spec.default, float):
                unknown.add(spec.name)
        elif power:
            _multiply(layer, spec, factor**power)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return unknown


def _power(layer: Sdf.Layer, spec: Sdf.AttributeSpec) -> float | None:
    """Power of length in the unit of an attribute; None where it is not known to have any."""
    name, parts = spec.name, spec.name.split(":")
    if name in LENGTHS:
        return LENGTHS[name]
    if parts[0] == "xformOp" and parts[1] in ("translate", "transform"):
        return 1
    if parts[0] == "xformOp" and parts[1] in ("translateX", "translateY", "translateZ"):
        return 1
    if name in ("physics:lowerLimit", "physics:upperLimit"):
        joint = layer.GetPrimAtPath(spec.path.GetPrimPath()).typeName
        return 1 if joint == "PhysicsPrismaticJoint" else None
    if parts[0] == "drive" and parts[-1] in DRIVES:
        return DRIVES[parts[-1]][_turns(parts[1])]
    if parts[0] == "limit" and parts[-1] in ("low", "high"):
        return None if _turns(parts[1]) else 1
    return None


def _turns(axis: str) -> bool:
    """Whether a degree of freedom is about an axis."""
    return axis == "angular" or axis.startswith("rot")


def _multiply(layer: Sdf.Layer, spec: Sdf.AttributeSpec, factor: float) -> None:
    """Multiply an attribute's default and its time samples."""
    if spec.default is not None:
        spec.default = _times(spec.default, factor)
    for time in layer.ListTimeSamplesForPath(spec.path):
        value = layer.QueryTimeSample(spec.path, time)
        layer.SetTimeSample(spec.path, time, _times(value, factor))


def _times(value: Any, factor: float) -> Any:
    """A length, a vector of lengths, a matrix's translation, or an array of such, times a factor."""
    if isinstance(value, Sdf.ValueBlock):
        return value
    if isinstance(value, Gf.Matrix4d):
        return Gf.Matrix4d(value).SetTranslateOnly(value.ExtractTranslation() * factor)
    if isinstance(value, int | float):
        return value * factor if math.isfinite(value) else value
    if isinstance(value, Vt.Matrix4dArray):
        return Vt.Matrix4dArray([_times(matrix, factor) for matrix in value])
    if hasattr(type(value), "FromNumpy"):
        array = np.array(value)
        return type(value).FromNumpy((array.astype(float) * factor).astype(array.dtype))
    return type(value)(*(float(part) * factor for part in value))


def _turn(stage: Usd.Stage) -> None:
    """Turn what stands in the world: a default prim that is only the root of the rest passes the turn on."""
    for prim in _standing(stage.GetPseudoRoot().GetFilteredChildren(Usd.PrimAllPrimsPredicate)):
        _turned(prim)
    for prim in stage.TraverseAll():
        if prim.IsA(UsdPhysics.Scene):
            _map(UsdPhysics.Scene(prim).GetGravityDirectionAttr(), _with_z_up)
        elif prim.IsA(UsdPhysics.Joint):
            _turn_anchor(UsdPhysics.Joint(prim))
        elif _leaves_its_parent(prim):
            _turned(prim)


def _standing(prims: Iterable[Usd.Prim]) -> list[Usd.Prim]:
    """The topmost prims that have a place of their own."""
    found = []
    for prim in prims:
        xformable = UsdGeom.Xformable(prim)
        bare = not prim.HasAPI(UsdPhysics.RigidBodyAPI) and not prim.HasVariantSets()
        root = prim.GetTypeName() == "Xform" and prim == prim.GetStage().GetDefaultPrim()
        if not xformable or (bare and root and not xformable.GetOrderedXformOps()):
            found += _standing(prim.GetFilteredChildren(Usd.PrimAllPrimsPredicate))
        else:
            found.append(prim)
    return found


def _turned(prim: Usd.Prim) -> None:
    """Put the turn before all that moves a prim."""
    xformable = UsdGeom.Xformable(prim)
    ops, resets = xformable.GetOrderedXformOps(), xformable.GetResetXformStack()
    turn = xformable.AddRotateXOp(UsdGeom.XformOp.PrecisionDouble, TURN)
    turn.Set(90.0)
    xformable.SetXformOpOrder([turn, *ops], resets)


def _turn_anchor(joint: UsdPhysics.Joint) -> None:
    """Turn the end of a joint that holds to the world."""
    ends = (
        (joint.GetBody0Rel(), joint.GetLocalPos0Attr(), joint.GetLocalRot0Attr()),
        (joint.GetBody1Rel(), joint.GetLocalPos1Attr(), joint.GetLocalRot1Attr()),
    )
    quarter = Gf.Quatf(math.sqrt(0.5), math.sqrt(0.5), 0, 0)
    for body, place, rotation in ends:
        if not body.GetTargets():
            _map(place, _with_z_up)
            rotation.Set(quarter * (rotation.Get() or Gf.Quatf(1)))


def _with_z_up(v: Gf.Vec3f) -> Gf.Vec3f:
    return Gf.Vec3f(v[0], -v[2], v[1])


def _leaves_its_parent(prim: Usd.Prim) -> bool:
    """Whether a prim stands in the world wherever its parents stand, and was not turned with them."""
    xformable = UsdGeom.Xformable(prim)
    if not xformable or not xformable.GetResetXformStack():
        return False
    return not any(op.GetOpName().endswith(f":{TURN}") for op in xformable.GetOrderedXformOps())


def _map(attribute: Usd.Attribute, function: Callable[[Any], Any]) -> None:
    if attribute.HasAuthoredValue():
        attribute.Set(function(attribute.Get()))
