"""Grid: the nodes over x, y and heading of gridded surveys and of maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.report.summary import Summarized, Summary, listed, rectangle

Array = NDArray[np.float64]

TURN = 2 * np.pi

FARTHEST_M = 1e8  # Largest coordinate accepted [m]: twice round the Earth

NARROWEST_M = 1e-6  # Smallest cell [m], which two nodes still have between them at `FARTHEST_M`

MOST_NODES = 50_000_000  # Larger grids (0.4 GB of values) are refused: the spacing is probably a typo


@dataclass(frozen=True, kw_only=True, repr=False)
class Grid(Summarized):
    """Evenly spaced nodes over a floor, at one or more headings.

    Node (h, j, i) is at x = origin_m[0] + i cell_m[0], y = origin_m[1] + j cell_m[1] in world, at heading
    headings_rad[h].
    """

    origin_m: tuple[float, float]  # World x and y of node [0, 0] [m]
    cell_m: tuple[float, float]  # Distance between nodes along x and y [m]
    headings_rad: tuple[float, ...]  # Headings [rad], ascending in [0, 2 pi)
    rows: int  # Number of nodes along y
    columns: int  # Number of nodes along x

    def __post_init__(self) -> None:
        headings = np.asarray(self.headings_rad, float)
        check_axes(self)
        if self.rows < 2 or self.columns < 2:
            raise InputError(f"a Grid needs 2 x 2 nodes at least, got {self.rows} x {self.columns}")
        object.__setattr__(self, "headings_rad", tuple(headings.tolist()))

    @classmethod
    def over(cls, extent: ArrayLike, spacing_m: float, headings_rad: ArrayLike) -> "Grid":
        """A grid of a given spacing, centred in a rectangle and within it.

        The rectangle is least x, greatest x, least y, greatest y [m]; headings [rad] ascend in [0, 2 pi).
        """
        x0, x1, y0, y1 = (float(v) for v in np.asarray(extent, float))
        if not (np.isfinite(spacing_m) and spacing_m > 0):
            raise InputError(f"spacing_m must be above 0 m, got {spacing_m!r}")
        if spacing_m < NARROWEST_M:
            raise InputError(f"spacing_m {spacing_m:g} is below {NARROWEST_M:g} m; widen `spacing_m`")
        columns, rows = (int(np.floor(length / spacing_m + 1e-9)) + 1 for length in (x1 - x0, y1 - y0))
        if min(columns, rows) < 2:
            raise InputError(f"spacing_m {spacing_m:g} leaves no cell on {x1 - x0:g} x {y1 - y0:g} m")
        return cls(
            origin_m=(
                (x0 + x1) / 2 - (columns - 1) * spacing_m / 2,
                (y0 + y1) / 2 - (rows - 1) * spacing_m / 2,
            ),
            cell_m=(spacing_m, spacing_m),
            headings_rad=tuple(np.asarray(headings_rad, float).ravel().tolist()),
            rows=rows,
            columns=columns,
        ).in_memory()

    @classmethod
    def filling(cls, extent: ArrayLike, widest_m: float, headings_rad: ArrayLike) -> "Grid":
        """A grid with nodes on the borders of a rectangle, and cells as wide as possible up to `widest_m`."""
        x0, x1, y0, y1 = (float(v) for v in np.asarray(extent, float))
        across, along = (max(1, int(np.ceil(length / widest_m - 1e-9))) for length in (x1 - x0, y1 - y0))
        return cls(
            origin_m=(x0, y0),
            cell_m=((x1 - x0) / across, (y1 - y0) / along),
            headings_rad=tuple(np.asarray(headings_rad, float).ravel().tolist()),
            rows=along + 1,
            columns=across + 1,
        ).in_memory()

    def in_memory(self) -> "Grid":
        """The grid, if arrays over all its nodes fit in memory."""
        headings, rows, columns = self.shape
        if headings * rows * columns > MOST_NODES:
            raise InputError(
                f"a grid of {float(rows):g} x {float(columns):g} nodes in {headings} headings is beyond "
                f"{MOST_NODES:,} nodes; widen `spacing_m`"
            )
        return self

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of headings, rows (y) and columns (x)."""
        return len(self.headings_rad), self.rows, self.columns

    @property
    def x_m(self) -> Array:
        """World x of the columns [m], shape (X,)."""
        return np.asarray(self.origin_m[0] + self.cell_m[0] * np.arange(self.columns))

    @property
    def y_m(self) -> Array:
        """World y of the rows [m], shape (Y,)."""
        return np.asarray(self.origin_m[1] + self.cell_m[1] * np.arange(self.rows))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least x, greatest x, least y, greatest y of the nodes, in world [m]."""
        (x, y), (dx, dy) = self.origin_m, self.cell_m
        return x, x + dx * (self.columns - 1), y, y + dy * (self.rows - 1)

    def poses(self) -> tuple[Array, Array]:
        """World x and y of every node [m], shape (H, Y, X, 2), and its heading [rad], shape (H, Y, X)."""
        self.in_memory()
        yaw, y, x = np.meshgrid(np.asarray(self.headings_rad), self.y_m, self.x_m, indexing="ij")
        return np.stack([x, y], axis=-1), yaw

    def _summary(self) -> Summary:
        headings, rows, columns = self.shape
        return Summary(
            f"Grid: {columns} x {rows} nodes, {self.cell_m[0]:.3g} x {self.cell_m[1]:.3g} m apart, "
            f"{headings} headings",
            (
                ("over", rectangle(*self.extent)),
                ("headings", listed([f"{d:.4g}" for d in np.degrees(self.headings_rad)]) + " deg"),
            ),
        )


def check_axes(grid: Any) -> None:
    """Check `headings_rad` of a grid or a map, and make `origin_m` and `cell_m` pairs of floats."""
    kind, headings = type(grid).__name__, np.asarray(grid.headings_rad, float)
    ascend = headings.ndim == 1 and headings.size and np.all(np.diff(headings) > 0)
    if not (ascend and headings[0] >= 0 and headings[-1] < TURN):
        raise InputError(f"headings_rad of {kind} must ascend in [0, 2 pi), got {headings.tolist()}")
    for name in ("origin_m", "cell_m"):
        pair = tuple(float(v) for v in getattr(grid, name))
        if len(pair) != 2 or not np.all(np.isfinite(pair)) or (name == "cell_m" and min(pair) <= 0):
            above = " above 0" if name == "cell_m" else ""
            raise InputError(f"{name} of {kind} must be two lengths{above} [m], got {pair}")
        least, most = (NARROWEST_M, FARTHEST_M) if name == "cell_m" else (-FARTHEST_M, FARTHEST_M)
        if min(pair) < least or max(pair) > most:
            raise InputError(f"{name} of {kind} must be from {least:g} to {most:g} m, got {pair}")
        object.__setattr__(grid, name, pair)
