"""Output of commands: reports on stdout, one JSON document with --json, nothing with --quiet."""

import io
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, cast

from magtwin.cli.progress import announce, current, progress, silence, step
from magtwin.errors import InputError
from magtwin.report.summary import printable, printable_lines

__all__ = ["announce", "printable", "progress", "silence", "step"]  # commands import these from here too

WIDE = 100_000
"""Columns of output that goes to a file or another program: no line is broken."""


@dataclass(frozen=True)
class Done:
    """Result of a command, printed at its end: `Done(report, file)`."""

    report: Any = None
    """A report: `print_report` shows it, and its `to_json` is the JSON."""
    wrote: Path | str | tuple[Path | str, ...] = ()
    """Files and folders that the command wrote."""
    text: str = ""
    """Last lines for people, in place of "Wrote ..."."""
    table: Callable[[], None] | None = None
    """Prints the report for people, in place of `print_report`."""
    data: Any = None
    """Content of the JSON, in place of the report's."""
    status: int = 0
    """Exit status."""

    def show(self) -> None:
        """Print it, as JSON if --json was given, and exit if the status is not 0."""
        wrote = [str(path) for path in (self.wrote if isinstance(self.wrote, tuple) else (self.wrote,))]
        if _mode.json:
            data = self.data
            if data is None:
                data = {} if self.report is None else json.loads(self.report.to_json())
            if wrote and isinstance(data, dict):
                data = {**data, "wrote": wrote}
            text = json.dumps(data, indent=2, ensure_ascii=False)
            print("".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text))  # noqa: T201
        else:
            if self.table is not None:
                self.table()
            elif self.report is not None:
                print_report(self.report)
            if self.text or wrote:
                say(self.text or f"Wrote {', '.join(wrote)}")
        if self.status:
            sys.exit(self.status)


@dataclass
class _Mode:
    """What --json and --quiet of the command said."""

    json: bool = False
    quiet: bool = False


_mode = _Mode()


@contextmanager
def output_mode(*, as_json: bool, quiet: bool) -> Iterator[None]:
    """Print JSON, or nothing, until the end of the block."""
    before = _mode.json, _mode.quiet
    _mode.json, _mode.quiet = as_json, quiet
    watch = current()
    watch.announces, watch.mute = not as_json, quiet
    try:
        yield
    finally:
        _mode.json, _mode.quiet = before


def say(text: str) -> None:
    """Print a line on stdout; nothing with --json or --quiet."""
    if not (_mode.json or _mode.quiet):
        print(printable_lines(text))  # noqa: T201


def note(text: str) -> None:
    """Print an indented line on stderr; nothing with --quiet."""
    if not _mode.quiet:
        print(f"  {printable_lines(text)}", file=sys.stderr)  # noqa: T201


def print_error(text: str, style: str = "") -> None:
    """Print one line on stderr, in colour on a terminal; --quiet prints it too."""
    text = f"magtwin: {printable(' '.join(text.split()))}"
    coloured = style and sys.stderr.isatty()
    print(f"\033[{style}m{text}\033[0m" if coloured else text, file=sys.stderr)  # noqa: T201


@contextmanager
def continued_by_a_repeat(*, when: bool = True) -> Iterator[None]:
    """At Ctrl-C, print that the same command continues the work of the block, if `when`."""
    try:
        yield
    except KeyboardInterrupt:
        if when:
            print_error("interrupted; finished work is kept, and the same command continues")
        raise


class _Trimmed(io.TextIOBase):
    """Stdout without the spaces that rich fills up lines with."""

    def write(self, text: str) -> int:
        """Write whole lines."""
        return sys.stdout.write("\n".join(line.rstrip(" ") for line in text.split("\n")))

    def flush(self) -> None:
        """Flush stdout."""
        sys.stdout.flush()


