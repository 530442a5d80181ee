"""Link: a rigid body with its mass, or a frame that only marks a place."""

from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.names import RefusedError
from magtwin.usd.urdf.description import Description, origin_of
from magtwin.usd.urdf.inertia import principal_axes

LINK_API, SITE_API = "IsaacLinkAPI", "IsaacSiteAPI"
"""Isaac Sim's applied schemas, by name: their plugins live in Omniverse, not here."""


def is_marker(link: Any) -> bool:
    """Whether a link only names a place: it has neither mass nor shape."""
    return link.inertial is None and not link.visuals and not link.collisions


def define_body(prim: Usd.Prim, link: Any, description: Description) -> Usd.Prim:
    """Make an Xform the rigid body of a link, with mass, centre and principal inertia.

    Raises:
        RefusedError: The mass is not above 0, or no body has such an inertia; the text gives the line.
    """
    prim.AddAppliedSchema(LINK_API)
    UsdPhysics.RigidBodyAPI.Apply(prim).CreateRigidBodyEnabledAttr(True)
    inertial = link.inertial
    if inertial is None:
        description.note(f"link {link.name!r} has no <inertial>: engines take its mass from its colliders")
        return prim
    if inertial.mass is None or not (np.isfinite(inertial.mass) and inertial.mass > 0):
        raise description.refused("link", link.name, f"has a mass of {inertial.mass!r} kg; give one above 0")
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(float(inertial.mass))
    pose = origin_of(inertial)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*(round(float(v), 12) for v in pose[:3, 3])))
    if inertial.inertia is None:
        description.note(f"link {link.name!r} has no <inertia>: engines take it from its colliders")
        return prim
    turned = pose[:3, :3] @ inertial.inertia @ pose[:3, :3].T  # from the inertial's axes to the link's
    turned[np.abs(turned) < 1e-9 * np.abs(turned).max()] = 0.0
    try:
        moments, q, repaired = principal_axes(turned)
    except RefusedError as error:
        raise description.refused("link", link.name, f"has an impossible inertia: {error}") from error
    if repaired:
        description.note(
            f"link {link.name!r}: its largest moment of inertia exceeded the sum of the others; "
            "brought down to it"
        )
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, moments)))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*(round(float(v), 7) + 0.0 for v in wxyz_from_xyzw(q))))
    return prim


def define_frame(prim: Usd.Prim) -> Usd.Prim:
    """Make an Xform a site: a named frame on the body that it lies under."""
    prim.AddAppliedSchema(SITE_API)
    return prim
