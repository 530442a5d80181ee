"""Shape: visuals and colliders of a link, as gprims in its frame.

Materials follow RViz (robot_link.cpp): those of a mesh file win, part by part. The visual's URDF material
applies to the other parts, such as all of an STL. The rest is GREY.
"""

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Shape
from magtwin.urdf.material import define_grip, define_look, define_priority, wear
from magtwin.urdf.meshes.mesh_layer import MESH, Entry, MeshLayer, free_child
from magtwin.urdf.meshes.piece import PLAIN, Paint
from magtwin.urdf.meshes.reading import Images, Reading
from magtwin.urdf.meshes.texture import Image, read_image
from magtwin.urdf.physics.gazebo import Surface
from magtwin.urdf.physics.inertia import quaternion
from magtwin.urdf.source.package import MissingFileError
from magtwin.usd.attributes import write_pose

VISUALS, COLLISIONS = "visuals", "collisions"
"""Xforms below a link's prim."""

NO_CONTACT, NO_CONTACT_RADIUS_M = "no_contact", 0.005
"""Name and radius of the disabled collider of a body that touches nothing."""

NEWTON_MESH_API = "NewtonMeshCollisionAPI"
"""Newton's applied schema; its plugin is not installed here."""

NEWTON_HULL = "newton:maxHullVertices"
"""Its limit on the vertices of a hull; -1 for none. Newton cuts hulls without it to 64, and so lost
the casters of a Fetch, which are part of its base."""


def define_visual(
    body: Usd.Prim, visual: Shape, description: Description, meshes: MeshLayer, layer: str
) -> Usd.Prim:
    """Author a URDF `<visual>`: a mesh with its look, or an Xform over one.

    Args:
        body: Prim of the link, a child of the robot's prim.
        visual: The visual.
        description: The description, with the robot's materials.
        meshes: Meshes of the robot.
        layer: Asset path of the exported mesh layer.
    """
    paint = _paint_of(visual, description, meshes.images)
    if visual.geometry.kind != "mesh":
        path = _path(body, VISUALS, visual.name or visual.geometry.kind)
        prim = body.GetStage().DefinePrim(path, "Mesh")
        prim.GetReferences().AddReference(layer, meshes.primitive(visual.geometry))
        _place(prim, origin_of(visual))
        wear(prim, body.GetParent(), _plain(paint, "a primitive", description), meshes)
        return prim
    entry = meshes.visual(visual.geometry)
    if not entry.textured:
        paint = _plain(paint, f"mesh {visual.geometry.filename!r} without texture coordinates", description)
    return _define_mesh(body, visual, entry, paint, meshes, layer)


def define_collider(
    body: Usd.Prim, collision: Shape, surface: Surface, meshes: MeshLayer, layer: str
) -> Usd.Prim:
    """Author a URDF `<collision>`: its primitive, or the hull of its mesh.

    The prim has purpose guide, so that viewers hide it by default. Arguments as for `define_visual`.
    """
    is_mesh = collision.geometry.kind == "mesh"
    if is_mesh:
        path = meshes.collider(collision.geometry)
        prim = body.GetStage().DefinePrim(_path(body, COLLISIONS, collision.name or path.name), "Mesh")
        prim.GetReferences().AddReference(layer, path)
        _place(prim, origin_of(collision))
    else:
        prim = _define_primitive(body, collision)
    UsdGeom.Imageable(prim).CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(prim).CreateCollisionEnabledAttr(True)
    if is_mesh:
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr("convexHull")
        prim.AddAppliedSchema(NEWTON_MESH_API)
        kind, fixed = Sdf.ValueTypeNames.Int, Sdf.VariabilityUniform
        prim.CreateAttribute(NEWTON_HULL, kind, custom=False, variability=fixed).Set(-1)
    wear(prim, body.GetParent(), None, meshes, define_grip(body.GetParent(), surface))
    define_priority(prim, surface)
    return prim


def define_no_contact(body: Usd.Prim, surface: Surface, meshes: MeshLayer) -> Usd.Prim:
    """Author a disabled collider on a body without colliders: a small sphere at its centre of mass.

    Isaac Sim's rules require a collider on every rigid body. A URDF link without `<collision>` touches
    nothing, so this one is disabled. Arguments as for `define_collider`.
    """
    sphere = UsdGeom.Sphere.Define(body.GetStage(), _path(body, COLLISIONS, NO_CONTACT))
    sphere.CreateRadiusAttr(NO_CONTACT_RADIUS_M)
    sphere.CreateExtentAttr([Gf.Vec3f(-NO_CONTACT_RADIUS_M), Gf.Vec3f(NO_CONTACT_RADIUS_M)])
    sphere.CreatePurposeAttr(UsdGeom.Tokens.guide)
    prim = sphere.GetPrim()
    x, y, z = UsdPhysics.MassAPI(body).GetCenterOfMassAttr().Get() or (0.0, 0.0, 0.0)
    write_pose(prim, (x, y, z))
    UsdPhysics.CollisionAPI.Apply(prim).CreateCollisionEnabledAttr(False)
    wear(prim, body.GetParent(), None, meshes, define_grip(body.GetParent(), surface))
    return prim


