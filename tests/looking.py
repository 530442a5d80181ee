"""What a stage needs to look the same in Kit, Blender, usdview and on the web, by usd-core alone."""

from collections.abc import Sequence
from math import pi
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdLux, UsdPhysics, UsdShade

from magtwin.spec.lab import LabSpec
from magtwin.usd.lab.room import FLOOR_THICKNESS_M

LIGHT_W = (5.0, 100.0)
"""Power of a lamp in Blender, which takes pi times its intensity [W]."""

SKY = (0.1, 2.0)
"""Radiance of the sky, where 1 is white."""


def assert_looks_alike(root: Path) -> Usd.Stage:
    """What is shown is a mesh that wears a material, which its own prototype holds; primitives are guides."""
    stage = Usd.Stage.Open(str(root))
    shown = shown_gprims(stage)
    assert len(shown) > 5
    for prim in shown:
        assert prim.IsA(UsdGeom.Mesh), f"{prim.GetPath()}: a shown {prim.GetTypeName()}"
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        for part in [s.GetPrim() for s in subsets] or [prim]:
            material = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial()[0]
            assert material, f"{part.GetPath()}: no material"
            assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"
            top = part
            while top.IsInstanceProxy():
                top = top.GetParent()
            if top.IsInstance():
                assert material.GetPath().HasPrefix(top.GetPath()), f"{part.GetPath()}: material outside"
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.HasAPI(UsdPhysics.CollisionAPI) and prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Mesh):
            assert UsdGeom.Imageable(prim).ComputePurpose() == "guide", prim.GetPath()
    return stage


def assert_lit(stage: Usd.Stage) -> None:
    """Lights have values for Blender and usdview, and the root layer has Kit's exposure for them."""
    lights = [p for p in stage.Traverse() if p.HasAPI(UsdLux.LightAPI)]
    assert len(lights) == 5
    for prim in lights:
        light = UsdLux.LightAPI(prim)
        intensity = light.GetIntensityAttr().Get()
        assert light.GetExposureAttr().Get() == 0  # Blender ignores it
        if prim.IsA(UsdLux.DomeLight):
            assert SKY[0] <= intensity <= SKY[1]
        else:
            assert light.GetNormalizeAttr().Get()  # as Blender takes it
            assert LIGHT_W[0] <= pi * intensity <= LIGHT_W[1]
    settings = stage.GetRootLayer().customLayerData["renderSettings"]
    assert 100 <= settings["rtx:post:tonemap:cm2Factor"] <= 1000


def assert_within_room(stage: Usd.Stage, room: LabSpec, *, top_m: float) -> None:
    """The box around what is shown is the slab of the room, up to `top_m`."""
    half = np.array(room.floor_m) / 2 + room.wall_thickness_m + room.apron_m
    low, high = bounds(shown_gprims(stage))
    assert_allclose(low, [*-half, -FLOOR_THICKNESS_M], atol=1e-6)
    assert_allclose(high, [*half, top_m], atol=1e-6)


def shown_gprims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Gprims that a program shows by default."""
    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    shapes = [(p, UsdGeom.Imageable(p)) for p in prims if p.IsA(UsdGeom.Gprim)]
    return [
        p
        for p, i in shapes
        if i.ComputePurpose() in ("default", "render") and i.ComputeVisibility() != "invisible"
    ]


def bounds(prims: Sequence[Usd.Prim]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around prims in world [m]."""
    cache = UsdGeom.BBoxCache(0, ["default", "render"])
    boxes = [cache.ComputeWorldBound(p).ComputeAlignedRange() for p in prims]
    return np.min([b.GetMin() for b in boxes], axis=0), np.max([b.GetMax() for b in boxes], axis=0)
