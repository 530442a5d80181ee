"""Material: the look of a surface (UsdPreviewSurface) and its friction (UsdPhysics)."""

from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.urdf.meshes.piece import PLAIN, Paint
from magtwin.urdf.meshes.texture import Textures
from magtwin.urdf.physics.gazebo import Surface
from magtwin.usd.geometry import linear_from_srgb

PHYSX_API = "PhysxMaterialAPI"
"""PhysX's applied schema; its plugin is not installed here."""

LOOKS = "Looks"
"""Scope of all materials below the robot's prim."""

SURFACE, TEXTURE, READER = "surface", "texture", "reader"
"""Shaders of a look."""


def define_look(robot: Usd.Prim, look: Paint, textures: Textures) -> UsdShade.Material:
    """The material of a look, shared by all prims with that look.

    Args:
        robot: Root prim; looks are in a scope below it.
        look: The look.
        textures: Receives its texture.
    """
    texture = "" if look.image is None else textures.add(look.image)
    stage = robot.GetStage()
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    hexed = "".join(f"{round(c * 255):02x}" for c in look.rgba)
    stem, number = Tf.MakeValidIdentifier(look.name) if look.name else f"colour_{hexed}", 1
    path = scope.AppendChild(stem)
    while stage.GetPrimAtPath(path):
        material = UsdShade.Material(stage.GetPrimAtPath(path))
        if _shows(material, look, texture):
            return material
        path = scope.AppendChild(f"{stem}_{hexed}" if number == 1 else f"{stem}_{hexed}_{number}")
        number += 1  # two looks have the same name
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild(SURFACE))
    surface.CreateIdAttr("UsdPreviewSurface")
    for name, kind, value in _inputs(look):
        surface.CreateInput(name, kind).Set(value)
    if look.by_vertex:
        reader = _reader(stage, path, "UsdPrimvarReader_float3", "displayColor", Sdf.ValueTypeNames.Float3)
        surface.GetInput("diffuseColor").ConnectToSource(reader)
    elif texture:
        _connect_texture(stage, path, surface, look, texture)
    surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _inputs(look: Paint) -> list[tuple[str, Sdf.ValueTypeName, Any]]:
    """Inputs of a look's UsdPreviewSurface: name, type and value."""
    kinds = Sdf.ValueTypeNames
    colour = linear_from_srgb(look.rgba[:3]) if look.image is None else look.display_colour
    return [
        ("diffuseColor", kinds.Color3f, Gf.Vec3f(*(round(float(c), 5) for c in colour))),
        ("opacity", kinds.Float, round(look.rgba[3], 4)),
        ("roughness", kinds.Float, round(look.roughness, 4)),
        ("metallic", kinds.Float, round(look.metallic, 4)),
        *([("opacityThreshold", kinds.Float, round(look.cutoff, 4))] if look.cutoff else []),
    ]


def _connect_texture(
    stage: Usd.Stage, path: Sdf.Path, surface: UsdShade.Shader, look: Paint, file: str
) -> None:
    """Connect a texture, mapped by the mesh's `st`, to the colour and, if used, the opacity."""
    kinds = Sdf.ValueTypeNames
    texture = UsdShade.Shader.Define(stage, path.AppendChild(TEXTURE))
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
    reader = UsdShade.Shader.Define(stage, path.AppendChild(READER))
    reader.CreateIdAttr(kind)
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
    return reader.CreateOutput("result", type_)


def _shows(material: UsdShade.Material, look: Paint, file: str) -> bool:
    """Whether a material from `define_look` has this look."""
    stage, path = material.GetPrim().GetStage(), material.GetPath()
    surface = UsdShade.Shader(stage.GetPrimAtPath(path.AppendChild(SURFACE)))
    texture = UsdShade.Shader(stage.GetPrimAtPath(path.AppendChild(TEXTURE)))
    if not surface:
        return False
    wanted = {name: np.float32(value).tolist() for name, _, value in _inputs(look)}
    return (
        {i.GetBaseName(): np.float32(i.Get()).tolist() for i in surface.GetInputs()} == wanted
        and (texture.GetInput("file").Get().path if texture else "") == file
        and surface.GetInput("opacity").HasConnectedSource() == bool(look.see_through and file)
        and bool(stage.GetPrimAtPath(path.AppendChild(READER))) == bool(look.by_vertex or file)
    )


def define_grip(robot: Usd.Prim, surface: Surface) -> UsdShade.Material:
    """The physics material of a surface, shared by all colliders with that surface.

    Args:
        robot: Root prim; physics materials are in the scope of its looks.
        surface: The surface; its stiffness and damping become PhysX's compliant contact.
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
    for what, value in (("Stiffness", surface.stiffness), ("Damping", surface.damping)):
        if value is not None:
            if PHYSX_API not in material.GetPrim().GetPrimTypeInfo().GetAppliedAPISchemas():
                material.GetPrim().AddAppliedSchema(PHYSX_API)
            attribute = f"physxMaterial:compliantContact{what}"
            material.GetPrim().CreateAttribute(attribute, Sdf.ValueTypeNames.Float, custom=False).Set(value)
    return material


def wear(
    prim: Usd.Prim,
    robot: Usd.Prim,
    look: Paint | None,
    textures: Textures,
    grip: UsdShade.Material | None = None,
) -> None:
    """Bind a look to a gprim or an Xform over one, and a physics material to a collider.

    The colour is also authored as displayColor, for viewers without materials, unless the mesh has one.
    """
    look = look or PLAIN
    api = UsdShade.MaterialBindingAPI.Apply(prim)
    api.Bind(define_look(robot, look, textures))
    if not look.by_vertex:
        colour = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.constant
        )
        colour.Set([Gf.Vec3f(*look.display_colour)])
    if grip is not None:
        api.Bind(grip, UsdShade.Tokens.weakerThanDescendants, "physics")
