"""Wheel: for the profile diff-drive, the driven wheels of a robot and the parts that slide on the floor."""

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
from magtwin.urdf.physics.drive import DEFAULT_EFFORT, RESPONSE, WHEEL_DAMPING, Wheels
from magtwin.urdf.physics.gazebo import Surface
from magtwin.urdf.physics.mechanism import SINGLE, Mechanism
from magtwin.urdf.physics.mobile_base import Kind, MobileBase

WHEEL_FRICTION, CASTER_FRICTION = 1.0, 0.05
"""Default friction of driven wheels (rubber) and of sliding parts (a polished ball)."""

GRAVITY = 9.81
"""[m/s2]."""

FULL_TURN = 6.3
"""Range of a joint above which it is a wheel's [rad]; exporters write -180 to 180 in place of no limits."""

CASTER_NAMES = ("caster", "castor")
"""Words in the names of links that slide."""

WHEEL_HEIGHT_M = 0.4
"""Largest height of a wheel's axle above the lowest link of the robot [m]; fingers are higher."""

STIFFER = 5.0
"""Gain of a driven wheel over that by which the robot alone answers within `RESPONSE`: wheels lag less."""

FLOOR = 0.002
"""Height above the lowest point of the wheels within which other parts touch the floor [m]."""


def find_base(mechanism: Mechanism, told: MobileBase | None = None) -> MobileBase:
    """The mobile base of a description, by its joints where no plugin or controller tells it.

    Wheels are the joints without limits about a horizontal axis, no higher than `WHEEL_HEIGHT_M` above the
    lowest link, except casters: joints with such a name, or below a joint that swivels. If several have
    "wheel" in their name or their link's, the others are none. Wheels below a joint with limits about a
    vertical axis are steered; with others that are not, it is a car.

    Args:
        mechanism: Joints of the description.
        told: Base of a plugin or controller; what it lacks is found.

    Raises:
        InputError: There are fewer than two wheels.
    """
    description = mechanism.description
    joints = {joint.name: joint for joint in description.joints.values()}
    told_wheels = () if told is None else tuple(n for n in told.wheels if _turns(joints[n]))
    if told is not None and len(told_wheels) > 1:
        return replace(told, wheels=told_wheels)
    poses = mechanism.poses()
    up = {name: abs(_axis(joint, poses)[2]) for name, joint in joints.items() if joint.type in SINGLE}
    lowest = min(float(T[2, 3]) for T in poses.values())
    wheels = [
        name
        for name, slope in up.items()
        if poses[joints[name].child][2, 3] < lowest + WHEEL_HEIGHT_M
        and _turns(joints[name])
        and slope < 0.5  # within 30 degrees of the horizontal
        and not any(word in _words(joints[name]) for word in CASTER_NAMES)
        and not any(
            _turns(above) and up.get(above.name, 0) >= 0.5 for above in _above(joints[name], description)
        )
    ]
    named = [name for name in wheels if "wheel" in _words(joints[name])]
    wheels = named if len(named) > 1 else wheels
    hinges = {
        name: above.name
        for name in wheels
        for above in _above(joints[name], description)
        if above.type == "revolute" and above.name not in mechanism.welded and up[above.name] > 0.8
    }
    fixed = [name for name in wheels if name not in hinges]
    steered = tuple(dict.fromkeys(hinges.values())) if fixed else ()
    lateral = all(abs(_axis(joints[name], poses)[1]) > 0.8 for name in fixed or wheels)
    wheels = fixed or wheels
    if len(wheels) < 2:
        raise InputError(
            f"{description.path}: profile diff-drive needs two wheels, continuous joints about a horizontal "
            f"axis near the floor; found {', '.join(wheels) or 'none'}. A robot without them can be "
            "converted with the profile general, but not driven"
        )
    if told is not None:
        return replace(told, wheels=tuple(wheels), steered=told.steered or steered)
    kind: Kind = "differential" if len(wheels) == 2 else "skid-steer"
    kind = "car" if steered else kind if lateral else "holonomic"
    return MobileBase(kind=kind, source="the joints", wheels=tuple(wheels), steered=steered)


def not_on(wheels: Iterable[str], rules: Iterable[DriveRule]) -> tuple[DriveRule, ...]:
    """The rules that match no driven wheel; the profile's gains replace those of an interface."""
    names = tuple(wheels)
    return tuple(rule for rule in rules if not any(fnmatchcase(name, rule.joints) for name in names))


