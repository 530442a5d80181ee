"""Parameters of a node, each with its range; set by name:=value on the command line, as in ROS."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from magtwin.errors import InputError, find


@dataclass(frozen=True)
class Parameter:
    """A number, a word or a flag."""

    default: Any
    """Default, which also defines the type."""

    doc: str
    """Meaning and unit."""

    low: float | None = None
    high: float | None = None
    """Inclusive range; None means no limit."""

    words: tuple[str, ...] = ()
    """Allowed words; empty allows any."""


def settings(table: Mapping[str, Parameter], given: Iterable[str]) -> dict[str, Any]:
    """Values of all parameters of a node.

    Args:
        table: Parameters by name.
        given: Parameters to set, such as `rate_hz:=50`.

    Raises:
        InputError: The form is wrong, a parameter is unknown, or a value has the wrong type or is out of its
            range.
    """
    values = {name: parameter.default for name, parameter in table.items()}
    for text in given:
        name, sign, value = text.partition(":=")
        if not sign:
            raise InputError(f"a parameter is set by name:=value, such as rate_hz:=50; got {text!r}")
        values[name] = _value(name, find("parameter", name, table), value)
    return values


def _value(name: str, parameter: Parameter, text: str) -> Any:
    """The value of a text from the command line."""
    kind = type(parameter.default)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise InputError(f"parameter {name} is true or false, got {text!r}")
        return text.lower() == "true"
    if kind is str:
        if parameter.words and text not in parameter.words:
            raise InputError(f"parameter {name} is {' or '.join(parameter.words)}, got {text!r}")
        return text
    low, high = parameter.low, parameter.high
    try:
        value = kind(text)
    except ValueError:
        raise InputError(f"parameter {name} is a number, got {text!r}") from None
    if not ((low is None or value >= low) and (high is None or value <= high)):
        raise InputError(f"parameter {name} must be from {low:g} to {high:g}, got {value:g}")
    return value
