"""The lab: its floor, walls and posts; and how a robot surveys it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.spec.base import KEY, LATER, Spec, Vec2
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.walls import SAME_M, Door, Structure, Wall, Window, steel_of_walls

DEFAULT_FLOOR_M = (6.0, 3.5)

STEP_M = 0.05
"""Steps along a wall at which it is seen whether it is on the floor [m]."""


@dataclass(frozen=True, kw_only=True)
class LabSpec(Spec):
    """A room: its floor, low walls around it, posts for motion capture, and walls with doors in it.

    The floor is a rectangle centred on the world's origin, or has corners anywhere.
    """

    floor_m: tuple[float, float] = DEFAULT_FLOOR_M
    """Size of the floor in x and y [m]. Of a floor with corners, it is computed: the rectangle about the
    world's origin that contains them."""

    floor: tuple[Vec2, ...] = field(default=(), metadata={LATER: True})
    """Corners of a floor that is not a rectangle about the origin, in order: x and y of each [m], such as
    [[0, 0], [9, 0], [9, 3], [4, 3], [4, 5], [0, 5]]. Instead of floor_m."""

    wall_height_m: float = 0.3
    """Height of the walls [m]; 0 means no walls."""

    wall_thickness_m: float = 0.05
    """Thickness of the walls, which stand outside the floor [m]."""

    post_height_m: float = 2.2
    """Height of the posts, one at each corner and one in the middle of each long wall [m]; 0 means none. A
    floor with corners has none."""

    apron_m: float = 0.2
    """Width of the slab outside the walls; furniture may stand on it [m]."""

    walls: tuple[Wall, ...] = field(default=(), metadata={KEY: None, LATER: True})
    """Walls in the room; the low walls around the floor are not among them."""

    doors: tuple[Door, ...] = field(default=(), metadata={KEY: None, LATER: True})
    """Doors in walls and in the sides of the room."""

    windows: tuple[Window, ...] = field(default=(), metadata={KEY: None, LATER: True})
    """Windows in walls and in the sides of the room."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.floor:
            check_corners(self.floor)
            around = tuple(2 * max(abs(corner[k]) for corner in self.floor) for k in range(2))
            known = self.floor_m in (DEFAULT_FLOOR_M, around)
            self._require("floor_m", known, "be left out beside the corners of floor", self.floor_m)
            object.__setattr__(self, "floor_m", around)
        self._require("floor_m", min(self.floor_m) > 0, "be above 0 m each way", self.floor_m)
        self._not_negative("wall_height_m", "post_height_m", "apron_m")
        self._above_zero("wall_thickness_m")
        if self.walls or self.doors or self.windows:
            built = Structure.named(self.walls, self.doors, self.windows, self.sides)
            built.check()
            object.__setattr__(self, "walls", built.walls)
            order = [wall.name for wall in (*built.walls, *built.sides)]
            for key in ("doors", "windows"):  # as they stand along the walls
                inside = sorted(getattr(built, key), key=lambda each: (order.index(each.wall), each.at_m))
                object.__setattr__(self, key, tuple(inside))

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Smallest and largest x, smallest and largest y of the floor [m]."""
        if not self.floor:
            x, y = self.floor_m
            return -x / 2, x / 2, -y / 2, y / 2
        xs, ys = zip(*self.floor, strict=True)
        return min(xs), max(xs), min(ys), max(ys)

    @property
    def size_text(self) -> str:
        """Size of the floor, and of one with corners how many and its area."""
        x0, x1, y0, y1 = self.extent_m
        more = f", {len(self.floor)} corners, {abs(area_m2(self.floor)):.4g} m2" if self.floor else ""
        return f"{x1 - x0:g} x {y1 - y0:g} m{more}"

    def inside_m(self, p_xy: ArrayLike) -> NDArray[np.float64]:
        """How far points (N, 2) are from the border of the floor [m], below 0 off it, shape (N,)."""
        p = np.asarray(p_xy, float)
        if self.floor:
            return inside_m(p, self.floor)
        return np.asarray(np.min(np.array(self.floor_m) / 2 - np.abs(p), axis=-1))

    @property
    def built(self) -> bool:
        """Whether there is more than the sides of a rectangle: corners, walls or doors."""
        return bool(self.floor or self.walls or self.doors)

    @property
    def corners(self) -> tuple[Vec2, ...]:
        """Corners of the floor, counter-clockwise [m]."""
        if self.floor:
            return self.floor if area_m2(self.floor) > 0 else self.floor[::-1]
        x0, x1, y0, y1 = self.extent_m
        return (x0, y0), (x1, y0), (x1, y1), (x0, y1)

    @property
    def sides(self) -> tuple[Wall, ...]:
        """Low walls along the sides of the floor, outside of it and seen counter-clockwise."""
        if not self.wall_height_m:
            return ()
        thick, corners = self.wall_thickness_m, self.corners
        names = [f"edge_{k}" for k in range(len(corners))]
        walls = []
        for k, name in enumerate(names if self.floor else ("south", "east", "north", "west")):
            (x0, y0), (x1, y1), (x2, y2) = (corners[(k + j) % len(corners)] for j in range(3))
            along, turn = math.atan2(y1 - y0, x1 - x0), math.atan2(y2 - y1, x2 - x1)
            bend = math.remainder(turn - along, math.tau)
            more = thick * (1.0 if bend > math.pi / 2 else max(math.sin(bend), 0.0))  # fills the corner
            ux, uy = math.cos(along), math.sin(along)
            out_x, out_y = uy * thick / 2, -ux * thick / 2
            start, end = (x0 + out_x, y0 + out_y), (x1 + out_x + more * ux, y1 + out_y + more * uy)
            height = self.wall_height_m
            walls.append(Wall(start, end, name=name, height_m=height, thickness_m=thick, material="plywood"))
        return tuple(walls)

    @property
    def structure(self) -> Structure:
        """Walls, doors and windows, with the sides of the room."""
        return Structure(self.walls, self.doors, self.windows, self.sides)

    @property
    def magnets(self) -> tuple[SourceSpec, ...]:
        """The steel of its walls and doors."""
        return steel_of_walls(self.structure) if self.walls or self.doors else ()


