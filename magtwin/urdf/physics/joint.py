"""Joint: how one body holds another, and how it may move.

URDF's joint frame is the child link's; UsdPhysics wants an axis X, Y or Z of a frame on each body, so
an oblique axis turns both frames. URDF's radians are degrees in UsdPhysics.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Sdf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.urdf.description.description import Description
from magtwin.urdf.description.model import Joint
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.physics.drive import NO_WHEELS, WheelDrive, choose_drive, define_drive
from magtwin.urdf.physics.inertia import quaternion
from magtwin.urdf.physics.mechanism import Mechanism

JOINT_API, NEWTON_API, NEWTON_MIMIC_API = "IsaacJointAPI", "NewtonJointAPI", "NewtonMimicAPI"
PHYSX_API, PHYSX_AXIS_API, PHYSX_MIMIC_API = "PhysxJointAPI", "PhysxJointAxisAPI", "PhysxMimicJointAPI"
"""Applied schemas of Isaac Sim, Newton and PhysX, by name: their plugins live elsewhere."""

AXIS = "magtwin:axis"
"""Key of a joint's customData: its axis in the child's body in double precision, where it is oblique."""

KINDS = {
    "revolute": UsdPhysics.RevoluteJoint,
    "continuous": UsdPhysics.RevoluteJoint,
    "prismatic": UsdPhysics.PrismaticJoint,
    "planar": UsdPhysics.Joint,
}
"""UsdPhysics' joints by URDF's types; floating is none at all."""

LOCKED = (1.0, -1.0)
"""Limits of an axis that cannot move: UsdPhysics has the lower one above the upper."""

WHEEL_SPEED = 30.0
"""Highest speed of a driven wheel where the URDF gives none [rad/s]: some 1 m/s at the rim of a small one."""

MIMIC_FREQUENCY = 100.0
"""Natural frequency of PhysX's mimic [1/s]; with a damping ratio of 0 the coupling is hard whatever it is."""


def define_joint(
    stage: Usd.Stage,
    path: Sdf.Path,
    joint: Joint,
    ends: tuple[Sdf.Path, Sdf.Path],
    T: NDArray,
    mechanism: Mechanism,
    options: Options = DEFAULTS,
    wheels: Mapping[str, WheelDrive] = NO_WHEELS,
) -> Usd.Prim:
    """Author a joint between two bodies; its mimic comes later, see `define_mimic`.

    A planar joint is a plain PhysicsJoint whose slide along the axis and whose turns across it are
    locked, the other three axes being limited to -inf..inf, since Newton takes an axis for free only
    where it says so. PhysX holds such a joint outside its reduced coordinates.

    Args:
        stage: Written to in its edit target.
        path: Path of the joint's prim.
        joint: The joint; not a floating one.
        ends: Paths of the parent's and the child's body.
        T: Pose in the parent's body of the joint at 0, or at rest if it is welded, shape (4, 4).
        mechanism: Joints of the description; its description takes notes of what was guessed.
        options: Drives and profile.
        wheels: Joints of driven wheels by name, see `choose_drive`.

    Raises:
        InputError: A limit is missing; the text gives the line.
    """
    description, reason = mechanism.description, mechanism.welded.get(joint.name)
    made = (UsdPhysics.FixedJoint if reason is not None else KINDS[joint.type]).Define(stage, path)
    made.CreateBody0Rel().SetTargets([ends[0]])
    made.CreateBody1Rel().SetTargets([ends[1]])
    turn = np.eye(3)
    if reason is None:
        token, turn = _axis(joint.axis)
        length = float(np.linalg.norm(joint.axis))
        if not np.array_equal(np.abs(turn), np.abs(np.round(turn))):  # single precision would turn it by 1e-7
            unit = np.asarray(joint.axis, float) / length
            made.GetPrim().SetCustomDataByKey(AXIS, Gf.Vec3d(*map(float, unit)))
        if abs(length - 1) > 1e-3:
            description.note(f"joint {joint.name!r} has an axis of length {length:.3g}: taken as a direction")
        axes = _free_axes(made, joint, token, description)
        drive = choose_drive(joint, mechanism, options, wheels)
        if drive is not None:
            for axis in axes:
                define_drive(made.GetPrim(), axis, drive)
        _tune(made.GetPrim(), joint, axes, joint.name in wheels, description)
    made.CreateLocalPos0Attr(Gf.Vec3f(*(round(float(v), 12) + 0.0 for v in T[:3, 3])))
    made.CreateLocalRot0Attr(_quatf(T[:3, :3] @ turn))
    made.CreateLocalPos1Attr(Gf.Vec3f(0))
    made.CreateLocalRot1Attr(_quatf(turn))
    made.GetPrim().AddAppliedSchema(JOINT_API)
    return made.GetPrim()


