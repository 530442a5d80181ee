"""Write scenes.md from the dataclasses of a scene's TOML: `python docs/scenes.py`."""

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magtwin.author.scene_file import SceneFile
from magtwin.spec.base import KEY
from magtwin.spec.furniture import GENERIC, KINDS, MATERIALS, STEEL, parts_of

HERE = Path(__file__).resolve().parent

INTRODUCTION = """\
# Scenes: every key of a scene's TOML

A scene is described by a TOML file: the room, its furniture, its field and its robots. From this file
`magtwin scene` makes a folder of USD layers that you can simulate. Start from a commented example:

```
magtwin new room.toml
magtwin scene room.toml --out room
magtwin run room/room.usda
```

In Python, `magtwin.author_scene("room.toml", "room")` makes the same folder, and `magtwin.Room` makes a room
call by call, with these keys: [python.md](python.md). A small scene:

```toml
name = "small"

[robot]                      # the only required table
asset = "turtlebot4"

[earth]
latitude_deg = 29.65
longitude_deg = -82.35
height_m = 50.0
date = "2026-11-21"

[[furniture]]
name = "desk"
kind = "desk"
p_world = [0.0, 1.2, 0.0]
```

* **Units.** Lengths are in metres, angles in radians unless a name ends in `_deg`, fields in nT,
  magnetization in A/m.
* **Axes.** The world's origin is the middle of the floor, or where the corners of the floor have it. x and y
  run along the floor, z points up.
* **File names** are relative to the TOML.
* **Errors.** For an unknown key, the message proposes the nearest known one. For a wrong value, it gives
  file and line.
* **Completion.** `magtwin new` writes the JSON schema of these keys beside the TOML, and names it in the
  first line. Editors that know TOML schemas, such as those with taplo, complete and check the keys.
  `magtwin schema --toml DIR` writes the schemas of all TOML files: scene, sources, robot, suite, training.

## Where the field comes from

| the TOML has | the true field | the map |
|---|---|---|
| a map only | the map, plus the robot's own field ([own.md](own.md)) | the given map |
| `[earth]` with furniture or sources, and no map | computed exactly everywhere | surveyed by the robot |
| a map, and `[earth]` with furniture or sources | computed exactly everywhere | the given map |
| neither a map nor `[earth]` | an error | |

* **Survey.** `[survey]` sets the survey of a scene without a map. The robot stands at each node of a grid
  in each heading and reads its magnetometer. `magtwin scene` prints nodes, spacing, headings, height and
  the range of the field. Some nodes cannot be read, because furniture is in the way or the magnetometer
  loses lock. They are filled from their neighbours. The same TOML gives a byte-identical map.
* **Agreement.** If there are a map and sources, the map is compared with the exact field at its nodes,
  except in steel and right beside it. A difference of 50 nT (rms) or more is printed with the place of its
  maximum. A difference above both 500 nT and 0.3 of the map's standard deviation is an error.

## Furniture

A piece of furniture consists of parts. Its steel parts are magnetised along their longest side.

* **Default magnetization.** Without `magnetization`, each steel part draws one from `seed`: uniform from
  500 to 5000 A/m, with a random sign, times a factor for the share of steel. The last column of the table
  gives this factor for wide hollow sections; it is 1 for all other parts. For a box, cylinder or mesh it is
  the share of a shell of 2 mm in the volume.
* **Independent draws.** The draw of a piece depends on the seed and its name only. Adding, removing or
  moving a piece does not change the others.
* **No field.** `magnetization = []` removes the field of a piece. It remains an obstacle.

"""

ROBOT = """
The tables below, `[robot.drive]` and so on, are for a robot from a URDF; see [urdf.md](urdf.md). An asset
already has these values: a key replaces the asset's, and its sensors stay on their links. For several
robots, write one `[[robot]]` with a `name` for each, and `[robot.drive]` below it.
"""

