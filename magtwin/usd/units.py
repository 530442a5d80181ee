"""Units of layers: USD converts none, so a layer in other units must be scaled where it is brought in."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pxr import Pcp, Sdf, Usd, UsdGeom

from magtwin.errors import InputError
from magtwin.usd.schema import place

SAME = 1e-3
"""Largest relative difference of a scale from the one that is needed."""


LONGEST_M = 1e9
"""Longest unit of a stage [m]; the shortest is its inverse."""


def check_units(stage: Usd.Stage) -> None:
    """Refuse a stage with a layer in other units that nothing scales or turns.

    A sublayer must have the units of the root layer. What a prim references or loads must too, or the prim
    must scale it, and turn it if its up axis differs.

    Raises:
        InputError: There is one; names the prim or the root layer, the layer and what to do.
    """
    for text in mixed_units(stage):
        raise InputError(text)


def mixed_units(stage: Usd.Stage) -> Iterator[str]:
    """One text for each layer whose units differ from those of the layer that brings it in.

    Only authored units count. A layer without any is taken to be in those of the stage.
    """
    root = stage.GetRootLayer()
    own = _units(root, root)
    foreign = {layer for layer in stage.GetUsedLayers() if layer.realPath and _units(layer, root) != own}
    if not foreign:
        return
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        if layer in foreign:
            yield (
                f"{root.realPath}: its sublayer {layer.realPath} has {said(_units(layer, root))}, the stage "
                f"{said(own)}, and USD converts neither; reference it from a prim that scales it, or "
                "convert it"
            )
    for prim in stage.Traverse():
        seen: set[Sdf.Layer] = set()
        for node in _nodes(prim.GetPrimIndex().rootNode):
            layer, above = node.layerStack.identifier.rootLayer, node.parent.layerStack.identifier.rootLayer
            there, here = _units(layer, root), _units(above, root)
            if (
                node.arcType not in (Pcp.ArcTypeReference, Pcp.ArcTypePayload)
                or layer in seen
                or there == here
            ):
                continue
            if node.GetDepthBelowIntroduction() or _converted(prim, there, here):
                continue
            seen.add(layer)
            turn = "" if there[1] == here[1] else f" and {'rotateX -90' if here[1] == 'Y' else 'rotateX 90'}"
            yield (
                f"{place(prim)}: brings in {layer.realPath} of {said(there)}, in {said(here)}, and USD "
                f"converts neither; give it scale {there[0] / here[0]:g}{turn}, or convert that file"
            )


def metres_per_unit(stage: Usd.Stage) -> float:
    """Length of a unit of a stage [m].

    Raises:
        InputError: It is no length.
    """
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    if not 1 / LONGEST_M <= metres <= LONGEST_M:
        raise InputError(
            f"{stage.GetRootLayer().identifier}: metersPerUnit is {metres:g}, which is no length of a unit; "
            "write 1 for metres or 0.01 for centimetres"
        )
    return metres


def upright(stage: Usd.Stage, points: NDArray) -> NDArray:
    """Points in world of a stage, shape (N, 3), in metres with Z up; errors as for `metres_per_unit`."""
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        points = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])
    return np.asarray(points * metres_per_unit(stage))


def _nodes(node: Pcp.NodeRef) -> Iterator[Pcp.NodeRef]:
    """The arcs below a prim's own opinions."""
    for child in node.children:
        yield child
        yield from _nodes(child)


def _units(layer: Sdf.Layer, root: Sdf.Layer) -> tuple[float, str]:
    """Metres a unit and up axis of a layer; those of the root where the layer has none."""
    found = []
    for name, default in (("metersPerUnit", 0.01), ("upAxis", "Y")):
        by = layer.pseudoRoot if layer.pseudoRoot.HasInfo(name) else root.pseudoRoot
        found.append(by.GetInfo(name) if by.HasInfo(name) else default)
    return round(float(found[0]), 9), str(found[1])


def said(units: tuple[float, str]) -> str:
    """Metres a unit and up axis in words."""
    return f"{units[0]:g} m a unit and {units[1]} up"


def _converted(prim: Usd.Prim, there: tuple[float, str], here: tuple[float, str]) -> bool:
    """Whether a prim's own transform scales what it brings in, and turns it from its up axis to the other."""
    xform = UsdGeom.Xformable(prim)
    if not xform:
        return there[0] == here[0] and there[1] == here[1]
    rows = np.array(xform.GetLocalTransformation())[:3, :3]
    size = float(abs(np.linalg.det(rows))) ** (1 / 3)
    scaled = there[0] == here[0] or math.isclose(size, there[0] / here[0], rel_tol=SAME)
    if there[1] == here[1]:
        return scaled
    up = rows["XYZ".index(there[1])]
    return scaled and bool(up["XYZ".index(here[1])] > (1 - SAME) * np.linalg.norm(up))
