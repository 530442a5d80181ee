"""Joint: how one body holds another, and how it may move.

URDF's joint frame is the frame of the child link. UsdPhysics needs an axis X, Y or Z of a frame on each
body, so an oblique axis turns both frames. Angles are radians in URDF and degrees in UsdPhysics.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Sdf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.urdf.description.description import Description
from magtwin.urdf.description.model import Joint
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.physics.drive import NO_WHEELS, Wheels, define_drive, rotor_inertia
from magtwin.urdf.physics.inertia import quaternion
from magtwin.urdf.physics.mechanism import Mechanism

JOINT_API, NEWTON_API, NEWTON_MIMIC_API = "IsaacJointAPI", "NewtonJointAPI", "NewtonMimicAPI"
MUJOCO_API = "MjcJointAPI"
PHYSX_API, PHYSX_AXIS_API, PHYSX_MIMIC_API = "PhysxJointAPI", "PhysxJointAxisAPI", "PhysxMimicJointAPI"
ROTORS = (NEWTON_API, "newton"), (PHYSX_API, "physxJoint"), (MUJOCO_API, "mjc")
STATE_API = "PhysicsJointStateAPI"
"""Applied schemas of Isaac Sim, Newton, MuJoCo and PhysX; their plugins are not installed here."""

AXIS = "magtwin:axis"
"""Key of a joint's customData: an oblique axis in the child's body in double precision."""

KINDS = {
    "revolute": UsdPhysics.RevoluteJoint,
    "continuous": UsdPhysics.RevoluteJoint,
    "prismatic": UsdPhysics.PrismaticJoint,
    "planar": UsdPhysics.Joint,
}
"""UsdPhysics' joints by URDF type; a floating joint has no prim."""

LOCKED = (1.0, -1.0)
"""Limits of an axis that cannot move: in UsdPhysics, the lower limit is above the upper."""

WHEEL_SPEED = 30.0
"""Default maximum speed of a driven wheel [rad/s]: about 1 m/s at the rim of a small wheel."""

MIMIC_FREQUENCY = 100.0
"""Natural frequency of PhysX's mimic [1/s]; without effect at a damping ratio of 0 (hard coupling)."""


def define_joint(
    stage: Usd.Stage,
    path: Sdf.Path,
    joint: Joint,
    ends: tuple[Sdf.Path, Sdf.Path],
    T: NDArray,
    mechanism: Mechanism,
    options: Options = DEFAULTS,
    wheels: Wheels = NO_WHEELS,
) -> Usd.Prim:
    """Author a joint between two bodies; `define_mimic` adds its mimic later.

    A planar joint is a PhysicsJoint whose slide along the axis and whose rotations across it are locked.
    The other three axes have limits of -inf..inf, because Newton needs explicit limits on free axes. PhysX
    holds such a joint outside its reduced coordinates.

    Args:
        stage: Stage; its edit target is written to.
        path: Path of the joint's prim.
        joint: A joint that is not floating.
        ends: Paths of the parent's and the child's body.
        T: Pose of the joint in the parent's body, at 0, or at rest if welded, shape (4, 4).
        mechanism: Joints of the description, which receives notes.
        options: Drives and profile.
        wheels: Driven wheels.
    """
    if joint.name in mechanism.welded:
        return define_fixed_joint(stage, path, ends, T)
    description = mechanism.description
    token, turn = _axis(joint.axis)
    made = _define(KINDS[joint.type], stage, path, ends, T, turn)
    prim, length = made.GetPrim(), float(np.linalg.norm(joint.axis))
    if not np.array_equal(np.abs(turn), np.abs(np.round(turn))):  # single precision would be off by 1e-7
        prim.SetCustomDataByKey(AXIS, Gf.Vec3d(*map(float, np.asarray(joint.axis, float) / length)))
    if abs(length - 1) > 1e-3:
        description.note(f"joint {joint.name!r} has an axis of length {length:.3g}: used as a direction")
    axes = _free_axes(made, joint, token, description)
    define_drive(prim, axes, joint, mechanism, options, wheels)
    rotor = rotor_inertia(prim, joint, mechanism, options)
    _tune(prim, joint, axes, joint.name in wheels, rotor, description)
    if joint.type != "planar":
        _define_state(prim, axes[0], mechanism.rests.get(joint.name, 0.0) * _unit(joint))
    prim.AddAppliedSchema(JOINT_API)
    return prim


