"""Material: the look of a surface (UsdPreviewSurface) and its friction (UsdPhysics)."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.urdf.meshes.mesh_layer import MeshLayer
from magtwin.urdf.meshes.piece import PLAIN, Map, Paint
from magtwin.urdf.meshes.texture import Image
from magtwin.urdf.physics.gazebo import Surface
from magtwin.usd.geometry import linear_from_srgb

PHYSX_API, MUJOCO_API = "PhysxMaterialAPI", "MjcCollisionAPI"
"""Applied schemas of PhysX and MuJoCo; their plugins are not installed here."""

SLIPPERY = 0.2
"""Friction below which a surface slides on any floor."""

NO_IMAGE = Image("", b"", (0.0, 0.0, 0.0))

LOOKS = "Looks"
"""Scope of all materials below the robot's prim."""


def define_look(robot: Usd.Prim, look: Paint, meshes: MeshLayer) -> UsdShade.Material:
    """The material of a look, shared by all prims that look so and name it so.

    Args:
        robot: Root prim; looks are in a scope below it.
        look: The look.
        meshes: Receives its texture, and the look by its path.
    """
    stage, kinds = robot.GetStage(), Sdf.ValueTypeNames
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    colour = linear_from_srgb(look.rgba[:3]) if look.image is None else look.display_colour
    mapped = {name for name, _ in look.maps}
    inputs: list[tuple[str, Sdf.ValueTypeName, Any]] = [
        ("diffuseColor", kinds.Color3f, _vector(colour)),
        ("opacity", kinds.Float, round(look.rgba[3], 4)),
        ("roughness", kinds.Float, round(look.roughness, 4)),
        ("metallic", kinds.Float, round(look.metallic, 4)),
    ]
    if look.cutoff:
        inputs.append(("opacityThreshold", kinds.Float, round(look.cutoff, 4)))
    if max(look.emissive) > 0 or "emissiveColor" in mapped:
        inputs.append(("emissiveColor", kinds.Color3f, _vector(look.emissive)))
    if look.specular is not None:
        inputs += [
            ("useSpecularWorkflow", kinds.Int, 1),
            ("specularColor", kinds.Color3f, _vector(look.specular)),
        ]
    if look.ior is not None:
        inputs.append(("ior", kinds.Float, round(look.ior, 4)))
    maps = list(look.maps)
    if look.image is not None:
        factor = (*linear_from_srgb(look.rgba[:3]), look.rgba[3])
        own = Map(look.image, scale=factor, colour=True, wrap=look.wrap)
        maps.insert(0, ("diffuseColor", own))
        if look.see_through:
            maps.insert(1, ("opacity", replace(own, channel="a")))
    files = [meshes.textures.add(each.image) for _, each in maps]
    values = tuple((n, replace(m, image=NO_IMAGE)) for n, m in maps)
    shown = look.name, tuple(inputs), tuple(files), values, look.by_vertex
    if shown in meshes.looks:
        return UsdShade.Material(stage.GetPrimAtPath(meshes.looks[shown]))
    hexed = "".join(f"{round(c * 255):02x}" for c in look.rgba)
    stem, number = Tf.MakeValidIdentifier(look.name) if look.name else f"colour_{hexed}", 1
    path = scope.AppendChild(stem)
    while stage.GetPrimAtPath(path):
        path = scope.AppendChild(f"{stem}_{hexed}" if number == 1 else f"{stem}_{hexed}_{number}")
        number += 1  # two looks have the same name
    meshes.looks[shown] = path
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    for name, kind, value in inputs:
        surface.CreateInput(name, kind).Set(value)
    if look.by_vertex:
        reader = _reader(stage, path, "UsdPrimvarReader_float3", "displayColor", kinds.Float3)
        surface.GetInput("diffuseColor").ConnectToSource(reader)
    for (name, each), file in zip(maps, files, strict=True):
        _connect_map(stage, path, surface, name, each, file)
    surface.CreateOutput("surface", kinds.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _vector(colour: ArrayLike) -> Gf.Vec3f:
    return Gf.Vec3f(*(round(float(c), 5) for c in np.asarray(colour)))


def _connect_map(
    stage: Usd.Stage, path: Sdf.Path, surface: UsdShade.Shader, name: str, each: Map, file: str
) -> None:
    """Connect a texture, mapped by the mesh's `st`, to an input of a surface.

    The colour and an opacity from the same file share a shader.
    """
    kinds = Sdf.ValueTypeNames
    prim = path.AppendChild("texture" if name == "diffuseColor" else f"{name}_texture")
    shared = stage.GetPrimAtPath(path.AppendChild("texture")) if name == "opacity" else None
    if shared and shared.GetAttribute("inputs:file").Get().path == file:
        prim = shared.GetPath()
    texture = UsdShade.Shader(stage.GetPrimAtPath(prim))
    if not texture:
        texture = UsdShade.Shader.Define(stage, prim)
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(file))
        st = _reader(stage, path, "UsdPrimvarReader_float2", "st", kinds.Float2)
        texture.CreateInput("st", kinds.Float2).ConnectToSource(st)
        for side, wrap in zip(("wrapS", "wrapT"), each.wrap, strict=True):
            texture.CreateInput(side, kinds.Token).Set(wrap)
        texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB" if each.colour else "raw")
        for key, values, usual in (("scale", each.scale, 1), ("bias", each.bias, 0)):
            if any(value != usual for value in values):
                rounded = (round(float(c), 5) for c in values)
                texture.CreateInput(key, kinds.Float4).Set(Gf.Vec4f(*rounded))
    wide = each.channel == "rgb"
    output = texture.CreateOutput(each.channel, kinds.Float3 if wide else kinds.Float)
    kind = kinds.Normal3f if name == "normal" else kinds.Color3f if wide else kinds.Float
    surface.CreateInput(name, kind).ConnectToSource(output)


def _reader(
    stage: Usd.Stage, path: Sdf.Path, kind: str, primvar: str, type_: Sdf.ValueTypeName
) -> UsdShade.Output:
    """Output of a shader that reads a primvar."""
    names = ("reader", f"reader_{primvar}")
    for prim in map(stage.GetPrimAtPath, map(path.AppendChild, names)):
        if prim and prim.GetAttribute("inputs:varname").Get() == primvar:
            return UsdShade.Shader(prim).GetOutput("result")
    name = names[1] if stage.GetPrimAtPath(path.AppendChild(names[0])) else names[0]
    reader = UsdShade.Shader.Define(stage, path.AppendChild(name))
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
