"""Wheel: what the profile diff-drive finds on a robot, its driven wheels and what slides on the floor."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Joint, Link
from magtwin.urdf.options import DriveRule
from magtwin.urdf.physics.drive import WheelDrive
from magtwin.urdf.physics.gazebo import Surface
from magtwin.urdf.physics.mechanism import Mechanism

WHEEL_FRICTION, CASTER_FRICTION = 1.0, 0.05
"""Friction of driven wheels and of what slides, where the URDF gives none: rubber, and a polished ball."""

RESPONSE = 0.007
"""Time in which a wheel's drive takes on a speed [s]."""

GRAVITY = 9.81
"""[m/s2]."""

CASTER_NAMES = ("caster", "castor")
"""What links that slide are called."""

FLOOR = 0.002
"""Distance from the lowest point of the wheels within which something else touches the floor too [m]."""


def find_wheels(mechanism: Mechanism, named: Iterable[str] = ()) -> tuple[str, ...]:
    """Names of the joints of a robot's driven wheels.

    Those that a drive plugin names, or else the continuous joints about a level axis, but those of
    casters: called so, or below a joint that swivels about the vertical.

    Args:
        mechanism: Joints of the description.
        named: Names of joints that a drive plugin gives.

    Raises:
        InputError: There are fewer than two.
    """
    description, poses = mechanism.description, mechanism.poses()
    joints = {joint.name: joint for joint in description.joints.values()}
    wheels = tuple(
        name for name in named if name in joints and joints[name].type in ("continuous", "revolute")
    )
    if not wheels:
        wheels = tuple(
            name
            for name, joint in joints.items()
            if _rolls(joint, poses)
            and not any(word in f"{name} {joint.child}".lower() for word in CASTER_NAMES)
            and not any(_swivels(above, poses) for above in _above(joint, description))
        )
    if len(wheels) < 2:
        raise InputError(
            f"{description.path}: profile diff-drive wants two wheels, continuous joints about a level axis; "
            f"found {', '.join(wheels) or 'none'}; convert with the profile general"
        )
    return wheels


def not_on(wheels: Iterable[str], rules: Iterable[DriveRule]) -> tuple[DriveRule, ...]:
    """The rules that fit no driven wheel: this profile knows better than an interface without gains."""
    names = tuple(wheels)
    return tuple(rule for rule in rules if not any(fnmatchcase(name, rule.joints) for name in names))


def fit_wheels(
    mechanism: Mechanism, wheels: Iterable[str], bodies: Mapping[str, Usd.Prim]
) -> dict[str, WheelDrive]:
    """What the wheels need to drive this robot, from its mass m, their number n and their radius r.

    Gain kd = m r^2 / (n t): the robot takes on a commanded speed within some t = RESPONSE. Torque
    mu m g r / n: what the rim can pass on to the floor. Measured in Newton 1.8 with a 5.4 kg robot at
    120 to 500 steps a second, a step of the command is followed to 3 %; ten times the gain needs 500
    steps, since its solver holds a saturated drive back by kd dt as if that were inertia.

    Args:
        mechanism: Joints of the description.
        wheels: Names of the joints of driven wheels.
        bodies: Prims of the bodies by name of their link, with masses and shapes.

    Returns:
        Drives by name of the joint; the usual one where a wheel has no shape or the robot no mass.
    """
    masses = [
        UsdPhysics.MassAPI(p).GetMassAttr().Get() for p in bodies.values() if p.HasAPI(UsdPhysics.MassAPI)
    ]
    names = tuple(wheels)
    share, fitted = sum(masses) / len(names), {}
    joints = {joint.name: joint for joint in mechanism.description.joints.values()}
    for name in names:
        body = bodies.get(joints[name].child)
        radius = 0.0 if body is None else _radius(body, joints[name].axis)
        fitted[name] = WheelDrive()
        if share * radius > 0:
            torque = WHEEL_FRICTION * share * GRAVITY * radius
            damping = share * radius**2 / RESPONSE
            fitted[name] = WheelDrive(float(f"{damping:.3g}"), float(f"{torque:.3g}"))
    return fitted


