"""Names: every robot, link and joint has a unique name; a second one is renamed."""

from collections.abc import Callable
from xml.etree import ElementTree

from magtwin.errors import InputError
from magtwin.files.budget import check_count
from magtwin.urdf.source.markup import plain_text
from magtwin.urdf.source.source import Source

Element = ElementTree.Element


def check_names(source: Source, repair: Callable[[str, str, Element], None]) -> None:
    """Give every link and joint a unique name.

    A second element that is equal to the first is removed. A second joint is renamed. A second link is
    renamed if a second joint holds a link of this name; that joint then holds it.

    Args:
        source: The description, whose XML is changed.
        repair: Receives every repair.

    Raises:
        InputError: A name is missing, or nothing tells which of two links a joint holds. The message gives
            the line.
    """
    xml, where = source.xml, source.where
    for path in ("link", "joint", "link/visual", "link/collision"):
        count = sum(1 for _ in xml.iterfind(path))
        check_count(where(xml), "URDF", count, f"{path.rpartition('/')[2]}s")
    if not xml.get("name"):
        xml.set("name", source.path.name.partition(".")[0])
        repair("name-missing", f"<robot> has no name: {xml.get('name')!r}, as its file", xml)
    for kind in ("link", "joint"):
        names = _Names(source, kind, repair)
        for element in xml.findall(kind):
            if not element.get("name"):
                raise InputError(f"{where(element)}: a <{kind}> has no name")
            names.keep(element)
        xml[:] = [part for part in xml if part not in names.removed]
    if not xml.findall("link"):
        raise InputError(f"{where(xml)}: the robot has no <link>")
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or not named.get("link"):
                raise InputError(f"{where(joint)}: joint {joint.get('name')!r} has no <{end} link=>")


class _Names:
    """The names of all links, or of all joints."""

    def __init__(self, source: Source, kind: str, repair: Callable[[str, str, Element], None]) -> None:
        self.removed: set[Element] = set()
        """Elements that are equal to one before."""
        self._source, self._kind, self._repair = source, kind, repair
        self._taken = {element.get("name") for element in source.xml.findall(kind)}
        self._first: dict[str, Element] = {}
        self._texts: dict[str, str] = {}  # of the first elements of names that are used twice
        self._next: dict[str, int] = {}  # number to try next for each name
        self._ends: dict[str | None, list[Element]] = {}  # <child> of the joints that hold each link
        for end in source.xml.iterfind("joint/child"):
            self._ends.setdefault(end.get("link"), []).append(end)

    def keep(self, element: Element) -> None:
        """Keep an element under its name if it is the first of it, else under a free one, or remove it."""
        name = element.attrib["name"]
        first = self._first.setdefault(name, element)
        if first is element:
            return
        source, kind = self._source, self._kind
        file, line = source.places[first]
        at = f"line {line}" if file == source.places[element][0] else f"{file.name}:{line}"
        start = f"{kind} {name!r} exists twice, first on {at}"
        if name not in self._texts:
            self._texts[name] = plain_text(first)
        if plain_text(element) == self._texts[name]:
            self.removed.add(element)
            self._repair("name-twice", f"{start}: the second is equal and left out", element)
            return
        number = self._next.get(name, 2)
        while f"{name}_{number}" in self._taken:
            number += 1
        free, self._next[name] = f"{name}_{number}", number + 1
        if kind == "link":
            ends = self._ends.get(name, [])
            if len(ends) < 2:
                raise InputError(f"{source.where(element)}: {start}; rename one")
            ends.pop(1).set("link", free)
        element.set("name", free)
        self._taken.add(free)
        self._first[free] = element
        self._repair("name-twice", f"{start}: the second is called {free!r}", element)
