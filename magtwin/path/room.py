"""The room of a path: checks on floor and obstacles, and fitting a path to them."""

import math
import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, MismatchWarning
from magtwin.path.coverage import cover
from magtwin.path.curves import CASES, PATHS, path_named
from magtwin.path.points import resolve_path
from magtwin.path.polyline import Path
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles

Array = NDArray[np.float64]

FLOOR_M = (6.0, 3.5)  # Floor for which the named paths are designed [m]
RADIUS_M = 0.171  # Robot radius for which they are designed [m]
# Clearance from obstacles, if there is room, since a robot deviates a little from its path [m]
CLEAR_M = 0.05
STEP_M = 0.03  # Spacing of the raster of the free floor [m]; larger on large floors
MOST_CELLS = 400_000  # Most cells of that raster
# Sizes to try, as fractions of the size that fits the empty floor
SHRINK = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25)
LEAST_SCALE = 0.1  # Below this scale, a path that is too large is taken for one in another unit
COVERAGE = "coverage"  # Name of the path that is planned for a room
STRIP_M = 0.5  # Distance between strips of that path [m]
PLAN_STEP_M = 0.05  # Spacing of the raster on which it is planned [m]
SWEPT = 0.8  # Least share of the free floor around a scaled path that is not told of
FEW_CELLS = 4_000  # Cells of a raster of which only shares are told
LITTLE_M2 = 0.1  # A smaller part of the free floor is not told of [m2]
SIDE_POINTS = 400  # Points along a fitted path whose side of each wall is checked
SHIFTS = 13  # Positions to try along each axis for each size


@dataclass(frozen=True)
class Room:
    """A floor with obstacles, and the robot that drives on it."""

    lab: LabSpec  # The floor
    footprint_radius_m: float  # Radius of the robot [m]
    obstacles: Obstacles  # Obstacles in the room

    def refusal(self, path: Path) -> InputError | None:
        """The error if the robot cannot drive the path here; None if it can."""
        try:
            check_on_floor(path, self.lab, self.footprint_radius_m)
            check_clear(path, self.obstacles, self.footprint_radius_m)
        except InputError as error:
            return error
        return None

    @property
    def reach_m(self) -> Array:
        """Largest |x| and |y| that the robot's centre can have [m], shape (2,)."""
        return self.half_m - self.footprint_radius_m

    @property
    def half_m(self) -> Array:
        """Half the size of the floor, or of the rectangle around its corners, in x and y [m], shape (2,)."""
        return np.ptp(self.lab.corners, axis=0) / 2

    @property
    def middle_m(self) -> Array:
        """Its middle in world [m], shape (2,)."""
        return np.asarray(self.lab.corners).min(axis=0) + self.half_m


def path_in(room: Room, path: str | os.PathLike[str]) -> Path:
    """A named path, fitted to the room, or the path of a CSV file, unchanged.

    Named paths are designed for a floor of 6 x 3.5 m. On another floor they are scaled in x and y. If an
    obstacle is in the way, they are moved and made smaller until the robot passes.

    Args:
        room: The room.
        path: A name of `PATHS`, a case A to E, or a CSV file.

    Raises:
        InputError: There is no such path, or no room for it.
    """
    text = os.fspath(path)
    if text not in PATHS and text not in CASES:
        return resolve_path(FilePath(text) if isinstance(path, FilePath) else text)
    if text == COVERAGE:
        return _covering(room)
    named = path_named(text)
    if room.lab.floor_m == FLOOR_M and not room.lab.floor and room.refusal(named) is None:
        return named
    made_for = np.asarray(FLOOR_M) / 2 - RADIUS_M
    whole = room.reach_m / made_for
    placed = _placed(named, room, whole, each_way=True)
    if not room.lab.floor and placed.placing == (*whole.tolist(), 0.0, 0.0):
        return placed  # as large as the floor
    # Its share of the free floor, by that of the named path on the floor it is made for.
    before = _around(named, Room(LabSpec(floor_m=FLOOR_M), RADIUS_M, Obstacles()))
    share = min(1.0, _around(placed, room) / max(before, 1e-9), _open_to(placed, room))
    return replace(placed, swept=round(share, 3))


def fit_path(path: Path, room: Room) -> Path:
    """A path, moved and if necessary made smaller until it fits into a room.

    Args:
        path: Any path; one that fits is returned unchanged.
        room: The room.

    Raises:
        InputError: It does not fit at a quarter of the size for the empty floor.
    """
    if room.refusal(path) is None:
        return path
    half = np.ptp(path.p_xy, axis=0) / 2
    with np.errstate(divide="ignore"):
        whole = min(1.0, float(np.min(room.reach_m / half)))
    fitted = _placed(path, room, np.array([whole, whole]), each_way=False)
    _check_side(path, fitted, room.lab)
    return fitted


