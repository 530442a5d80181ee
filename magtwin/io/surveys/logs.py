"""Logs: recordings of phones and vehicles, whose field and places have times of their own.

A log is a set of tables by name: the files of a folder or of an archive, or the parts of one file. The table
of the field gets the places of the others, joined by time.
"""

import re
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.survey.folder import LARGEST_TURN
from magtwin.files.budget import BUDGETS, allowed, check_size
from magtwin.files.kinds import ARCHIVE, TABLE, kind_of
from magtwin.io.surveys.arrays import ARRAYS, tables_of_arrays
from magtwin.io.surveys.places import between
from magtwin.io.surveys.walk import Marks, marks_of, walked
from magtwin.tables.labels import meaning_of, words_of
from magtwin.tables.quantities import CLOCKWISE, DEGREES
from magtwin.tables.table import PARQUET, SPREADSHEETS, Column, Table, read_table, since_1970

Array = NDArray[np.float64]
Parts = Mapping[str, Table]

VEHICLES = (".ulg", ".bin", *ARRAYS)  # Suffixes of logs of vehicles and of files of arrays

TABLES = (".csv", ".txt", ".jsonl", ".ndjson", *SPREADSHEETS)
FIELD = ("magnetometer", "magnetic", "mag", "magneticfield", "raw")
MARKS = ("annotation", "annotations", "waypoint", "waypoints", "mark", "marks", "notes", "events")
ACCELERATION = ("accelerometer", "acceleration", "acc", "accel", "linear")
"""Words in the names of the tables of a log."""

SEVERAL = (
    0.05  # Share of rows at the time of another one, and elsewhere, above which there are several things
)
MOST_PARTS = 200  # Most tables of a log
_TRACE = re.compile(rb"^\d+\tTYPE_[A-Z_]+\t", re.M)  # A line of an Android trace: time [ms], sensor, values
BETWEEN = 0.2  # Share of the rows below which rows with places are marks, and others lie between them


def is_log(path: Path) -> bool:
    """Whether a source is a log of several tables."""
    if path.is_dir():
        return any(_has(file.stem, FIELD) for file in path.iterdir() if file.suffix.lower() in TABLES)
    if path.suffix.lower() in (".zip", *VEHICLES):
        return True
    with path.open("rb") as file:
        return bool(_TRACE.search(file.read(1 << 16)))


def is_survey(path: Path) -> bool:
    """Whether a file is a table or log of another program, and no run, stage or network."""
    if path.suffix.lower() in (*TABLES, *PARQUET, ".xyz", ".dat", ".tsv", ".grd", ".asc", ".lvm", ".log"):
        return kind_of(path) in (None, TABLE) or is_log(path)
    return kind_of(path) in (None, ARCHIVE) and is_log(path)


def table_of_log(path: Path, waypoints: Path | None = None, step_m: float | None = None) -> Table:
    """The readings of a log, with their places, by a table of marks `waypoints` if the log has none,
    and the length of a step [m] if these have no times.

    A log is a table; a folder or a zip of tables, as phyphox and Sensor Logger write them; a trace of an
    Android phone; or a log of a vehicle: PX4 (.ulg), ArduPilot (.bin) or HDF5; or a
    file of arrays, such as MATLAB's (.mat).
    """
    parts = _parts(path) if (log := is_log(path)) else {path.stem: read_table(path)}
    name, field = _field(path, parts) if log else (path.stem, parts[path.stem])
    marks = marks_of(read_table(waypoints), timed=False) if waypoints else _marks(parts, name)
    if waypoints and marks is None:
        text = "a row is t,x,y, or t and a note such as 1.5,2, or x,y in order"
        raise InputError(f"{waypoints}: no marks; {text}")
    if marks:
        return walked(field, marks, _accelerations(parts), step_m)
    if step_m is not None:
        text = "its positions do not come from marks of a walk; leave out --step-m"
        raise InputError(f"{path}: {text}", parameter="step_m")
    if labels := field.find("x", "y") or field.find("lon", "lat"):
        return _filled(field, [*labels, *field.find("heading")])
    for other in (part for key, part in parts.items() if key != name):
        if (labels := other.find("x", "y") or other.find("lon", "lat")) and other.find("t"):
            return _joined(field, other, labels)
    return field


