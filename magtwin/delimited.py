"""Delimited text: rows of words in a file of another program, such as a spreadsheet or a script.

Separator and header are found from the text. `notes` has what was repaired: lines above the header, decimal
commas, and a last number that was cut short.
"""

import csv
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from magtwin.budget import check_size
from magtwin.errors import InputError
from magtwin.files import existing

LONGEST_LINE = 65_536
"""Longest line [characters]."""

QUOTED = 60
"""Most characters of a file that an error message quotes."""

LOOKED = 50
"""Lines from which the separator is found."""

MOST_ABOVE = 20
"""Most lines above the header, such as the name and the date of a recording."""

LEAST_ROWS = 8
"""Rows from which a last number can be told to be cut short."""

LOST = 5.0
"""Factor below all others from which a number is cut short; a lost digit makes it a tenth."""

MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "#na", "#nv", "#n/a"}
"""Words for a missing value, in lower case. Spreadsheets also write errors for them, such as #DIV/0!."""

LENGTHS = {"m": 1.0, "metre": 1.0, "meter": 1.0, "cm": 0.01, "mm": 0.001, "km": 1e3, "ft": 0.3048}
"""Metres per unit of length, by the unit in a header."""

PLACED = ("x", "y", "heading", "yaw", "theta")
"""Names of columns of poses."""

DEGREES = ("deg", "degree", "degrees", "\N{DEGREE SIGN}", "\N{MASCULINE ORDINAL INDICATOR}")
"""Names of the degree in a header."""

_NUMBER = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
_COMMA = re.compile(r"\s*[+-]?(\d{1,3}(\.\d{3})+|\d*),\d+([eE][+-]?\d+)?\s*", re.ASCII)
"""A number with a decimal comma, and perhaps with points between its thousands."""

_REMARK = re.compile(r"\s*#\s*\w+:\s")
"""A comment line `# KEY: VALUE`, as in maps written as CSV."""

_ERROR = re.compile(r"\s*#(n/?a|nv|value!|div/0!|ref!|num!|name\?|null!)\s*", re.IGNORECASE)
_BRACKETS = re.compile(r"\s*(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*")


@dataclass(frozen=True)
class Delimited:
    """Rows of words, all of one width."""

    path: Path
    """The file."""

    names: tuple[str, ...]
    """Names of the columns; () in a file without a header."""

    rows: Sequence[Sequence[str]]
    """Words of each row."""

    lines: Sequence[int]
    """Line of each row in the file."""

    notes: tuple[str, ...] = ()
    """What was repaired."""

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.names or self.rows[0])

    def named(self) -> "Delimited":
        """Without the columns that have no name beside others that have one, such as the index of pandas."""
        keep = [k for k, name in enumerate(self.names) if name and not name.startswith("Unnamed: ")]
        if not keep or len(keep) == self.width:
            return self
        names = tuple(self.names[k] for k in keep)
        return replace(self, names=names, rows=[[row[k] for k in keep] for row in self.rows])


def read_delimited(path: str | os.PathLike[str], noun: str, kind: str, wanted: str) -> Delimited:
    """Read a text file of rows whose words are separated by commas, semicolons, tabs or blanks.

    The header is the first line if any of its words is not a number, else the last comment line above the
    rows with as many words as they have. Other lines that begin with `#`, such as `# KEY: VALUE`, empty
    lines, a first line `sep=;`, and lines of prose above the header are skipped. A decimal comma is read
    unless commas separate the words or other numbers have decimal points. If the last line has no end, and
    its last number is far below all others of its column, that number is missing.

    Args:
        path: The file.
        noun: What it is, for error messages.
        kind: Format in `magtwin.budget.BUDGETS`.
        wanted: What a row holds, for error messages ("one row of numbers per reading").

    Raises:
        InputError: The file is missing, not text, or empty, or its lines are too long or of different widths.
    """
    path = existing(path, noun)
    if path.is_dir():
        raise InputError(f"{path}: cannot be read (a folder); expected a {noun}")
    check_size(path, kind)
    lines = list(_lines(path, noun))
    ended = not lines or lines[-1][1].endswith("\n")
    lines = [(number, line.rstrip("\n")) for number, line in lines]
    between = None
    told = re.fullmatch(r'"?sep=(.)"?', lines[0][1].strip(" \r"), re.IGNORECASE) if lines else None
    if told:
        lines.pop(0)
    above: list[tuple[int, str]] = []
    while lines and _is_comment(lines[0][1]):
        number, line = lines.pop(0)
        if not _REMARK.match(line):
            above.append((number, line.lstrip().lstrip("#")))
    lines = [(number, line) for number, line in lines if not _is_comment(line)]
    if not lines:
        raise InputError(f"{path}: empty; expected {wanted}")
    begun = [line for _, line in lines[:LOOKED]]
    between, prose = (told[1], 0) if told and told[1] != " " else _separator(begun)
    notes = [f"line {lines[prose][0]} as the header, and the lines above it as prose"] if prose else []
    lines = lines[prose:]
    rows = _words(path, lines, between)
    if between != ",":
        rows, some = _with_points(rows)
        notes += ["numbers with decimal commas"] if some else []
    names: list[str] = []
    if _is_header(rows[0]):
        names = [word.strip() for word in rows.pop(0)]
        lines.pop(0)
    else:
        for comment in above:
            with suppress(InputError):  # prose with unpaired quotes
                (header,) = _words(path, [comment], between)
                names = [word.strip() for word in header] if len(header) == len(rows[0]) else names
    if not rows:
        raise InputError(f"{path}: no rows below the header; expected {wanted}")
    width = len(names) or len(rows[0])
    for (number, _), row in zip(lines, rows, strict=True):
        if len(row) != width:
            raise InputError(f"{path}:{number}: {width} values expected, got {len(row)}")
    numbers = [number for number, _ in lines]
    if not ended and is_cut_short([row[-1] for row in rows]):
        notes.append(
            f"line {numbers[-1]} as cut short and left out: it has no end, and its {rows[-1][-1].strip()} is "
            "far below all other values"
        )
        rows[-1][-1] = ""
    return Delimited(path, tuple(names), rows, numbers, tuple(notes))


