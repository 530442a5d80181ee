"""Shape: visuals and colliders of a link, as gprims in its frame.

A mesh looks as in RViz (robot_link.cpp): its file's own materials win, part by part; the visual's URDF
material is worn by the parts to which the file gives none, which is all of an STL. GREY is what neither
dresses.
"""

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Material, Shape
from magtwin.urdf.material import Look, define_grip, define_look, wear
from magtwin.urdf.meshes.mesh import Paint
from magtwin.urdf.meshes.mesh_layer import MESH, Entry, MeshLayer, free_name
from magtwin.urdf.meshes.reading import Reading
from magtwin.urdf.meshes.texture import Image, read_image
from magtwin.urdf.physics.gazebo import Surface
from magtwin.urdf.physics.inertia import quaternion
from magtwin.urdf.source.source import MissingFileError
from magtwin.usd.sensors import write_pose

VISUALS, COLLISIONS = "visuals", "collisions"
"""Xforms below a link's prim."""

APPROXIMATIONS = {"hull": "convexHull", "decomposition": "convexHull", "mesh": "none"}
"""What engines are to make of a mesh collider's triangles, by `Options.collision`."""

NEWTON_MESH_API = "NewtonMeshCollisionAPI"
"""Newton's applied schema, by name: its plugin lives elsewhere."""


def define_visual(
    body: Usd.Prim, visual: Shape, description: Description, meshes: MeshLayer, layer: str
) -> list[Usd.Prim]:
    """The prim of a URDF `<visual>`: a gprim with its look, or an Xform over the mesh that it shares.

    Args:
        body: Prim of the link, a child of the robot's.
        visual: The visual.
        description: Where the robot's materials stand.
        meshes: Where the mesh's triangles stand.
        layer: Asset path of the exported mesh layer.

    Returns:
        The prim, or nothing where its mesh is missing and that was allowed.
    """
    paint = _paint_of(visual, description)
    if visual.geometry.mesh is None:
        prim = _define_primitive(body, VISUALS, visual)
        wear(prim, body.GetParent(), _look(_plain(paint, "a primitive", description), meshes))
        return [prim]
    entry = meshes.try_add(visual.geometry.mesh, meshes.visual)
    if entry is None:
        return []
    if not entry.textured:
        paint = _plain(
            paint, f"mesh {visual.geometry.mesh.filename!r} without texture coordinates", description
        )
    return [_define_mesh(body, visual, entry, paint, meshes, layer)]


def define_collider(
    body: Usd.Prim, collision: Shape, surface: Surface, meshes: MeshLayer, layer: str
) -> list[Usd.Prim]:
    """The colliders of a URDF `<collision>`: its primitive, or the solids that its mesh collides as.

    They are of purpose guide, so that no viewer shows them unasked. Other args as for `define_visual`.
    """
    if collision.geometry.mesh is None:
        made = [_define_primitive(body, COLLISIONS, collision)]
    else:
        made = []
        for path in meshes.try_add(collision.geometry.mesh, meshes.collider) or ():
            prim = body.GetStage().DefinePrim(_path(body, COLLISIONS, collision.name or path.name), "Mesh")
            prim.GetReferences().AddReference(layer, path)
            _place(prim, origin_of(collision))
            made.append(prim)
    robot = body.GetParent()
    for prim in made:
        UsdGeom.Imageable(prim).CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(prim).CreateCollisionEnabledAttr(True)
        if prim.IsA(UsdGeom.Mesh):
            UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(APPROXIMATIONS[meshes.collision])
            prim.AddAppliedSchema(NEWTON_MESH_API)
        wear(prim, robot, Look(), define_grip(robot, surface))
    return made


def _define_mesh(
    body: Usd.Prim, visual: Shape, entry: Entry, given: Paint | None, meshes: MeshLayer, layer: str
) -> Usd.Prim:
    """An Xform that refers to a mesh, as an instance where one look covers it.

    Looks stand in the robot's own scope, which nothing below an instance can see: the one of an instance
    is bound over it, and a mesh of several is no instance. Its arrays are shared either way.
    """
    stage, robot = body.GetStage(), body.GetParent()
    prim = UsdGeom.Xform.Define(stage, _path(body, VISUALS, visual.name or entry.path.name)).GetPrim()
    prim.GetReferences().AddReference(layer, entry.path)
    _place(prim, origin_of(visual))
    looks = [_look(paint or given, meshes) for paint in entry.paints]
    if not entry.subsets:
        wear(prim, robot, looks[0])
        prim.SetInstanceable(True)
        return prim
    mesh = prim.GetPrimAtPath(MESH)
    for name, look in zip(entry.subsets, looks, strict=True):
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrimAtPath(name)).Bind(define_look(robot, look))
    colours = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor")
    if given is not None and None in entry.paints and colours.GetInterpolation() == UsdGeom.Tokens.uniform:
        colours.GetAttr().Set(Vt.Vec3fArray([Gf.Vec3f(*look.display_colour) for look in looks]))
    return prim


