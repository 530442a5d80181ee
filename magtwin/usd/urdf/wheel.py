"""Wheel: what the profile diff-drive finds on a robot, its driven wheels and what slides on the floor."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError
from magtwin.usd.urdf.description import Description, origin_of
from magtwin.usd.urdf.drive import DEFAULT_EFFORT
from magtwin.usd.urdf.gazebo import Surface
from magtwin.usd.urdf.mechanism import Mechanism

WHEEL_FRICTION, CASTER_FRICTION = 1.0, 0.05
"""Friction of driven wheels and of what slides, where the URDF gives none: rubber, and a polished ball."""

GRAVITY = 9.81
"""[m/s2]."""

CASTER_NAMES = ("caster", "castor")
"""What links that slide are called."""

FLOOR = 0.002
"""Distance from the lowest point of the wheels within which something else touches the floor too [m]."""


def find_wheels(mechanism: Mechanism, named: Iterable[str] = ()) -> dict[str, float]:
    """The joints of a robot's driven wheels by name, with the torque that each gets if the URDF gives none.

    Those that a drive plugin names, or else the continuous joints about a level axis, but those of
    casters: called so, or below a joint that swivels about the vertical.

    Args:
        mechanism: Joints of the description.
        named: Names of joints that a drive plugin gives.

    Raises:
        RefusedError: There are fewer than two.
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
        raise RefusedError(
            f"{description.path}: profile diff-drive wants two wheels, continuous joints about a level axis; "
            f"found {', '.join(wheels) or 'none'}; convert with the profile general"
        )
    mass = sum(link.inertial.mass or 0.0 for link in description.links.values() if link.inertial is not None)
    return {name: _torque(description.links[joints[name].child], mass / len(wheels)) for name in wheels}


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


def _torque(link: Any, mass: float) -> float:
    """Half of what a wheel's rim can pass on to the floor: mu m g r / 2 [N m].

    More would throw the robot back at each step of its command, which no base of this kind can do.

    Args:
        link: yourdfpy's link of the wheel; its radius is that of its round collider or visual.
        mass: The wheel's share of the robot's [kg].
    """
    shapes = [shape.geometry for shape in (*link.collisions, *link.visuals)]
    round_ones = [geometry.cylinder or geometry.sphere for geometry in shapes]
    radius = max((float(one.radius) for one in round_ones if one is not None), default=0.0)
    return float(f"{WHEEL_FRICTION * mass * GRAVITY * radius / 2:.3g}") or DEFAULT_EFFORT


def _rolls(joint: Any, poses: Mapping[str, NDArray]) -> bool:
    """Whether a joint turns for ever about an axis within 30 degrees of level."""
    return joint.type == "continuous" and abs(_axis(joint, poses)[2]) < 0.5


def _swivels(joint: Any, poses: Mapping[str, NDArray]) -> bool:
    """Whether a joint turns for ever about an axis that is not level."""
    return joint.type == "continuous" and abs(_axis(joint, poses)[2]) >= 0.5


def _axis(joint: Any, poses: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Unit axis of a joint in the root link's frame, shape (3,)."""
    return np.asarray(poses[joint.child][:3, :3] @ joint.axis / np.linalg.norm(joint.axis))


def _above(joint: Any, description: Description) -> Iterable[Any]:
    """The joints between a joint and the root."""
    while joint.parent in description.joints:
        joint = description.joints[joint.parent]
        yield joint


def _lowest(link: Any, pose: NDArray) -> float:
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
