"""Scans of a run as a Parquet file, one per row."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.outputs import output
from magtwin.sim.sensors.lidar import Scans
from magtwin.tables.parquet import load_parquet

_VECTORS = {"p_world_lidar": 3, "q_world_lidar_xyzw": 4}
_DOCS = {
    "t": ("s", "time of the scan"),
    "arrival": ("s", "time of arrival"),
    "p_world_lidar": ("m", "position of the LiDAR at that time"),
    "q_world_lidar_xyzw": ("", "its orientation"),
    "ranges_m": ("m", "range along each ray, evenly from -pi anticlockwise; inf: no return, -inf: too near"),
}


def write_scans(scans: Scans, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write scans as Parquet; the same scans give the same bytes.

    Columns t and arrival [s], p_world_lidar [m], q_world_lidar_xyzw, and ranges_m [m], a list of a fixed
    length; unit and meaning are on each Arrow field.
    """
    columns, fields = [], []
    for name, (unit, doc) in _DOCS.items():
        values = getattr(scans, name)
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        column = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        columns.append(column)
        fields.append(pa.field(name, column.type, nullable=False, metadata={"unit": unit, "doc": doc}))
    table = pa.Table.from_arrays(columns, schema=pa.schema(fields))
    with output(path, force=force) as aside:
        pq.write_table(table, aside, compression="zstd", use_dictionary=False)


def read_scans(path: str | os.PathLike[str]) -> Scans:
    """Read scans that `write_scans` wrote, to the last bit.

    Raises:
        InputError: The file is missing, is not Parquet, is truncated, or holds no scans.
    """
    path = existing(path, "Parquet file of scans")
    table = load_parquet(path)
    values = {}
    for name in _DOCS:
        if name not in table.column_names:
            raise InputError(f"{path}: no scans: column {name!r} is missing; write them with --scans")
        column = table.column(name).combine_chunks()
        width = column.type.list_size if pa.types.is_fixed_size_list(column.type) else 0
        if name in _VECTORS and width != _VECTORS[name]:
            raise InputError(f"{path}: column {name!r} must hold {_VECTORS[name]} numbers a row")
        array = (column.flatten() if width else column).to_numpy(zero_copy_only=False)
        values[name] = array.reshape(-1, width) if width else array
    return Scans(**values)
