"""Table: columns of numbers from CSV or Parquet, with file and line of every cell for error messages.

The one reader of tables that other programs wrote: of surveys, paths and commands.
"""

import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.files.file import existing, existing_file
from magtwin.report.summary import listed
from magtwin.tables.delimited import MISSING, QUOTED, number_of, read_delimited
from magtwin.tables.jsonlines import is_json_lines, rows_of_json
from magtwin.tables.labels import bare, meaning_of, unit_of
from magtwin.tables.lattice import is_lattice, nodes_of
from magtwin.tables.quantities import QUANTITIES

Array = NDArray[np.float64]

PARQUET = (".parquet", ".pq")
SPREADSHEETS = (".xlsx", ".xls", ".ods")  # Suffixes of Parquet and of spreadsheets; other tables are text

_EPOCHS = ((1e17, 1e9, "ns"), (1e14, 1e6, "us"), (1e11, 1e3, "ms"))
"""Least median of times since 1970, ticks per second and unit; below them are seconds."""

_DATE = re.compile(r"\d{1,4}[-/.](\d{1,2}|[A-Za-z]{3})[-/.]\d{1,4}", re.ASCII)
_CLOCK = re.compile(r"\d{1,3}(:\d\d){1,2}(\.\d*)?", re.ASCII)
_DAYS = ("%Y-%m-%d", "%d-%m-%Y", "%m-%d-%Y", "%d-%b-%Y")  # Orders of a date, with a hyphen for any mark
_CLOCKS = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M %p", " %I:%M:%S %p")  # Times behind a date
_READ = "2025-11-22T08:26:40"  # A date as an error message shows it

_MELTED = (("variable", "name", "key", "quantity", "channel", "signal", "parameter"), ("value", "values"))
"""Names of the columns of a table with a row for each value: of its quantity, and of the value."""

MOST_MELTED = 100  # Most quantities of such a table


