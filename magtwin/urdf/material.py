"""Material: the look of a surface (UsdPreviewSurface) and its friction (UsdPhysics)."""

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.urdf.meshes.mesh_layer import MeshLayer
from magtwin.urdf.meshes.piece import PLAIN, Paint
from magtwin.urdf.physics.gazebo import Surface
from magtwin.usd.geometry import linear_from_srgb

PHYSX_API, MUJOCO_API = "PhysxMaterialAPI", "MjcCollisionAPI"
"""Applied schemas of PhysX and MuJoCo; their plugins are not installed here."""

SLIPPERY = 0.2
"""Friction below which a surface slides on any floor."""

LOOKS = "Looks"
"""Scope of all materials below the robot's prim."""


def define_look(robot: Usd.Prim, look: Paint, meshes: MeshLayer) -> UsdShade.Material:
    """The material of a look, shared by all prims with that look.

    Args:
        robot: Root prim; looks are in a scope below it.
        look: The look.
        meshes: Receives its texture, and the look by its path.
    """
    stage, kinds = robot.GetStage(), Sdf.ValueTypeNames
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    colour = linear_from_srgb(look.rgba[:3]) if look.image is None else look.display_colour
    inputs = [
        ("diffuseColor", kinds.Color3f, Gf.Vec3f(*(round(float(c), 5) for c in colour))),
        ("opacity", kinds.Float, round(look.rgba[3], 4)),
        ("roughness", kinds.Float, round(look.roughness, 4)),
        ("metallic", kinds.Float, round(look.metallic, 4)),
        *([("opacityThreshold", kinds.Float, round(look.cutoff, 4))] if look.cutoff else []),
    ]
    texture = "" if look.image is None else meshes.textures.add(look.image)
    shown = (*(value for _, _, value in inputs), texture, look.see_through, look.by_vertex)
    hexed = "".join(f"{round(c * 255):02x}" for c in look.rgba)
    stem, number = Tf.MakeValidIdentifier(look.name) if look.name else f"colour_{hexed}", 1
    path = scope.AppendChild(stem)
    while stage.GetPrimAtPath(path):
        if meshes.looks.get(path) == shown:
            return UsdShade.Material(stage.GetPrimAtPath(path))
        path = scope.AppendChild(f"{stem}_{hexed}" if number == 1 else f"{stem}_{hexed}_{number}")
        number += 1  # two looks have the same name
    meshes.looks[path] = shown
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    for name, kind, value in inputs:
        surface.CreateInput(name, kind).Set(value)
    if look.by_vertex:
        reader = _reader(stage, path, "UsdPrimvarReader_float3", "displayColor", kinds.Float3)
        surface.GetInput("diffuseColor").ConnectToSource(reader)
    elif texture:
        _connect_texture(stage, path, surface, look, texture)
    surface.CreateOutput("surface", kinds.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _connect_texture(
    stage: Usd.Stage, path: Sdf.Path, surface: UsdShade.Shader, look: Paint, file: str
) -> None:
    """Connect a texture, mapped by the mesh's `st`, to the colour and, if used, the opacity."""
    kinds = Sdf.ValueTypeNames
    texture = UsdShade.Shader.Define(stage, path.AppendChild("texture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(file))
    st = _reader(stage, path, "UsdPrimvarReader_float2", "st", kinds.Float2)
    texture.CreateInput("st", kinds.Float2).ConnectToSource(st)
    for side in ("wrapS", "wrapT"):
        texture.CreateInput(side, kinds.Token).Set("repeat")
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    factor = (*linear_from_srgb(look.rgba[:3]), look.rgba[3])
    if factor != (1, 1, 1, 1):
        texture.CreateInput("scale", kinds.Float4).Set(Gf.Vec4f(*(round(float(c), 5) for c in factor)))
    surface.GetInput("diffuseColor").ConnectToSource(texture.CreateOutput("rgb", kinds.Float3))
    if look.see_through:
        surface.GetInput("opacity").ConnectToSource(texture.CreateOutput("a", kinds.Float))


def _reader(
    stage: Usd.Stage, path: Sdf.Path, kind: str, primvar: str, type_: Sdf.ValueTypeName
) -> UsdShade.Output:
    """Output of a shader that reads a primvar."""
    reader = UsdShade.Shader.Define(stage, path.AppendChild("reader"))
    reader.CreateIdAttr(kind)
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
    return reader.CreateOutput("result", type_)


def define_grip(robot: Usd.Prim, surface: Surface) -> UsdShade.Material:
    """The physics material of a surface, shared by all colliders with that surface.

    Args:
        robot: Root prim; physics materials are in the scope of its looks.
        surface: The surface; its stiffness and damping become PhysX's compliant contact. If its friction is
            below `SLIPPERY`, PhysX uses that of the less rough of a pair, instead of the mean.
    """
    stage = robot.GetStage()
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    name = f"friction_{surface.friction:g}"
    for label, value in (
        ("bounce", surface.restitution or None),
        ("stiffness", surface.stiffness),
        ("damping", surface.damping),
    ):
        name += "" if value is None else f"_{label}_{value:g}"
    path = scope.AppendChild(Tf.MakeValidIdentifier(name))
    if stage.GetPrimAtPath(path):
        return UsdShade.Material(stage.GetPrimAtPath(path))
    material = UsdShade.Material.Define(stage, path)
    api = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    api.CreateStaticFrictionAttr(surface.friction)
    api.CreateDynamicFrictionAttr(surface.friction)
    api.CreateRestitutionAttr(surface.restitution)
    prim, kinds = material.GetPrim(), Sdf.ValueTypeNames
    if surface.friction < SLIPPERY or surface.stiffness is not None or surface.damping is not None:
        prim.AddAppliedSchema(PHYSX_API)
    if surface.friction < SLIPPERY:
        prim.CreateAttribute("physxMaterial:frictionCombineMode", kinds.Token, custom=False).Set("min")
    for what, value in (("Stiffness", surface.stiffness), ("Damping", surface.damping)):
        if value is not None:
            name = f"physxMaterial:compliantContact{what}"
            prim.CreateAttribute(name, kinds.Float, custom=False).Set(value)
    return material


def define_priority(collider: Usd.Prim, surface: Surface) -> None:
    """Author that MuJoCo and Newton use the friction of a slippery collider, not the larger of a pair."""
    if surface.friction < SLIPPERY:
        collider.AddAppliedSchema(MUJOCO_API)
        collider.CreateAttribute("mjc:priority", Sdf.ValueTypeNames.Int, custom=False).Set(1)


def wear(
    prim: Usd.Prim,
    robot: Usd.Prim,
    look: Paint | None,
    meshes: MeshLayer,
    grip: UsdShade.Material | None = None,
) -> None:
    """Bind a look to a gprim or an Xform over one, and a physics material to a collider.

    The colour is also authored as displayColor, for viewers without materials, unless the mesh has one.
    """
    look = look or PLAIN
    api = UsdShade.MaterialBindingAPI.Apply(prim)
    api.Bind(define_look(robot, look, meshes))
    if not look.by_vertex:
        colour = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.constant
        )
        colour.Set([Gf.Vec3f(*look.display_colour)])
    if grip is not None:
        api.Bind(grip, UsdShade.Tokens.weakerThanDescendants, "physics")
