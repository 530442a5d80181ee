"""Furniture on a stage: looks, colliders and magnetised parts."""

from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Kind, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.frames import IDENTITY_XYZW
from magtwin.spec.furniture import BODY, GENERIC, FurnitureSpec, parts_of
from magtwin.spec.magnetics import SourceSpec
from magtwin.usd.attributes import check_prim_name, plain_value, write_pose
from magtwin.usd.lab.looks import define_looks
from magtwin.usd.lab.parts import define_part, named_source
from magtwin.usd.lab.sources import (
    LOOKS,
    SOURCES,
    read_source,
    read_transform,
    source_prims,
)
from magtwin.usd.lab.walls import read_walls
from magtwin.usd.layers import WORLD
from magtwin.usd.placement import labs_on
from magtwin.usd.schema import apply_api, attribute_name, author, has_api, place, prims_with

FURNITURE = WORLD.AppendChild("Furniture")
KIND = attribute_name("furniture", "kind")
MATERIAL = attribute_name("furniture", "material")
SIZE = attribute_name("furniture", "size_m")


def define_furniture(stage: Usd.Stage, furniture: tuple[FurnitureSpec, ...]) -> None:
    """Author pieces of furniture under /World/Furniture, each an Xform that can be moved as one.

    Args:
        stage: Written to in its edit target.
        furniture: The pieces.

    Raises:
        InputError: A name cannot name a prim.
    """
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, FURNITURE)).SetKind(Kind.Tokens.group)
    for spec in furniture:
        path = FURNITURE.AppendChild(check_prim_name(spec.name, "furniture"))
        piece = UsdGeom.Xform.Define(stage, path).GetPrim()
        Usd.ModelAPI(piece).SetKind(Kind.Tokens.component)
        turn = None if spec.q_world_xyzw == IDENTITY_XYZW else spec.q_world_xyzw
        write_pose(piece, spec.p_world, turn)
        author(apply_api(piece, "furniture").GetAttribute(KIND), spec.kind)
        if spec.kind in GENERIC:
            author(piece.GetAttribute(MATERIAL), spec.material)
            author(piece.GetAttribute(SIZE), spec.size_m)
        parts = spec.parts
        define_looks(stage, path.AppendChild(LOOKS), dict.fromkeys(part.look for part in parts))
        steel = {source.name.removeprefix(f"{spec.name}_"): source for source in spec.sources(in_world=False)}
        for part in parts:
            prim = define_part(stage, path, part, steel.get(part.name))
            UsdPhysics.CollisionAPI.Apply(prim)


def read_magnets(stage: Usd.Stage) -> tuple[tuple[SourceSpec, ...], tuple[FurnitureSpec, ...]]:
    """Every magnetised thing of a stage: its sources, and its furniture.

    A piece that was moved or turned as a whole is read at its new place. A piece with a part that was moved,
    scaled, added or magnetised differently is read as separate sources.

    Raises:
        InputError: A source is part of a robot, or as for `read_source`.
    """
    robots = [prim.GetPath() for prim in prims_with(stage.GetPseudoRoot(), "robot")]
    prims = source_prims(stage)
    pieces, taken = [], set()
    for root in stage.Traverse(Usd.TraverseInstanceProxies()):
        if has_api(root, "furniture") and (piece := _whole(root, prims)):
            pieces.append(piece)
            taken |= {prim.GetPath() for prim in prims if prim.GetPath().HasPrefix(root.GetPath())}
    for lab in prims_with(stage.GetPseudoRoot(), "lab"):
        taken |= read_walls(lab).sources
    sources: list[SourceSpec] = []
    names: set[str] = set()
    labs = {lab.root.GetPath() for lab in labs_on(stage)} - {Sdf.Path.absoluteRootPath}
    root_path = labs.pop() if len(labs) == 1 else WORLD
    for prim in prims:
        if robot := next((r for r in robots if prim.GetPath().HasPrefix(r)), None):
            text = f"a magnetic source on the robot {robot}, which moves"
            raise InputError(f"{place(prim)}: {text}; author it as the robot's platform field")
        if prim.GetPath() not in taken:
            sources.append(read_source(prim, name=_name(prim, root_path, names)))
            names.add(sources[-1].name)
    return tuple(sources), tuple(pieces)


def _whole(root: Usd.Prim, prims: list[Usd.Prim]) -> FurnitureSpec | None:
    """The piece of furniture at a prim; None if its steel parts are not those of its kind."""
    own = [prim for prim in prims if prim.GetPath().HasPrefix(root.GetPath())]
    p, q, scale = read_transform(root)
    if max(abs(s - 1) for s in scale) > 1e-9 or any(prim.GetParent() != root for prim in own):
        return None
    kind = plain_value(root.GetAttribute(KIND))
    if kind not in GENERIC:
        parts_of(kind)  # raises if the kind is unknown
    try:
        known = {"name": root.GetName(), "kind": kind, "p_world": p, "q_world_xyzw": q}
        bare = FurnitureSpec(**known, **_generic(root, kind))  # type: ignore[arg-type]
        along = {part.name: part.along for part in bare.parts if part.steel}
        steel = [read_source(prim, local=True) for prim in own]
        strength = tuple(source.magnetization[along.get(source.name, 0)] for source in steel)
        figures = {"magnetization": strength} | ({"susceptibility": steel[0].susceptibility} if steel else {})
        spec = replace(bare, **figures)  # type: ignore[arg-type]
    except InputError:  # it has more parts, or fewer
        return None
    wanted = spec.sources(in_world=False)
    same = [named_source(source, source.name.removeprefix(f"{spec.name}_")) for source in wanted]
    return spec if steel == same else None


def _generic(root: Usd.Prim, kind: str) -> dict[str, Any]:
    """Material and size of a generic piece, or vertices and faces; empty for other kinds."""
    if kind not in GENERIC:
        return {}
    given: dict[str, Any] = {"material": plain_value(root.GetAttribute(MATERIAL))}
    if kind != "mesh":
        return given | {"size_m": plain_value(root.GetAttribute(SIZE))}
    mesh = UsdGeom.Mesh(root.GetStage().GetPrimAtPath(root.GetPath().AppendChild(BODY)))
    if not mesh:
        raise InputError(f"{place(root)}: a mesh without its {BODY}")
    points = np.array(mesh.GetPointsAttr().Get() or [], float).reshape(-1, 3)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], int)
    if (mesh.GetFaceVertexCountsAttr().Get() or [0]) != [3] * (len(faces) // 3):
        raise InputError(f"{place(root)}: its {BODY} is not of triangles")
    return given | {
        "vertices_m": tuple(map(tuple, points.tolist())),
        "faces": tuple(map(tuple, faces.reshape(-1, 3).tolist())),
    }


def _name(prim: Usd.Prim, root: Sdf.Path, taken: set[str]) -> str:
    """Unique name of a source: its prim's below the lab's Sources, else the path of prims down to it."""
    path, sources = prim.GetPath(), root.AppendChild(SOURCES.name)
    anchor = sources if path.GetParentPath() == sources else root if path.HasPrefix(root) else Sdf.Path("/")
    name = path.MakeRelativePath(anchor).pathString.replace("/", "_")
    number, free = 2, name
    while free in taken:
        number, free = number + 1, f"{name}_{number}"
    return free