@dataclass(frozen=True, eq=False)
class Column:
    """A column of a table."""

    name: str  # Name; "" in a file without a header
    cells: Any  # N cells: a list of texts, or an array of numbers with nan for empty cells
    path: Path  # Its file
    lines: Sequence[int] | None  # Line of each cell in the file; None for files without lines

    def where(self, row: int) -> str:
        """File and line of a cell."""
        return f"{self.path}:{self.lines[row]}" if self.lines is not None else f"{self.path}, row {row}"


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length."""

    columns: tuple[Column, ...]  # In the order of the file or files
    notes: tuple[str, ...] = ()  # What was repaired
    comments: tuple[tuple[int, str], ...] = ()  # Number and text of the lines of a text that begin with `#`

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
        """A column by its name, by its number from 1, or by its name without the unit in brackets."""
        matches = [column for column in self.columns if column.name == name]
        if len(matches) > 1:
            text = f"{len(matches)} columns are called {name!r}; name it by its number"
            raise InputError(f"{self.path}: {text}")
        if matches:
            return matches[0]
        if name.isascii() and name.isdigit() and 1 <= int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        without = [column for column in self.columns if name and bare(column.name) == name]
        if len(without) == 1:
            return without[0]
        names = [column.name[:QUOTED] for column in self.columns if column.name]
        known = hint(name, names) if names else f"no header: name columns by number, 1 to {len(self.columns)}"
        raise InputError(f"{self.path}: no column {name!r}; {known}")

    def find(self, *symbols: str, apart: Collection[str] = ()) -> list[str]:
        """The columns that hold quantities that belong together, by their names; [] if one has none.

        `symbols` are quantities in `magtwin.tables.quantities.QUANTITIES`, such as x and y, and `apart`
        columns that hold something else. It is refused if two columns could be one of them.
        """
        labels = [column.name for column in self.columns if column.name not in ("", *apart)]
        matches = {
            symbol: {label: meaning for label in labels if (meaning := meaning_of(label, symbol))}
            for symbol in symbols
        }
        names = [{meaning.name for meaning in some.values()} for some in matches.values()]
        if not (common := set.intersection(*names)):
            return []
        found = []
        for symbol, some in matches.items():
            named = {label: m for label, m in some.items() if m.name == min(common)}
            least = min(meaning.around for meaning in named.values())
            best = [label for label, meaning in named.items() if meaning.around == least]
            if len(best) > 1:
                raise InputError(f"{self.path}: {listed(best)} could each be {symbol}; keep one")
            found += best
        return found

    def unit(self, name: str, symbol: str) -> str:
        """The unit in the label of a column that holds a quantity; "" if there is none."""
        return unit_of(self.column(name).name, symbol)

    def numbers(self, name: str, symbol: str = "") -> Array:
        """The numbers of a column, shape (N,); nan for cells that are empty or nan.

        With the `symbol` of its quantity, values are taken from the unit in the label to SI units or nT.
        Errors give file and line of a cell that is no number.
        """
        column = self.column(name)
        factor = 1.0
        if symbol and (unit := self.unit(name, symbol)):
            units = QUANTITIES[symbol].units
            if unit not in units:
                usual = {factor: known.replace("_", "/") for known, factor in reversed(list(units.items()))}
                text = f"{column.name[:QUOTED]!r} is in no unit of {symbol}"
                raise InputError(f"{self.path}: {text}; {hint(unit, usual.values())}")
            factor = units[unit]
        if isinstance(column.cells, np.ndarray):
            if column.cells.dtype.kind not in "fiub":
                raise InputError(f"{column.path}: column {name!r} must hold numbers, got texts")
            values = column.cells.astype(float)
        else:
            values = np.array([number_of(cell) for cell in column.cells])
        if (wrong := np.isinf(values)).any():
            row = int(wrong.argmax())
            cell = column.cells[row]
            shown = repr(cell.strip()[:QUOTED]) if isinstance(cell, str) else values[row]
            advice = "; a decimal comma is read where no number has a point, and no comma separates cells"
            advice *= "," in str(shown)
            raise InputError(f"{column.where(row)}: {name} must be a finite number, got {shown}{advice}")
        return factor * values

    def taken(self, columns: Mapping[str, str]) -> list[str]:
        """What was deduced from the header about the columns of quantities, and what was left out."""
        notes, labels = list[str](), list(columns.values())
        wanted = _and(list(columns))
        meanings = {symbol: meaning_of(label, symbol) for symbol, label in columns.items()}
        if any(m is None or (m.name, m.around) != (0, 0) for m in meanings.values()):
            notes.append(f"{_and(labels)} as {wanted}")
        elif labels != sorted(labels, key=self.names.index):
            notes.append(f"{wanted} by their names")
        units = {label: QUANTITIES[k].units.get(self.unit(label, k), 1.0) for k, label in columns.items()}
        if some := [label for label, factor in units.items() if factor != 1]:
            notes.append(f"{_and(some)} by the units in their names")
        if left := [column.name for column in self.columns if column.name and column.name not in labels]:
            notes.append(f"{wanted}, and left out {listed(left)}")
        return notes

    def times(self, name: str) -> Array:
        """The times of a column [s], shape (N,); nan for cells that are empty or nan.

        They are numbers, in the unit of the name or in seconds; times of day, which become seconds since
        midnight, beyond the next midnight too; or dates and times, which become seconds since 1970: as in ISO
        8601, as `2025/11/22 08:26:40` or `22-Nov-2025 08:26:40`, or with day and month in the order that the
        column proves by a number above 12. One without a zone is in UTC.
        """
        column = self.column(name)
        is_text = not isinstance(column.cells, np.ndarray) or column.cells.dtype.kind == "O"
        texts = self.texts(name) if is_text else []
        if texts and all(map(_CLOCK.fullmatch, texts)):
            return _of_day([[float(part) for part in text.split(":")] for text in texts])
        if not any(map(_DATE.match, texts)):
            for row, text in enumerate(texts):
                if np.isinf(number_of(text)):
                    wanted = f"a number of seconds, or a date and time such as {_READ}"
                    raise InputError(f"{column.where(row)}: {name} must be {wanted}; got {text[:QUOTED]!r}")
            return self.numbers(name, "t" if self.unit(name, "t") in QUANTITIES["t"].units else "")
        tried = [_seconds(texts, datetime.fromisoformat), *(_seconds(texts, _reader(day)) for day in _DAYS)]
        best = max(tried, key=len)
        if len(best) < len(texts):
            text = f"{name} must be a date and time, got {texts[len(best)][:QUOTED]!r}"
            raise InputError(f"{column.where(len(best))}: {text}; one such as {_READ} is read")
        if any(len(other) == len(best) and other != best for other in tried):
            text = f"day and month of {name} cannot be told apart; write dates such as {_READ}"
            raise InputError(f"{column.where(0)}: {text}")
        return np.array(best)

    def texts(self, name: str) -> list[str]:
        """The cells of a column as stripped texts."""
        return [str(cell).strip() for cell in self.column(name).cells]

    def beside(self, other: "Table") -> "Table":
        """This table with the columns of another, of as many rows, on the right."""
        if self.rows != other.rows:
            text = "files joined side by side need one row per reading each"
            raise InputError(f"{other.path}: {other.rows} rows, but {self.path} has {self.rows}; {text}")
        return Table(self.columns + other.columns, self.notes + other.notes, self.comments)


def since_1970(table: Table, name: str) -> tuple[Array, str]:
    """The times of a column [s], those far too large for seconds as ms, us or ns since 1970; and a note."""
    t = table.times(name)
    usual = float(np.median(np.abs(t[np.isfinite(t)]))) if np.isfinite(t).any() else 0.0
    if table.unit(name, "t") not in QUANTITIES["t"].units:
        for least, ticks, unit in _EPOCHS:
            if usual >= least:
                label = table.column(name).name or name
                return t / ticks, f"{label} in {unit} since 1970, by its size"
    return t, ""


def _by_time(table: Table) -> Table:
    """A table with a column for each quantity, of one with a column of values and one of their names."""
    key, value = ([c for c in table.columns if c.name.strip().lower() in words] for words in _MELTED)
    if len(key) != 1 or len(value) != 1 or table.columns[0] in (*key, *value):
        return table
    rest = [column for column in table.columns if column not in (*key, *value)]
    rows, again, at = dict[Any, int](), dict[Any, int](), list[int]()
    for name, *cells in zip(key[0].cells, *(column.cells for column in rest), strict=True):
        again[name, *cells] = count = again.get((name, *cells), -1) + 1
        at.append(rows.setdefault((count, *cells), len(rows)))
    names, first = np.array(key[0].cells, object), np.unique(at, return_index=True)[1].tolist()
    lines = None if value[0].lines is None else [value[0].lines[row] for row in first]
    columns = [replace(c, cells=np.asarray(c.cells)[first].astype(str).tolist(), lines=lines) for c in rest]
    for name in dict.fromkeys(key[0].cells):
        texts = np.full(len(rows), "nan", object)
        texts[np.array(at)[names == name]] = np.asarray(value[0].cells)[names == name].astype(str)
        columns.append(Column(str(name), texts.tolist(), table.path, lines))
    own, others = ([c.name for c in part] for part in (columns[: len(rest)], columns[len(rest) :]))
    wide = Table(tuple(columns), (*table.notes, f"{key[0].name} as {listed(others)}, by {_and(own)}"))
    known = any(wide.find(*some) for some in (("x", "y"), ("field",), ("bx", "by", "bz")))
    return replace(wide, comments=table.comments) if known and len(others) <= MOST_MELTED else table


def _and(names: Sequence[str]) -> str:
    """Names in a line: `t, v and w`."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)[: 3 * QUOTED]


