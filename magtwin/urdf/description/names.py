"""Names: every robot, link and joint has a unique name; a second one is renamed."""

from collections.abc import Callable
from xml.etree import ElementTree

from magtwin.errors import InputError
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
    if not xml.get("name"):
        xml.set("name", source.path.name.partition(".")[0])
        repair("name-missing", f"<robot> has no name: {xml.get('name')!r}, as its file", xml)
    for kind in ("link", "joint"):
        seen: dict[str, Element] = {}
        for element in xml.findall(kind):
            name = element.get("name")
            if not name:
                raise InputError(f"{where(element)}: a <{kind}> has no name")
            kept = element if name not in seen else _renamed(source, kind, element, seen[name], repair)
            if kept is not None:
                seen[kept.attrib["name"]] = kept
    if not xml.findall("link"):
        raise InputError(f"{where(xml)}: the robot has no <link>")
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or not named.get("link"):
                raise InputError(f"{where(joint)}: joint {joint.get('name')!r} has no <{end} link=>")


def _renamed(
    source: Source, kind: str, element: Element, first: Element, repair: Callable[[str, str, Element], None]
) -> Element | None:
    """A second element of one name under a free name; None if it is removed."""
    xml, name = source.xml, element.attrib["name"]
    file, line = source.places[first]
    at = f"line {line}" if file == source.places[element][0] else f"{file.name}:{line}"
    start = f"{kind} {name!r} exists twice, first on {at}"
    if plain_text(element) == plain_text(first):
        xml.remove(element)
        repair("name-twice", f"{start}: the second is equal and left out", element)
        return None
    taken = {other.get("name") for other in xml.findall(kind)}
    free = next(f"{name}_{n}" for n in range(2, len(taken) + 3) if f"{name}_{n}" not in taken)
    if kind == "link":
        ends = [end for end in xml.findall("joint/child") if end.get("link") == name]
        if len(ends) < 2:
            raise InputError(f"{source.where(element)}: {start}; rename one")
        ends[1].set("link", free)
    element.set("name", free)
    repair("name-twice", f"{start}: the second is called {free!r}", element)
    return element
