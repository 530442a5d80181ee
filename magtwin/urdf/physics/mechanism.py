"""Mechanism: which joints move, which follow another, and where each rests."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Joint
from magtwin.urdf.options import DEFAULTS, Options

SINGLE = ("revolute", "continuous", "prismatic")
"""Joints of one degree of freedom: the only ones that drives and mimics are for."""


@dataclass(frozen=True)
class Mimic:
    """That a joint follows another: q = multiplier q_leader + offset."""

    leader: str
    """Name of the joint that is followed; it follows none itself."""

    multiplier: float
    """Ratio of the two values [1, or rad/m and m/rad where one turns and the other slides]."""

    offset: float
    """Value where the leader's is 0 [rad or m]."""


@dataclass(frozen=True)
class Mechanism:
    """The joints of a description by their names."""

    description: Description

    welded: Mapping[str, str]
    """Joints that cannot move, with the reason: "" for those of type fixed."""

    mimics: Mapping[str, Mimic]
    """Joints that follow another."""

    rests: Mapping[str, float]
    """Value at which the robot is authored [rad or m], of the joints where it is not 0."""

    def pose(self, joint: Joint) -> NDArray[np.float64]:
        """T_parent_child of a joint's links at rest, shape (4, 4)."""
        T, rest = origin_of(joint), self.rests.get(joint.name, 0.0)
        return T @ displacement(joint, rest) if rest else T

    def poses(self) -> dict[str, NDArray[np.float64]]:
        """T_root_link of each link at rest, shape (4, 4)."""
        poses = {self.description.root: np.eye(4)}
        for child, joint in self.description.joints.items():
            poses[child] = poses[joint.parent] @ self.pose(joint)
        return poses


def read_mechanism(description: Description, options: Options = DEFAULTS) -> Mechanism:
    """Find out which joints move.

    A joint is welded that is fixed, that has no room between its limits, or that its limits give neither
    effort nor speed, but for one that turns for ever, whose zeros exporters fill in; with the profile
    diff-drive also a slide without one of the two, which stands for a suspension whose spring the URDF
    cannot hold. What follows a welded joint is welded too.

    Raises:
        InputError: A joint that mimics another has several axes, or the ratio 0; the text gives the line.
    """
    joints = {joint.name: joint for joint in description.joints.values()}
    welded = {}
    for joint in joints.values():
        reason = _welded(joint, options)
        if reason is not None:
            welded[joint.name] = reason
            if reason:
                description.note(f"joint {joint.name!r} ({joint.type}) {reason}: welded")
    mimics, rests = {}, {}
    for name, joint in joints.items():
        if name in welded:
            limit = joint.limit
            if welded[name] and limit and limit.lower is not None and limit.lower == limit.upper != 0:
                rests[name] = float(limit.lower)
            if joint.mimic is not None:
                description.note(
                    f"joint {name!r} cannot move: that it mimics {joint.mimic.joint!r} is left out"
                )
            continue
        if joint.mimic is None:
            continue
        mimic = _resolved(joint, joints, description)
        if mimic.leader in welded:
            welded[name] = f"follows {mimic.leader!r}, which cannot move"
            description.note(f"joint {name!r} {welded[name]}: welded")
        else:
            mimics[name] = mimic
        start = mimic.multiplier * _rest_of(joints[mimic.leader], welded) + mimic.offset
        if start:
            rests[name] = start
    return Mechanism(description, welded, mimics, rests)


def displacement(joint: Joint, value: float) -> NDArray[np.float64]:
    """Motion of a joint's child from its place at 0: a turn about the axis, or a slide along it, (4, 4).

    R = 1 + sin(q) K + (1 - cos(q)) K^2, K the cross product with the unit axis (Rodrigues).
    """
    T, axis = np.eye(4), np.asarray(joint.axis, float) / np.linalg.norm(joint.axis)
    if joint.type == "prismatic":
        T[:3, 3] = value * axis
        return T
    K = np.cross(np.eye(3), axis)
    T[:3, :3] += np.sin(value) * K + (1 - np.cos(value)) * K @ K
    return T


def _welded(joint: Joint, options: Options) -> str | None:
    """Why a joint cannot move; "" if it is fixed, None if it can."""
    limit = joint.limit
    if joint.type == "fixed":
        return ""
    if limit is None:
        return None
    if limit.effort == 0 and limit.velocity == 0 and joint.type != "continuous":
        return "cannot move by its own limits"
    if joint.type in ("revolute", "prismatic") and limit.lower is not None and limit.lower == limit.upper:
        return "cannot move by its own limits"
    if options.profile == "diff-drive" and joint.type == "prismatic" and 0 in (limit.effort, limit.velocity):
        return "is a suspension without effort or speed"
    return None


def _resolved(joint: Joint, joints: Mapping[str, Joint], description: Description) -> Mimic:
    """What a joint follows in the end, through joints that follow others; the description has no circle."""
    multiplier, offset, at = 1.0, 0.0, joint
    while at.mimic is not None:
        ratio = 1.0 if at.mimic.multiplier is None else float(at.mimic.multiplier)
        if ratio == 0:
            raise description.refused("joint", at.name, "mimics with multiplier 0; make it fixed")
        offset += multiplier * float(at.mimic.offset or 0.0)
        multiplier *= ratio
        at = joints[at.mimic.joint]
    if joint.type not in SINGLE:
        raise description.refused(
            "joint", joint.name, f"is {joint.type} and has no one value with which to mimic {at.name!r}"
        )
    return Mimic(at.name, multiplier, offset)


def _rest_of(leader: Joint, welded: Mapping[str, str]) -> float:
    """Where a joint that follows none rests."""
    limit = leader.limit
    if welded.get(leader.name) and limit and limit.lower is not None and limit.lower == limit.upper:
        return float(limit.lower)
    return 0.0
