"""Delimited text: rows of words in a file of another program, such as a spreadsheet or a script.

Encoding, separator and header are found from the text. `notes` has what was repaired: lines above the header,
headers that are repeated, decimal commas, marks between thousands, and a last line that was cut short.
"""

import codecs
import csv
import itertools
import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from magtwin.errors import InputError
from magtwin.tables.body import body_of, cells, degrees_of
from magtwin.tables.labels import meaning_of, split_label
from magtwin.tables.quantities import UNITS

LONGEST_LINE = 65_536  # Longest line [characters]
QUOTED = 60  # Most characters of a file that an error message quotes
HEAD = 4096  # Bytes from which the encoding is found
LOOKED = 50  # Lines from which the separator is found
MOST_ABOVE = 20  # Most lines above the header, such as the name and the date of a recording
LEAST_ROWS = 8  # Rows from which a last number can be told to be cut short
LOST = 5.0  # Factor below all others from which a number is cut short; a lost digit makes it a tenth

MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "*", "#na", "#nv", "#n/a"}
MISSING |= {"\N{EM DASH}", "\N{EN DASH}"}
"""Words for a missing value, in lower case; `*` is that of Geosoft. Spreadsheets also write errors for them,
such as #DIV/0!."""

_NUMBER = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
_COMMA = re.compile(r"\s*[+-]?(\d{1,3}(\.\d{3})+|\d*),\d+([eE][+-]?\d+)?\s*", re.ASCII)
"""A number with a decimal comma, and perhaps with points between its thousands."""

_THOUSANDS = re.compile(
    r"\s*[+-]?[1-9]\d{0,2}(?P<mark>[,'\u2019 \u00a0\u202f])\d{3}((?P=mark)\d{3})*(?P<rest>[.,]\d*)?\s*",
    re.ASCII,
)
"""A number with marks between its thousands: English commas, Swiss apostrophes or French blanks."""

_MOMENT = re.compile(
    r"\s*(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}\D?)?(\d{1,3}:\d\d(:\d\d)?(\.\d*)?\S*)?\s*", re.ASCII
)
"""A date, a time, or both."""

_COMPASS = re.compile(r"(\d+(?:\.\d*)?)([EWNS])", re.ASCII)
"""A number with the direction in which it counts, as of GEM's magnetometers: 00005.400E."""

_SUMMARY = re.compile(
    r"\s*(mean|average|avg|sum|total|min|max|std|median|mittel\w*|summe|moyenne|somme|media|promedio|suma)\b",
    re.IGNORECASE,
)
"""Begin of a row below a table that sums it up."""

_BELOW_1000 = re.compile(r"\s*[+-]?\d{1,3}([.,]\d*)?\s*", re.ASCII)
_BEGUN = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d*)?([eE][+-]?)?", re.ASCII)  # The begin of a number

_SLASH = re.compile(r"\s*/([^\w,;]|\w+\s|$)")
"""A comment line of Geosoft's XYZ, and no word that begins with a slash, such as a topic of ROS."""

_TRACK = re.compile(r"\s*(line|tie)\s+(?=\S*\d)\S+\s*", re.IGNORECASE)  # Begins a survey line of Geosoft
_REMARK = re.compile(r"\s*#\s*\w+:\s")  # A comment line `# KEY: VALUE`, as in maps written as CSV

_NMEA = re.compile(r"\s*[$!][A-Z]{4,7},.*\*[0-9A-F]{2}\s*$")  # A sentence of NMEA 0183
_IN_QUOTES = re.compile(r'(?:^|(?<=[\t;,]))\s*"(?:[^"]|"")*"')  # A quoted word, and no sign of seconds
_BRACKET = re.compile(r"[\[(]")
_ERROR = re.compile(r"\s*#(n/?a|nv|value!|div/0!|ref!|num!|name\?|null!)\s*", re.IGNORECASE)
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")  # Characters that no text has
_Lines = list[tuple[int, str]]  # Number and text of lines
_Rows = list[tuple[int, list[str]]]  # Line and words of rows

