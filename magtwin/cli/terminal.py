"""Output of commands: verdict, figures, files, what to type next; JSON with --json, nothing with --quiet."""

import io
import json
import os
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, cast

from magtwin.cli.progress import announce, current, progress, silence, step
from magtwin.errors import InputError
from magtwin.report.report import jsonable
from magtwin.report.summary import WIDTH, aligned, clipped, listed, printable, printable_lines

__all__ = ["announce", "printable", "progress", "silence", "step"]  # commands import these from here too

WIDE = 100_000
"""Columns of output that goes to a file or another program: no line is broken."""

MOST_LINES, MOST_FIGURES, MOST_NOTES = 12, 5, 5
"""Most lines, figures and notes that a command prints; `magtwin info`, pages and --json have all."""

ORIGIN = ("licences", "columns", "features", "inputs")
"""Lists of a report that only `magtwin info` prints, as it does those of checksums."""

MISMATCH = "_mismatch"
"""End of the names of facts that are always printed: the network or the map is that of another twin."""

FLAG = "flag_"
"""Figures with this in their names count readings in doubt, and are printed in one line."""

CHECKSUM, LISTS = re.compile(r"[0-9a-f]{32}"), (dict, list, tuple)


@dataclass(frozen=True)
class Done:
    """Result of a command, printed at its end: `Done(report, file)`."""

    report: Any = None
    """A report; its `to_json` is the JSON."""
    wrote: Path | str | tuple[Path | str, ...] = ()
    """Files and folders that the command wrote."""
    figures: Sequence[str] = ()
    """Names of the figures that are printed. Default: the first."""
    lines: Sequence[str] = ()
    """What is printed in place of a report."""
    text: str = ""
    """Added to the line of what was written; or the only line."""
    rest: str = ""
    """Command or file that has what is not printed. Default: --json."""
    next: Sequence[Sequence[object]] = ()
    """Commands to type next, each by its words."""
    data: Any = None
    """Content of the JSON, in place of the report's."""
    whole: bool = False
    """Whether all of the report is printed."""
    status: int = 0
    """Exit status."""

    def show(self) -> None:
        """Print it, as JSON if --json was given, and exit if the status is not 0."""
        from magtwin.files.outputs import instead

        wrote = [str(path) for path in (self.wrote if isinstance(self.wrote, tuple) else (self.wrote,))]
        following = [shlex.join(map(str, words)) for words in self.next]
        written = [folder for path in wrote for folder in (Path(path), *Path(path).parents)]
        renamed = [str(asked) for asked, new in instead().items() if new in written]
        exist = f"{' and '.join(renamed)} exist{'s' if len(renamed) == 1 else ''}"
        said = f"{exist}: wrote" if renamed else "Wrote"
        said = f"{said} {listed(wrote, WIDTH)}" if wrote else ""
        if not any(_mode.values()):
            inside = ""
            if len(wrote) == 1 and Path(wrote[0]).is_dir():
                inside = listed(sorted(file.name for file in Path(wrote[0]).glob("[!.]*")))
            told = ": ".join(filter(None, (said, self.text or inside)))
            tail = [told] if told and not renamed else []
            tail += [f"{'       ' if k else 'Next:  '}{words}" for k, words in enumerate(following)]
            head = [_bold(f"{told}; --force replaces")] if renamed else []
            for line in (*head, *self._told(MOST_LINES - len(head) - len(tail)), *tail):
                say(line)
        elif renamed:
            print_error(said)
        if _mode["json"]:
            data = self.data
            if data is None:
                data = {} if self.report is None else json.loads(self.report.to_json())
            if isinstance(data, dict):
                data = {**data, **({"wrote": wrote} if wrote else {})}
                data |= {"next": following} if following else {}
            print_json(data)
        if self.status:
            sys.exit(self.status)

    def _told(self, room: int) -> list[str]:
        """The report in a number of lines: title, verdict, figures, notes, and where the rest is."""
        if self.report is None:
            return _cut(self.lines, room, self.rest)
        report, named = self.report, {figure.name: figure for figure in self.report.figures}
        flags = [figure for figure in report.figures if FLAG in figure.name]
        lines = "\n".join(_bold(line) for line in (report.title, report.verdict) if line).splitlines()
        wrong = [str(each) for name, each in report.metadata.items() if name.endswith(MISMATCH)]
        if self.whole:
            words = [
                (name, str(each)) for name, each in report.metadata.items() if not isinstance(each, LISTS)
            ]
            lists = [line for name, each in report.metadata.items() for line in _notes(name, each)]
            return [*lines, *_rows(report.figures), *aligned([row for row in words if row[1]]), *lists]
        plain = [figure for figure in report.figures if figure not in flags]
        chosen = [named[name] for name in self.figures if name in named] if self.figures else plain
        lines += map(printable, wrong)
        most = max(min(MOST_FIGURES, room - len(lines) - bool(flags) - 1), 1)
        lines += _rows(chosen[:most], clip=True)
        counts = ", ".join(f"{f.value:,} {f.name.replace(FLAG, '')}" for f in flags)
        lines += [f"readings in doubt  {counts}"] if flags else []
        notes = [line for name, each in report.metadata.items() for line in _notes(name, each, brief=True)]
        facts = [each for each in report.metadata.values() if not isinstance(each, LISTS) and each != ""]
        left = len(report.figures) - len(flags) - min(len(chosen), most) + len(facts) - len(wrong)
        room = min(room - len(lines), MOST_NOTES + 2)
        return lines + _cut([*self.lines, *notes], room, self.rest, left if self.rest else 0)


