"""A summary of any stage."""

from collections import Counter
from pathlib import Path

from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.report.report import Figure, Report
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.placement import AT_ORIGIN, labs_on, pose_of
from magtwin.usd.scene import open_scene
from magtwin.usd.units import metres_per_unit

_PREFIX = "Magtwin"
_MANY = ("MagtwinMagneticSourceAPI", "MagtwinFurnitureAPI")
"""Schemas that are on many prims, so that only their number is shown."""


@translates
def info_of_stage(path: Path) -> Report:
    """Units, extent, bodies, joints, mass and magnetic prims of a stage."""
    stage = open_stage(path)
    prims = list(stage.TraverseAll())
    bodies = [p for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    joints = Counter(p.GetTypeName().removeprefix("Physics") for p in prims if p.IsA(UsdPhysics.Joint))
    weighed = [UsdPhysics.MassAPI(p) for p in bodies if p.HasAPI(UsdPhysics.MassAPI)]
    mass = sum(body.GetMassAttr().Get() or 0.0 for body in weighed)
    purposes = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render]
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes).ComputeWorldBound(stage.GetPseudoRoot())
    bounds = box.ComputeAlignedRange()
    metres, kilograms = metres_per_unit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    size = None if bounds.IsEmpty() else " x ".join(f"{s * metres:.3f}" for s in bounds.GetSize())
    figures = [
        Figure("default prim", str(stage.GetDefaultPrim().GetPath()) if stage.GetDefaultPrim() else "none"),
        Figure("metres per unit", metres),
        Figure("up axis", str(UsdGeom.GetStageUpAxis(stage))),
        Figure("layers", len(stage.GetUsedLayers())),
        Figure("prims", len(prims)),
        Figure("size", "no shapes" if size is None else size, "" if size is None else "m"),
        Figure("rigid bodies", len(bodies)),
        Figure("joints", sum(joints.values()), note=", ".join(f"{n} {t}" for t, n in sorted(joints.items()))),
        Figure("mass", float(mass) * kilograms, "kg"),
    ]
    places: dict[str, list[str]] = {}
    for prim in prims:
        for schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
            if schema.startswith(_PREFIX):
                places.setdefault(schema, []).append(str(prim.GetPath()))
    figures += [Figure(name, ", ".join(paths)) for name, paths in places.items() if name not in _MANY]
    figures += [Figure(name, len(places[name]), "prims") for name in _MANY if name in places]
    figures += _labs(path, stage)
    return Report(str(path), tuple(figures))


def _labs(path: Path, stage: Usd.Stage) -> list[Figure]:
    """Where each lab stands, if not at the origin, and what has changed since its map was made."""
    figures = []
    for lab in {lab.path: lab for lab in labs_on(stage)}.values():
        try:
            pose = pose_of(lab)
        except InputError as error:
            figures.append(Figure(f"lab {lab.path}", "cannot be used", note=str(error)))
            continue
        if pose != AT_ORIGIN:
            figures.append(Figure(f"lab {lab.path}", str(pose)))
        try:
            opened = open_scene(path, lab=lab.path, check_network=False)
        except InputError as error:
            figures.append(Figure("cannot be run", str(error)))
            continue
        if opened.map.made_from is not None:
            figures.append(Figure("map made from", str(opened.map.made_from)))
        if opened.changes:
            note = f"magtwin map survey {path} --out MAP.usdc --adopt surveys again"
            figures.append(Figure("changed since", "; ".join(opened.changes), note=note))
        figures += [Figure("note", text) for text in opened.notes]
    return figures
