"""Kinematics: link poses of a description by yourdfpy, independent of the conversion."""

import io
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.urdf.description.description import MOVING, Description, origin_of, read_description
from magtwin.urdf.description.grammar import check_grammar
from magtwin.urdf.description.model import rpy_of
from magtwin.urdf.source.source import read_source


def link_poses(
    urdf: str | os.PathLike[str],
    positions: Mapping[str, float] = MappingProxyType({}),
    *,
    packages: Mapping[str, Path] = MappingProxyType({}),
    arguments: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, NDArray[np.float64]]:
    """Forward kinematics of a URDF or xacro, to check a converted stage or a sensor's mount.

    Args:
        urdf: The description.
        positions: Positions of joints by name [rad or m]. Default: 0. Mimicking joints follow.
        packages: Folders of packages by name, for a xacro.
        arguments: Arguments of a xacro.

    Returns:
        T_root_link of each link, shape (4, 4), parents before children.

    Raises:
        InputError: The description cannot be used; or a joint is unknown, follows another, or does not have
            a single position.
    """
    import yourdfpy  # takes longer to import than most robots to convert

    description = read_description(read_source(urdf, packages=packages, arguments=arguments))
    values = _values(description, positions)
    bare = ElementTree.Element("robot", name=description.name)
    joints = {joint.name: joint for joint in description.joints.values()}
    for part in description.xml:
        if part.tag == "link":
            ElementTree.SubElement(bare, "link", name=part.attrib["name"])
        elif part.tag == "joint" and part.get("name") in joints:
            bare.append(check_grammar(part, description.where, description.repair))
            for mimic in bare[-1].findall("mimic"):  # yourdfpy does not support a mimic of a mimic
                bare[-1].remove(mimic)
            for origin in bare[-1].findall("origin[@quat_xyzw]"):  # nor a quaternion
                R = origin_of(joints[part.attrib["name"]])[:3, :3]
                origin.set("rpy", " ".join(map(repr, rpy_of(R))))
    model = yourdfpy.URDF.load(io.BytesIO(ElementTree.tostring(bare)), load_meshes=False)
    for joint in description.joints.values():
        if joint.type == "prismatic":  # yourdfpy does not normalise the axis
            values[joint.name] /= float(np.linalg.norm(joint.axis))
    model.update_cfg(values)
    return {link: model.get_transform(link, description.root) for link in description.links}


def _values(description: Description, positions: Mapping[str, float]) -> dict[str, float]:
    """Positions of all joints with one degree of freedom, including those that follow others."""
    joints = {joint.name: joint for joint in description.joints.values() if joint.type in MOVING}
    for name in positions:
        mimic = find("joint with one position", name, joints).mimic
        if mimic is not None:
            raise InputError(f"{description.path}: joint {name!r} follows {mimic.joint!r}; give that one's")

    def value(name: str) -> float:
        mimic = joints[name].mimic
        if mimic is None:
            return float(positions.get(name, 0.0))
        return mimic.multiplier * value(mimic.joint) + mimic.offset

    return {name: value(name) for name in joints}
