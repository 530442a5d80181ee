"""Gazebo: contact of links and springs of joints from `<gazebo>` tags; the table is `extensions`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from pxr import Usd, UsdPhysics

from magtwin.errors import near
from magtwin.urdf.description.extensions import SURFACE
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.options import Options


@dataclass(frozen=True)
class Surface:
    """Contact of a link's colliders."""

    friction: float = 0.5
    """Coulomb friction, static and dynamic; USD's and Gazebo's engines have different defaults."""

    restitution: float = 0.0
    """Coefficient of restitution."""

    stiffness: float | None = None
    """Contact stiffness [N/m]; None for a rigid contact."""

    damping: float | None = None
    """Contact damping [N s/m]; None for the engine's default."""


SATISFIED = ("preserveFixedJoint", "disableFixedJointLumping")
"""Tags of joints that ask for the default: fixed joints stay unless `Options.merge_fixed`."""


def read_surfaces(tags: Tags) -> dict[str, Surface]:
    """Surfaces by link, from `<gazebo reference="LINK">`.

    mu1 becomes the friction; UsdPhysics has no attribute for mu2. kp and kd become PhysX's compliant
    contact, and the bounce becomes UsdPhysics' restitution.
    """
    surfaces: dict[str, Surface] = {}
    description = tags.description
    known = {*description.links, *(joint.name for joint in description.joints.values())}
    for block in tags.blocks("gazebo"):
        link = block.get("reference", "")
        if link and link not in known:
            advice = description.repairs.suggestion(link, known, near)
            text = f"<gazebo> is about {link!r}, which is no link or joint{advice}: kept as text"
            description.repair("name-unknown", text, block)
        if link not in description.links:
            continue
        given = tags.figures(block, SURFACE)
        across = given.pop("across", None)
        if across is not None and given.setdefault("friction", across) != across:
            text = f"friction {given['friction']:g} is used across too, in place of mu2 {across:g}"
            description.note(f"link {link!r}: {text}", lost=True)
        if given:
            surfaces[link] = replace(surfaces.get(link, Surface()), **given)
    return surfaces


def self_collides(tags: Tags) -> bool:
    """Whether any link collides with its own robot; UsdPhysics' engines have one switch for all links."""
    blocks = [block for block in tags.blocks("gazebo") if tags.flag(block, "selfCollide", "self_collide")]
    if blocks:
        name = blocks[0].get("reference", "")
        tags.description.note(f"link {name!r} collides with its own robot: so do all links but neighbours")
    return bool(blocks)


def define_springs(tags: Tags, joint_of: Callable[[str], Usd.Prim | None], options: Options) -> None:
    """Author `<springStiffness>` and `<springReference>` as position drives of their joints.

    Args:
        tags: Tags of the description.
        joint_of: Returns the prim of a joint by its name, or None.
        options: Drive rules, which override springs.
    """
    names = {joint.name for joint in tags.description.joints.values()}
    for block in tags.blocks("gazebo"):
        name = block.get("reference", "")
        if name not in names:
            continue
        for tag in SATISFIED:
            tags.flag(block, tag)
        if block.find("springStiffness") is None:
            continue
        prim = joint_of(name)
        axis = next((a for a in ("angular", "linear") if prim and prim.HasAPI(UsdPhysics.DriveAPI, a)), "")
        if prim is None or not axis or any(fnmatchcase(name, rule.joints) for rule in options.drives):
            why = "a rule drives it" if axis else "it cannot move"
            tags.description.note(f"joint {name!r}: its spring is kept as text, since {why}")
            continue
        stiffness = tags.number(block, "springStiffness", least=0.0)
        rest = tags.number(block, "springReference") or 0.0
        unit = np.pi / 180 if axis == "angular" else 1.0  # gains are per degree in UsdPhysics
        drive = UsdPhysics.DriveAPI(prim, axis)
        drive.CreateStiffnessAttr(round(float(stiffness or 0.0) * unit, 9))
        drive.CreateDampingAttr(0.0)  # the damping is the joint's own, from <dynamics>
        drive.CreateTargetPositionAttr(rest / unit)