_PLACED = ("x", "y", "heading")  # A header names one, if prose above it looks like another header
_UNITS = frozenset(unit.replace("_", "") for unit in UNITS)


@dataclass(frozen=True)
class Delimited:
    """Rows of words, all of one width."""

    path: Path  # The file
    names: tuple[str, ...]  # Names of the columns; () in a file without a header
    rows: Sequence[Sequence[str]]  # Words of each row
    lines: Sequence[int]  # Line of each row in the file
    notes: tuple[str, ...] = ()  # What was repaired
    comments: tuple[tuple[int, str], ...] = ()  # Number and text of the lines that begin with `#`


def read_delimited(path: str | os.PathLike[str], noun: str, wanted: str, content: bytes) -> Delimited:
    """Read the text of a file of rows whose words are separated by commas, semicolons, tabs or blanks.

    The text is UTF-8, UTF-16, or cp1252, which older spreadsheets write. The header is the first line if any
    of its words is not a number, else the last comment line above the rows with as many words as they have.
    These are skipped: other lines that begin with `#`, such as `# KEY: VALUE`; those that begin with `/` if
    the first line does; empty lines; a first line `sep=;`; lines of prose above the header and one below the
    rows; headers that are repeated; and the lines `Line 10` and `Tie 3` of Geosoft. The units in a row below
    the header are added to the names, as in `x [cm]`. A decimal comma is read unless commas separate the
    words or other numbers have decimal points. Marks between thousands are read if all numbers of the column
    fit. If the last line has no end, it is left out if it has fewer words than others; its last number is
    missing if it is far below all others of its column.

    Errors tell its `noun` and what a row holds, which is `wanted` ("one row of numbers per reading").
    `content` are the bytes of the file.
    """
    path, notes = Path(path), list[str]()
    lines, ended = _lines(path, _decoded(path, content, noun, notes))
    comments, above, lines, told = _without_comments(lines, notes)
    if not lines:
        raise InputError(f"{path}: empty; expected {wanted}")
    if sum(bool(_NMEA.match(line)) for _, line in lines[:LOOKED]) > 1:
        raise InputError(
            f"{path}:{lines[0][0]}: sentences of NMEA 0183; write its positions and readings as CSV with a "
            "header time,lat,lon,field"
        )
    between, prose, rows = _rows(path, lines, told, ended)
    first = _header(rows)
    if prose or first:
        what = "header" if _is_header(rows[first][1]) else "first row"
        notes.append(f"line {rows[first][0]} as the {what}, and the lines above it as prose")
    comments += [line for line in lines if line[0] < rows[first][0]]
    above = [comment for comment in above if comment[0] < rows[first][0]]
    names, rows = _names(path, rows[first:], above, between)
    if not rows:
        raise InputError(f"{path}: no rows below the header; expected {wanted}")
    width = len(names) or len(rows[0][1])
    if why := _last(rows, width, ended, between is None):
        notes.append(f"line {rows[-1][0]} {why}")
        rows = rows[:-1]
    names, rows = _without_headers(names, rows, notes)
    for number, row in rows:
        if len(row) != width:
            raise InputError(f"{path}:{number}: {width} values expected, got {len(row)}")
    words = [row for _, row in rows]
    _plain_numbers(names, words, between, notes)
    _plain_angles(words)
    if not ended and rows[-1][0] == lines[-1][0]:
        _without_begun(rows[-1][0], words, notes)
    return Delimited(path, tuple(names), words, [number for number, _ in rows], tuple(notes), tuple(comments))