def _check_side(path: Path, fitted: Path, lab: LabSpec) -> None:
    """Refuse a fitted path of which a point that was on the floor is now on the other side of a wall."""
    share = np.linspace(0.0, 1.0, SIDE_POINTS)
    old, new = path.at(share * path.length), fitted.at(share * fitted.length)
    on = lab.inside_m(old) > 0
    for wall in lab.walls:
        a, b = np.array(wall.start), np.array(wall.end)
        crossed = on & (_left(a, b, old) != _left(a, b, new)) & (_left(old, new, a) != _left(old, new, b))
        if crossed.any():
            i = int(np.flatnonzero(crossed)[0])
            raise InputError(
                f"path {path.name} does not fit: the nearest place for it moves its point "
                f"({old[i, 0]:.3f}, {old[i, 1]:.3f}) m by {np.hypot(*(new - old)[i]):.2f} m, to the other "
                f"side of {wall.name}; open the door (open_deg), or move the path's points"
            )


def _left(a: Array, b: Array, p: Array) -> NDArray[np.bool_]:
    """Whether points are to the left of the line from a to b, each of shape (2,) or (N, 2)."""
    along, to = b - a, p - a
    return np.asarray(along[..., 0] * to[..., 1] > along[..., 1] * to[..., 0])


def check_on_floor(path: Path, lab: LabSpec, footprint_radius_m: float) -> None:
    """Check that a round robot on the path stays on the floor of a room.

    Args:
        path: Path of its centre.
        lab: The room.
        footprint_radius_m: Radius of the robot [m].

    Raises:
        InputError: It does not; the text has the first such point and what would fit.
    """
    s, p = _along(path, footprint_radius_m) if lab.floor else (path.s, path.p_xy)
    beyond = footprint_radius_m - lab.inside_m(p)
    outside = np.flatnonzero(beyond > 1e-9)
    if not len(outside):
        return
    i = int(outside[0])
    where = f"{s[i]:.3f} m along it" if lab.floor else f"at point {i + 1} of {len(p)}"
    text = (
        f"path {path.name} leaves the floor {where}, ({p[i, 0]:.3f}, {p[i, 1]:.3f}) m, by {beyond[i]:.3f} m: "
        f"with a robot of radius {footprint_radius_m:g} m it "
    )
    if lab.floor:
        way = "give `fit=True`, or move its points"
        raise InputError(f"{text}must stay that far inside of its {len(lab.floor)} corners; {way}")
    needs = np.ptp(p, axis=0) + 2 * footprint_radius_m
    raise InputError(
        f"{text}needs {needs[0]:.2f} x {needs[1]:.2f} m, the floor is {lab.size_text}; "
        f"{_what_fits(path, lab.floor_m, footprint_radius_m)}"
    )


def _what_fits(path: Path, floor_m: tuple[float, float], footprint_radius_m: float) -> str:
    """Advice how to fit a path to the floor."""
    room = np.array(floor_m) - 2 * footprint_radius_m
    if min(room) <= 0:
        return "the floor is no wider than the robot; enlarge it"
    low, high = path.p_xy.min(axis=0), path.p_xy.max(axis=0)
    with np.errstate(divide="ignore"):
        scale = float(np.min(room / (high - low)))
    if scale >= 1:
        x, y = np.clip(0.0, high - room / 2, low + room / 2) * -1.0 + 0.0
        return f"moved by ({x:.2f}, {y:.2f}) m it fits the floor: give `fit=True`, or move its points"
    if scale < LEAST_SCALE:
        return "points are in metres: convert them if they are in mm or another unit, or give a shorter path"
    return f"scaled by {math.floor(scale * 100) / 100:g} it fits the floor: give `fit=True`, or enlarge it"


def _along(path: Path, footprint_radius_m: float) -> tuple[Array, Array]:
    """Lengths along a path (N,) [m], a quarter of the radius apart at most, and its points there (N, 2)."""
    step = max(footprint_radius_m / 4, path.length / 100_000)  # segments may be long
    s = np.union1d(np.linspace(0.0, path.length, math.ceil(path.length / step) + 1), path.s)
    return s, path.at(np.minimum(s, path.length))


