"""Tables: a scene as the tables of its TOML, and their text. `magtwin.author.scene_file` reads them."""

import json
import re
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from magtwin.author.scene_file import PARTS
from magtwin.files.file import shipped
from magtwin.spec.base import KEY
from magtwin.spec.lab import LabSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import PlacedRobot
from magtwin.spec.scene import Scene
from magtwin.usd.robot import load_robot

Table = dict[str, Any]


def toml_text(table: Mapping[str, Any]) -> str:
    """Tables as the text of a TOML that `magtwin.files.settings.read_toml` reads back, number for number."""
    lines = list[str]()

    def write(table: Mapping[str, Any], section: str) -> None:
        below = []
        for key, value in table.items():
            several = isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value)
            if isinstance(value, Mapping) or several:
                below.append((f"{section}.{_key(key)}" if section else _key(key), value))
            else:
                lines.append(f"{_key(key)} = {_text(value)}")
        for name, value in below:
            for each in [value] if isinstance(value, Mapping) else value:
                lines.extend(("", f"[{name}]" if isinstance(value, Mapping) else f"[[{name}]]"))
                write(each, name)

    write(table, "")
    return "\n".join(lines).strip() + "\n"


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _text(key)


def _text(value: Any) -> str:
    """A value as TOML; texts have JSON's escapes, of which TOML lacks none that is used."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)


def table_of_scene(scene: Scene) -> Table:
    """A scene as the tables of a TOML: `scene_from_toml` makes the same scene of them."""
    table: Table = {"name": scene.name, "map": str(scene.map_layer.absolute())}
    alone = not scene.others and load_robot(scene.robot.asset).name == scene.robot.name
    robots = [table_of_robot(placed) for placed in scene.robots]
    if alone:
        table["start"] = robots[0].pop("start")
        del robots[0]["name"]
    table |= tables_of_lab(scene.lab)
    if scene.earth is not None:
        table["earth"] = table_of(scene.earth)
    if scene.sources:
        table["source"] = [table_of(s, leave={"size_m"} if s.faces else set()) for s in scene.sources]
    if scene.furniture:  # magnetization is given, or else it would be drawn
        drawn = [{"magnetization": list(piece.magnetization)} for piece in scene.furniture]
        table["furniture"] = [table_of(p) | own for p, own in zip(scene.furniture, drawn, strict=True)]
    return table | {"robot": robots[0] if alone else robots}


def tables_of_lab(lab: LabSpec) -> Table:
    """A room as [lab], [[wall]], [[door]] and [[window]]."""
    table: Table = {"lab": table_of(lab, leave={"floor_m"})}
    if not lab.floor:
        table["lab"]["floor_m"] = list(lab.floor_m)
    for section, things in (("wall", lab.walls), ("door", lab.doors), ("window", lab.windows)):
        if things:
            table[section] = [table_of(thing) for thing in things]
    return table


def table_of(spec: Any, *, leave: "set[str] | frozenset[str]" = frozenset(), like: Any = None) -> Table:
    """The fields of a spec that differ from their defaults, or from those of another spec.

    Args:
        spec: The spec.
        leave: Fields to leave out.
        like: Spec of the same class to differ from.
    """
    table: Table = {}
    for f in fields(spec):
        key, value = f.metadata.get(KEY, f.name), getattr(spec, f.name)
        default = f.default if f.default_factory is MISSING else f.default_factory()
        if key is None or f.name in leave or value == (default if like is None else getattr(like, f.name)):
            continue
        table[key] = table_of(value) if is_dataclass(value) else _value(value)
    return table


def _value(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_value(entry) for entry in value]
    return str(value.absolute()) if isinstance(value, Path) else value


def table_of_robot(placed: PlacedRobot) -> Table:
    """A robot as its asset, and what differs from it."""
    robot, asset = placed.robot, load_robot(placed.robot.asset)
    known = shipped("robots") / robot.asset.stem / robot.asset.name
    named = robot.asset.stem if known == robot.asset else str(robot.asset)
    table: Table = {"name": robot.name, "asset": named, "start": list(placed.start)}
    if placed.path:
        table["path"] = str(placed.path)
    if robot.footprint_radius_m != asset.footprint_radius_m:
        table["footprint_radius_m"] = robot.footprint_radius_m
    for name in PARTS:
        if given := table_of(getattr(robot, name), like=getattr(asset, name)):
            table[name] = given
    if robot.plant != asset.plant:
        table["plant"] = table_of(robot.plant, like=PlantSpec())
    return table
