"""Link: a rigid body with its mass, or a frame without mass and shape."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Link
from magtwin.urdf.physics.inertia import (
    WATER,
    MassProperties,
    ball_of,
    combined,
    nearest_possible,
    principal_axes,
    read_solid,
)

MASSLESS_KG = 0.001
"""Mass of a body without colliders whose links have none [kg]. Engines would give it 1 kg."""

THICKER = 5e-7
"""The largest moment of a body with turned axes is below the sum of the others by at least this part."""

LINK_API, SITE_API = "IsaacLinkAPI", "IsaacSiteAPI"
"""Isaac Sim's applied schemas; their plugins are not installed here."""


@dataclass(frozen=True)
class Rider:
    """A link that is a body or part of one."""

    link: Link

    pose: NDArray[np.float64]
    """Pose of the link in the body, shape (4, 4)."""

    colliders: list[Usd.Prim] = field(default_factory=list)
    """Its colliders below the body's prim."""

    visuals: list[Usd.Prim] = field(default_factory=list)
    """Its visuals below the body's prim."""


def is_marker(link: Link) -> bool:
    """Whether a link is only a frame, without mass and shape."""
    return link.inertial is None and not link.visuals and not link.collisions


def define_body(
    prim: Usd.Prim, parts: Sequence[Rider], description: Description, density: float = WATER
) -> dict[str, MassProperties]:
    """Make an Xform a rigid body with the total mass, centre and principal inertia of its links.

    A body of links without mass gets that of its shapes at a density, see `_filled`, or else `MASSLESS_KG`.

    Args:
        prim: The Xform, with its shapes below it.
        parts: The body's own link, and links merged into it.
        description: Receives notes of repairs and guesses.
        density: Density of links without mass [kg/m3].

    Returns:
        Mass properties, in the body's frame, of the links that were filled, by name.
    """
    prim.AddAppliedSchema(LINK_API)
    UsdPhysics.RigidBodyAPI.Apply(prim).CreateRigidBodyEnabledAttr(True)
    parts = [part for part in parts if part is parts[0] or not is_marker(part.link)]
    known = [_mass_properties(part, prim, description) for part in parts if part.link.inertial is not None]
    filled: dict[str, MassProperties] = {}
    for part in () if known else parts:
        solid = _filled(part, prim, description, density)
        filled |= {} if solid is None else {part.link.name: solid}
    known = known or list(filled.values()) or [_massless(parts[0], prim, description)]
    whole = known[0] if len(known) == 1 else combined(known)
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(whole.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*(round(float(v), 12) + 0.0 for v in whole.centre)))
    tensor = whole.inertia.copy()
    tensor[np.abs(tensor) < 1e-9 * np.abs(tensor).max()] = 0.0
    moments, q = principal_axes(tensor)
    mass.CreateDiagonalInertiaAttr(_single(moments, turned=abs(q[3]) < 1))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*(round(float(v), 7) + 0.0 for v in wxyz_from_xyzw(q))))
    return filled


def _single(moments: NDArray, *, turned: bool) -> Gf.Vec3f:
    """Principal moments in single precision, where none may exceed the sum of the others either.

    Engines turn them to a tensor in single precision and back, so a flat body with turned axes is made
    thicker by `THICKER`, and a needle first: its two large moments are both near the sum of the others.
    """
    rounded = np.asarray(moments, np.float32)
    rounded = np.maximum(rounded, np.float32(3 * THICKER * turned) * rounded.max())
    largest = int(np.argmax(rounded))
    others = sum(float(rounded[i]) for i in range(3) if i != largest)
    while float(rounded[largest]) > others * (1 - THICKER * turned):
        rounded[largest] = np.nextafter(rounded[largest], np.float32(0))
    return Gf.Vec3f(*map(float, rounded))


def _mass_properties(part: Rider, body: Usd.Prim, description: Description) -> MassProperties:
    """Mass properties of a link with an `<inertial>` in its body's frame."""
    link, inertial = part.link, part.link.inertial
    assert inertial is not None
    assert inertial.mass is not None  # the grammar leaves out an <inertial> without one
    mass, centre = float(inertial.mass), (part.pose @ origin_of(inertial))[:3, 3]
    about, start = ("link", link.name), f"link {link.name!r}"
    tensor = None if inertial.inertia is None else _turned(inertial.inertia, origin_of(inertial))
    nearest = None if tensor is None else nearest_possible(tensor)
    if tensor is not None and nearest is not tensor:
        moments = ", ".join(f"{m:.3g}" for m in np.linalg.eigvalsh(tensor))
        done = "the nearest possible tensor is used" if nearest is not None else "it counts as none"
        text = f"{start}: no body has principal moments of inertia {moments} kg m2: {done}"
        description.repair("inertia-impossible", text, about)
    if nearest is not None:
        return MassProperties(mass, centre, part.pose[:3, :3] @ nearest @ part.pose[:3, :3].T)
    used, solid = "its colliders", read_solid(part.colliders, body)
    if solid is None:
        used, solid = "its visuals", read_solid(part.visuals, body)
    if solid is None:
        used, solid = "a ball of water", ball_of(mass)
    text = f"{start} has no <inertia>: that of {used}, filled evenly with its {mass:g} kg"
    description.repair("inertia-missing", text, about)
    return MassProperties(mass, centre, mass / solid.mass * solid.inertia)


def _filled(part: Rider, body: Usd.Prim, description: Description, density: float) -> MassProperties | None:
    """Mass properties of a link without `<inertial>`: its colliders at a density, or else its visuals.

    Engines fill colliders too. Visuals are filled only where no link of the robot has an `<inertial>`.
    """
    bare = all(link.inertial is None for link in description.links.values())
    for what, shapes in ("colliders", part.colliders), ("visuals", part.visuals if bare else []):
        solid = read_solid(shapes, body)
        if solid is not None:
            mass, name = density * solid.mass, part.link.name
            description.note(
                f"link {name!r} has no <inertial>: {mass:.3g} kg, its {what} at {density:g} kg/m3"
            )
            return MassProperties(mass, solid.centre, density * solid.inertia)
    return None


def _massless(part: Rider, body: Usd.Prim, description: Description) -> MassProperties:
    """Mass properties of a body whose links have no mass: `MASSLESS_KG`, spread over its visuals."""
    kg = MASSLESS_KG
    description.note(f"link {part.link.name!r} has no <inertial>: {kg:g} kg, so that engines add none")
    solid = read_solid(part.visuals, body) or ball_of(kg)
    return MassProperties(kg, solid.centre, kg / solid.mass * solid.inertia)


def _turned(inertia: NDArray, origin: NDArray) -> NDArray[np.float64]:
    """A tensor (3, 3) at an `origin` (4, 4) in its link's axes, without rounding errors off its diagonal."""
    turned = origin[:3, :3] @ np.asarray(inertia, float) @ origin[:3, :3].T
    return np.where(np.abs(turned) < 1e-9 * np.abs(turned).max(), 0.0, turned)
