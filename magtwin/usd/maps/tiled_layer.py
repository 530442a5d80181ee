"""Maps in tiles as USD layers: opened without their arrays, written tile by tile."""

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, Vt

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.field.maps.tiles import Tile, TiledMap, Tiling
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.outputs import output
from magtwin.usd.layers import WORLD, describe_stage
from magtwin.usd.maps.attributes import (
    GRID,
    PLACES,
    TEXTS,
    TILED_CHECKSUM_VERSION,
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
from magtwin.usd.maps.heat_map import MAP, Floor, define_colours, define_heat_map, nodes_shown
from magtwin.usd.maps.tiles import LayerTiles, tile_path, write_tiles
from magtwin.usd.schema import apply_api, attribute_name, place, value_of


def save_tiled_map(
    path: str | os.PathLike[str],
    grid: Grid,
    field_of: Callable[[slice, slice], Tile],
    *,
    tile_cells: int | None = None,
    force: bool = False,
    **about: Any,
) -> None:
    """Write a map of any size tile by tile, from a function that gives its arrays at some nodes.

    Args:
        path: File to make, .usdc or .usd.
        grid: The nodes.
        field_of: The arrays at some rows and columns of nodes, at every heading; it is called for one tile
            after another. Tiles share the nodes between them.
        tile_cells: Number of cells along x and y of a tile. None: chosen by size.
        force: Whether to replace an existing file.
        about: Other fields of AnomalyMap, such as `name` and `height_m`.

    Raises:
        InputError: As for `save_map`; or an array has another shape, or a value that no map may have.
    """
    tiling = Tiling(grid, tile_cells) if tile_cells else Tiling.of(grid)
    few: dict[str, Any] = {"origin_m": grid.origin_m, "cell_m": grid.cell_m, "headings_rad": [0.0]}
    known = AnomalyMap(values_nt=np.zeros((1, 2, 2)), **few, **about)  # checks what is told
    write_tiled(tiling, lambda tile: field_of(*tiling.nodes(tile)), known, path, force)


def is_tiled(prim: Usd.Prim) -> bool:
    """Whether a prim's map is stored in tiles."""
    return bool(prim.GetAttribute(attribute_name("anomalyMap", "tile_cells")).HasAuthoredValue())


def tile_faults(prim: Usd.Prim) -> Iterator[tuple[Sdf.Path, str]]:
    """What is wrong with the tiles of a map, and where; reads every tile in turn, and keeps none.

    Raises:
        InputError: As for `read_map`.
    """
    if not is_tiled(prim):
        return
    field = read_tiled(prim)
    for tile in range(len(field.tiling)):
        try:
            field.tile(tile)
        except InputError as error:
            path = tile_path(prim.GetPath(), field.tiling, tile)
            yield path, str(error).removeprefix(f"{field.tiles.place(tile)}: ")


def check_tiles(prim: Usd.Prim) -> None:
    """Refuse a map with a damaged tile; reads every tile in turn. A map without tiles passes.

    Raises:
        InputError: A tile is damaged; names its prim. Or as for `read_map`.
    """
    for path, text in tile_faults(prim):
        raise InputError(f"{place(prim.GetStage().GetPrimAtPath(path) or prim)}: {text}")


def _tree(prim: Usd.Prim) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Checksums and figures of a map's tiles, and the numbers of its grid with the cells of a tile."""
    version = get(prim, "checksumVersion")
    if version != TILED_CHECKSUM_VERSION:
        raise InputError(
            f"{place(prim)}: the checksum of a map in tiles is of version {TILED_CHECKSUM_VERSION}, this one "
            f"of {version}; read it with a later magtwin, or make the map anew"
        )
    grid = [np.ravel(np.array(get(prim, name), float)) for name in (*GRID, "tile_cells")]
    figures = np.array(get(prim, "tile_figures"), float).reshape(-1, 4)
    return list(get(prim, "tile_checksums")), figures, np.concatenate(grid)


def _tiled_checksum(
    checksums: Sequence[str],
    figures: NDArray[np.float64],
    grid: NDArray[np.float64],
    harmonic: Mapping[str, NDArray] | None,
) -> str:
    """SHA-256 over the checksums of a map's tiles, their figures and its grid."""
    digest = hashlib.sha256("".join(checksums).encode())
    for array in (figures, *(harmonic or {}).values(), grid):
        digest.update(array.astype("<f8").tobytes())
    return digest.hexdigest()


def tiled_checksums(prim: Usd.Prim) -> tuple[str, str]:
    """The stored and the computed checksum of a map in tiles: of its tiles' checksums, figures and grid."""
    return get(prim, "checksum"), _tiled_checksum(*_tree(prim), read_harmonic(prim))


def read_tiled(prim: Usd.Prim) -> TiledMap:
    """The map of a prim whose arrays are in tiles, none of which is read yet."""
    tree, harmonic = _tree(prim), read_harmonic(prim)
    if get(prim, "checksum") != _tiled_checksum(*tree, harmonic):
        raise InputError(
            f"{place(prim)}: the map's grid and the checksums of its tiles do not match its checksum; make "
            "the map anew"
        )
    shape, cells = tuple(get(prim, "shape")), get(prim, "tile_cells")
    degrees = np.array(get(prim, "headings"), float)
    try:
        if len(shape) != 3 or cells < 1 or shape[0] != degrees.size:
            raise InputError(
                f"shape {list(shape)} of {degrees.size} headings in tiles of {cells} cells; make the map anew"
            )
        grid = Grid(
            origin_m=tuple(get(prim, "origin")),
            cell_m=tuple(get(prim, "cellSize")),
            headings_rad=tuple(np.deg2rad(degrees).tolist()),
            rows=shape[1],
            columns=shape[2],
        )
        tiling, planes = Tiling(grid, cells), _planes(prim)
        return TiledMap(
            tiling,
            LayerTiles(prim, tiling, planes),
            *tree[:2],
            planes=planes,
            height_m=read_height(prim),
            parameters=read_parameters(get(prim, "parameters")),
            harmonic=None if harmonic is None else HarmonicField(**harmonic),
            made_from=read_made_from(prim),
            **{name: get(prim, name) for name in (*PLACES, *TEXTS)},
        )
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error


def _planes(prim: Usd.Prim) -> int:
    """Number of variances per node of a map in tiles, as its first tile has them."""
    tile = prim.GetStage().GetPrimAtPath(prim.GetPath().AppendPath("Tiles/tile_0_0"))
    values, variance = (
        value_of(tile.GetAttribute(attribute_name("mapTile", name))) if tile else None
        for name in ("values", "variance")
    )
    ratio = len(variance) / len(values) if values and variance is not None else -1
    if ratio not in (0, 1, 3):
        raise InputError(
            "its first tile has no values, or not 0, 1 or 3 variances a value; make the map anew"
        )
    return int(ratio)


def write_tiled(
    tiling: Tiling,
    tile_of: Callable[[int], Tile],
    field: AnomalyMap,
    path: str | os.PathLike[str],
    force: bool,
) -> None:
    """Write a map tile by tile; `field` tells what is no array."""
    if Path(path).suffix.lower() not in (".usdc", ".usd"):
        raise InputError(f"{path}: a map layer ends in .usdc or .usd")
    grid, count = tiling.grid, len(tiling)
    every, j, i = nodes_shown(grid)
    shown = np.zeros((len(grid.headings_rad), len(j), len(i)), np.float32)
    flags = np.zeros(shown.shape, bool)
    checksums, figures, planes = [""] * count, np.empty((count, 4)), set()
    about = f"Magnetic anomaly map {field.name}: total field over x, y and heading. {field.source}"

    def checked(tile: int) -> Tile:
        arrays = tile_of(tile)
        shape, spreads = tiling.tile_shape(tile), (arrays.variance_nt2, arrays.between_nt2)
        planes.add(tuple(part is not None for part in spreads))
        fits = [(2,), ()]
        if not (
            arrays.values_nt.shape == arrays.valid.shape == shape
            and len(planes) == 1
            and planes != {(False, True)}
            and all(p is None or p.shape == (*fits.pop(), *shape) for p in spreads)
        ):
            raise InputError(f"tile {tile} of map {field.name!r}: arrays must be of shape {shape}")
        arrays.check()
        return arrays

    with output(path, force=force) as aside:
        stage = Usd.Stage.CreateNew(str(aside))
        describe_stage(stage, about)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
        UsdGeom.Xform.Define(stage, MAP)
        stage.Save()
        del stage
        for tile, arrays in write_tiles(aside, MAP, tiling, checked):
            checksums[tile], figures[tile] = arrays.sha256, tiling.figures(tile, arrays)
            rows, columns = tiling.nodes(tile)
            to = [
                slice(*np.searchsorted(k, (at.start, at.stop)).tolist())
                for k, at in ((j, rows), (i, columns))
            ]
            at = np.ix_(np.arange(len(shown)), j[to[0]] - rows.start, i[to[1]] - columns.start)
            shown[:, to[0], to[1]], flags[:, to[0], to[1]] = arrays.values_nt[at], arrays.valid[at]
        stage = Usd.Stage.Open(str(aside))
        prim = apply_api(stage.GetPrimAtPath(MAP), "anomalyMap")
        harmonic = harmonic_arrays(field)
        if harmonic:
            apply_api(prim, "harmonic")
        numbers = np.concatenate([grid_numbers(grid), [tiling.cells]])
        tree = {
            "values": Vt.FloatArray(),
            "valid": Vt.BoolArray(),
            "variance": Vt.FloatArray(),
            "tile_cells": tiling.cells,
            "tile_checksums": Vt.StringArray(checksums),
            "tile_figures": Vt.Vec4dArray.FromNumpy(figures),
            "checksum": _tiled_checksum(checksums, figures, numbers, harmonic),
        }
        named = {attribute_name("anomalyMap", name): value for name, value in tree.items()}
        shared = shared_values(field, grid, TILED_CHECKSUM_VERSION)
        set_values(prim, {**shared, **named, **texts_of(field), **harmonic_values(harmonic)})
        floor = Floor(grid, every, j, i, [(shown, flags)], colour_limits(shown[flags].astype(float)))
        define_colours(define_heat_map(stage, floor), floor)
        stage.Save()
        del stage, prim