PATHS = """
## Floor and paths

**Floor.** `floor_m` is the size of the floor. Default: with a map, the smallest floor around the origin
that contains the map; without a map, 6 x 3.5 m.

**Named paths** (sine, lawnmower, figure8, A to E, ...) are made for a floor of 6 x 3.5 m. On another floor
they are scaled in x and in y. If furniture is in the way, they are moved and shrunk until the robot passes,
with 5 cm of clearance if there is space. `magtwin run` prints the scale. The run's metadata keeps it as
`path_placing`: scale in x and y, then shift in x and y [m].

If more than 20 % of the free floor is then outside of the path, the run's summary, its picture and the
command say how much; the metadata keep it as `path_swept`.

**`coverage`** is planned for the room: strips 0.5 m apart over all of the floor that the robot can reach,
through every open door. Its `path_swept` is the share of that floor within 0.25 m of the path. A warning
names each part of the floor that it cannot enter, and the nearest door.

**A CSV file** is driven unchanged. If it does not fit, the error message proposes a change. `--fit` moves
the path and, if necessary, shrinks it; not to the other side of a wall, which is refused.

## Walls and doors

A floor with corners, walls from point to point, and doors in them:

```toml
name = "l_room"
robot = {asset = "turtlebot4", path = "coverage"}
earth = {latitude_deg = 29.65, longitude_deg = -82.35, height_m = 50, date = "2026-11-21"}
lab = {floor = [[0, 0], [9, 0], [9, 3], [4, 3], [4, 5], [0, 5]]}
wall = [{from = [4, 0], to = [4, 3], material = "reinforced_concrete"}, {from = [0, 2.5], to = [4, 2.5]}]
door = [{wall = 0, at_m = 1.2, material = "steel"}, {wall = 1, at_m = 2}]
```

* **Sides.** The low walls of `[lab]` stand around the floor. Doors and windows can be in them too: of a
  floor with corners they are called `edge_0`, `edge_1` and so on, of a rectangle `south`, `east`, `north` and
  `west`.
* **Doors** have a leaf that turns about its hinge. An open one is driven through; a closed one is an
  obstacle. On the stage, turn the prim of the door to open it.
* **Field.** Walls of steel or reinforced concrete and doors of steel are magnetised as furniture is. Their
  field is exact, and a map is stale once a steel door turns.
* **Start.** Without `start`, the robot stands at the first point of its path.

## A room from a floor plan

```
magtwin new room.toml --plan plan.svg --scale 0.01
magtwin new room.toml --plan map.pgm
```

| plan | what is read | scale |
|---|---|---|
| .svg | lines, polylines, polygons, rectangles, paths; curves are straight | width in mm, cm, in or m |
| .dxf | LINE, LWPOLYLINE, POLYLINE, INSERT; ARC as the swing of a door; text form only | `$INSUNITS` |
| .geojson | lines and polygons; degrees are projected to the plane in their middle | metres or degrees |
| .pgm, .png, .yaml | the largest free part of an occupancy map of ROS, in the map's axes | `resolution` |

* **Layers**, groups, classes and properties say what a line is: door, window, or what is left out
  (furniture, text, dimensions). All other lines are walls, 0.1 m thick unless their stroke has a width. A
  rectangle thinner than 0.6 m is one wall.
* **Doors and windows** are lines across their opening, in a wall or in a gap between walls.
* **Floor**: the closed line around all others, or else what the walls enclose, across gaps up to 1.3 m.
  Walls off the floor are left out.
* **Scale.** `--scale` is metres per unit of the drawing; of an SVG, per unit of its viewBox. A sheet at 1:50
  drawn in mm needs `--scale 0.05`, since 1 mm is 0.05 m. Without it, an SVG with a width in mm has its size
  on paper, which is too small for a room and refused; so is a plan without any scale, with its size in units.
* **Axes.** y of an SVG counts down, y of the room counts up: what is low on the sheet has the small y. The
  origin is the lower left corner of the walls.

An SVG at 1:50, of two rooms of 4 x 5 m with a door between them and one to the outside in the lower wall:

```
<svg xmlns="http://www.w3.org/2000/svg" width="180mm" height="120mm" viewBox="0 0 180 120">
  <g id="walls" fill="none" stroke="black" stroke-width="2">
    <rect x="10" y="10" width="160" height="100"/>
    <line x1="90" y1="10" x2="90" y2="110"/>
  </g>
  <g id="doors" stroke="red">
    <line x1="90" y1="50" x2="90" y2="70"/>
    <line x1="30" y1="110" x2="50" y2="110"/>
  </g>
</svg>
```

`magtwin new rooms.toml --plan plan.svg --scale 0.05` makes of it a floor of 8 x 5 m, a wall from (4, 5) to
(4, 0), and doors of 1 m at (4, 2.5) and (1.5, 0).

## A lab in another place

A stage of your own cannot be driven in as it is, since its field is not known. Make a lab from a TOML, and
reference it in your stage.

The lab, its map, sources, robots and floor are relative to the lab's root, the prim `/World` of the stage
that magtwin writes. Move and turn this prim, or reference the stage into another one, as often as you like:

```
def Xform "Building"
{
    def Xform "LabA" (references = @lab/lab.usda@) {}
    def Xform "LabB" (references = @lab/lab.usda@)
    {
        double3 xformOp:translate = (12, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
```

```
magtwin run building.usda --lab /Building/LabB
```

Here `lab/` is in the folder of `building.usda`. A stage names files of its own folder; `--allow` adds others:
`magtwin run building.usda --lab /Building/LabB --allow ../labs` ([SECURITY.md](../SECURITY.md)).

* **Readings** of a moved and turned lab equal those of the lab at the origin, to the byte. Poses and fields
  are in the lab's axes. The run's metadata keep the lab's path (`lab`, on a stage of several labs) and its
  x, y, z [m] and yaw [rad] on the stage (`lab_pose`).
* **Commands.** `run`, `drive`, `ros sim`, `ros magnetometer` and `map survey` take `--lab`, a
  benchmark's scenario has the key `lab`, and in Python it is `open_twin(stage, lab=...)`, also of the gym
  environments. Newton drives a lab wherever it stands. Of several labs, `magtwin export` takes the lab's own
  stage.
* **Earth's field.** The lab's own field turns with the lab, because its map was measured with it. If another
  field on the stage differs by more than 1 nT in the lab's axes, a run warns: the stage then has two norths.
  A lab without a field of its own takes that of the stage, turned into its axes.
* **Steel** outside every lab counts in each of them. That of another lab does not.
* **Units.** A stage in centimetres or with Y up must reference the lab with scale 100 and rotateX -90.
  Otherwise it is refused.

## Editing a stage

A map records what it was made from: the Earth's field, each magnetised thing, the place of the magnetometer
and the robot's hard and soft iron. `run`, `info` and `validate` warn if the stage no longer agrees. Survey
again with `magtwin map survey lab.usda --out new.usdc --adopt`; the stage then reads the new map. If a
network was trained on the old map, a run warns how far the two maps differ.

| edit in usdview, Kit or Blender | result |
|---|---|
| a desk is moved, added, removed, magnetised | the new field; warning: map stale, why and by how much |
| the same in a stronger layer | the same |
| something that is not magnetic is moved | read as it is; no warning |
| the magnetometer is mounted elsewhere | read at the new place; warning that the map is stale |
| a second robot is added by reference | refused until its `magtwin:magnetometer:map` names the map |
| a robot is scaled | refused, with the prim |
| a robot floats or leans | starts on the floor, with a warning |
| furniture is made instanceable, or a payload | read as before |
| a payload is unloaded in a viewer | read whole: the file does not store it; a missing file is refused |
| variants are switched off | the same bytes |
| edits in usdview's session layer | not part of the file; saved as a layer, that is a stronger layer |
| changes in the same process that are not saved | refused: save them first |
| the whole lab is moved, or turned about the vertical | the same bytes |
| the whole lab is tilted, scaled or mirrored | refused, with the prim |
| only the room or only the map is moved | refused, with the prim to move instead |
| the lab is referenced twice | the same bytes in each; `--lab` names one |
| a stage in centimetres or with Y up references the lab | the same bytes if scaled and turned, else refused |
| a layer in other units is brought in without a scale | refused, with prim, scale and turn |
"""