def define_fixed_joint(
    stage: Usd.Stage, path: Sdf.Path, ends: tuple[Sdf.Path, Sdf.Path], T: NDArray
) -> Usd.Prim:
    """Author a fixed joint.

    Args:
        stage: Stage; its edit target is written to.
        path: Path of the joint's prim.
        ends: Paths of the two bodies. To fix a base to the world, the first is the robot's prim, not a body.
        T: Pose of the second body in the first, shape (4, 4).
    """
    prim = _define(UsdPhysics.FixedJoint, stage, path, ends, T).GetPrim()
    prim.AddAppliedSchema(JOINT_API)
    return prim


def define_mimic(prim: Usd.Prim, leader: Usd.Prim, joint: Joint, lead: Joint, mechanism: Mechanism) -> None:
    """Author that a joint follows another, for Newton and for PhysX.

    Newton: q = coef0 + coef1 q_leader, with coef0 in degrees if the follower rotates. PhysX, until it reads
    Newton's attributes: q + gearing q_leader + offset = 0, in degrees or metres, with limits on a joint
    that rotates. The follower's drive has no gains, so that the coupling alone moves it; a runtime that
    supports neither lets it move freely.

    Args:
        prim: Prim of the follower.
        leader: Prim of the leader.
        joint: The follower.
        lead: The leader.
        mechanism: Joints of the description.
    """
    mimic, kinds = mechanism.mimics[joint.name], Sdf.ValueTypeNames
    unit, lead_unit = _unit(joint), _unit(lead)
    prim.AddAppliedSchema(NEWTON_MIMIC_API)
    prim.CreateRelationship("newton:mimicJoint", custom=False).SetTargets([leader.GetPath()])
    _write(prim, "newton:mimicCoef0", mimic.offset * unit)
    _write(prim, "newton:mimicCoef1", mimic.multiplier)
    if joint.type == "continuous" or lead.type == "continuous":
        mechanism.description.note(
            f"joint {joint.name!r} follows {lead.name!r} without limits: read by Newton, not by older PhysX"
        )
        return
    instance, lead_axis = f"rot{_axis(joint.axis)[0]}", f"rot{_axis(lead.axis)[0]}"
    prim.AddAppliedSchema(f"{PHYSX_MIMIC_API}:{instance}")
    space = f"physxMimicJoint:{instance}"
    prim.CreateRelationship(f"{space}:referenceJoint", custom=False).SetTargets([leader.GetPath()])
    axis = prim.CreateAttribute(f"{space}:referenceJointAxis", kinds.Token, False, Sdf.VariabilityUniform)
    axis.Set(lead_axis)
    _write(prim, f"{space}:gearing", -mimic.multiplier * unit / lead_unit)
    _write(prim, f"{space}:offset", -mimic.offset * unit)
    _write(prim, f"{space}:naturalFrequency", MIMIC_FREQUENCY)
    _write(prim, f"{space}:dampingRatio", 0.0)


def _define(
    schema: Any,
    stage: Usd.Stage,
    path: Sdf.Path,
    ends: tuple[Sdf.Path, Sdf.Path],
    T: NDArray,
    turn: NDArray | None = None,
) -> Any:
    """A joint of a schema whose frames are turned by `turn`, shape (3, 3), on both bodies."""
    turn = np.eye(3) if turn is None else turn
    made = schema.Define(stage, path)
    made.CreateBody0Rel().SetTargets([ends[0]])
    made.CreateBody1Rel().SetTargets([ends[1]])
    made.CreateLocalPos0Attr(Gf.Vec3f(*(round(float(v), 12) + 0.0 for v in T[:3, 3])))
    made.CreateLocalRot0Attr(_quatf(T[:3, :3] @ turn))
    made.CreateLocalPos1Attr(Gf.Vec3f(0))
    made.CreateLocalRot1Attr(_quatf(turn))
    return made