def _parts(path: Path) -> Parts:
    """The tables of a log, by name."""
    if path.suffix.lower() in VEHICLES:
        from magtwin.io.surveys.vehicles import columns_of_log  # imports the library of each kind

        check_size(path, "recording")
        columns = {} if path.suffix.lower() == ".mat" else columns_of_log(path)
        return {path.stem: table_of(path, columns)} if columns else tables_of_arrays(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in TABLES)[:MOST_PARTS]
        return {file.stem: table for file in files if (table := _read(file)) is not None}
    if path.suffix.lower() == ".zip":
        return _zipped(path)
    return _trace(path)


def _read(path: Path, content: bytes | None = None) -> Table | None:
    """The table in a file; None if it is none and no table of the field."""
    try:
        return read_table(path, content=content)
    except InputError:
        if _has(path.stem, (*FIELD, *MARKS)):
            raise
        return None


def _zipped(path: Path) -> Parts:
    """The tables in an archive. Nothing is written."""
    check_size(path, "readings")
    parts = dict[str, Table]()
    most = max(BUDGETS["readings"].file, allowed())
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist()[:MOST_PARTS]:
                inside = Path(info.filename)
                folders = map(str.lower, inside.parts[:-1])
                if inside.suffix.lower() not in (".csv", ".txt") or "meta" in folders:
                    continue
                with archive.open(info) as file:
                    content = file.read(most + 1)
                if len(content) > most:
                    text = f"{info.filename} is larger than {most:,} bytes; unpack the archive"
                    raise InputError(f"{path}: {text}")
                if (table := _read(path / inside.name, content)) is not None:
                    parts[inside.stem] = table
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError) as error:
        text = f"no archive of tables, or damaged ({str(error)[:100]}); unpack it"
        raise InputError(f"{path}: {text}") from None
    return parts


def _trace(path: Path) -> Parts:
    """The sensors of a trace of an Android phone: lines of time [ms], sensor and values."""
    check_size(path, "readings")
    rows = dict[str, list[list[float]]]()
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        words = line.split("\t")
        if len(words) < 4 or not words[1].startswith("TYPE_"):
            continue
        kind = words[1].removeprefix("TYPE_").lower()
        if not _has(kind, (*FIELD, *MARKS, *ACCELERATION)):
            continue
        try:
            values = [float(words[0]) / 1e3, *map(float, words[2:5])]
        except ValueError:
            raise InputError(f"{path}:{number}: not a time, a sensor and numbers: {line[:60]!r}") from None
        rows.setdefault(kind, []).append(values)
    names = ("t", "x", "y", "z")
    return {
        kind: table_of(path, dict(zip(names, np.array(some).T, strict=False)))
        for kind, some in rows.items()
        if len({len(row) for row in some}) == 1
    }


def _field(path: Path, parts: Parts) -> tuple[str, Table]:
    """Name and table of the field: calibrated rather than not."""
    found = [name for name, part in parts.items() if part.find("field") or part.find("bx", "by", "bz")]
    named = [name for name in parts if _has(name, FIELD)]
    names = sorted({*found, *named}, key=lambda name: ("uncal" in name.lower(), name not in found, name))
    if not names:
        raise InputError(f"{path}: no table of a magnetic field in it; it holds {', '.join(parts) or 'none'}")
    name, table = names[0], parts[names[0]]
    if name not in found and not {"x", "y", "z"} - set(table.names):
        columns = (replace(c, name=f"b{c.name}" if c.name in "xyz" else c.name) for c in table.columns)
        table = replace(table, columns=tuple(columns))
    return name, table


