"""Parquet: what a file would take in memory, from its metadata."""

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from magtwin.budget import check_count, check_decoded, check_size
from magtwin.errors import InputError

_BATCH = 1000
"""Rows of texts that are measured at once."""

_ROW_GROUPS, _COLUMNS, _ABOUT, _COUNT = 4, 1, 3, 5
"""Fields of FileMetaData, RowGroup, ColumnChunk and ColumnMetaData, by parquet.thrift of Apache Parquet."""


def check_parquet(path: Path) -> None:
    """Refuse a Parquet file that would be too large in memory: equal values take no room in the file.

    Raises:
        InputError: Its columns, decoded, are over the budget, or there are too many of them.
    """
    size = check_size(path, "Parquet")
    with pq.ParquetFile(path) as file:
        about = file.metadata
        check_count(path, "Parquet", about.num_columns, "columns")
        columns = [about.schema.column(i) for i in range(about.num_columns)]
        lists = [i for i, column in enumerate(columns) if column.max_repetition_level]
        values = 8 * about.num_rows * (len(columns) - len(lists))
        if lists:
            counts = _counts(path)
            values += 8 * sum(count for group in counts for i, count in enumerate(group) if i in lists)
        check_decoded(path, size, values)
        texts = [column.path for column in columns if column.physical_type.endswith("BYTE_ARRAY")]
        for batch in file.iter_batches(_BATCH, columns=texts) if texts else ():
            values += batch.nbytes
            check_decoded(path, size, values)


def _counts(path: Path) -> list[list[int]]:
    """Values of each column by row group. pyarrow ends the process on columns whose metadata are damaged.

    Raises:
        InputError: The metadata are damaged.
    """
    with path.open("rb") as file:
        file.seek(-8, 2)
        length = int.from_bytes(file.read(4), "little")
        file.seek(-8 - length, 2)
        data = file.read(length)
    try:
        groups = _struct(data, 0, 0)[0].get(_ROW_GROUPS, [])
        return [[int(column[_ABOUT][_COUNT]) for column in group[_COLUMNS]] for group in groups]
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged Parquet (its metadata); write it again") from error


def _struct(data: bytes, at: int, depth: int) -> tuple[dict[int, Any], int]:
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


def _value(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (1, 2, 3):  # in a list, booleans take a byte
        return data[at], at + 1
    if kind in (4, 5, 6):
        return _integer(data, at)
    if kind == 7:
        return None, at + 8
    if kind == 8:
        length, at = _varint(data, at)
        return None, at + length
    if depth > 16:
        raise ValueError("lists without end")
    if kind == 12:
        return _struct(data, at, depth + 1)
    if kind not in (9, 10):
        raise ValueError(f"unknown kind {kind}")
    count, kind, at = data[at] >> 4, data[at] & 15, at + 1
    if count == 15:
        count, at = _varint(data, at)
    values = []
    for _ in range(count):  # each takes a byte at least
        value, at = _value(data, at, kind, depth + 1)
        values.append(value)
    return values, at


def _integer(data: bytes, at: int) -> tuple[int, int]:
    """A signed number, in zigzag code."""
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """An unsigned number in groups of 7 bits, the lowest first."""
    value = 0
    for shift in range(0, 70, 7):
        value |= (data[at] & 127) << shift
        at += 1
        if not data[at - 1] & 128:
            return value, at
    raise ValueError("a number without end")