def grip(mechanism: Mechanism, wheels: Iterable[str], surfaces: Mapping[str, Surface]) -> dict[str, Surface]:
    """Surfaces by link, with friction for wheels and casters that have none of their own.

    A caster is a link with a collider that is called one, or whose primitive touches the floor on which
    the wheels stand.

    Args:
        mechanism: Joints of the description; its description takes notes of what was guessed.
        wheels: Names of the joints of driven wheels.
        surfaces: Those that the URDF gives; they win.
    """
    description, poses = mechanism.description, mechanism.poses()
    given, driven = dict(surfaces), {j.child for j in description.joints.values() if j.name in wheels}
    floor = min((_lowest(description.links[name], poses[name]) for name in driven), default=np.inf)
    for name, link in description.links.items():
        if name in given or not link.collisions:
            continue
        called = any(word in name.lower() for word in CASTER_NAMES)
        if name in driven:
            friction, what = WHEEL_FRICTION, "a driven wheel"
        elif called or abs(_lowest(link, poses[name]) - floor) < FLOOR:
            friction, what = CASTER_FRICTION, "a caster"
        else:
            continue
        given[name] = replace(Surface(), friction=friction)
        description.note(f"link {name!r} is {what} and gives no friction: {friction:g}")
    return given


def _radius(body: Usd.Prim, axis: NDArray) -> float:
    """Half of the largest extent of a wheel across its axis [m]; 0 if it has no shape."""
    purposes = [UsdGeom.Tokens.guide, UsdGeom.Tokens.default_, UsdGeom.Tokens.render]
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes)
    extent = cache.ComputeUntransformedBound(body).ComputeAlignedRange()
    across = np.abs(axis) / np.linalg.norm(axis) < 0.7
    return 0.0 if extent.IsEmpty() else float(np.max(np.asarray(extent.GetSize())[across]) / 2)


def _rolls(joint: Joint, poses: Mapping[str, NDArray]) -> bool:
    """Whether a joint turns for ever about an axis within 30 degrees of level."""
    return joint.type == "continuous" and abs(_axis(joint, poses)[2]) < 0.5


def _swivels(joint: Joint, poses: Mapping[str, NDArray]) -> bool:
    """Whether a joint turns for ever about an axis that is not level."""
    return joint.type == "continuous" and abs(_axis(joint, poses)[2]) >= 0.5


def _axis(joint: Joint, poses: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Unit axis of a joint in the root link's frame, shape (3,)."""
    return np.asarray(poses[joint.child][:3, :3] @ joint.axis / np.linalg.norm(joint.axis))


def _above(joint: Joint, description: Description) -> Iterable[Joint]:
    """The joints between a joint and the root."""
    while joint.parent in description.joints:
        joint = description.joints[joint.parent]
        yield joint


def _lowest(link: Link, pose: NDArray) -> float:
    """Height of the lowest point of a link's primitive colliders in the root link's frame [m].

    A primitive reaches down by its support in the direction of gravity; inf where there is none.
    """
    heights = [np.inf]
    for collision in link.collisions:
        T, geometry = pose @ origin_of(collision), collision.geometry
        down = np.abs(T[2, :3])  # of the primitive's axes, their slope
        if geometry.sphere is not None:
            reach = geometry.sphere.radius
        elif geometry.box is not None:
            reach = float(down @ np.asarray(geometry.box.size, float) / 2)
        elif geometry.cylinder is not None:
            level = np.sqrt(max(0.0, 1 - down[2] ** 2))
            reach = geometry.cylinder.length / 2 * down[2] + geometry.cylinder.radius * level
        else:
            continue
        heights.append(T[2, 3] - reach)
    return float(min(heights))
