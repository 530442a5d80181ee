"""Description: a URDF that was read and checked, links and joints in the order of their tree.

yourdfpy reads links, joints and materials; what it drops (`<gazebo>` and the like) stays at hand as XML.
"""

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from magtwin.files import existing
from magtwin.names import RefusedError, hint

JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic")
"""Joints that can be converted; `planar` and `floating` are refused by name."""

MOVING = JOINT_TYPES[1:]


@dataclass(frozen=True)
class Description:
    """A robot as its URDF has it: a tree of links held by joints."""

    path: Path
    """The file."""

    name: str
    """Name of the robot."""

    root: str
    """Name of the link that no joint holds."""

    links: Mapping[str, Any]
    """yourdfpy's links by name, parents before children."""

    joints: Mapping[str, Any]
    """yourdfpy's joints by the name of the link that they hold, parents before children."""

    materials: Mapping[str, Any]
    """yourdfpy's robot-wide materials by name."""

    xml: ElementTree.Element
    """The whole file, for what yourdfpy does not read."""

    lines: Mapping[ElementTree.Element, int]
    """Line of each element's start."""

    notes: list[str] = field(default_factory=list)
    """What was repaired, guessed or left out on the way to USD: one line each, nothing silent."""

    dropped: list[str] = field(default_factory=list)
    """Those of the notes that tell of something lost."""

    def note(self, text: str, *, lost: bool = False) -> None:
        """Put down something that the user ought to know of the conversion, once.

        Args:
            text: What was repaired, guessed or left out, and where.
            lost: Whether the stage has less than the description: `Options.strict` refuses that.
        """
        if text not in self.notes:
            self.notes.append(text)
            if lost:
                self.dropped.append(text)

    def refused(self, kind: str, name: str, text: str) -> RefusedError:
        """A refusal that names the line of the link or joint called `name`."""
        element = next((e for e in self.xml.findall(kind) if e.get("name") == name), None)
        line = "" if element is None else f":{self.lines[element]}"
        return RefusedError(f"{self.path}{line}: {kind} {name!r} {text}")

    def poses(self) -> dict[str, NDArray[np.float64]]:
        """T_root_link of each link with every joint at zero, shape (4, 4)."""
        poses = {self.root: np.eye(4)}
        for child, joint in self.joints.items():
            poses[child] = poses[joint.parent] @ origin_of(joint)
        return poses


def origin_of(part: Any) -> NDArray[np.float64]:
    """Pose of a joint, visual, collision or inertial in its link, shape (4, 4); identity if none is given."""
    return np.eye(4) if part.origin is None else np.asarray(part.origin, float)


def read_description(path: str | os.PathLike[str]) -> Description:
    """Read and check a URDF.

    Raises:
        RefusedError: The file is missing; is not XML (the line is given); has a DOCTYPE, through which
            entities could reach other files or fill the memory; is not a URDF; or its links and joints
            are not one tree.
    """
    path = existing(path, "URDF file")
    try:
        text = path.read_bytes()
    except OSError as error:
        raise RefusedError(f"{path}: cannot be read ({error.strerror}); a URDF file is wanted") from error
    xml, lines = _parse(text, path)
    if xml.tag != "robot":
        raise RefusedError(f"{path}:{lines[xml]}: a URDF begins with <robot>, this file with <{xml.tag}>")
    _check_names(xml, lines, path)
    robot = _read(text, path)
    links = {link.name: link for link in robot.links}
    held = {joint.child: joint for joint in robot.joints}
    description = Description(
        path=path,
        name=robot.name,
        root="",
        links=links,
        joints=held,
        materials=MappingProxyType({m.name: m for m in robot.materials}),
        xml=xml,
        lines=lines,
    )
    _check_joints(description, robot.joints)
    roots = [name for name in links if name not in held]
    if not roots:
        first = robot.joints[0].name
        raise description.refused("joint", first, "closes a circle: no link is the root; remove one joint")
    if len(roots) > 1:
        raise description.refused(
            "link", roots[1], f"hangs in the air: a robot has one root, this has {', '.join(roots)}"
        )
    order = _order(roots[0], robot.joints)
    if len(order) < len(links):
        astray = next(name for name in links if name not in order)
        raise description.refused("joint", held[astray].name, "closes a circle; remove one joint of it")
    return Description(
        path=path,
        name=robot.name,
        root=roots[0],
        links=MappingProxyType({name: links[name] for name in order}),
        joints=MappingProxyType({name: held[name] for name in order if name in held}),
        materials=description.materials,
        xml=xml,
        lines=lines,
    )


