"""OmniGraph: the node types of Isaac Sim's graphs, and graphs as USD prims.

`ogn.toml` has the definition of each node type, with its source. A misspelt attribute, or a connection of
types that do not match, is an error here rather than in Isaac Sim.
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd

from magtwin.errors import InputError, hint

TABLE = Path(__file__).with_name("ogn.toml")

ROLES = ("vector", "quat", "point", "normal", "color")
"""Roles that OmniGraph treats as plain tuples: vectord[3] fits double[3]."""

_BASES = {"d": "double", "f": "float", "h": "half"}
_SHAPE = re.compile(r"(?P<base>[a-z]+(?:64)?)(?P<tuple>\[\d\])?(?P<array>\[\])?")

_USD = {
    "execution": Sdf.ValueTypeNames.UInt,
    "bool": Sdf.ValueTypeNames.Bool,
    "uchar": Sdf.ValueTypeNames.UChar,
    "int": Sdf.ValueTypeNames.Int,
    "int[]": Sdf.ValueTypeNames.IntArray,
    "int[2]": Sdf.ValueTypeNames.Int2,
    "int64": Sdf.ValueTypeNames.Int64,
    "uint": Sdf.ValueTypeNames.UInt,
    "uint64": Sdf.ValueTypeNames.UInt64,
    "uchar[]": Sdf.ValueTypeNames.UCharArray,
    "float": Sdf.ValueTypeNames.Float,
    "float[]": Sdf.ValueTypeNames.FloatArray,
    "double": Sdf.ValueTypeNames.Double,
    "double[]": Sdf.ValueTypeNames.DoubleArray,
    "vectord[3]": Sdf.ValueTypeNames.Vector3d,
    "quatd[4]": Sdf.ValueTypeNames.Quatd,
    "string": Sdf.ValueTypeNames.String,
    "token": Sdf.ValueTypeNames.Token,
    "token[]": Sdf.ValueTypeNames.TokenArray,
}
"""USD type by OmniGraph's name of a kind. A choice of several kinds is a token."""