def _of_day(clocks: Sequence[list[float]]) -> Array:
    """Seconds of times of day, beyond midnight too; or of m:ss, which begin at 0 or have fractions."""
    minutes = len(clocks[0]) == 2 and (clocks[0][0] == 0 or any(clock[1] % 1 for clock in clocks))
    weights = (60.0, 1.0) if minutes else (3600.0, 60.0, 1.0)
    seconds = np.array([sum(w * part for w, part in zip(weights, clock, strict=False)) for clock in clocks])
    return np.asarray(seconds + 86_400.0 * np.cumsum(np.diff(seconds, prepend=seconds[0]) < -43_200))


def _reader(day: str) -> Callable[[str], datetime]:
    """A reader of dates in an order of `_DAYS`, and of times behind them."""
    clocks = list(_CLOCKS)

    def read(text: str) -> datetime:
        date, _, clock = text.partition(" ")
        text = f"{re.sub('[/.]', '-', date)} {clock.strip().replace(',', '.')}".strip()
        for k, form in enumerate(clocks):
            with suppress(ValueError):
                moment = datetime.strptime(text, day + form)
                clocks.insert(0, clocks.pop(k))  # the next text has most likely the same
                return moment
        raise ValueError(text)

    return read


def _seconds(texts: Sequence[str], read: Callable[[str], datetime]) -> list[float]:
    """Seconds since 1970 of dates, up to the first that cannot be read; one without a zone is in UTC."""
    seconds = list[float]()
    with suppress(ValueError, OverflowError):
        for text in texts:
            if text.lower() in MISSING:
                seconds.append(np.nan)
                continue
            moment = read(text)
            seconds.append((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp())
    return seconds


def _lattice_or_json(path: Path, content: bytes) -> Table | None:
    """The table of a grid or of lines of JSON; None for other texts."""
    if is_lattice(content):
        columns, note = nodes_of(path, content)
        return Table(tuple(Column(name, cells, path, None) for name, cells in columns.items()), (note,))
    if not is_json_lines(content):
        return None
    keys, lines = rows_of_json(path, content)
    return Table(tuple(Column(name, cells, path, lines) for name, cells in keys.items()))


def read_table(
    path: str | os.PathLike[str],
    noun: str = "file of readings",
    wanted: str = "one row of numbers per reading",
    content: bytes | None = None,
) -> Table:
    """Read a table: Parquet and spreadsheets by their suffix, else text, as `magtwin.tables.delimited` does.

    Errors tell its `noun`, and what a row holds, which is `wanted`. `content` are the bytes of a text in an
    archive.
    """
    if Path(path).suffix.lower() in PARQUET:
        from magtwin.tables.parquet import parquet_columns  # imports pyarrow

        path = existing(path, noun)
        return _by_time(
            Table(tuple(Column(name, cells, path, None) for name, cells in parquet_columns(path)))
        )
    if content is None and Path(path).suffix.lower() in SPREADSHEETS:
        from magtwin.tables.spreadsheet import text_of_spreadsheet

        content = text_of_spreadsheet(existing(path, noun))
    elif content is None:
        content = existing_file(path, noun, "readings").read_bytes()
    if (special := _lattice_or_json(Path(path), content)) is not None:
        return _by_time(special)
    text = read_delimited(path, noun, wanted, content)
    names = text.names or ("",) * len(text.rows[0])
    pairs = zip(names, zip(*text.rows, strict=True), strict=True)
    columns = tuple(Column(name, list(cells), text.path, text.lines) for name, cells in pairs)
    return _by_time(Table(columns, text.notes, text.comments))
