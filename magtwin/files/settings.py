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
    known = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in table:
        if key not in known:
            raise where.refused(key, f"unknown key {key!r}; {hint(key, known)}")
    for name, spec in known.items():
        if (
            name not in table
            and spec.default is dataclasses.MISSING
            and spec.default_factory is dataclasses.MISSING
        ):
            raise where.refused("", f"key {name!r} is missing; add it")
    values = {key: _value(hints[key], value, where, key) for key, value in table.items()}
    try:
        return cls(**values)
    except InputError as error:
        raise where.refused(next((k for k in values if k in str(error)), ""), str(error)) from error


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


_Place = tuple[tuple[str, int], ...]
"""Names and indices of the tables from the top to one."""


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
        line = self._line(key)
        table = f"[{self.section}] " if self.section else ""
        where = f"{self.path}:{line}" if line else str(self.path)
        return InputError(f"{where}: {table}{text}")

    def _line(self, key: str) -> int | None:
        """Line of a key, or of the table if it has none; None if the file cannot be read."""
        try:
            lines = self.path.read_text(encoding="utf-8-sig").splitlines()
        except OSError:
            return None
        here, counts, header = self._place(), dict[_Place, int](), 0
        place: _Place = ()
        for number, line in enumerate(lines, 1):
            text = line.strip()
            if text.startswith("["):
                name = text.split("#")[0].strip("[] ")
                place = _counted(counts, name, text.startswith("[["))
                if _matches(place, here):
                    header = number
                elif key and place[-1][0] == key and _matches(place[:-1], here):
                    return number
            elif _matches(place, here) and key and text.split("=")[0].strip().strip('"') == key:
                return number
        if not header and self.parent is not None:  # an inline table
            return self.parent._line(self.section.rpartition(".")[2])
        return header or None

    def _place(self) -> tuple[tuple[str, int | None], ...]:
        """Names and indices of the tables from the top to this one; an index of None matches any."""
        above: tuple[tuple[str, int | None], ...] = ()
        if self.parent is not None:
            above = self.parent._place()
        elif self.section:
            above = tuple((name, None) for name in self.section.split(".")[:-1])
        return (*above, (self.section.rpartition(".")[2], self.number)) if self.section else ()


def _counted(counts: dict[_Place, int], name: str, array: bool) -> _Place:
    """Names and indices of the tables that a header begins; `counts` has those of the headers before."""
    *above, last = name.split(".", BUDGETS["TOML"].depth)
    place: _Place = ()
    for word in above:
        place = (*place, (word, counts.get((*place, (word, 0)), 0)))
    first = (*place, (last, 0))
    if array:
        counts[first] = counts.get(first, -1) + 1
    return (*place, (last, counts.get(first, 0)))


def _matches(place: Sequence[tuple[str, int]], wanted: Sequence[tuple[str, int | None]]) -> bool:
    return len(place) == len(wanted) and all(
        name == word and index in (None, number)
        for (name, number), (word, index) in zip(place, wanted, strict=True)
    )


def _value(kind: Any, value: Any, where: _Where, key: str) -> Any:
    """`value` checked and converted to the annotation `kind`."""

    def wrong() -> InputError:
        return where.refused(key, f"{key} must be {_in_words(kind)}, got {value!r}")

    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _value(next(a for a in args if a is not type(None)), value, where, key)
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise wrong()
        return _from_table(kind, value, where.inside(key))  # type: ignore[arg-type]
    if origin is tuple:
        if not isinstance(value, list):
            raise wrong()
        if len(args) == 2 and args[1] is Ellipsis:
            args = (args[0],) * len(value)
        if len(args) != len(value):
            raise wrong()
        if any(dataclasses.is_dataclass(a) for a in args):
            if not all(isinstance(v, dict) for v in value):
                raise wrong()
            return tuple(
                _from_table(a, v, where.inside(key, k))
                for k, (a, v) in enumerate(zip(args, value, strict=True))
            )
        return tuple(_value(a, v, where, key) for a, v in zip(args, value, strict=True))
    if origin is typing.Literal:
        if value not in args:
            raise where.refused(key, f"{key} must be one of {', '.join(map(repr, args))}, got {value!r}")
        return value
    if origin in (dict, Mapping):
        if not isinstance(value, dict):
            raise wrong()
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
    words = {
        float: "a number",
        int: "a whole number",
        str: "a text",
        bool: "true or false",
        Path: "a file name",
    }
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"a list, each {_in_words(args[0])}"
        return f"a list of {len(args)}, each {_in_words(args[0])}"
    if origin in (typing.Union, types.UnionType):
        return _in_words(next(a for a in args if a is not type(None)))
    return words.get(kind, "a table")
