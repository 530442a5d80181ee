"""The base class of all specs, and the types of their fields.

A spec is plain data: `usd/` reads and authors it, `sim/` runs it. Each field is one attribute of a prim, and
is checked when the spec is made. Lengths are metres, angles radians, fields nT.
"""

import functools
import math
import re
import types
import typing
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

from magtwin.errors import InputError, hint

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
"""Rows of a 3 x 3 matrix, one after the other."""

ZERO3: Vec3 = (0.0, 0.0, 0.0)
ZERO9: Matrix3 = (0.0,) * 9  # type: ignore[assignment]

UNIT_TOLERANCE = 1e-6
"""Largest error of the squared length of a unit quaternion; single precision passes."""


KEY = "key"
"""Metadata of a field: its key in a TOML, if that is not its name; None if a TOML does not have it."""

LATER = "later"
"""Metadata of a field that a later version added: `spelled` leaves it out while it has its default."""


ONE, ANY = 0, -1
"""Width of a field that is one number, and of a tuple of any length."""

_Kind = tuple[int, type]
"""Width of a field of numbers, and float or int."""


@functools.cache
def _number_fields(cls: type) -> dict[str, _Kind]:
    """The fields of a spec that are numbers."""
    widths: dict[str, _Kind] = {}
    for name, kind in typing.get_type_hints(cls).items():
        some = [a for a in typing.get_args(kind) if a is not type(None)]
        if isinstance(kind, types.UnionType) and len(some) == 1:
            kind, some = some[0], list(typing.get_args(some[0]))
        if kind in (float, int):
            widths[name] = ONE, kind
        elif typing.get_origin(kind) is tuple and set(some) in ({float}, {float, Ellipsis}):
            widths[name] = ANY if Ellipsis in some else len(some), float
    return widths


def _are_numbers(value: Any, width: int, kind: type) -> bool:
    """Whether a value has the form of its field; an int is no float, and has another spelling."""
    if width == ONE:
        return type(value) is kind
    return type(value) is tuple and width in (ANY, len(value)) and all(type(x) is kind for x in value)


class Spec:
    """Base class of all specs: every number is one and finite. Lists and arrays become tuples."""

    def __post_init__(self) -> None:
        kinds = _number_fields(type(self))  # type: ignore[arg-type]
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if f.name in kinds and not _are_numbers(value, *kinds[f.name]):
                value = self._numbers(f.name, value, *kinds[f.name])
            numbers = value if isinstance(value, tuple) else (value,)
            finite = all(abs(x) < math.inf for x in numbers if isinstance(x, int | float))
            self._require(f.name, finite, "be finite", value)

    def _numbers(self, name: str, given: Any, width: int, kind: type) -> Any:
        """The value of a field of numbers, from NumPy's, a list's or whole ones."""
        if given is None:  # of a field that may be None; others are refused where they are used
            return None
        value = given.tolist() if hasattr(given, "tolist") else given
        many = list(value) if isinstance(value, list | tuple) and width != ONE else [value]
        fits = width in (ANY, len(many)) or (width == ONE and not isinstance(value, list | tuple))
        fits = fits and all(isinstance(x, int | float) and not isinstance(x, bool) for x in many)
        one = "be a number" if kind is float else "be a whole number"
        what = {ONE: one, ANY: "be numbers"}.get(width, f"be {width} numbers")
        self._require(name, fits and (kind is float or all(x == int(x) for x in many)), what, given)
        many = [kind(x) for x in many]
        value = many[0] if width == ONE else tuple(many)
        object.__setattr__(self, name, value)
        return value

    def _require(self, name: str, holds: bool, what: str, value: Any) -> None:
        if not holds:
            kind = re.sub(r"Spec$|Table$|Settings$", "", type(self).__name__.lstrip("_"))
            kind = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind).lower()  # as in a TOML
            raise InputError(f"{name} of {kind} must {what}, got {value!r}")

    def _above_zero(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            self._require(name, _least(value) > 0, "be above 0", value)

    def _not_negative(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            self._require(name, _least(value) >= 0, "not be below 0", value)

    def _named(self, name: str, known: tuple[str, ...]) -> None:
        value = getattr(self, name)
        self._require(name, value in known, f"be a known {name} ({hint(value, known)})", value)

    def _within(self, name: str, least: float, most: float) -> None:
        value = getattr(self, name)
        self._require(name, least <= value <= most, f"lie in {least:g}..{most:g}", value)

    def _unit(self, *names: str) -> None:
        for name in names:
            q = getattr(self, name)
            off = abs(sum(c * c for c in q) - 1)
            self._require(name, off <= UNIT_TOLERANCE, "be a unit quaternion", q)


def _least(value: float | tuple[float, ...]) -> float:
    return min(value) if isinstance(value, tuple) else value


def _is_default(spec: Any, f: Field[Any]) -> bool:
    """Whether a field of a spec has its default."""
    default = f.default if f.default_factory is MISSING else f.default_factory()
    return bool(getattr(spec, f.name) == default)


def spelled(value: Any) -> str:
    """Every value of a spec as text, the input of its checksum.

    It is the `repr` of a plain dataclass, even if the class has its own `repr`. Runs keep the checksum, so
    the spelling must not change.
    """
    if is_dataclass(value) and not isinstance(value, type):
        kept = [f for f in fields(value) if f.repr and not (LATER in f.metadata and _is_default(value, f))]
        values = ", ".join(f"{f.name}={spelled(getattr(value, f.name))}" for f in kept)
        return f"{type(value).__qualname__}({values})"
    if type(value) is tuple:
        return f"({', '.join(map(spelled, value))}{',' * (len(value) == 1)})"
    return repr(value)