UNIT = r"(?<!\[)\[([A-Za-z1][^\]]{0,40})\](?!\])"
"""A unit in a docstring."""

LATER = ("robot",)
"""Tables at the end of the page."""


def page() -> str:
    """The text of scenes.md."""
    parts = [INTRODUCTION, _kinds(), "\nMaterials: ", _materials(), ".\n", PATHS]
    parts += ["\n## Keys\n", *_table(SceneFile, "", "At the top of the file, before any table.")]
    return "".join(parts)


def _kinds() -> str:
    lines = ["| kind | size | steel parts, in the order of `magnetization` (factor) |", "|---|---|---|"]
    for kind in KINDS:
        parts = parts_of(kind)
        low = [min(p.p[k] - p.size_m[k] / 2 for p in parts) for k in range(3)]
        high = [max(p.p[k] + p.size_m[k] / 2 for p in parts) for k in range(3)]
        size = " x ".join(f"{b - a:.3g}" for a, b in zip(low, high, strict=True))
        steel = ", ".join(f"{p.name} ({p.fill:g})" if p.fill != 1 else p.name for p in parts if p.steel)
        lines.append(f"| `{kind}` | {size} m | {steel} |")
    generic = ", ".join(f"`{kind}`" for kind in GENERIC)
    lines.append(f"| {generic} | `size_m`, or the mesh `file` | body, if it is of steel |")
    return "\n".join(lines) + "\n"


