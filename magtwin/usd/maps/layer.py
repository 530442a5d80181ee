"""An AnomalyMap as a USD layer: arrays on one prim, and a coloured floor for viewers."""

import hashlib
import math
import os
import re
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, Vt

from magtwin.errors import InputError, about
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.usd.layers import new_stage, open_stage, translates
from magtwin.usd.maps.attributes import (
    CHECKSUM_VERSION,
    GRID,
    MOST_CHARACTERS,
    PLACES,
    TEXTS,
    check_type,
    get,
    grid_numbers,
    grid_values,
    harmonic_arrays,
    harmonic_values,
    read_harmonic,
    read_height,
    read_made_from,
    read_parameters,
    set_values,
    texts_of,
)
from magtwin.usd.maps.heat_map import MAP, define_heat_map
from magtwin.usd.schema import apply_api, attribute_name, only_prim_with, place, prims_with

RECORDED = ("recorded_nt", "recorded_yaw")
"""What only a survey has: its exact readings, and their headings."""


def save_map(field: AnomalyMap, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a map as a layer, which any stage can use as a sublayer.

    Values become single precision (steps of 0.004 nT at 42,000 nT). The readings of a survey's nodes and a
    harmonic field keep their precision.

    Args:
        field: The map.
        path: File to make: .usdc, .usd, or .usda, which is text and ten times as large.
        force: Whether to replace an existing file.

    Raises:
        InputError: The file exists and `force` was not given, or has another suffix; or a parameter of the
            map cannot be written as JSON.
    """
    if Path(path).suffix.lower() not in (".usdc", ".usd", ".usda"):
        raise InputError(f"{path}: a map layer ends in .usdc, .usd or .usda")
    values = {**grid_values(field), **_values(field)}
    about = f"Magnetic anomaly map {field.name}: total field over x, y and heading. {field.source}"
    with new_stage(path, about, force=force) as stage:
        prim = apply_api(UsdGeom.Xform.Define(stage, MAP).GetPrim(), "anomalyMap")
        if field.harmonic is not None:
            apply_api(prim, "harmonic")
        set_values(prim, values)
        define_heat_map(stage, field)


def _refuse_tables(path: str | os.PathLike[str]) -> None:
    """Refuse a table of readings or a recording in place of a map."""
    if Path(path).suffix.lower() in (".csv", ".txt", ".parquet", ".pq", ".mcap", ".db3"):
        fitted = Path(path).with_suffix(".usdc").name
        way = f"fit a map to it first: magtwin map fit {quote(str(path))} --out {fitted}"
        raise InputError(f"{path}: a table of readings or a recording, not a map; {way}")


@translates
def load_map(path: str | os.PathLike[str]) -> AnomalyMap:
    """The map of a layer, or of a stage that holds one.

    Raises:
        InputError: The file is missing or not USD, holds no map or several, or its arrays are inconsistent
            or do not match the checksum.
    """
    _refuse_tables(path)
    stage = open_stage(path)  # held in a name: a prim does not keep its stage alive
    return read_map(only_prim_with(stage.GetPseudoRoot(), "anomalyMap"))


@translates
def is_map_layer(path: str | os.PathLike[str]) -> bool:
    """Whether a USD file is a map: it holds an anomaly map and no robot.

    Raises:
        InputError: The file is missing or not USD.
    """
    _refuse_tables(path)
    stage = open_stage(path)
    root = stage.GetPseudoRoot()
    return len(prims_with(root, "anomalyMap")) == 1 and not prims_with(root, "robot")


@translates
def layer_of_map(path: str | os.PathLike[str]) -> Path | None:
    """The file of a stage's layer with the values of its map; None if it has none or several maps."""
    stage = open_stage(path)
    maps = prims_with(stage.GetPseudoRoot(), "anomalyMap")
    values = maps[0].GetAttribute(attribute_name("anomalyMap", "values")) if len(maps) == 1 else None
    specs = values.GetPropertyStack() if values else []
    return Path(specs[0].layer.realPath) if specs else None


def check_map_layer(path: str | os.PathLike[str]) -> None:
    """Refuse a file that is no map layer, as `map_layer`; errors as for `is_map_layer`."""
    if not is_map_layer(path):
        text = "is no map layer; give the layer of a map, such as `magtwin map import` writes"
        raise InputError(f"{path}: {text}", parameter="map_layer")


def _arrays(prim: Usd.Prim) -> tuple[NDArray, NDArray, NDArray, dict[str, NDArray] | None, NDArray]:
    """What the checksum covers: values, flags and variances, flat, the harmonic field, and the grid."""
    version = get(prim, "checksumVersion")
    if version != CHECKSUM_VERSION:
        raise InputError(
            f"{place(prim)}: its checksum is of version {version}, this magtwin reads {CHECKSUM_VERSION}; "
            "make the map anew, or read it with the magtwin that wrote it"
        )
    values, valid, variance = (np.array(get(prim, name)) for name in ("values", "valid", "variance"))
    if not values.size:
        raise InputError(
            f"{place(prim)}: has no {attribute_name('anomalyMap', 'values')}; select the variant that has "
            "them, or make the map anew"
        )
    grid = np.concatenate([np.ravel(np.array(get(prim, name), float)) for name in GRID])
    return values, valid, variance, read_harmonic(prim), grid


@translates
def read_map(prim: Usd.Prim) -> AnomalyMap:
    """The map of a prim, as its stage shows it; errors as for `load_map`."""
    values, valid, variance, harmonic, grid = _arrays(prim)
    checksum = get(prim, "checksum")
    if not re.fullmatch("[0-9a-f]{64}", checksum):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'checksum')} must be a SHA-256, 64 digits 0-9a-f, "
            f"got {checksum[:MOST_CHARACTERS]!r}; make the map anew"
        )
    shape = tuple(get(prim, "shape"))
    if len(shape) != 3 or min(shape) < 1 or not values.size == valid.size == math.prod(shape):
        sizes = f"{values.size} values and {valid.size} flags"
        raise InputError(f"{place(prim)}: shape {list(shape)} does not fit {sizes}")
    if variance.size not in (0, values.size, 3 * values.size):
        raise InputError(f"{place(prim)}: {values.size} values have {variance.size} variances")
    headings = np.array(get(prim, "headings"), float)
    if not (headings.size and np.all(np.diff(headings) > 0) and headings[0] >= 0 and headings[-1] < 360):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'headings')} must ascend in [0, 360) deg, got "
            f"{str(headings.tolist())[:MOST_CHARACTERS]}; make the map anew"
        )
    if checksum != _checksum(values, valid, variance, harmonic, grid):
        text = "the map's values do not match its checksum, which covers its grid too; make the map anew"
        raise InputError(f"{place(prim)}: {text}")
    spreads = variance.reshape(-1, *shape).astype(float)  # of the nodes, and between them
    recorded = _read_recorded(prim, RECORDED[0], shape)
    if recorded is not None and not np.array_equal(recorded.ravel().astype("f4"), values, equal_nan=True):
        text = "the map's values are not those that were recorded, in single precision; make the map anew"
        raise InputError(f"{place(prim)}: {text}")
    with about(f"{place(prim)}:"):
        return AnomalyMap(
            values_nt=values.reshape(shape).astype(float) if recorded is None else recorded,
            valid=valid.reshape(shape).astype(bool),
            variance_nt2=spreads[0] if len(spreads) else None,
            between_nt2=spreads[1:] if len(spreads) > 1 else None,
            recorded_yaw=_read_recorded(prim, RECORDED[1], shape),
            origin_m=tuple(get(prim, "origin")),
            cell_m=tuple(get(prim, "cellSize")),
            headings_rad=np.deg2rad(headings),
            height_m=read_height(prim),
            parameters=read_parameters(get(prim, "parameters")),
            harmonic=None if harmonic is None else HarmonicField(**harmonic),
            made_from=read_made_from(prim),
            **{name: get(prim, name) for name in PLACES},
            **{name: get(prim, name) for name in TEXTS},
        )


