"""Coverage: a drive over every part of the free floor, in strips side by side.

The free floor is a raster of places where a robot's centre can be. It is cut into cells whose columns have
one run each (boustrophedon cells, Choset 2000). Each cell is driven in strips, the nearest cell next, along
the shortest way over the raster. What the strips leave out is visited point by point.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]
Lane = tuple[Cells, Cells]
"""Both ends of a strip, each a cell of the raster."""

ENOUGH = 0.98
"""Share of the floor at which no more points are visited."""

WORTH = 0.1
"""Area that a strip must add, in squares of the distance between strips."""


@dataclass(frozen=True)
class Coverage:
    """A drive over the largest connected part of a free floor."""

    cells: Cells
    """Corners of the drive, as cells of the raster, shape (N, 2)."""

    share: float
    """Share of that part within half the distance between strips."""

    closed: tuple[tuple[float, Cells], ...]
    """Other parts of the free floor: number of cells, and the middle one."""


def cover(free: Mask, strip: float) -> Coverage | None:
    """Drive over every cell of a raster that can be reached from its largest connected part.

    Args:
        free: Where the robot's centre can be, shape (X, Y).
        strip: Distance between strips, in cells.

    Returns:
        The drive; None if nothing is free.
    """
    from scipy import ndimage

    labels, count = ndimage.label(free)
    if not count:
        return None
    sizes = np.bincount(labels.ravel())[1:]
    main = int(np.argmax(sizes)) + 1
    region = labels == main
    both = [_lanes(region, strip), _lanes(region.T, strip)]
    flip = sum(map(len, both[1])) < sum(map(len, both[0]))
    lanes = [[(a[::-1], b[::-1]) for a, b in cell] if flip else cell for cell in both[flip]]
    lanes += [[(point, point)] for point in _left_out(region, lanes, strip)]
    graph = _Graph(region)
    corners = np.array(list(_tour(graph, lanes)))
    far = ndimage.distance_transform_edt(~_drawn(region.shape, corners)) > strip / 2
    others = [k + 1 for k in range(count) if k + 1 != main]
    closed = [(float(sizes[k - 1]), _middle(labels == k)) for k in others]
    return Coverage(corners, 1 - float(far[region].mean()), tuple(closed))


def _middle(part: Mask) -> Cells:
    """The cell of a part that is farthest from its border."""
    from scipy import ndimage

    depth = ndimage.distance_transform_edt(part)
    return np.array(np.unravel_index(int(np.argmax(depth)), part.shape))


def _lanes(region: Mask, strip: float) -> list[list[Lane]]:
    """Strips of each cell, along the second axis, without those that add next to nothing."""
    covered, kept = np.zeros_like(region), list[list[Lane]]()
    reach = int(strip / 2)
    for cell in sorted(_cells(region), key=lambda cell: -sum(b - a for _, a, b in cell)):
        count = max(1, int(np.ceil(len(cell) / strip)))
        lanes = list[Lane]()
        for k in range(count):
            i, a, b = cell[int((k + 0.5) * len(cell) / count)]
            window = slice(max(i - reach, 0), i + reach + 1), slice(max(a - reach, 0), b + reach)
            if np.count_nonzero(region[window] & ~covered[window]) > WORTH * strip**2:
                covered[window] = True
                lanes.append((np.array([i, a]), np.array([i, b - 1])))
        kept += [lanes] if lanes else []
    return kept


def _cells(region: Mask) -> list[list[tuple[int, int, int]]]:
    """Cells of a region: rows i with the begin and end of their run, one run a row."""
    done, open_cells = list[list[tuple[int, int, int]]](), list[list[tuple[int, int, int]]]()
    for i, row in enumerate(region):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.view(np.int8), [0]]))).reshape(-1, 2)
        runs = [(i, int(a), int(b)) for a, b in edges]
        ends = [cell[-1] for cell in open_cells]
        meets = [[k for k, (_, a, b) in enumerate(ends) if a < run[2] and run[1] < b] for run in runs]
        met = [sum(k in ks for ks in meets) for k in range(len(open_cells))]
        now = list[list[tuple[int, int, int]]]()
        for run, ks in zip(runs, meets, strict=True):
            if len(ks) == 1 and met[ks[0]] == 1:
                open_cells[ks[0]].append(run)
                now.append(open_cells[ks[0]])
            else:
                now.append([run])
        done += [cell for cell in open_cells if not any(cell is each for each in now)]
        open_cells = now
    return done + open_cells


def _left_out(region: Mask, lanes: list[list[Lane]], strip: float) -> Iterator[Cells]:
    """Points from which the rest of the region is seen, the deepest in it first."""
    from scipy import ndimage

    drawn = np.zeros(region.shape, bool)
    for lane in (lane for cell in lanes for lane in cell):
        drawn |= _drawn(region.shape, np.array(lane))
    rest = region & (ndimage.distance_transform_edt(~drawn) > strip / 2)
    spare = (1 - ENOUGH) * np.count_nonzero(region)
    depth = ndimage.distance_transform_edt(rest)
    places = np.argwhere(rest)
    for place in places[np.argsort(-depth[rest], kind="stable")]:
        if np.count_nonzero(rest) <= spare:
            return
        if rest[tuple(place)]:
            low = np.maximum(np.ceil(place - strip / 2), 0).astype(int)
            window = tuple(slice(a, int(p + strip / 2) + 1) for a, p in zip(low, place, strict=True))
            away = np.indices(rest[window].shape) + (low - place)[:, None, None]
            rest[window] &= np.hypot(*away) > strip / 2
            yield place


def _drawn(shape: tuple[int, ...], corners: Cells) -> Mask:
    """The cells that a polyline passes."""
    mask = np.zeros(shape, bool)
    mask[tuple(corners.T)] = True
    for a, b in pairwise(corners):
        mask[tuple(_between(a, b).T)] = True
    return mask


def _between(a: Cells, b: Cells) -> Cells:
    """The cells from one to another, less than a cell apart."""
    steps = 2 * int(np.abs(b - a).max()) + 1
    return np.rint(np.linspace(a, b, steps)).astype(int)


def _tour(graph: "_Graph", cells: list[list[Lane]]) -> Iterator[Cells]:
    """Corners of a drive through all cells, the nearest entry next."""
    waiting = [_ways(cell) for cell in cells]
    here = None
    while waiting:
        if here is None:
            chosen, way = 0, waiting[0][0]
        else:
            away = graph.distances(here)
            nearest = [min(float(away[graph.number(way[0])]) for way in ways) for ways in waiting]
            chosen = int(np.argmin(nearest))
            way = min(waiting[chosen], key=lambda way: float(away[graph.number(way[0])]))
            yield from graph.way_to(way[0])
        del waiting[chosen]
        yield way[0]
        for a, b in pairwise(way):
            if not graph.sees(a, b):
                graph.distances(a)
                yield from graph.way_to(b)
            yield b
        here = way[-1]


def _ways(cell: list[Lane]) -> list[list[Cells]]:
    """The drives over the strips of a cell: from either end of its first or last strip."""
    ways = []
    for lanes in (cell, cell[::-1]) if len(cell) > 1 else (cell,):
        for side in (0, 1):
            ways += [[lane[(side + k + j) % 2] for k, lane in enumerate(lanes) for j in (0, 1)]]
    return ways


class _Graph:
    """The cells of a region with their neighbours, eight at most."""

    def __init__(self, region: Mask) -> None:
        from scipy.sparse import csr_array

        self.region = region
        self._number = np.full(region.shape, -1)
        self._places = np.argwhere(region)
        self._number[region] = np.arange(len(self._places))
        rows, columns, lengths = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            here, there = self._places, self._places + np.array([dx, dy])
            inside = np.all((there >= 0) & (there < region.shape), axis=1)
            here, there = here[inside], there[inside]
            clear = region[tuple(there.T)]  # a diagonal needs both cells beside it
            clear &= region[here[:, 0] + dx, here[:, 1]] & region[here[:, 0], here[:, 1] + dy]
            rows.append(self._number[tuple(here[clear].T)])
            columns.append(self._number[tuple(there[clear].T)])
            lengths.append(np.full(np.count_nonzero(clear), np.hypot(dx, dy)))
        ends = np.concatenate(rows), np.concatenate(columns)
        count = len(self._places)
        self._links = csr_array((np.concatenate(lengths), ends), shape=(count, count))
        self._before: Any = None

    def number(self, cell: Cells) -> int:
        """Number of a cell in `distances`."""
        return int(self._number[tuple(cell)])

    def distances(self, cell: Cells) -> NDArray[np.float64]:
        """Length of the shortest way from a cell to each cell; `way_to` then begins there."""
        from scipy.sparse.csgraph import dijkstra

        found, self._before = dijkstra(
            self._links, directed=False, indices=self.number(cell), return_predecessors=True
        )
        return np.asarray(found)

    def way_to(self, cell: Cells) -> Iterator[Cells]:
        """Corners of the shortest way to a cell, pulled straight, without its ends."""
        back = [self.number(cell)]
        while self._before[back[-1]] >= 0:
            back.append(int(self._before[back[-1]]))
        way = self._places[back[::-1]]
        at, last = 0, len(way) - 1
        while at < last:
            far, reach = at + 1, 1
            while at + 2 * reach <= last and self.sees(way[at], way[at + 2 * reach]):
                reach *= 2
                far = at + reach
            for further in range(min(at + 2 * reach, last), far, -1):
                if self.sees(way[at], way[further]):
                    far = further
                    break
            at = far
            if at < last:
                yield way[at]

    def sees(self, a: Cells, b: Cells) -> bool:
        """Whether the straight line between two cells stays in the region."""
        return bool(self.region[tuple(_between(a, b).T)].all())
