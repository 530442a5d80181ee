"""Merge: which body each link is, or rides on; links on welded joints can become part of the body above."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import origin_of
from magtwin.urdf.description.model import Shape
from magtwin.urdf.physics.link import is_marker
from magtwin.urdf.physics.mechanism import Mechanism

Place = tuple[str, NDArray[np.float64]]
"""Name of a body, and a pose in it, shape (4, 4)."""

WORLD = ""
"""Name of what is no body: joints on it hold the robot to its prim's frame, and so to the world."""


def place_links(mechanism: Mechanism, *, merge: bool = False) -> dict[str, Place]:
    """The body that each link is, or rides on, with its pose in it; parents before children.

    Links that only name a place ride on the nearest body above them; those above the first body, such
    as base_footprint, on that. Under a root without mass from which a joint moves the rest, such as the
    rail of a slide, is the world.

    Args:
        mechanism: Joints of the description.
        merge: Whether links with mass or shape ride too, where they cannot move against the body above.
    """
    description = mechanism.description
    base, above = _base(mechanism)
    poses = mechanism.poses()
    home = np.eye(4) if base == WORLD else poses[base]
    places = {name: (base, np.linalg.inv(home) @ poses[name]) for name in above}
    if base != WORLD:
        places[base] = (base, np.eye(4))
    for name, link in description.links.items():
        if name in places:
            continue
        joint = description.joints[name]
        body, pose = places[joint.parent]
        rides = is_marker(link) or (merge and body != WORLD)
        if rides and joint.name in mechanism.welded:
            places[name] = (body, pose @ mechanism.pose(joint))
        else:
            places[name] = (name, np.eye(4))
    order = {name: i for i, name in enumerate(description.links)}
    return dict(sorted(places.items(), key=lambda item: order[item[0]]))


def riders(places: dict[str, Place], body: str) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """The links that are part of a body or ride on it, itself first, with their poses in it."""
    yield body, np.eye(4)
    for name, (carrier, pose) in places.items():
        if carrier == body != name:
            yield name, pose


def carried(shapes: Iterable[Shape], pose: NDArray, link: str, body: str) -> list[Shape]:
    """Visuals or colliders of a link as those of the body that it is part of.

    Args:
        shapes: Visuals or collisions.
        pose: Of the link in the body, shape (4, 4).
        link: Name of the link, which its shapes without a name get on another's body.
        body: Name of the body's own link, whose shapes stay as they are.
    """
    if link == body:
        return list(shapes)
    return [replace(shape, origin=pose @ origin_of(shape), name=shape.name or link) for shape in shapes]


def _base(mechanism: Mechanism) -> tuple[str, list[str]]:
    """The robot's first body, or the world, and the links above it, which only name places."""
    description = mechanism.description
    above, pending = {description.root: [description.root]}, [description.root]
    while pending:
        link = pending.pop(0)
        if not is_marker(description.links[link]):
            return link, above[link][:-1]
        for child, joint in description.joints.items():
            if joint.parent == link and joint.name in mechanism.welded:
                above[child] = [*above[link], child]
                pending.append(child)
    moving = [
        child for child, joint in description.joints.items() if joint.parent in above and child not in above
    ]
    if not moving:
        return description.root, []
    first = moving[0]
    if len(moving) == 1 and description.joints[first].type == "floating":
        return first, above[description.joints[first].parent]
    return WORLD, list(above)
