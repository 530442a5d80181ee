"""Walls on a stage: their boxes, doors that turn about their hinges, and windows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError, about
from magtwin.frames import IDENTITY_XYZW, quat_from_yaw, yaw_from_quat
from magtwin.spec.base import Quat, Vec3
from magtwin.spec.furniture import Part
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.walls import Door, Wall, Window, parts_of_wall, sources_of_wall
from magtwin.usd.attributes import read_spec, write_pose, write_spec
from magtwin.usd.lab.looks import define_looks
from magtwin.usd.lab.parts import define_part, named_source
from magtwin.usd.lab.sources import LOOKS, read_source, read_transform, source_prims
from magtwin.usd.layers import WORLD
from magtwin.usd.schema import apply_api, has_api, place, prims_with

WALLS = WORLD.AppendChild("Lab").AppendChild("Walls")
UPRIGHT = 1e-9
"""Largest tilt, scale and lift of a wall or door that is read as one."""


def define_walls(stage: Usd.Stage, lab: LabSpec) -> None:
    """Author walls below /World/Lab/Walls, each an Xform at its start with x along it.

    Its children are its boxes, and an Xform for each door, at its hinge, and each window. A side of the room
    has no attributes of its own, since it is derived from the room's.

    Args:
        stage: Written to in its edit target.
        lab: The room.
    """
    structure = lab.structure
    UsdGeom.Xform.Define(stage, WALLS)
    for wall in (*structure.sides, *structure.walls):
        own = wall in structure.walls
        path = WALLS.AppendChild(wall.name if own or lab.floor else wall.name.capitalize())
        prim = UsdGeom.Xform.Define(stage, path).GetPrim()
        write_pose(prim, (*wall.start, 0.0), wall.q_world_xyzw)
        if own:
            write_spec(apply_api(prim, "wall"), "wall", wall, skip=("name",))
        openings = structure.openings(wall)
        steel = {source.name: source for source in sources_of_wall(wall, openings, in_world=False)}
        _define_parts(stage, path, parts_of_wall(wall, openings), steel)
        for opening in openings:
            _define_opening(stage, path, wall, opening, steel)


def _define_parts(
    stage: Usd.Stage, path: Sdf.Path, parts: Sequence[Part], steel: dict[str, SourceSpec]
) -> None:
    """Parts as colliders below a prim."""
    define_looks(stage, path.AppendChild(LOOKS), dict.fromkeys(part.look for part in parts))
    for part in parts:
        UsdPhysics.CollisionAPI.Apply(define_part(stage, path, part, steel.get(part.name)))


def _define_opening(
    stage: Usd.Stage, wall_path: Sdf.Path, wall: Wall, opening: Door | Window, steel: dict[str, SourceSpec]
) -> None:
    """The Xform of a door, with its leaf, or of a window, in its middle."""
    path = wall_path.AppendChild(opening.name)
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    noun = "door" if isinstance(opening, Door) else "window"
    write_spec(apply_api(prim, noun), noun, opening, skip=("name", "wall"))
    write_pose(prim, *_pose_of(opening, wall))
    made = opening.leaf(wall) if isinstance(opening, Door) else None
    if made:
        part, source = made[0], steel.get(f"{opening.name}_leaf")
        named = {} if source is None else {part.name: named_source(source, part.name)}
        _define_parts(stage, path, [part], named)


def _pose_of(opening: Door | Window, wall: Wall) -> tuple[Vec3, Quat]:
    """Pose of the prim of an opening, in the wall's axes."""
    if isinstance(opening, Window):
        return (opening.at_m, 0.0, opening.sill_m + opening.height_m / 2), IDENTITY_XYZW
    made = opening.leaf(wall)
    if made is None:
        return (opening.at_m, 0.0, 0.0), IDENTITY_XYZW
    _, hinge, turn = made
    x, y, z, w = quat_from_yaw(turn).tolist()
    return (*hinge, 0.0), (x, y, z, w)


@dataclass(frozen=True)
class ReadWalls:
    """Walls of a stage."""

    walls: tuple[Wall, ...] = ()
    doors: tuple[Door, ...] = ()
    windows: tuple[Window, ...] = ()

    sources: frozenset[Sdf.Path] = frozenset()
    """Prims of magnetic sources that are the steel of these walls and doors."""


