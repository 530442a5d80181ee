"""TiledMap: an anomaly map too large for memory, whose arrays are read tile by tile when a lookup needs them.

A tile has the nodes of a square of cells at every heading. Neighbours share the nodes between them, so each
cell lies in one tile whole, and a lookup gives the same bytes as that of a map in memory.
"""

import hashlib
import math
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.days import check_texts
from magtwin.field.grid import MOST_NODES, Grid
from magtwin.field.maps.lookup import BLOCK, NONE, Block, Lookup, closed
from magtwin.field.maps.map import CONSTANT_NT, TEXTS, AnomalyMap, Known, amplitude, is_variance
from magtwin.report import Figure, Report

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

TILED_FROM = 8_000_000
"""Nodes over all headings from which on a map is stored in tiles: 32 MB of values."""

TILE_NODES = 150_000
"""Nodes of a tile that `Tiling.of` comes near to, over all headings: 0.6 MB of values."""

CACHE_BYTES = 256_000_000
"""Bytes of the tiles that a map keeps in memory, those used last."""

OVERVIEW_NODES = 2_000_000
"""Most nodes of an overview, over all headings."""

SAMPLES = 2_000_000
"""About how many nodes the medians of a tiled map are taken over."""


@dataclass(frozen=True, eq=False)
class Tile:
    """Arrays of a tile in single precision, each of shape (H, Y, X) over its nodes."""

    values_nt: Floats
    valid: NDArray[np.bool_]
    variance_nt2: Floats | None = None
    between_nt2: Floats | None = None  # Shape (2, H, Y, X)

    @property
    def variance(self) -> Floats:
        """The variances as a layer has them, flat: of the nodes, and between them; empty if unknown."""
        parts = [part for part in (self.variance_nt2, self.between_nt2) if part is not None]
        return np.concatenate([np.empty(0, np.float32), *(np.ravel(part) for part in parts)])

    @property
    def sha256(self) -> str:
        """SHA-256 of values, flags and variances: little-endian float32, one byte a flag."""
        digest = hashlib.sha256(np.ascontiguousarray(self.values_nt, "<f4").data)
        digest.update(np.ascontiguousarray(self.valid, np.uint8).data)
        digest.update(np.ascontiguousarray(self.variance, "<f4").data)
        return digest.hexdigest()

    def check(self) -> None:
        """Refuse values that no map may have; errors as for `AnomalyMap`."""
        if not np.all(np.isfinite(self.values_nt) | ~self.valid):
            raise InputError("its values must be finite at valid nodes; mask the others in `valid`")
        for part in (self.variance_nt2, self.between_nt2):
            if part is not None and not np.all(is_variance(part) | ~self.valid):
                raise InputError("its variances must not be below 0, nor nan or infinite, at valid nodes")


@dataclass(frozen=True, eq=False)
class Tiling:
    """How a grid is cut into tiles: squares of `cells` x `cells` cells, smaller at the greatest x and y."""

    grid: Grid
    cells: int

    @classmethod
    def of(cls, grid: Grid) -> "Tiling":
        """The tiling of a grid for new maps: a power of two of cells, at least 8."""
        side = math.sqrt(TILE_NODES / len(grid.headings_rad))
        return cls(grid, max(8, 2 ** round(math.log2(side))))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of tiles along y and along x."""
        return -(-(self.grid.rows - 1) // self.cells), -(-(self.grid.columns - 1) // self.cells)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def nodes(self, tile: int) -> tuple[slice, slice]:
        """Rows and columns of the nodes of a tile; tiles are numbered row by row."""
        j, i = np.multiply(divmod(tile, self.shape[1]), self.cells).tolist()
        rows = slice(j, min(j + self.cells + 1, self.grid.rows))
        return rows, slice(i, min(i + self.cells + 1, self.grid.columns))

    def own(self, tile: int) -> tuple[slice, slice]:
        """Rows and columns within a tile of the nodes that no later tile has: each node is of one tile."""
        rows, columns = self.nodes(tile)
        return tuple(
            slice(0, at.stop - at.start - (at.stop < end))
            for at, end in ((rows, self.grid.rows), (columns, self.grid.columns))
        )  # type: ignore[return-value]

    def tile_shape(self, tile: int) -> tuple[int, int, int]:
        """Headings, rows and columns of the nodes of a tile."""
        rows, columns = self.nodes(tile)
        return len(self.grid.headings_rad), rows.stop - rows.start, columns.stop - columns.start

    def figures(self, tile: int, arrays: Tile) -> tuple[float, float, float, float]:
        """Number, least, greatest and sum of the valid values at a tile's own nodes; nan if there is none.

        The sum goes node by node, so that every machine has the same.
        """
        own = (slice(None), *self.own(tile))
        known = arrays.values_nt[own][arrays.valid[own]]
        if not known.size:
            return 0.0, math.nan, math.nan, 0.0
        return (
            float(known.size),
            float(known.min()),
            float(known.max()),
            float(np.cumsum(known, dtype=float)[-1]),
        )


class Tiles(Protocol):
    """Where a map's tiles are stored. It can be pickled."""

    def read(self, tile: int) -> Tile:
        """The arrays of a tile, unchecked.

        Raises:
            InputError: The tile is missing or of another shape; names its place.
        """
        ...

    def place(self, tile: int) -> str:
        """File and name of a tile, for error messages."""
        ...