def _read_recorded(prim: Usd.Prim, name: str, shape: tuple[int, ...]) -> NDArray | None:
    """Recorded numbers at the nodes; None if there are none."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", name))
    value = attribute.Get()
    if value is None or not len(value):
        return None
    recorded = np.array(check_type(attribute, value), float)
    if recorded.size != math.prod(shape):
        raise InputError(
            f"{place(prim)}: {attribute.GetName()} has {recorded.size} numbers for {math.prod(shape)} values"
        )
    return recorded.reshape(shape)


def _values(field: AnomalyMap) -> dict[str, Any]:
    """Values of the attributes of a map's arrays and texts, by name; None if there is no value."""
    values = field.values_nt.astype(np.float32).ravel()
    valid = np.ascontiguousarray(field.valid).ravel()
    variance = np.empty(0, np.float32)
    if field.variance_nt2 is not None:
        parts = [field.variance_nt2, *([] if field.between_nt2 is None else field.between_nt2)]
        variance = np.stack(parts).astype(np.float32).ravel()
    recorded = [None, None]
    if field.recorded_yaw is not None:
        recorded = [Vt.DoubleArray.FromNumpy(a.ravel()) for a in (field.values_nt, field.recorded_yaw)]
        if np.array_equal(values, field.values_nt.ravel(), equal_nan=True):
            recorded[0] = None
    harmonic = harmonic_arrays(field)
    given = {
        "values": Vt.FloatArray.FromNumpy(values),
        "valid": Vt.BoolArray.FromNumpy(valid),
        "variance": Vt.FloatArray.FromNumpy(variance),
        **dict(zip(RECORDED, recorded, strict=True)),
        "checksum": _checksum(values, valid, variance, harmonic, grid_numbers(field.grid)),
    }
    named = {attribute_name("anomalyMap", name): value for name, value in given.items()}
    return {**named, **texts_of(field), **harmonic_values(harmonic)}


def _checksum(values: NDArray, valid: NDArray, variance: NDArray, harmonic: Any, grid: NDArray) -> str:
    """SHA-256 over the bytes of the arrays: float32, one byte a flag, float64; little-endian."""
    digest = hashlib.sha256(values.astype("<f4").tobytes())
    digest.update(valid.astype(np.uint8).tobytes())
    digest.update(variance.astype("<f4").tobytes())
    for array in (*(harmonic or {}).values(), grid):
        digest.update(array.astype("<f8").tobytes())
    return digest.hexdigest()
