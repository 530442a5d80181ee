"""Saved readings: Readings as Parquet."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.survey.readings import SHAPES, Readings
from magtwin.files.file import existing
from magtwin.files.outputs import output
from magtwin.tables.parquet import load_parquet
from magtwin.tables.table import read_table

_SURVEY = b"magtwin_readings"
_PARTS = {"p_xy": ("x", "y"), "b_body_nt": ("x", "y", "z"), "node": ("heading", "row", "column")}
_UNITS = {"p_xy": "m", "yaw": "rad", "b_nt": "nT", "b_body_nt": "nT", "t": "s", "good": "bool"}
_FRAMES = {"p_xy": "world", "yaw": "world", "b_body_nt": "base_link"}
_TEXTS = ("name", "source", "licence", "created")
_PLACES = ("frame", "datum")


def save_readings(readings: Readings, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write readings as Parquet; the same readings give the same bytes.

    Arrow fields have unit and frame as metadata. The metadata `magtwin_readings` of the file hold, as JSON,
    the runs, the grid, the height and the source.
    """
    fields, arrays, parts = [], [], {**_PARTS, "signals": readings.signal_names}
    for key, (width, _) in SHAPES.items():
        values = getattr(readings, key)
        if values is None:
            continue
        for i, part in enumerate(parts[key] if width else ("",)):
            array = pa.array(np.ascontiguousarray(values[:, i] if width else values))
            texts = {"column": key, "part": part, "unit": _UNITS.get(key, ""), "frame": _FRAMES.get(key, "")}
            texts = {k: text for k, text in texts.items() if text}
            label = f"{key}_{part}" if part else key
            fields.append(pa.field(label, array.type, nullable=False, metadata=texts))
            arrays.append(array)
    about: dict[str, Any] = {key: getattr(readings, key) for key in (*_TEXTS, *_PLACES)}
    about |= {"runs": readings.runs, "height_m": readings.height_m, "earth_nt": readings.earth_nt}
    about |= {"signal_names": readings.signal_names} if readings.signal_names else {}
    about |= {"by_hand": True} if readings.by_hand else {}
    about |= {"rounding_nt": readings.rounding_nt} if readings.rounding_nt else {}
    about["grid"] = None if readings.grid is None else asdict(readings.grid)
    schema = pa.schema(fields, metadata={_SURVEY: json.dumps(about, ensure_ascii=False)})
    split = {f.name: "BYTE_STREAM_SPLIT" for f in fields if pa.types.is_floating(f.type)}
    table = pa.Table.from_arrays(arrays, schema=schema)
    with output(path, force=force) as aside:
        pq.write_table(table, aside, compression="zstd", use_dictionary=False, column_encoding=split)


def load_readings(path: str | os.PathLike[str]) -> Readings:
    """Read readings that `save_readings` wrote, to the last bit."""
    path = Path(existing(path, "Parquet file"))
    metadata = dict(load_parquet(path, pq.read_schema).metadata or {})
    table = read_table(path)
    if _SURVEY not in metadata:
        raise InputError(f"{path}: no Readings: metadata {_SURVEY.decode()!r} is missing")
    try:
        about = json.loads(metadata[_SURVEY])
        grid = (
            about["grid"]
            and Grid(**{**about["grid"], "headings_rad": tuple(about["grid"]["headings_rad"])}).in_memory()
        )
        given = {key: about[key] for key in (*_TEXTS, "height_m")} | {"runs": tuple(about["runs"])}
        given |= {key: about.get(key, "") for key in _PLACES} | {"earth_nt": about.get("earth_nt")}
        given["signal_names"] = tuple(map(str, about.get("signal_names", ())))
        given |= {"by_hand": about.get("by_hand") is True, "rounding_nt": about.get("rounding_nt", 0.0)}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from error
        raise InputError(
            f"{path}: metadata {_SURVEY.decode()!r} is damaged ({type(error).__name__}: {error})"
        ) from error
    names = set(table.names)
    arrays: dict[str, ArrayLike] = {}
    parts = {**_PARTS, "signals": given["signal_names"]}
    for key, (width, kind) in SHAPES.items():
        labels = [f"{key}_{part}" for part in parts[key]] if width else [key]
        if names.isdisjoint(labels) and key in ("b_body_nt", "t", "signals", "node"):
            continue
        cells: list[NDArray[Any]] = [table.numbers(label).astype(kind) for label in labels]
        arrays[key] = np.column_stack(cells) if width else cells[0]
    try:
        return Readings(**arrays, grid=grid or None, **given)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
