"""Shape: visuals and colliders of a link, as gprims in its frame."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from magtwin.usd.sensors import write_pose
from magtwin.usd.urdf.description import Description, origin_of
from magtwin.usd.urdf.gazebo import Surface
from magtwin.usd.urdf.inertia import quaternion
from magtwin.usd.urdf.material import GREY, define_grip, define_look, wear
from magtwin.usd.urdf.mesh import Rgba
from magtwin.usd.urdf.mesh_layer import Form, MeshLayer

VISUALS, COLLISIONS = "visuals", "collisions"
"""Xforms below a link's prim."""

COLLIDER_FORM: Form = "hull"
"""What of a mesh collides."""

NEWTON_MESH_API = "NewtonMeshCollisionAPI"
"""Newton's applied schema, by name: its plugin lives elsewhere."""


def define_visual(
    body: Usd.Prim, visual: Any, description: Description, meshes: MeshLayer, layer: str
) -> list[Usd.Prim]:
    """The gprims of a URDF `<visual>`: one, or one a colour of its mesh, each with its look.

    Args:
        body: Prim of the link, a child of the robot's.
        visual: yourdfpy's visual.
        description: Where the robot's materials stand.
        meshes: Where the mesh's triangles stand.
        layer: Asset path of the exported mesh layer.
    """
    name, given = _material(visual, description)
    made = []
    for gprim, colour in _define(body, VISUALS, visual, meshes, layer, form_of(visual, description)):
        wear(gprim, define_look(body.GetParent(), given or colour or GREY, name))
        made.append(gprim)
    return made


def define_collider(
    body: Usd.Prim, collision: Any, surface: Surface, meshes: MeshLayer, layer: str
) -> list[Usd.Prim]:
    """The collider of a URDF `<collision>`: its primitive, or the convex hull of its mesh.

    It is of purpose guide, so that no viewer shows it unasked. Other args as for `define_visual`.
    """
    made = []
    for gprim, _ in _define(body, COLLISIONS, collision, meshes, layer, COLLIDER_FORM):
        UsdGeom.Imageable(gprim).CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(gprim).CreateCollisionEnabledAttr(True)
        if gprim.IsA(UsdGeom.Mesh):
            UsdPhysics.MeshCollisionAPI.Apply(gprim).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
            gprim.AddAppliedSchema(NEWTON_MESH_API)
        wear(gprim, define_look(body.GetParent(), GREY), define_grip(body.GetParent(), surface))
        made.append(gprim)
    return made


def form_of(visual: Any, description: Description) -> Form:
    """Whether a visual's mesh comes in its own colours, or whole because the URDF's material covers it."""
    return "parts" if _material(visual, description)[1] is None else "whole"


def _material(visual: Any, description: Description) -> tuple[str, Rgba | None]:
    """Name and colour of a visual's material: its own, or the robot's of that name."""
    material = visual.material
    if material is None:
        return "", None
    shared = description.materials.get(material.name)
    colour = material.color or (shared.color if shared else None)
    if material.texture is not None or (shared is not None and shared.texture is not None):
        description.note(f"material {material.name!r}: its texture is not converted")
    if colour is None:
        return "", None
    r, g, b, a = (float(c) for c in colour.rgba)
    return material.name or "", (r, g, b, a)


def _define(
    body: Usd.Prim, scope: str, shape: Any, meshes: MeshLayer, layer: str, form: Form
) -> list[tuple[Usd.Prim, Rgba | None]]:
    """Prims of a geometry, with the colours that its file gives."""
    stage, geometry = body.GetStage(), shape.geometry
    parent = UsdGeom.Xform.Define(stage, body.GetPath().AppendChild(scope)).GetPrim()
    pose = origin_of(shape)
    if geometry.mesh is not None:
        made = []
        for entry in meshes.add(geometry.mesh, form):
            prim = stage.DefinePrim(_free(parent, shape.name or entry.path.name), "Mesh")
            prim.GetReferences().AddReference(layer, entry.path)
            _place(prim, pose)
            made.append((prim, entry.colour))
        return made
    if geometry.box is not None:
        prim = UsdGeom.Cube.Define(stage, _free(parent, shape.name or "box")).GetPrim()
        UsdGeom.Cube(prim).CreateSizeAttr(1.0)
        _place(prim, pose, scale=np.asarray(geometry.box.size, float))
    elif geometry.cylinder is not None:
        prim = UsdGeom.Cylinder.Define(stage, _free(parent, shape.name or "cylinder")).GetPrim()
        UsdGeom.Cylinder(prim).CreateRadiusAttr(geometry.cylinder.radius)
        UsdGeom.Cylinder(prim).CreateHeightAttr(geometry.cylinder.length)
        UsdGeom.Cylinder(prim).CreateAxisAttr(UsdGeom.Tokens.z)
        _place(prim, pose)
    else:
        prim = UsdGeom.Sphere.Define(stage, _free(parent, shape.name or "sphere")).GetPrim()
        UsdGeom.Sphere(prim).CreateRadiusAttr(geometry.sphere.radius)
        _place(prim, pose)
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    UsdGeom.Boundable(prim).CreateExtentAttr(extent)
    return [(prim, None)]


def _free(parent: Usd.Prim, name: str) -> Sdf.Path:
    """Path of a child that is not there yet, called `name` if that is free."""
    name = Tf.MakeValidIdentifier(name)
    taken = {child.GetName() for child in parent.GetChildren()}
    unique = next(n for n in [name, *(f"{name}_{i}" for i in range(2, 10_000))] if n not in taken)
    return parent.GetPath().AppendChild(unique)


def _place(prim: Usd.Prim, pose: NDArray, scale: NDArray | None = None) -> None:
    """Put a gprim at a pose (4, 4) in its link, stretched by `scale` first."""
    p, q = pose_of(pose)
    write_pose(prim, p, q)
    if scale is not None:
        UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(*scale))


def pose_of(T: NDArray) -> tuple[tuple[float, float, float], tuple[float, float, float, float] | None]:
    """Position and quaternion xyzw of a transform (4, 4); no quaternion where it does not turn.

    Rounded to 1e-12, so that the text shows 0 where the arithmetic left 1e-17.
    """
    x, y, z = (round(float(v), 12) + 0.0 for v in T[:3, 3])
    if np.allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-12):
        return (x, y, z), None
    i, j, k, w = (round(float(v), 12) + 0.0 for v in quaternion(T[:3, :3]))
    return (x, y, z), (i, j, k, w)