def _rows(path: Path, lines: _Lines, told: str, ended: bool) -> tuple[str | None, int, _Rows]:
    """Separator, number of lines of prose above, and the rows, of which the first may be the header.

    If the rows differ in their number of words, or stand below prose without names, they are those of
    `magtwin.tables.body`.
    """
    between, prose = (told, 0) if told else _separator(lines)
    if not ended and between and lines[-1][1].count('"') % 2:
        lines[-1] = (lines[-1][0], lines[-1][1] + '"')
    fault: InputError | None = None
    try:
        rows = _words(path, lines[prose:], between)
        named = not prose or _is_header(rows[0][1])
        if named and len({len(row) for _, row in rows[:-1]}) < 2:
            return between, prose, rows
    except InputError as error:  # prose with unpaired quotes
        fault = error
    body = None if told else body_of([line for _, line in lines], _is_row, _is_row_of_units)
    if body is None:
        if fault:
            raise fault
        return between, prose, rows
    rows = _words(path, lines[body.begin :], body.mark)
    for k in (body.units, body.header):
        if k is not None:
            words = cells(lines[k][1], body.mark)[: len(rows[-2][1])]
            words = words if k == body.header or "unit" not in words[0].lower() else ["", *words[1:]]
            rows.insert(0, (lines[k][0], words))
    return body.mark, body.header, rows


def _is_row(words: list[str]) -> bool:
    """Whether a row is one of values: most of its words are numbers, dates, times or angles."""
    return 2 * sum(bool(word.strip()) and not _is_text(word) for word in words) > len(words)


def _is_row_of_units(words: list[str]) -> bool:
    return 2 * sum(map(_is_unit, words)) > len(words)


def number_of(word: str) -> float:
    """A word as a number; nan if it is missing, -inf if it is not a number."""
    if _NUMBER.fullmatch(word):
        value = float(word)
        return value if math.isfinite(value) else -math.inf
    return math.nan if word.strip().lower() in MISSING or _ERROR.fullmatch(word) else -math.inf


def _is_number(word: str) -> bool:
    """Whether a word is a number, perhaps with a decimal comma or marks between thousands."""
    return math.isfinite(number_of(word)) or bool(_COMMA.fullmatch(word) or _THOUSANDS.fullmatch(word))


def _is_text(word: str) -> bool:
    """Whether a word is no number, date or time, and not missing."""
    if not math.isinf(number_of(word)) or _is_number(word):
        return False
    if _MOMENT.fullmatch(word) or _COMPASS.fullmatch(word.strip()):
        return False
    return degrees_of(word) is None


def _is_header(words: list[str]) -> bool:
    """Whether a word of the first row is not a number, and none is one with a comma."""
    numbers = any(_COMMA.fullmatch(word) or _THOUSANDS.fullmatch(word) for word in words)
    return any(map(_is_text, words)) and not numbers


def _header(rows: _Rows) -> int:
    """Index of the header, below prose that a spreadsheet has filled to the width of the table.

    It is the last row of distinct texts, one for each column, above the first row that is mostly numbers;
    rather one that names a column of poses.
    """
    head = [row for _, row in rows[: MOST_ABOVE + 3]]  # with a row of units and one of numbers
    full = next((k for k, row in enumerate(head) if _is_row(row)), 0)
    likely = [k for k, row in enumerate(head[:full]) if _is_names(row, head[full])]
    placed = [k for k in likely if any(meaning_of(word, role) for word in head[k] for role in _PLACED)]
    found = (placed or likely or [0])[-1]
    prose = all(any(map(_is_text, row)) or not any(map(str.strip, row)) for row in head[:found])
    return found if prose and found <= MOST_ABOVE else 0


def _is_names(row: list[str], below: list[str]) -> bool:
    """Whether a row has a text of its own in each column of a row of numbers, and is not one of units."""
    if len(row) != len(below) or 2 * sum(map(_is_unit, row)) > len(row):
        return False
    texts = [word.strip() for word, number in zip(row, below, strict=True) if word.strip() or number.strip()]
    return all(map(_is_text, texts)) and len(set(texts)) == len(texts)


def _last(rows: _Rows, width: int, ended: bool, blanks: bool) -> str:
    """Why the last row is left out: it was cut short, or is prose such as `END OF FILE`; "" if it is not."""
    if len(rows) < 2 or len(rows[-2][1]) != width:
        return ""
    row = rows[-1][1]
    words = [word for word in row if word.strip()]
    if not ended and len(row) < width:
        return f"as cut short and left out: it has no end, and {len(row)} of {width} values"
    if any(_SUMMARY.match(word) and _is_number(above) for word, above in zip(row, rows[-2][1], strict=False)):
        return f"as a summary and left out: {' '.join(words)[:QUOTED]!r}"
    alone = width > 1 and (blanks or len(words) == 1) and all(map(_is_text, words))
    below = len(row) != width or _is_number(rows[-2][1][0])
    return f"as prose and left out: {' '.join(words)[:QUOTED]!r}" if alone and below else ""


