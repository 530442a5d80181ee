"""Parquet: loading a file, once its metadata tell that it fits into memory."""

import mmap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import check_count, check_decoded, check_size
from magtwin.files.file import existing
from magtwin.files.protobuf import varint

_MAGIC = b"PAR1"

_BATCH = 1 << 20  # Most rows of texts that are measured at once
_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # Ticks per second of a timestamp of Arrow, by its unit
_FIXED = "FIXED_LEN_BYTE_ARRAY"  # Texts of equal length, whose length is in the metadata

_ROW_GROUPS, _COLUMNS, _ABOUT = 4, 1, 3
_COUNT, _PACKED, _DATA, _DICTIONARY = 5, 7, 9, 11
_PAGE, _PACKED_PAGE = 2, 3
"""Fields of FileMetaData, RowGroup and ColumnChunk; of ColumnMetaData; and of PageHeader, by parquet.thrift
of Apache Parquet."""


def _whole(path: Path) -> pa.Table:
    with pq.ParquetFile(path) as file:  # `read_table` would import pandas
        return file.read()


def load_parquet(path: Path, load: Callable[[Path], Any] = _whole) -> Any:
    """A Parquet file, loaded by a function of pyarrow, if it begins and ends like one and is whole."""
    path = existing(path, "Parquet file")
    if path.is_dir():
        raise InputError(f"{path}: a folder, not a Parquet file; name the file in it")
    with open(path, "rb") as file:
        head = file.read(4)
        file.seek(max(0, path.stat().st_size - 4))
        tail = file.read(4)
    if head != _MAGIC:
        raise InputError(f"{path}: not a Parquet file: it begins with {head!r}, not {_MAGIC!r}")
    if tail != _MAGIC:
        raise InputError(f"{path}: Parquet cut short: its end is missing; write it again, or copy it again")
    try:
        check_parquet(path)
        loaded = load(path)
        if isinstance(loaded, pa.Table):
            loaded.validate(full=True)  # texts that are not UTF-8 fail later otherwise
        return loaded
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(f"{path}: damaged Parquet ({reason}); write it again") from error


def parquet_columns(path: Path) -> list[tuple[str, NDArray[Any]]]:
    """Name and cells of the columns of numbers, texts and times, which are seconds, of dates since 1970."""
    table = load_parquet(path)
    columns = []
    for field, values in zip(table.schema, table.columns, strict=True):
        kind = field.type
        if pa.types.is_dictionary(kind):
            values, kind = values.cast(kind.value_type), kind.value_type
        if pa.types.is_decimal(kind) or pa.types.is_date(kind):
            kind = pa.float64() if pa.types.is_decimal(kind) else pa.timestamp("s")
            values = values.cast(kind)
        if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind):
            plain = values.cast(pa.float64(), safe=False) if values.null_count else values
            columns.append((field.name, plain.to_numpy()))
        elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
            values = values.cast(pa.int32()) if pa.types.is_time32(kind) else values
            since = values.cast(pa.int64()).cast(pa.float64(), safe=False)
            columns.append((field.name, since.to_numpy() / _TICKS[kind.unit]))
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            columns.append((field.name, np.array(values.to_pylist(), object)))
    if not columns or not table.num_rows:
        raise InputError(f"{path}: it has no rows of numbers; expected one per reading")
    return columns


def check_parquet(path: Path) -> None:
    """Refuse a Parquet file too large in memory: equal values take no room in the file."""
    size = check_size(path, "Parquet")
    with pq.ParquetFile(path) as file:
        about = file.metadata
        check_count(path, "Parquet", about.num_columns, "columns")
        columns = [about.schema.column(i) for i in range(about.num_columns)]
        _check_pages(path, size)
        values = 8 * about.num_rows * sum(not column.max_repetition_level for column in columns)
        for group in _counts(path):
            for column, count in zip(columns, group, strict=False):
                values += 8 * count if column.max_repetition_level else 0
                values += column.length * count if column.physical_type == _FIXED else 0
        check_decoded(path, size, values)
    texts = [column.path for column in columns if column.physical_type == "BYTE_ARRAY"]
    # As dictionaries, since a large text of a dictionary can be in every row.
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        for batch in file.iter_batches(_BATCH, columns=texts) if texts else ():
            values += sum(_nbytes(column) for column in batch.columns)
            check_decoded(path, size, values)


