"""Drawn worlds: rooms with iron in floor, columns and furniture, and drives through them, all from seeds.

A place is drawn from its number and a salt: so the held-out rooms, whose salt is secret, are other rooms than
the public ones. A run draws its start, path, direction, speed and the iron of its session from its own seed.
"""

import hashlib
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter1d

from magtwin.bench import world
from magtwin.bench.case import Case
from magtwin.bench.suite import Scenario
from magtwin.bench.twin_case import STREAMS, case_of
from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_yaw
from magtwin.localization.scores import SCALE_M
from magtwin.run.run import Run

Array = NDArray[np.float64]

EARTH_NT = (20_000.0, 1_000.0, -44_000.0)
"""The Earth's field, x, y and z [nT]: that of 50 deg north."""

RADIUS_M = 0.2
"""Radius of the robot [m]."""

LEVER_M = (0.05, 0.0)
"""Place of the magnetometer on it [m]."""

TRIES = 300
"""Places that are looked at for the next stretch of a path."""


class Kind(NamedTuple):
    """How a place is drawn. Lengths in m, speeds in m/s."""

    name: str
    size: tuple[float, float]
    cell: float
    depth: float  # of the iron in the floor below the sensor
    mesh: float  # Spacing of its bars; 0 for none
    clutter: float  # Pieces of iron in the floor per m^2
    columns: float  # Spacing of columns; 0 for none
    furniture: float  # Pieces of furniture per m^2
    rows: float  # Spacing of rows of shelves; 0 for none
    sd_nt: float  # Standard deviation of the field
    speed: tuple[float, float]


PLACES = (
    Kind("store room", (4, 4), 0.05, 0.50, 0.8, 1.0, 0, 0.15, 0, 3000, (0.10, 0.25)),
    Kind("office", (5, 4), 0.05, 0.55, 0, 0.6, 0, 0.15, 0, 2200, (0.12, 0.30)),
    Kind("laboratory", (6, 4), 0.05, 0.55, 0.6, 0.8, 0, 0.10, 0, 2800, (0.12, 0.30)),
    Kind("class room", (9, 7), 0.05, 0.65, 1.2, 0.5, 0, 0.12, 0, 1800, (0.15, 0.40)),
    Kind("workshop", (12, 8), 0.05, 0.60, 0, 0.6, 4, 0.10, 0, 3500, (0.15, 0.40)),
    Kind("corridor", (30, 3), 0.05, 0.65, 1.5, 0.4, 5, 0.03, 0, 2000, (0.20, 0.60)),
    Kind("canteen", (16, 12), 0.10, 0.75, 0, 0.4, 5, 0.10, 0, 1700, (0.20, 0.50)),
    Kind("garage", (24, 16), 0.10, 0.75, 1.5, 0.3, 6, 0.02, 0, 2500, (0.25, 0.70)),
    Kind("hall", (40, 25), 0.10, 0.80, 0, 0.3, 8, 0.02, 0, 2000, (0.30, 0.80)),
    Kind("factory", (60, 40), 0.10, 0.85, 2.0, 0.2, 10, 0.03, 0, 3000, (0.30, 0.90)),
    Kind("warehouse", (48, 30), 0.10, 0.80, 2.5, 0.2, 0, 0.0, 4, 3000, (0.30, 0.90)),
    Kind("outdoor course", (120, 80), 0.25, 4.00, 0, 0.05, 0, 0.002, 0, 900, (0.60, 1.50)),
)


@dataclass(frozen=True, eq=False)
class Place:
    """A place: its field, and where a robot can be."""

    field: AnomalyMap
    clear_m: Array
    """Distance of each node of the field from what stands there, and from the walls [m], shape (Y, X)."""

    length_m: float
    """Distance over which the field changes: sqrt(2) times its sd over its root mean square gradient."""

    kind: Kind


def words(*parts: object) -> list[int]:
    """Words of a seed that tells nothing of its parts."""
    digest = hashlib.sha256(repr(parts).encode()).digest()
    return np.frombuffer(digest, np.uint32).tolist()


