"""Where a lab stands on its stage: found, checked, and taken to the origin.

A lab's root is the nearest prim above it that also holds its map. The lab, its map, its sources and its
robots are relative to that prim, so it can be moved, turned about the vertical and referenced anywhere, also
by a stage in other units. `take_to_origin` places the stage so that the root's axes become the world's: the
readers of `magtwin.usd` then read every place in the lab's axes, in metres with Z up. What is below the root
keeps its numbers to the bit.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from magtwin.errors import InputError
from magtwin.usd.schema import has_api, only_prim_with, place, prims_with
from magtwin.usd.sensors import MAP_RELATIONSHIP
from magtwin.usd.units import said

SAME = 1e-6
"""Largest relative error of a length that counts as none."""

UPRIGHT = 1 - 1e-9
"""Cosine of the tilt of a lab that counts as level: 0.003 deg."""

_PLACED = "xformOp:transform:magtwinLab"


@dataclass(frozen=True)
class Lab:
    """A lab on a stage. Its prims are only valid while the stage is."""

    prim: Usd.Prim
    """The prim with the lab schema."""

    root: Usd.Prim
    """The prim that moves with the whole lab; the pseudo-root if lab and map have no prim in common."""

    @property
    def path(self) -> str:
        """Path of the root."""
        return str(self.root.GetPath())


@dataclass(frozen=True)
class Pose:
    """The pose of a lab's axes in its stage, in metres with Z up."""

    p: tuple[float, float, float]
    """Origin [m]."""

    yaw: float
    """Angle about the vertical [rad]."""

    def __str__(self) -> str:
        x, y, z = (round(c, 4) + 0.0 for c in self.p)
        return f"({x:g}, {y:g}, {z:g}) m, turned by {math.degrees(self.yaw):.4g} deg"


AT_ORIGIN = Pose((0.0, 0.0, 0.0), 0.0)


def labs_on(stage: Usd.Stage) -> list[Lab]:
    """Every lab of a stage, in order of the prims. Instances that hold one become ordinary prims."""
    _open_instances(stage)
    world = stage.GetPseudoRoot()
    maps = [prim.GetPath() for prim in prims_with(world, "anomalyMap")]
    return [Lab(prim, _root_of(prim, maps)) for prim in prims_with(world, "lab")]


def lab_on(stage: Usd.Stage, name: str = "") -> Lab:
    """One lab of a stage.

    Args:
        stage: The stage.
        name: Path of the lab's root, of a prim that holds this lab only, or name of the root. "" is the only
            lab of the stage.

    Raises:
        InputError: There is no lab, several of which none is named, or none of that name.
    """
    labs = labs_on(stage)
    if not labs:
        only_prim_with(stage.GetPseudoRoot(), "lab")  # refuses
    where = f"{stage.GetRootLayer().realPath or stage.GetRootLayer().identifier}"
    known = ", ".join(lab.path for lab in labs)
    if not name:
        if len(labs) > 1 and len({lab.path for lab in labs}) == 1:
            only_prim_with(stage.GetPseudoRoot(), "lab")  # refuses
        if len(labs) > 1:
            raise InputError(f"{where}: has {len(labs)} labs, {known}; name one with `lab`", parameter="lab")
        return labs[0]
    fits = [lab for lab in labs if name in (lab.path, str(lab.prim.GetPath()), lab.root.GetName())]
    if not fits and Sdf.Path.IsValidPathString(name):
        fits = [lab for lab in labs if lab.root.GetPath().HasPrefix(Sdf.Path(name))]
    if len(fits) != 1:
        what = f"{len(fits)} labs are" if fits else "no lab is"
        raise InputError(f"{where}: {what} at {name!r}; known: {known}", parameter="lab")
    return fits[0]


def nearest_lab(prim: Usd.Prim, labs: list[Lab]) -> Lab | None:
    """The lab whose root is nearest above a prim; None if the prim is outside every lab."""
    above = [lab for lab in labs if prim.GetPath().HasPrefix(lab.root.GetPath())]
    return max(above, key=lambda lab: lab.root.GetPath().pathElementCount, default=None)