def fit_wheels(mechanism: Mechanism, wheels: Iterable[str], bodies: Mapping[str, Usd.Prim]) -> Wheels:
    """Drives of the wheels, from the robot's mass m, the number of wheels n and their radius r.

    Gain kd = 5 m r^2 / (n t), t = RESPONSE. Torque mu m g r / n: the most that the floor can take. Ten times
    that gain needs 500 steps a second in Newton 1.8, whose solver slows a saturated drive by kd dt as if that
    were inertia.

    Args:
        mechanism: Joints of the description.
        wheels: Joints of driven wheels.
        bodies: Prims of the bodies by link name, with masses and shapes.

    Returns:
        Gains and torques by joint name; the default where a wheel has no shape or the robot no mass.
    """
    masses = [
        UsdPhysics.MassAPI(p).GetMassAttr().Get() for p in bodies.values() if p.HasAPI(UsdPhysics.MassAPI)
    ]
    names = tuple(wheels)
    share, fitted = sum(masses) / len(names), dict[str, tuple[float, float]]()
    joints = {joint.name: joint for joint in mechanism.description.joints.values()}
    for name in names:
        body = bodies.get(joints[name].child)
        radius = 0.0 if body is None else wheel_radius(body, joints[name].axis)
        fitted[name] = (WHEEL_DAMPING, DEFAULT_EFFORT)
        if share * radius > 0:
            torque = WHEEL_FRICTION * share * GRAVITY * radius
            damping = STIFFER * share * radius**2 / RESPONSE
            fitted[name] = (float(f"{damping:.3g}"), float(f"{torque:.3g}"))
    return fitted


def grip(mechanism: Mechanism, wheels: Iterable[str], surfaces: Mapping[str, Surface]) -> dict[str, Surface]:
    """Surfaces by link, with default friction for wheels and casters.

    A caster is a link with a collider that has such a name, or whose primitive touches the floor.

    Args:
        mechanism: Joints of the description, which receives notes.
        wheels: Joints of driven wheels.
        surfaces: Surfaces from the URDF; they override the defaults.
    """
    description, poses = mechanism.description, mechanism.poses()
    given, driven = dict(surfaces), {j.child for j in description.joints.values() if j.name in wheels}
    floor = min((_lowest(description.links[name], poses[name]) for name in driven), default=np.inf)
    for name, link in description.links.items():
        if name in given or not link.collisions:
            continue
        if name in driven:
            friction, what = WHEEL_FRICTION, "a driven wheel"
        elif (
            any(word in name.lower() for word in CASTER_NAMES)
            or abs(_lowest(link, poses[name]) - floor) < FLOOR
        ):
            friction, what = CASTER_FRICTION, "a caster"
        else:
            continue
        given[name] = replace(Surface(), friction=friction)
        description.note(f"link {name!r} is {what} and gives no friction: {friction:g}")
    return given


def wheel_radius(body: Usd.Prim, axis: NDArray) -> float:
    """Half the largest extent of a wheel across its axis [m]; 0 if it has no shape."""
    purposes = [UsdGeom.Tokens.guide, UsdGeom.Tokens.default_, UsdGeom.Tokens.render]
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes)
    extent = cache.ComputeUntransformedBound(body).ComputeAlignedRange()
    across = np.abs(axis) / np.linalg.norm(axis) < 0.7
    return 0.0 if extent.IsEmpty() else float(np.max(np.asarray(extent.GetSize())[across]) / 2)


def _turns(joint: Joint) -> bool:
    """Whether a joint turns without end: it is continuous, or has a range of more than a turn."""
    limit = joint.limit
    if joint.type != "revolute" or limit is None or limit.lower is None or limit.upper is None:
        return joint.type == "continuous"
    return limit.upper - limit.lower > FULL_TURN


def _axis(joint: Joint, poses: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Unit axis of a joint in the root's frame, shape (3,)."""
    axis = np.asarray(joint.axis, float)
    return np.asarray(poses[joint.child][:3, :3] @ axis / np.linalg.norm(axis))


def _words(joint: Joint) -> str:
    """Names of a joint and its link."""
    return f"{joint.name} {joint.child}".lower()


def _above(joint: Joint, description: Description) -> Iterable[Joint]:
    """The joints between a joint and the root."""
    while joint.parent in description.joints:
        joint = description.joints[joint.parent]
        yield joint


def _lowest(link: Link, pose: NDArray) -> float:
    """Height of the lowest point of a link's primitive colliders in the root's frame [m]; inf for none."""
    poses = ((pose @ origin_of(part), part.geometry) for part in link.collisions)
    heights = [T[2, 3] - form.half_extents(T[:3, :3])[2] for T, form in poses if form.kind != "mesh"]
    return float(min(heights, default=np.inf))
