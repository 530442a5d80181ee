"""A floor plan as the TOML of a scene: walls, doors and windows, and the floor that they enclose."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from magtwin.author.plan.drawing import Array, Drawing, Line
from magtwin.author.plan.dxf import read_dxf
from magtwin.author.plan.floor import as_bar, enclosed
from magtwin.author.plan.geojson import read_geojson
from magtwin.author.plan.grid import read_grid
from magtwin.author.plan.svg import read_svg
from magtwin.author.rooms import EARTH
from magtwin.author.tables import tables_of_lab, toml_text
from magtwin.errors import InputError, about
from magtwin.files.file import existing
from magtwin.spec.base import Vec2
from magtwin.spec.lab import LabSpec, off_floor_m
from magtwin.spec.walls import Door, Wall, Window, corners_of

READERS: Mapping[str, Callable[[Path], Drawing]] = MappingProxyType(
    {".svg": read_svg, ".dxf": read_dxf, ".geojson": read_geojson, ".json": read_geojson}
)
GRIDS = (".pgm", ".yaml", ".yml", ".png")
WORDS = (
    ("door", r"(?<!in)(?<!out)door|t(?:ue|ü)r(?![a-z])|porte|puerta"),
    ("window", r"window|glaz|fenster|fen[eê]tre|ventana"),
    ("", r"text|dim|anno|hatch|furn|m(?:oe|ö)bel|grid|axis|axes|title|stair|symbol|defpoints|equip|plumb"),
)
"""Words in the name of a layer that say what it is; of others, the lines are walls."""

HIGH_M = 2.5
"""Height of the sides of a floor whose border is drawn [m]."""

THICK_M, STROKES_M = 0.1, (0.04, 0.6)
"""Thickness of a wall, unless its stroke has a width in a range [m]."""

SHORT_M, NEAR_M = 0.03, 0.15
"""A shorter line is no wall, and a door within this distance of a wall is in it [m]."""

DOORS_M = (0.4, 4.0)
"""Widths of openings [m]."""

SIZE_M = (1.0, 1000.0)
"""Sizes of a plan [m]; another one is in another unit."""

MOST_WALLS = 3000
"""Most walls of a plan."""


@dataclass
class Plan:
    """What is read of a room."""

    floor: tuple[Vec2, ...] = ()
    sides: Mapping[str, float] = field(default_factory=dict)
    walls: list[Wall] = field(default_factory=list)
    openings: list[Door | Window] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def plan_toml(path: Path, name: str, scale: float | None = None) -> tuple[str, list[str]]:
    """The text of a TOML of the room in a floor plan or an occupancy map, and notes on how it was read.

    Args:
        path: .svg, .dxf, .geojson, or .pgm, .png or .yaml of an occupancy map.
        name: Name of the scene.
        scale: Metres per unit of the drawing, or per cell of a map. Default: what the file states.

    Raises:
        InputError: The file is of another kind or has no scale, no walls, or walls that a room cannot have.
    """
    path, suffix = existing(path, "floor plan"), path.suffix.lower()
    if suffix not in (*READERS, *GRIDS):
        kinds = ".svg, .dxf, .geojson, or .pgm or .yaml of an occupancy map"
        raise InputError(f"{path}: a floor plan is {kinds}")
    if scale is not None and not 0 < scale < math.inf:
        raise InputError(f"scale must be above 0 metres per unit, got {scale!r}", parameter="scale")
    if suffix in GRIDS:
        corners, bars, notes = read_grid(path, scale)
        walls = [_wall(k, p, thick) for k, (p, thick) in enumerate(bars)]
        plan = Plan(corners, {"wall_height_m": HIGH_M}, walls, notes=notes)
    else:
        plan = _plan(READERS[suffix](path), path, scale)
    if len(plan.walls) > MOST_WALLS:
        count = f"{len(plan.walls):,} walls, at most {MOST_WALLS:,}"
        raise InputError(f"{path}: {count}; leave out what is no wall")
    with about(f"{path}:"):
        lab = LabSpec(floor=plan.floor, **plan.sides)  # type: ignore[arg-type]
        off = {wall.name for wall in plan.walls if off_floor_m(wall, lab)[1].min() > 0}
        if off:
            plan.notes.append(f"{len(off)} lines left out that stand off the floor")
        openings = [each for each in plan.openings if each.wall not in off]
        lab = replace(
            lab,
            walls=tuple(wall for wall in plan.walls if wall.name not in off),
            doors=tuple(each for each in openings if isinstance(each, Door)),
            windows=tuple(each for each in openings if isinstance(each, Window)),
        )
    head = HEAD.format(name=name, file=path.name, notes="".join(f"# {note}\n" for note in plan.notes))
    return head + toml_text({"name": name, **REST, **tables_of_lab(lab)}), plan.notes


def _plan(drawing: Drawing, path: Path, scale: float | None) -> Plan:
    """The plan of a drawing."""
    if not drawing.lines:
        raise InputError(f"{path}: no lines in it; a plan has lines, polylines, polygons or rectangles")
    known = [(line, "door" if line.arc and _kind(line) == "wall" else _kind(line)) for line in drawing.lines]
    every = np.vstack([line.p for line, kind in known if kind] or [line.p for line in drawing.lines])
    low, size = every.min(axis=0), np.ptp(every, axis=0)
    way = (
        f"give `scale=M`, metres per unit of the drawing: it is {size[0]:.4g} x {size[1]:.4g} units large, "
        f"so that {10 / size.max():.2g} would make it 10 m long"
    )
    metres = drawing.metres if scale is None else scale
    if metres is None:
        raise InputError(f"{path}: a plan without a scale: {drawing.stated}; {way}", parameter="scale")
    if not SIZE_M[0] <= metres * size.max() <= SIZE_M[1]:
        large = f"would be {metres * size[0]:.4g} x {metres * size[1]:.4g} m large"
        since = drawing.stated if scale is None else f"scale is {scale:g}"
        raise InputError(f"{path}: {large}, since {since}; {way}", parameter="scale")
    plan = Plan(notes=list(drawing.notes))
    told = drawing.stated if scale is None else "as told"
    plan.notes.insert(0, f"one unit is {metres:.6g} m ({told}); ({low[0]:.10g}, {low[1]:.10g}) is the origin")
    kinds: dict[str, list[Line]] = {"wall": [], "door": [], "window": [], "": []}
    for line, kind in known:
        placed = replace(line, p=np.round((line.p - low) * metres, 3), width=line.width * metres)
        kinds[kind].append(placed)
    if kinds[""]:
        layers = sorted({line.layer.strip() for line in kinds[""]})
        plan.notes.append(f"{len(kinds[''])} lines left out that are no walls: {', '.join(layers)[:120]}")
    floor = _outer(kinds["wall"])
    if floor is not None:
        kinds["wall"].remove(floor)
    bars = _bars(kinds["wall"])
    if not bars and floor is None:
        raise InputError(f"{path}: no walls in it, only {', '.join(k for k, v in kinds.items() if v and k)}")
    plan.walls = [_wall(k, p, thick) for k, (p, thick) in enumerate(bars)]
    plan.floor = () if floor is None else _corners(floor.p)
    sides = LabSpec(floor=plan.floor).sides if plan.floor else ()
    for kind in ("door", "window"):
        _open(plan, kinds[kind], kind, sides)
    plan.sides = {"wall_height_m": HIGH_M, "wall_thickness_m": THICK_M}
    if floor is None:
        plan.sides = {"wall_height_m": 0.0}
        plan.floor = _corners(np.round(enclosed([np.array(corners_of(wall)) for wall in plan.walls]), 3))
    return plan


def _kind(line: Line) -> str:
    """What a line is, by the words of its layer."""
    return next((kind for kind, words in WORDS if re.search(words, line.layer.lower())), "wall")


def _corners(p: Array) -> tuple[Vec2, ...]:
    """Corners (N, 2) without equal neighbours, and without those on a straight line."""
    p = p[np.hypot(*(p - np.roll(p, 1, axis=0)).T) > 2e-3]
    before, after = p - np.roll(p, 1, axis=0), np.roll(p, -1, axis=0) - p
    bend = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    kept = p[np.abs(bend) > 1e-3 * np.hypot(*before.T) * np.hypot(*after.T)]
    return tuple((float(x), float(y)) for x, y in kept)


def _outer(lines: list[Line]) -> Line | None:
    """The closed line in which all others are, if there is one."""
    every = np.vstack([line.p for line in lines]) if lines else np.zeros((1, 2))
    low, high = every.min(axis=0), every.max(axis=0)
    for line in lines:
        around = np.all(line.p.min(axis=0) <= low + NEAR_M) and np.all(line.p.max(axis=0) >= high - NEAR_M)
        if line.closed and around and as_bar(line.p) is None:
            return line
    return None


def _bars(lines: list[Line]) -> list[tuple[Array, float]]:
    """Centre lines (2, 2) and thicknesses of walls, each once."""
    bars = dict[tuple[float, ...], tuple[Array, float]]()
    for line in lines:
        bar = as_bar(line.p) if line.closed else None
        thick = line.width if STROKES_M[0] <= line.width <= STROKES_M[1] else THICK_M
        ends = np.vstack([line.p, line.p[:1]]) if line.closed else line.p
        for p, t in [bar] if bar else [(ends[k : k + 2], thick) for k in range(len(ends) - 1)]:
            if math.dist(*p) >= SHORT_M:
                key = tuple(np.round(p[np.lexsort(p.T)], 2).ravel().tolist())
                bars.setdefault(key, (p, t))
    return list(bars.values())


def _wall(number: int, p: Array, thick: float) -> Wall:
    (x0, y0), (x1, y1) = np.round(p, 3).tolist()
    return Wall((x0, y0), (x1, y1), name=f"wall_{number}", thickness_m=round(thick, 3))


def _open(plan: Plan, lines: list[Line], kind: str, sides: tuple[Wall, ...]) -> None:
    """Put doors or windows into their walls, or into walls of their own in a gap."""
    lost, begun = 0, len(plan.walls)
    hinges = [line.p[0] for line in lines if line.arc]
    for line in sorted(lines, key=lambda line: not line.arc):
        spans = [line.p[[0, -1]]] if not line.arc else [line.p[[0, 1]], line.p[[0, 2]]]
        bar = as_bar(line.p) if line.closed else None
        spans = [bar[0]] if bar else spans
        if not line.arc and any(np.hypot(*(line.p - hinge).T).min() < NEAR_M for hinge in hinges):
            continue  # the leaf of a door, which its swing has placed
        placed = [where for span in spans if (where := _place(span, (*plan.walls[:begun], *sides)))]
        if not placed:
            lost += 1
            continue
        wall, ends = min(placed, key=lambda where: where[0] is None)
        if wall is None:
            wall = _wall(len(plan.walls), ends, THICK_M)
            plan.walls.append(wall)
            ends = np.array([THICK_M / 2, wall.length_m - THICK_M / 2])  # clear of the walls that meet here
        first, last = map(float, ends)
        middle, width = round((first + last) / 2, 3), math.floor((last - first) * 1000 - 1) / 1000
        same = [each for each in plan.openings if each.wall == wall.name]
        if all(abs(each.at_m - middle) > (each.width_m + width) / 2 for each in same):
            number = sum(isinstance(each, Door) == (kind == "door") for each in plan.openings)
            make = Door if kind == "door" else Window
            plan.openings.append(make(wall.name, middle, name=f"{kind}_{number}", width_m=width))
    if lost:
        plan.notes.append(f"{lost} lines of {kind}s left out: in no wall and in no gap between walls")


def _place(span: Array, walls: tuple[Wall, ...]) -> tuple[Wall | None, Array] | None:
    """The wall that an opening is in, with its begin and end there; no wall, with its ends, for a gap."""
    if not DOORS_M[0] <= math.dist(*span) <= DOORS_M[1]:
        return None
    for wall in walls:
        start, along = np.array(wall.start), (np.array(wall.end) - wall.start) / wall.length_m
        s, d = (span - start) @ along, (span - start) @ [-along[1], along[0]]
        first, last = float(s.min()), float(s.max())
        beside = np.abs(d).max() <= wall.thickness_m / 2 + NEAR_M
        if beside and first >= -NEAR_M and last <= wall.length_m + NEAR_M:
            return wall, np.clip([first, last], 0.0, wall.length_m)
    ends = np.array([end for wall in walls for end in (wall.start, wall.end)]).reshape(-1, 2)
    in_gap = len(ends) and all(np.hypot(*(ends - p).T).min() < 2 * NEAR_M for p in span)
    return (None, span) if in_gap else None


HEAD = """\
# {name}: made from {file} by `magtwin new --plan`.
# `magtwin scene FILE.toml --out DIR` makes its USD stage, `magtwin run DIR/{name}.usda` drives the robot
# through it, in strips over the whole floor and through every open door. Lengths are in metres.
# [earth] is where the room is, and when. docs/scenes.md of magtwin has every key.
{notes}
"""
REST = MappingProxyType({"robot": {"asset": "turtlebot4", "path": "coverage"}, "earth": EARTH})
"""What a plan does not tell."""
