"""Mass: what a USD physics engine computes as the mass of each body."""

from pxr import Gf, Sdf, Usd, UsdPhysics

from magtwin.frames import wxyz_from_xyzw
from magtwin.urdf.physics.inertia import principal_axes, read_solid


def engine_masses(stage: Usd.Stage) -> dict[Sdf.Path, float]:
    """Mass of each rigid body as UsdPhysics defines it [kg].

    The first of these that is above 0 holds: the mass of the body, its density times the volume of its
    colliders, the masses and densities of its colliders, and 1000 kg/m3.

    Args:
        stage: Stage in kilograms and metres.
    """
    return {
        prim.GetPath(): _mass(prim)
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
        if prim.HasAPI(UsdPhysics.RigidBodyAPI)
    }


def _mass(body: Usd.Prim) -> float:
    """Mass of a body [kg]: its own, or else what USD's own implementation computes from its colliders."""
    own = UsdPhysics.MassAPI(body).GetMassAttr().Get() if body.HasAPI(UsdPhysics.MassAPI) else None
    if own:
        return float(own)

    def information(collider: Usd.Prim) -> UsdPhysics.RigidBodyAPI.MassInformation:
        told, solid = UsdPhysics.RigidBodyAPI.MassInformation(), read_solid([collider], body)
        told.volume, told.inertia = 0.0, Gf.Matrix3f(1.0)
        told.centerOfMass, told.localPos, told.localRot = Gf.Vec3f(0), Gf.Vec3f(0), Gf.Quatf(1)
        if solid is not None:
            moments, q = principal_axes(solid.inertia)
            told.volume, told.inertia = solid.mass, Gf.Matrix3f(Gf.Vec3f(*map(float, moments)))
            told.localPos = Gf.Vec3f(*map(float, solid.centre))
            told.localRot = Gf.Quatf(*map(float, wxyz_from_xyzw(q)))
        return told

    mass = UsdPhysics.RigidBodyAPI(body).ComputeMassProperties(information)[0]
    return float(mass)
