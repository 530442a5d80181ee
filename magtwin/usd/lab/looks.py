"""Looks: materials of rooms, furniture and steel, and the meshes that are shown with them.

A mesh is shown; the primitive beside it, of purpose guide, collides or is magnetised.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from magtwin.errors import find
from magtwin.spec.base import Quat, Vec3
from magtwin.usd.attributes import write_pose
from magtwin.usd.layers import WORLD
from magtwin.usd.solids import Triangles, box, cylinder, define_triangles, sphere

SHAPES = WORLD.AppendChild("Shapes")
"""Class prim of the unit shapes."""

SHAPES_FILE = "shapes.usdc"
"""Layer of the unit shapes: their arrays do not belong in text."""

VISUALS = "Visuals"
"""Name of the Xform of meshes that are shown, beside the colliders and sources that they show."""

UNITS: Mapping[str, Triangles] = MappingProxyType(
    {"cuboid": box(1.0), "cylinder": cylinder(0.5, 1.0), "sphere": sphere(0.5)}
)
"""Shapes of size 1 m about the origin."""


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
        "ReinforcedConcrete": Look((0.36, 0.36, 0.35), 0.9, friction=0.6),
        "Plasterboard": Look((0.70, 0.69, 0.66), 0.8, friction=0.5),  # painted off-white
        "Glass": Look((0.45, 0.60, 0.60), 0.1, friction=0.3),
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
        shown = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(shown)
        if look.friction is not None:
            physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
            physics.CreateStaticFrictionAttr(look.friction)
            physics.CreateDynamicFrictionAttr(look.friction)
            physics.CreateRestitutionAttr(0.0)


def define_shapes(stage: Usd.Stage) -> None:
    """Author the unit shapes as class prims below `SHAPES`, which shown meshes reference.

    A class prim is shown nowhere. A layer of text keeps them in a sublayer of its own, see `SHAPES_FILE`.
    """
    if not stage.GetPrimAtPath(SHAPES):
        stage.CreateClassPrim(SHAPES)
    for name, (points, faces) in UNITS.items():
        if not stage.GetPrimAtPath(SHAPES.AppendChild(name)):
            mesh = UsdGeom.Mesh.Define(stage, SHAPES.AppendChild(name))
            define_triangles(mesh, points, faces, shaded=True)


def define_box(
    stage: Usd.Stage,
    path: Sdf.Path,
    centre: ArrayLike,
    size: ArrayLike,
    look: Sdf.Path,
    *,
    collides: bool = False,
) -> Usd.Prim:
    """A shown box of `size` [m] at `centre` [m] in its parent, with the material at `look`.

    Returns:
        The mesh; of a box that collides, the collider, whose mesh is at `visual_path`.
    """
    p, sides = (tuple(map(float, np.asarray(v))) for v in (centre, size))
    if not collides:
        return define_visual(stage, path, "cuboid", p, sides, look)  # type: ignore[arg-type]
    cube = UsdGeom.Cube.Define(stage, path)
    cube.CreateSizeAttr(1.0)
    cube.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(-0.5), Gf.Vec3f(0.5)]))
    write_pose(cube.GetPrim(), p)  # type: ignore[arg-type]
    cube.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*sides))
    hide(cube, look)
    UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    define_visual(stage, visual_path(path), "cuboid", p, sides, look)  # type: ignore[arg-type]
    return cube.GetPrim()


def define_visual(
    stage: Usd.Stage,
    path: Sdf.Path,
    shape: str,
    p: Vec3,
    size_m: Vec3,
    look: Sdf.Path,
    *,
    q_xyzw: Quat | None = None,
) -> Usd.Prim:
    """A shown mesh: a unit shape by reference, placed and scaled, with the material at `look`.

    Programs differ in how they show cubes, cylinders and spheres: Blender drops their materials.

    Args:
        stage: Written to in its edit target.
        path: Its path.
        shape: cuboid, cylinder or sphere.
        p: Centre, in its parent [m].
        size_m: Sides; of a cylinder its diameter, diameter and height [m].
        look: Path of its material.
        q_xyzw: Orientation in its parent.
    """
    define_shapes(stage)
    if path.GetParentPath().name == VISUALS:
        UsdGeom.Xform.Define(stage, path.GetParentPath())
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.GetPrim().GetReferences().AddInternalReference(SHAPES.AppendChild(shape))
    write_pose(mesh.GetPrim(), p, q_xyzw)
    mesh.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*size_m))
    wear(mesh, look)
    return mesh.GetPrim()


def visual_path(path: Sdf.Path) -> Sdf.Path:
    """Path of the mesh that shows a collider or a source: of its name, in `VISUALS` beside it."""
    return path.GetParentPath().AppendChild(VISUALS).AppendChild(path.name)


def hide(gprim: UsdGeom.Gprim, look: Sdf.Path) -> None:
    """Make a gprim a guide, which programs do not show; the material at `look` gives its friction."""
    gprim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    bind(gprim, look)


def bind(gprim: UsdGeom.Gprim, look: Sdf.Path) -> None:
    """Bind the material at `look`."""
    material = UsdShade.Material.Get(gprim.GetPrim().GetStage(), look)
    UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)


def wear(gprim: UsdGeom.Gprim, look: Sdf.Path) -> None:
    """Bind the material at `look`, and author its colour on the prim too."""
    gprim.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*LOOKS[look.name].colour)]))
    bind(gprim, look)