def _marks(parts: Parts, field: str) -> Marks | None:
    """The marks of a log: a table of them, or the few rows of the field's table that have places."""
    for name, part in parts.items():
        if name != field and _has(name, MARKS) and (marks := marks_of(part)):
            return marks
    table = parts[field]
    if (labels := table.find("x", "y")) and table.find("t") and not {"x", "y", "z"} <= set(table.names):
        known = np.isfinite([table.numbers(label) for label in labels]).all(axis=0)
        if 2 <= np.count_nonzero(known) < BETWEEN * table.rows:
            return marks_of(table)
    return None


def _accelerations(parts: Parts) -> tuple[Array, Array] | None:
    """Times and accelerations of a walker, if a log has them."""
    for name, part in parts.items():
        if _has(name, ACCELERATION) and part.find("t") and not {"x", "y", "z"} - set(part.names):
            t, _ = since_1970(part, part.find("t")[0])
            moved = np.column_stack([t, *(part.numbers(axis) for axis in "xyz")])
            moved = moved[np.isfinite(moved).all(axis=1)]
            moved = moved[np.argsort(moved[:, 0], kind="stable")]
            return (moved[:, 0], moved[:, 1:]) if len(moved) else None
    return None


def _joined(field: Table, other: Table, labels: list[str]) -> Table:
    """A table with columns of another, between whose rows they are linear in time."""
    at, _ = since_1970(other, other.find("t")[0])
    t, _ = since_1970(field, field.find("t")[0])
    numbers = [other.numbers(label) for label in labels]
    _check_one(other, at, np.column_stack(numbers[:2]))
    cells = [between(t, at, some, _period(other, label)) for some, label in zip(numbers, labels, strict=True)]
    columns = (Column(label, values, field.path, None) for label, values in zip(labels, cells, strict=True))
    kept = (column for column in field.columns if column.name not in labels)
    where = f"of {other.path.name}" if other is not field else "between the rows that have them"
    note = f"{' and '.join(labels)} {where}, by time"
    return Table((*kept, *columns), (*field.notes, note), field.comments)


def _check_one(table: Table, at: Array, p: Array) -> None:
    """Refuse places of several things at the same times, such as of several tags in a picture."""
    known = np.isfinite(at) & np.isfinite(p).all(axis=1)
    at, p = at[known], p[known]
    order = np.argsort(at, kind="stable")
    same = (np.diff(at[order]) == 0) & (np.diff(p[order], axis=0) != 0).any(axis=1)
    if np.count_nonzero(same) > SEVERAL * len(at):
        raise InputError(
            f"{table.path}: has several places at {np.count_nonzero(same)} of {len(at)} times, such as "
            f"{at[order][np.argmax(same)]:.10g} s; write the rows of one thing into a table t,x,y, and give "
            "it to the file of the field: --waypoints FILE"
        )


def _period(table: Table, label: str) -> float | None:
    """The period of a heading in the unit of its column; None for other columns."""
    meaning = meaning_of(label, "heading")
    if meaning is None:
        return None
    values = table.numbers(label)
    turns = np.nanmax(np.abs(values), initial=0.0) > LARGEST_TURN
    return 360.0 if turns or meaning.unit in DEGREES or meaning.name in CLOCKWISE else 2 * np.pi


def _filled(table: Table, labels: list[str]) -> Table:
    """A table whose rows hold a field or a place and never both, with the places between in time."""
    names = table.find("field") or table.find("bx", "by", "bz")
    if not names or not table.find("t"):
        return table
    read, placed = (np.isfinite([table.numbers(n) for n in some]).all(axis=0) for some in (names, labels))
    return table if (read & placed).any() or not placed.any() else _joined(table, table, labels)


def table_of(path: Path, columns: Mapping[str, Array]) -> Table:
    """A table of arrays."""
    return Table(tuple(Column(name, values, path, None) for name, values in columns.items()))


def _has(name: str, words: tuple[str, ...]) -> bool:
    """Whether a name has one of some words, as `TYPE_MAGNETIC_FIELD` and `Raw Data` do."""
    return any(part.startswith(word) for part in words_of(name.replace("_", " ")) for word in words)
