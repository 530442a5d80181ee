"""Arrow: a Run as an Arrow table, for Parquet and CSV, and back.

A vector column of a Run becomes one table column per part (`p_world_base_x`, `p_world_base_y`, ...), not a
column of lists. So pandas holds plain float64, SQL in DuckDB and expressions in polars need no indexing, a
part can be read alone, and byte-stream-split encoding works. Arrow fields have the metadata `column`, `part`,
`unit`, `frame`, `doc` and `interpolation`; the table has `magtwin_facts`, the Run's metadata as JSON.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.run.resample import RULES
from magtwin.run.run import COLUMNS, Column, Metadata, Run, check_clock

FACTS = b"magtwin_facts"


@contextmanager
def without_pandas() -> Iterator[None]:
    """Keep pyarrow from importing pandas, for a third of a second, in a block that makes arrays of lists."""
    shim = getattr(pa.lib, "_pandas_api", None)
    if shim is None or "pandas" in sys.modules:
        yield
        return

    class Finder:
        @staticmethod
        def find_spec(name: str, *_: Any) -> None:
            if name == "pandas":
                raise ImportError

    sys.meta_path.insert(0, Finder)  # type: ignore[arg-type]
    try:
        pa.array([])  # looks for pandas once
    finally:
        sys.meta_path.remove(Finder)  # type: ignore[arg-type]
    try:
        yield
    finally:
        shim.__init__()  # looks again when asked


def table_of(run: Run) -> pa.Table:
    """A run as a table.

    Raises:
        InputError: Its clock is missing or does not ascend, or a column cannot stand in a table.
    """
    check_clock(run, "the run to write")
    flat = run.members()
    fields = [
        pa.field(
            name,
            pa.from_numpy_dtype(values.dtype),
            nullable=False,
            metadata=said_of(run.spec(column), column, part),
        )
        for name, (column, part, values) in flat.items()
    ]
    schema = pa.schema(fields, metadata={FACTS: metadata_to_json(run)})
    return pa.Table.from_arrays([_array(values) for _, _, values in flat.values()], schema=schema)


def _array(values: NDArray[Any]) -> pa.Array:
    """A column of numbers or bools; `pa.array` would import pandas."""
    if values.dtype == bool:
        values, kind, count = np.packbits(values, bitorder="little"), pa.bool_(), len(values)
    else:
        kind, count = pa.from_numpy_dtype(values.dtype), len(values)
    return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(np.ascontiguousarray(values))])


def run_of(table: pa.Table, path: Path, first: int | None = None) -> Run:
    """The run in a table, which may also be from another program that uses the column names of a Run.

    `first` is the number of its first row, if it is a block of a longer table; its clock is then not checked.
    """
    if twice := sorted(name for name, count in Counter(table.column_names).items() if count > 1):
        raise InputError(f"{path}: two columns are called {twice[0]!r}; rename one")
    held = dict(zip(table.column_names, table.columns, strict=True))
    fields = {field.name: field for field in table.schema}
    columns, specs = {}, {}
    for name, members in _members(table.schema, path).items():
        parts = [_numpy(held[member], member, path, first or 0) for member in members]
        told = [_said(fields[member], path) for member in members]
        said = told[0]
        vector = COLUMNS[name].width > 1 if name in COLUMNS else "part" in said
        columns[name] = np.column_stack(parts) if vector else parts[0]
        if name in COLUMNS:
            wrong = (columns[name] != 0) & (columns[name] != 1) & (COLUMNS[name].unit == "bool")
            if wrong.any():
                row = int(np.argmax(wrong))
                text = f"a flag is 0 or 1, got {columns[name][row]}"
                raise InputError(f"{path}: column {name!r}, row {(first or 0) + row}: {text}")
        elif "column" in said:
            if vector and not all("part" in each for each in told):
                raise InputError(f"{path}: column {name!r} has a part without a name; write it again")
            named = tuple(each["part"] for each in told) if vector else ()
            specs[name] = spec_said(said, named)
    run = Run(columns, metadata_from_json((table.schema.metadata or {}).get(FACTS, b"{}"), path), specs)
    if first is None:
        check_clock(run, str(path))
    return run


def said_of(spec: Column, name: str, part: str = "") -> dict[str, str]:
    """Metadata of a table column."""
    texts = {"column": name, "part": part, "unit": spec.unit, "frame": spec.frame, "doc": spec.doc}
    texts["interpolation"] = spec.interpolation if name not in COLUMNS else ""
    return {key: text for key, text in texts.items() if text}


def spec_said(said: dict[str, str], parts: tuple[str, ...]) -> Column:
    """The description of a column from its metadata; an unknown interpolation is "linear"."""
    rule: Any = said.get("interpolation", "linear")
    unit, frame, doc = (said.get(key, "") for key in ("unit", "frame", "doc"))
    return Column(unit, frame, doc, len(parts) or 1, parts, rule if rule in RULES else "linear")


def metadata_to_json(run: Run) -> str:
    """The metadata of a run as a JSON object.

    Raises:
        InputError: A value is not a text, number or bool.
    """
    return json.dumps(check_metadata(dict(run.metadata)), ensure_ascii=False)


def metadata_from_json(text: str | bytes, path: Path) -> Metadata:
    """The metadata from `metadata_to_json`.

    Raises:
        InputError: The text is not a JSON object of texts, numbers and bools.
    """
    try:
        metadata = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: metadata {FACTS.decode()!r} is not JSON: {error}") from error
    return check_metadata(metadata, f"{path}: ")


def check_metadata(metadata: Any, where: str = "") -> Metadata:
    """Metadata of a run, if they are texts, numbers and bools by name; `where` begins the refusal.

    Raises:
        InputError: They are not.
    """
    if not isinstance(metadata, dict):
        raise InputError(f"{where}metadata {FACTS.decode()!r} must be an object, got {str(metadata)[:40]!r}")
    for key, value in metadata.items():
        if not isinstance(value, str | int | float | bool):
            raise InputError(
                f"{where}metadata {key!r} must be a text, a number, or true or false, got {value!r}"
            )
        if isinstance(value, int) and abs(value) > sys.float_info.max:
            raise InputError(f"{where}metadata {key!r} is a number beyond 1e308; write it as a text")
    return metadata


def _said(field: pa.Field, path: Path) -> dict[str, str]:
    """Metadata of a table column, as `said_of` gives it."""
    try:
        return {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
    except UnicodeDecodeError as error:
        text = f"{path}: damaged Parquet (metadata of column {field.name!r} are not UTF-8); write it again"
        raise InputError(text) from error


def _members(schema: pa.Schema, path: Path) -> dict[str, list[str]]:
    """Table columns of each column of the Run, in the order of its parts."""
    known = {f"{name}_{part}": name for name, column in COLUMNS.items() for part in column.parts}
    members: dict[str, list[str]] = {}
    for field in schema:
        home = _said(field, path).get("column") or known.get(field.name, field.name)
        members.setdefault(home, []).append(field.name)
    for name in members.keys() & COLUMNS.keys():
        wanted = [f"{name}_{part}" for part in COLUMNS[name].parts] or [name]
        missing = [key for key in wanted if key not in members[name]]
        if missing:
            raise InputError(f"{path}: column {missing[0]!r} is missing beside {members[name][0]!r}")
        members[name] = wanted
    return members


def _numpy(column: pa.ChunkedArray, name: str, path: Path, first: int) -> NDArray[Any]:
    kind = column.type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise InputError(f"{path}: column {name!r} must hold numbers or flags, got {kind}")
    if column.null_count:
        row = first + column.is_null().to_numpy().argmax()
        raise InputError(f"{path}: column {name!r}, row {row}: no value; write nan for unknown values")
    kept = [_flags(chunk) if kind == pa.bool_() else np.from_dlpack(chunk) for chunk in column.chunks]
    return np.concatenate(kept) if kept else np.empty(0, kind.to_pandas_dtype())


def _flags(chunk: pa.Array) -> NDArray[np.bool_]:
    """The bools of an array; `to_numpy` would import pandas."""
    bits = np.frombuffer(chunk.buffers()[1], np.uint8)
    return np.unpackbits(bits, bitorder="little")[chunk.offset : chunk.offset + len(chunk)].astype(bool)
