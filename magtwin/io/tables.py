"""Tables: a Run as Parquet, CSV or npz; Parquet also part by part, while a run goes on.

All three give a Run back to the last bit. Parquet is small and typed, with unit and frame of every column.
CSV is for spreadsheets; its metadata are in lines that begin with #. npz is for numpy.
"""

import io
import json
import math
import os
import shutil
import struct
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning, find
from magtwin.field.units import NT_PER, unit_by_size
from magtwin.files.budget import BUDGETS, check_count, check_decoded, decoded_limit
from magtwin.files.file import check_zip, existing, existing_file
from magtwin.files.outputs import check_free, output
from magtwin.report.summary import listed
from magtwin.run import mapped
from magtwin.run.arrow import (
    FACTS,
    metadata_from_json,
    metadata_to_json,
    run_of,
    said_of,
    spec_said,
    table_of,
)
from magtwin.run.run import COLUMNS, Run, check_clock
from magtwin.run.spool import Spool, blocks
from magtwin.tables.parquet import load_parquet
from magtwin.tables.quantities import QUANTITIES
from magtwin.tables.table import Column, Table, read_table, since_1970

_ABOUT = "magtwin"  # Name of the member of an npz with the metadata, and first word of a CSV

_OWN = {("t",): ("t",), ("x", "y"): ("p_world_base_x", "p_world_base_y"), ("heading",): ("yaw",)}
_OWN |= {("field",): ("b_measured_nt",)}
"""Columns of a Run that are known by the quantity that a table of another program names."""

_BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError)
"""What zipfile and numpy raise for a damaged npz."""

NUMBER = 8  # Bytes of a number in memory
_CSV_ABOUT = 100_000  # Most lines of a CSV that begin with #; a run has one for each column, and three others
_CSV_LINE = 1 << 20  # Longest line of a CSV [bytes]; a header of ten thousand columns is shorter


