"""Looks: materials of rooms, furniture and steel, and boxes with them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from magtwin.errors import find


@dataclass(frozen=True)
class Look:
    """A preview material; with friction, it is also a physics material."""

    colour: tuple[float, float, float]
    """Linear red, green, blue."""

    roughness: float
    metallic: float = 0.0

    friction: float | None = None
    """Coulomb friction, static and dynamic."""


LOOKS: Mapping[str, Look] = MappingProxyType(
    {
        "Floor": Look((0.33, 0.34, 0.36), 0.7, friction=0.8),  # dark vinyl
        "Wall": Look((0.62, 0.53, 0.40), 0.6, friction=0.4),  # plywood
        "Post": Look((0.70, 0.71, 0.73), 0.35, 1.0, friction=0.4),  # anodised aluminium
        "Camera": Look((0.03, 0.03, 0.035), 0.5),
        "Lens": Look((0.02, 0.08, 0.35), 0.1),  # a blue ring
        "Steel": Look((0.24, 0.20, 0.18), 0.75, 0.4, friction=0.4),  # mill scale and rust
        "PaintedSteel": Look((0.28, 0.31, 0.33), 0.5, friction=0.4),  # grey powder coat
        "Door": Look((0.45, 0.49, 0.50), 0.45, friction=0.4),  # a lighter one
        "Chrome": Look((0.55, 0.56, 0.57), 0.2, 1.0, friction=0.3),
        "Wood": Look((0.50, 0.33, 0.17), 0.55, friction=0.4),  # beech
        "Concrete": Look((0.42, 0.41, 0.39), 0.85, friction=0.6),
        "Enamel": Look((0.80, 0.80, 0.78), 0.35, friction=0.4),  # white, as radiators have
        "Brick": Look((0.40, 0.16, 0.10), 0.9, friction=0.6),
        "Aluminium": Look((0.70, 0.71, 0.73), 0.35, 1.0, friction=0.4),
        "Plastic": Look((0.02, 0.02, 0.02), 0.6, friction=0.4),
    }
)


def define_looks(stage: Usd.Stage, scope: Sdf.Path, names: Iterable[str]) -> None:
    """Author materials as children of a scope."""
    UsdGeom.Scope.Define(stage, scope)
    for name in names:
        look = find("look", name, LOOKS)
        material = UsdShade.Material.Define(stage, scope.AppendChild(name))
        surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*look.colour))
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(look.roughness)
        surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(look.metallic)
        material.CreateSurfaceOutput().ConnectToSource(
            surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        )
        if look.friction is not None:
            physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
            physics.CreateStaticFrictionAttr(look.friction)
            physics.CreateDynamicFrictionAttr(look.friction)
            physics.CreateRestitutionAttr(0.0)


def define_box(
    stage: Usd.Stage,
    path: Sdf.Path,
    centre: ArrayLike,
    size: ArrayLike,
    look: Sdf.Path,
    *,
    collides: bool = False,
) -> Usd.Prim:
    """A cube scaled to `size` [m] at `centre` [m] in its parent, with the material at `look`."""
    cube = UsdGeom.Cube.Define(stage, path)
    cube.CreateSizeAttr(1.0)
    cube.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(-0.5), Gf.Vec3f(0.5)]))
    cube.AddTranslateOp().Set(Gf.Vec3d(*map(float, np.asarray(centre))))
    cube.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, np.asarray(size))))
    wear(cube, look)
    if collides:
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    return cube.GetPrim()


def wear(gprim: UsdGeom.Gprim, look: Sdf.Path) -> None:
    """Bind the material at `look`, and author its colour on the prim too."""
    gprim.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*LOOKS[look.name].colour)]))
    material = UsdShade.Material.Get(gprim.GetPrim().GetStage(), look)
    UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)
