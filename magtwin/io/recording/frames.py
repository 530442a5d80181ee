"""Frames: what the messages of each role are in, and the way from there to base_link by /tf_static.

Poses and vectors of a recording become those of base_link. A message is in the frames of its header. Vectors
of a sensor whose place on the robot is known are turned into base_link; the pose of a part of the robot, such
as a camera, becomes the pose of base_link. Frames are named as in REP 105.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple
from xml.etree.ElementTree import ParseError, fromstring

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import (
    IDENTITY_XYZW,
    matrix_from_quat,
    quat_conjugate,
    quat_from_rpy,
    quat_multiply,
    rotate,
)
from magtwin.io.bags.cdr import Index, Leaf, Messages, decode
from magtwin.io.recording.roles import Role

Array = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]
Frames = tuple[str, str]  # Frame of the header and child frame of a message; "" if it has none

LEAVES = ("header.frame_id", "child_frame_id")

WORDS: Mapping[str, str] = {
    "fixed": "map vision takeoff odom world earth enu ned utm origin local global vicon mocap optitrack "
    "qualisys qtm",
    "part": "camera cam optical imu gyro accel lidar laser scan rplidar velodyne depth radar sonar gps gnss "
    "mag magnetometer compass antenna sensor wheel",
    "base": "base footprint body chassis robot",
}
"""Words in names of frames that stand still, of parts of a robot, and of its base; the first match counts."""

TURNED_RAD, MOVED_M = 1e-6, 1e-6  # Turns [rad] and distances [m] below which a transform is none
TILTED_M_S2 = 0.5  # Difference of mean upward accelerations by which gravity decides [m/s2]
MOST_TRANSFORMS = 256  # Messages of more transforms are not read

_TRANSFORM = ("header.stamp", *LEAVES, "transform.translation", "transform.rotation")


class Mount(NamedTuple):
    """A frame at rest on the robot."""

    name: str
    base: str  # Name of the robot's base
    p: Array  # Origin of the frame in base [m], shape (3,)
    q_xyzw: Array  # Axes of the frame in base, shape (4,)

    def __str__(self) -> str:
        place = ", ".join(f"{part + 0:.3g}" for part in np.round(self.p, 4))
        cosine = (np.trace(matrix_from_quat(self.q_xyzw)) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        where = f"at ({place}) m, turned by {turn:.3g} deg"
        return f"{self.name!r:.40} to {self.base!r:.40}, which has it {where}"


@dataclass
class StaticFrames:
    """Transforms that do not change: those of /tf_static, and of a robot's description."""

    # By frame: its parent, its origin [m] and its axes (xyzw) there
    parents: dict[str, tuple[str, Array, Array]] = field(default_factory=dict)

    def add(self, parent: str, child: str, p: Array, q_xyzw: Array) -> None:
        """Take a transform; one that is no number or no rotation is left out."""
        size = float(np.linalg.norm(q_xyzw))
        if np.isfinite([*p, *q_xyzw]).all() and abs(size - 1) < 0.1:
            self.parents[plain(child)] = plain(parent), np.asarray(p, float), np.asarray(q_xyzw, float) / size

    def describe(self, urdf: str) -> None:
        """Take the fixed joints of a description, where /tf_static has none; those of no damaged one."""
        try:
            joints = [] if "<!" in urdf.replace("<!--", "") else fromstring(urdf).findall("joint")
            for joint in joints:
                parent, child, origin = map(joint.find, ("parent", "child", "origin"))
                if joint.get("type") == "fixed" and parent is not None and child is not None:
                    told = {} if origin is None else origin.attrib
                    xyz, rpy = (np.array(told.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy"))
                    if plain(name := child.get("link", "")) not in self.parents and len(xyz) == len(rpy) == 3:
                        self.add(parent.get("link", ""), name, xyz, quat_from_rpy(rpy))
        except (ParseError, ValueError):
            return

    def mount(self, frame: str) -> Mount | None:
        """Where a frame is on the robot; None if that is not known.

        The base is base_link if the two are in one tree, else base_footprint, else another base.
        """
        name = plain(frame)
        known = dict.fromkeys(chain(self.parents, (parent for parent, *_ in self.parents.values())))
        if name not in known:
            return None
        root, p, q = self._in_root(name)
        bases = [other for other in known if kind_of(other) == "base" and self._in_root(other)[0] == root]
        ranks = ("base_link", "base_footprint")
        bases.sort(key=lambda other: [not other.endswith(rank) for rank in ranks])
        if not bases or name in bases:
            return None
        _, p_base, q_base = self._in_root(bases[0])
        back = quat_conjugate(q_base)
        return Mount(name, bases[0], rotate(back, p - p_base), quat_multiply(back, q))

    def _in_root(self, name: str) -> tuple[str, Array, Array]:
        """The root of a frame's tree, and the frame's origin and axes there."""
        p, q, seen = np.zeros(3), np.array(IDENTITY_XYZW), {name}
        while name in self.parents:
            parent, p_here, q_here = self.parents[name]
            p, q = p_here + rotate(q_here, p), quat_multiply(q_here, q)
            if parent in seen:
                break  # a ring
            seen.add(parent)
            name = parent
        return name, p, q


def plain(frame: str) -> str:
    """The name of a frame without the leading / of ROS 1."""
    return frame.strip("/")


def kind_of(frame: str) -> str:
    """What the name of a frame stands for, by `WORDS`, in any namespace; "" if that is not known."""
    words = set(re.findall("[a-z]+", plain(frame).rpartition("/")[2].lower()))
    kinds = (kind for kind, known in WORDS.items() if words & set(known.split()))
    return next(kinds, "part" if "link" in words else "")


def mount_of(role: Role, frames: Frames, known: StaticFrames) -> tuple[Mount | None, str]:
    """Where the frame of messages is on the robot, and what is wrong with it; "" if nothing is.

    No mount: it is base_link, or its place is not known by the transforms.
    """
    header, child = map(plain, frames)
    stands = kind_of(header) == "fixed"
    if not role.position:
        if stands:
            return None, f"{header!r:.40} is no frame of a sensor"
        return known.mount(header), ""
    on_robot = not stands and (kind_of(header) == "part" or known.mount(header) is not None)
    part = child or (header if on_robot else "")
    if kind_of(part) == "base":
        return None, ""
    mount = known.mount(part)
    if mount is None and kind_of(part) == "part":
        text = "and no tree of frames has the way from base_link to there"
        return None, f"it is the pose of {part!r:.40}, {text}"
    return mount, ""


def in_base(role: Role, columns: Columns, mount: Mount) -> dict[str, NDArray[Any]]:
    """The columns of messages of a part of the robot, by its mount, as those of the robot's base.

    With p_base_part and q_base_part of the mount, vectors are rotate(q_base_part, v_part), poses are

        q_world_base = q_world_part q_base_part^-1
        p_world_base = p_world_part - rotate(q_world_base, p_base_part)

    and the velocity of base is v_base = rotate(q_base_part, v_part) - w_base x p_base_part. An IMU's
    orientation is that of its own axes (REP 145), unless its accelerations contain gravity and show that the
    driver gives that of base.
    """
    p, q = mount.p, mount.q_xyzw
    turned = 2 * np.linalg.norm(q[:3]) > TURNED_RAD
    moved = dict(columns)
    if turned:
        moved |= {name: rotate(q, columns[name]) for name in (*role.vectors, *role.twist)}
    if turned and role.orientation:
        own = quat_multiply(columns[role.orientation], quat_conjugate(q))
        if role.position or not _of_base(columns[role.orientation], own, moved[role.vectors[-1]]):
            moved[role.orientation] = own
    if role.position and np.linalg.norm(p) > MOVED_M:
        moved[role.position] = columns[role.position] - rotate(moved[role.orientation], p)
        if role.twist:
            linear, angular = role.twist
            moved[linear] = moved[linear] - np.cross(moved[angular], p)
    return moved


def _of_base(given: Array, turned: Array, a_base: Array) -> bool:
    """Whether gravity in accelerations is up by orientations as given, and not by those that were turned."""
    up = rotate(given, a_base)[:, 2] - rotate(turned, a_base)[:, 2]
    up = up[np.isfinite(up)]
    return len(up) > 0 and bool(up.mean() > TILTED_M_S2)


def frames_of(leaves: Iterable[Leaf], messages: Messages) -> Frames:
    """The frames of the messages of a topic, whose type has some leaves; several are refused."""
    leaves = tuple(leaves)
    wanted = [leaf.name for leaf in leaves if leaf.name in LEAVES]
    names = decode(leaves, messages, wanted)
    each = [sorted({plain(name) for name in names.get(leaf, ())} - {""}) for leaf in LEAVES]
    for several in each:
        if len(several) > 1:
            listed = ", ".join(several)[:200]
            raise InputError(f"its messages are in several frames, {listed}; record one topic each")
    return "".join(each[0]), "".join(each[1])


class Transform(NamedTuple):
    """A transform of TFMessages, at several times."""

    stamps: Index
    parents: list[str]
    children: list[str]
    p: Array
    q_xyzw: Array


def transforms(messages: Messages, layout: Callable[[dict[str, int]], Iterable[Leaf]]) -> Iterator[Transform]:
    """The transforms of TFMessages, those of the same place in messages of the same length at a time."""
    counts = decode([Leaf("transforms", "u4")], messages, ["transforms"])["transforms"]
    for count in np.unique(counts[counts <= MOST_TRANSFORMS]).tolist():
        some = messages.take(np.flatnonzero(counts == count))
        names = [[f"transforms.{k}.{leaf}" for leaf in _TRANSFORM] for k in range(count)]
        fields = decode(tuple(layout({"transforms": count})), some, chain(*names))
        for each in names:
            yield Transform(*(fields[name] for name in each))
