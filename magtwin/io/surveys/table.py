"""Table: columns of numbers from CSV or Parquet, with file and line of every cell for error messages."""

import csv
import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magtwin.budget import check_size
from magtwin.errors import InputError, hint
from magtwin.files import existing
from magtwin.io.tables import load_parquet

Array = NDArray[np.float64]

LONGEST_LINE = 65_536
"""Longest line [characters]."""

QUOTED = 60
"""Most characters of a file that an error message quotes."""

_NUMBER = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
_NOTHING = {"", "nan", "na", "null", "none"}

_REMARK = re.compile(r"\s*#\s*\w+:\s")
"""A comment line `# KEY: VALUE`, as in maps written as CSV."""


@dataclass(frozen=True, eq=False)
class Column:
    """A column of a table."""

    name: str
    """Name; "" in a file without a header."""

    cells: Any
    """N cells: a list of texts, or an array of numbers with nan for empty cells."""

    path: Path
    """Its file."""

    lines: Sequence[int] | None
    """Line of each cell in the file; None for files without lines."""

    def where(self, row: int) -> str:
        """File and line of a cell."""
        return f"{self.path}:{self.lines[row]}" if self.lines is not None else f"{self.path}, row {row}"


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length."""

    columns: tuple[Column, ...]
    """In the order of the file or files."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.columns[0].cells)

    @property
    def names(self) -> list[str]:
        """Names of the columns; "1", "2", ... if they have none."""
        return [column.name or str(i) for i, column in enumerate(self.columns, 1)]

    @property
    def path(self) -> Path:
        """The file, or the first of them."""
        return self.columns[0].path

    def column(self, name: str) -> Column:
        """A column by its name, or by its number from 1.

        Raises:
            InputError: There is no such column (the message has the nearest name), or two have that name.
        """
        matches = [column for column in self.columns if column.name == name]
        if len(matches) > 1:
            text = f"{len(matches)} columns are called {name!r}; name it by its number"
            raise InputError(f"{self.path}: {text}")
        if matches:
            return matches[0]
        if name.isascii() and name.isdigit() and 1 <= int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        named = [column.name[:QUOTED] for column in self.columns if column.name]
        known = hint(name, named) if named else f"no header: name columns by number, 1 to {len(self.columns)}"
        raise InputError(f"{self.path}: no column {name!r}; {known}")

    def numbers(self, name: str) -> Array:
        """The numbers of a column, shape (N,); nan for cells that are empty or nan.

        Raises:
            InputError: There is no such column, or a cell is not a number; with file and line.
        """
        column = self.column(name)
        if isinstance(column.cells, np.ndarray):
            if column.cells.dtype.kind not in "fiub":
                raise InputError(f"{column.path}: column {name!r} must hold numbers, got texts")
            values = column.cells.astype(float)
        else:
            values = np.array([_number(cell) for cell in column.cells])
        wrong = np.flatnonzero(np.isinf(values))
        if len(wrong):
            row = int(wrong[0])
            cell = column.cells[row]
            shown = repr(cell.strip()[:QUOTED]) if isinstance(cell, str) else values[row]
            raise InputError(f"{column.where(row)}: {name} must be a finite number, got {shown}")
        return values

    def texts(self, name: str) -> list[str]:
        """The cells of a column as stripped texts."""
        return [str(cell).strip() for cell in self.column(name).cells]

    def beside(self, other: "Table") -> "Table":
        """This table with the columns of another on the right.

        Raises:
            InputError: The numbers of rows differ.
        """
        if self.rows != other.rows:
            raise InputError(
                f"{other.path}: {other.rows} rows, but {self.path} has {self.rows}; "
                "files joined side by side need one row per reading each"
            )
        return Table(self.columns + other.columns)


def read_csv(path: str | os.PathLike[str]) -> Table:
    """Read a text file with values separated by commas, semicolons, tabs or blanks.

    The header is the first line if any of its words is not a number, else the last comment line above the
    rows with as many words as they have. Other lines that begin with `#`, such as `# KEY: VALUE`, and empty
    lines are skipped.

    Raises:
        InputError: The file is missing, not text, or empty, or its lines are too long or of different widths.
    """
    path = existing(path, "file of readings")
    if path.is_dir():
        raise InputError(f"{path}: a folder; name the file in it")
    check_size(path, "readings")
    lines = list(_lines(path))
    above: list[tuple[int, str]] = []
    while lines and lines[0][1].lstrip().startswith("#"):
        number, line = lines.pop(0)
        if not _REMARK.match(line):
            above.append((number, line.lstrip().lstrip("#")))
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"{path}: empty; expected one row of numbers per reading")
    between = next((mark for mark in ",;\t" if mark in lines[0][1]), None)
    words = _words(path, lines, between)
    names: list[str] = []
    if any(math.isinf(_number(word)) for word in words[0]):
        names = [word.strip() for word in words.pop(0)]
        lines.pop(0)
    else:
        for comment in above:
            with suppress(InputError):  # prose with unpaired quotes
                (header,) = _words(path, [comment], between)
                names = [word.strip() for word in header] if len(header) == len(words[0]) else names
    if not words:
        raise InputError(f"{path}: no rows below the header; expected one per reading")
    width = len(names) or len(words[0])
    for (number, _), row in zip(lines, words, strict=True):
        if len(row) != width:
            raise InputError(f"{path}:{number}: {width} values expected, got {len(row)}")
    numbers = [number for number, _ in lines]
    pairs = zip(names or [""] * width, zip(*words, strict=True), strict=True)
    return Table(tuple(Column(name, list(cells), path, numbers) for name, cells in pairs))


def read_parquet_table(path: str | os.PathLike[str]) -> Table:
    """Read the columns of numbers and texts of a Parquet file.

    Raises:
        InputError: The file is missing, is not Parquet, is truncated, or has no rows.
    """
    path = existing(path, "Parquet file")
    table = load_parquet(path)
    columns = []
    for field, values in zip(table.schema, table.columns, strict=True):
        kind = field.type
        if pa.types.is_dictionary(kind):
            values, kind = values.cast(kind.value_type), kind.value_type
        if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind):
            plain = values.cast(pa.float64(), safe=False) if values.null_count else values
            columns.append(Column(field.name, plain.to_numpy(), path, None))
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            columns.append(Column(field.name, np.array(values.to_pylist(), object), path, None))
    if not columns or not table.num_rows:
        raise InputError(f"{path}: it has no rows of numbers; expected one per reading")
    return Table(tuple(columns))


def _lines(path: Path) -> Any:
    """Number and text of every nonblank line."""
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
                    yield number, line.rstrip("\n")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: not a text file ({error}); readings are CSV in UTF-8") from error


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


def _number(word: str) -> float:
    """A word as a number; nan if it is empty, -inf if it is not a number."""
    if _NUMBER.fullmatch(word):
        value = float(word)
        return value if math.isfinite(value) else -math.inf
    return math.nan if word.strip().lower() in _NOTHING else -math.inf
