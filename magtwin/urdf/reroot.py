"""Reroot: a URDF told from another link down."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.urdf.source.markup import parse_markup
from magtwin.urdf.write import write_origin


def reroot(text: str, base: str, path: Path) -> str:
    """A description whose root is `base`: frames that were above it, such as base_footprint, hang below it.

    Who publishes where `base` is in odom leaves it no other parent (REP 105), and robot_state_publisher makes
    one of each joint. Only fixed joints are turned round: T_child_parent = T_parent_child^-1.

    Args:
        text: The URDF.
        base: Name of a link.
        path: Where it was read, for refusals.

    Returns:
        The text as it is, where `base` is its root already, is none of its links, or moves on a joint.

    Raises:
        InputError: It is not XML, could not be read safely, or a place in it is none.
    """
    tree = parse_markup(text.encode("utf-8"), path).root
    above = {
        child.get("link"): (joint, parent, child)
        for joint in tree.findall("joint")
        if (parent := joint.find("parent")) is not None and (child := joint.find("child")) is not None
    }
    chain, link = list[tuple[ElementTree.Element, ...]](), base
    while (found := above.get(link)) is not None:
        if found in chain or found[0].get("type") != "fixed":
            return text
        chain.append(found)
        link = found[1].get("link", "")
    if not chain:
        return text
    for joint, parent, child in chain:
        parent.attrib, child.attrib = child.attrib, parent.attrib
        origin = joint.find("origin")
        if origin is None:
            continue
        T = np.eye(4)
        try:
            xyz, rpy = (np.array(origin.get(name, "0 0 0").split(), float) for name in ("xyz", "rpy"))
            T[:3, :3], T[:3, 3] = matrix_from_quat(quat_from_rpy(rpy)), xyz
        except ValueError as error:
            raise InputError(f"{path}: joint {joint.get('name')!r} has no place: {error}") from error
        joint.remove(origin)
        write_origin(joint, np.linalg.inv(T).astype(np.float64))
    return ElementTree.tostring(tree, encoding="unicode", xml_declaration=False)