def _free_axes(made: Any, joint: Joint, token: str, description: Description) -> list[str]:
    """Author axis and limits of a joint that moves; returns the names of the free axes."""
    if joint.type != "planar":
        made.CreateAxisAttr(token)
        limit = joint.limit
        if joint.type == "continuous":
            return ["angular"]
        assert limit is not None  # the grammar completes limits
        assert limit.lower is not None
        assert limit.upper is not None
        if not limit.lower <= 0 <= limit.upper:
            description.note(
                f"joint {joint.name!r} stands at 0, outside its limits {limit.lower:g} to {limit.upper:g}: "
                "engines push it inside at their first step"
            )
        made.CreateLowerLimitAttr(limit.lower * _unit(joint))
        made.CreateUpperLimitAttr(limit.upper * _unit(joint))
        return ["linear" if joint.type == "prismatic" else "angular"]
    free = [f"trans{other}" for other in "XYZ" if other != token] + [f"rot{token}"]
    for axis in (f"{kind}{letter}" for kind in ("trans", "rot") for letter in "XYZ"):
        api = UsdPhysics.LimitAPI.Apply(made.GetPrim(), axis)
        low, high = (-np.inf, np.inf) if axis in free else LOCKED
        api.CreateLowAttr(low)
        api.CreateHighAttr(high)
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


def _define_state(prim: Usd.Prim, axis: str, position: float) -> None:
    """Author where a joint stands, without motion: Isaac Sim writes its state there while it runs."""
    prim.AddAppliedSchema(f"{STATE_API}:{axis}")
    _write(prim, f"state:{axis}:physics:position", position)
    _write(prim, f"state:{axis}:physics:velocity", 0.0)


def _unit(joint: Joint) -> float:
    """UsdPhysics' unit of a joint's value, over URDF's."""
    return 1.0 if joint.type == "prismatic" else 180 / np.pi


def _write(prim: Usd.Prim, name: str, value: float) -> None:
    """Author a number of a schema whose plugin is not installed."""
    prim.CreateAttribute(name, Sdf.ValueTypeNames.Float, custom=False).Set(value)


def _tune(
    prim: Usd.Prim, joint: Joint, axes: list[str], wheel: bool, rotor: float, description: Description
) -> None:
    """Maximum speed, rotor inertia, damping and friction of a joint, for Newton, PhysX and MuJoCo.

    PhysX from 2026 on reads the Newton attributes of the whole joint, older ones PhysxJointAPI.
    """
    unit = _unit(joint)
    speed = None if joint.limit is None or joint.type == "planar" else joint.limit.velocity
    speed = speed if speed and np.isfinite(speed) else None
    if speed is None and wheel:
        description.note(f"joint {joint.name!r} gives no velocity: it may turn at {WHEEL_SPEED:g} rad/s")
        speed = WHEEL_SPEED
    prim.AddAppliedSchema(NEWTON_API)
    if speed is not None:
        _write(prim, "newton:velocityLimit", speed * unit)
        prim.AddAppliedSchema(PHYSX_API)
        _write(prim, "physxJoint:maxJointVelocity", speed * unit)
    for schema, name in ROTORS if rotor else ():
        prim.AddAppliedSchema(schema)
        _write(prim, f"{name}:armature", rotor)
    if joint.dynamics is None:
        return
    damping, friction = float(joint.dynamics.damping or 0.0), float(joint.dynamics.friction or 0.0)
    _write(prim, "newton:damping", damping / unit)
    _write(prim, "newton:friction", friction)
    for axis in axes if damping or friction else ():
        prim.AddAppliedSchema(f"{PHYSX_AXIS_API}:{axis}")
        space, per = f"physxJointAxis:{axis}", 1.0 if axis.startswith(("linear", "trans")) else 180 / np.pi
        _write(prim, f"{space}:staticFrictionEffort", friction)
        _write(prim, f"{space}:dynamicFrictionEffort", friction)
        _write(prim, f"{space}:viscousFrictionCoefficient", damping / per)
        if speed is not None:
            _write(prim, f"{space}:maxJointVelocity", speed * unit)
