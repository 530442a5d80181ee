"""Mechanism: which joints move, which follow another, and the rest position of each."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Joint, Mimic
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.physics.inertia import MassProperties
from magtwin.urdf.physics.load import Load, read_loads

SINGLE = ("revolute", "continuous", "prismatic")
"""Joints with one degree of freedom: only these can have mimics and default drives."""

BESIDE = 0.25
"""A load is beside an axis if more than this part of its inertia is due to its distance from it."""


@dataclass(frozen=True)
class Mechanism:
    """The joints of a description by name."""

    description: Description

    welded: Mapping[str, str]
    """Joints that cannot move, with the reason; "" for joints of type fixed."""

    mimics: Mapping[str, Mimic]
    """Joints that follow another, which follows none."""

    rests: Mapping[str, float]
    """Authored value of joints that do not rest at 0 [rad or m]."""

    filled: dict[str, MassProperties] = field(default_factory=dict)
    """Mass properties in the root's frame of links without `<inertial>`; known when bodies are authored."""

    def pose(self, joint: Joint) -> NDArray[np.float64]:
        """T_parent_child of a joint's links at rest, shape (4, 4)."""
        T, rest = origin_of(joint), self.rests.get(joint.name, 0.0)
        return T @ displacement(joint.axis, rest, slides=joint.type == "prismatic") if rest else T

    @cached_property
    def loads(self) -> Mapping[str, Load]:
        """What each joint carries, by name."""
        return read_loads(self.description, self.poses(), self.filled)

    def carriers(self, kinds: Iterable[str]) -> frozenset[str]:
        """Joints beyond which a joint of one of some types moves."""
        joints, found = self.description.joints, set[str]()
        for joint in joints.values():
            at = joint
            if joint.type in kinds and joint.name not in self.welded:
                while at.parent in joints and joints[at.parent].name not in found:
                    at = joints[at.parent]
                    found.add(at.name)
        return frozenset(found)

    @cached_property
    def bearers(self) -> frozenset[str]:
        """Joints that bear a load although they may have no limits, as in arms and legs.

        They carry a joint with limits; or their axis is within 30 degrees of the horizontal, and they carry
        another joint or a load beside the axis. A wheel does none of that, nor the swivel of a caster.
        """
        limited, moving = self.carriers(("revolute", "prismatic")), self.carriers(SINGLE)
        return limited | {
            name
            for name, load in self.loads.items()
            if load.slope < 0.5 and (name in moving or load.beside > BESIDE)
        }

    def in_world(self, link: str) -> bool:
        """Whether a link is fixed to the root `world`, which is the world to Gazebo, MoveIt and Drake."""
        joints, at = self.description.joints, link
        while at in joints and joints[at].name in self.welded:
            at = joints[at].parent
        return at == self.description.root == "world" != link

    def poses(self) -> dict[str, NDArray[np.float64]]:
        """T_root_link of each link at rest, shape (4, 4)."""
        poses = {self.description.root: np.eye(4)}
        for child, joint in self.description.joints.items():
            poses[child] = poses[joint.parent] @ self.pose(joint)
        return poses


def read_mechanism(description: Description, options: Options = DEFAULTS) -> Mechanism:
    """Determine which joints move.

    A joint is welded if it is fixed, if its limits leave no range, or if it slides and its limits give
    neither effort nor speed: a suspension. A joint that turns moves even so, since exporters fill in zeros.
    With the profile diff-drive, a prismatic joint without one of the two is welded too: it stands for a
    suspension whose spring a URDF cannot describe. A joint that follows a welded joint, or another with
    multiplier 0, is welded.
    """
    joints = {joint.name: joint for joint in description.joints.values()}
    welded = {}
    for joint in joints.values():
        reason = _weld_reason(joint, options)
        if reason is not None:
            welded[joint.name] = reason
            if reason:
                description.note(f"joint {joint.name!r} ({joint.type}) {reason}: welded")
    mimics, rests = {}, {}
    for name, joint in joints.items():
        if name in welded:
            rest = _welded_value(joint, welded)
            if rest:
                rests[name] = rest
            if joint.mimic is not None:
                description.note(
                    f"joint {name!r} cannot move: its mimic of {joint.mimic.joint!r} is left out"
                )
            continue
        if joint.mimic is None:
            continue
        mimic = _resolved(joint, joints)
        if mimic.joint in welded or mimic.multiplier == 0:
            still = "which cannot move" if mimic.joint in welded else "taken 0 times"
            welded[name] = f"follows {mimic.joint!r}, {still}"
            description.note(f"joint {name!r} {welded[name]}: welded")
        else:
            mimics[name] = mimic
        start = mimic.multiplier * _welded_value(joints[mimic.joint], welded) + mimic.offset
        if start:
            rests[name] = start
    return Mechanism(description, welded, mimics, rests)


def displacement(axis: ArrayLike, value: float, *, slides: bool) -> NDArray[np.float64]:
    """Motion of a joint's child from its place at 0: a rotation about the axis, or a slide along it, (4, 4).

    R = 1 + sin(q) K + (1 - cos(q)) K^2, with K the cross product with the unit axis (Rodrigues).
    """
    T, unit = np.eye(4), np.asarray(axis, float) / np.linalg.norm(axis)
    if slides:
        T[:3, 3] = value * unit
        return T
    K = np.cross(np.eye(3), unit)
    T[:3, :3] += np.sin(value) * K + (1 - np.cos(value)) * K @ K
    return T


def _weld_reason(joint: Joint, options: Options) -> str | None:
    """Why a joint cannot move; "" if it is fixed, None if it can move."""
    limit = joint.limit
    if joint.type == "fixed" or limit is None:
        return "" if joint.type == "fixed" else None
    powerless = limit.effort == 0 and limit.velocity == 0 and joint.type not in ("continuous", "revolute")
    closed = limit.lower is not None and limit.lower == limit.upper
    if powerless or (closed and joint.type in ("revolute", "prismatic")):
        return "cannot move by its own limits"
    if options.profile == "diff-drive" and joint.type == "prismatic" and 0 in (limit.effort, limit.velocity):
        return "is a suspension without effort or speed"
    return None


def _resolved(joint: Joint, joints: Mapping[str, Joint]) -> Mimic:
    """The first joint of a chain of mimics, with the total ratio; the description has no circle."""
    multiplier, offset, at = 1.0, 0.0, joint
    while at.mimic is not None:
        offset += multiplier * at.mimic.offset
        multiplier *= at.mimic.multiplier
        at = joints[at.mimic.joint]
    return Mimic(at.name, multiplier, offset)


def _welded_value(joint: Joint, welded: Mapping[str, str]) -> float:
    """Rest position of a joint that follows none [rad or m]; not 0 only for equal limits."""
    limit = joint.limit
    if welded.get(joint.name) and limit and limit.lower is not None and limit.lower == limit.upper:
        return float(limit.lower)
    return 0.0