def read_lab(lab: Usd.Prim) -> LabSpec:
    """The spec of an authored lab, with its walls, doors and windows.

    Raises:
        InputError: The prim is no lab, or a value is out of range.
    """
    read, room = read_walls(lab), _read_room(lab)
    if not (read.walls or read.doors or read.windows):
        return room
    with about(f"{place(lab)}:"):
        return replace(room, walls=read.walls, doors=read.doors, windows=read.windows)


def _read_room(lab: Usd.Prim) -> LabSpec:
    return read_spec(LabSpec, lab, "lab", walls=(), doors=(), windows=())


def read_walls(lab: Usd.Prim) -> ReadWalls:
    """Walls of a lab's prim, and doors and windows in them and in the sides of the room.

    A wall that was moved or turned on the floor is read at its new place, a door that was turned about its
    hinge at its new angle. Steel that was moved otherwise, scaled or magnetised differently is read as
    separate sources; its wall and doors then have no magnetization.
    """
    prims = [prim for prim in prims_with(lab, "wall") if prim != lab]
    inside = [prim for noun in ("door", "window") for prim in prims_with(lab, noun)]
    if not (prims or inside):
        return ReadWalls()
    steel = source_prims(lab.GetStage())
    walls, doors, windows, taken = list[Wall](), list[Door](), list[Window](), set[Sdf.Path]()
    sides = {side.name: side for side in _read_room(lab).sides}
    places = {prim.GetPath(): prim for prim in prims}
    for prim in inside:
        places.setdefault(prim.GetPath().GetParentPath(), prim.GetParent())
    for path, prim in places.items():
        wall = _read_wall(prim) if has_api(prim, "wall") else sides.get(path.name.casefold())
        if wall is None:
            raise InputError(f"{path}: has a door or window and is no wall; put MagtwinWallAPI on it")
        own = [each for each in inside if each.GetPath().GetParentPath() == path]
        openings = [_read_opening(each, wall) for each in own]
        mine = [s for s in steel if s.GetPath().HasPrefix(path)]
        wanted = {s.name: s for s in sources_of_wall(wall, openings, in_world=False)}
        names = [s.GetPath().MakeRelativePath(path).pathString.replace("/", "_") for s in mine]
        found = {name: read_source(s, local=True) for name, s in zip(names, mine, strict=True)}
        if found == {name: replace(s, name=found[name].name) for name, s in wanted.items() if name in found}:
            taken |= {s.GetPath() for s in mine}
        else:
            none = {"magnetization": 0.0, "susceptibility": 0.0}
            wall = replace(wall, **none)  # type: ignore[arg-type]
            openings = [replace(o, **none) if isinstance(o, Door) else o for o in openings]  # type: ignore[arg-type]
        walls += [wall] if has_api(prim, "wall") else []
        doors += [each for each in openings if isinstance(each, Door)]
        windows += [each for each in openings if isinstance(each, Window)]
    return ReadWalls(tuple(walls), tuple(doors), tuple(windows), frozenset(taken))


def _read_wall(prim: Usd.Prim) -> Wall:
    """The wall of a prim, where it stands."""
    wall = read_spec(Wall, prim, "wall", name=prim.GetName())
    p, q, scale = read_transform(prim)
    if (p, q) == ((*wall.start, 0.0), wall.q_world_xyzw):
        return wall
    if not _upright(p, q, scale):
        raise InputError(
            f"{prim.GetPath()}: a wall that is tilted, scaled or lifted; move or turn it on the floor"
        )
    yaw = float(yaw_from_quat(q))
    end = p[0] + wall.length_m * math.cos(yaw), p[1] + wall.length_m * math.sin(yaw)
    return replace(wall, start=(p[0], p[1]), end=end)


def _read_opening(prim: Usd.Prim, wall: Wall) -> Door | Window:
    """The door or window of a prim in a wall."""
    known = {"name": prim.GetName(), "wall": wall.name}
    if has_api(prim, "window"):
        return read_spec(Window, prim, "window", **known)
    door = read_spec(Door, prim, "door", **known)
    (hinge, q), (p, turn, scale) = _pose_of(door, wall), read_transform(prim, local=True)
    if turn == q or door.leaf(wall) is None or not _upright(p, turn, scale) or math.dist(p, hinge) > 1e-6:
        return door
    angle = round(math.degrees(float(yaw_from_quat(turn))), 9)
    return replace(door, open_deg=-angle if door.hinge == "end" else angle)


def _upright(p: Vec3, q: Quat, scale: Vec3) -> bool:
    """Whether a pose is on the floor, turned about the vertical alone."""
    return max(abs(p[2]), abs(q[0]), abs(q[1]), *(abs(s - 1) for s in scale)) < UPRIGHT
