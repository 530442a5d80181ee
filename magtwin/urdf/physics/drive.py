"""Drive: what actuates a joint, from the user's rules or from the URDF.

Gains of rotary joints are per degree in UsdPhysics, and per radian in URDF and here.
"""

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from types import MappingProxyType

import numpy as np
from pxr import Usd, UsdPhysics

from magtwin.errors import InputError, hint
from magtwin.urdf.description.description import Description
from magtwin.urdf.description.model import Joint
from magtwin.urdf.options import DriveRule, Options
from magtwin.urdf.physics.mechanism import SINGLE, Mechanism

WHEEL_DAMPING = 5.0
"""Default gain of a continuous joint's velocity drive [N m s/rad]. With it, Newton 1.8 is stable for a 5 kg
robot from 500 steps a second; the profile diff-drive fits the gain to the robot."""

RESPONSE = 0.007
"""Response time of a wheel's velocity drive [s]."""

ROTOR_KG_M2 = 0.002
"""Default inertia of a wheel's motor through its gears; assumed. With less, a wheel answers a stiff drive
within one step: MuJoCo's implicit integrator then corrects the wheel but not the contact, and throws a robot
of 5 kg."""

POSITION_STIFFNESS = 100.0
"""Least default gain of a position drive that slides, or that a `<ros2_control>` gives to a joint without
limits [N m/rad, N/m]; the damping of a position drive is a tenth of its gain."""

POSITION_HZ = 10.0
"""Natural frequency of the drive with what it carries: an arm of length L then sags by about
g / (2 pi f)^2 = 2.5 mm, whatever its mass."""

PER_INERTIA = (2 * np.pi * POSITION_HZ) ** 2
"""Stiffness of that frequency over the inertia [1/s2]."""

ROUNDING = 1e-5
"""Inertia that a gain of three figures may lack, relative to the gain [s2]."""

YIELD_RAD, STIFFEST = 0.1, 1000.0
"""The gain of a joint that turns is at least its effort over this angle [rad], as far as that is at most
`STIFFEST` [N m/rad]: the knee of a standing robot carries more than the links below it."""

ROLLING_NAMES = ("wheel", "caster", "castor")
"""Words in the names of joints and links that roll."""

DEFAULT_EFFORT = 10.0
"""Least default for the maximum effort of a drive [N m, N]."""

RESERVE = 2.0
"""Default maximum effort of a position drive, relative to the weight that it carries."""

STRONGER = 10.0
"""Gain of a velocity drive over its joint's own damping, and over its friction at 1 rad/s or m/s: it falls
short of its target by about a tenth."""

OWN_SPEED = {"prismatic": 1.0}
"""Speed at which a drive overcomes its joint's own damping, if no velocity is given; 10 rad/s if it turns."""


Wheels = Mapping[str, tuple[float, float]]
"""Default gain [N m s/rad] and maximum torque [N m] of driven wheels, by joint name."""

NO_WHEELS: Wheels = MappingProxyType({})


