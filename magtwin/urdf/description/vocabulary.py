"""Vocabulary: every element and attribute of a URDF, as one table.

Sources: the URDF XML specification (wiki.ros.org/urdf/XML); urdfdom for versions 1.1 (`quat_xyzw`, `capsule`)
and 1.2 (limits of acceleration, deceleration and jerk); the manuals of Bullet and Drake. Each element and
attribute of a description is used, repaired, kept as text, or unknown, as the table says.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from xml.etree import ElementTree

Element = ElementTree.Element


@dataclass(frozen=True)
class Number:
    """Constraints on an attribute's numbers."""

    counts: tuple[int, ...] = (1,)
    """Allowed counts."""

    required: bool = False

    least: float = -math.inf
    """Smaller numbers are raised to it."""

    most: float = math.inf
    """Larger numbers are reduced to it."""

    vital: bool = False
    """Whether an unreadable number is refused; others count as not given, as they have a default."""

    signed: bool = True
    """Whether the sign matters; without it, the absolute value is used."""

    endless: bool = False
    """Whether numbers may be infinite."""

    rest: str = ""
    """Value that completes the smallest count to the largest."""


@dataclass(frozen=True)
class Entry:
    """An element of a URDF."""

    words: str = ""
    """Attributes that are used as they are."""

    numbers: Mapping[str, Number] = field(default_factory=dict)
    """Attributes that are used as numbers."""

    children: str = ""
    """Elements below it that are used."""

    moved: str = ""
    """Elements below it that belong elsewhere and are moved there, a repair."""

    kept: str = ""
    """What has no counterpart in USD and is kept as text: elements, and attributes as `@name`. Sections with
    a grammar of their own are among them; `tag.Tags` uses parts of these."""

    many: bool = False
    """Whether it may occur several times."""

    needed: str = ""
    """Attribute without which it is empty."""

    @cached_property
    def fates(self) -> Mapping[str, str]:
        """What becomes of attributes, as `@name`, and of elements: "used", "moved" or "kept"."""
        used = (*(f"@{name}" for name in (*self.words.split(), *self.numbers)), *self.children.split())
        lists = ("used", used), ("moved", self.moved.split()), ("kept", self.kept.split())
        return {name: fate for fate, names in lists for name in names}

    def fate(self, name: str) -> str:
        """What becomes of an attribute, as `@name`, or of an element; "unknown" if no grammar has it.

        A name with a prefix is of a dialect, such as Drake's. Declarations of namespaces count as used.
        """
        if name.startswith(("@xmlns", "@xml:")):
            return "used"
        return self.fates.get(name, "kept" if ":" in name else "unknown")


XYZ = Number(counts=(3,), vital=True)
SIZE = Number(required=True, vital=True, signed=False)
AMOUNT = Number(least=0.0)
PLAIN, ENDLESS = Number(), Number(endless=True)
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

GRAMMAR: Mapping[str, Entry] = {
    "robot": Entry(
        "name version",
        children="link joint material",
        kept="gazebo transmission ros2_control sensor mujoco frame loop_joint collision_filter_group",
    ),
    "link": Entry(
        "name",
        children="inertial visual collision",
        kept="@type contact self_collision_checking verbose",
    ),
    "inertial": Entry(children="origin mass inertia"),
    "mass": Entry(numbers={"value": PLAIN}),
    "inertia": Entry(numbers=dict.fromkeys(MOMENTS, PLAIN)),
    "visual": Entry(
        "name", children="origin geometry material", moved="color texture", kept="@group", many=True
    ),
    "collision": Entry(
        "name",
        children="origin geometry",
        kept="@group material verbose contact_coefficients",
        many=True,
    ),
    "origin": Entry(numbers={"xyz": XYZ, "rpy": XYZ, "quat_xyzw": Number(counts=(4,), vital=True)}),
    "geometry": Entry(
        children="box capsule cylinder mesh sphere", moved="material color texture", kept="@name"
    ),
    "box": Entry(numbers={"size": Number(counts=(3,), required=True, vital=True, signed=False)}),
    "capsule": Entry(numbers={"radius": SIZE, "length": SIZE}),
    "cylinder": Entry(numbers={"radius": SIZE, "length": SIZE}),
    "mesh": Entry("filename", {"scale": Number(counts=(1, 3), vital=True)}, needed="filename"),
    "sphere": Entry(numbers={"radius": SIZE}),
    "material": Entry("name", children="color texture"),
    "color": Entry(numbers={"rgba": Number(counts=(3, 4), least=0.0, most=1.0, rest="1")}, needed="rgba"),
    "texture": Entry("filename", needed="filename"),
    "joint": Entry(
        "name type dont_collapse",
        children="origin parent child axis dynamics limit mimic",
        kept="calibration safety_controller",
    ),
    "parent": Entry("link"),
    "child": Entry("link"),
    "axis": Entry(numbers={"xyz": XYZ}),
    "dynamics": Entry(numbers={"damping": AMOUNT, "friction": AMOUNT}),
    "limit": Entry(
        numbers=dict.fromkeys(("lower", "upper", "effort", "velocity"), ENDLESS),
        kept="@acceleration @deceleration @jerk",
    ),
    "mimic": Entry("joint", {"multiplier": PLAIN, "offset": PLAIN}, needed="joint"),
}
"""Every element by its tag."""

VERSIONS = ("1.0", "1.1", "1.2")
"""Versions of URDF; a file without one has the first. What came later is read in any."""

PARTS = tuple(GRAMMAR["robot"].children.split())
"""Elements directly below `<robot>` that describe the body."""


@dataclass(frozen=True)
class Unused:
    """An element or attribute that has no effect."""

    way: tuple[Element, ...]
    """The elements that hold it, from `<robot>` on."""

    name: str
    """The element's tag, or `@` and the attribute's name."""

    element: Element | None
    """The element; None for an attribute."""

    known: bool
    """Whether a grammar has it."""

    @property
    def alternatives(self) -> list[str]:
        """Names that the grammar has in its place."""
        names = GRAMMAR[self.way[-1].tag].fates
        return [name.lstrip("@") for name in names if (name[0] == "@") == (self.element is None)]


def unused(element: Element, *above: Element) -> Iterator[Unused]:
    """The outermost elements and attributes, at or below an element, that the grammar does not use."""
    entry, way = GRAMMAR[element.tag], (*above, element)
    for name in (f"@{attribute}" for attribute in element.attrib):
        fate = entry.fate(name)
        if fate != "used":
            yield Unused(way, name, None, fate == "kept")
    for child in element:
        fate = entry.fate(child.tag)
        if fate in ("used", "moved"):
            yield from unused(child, *way)
        else:
            yield Unused(way, child.tag, child, fate == "kept")