def area_m2(corners: Sequence[Vec2]) -> float:
    """Area of a polygon [m2], below 0 if its corners run clockwise."""
    pairs = zip(corners, [*corners[1:], corners[0]], strict=True)
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairs) / 2


def on_polygon(p_xy: NDArray[np.float64], corners: Sequence[Vec2]) -> NDArray[np.bool_]:
    """Whether points (N, 2) are in a polygon or on its border, shape (N,)."""
    x, y = p_xy[:, 0], p_xy[:, 1]
    inside, border = np.zeros(len(x), bool), np.zeros(len(x), bool)
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        if y0 != y1:  # a ray along x crosses the side
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        size = math.dist((x0, y0), (x1, y1))
        along = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / size
        away = ((x - x0) * (y1 - y0) - (y - y0) * (x1 - x0)) / size
        border |= (np.abs(away) < SAME_M) & (along > -SAME_M) & (along < size + SAME_M)
    return inside | border


def inside_m(p_xy: NDArray[np.float64], corners: Sequence[Vec2]) -> NDArray[np.float64]:
    """Distance of points (N, 2) from the border of a polygon [m], below 0 outside of it, shape (N,)."""
    away = np.full(len(p_xy), np.inf)
    for start, end in zip(np.array(corners, float), np.roll(corners, -1, axis=0), strict=True):
        side, to = end - start, p_xy - start
        along = np.clip(to @ side / (side @ side), 0, 1)
        away = np.minimum(away, np.hypot(*(to - along[:, None] * side).T))
    return np.where(on_polygon(p_xy, corners), away, -away)