def pose_of(lab: Lab) -> Pose:
    """The pose of a lab in its stage.

    Raises:
        InputError: The lab is tilted, scaled or mirrored, or its lab or map prim is moved inside it; names
            the prim.
    """
    _check_inside(lab)
    stage = lab.root.GetStage()
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    if not 0 < metres < math.inf:
        text = f"its metersPerUnit is {metres:g}; set it to 1, and make the stage in metres"
        raise InputError(f"{stage.GetRootLayer().identifier}: {text}")
    level = _level(stage)
    world = _world(lab.root)
    rows = np.array(world)[:3, :3] * metres
    lengths = np.linalg.norm(rows, axis=1)
    right = np.abs(lengths - 1).max() <= SAME and np.abs(rows @ rows.T - np.eye(3)).max() <= SAME
    if not (right and np.linalg.det(rows) > 0 and rows[2] @ level[:, 2] >= UPRIGHT):
        raise _refused(lab, metres)
    p = np.array(world.ExtractTranslation()) * metres @ level
    ahead = rows[0] @ level
    return Pose((float(p[0]), float(p[1]), float(p[2])), float(math.atan2(ahead[1], ahead[0])))


def into_lab(lab: Lab, prim: Usd.Prim) -> Gf.Matrix4d:
    """The transform from a prim's axes to a lab's in metres; exactly 1 if both have the same axes."""
    world, root = _world(prim), _world(lab.root)
    return Gf.Matrix4d(1) if world == root else world * root.GetInverse()


def take_to_origin(stage: Usd.Stage, lab: Lab) -> None:
    """Make the axes of a lab those of the world, in metres with Z up, in the stage's session layer.

    Other labs are made inactive, with their robots. Nothing is written to a file.

    Raises:
        InputError: As for `pose_of`.
    """
    pose_of(lab)
    others = [other for other in labs_on(stage) if other.root != lab.root]
    gone = list(_of_others(stage, lab, others))
    session = Usd.EditContext(stage, stage.GetSessionLayer())
    with session:
        for prim in gone:
            prim.SetActive(False)
    root, world = lab.root, _world(lab.root)
    level = UsdGeom.LinearUnitsAre(UsdGeom.GetStageMetersPerUnit(stage), 1) and _level(stage)[2, 2] == 1
    if level and world == Gf.Matrix4d(1):
        return
    inverse = world.GetInverse()
    movable = [prim for prim in _movable(stage.GetPseudoRoot()) if prim != root]
    outside = [(prim, UsdGeom.Xformable(prim).GetLocalTransformation() * inverse) for prim in movable]
    with session:
        UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        for prim, matrix in outside:
            xform = UsdGeom.Xformable(prim)
            reset = xform.GetResetXformStack()
            attribute = prim.CreateAttribute(_PLACED, Sdf.ValueTypeNames.Matrix4d, custom=False)
            attribute.Set(matrix)
            xform.SetXformOpOrder([UsdGeom.XformOp(attribute)], reset)
        if not root.IsPseudoRoot():
            UsdGeom.Xformable(root).SetXformOpOrder([], True)


def _world(prim: Usd.Prim) -> Gf.Matrix4d:
    return UsdGeom.XformCache().GetLocalToWorldTransform(prim)


def _level(stage: Usd.Stage) -> np.ndarray:
    """Rotation of row vectors from the stage's axes to Z up (3, 3): 90 deg about x for Y up."""
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        return np.eye(3)
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def _root_of(prim: Usd.Prim, maps: list[Sdf.Path]) -> Usd.Prim:
    """The nearest prim at or above a lab's that holds a map."""
    root = prim
    while not root.IsPseudoRoot() and not any(path.HasPrefix(root.GetPath()) for path in maps):
        root = root.GetParent()
    return root if maps else prim.GetParent()


def _open_instances(stage: Usd.Stage) -> None:
    """Make instances that hold a lab, a map or a robot ordinary prims, in the session layer."""
    wanted = ("lab", "anomalyMap", "robot", "magnetometer")
    while stage.GetPrototypes():
        proxies = (p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsInstanceProxy())
        prim = next((p for p in proxies if any(has_api(p, noun) for noun in wanted)), None)
        if prim is None:
            return
        while prim.IsInstanceProxy():
            prim = prim.GetParent()
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            prim.SetInstanceable(False)


