"""Walls, doors and windows of a scene's TOML, their default magnetization, and what stands in them."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from magtwin.author.furniture import drawn_magnetization
from magtwin.errors import InputError, MismatchWarning
from magtwin.files.settings import refused_at
from magtwin.frames import rotate
from magtwin.spec.furniture import BODY, MATERIALS, FurnitureSpec, Part
from magtwin.spec.lab import LabSpec, off_floor_m
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.walls import NO_LEAF, Door, Structure, Wall, Window, overlap_m
from magtwin.usd.lab.furniture import FURNITURE
from magtwin.usd.lab.walls import WALLS

W = TypeVar("W", Wall, Door)

IN_WALL_M = 0.01
"""Furniture that is not deeper in a wall than this touches it [m]."""


@dataclass(frozen=True)
class WallTable(Wall):
    """A straight wall from point to point, in the room or around it."""

    magnetization: float | None = None  # type: ignore[assignment]
    """Magnetization along the wall [A/m]. Default: drawn from the seed, as for furniture: 5 to 50 A/m of
    either sign for reinforced concrete, 0 without steel."""


@dataclass(frozen=True)
class DoorTable(Door):
    """A door in a wall: an opening from the floor up, with a leaf that turns. An open door can be driven
    through; a closed one is an obstacle.
    """

    magnetization: float | None = None  # type: ignore[assignment]
    """Magnetization of the leaf along its longest side [A/m]. Default: drawn from the seed, as for furniture,
    0 without steel."""


def _drawn(cls: type[W], table: Any, length_m: float, seed: int) -> W:
    """The wall or door of a table."""
    values = {f.name: getattr(table, f.name) for f in fields(cls)}  # type: ignore[arg-type]
    if values["magnetization"] is None:
        look = MATERIALS[table.material] if table.material != NO_LEAF else ""
        body = Part(BODY, (0, 0, 0), (length_m, table.thickness_m, table.height_m), look)
        drawn = drawn_magnetization(table.name, [body], seed=seed)
        values["magnetization"] = drawn[0] if drawn else 0.0
    return cls(**values)


def lab_with_walls(
    lab: LabSpec,
    walls: Sequence[Wall],
    doors: Sequence[Door],
    windows: Sequence[Window],
    path: str | os.PathLike[str],
    *,
    seed: int,
) -> LabSpec:
    """A room with walls, doors and windows; steel without a magnetization draws it from the seed.

    Args:
        lab: The room.
        walls: Walls, or tables of walls, in order.
        doors: Doors, or tables of doors, in order.
        windows: Windows, in order.
        path: The TOML of the tables, for error messages.
        seed: Seed of the scene.

    Raises:
        InputError: A door or window is in no wall or not within it, or a wall stands in one or off the floor;
            the text has file and line.
    """
    if not (walls or doors or windows):
        return lab
    built = Structure.named(walls, doors, windows, lab.sides)
    for section, number, key, text in built.faults():
        raise refused_at(path, key, text, section=section, number=number)
    own_walls = tuple(_drawn(Wall, wall, wall.length_m, seed) for wall in built.walls)
    own_doors = tuple(_drawn(Door, door, door.width_m, seed) for door in built.doors)
    made = replace(lab, walls=own_walls, doors=own_doors, windows=built.windows)
    for number, wall in enumerate(made.walls):
        p_xy, beyond = off_floor_m(wall, lab)
        x, y = p_xy[beyond.argmax()]
        floor = "floor" if lab.floor else "floor_m"
        text = f"end it at the floor's border, or enlarge {floor} of [lab]"
        text = f"reaches {beyond.max():.2f} m off the floor at ({x:.2f}, {y:.2f}); {text}"
        if beyond.min() > 0:
            text = f"wall {wall.name!r} stands off the floor and {text}"
            raise refused_at(path, "from", text, section="wall", number=number)
        if beyond.max() > 0:
            warnings.warn(f"{path}: wall {wall.name!r} {text}", MismatchWarning, stacklevel=2)
    return made


def _outline(piece: FurnitureSpec, part: Part) -> np.ndarray:
    """Outline of the box of a part of a piece on the floor, shape (4, 2) [m]."""
    signs = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    box = np.array(part.p) + signs * np.array(part.size_m) / 2
    return np.asarray((rotate(piece.q_world_xyzw, box) + piece.p_world)[:, :2])


def check_not_in_walls(
    pieces: Sequence[FurnitureSpec], lab: LabSpec, obstacles: Obstacles, path: str | os.PathLike[str]
) -> None:
    """Refuse furniture that stands in a wall, in the leaf of a door, or through a side of a floor with
    corners. Warn of a piece that stands through a side of a rectangle.

    Args:
        pieces: Furniture, in the order of its tables in `path`.
        lab: The room.
        obstacles: Those of the room and its furniture.
        path: The TOML, for error messages.

    Raises:
        InputError: A piece does; the text has its line, the wall and the depth.
    """
    placed = list(zip(obstacles.names, obstacles.outlines, strict=True))
    own = {wall.name for wall in lab.walls}
    walls = [(name.split("/")[4:], outline) for name, outline in placed if name.startswith(f"{WALLS}/")]
    numbers = {piece.name: number for number, piece in enumerate(pieces)}
    parts: dict[str, list[np.ndarray]] = {}
    for name, outline in placed:
        if name.startswith(f"{FURNITURE}/"):
            parts.setdefault(name.split("/")[3], []).append(outline)
    upper = {p.name: [_outline(p, part) for part in p.parts if not part.faces] for p in pieces}
    for piece, standing in parts.items():
        whole = Obstacles((piece,), (np.concatenate(standing),)).outlines  # a table's legs are beside a side
        outlines = [*standing, *upper.get(piece, ())]  # with what robots pass below, such as its top
        for wall_name, wall in walls:
            inner = wall_name[0] in own
            depths = [(overlap_m(outline, wall), outline) for outline in (outlines if inner else whole)]
            deep, outline = max(depths, key=lambda each: each[0])
            if deep <= IN_WALL_M:
                continue
            what = f"door {wall_name[1]!r}" if wall_name[-1] == "leaf" else f"wall {wall_name[0]!r}"
            x, y = outline.mean(axis=0)
            text = f"{piece!r} stands {deep:.2f} m deep in {what} at ({x:.2f}, {y:.2f}); move it"
            text += ", or end the wall there" if inner else " onto the floor"
            if not (inner or lab.floor):
                warnings.warn(f"{path}: {text}", MismatchWarning, stacklevel=2)
            elif piece not in numbers:
                raise InputError(f"{path}: {text}")
            else:
                raise refused_at(path, "p_world", text, section="furniture", number=numbers[piece])
