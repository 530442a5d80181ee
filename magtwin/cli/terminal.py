"""What commands say, and how: reports, steps, progress, refusals; options that many of them share."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from magtwin.names import RefusedError


def _whole(kind: type, tokens: Any) -> int:
    """A whole number; cyclopts itself would round 1.5 to 2."""
    return int(tokens[0].value)


Whole = Annotated[int, Parameter(converter=_whole)]
Seed = Whole
Force = Annotated[bool, Parameter(name="--force", negative="")]
Json = Annotated[bool, Parameter(name="--json", negative="")]


def say(text: str) -> None:
    """Say a line on stdout."""
    print(text)  # noqa: T201


def announcer(*, quiet: bool) -> Any:
    """A function that says what is being done, on stderr."""
    return (lambda text: None) if quiet else (lambda text: print(f"  {text} ...", file=sys.stderr))  # noqa: T201


@contextmanager
def progress(title: str) -> Iterator[Any]:
    """A progress bar with rate and time left; gives `advance(done, total, what)`."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=None, what="")
        yield lambda done, total, what: progress.update(task, completed=done, total=total, what=what)


def check_suffix(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    """Refuse a file to write whose name ends otherwise."""
    if path.suffix not in suffixes:
        raise RefusedError(f"{path}: {what} ends in {' or '.join(suffixes)}")


def print_report(report: Any, as_json: bool) -> None:
    """A report as a table for people, or as JSON for scripts."""
    if as_json:
        say(report.to_json())
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    numbers, words = ((Table(show_header=False, box=None, pad_edge=False)) for _ in range(2))
    for column in ("name", "value", "spread", "unit", "note"):
        numbers.add_column(column, justify="right" if column == "value" else "left", overflow="fold")
    for column in ("name", "text"):
        words.add_column(column, overflow="fold")
    for figure in report.figures:
        if isinstance(figure.value, str):
            note = f"  ({figure.note})" if figure.note else ""
            words.add_row(Text(figure.name), Text(f"{figure.value} {figure.unit}{note}".strip()))
        else:
            value = f"{figure.value:,.6g}" if isinstance(figure.value, float) else f"{figure.value:,}"
            spread = f"± {figure.spread:,.3g}" if figure.spread is not None else ""
            cells = (figure.name, value, spread, figure.unit)
            numbers.add_row(*map(Text, cells), Text(figure.note, style="dim"))
    for name, fact in report.facts.items():
        if isinstance(fact, dict):
            entries = list(fact.items())
        else:
            entries = [("", entry) for entry in (fact if isinstance(fact, list) else [fact])]
        for key, entry in entries:
            words.add_row(Text(f"{name} {key}".strip()), Text(str(entry)))
    console.print(Text(report.title, style="bold"))
    for table in (numbers, words):
        if table.row_count:
            console.print(table)