def stdout_console() -> Any:
    """A console on stdout: as wide as the terminal, or as its text if stdout is no terminal."""
    from rich.console import Console as RichConsole

    class Console(RichConsole):
        def on_broken_pipe(self) -> None:
            raise  # the program ends as after any other output

    if _mode.json or _mode.quiet:
        console = Console(file=io.StringIO(), highlight=False)
    elif sys.stdout.isatty():
        console = Console(highlight=False)
    else:
        width = None if os.environ.get("COLUMNS") else WIDE
        console = Console(highlight=False, width=width, file=cast(TextIO, _Trimmed()))
    console.push_render_hook(cast(Any, _PrintableTexts()))
    return console


class _PrintableTexts:
    """Hook of a console: escapes control characters in all that is printed, but for those of styles."""

    def process_renderables(self, renderables: list[Any]) -> list[Any]:
        """What a console is to print, escaped."""
        return [_Escaped(renderable) for renderable in renderables]


@dataclass(frozen=True)
class _Escaped:
    """Something to print, with control characters of its texts escaped."""

    content: Any

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        from rich.segment import Segment

        for text, style, control in console.render(self.content, options):
            yield Segment(text if control else printable_lines(text), style, control)


def check_suffix(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    """Refuse an output whose name has another suffix."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: {what} ends in {' or '.join(suffixes)}")


def check_output(path: Path | None, suffixes: tuple[str, ...], what: str, *, force: bool) -> None:
    """Refuse an output whose name has another suffix, or that exists without --force."""
    from magtwin.files.outputs import check_free

    if path is not None:
        check_suffix(path, suffixes, what)
        check_free(path, force=force)


def print_report(report: Any) -> None:
    """Print a report as tables; nothing with --json or --quiet."""
    if _mode.json or _mode.quiet:
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
    rows, pairs, lists = _content(report)
    for *cells, note in rows:
        numbers.add_row(*map(Text, cells), Text(note, style="dim"))
    for pair in pairs:
        words.add_row(*map(Text, pair))
    console.print(Text(printable(report.title), style="bold"))
    for table in (numbers, words):
        if table.row_count:
            console.print(table)
    if report.verdict:
        console.print(Text(printable(report.verdict), style="bold"), soft_wrap=True)
    for name, entries in lists:
        console.print(Text(name))
        for key, item in entries:
            _print_entry(console, key, item)


Rows = list[tuple[str, ...]]


def _content(report: Any) -> tuple[Rows, Rows, list[tuple[str, Rows]]]:
    """A report's figures as name, value, unit and note; its words by name; and its lists by name."""
    numbers: Rows = []
    words: Rows = []
    lists: list[tuple[str, Rows]] = []
    for figure in report.figures:
        if isinstance(figure.value, str):
            note = f"  ({figure.note})" if figure.note else ""
            words.append((figure.name, printable(f"{figure.value} {figure.unit}{note}".strip())))
        else:
            value = f"{figure.value:,.6g}" if isinstance(figure.value, float) else f"{figure.value:,}"
            spread = f"± {_rounded(figure.spread)}" if figure.spread is not None else ""
            numbers.append((figure.name, value, f"{spread} {figure.unit}".strip(), figure.note))
    for name, entry in report.metadata.items():
        if isinstance(entry, (dict, list)):
            entries = entry.items() if isinstance(entry, dict) else (("", item) for item in entry)
            lists.append((name, [(printable(str(key)), printable(str(item))) for key, item in entries]))
        elif entry != "":
            words.append((name, printable(str(entry))))
    return numbers, words, lists


def _rounded(spread: float) -> str:
    """A spread to three digits, without an exponent below 1e9."""
    text = f"{spread:,.3g}"
    return f"{round(spread, 3 - len(str(int(spread)))):,.0f}" if "e+" in text and spread < 1e9 else text


def _print_entry(console: Any, key: str, text: str) -> None:
    """Print an entry of a list below its title: on one line if it fits, else the text below its key."""
    from rich.padding import Padding
    from rich.text import Text

    line = f"{key}  {text}" if key else text
    fits = not key or len(line) + 2 <= console.width
    for part, indent in ((line, 2),) if fits else ((key, 2), (text, 4)):
        console.print(Padding(Text(part, overflow="fold"), (0, 0, 0, indent), expand=False))
