"""Gazebo: contact of links from `<gazebo>` tags; the table is `extensions`."""

from dataclasses import dataclass, replace

from magtwin.errors import near
from magtwin.urdf.description.extensions import SURFACE
from magtwin.urdf.description.tag import Tags


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
            for tag in SATISFIED if link else ():
                tags.flag(block, tag)
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
