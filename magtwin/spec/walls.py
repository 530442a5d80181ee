"""Walls from point to point, and the doors and windows that are cut in them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from magtwin.errors import InputError, find, hint
from magtwin.frames import quat_from_yaw
from magtwin.spec.base import KEY, Quat, Spec, Vec2
from magtwin.spec.furniture import MATERIALS, STEEL, Part, source_of
from magtwin.spec.magnetics import SourceSpec

NO_LEAF = "none"
"""Material of a door that is a passage without a leaf."""

SAME_M = 1e-6
"""Lengths that differ by less are equal [m]."""


@dataclass(frozen=True)
class Wall(Spec):
    """A straight wall from point to point, which stands on the floor."""

    start: Vec2 = field(metadata={KEY: "from"})
    """Begin of its centre line: x and y [m]."""

    end: Vec2 = field(metadata={KEY: "to"})
    """End of its centre line: x and y [m]."""

    _: KW_ONLY

    name: str = ""
    """Name of its prim, used once. Default: wall_0 for the first wall, wall_1 for the second."""

    height_m: float = 2.5
    """Height [m]."""

    thickness_m: float = 0.1
    """Thickness, half of it on each side of the centre line [m]."""

    material: str = "plasterboard"
    """Material, as for a box. A wall of steel or reinforced concrete is magnetised."""

    magnetization: float = 0.0
    """Magnetization along the wall [A/m]."""

    susceptibility: float = 0.0
    """Volume susceptibility of the wall [1]. Above 0, the Earth's field magnetises it too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("height_m", "thickness_m")
        self._not_negative("susceptibility")
        find("material", self.material, MATERIALS)
        self._require("end", self.length_m > SAME_M, "differ from its start, `from` of a TOML", self.end)
        _check_steel(self, self.material)

    @property
    def length_m(self) -> float:
        """Distance of its ends [m]."""
        return math.dist(self.start, self.end)

    @property
    def yaw(self) -> float:
        """Direction from start to end [rad]."""
        return math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])

    @property
    def q_world_xyzw(self) -> Quat:
        """Its axes in world: x from start to end, y to the left, z up."""
        return _turned(self.yaw)

    def at(self, along_m: float, left_m: float = 0.0) -> Vec2:
        """World x and y of a place `along_m` from its start and `left_m` to the left of its centre line."""
        ux, uy = ((b - a) / self.length_m for a, b in zip(self.start, self.end, strict=True))
        return self.start[0] + along_m * ux - left_m * uy, self.start[1] + along_m * uy + left_m * ux


