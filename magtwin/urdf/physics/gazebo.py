"""Gazebo: contact of links and springs of joints from `<gazebo>` tags.

Follows SDFormat's URDF extensions (sdformat.org, "SDFormat extensions to URDF").
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from pxr import Sdf, Usd, UsdPhysics

from magtwin.errors import near
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.options import Options

RIGID_BODY_API = "PhysxRigidBodyAPI"
"""PhysX's applied schema; its plugin is not installed here."""


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


FRICTION = ("mu1", "mu", "collision/surface/friction/ode/mu")
ACROSS = ("mu2", "collision/surface/friction/ode/mu2")
STIFFNESS = ("kp", "collision/surface/contact/ode/kp")
DAMPING = ("kd", "collision/surface/contact/ode/kd")
BOUNCE = ("collision/surface/bounce/restitution_coefficient",)
"""Paths of each value in `<gazebo reference="LINK">`."""

SATISFIED = ("preserveFixedJoint", "disableFixedJointLumping")
"""Tags of joints that ask for the default: fixed joints stay unless `Options.merge_fixed`."""


def read_surfaces(tags: Tags) -> dict[str, Surface]:
    """Surfaces by link, from `<gazebo reference="LINK">`.

    mu1 becomes the friction; UsdPhysics has no attribute for mu2. kp and kd become PhysX's compliant
    contact, and the bounce becomes UsdPhysics' restitution.

    Raises:
        InputError: A value is not a number, or is below 0; the message gives the line.
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
        friction = tags.number(block, *FRICTION, least=0.0)
        across = tags.number(block, *ACROSS, least=0.0)
        if across is not None and across != (across if friction is None else friction):
            text = f"link {link!r}: friction {friction:g} is used across too, in place of mu2 {across:g}"
            description.note(text, lost=True)
        figures = {
            "friction": across if friction is None else friction,
            "restitution": tags.number(block, *BOUNCE, least=0.0),
            "stiffness": tags.number(block, *STIFFNESS, least=0.0),
            "damping": tags.number(block, *DAMPING, least=0.0),
        }
        given = {name: value for name, value in figures.items() if value is not None}
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


def define_weightless(tags: Tags, prim_of: Callable[[str], Usd.Prim]) -> None:
    """Disable gravity for links with `<gravity>false`, in PhysX, the only engine with a switch for it."""
    for block in tags.blocks("gazebo"):
        link = block.get("reference", "")
        if link not in tags.description.links or tags.flag(block, "gravity") is not False:
            continue
        prim = prim_of(link)
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            tags.description.note(
                f"link {link!r} has no gravity, but is part of a body with gravity", lost=True
            )
            continue
        prim.AddAppliedSchema(RIGID_BODY_API)
        kind = Sdf.ValueTypeNames.Bool
        prim.CreateAttribute("physxRigidBody:disableGravity", kind, custom=False).Set(True)
        tags.description.note(f"link {link!r} has no gravity in PhysX; other engines have no such switch")


def define_springs(tags: Tags, joint_of: Callable[[str], Usd.Prim | None], options: Options) -> None:
    """Author `<springStiffness>` and `<springReference>` as position drives of their joints.

    Args:
        tags: Tags of the description.
        joint_of: Returns the prim of a joint by its name, or None.
        options: Drive rules, which override springs.

    Raises:
        InputError: A value is not a number, or a stiffness is below 0; the message gives the line.
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
