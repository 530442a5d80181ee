"""Tables: a Run as a Parquet file, a pandas DataFrame, an xarray Dataset.

A vector column of a Run becomes one table column a part (`p_world_base_x`, `p_world_base_y`, ...), not
a column of lists: pandas then holds plain float64 (lists would be Python objects), SQL in DuckDB and
expressions in polars need no indexing, one part can be read alone, and byte-stream-split coding works.
What a flat table cannot say stands in the metadata: on every Arrow field `column`, `part`, `unit`,
`frame` and `doc`; on the file `magtwin_facts`, the Run's facts in JSON, which any Parquet reader shows.
"""

import importlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.files import existing, output
from magtwin.names import RefusedError
from magtwin.run import COLUMNS, Column, Run

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_FACTS = b"magtwin_facts"
_MAGIC = b"PAR1"


def write_parquet(run: Run, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a run as Parquet; the same run gives the same bytes.

    Args:
        run: The run; it must have a column `t`.
        path: The file to make.
        force: Whether one that exists is replaced.

    Raises:
        RefusedError: The file exists and `force` was not given, or a column cannot stand in a table.
    """
    _check_clock(run, "the run to write")
    flat = _flat(run)
    fields = [
        pa.field(name, pa.from_numpy_dtype(values.dtype), nullable=False, metadata=_metadata(column, part))
        for name, (column, part, values) in flat.items()
    ]
    schema = pa.schema(fields, metadata={_FACTS: json.dumps(dict(run.facts), ensure_ascii=False)})
    table = pa.Table.from_arrays([pa.array(values) for _, _, values in flat.values()], schema=schema)
    split = {f.name: "BYTE_STREAM_SPLIT" for f in fields if pa.types.is_floating(f.type)}
    with output(path, force=force) as aside:
        pq.write_table(table, aside, compression="zstd", use_dictionary=False, column_encoding=split)


def read_parquet(path: str | os.PathLike[str]) -> Run:
    """The run that `write_parquet` wrote, to the last bit.

    A file that another program wrote is read too where it has the column names: without the metadata
    it just brings no facts.

    Args:
        path: The file.

    Raises:
        RefusedError: The file is missing, is not Parquet, was cut short, or holds no run.
    """
    path = existing(path, "Parquet file")
    check_parquet(path)
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise RefusedError(f"{path}: damaged Parquet ({reason}); write it again") from error
    columns = {}
    for name, members in _members(table.schema, path).items():
        parts = [_numpy(table, member, path) for member in members]
        vector = COLUMNS[name].width > 1 if name in COLUMNS else _is_part(table.schema.field(members[0]))
        columns[name] = np.column_stack(parts) if vector else parts[0]
    run = Run(columns, _read_facts(table.schema, path))
    _check_clock(run, str(path))
    return run


def to_pandas(run: Run) -> "pd.DataFrame":
    """A DataFrame with a column a part, one row a reading.

    `attrs["units"]` gives the unit of every column, `attrs["facts"]` the run's facts.

    Raises:
        RefusedError: pandas is not installed, or a column cannot stand in a table.
    """
    pandas = _optional("pandas")
    flat = _flat(run)
    frame = pandas.DataFrame({name: values for name, (_, _, values) in flat.items()})
    units = {name: _column(column).unit for name, (column, _, _) in flat.items()}
    frame.attrs = {"units": units, "facts": dict(run.facts)}
    return frame


def to_xarray(run: Run) -> "xr.Dataset":
    """A Dataset along the coordinate `t` [s]; vectors keep a second dimension of named parts.

    The dimensions of parts are called after them (`x_y_z`, `left_right`); `units`, `frame` and
    `long_name` are attributes of each variable, the run's facts those of the dataset.

    Raises:
        RefusedError: xarray is not installed, or the run has no column `t`.
    """
    xarray = _optional("xarray")
    _check_clock(run, "the run")
    variables: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    for name, values in run.items():
        column = _column(name)
        attrs = {"units": column.unit, "frame": column.frame, "long_name": column.doc}
        dims: tuple[str, ...] = ("t",)
        if values.ndim > 1:
            parts = _parts(name, values)
            dims = ("t", "_".join(parts))
            coords[dims[1]] = list(parts)
        variables[name] = (dims, values, {key: text for key, text in attrs.items() if text})
    coords["t"] = variables.pop("t")
    return xarray.Dataset(variables, coords, dict(run.facts))


def _check_clock(run: Run, what: str) -> None:
    if "t" not in run.columns:
        known = ", ".join(list(run.columns)[:5]) or "none"
        raise RefusedError(f"{what}: not a Run: column 't' is missing (columns: {known}, ...)")


def _column(name: str) -> Column:
    return COLUMNS.get(name, Column("", "", ""))


def _parts(name: str, values: NDArray[Any]) -> tuple[str, ...]:
    """Names of the numbers of a row: those of COLUMNS, else 0, 1, ...; none for a scalar."""
    if values.ndim == 1:
        return ()
    return _column(name).parts or tuple(str(i) for i in range(values.shape[1]))


def _flat(run: Run) -> dict[str, tuple[str, str, NDArray[Any]]]:
    """Columns of the table: by name, the Run's column, the part ("" for a scalar), contiguous values (N,)."""
    flat: dict[str, tuple[str, str, NDArray[Any]]] = {}
    for name, values in run.items():
        if values.ndim > 2 or values.dtype.kind not in "bfiu":
            raise RefusedError(
                f"column {name!r} cannot stand in a table: numbers or flags of shape (N,) or (N, width) "
                f"can, got {values.dtype} of shape {values.shape}"
            )
        rows = {f"{name}_{part}": (name, part, values[:, i]) for i, part in enumerate(_parts(name, values))}
        for key, (column, part, array) in (rows or {name: (name, "", values)}).items():
            if key in flat:
                raise RefusedError(f"columns {flat[key][0]!r} and {column!r} would both be called {key!r}")
            flat[key] = (column, part, np.ascontiguousarray(array))
    return flat


def _metadata(name: str, part: str) -> dict[str, str]:
    column = _column(name)
    said = {"column": name, "part": part, "unit": column.unit, "frame": column.frame, "doc": column.doc}
    return {key: text for key, text in said.items() if text}


def check_parquet(path: Path) -> None:
    """Refuse what does not begin and end as Parquet files do."""
    if path.is_dir():
        raise RefusedError(f"{path}: a folder, not a Parquet file; name the file in it")
    with open(path, "rb") as file:
        head = file.read(4)
        file.seek(max(0, path.stat().st_size - 4))
        tail = file.read(4)
    if head != _MAGIC:
        raise RefusedError(f"{path}: not a Parquet file: it begins with {head!r}, not {_MAGIC!r}")
    if tail != _MAGIC:
        raise RefusedError(f"{path}: Parquet cut short: its end is missing; write it again, or copy it again")


def _members(schema: pa.Schema, path: Path) -> dict[str, list[str]]:
    """For each column of the Run the table columns that hold it, in the order of its parts."""
    known = {f"{name}_{part}": name for name, column in COLUMNS.items() for part in column.parts}
    members: dict[str, list[str]] = {}
    for field in schema:
        said = (field.metadata or {}).get(b"column")
        home = said.decode() if said else known.get(field.name, field.name)
        members.setdefault(home, []).append(field.name)
    for name in members.keys() & COLUMNS.keys():
        wanted = [f"{name}_{part}" for part in COLUMNS[name].parts] or [name]
        missing = [key for key in wanted if key not in members[name]]
        if missing:
            raise RefusedError(f"{path}: column {missing[0]!r} is missing beside {members[name][0]!r}")
        members[name] = wanted
    return members


def _is_part(field: pa.Field) -> bool:
    return b"part" in (field.metadata or {})


def _numpy(table: pa.Table, name: str, path: Path) -> NDArray[Any]:
    column = table.column(name)
    kind = column.type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise RefusedError(f"{path}: column {name!r} must hold numbers or flags, got {kind}")
    if column.null_count:
        row = column.is_null().to_numpy().argmax()
        raise RefusedError(f"{path}: column {name!r}, row {row}: no value; write nan where nothing is known")
    return column.to_numpy()


def _read_facts(schema: pa.Schema, path: Path) -> dict[str, str | int | float | bool]:
    try:
        facts = json.loads((schema.metadata or {}).get(_FACTS, b"{}"))
    except ValueError as error:
        raise RefusedError(f"{path}: metadata {_FACTS.decode()!r} is not JSON: {error}") from error
    return facts


def _optional(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RefusedError(
            f"{module} is not installed; install it with: pip install 'magtwin[{module}]'"
        ) from error