def off_floor_m(wall: Wall, lab: LabSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points along a wall in world, shape (N, 2), and how far each is off the floor, shape (N,) [m].

    A wall that stands around the floor, on the slab, is not off it.
    """
    far = np.linspace(0, wall.length_m, max(3, int(wall.length_m / STEP_M)))
    p_xy = np.array([wall.at(float(s), 0.0) for s in far])
    off = -inside_m(p_xy, lab.corners)
    slab = lab.wall_thickness_m + lab.apron_m + wall.thickness_m / 2 + SAME_M
    return p_xy, np.where(off > slab, off, 0.0)


@lru_cache(maxsize=64)
def check_corners(corners: tuple[Vec2, ...]) -> None:
    """Refuse a floor whose corners are not those of a polygon.

    Raises:
        InputError: It has fewer than three corners, two equal ones, no area, or crosses itself.
    """
    count = len(corners)
    if count < 3:
        raise InputError(f"floor must have three corners or more, got {count}")
    if not all(abs(c) < math.inf for corner in corners for c in corner):
        raise InputError("floor must have finite corners")

    def shown(k: int) -> str:
        return "floor[{}] ({:g}, {:g})".format(k % count, *corners[k % count])

    for k in range(count):
        a, b, c = (corners[(k + j) % count] for j in range(3))
        back = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]) < 0
        if math.dist(a, b) >= SAME_M and back and abs(area_m2((a, b, c))) < SAME_M:
            raise InputError(f"floor crosses itself: it turns back at {shown(k + 1)}; leave that corner out")
        if math.dist(a, b) < SAME_M:
            again = "; the last corner need not repeat the first" if k == count - 1 else ""
            raise InputError(f"{shown(k)} and {shown(k + 1)} are the same corner; leave one out{again}")
    for i in range(count):
        for j in range(i + 1, count):
            apart = j not in (i, i + 1) and (j + 1) % count != i
            if apart and _cross(corners[i], corners[i + 1], corners[j], corners[(j + 1) % count]):
                raise InputError(
                    f"floor crosses itself: its side from {shown(i)} to {shown(i + 1)} meets that from "
                    f"{shown(j)} to {shown(j + 1)}; give its corners in order around the room"
                )
    if abs(area_m2(corners)) < SAME_M:
        raise InputError("floor has no area; give its corners in order around the room")


def _cross(a: Vec2, b: Vec2, c: Vec2, d: Vec2) -> bool:
    """Whether the segments a-b and c-d meet."""

    def side(p: Vec2, q: Vec2, r: Vec2) -> int:
        """1 if r is to the left of p-q, -1 to the right, 0 on its line."""
        off = ((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])) / math.dist(p, q)
        return 0 if abs(off) < SAME_M else (1 if off > 0 else -1)

    def within(p: Vec2, q: Vec2, r: Vec2) -> bool:
        return all(min(p[k], q[k]) - SAME_M <= r[k] <= max(p[k], q[k]) + SAME_M for k in range(2))

    sides = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    if sides[0] * sides[1] < 0 and sides[2] * sides[3] < 0:
        return True
    touching = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(not on and within(*ends) for on, ends in zip(sides, touching, strict=True))


@dataclass(frozen=True, kw_only=True)
class SurveySpec(Spec):
    """A survey of a room without a map: the robot stands at each node of a grid in each heading."""

    spacing_m: float = 0.25
    """Distance between nodes [m]."""

    headings_deg: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)
    """Headings at each node, ascending [deg]."""

    readings: int = 135
    """Readings averaged at each node and heading."""

    height_m: float | None = None
    """Height of the sensor above the floor [m]. Default: the robot's."""

    heading_error_deg: float = 0.0
    """Standard deviation of the heading [deg]."""

    position_error_m: float = 0.0
    """Standard deviation of the position along x and y [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("spacing_m")
        self._require("readings", self.readings >= 1, "be at least 1", self.readings)
        self._not_negative("heading_error_deg", "position_error_m")
        self._require("height_m", (self.height_m or 0.0) >= 0, "not be below 0", self.height_m)
        headings = self.headings_deg
        rises = bool(headings) and list(headings) == sorted(set(headings))
        within = rises and headings[0] >= 0 and headings[-1] < 360
        self._require("headings_deg", within, "ascend from 0 to below 360", headings)
