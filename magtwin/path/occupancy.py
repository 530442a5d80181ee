"""OccupancyGrid: a lab for navigation programs, in cells that are free, occupied or unknown."""

import math
import os
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.outputs import check_free, output, transaction
from magtwin.path.room import Room
from magtwin.report.summary import Summarized, Summary
from magtwin.spec.obstacles import Obstacles

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, those of nav_msgs/OccupancyGrid."""

RESOLUTION_M = 0.05
"""Default side of a cell [m]."""

FEW_CELLS = 1_000_000
"""Number of cells above which the default side is doubled."""

MOST_CELLS = 16_000_000
"""Largest number of cells."""

PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""Grey of each value in the picture of nav2's map_server, with the thresholds that `save` writes."""


@dataclass(frozen=True, eq=False, repr=False)
class OccupancyGrid(Summarized):
    """Cells of a lab. The lower left corner of `cells[j, i]` is at origin + (i, j) * resolution."""

    cells: NDArray[np.int8]
    """Values of the cells, shape (Y, X); rows ascend in y."""

    resolution_m: float
    """Side of a cell [m]."""

    origin_m: tuple[float, float]
    """World x and y of the lower left corner of `cells[0, 0]` [m]."""

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> tuple[FilePath, FilePath]:
        """Write it for nav2's map_server: a YAML file, and the picture that it names (.pgm) beside it.

        Args:
            path: The YAML file.
            force: Whether to replace existing files.

        Returns:
            The YAML file and the picture.

        Raises:
            InputError: The suffix is not .yaml, or a file exists and `force` is False.
        """
        file = FilePath(path)
        if file.suffix.lower() != ".yaml":
            raise InputError(f"{file}: the map of map_server is a .yaml file", parameter="out")
        picture = file.with_suffix(".pgm")
        for each in (file, picture):
            check_free(each, force=force)
        grey = np.full(self.cells.shape, PIXELS[UNKNOWN], np.uint8)
        for value in (FREE, OCCUPIED):
            grey[self.cells == value] = PIXELS[value]
        rows, columns = self.cells.shape
        x, y = self.origin_m
        text = (
            f"image: {picture.name}\nmode: trinary\nresolution: {self.resolution_m:.9g}\n"
            f"origin: [{x:.9g}, {y:.9g}, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        with transaction():
            with output(picture, force=force) as aside:
                aside.write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + grey[::-1].tobytes())
            with output(file, force=force) as aside:
                aside.write_text(text, encoding="utf-8")
        return file, picture

    def _summary(self) -> Summary:
        rows, columns = self.cells.shape
        share = [(self.cells == value).mean() for value in (FREE, OCCUPIED, UNKNOWN)]
        x, y = self.origin_m
        title = f"OccupancyGrid: {columns} x {rows} cells of {self.resolution_m:g} m"
        cells = "{:.1%} free, {:.1%} occupied, {:.1%} unknown".format(*share)
        return Summary(title, (("cells", cells), ("origin", f"x {x:g}, y {y:g} m")))


def occupancy_of(room: Room, *, resolution_m: float | None = None) -> OccupancyGrid:
    """The occupancy grid of a room, over its floor and all obstacles.

    A cell is occupied if its centre is less than half a cell from the outline of an obstacle, or if a corner
    of an outline is in it. The outlines are those at which simulated robots stop. Other cells are free on the
    floor, and unknown beyond it.

    Args:
        room: Floor and obstacles.
        resolution_m: Side of a cell [m]. Default: `RESOLUTION_M`, doubled until at most `FEW_CELLS` remain.

    Raises:
        InputError: The resolution is not above 0, or gives more than `MOST_CELLS` cells.
    """
    if resolution_m is None:
        resolution_m = RESOLUTION_M
        while _extent(room, resolution_m)[1].prod() > FEW_CELLS:
            resolution_m *= 2
    if not (math.isfinite(resolution_m) and resolution_m > 0):
        raise InputError(f"resolution_m must be above 0 m, got {resolution_m!r}", parameter="resolution_m")
    low, count = _extent(room, resolution_m)
    if count.prod() > MOST_CELLS:
        text = f"{count[0]:.0f} x {count[1]:.0f} cells of {resolution_m:g} m are too many"
        raise InputError(f"{text}; at most {MOST_CELLS:,} are possible", parameter="resolution_m")
    columns, rows = count.astype(int).tolist()
    x, y = ((low[k] + np.arange(n) + 0.5) * resolution_m for k, n in enumerate((columns, rows)))
    at = np.stack(np.meshgrid(x, y), axis=-1)
    on_floor = (room.lab.inside_m(at.reshape(-1, 2)) >= 0).reshape(at.shape[:2])
    cells = np.where(on_floor, FREE, UNKNOWN).astype(np.int8)
    for name, outline in zip(room.obstacles.names, room.obstacles.outlines, strict=True):
        first = (np.floor(outline.min(axis=0) / resolution_m - low) - 1).astype(int)
        last = (np.ceil(outline.max(axis=0) / resolution_m - low) + 1).astype(int)
        window = (slice(first[1], last[1]), slice(first[0], last[0]))
        at = np.stack(np.meshgrid(x[window[1]], y[window[0]]), axis=-1)
        distance, _ = Obstacles((name,), (outline,)).clearance(at.reshape(-1, 2))
        cells[window][(distance < resolution_m / 2 * (1 - 1e-6)).reshape(at.shape[:2])] = OCCUPIED
        # corners move inwards a little, off the borders of cells
        corners = outline + 1e-6 * (outline.mean(axis=0) - outline)
        column, row = np.floor(corners / resolution_m - low).astype(int).T
        cells[row, column] = OCCUPIED
    return OccupancyGrid(cells, resolution_m, (low[0] * resolution_m, low[1] * resolution_m))


def _extent(room: Room, resolution_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower left corner, in cells, and numbers of columns and rows, with two cells more on each side."""
    corners = np.concatenate([room.lab.corners, *room.obstacles.outlines])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        low = np.floor(corners.min(axis=0) / resolution_m - 1e-9) - 2
        return low, np.ceil(corners.max(axis=0) / resolution_m + 1e-9) + 2 - low