def _materials() -> str:
    return ", ".join(f"`{name}`" + " (magnetic)" * (look in STEEL) for name, look in MATERIALS.items())


def _table(cls: type, section: str, about: str, *, many: bool = False) -> list[str]:
    """The table of a dataclass, followed by those of its nested dataclasses."""
    header = f"[[{section}]]" if many else f"[{section}]"
    lines = [f"\n### `{header}`\n\n" if section else "\n", f"{about}\n" if about else ""]
    lines += ["\n| key | type | unit | default | meaning |\n|---|---|---|---|---|\n"]
    docs, hints, below = field_docs(cls), typing.get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        if (key := field.metadata.get(KEY, field.name)) is None:
            continue
        kind, array = _inner(hints[field.name])
        name = f"{section}.{key}" if section else key
        if dataclasses.is_dataclass(kind):
            below.append((kind, name, docs.get(field.name, ""), array))
            continue
        text = docs.get(field.name, "")
        units = list(dict.fromkeys(re.findall(UNIT, text)))
        meaning = re.sub(f" {UNIT}", "", text) if len(units) == 1 else text
        kind, unit = _kind(hints[field.name]), ", ".join(units)
        cells = [f"`{key}`", kind, unit, _default(field), meaning]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    below.sort(key=lambda entry: entry[1] in LATER)
    for kind, name, text, array in below:
        lines += _table(kind, name, text or _about(kind), many=array and name != "robot")
        if name == "robot":
            at = next(k for k, line in enumerate(lines) if line.startswith("\n### `[robot."))
            lines.insert(at, ROBOT)
    return lines


def field_docs(cls: type) -> dict[str, str]:
    """Field docstrings of a dataclass and its bases."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        if not dataclasses.is_dataclass(base):
            continue
        tree = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for name, text in zip(tree.body, tree.body[1:], strict=False):
            if (
                isinstance(name, ast.AnnAssign)
                and isinstance(name.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                docs[name.target.id] = " ".join(str(text.value.value).split())
    return docs


def _about(cls: type) -> str:
    text = inspect.getdoc(cls) or ""
    return " ".join(text.split("\n\n")[0].split())


def _inner(kind: Any) -> tuple[Any, bool]:
    """The type of a table, and whether the field is an array of such tables."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _inner(next(a for a in args if a is not type(None)))
    if origin is tuple and dataclasses.is_dataclass(args[0]):
        return args[0], True
    return kind, False


def _kind(kind: Any) -> str:
    """An annotation as text."""
    words = {float: "number", int: "integer", str: "string", bool: "boolean", Path: "file"}
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _kind(next(a for a in args if a is not type(None)))
    if origin is tuple:
        if args[-1] is Ellipsis:
            item = _kind(args[0])
            return f"list of [{item}]" if item[0].isdigit() else f"list of {item}s"
        return f"{len(args)} {_kind(args[0])}s"
    if origin is typing.Literal:
        return ", ".join(f'"{a}"' for a in args)
    if origin in (dict, Mapping):
        return "table"
    return words.get(kind, str(kind))


def _default(field: Any) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        if field.default_factory is dataclasses.MISSING:
            return "required"
        return ""
    if value is None or value in ("", ()):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


if __name__ == "__main__":
    (HERE / "scenes.md").write_text(page(), encoding="utf-8")