def number_of(word: str) -> float:
    """A word as a number; nan if it is missing, -inf if it is not a number."""
    if _NUMBER.fullmatch(word):
        value = float(word)
        return value if math.isfinite(value) else -math.inf
    return math.nan if word.strip().lower() in MISSING or _ERROR.fullmatch(word) else -math.inf


def is_cut_short(column: Sequence[str]) -> bool:
    """Whether the last number of a column has lost its end: it is shorter and far less than all others."""
    *others, last = column
    if len(others) < LEAST_ROWS or not math.isfinite(value := number_of(last)):
        return False
    if len(last.strip()) >= min(len(word.strip()) for word in others):
        return False
    return LOST * abs(value) < min((abs(v) for v in map(number_of, others) if math.isfinite(v)), default=0.0)


def label_of(text: str) -> tuple[str, str]:
    """Name and unit in the header of a column, in lower case: `X [cm]`, `x (cm)` and `x_cm` are x in cm.

    The unit is "" if there is none. It is read after a low line only for the names in `PLACED`.
    """
    text = text.strip().lower()
    if match := _BRACKETS.fullmatch(text):
        return match[1], match[2]
    name, _, unit = text.rpartition("_")
    return (name, unit) if name in PLACED and unit in (*LENGTHS, *DEGREES, "rad") else (text, "")


def _is_header(words: list[str]) -> bool:
    """Whether a word of the first row is not a number, nor one with a comma."""
    return any(math.isinf(number_of(word)) for word in words) and not any(map(_COMMA.fullmatch, words))


def _is_comment(line: str) -> bool:
    """Whether a line begins with `#`, and not with the error of a spreadsheet."""
    return line.lstrip().startswith("#") and not _ERROR.fullmatch(re.split(r"[,;\t]", line, maxsplit=1)[0])


def _lines(path: Path, noun: str) -> Iterator[tuple[int, str]]:
    """Number and text of every nonblank line, with its end."""
    with open(path, encoding="utf-8-sig", newline=None) as file:
        number = 0
        try:
            while line := file.readline(LONGEST_LINE + 1):
                number += 1
                if len(line) > LONGEST_LINE:
                    raise InputError(
                        f"{path}:{number}: longer than {LONGEST_LINE:,} characters; this is no row of numbers"
                    )
                if line.strip():
                    yield number, line
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: not a text file ({error}); a {noun} is CSV in UTF-8") from error


def _separator(lines: Sequence[str]) -> tuple[str | None, int]:
    """What stands between the words of lines, and the number of lines of prose above the header.

    It is the mark that each line has as often, from the header on; None for blanks.
    """
    words = lines[-1].split()
    numbers = all(_COMMA.fullmatch(word) or math.isfinite(number_of(word)) for word in words)
    if len(words) > 1 and numbers and any(map(_COMMA.fullmatch, words)):
        return None, 0
    bare = [re.sub(r'"[^"]*"', "", line) for line in lines]
    found = {mark: above for mark in ";\t," if (above := _above(bare, mark)) is not None}
    if 0 in found.values():
        return next(mark for mark, above in found.items() if not above), 0
    for mark, above in found.items():
        prose, header = lines[:above], lines[above].split(mark)
        if all(_is_header(line.split(mark)) for line in prose) and not any(map(_NUMBER.fullmatch, header)):
            return mark, above
    return next((mark for mark in ",;\t" if mark in lines[0]), None), 0


def _above(lines: Sequence[str], mark: str) -> int | None:
    """Number of lines above those that have a mark as often as the last has; None if these are no table."""
    counts = [line.count(mark) for line in lines]
    above = counts.index(counts[-1])
    same = counts[-1] > 0 and set(counts[above:]) == {counts[-1]}
    return above if same and (above == 0 or above <= min(MOST_ABOVE, len(lines) - 2)) else None


def _words(path: Path, lines: list[tuple[int, str]], between: str | None) -> list[list[str]]:
    if between is None:
        return [line.split() for _, line in lines]
    rows = []
    for number, line in lines:
        try:
            rows.append(next(csv.reader([line], delimiter=between, strict=True)))
        except csv.Error as error:
            raise InputError(f"{path}:{number}: not CSV: {error}, in {line[:QUOTED]!r}") from None
    return rows


def _with_points(rows: list[list[str]]) -> tuple[list[list[str]], bool]:
    """Rows whose decimal commas are points, unless numbers have both; and whether there are any."""
    if not any(_COMMA.fullmatch(word) for row in rows for word in row if "," in word):
        return rows, False
    if any(_NUMBER.fullmatch(word) for row in rows for word in row if "." in word):
        return rows, False
    return [
        [word.replace(".", "").replace(",", ".") if _COMMA.fullmatch(word) else word for word in row]
        for row in rows
    ], True
