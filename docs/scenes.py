"""Write scenes.md from the dataclasses that read a scene's TOML: `python docs/scenes.py`."""

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
from magtwin.spec.furniture import GENERIC, KINDS, MATERIALS, STEEL, parts_of

HERE = Path(__file__).resolve().parent

INTRODUCTION = """\
# Scenes: every key of a scene's TOML

A scene is a TOML file. `magtwin scene FILE.toml --out DIR` makes a folder of USD layers from it, and
`magtwin.author_scene("FILE.toml", "DIR")` does so in Python. `magtwin new room.toml` writes a commented
file to start from:

```
magtwin new room.toml
magtwin scene room.toml --out room
magtwin run room/room.usda
```

The one table that a scene must have is `[robot]`. Lengths are in metres, angles in radians unless a name
ends in `_deg`, fields in nT, magnetization in A/m.
The world's origin is the middle of the floor; x and y run along its sides, z points up. File names are
relative to the TOML. An unknown key is refused with the nearest known one, a wrong value with file and
line.

## Where the field comes from

* **A map, and nothing else**: the map is the truth, which a physical magnetometer reads with the robot's own
  field. [own.md](own.md) shows how to bring a survey and a robot of your own.
* **`[earth]` with `[[furniture]]` or `[[source]]`, and no map**: the exact field is known everywhere. The
  scene's own robot surveys it (`[survey]`): it stands at each node of a grid in each heading, and reads its
  magnetometer. `magtwin scene` prints nodes, spacing, headings, height and the range of the field. Nodes
  where the robot would stand in furniture, or where its magnetometer loses lock, are filled from their
  neighbours. The same TOML gives the same map to the byte.
* **A map and `[earth]` with furniture or sources**: the map is what is looked up, the exact field is what a
  physical magnetometer reads. The two are compared at the map's nodes, but for those in steel or right
  beside it. A difference of 50 nT rms or more is printed, with the place where it is largest. Above 500 nT
  rms and above 0.3 of the map's standard deviation they contradict each other, and the scene is refused.
* Neither a map nor `[earth]`: refused.

## Furniture

Each piece consists of parts; its steel parts are magnetised along their longest side. Without
`magnetization` each steel part draws one from the `seed`: uniform between 500 and 5000 A/m, of either sign,
times a factor for wide hollow sections (the last column below; for a box, cylinder or mesh, the share of a
shell of 2 mm in its volume). Each piece draws from a stream of its own, made from the seed and its name:
adding, removing or moving a piece changes no other. `magnetization = []` keeps a piece without a field; its
place as an obstacle stays.

"""

ROBOT = """
The tables below are for a robot from a URDF, `[robot.drive]` and so on; see [urdf.md](urdf.md). For each of
several robots, write `[[robot]]` with a `name`, and `[robot.drive]` below it. An asset has these figures
already.
"""

PATHS = """
## Named paths and the floor

`floor_m` sets the size of the floor; without it, a scene with a map has the smallest floor about the origin
that holds the map, and one without has 6 x 3.5 m. Named paths (sine, lawnmower, figure8, A to E, ...) are
made for 6 x 3.5 m and are used as they are there. On another floor they are scaled with it in x and in y.
Where furniture stands in the way, they are moved and made smaller until the robot passes, with 5 cm to
spare if there is room. `magtwin run` prints the scale, and the run keeps it as its fact `path_placing`
(scale in x and y, then shift in x and y [m]).

A CSV file is driven as it is. If it does not fit, the refusal says what would: `--fit` moves it and, if
need be, makes it smaller.
"""


UNIT = r"(?<!\[)\[([A-Za-z1][^\]]{0,40})\](?!\])"
"""A unit in a docstring."""

LATER = ("robot",)
"""Tables that come after the others."""


def page() -> str:
    """The page, from the dataclasses."""
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
    """The table of a dataclass, and those of the dataclasses in it."""
    header = f"[[{section}]]" if many else f"[{section}]"
    lines = [f"\n### `{header}`\n\n" if section else "\n", f"{about}\n" if about else ""]
    lines += ["\n| key | type | unit | default | meaning |\n|---|---|---|---|---|\n"]
    docs, hints, below = field_docs(cls), typing.get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        kind, array = _inner(hints[field.name])
        name = f"{section}.{field.name}" if section else field.name
        if dataclasses.is_dataclass(kind):
            below.append((kind, name, docs.get(field.name, ""), array))
            continue
        text = docs.get(field.name, "")
        units = list(dict.fromkeys(re.findall(UNIT, text)))
        meaning = re.sub(f" {UNIT}", "", text) if len(units) == 1 else text
        kind, unit = _kind(hints[field.name]), ", ".join(units)
        cells = [f"`{field.name}`", kind, unit, _default(field), meaning]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    below.sort(key=lambda one: one[1] in LATER)
    for kind, name, text, array in below:
        lines += _table(kind, name, text or _about(kind), many=array and name != "robot")
        if name == "robot":
            at = next(k for k, line in enumerate(lines) if line.startswith("\n### `[robot."))
            lines.insert(at, ROBOT)
    return lines


def field_docs(cls: type) -> dict[str, str]:
    """The docstrings below the fields of a dataclass and of those that it inherits from."""
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
    """What a table holds, and whether it is an array of such tables."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _inner(next(a for a in args if a is not type(None)))
    if origin is tuple and dataclasses.is_dataclass(args[0]):
        return args[0], True
    return kind, False


def _kind(kind: Any) -> str:
    """An annotation in words."""
    words = {float: "number", int: "whole number", str: "text", bool: "true or false", Path: "file"}
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _kind(next(a for a in args if a is not type(None)))
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"list of {_many(args[0])}"
        return f"{len(args)} {_many(args[0])}"
    if origin is typing.Literal:
        return ", ".join(f'"{a}"' for a in args)
    if origin in (dict, Mapping):
        return "table"
    return words.get(kind, str(kind))


def _many(kind: Any) -> str:
    """Several of an annotation, in words."""
    text = _kind(kind)
    return text if text.endswith("s") else f"{text}s"


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