Kind = str | tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class NodeType:
    """The definition of a node type."""

    name: str
    version: int

    inputs: dict[str, Kind]
    """Kind of each input by its name: OmniGraph's name of a type, or several alternatives."""

    outputs: dict[str, Kind]

    tokens: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Allowed values of an input that is a choice."""

    source: str = ""
    """Source of the definition: version and file."""


@cache
def node_types() -> dict[str, NodeType]:
    """Every known type of node by its name."""
    table = _table()
    return {
        name: NodeType(
            name=name,
            version=given["version"],
            inputs=_kinds(given.get("inputs", {})),
            outputs=_kinds(given.get("outputs", {})),
            tokens={key: tuple(values) for key, values in given.get("tokens", {}).items()},
            source=f"{_source(table['sources'][given['source']])}: {given['file']}",
        )
        for name, given in table["nodes"].items()
    }


@cache
def message_fields(message: str) -> dict[str, Kind]:
    """Inputs of a ROS2Publisher for a message such as geometry_msgs/msg/PoseStamped; empty if unknown."""
    return _kinds(_table()["messages"].get(message, {}))


def fits(given: Kind, taken: Kind) -> bool:
    """Whether an output of one kind may be connected to an input of another.

    Base type, tuple and array must be equal, but not the role: a vectord[3] fits a double[3]. One of several
    alternatives must fit.
    """
    sides = [{_shape(k) for k in ((kind,) if isinstance(kind, str) else kind)} for kind in (given, taken)]
    return bool(sides[0] & sides[1])


def ports(node: Usd.Prim) -> dict[str, Kind] | None:
    """Kinds of a node's inputs and outputs by name (`inputs:execIn`), with those of its message.

    None if the node's type is unknown.
    """
    known = node_types().get(node.GetAttribute("node:type").Get())
    if known is None:
        return None
    inputs = known.inputs | (_fields(node) if "messageName" in known.inputs else {})
    named = {"inputs": inputs, "outputs": known.outputs}
    return {f"{space}:{name}": kind for space, kinds in named.items() for name, kind in kinds.items()}


def _fields(node: Usd.Prim) -> dict[str, Kind]:
    """Inputs of a node for its message."""
    parts = (node.GetAttribute(f"inputs:message{part}").Get() for part in ("Package", "Subfolder", "Name"))
    return message_fields("/".join(map(str, parts)))


def faults(node: Usd.Prim) -> list[str]:
    """Differences of a node from its definition, one sentence each; none if its type is unknown."""
    kinds = ports(node)
    if kinds is None:
        return []
    known, texts = node_types()[node.GetAttribute("node:type").Get()], []
    version = node.GetAttribute("node:typeVersion").Get()
    if version != known.version:
        texts.append(f"is version {version} of {known.name}, not {known.version}")
    for prop in node.GetAuthoredProperties():
        name = prop.GetName()
        if not name.startswith(("inputs:", "outputs:")):
            continue
        if name not in kinds:
            if "inputs:messageName" in kinds and not _fields(node):
                continue  # an unknown message
            texts.append(f"{known.name} has no {name}; {hint(name, kinds)}")
        elif isinstance(prop, Usd.Attribute):
            if (
                isinstance(kinds[name], str)
                and kinds[name] in _USD
                and prop.GetTypeName() != _usd_type(kinds[name])
            ):
                texts.append(f"{name} is a {prop.GetTypeName()}, {known.name} has a {_words(kinds[name])}")
            texts += [text for path in prop.GetConnections() if (text := _unfit(prop, path, kinds[name]))]
    return texts


def _unfit(attribute: Usd.Attribute, path: Sdf.Path, taken: Kind) -> str:
    """What is wrong with one connection of an attribute, or ""."""
    source = attribute.GetStage().GetPrimAtPath(path.GetPrimPath())
    if source and source.GetTypeName() == "OmniGraph":
        return ""  # a variable of the graph
    if not source or source.GetTypeName() != "OmniGraphNode":
        return f"{attribute.GetName()} is connected to <{path}>, which is on no node"
    given = ports(source)
    if given is None:
        return ""
    if not path.name.startswith("outputs:") or path.name not in given:
        return f"{attribute.GetName()} is connected to <{path}>, which is no output"
    if not fits(given[path.name], taken):
        return f"{attribute.GetName()} takes {_words(taken)}, <{path}> is {_words(given[path.name])}"
    return ""


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
        self._kinds: dict[str, Mapping[str, Kind]] = {}
        prim = stage.DefinePrim(path, "OmniGraph")
        settings = {
            "evaluationMode": "Automatic",
            "evaluator:type": "execution",
            "fabricCacheBacking": "Shared",
            "fileFormatVersion": Gf.Vec2i(1, 9),
            "pipelineStage": "pipelineStageSimulation",
        }
        known = _kinds({k: v for k, v in _table()["graph"].items() if k not in ("source", "file")})
        for name, value in settings.items():
            prim.CreateAttribute(name, _usd_type(known[name]), custom=False).Set(value)

    def node(self, name: str, kind: str, *, message: str = "", **values: Any) -> Usd.Prim:
        """Define a node.

        Args:
            name: Name of its prim.
            kind: Its type, one of `node_types`.
            message: Message type of a ROS2Publisher; its fields become inputs.
            **values: Values of its inputs; for a target, the path or paths of prims.

        Raises:
            InputError: The type, an input or a value is unknown.
        """
        types = node_types()
        if kind not in types:
            raise InputError(f"no node type {kind!r}; {hint(kind, types)}")
        known = types[kind]
        prim = self.stage.DefinePrim(self.path.AppendChild(name), "OmniGraphNode")
        names = Sdf.ValueTypeNames
        prim.CreateAttribute("node:type", names.Token, custom=False).Set(kind)
        prim.CreateAttribute("node:typeVersion", names.Int, custom=False).Set(known.version)
        inputs = dict(known.inputs)
        if message:
            if not message_fields(message):
                raise InputError(f"no message {message!r}; {hint(message, _table()['messages'])}")
            package, folder, short = message.split("/")
            values |= {"messagePackage": package, "messageSubfolder": folder, "messageName": short}
            inputs |= message_fields(message)
            for key, its in message_fields(message).items():
                self._attribute(prim, f"inputs:{key}", its)
        self._kinds[name] = {f"inputs:{key}": its for key, its in inputs.items()} | {
            f"outputs:{key}": its for key, its in known.outputs.items()
        }
        for key, value in values.items():
            if key not in inputs:
                raise InputError(f"{kind} has no input {key!r}; {hint(key, inputs)}")
            if key in known.tokens and value not in known.tokens[key]:
                raise InputError(f"{kind}: {key} cannot be {value!r}; {hint(str(value), known.tokens[key])}")
            self._set(prim, key, inputs[key], value)
        return prim

    def connect(self, given: str, taken: str) -> None:
        """Connect an output to an input, each as NODE.ATTRIBUTE without namespace: tick.tick, clock.execIn.

        Raises:
            InputError: One of them does not exist, or their types do not match.
        """
        output, input_ = self._end(given, "outputs"), self._end(taken, "inputs")
        if not fits(output[2], input_[2]):
            raise InputError(f"{given} is {_words(output[2])}, {taken} takes {_words(input_[2])}")
        self._attribute(*output)
        attribute = self._attribute(*input_)
        attribute.AddConnection(output[0].GetPath().AppendProperty(output[1]))

    def _end(self, text: str, namespace: str) -> tuple[Usd.Prim, str, Kind]:
        node, _, name = text.partition(".")
        kinds = self._kinds.get(node)
        if kinds is None:
            raise InputError(f"{text}: no node {node!r}; {hint(node, self._kinds)}")
        full = f"{namespace}:{name}"
        if full not in kinds:
            raise InputError(f"{text}: no such attribute; {hint(full, kinds)}")
        return self.stage.GetPrimAtPath(self.path.AppendChild(node)), full, kinds[full]

    @staticmethod
    def _attribute(prim: Usd.Prim, name: str, kind: Kind) -> Usd.Attribute:
        """An attribute of a node, as OmniGraph itself writes it."""
        attribute = prim.CreateAttribute(name, _usd_type(kind), custom=True)
        if kind == "execution":
            attribute.SetCustomDataByKey("isExecution", True)
        return attribute

    def _set(self, prim: Usd.Prim, name: str, kind: Kind, value: Any) -> None:
        if kind == "target":
            paths: Sequence[Any] = [value] if isinstance(value, (str, Sdf.Path)) else value
            prim.CreateRelationship(f"inputs:{name}", custom=True).SetTargets(
                [Sdf.Path(str(p)) for p in paths]
            )
        else:
            self._attribute(prim, f"inputs:{name}", kind).Set(value)


@cache
def _table() -> dict[str, Any]:
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def _kinds(given: Mapping[str, str | list[str]]) -> dict[str, Kind]:
    return {name: kind if isinstance(kind, str) else tuple(kind) for name, kind in given.items()}


def _source(source: Mapping[str, str]) -> str:
    at = f" at {source['commit']}" if "commit" in source else ""
    return f"{source['name']} {source['version']}, {source['repository']}{at}"


def _words(kind: Kind) -> str:
    return kind if isinstance(kind, str) else " or ".join(kind)


def _usd_type(kind: Kind) -> Sdf.ValueTypeName:
    return _USD[kind] if isinstance(kind, str) else Sdf.ValueTypeNames.Token


def _shape(kind: str) -> tuple[str, str, str]:
    """Base type, tuple and array of a kind, without its role."""
    match = _SHAPE.fullmatch(kind)
    if match is None:
        raise InputError(f"{kind!r} is no type of OmniGraph")
    base, count, array = match["base"], match["tuple"] or "", match["array"] or ""
    role = next((r for r in ROLES if base.startswith(r)), "")
    if role:
        base = _BASES[base.removeprefix(role)]
    return base, count, array