def _of_others(stage: Usd.Stage, lab: Lab, others: list[Lab]) -> Iterator[Usd.Prim]:
    """What belongs to other labs: their roots, or where these hold our lab, their lab, map and robots."""
    ours = lab.root.GetPath()
    theirs = [other.root.GetPath() for other in others]
    whole = [path for path in theirs if not ours.HasPrefix(path)]
    for path in whole:
        yield stage.GetPrimAtPath(path)
    for other in others:
        if other.root.GetPath() in whole or any(other.root.GetPath().HasPrefix(path) for path in whole):
            continue
        yield other.prim
        for prim in prims_with(other.root, "anomalyMap"):
            if _belongs(prim.GetPath(), other.root.GetPath(), [ours, *theirs]):
                yield prim
    for robot in prims_with(stage.GetPseudoRoot(), "robot"):
        path = robot.GetPath()
        if path.HasPrefix(ours) or any(path.HasPrefix(root) for root in whole):
            continue
        named = [m.GetRelationship(MAP_RELATIONSHIP) for m in prims_with(robot, "magnetometer")]
        maps = [target for relationship in named for target in relationship.GetForwardedTargets()]
        if any(_belongs(target, root, [ours, *theirs]) for target in maps for root in theirs):
            yield robot


def _belongs(path: Sdf.Path, root: Sdf.Path, roots: list[Sdf.Path]) -> bool:
    """Whether `root` is the nearest of several roots above a path."""
    above = [one for one in roots if path.HasPrefix(one)]
    return bool(above) and max(above, key=lambda one: one.pathElementCount) == root


def _movable(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """The topmost prims with a transform, and those below that reset the transforms above them."""
    pending = [(child, True) for child in prim.GetChildren()]
    while pending:
        prim, top = pending.pop()
        xform = UsdGeom.Xformable(prim)
        if xform and (top or xform.GetResetXformStack()):
            yield prim
        pending += [(child, top and not xform) for child in prim.GetChildren()]


def _check_inside(lab: Lab) -> None:
    """Refuse a lab or a map that is moved relative to the root, and so to one another."""
    cache = UsdGeom.XformCache()
    for prim in (lab.prim, *prims_with(lab.root, "anomalyMap")):
        if lab.prim != prim and _other_lab(lab, prim):
            continue
        off = into_lab(lab, prim) if not lab.root.IsPseudoRoot() else cache.GetLocalToWorldTransform(prim)
        if np.abs(np.array(off) - np.eye(4)).max() > SAME:
            where = f"move {lab.path} instead, which holds both"
            if lab.root.IsPseudoRoot():
                where = "put both below one prim and move that"
            raise InputError(
                f"{place(prim)}: is moved, turned or scaled by itself, so lab, map and robots no longer "
                f"share their axes; {where}"
            )


def _other_lab(lab: Lab, prim: Usd.Prim) -> bool:
    """Whether a map below a lab's root belongs to another lab below it."""
    others = [other for other in prims_with(lab.root, "lab") if other != lab.prim]
    while prim and prim != lab.root:
        if any(other.GetPath().HasPrefix(prim.GetPath()) for other in others):
            return True
        prim = prim.GetParent()
    return False


def _refused(lab: Lab, metres: float) -> InputError:
    """The error of a lab that does not stand level in its own size."""
    stage = lab.root.GetStage()
    z_up = _level(stage)[2, 2] == 1
    if not (UsdGeom.LinearUnitsAre(metres, UsdGeom.LinearUnits.meters) and z_up):
        units = said((metres, UsdGeom.GetStageUpAxis(stage)))
        turn = "" if z_up else " and rotateX -90"
        return InputError(
            f"{place(lab.root)}: the stage has {units}; magtwin reads metres with Z up, and USD converts "
            f"neither: reference the lab with scale {1 / metres:g}{turn}, or make the stage in metres, Z up"
        )
    for path in lab.root.GetPath().GetPrefixes():
        prim = stage.GetPrimAtPath(path)
        if not UsdGeom.Xformable(prim):
            continue
        rows = np.array(UsdGeom.Xformable(prim).GetLocalTransformation())[:3, :3]
        lengths = np.linalg.norm(rows, axis=1)
        what = ""
        if np.linalg.det(rows) <= 0:
            what = "mirrored or flat"
        elif np.abs(lengths - 1).max() > SAME:
            what = f"scaled by {', '.join(f'{s:g}' for s in lengths)}"
        elif np.abs(rows @ rows.T - np.eye(3)).max() > SAME:
            what = "sheared"
        elif rows[2, 2] < UPRIGHT:
            what = f"tilted by {math.degrees(math.acos(max(-1.0, rows[2, 2]))):.3g} deg"
        if what:
            return InputError(
                f"{place(prim)}: is {what}, and its lab with it; a lab can be moved and turned about the "
                "vertical, but neither tilted nor scaled"
            )
    text = "is tilted or scaled; a lab can be moved and turned about the vertical"
    return InputError(f"{place(lab.root)}: {text}")