class TiledMap(AnomalyMap):
    """An AnomalyMap in tiles. Lookups read the tiles that they touch, and keep those used last.

    A tile is checked against its checksum when it is read. `values_nt` and the other arrays are those of
    `whole`, which reads every tile. `dataclasses.replace` gives a map in memory.
    """

    def __new__(cls, *_: Any, **given: Any) -> Any:
        """A map in memory instead, if its arrays are given."""
        if "values_nt" in given:  # from dataclasses.replace
            return AnomalyMap(**given)
        return super().__new__(cls)

    def __init__(
        self,
        tiling: Tiling,
        tiles: Tiles,
        checksums: Sequence[str],
        figures: Array,
        *,
        planes: int,
        **about: Any,
    ) -> None:
        """A map whose tiles are read when needed.

        Args:
            tiling: How the grid is cut.
            tiles: Where the tiles are.
            checksums: `Tile.sha256` of each tile.
            figures: `Tiling.figures` of each tile, shape (T, 4).
            planes: Number of variances per node: 0, 1 (that of the nodes) or 3 (with `between_nt2`).
            about: Fields of AnomalyMap that are no arrays.

        Raises:
            InputError: A figure is out of range.
        """
        grid = tiling.grid
        known: dict[str, Any] = {f.name: f.default for f in fields(AnomalyMap) if f.name not in _ARRAYS}
        known |= {"parameters": {}} | about
        known |= {"origin_m": grid.origin_m, "cell_m": grid.cell_m}
        known |= {"headings_rad": np.array(grid.headings_rad), "tiling": tiling, "tiles": tiles}
        known |= {"checksums": tuple(checksums), "figures": np.array(figures, float), "planes": planes}
        for name, value in known.items():
            object.__setattr__(self, name, value)
        self.headings_rad.flags.writeable = False
        check_texts(self, TEXTS)
        if len(self.checksums) != len(tiling) or self.figures.shape != (len(tiling), 4):
            raise InputError(
                f"a map of {len(tiling)} tiles has {len(self.checksums)} checksums and figures of shape "
                f"{self.figures.shape}"
            )
        object.__setattr__(self, "opened", set())

    tiling: Tiling
    tiles: Tiles
    checksums: tuple[str, ...]
    figures: Array
    planes: int
    opened: set[int]  # Numbers of the tiles that were read so far

    def __getstate__(self) -> dict[str, Any]:
        lazy = (*_ARRAYS, "_lookup", "_whole", "_overview")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    def __eq__(self, other: object) -> bool:
        if isinstance(other, TiledMap) and self.checksums == other.checksums:
            names = {f.name for f in fields(self)} - set(_ARRAYS) - {"headings_rad"}
            same = all(getattr(self, name) == getattr(other, name) for name in names)
            return same and self.grid == other.grid and self.tiling.cells == other.tiling.cells
        return super().__eq__(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def grid(self) -> Grid:  # type: ignore[override]
        """The nodes."""
        return self.tiling.grid

    @property
    def has_variance(self) -> bool:
        """Whether the variance of the values is known."""
        return self.planes > 0

    def tile(self, tile: int) -> Tile:
        """The arrays of a tile, read and checked.

        Raises:
            InputError: It is missing, or does not match its checksum; names its place.
        """
        arrays = self.tiles.read(tile)
        if arrays.sha256 != self.checksums[tile]:
            raise InputError(
                f"{self.tiles.place(tile)}: the tile's values do not match its checksum; make the map anew"
            )
        try:
            arrays.check()
        except InputError as error:
            raise InputError(f"{self.tiles.place(tile)}: {error}") from error
        if not np.array_equal(self.tiling.figures(tile, arrays), self.figures[tile], equal_nan=True):
            raise InputError(
                f"{self.tiles.place(tile)}: the tile's values are not those that the map's figures tell; "
                "make the map anew"
            )
        self.opened.add(tile)
        return arrays

    def each_tile(self) -> Iterator[tuple[int, Tile]]:
        """Every tile with its number, one after another; errors as for `tile`."""
        return ((tile, self.tile(tile)) for tile in range(len(self.tiling)))

    def whole(self) -> AnomalyMap:
        """The map with all its arrays in memory, in double precision.

        Raises:
            InputError: The map is too large for that; or as for `tile`.
        """
        return self._whole

    @cached_property
    def _whole(self) -> AnomalyMap:
        headings, rows, columns = self.grid.shape
        if headings * rows * columns > MOST_NODES:
            gigabytes = (9 + 8 * self.planes) * headings * rows * columns / 1e9
            raise InputError(
                f"map {self.name!r} has {rows} x {columns} nodes in {headings} headings, "
                f"{gigabytes:.1f} GB at once, and this needs all of them; only maps up to {MOST_NODES:,} "
                "nodes are read whole: in Python, take a part of it (`map.part`)"
            )
        return self._joined(slice(0, rows), slice(0, columns))

    def part(self, x_m: tuple[float, float], y_m: tuple[float, float]) -> AnomalyMap:
        """The nodes in a rectangle as a map in memory. It reads the tiles that it touches.

        Args:
            x_m: Least and greatest x in world [m].
            y_m: Least and greatest y in world [m].

        Raises:
            InputError: There are less than 2 x 2 nodes in it, or too many for memory; or as for `tile`.
        """
        grid = self.grid
        kept = []
        for at, (low, high) in ((grid.y_m, y_m), (grid.x_m, x_m)):
            kept.append(slice(*np.searchsorted(at, (low - 1e-9, high + 1e-9)).tolist()))
        sides = [each.stop - each.start for each in kept]
        if min(sides) < 2:
            raise InputError(
                f"a part of map {self.name!r} needs 2 x 2 nodes at least, got {sides[0]} x {sides[1]}"
            )
        if math.prod(sides) * len(grid.headings_rad) > MOST_NODES:
            raise InputError(
                f"a part of {sides[0]} x {sides[1]} nodes in {len(grid.headings_rad)} headings is beyond "
                f"{MOST_NODES:,} nodes; take a smaller one"
            )
        return self._joined(*kept)

    def overview(self) -> AnomalyMap:
        """Every few nodes as a map in memory, for pictures; the last rows and columns can be left out."""
        return self._overview

    @cached_property
    def _overview(self) -> AnomalyMap:
        headings, rows, columns = self.grid.shape
        every = max(1, math.ceil(math.sqrt(headings * rows * columns / OVERVIEW_NODES)))
        return self._joined(slice(0, rows, every), slice(0, columns, every))

    def _joined(self, rows: slice, columns: slice) -> AnomalyMap:
        """The nodes at some rows and columns as a map in memory."""
        every = rows.step or 1
        j, i = (np.arange(at.start, at.stop, every) for at in (rows, columns))
        shape = (len(self.headings_rad), len(j), len(i))
        values, valid = np.empty(shape), np.empty(shape, bool)
        spreads = np.empty((self.planes, *shape))
        for tile in range(len(self.tiling)):
            down, along = self.tiling.nodes(tile)
            to = [
                slice(*np.searchsorted(nodes, (at.start, at.stop)).tolist())
                for nodes, at in ((j, down), (i, along))
            ]
            if any(each.start == each.stop for each in to):
                continue
            arrays = self.tile(tile)
            at = np.ix_(np.arange(shape[0]), j[to[0]] - down.start, i[to[1]] - along.start)
            here = (slice(None), *to)
            values[here], valid[here] = arrays.values_nt[at], arrays.valid[at]
            for plane, part in zip(spreads, _planes(arrays), strict=True):
                plane[here] = part[at]
        about = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        dx, dy = self.cell_m
        about["origin_m"] = (
            self.origin_m[0] + columns.start * dx,
            self.origin_m[1] + rows.start * dy,
        )
        about["cell_m"] = (every * dx, every * dy)
        if every > 1:
            about["name"] = f"{self.name}, every {every}th node"
        return AnomalyMap(
            **about,
            values_nt=values,
            valid=valid,
            variance_nt2=spreads[0] if self.planes else None,
            between_nt2=spreads[1:] if self.planes > 1 else None,
        )

    values_nt = property(lambda self: self._whole.values_nt)  # type: ignore[assignment]
    valid = property(lambda self: self._whole.valid)  # type: ignore[assignment]
    variance_nt2 = property(lambda self: self._whole.variance_nt2 if self.planes else None)  # type: ignore[assignment]
    between_nt2 = property(lambda self: self._whole.between_nt2 if self.planes > 1 else None)  # type: ignore[assignment]
    recorded_yaw = None

    @cached_property
    def known(self) -> Known:
        """The values of the valid nodes in short."""
        count = self.figures[:, 0]
        nodes = int(count.sum())
        if not nodes:
            return Known(0, math.nan, math.nan, math.nan)
        least, greatest = float(np.nanmin(self.figures[:, 1])), float(np.nanmax(self.figures[:, 2]))
        return Known(nodes, least, greatest, math.fsum(self.figures[:, 3]) / nodes)

    @property
    def mean_nt(self) -> float:  # type: ignore[override]
        """Mean of the valid values [nT]."""
        return self.known.mean_nt

    @cached_property
    def turns(self) -> bool:
        """Whether the values depend on the heading by more than 1 pT at any node."""
        if len(self.headings_rad) == 1:
            return False
        for _, arrays in self.each_tile():
            values = np.where(arrays.valid, arrays.values_nt, np.nan).astype(float)
            if np.any(np.abs(values - values[:1]) > CONSTANT_NT):
                return True
        return False

    def tables(self) -> tuple[Array, Array]:
        """As `AnomalyMap.tables`, of the whole map."""
        return self._whole.tables()

    @cached_property
    def _lookup(self) -> "TiledLookup":  # type: ignore[override]
        return TiledLookup(self)

    @property
    def _spreads(self) -> Array:  # type: ignore[override]
        """Something of the number of variances per node: a lookup takes them from the tiles."""
        if not self.planes:
            return super()._spreads  # type: ignore[misc, no-any-return]  # refuses
        return np.empty(self.planes)

    def _error_in_short(self) -> list[str]:
        return [f"{len(self.tiling):,} tiles, read when needed"]

    @cached_property
    def sums(self) -> "Sums":
        """Statistics of the whole map, from every tile in turn."""
        return Sums.of(self)

    def report(self) -> Report:
        """As `AnomalyMap.report`, from every tile in turn; gradients are those of every few nodes."""
        sums, slope = self.sums, self.sums.slopes_nt_m / 1000
        headings, rows, columns = self.grid.shape
        figures = [
            Figure("headings", headings),
            Figure("nodes", rows * columns, note=f"a heading; {len(self.tiling):,} tiles"),
            Figure("masked nodes", headings * rows * columns - self.known.nodes, note="over all headings"),
        ]
        if self.known.nodes:
            mean, sd = sums.over_all()
            figures += [
                Figure("mean", round(mean, 1), "nT", spread=round(sd, 1)),
                Figure("least", round(self.known.least_nt, 1), "nT"),
                Figure("greatest", round(self.known.greatest_nt, 1), "nT"),
            ]
        if slope.size:
            note = f"of every {sums.every}th node along x and y" if sums.every > 1 else ""
            sizes = {"median": np.median(slope), "mean": slope.mean(), "greatest": slope.max()}
            figures += [
                Figure(f"{k} gradient", round(float(v), 3), "uT/m", note=note) for k, v in sizes.items()
            ]
        if headings >= 3 and sums.everywhere:
            figures.append(amplitude(sums.means_everywhere, self.headings_rad))
        return Report(f"map {self.name}", tuple(figures), {"method": self.method, "licence": self.licence})


_ARRAYS = ("values_nt", "valid", "variance_nt2", "between_nt2", "recorded_yaw")


def _planes(arrays: Tile) -> list[Floats]:
    parts = [] if arrays.variance_nt2 is None else [arrays.variance_nt2]
    return [*parts, *([] if arrays.between_nt2 is None else arrays.between_nt2)]


@dataclass(frozen=True, eq=False)
class Sums:
    """Statistics of a map in tiles; arrays over the headings have shape (H,)."""

    nodes: int  # Nodes of a heading
    count: Array  # Valid nodes of each heading
    mean: Array  # Their mean [nT]
    square: Array  # Sum of the squares of their differences from it [nT^2]
    least: Array
    greatest: Array
    everywhere: int  # Nodes valid at all headings
    means_everywhere: Array  # Mean of each heading over those [nT]
    every: int  # Step along x and y between the nodes of the samples
    slopes_nt_m: Array  # Gradient along the floor at the samples [nT/m]
    variances_nt2: Array  # Variance at the samples

    @classmethod
    def of(cls, field: TiledMap) -> "Sums":
        """The statistics of a map; reads every tile once."""
        tiling, (headings, rows, columns) = field.tiling, field.grid.shape
        every = max(1, math.ceil(math.sqrt(headings * rows * columns / SAMPLES)))
        dx, dy = field.cell_m
        count, mean, square, total = np.zeros((4, headings))
        least, greatest = np.full(headings, math.nan), np.full(headings, math.nan)
        everywhere, slopes, variances = 0, [], []
        for tile, arrays in field.each_tile():
            own = (slice(None), *tiling.own(tile))
            known = np.where(arrays.valid, arrays.values_nt, np.nan).astype(float)
            values, valid = known[own], arrays.valid[own]
            n = np.count_nonzero(valid, axis=(1, 2))
            some = n > 0
            here = np.zeros(headings)
            here[some] = np.nansum(values[some], axis=(1, 2)) / n[some]
            off = values - here[:, None, None]
            both = np.maximum(count + n, 1)
            square += np.nansum(off * off, axis=(1, 2)) + (here - mean) ** 2 * count * n / both
            mean += (here - mean) * n / both
            count += n
            least[some] = np.fmin(least[some], np.nanmin(values[some], axis=(1, 2)))
            greatest[some] = np.fmax(greatest[some], np.nanmax(values[some], axis=(1, 2)))
            all_valid = valid.all(axis=0)
            everywhere += int(np.count_nonzero(all_valid))
            total += values[:, all_valid].sum(axis=1)
            along_y = (known[:, 2::, 1:-1] - known[:, :-2, 1:-1])[:, ::every, ::every] / (2 * dy)
            along_x = (known[:, 1:-1, 2:] - known[:, 1:-1, :-2])[:, ::every, ::every] / (2 * dx)
            slope = np.hypot(along_x, along_y)
            slopes.append(slope[np.isfinite(slope)])
            if arrays.variance_nt2 is not None:
                thin = (*own[:1], *(slice(at.start, at.stop, every) for at in own[1:]))
                variances.append(arrays.variance_nt2[thin][arrays.valid[thin]].astype(float))
        return cls(
            nodes=rows * columns,
            count=count,
            mean=mean,
            square=square,
            least=least,
            greatest=greatest,
            everywhere=everywhere,
            means_everywhere=total / max(everywhere, 1),
            every=every,
            slopes_nt_m=np.concatenate(slopes),
            variances_nt2=np.concatenate([np.empty(0), *variances]),
        )

    def over_all(self) -> tuple[float, float]:
        """Mean and standard deviation over all headings [nT]."""
        mean = float(self.count @ self.mean / self.count.sum())
        square = float((self.square + self.count * (self.mean - mean) ** 2).sum())
        return mean, math.sqrt(square / float(self.count.sum()))


class TiledLookup(Lookup):
    """`Lookup` in the tiles of a map: the same operations in the same order, so the same bytes."""

    def __init__(self, field: TiledMap) -> None:
        grid = field.grid
        self.field = field
        self._lay_axes(*grid.shape, grid.origin_m, grid.cell_m, field.headings_rad)
        self._blocks: OrderedDict[int, Block] = OrderedDict()
        self._lock = threading.Lock()
        bytes_each = 4 * math.prod(field.tiling.tile_shape(0)) * (2 + field.planes)
        self._most = max(4, CACHE_BYTES // bytes_each)

    def lookup(
        self, p: Array, yaw: Array, *, clamp: bool, gradient: bool, spreads: Array = NONE
    ) -> tuple[Array, Array, Array]:
        """As `Lookup.lookup`; of `spreads` only the number of variances counts."""
        out, slopes = np.full(len(p), np.nan), np.full((len(p) if gradient else 0, 3), np.nan)
        sds = np.full(len(p) if len(spreads) else 0, np.nan)
        (i, j), _, _, unknown = self._cells(p, clamp)
        tiling = self.field.tiling
        at = (j // tiling.cells) * tiling.shape[1] + i // tiling.cells
        known = np.flatnonzero(~unknown & np.isfinite(yaw))
        known = known[np.argsort(at[known], kind="stable")]
        ends = np.flatnonzero(np.diff(at[known])) + 1
        for rows in np.split(known, ends) if len(known) else []:
            block = self._block_of(int(at[rows[0]]))
            for start in range(0, len(rows), BLOCK):
                some = rows[start : start + BLOCK]
                b, g = np.empty(len(some)), np.empty((len(some) if gradient else 0, 3))
                sd = np.empty(len(some) if len(sds) else 0)
                self._by_numpy(block, p[some], yaw[some], clamp, b, g, sd)
                out[some] = b
                if gradient:
                    slopes[some] = g
                if len(sds):
                    sds[some] = sd
        sds[np.isnan(out[: len(sds)])] = np.nan
        return out, slopes, sds

    def at(self, x: float, y: float, yaw: float, *, clamp: bool = False) -> float:
        """Field at one pose [nT], as `lookup` gives it."""
        return float(self.lookup(np.array([[x, y]]), np.array([yaw]), clamp=clamp, gradient=False)[0][0])

    def at_with_gradient(
        self, x: float, y: float, yaw: float, *, clamp: bool = False
    ) -> tuple[float, float, float, float]:
        """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad], as `lookup` gives them."""
        b, g, _ = self.lookup(np.array([[x, y]]), np.array([yaw]), clamp=clamp, gradient=True)
        return (float(b[0]), *map(float, g[0]))  # type: ignore[return-value]

    def _block_of(self, tile: int) -> Block:
        """A tile laid out for lookup, from memory if it is one of those used last."""
        with self._lock:
            if tile in self._blocks:
                self._blocks.move_to_end(tile)
                return self._blocks[tile]
        arrays = self.field.tile(tile)
        values, holes = arrays.values_nt, None
        if not arrays.valid.all():
            values, holes = np.where(arrays.valid, values, np.float32(0)), closed(~arrays.valid)
        spreads = [closed(np.where(arrays.valid, part, np.float32(0))) for part in _planes(arrays)]
        rows, columns = self.field.tiling.nodes(tile)
        shape = self.field.tiling.tile_shape(tile)
        block = Block(closed(values), holes, tuple(spreads), rows.start, columns.start, *shape[1:])
        with self._lock:
            self._blocks[tile] = block
            while len(self._blocks) > self._most:
                self._blocks.popitem(last=False)
        return block
