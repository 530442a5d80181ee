"""Tag: elements outside URDF's grammar; those that are not used are kept as text."""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from xml.etree import ElementTree

import numpy as np
from pxr import Usd, Vt

from magtwin.urdf.description.description import Description
from magtwin.urdf.description.extensions import Figure
from magtwin.urdf.description.vocabulary import Unused, unused
from magtwin.urdf.source.markup import plain_text

Element = ElementTree.Element

KEPT = "magtwin:unconverted"
"""Key of a prim's customData: unused tags, each as text."""

READ = frozenset(("name", "reference", "type", "filename", "value", "relative_to", "frame", "degrees"))
"""Attributes that are used where the tag that has them is read."""


class Tags:
    """The tags of a description: `<gazebo>`, `<ros2_control>`, `<transmission>` and others.

    The methods below mark the elements that they read. `keep` stores all others as text on the prim to which
    they refer, and counts them.
    """

    def __init__(self, description: Description) -> None:
        self.description = description
        self._read: set[Element] = set()
        self.fields: dict[Element, str] = {}
        """Names, in the tables of `extensions`, of numbers that were read."""

    def blocks(self, tag: str) -> list[Element]:
        """Elements called `tag` directly below `<robot>`; marks them, but not their children."""
        return self.findall(self.description.xml, tag)

    def have(self, tag: str) -> bool:
        """Whether a `<gazebo>` has a tag."""
        return any(block.find(tag) is not None for block in self.description.xml.findall("gazebo"))

    def find(self, element: Element | None, *paths: str) -> Element | None:
        """The first element at one of the paths below another, or None; marks it and its parents."""
        for path in paths:
            here, way = element, list[Element]()
            for step in path.split("/"):
                here = None if here is None else here.find(step)
                if here is not None:
                    way.append(here)
            if here is not None:
                self._read.update(way)
                return here
        return None

    def findall(self, element: Element, tag: str) -> list[Element]:
        """The children of an element called `tag`; marks them."""
        elements = element.findall(tag)
        self._read.update(elements)
        return elements

    def read(self, element: Element) -> Element:
        """Mark an element, but not its children."""
        self._read.add(element)
        return element

    def forget(self, element: Element) -> None:
        """Unmark an element and everything below it, so that `keep` keeps it."""
        self._read -= set(element.iter())

    def text(self, element: Element | None, *paths: str) -> str:
        """Text of the first element at one of the paths; "" if there is none."""
        match = self.find(element, *paths)
        return "" if match is None else _text_of(match)

    def number(
        self,
        element: Element | None,
        *paths: str,
        least: float = -np.inf,
        above: float = -np.inf,
    ) -> float | None:
        """A finite number at one of the paths; None if there is none, or if it is invalid.

        A number below `least` is raised to it. One that is not above `above`, and a text that is no number,
        count as not given.
        """
        match = self.find(element, *paths)
        if match is None:
            return None
        text, value = _text_of(match), np.nan
        with contextlib.suppress(ValueError):
            value = float(text)
        repair = self.description.repair
        if not np.isfinite(value):
            repair("number-unreadable", f"{match.tag} must be a finite number, not {text!r}: not used", match)
            return None
        if value < least:
            repair("number-range", f"{match.tag} {text} is below {least:g}: raised to it", match)
            return least
        if not (value > above or above == -np.inf):
            repair("number-range", f"{match.tag} {text} is not above {above:g}: not used", match)
            return None
        return value

    def figures(self, element: Element, table: Mapping[str, Figure]) -> dict[str, float]:
        """The numbers of a table that an element gives, by name."""
        read = {n: self.number(element, *f.paths, least=f.least, above=f.above) for n, f in table.items()}
        self.fields |= {e: n for n, f in table.items() if (e := self.find(element, *f.paths)) is not None}
        return {name: value for name, value in read.items() if value is not None}

    def nothing(self, element: Element | None, *paths: str) -> None:
        """Mark numbers that are 0, which have no effect; others stay unmarked."""
        for path in paths:
            text = None if element is None else element.findtext(path)
            with contextlib.suppress(ValueError):
                if float(text or "") == 0:
                    self.find(element, path)

    def flag(self, element: Element | None, *paths: str) -> bool | None:
        """A boolean at one of the paths; None if there is none, or if it is no boolean."""
        match = self.find(element, *paths)
        if match is None:
            return None
        word = _text_of(match).lower()
        if word not in ("true", "false", "1", "0"):
            text = f"{match.tag} must be true or false, not {word!r}: not used"
            self.description.repair("number-unreadable", text, match)
            return None
        return word in ("true", "1")

    def keep(self, prim_of: Callable[[str], Usd.Prim]) -> dict[str, int]:
        """Keep what is not used as text on the prims to which it refers.

        Args:
            prim_of: Returns the prim of a link or joint by its name, and the robot's for other names.

        Returns:
            Number of unmarked elements and attributes by path, such as `gazebo/sensor/visualize` or
            `limit/@jerk`, without those that are reported as unknown.
        """
        texts: dict[str, list[str]] = {}
        counts: Counter[str] = Counter()
        for owner, depth, left in self.left():
            counts["/".join((*(e.tag for e in left.way[depth:]), left.name))] += left.known
            texts.setdefault(owner, []).append(text_of(left, depth))
        for owner, kept in texts.items():
            prim = prim_of(owner)
            there = prim.GetCustomDataByKey(KEPT) or ()
            prim.SetCustomDataByKey(KEPT, Vt.StringArray([*there, *kept]))
        return {name: count for name, count in sorted(counts.items()) if count}

    def left(self) -> Iterator[tuple[str, int, Unused]]:
        """What is not used; the name of its link or joint, and the depth of the elements inside that."""
        for one in unused(self.description.xml):
            if len(one.way) > 1:
                part = one.way[1]
                yield ("", 1, one) if part.tag == "material" else (part.get("name", ""), 2, one)
            elif one.element is None:
                yield "", 1, one
            else:
                owner = one.element.get("reference", "")
                yield from ((owner, 1, left) for left in self._unread(one.element, one))

    def _unread(self, element: Element, section: Unused, *way: Element) -> Iterator[Unused]:
        """The outermost unmarked elements of a section, and the attributes that no marked one uses."""
        above = (*section.way, *way)
        if element not in self._read:
            yield Unused(above, element.tag, element, section.known)
            return
        for name in element.attrib:
            if name not in READ:
                yield Unused((*above, element), f"@{name}", None, section.known)
        for child in element:
            yield from self._unread(child, section, *way, element)


def _text_of(element: Element) -> str:
    """Text of an element, or its attribute `value`, as in `<mu1 value="1"/>`."""
    return (element.text or "").strip() or element.get("value", "").strip()


def text_of(left: Unused, depth: int) -> str:
    """The text by which `keep` keeps what is not used, with the elements that hold it from a depth on."""
    inside = "/".join(label_of(e) for e in left.way[depth:])
    value = f"{left.name[1:]}={left.way[-1].get(left.name[1:])!r}"
    text = value if left.element is None else plain_text(left.element)
    return f"{inside}: {text}" if inside else text


def label_of(element: Element) -> str:
    """Tag of an element, with its name if it has one."""
    name = element.get("name")
    return f"{element.tag}({name})" if name else element.tag