@lru_cache(maxsize=16)
def place(number: int, salt: str) -> Place:
    """The place of a number in `PLACES`.

    Its field is that of sheets of dipoles, one a spot of iron: the potential of a sheet of moments m at a
    height z above it is, by wave number k, mu0 / 2 (m_z - i (k m) / |k|) exp(-|k| z) (Blakely 1995, ch. 11).
    """
    kind = PLACES[number]
    rng = np.random.default_rng(words("place", kind.name, salt))
    sides = [side * rng.uniform(0.9, 1.1) for side in kind.size]
    columns, rows = (round(side / kind.cell) + 1 for side in sides)
    solid = np.zeros((rows, columns), bool)
    floor, standing = np.zeros((3, rows, columns)), np.zeros((3, rows, columns))
    main = rng.normal(size=3) + np.array([0.0, 0.0, -2.0])  # most iron is magnetised alike

    def iron(sheet: Array, at: NDArray[Any], strength: float) -> None:
        moment = strength * (main + rng.normal(size=(len(at), 3))) * rng.lognormal(0, 0.5, (len(at), 1))
        for part, moments in zip(sheet, moment.T, strict=True):
            np.add.at(part, tuple(at[:, ::-1].T), moments)

    def spots(count: float) -> Array:
        return np.column_stack([rng.integers(n, size=max(1, round(count))) for n in (columns, rows)])

    area = sides[0] * sides[1]
    iron(floor, spots(kind.clutter * area), 1.0)
    if kind.mesh:
        for axis, many in ((0, columns), (1, rows)):
            lines = np.arange(rng.uniform(0, kind.mesh), many * kind.cell, kind.mesh) / kind.cell
            along = np.arange(0, (rows, columns)[axis], max(1, round(0.3 / kind.cell)))
            pairs = np.array([(int(a), b) for a in lines for b in along])
            iron(floor, pairs if axis == 0 else pairs[:, ::-1], 0.15)

    def stand(x: float, y: float, wide: float, deep: float, strength: float) -> None:
        size = np.array([wide, deep])
        low = np.maximum(np.rint((np.array([x, y]) - size / 2) / kind.cell).astype(int), 0)
        high = np.minimum(low + np.rint(size / kind.cell).astype(int) + 1, [columns, rows])
        solid[low[1] : high[1], low[0] : high[0]] = True
        if (low < high).all():
            iron(standing, rng.integers(low, high, (max(2, round(2 * wide * deep)), 2)), strength)

    if kind.columns:
        begin = rng.uniform(0.3, 0.7, 2) * kind.columns
        for x in np.arange(begin[0], sides[0], kind.columns):
            for y in np.arange(begin[1], sides[1], kind.columns):
                stand(x, y, 0.4, 0.4, 2.0)
    for _ in range(round(kind.furniture * area)):
        (x, y), (wide, deep) = rng.uniform(0, sides), rng.uniform(0.4, 1.6, 2)
        stand(x, y, wide, deep, rng.choice([0.2, 1.2]))
    for y in np.arange(kind.rows, sides[1] - kind.rows / 2, kind.rows) if kind.rows else ():
        gap = rng.uniform(0.3, 0.7) * sides[0]  # a way through
        for x0, x1 in ((2.5, gap - 1.5), (gap + 1.5, sides[0] - 2.5)):
            if x1 > x0:
                stand((x0 + x1) / 2, y, x1 - x0, 1.0, 1.5)
    field = _field((floor, standing), (kind.depth, 1.5 * kind.depth), kind.cell)
    field *= kind.sd_nt * np.linalg.norm(EARTH_NT) / np.std(field @ EARTH_NT)
    total = np.linalg.norm(field + EARTH_NT, axis=-1)
    slope = np.gradient(total, kind.cell)
    made = AnomalyMap(
        values_nt=total[None],
        origin_m=(-sides[0] / 2, -sides[1] / 2),
        cell_m=(kind.cell, kind.cell),
        headings_rad=np.zeros(1),
        variance_nt2=np.zeros((1, rows, columns)),
        name=kind.name,
    )
    free = np.pad(~solid, 1)  # with walls
    clear = np.asarray(distance_transform_edt(free))[1:-1, 1:-1] * kind.cell
    length = math.sqrt(2) * total.std() / math.sqrt(np.mean(slope[0] ** 2 + slope[1] ** 2))
    return Place(made, clear, float(length), kind)


def _field(sheets: tuple[Array, ...], heights_m: tuple[float, ...], cell_m: float) -> Array:
    """Field above sheets of dipoles, to a factor, shape (Y, X, 3)."""
    _, rows, columns = sheets[0].shape
    pad = [round(4 * max(heights_m) / cell_m)] * 2
    shape = (rows + pad[0], columns + pad[1])
    kx, ky = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n, cell_m) for n in shape[::-1]))
    k = np.hypot(kx, ky)
    k[0, 0] = 1.0
    potential = np.zeros(shape, complex)
    for sheet, height in zip(sheets, heights_m, strict=True):
        x, y, z = (np.fft.fft2(part, shape) for part in sheet)
        potential += (z - 1j * (kx * x + ky * y) / k) * np.exp(-k * height)
    potential[0, 0] = 0.0
    parts = [np.fft.ifft2(factor * potential).real for factor in (-1j * kx, -1j * ky, k)]
    return np.stack(parts, axis=-1)[:rows, :columns]


