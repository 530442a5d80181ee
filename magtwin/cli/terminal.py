"""What commands say, and how: reports, steps, progress, refusals; options that many of them share."""

import io
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO, cast

from cyclopts import Parameter

from magtwin.cli.progress import announcer, progress, silence, step
from magtwin.errors import InputError
from magtwin.summary import printable

__all__ = [
    "announcer",
    "printable",
    "progress",
    "silence",
    "step",
]  # beside what is made here: commands have all from one place

WIDE = 100_000
"""Columns of output that goes to a file or another program: no line is broken."""


def _whole(kind: type, tokens: Any) -> int:
    """A whole number; cyclopts itself would round 1.5 to 2."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"a whole number is wanted, got {tokens[0].value!r}") from None


Whole = Annotated[int, Parameter(converter=_whole)]
Seed = Whole


def _session(kind: Any, tokens: Any) -> int | str:
    """A session: its number, or "survey"."""
    text = tokens[0].value
    if text == "survey":
        return "survey"
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"a session is a whole number, or survey; got {text!r}") from None


Session = Annotated[int | Literal["survey"] | None, Parameter(converter=_session)]
Force = Annotated[bool, Parameter(name="--force", negative="")]
Json = Annotated[bool, Parameter(name="--json", negative="")]


def say(text: str) -> None:
    """Say a line on stdout."""
    print(text)  # noqa: T201


class _Trimmed(io.TextIOBase):
    """Stdout without the spaces that rich fills up lines with."""

    def write(self, text: str) -> int:
        """Write whole lines."""
        return sys.stdout.write("\n".join(line.rstrip(" ") for line in text.split("\n")))

    def flush(self) -> None:
        """Hand on what was written."""
        sys.stdout.flush()


def stdout_console() -> Any:
    """A console on stdout: as wide as the terminal, or as wide as its text needs where there is none."""
    import os

    from rich.console import Console

    if sys.stdout.isatty():
        return Console(highlight=False)
    width = None if os.environ.get("COLUMNS") else WIDE
    return Console(highlight=False, width=width, file=cast(TextIO, _Trimmed()))


def check_suffix(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    """Refuse a file to write whose name ends otherwise."""
    if path.suffix not in suffixes:
        raise InputError(f"{path}: {what} ends in {' or '.join(suffixes)}")


def print_report(report: Any, as_json: bool) -> None:
    """A report as a table for people, or as JSON for scripts."""
    if as_json:
        say(report.to_json())
        return
    from rich.table import Table
    from rich.text import Text

    console = stdout_console()
    numbers, words = ((Table(show_header=False, box=None, pad_edge=False)) for _ in range(2))
    for column in ("name", "value", "unit"):
        numbers.add_column(column, justify="right" if column == "value" else "left", no_wrap=True)
    numbers.add_column("note", overflow="fold")
    words.add_column("name", no_wrap=True)
    words.add_column("text", overflow="fold")
    lists: list[tuple[str, Any]] = []
    for figure in report.figures:
        if isinstance(figure.value, str):
            note = f"  ({figure.note})" if figure.note else ""
            words.add_row(Text(figure.name), Text(printable(f"{figure.value} {figure.unit}{note}".strip())))
        else:
            value = f"{figure.value:,.6g}" if isinstance(figure.value, float) else f"{figure.value:,}"
            spread = f"± {_rounded(figure.spread)}" if figure.spread is not None else ""
            cells = (figure.name, value, f"{spread} {figure.unit}".strip())
            numbers.add_row(*map(Text, cells), Text(figure.note, style="dim"))
    for name, fact in report.metadata.items():
        if isinstance(fact, (dict, list)):
            lists.append((name, fact))
        elif fact != "":
            words.add_row(Text(name), Text(printable(str(fact))))
    console.print(Text(printable(report.title), style="bold"))
    for table in (numbers, words):
        if table.row_count:
            console.print(table)
    if report.verdict:
        console.print(Text(printable(report.verdict), style="bold"), soft_wrap=True)
    for name, fact in lists:
        console.print(Text(name))
        entries = fact.items() if isinstance(fact, dict) else (("", entry) for entry in fact)
        for key, entry in entries:
            _print_entry(console, printable(str(key)), printable(str(entry)))


def _rounded(spread: float) -> str:
    """A spread to three digits, without an exponent where it is a usual number."""
    text = f"{spread:,.3g}"
    return f"{round(spread, 3 - len(str(int(spread)))):,.0f}" if "e+" in text and spread < 1e9 else text


def _print_entry(console: Any, key: str, text: str) -> None:
    """An entry of a list, below its title: on one line, or its text on lines of its own below its key."""
    from rich.padding import Padding
    from rich.text import Text

    whole = f"{key}  {text}" if key else text
    if not key or len(whole) + 2 <= console.width:
        console.print(Padding(Text(whole, overflow="fold"), (0, 0, 0, 2), expand=False))
        return
    console.print(Padding(Text(key), (0, 0, 0, 2), expand=False))
    console.print(Padding(Text(text, overflow="fold"), (0, 0, 0, 4), expand=False))
