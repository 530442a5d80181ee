"""Settings: tables of TOML files, checked against dataclasses; and a loader of YAML without surprises."""

import dataclasses
import functools
import os
import re
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from magtwin.errors import InputError, hint
from magtwin.files.budget import BUDGETS, check_depth
from magtwin.files.file import read_text

T = TypeVar("T")

SCHEMAS = Path(__file__).resolve().parents[1] / "spec/toml"
"""JSON schemas of TOML files, KIND.schema.json: scene, sources, robot, suite, training (docs/schemas.py)."""


def copy_schemas(folder: str | os.PathLike[str]) -> list[Path]:
    """Copy JSON schemas, by which editors complete and check a TOML, into a folder, which is made.

    The first line of the TOML names its schema: `#:schema ./scene.schema.json`.

    Args:
        folder: Where they are written; those of another version are replaced.
    """
    names = sorted(file.name for file in SCHEMAS.glob("*.json"))
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name in names:
        Path(folder, name).write_bytes((SCHEMAS / name).read_bytes())
    return [Path(folder, name) for name in names]


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: The file is missing, too large, nests too deep, or is not TOML; the text has the line.
    """
    return parse_toml(read_text(path, "TOML file", "TOML", "utf-8-sig"), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """The tables of a TOML text.

    tomllib recurses into arrays, and its memory grows with the square of the parts of a dotted key, so that
    both depths are checked before.

    Args:
        text: The text.
        where: Its file, for error messages.

    Raises:
        InputError: It nests too deep or is not TOML.
    """
    plain = _TOML_WORDS.sub("s", text)
    check_depth(where, "TOML", max((run.count(".") for run in _TOML_KEY.findall(plain)), default=0))
    depth = 0
    for bracket in _TOML_BRACKET.findall(plain):
        depth += 1 if bracket in "[{" else -1
        check_depth(where, "TOML", depth)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError, OverflowError) as error:  # numbers of too many digits are ValueError
        raise InputError(f"{where}: not TOML: {error}") from error


@functools.cache
def yaml_loader() -> type:
    """Loader of PyYAML for safe types. A fault of a file is a `yaml.YAMLError` with its line.

    Tables that grow exponentially by merging each other are refused. Numbers to base 60 (`1:30`) are texts,
    as in YAML 1.2: to read them takes time with the square of their length.
    """
    import yaml

    faults = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
    numbers = {f"tag:yaml.org,2002:{kind}" for kind in ("int", "float")}

    class Loader(yaml.SafeLoader):
        merged = 0
        """Entries so far of all tables that merge others."""

        def get_single_data(self) -> Any:
            try:
                return super().get_single_data()
            except faults as error:  # such as a character beyond U+10FFFF
                raise yaml.MarkedYAMLError(problem=str(error), problem_mark=self.get_mark()) from error

        def resolve(self, kind: type[yaml.Node], value: str | None, implicit: Any) -> str:
            tag: str = super().resolve(kind, value, implicit)
            return "tag:yaml.org,2002:str" if tag in numbers and ":" in (value or "") else tag

        def flatten_mapping(self, node: yaml.MappingNode) -> None:
            own = len(node.value)
            super().flatten_mapping(node)
            self.merged += len(node.value) if len(node.value) > own else 0
            if max(self.merged, len(node.value)) > (most := BUDGETS["YAML"].count):
                raise yaml.constructor.ConstructorError(
                    None, None, f"a table of over {most} entries", node.start_mark
                )

        def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
            try:
                if node.tag in numbers and (":" in node.value or len(node.value) > LONGEST_NUMBER):
                    raise ValueError("not decimal, or too long")
                return super().construct_object(node, deep)
            except faults as error:
                value = f"{node.value!r:.60}" if isinstance(node.value, str) else f"a {node.id}"
                reason = f": {error}" if isinstance(error, ValueError) else ""
                raise yaml.constructor.ConstructorError(
                    None, None, f"{value} is no {node.tag.rpartition(':')[2]}{reason}", node.start_mark
                ) from error

    return Loader


LONGEST_NUMBER = 300
"""Most characters of a number in YAML; longer ones are beyond 1e300."""

_TOML_WORDS = re.compile(
    r'''"""(?:[^"\\]|\\.|"(?!""))*+"{0,5}|"(?:[^"\\\n]|\\.)*+"?'''
    r"""|'''(?:[^']|'(?!''))*+'{0,5}|'[^'\n]*+'?|#[^\n]*""",
    re.DOTALL,
)
"""Texts and comments of a TOML file. A text without an end, which tomllib refuses, goes as far as it can: to
search for the end of each takes time with the square of the file."""

_TOML_KEY, _TOML_BRACKET = re.compile(r"[\w. \t-]+"), re.compile(r"[][{}]")


def from_table(
    cls: type[T], table: dict[str, Any], path: str | os.PathLike[str], section: str = "", number: int = 0
) -> T:
    """A dataclass from a table of a TOML file, with every key and type checked.

    Args:
        cls: The dataclass. A nested dataclass is a nested table, a tuple of dataclasses an array of tables.
        table: The result of `read_toml`, or a part of it.
        path: The file, for error messages; `Path` fields are relative to its folder.
        section: Name of the table in the file, for error messages.
        number: Index among tables of that name.

    Raises:
        InputError: A key is unknown or missing, or a value has the wrong type or range; the text has file and
            line.
    """
    return _from_table(cls, table, _Where(Path(path), section, number))


def _from_table(cls: type[T], table: dict[str, Any], where: "_Where") -> T:
    """As `from_table`."""
    hints = typing.get_type_hints(cls)
    # the key of a field may differ from its name, or be None (`magtwin.spec.base.KEY`)
    known = {f.metadata.get("key", f.name): f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    known.pop(None, None)
    for key in table:
        if key not in known:
            raise where.refused(key, f"unknown key {key!r}; {hint(key, known)}")
    for name, spec in known.items():
        required = spec.default is spec.default_factory is dataclasses.MISSING
        if required and name not in table:
            raise where.refused("", f"key {name!r} is missing; add it")
    values = {known[key].name: _value(hints[known[key].name], v, where, key) for key, v in table.items()}
    try:
        return cls(**values)
    except InputError as error:
        named = (key for key in table if known[key].name in str(error))
        raise where.refused(next(named, ""), str(error)) from error


def from_values(cls: type[T], values: Mapping[str, Any], what: str) -> T:
    """A dataclass from values that somebody gave in Python, with every name and type checked.

    Lists, tuples and arrays are alike, and NumPy's numbers are numbers.

    Args:
        cls: The dataclass.
        values: Values by field.
        what: How the text of a refusal begins, such as "shelf".

    Raises:
        InputError: A name is unknown or missing, or a value has the wrong type or range.
    """
    return from_table(cls, plain(values), what)


def value_of(cls: type, name: str, value: Any) -> Any:
    """A value that somebody gave in Python for a field of a dataclass, checked and converted.

    Raises:
        InputError: It has the wrong type; the text begins with the name.
    """
    if value is None:
        return None
    try:
        return _value(typing.get_type_hints(cls)[name], plain(value), _Where(Path(), ""), name)
    except InputError as error:
        raise InputError(str(error).removeprefix(".: "), parameter=name) from error


def plain(value: Any) -> Any:
    """A value as a TOML would have it: lists for tuples and arrays, texts for paths, Python's numbers."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items() if entry is not None}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, tuple | list):
        return [plain(entry) for entry in value]
    return str(Path(value).absolute()) if isinstance(value, os.PathLike) else value


def refused_at(
    path: str | os.PathLike[str], key: str, text: str, *, section: str = "", number: int = 0
) -> InputError:
    """An error with the line of a key in a TOML file.

    Args:
        path: The file.
        key: The key.
        text: What is wrong, and what to do.
        section: Name of the key's table; "" for the top.
        number: Index among tables of that name.
    """
    return _Where(Path(path), section, number).refused(key, text)


@dataclasses.dataclass(frozen=True)
class _Where:
    """A table of a TOML file, for errors that name the line."""

    path: Path
    section: str
    number: int = 0
    """Index among tables of that name in `parent`."""

    parent: "_Where | None" = None
    """The table that this one is in."""

    def inside(self, key: str, number: int = 0) -> "_Where":
        """The table, or one of the array of tables, that is the value of a key."""
        return _Where(self.path, f"{self.section}.{key}" if self.section else key, number, self)

    def refused(self, key: str, text: str) -> InputError:
        try:
            lines = self.path.read_text(encoding="utf-8-sig").splitlines()
        except OSError:
            lines = []
        line = self._line(lines, key)
        table = f"[{self.section}] " if self.section else ""
        where = f"{self.path}:{line}" if line else str(self.path)
        return InputError(f"{where}: {table}{text}")

    def _line(self, lines: Sequence[str], key: str) -> int:
        """Line of a key, or of the table if it has none, from 1; 0 if it is not found."""
        begin = self._header(lines)
        if self.section and not begin:  # an inline table
            return self.parent._line(lines, self.section.rpartition(".")[2]) if self.parent else 0
        name = f"{self.section}.{key}" if self.section else key
        inside = True
        for number, line in enumerate(lines[begin:], begin + 1):
            header = _header_of(line)
            inside = inside and not header
            if key and (header == name or (inside and line.split("=")[0].strip().strip('"') == key)):
                return number
            if header and header == self.section:
                break
        return begin

    def _header(self, lines: Sequence[str]) -> int:
        """Line of the table's header, from 1; 0 if it has none."""
        if not self.section:
            return 0
        begin = self.parent._header(lines) if self.parent is not None else 0
        same = [n for n, line in enumerate(lines, 1) if n > begin and _header_of(line) == self.section]
        return same[self.number] if len(same) > self.number else 0


def _header_of(line: str) -> str:
    """The name of the table that a line of TOML begins; "" if it begins none."""
    text = line.split("#")[0].strip()
    return text.strip("[] ") if text.startswith("[") else ""


def _value(kind: Any, value: Any, where: _Where, key: str) -> Any:
    """`value` checked and converted to the annotation `kind`."""

    def wrong() -> InputError:
        return where.refused(key, f"{key} must be {_in_words(kind)}, got {value!r}")

    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        some = [a for a in args if a is not type(None)]
        return _value(type(value) if type(value) in some else some[0], value, where, key)
    table, many = dataclasses.is_dataclass(kind) or origin in (dict, Mapping), origin is tuple
    if (table and not isinstance(value, dict)) or (many and not isinstance(value, list)):
        raise wrong()
    if dataclasses.is_dataclass(kind):
        return _from_table(kind, value, where.inside(key))  # type: ignore[arg-type]
    if many:
        if len(args) == 2 and args[1] is Ellipsis:
            args = (args[0],) * len(value)
        if len(args) != len(value):
            raise wrong()
        if any(dataclasses.is_dataclass(a) for a in args):
            if not all(isinstance(v, dict) for v in value):
                raise wrong()
            each = enumerate(zip(args, value, strict=True))
            return tuple(_from_table(a, v, where.inside(key, k)) for k, (a, v) in each)
        if set(args) == {float} and any(isinstance(v, str) for v in value):
            raise wrong()
        return tuple(_value(a, v, where, key) for a, v in zip(args, value, strict=True))
    if origin is typing.Literal:
        if value not in args:
            raise where.refused(key, f"{key} must be one of {', '.join(map(repr, args))}, got {value!r}")
        return value
    if table:
        return {name: _value(args[1], entry, where.inside(key), name) for name, entry in value.items()}
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if not abs(value) < 1e300:  # nan, inf, and too large integers
            raise wrong()
        return float(value)
    if kind is Path and isinstance(value, str):
        return (where.path.parent / value).resolve()
    if kind is Any or (kind in (str, int, bool) and type(value) is kind):
        return value
    raise wrong()


def _in_words(kind: Any) -> str:
    """An annotation in words."""
    words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    words[Path] = "a file name"
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return f"a list{'' if args[-1] is Ellipsis else f' of {len(args)}'}, each {_in_words(args[0])}"
    if origin in (typing.Union, types.UnionType):
        return _in_words(next(a for a in args if a is not type(None)))
    return words.get(kind, "a table")