def _cut(lines: Sequence[str], most: int, rest: str, left: int = 0) -> list[str]:
    """At most so many lines, the last of which tells how many more there are, beside `left`, and where."""
    if len(lines) + bool(left) <= most and not left:
        return list(lines)
    shown = max(min(most - 1, len(lines)), 0)
    return [
        *lines[:shown],
        f"and {len(lines) - shown + left:,} more {'facts' if left else 'lines'}: {rest or 'add --json'}",
    ]


def _bold(text: str) -> str:
    """A title or verdict, whose lines are broken between words on a terminal."""
    columns = width()
    return printable(text) if columns is None else textwrap.fill(printable(text), columns)


def width() -> int | None:
    """Columns of the terminal; None for output that goes elsewhere."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() or os.environ.get("COLUMNS") else None


def _rows(figures: Sequence[Any], *, clip: bool = False) -> list[str]:
    """Figures as lines of name, value, unit and note; a terminal's notes are clipped to its width."""
    numbers, words, columns = list[tuple[str, ...]](), list[tuple[str, ...]](), width()
    for figure in figures:
        value = figure.value
        if isinstance(value, str):
            words.append((figure.name, f"{value} {figure.unit}".rstrip(), figure.note))
            continue
        spread = f"± {_rounded(figure.spread)} " if figure.spread is not None else ""
        shown = f"{value:,.6g}" if isinstance(value, float) else f"{value:,}"
        numbers.append((figure.name, shown, f"{spread}{figure.unit}", figure.note))
    lines = [*aligned(numbers, right=(1,)), *aligned(words)]
    return [clipped(line, columns) if clip and columns else line for line in lines]


def _notes(name: str, entry: Any, *, brief: bool = False) -> list[str]:
    """A list or table of metadata: its name, and a line for each entry."""
    if not isinstance(entry, LISTS) or (brief and (name in ORIGIN or CHECKSUM.search(str(entry)))):
        return []
    pairs = entry.items() if isinstance(entry, dict) else (("-", item) for item in entry)
    return [name, *(f"  {printable(str(key))}  {printable(str(item))}" for key, item in pairs)]


def refusal(text: str) -> dict[str, str]:
    """A refusal for JSON: its text, and the file, the parameter and the way on that it names."""
    file, colon, _ = text.partition(": ")
    looks = os.path.lexists(file) or (" " not in file and ("/" in file or "." in file))
    parameter = re.search(r"--[a-z][a-z0-9-]*", text)
    found = {
        "message": text,
        "file": file if colon and looks else "",
        "parameter": parameter[0] if parameter else "",
        "hint": text.rpartition("; ")[2] if "; " in text else "",
    }
    return {name: each for name, each in found.items() if each}


def print_json(data: Any) -> None:
    """Print one JSON document on stdout."""
    text = json.dumps(jsonable(data), indent=2, ensure_ascii=False)
    print("".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text))  # noqa: T201


_mode = {"json": False, "quiet": False}
"""What --json and --quiet of the command said."""


@contextmanager
def output_mode(*, as_json: bool, quiet: bool) -> Iterator[None]:
    """Print JSON, or nothing, until the end of the block."""
    before = dict(_mode)
    _mode.update(json=as_json, quiet=quiet)
    watch = current()
    watch.announces, watch.mute = not as_json, quiet
    try:
        yield
    finally:
        _mode.update(before)


def say(text: str) -> None:
    """Print a line on stdout; nothing with --json or --quiet."""
    if not any(_mode.values()):
        current().clear()
        print(printable_lines(text))  # noqa: T201


def note(text: str) -> None:
    """Print an indented line on stderr; nothing with --quiet."""
    if not _mode["quiet"]:
        current().clear()
        print(f"  {printable_lines(text)}", file=sys.stderr)  # noqa: T201


def print_error(text: str, style: str = "") -> None:
    """Print one line on stderr, in colour on a terminal; --quiet prints it too."""
    text = f"magtwin: {printable(' '.join(text.split()))}"
    coloured = style and sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    current().clear()
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


def stdout_console() -> Any:
    """A console for help that goes to a file or another program: no line is broken."""
    from rich.console import Console as RichConsole

    class Console(RichConsole):
        def on_broken_pipe(self) -> None:
            raise  # the program ends as after any other output

    columns = None if os.environ.get("COLUMNS") else WIDE
    return Console(highlight=False, width=columns, file=cast(TextIO, _Trimmed()))


class _Trimmed(io.TextIOBase):
    """Stdout without the spaces that rich fills up lines with."""

    def write(self, text: str) -> int:
        """Write whole lines."""
        return sys.stdout.write("\n".join(line.rstrip(" ") for line in text.split("\n")))

    def flush(self) -> None:
        """Flush stdout."""
        sys.stdout.flush()


def named(
    path: Path, suffixes: Sequence[str] = (), what: str = "", *, beside: Sequence[str] = (), force: bool
) -> Path:
    """A free name for an output, of one of the suffixes if there are any: `magtwin.files.outputs.free`."""
    from magtwin.files.outputs import free

    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: {what} ends in {' or '.join(suffixes)}")
    return free(path, beside=beside, force=force)[0]


def _rounded(spread: float) -> str:
    """A spread to three digits, without an exponent below 1e9."""
    text = f"{spread:,.3g}"
    return f"{round(spread, 3 - len(str(int(spread)))):,.0f}" if "e+" in text and spread < 1e9 else text
