"""Grammar: the values of a URDF's links and joints, checked and repaired by the table in `vocabulary`."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from xml.etree import ElementTree

from magtwin.errors import InputError
from magtwin.urdf.description.vocabulary import GRAMMAR, Number
from magtwin.urdf.repairs import NOTE

Element = ElementTree.Element


Repair = Callable[[str, str, Element], None]
"""Receives the kind of a repair, its text, and the element with the fault."""


class _ShapeError(Exception):
    """A visual or collision has no shape that can be made; the text gives the reason."""


TURN = 2 * math.pi
"""Range from which a revolute joint without effort and velocity counts as a wheel [rad]."""

UNIT = 1e-3
"""Deviation of a quaternion's length from 1 from which it is reported."""

LARGEST = 1e30
"""Larger numbers count as infinite: USD stores single precision, and volumes are cubes."""


def check_grammar(
    part: Element, where: Callable[[Element], str], repair: Repair, made: dict[Element, Element] | None = None
) -> Element:
    """Check a link, joint or material, and repair what has an evident reading.

    Args:
        part: The element.
        where: File and line of an element, for error messages.
        repair: Receives every repair.
        made: Receives what became of each element that is used.

    Returns:
        `part` with known elements and attributes only, and numbers separated by blanks.

    Raises:
        InputError: A number of a pose, an axis or a size is invalid, so that the shape of the robot is
            unknown.
    """
    label = f"{part.tag} {part.get('name')!r}"
    clean = _Checker(label, where, repair, {} if made is None else made).cleaned(part)
    assert clean is not None  # only the elements below it can be left out
    return clean


