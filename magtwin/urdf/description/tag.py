"""Tag: elements outside URDF's grammar; those that are not used are kept as text."""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from xml.etree import ElementTree

import numpy as np
from pxr import Usd, Vt

from magtwin.urdf.description.description import Description
from magtwin.urdf.description.grammar import CHILDREN
from magtwin.urdf.source.markup import plain_text

Element = ElementTree.Element

KEPT = "magtwin:unconverted"
"""Key of a prim's customData: unused tags, each as text."""

BEYOND = ("calibration", "safety_controller")
"""Elements of URDF's grammar that do not describe the body; they are read as tags."""


class Tags:
    """The tags of a description: `<gazebo>`, `<ros2_control>`, `<transmission>` and others.

    The methods below mark the elements that they read. `keep` stores all others as text on the prim to which
    they refer, and counts them.
    """

    def __init__(self, description: Description) -> None:
        self.description = description
        self._read: set[Element] = set()

    def blocks(self, tag: str) -> list[Element]:
        """Elements called `tag` directly below `<robot>`; marks them, but not their children."""
        return self.findall(self.description.xml, tag)

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
        """Keep unmarked elements as text on the prims to which they refer.

        Args:
            prim_of: Returns the prim of a link or joint by its name, and the robot's for other names.

        Returns:
            Number of unmarked elements by path, such as `gazebo/sensor/visualize`.
        """
        texts: dict[str, list[str]] = {}
        counts: Counter[str] = Counter()
        for name, element in self._foreign():
            for way, left in self._unread(element):
                counts["/".join((*(e.tag for e in way), left.tag))] += 1
                inside = "/".join(_label(e) for e in way)
                texts.setdefault(name, []).append(
                    f"{inside}: {plain_text(left)}" if inside else plain_text(left)
                )
        for name, kept in texts.items():
            prim = prim_of(name)
            there = prim.GetCustomDataByKey(KEPT) or ()
            prim.SetCustomDataByKey(KEPT, Vt.StringArray([*there, *kept]))
        return dict(sorted(counts.items()))

    def _foreign(self) -> Iterator[tuple[str, Element]]:
        """Elements outside URDF's grammar, with the name of the link or joint to which they refer."""
        for element in self.description.xml:
            if element.tag not in ("link", "joint", "material"):
                yield element.get("reference", ""), element
            elif element.tag != "material":
                known = [tag for tag in CHILDREN[element.tag] if tag not in BEYOND]
                for child in element:
                    if child.tag not in known:
                        yield element.get("name", ""), child

    def _unread(self, element: Element, *way: Element) -> Iterator[tuple[tuple[Element, ...], Element]]:
        """The outermost unmarked elements, with their parents."""
        if element not in self._read:
            yield way, element
            return
        for child in element:
            yield from self._unread(child, *way, element)


def _text_of(element: Element) -> str:
    """Text of an element, or its attribute `value`, as in `<mu1 value="1"/>`."""
    return (element.text or "").strip() or element.get("value", "").strip()


def _label(element: Element) -> str:
    """Tag of an element, with its name if it has one."""
    name = element.get("name")
    return f"{element.tag}({name})" if name else element.tag
