"""Parameters: what a node is set to, each with its range, from a command line as ROS has it: name:=value."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from magtwin.errors import InputError, find


@dataclass(frozen=True)
class Parameter:
    """A number, a word or a flag."""

    default: Any
    """Its value unless it is set, which also tells its type."""

    doc: str
    """What it is, with its unit."""

    low: float | None = None
    high: float | None = None
    """Its range, the ends included; none for any."""

    words: tuple[str, ...] = ()
    """What it may be; none for anything."""


def settings(table: Mapping[str, Parameter], given: Iterable[str]) -> dict[str, Any]:
    """Values of all parameters of a node.

    Args:
        table: Parameters by name.
        given: Those that are set, as `rate_hz:=50`.

    Raises:
        InputError: One is not of that form or not a parameter's, or a value is of the wrong kind or out of
            its range.
    """
    values = {name: parameter.default for name, parameter in table.items()}
    for text in given:
        name, sign, value = text.partition(":=")
        if not sign:
            raise InputError(f"a parameter is set by name:=value, such as rate_hz:=50; got {text!r}")
        values[name] = _value(name, find("parameter", name, table), value)
    return values


def _value(name: str, parameter: Parameter, text: str) -> Any:
    """The value that a text of a command line stands for."""
    kind = type(parameter.default)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise InputError(f"parameter {name} is true or false, got {text!r}")
        return text.lower() == "true"
    if kind is str:
        return checked(name, parameter, text)
    try:
        number = kind(text)
    except ValueError:
        raise InputError(f"parameter {name} is a number, got {text!r}") from None
    return checked(name, parameter, number)


def checked(name: str, parameter: Parameter, value: Any) -> Any:
    """A value of a parameter's kind, if it is one that the parameter may have.

    Raises:
        InputError: It is out of the range, or none of the words.
    """
    if parameter.words and value not in parameter.words:
        raise InputError(f"parameter {name} is {' or '.join(parameter.words)}, got {value!r}")
    low, high = parameter.low, parameter.high
    if not ((low is None or value >= low) and (high is None or value <= high)):
        raise InputError(f"parameter {name} must be from {low:g} to {high:g}, got {value:g}")
    return value
