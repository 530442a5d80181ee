"""Description: a checked URDF, with links and joints in tree order.

Links, joints and materials are values, see `model`; tags outside URDF's grammar, such as `<gazebo>`, stay in
the XML.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.urdf.description.grammar import check_grammar
from magtwin.urdf.description.model import (
    Inertial,
    Joint,
    Link,
    Material,
    Shape,
    read_joint,
    read_link,
    read_material,
)
from magtwin.urdf.source.source import Source, read_source

JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic", "planar", "floating")
"""Types of joints that can be converted."""

AXIAL = JOINT_TYPES[1:5]
"""Types with an axis; a planar joint's is the normal of its plane."""

MOVING = JOINT_TYPES[1:4]
"""Types with one degree of freedom."""


@dataclass(frozen=True)
class Description:
    """A robot as a tree of links and joints."""

    source: Source
    """The file, and the packages around it."""

    name: str
    """Name of the robot."""

    root: str
    """Name of the root link."""

    links: Mapping[str, Link]
    """Links by name, parents before children."""

    joints: Mapping[str, Joint]
    """Joints by the name of their child link, parents before children."""

    materials: Mapping[str | None, Material] = field(default_factory=dict)
    """Robot-wide materials by name."""

    notes: list[str] = field(default_factory=list)
    """Every repair, guess and omission of a conversion, one line each."""

    dropped: list[str] = field(default_factory=list)
    """The notes on losses."""

    @property
    def path(self) -> Path:
        """The file."""
        return self.source.path

    @property
    def xml(self) -> ElementTree.Element:
        """The whole `<robot>`, with everything that `links` and `joints` lack."""
        return self.source.xml

    def where(self, element: ElementTree.Element | None) -> str:
        """`file:line` of an element of `xml`."""
        return self.source.where(element)

    def find_file(self, filename: str, what: str) -> Path:
        """The file that a `filename=` refers to, see `Source.find_file`.

        Raises:
            MissingFileError: The file does not exist.
            InputError: The file may not be read, or its package was not found.
        """
        named = (e for e in self.xml.iter() if e.get("filename") == filename)
        try:
            return self.source.find_file(filename, what, next(named, None))
        finally:
            self._take_notes()

    def note(self, text: str, *, lost: bool = False) -> None:
        """Add a note for the user, once.

        Args:
            text: What was repaired, guessed or left out, and where.
            lost: Whether the stage lacks something of the description; `Options.strict` refuses that.
        """
        if text not in self.notes:
            self.notes.append(text)
            if lost:
                self.dropped.append(text)

    def refused(self, kind: str, name: str, text: str) -> InputError:
        """An error with the line of the link or joint called `name`."""
        element = next((e for e in self.xml.findall(kind) if e.get("name") == name), None)
        return InputError(f"{self.source.where(element)}: {kind} {name!r} {text}")

    def _take_notes(self) -> None:
        """Take over the notes of the source, which grow as files are searched."""
        for note in (*self.source.notes, *self.source.packages.notes):
            self.note(note)

    def poses(self) -> dict[str, NDArray[np.float64]]:
        """T_root_link of each link with every joint at zero, shape (4, 4)."""
        poses = {self.root: np.eye(4)}
        for child, joint in self.joints.items():
            poses[child] = poses[joint.parent] @ origin_of(joint)
        return poses


def origin_of(part: Joint | Shape | Inertial) -> NDArray[np.float64]:
    """Pose of a joint, visual, collision or inertial in its link, shape (4, 4). Default: identity."""
    return np.eye(4) if part.origin is None else part.origin


