"""Drive: what holds a joint, by the user's rules or by what the URDF says of it.

UsdPhysics has gains of joints that turn per degree, URDF and we per radian.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import Literal

import numpy as np
from pxr import Usd, UsdPhysics

from magtwin.errors import InputError, hint
from magtwin.urdf.description.description import Description
from magtwin.urdf.description.model import Joint
from magtwin.urdf.options import DriveRule, Options
from magtwin.urdf.physics.mechanism import SINGLE, Mechanism

WHEEL_DAMPING = 5.0
"""Gain of a continuous joint's velocity drive [N m s/rad], for want of a better. Newton 1.8 follows it with
a 5 kg robot from 500 steps a second on; the profile diff-drive fits the gain to the robot."""

POSITION_STIFFNESS = 100.0
"""Gain of a limited joint's position drive [N m/rad, N/m]; its damping is a tenth."""

DEFAULT_EFFORT = 10.0
"""Largest effort of a drive where the URDF gives none [N m, N]."""


@dataclass(frozen=True)
class WheelDrive:
    """What a driven wheel's drive has, unless the URDF or a rule says otherwise."""

    damping: float = WHEEL_DAMPING
    """Gain on the error of velocity [N m s/rad]."""

    max_force: float = DEFAULT_EFFORT
    """Highest torque [N m]."""


NO_WHEELS: Mapping[str, WheelDrive] = MappingProxyType({})


@dataclass(frozen=True)
class Drive:
    """What holds a joint: effort = stiffness (q_target - q) + damping (v_target - v), up to max_force."""

    type: Literal["velocity", "position", "none"]
    """What it holds; none has no gains and leaves the joint free."""

    stiffness: float
    """Gain on the error of position [N m/rad or N/m]."""

    damping: float
    """Gain on the error of velocity [N m s/rad or N s/m]."""

    max_force: float
    """Highest torque or force [N m or N]."""

    target: float = 0.0
    """Position that is held [rad or m]; velocities are held at 0 until told otherwise."""


def check_rules(mechanism: Mechanism, options: Options) -> None:
    """Refuse rules that fit no joint that can be driven, since a misspelt pattern drives nothing.

    Raises:
        InputError: A rule fits none; the text names the joints.
    """
    names = [
        joint.name
        for joint in mechanism.description.joints.values()
        if joint.type != "floating"
        and joint.name not in mechanism.welded
        and joint.name not in mechanism.mimics
    ]
    for rule in options.drives:
        if not any(fnmatchcase(name, rule.joints) for name in names):
            raise InputError(
                f"{mechanism.description.path}: drive rule {rule.joints!r} fits no joint that can be driven; "
                f"{hint(rule.joints, names)}"
            )


def choose_drive(
    joint: Joint, mechanism: Mechanism, options: Options, wheels: Mapping[str, WheelDrive] = NO_WHEELS
) -> Drive | None:
    """The drive of a joint that moves; None if it has none: it follows another, or has several axes.

    The first rule that fits wins. Without one, wheels and continuous joints hold a velocity and limited
    joints a position; with the profile diff-drive, continuous joints that are no wheels are left free.

    Args:
        joint: The joint.
        mechanism: Joints of the description; its description takes notes of what was guessed.
        options: Rules and profile.
        wheels: Drives of driven wheels by name of the joint.

    Raises:
        InputError: The URDF's effort is below 0; the text gives the line.
    """
    if joint.name in mechanism.mimics:
        return None
    rule = next((r for r in options.drives if fnmatchcase(joint.name, r.joints)), None)
    if joint.type not in SINGLE and rule is None:
        return None
    if rule is not None:
        force = rule.max_force
    elif joint.type != "continuous":
        rule, force = (
            DriveRule(
                joints=joint.name,
                type="position",
                stiffness=POSITION_STIFFNESS,
                damping=POSITION_STIFFNESS / 10,
            ),
            None,
        )
    elif options.profile == "diff-drive" and joint.name not in wheels:
        rule, force = DriveRule(joints=joint.name, type="none"), None
        mechanism.description.note(f"joint {joint.name!r} is no driven wheel: it turns freely")
    else:
        damping = wheels.get(joint.name, WheelDrive()).damping
        rule, force = DriveRule(joints=joint.name, type="velocity", damping=damping), None
    if force is None:
        force = _effort(joint, wheels.get(joint.name, WheelDrive()).max_force, mechanism.description)
    return Drive(rule.type, rule.stiffness, rule.damping, force, _target(joint))


def define_drive(prim: Usd.Prim, axis: str, drive: Drive) -> None:
    """Author a drive.

    Args:
        prim: Prim of the joint.
        axis: Name of the drive in UsdPhysics: angular, linear, transX, rotX, and so on.
        drive: What to author; target positions only where a position is held.
    """
    unit = np.pi / 180 if axis == "angular" or axis.startswith("rot") else 1.0
    made = UsdPhysics.DriveAPI.Apply(prim, axis)
    made.CreateTypeAttr(UsdPhysics.Tokens.force)
    made.CreateMaxForceAttr(drive.max_force)
    made.CreateStiffnessAttr(round(drive.stiffness * unit, 9))
    made.CreateDampingAttr(round(drive.damping * unit, 9))
    if drive.type == "position":
        made.CreateTargetPositionAttr(drive.target / unit)
    else:
        made.CreateTargetVelocityAttr(0.0)


def _effort(joint: Joint, guess: float, description: Description) -> float:
    """The URDF's effort, inf for as much as it takes, or the guess with a note."""
    effort = None if joint.limit is None else joint.limit.effort
    if not effort:
        description.note(
            f"joint {joint.name!r} gives {'no effort' if effort is None else 'an effort of 0'}: "
            f"its drive may use {guess:g} {'N' if joint.type == 'prismatic' else 'N m'}"
        )
        return guess
    if not effort > 0:
        raise description.refused("joint", joint.name, f"has an effort of {effort:g}; give one above 0")
    return float(effort)


def _target(joint: Joint) -> float:
    """The position nearest to 0 that a joint's limits allow [rad or m]."""
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return 0.0
    return float(min(max(0.0, limit.lower), limit.upper))
