"""Material: how a surface looks (UsdPreviewSurface) and how it grips (UsdPhysics)."""

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.urdf.gazebo import Surface

Rgba = tuple[float, float, float, float]

GREY: Rgba = (0.5, 0.5, 0.5, 1.0)
"""Look of what has none, as RViz shows it."""

LOOKS = "Looks"
"""Scope of all materials below the robot's prim."""


def define_look(robot: Usd.Prim, rgba: Rgba, name: str = "") -> UsdShade.Material:
    """The look of a colour, shared by all that have it.

    Args:
        robot: Root prim; looks lie in a scope below it.
        rgba: Red, green, blue and opacity as screens show them (sRGB), 0 to 1, as URDF has them; USD's
            are linear.
        name: Name of the URDF's material; "" makes one from the colour.
    """
    stage = robot.GetStage()
    red, green, blue, opacity = (round(float(c), 4) for c in rgba)
    hexed = "".join(f"{round(c * 255):02x}" for c in (red, green, blue, opacity))
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    linear = Gf.Vec3f(*(round(float(c), 5) for c in linear_from_srgb((red, green, blue))))
    path = scope.AppendChild(Tf.MakeValidIdentifier(name) if name else f"colour_{hexed}")
    shader = UsdShade.Shader(stage.GetPrimAtPath(path.AppendChild("surface")))
    if shader and (
        shader.GetInput("diffuseColor").Get() != linear
        or shader.GetInput("opacity").Get() != np.float32(opacity)
    ):
        path = scope.AppendChild(f"{path.name}_{hexed}")  # the URDF uses one name for two colours
    if stage.GetPrimAtPath(path):
        return UsdShade.Material(stage.GetPrimAtPath(path))
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(linear)
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(opacity)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.5)
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def define_grip(robot: Usd.Prim, surface: Surface) -> UsdShade.Material:
    """The physics material of a friction, shared by all that have it.

    Args:
        robot: Root prim; physics materials lie among its looks.
        surface: Coefficients of friction [-] and restitution [-].
    """
    stage = robot.GetStage()
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(LOOKS)).GetPath()
    path = scope.AppendChild(Tf.MakeValidIdentifier(f"friction_{surface.friction:g}"))
    if stage.GetPrimAtPath(path):
        return UsdShade.Material(stage.GetPrimAtPath(path))
    material = UsdShade.Material.Define(stage, path)
    api = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    api.CreateStaticFrictionAttr(surface.friction)
    api.CreateDynamicFrictionAttr(surface.friction)
    api.CreateRestitutionAttr(surface.restitution)
    return material


def wear(prim: Usd.Prim, look: UsdShade.Material, grip: UsdShade.Material | None = None) -> None:
    """Give a gprim its look, as displayColor too for viewers without materials, and a collider its grip."""
    api = UsdShade.MaterialBindingAPI.Apply(prim)
    api.Bind(look)
    surface = look.ComputeSurfaceSource()[0]
    UsdGeom.Gprim(prim).CreateDisplayColorAttr([surface.GetInput("diffuseColor").Get()])
    if grip is not None:
        api.Bind(grip, UsdShade.Tokens.weakerThanDescendants, "physics")