def check_clear(path: Path, obstacles: Obstacles, footprint_radius_m: float) -> None:
    """Check that a round robot on the path touches no obstacle.

    Args:
        path: Path of its centre.
        obstacles: The obstacles.
        footprint_radius_m: Radius of the robot [m].

    Raises:
        InputError: It touches one; the text has the first such point and the obstacle.
    """
    s, p = _along(path, footprint_radius_m)
    distance, which = obstacles.clearance(p, reach_m=footprint_radius_m)
    touched = np.flatnonzero(distance < footprint_radius_m - 1e-9)
    if len(touched):
        i = int(touched[0])
        closed = obstacles.names[which[i]].endswith("/leaf")
        way = "open the door (open_deg)" if closed else "give `fit=True`"
        raise InputError(
            f"path {path.name} runs into {obstacles.names[which[i]]}: {s[i]:.3f} m along it, at "
            f"({p[i, 0]:.3f}, {p[i, 1]:.3f}) m, a robot of radius {footprint_radius_m:g} m is "
            f"{footprint_radius_m - distance[i]:.3f} m too near; {way}, or move the path "
            "or the obstacle"
        )


def _placed(path: Path, room: Room, whole: Array, *, each_way: bool) -> Path:
    """The path at the largest size that fits, up to the scale `whole` (2,), near its original position."""
    if min(room.reach_m) <= 0:
        radius = f"a robot of radius {room.footprint_radius_m:g} m"
        text = f"the floor of {room.lab.size_text} is no wider than {radius}"
        raise InputError(f"path {path.name} does not fit: {text}")
    middle = (path.p_xy.min(axis=0) + path.p_xy.max(axis=0)) / 2
    half = np.ptp(path.p_xy, axis=0) / 2
    sizes = [(a, b) for a in SHRINK for b in (SHRINK if each_way else (a,))]
    sizes.sort(key=lambda size: (-size[0] * size[1], abs(size[0] - size[1]), -size[0]))
    for clear in (CLEAR_M, 0.0):
        free = _Free(room, clear)
        for share in sizes:
            scale = whole * share
            slack = np.maximum(room.reach_m - half * scale - clear, 0.0)
            start = middle * scale if each_way else middle
            shifts = _shifts(np.clip(start, -slack, slack), slack) - middle * scale + room.middle_m
            if each_way:  # first try the path scaled with the floor
                shifts = np.vstack([room.middle_m, shifts])
            scaled = path.placed((float(scale[0]), float(scale[1]), 0.0, 0.0))
            count = min(math.ceil(scaled.length / max(free.step_m, 0.02)) + 1, 20_000)
            dense = scaled.at(np.linspace(0.0, scaled.length * (1 - 1e-12), count))
            for shift in shifts[free.holds(dense, shifts)]:
                found = path.placed(tuple(map(float, (*scale, *shift))))  # type: ignore[arg-type]
                if room.refusal(found) is None:
                    return found
    raise InputError(
        f"path {path.name} does not fit between the obstacles on the floor of {room.lab.size_text}, "
        f"not even at a quarter of its size; move the furniture, or give your "
        "own points in a CSV file"
    )


