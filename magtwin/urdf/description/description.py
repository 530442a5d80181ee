"""Description: a checked URDF, with links and joints in tree order.

Links, joints and materials are values, see `model`; tags outside URDF's grammar, such as `<gazebo>`, stay in
the XML.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint, near
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
from magtwin.urdf.description.names import check_names
from magtwin.urdf.description.vocabulary import PARTS, VERSIONS, unused
from magtwin.urdf.repairs import LOSS, NOTE, Repairs
from magtwin.urdf.source.source import Source, read_source

Element = ElementTree.Element

WORLD = "world"
"""Root link that is the world."""

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

    repairs: Repairs = field(default_factory=Repairs)
    """Every repair, loss and guess of a conversion."""

    checked: dict[Element, Element] = field(default_factory=dict)
    """What became of each element of links, joints and materials that is used."""

    @cached_property
    def joint_names(self) -> frozenset[str]:
        """Names of all joints."""
        return frozenset(joint.name for joint in self.joints.values())

    @property
    def path(self) -> Path:
        """The file."""
        return self.source.path

    @property
    def xml(self) -> Element:
        """The whole `<robot>`, with everything that `links` and `joints` lack."""
        return self.source.xml

    def where(self, element: Element | None) -> str:
        """`file:line` of an element of `xml`."""
        return self.source.where(element)

    def find_file(self, filename: str, what: str) -> Path:
        """The file that a `filename=` refers to, see `Source.find_file`."""
        try:
            return self.source.find_file(filename, what, self.source.elements.get(("", filename)))
        finally:
            self._take_notes()

    def mesh_element(self, filename: str) -> Element | None:
        """The first `<mesh>` of a file."""
        return self.source.elements.get(("mesh", filename))

    def note(self, text: str, *, lost: bool = False, file: Path | None = None) -> None:
        """Add a note for the user, once.

        Args:
            text: What was guessed or left out, and where.
            lost: Whether the stage lacks something of the description; `Options.strict` refuses that.
            file: The file that it is about, if it is not the description.
        """
        near = "" if file is None else Path(os.path.relpath(file, self.path.parent)).as_posix()
        self.repairs.add(LOSS if lost else NOTE, text, (near, 0))

    def repair(self, kind: str, text: str, about: Element | tuple[str, str] | None = None) -> None:
        """Add a repair, which `Options.strict` refuses.

        Args:
            kind: A key of `repairs.FAULTS`.
            text: What was found and done, in words.
            about: The element with the fault; or the tag and name of its link or joint.
        """
        element = self._find(*about) if isinstance(about, tuple) else about
        self.repairs.add(kind, text, self.source.place(element))
        if element is not None:
            self.repairs.about.setdefault(element, []).append((kind, text))

    def refused(self, kind: str, name: str, text: str) -> InputError:
        """An error with the line of the link or joint called `name`."""
        return InputError(f"{self.source.where(self._find(kind, name))}: {kind} {name!r} {text}")

    def _find(self, kind: str, name: str) -> Element | None:
        """The `<link>` or `<joint>` called `name`."""
        return self.source.elements.get((f"robot/{kind}", name))

    def _take_notes(self) -> None:
        """Take over the notes on packages, which grow as files are searched."""
        for note in self.source.packages.notes:
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
    description = Description(source, "", "", links={}, joints={}, repairs=source.repairs)
    description._take_notes()
    check_names(source, description.repair)
    description = replace(description, name=source.xml.attrib["name"])
    clean = [
        check_grammar(part, description.where, description.repair, description.checked)
        for part in source.xml
        if part.tag in PARTS
    ]
    _report_unknown(description)
    links = [read_link(e) for e in clean if e.tag == "link"]
    for link in links:
        for role, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for kind in (shape.geometry.kind for shape in shapes if shape.geometry.empty):
                text = f"link {link.name!r}: a {role} {kind} of size 0 is left out"
                description.repair("shape-empty", text, ("link", link.name))
    joints = _leading(description, links, [read_joint(e) for e in clean if e.tag == "joint"])
    parents = {joint.parent for joint in joints} - {link.name for link in links}
    if WORLD in parents:
        description.note(f"link {WORLD!r} is held by a joint and missing: it is added")
        links.append(Link(WORLD, None, (), ()))
    materials = _materials(description, [e for e in clean if e.tag == "material"])
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
        materials=MappingProxyType(materials),
    )
    _check_joints(description, joints)
    held = _without_bad_mimics(description, joints)
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


def _report_unknown(description: Description) -> None:
    """Report elements and attributes that no grammar has, and an unknown version of URDF."""
    version = description.xml.get("version", VERSIONS[0])
    if version not in VERSIONS:
        description.note(f"version {version!r} of URDF is unknown: it is read as {VERSIONS[-1]}")
    for one in unused(description.xml):
        if one.known:
            continue
        holder, part = one.way[-1], one.way[1] if len(one.way) > 1 else one.way[0]
        what = f"<{one.name}>" if one.element is not None else f"{one.name[1:]}={holder.get(one.name[1:])!r}"
        advice = description.repairs.suggestion(one.name.lstrip("@"), one.alternatives, near)
        of = "in" if one.element is not None else "of"
        text = f"{part.tag} {part.get('name')!r}: {what} {of} <{holder.tag}> is unknown{advice}: kept as text"
        kind = "attribute-unknown" if one.element is None else "element-unknown"
        description.repair(kind, text, holder if one.element is None else one.element)


def _materials(description: Description, elements: Sequence[Element]) -> dict[str | None, Material]:
    """Robot-wide materials by name; the first of a name is used."""
    materials: dict[str | None, Material] = {}
    for element in elements:
        material = read_material(element)
        about = ("material", material.name or "")
        if material.name is None:
            description.repair("tag-empty", "a <material> of the robot without name= is left out", about)
        elif material.name in materials:
            alike = _look(materials[material.name]) == _look(material)
            text = f"material {material.name!r} is defined twice, {'alike' if alike else 'with two looks'}"
            description.repair("material-twice", f"{text}: the first definition is used", about)
        else:
            materials[material.name] = material
    return materials


def _look(material: Material) -> tuple[object, ...]:
    """What a material looks like."""
    return material.texture, None if material.rgba is None else tuple(material.rgba)


def _leading(description: Description, links: Sequence[Link], joints: Sequence[Joint]) -> list[Joint]:
    """The joints without those that lead to no link, if all links are connected without them."""
    names, children = {link.name for link in links}, {joint.child for joint in joints}
    if len(names - children) != 1:
        return list(joints)  # a misspelt child leaves a link behind: see `_check_joints`
    for joint in joints:
        if joint.child not in names:
            text = f"joint {joint.name!r} leads to no link {joint.child!r}: left out"
            description.repair("name-unknown", text, ("joint", joint.name))
    return [joint for joint in joints if joint.child in names]


def _check_joints(description: Description, joints: Sequence[Joint]) -> None:
    """Check types, links and axes of joints."""
    held: dict[str, str] = {}
    for joint in joints:
        problem = ""
        missing = next((link for link in (joint.parent, joint.child) if link not in description.links), None)
        if joint.type not in JOINT_TYPES:
            problem = f"is of type {joint.type!r}; known: {', '.join(JOINT_TYPES)}"
        elif missing is not None:
            problem = f"names no link {missing!r}; {hint(missing, description.links)}"
        elif joint.child in held:
            problem = f"holds {joint.child!r}, which {held[joint.child]!r} holds already"
        elif joint.type in AXIAL and not np.linalg.norm(joint.axis) > 0:
            problem = "moves about an axis of length 0"
        if problem:
            raise description.refused("joint", joint.name, problem)
        held[joint.child] = joint.name


def _without_bad_mimics(description: Description, joints: Sequence[Joint]) -> dict[str, Joint]:
    """Joints by child link; a mimic that its joint cannot follow is left out."""
    named, leads, held = {joint.name: joint for joint in joints}, dict[str, str](), dict[str, Joint]()
    for joint in joints:
        held[joint.child] = joint
        if joint.mimic is None:
            continue
        leader, problem, about = joint.mimic.joint, "", ("joint", joint.name)
        chain = [joint.name, leader]
        while chain[-1] in leads and chain[-1] != joint.name:
            chain.append(leads[chain[-1]])
        if leader not in named:
            advice = description.repairs.suggestion(leader, named, hint)
            problem = f"no joint {leader!r}" + (f" ({advice})" if advice else "")
        elif chain[-1] == joint.name:
            problem = f"itself: {' -> '.join(chain)}"
        elif joint.type not in (*MOVING, "fixed"):
            problem = f"{leader!r} but is {joint.type}, which has no single value"
        elif named[leader].type in ("planar", "floating"):
            problem = f"{leader!r}, which is {named[leader].type} and has no single value"
        if problem:
            text = f"joint {joint.name!r} mimics {problem}: the mimic is left out"
            description.repair("mimic-leader", text, about)
            held[joint.child] = replace(joint, mimic=None)
            continue
        leads[joint.name] = leader
        still = "fixed" if named[leader].type == "fixed" else "taken 0 times" * (joint.mimic.multiplier == 0)
        if still and joint.type != "fixed":
            text = f"joint {joint.name!r} mimics {leader!r}, which is {still}: it is fixed at its offset"
            description.repair("mimic-fixed", text, about)
    return held


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
