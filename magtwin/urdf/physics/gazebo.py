"""Gazebo: what `<gazebo>` tags say of how links touch and of springs in joints.

After SDFormat's URDF extensions (sdformat.org, "SDFormat extensions to URDF").
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from pxr import Sdf, Usd, UsdPhysics

from magtwin.errors import hint
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.options import Options

RIGID_BODY_API = "PhysxRigidBodyAPI"
"""PhysX's applied schema, by name: its plugin lives elsewhere."""


@dataclass(frozen=True)
class Surface:
    """How a link's colliders touch."""

    friction: float = 0.5
    """Coulomb friction, static and sliding; USD's and Gazebo's engines differ in their own default."""

    restitution: float = 0.0
    """Part of the speed that comes back from a bounce."""

    stiffness: float | None = None
    """Stiffness of the contact [N/m]; None for as rigid as the engine makes it."""

    damping: float | None = None
    """Damping of the contact [N s/m]; None for the engine's own."""


FRICTION = ("mu1", "mu", "collision/surface/friction/ode/mu")
ACROSS = ("mu2", "collision/surface/friction/ode/mu2")
STIFFNESS = ("kp", "collision/surface/contact/ode/kp")
DAMPING = ("kd", "collision/surface/contact/ode/kd")
BOUNCE = ("collision/surface/bounce/restitution_coefficient",)
"""Where a figure may stand in `<gazebo reference="LINK">`."""

SATISFIED = ("preserveFixedJoint", "disableFixedJointLumping")
"""Tags of joints that ask for what is done anyway: fixed joints stay unless `Options.merge_fixed`."""


def read_surfaces(tags: Tags) -> dict[str, Surface]:
    """Surfaces by link, from `<gazebo reference="LINK">`.

    mu1 becomes the friction; mu2, which is that across it, has no place in UsdPhysics. kp and kd become
    PhysX's compliant contact, the bounce UsdPhysics' restitution.

    Raises:
        InputError: A figure is not a number, or below 0; the text gives the line.
    """
    surfaces: dict[str, Surface] = {}
    known = {*tags.description.links, *(joint.name for joint in tags.description.joints.values())}
    for block in tags.blocks("gazebo"):
        link = block.get("reference", "")
        if link and link not in known:
            where = tags.description.where(block).rpartition("/")[2]
            tags.description.note(
                f"{where}: <gazebo> is about {link!r}, which is no link or joint; {hint(link, known)}; "
                "kept as text",
                lost=True,
            )
        if link not in tags.description.links:
            continue
        friction = tags.number(block, *FRICTION, least=0.0)
        across = tags.number(block, *ACROSS, least=0.0)
        if across is not None and across != (across if friction is None else friction):
            tags.description.note(
                f"link {link!r}: friction {friction:g} is taken for that across it too, mu2 {across:g}",
                lost=True,
            )
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
    """Whether a link is told to touch others of its robot; one switch for all in UsdPhysics' engines."""
    asked = [
        block.get("reference", "")
        for block in tags.blocks("gazebo")
        if tags.flag(block, "selfCollide", "self_collide")
    ]
    if asked:
        tags.description.note(f"link {asked[0]!r} touches its own robot: so do all others, but neighbours")
    return bool(asked)


def define_weightless(tags: Tags, prim_of: Callable[[str], Usd.Prim]) -> None:
    """Let bodies float that are told to know no gravity, in PhysX, which alone has a switch for it."""
    for block in tags.blocks("gazebo"):
        link = block.get("reference", "")
        if link not in tags.description.links or tags.flag(block, "gravity") is not False:
            continue
        prim = prim_of(link)
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            tags.description.note(
                f"link {link!r} knows no gravity, but is part of a body that does", lost=True
            )
            continue
        prim.AddAppliedSchema(RIGID_BODY_API)
        kind = Sdf.ValueTypeNames.Bool
        prim.CreateAttribute("physxRigidBody:disableGravity", kind, custom=False).Set(True)
        tags.description.note(f"link {link!r} knows no gravity in PhysX; other engines have no such switch")


def define_springs(tags: Tags, joint_of: Callable[[str], Usd.Prim | None], options: Options) -> None:
    """Make springs of `<springStiffness>` and `<springReference>` the position drives of their joints.

    Args:
        tags: Read.
        joint_of: Gives the prim of a joint by its name; none where it has none.
        options: Its rules for drives win.

    Raises:
        InputError: A figure is not a number, or a stiffness is below 0; the text gives the line.
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
        if prim is None or not axis or _ruled(name, options):
            why = "a rule drives it" if axis else "it cannot move"
            tags.description.note(f"joint {name!r}: its spring is kept as text, since {why}")
            continue
        stiffness = tags.number(block, "springStiffness", least=0.0)
        rest = tags.number(block, "springReference") or 0.0
        unit = np.pi / 180 if axis == "angular" else 1.0  # gains are per degree in UsdPhysics
        drive = UsdPhysics.DriveAPI(prim, axis)
        drive.CreateStiffnessAttr(round(float(stiffness or 0.0) * unit, 9))
        drive.CreateDampingAttr(0.0)  # its damping is the joint's own, of <dynamics>
        drive.CreateTargetPositionAttr(rest / unit)


def _ruled(name: str, options: Options) -> bool:
    rules: Iterable[str] = (rule.joints for rule in options.drives)
    return any(fnmatchcase(name, pattern) for pattern in rules)