def define_root_joint(
    stage: Usd.Stage, path: Sdf.Path, ends: tuple[Sdf.Path, Sdf.Path], T: NDArray
) -> Usd.Prim:
    """Bolt a robot's base to the world, where the robot's prim stands.

    Args:
        stage: Written to in its edit target.
        path: Path of the joint's prim.
        ends: Paths of the robot's prim, which is no body, and of the base.
        T: Pose of the base in the robot's prim, shape (4, 4).
    """
    made = UsdPhysics.FixedJoint.Define(stage, path)
    made.CreateBody0Rel().SetTargets([ends[0]])
    made.CreateBody1Rel().SetTargets([ends[1]])
    made.CreateLocalPos0Attr(Gf.Vec3f(*(round(float(v), 12) + 0.0 for v in T[:3, 3])))
    made.CreateLocalRot0Attr(_quatf(T[:3, :3]))
    made.CreateLocalPos1Attr(Gf.Vec3f(0))
    made.CreateLocalRot1Attr(Gf.Quatf(1))
    made.GetPrim().AddAppliedSchema(JOINT_API)
    return made.GetPrim()


def define_mimic(prim: Usd.Prim, leader: Usd.Prim, joint: Joint, lead: Joint, mechanism: Mechanism) -> None:
    """Author that a joint follows another, for Newton and for PhysX.

    Newton: q = coef0 + coef1 q_leader, coef0 in degrees where the follower turns. PhysX, until it reads
    Newton's: q + gearing q_leader + offset = 0, all in degrees or metres; it needs limits on a joint
    that turns. The follower has no drive of its own, so that the coupling owns it; a runtime that knows
    neither lets it swing.

    Args:
        prim: The follower's.
        leader: The leader's.
        joint: The follower.
        lead: The leader.
        mechanism: Joints of the description.
    """
    mimic, kinds = mechanism.mimics[joint.name], Sdf.ValueTypeNames
    unit, lead_unit = _unit(joint), _unit(lead)
    prim.AddAppliedSchema(NEWTON_MIMIC_API)
    prim.CreateRelationship("newton:mimicJoint", custom=False).SetTargets([leader.GetPath()])
    _write(prim, "newton:mimicCoef0", kinds.Float, mimic.offset * unit)
    _write(prim, "newton:mimicCoef1", kinds.Float, mimic.multiplier)
    if joint.type == "continuous" or lead.type == "continuous":
        mechanism.description.note(
            f"joint {joint.name!r} follows {lead.name!r} without limits: for Newton, not for older PhysX"
        )
        return
    instance, lead_axis = f"rot{_axis(joint.axis)[0]}", f"rot{_axis(lead.axis)[0]}"
    prim.AddAppliedSchema(f"{PHYSX_MIMIC_API}:{instance}")
    space = f"physxMimicJoint:{instance}"
    prim.CreateRelationship(f"{space}:referenceJoint", custom=False).SetTargets([leader.GetPath()])
    axis = prim.CreateAttribute(f"{space}:referenceJointAxis", kinds.Token, False, Sdf.VariabilityUniform)
    axis.Set(lead_axis)
    _write(prim, f"{space}:gearing", kinds.Float, -mimic.multiplier * unit / lead_unit)
    _write(prim, f"{space}:offset", kinds.Float, -mimic.offset * unit)
    _write(prim, f"{space}:naturalFrequency", kinds.Float, MIMIC_FREQUENCY)
    _write(prim, f"{space}:dampingRatio", kinds.Float, 0.0)