def _parse(text: bytes, path: Path) -> tuple[ElementTree.Element, dict[ElementTree.Element, int]]:
    """The elements of an XML file and the line that each starts on; comments are dropped."""
    builder, lines = ElementTree.TreeBuilder(), {}
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    def doctype(*_: Any) -> None:
        raise RefusedError(
            f"{path}:{parser.CurrentLineNumber}: has a DOCTYPE, whose entities are not followed; "
            "remove it and write values out"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        reason = expat.errors.messages[error.code]
        raise RefusedError(f"{path}:{error.lineno}: not XML: {reason} (column {error.offset})") from error
    return builder.close(), lines


def _check_names(xml: ElementTree.Element, lines: Mapping[ElementTree.Element, int], path: Path) -> None:
    """Every link and joint has a name, and no two have the same."""
    if not xml.get("name"):
        raise RefusedError(f"{path}:{lines[xml]}: <robot> has no name")
    for kind in ("link", "joint"):
        seen: dict[str, int] = {}
        for element in xml.findall(kind):
            name, line = element.get("name"), lines[element]
            if not name:
                raise RefusedError(f"{path}:{line}: a <{kind}> has no name")
            if name in seen:
                raise RefusedError(
                    f"{path}:{line}: {kind} {name!r} is there twice, first on line {seen[name]}; rename one"
                )
            seen[name] = line
    if not xml.findall("link"):
        raise RefusedError(f"{path}:{lines[xml]}: the robot has no <link>")
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or not named.get("link"):
                raise RefusedError(f"{path}:{lines[joint]}: joint {joint.get('name')!r} has no <{end} link=>")


def _read(text: bytes, path: Path) -> Any:
    """Yourdfpy's robot; its meshes and its scene graph are left alone, they are read elsewhere."""
    import yourdfpy

    try:
        return yourdfpy.URDF.load(
            io.BytesIO(text), build_scene_graph=False, load_meshes=False, load_collision_meshes=False
        ).robot
    except (ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
        raise RefusedError(f"{path}: not a URDF: {type(error).__name__}: {error}") from error


def _check_joints(description: Description, joints: list[Any]) -> None:
    """Each joint is of a known type, has an axis, holds a link that is there and is held by no other."""
    held: dict[str, str] = {}
    for joint in joints:
        if joint.type not in JOINT_TYPES:
            raise description.refused(
                "joint", joint.name, f"is of type {joint.type!r}; known: {', '.join(JOINT_TYPES)}"
            )
        for link in (joint.parent, joint.child):
            if link not in description.links:
                raise description.refused(
                    "joint", joint.name, f"names no link {link!r}; {hint(link, description.links)}"
                )
        if joint.child in held:
            raise description.refused(
                "joint", joint.name, f"holds {joint.child!r}, which {held[joint.child]!r} holds already"
            )
        held[joint.child] = joint.name
        if joint.type in MOVING and not np.linalg.norm(joint.axis) > 0:
            raise description.refused("joint", joint.name, "moves about an axis of length 0")


def _order(root: str, joints: list[Any]) -> list[str]:
    """Links from the root outwards, depth first, each parent's joints in the order of the file."""
    order, pending = [], [root]
    while pending:
        link = pending.pop()
        order.append(link)
        pending += [joint.child for joint in reversed(joints) if joint.parent == link]
    return order