def _define_mesh(
    body: Usd.Prim, visual: Shape, entry: Entry, given: Paint | None, meshes: MeshLayer, layer: str
) -> Usd.Prim:
    """An Xform that references a mesh, whose arrays all references share.

    It is no instance: looks are in the robot's scope, to which prims below an instance cannot refer, and
    Blender drops a look that is bound above one.
    """
    stage, robot = body.GetStage(), body.GetParent()
    prim = UsdGeom.Xform.Define(stage, _path(body, VISUALS, visual.name or entry.path.name)).GetPrim()
    prim.GetReferences().AddReference(layer, entry.path)
    _place(prim, origin_of(visual))
    looks = [paint or given or PLAIN for paint in entry.paints]
    if not entry.subsets:
        wear(prim, robot, looks[0], meshes)
        return prim
    mesh = prim.GetPrimAtPath(MESH)
    for name, look in zip(entry.subsets, looks, strict=True):
        material = define_look(robot, look, meshes)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrimAtPath(name)).Bind(material)
    colours = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor")
    if given is not None and None in entry.paints and colours.GetInterpolation() == UsdGeom.Tokens.uniform:
        colours.GetAttr().Set(Vt.Vec3fArray([Gf.Vec3f(*look.display_colour) for look in looks]))
    return prim


def _paint_of(visual: Shape, description: Description, images: Images) -> Paint | None:
    """The URDF material of a visual: its own, or the robot's of that name; None if it has none.

    As in urdfdom, a material defined in one visual applies to others that name it. As in RViz, a texture
    replaces the colour; if the texture is missing, the colour is used.
    """
    material = visual.material
    if material is None:
        return None
    name = material.name or ""
    shared = description.materials.get(name)
    if material.rgba is None and not material.texture and not shared:
        given = (v.material for link in description.links.values() for v in link.visuals if v.material)
        shared = next(
            (m for m in given if name and m.name == name and (m.rgba is not None or m.texture)), None
        )
    colour = shared.rgba if shared and material.rgba is None else material.rgba
    texture = material.texture or (shared.texture if shared else None)
    image = None if texture is None else _image(texture, name, description, images)
    if image is None and colour is None:
        if texture is None and name:
            description.note(f"material {name!r} is named, but has no colour: shown without it")
        return None
    r, g, b, a = (1.0, 1.0, 1.0, 1.0) if colour is None else (float(c) for c in colour)
    return Paint(name, (r, g, b, a)) if image is None else Paint(name, (1.0, 1.0, 1.0, a), image)


def _image(filename: str, material: str, description: Description, images: Images) -> Image | None:
    """The image of a URDF `<texture>`; None with a note if it is missing or unreadable."""
    reading = Reading(description.path, description.source.packages.holds, images)
    try:
        image = read_image(str(description.find_file(filename, "texture")), reading)
    except MissingFileError:
        reading.lose(f"texture {filename!r} of material {material!r} is missing and is left out")
        image = None
    for note, lost in reading.notes:
        description.note(note, lost=lost)
    return image


def _plain(paint: Paint | None, what: str, description: Description) -> Paint | None:
    """A paint without texture: the mean colour of the texture, with a note."""
    if paint is None or paint.image is None:
        return paint
    description.note(f"material {paint.name!r}: {what} shows the mean colour of its texture", lost=True)
    return Paint(f"{paint.name}_mean", (*paint.image.mean, paint.rgba[3]))


def _define_primitive(body: Usd.Prim, shape: Shape) -> Usd.Prim:
    """Author a box, capsule, cylinder or sphere as a collider."""
    stage, form, kind, scale = body.GetStage(), shape.geometry, shape.geometry.kind, None
    path = _path(body, COLLISIONS, shape.name or kind)
    if kind == "box":
        prim = UsdGeom.Cube.Define(stage, path).GetPrim()
        UsdGeom.Cube(prim).CreateSizeAttr(1.0)
        scale = form.size
    elif kind == "sphere":
        prim = UsdGeom.Sphere.Define(stage, path).GetPrim()
        UsdGeom.Sphere(prim).CreateRadiusAttr(form.radius)
    else:
        schema = UsdGeom.Capsule if kind == "capsule" else UsdGeom.Cylinder
        prim = schema.Define(stage, path).GetPrim()
        schema(prim).CreateRadiusAttr(form.radius)
        schema(prim).CreateHeightAttr(form.length)  # without the ends of a capsule, in URDF and USD
        schema(prim).CreateAxisAttr(UsdGeom.Tokens.z)
    _place(prim, origin_of(shape), scale)
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    UsdGeom.Boundable(prim).CreateExtentAttr(extent)
    return prim


def _path(body: Usd.Prim, scope: str, name: str) -> Sdf.Path:
    """A free path in a scope of a link, called `name` if possible."""
    parent = UsdGeom.Xform.Define(body.GetStage(), body.GetPath().AppendChild(scope)).GetPrim()
    return free_child(parent, name)


def _place(prim: Usd.Prim, pose: NDArray, scale: NDArray | None = None) -> None:
    """Place a gprim at a pose (4, 4) in its link, after scaling it."""
    p, q = pose_of(pose)
    write_pose(prim, p, q)
    if scale is not None:
        UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(*scale))


def pose_of(T: NDArray) -> tuple[tuple[float, float, float], tuple[float, float, float, float] | None]:
    """Position and quaternion xyzw of a transform (4, 4); the quaternion is None without a rotation.

    Rounded to 1e-12, to remove rounding errors of arithmetic; the quaternion to 1e-15, since its w differs
    little from 1 for small rotations.
    """
    x, y, z = (round(float(v), 12) + 0.0 for v in T[:3, 3])
    if np.allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-12):
        return (x, y, z), None
    i, j, k, w = (round(float(v), 15) + 0.0 for v in quaternion(T[:3, :3]))
    return (x, y, z), (i, j, k, w)