def write_parquet(run: Run, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a run, whose clock `t` must ascend, as Parquet; the same run gives the same bytes."""
    check_clock(run, "the run to write")
    with output(path, force=force) as aside:
        _write(run, aside)


def parquet_of(run: Run) -> bytes:
    """The content of the file that `write_parquet` writes; arguments and errors are its own."""
    check_clock(run, "the run to write")
    sink = pa.BufferOutputStream()
    _write(run, sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _write(run: Run, where: Any) -> None:
    """Write the blocks of a run as groups of rows."""
    tables = map(table_of, blocks(run))
    first = next(tables)
    split = {f.name: "BYTE_STREAM_SPLIT" for f in first.schema if pa.types.is_floating(f.type)}
    options: Any = {"compression": "zstd", "use_dictionary": False, "column_encoding": split}
    with pq.ParquetWriter(where, first.schema, **options) as writer:
        writer.write_table(first)
        del first
        for table in tables:
            writer.write_table(table)


def read_parquet(path: str | os.PathLike[str], *, columns: Mapping[str, str] | None = None) -> Run:
    """Read a run that `write_parquet` wrote, to the last bit, or the folder of an unfinished `ParquetParts`.

    A file of another program is read too if it has the column names of a Run; `columns` are other names, as
    for `read_csv`.
    """
    path = existing(path, "Parquet file")
    try:
        if path.is_dir():
            parts = sorted(path.glob("part-*.parquet"))
            if not parts:
                raise InputError(f"{path}: a folder without Parquet parts; name the file in it")
            return _joined(path, parts, None)
        about = load_parquet(path, pq.read_metadata)
        if about.num_rows > mapped.LONG:
            return _joined(path, [path], columns)
        if FACTS not in (about.metadata or {}):
            return _others(path, columns)
        table = load_parquet(path)
        if columns:
            names, about = _renamed(table.column_names, columns, path), table.schema.metadata
            table = table.rename_columns(names).replace_schema_metadata(about)
        return run_of(table, path)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: damaged Parquet (a name is no text); write it again") from error


def _joined(path: Path, files: Sequence[Path], columns: Mapping[str, str] | None) -> Run:
    """The run in files one after the other, read in blocks, with the metadata of the last."""
    abouts = [load_parquet(file, pq.read_metadata) for file in files]
    schemas = [about.schema.to_arrow_schema() for about in abouts]
    spool, rows = Spool(sum(about.num_rows for about in abouts)), 0
    if not any(about.num_rows for about in abouts):
        return run_of(load_parquet(files[-1]), path)

    def append(file: Path) -> None:
        nonlocal rows
        with pq.ParquetFile(file) as source:
            for batch in source.iter_batches(mapped.BLOCK):
                table = pa.Table.from_batches([batch]).replace_schema_metadata(schemas[-1].metadata)
                if columns:
                    table = _on_the_floor(table.rename_columns(_renamed(table.column_names, columns, path)))
                spool.append(run_of(table, path, rows))
                rows += len(table)

    for file, schema in zip(files, schemas, strict=True):
        if schema != schemas[0]:
            raise InputError(f"{file}: has other columns than {files[0].name}; it belongs to another run")
        load_parquet(file, append)
    run = spool.run
    check_clock(run, str(path))
    return run


class ParquetParts:
    """A run that grows: each block becomes a Parquet file in the folder `F.parts`.

    `read_parquet` reads the folder at any time; a killed program loses at most the current block.
    """

    def __init__(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Start a file; `force` replaces it, and the parts of an unfinished one."""
        self.path = check_free(path, force=force)
        self.folder = Path(f"{self.path}.parts")  # Folder of the parts
        if self.folder.exists() and not force:
            advice = "magtwin convert reads them; give --force to replace them, or another name"
            raise InputError(f"{self.folder}: parts of a run that did not end; {advice}")
        self._count, self._last = 0, -np.inf
        try:
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written ({error.strerror})") from error

    def append(self, run: Run) -> None:
        """Add the rows of a block, which begins after the previous one, and write them to the disk."""
        if not run.rows:
            return
        check_clock(run, "the block to append")
        if run["t"][0] <= self._last:
            begin = f"begins at {run['t'][0]:.9g} s"
            raise InputError(f"the block to append {begin}, and the last ended at {self._last:.9g} s")
        with output(self.folder / f"part-{self._count:06d}.parquet", at_once=True) as aside:
            _write(run, aside)
        self._count, self._last = self._count + 1, run["t"][-1]


def write_csv(run: Run, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a run as CSV: metadata in lines that begin with #, a line of names, one line per row.

    Numbers have the fewest digits that give the same bits back; flags are true and false. pandas reads it
    with `read_csv(F, comment="#")` (before pandas 3, with `float_precision="round_trip"` beside), DuckDB with
    `read_csv('F', comment='#')`, polars with `read_csv(F, comment_prefix="#")`.
    """
    check_clock(run, "the run to write")
    table = table_of(run.take(slice(0, 1)))
    lines = [f"# {_ABOUT} run: metadata, then columns by name with unit, frame and meaning, in JSON"]
    lines += [f"# rows {run.rows}", f"# facts {_line_safe(json.loads(metadata_to_json(run)))}"]
    for field in table.schema:
        about = {key.decode(): text.decode() for key, text in field.metadata.items()}
        lines.append(f"# column {field.name} {_line_safe({'type': str(field.type), **about})}")
    for name in table.column_names:
        if not name.isprintable() or set(name) & set('",# '):
            raise InputError(f"column {name!r} cannot stand in a CSV file; use letters, digits and _")
    lines.append(",".join(table.column_names))
    from pyarrow import csv  # slow to import

    with output(path, force=force) as aside, open(aside, "wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        bare = csv.WriteOptions(include_header=False, quoting_style="none")
        for block in blocks(run):
            csv.write_csv(table_of(block), file, bare)


def read_csv(path: str | os.PathLike[str], *, columns: Mapping[str, str] | None = None) -> Run:
    """Read a run that `write_csv` wrote, to the last bit.

    A file of another program is read too if its columns have the names of a Run; vectors are split as in
    `odom_p_x`. `columns` are names in the file by names of a Run, such as `{"odom_p_x": "x"}`. A p_world_base
    without z lies on the floor.
    """
    path = existing_file(path, "CSV file", "CSV")
    size = path.stat().st_size
    with open(path, "rb") as file:
        try:
            about, names, skipped = _csv_head(file, path)
        except InputError as error:
            return _others(path, columns, error)
        file.seek(-1, os.SEEK_END)
        cut = file.read(1) != b"\n"
    check_count(path, "CSV", len(names), "columns")
    if NUMBER * size > decoded_limit(0):  # an empty cell is one byte
        with open(path, "rb") as file:
            lines = sum(block.count(b"\n") for block in iter(lambda: file.read(_CSV_LINE), b""))
        check_decoded(path, size, NUMBER * len(names) * lines)
    rows, metadata, said = _csv_about(about, path)
    names = _renamed(names, columns or {}, path)
    types = {
        name: pa.bool_() if name in COLUMNS and COLUMNS[name].unit == "bool" else pa.float64()
        for name in names
    }
    for name in said.keys() & types.keys():
        try:
            types[name] = pa.type_for_alias(said[name].pop("type", str(types[name])))
        except ValueError as error:
            raise InputError(f"{path}: column {name!r} has no such type: {error}") from error
    if cut and said:
        raise InputError(f"{path}: CSV cut short: its last line has no end; write it again, or copy it again")
    from pyarrow import csv  # slow to import

    try:
        reading = csv.ReadOptions(column_names=names, skip_rows=skipped)
        conversion = csv.ConvertOptions(
            column_types=types,
            null_values=[""],
            true_values=["true", "True", "TRUE", "1", "1.0"],
            false_values=["false", "False", "FALSE", "0", "0.0"],
        )
        table = csv.read_csv(path, reading, csv.ParseOptions(), conversion)
    except (pa.ArrowException, OSError) as error:
        fault = InputError(f"{path}: not a CSV file of a run: {_short(error)}")
        if not said:
            return _others(path, columns, fault)
        raise fault from error
    if rows not in ("", str(table.num_rows)):
        text = f"holds {table.num_rows} rows, but its line '# rows' says {rows[:20]!r}"
        raise InputError(f"{path}: {text}: cut short, or edited; copy it again, or remove that line")
    fields = [f.with_metadata(said.get(f.name) or None) for f in table.schema]
    table = table.cast(pa.schema(fields, metadata={FACTS: metadata}))
    return run_of(table if said else _by_quantity(table, path), path)


def _renamed(names: Sequence[str], columns: Mapping[str, str], path: Path) -> list[str]:
    """Names of columns, renamed to those of a Run."""
    known, own = {name: name for name in names}, {}
    for name, theirs in columns.items():
        try:
            own[find("column", theirs, known)] = name
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return [own.get(name, name) for name in names]


def _others(path: Path, columns: Mapping[str, str] | None, error: InputError | None = None) -> Run:
    """The run in a table of another program, without its texts; if it is none, the error is raised."""
    try:
        table = read_table(path)
    except InputError:
        if error is None:
            raise
        raise error from None
    if (twice := Counter(table.names).most_common(1)[0])[1] > 1:
        raise InputError(f"{path}: two columns are called {twice[0]!r}; rename one")
    kept, texts = dict[str, Any](), list[str]()
    for name, column in zip(table.names, table.columns, strict=True):
        if isinstance(column.cells, np.ndarray) and column.cells.dtype.kind in "fiub":
            kept[name] = column.cells
            continue
        for read in (table.numbers, table.times):
            with suppress(InputError):
                kept[name] = read(name)
                break
        else:
            texts.append(name)
    names = _renamed([*kept], columns or {}, path)
    if wrong := {*COLUMNS} & {*texts}:
        raise error or InputError(f"{path}: column {min(wrong)!r} must hold numbers or flags, got texts")
    run = run_of(_by_quantity(pa.table([pa.array(v) for v in kept.values()], names), path), path)
    if notes := [*table.notes, *([f"without the texts in {listed(texts)}"] if texts else [])]:
        warnings.warn(f"{path}: read {', '.join(notes)}", RepairWarning, stacklevel=4)
    return run


def _by_quantity(table: pa.Table, path: Path) -> pa.Table:
    """A table of another program, with the names and units of a Run for what it names otherwise."""
    notes = []
    for symbols, own in _OWN.items():
        free = (n for n in table.column_names if n not in COLUMNS and not _is_part(n))
        columns = Table(tuple(Column(name, (), path, None) for name in free))
        labels = [] if set(own) & set(table.column_names) else columns.find(*symbols)
        for symbol, label, name in zip(symbols, labels, own, strict=False):
            k = table.column_names.index(label)
            if pa.types.is_floating(kind := table.schema.field(k).type) or pa.types.is_integer(kind):
                values = table.column(k).to_numpy()
                factor = QUANTITIES[symbol].units.get(columns.unit(label, symbol))
                if symbol == "t":
                    values, factor = since_1970(Table((Column(label, values, path, None),)), label)[0], 1.0
                elif factor is None:
                    factor = NT_PER[unit_by_size(values) or "nT"] if symbol == "field" else 1.0
                table = table.set_column(k, name, pa.array(factor * values))
                notes.append(f"{label} as {name}")
    if "t" not in table.column_names:
        known = f"column 't' is missing (columns: {listed(table.column_names)})"
        raise InputError(f"{path}: not a Run: {known}; if a survey, magtwin map import takes it")
    if notes:
        warnings.warn(f"{path}: read {', '.join(notes)}", RepairWarning, stacklevel=4)
    return _on_the_floor(table)


def _is_part(name: str) -> bool:
    """Whether a name is that of a part of a vector of a Run, such as `odom_p_x`."""
    vector = COLUMNS.get(name.rpartition("_")[0])
    return vector is not None and vector.width > 1


def _on_the_floor(table: pa.Table) -> pa.Table:
    """A table with z = 0 if the positions have only x and y."""
    x, y, z = (f"p_world_base_{axis}" for axis in "xyz")
    if not {x, y} <= set(table.column_names) or z in table.column_names:
        return table
    return table.add_column(table.column_names.index(y) + 1, z, pa.array(np.zeros(table.num_rows)))


def _csv_head(file: io.BufferedReader, path: Path) -> tuple[list[str], list[str], int]:
    """The lines of a CSV that begin with #, its column names, and the number of these lines."""
    about, held = list[str](), 0
    for count, line in enumerate(iter(lambda: file.readline(_CSV_LINE), b""), 1):
        try:
            text = line.decode("utf-8-sig" if count == 1 else "utf-8").rstrip("\r\n")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: line {count} is not UTF-8; this is not a CSV file") from error
        if len(line) == _CSV_LINE or "\0" in text:
            raise InputError(f"{path}: line {count} is not a line of a CSV file")
        if text.startswith("#"):
            held += len(line)
            if len(about) == _CSV_ABOUT or held > BUDGETS["text"].file:
                raise InputError(f"{path}: {count:,} lines of comments; remove those that are not needed")
            about.append(text)
        elif text.strip():
            return about, [name.strip().strip('"') for name in text.split(",")], count
    raise InputError(f"{path}: no line of column names; the file is empty, or cut short")


def _csv_about(lines: list[str], path: Path) -> tuple[str, str, dict[str, dict[str, str]]]:
    """The number of rows ("" if missing), the metadata as JSON, and the metadata of columns in a CSV."""
    about, said = {"rows": "", "facts": "{}"}, {}
    for number, line in enumerate(lines, 1):
        kind, _, rest = line[1:].strip().partition(" ")
        if kind == "column":
            name, _, text = rest.partition(" ")
            said[name] = _texts(text, f"{path}:{number}")
        else:
            about[kind] = rest
    return about["rows"], about["facts"], said


def _texts(text: str, where: str) -> dict[str, str]:
    """A JSON object of texts."""
    try:
        said = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: metadata of a column are not JSON: {error}") from error
    if not isinstance(said, dict) or not all(isinstance(value, str) for value in said.values()):
        raise InputError(f"{where}: metadata of a column must be an object of texts, got {text[:40]!r}")
    return said


def _line_safe(value: Any) -> str:
    """JSON on one line, also for readers that end lines at other characters."""
    text = json.dumps(value, ensure_ascii=False)
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def _short(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:200] + " ..."


def write_npz(run: Run, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a run as npz: one array per column, and `magtwin`, a JSON text with metadata, units and frames.

    Arrays are not compressed, for speed, and nothing is pickled. The same run gives the same bytes.
    """
    check_clock(run, "the run to write")
    run.take(slice(0, 1)).members()  # refuses other than numbers
    if _ABOUT in run:
        raise InputError(f"column {_ABOUT!r} has the name that npz uses for metadata; rename it")
    columns = {
        name: {**said_of(run.spec(name), name), "parts": ",".join(run.spec(name).parts)} for name in run
    }
    about = json.dumps({"facts": json.loads(metadata_to_json(run)), "columns": columns}, ensure_ascii=False)
    with output(path, force=force) as aside, zipfile.ZipFile(aside, "w") as archive:
        for name, values in {_ABOUT: np.array(about), **run.columns}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _write_array(member, values)


def _write_array(member: Any, values: NDArray[Any]) -> None:
    """Write an array as numpy does, a long one block by block."""
    if not values.ndim or len(values) <= mapped.LONG:
        np.lib.format.write_array(member, values, allow_pickle=False)
        return
    head = np.lib.format.header_data_from_array_1_0(values)
    np.lib.format.write_array_header_1_0(member, {**head, "fortran_order": False})
    for first in range(0, len(values), mapped.BLOCK):
        member.write(values[first : first + mapped.BLOCK].tobytes())
        mapped.release()


def read_npz(path: str | os.PathLike[str]) -> Run:
    """Read a run that `write_npz` wrote, to the last bit, or any npz with array names of a Run."""
    path = existing_file(path, "npz file", "npz")
    try:
        with zipfile.ZipFile(path) as archive:
            check_zip(path, archive, "npz", "arrays")
            names = Counter(archive.namelist())
            if twice := sorted(name for name, count in names.items() if count > 1):
                raise InputError(f"{path}: two arrays are called {twice[0]!r}; write it again")
            arrays = {name.removesuffix(".npy"): _array(archive, name, path) for name in names}
    except _BROKEN as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not an npz file, damaged, or cut short ({error})") from error
    try:
        about = json.loads(str(arrays.pop(_ABOUT, "{}")))
        metadata = metadata_from_json(json.dumps(about.get("facts", {})), path)
        said = {name: _texts(json.dumps(text), str(path)) for name, text in about.get("columns", {}).items()}
    except (ValueError, AttributeError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: array {_ABOUT!r} holds no metadata of a run ({error})") from error
    specs = {
        name: spec_said(texts, tuple(filter(None, texts.get("parts", "").split(","))))
        for name, texts in said.items()
        if name not in COLUMNS
    }
    for name, values in arrays.items():
        if values.dtype.kind not in "bfiu" or values.ndim not in (1, 2):
            got = f"{values.dtype} of shape {values.shape}"
            raise InputError(f"{path}: column {name!r} must hold numbers or flags in rows, got {got}")
    try:
        run = Run(arrays, metadata, specs)
    except (InputError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    check_clock(run, str(path))
    return run


def _array(archive: zipfile.ZipFile, name: str, path: Path) -> NDArray[Any]:
    try:
        with archive.open(name) as file:
            _check_header(file, archive.getinfo(name).file_size)
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)  # type: ignore[arg-type]
    except (ValueError, MemoryError, OverflowError, SyntaxError, TokenError) as error:
        raise InputError(f"{path}: {name} is no whole array of plain numbers ({_short(error)})") from error


def _check_header(file: IO[bytes], size: int) -> None:
    """Refuse an array whose header claims more than its file holds, before room is made for it."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if math.prod(shape) * max(dtype.itemsize, 1) > size:
        raise ValueError(f"its header claims shape {shape} of {dtype} in {size:,} bytes")
