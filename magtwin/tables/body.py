"""Body: the rows of a text table below titles, settings and a header, and angles as they stand on maps."""

import csv
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

MARKS = ("\t", ";", ",", None)  # Separators, the first before others with as many rows; None for blanks
LEAST_ROWS = 3  # Fewest rows that tell a table from prose

_ANGLE = re.compile(
    r"(?P<before>[NSEW])?\s*(?P<sign>[+-])?(?P<degrees>\d{1,3})\s*\u00b0\s*(?P<minutes>\d{1,2}(?:[.,]\d+)?)"
    r"\s*['\u2019\u2032]\s*"
    r"(?:(?P<seconds>\d{1,2}(?:[.,]\d+)?)\s*(?:[\"\u201d\u2033]|''))?\s*(?P<behind>[NSEW])?",
    re.ASCII,
)
"""Degrees, minutes and perhaps seconds, with a letter before or behind."""


class Body(NamedTuple):
    """Where a table stands in a text."""

    mark: str | None  # Between its cells; None for blanks
    begin: int  # Index of its first line of values
    header: int  # Index of the line of its names
    units: int | None  # Index of the line of their units, which may be above that of the names


def body_of(
    lines: Sequence[str], is_row: Callable[[list[str]], bool], is_units: Callable[[list[str]], bool]
) -> Body | None:
    """The longest run of lines of values that have one number of cells and reach the end of a text.

    Its names are the last line of texts above it that has as many cells. The last line of the text may be cut
    short. None: there is no such run, or other values above it seem to belong to the table.
    """
    found, most = None, LEAST_ROWS - 1
    for mark in MARKS:
        rows = [cells(line, mark) for line in lines]
        for end in (len(rows), len(rows) - 1):
            begin, width = end, len(rows[end - 1])
            while width > 1 and begin and len(rows[begin - 1]) == width and is_row(rows[begin - 1]):
                begin -= 1
            if end - begin > most and (head := _head(rows[:begin], width, is_row, is_units)):
                found, most = Body(mark, begin, *head), end - begin
    return found


def _head(
    above: list[list[str]],
    width: int,
    is_row: Callable[[list[str]], bool],
    is_units: Callable[[list[str]], bool],
) -> tuple[int, int | None] | None:
    """Indices of the names and of the units among the rows above a body."""
    full = [k for k, row in enumerate(above) if len(row) >= width and all(word for word in row[:width])]
    names = [k for k in full if not is_row(above[k]) and not is_units(above[k][:width])]
    if not names or any(map(is_row, above[names[-1] + 1 :])):
        return None
    if any(len(row) == width and is_row(row) for row in above):
        return None  # rows of the table, one of which is damaged
    labelled = [k for k in full if "unit" in above[k][0].lower() or k > names[-1]]
    units = [k for k in labelled if is_units(above[k][:width])]
    return names[-1], units[-1] if units else None


def cells(line: str, mark: str | None) -> list[str]:
    """The cells of a line, without blanks around them."""
    words = line.split() if mark is None else next(csv.reader([line], delimiter=mark), [])
    return [word.strip() for word in words]


def degrees_of(word: str) -> float | None:
    """An angle such as `52\u00b016'05.2"N` or `W 10\u00b0 31.6'` in degrees; None if a word is none."""
    match = _ANGLE.fullmatch(word.strip()) if "\u00b0" in word else None
    if match is None or (match["before"] and match["behind"]):
        return None
    degrees, minutes, seconds = (
        float((match[part] or "0").replace(",", ".")) for part in ("degrees", "minutes", "seconds")
    )
    negative = (match["before"] or match["behind"] or "N") in "SW" or match["sign"] == "-"
    return (-1 if negative else 1) * (degrees + minutes / 60 + seconds / 3600)
