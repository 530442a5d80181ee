"""An AnomalyMap as a USD layer: arrays on one prim, and a coloured floor for viewers."""

import datetime
import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, Vt

from magtwin.errors import InputError
from magtwin.field.days import parse_day
from magtwin.field.maps.epochs import at_date, day_of, in_order
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.tiles import TILED_FROM, Tile, TiledMap, Tiling
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
    harmonic_arrays,
    harmonic_values,
    read_harmonic,
    read_height,
    read_made_from,
    read_parameters,
    set_values,
    shared_values,
    texts_of,
)
from magtwin.usd.maps.epochs import define_epoch, each_epoch, epochs_of, selected_epoch, warn_of_time_codes
from magtwin.usd.maps.heat_map import MAP, Floor, define_colours, define_heat_map
from magtwin.usd.maps.tiled_layer import is_tiled, read_tiled, tiled_checksums, write_tiled
from magtwin.usd.schema import apply_api, attribute_name, only_prim_with, place, prims_with

RECORDED = ("recorded_nt", "recorded_yaw")
"""What only a survey has: its exact readings, and their headings."""


def save_map(
    field: AnomalyMap, path: str | os.PathLike[str], *, tile_cells: int | None = None, force: bool = False
) -> None:
    """Write a map as a layer, which any stage can use as a sublayer.

    Values become single precision (steps of 0.004 nT at 42,000 nT). The readings of a survey's nodes and a
    harmonic field keep their precision. A map of 8,000,000 nodes or more over all headings is stored in
    tiles, which are read when a lookup needs them, unless it has the yaw of single readings.

    Args:
        field: The map.
        path: File to make, .usdc or .usd.
        tile_cells: Number of cells along x and y of a tile. None: chosen by size.
        force: Whether to replace an existing file.

    Raises:
        InputError: The file exists and `force` was not given, or has another suffix; or a parameter of the
            map cannot be written as JSON.
    """
    if tile_cells is not None and (tile_cells < 1 or field.recorded_yaw is not None):
        why = "a map of single readings has no tiles" if tile_cells >= 1 else "it must be 1 or more"
        raise InputError(f"`tile_cells` {tile_cells}: {why}", parameter="tile_cells")
    large = math.prod(field.grid.shape) >= TILED_FROM and field.recorded_yaw is None
    if not (large or isinstance(field, TiledMap) or tile_cells):
        _save((field,), path, force)
        return
    if isinstance(field, TiledMap) and tile_cells in (None, field.tiling.cells):
        write_tiled(field.tiling, field.tile, field, path, force)
        return
    held = field.whole()
    tiling = Tiling(held.grid, tile_cells) if tile_cells else Tiling.of(held.grid)

    def tile_of(tile: int) -> Tile:
        at = (..., *tiling.nodes(tile))
        spreads = (held.variance_nt2, held.between_nt2)
        variance, between = (None if a is None else a[at].astype(np.float32) for a in spreads)
        return Tile(held.values_nt[at].astype(np.float32), held.valid[at], variance, between)

    write_tiled(tiling, tile_of, held, path, force)