@dataclass(frozen=True)
class _Opening(Spec):
    """An opening in a wall."""

    wall: str | int
    """Name of the wall, or its number from 0. Sides of the room: south, east, north and west of a floor
    without corners; edge_0 from the first corner to the second, edge_1 and so on of a floor with them."""

    at_m: float
    """Middle of the opening, from the wall's start [m]."""

    _: KW_ONLY

    name: str = ""
    """Name of its prim, used once. Default: door_0 for the first door, window_1 for the second window."""

    width_m: float = 0.9
    """Width of the opening [m]."""

    height_m: float = 2.0
    """Height of the opening, and of a door's leaf [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("width_m", "height_m")

    @property
    def span_m(self) -> Vec2:
        """Begin and end of the opening along the wall [m]."""
        return self.at_m - self.width_m / 2, self.at_m + self.width_m / 2


@dataclass(frozen=True)
class Door(_Opening):
    """A door in a wall: an opening from the floor up, with a leaf that turns."""

    _: KW_ONLY

    open_deg: float = 90.0
    """Angle of the leaf, from -180 to 180 [deg]; 0 is closed. Above 0 it turns to the left of the wall, seen
    from its start to its end, below 0 to the right."""

    hinge: str = "start"
    """Side of the hinge: "start" or "end" of the wall."""

    thickness_m: float = 0.04
    """Thickness of the leaf [m]."""

    material: str = "wood"
    """Material of the leaf, as for a box; "none" is a passage without a leaf."""

    magnetization: float = 0.0
    """Magnetization of the leaf along its longest side [A/m]."""

    susceptibility: float = 0.0
    """Volume susceptibility of the leaf [1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("thickness_m")
        self._not_negative("susceptibility")
        self._within("open_deg", -180, 180)
        self._named("hinge", ("start", "end"))
        find("material", self.material, {**MATERIALS, NO_LEAF: ""})
        _check_steel(self, self.material)

    def leaf(self, wall: Wall) -> tuple[Part, Vec2, float] | None:
        """The leaf in its hinge's axes, the hinge in the wall's axes [m], and the leaf's yaw there [rad].

        The hinge is at the jamb, at the face of the wall to which the leaf turns; closed, the leaf is flush
        with it. None for a passage.
        """
        if self.material == NO_LEAF:
            return None
        left, at_end = self.open_deg >= 0, self.hinge == "end"
        face = wall.thickness_m / 2 if left else -wall.thickness_m / 2
        wide = self.width_m - 2 * SAME_M  # two bodies do not touch
        x, y = wide / 2, -self.thickness_m / 2 if left else self.thickness_m / 2
        centre = (-x if at_end else x, y, self.height_m / 2)
        look = MATERIALS[self.material]
        part = Part("leaf", centre, (wide, self.thickness_m, self.height_m), look)
        at = self.span_m[1] - SAME_M if at_end else self.span_m[0] + SAME_M
        turn = math.radians(-self.open_deg if at_end else self.open_deg)
        return part, (at, face), turn


@dataclass(frozen=True)
class Window(_Opening):
    """A window in a wall: an opening without glass above a sill. One with a sill of 0 is a passage."""

    _: KW_ONLY

    width_m: float = 1.2
    """Width of the opening [m]."""

    height_m: float = 1.2
    """Height of the opening [m]."""

    sill_m: float = 0.9
    """Height of the sill above the floor [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._not_negative("sill_m")


def _check_steel(spec: Wall | Door, material: str) -> None:
    """Refuse a magnetization of what has no steel."""
    steel = material != NO_LEAF and Part("", (0, 0, 0), (1, 1, 1), MATERIALS[material]).steel
    for name in ("magnetization", "susceptibility"):
        what = f"be left out: {material} is not magnetic"
        spec._require(name, steel or not getattr(spec, name), what, getattr(spec, name))


def _turned(yaw: float) -> Quat:
    x, y, z, w = quat_from_yaw(yaw).tolist()
    return (x, y, z, w)


def parts_of_wall(wall: Wall, openings: Sequence[Door | Window]) -> tuple[Part, ...]:
    """The boxes of a wall, in its axes: solid between openings, a lintel above each, and sills.

    The origin is the wall's start on the floor, x is along it, z is up.
    """
    look, parts = MATERIALS[wall.material], list[Part]()

    def add(name: str, x0: float, x1: float, z0: float, z1: float) -> None:
        if x1 - x0 > SAME_M and z1 - z0 > SAME_M:
            centre, size = ((x0 + x1) / 2, 0.0, (z0 + z1) / 2), (x1 - x0, wall.thickness_m, z1 - z0)
            parts.append(Part(name, centre, size, look))

    begin = 0.0
    for number, opening in enumerate(sorted(openings, key=lambda each: each.at_m)):
        first, last = max(opening.span_m[0], 0.0), min(opening.span_m[1], wall.length_m)
        add(f"solid_{number}", begin, first, 0.0, wall.height_m)
        sill = opening.sill_m if isinstance(opening, Window) else 0.0
        add(f"sill_{opening.name}", first, last, 0.0, min(sill, wall.height_m))
        add(f"lintel_{opening.name}", first, last, sill + opening.height_m, wall.height_m)
        begin = last
    add(f"solid_{len(openings)}", begin, wall.length_m, 0.0, wall.height_m)
    return tuple(parts)


def sources_of_wall(
    wall: Wall, openings: Sequence[Door | Window], *, in_world: bool = True
) -> tuple[SourceSpec, ...]:
    """One source for each steel box of a wall, and for each steel leaf of its doors.

    Args:
        wall: The wall.
        openings: Its doors and windows.
        in_world: Whether positions and axes are in world, and names begin with that of the wall; otherwise
            they are in the axes of the wall, or of a leaf's hinge.
    """

    def source(name: str, part: Part, at: Vec2, yaw: float, along: int, of: Wall | Door) -> SourceSpec:
        name, place = (f"{wall.name}_{name}", ((*at, 0.0), _turned(yaw))) if in_world else (name, None)
        return source_of(part, name, place, of.magnetization, along, of.susceptibility)

    parts = parts_of_wall(wall, openings) if MATERIALS[wall.material] in STEEL else ()
    sources = [source(part.name, part, wall.start, wall.yaw, 0, wall) for part in parts]
    for door in openings:
        made = door.leaf(wall) if isinstance(door, Door) else None
        if made and made[0].steel:
            assert isinstance(door, Door)
            part, hinge, turn = made
            yaw = wall.yaw + turn
            sources.append(source(f"{door.name}_leaf", part, wall.at(*hinge), yaw, part.along, door))
    return tuple(sources)


Fault = tuple[str, int, str, str]
"""What is wrong with walls: the table of a TOML, its number, its key, and a text with the way on."""


@dataclass(frozen=True)
class Structure:
    """Walls of a room with their doors and windows; names are set and walls are referred to by name."""

    walls: tuple[Wall, ...]
    doors: tuple[Door, ...]
    windows: tuple[Window, ...]

    sides: tuple[Wall, ...] = ()
    """Sides of the room, which doors and windows can be in too."""

    @classmethod
    def named(
        cls,
        walls: Sequence[Wall],
        doors: Sequence[Door],
        windows: Sequence[Window],
        sides: Sequence[Wall] = (),
    ) -> "Structure":
        """With default names, and walls by their names."""
        known = [replace(w, name=w.name or f"wall_{k}") for k, w in enumerate(walls)]

        def wall_of(opening: Door | Window) -> str:
            number = opening.wall if isinstance(opening.wall, int) else -1
            return known[number].name if 0 <= number < len(known) else str(opening.wall)

        return cls(
            tuple(known),
            tuple(replace(d, name=d.name or f"door_{k}", wall=wall_of(d)) for k, d in enumerate(doors)),
            tuple(replace(w, name=w.name or f"window_{k}", wall=wall_of(w)) for k, w in enumerate(windows)),
            tuple(sides),
        )

    def openings(self, wall: Wall | None = None) -> tuple[Door | Window, ...]:
        """Doors and windows in a wall, or all of them."""
        return (*self.doors, *self.windows) if wall is None else tuple(self._within.get(wall.name, ()))

    def magnetic(self) -> list[Wall | Door | Window]:
        """What makes a field: walls of steel with their openings, and doors of steel."""
        walls = [wall for wall in self.walls if MATERIALS[wall.material] in STEEL]
        cut = [each for wall in walls for each in self.openings(wall)]
        doors = [door for door in self.doors if MATERIALS.get(door.material) in STEEL and door not in cut]
        return [*walls, *cut, *doors]

    def faults(self) -> Iterator[Fault]:
        """What is wrong, in order."""
        tables: dict[str, Sequence[Wall | Door | Window]]
        tables = {"wall": self.walls, "door": self.doors, "window": self.windows}
        things = [(section, k, thing) for section in tables for k, thing in enumerate(tables[section])]
        taken = {wall.name.casefold() for wall in self.sides}
        for section, number, thing in things:
            if not (thing.name.isidentifier() and thing.name.isascii()):
                text = f"{section} {thing.name!r} cannot name a prim; use letters, digits and _"
                yield section, number, "name", text
            if thing.name.casefold() in taken:
                text = f"{section} {thing.name!r} has a name that is taken; give each its own"
                yield section, number, "name", text
            taken.add(thing.name.casefold())
        for section, number, thing in things:
            if not isinstance(thing, Wall):
                yield from self._misplaced(section, number, thing)
        yield from self._crossed()

    def _crossed(self) -> Iterator[Fault]:
        """Walls that stand in an opening of another wall; touching is not standing in it."""
        openings, none = self.openings(), np.empty((0, 4, 2))
        held = [corners_of(self.wall_of(each), each.span_m) for each in openings]
        holes = np.array(held) if openings else none
        low, high = holes.min(axis=1) - SAME_M, holes.max(axis=1) + SAME_M
        for number, wall in enumerate(self.walls if openings else ()):
            corners = corners_of(wall)
            near = np.all((np.min(corners, axis=0) < high) & (np.max(corners, axis=0) > low), axis=1)
            for opening, hole in ((openings[k], holes[k]) for k in np.flatnonzero(near)):
                if opening.wall != wall.name and overlap_m(corners, hole) > SAME_M:
                    x, y = self.wall_of(opening).at(opening.at_m)
                    text = (
                        f"wall {wall.name!r} crosses {opening.name!r} of wall {opening.wall!r} at "
                        f"({x:.2f}, {y:.2f}); end the wall before it, or move the opening (at_m)"
                    )
                    yield "wall", number, "from", text

    @cached_property
    def _known(self) -> dict[str, Wall]:
        return {wall.name: wall for wall in (*self.walls, *self.sides)}

    @cached_property
    def _within(self) -> dict[str, list[Door | Window]]:
        """Doors and windows by the name of their wall."""
        within = dict[str, list[Door | Window]]()
        for each in self.openings():
            within.setdefault(str(each.wall), []).append(each)
        return within

    def wall_of(self, opening: Door | Window) -> Wall:
        """The wall of an opening.

        Raises:
            InputError: There is no such wall.
        """
        return find("wall", str(opening.wall), self._known)

    def _misplaced(self, section: str, number: int, opening: Door | Window) -> Iterator[Fault]:
        known = self._known
        if opening.wall not in known:
            more = hint(str(opening.wall), known) if known else "the room has none; add a [[wall]]"
            yield section, number, "wall", f"no wall {opening.wall!r} for {opening.name!r}: {more}"
            return
        wall, (first, last) = self.wall_of(opening), opening.span_m
        if first < -SAME_M or last > wall.length_m + SAME_M:
            half, way = opening.width_m / 2, "make it narrower (width_m)"
            if 2 * half <= wall.length_m:
                way = f"choose at_m from {half:g} to {wall.length_m - half:g}"
            text = (
                f"{opening.name!r} reaches from {first:g} to {last:g} m along wall {wall.name!r}, which is "
                f"{wall.length_m:g} m long; {way}"
            )
            yield section, number, "at_m", text
        if isinstance(opening, Door) and opening.leaf(wall) and opening.thickness_m > wall.thickness_m:
            text = (
                f"thickness_m of {opening.name!r} must not be above that of wall {wall.name!r}, "
                f"{wall.thickness_m:g} m, got {opening.thickness_m:g}"
            )
            yield section, number, "thickness_m", text
        for other in self.openings(wall):
            if other is opening:
                break
            low, high = other.span_m
            if min(high, last) - max(low, first) > SAME_M:
                text = (
                    f"{opening.name!r} overlaps {other.name!r} in wall {wall.name!r}, from "
                    f"{max(low, first):g} to {min(high, last):g} m along it; move one of them"
                )
                yield section, number, "at_m", text

    def check(self) -> None:
        """Refuse what is wrong.

        Raises:
            InputError: The first fault, with its table.
        """
        for section, number, _, text in self.faults():
            raise InputError(f"[[{section}]] {number}: {text}")


def corners_of(wall: Wall, span_m: Vec2 | None = None) -> list[Vec2]:
    """Corners of a wall on the floor, or of a span of it, counter-clockwise."""
    (first, last), half = span_m or (0.0, wall.length_m), wall.thickness_m / 2
    return [wall.at(s, d) for s, d in ((first, -half), (last, -half), (last, half), (first, half))]


def overlap_m(one: Sequence[Vec2] | np.ndarray, other: Sequence[Vec2] | np.ndarray) -> float:
    """How deep two convex outlines are in each other [m], by their separating axes; below 0 if apart."""
    a, b = np.asarray(one, float), np.asarray(other, float)
    side = np.concatenate([np.roll(a, -1, axis=0) - a, np.roll(b, -1, axis=0) - b])
    normal = np.stack([-side[:, 1], side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    p, q = a @ normal.T, b @ normal.T
    return float(np.min(np.minimum(p.max(0), q.max(0)) - np.maximum(p.min(0), q.min(0))))


@lru_cache(maxsize=256)
def steel_of_walls(structure: Structure) -> tuple[SourceSpec, ...]:
    """Sources of all walls and doors of a room."""
    walls = (*structure.walls, *structure.sides)
    return sum((sources_of_wall(wall, structure.openings(wall)) for wall in walls), ())
