"""Refusals, and finding things by name."""

import difflib
from collections.abc import Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")


class InputError(ValueError):
    """An input that magtwin will not work on; its text says what, where and what to do.

    Everything a user can get wrong (a file, a name, a number) raises this class or a subclass of it.
    The command line prints it as one line and exits with status 1.
    """


class MismatchWarning(UserWarning):
    """A network is used with a map, at a place or on a robot that it did not learn on."""


class UnknownNameError(InputError, KeyError):
    """A name that is not in a table; also a KeyError, so that mappings behave as Python's do."""

    __str__ = InputError.__str__  # KeyError would show the text in quotes


def hint(name: str, known: Iterable[str]) -> str:
    """The end of a refusal: the nearest known name, or all of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"


def find(kind: str, name: str, table: Mapping[str, T]) -> T:
    """The entry called `name`.

    Args:
        kind: What the table holds, in the singular, for the refusal ("path", "column").
        name: The name looked for.
        table: Entries by name.

    Raises:
        UnknownNameError: No such entry; the text names the nearest one.
    """
    if name in table:
        return table[name]
    raise UnknownNameError(f"no {kind} {name!r}; {hint(name, table)}")