def _nbytes(column: pa.Array) -> int:
    """Bytes of a column, each of its texts whole."""
    if pa.types.is_dictionary(column.type):
        from pyarrow import compute  # slow to import

        lengths = compute.binary_length(column.dictionary).cast(pa.int64())
        return _nbytes(column.indices) + int(compute.sum(lengths.take(column.indices)).as_py() or 0)
    if pa.types.is_nested(column.type):
        return sum(map(_nbytes, column.flatten() if pa.types.is_struct(column.type) else [column.flatten()]))
    return int(column.nbytes)


def _counts(path: Path) -> list[list[int]]:
    """Values of each column by row group. pyarrow ends the process on columns whose metadata are damaged."""
    return [[column[_COUNT] for column in group] for group in _chunks(path)]


def _check_pages(path: Path, size: int) -> None:
    """Refuse pages that would be too large, decompressed, in a file of `size` bytes."""
    total, packed = 0, 0
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for column in (column for group in _chunks(path) for column in group):
            at = min(filter(None, (column[_DATA], column[_DICTIONARY])), default=0)
            end = at + column[_PACKED]
            packed += column[_PACKED]
            if not 0 <= at <= end <= size >= packed:
                raise _damaged(path)
            while at < end:
                try:
                    page, at = _struct(data, at, 0)
                    length, step = int(page[_PAGE]), int(page[_PACKED_PAGE])
                except (IndexError, KeyError, TypeError, ValueError) as error:
                    raise _damaged(path) from error
                if min(length, step) < 0:
                    raise _damaged(path)
                total, at = total + length, at + step
            check_decoded(path, size, total)


def _chunks(path: Path) -> list[list[dict[int, Any]]]:
    """Metadata of the parts of the columns, by row group; their numbers are numbers."""
    with path.open("rb") as file:
        file.seek(-8, 2)
        length = int.from_bytes(file.read(4), "little")
        file.seek(-8 - length, 2)
        data = file.read(length)
    try:
        groups = _struct(data, 0, 0)[0].get(_ROW_GROUPS, [])
        chunks = [[column[_ABOUT] for column in group[_COLUMNS]] for group in groups]
        for column in (column for group in chunks for column in group):
            column |= {field: int(column[field]) for field in (_COUNT, _PACKED, _DATA)}
            column[_DICTIONARY] = int(column.get(_DICTIONARY, 0))
        return chunks
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error


def _damaged(path: Path) -> InputError:
    return InputError(f"{path}: damaged Parquet (its metadata); write it again")


def _struct(data: bytes | mmap.mmap, at: int, depth: int) -> tuple[dict[int, Any], int]:
    """Fields by number of a struct in Thrift's compact protocol, and where it ends."""
    fields: dict[int, Any] = {}
    number = 0
    while kind := data[at]:
        at += 1
        if kind >> 4:
            number += kind >> 4
        else:
            number, at = _integer(data, at)
        if kind & 15 in (1, 2):  # booleans, whose value is their kind
            fields[number] = kind & 15 == 1
        else:
            fields[number], at = _value(data, at, kind & 15, depth)
    return fields, at + 1


def _value(data: bytes | mmap.mmap, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (1, 2, 3):  # in a list, booleans take a byte
        return data[at], at + 1
    if kind in (4, 5, 6):
        return _integer(data, at)
    if kind == 7:
        return None, at + 8
    if kind == 8:
        length, at = varint(data, at)
        return None, at + length
    if depth > 16:
        raise ValueError("lists without end")
    if kind == 12:
        return _struct(data, at, depth + 1)
    if kind not in (9, 10):
        raise ValueError(f"unknown kind {kind}")
    count, kind, at = data[at] >> 4, data[at] & 15, at + 1
    if count == 15:
        count, at = varint(data, at)
    values = []
    for _ in range(count):  # each takes a byte at least
        value, at = _value(data, at, kind, depth + 1)
        values.append(value)
    return values, at


def _integer(data: bytes | mmap.mmap, at: int) -> tuple[int, int]:
    """A signed number, in zigzag code."""
    value, at = varint(data, at)
    return (value >> 1) ^ -(value & 1), at