def _is_unit(word: str) -> bool:
    unit = word.strip(" []()")
    return not _BRACKET.search(unit) and split_label(f"x [{unit}]").unit.replace("_", "") in _UNITS


def _names(path: Path, rows: _Rows, above: _Lines, between: str | None) -> tuple[list[str], _Rows]:
    """Names of the columns, from the first row or from a comment above the rows; and the other rows."""
    if _is_header(rows[0][1]):
        return [word.strip() for word in rows[0][1]], rows[1:]
    names: list[str] = []
    marks = [*dict.fromkeys((between or ",", *",;\t", None))]  # the first that fits counts
    for comment, mark in itertools.product(above, reversed(marks)):
        with suppress(InputError):  # prose with unpaired quotes
            ((_, header),) = _words(path, [comment], mark)
            names = [word.strip() for word in header] if len(header) == len(rows[0][1]) else names
    return names, rows


def _without_headers(names: list[str], rows: _Rows, notes: list[str]) -> tuple[list[str], _Rows]:
    """Names with the units of a row below them, and the rows without headers that are repeated."""
    if not names:
        return names, rows
    headers = [names]
    if _is_units([row for _, row in rows[:2]], len(names)):
        number, units = rows[0]
        notes.append(f"line {number} as the units of the columns")
        headers.append([word.strip() for word in units])
        names = [_with_unit(name, word) for name, word in zip(names, units, strict=True)]
        rows = rows[1:]
    others = [row for row in rows if [word.strip() for word in row[1]] not in headers]
    if 0 < len(others) < len(rows):
        notes.append(f"lines that repeat the header left out: {len(rows) - len(others)}")
        rows = others
    return names, rows


def _is_units(rows: list[list[str]], width: int) -> bool:
    """Whether the first of two rows is one of units: it has no number, and a unit above a number."""
    if [len(row) for row in rows] != [width, width] or any(map(_is_number, rows[0])):
        return False
    return any(_is_unit(word) and _is_number(below) for word, below in zip(rows[0], rows[1], strict=True))


def _with_unit(name: str, word: str) -> str:
    """The name of a column with its unit, unless it has one or the word is missing."""
    unit = word.strip(" []()")
    meanings = filter(None, (meaning_of(name, role) for role in _PLACED))
    has_unit = bool(split_label(name).unit) or any(meaning.unit for meaning in meanings)
    return f"{name} [{unit}]" if name and _is_text(unit) and not has_unit else name


def _without_comments(lines: _Lines, notes: list[str]) -> tuple[_Lines, _Lines, _Lines, str]:
    """Comments, those above the rows that may be a header, other lines, and the mark of a line `sep=;`."""
    match = re.fullmatch(r'"?sep=(\S)"?', lines[0][1].strip(), re.IGNORECASE) if lines else None
    lines = lines[1:] if match else lines
    slashed = any(_SLASH.match(line) for _, line in lines[:MOST_ABOVE])
    others = [(number, line) for number, line in lines if not _is_comment(line, slashed)]
    texts = [(number, line.strip()) for number, line in lines if _is_comment(line, slashed)]
    texts = [(number, text) for number, text in texts if re.search(r"\w", text) and not _REMARK.match(text)]
    above = [(number, text.lstrip(text[0])) for number, text in texts]
    comments = [row for row in lines if row[1].lstrip().startswith("#") and _is_comment(row[1])]
    if tracks := [line.strip() for _, line in others if _TRACK.fullmatch(line)]:
        notes.append(f"lines such as {tracks[0][:QUOTED]!r} left out: {len(tracks)}")
        others = [(number, line) for number, line in others if not _TRACK.fullmatch(line)]
    return comments, above, others, match[1] if match else ""