def read_description(source: Source | str | os.PathLike[str]) -> Description:
    """Read and check a URDF.

    Args:
        source: The result of `read_source`, or a file to read without options.

    Raises:
        InputError: See `read_source`; or a link or joint violates URDF's grammar; or links and joints are
            not one tree. The message gives file and line.
    """
    if not isinstance(source, Source):
        source = read_source(source)
    _check_names(source)
    description = Description(source=source, name=source.xml.get("name", ""), root="", links={}, joints={})
    description._take_notes()
    clean = [
        check_grammar(part, description.where, description.note)
        for part in source.xml
        if part.tag in ("link", "joint", "material")
    ]
    links = [read_link(e) for e in clean if e.tag == "link"]
    for link in links:
        for role, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for kind in (shape.geometry.kind for shape in shapes if shape.geometry.empty):
                description.note(f"link {link.name!r}: a {role} {kind} of size 0 is left out", lost=True)
    joints = [read_joint(e) for e in clean if e.tag == "joint"]
    materials = [read_material(e) for e in clean if e.tag == "material"]
    held = {joint.child: joint for joint in joints}
    description = replace(
        description,
        links={
            link.name: replace(
                link,
                visuals=tuple(shape for shape in link.visuals if not shape.geometry.empty),
                collisions=tuple(shape for shape in link.collisions if not shape.geometry.empty),
            )
            for link in links
        },
        joints=held,
        materials=MappingProxyType({m.name: m for m in materials}),
    )
    _check_joints(description, joints)
    roots = [name for name in description.links if name not in held]
    if not roots:
        first = joints[0].name
        raise description.refused("joint", first, "closes a circle: no link is the root; remove one joint")
    if len(roots) > 1:
        text = f"is not connected: a robot has one root, this has {', '.join(roots)}"
        raise description.refused("link", roots[1], text)
    order = _order(roots[0], joints)
    if len(order) < len(description.links):
        astray = next(name for name in description.links if name not in order)
        raise description.refused("joint", held[astray].name, "closes a circle; remove one joint of it")
    return replace(
        description,
        root=roots[0],
        links=MappingProxyType({name: description.links[name] for name in order}),
        joints=MappingProxyType({name: held[name] for name in order if name in held}),
    )


def _check_names(source: Source) -> None:
    """Check that every link and joint has a unique name."""
    xml, where = source.xml, source.where
    if not xml.get("name"):
        raise InputError(f"{where(xml)}: <robot> has no name")
    for kind in ("link", "joint"):
        seen: dict[str, ElementTree.Element] = {}
        for element in xml.findall(kind):
            name = element.get("name")
            if not name:
                raise InputError(f"{where(element)}: a <{kind}> has no name")
            if name in seen:
                file, line = source.places[seen[name]]
                first = f"line {line}" if file == source.places[element][0] else f"{file}:{line}"
                raise InputError(
                    f"{where(element)}: {kind} {name!r} exists twice, first on {first}; rename one"
                )
            seen[name] = element
    if not xml.findall("link"):
        raise InputError(f"{where(xml)}: the robot has no <link>")
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or not named.get("link"):
                raise InputError(f"{where(joint)}: joint {joint.get('name')!r} has no <{end} link=>")


def _check_joints(description: Description, joints: Sequence[Joint]) -> None:
    """Check types, links, axes, limits and mimics of joints."""
    held: dict[str, str] = {}
    named = {joint.name: joint for joint in joints}
    for joint in joints:
        limit, problem = joint.limit, ""
        missing = next((link for link in (joint.parent, joint.child) if link not in description.links), None)
        if joint.type not in JOINT_TYPES:
            problem = f"is of type {joint.type!r}; known: {', '.join(JOINT_TYPES)}"
        elif missing is not None:
            problem = f"names no link {missing!r}; {hint(missing, description.links)}"
        elif joint.child in held:
            problem = f"holds {joint.child!r}, which {held[joint.child]!r} holds already"
        elif joint.type in AXIAL and not np.linalg.norm(joint.axis) > 0:
            problem = "moves about an axis of length 0"
        elif limit is not None and joint.type not in ("fixed", "continuous"):
            low, high = limit.lower, limit.upper
            if low is not None and high is not None and low > high:
                problem = f"has its lower limit {low:g} above its upper {high:g}"
        if problem:
            raise description.refused("joint", joint.name, problem)
        held[joint.child] = joint.name
        if joint.mimic is not None:
            _check_mimic(description, joint, named)


def _check_mimic(description: Description, joint: Joint, named: Mapping[str, Joint]) -> None:
    """Check that the leader of a joint exists, moves, and does not follow it in turn."""
    chain = [joint.name]
    while (mimic := named[chain[-1]].mimic) is not None:
        if mimic.joint not in named:
            text = f"mimics no joint {mimic.joint!r}; {hint(mimic.joint, named)}"
            raise description.refused("joint", chain[-1], text)
        if mimic.joint in chain:
            text = f"mimics itself: {' -> '.join([*chain, mimic.joint])}"
            raise description.refused("joint", joint.name, text)
        chain.append(mimic.joint)
    if named[chain[-1]].type not in MOVING:
        text = f"mimics {chain[-1]!r}, which is {named[chain[-1]].type}; give one that moves"
        raise description.refused("joint", joint.name, text)


def _order(root: str, joints: Sequence[Joint]) -> list[str]:
    """Links from the root, depth first, with each parent's joints in file order."""
    below: dict[str, list[str]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint.child)
    order, pending = [], [root]
    while pending:
        link = pending.pop()
        order.append(link)
        pending += reversed(below.get(link, []))
    return order
