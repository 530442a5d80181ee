"""Merge: the body that each link is or rides on; welded links can become part of the body above."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import origin_of
from magtwin.urdf.description.model import Joint, Shape
from magtwin.urdf.physics.link import is_marker
from magtwin.urdf.physics.mechanism import Mechanism

Place = tuple[str, NDArray[np.float64]]
"""Name of a body, and a pose in it, shape (4, 4)."""

WORLD = ""
"""Name of the world, which is not a body; joints to it hold the robot at its prim's frame."""


def place_links(mechanism: Mechanism, *, merge: bool = False) -> dict[str, Place]:
    """The body that each link is or rides on, with its pose in it; parents before children.

    Links that are only frames ride on the nearest body above; those above the first body, such as
    base_footprint, on that. If a joint moves everything relative to a root without mass, such as the rail of
    a slide, the root is the world.

    No body should be without mass, because engines fill its colliders with a default density. A link with
    shapes and without mass rides on the body that it is welded to, if there is one above it. Otherwise it
    takes over a link with mass that is welded to it, such as the inertial_link of a massless base_link.

    Args:
        mechanism: Joints of the description, which receives notes.
        merge: Whether links with mass or shape that cannot move also ride on the body above, except those
            whose joint has `dont_collapse`.
    """
    description = mechanism.description
    taken = {} if merge else _taken_over(mechanism)
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
        massless = link.inertial is None
        joins = body != WORLD and not joint.own_body and (merge or massless or name in taken)
        if joint.name in mechanism.welded and (joins or is_marker(link)):
            places[name] = (body, pose @ mechanism.pose(joint))
            if massless and not merge and not is_marker(link):
                description.note(f"link {name!r} has no <inertial>: it is part of the body of {body!r}")
            elif name in taken:
                description.note(f"link {taken[name]!r} has no <inertial>: it takes that of {name!r}")
        else:
            places[name] = (name, np.eye(4))
    return {name: places[name] for name in description.links}


def riders(places: Mapping[str, Place]) -> dict[str, list[Place]]:
    """Of each body, the links that are part of it or ride on it, itself first, with their poses in it."""
    groups: dict[str, list[Place]] = {
        name: [(name, np.eye(4))] for name, (body, _) in places.items() if body == name
    }
    for name, (body, pose) in places.items():
        if body != name and body in groups:
            groups[body].append((name, pose))
    return groups


def carried(shapes: Iterable[Shape], pose: NDArray, link: str, body: str) -> list[Shape]:
    """Visuals or colliders of a link as shapes of its body.

    Args:
        shapes: Visuals or collisions.
        pose: Pose of the link in the body, shape (4, 4).
        link: Name of the link; shapes without a name get it.
        body: Name of the body's own link, whose shapes stay unchanged.
    """
    if link == body:
        return list(shapes)
    return [replace(shape, origin=pose @ origin_of(shape), name=shape.name or link) for shape in shapes]


def _taken_over(mechanism: Mechanism) -> dict[str, str]:
    """Links with mass by which links without become bodies with mass: those links by the former's names.

    Of several links that are welded to a link without mass, one without shapes is preferred.
    """
    description = mechanism.description
    welded = _welded_below(mechanism)
    taken: dict[str, str] = {}
    for name, link in description.links.items():
        if link.inertial is not None or is_marker(link):
            continue
        massive = [c for c in welded.get(name, ()) if description.links[c].inertial is not None]
        massive.sort(key=lambda c: bool(description.links[c].visuals or description.links[c].collisions))
        if massive:
            taken[massive[0]] = name
    return taken


def _welded_below(mechanism: Mechanism) -> dict[str, list[str]]:
    """The links that are welded to each link, by the link above them."""
    below: dict[str, list[str]] = {}
    for child, joint in mechanism.description.joints.items():
        if joint.name in mechanism.welded:
            below.setdefault(joint.parent, []).append(child)
    return below


def _base(mechanism: Mechanism) -> tuple[str, list[str]]:
    """The robot's first body, or the world; and the links above it, which are only frames."""
    description, below = mechanism.description, _welded_below(mechanism)
    joints, reached = description.joints, {description.root: None}
    pending = deque(reached)
    while pending:
        link = pending.popleft()
        if not is_marker(description.links[link]):
            return link, _above(link, joints)
        reached |= dict.fromkeys(below.get(link, ()))
        pending += below.get(link, ())
    moving = [child for child, joint in joints.items() if joint.parent in reached and child not in reached]
    if not moving:
        return description.root, []
    if len(moving) == 1 and joints[moving[0]].type == "floating":
        return moving[0], _above(moving[0], joints)
    return WORLD, list(reached)


def _above(link: str, joints: Mapping[str, Joint]) -> list[str]:
    """The links from the root down to a link, which is left out."""
    way: list[str] = []
    while link in joints:
        link = joints[link].parent
        way.append(link)
    return way[::-1]
