"""OmniGraph: the node types of Isaac Sim's graphs, and graphs as USD prims.

`ogn.toml` has the definition of each node type, with its source.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd

from magtwin.errors import InputError

_USD = {"execution": "uint", "int[2]": "int2", "vectord[3]": "vector3d", "quatd[4]": "quatd"}
"""USD types with another name than OmniGraph's."""

Kind = str | tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class NodeType:
    """The definition of a node type."""

    name: str
    version: int

    inputs: dict[str, Kind]
    """Kind of each input by its name: OmniGraph's name of a type, or several alternatives."""

    outputs: dict[str, Kind]


@cache
def node_types() -> dict[str, NodeType]:
    """Every known type of node by its name."""
    return {
        name: NodeType(
            name=name,
            version=given["version"],
            inputs=_kinds(given.get("inputs", {})),
            outputs=_kinds(given.get("outputs", {})),
        )
        for name, given in _table()["nodes"].items()
    }


@cache
def message_fields(message: str) -> dict[str, Kind]:
    """Inputs of a ROS2Publisher for a message such as geometry_msgs/msg/PoseStamped; empty if unknown."""
    return _kinds(_table()["messages"].get(message, {}))


class Graph:
    """An Action Graph, authored in a stage's edit target."""

    def __init__(self, stage: Usd.Stage, path: Sdf.Path) -> None:
        """Define the graph's prim.

        Raises:
            InputError: Another prim has the path.
        """
        there = stage.GetPrimAtPath(path)
        if there and there.IsDefined() and there.GetTypeName() != "OmniGraph":
            raise InputError(f"<{path}>: is a {there.GetTypeName() or 'prim'} already; rename it")
        self.stage, self.path = stage, path
        self._kinds: dict[tuple[str, str], Kind] = {}  # by node, and name with its namespace
        prim = stage.DefinePrim(path, "OmniGraph")
        settings = {
            "evaluationMode": "Automatic",
            "evaluator:type": "execution",
            "fabricCacheBacking": "Shared",
            "fileFormatVersion": Gf.Vec2i(1, 9),
            "pipelineStage": "pipelineStageSimulation",
        }
        for name, value in settings.items():
            prim.CreateAttribute(name, _usd_type(_table()["graph"][name]), custom=False).Set(value)

    def node(self, name: str, kind: str, *, message: str = "", **values: Any) -> Usd.Prim:
        """Define a node.

        Args:
            name: Name of its prim.
            kind: Its type, one of `node_types`.
            message: Message type of a ROS2Publisher; its fields become inputs.
            **values: Values of its inputs; for a target, the path or paths of prims.
        """
        known, names = node_types()[kind], Sdf.ValueTypeNames
        prim = self.stage.DefinePrim(self.path.AppendChild(name), "OmniGraphNode")
        prim.CreateAttribute("node:type", names.Token, custom=False).Set(kind)
        prim.CreateAttribute("node:typeVersion", names.Int, custom=False).Set(known.version)
        inputs = known.inputs | message_fields(message)
        for space, kinds in (("inputs", inputs), ("outputs", known.outputs)):
            self._kinds |= {(name, f"{space}:{key}"): each for key, each in kinds.items()}
        if message:
            parts = zip(
                ("messagePackage", "messageSubfolder", "messageName"), message.split("/"), strict=True
            )
            values |= dict(parts)
        for key in {**message_fields(message), **values}:
            if inputs[key] == "target":
                paths: Sequence[Any] = [values[key]] if isinstance(values[key], Sdf.Path) else values[key]
                prim.CreateRelationship(f"inputs:{key}", custom=True).SetTargets(list(paths))
                continue
            attribute = _attribute(prim, f"inputs:{key}", inputs[key])
            if key in values:
                attribute.Set(values[key])
        return prim

    def connect(self, given: str, taken: str) -> None:
        """Connect an output to an input, as NODE.ATTRIBUTE without namespace: tick.tick, clock.execIn."""
        ends = []
        for text, namespace in ((given, "outputs"), (taken, "inputs")):
            node, _, name = text.partition(".")
            prim = self.stage.GetPrimAtPath(self.path.AppendChild(node))
            name = f"{namespace}:{name}"
            ends.append(_attribute(prim, name, self._kinds[node, name]))
        ends[1].AddConnection(ends[0].GetPath())


def _attribute(prim: Usd.Prim, name: str, kind: Kind) -> Usd.Attribute:
    """An attribute of a node, as OmniGraph itself writes it."""
    attribute = prim.CreateAttribute(name, _usd_type(kind), custom=True)
    if kind == "execution":
        attribute.SetCustomDataByKey("isExecution", True)
    return attribute


@cache
def _table() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name("ogn.toml").read_text(encoding="utf-8"))


def _kinds(given: Mapping[str, str | list[str]]) -> dict[str, Kind]:
    return {name: kind if isinstance(kind, str) else tuple(kind) for name, kind in given.items()}


def _usd_type(kind: Kind) -> Sdf.ValueTypeName:
    """USD's type of a kind. A choice of several kinds is a token."""
    return Sdf.ValueTypeNames.Find(_USD.get(kind, kind) if isinstance(kind, str) else "token")
