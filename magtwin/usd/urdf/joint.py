"""Joint: how one body holds another, and the drive that moves it.

URDF's joint frame is the child link's; UsdPhysics wants an axis X, Y or Z of a frame on each body, so
an oblique axis turns both frames. URDF's radians are degrees in UsdPhysics.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Sdf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.usd.urdf.description import Description
from magtwin.usd.urdf.inertia import quaternion

JOINT_API, NEWTON_API = "IsaacJointAPI", "NewtonJointAPI"
"""Applied schemas of Isaac Sim and Newton, by name: their plugins live elsewhere."""

WHEEL_DAMPING = 5.0
"""Gain of a continuous joint's velocity drive [N m s/rad]: stiff enough for Newton to hold a commanded
speed of a 4 kg robot to 1 %, soft enough to be stable at 60 steps a second."""

POSITION_STIFFNESS = 100.0
"""Gain of a limited joint's position drive [N m/rad, N/m]."""

DEFAULT_EFFORT = 10.0
"""Largest effort of a drive where the URDF gives none [N m, N]."""


def is_welded(joint: Any) -> bool:
    """Whether a joint cannot move: fixed, or by its own limits (no effort and no speed, or no room)."""
    limit = joint.limit
    if joint.type == "fixed":
        return True
    if limit is None:
        return False
    if limit.effort == 0 and limit.velocity == 0:
        return True
    return joint.type != "continuous" and limit.lower is not None and limit.lower == limit.upper


def define_joint(
    stage: Usd.Stage,
    path: Sdf.Path,
    joint: Any,
    ends: tuple[Sdf.Path, Sdf.Path],
    T: NDArray,
    description: Description,
) -> Usd.Prim:
    """Author a joint between two bodies.

    Args:
        stage: Written to in its edit target.
        path: Path of the joint's prim.
        joint: yourdfpy's joint.
        ends: Paths of the parent's and the child's body.
        T: Pose of the joint in the parent's body, shape (4, 4).
        description: Takes notes of what was guessed.

    Raises:
        RefusedError: A limit is missing, upside down, or not above 0; the text gives the line.
    """
    if is_welded(joint):
        made = UsdPhysics.FixedJoint.Define(stage, path)
        if joint.type != "fixed":
            description.note(f"joint {joint.name!r} ({joint.type}) cannot move by its own limits: welded")
    elif joint.type == "prismatic":
        made = UsdPhysics.PrismaticJoint.Define(stage, path)
    else:
        made = UsdPhysics.RevoluteJoint.Define(stage, path)
    made.CreateBody0Rel().SetTargets([ends[0]])
    made.CreateBody1Rel().SetTargets([ends[1]])
    turn = np.eye(3)
    if not is_welded(joint):
        token, turn = _axis(joint.axis)
        made.CreateAxisAttr(token)
        _limit(made, joint, description)
        _drive(made.GetPrim(), joint, description)
    made.CreateLocalPos0Attr(Gf.Vec3f(*(round(float(v), 12) + 0.0 for v in T[:3, 3])))
    made.CreateLocalRot0Attr(_quatf(T[:3, :3] @ turn))
    made.CreateLocalPos1Attr(Gf.Vec3f(0))
    made.CreateLocalRot1Attr(_quatf(turn))
    made.GetPrim().AddAppliedSchema(JOINT_API)
    if joint.mimic is not None:
        description.note(f"joint {joint.name!r}: that it mimics {joint.mimic.joint!r} is not converted")
    return made.GetPrim()


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


def _limit(made: Any, joint: Any, description: Description) -> None:
    """Range of a revolute or prismatic joint; a continuous one has none."""
    if joint.type == "continuous":
        return
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        raise description.refused("joint", joint.name, f"is {joint.type} and needs <limit lower= upper=>")
    if not limit.lower < limit.upper:
        raise description.refused(
            "joint", joint.name, f"has its lower limit {limit.lower:g} above its upper {limit.upper:g}"
        )
    unit = 180 / np.pi if joint.type == "revolute" else 1.0
    made.CreateLowerLimitAttr(limit.lower * unit)
    made.CreateUpperLimitAttr(limit.upper * unit)


def _drive(prim: Usd.Prim, joint: Any, description: Description) -> None:
    """A velocity drive on a continuous joint, a position drive on a limited one, of finite effort."""
    limit, dynamics = joint.limit, joint.dynamics
    angular = joint.type != "prismatic"
    unit = np.pi / 180 if angular else 1.0  # gains are per degree in UsdPhysics
    effort = None if limit is None else limit.effort
    if not effort:
        description.note(
            f"joint {joint.name!r} gives {'no effort' if effort is None else 'an effort of 0'}: "
            f"its drive may use {DEFAULT_EFFORT:g} {'N m' if angular else 'N'}"
        )
        effort = DEFAULT_EFFORT
    if effort < 0 or not np.isfinite(effort):
        raise description.refused("joint", joint.name, f"has an effort of {effort:g}; give one above 0")
    drive = UsdPhysics.DriveAPI.Apply(prim, "angular" if angular else "linear")
    drive.CreateTypeAttr(UsdPhysics.Tokens.force)
    drive.CreateMaxForceAttr(effort)
    if joint.type == "continuous":
        drive.CreateStiffnessAttr(0.0)
        drive.CreateDampingAttr(round(WHEEL_DAMPING * unit, 9))
        drive.CreateTargetVelocityAttr(0.0)
    else:
        drive.CreateStiffnessAttr(round(POSITION_STIFFNESS * unit, 9))
        drive.CreateDampingAttr(round(POSITION_STIFFNESS / 10 * unit, 9))
        drive.CreateTargetPositionAttr(0.0)
    prim.AddAppliedSchema(NEWTON_API)
    names, tuning = Sdf.ValueTypeNames, {}
    if limit is not None and limit.velocity:
        tuning["velocityLimit"] = limit.velocity / unit
    if dynamics is not None:
        tuning["damping"] = _passive(joint, "damping", description) * unit
        tuning["friction"] = _passive(joint, "friction", description)
    for name, value in tuning.items():
        prim.CreateAttribute(f"newton:{name}", names.Float, custom=False).Set(float(value))


def _passive(joint: Any, name: str, description: Description) -> float:
    """A figure of a joint's `<dynamics>`, which yourdfpy leaves as text; 0 where there is none."""
    text = getattr(joint.dynamics, name)
    try:
        value = float(text or 0.0)
    except ValueError:
        value = -1.0
    if not 0 <= value < np.inf:
        raise description.refused("joint", joint.name, f"has a {name} of {text!r}; give a number from 0 up")
    return value