def _shifts(home: Array, slack: Array) -> Array:
    """Centres to try, nearest to `home` first, shape (N, 2)."""
    axes = [np.union1d(np.linspace(-s, s, SHIFTS), [h]) for s, h in zip(slack, home, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    away = np.round(np.hypot(*(grid - home).T), 9)
    return np.asarray(grid[np.lexsort((grid[:, 1], grid[:, 0], away))])


def _covering(room: Room) -> Path:
    """A path over the largest connected part of the free floor of a room; warns of parts it cannot enter.

    Raises:
        InputError: The robot can stand nowhere.
    """
    for clear in (CLEAR_M, 0.0):
        free = _Free(room, clear, PLAN_STEP_M)
        found = cover(free.inside(room, clear), STRIP_M / free.step_m)
        if found is not None and len(found.cells) > 1:
            break
    else:
        raise InputError(
            f"path {COVERAGE} does not fit: a robot of radius {room.footprint_radius_m:g} m can stand "
            "nowhere on the free floor; move the furniture, or enlarge the floor"
        )
    for count, cell in found.closed:
        if (area := count * free.step_m**2) > LITTLE_M2:
            x, y = free.places(cell)
            part = f"{area:.1f} m2 of the free floor about ({x:.2f}, {y:.2f})"
            text = f"path {COVERAGE} cannot enter {part}: {_closed_by(room, x, y)}"
            warnings.warn(text, MismatchWarning, stacklevel=4)
    path = Path(COVERAGE, free.places(found.cells), swept=round(found.share, 3))
    if (error := room.refusal(path)) is not None:
        raise error
    return path


@PATHS.register(COVERAGE)
def coverage(*, length_m: float = 6.0, width_m: float = 3.5, footprint_radius_m: float = 0.171) -> Path:
    """Strips over a whole floor, 0.5 m apart. `path_in` plans it for a room, through every open door.

    Args:
        length_m: Length of an empty floor along x [m].
        width_m: Its width along y [m].
        footprint_radius_m: Radius of the robot [m].
    """
    return _covering(Room(LabSpec(floor_m=(length_m, width_m)), footprint_radius_m, Obstacles()))


def _closed_by(room: Room, x: float, y: float) -> str:
    """Why a part of the floor cannot be entered, and what to do."""
    doors = [k for k, name in enumerate(room.obstacles.names) if name.endswith("/leaf")]
    near = room.obstacles.only(doors)
    _, which = near.clearance([[x, y]])
    if which[0] < 0:
        return f"no way is {2 * room.footprint_radius_m:g} m wide; add a [[door]], or move what is in the way"
    name = near.names[which[0]].removesuffix("/leaf")
    return f"the door nearest to it is {name}; open it (open_deg = 90), or make it wider (width_m)"


def _open_to(path: Path, room: Room) -> float:
    """Share of the free floor of a room that is connected with the start of a path."""
    from scipy import ndimage

    free = _Free(room, 0.0, PLAN_STEP_M)
    inside = free.inside(room, 0.0)
    parts, count = ndimage.label(inside)
    cells = np.argwhere(inside)
    if not count:
        return 1.0
    near = cells[np.argmin(np.hypot(*(free.places(cells) - path.p_xy[0]).T))]
    return float(np.mean(parts[inside] == parts[tuple(near)]))


def _around(path: Path, room: Room) -> float:
    """Share of the places of a robot in a room that are inside a path's hull, or half a strip outside."""
    free = _Free(room, 0.0, math.sqrt(4 * math.prod(room.half_m) / FEW_CELLS))
    places = free.places(np.argwhere(free.inside(room, 0.0)))
    hull = path.p_xy[:: max(1, len(path.p_xy) // 100)]
    away, _ = Obstacles((path.name,), (hull,)).clearance(places, reach_m=STRIP_M)
    return float(np.mean(away <= STRIP_M / 2)) if len(places) else 1.0


class _Free:
    """Raster of the places where the robot's centre can be."""

    def __init__(self, room: Room, clear_m: float, step_m: float = STEP_M) -> None:
        """Mark the places where the robot is at least `clear_m` away from obstacles on the floor."""
        half, middle = room.half_m, room.middle_m
        self.step_m = max(step_m, math.sqrt(4 * half[0] * half[1] / MOST_CELLS))
        self._low = middle - half
        axes = [m + np.arange(-h, h + self.step_m, self.step_m) for m, h in zip(middle, half, strict=True)]
        at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        inner = half - 1e-6  # an outline that only touches the floor's edge is outside
        kept = [
            k
            for k, outline in enumerate(room.obstacles.outlines)
            if room.lab.floor or (np.all(outline.max(0) > -inner) and np.all(outline.min(0) < inner))
        ]
        standing = room.obstacles.only(kept)
        # A point is at most this far from the nearest node of the raster.
        needed = room.footprint_radius_m + clear_m + self.step_m / math.sqrt(2)
        distance, _ = standing.clearance(at.reshape(-1, 2), reach_m=needed)
        if room.lab.floor:
            distance = np.minimum(distance, room.lab.inside_m(at.reshape(-1, 2)))
        self.free: NDArray[np.bool_] = (distance >= needed).reshape(at.shape[:2])

    def inside(self, room: Room, clear_m: float) -> NDArray[np.bool_]:
        """The free places at which the robot is on the floor, and `clear_m` from its border."""
        near = list[NDArray[np.bool_]]()
        for k, count in enumerate(self.free.shape):
            nodes = self._low[k] - room.middle_m[k] + self.step_m * np.arange(count)
            near.append(np.abs(nodes) <= room.reach_m[k] - clear_m)
        return np.asarray(self.free & near[0][:, None] & near[1])

    def places(self, cells: ArrayLike) -> Array:
        """World x and y of cells (N, 2) [m]."""
        return self._low + self.step_m * np.asarray(cells)

    def holds(self, points: Array, shifts: ArrayLike) -> NDArray[np.bool_]:
        """Whether all points (N, 2) are free after each of the shifts (M, 2), shape (M,)."""
        if self.free.all():
            return np.ones(len(np.asarray(shifts)), bool)
        most: Array = np.array(self.free.shape) - 1.0
        held = []
        for shift in np.asarray(shifts):
            cell = np.clip(np.rint((points + shift - self._low) / self.step_m), 0, most).astype(int)
            held.append(bool(self.free[cell[:, 0], cell[:, 1]].all()))
        return np.array(held)