def _is_comment(line: str, slashed: bool = False) -> bool:
    """Whether a line begins with `#` and not with the error of a spreadsheet, or with `/` in such a file."""
    begun = line.lstrip()
    if begun.startswith("/"):
        return slashed
    return begun.startswith("#") and not _ERROR.fullmatch(re.split(r"[,;\t]", line, maxsplit=1)[0])


def _decoded(path: Path, content: bytes, noun: str, notes: list[str]) -> str:
    """The text of a file, with a note on an encoding other than UTF-8."""
    head = content[:HEAD]
    encoding = "utf-8-sig"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:  # plain letters in UTF-16 have a byte of 0 each
        even, odd = head[::2].count(0), head[1::2].count(0)
        if len(head) > 8 and 3 * max(even, odd) > len(head) and not min(even, odd):
            encoding = "utf-16-le" if odd else "utf-16-be"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        encoding = "cp1252"
        text = content.decode(encoding, "replace")
    if encoding != "utf-8-sig":
        notes.append(f"text in {encoding}")
    if _CONTROL.search(text):
        raise InputError(f"{path}: not a text file; a {noun} is CSV in UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _lines(path: Path, text: str) -> tuple[_Lines, bool]:
    """Number and text of every nonblank line, and whether the last one has an end."""
    lines = list(enumerate(text.split("\n"), 1))
    for number, line in lines:
        if len(line) > LONGEST_LINE:
            text = f"longer than {LONGEST_LINE:,} characters; this is no row of numbers"
            raise InputError(f"{path}:{number}: {text}")
    return [(number, line) for number, line in lines if line.strip()], not lines[-1][1].strip()


def _separator(lines: _Lines) -> tuple[str | None, int]:
    """What stands between the words of lines (None: blanks), and the number of lines of prose above.

    It is the mark that each line has as often, from the header on; the last line of a short file may differ.
    """
    begun = [line for _, line in lines[:LOOKED]]
    found = _mark(begun) or (_mark(begun[:-1]) if 2 < len(lines) <= LOOKED else None)
    return found or _blanks(begun) or (next((mark for mark in ",;\t" if mark in begun[0]), None), 0)


def _blanks(lines: Sequence[str]) -> tuple[None, int] | None:
    """Number of lines of prose above rows of numbers with blanks between; None if these are no such rows."""
    words = [line.split() for line in lines]
    rows = [len(row) == len(words[-1]) > 1 and not any(map(_is_text, row)) for row in words]
    above = rows.index(True) if True in rows else len(rows)
    above -= 0 < above < len(rows) and len(words[above - 1]) == len(words[-1])  # a header
    return (None, above) if all(rows[above + 1 :]) and 0 < above < min(MOST_ABOVE, len(rows) - 1) else None


def _mark(lines: Sequence[str]) -> tuple[str | None, int] | None:
    """Separator and lines of prose; None if the lines have no mark as often."""
    words = lines[-1].split()
    numbers = all(_COMMA.fullmatch(word) or math.isfinite(number_of(word)) for word in words)
    if len(words) > 1 and numbers and any(map(_COMMA.fullmatch, words)):
        return (None, 0) if (above := _above(lines, "\t")) is None else ("\t", above)
    bare = [_IN_QUOTES.sub("", line) for line in lines]
    found = {mark: above for mark in ";\t," if (above := _above(bare, mark)) is not None}
    if 0 in found.values():
        return next(mark for mark, above in found.items() if not above), 0
    for mark, above in found.items():
        prose, header = lines[:above], lines[above].split(mark)
        if all(_is_header(line.split(mark)) for line in prose) and not any(map(_NUMBER.fullmatch, header)):
            return mark, above
    return None


def _above(lines: Sequence[str], mark: str) -> int | None:
    """Number of lines above those that have a mark as often as the last has; None if these are no table."""
    counts = [line.count(mark) for line in lines]
    above = counts.index(counts[-1])
    same = counts[-1] > 0 and set(counts[above:]) == {counts[-1]}
    return above if same and (above == 0 or above <= min(MOST_ABOVE, len(lines) - 2)) else None


def _words(path: Path, lines: _Lines, between: str | None) -> _Rows:
    if between is None:
        return [(number, line.split()) for number, line in lines]
    rows = []
    for number, line in lines:
        try:
            rows.append((number, next(csv.reader([line], delimiter=between, strict=True))))
        except csv.Error as error:
            raise InputError(f"{path}:{number}: not CSV: {error}, in {line[:QUOTED]!r}") from None
    return rows


def _plain_numbers(names: list[str], rows: list[list[str]], between: str | None, notes: list[str]) -> None:
    """Take marks between thousands and directions out of the rows, and make decimal commas points."""
    for column in range(len(rows[0])):
        found = [_COMPASS.fullmatch(row[column].strip()) for row in rows]
        for row, match in zip(rows, found, strict=True) if all(found) else ():
            row[column] = ("-" if match and match[2] in "WS" else "") + (match[1] if match else "")
    if columns := _without_thousands(rows):
        named = ", ".join(names[k] if names else str(k + 1) for k in columns)
        notes.append(f"numbers of {named[:QUOTED]} with marks between thousands")
    if between == "," or not any(_COMMA.fullmatch(word) for row in rows for word in row if "," in word):
        return
    if any(_NUMBER.fullmatch(word) for row in rows for word in row if "." in word):
        return
    notes.append("numbers with decimal commas")
    for row in rows:
        row[:] = [w.replace(".", "").replace(",", ".") if _COMMA.fullmatch(w) else w for w in row]
        row[:] = [w.replace(",", ".") if ":" in w and _MOMENT.fullmatch(w) else w for w in row]


def _plain_angles(rows: list[list[str]]) -> None:
    """Make degrees, minutes and seconds decimal degrees."""
    for column in [k for k, word in enumerate(rows[0]) if degrees_of(word) is not None]:
        for row in rows:
            row[column] = row[column] if (angle := degrees_of(row[column])) is None else repr(angle)


def _without_begun(number: int, rows: list[list[str]], notes: list[str]) -> None:
    """Take out the last number of a last line without an end, if it lost its own end.

    It begins a number, or is shorter and far less than all others.
    """
    *others, last = (row[-1].strip() for row in rows)
    begun = others and _is_text(last) and _BEGUN.fullmatch(last) and _is_number(others[-1])
    sizes = [abs(value) for value in map(number_of, others) if math.isfinite(value)]
    shorter = len(others) >= LEAST_ROWS and len(last) < min(map(len, others))
    if begun or (shorter and LOST * abs(number_of(last)) < min(sizes, default=0.0)):
        why = "begins a number" if begun else "is far below all other values"
        notes.append(f"line {number} as cut short and left out: it has no end, and its {last[:QUOTED]} {why}")
        rows[-1][-1] = ""


def _without_thousands(rows: list[list[str]]) -> list[int]:
    """Take the marks between thousands out of the columns all of whose numbers fit; returns these columns.

    A comma is between thousands if a number has a point after it, or two of them; else it may be decimal.
    """
    found = dict[int, str]()
    for k, word in (cell for row in rows for cell in enumerate(row)):
        if len(word) > 4 and (match := _THOUSANDS.fullmatch(word)):
            found[k] = match["mark"]
    columns = []
    for k, mark in found.items():
        words = [row[k] for row in rows]
        matches = [_THOUSANDS.fullmatch(word) for word in words]
        plain = [word for word, match in zip(words, matches, strict=True) if not match]
        plain = [word for word in plain if not math.isnan(number_of(word))]
        fits = all(match["mark"] == mark for match in matches if match)
        fits &= all(mark not in word.strip() and _BELOW_1000.fullmatch(word) for word in plain)
        ends = {match["rest"][0] for match in matches if match and match["rest"]}
        sure = mark != "," or "." in ends or any(word.count(mark) > 1 for word in words)
        if fits and sure and mark not in ends:
            columns.append(k)
            for row in rows:
                row[k] = row[k].strip().replace(mark, "")
    return columns