def _look(paint: Paint | None, meshes: MeshLayer) -> Look:
    """The look of a paint, its texture among the robot's; that of what has none if it is none."""
    if paint is None:
        return Look()
    return Look(
        rgba=paint.rgba,
        name=paint.name,
        texture="" if paint.image is None else meshes.textures.add(paint.image),
        mean=(1.0, 1.0, 1.0) if paint.image is None else paint.image.mean,
        roughness=paint.roughness,
        metallic=paint.metallic,
        see_through=paint.see_through and paint.image is not None,
        cutoff=paint.cutoff,
        by_vertex=paint.by_vertex,
    )


def _paint_of(visual: Shape, description: Description) -> Paint | None:
    """A visual's URDF material: its own, or the robot's of that name; none if it has none.

    As urdfdom has it, what a visual says of a material holds for others that only name it. A texture is
    the colour alone, as in RViz; where it is missing, the material's colour is.
    """
    material = visual.material
    if material is None:
        return None
    name = material.name or ""
    shared = description.materials.get(name)
    if not (material.color or material.texture or shared):
        shared = _told_by_another(name, description)
    colour = material.color or (shared.color if shared else None)
    texture = material.texture or (shared.texture if shared else None)
    image = None if texture is None else _image(texture.filename, name, description)
    if image is None and colour is None:
        if texture is None and name:
            description.note(f"material {name!r} is named, but nothing says its colour: shown without it")
        return None
    r, g, b, a = (1.0, 1.0, 1.0, 1.0) if colour is None else (float(c) for c in colour.rgba)
    return Paint(name, (r, g, b, a)) if image is None else Paint(name, (1.0, 1.0, 1.0, a), image)


def _told_by_another(name: str, description: Description) -> Material | None:
    """The first material of a name that a visual says more of than that; none if none does."""
    given = (v.material for link in description.links.values() for v in link.visuals if v.material)
    return next((m for m in given if name and m.name == name and (m.color or m.texture)), None)


def _image(filename: str, material: str, description: Description) -> Image | None:
    """The picture of a URDF `<texture>`; none, with a note, where it is missing or none."""
    reading = Reading(description.path, description.source.packages.holds)
    try:
        image = read_image(str(description.find_file(filename, "texture")), reading)
    except MissingFileError:
        reading.lose(f"texture {filename!r} of material {material!r} is missing and is left out")
        image = None
    for note in reading.notes:
        description.note(note.text, lost=note.lost)
    return image


def _plain(paint: Paint | None, what: str, description: Description) -> Paint | None:
    """A paint for what no texture can lie on: its mean colour."""
    if paint is None or paint.image is None:
        return paint
    description.note(f"material {paint.name!r}: {what} shows the mean colour of its texture", lost=True)
    return Paint(f"{paint.name}_mean", (*paint.image.mean, paint.rgba[3]))


def _define_primitive(body: Usd.Prim, scope: str, shape: Shape) -> Usd.Prim:
    """The gprim of a box, capsule, cylinder or sphere."""
    stage, geometry = body.GetStage(), shape.geometry
    kind = geometry.kind
    solid, path, scale = getattr(geometry, kind), _path(body, scope, shape.name or kind), None
    if kind == "box":
        prim = UsdGeom.Cube.Define(stage, path).GetPrim()
        UsdGeom.Cube(prim).CreateSizeAttr(1.0)
        scale = np.asarray(solid.size, float)
    elif kind == "sphere":
        prim = UsdGeom.Sphere.Define(stage, path).GetPrim()
        UsdGeom.Sphere(prim).CreateRadiusAttr(solid.radius)
    else:
        schema = UsdGeom.Capsule if kind == "capsule" else UsdGeom.Cylinder
        prim = schema.Define(stage, path).GetPrim()
        schema(prim).CreateRadiusAttr(solid.radius)
        schema(prim).CreateHeightAttr(solid.length)  # of a capsule without its ends, in URDF and in USD
        schema(prim).CreateAxisAttr(UsdGeom.Tokens.z)
    _place(prim, origin_of(shape), scale)
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    UsdGeom.Boundable(prim).CreateExtentAttr(extent)
    return prim


def _path(body: Usd.Prim, scope: str, name: str) -> Sdf.Path:
    """Path of a prim that is not there yet, in a scope of a link, called `name` if that is free."""
    parent = UsdGeom.Xform.Define(body.GetStage(), body.GetPath().AppendChild(scope)).GetPrim()
    taken = {child.GetName() for child in parent.GetChildren()}
    return parent.GetPath().AppendChild(free_name(Tf.MakeValidIdentifier(name), taken))


def _place(prim: Usd.Prim, pose: NDArray, scale: NDArray | None = None) -> None:
    """Put a gprim at a pose (4, 4) in its link, stretched by `scale` first."""
    p, q = pose_of(pose)
    write_pose(prim, p, q)
    if scale is not None:
        UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(*scale))


def pose_of(T: NDArray) -> tuple[tuple[float, float, float], tuple[float, float, float, float] | None]:
    """Position and quaternion xyzw of a transform (4, 4); no quaternion where it does not turn.

    Rounded to 1e-12 (the quaternion to 1e-15: its w tells turns of 1e-6 from none), so that the text
    shows 0 where the arithmetic left 1e-17.
    """
    x, y, z = (round(float(v), 12) + 0.0 for v in T[:3, 3])
    if np.allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-12):
        return (x, y, z), None
    i, j, k, w = (round(float(v), 15) + 0.0 for v in quaternion(T[:3, :3]))
    return (x, y, z), (i, j, k, w)
