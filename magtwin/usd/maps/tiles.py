"""Tiles of a large map in its layer: one prim with arrays each, read when asked for and written in turn."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, Vt

from magtwin.errors import InputError
from magtwin.field.maps.tiles import Tile, Tiling
from magtwin.usd.layers import check_stage
from magtwin.usd.schema import NOUNS, attribute_name, place, value_of

TILES = "Tiles"
"""Name of the prim of the tiles, below that of the map."""

WRITTEN_BYTES = 64_000_000
"""Bytes of tiles that wait in memory until they are written."""

ARRAYS = {name: attribute_name("mapTile", name) for name in ("values", "valid", "variance")}


def tile_path(map_prim: Sdf.Path, tiling: Tiling, tile: int) -> Sdf.Path:
    """Path of a tile's prim."""
    row, column = divmod(tile, tiling.shape[1])
    return map_prim.AppendChild(TILES).AppendChild(f"tile_{row}_{column}")


class LayerTiles:
    """The tiles below a map's prim. USD maps their arrays from the file when they are asked for."""

    def __init__(self, prim: Usd.Prim, tiling: Tiling, planes: int) -> None:
        self.stage, self.path, self.tiling, self.planes = prim.GetStage(), prim.GetPath(), tiling, planes
        # the layer that has the tiles, for another process
        spec = prim.GetAttribute(attribute_name("anomalyMap", "tile_cells")).GetPropertyStack()[0]
        self.layer, self.layer_path = spec.layer.realPath, spec.path.GetPrimPath()

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened, (self.layer, str(self.layer_path), self.tiling, self.planes)

    def read(self, tile: int) -> Tile:
        """The arrays of a tile, unchecked.

        Raises:
            InputError: The tile is missing or of another shape; names its prim.
        """
        prim = self.stage.GetPrimAtPath(tile_path(self.path, self.tiling, tile))
        if not prim:
            raise InputError(f"{self.place(tile)}: the map's tile is missing; make the map anew")
        arrays = {}
        for name, attribute in ARRAYS.items():
            value = value_of(prim.GetAttribute(attribute))
            kind = Vt.BoolArray if name == "valid" else Vt.FloatArray
            if not isinstance(value, kind):
                raise InputError(f"{place(prim)}: {attribute} must be a {kind.__name__}; make the map anew")
            arrays[name] = np.asarray(value)
        shape = self.tiling.tile_shape(tile)
        nodes = int(np.prod(shape))
        counts = tuple(array.size for array in arrays.values())
        if counts != (nodes, nodes, self.planes * nodes):
            raise InputError(
                f"{place(prim)}: {counts[0]} values, {counts[1]} flags and {counts[2]} variances do not fit "
                f"a tile of {nodes} nodes; make the map anew"
            )
        spreads = arrays["variance"].reshape(self.planes, *shape)
        return Tile(
            arrays["values"].reshape(shape),
            arrays["valid"].reshape(shape),
            spreads[0] if self.planes else None,
            spreads[1:] if self.planes > 1 else None,
        )

    def place(self, tile: int) -> str:
        """File and prim of a tile, for error messages."""
        layer = self.stage.GetRootLayer()
        return f"{layer.realPath or layer.identifier} <{tile_path(self.path, self.tiling, tile)}>"


def _reopened(file: str, path: str, tiling: Tiling, planes: int) -> LayerTiles:
    stage = Usd.Stage.Open(
        str(check_stage(file, own=True))
    )  # held in a name: a prim does not keep its stage alive
    return LayerTiles(stage.GetPrimAtPath(path), tiling, planes)


def write_tiles(
    file: Path, map_prim: Sdf.Path, tiling: Tiling, tile_of: Callable[[int], Tile]
) -> Iterator[tuple[int, Tile]]:
    """Add tiles to a map's layer on disk, some at a time, so that few are in memory.

    Args:
        file: The layer, which no one else has open.
        map_prim: Path of the map's prim.
        tiling: How the grid is cut.
        tile_of: The arrays of a tile by its number.

    Yields:
        Each tile, by its number, before it is written.
    """
    tile, count = 0, len(tiling)
    while tile < count:
        layer, waiting = Sdf.Layer.FindOrOpen(str(file)), 0
        with Sdf.ChangeBlock():
            if tile == 0:
                _define(layer, map_prim.AppendChild(TILES))
            while tile < count and waiting < WRITTEN_BYTES:
                arrays = tile_of(tile)
                yield tile, arrays
                waiting += _write(layer, tile_path(map_prim, tiling, tile), arrays)
                tile += 1
        layer.Save()
        del layer  # closed, it forgets the arrays that it has written


def _define(layer: Sdf.Layer, path: Sdf.Path) -> Sdf.PrimSpec:
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier, prim.typeName = Sdf.SpecifierDef, "Xform"
    return prim


def _write(layer: Sdf.Layer, path: Sdf.Path, arrays: Tile) -> int:
    """Author a tile; returns its bytes."""
    prim = _define(layer, path)
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=[NOUNS["mapTile"]]))
    given: dict[str, NDArray] = {
        "values": np.ascontiguousarray(arrays.values_nt, np.float32).ravel(),
        "valid": np.ascontiguousarray(arrays.valid, bool).ravel(),
        "variance": arrays.variance.astype(np.float32, copy=False),
    }
    for name, array in given.items():
        flags = name == "valid"
        kind = Sdf.ValueTypeNames.BoolArray if flags else Sdf.ValueTypeNames.FloatArray
        attribute = Sdf.AttributeSpec(prim, ARRAYS[name], kind)
        attribute.default = (Vt.BoolArray if flags else Vt.FloatArray).FromNumpy(array)
    return sum(array.nbytes for array in given.values())
