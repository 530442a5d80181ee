"""Names: every robot, link and joint has a name of its own."""

import re
from collections.abc import Callable
from xml.etree import ElementTree

from magtwin.errors import InputError
from magtwin.files.budget import check_count
from magtwin.urdf.source.markup import plain_text
from magtwin.urdf.source.source import Source

Element = ElementTree.Element


def check_names(source: Source, repair: Callable[[str, str, Element], None]) -> None:
    """Check that every link and joint has a name of its own; a second one that is equal is removed.

    Args:
        source: The description, whose XML is changed.
        repair: Receives every repair.

    Raises:
        InputError: A name is missing, or two different elements have one. The message gives the line.
    """
    xml, where = source.xml, source.where
    for path in ("link", "joint", "link/visual", "link/collision"):
        count = sum(1 for _ in xml.iterfind(path))
        check_count(where(xml), "URDF", count, f"{path.rpartition('/')[2]}s")
    if not xml.get("name"):
        xml.set("name", source.path.name.partition(".")[0])
        repair("name-missing", f"<robot> has no name: {xml.get('name')!r}, as its file", xml)
    for kind in ("link", "joint"):
        first: dict[str, Element] = {}
        for element in xml.findall(kind):
            name = element.get("name")
            if not name:
                raise InputError(f"{where(element)}: a <{kind}> has no name")
            twin = first.setdefault(name, element)
            if twin is element:
                continue
            text = f"{kind} {name!r} exists twice, first at {where(twin).rpartition('/')[2]}"
            if plain_text(element) != plain_text(twin):
                raise InputError(f"{where(element)}: {text}; rename one")
            repair("name-twice", f"{text}: the second is equal and left out", element)
            xml.remove(element)
    if not xml.findall("link"):
        text = source.path.read_text(encoding="utf-8", errors="replace")
        macros = ", ".join(re.findall(r"<xacro:macro[^>]*?\bname=[\"']([^\"']+)", text))
        advice = f"; it has macros only: {macros}; convert a file that calls one" if macros else ""
        raise InputError(f"{where(xml)}: the robot has no <link>{advice}")
    for joint in xml.findall("joint"):
        for end in ("parent", "child"):
            named = joint.find(end)
            if named is None or not named.get("link"):
                raise InputError(f"{where(joint)}: joint {joint.get('name')!r} has no <{end} link=>")