def check_rules(mechanism: Mechanism, options: Options) -> None:
    """Refuse rules that match no joint, since a misspelt pattern would drive nothing.

    Raises:
        InputError: A rule matches no joint that can be driven; the message suggests a near name.
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


def define_drive(
    prim: Usd.Prim,
    axes: Iterable[str],
    joint: Joint,
    mechanism: Mechanism,
    options: Options,
    wheels: Wheels = NO_WHEELS,
) -> None:
    """Author the drive of a joint that moves.

    The first rule that matches wins. By default a joint holds a position (see `holds_position`), or else a
    velocity; with the profile diff-drive, the latter is left free unless it is a wheel. The gains of a joint
    that follows another, or has several axes and no rule, are 0: it moves freely.

    Args:
        prim: Prim of the joint.
        axes: Names of its free axes in UsdPhysics: angular, linear, transX, rotX, and so on.
        joint: The joint.
        mechanism: Joints of the description, which receives notes.
        options: Rules and profile.
        wheels: Driven wheels.
    """
    rule = _rule(joint, options)
    if joint.name in mechanism.mimics or (joint.type not in SINGLE and rule is None):
        effort = None if joint.limit is None else joint.limit.effort
        force = float(effort) if effort and 0 < effort < np.inf else DEFAULT_EFFORT
        for axis in axes:  # Isaac Sim's rules want a drive on every joint that moves
            _define_gains(prim, axis, force, 0.0, 0.0)
        return
    damping, force = wheels.get(joint.name, (WHEEL_DAMPING, DEFAULT_EFFORT))
    damping += own_gain(joint)
    if rule is None and joint.name not in wheels and holds_position(joint, mechanism):
        force = max(DEFAULT_EFFORT, float(f"{RESERVE * mechanism.loads[joint.name].weight:.3g}"))
        gain = _position_gain(joint, mechanism, force + _own_force(joint))
        rule = DriveRule(joints=joint.name, type="position", stiffness=gain, damping=gain / 10)
    elif rule is None and options.profile == "diff-drive" and joint.name not in wheels:
        rule = DriveRule(joints=joint.name, type="none")
        mechanism.description.note(f"joint {joint.name!r} is not a driven wheel: it turns freely")
    elif rule is None:
        rule = DriveRule(joints=joint.name, type="velocity", damping=damping)
    force += _own_force(joint)
    force = _effort(joint, force, mechanism.description) if rule.max_force is None else rule.max_force
    for axis in axes:
        unit = np.pi / 180 if axis == "angular" or axis.startswith("rot") else 1.0
        made = _define_gains(prim, axis, force, rule.stiffness * unit, rule.damping * unit)
        if rule.type == "position":
            made.CreateTargetPositionAttr(_target(joint) / unit)
        else:
            made.CreateTargetVelocityAttr(0.0)


def holds_position(joint: Joint, mechanism: Mechanism) -> bool:
    """Whether a joint holds a position by default: it has limits, or it bears a load and is no wheel by name.

    A velocity drive gives way under a load, as in arms and legs whose joints an exporter made continuous.
    """
    if joint.type != "continuous":
        return True
    rolls = any(word in f"{joint.name} {joint.child}".lower() for word in ROLLING_NAMES)
    return not rolls and joint.name in mechanism.bearers


def _rule(joint: Joint, options: Options) -> DriveRule | None:
    """The first rule that matches a joint."""
    return next((rule for rule in options.drives if fnmatchcase(joint.name, rule.joints)), None)


def _position_gain(joint: Joint, mechanism: Mechanism, default: float) -> float:
    """Default stiffness of a position drive [N m/rad or N/m]; `default` is its effort if none is given."""
    least = POSITION_STIFFNESS
    if joint.type != "prismatic":
        effort = None if joint.limit is None else joint.limit.effort
        least = min((effort if effort and effort > 0 else default) / YIELD_RAD, STIFFEST)
    return float(f"{max(least, PER_INERTIA * mechanism.loads[joint.name].inertia):.3g}")


def own_gain(joint: Joint) -> float:
    """What a velocity drive's gain needs for the joint's own damping and friction [N m s/rad or N s/m]."""
    friction, damping = _resistance(joint)
    return float(f"{STRONGER * (friction + damping):.3g}")


def _own_force(joint: Joint) -> float:
    """What a drive needs to move its joint against its own damping and friction [N m or N]."""
    friction, damping = _resistance(joint)
    speed = None if joint.limit is None else joint.limit.velocity
    if not speed or not np.isfinite(speed):
        speed = OWN_SPEED.get(joint.type, 10.0)
    return float(f"{friction + damping * speed:.3g}")


def _resistance(joint: Joint) -> tuple[float, float]:
    """Friction [N m or N] and damping [N m s/rad or N s/m] of a joint."""
    own = joint.dynamics
    return (0.0, 0.0) if own is None else (float(own.friction or 0.0), float(own.damping or 0.0))


def _define_gains(
    prim: Usd.Prim, axis: str, force: float, stiffness: float, damping: float
) -> UsdPhysics.DriveAPI:
    """A drive of a joint's axis with gains in the units of UsdPhysics; with gains of 0 it exerts nothing."""
    made = UsdPhysics.DriveAPI.Apply(prim, axis)
    made.CreateTypeAttr(UsdPhysics.Tokens.force)
    made.CreateMaxForceAttr(force)
    made.CreateStiffnessAttr(round(stiffness, 9))
    made.CreateDampingAttr(round(damping, 9))
    return made


def rotor_inertia(prim: Usd.Prim, joint: Joint, mechanism: Mechanism, options: Options) -> float:
    """Inertia of the motor of a joint [kg m2 or kg]; 0 if it needs none.

    A velocity drive: at most gain times `RESPONSE`, so that the rotor of a small robot does not slow its
    drive. A default position drive: what its load lacks for `POSITION_HZ`. Without it, a finger of 1e-9 kg m2
    passes its target by many turns within a step.
    """
    axis = "linear" if joint.type == "prismatic" else "angular"
    if joint.type not in SINGLE or not prim.HasAPI(UsdPhysics.DriveAPI, axis):
        return 0.0
    drive, unit = UsdPhysics.DriveAPI(prim, axis), 1.0 if axis == "linear" else 180 / np.pi
    damping, stiffness = drive.GetDampingAttr().Get() * unit, drive.GetStiffnessAttr().Get() * unit
    if stiffness:
        lacks = stiffness / PER_INERTIA - mechanism.loads[joint.name].inertia
        return 0.0 if _rule(joint, options) or lacks < ROUNDING * stiffness else float(f"{lacks:.3g}")
    return 0.0 if axis == "linear" else float(f"{min(ROTOR_KG_M2, damping * RESPONSE):.3g}")


def _effort(joint: Joint, default: float, description: Description) -> float:
    """The URDF's effort, which may be infinite, or the default with a note."""
    effort = None if joint.limit is None else joint.limit.effort
    if not effort:
        description.note(
            f"joint {joint.name!r} gives {'no effort' if effort is None else 'an effort of 0'}: "
            f"its drive may use {default:g} {'N' if joint.type == 'prismatic' else 'N m'}"
        )
        return default
    return float(effort)


def _target(joint: Joint) -> float:
    """The position nearest to 0 within a joint's limits [rad or m]."""
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return 0.0
    return float(min(max(0.0, limit.lower), limit.upper))
