"""Refusals of wrong input, and look-ups by name."""

import ast
import difflib
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

LONGEST = 1500
"""Most characters of a refusal; what it quotes from a file may have no end."""

NEAR, NEAR_SHORT, SHORT = 0.7, 0.6, 4
"""Least similarity of a suggested name (1: equal): of a long one, and of one of at most so many letters."""

TERMINATED = 143
"""Exit status of a command that SIGTERM ended."""

_PARAMETER = re.compile(r"`(?:magtwin\.)?([a-z_][a-z0-9_]*)(?:=([^`]*)|\(([^`]*)\))?`")
"""A parameter in the text of a refusal: `force=True`, `map_layer`, `magtwin.allow('folder')`."""

_FIRST = re.compile(r"\A([a-z]\w*_\w+(?= )|[a-z]+(?= (?:of [^:;,]* )?(?:must|is no option) ))")
"""A parameter that begins a refusal: rate_hz of the magnetometer must be above 0."""


class InputError(ValueError):
    """An input that magtwin refuses. Its text says what is wrong, where, and what to do.

    Everything that a user can get wrong (a file, a name, a number) raises this class or a subclass. The
    command line prints it as one line and exits with status 1.

    A text names a parameter as a Python user writes it, in backticks: `` `force=True` ``, or as its first
    word: `seed must be 0 or more`. The command line prints `in_flags` instead.
    """

    parameter: str | None
    """Name of the parameter that is wrong, or that would help. None if the error is about none."""

    def __init__(self, text: str = "", *, parameter: str | None = None) -> None:
        if "\n" in text:  # in a value of a file, such as a matrix
            text = " ".join(line.strip() for line in text.split("\n"))
        if len(text) > LONGEST:  # what is wrong is at the beginning, what to do at the end
            text = f"{text[: LONGEST * 2 // 3]} ... {text[-LONGEST // 3 :]}"
        super().__init__(text)
        self.parameter = parameter

    def in_flags(self, flags: Mapping[str, str]) -> str:
        """The text with parameters spelled as flags: `` `force=True` `` becomes `--force`.

        Args:
            flags: Flag of each parameter that the command has ({"force": "--force"}). Other words
                stay as they are.

        Returns:
            The text, in which the flag of `parameter` is named in any case.
        """

        def flag(match: re.Match[str]) -> str:
            name, value, arguments = match.groups()
            if name not in flags:
                return match.group()
            if arguments is not None:
                try:
                    texts = ast.literal_eval(f"({arguments},)")
                except (ValueError, SyntaxError):
                    return match.group()  # text of a file, that looks like a call
                return " ".join(f"{flags[name]} {shlex.quote(text)}" for text in texts)
            value = (value or "").strip("\"'")
            return f"{flags[name]} {value}" if value not in ("", "True") else flags[name]

        text = _PARAMETER.sub(flag, str(self))
        text = _FIRST.sub(lambda match: flags.get(match[1], match[1]), text)
        named = flags.get(self.parameter or "")
        return f"{named}: {text}" if named and named not in text else text


@contextmanager
def about(start: str) -> Iterator[None]:
    """Errors inside begin with what they are about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{start} {error}") from error


def is_termination(error: BaseException) -> bool:
    """Whether an error ends the command itself, and is not a `sys.exit` of code that the user gave."""
    return isinstance(error, SystemExit) and error.code == TERMINATED


class MismatchWarning(UserWarning):
    """A network is used where it was not trained, or a map where the lab is no longer as it was."""


class RepairWarning(UserWarning):
    """An input was repaired, or an option is not followed to the letter; the text says how."""


class CalibrationWarning(UserWarning):
    """A drive is poorly suited to calibrate a model."""


class UnknownNameError(InputError, KeyError):
    """A name that is not in a table. It is also a KeyError, as Python's mappings raise."""

    __str__ = InputError.__str__  # KeyError would show the text in quotes


def hint(name: object, known: Iterable[str]) -> str:
    """The end of a refusal: the nearest known name, or all of them. A name from a file may be no text."""
    known = sorted(known)
    match = _nearest(name, known)
    return f"did you mean {match!r}?" if match else f"known: {', '.join(known)}"


def near(name: object, known: Iterable[str]) -> str:
    """An addition to a text with the nearest known name: " (did you mean 'left'?)", or ""."""
    return f" (did you mean {match!r}?)" if (match := _nearest(name, sorted(known))) else ""


def _nearest(name: object, known: list[str]) -> str:
    """The nearest known name, "" if all are far."""
    if not isinstance(name, str):
        return ""
    cutoff = NEAR_SHORT if len(name) <= SHORT else NEAR
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=cutoff)), "")


def find(kind: str, name: object, table: Mapping[str, T]) -> T:
    """The entry called `name`.

    Args:
        kind: What the table holds, in the singular, for the refusal ("path", "column").
        name: The name looked for.
        table: Entries by name.

    Raises:
        UnknownNameError: No such entry; the text names the nearest one.
    """
    if isinstance(name, str) and name in table:
        return table[name]
    raise UnknownNameError(f"no {kind} {name!r}; {hint(name, table)}")