def save_map_series(maps: Sequence[AnomalyMap], path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write the epochs of a map as one layer: the variant set `epoch`, with one variant per date.

    Shared attributes are written once. The latest epoch is selected; any program that reads USD can select
    another one, also in a stage that brings the layer in. The colours of all epochs have one scale.

    Args:
        maps: Two or more maps of one grid, each with its date in `created`, in any order.
        path: File to make, .usdc or .usd.
        force: Whether to replace an existing file.

    Raises:
        InputError: As for `save_map`, and if the maps are no epochs of one map (`magtwin.field.maps.epochs`).
    """
    _save(in_order(maps), path, force)


def _refuse_tables(path: str | os.PathLike[str]) -> None:
    """Refuse a table of readings or a recording in place of a map."""
    if Path(path).suffix.lower() in (".csv", ".txt", ".parquet", ".pq", ".mcap", ".db3"):
        fitted = Path(path).with_suffix(".usdc").name
        raise InputError(
            f"{path}: a table of readings or a recording, not a map; fit a map to it first: "
            f"magtwin map fit {quote(str(path))} --out {fitted}"
        )


@translates
def load_map(path: str | os.PathLike[str], date: str | datetime.date | None = None) -> AnomalyMap:
    """The map of a layer, or of a stage that holds one.

    Args:
        path: The layer or stage.
        date: Date of the map, or its text YYYY-MM-DD; the map is interpolated linearly in time between two
            epochs. Default: the epoch that the file selects, which is the latest unless someone changed it.

    Raises:
        InputError: The file is missing or not USD, holds no map or several, or its arrays are inconsistent
            or do not match the checksum; or the date is not valid or outside the epochs.
    """
    _refuse_tables(path)
    stage = open_stage(path)
    prim = only_prim_with(stage.GetPseudoRoot(), "anomalyMap")
    if date is None:
        return read_map(prim)
    day = parse_day(date).isoformat()
    if day in epochs_of(prim):
        return next(_read(at) for _, at in each_epoch(prim, [day]))
    return at_date(_epochs(prim), day)


@translates
def load_epochs(path: str | os.PathLike[str]) -> tuple[AnomalyMap, ...]:
    """Every epoch of a layer's or stage's map, the earliest first.

    Raises:
        InputError: As for `load_map`, for any of the epochs.
    """
    stage = open_stage(path)
    prim = only_prim_with(stage.GetPseudoRoot(), "anomalyMap")
    return _epochs(prim)


def _epochs(prim: Usd.Prim) -> tuple[AnomalyMap, ...]:
    if not epochs_of(prim) and not warn_of_time_codes(prim):
        return (_read(prim),)
    return tuple(_read(at, date) for date, at in each_epoch(prim))


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
def read_map(prim: Usd.Prim) -> AnomalyMap:
    """The map of a prim, at the epoch that its stage selects; errors as for `load_map`."""
    warn_of_time_codes(prim)
    return _read(prim)


def checksums(prim: Usd.Prim) -> list[tuple[str, str]]:
    """The stored and the computed checksum of a map: of each epoch, if it has several.

    That of a map in tiles covers the checksums of its tiles, not the tiles: `tile_faults` checks those.

    Raises:
        InputError: An array is missing or of another type; names the prim.
    """
    if is_tiled(prim):
        return [tiled_checksums(prim)]
    pairs = [_checksums(at) for _, at in each_epoch(prim)]
    return pairs or [_checksums(prim)]


def _checksums(prim: Usd.Prim) -> tuple[str, str]:
    values, valid, variance = (np.array(get(prim, name)) for name in ("values", "valid", "variance"))
    taken = _checksum(values, valid, variance, read_harmonic(prim), _covered_grid(prim))
    return get(prim, "checksum"), taken


def _covered_grid(prim: Usd.Prim) -> NDArray[np.float64] | None:
    """The numbers of the grid in the order of `GRID`; None if the map's checksum does not cover them."""
    version = get(prim, "checksumVersion")
    if version == 1:
        return None
    if version != CHECKSUM_VERSION:
        raise InputError(
            f"{place(prim)}: its checksum is of version {version}, this magtwin knows 1 to "
            f"{CHECKSUM_VERSION}; read it with a later magtwin, or make the map anew"
        )
    return np.concatenate([np.ravel(np.array(get(prim, name), float)) for name in GRID])


def _read(prim: Usd.Prim, date: str = "") -> AnomalyMap:
    """The map of a prim as its stage shows it; `date` is that of its epoch, if that is known otherwise."""
    date = date or selected_epoch(prim)
    checksum = get(prim, "checksum")
    if is_tiled(prim):
        return read_tiled(prim)
    if not re.fullmatch("[0-9a-f]{64}", checksum):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'checksum')} must be a SHA-256, 64 digits 0-9a-f, "
            f"got {checksum[:MOST_CHARACTERS]!r}; make the map anew"
        )
    values, valid, variance = (np.array(get(prim, name)) for name in ("values", "valid", "variance"))
    harmonic = read_harmonic(prim)
    shape = tuple(get(prim, "shape"))
    if len(shape) != 3 or min(shape) < 1 or not values.size == valid.size == math.prod(shape):
        raise InputError(
            f"{place(prim)}: shape {list(shape)} does not fit {values.size} values and {valid.size} flags"
        )
    if variance.size not in (0, values.size, 3 * values.size):
        raise InputError(f"{place(prim)}: {values.size} values have {variance.size} variances")
    headings = np.array(get(prim, "headings"), float)
    if not (headings.size and np.all(np.diff(headings) > 0) and headings[0] >= 0 and headings[-1] < 360):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'headings')} must ascend in [0, 360) deg, got "
            f"{str(headings.tolist())[:MOST_CHARACTERS]}; make the map anew"
        )
    grid = _covered_grid(prim)
    if checksum != _checksum(values, valid, variance, harmonic, grid):
        also = "" if grid is None else ", which covers its grid too"
        text = f"the map's values do not match its checksum{also}; make the map anew"
        raise InputError(f"{place(prim)}: {text}")
    spreads = variance.reshape(-1, *shape).astype(float)  # of the nodes, and between them
    recorded = _read_recorded(prim, RECORDED[0], shape)
    if recorded is not None and not np.array_equal(recorded.ravel().astype("f4"), values, equal_nan=True):
        raise InputError(
            f"{place(prim)}: the map's values are not those that were recorded, in single precision; make "
            "the map anew"
        )
    try:
        field = AnomalyMap(
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
        day = day_of(field).isoformat() if date else ""
    except InputError as error:
        raise InputError(f"{place(prim)}: {f'epoch {date}: ' if date else ''}{error}") from error
    if day != date:
        raise InputError(
            f"{place(prim)}: its epoch {date} must be of that day, got "
            f"{attribute_name('anomalyMap', 'created')} {day}; make the map anew"
        )
    return field


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


def _save(maps: Sequence[AnomalyMap], path: str | os.PathLike[str], force: bool) -> None:
    """Write maps of one grid, earliest first: a single one, or several as epochs with the last selected."""
    if Path(path).suffix.lower() not in (".usdc", ".usd"):
        raise InputError(f"{path}: a map layer ends in .usdc or .usd")
    latest = maps[-1]
    samples = [_epoch_values(m) for m in maps]
    for name in (attribute_name("anomalyMap", field) for field in RECORDED):
        if all(sample[name] is None for sample in samples):
            samples = [{n: value for n, value in sample.items() if n != name} for sample in samples]
    about = f"Magnetic anomaly map {latest.name}: total field over x, y and heading. {latest.source}"
    with new_stage(path, about, force=force) as stage:
        prim = apply_api(UsdGeom.Xform.Define(stage, MAP).GetPrim(), "anomalyMap")
        if any(m.harmonic is not None for m in maps):
            apply_api(prim, "harmonic")
        shared, floor = shared_values(latest, latest.grid, CHECKSUM_VERSION), Floor.of(maps)
        if len(maps) == 1:
            set_values(prim, {**shared, **samples[0]})
            define_colours(define_heat_map(stage, floor), floor)
            return
        set_values(prim, shared)
        mesh = define_heat_map(stage, floor)
        for k, sample in enumerate(samples):
            with define_epoch(prim, day_of(maps[k]).isoformat()):
                set_values(prim, sample)
                define_colours(mesh, floor, k)


def _epoch_values(field: AnomalyMap) -> dict[str, Any]:
    """Values of the attributes that differ between epochs, by name; None if there is no value."""
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


def _checksum(
    values: NDArray,
    valid: NDArray,
    variance: NDArray,
    harmonic: Mapping[str, NDArray] | None,
    grid: NDArray | None,
) -> str:
    """SHA-256 over the bytes of the arrays: float32, one byte a flag, float64; little-endian."""
    digest = hashlib.sha256(values.astype("<f4").tobytes())
    digest.update(valid.astype(np.uint8).tobytes())
    digest.update(variance.astype("<f4").tobytes())
    for array in (*(harmonic or {}).values(), *([] if grid is None else [grid])):
        digest.update(array.astype("<f8").tobytes())
    return digest.hexdigest()
