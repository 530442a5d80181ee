"""Reroot: a URDF with another root link."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from magtwin.errors import InputError
from magtwin.urdf.description.model import read_origin
from magtwin.urdf.source.markup import parse_markup
from magtwin.urdf.write import write_origin


def reroot(text: str, base: str, path: Path) -> str:
    """Make `base` the root of a URDF; frames above it, such as base_footprint, move below it.

    A frame has one parent (REP 105). If odometry publishes `base` in odom, no joint above `base` may publish
    it too. Only fixed joints are inverted: T_child_parent = T_parent_child^-1.

    Args:
        text: The URDF.
        base: Name of a link.
        path: File of the text, for error messages.

    Returns:
        The URDF; unchanged if `base` is the root, is not a link, or is on a joint that moves.

    Raises:
        InputError: The text is not safe XML, or an origin is invalid.
    """
    tree = parse_markup(text.encode("utf-8"), path).root
    above = {
        child.get("link"): (joint, parent, child)
        for joint in tree.findall("joint")
        if (parent := joint.find("parent")) is not None and (child := joint.find("child")) is not None
    }
    chain, link = list[tuple[ElementTree.Element, ...]](), base
    while (match := above.get(link)) is not None:
        if match in chain or match[0].get("type") != "fixed":
            return text
        chain.append(match)
        link = match[1].get("link", "")
    if not chain:
        return text
    for joint, parent, child in chain:
        parent.attrib, child.attrib = child.attrib, parent.attrib
        origin = joint.find("origin")
        try:
            T = read_origin(origin)
        except ValueError as error:
            raise InputError(f"{path}: joint {joint.get('name')!r} has an invalid origin: {error}") from error
        if origin is None or T is None:
            continue
        joint.remove(origin)
        write_origin(joint, np.linalg.inv(T).astype(np.float64))
    return ElementTree.tostring(tree, encoding="unicode", xml_declaration=False)