@dataclass(frozen=True)
class _Checker:
    """Checks one link, joint or material."""

    label: str
    where: Callable[[Element], str]
    report: Repair
    made: dict[Element, Element]

    def repair(self, kind: str, text: str, element: Element) -> None:
        self.report(kind, f"{self.label}: {text}", element)

    def cleaned(self, element: Element) -> Element | None:
        """An element as the grammar has it; None if it is left out."""
        attributes = self._attributes(element)
        wanted = GRAMMAR[element.tag].needed
        if wanted and not attributes.get(wanted):
            if element.tag == "mesh":
                raise _ShapeError("a <mesh> without filename=")
            kind = "mimic-leader" if element.tag == "mimic" else "tag-empty"
            if wanted != "rgba" or not element.get(wanted, "").strip():  # an unreadable colour is reported
                self.repair(kind, f"a <{element.tag}> without {wanted}= is left out", element)
            return None
        clean = Element(element.tag, attributes)
        for child in element:
            if self._is_known(child, element, clean):
                self._append(clean, child)
        if element.tag == "geometry" and len(clean) != 1:
            raise _ShapeError("a <geometry> without a shape")
        if GRAMMAR[element.tag].many and clean.find("geometry") is None:
            raise _ShapeError(f"a <{element.tag}> without <geometry>")
        if element.tag == "visual":
            parts = (element, *element.findall("geometry"))
            self._rehouse(clean, [e for p in parts for e in p if GRAMMAR[p.tag].fate(e.tag) == "moved"])
        finish = {"link": self._finish_link, "joint": self._finish_joint, "origin": self._finish_origin}
        if element.tag in finish:
            finish[element.tag](clean, element)
        self.made[element] = clean
        return clean

    def _append(self, clean: Element, child: Element) -> None:
        """Add a child as the grammar has it."""
        try:
            made = self.cleaned(child)
        except _ShapeError as error:
            if not GRAMMAR[child.tag].many:
                raise
            self.repair("shape-missing", f"{error}: the {child.tag} is left out", child)
            return
        if made is not None:
            clean.append(made)

    def _is_known(self, child: Element, parent: Element, clean: Element) -> bool:
        """Whether a child is used here and the first of its kind; `vocabulary.unused` finds all others."""
        if GRAMMAR[parent.tag].fate(child.tag) != "used":
            return False
        first = clean.find(child.tag)
        if parent.tag == "geometry" and len(clean):
            first = clean[0]
        if first is not None and not GRAMMAR[child.tag].many:
            self.repair("tag-twice", f"a second <{child.tag}> in <{parent.tag}> is left out", child)
            return False
        return True

    def _rehouse(self, visual: Element, astray: list[Element]) -> None:
        """Move misplaced looks into the material of their visual."""
        for look in astray:
            made = self.cleaned(look)
            if made is None:
                continue
            material = visual.find("material")
            if material is None:
                material = ElementTree.SubElement(visual, "material")
            parts = list(made) if look.tag == "material" else [made]
            if look.tag == "material" and "name" in made.attrib:
                material.attrib.setdefault("name", made.attrib["name"])
            for part in parts:
                if material.find(part.tag) is None:
                    material.append(part)
            self.repair("tag-misplaced", f"<{look.tag}> moved into the <material> of its visual", look)

    def _finish_link(self, clean: Element, link: Element) -> None:
        """Check a link's mass and inertia."""
        inertial, source = clean.find("inertial"), link.find("inertial")
        if inertial is not None and source is not None:
            self._check_inertia(inertial, source)
            self._check_mass(clean, inertial, source)

    def _check_inertia(self, inertial: Element, source: Element) -> None:
        """Leave out an inertia of zeros, or with a part that cannot be read."""
        tensor, given = inertial.find("inertia"), source.find("inertia")
        if tensor is None or given is None:
            return
        if GRAMMAR["inertia"].numbers.keys() & given.attrib.keys() - tensor.attrib.keys():
            inertial.remove(tensor)
            self.repair("inertia-unreadable", "an <inertia> that cannot be read counts as none", given)
        elif not any(map(float, tensor.attrib.values())):
            inertial.remove(tensor)
            mass = inertial.find("mass")
            if mass is None or float(mass.get("value", 0.0)) != 0:
                self.repair(NOTE, "an <inertia> of zeros counts as none", given)

    def _check_mass(self, link: Element, inertial: Element, source: Element) -> None:
        """Leave out an inertial without a mass above 0."""
        mass = inertial.find("mass")
        value = None if mass is None else mass.get("value")
        if value is not None and float(value) > 0:
            return
        link.remove(inertial)
        given = source.find("mass")
        what = "no mass" if value is None else f"a mass of {float(value):g}"
        self.repair("mass-invalid", f"{what} counts as none", source if given is None else given)

    def _finish_origin(self, clean: Element, origin: Element) -> None:
        """Leave out roll, pitch and yaw beside a quaternion, and note one whose length is not 1."""
        if "quat_xyzw" not in clean.attrib:
            return
        given = clean.attrib["quat_xyzw"]
        length = math.hypot(*map(float, given.split()))
        if length == 0:
            raise InputError(f"{self.where(origin)}: {self.label}: quat_xyzw of <origin> has length 0")
        if abs(length - 1) > UNIT:
            text = f"quat_xyzw of <origin> has length {length:.4g} in {given!r}: scaled to 1"
            self.repair("number-range", text, origin)
        if clean.attrib.pop("rpy", None) is not None:
            self.repair("turn-twice", "<origin> has rpy and quat_xyzw: quat_xyzw is used", origin)

    def _finish_joint(self, clean: Element, joint: Element) -> None:
        """Complete limits; see `repairs.FAULTS`."""
        limit, given, kind = clean.find("limit"), joint.find("limit"), clean.get("type")
        about = joint if given is None else given
        given_ends = {} if limit is None else limit.attrib
        ends: dict[str, float] = {e: float(given_ends[e]) for e in ("lower", "upper") if e in given_ends}
        for name in ("effort", "velocity"):
            if limit is not None and float(limit.get(name, 0.0)) < 0:
                value = limit.attrib.pop(name)
                self.repair("effort-invalid", f"{name} {value} of <limit> counts as not given", about)
        if kind == "continuous" and any(map(math.isfinite, ends.values())):
            words = ", ".join(f"{end} {value:g}" for end, value in ends.items())
            text = f"is continuous, which has no range: {words} of its <limit> is ignored"
            self.report("limit-ignored", f"{self.label} {text}", about)
        if kind not in ("revolute", "prismatic"):
            return
        if not ends:
            self._free(clean, limit)
            self.report("limit-missing", f"{self.label} is {kind} without limits: it moves without", about)
            return
        assert limit is not None
        if len(ends) == 1:
            missing = "lower" if "upper" in ends else "upper"
            limit.set(missing, "0")
            ends[missing] = 0.0
            text = f"gives no {missing} limit: 0, URDF's default"
            self.report("limit-one-end", f"{self.label} {text}", about)
        if ends["lower"] > ends["upper"]:
            limit.attrib["lower"], limit.attrib["upper"] = limit.attrib["upper"], limit.attrib["lower"]
            text = f"has its lower limit {ends['lower']:g} above its upper {ends['upper']:g}: swapped"
            self.report("limit-swapped", f"{self.label} {text}", about)
        powerless = all(float(limit.get(name, 1.0)) == 0 for name in ("effort", "velocity"))
        span = abs(ends["upper"] - ends["lower"])
        if kind == "revolute" and powerless and (set(ends.values()) == {0.0} or span >= TURN):
            self._free(clean, limit)
            words = (
                "range, effort and velocity"
                if span == 0
                else f"effort and velocity of 0 and a range of {span:g} rad"
            )
            text = f"is revolute with {words}" + (" of 0" if span == 0 else "") + ": a wheel without limits"
            self.report("limit-zeros", f"{self.label} {text}", about)
        elif kind == "revolute" and powerless and span > 0:
            text = (
                f"is revolute with effort and velocity of 0 and a range of {span:g} rad: it moves within it"
            )
            self.report("limit-zeros", f"{self.label} {text}", about)

    def _free(self, joint: Element, limit: Element | None) -> None:
        """Let a joint move without limits."""
        if joint.get("type") == "revolute":
            joint.set("type", "continuous")
            for end in ("lower", "upper"):
                if limit is not None:
                    limit.attrib.pop(end, None)
            return
        limit = ElementTree.SubElement(joint, "limit") if limit is None else limit
        limit.set("lower", "-inf")
        limit.set("upper", "inf")

    def _attributes(self, element: Element) -> dict[str, str]:
        """Attributes of an element, with numbers checked."""
        entry = GRAMMAR[element.tag]
        made = {name: element.attrib[name] for name in entry.words.split() if name in element.attrib}
        for name, kind in entry.numbers.items():
            given = element.get(name)
            if given is not None and given.strip():
                words = self._numbers(given, kind, element, name)
                if words:
                    made[name] = words
            elif kind.required:
                raise _ShapeError(f"a <{element.tag}> without {name}=")
        return made

    def _numbers(self, given: str, kind: Number, element: Element, name: str) -> str:
        """Numbers of an attribute, separated by blanks; "" if they count as not given."""
        label, words = f"{name} of <{element.tag}>", given.replace(",", " ").split()
        counts = " or ".join(map(str, kind.counts))
        wanted = "a finite number" if kind.counts == (1,) else f"{counts} finite numbers"
        values = [_value(word, endless=kind.endless) for word in words]
        counted = self._counted(words, values, kind)
        if counted is None or None in values:
            if kind.vital:
                start = f"{self.where(element)}: {self.label}"
                raise InputError(f"{start}: {label} must be {wanted}, got {given!r}")
            self.repair("number-unreadable", f"{label} must be {wanted}, not {given!r}: not used", element)
            return ""
        bounded = [_bounded(word, kind) for word in words]
        if bounded != words:
            above = any(float(word) > kind.most for word in words)
            text = f"is above {kind.most:g} in {given!r}: reduced to it"
            if not above:
                done = "raised to it" if kind.signed else "used without its sign"
                text = f"is below 0 in {given!r}: {done}"
            self.repair("number-range", f"{label} {text}", element)
            counted = self._counted(bounded, values, kind)
        assert counted is not None
        if counted != bounded:
            longer = len(counted) > len(words) and kind.rest
            done = f"completed by {kind.rest}" if longer else f"read as {' '.join(counted)}"
            self.repair("number-count", f"{label} has {len(words)} numbers in {given!r}: {done}", element)
        return " ".join(counted)

    def _counted(self, words: list[str], values: list[float | None], kind: Number) -> list[str] | None:
        """As many numbers as wanted; None if there is no evident reading."""
        most, least = max(kind.counts), min(kind.counts)
        if len(words) in kind.counts:
            return words + [kind.rest] * (most - len(words)) if kind.rest else words
        if len(words) > most and (not any(values[most:]) or kind.rest):
            return words[:most]
        if len(words) == 1 and most == 3 and (values == [0.0] or not kind.signed):
            return words * least
        return None


def _value(word: str, *, endless: bool) -> float | None:
    """A number; None if it is none, or not finite."""
    try:
        value = float(word)
    except ValueError:
        return None
    unreadable = "_" in word or math.isnan(value) or (abs(value) > LARGEST and not endless)
    return None if unreadable else value


def _bounded(word: str, kind: Number) -> str:
    """A number within its range."""
    value = float(word)
    if not kind.signed and value < 0:
        return f"{-value:g}"
    if value < kind.least or value > kind.most:
        return f"{kind.least if value < kind.least else kind.most:g}"
    return word
