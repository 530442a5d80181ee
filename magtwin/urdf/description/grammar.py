"""Grammar: the elements and attributes of a URDF's links and joints, and their allowed values.

Follows the URDF XML specification (wiki.ros.org/urdf/XML), with the capsule of urdfdom 4.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

from magtwin.errors import InputError, hint

Element = ElementTree.Element


Note = Callable[..., None]
"""Receives a note for the user; with `lost=True` if something was left out."""


@dataclass(frozen=True)
class Number:
    """Constraints on an attribute's numbers."""

    counts: tuple[int, ...] = (1,)
    """Allowed counts."""

    required: bool = False

    least: float = -math.inf
    """Smaller numbers are refused."""

    most: float = math.inf
    """Larger numbers are reduced to it."""

    endless: bool = False
    """Whether numbers may be infinite."""

    rest: str = ""
    """Value that completes the smallest count to the largest."""


LARGEST = 1e30
"""Larger numbers count as infinite: USD stores single precision, and volumes are cubes."""

XYZ = Number(counts=(3,))
SIZE = Number(required=True, least=0.0)
AMOUNT = Number(least=0.0)

NUMBERS: Mapping[str, Mapping[str, Number]] = {
    "origin": {"xyz": XYZ, "rpy": XYZ},
    "mass": {"value": Number(required=True, least=0.0)},
    "inertia": {name: Number() for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")},
    "box": {"size": Number(counts=(3,), required=True, least=0.0)},
    "cylinder": {"radius": SIZE, "length": SIZE},
    "capsule": {"radius": SIZE, "length": SIZE},
    "sphere": {"radius": SIZE},
    "mesh": {"scale": Number(counts=(1, 3))},
    "color": {"rgba": Number(counts=(3, 4), required=True, least=0.0, most=1.0, rest="1")},
    "axis": {"xyz": XYZ},
    "limit": {
        "lower": Number(endless=True),
        "upper": Number(endless=True),
        "effort": Number(endless=True),
        "velocity": Number(least=0.0, endless=True),
    },
    "dynamics": {"damping": AMOUNT, "friction": AMOUNT},
    "mimic": {"multiplier": Number(), "offset": Number()},
    "calibration": {"rising": Number(), "falling": Number()},
    "safety_controller": {
        name: Number() for name in ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity")
    },
}
"""Numeric attributes by element."""

SHAPES = ("box", "capsule", "cylinder", "mesh", "sphere")

CHILDREN: Mapping[str, tuple[str, ...]] = {
    "link": ("inertial", "visual", "collision"),
    "inertial": ("origin", "mass", "inertia"),
    "visual": ("origin", "geometry", "material"),
    "collision": ("origin", "geometry"),
    "geometry": SHAPES,
    "material": ("color", "texture"),
    "joint": (
        *("origin", "parent", "child", "axis", "calibration", "dynamics", "limit", "mimic"),
        "safety_controller",
    ),
}
"""Allowed children by element."""

MANY = frozenset({"visual", "collision"})
"""Elements that may occur several times."""

NEEDED: Mapping[str, str] = {"visual": "geometry", "collision": "geometry"}
"""Required child by element."""

TEXTS: Mapping[str, str] = {"mesh": "filename", "texture": "filename", "mimic": "joint"}
"""Required text attribute by element."""


def check_grammar(part: Element, where: Callable[[Element], str], note: Note) -> Element:
    """Check a link, joint or material; anything outside the grammar is left out with a note.

    Args:
        part: The element.
        where: File and line of an element, for error messages.
        note: Receives notes of repairs and omissions.

    Returns:
        `part` with known elements and attributes only, and numbers separated by blanks.

    Raises:
        InputError: A number is missing, invalid, not finite or too small; there are too many or too few
            numbers; or a geometry does not have exactly one known shape.
    """
    label = f"{part.tag} {part.get('name')!r}"
    clean = _clean(part, label, where, note)
    _drop_zeros(clean, label, note)
    _complete_limit(clean, label, note)
    return clean


def _drop_zeros(link: Element, label: str, note: Note) -> None:
    """Leave out a mass of 0 and an inertia of zeros: they are placeholders."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if tensor is not None and not any(map(float, tensor.attrib.values())):
        inertial.remove(tensor)
        if mass is None or float(mass.attrib["value"]) != 0:
            note(f"{label}: an <inertia> of zeros counts as none")
        tensor = None
    if mass is not None and float(mass.attrib["value"]) == 0:
        link.remove(inertial)
        note(f"{label}: a mass of 0 counts as none", lost=tensor is not None)


def _complete_limit(joint: Element, label: str, note: Note) -> None:
    """Set a missing end of a range to 0, URDF's default; ignore the range of a continuous joint."""
    limit, ends = joint.find("limit"), ("lower", "upper")
    if limit is None:
        return
    given = {end: float(limit.attrib[end]) for end in ends if end in limit.attrib}
    if joint.get("type") == "continuous":
        if any(map(math.isfinite, given.values())):
            words = ", ".join(f"{end} {value:g}" for end, value in given.items())
            note(f"{label} is continuous, which has no range: {words} of its <limit> is ignored")
    elif joint.get("type") in ("revolute", "prismatic") and len(given) == 1:
        missing = next(end for end in ends if end not in given)
        limit.set(missing, "0")
        note(f"{label} gives no {missing} limit: 0, URDF's default")


def _clean(element: Element, label: str, where: Callable[[Element], str], note: Note) -> Element:
    start = f"{where(element)}: {label}"
    clean = Element(element.tag, _attributes(element, where(element), label, note))
    known = CHILDREN.get(element.tag, ())
    seen: set[str] = set()
    for child in element:
        if child.tag not in known:
            if element.tag == "geometry":
                raise InputError(
                    f"{where(child)}: {label} has a geometry {child.tag!r}; {hint(child.tag, SHAPES)}"
                )
            near = hint(child.tag, known) if known else ""
            note(
                f"{label}: <{child.tag}> is unknown in <{element.tag}> and left out"
                + (f"; {near}" if near.startswith("did") else ""),
                lost=True,
            )
            continue
        if child.tag in seen and child.tag not in MANY:
            note(f"{label}: a second <{child.tag}> in <{element.tag}> is left out", lost=True)
            continue
        if child.tag == "texture" and child.get("filename") == "":
            note(f"{label}: a <texture> of no file is left out")
            continue
        seen.add(child.tag)
        clean.append(_clean(child, label, where, note))
    if element.tag == "geometry" and len(clean) != 1:
        raise InputError(f"{start} has a <geometry> of {len(clean)} shapes; give one of {', '.join(SHAPES)}")
    if NEEDED.get(element.tag, element.tag) not in {element.tag, *seen}:
        raise InputError(f"{start} has a <{element.tag}> without <{NEEDED[element.tag]}>")
    return clean


def _attributes(element: Element, place: str, label: str, note: Note) -> dict[str, str]:
    """Attributes of an element, with numbers checked."""
    start = f"{place}: {label}"
    numbers = NUMBERS.get(element.tag, {})
    made = {name: value for name, value in element.items() if name not in numbers and ":" not in name}
    made.pop("xmlns", None)
    text = TEXTS.get(element.tag)
    if text is not None and not made.get(text):
        raise InputError(f"{start} has a <{element.tag}> without {text}=")
    for name, kind in numbers.items():
        given = element.get(name)
        if given is None or not given.strip():
            if kind.required:
                raise InputError(f"{start} has a <{element.tag}> without {name}=")
            continue
        made[name] = _numbers(given, kind, place, f"{label}: {name} of <{element.tag}>", note)
    return made


def _numbers(given: str, kind: Number, place: str, label: str, note: Note) -> str:
    """Numbers of an attribute, separated by blanks; refuses invalid ones."""
    start = f"{place}: {label}"
    words = given.replace(",", " ").split()
    counts = " or ".join(map(str, kind.counts))
    wanted = "a finite number" if kind.counts == (1,) else f"{counts} finite numbers"
    for word in words:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if "_" in word or math.isnan(value) or (abs(value) > LARGEST and not kind.endless):
            raise InputError(f"{start} must be {wanted}, got {given!r}")
        if value < kind.least:
            raise InputError(f"{start} must not be below {kind.least:g}, got {given!r}")
    if len(words) not in kind.counts:
        raise InputError(f"{start} must be {wanted}, got {given!r}")
    if any(float(word) > kind.most for word in words):
        note(f"{label} is above {kind.most:g} in {given!r}: reduced to it")
        words = [word if float(word) <= kind.most else f"{kind.most:g}" for word in words]
    if len(words) < max(kind.counts) and kind.rest:
        note(f"{label} has {len(words)} numbers in {given!r}: completed by {kind.rest}")
        words += [kind.rest] * (max(kind.counts) - len(words))
    return " ".join(words)