def drive(place: Place, duration_s: float, rate_hz: float, rng: np.random.Generator) -> Run:
    """A drive at nearly constant speed along a smooth path from one free spot in sight to the next.

    Raises:
        InputError: The place has no room for the robot.
    """
    speed = rng.uniform(*place.kind.speed) * (1 + 0.2 * np.sin(rng.uniform(0, 6) + np.arange(256) / 20))
    cell, window = place.kind.cell, max(4 * RADIUS_M, 2.5 * float(speed.max()))
    needed_m = duration_s * speed.max() + 2 * window
    margin = min(RADIUS_M + window / 8, 0.7 * float(place.clear_m.max()))  # the mean cuts a corner by less
    ys, xs = np.nonzero(place.clear_m >= margin)
    spots = np.column_stack([xs, ys]) * cell
    if len(spots) < 2:
        raise InputError(f"{place.kind.name}: no room for a robot of radius {RADIUS_M:g} m")
    path, length, ends = [spots[rng.integers(len(spots))]], 0.0, 0
    far = 0.25 * float(np.ptp(spots, axis=0).max())
    while length < needed_m:
        tried = spots[rng.integers(len(spots), size=TRIES)] - path[-1]
        away = np.hypot(*tried.T)
        before = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
        turned = tried @ before / np.maximum(away * np.hypot(*before), 1e-9)  # cosine of the turn
        order = np.argsort(np.abs(away - rng.uniform(0.5, 1.5) * far) + 1e3 * (turned < -0.5), kind="stable")
        for k in order[(away[order] > window / 2) & (turned[order] > -0.95)]:
            if _sees(place, path[-1], path[-1] + tried[k], margin):
                spot, step = path[-1] + tried[k], float(away[k])
                break
        else:  # a dead end: begin anew elsewhere
            path, length = [spots[rng.integers(len(spots))]], 0.0
            ends += 1
            if ends > TRIES:
                raise InputError(
                    f"{place.kind.name}: no path of {needed_m:.0f} m for a robot of {RADIUS_M:g} m"
                )
            continue
        path.append(spot)
        length += step
    corners = np.array(path)
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    fine = np.arange(0.0, at[-1], RADIUS_M / 10)
    line = np.column_stack([np.interp(fine, at, corners[:, k]) for k in range(2)])
    for _ in range(2):  # twice: the curvature has no jumps
        line = uniform_filter1d(line, round(window / (RADIUS_M / 10) / 2), axis=0, mode="nearest")
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    travelled = np.concatenate([[0.0], np.cumsum(speed)]) * duration_s / len(speed)
    way = window + np.interp(t, np.linspace(0, duration_s, len(travelled)), travelled)
    p = np.column_stack([np.interp(way, s, line[:, k]) for k in range(2)])
    slope = np.gradient(line, axis=0)
    heading = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
    yaw = np.interp(way, s, heading)
    p += place.field.origin_m
    columns = {"t": t, "p_world_base": np.column_stack([p, np.zeros(len(t))]), "yaw": yaw}
    columns["q_world_base_xyzw"] = quat_from_yaw(yaw)
    return Run(columns, {"sensor_m": f"{LEVER_M[0]},{LEVER_M[1]},0"})


def _sees(place: Place, a: Array, b: Array, margin_m: float) -> bool:
    """Whether a robot can drive straight from a to b."""
    cell = place.kind.cell
    line = np.linspace(a, b, max(2, math.ceil(np.hypot(*(b - a)) / cell))) / cell
    columns, rows = np.rint(line).astype(int).T
    return bool((place.clear_m[rows, columns] >= margin_m).all())


def drawn_case(scenario: Scenario, seed: int, salt: str = "") -> Case:
    """One run of a scenario in a drawn place.

    Args:
        scenario: The scenario. Some of its lengths are meant for a field that changes over `SCALE_M`, and
            grow with the place's `length_m`: those of the map's error, its nodes, and kidnaps; as do errors
            that count as near or far.
        seed: Seed of the run; its place is that of this number modulo the number of places.
        salt: Salt of the suite's seeds.
    """
    known = {kind.name: k for k, kind in enumerate(PLACES)}
    numbers = [find("place", name, known) for name in scenario.places] or list(known.values())
    here = place(numbers[seed % len(numbers)], salt)
    times = here.length_m / SCALE_M
    kidnap_m = (scenario.kidnap_m[0] * times, scenario.kidnap_m[1] * times)
    scenario = replace(scenario, map_length_m=scenario.map_length_m * times, kidnap_m=kidnap_m)
    rngs = np.random.default_rng(words("run", seed, salt)).spawn(len(STREAMS) + 2)
    streams = dict(zip(STREAMS, rngs, strict=False))
    length = scenario.duration_s * (2 if scenario.kidnaps else 1)
    driven = drive(here, length, scenario.rate_hz, rngs[-1])

    def belief(rng: np.random.Generator) -> AnomalyMap | None:
        if scenario.belief == "none":
            return None
        if scenario.belief == "trilinear":
            return world.trilinear(here.field, scenario.survey_spacing_m * times)
        if scenario.map_error_nt:
            return world.with_error(here.field, scenario.map_error_nt, scenario.map_length_m, rng)
        return here.field

    iron = rngs[-2].normal(0.0, 1.0, 2)
    return case_of(scenario, driven, here.field, belief, iron, streams, scale_m=here.length_m)