def _free_axes(made: Any, joint: Joint, token: str, description: Description) -> list[str]:
    """Author axis and limits of a joint that moves; returns the names of the axes that are free."""
    if joint.type != "planar":
        made.CreateAxisAttr(token)
        _limit(made, joint, description)
        return ["linear" if joint.type == "prismatic" else "angular"]
    free = [f"trans{other}" for other in "XYZ" if other != token] + [f"rot{token}"]
    for axis in (f"{kind}{letter}" for kind in ("trans", "rot") for letter in "XYZ"):
        limit = UsdPhysics.LimitAPI.Apply(made.GetPrim(), axis)
        low, high = (-np.inf, np.inf) if axis in free else LOCKED
        limit.CreateLowAttr(low)
        limit.CreateHighAttr(high)
    return free


def _axis(axis: ArrayLike) -> tuple[str, NDArray[np.float64]]:
    """An axis as X, Y or Z of a turned frame: the token, and the frame's rotation in the link, (3, 3)."""
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    for i, token in enumerate("XYZ"):
        if np.allclose(unit, np.eye(3)[i], rtol=0, atol=1e-9):
            return token, np.eye(3)
    other = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    other /= np.linalg.norm(other)
    return "X", np.column_stack([unit, other, np.cross(unit, other)])


def _quatf(R: NDArray) -> Gf.Quatf:
    return Gf.Quatf(*(round(float(v), 9) + 0.0 for v in wxyz_from_xyzw(quaternion(R))))


def _unit(joint: Joint) -> float:
    """UsdPhysics' measure of a joint's value, over URDF's."""
    return 1.0 if joint.type == "prismatic" else 180 / np.pi


def _write(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: object) -> None:
    """Author an attribute of a schema whose plugin is not here."""
    prim.CreateAttribute(name, kind, custom=False).Set(value)


def _limit(made: Any, joint: Joint, description: Description) -> None:
    """Range of a revolute or prismatic joint; a continuous one has none."""
    if joint.type == "continuous":
        return
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        raise description.refused("joint", joint.name, f"is {joint.type} and needs <limit lower= upper=>")
    if not limit.lower <= 0 <= limit.upper:
        description.note(
            f"joint {joint.name!r} stands at 0, outside its limits {limit.lower:g} to {limit.upper:g}: "
            "engines push it inside at their first step"
        )
    made.CreateLowerLimitAttr(limit.lower * _unit(joint))
    made.CreateUpperLimitAttr(limit.upper * _unit(joint))


def _tune(prim: Usd.Prim, joint: Joint, axes: list[str], wheel: bool, description: Description) -> None:
    """Highest speed, damping and friction of a joint, as Newton and PhysX read them."""
    names, unit = Sdf.ValueTypeNames.Float, _unit(joint)
    damping, friction = (
        float(getattr(joint.dynamics, name, None) or 0.0) for name in ("damping", "friction")
    )
    speed = _speed(joint, wheel, description)
    prim.AddAppliedSchema(NEWTON_API)
    if speed is not None and joint.type != "planar":
        _write(prim, "newton:velocityLimit", names, speed * unit)
        prim.AddAppliedSchema(PHYSX_API)
        _write(prim, "physxJoint:maxJointVelocity", names, speed * unit)
    if joint.dynamics is None:
        return
    _write(prim, "newton:damping", names, damping / unit)
    _write(prim, "newton:friction", names, friction)
    for axis in axes if damping or friction else ():
        prim.AddAppliedSchema(f"{PHYSX_AXIS_API}:{axis}")
        per = 1.0 if axis.startswith(("linear", "trans")) else 180 / np.pi
        _write(prim, f"physxJointAxis:{axis}:staticFrictionEffort", names, friction)
        _write(prim, f"physxJointAxis:{axis}:dynamicFrictionEffort", names, friction)
        _write(prim, f"physxJointAxis:{axis}:viscousFrictionCoefficient", names, damping / per)
        if speed is not None and joint.type != "planar":
            _write(prim, f"physxJointAxis:{axis}:maxJointVelocity", names, speed * unit)


def _speed(joint: Joint, wheel: bool, description: Description) -> float | None:
    """The URDF's highest speed [rad/s or m/s]; None if it gives none, but for a driven wheel."""
    speed = None if joint.limit is None else joint.limit.velocity
    if speed and np.isfinite(speed):
        return float(speed)
    if wheel:
        description.note(f"joint {joint.name!r} gives no velocity: it may turn at {WHEEL_SPEED:g} rad/s")
        return WHEEL_SPEED
    return None
