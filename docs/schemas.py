"""Write the JSON schemas of magtwin's TOML files from their dataclasses: `python docs/schemas.py`.

Editors complete and check a TOML whose first line is `#:schema ./FILE`. The dataclasses are those that
`from_table` reads the files with, and those of docs/scenes.md.
"""

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magtwin.author.robot import RobotSettings
from magtwin.author.scene_file import SceneFile, _SourceFile
from magtwin.bench.suite import Suite
from magtwin.learn.training.config import TrainConfig
from scenes import field_docs

FOLDER = Path(__file__).resolve().parents[1] / "magtwin/spec/toml"
FILES = {
    "scene": (SceneFile, "A scene of magtwin: `magtwin scene FILE.toml`"),
    "sources": (_SourceFile, "Furniture and sources of a scene of magtwin"),
    "robot": (RobotSettings, "Settings of a robot of magtwin: `magtwin robot --settings FILE.toml`"),
    "suite": (Suite, "A benchmark of magtwin: `magtwin bench FILE.toml`"),
    "training": (TrainConfig, "Settings of a training of magtwin: `magtwin train --config FILE.toml`"),
}  # the keys are those of `magtwin.files.settings.SCHEMAS`
"""Dataclass of each kind of file, and what it is."""

WORDS = {float: "number", int: "integer", str: "string", bool: "boolean", Path: "string"}


def schema(name: str) -> str:
    """Text of a schema, without a title for each key: editors show the descriptions."""
    cls, title = FILES[name]
    shared: dict[str, Any] = {}
    top = _table(cls, shared)
    if name == "scene":  # one robot is a table, several are an array of tables
        several = top["properties"]["robot"]
        top["properties"]["robot"] = {"anyOf": [several["items"], several]}
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": title}
    return json.dumps(head | top | {"definitions": shared}, indent=1, ensure_ascii=False) + "\n"


def _table(cls: type, shared: dict[str, Any]) -> dict[str, Any]:
    """Schema of a table: that of a dataclass."""
    docs, hints = field_docs(cls), typing.get_type_hints(cls)
    keys, required = {}, []
    for field in dataclasses.fields(cls):
        key = _value(hints[field.name], shared)
        keys[field.name] = key | ({"description": docs[field.name]} if docs.get(field.name) else {})
        if field.default is dataclasses.MISSING:
            required += [field.name] if field.default_factory is dataclasses.MISSING else []
        elif isinstance(field.default, bool | int | float | str) and field.default != "":
            keys[field.name]["default"] = field.default
    table = {"type": "object", "properties": keys, "additionalProperties": False}
    return table | ({"required": required} if required else {})


def _value(kind: Any, shared: dict[str, Any]) -> dict[str, Any]:
    """Schema of a value, by its annotation; tables are shared."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _value(next(a for a in args if a is not type(None)), shared)
    if dataclasses.is_dataclass(kind):
        name = kind.__name__.strip("_")
        if name not in shared:
            shared[name] = _table(typing.cast(type, kind), shared)
        return {"allOf": [{"$ref": f"#/definitions/{name}"}]}  # a draft-07 $ref hides its neighbours
    if origin is tuple:
        if args[-1] is Ellipsis:
            return {"type": "array", "items": _value(args[0], shared)}
        items = [_value(a, shared) for a in args]
        same = items[0] if all(item == items[0] for item in items) else items
        return {"type": "array", "items": same, "minItems": len(args), "maxItems": len(args)}
    if origin is typing.Literal:
        return {"enum": list(args)}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _value(args[1], shared)}
    return {"type": WORDS[kind]} if kind in WORDS else {}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for kind in FILES:
        (FOLDER / f"{kind}.schema.json").write_text(schema(kind), encoding="utf-8")
