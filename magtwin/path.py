"""Path: where to drive, a line on the floor that knows its arc length."""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find, hint
from magtwin.files import existing
from magtwin.spec.obstacles import Obstacles
from magtwin.summary import Summarized, Summary, rectangle

Array = NDArray[np.float64]

MOST_POINTS = 1_000_000
"""Most points that a path is made of: 5 km of a spline's, 16 MB."""

_SAME_M = 1e-6
"""Neighbours nearer than this are one point; a line whose ends are nearer than this is closed [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class Path(Summarized):
    """A polyline in the plane of the floor, parametrised by its arc length.

    Neighbours that coincide are merged at birth. A closed path ends where it began: its first point
    is repeated at the end, and is added there if it is not.
    """

    name: str
    """What it is called: a name of `PATHS`, or the file that it came from."""

    p_xy: Array
    """Points in world [m], shape (N, 2), N >= 2."""

    closed: bool = False
    """Whether it can be driven round and round."""

    file: str = ""
    """The file that it was read from, as that was named; "" for one that came from no file."""

    placing: tuple[float, ...] = ()
    """How a path was brought onto its floor: scale in x and y, then shift in x and y [m]; () for none."""

    s: Array = field(init=False, repr=False)
    """Arc length at each point, from 0 [m], shape (N,)."""

    def __post_init__(self) -> None:
        p = np.array(self.p_xy, float)
        if p.ndim != 2 or p.shape[1] != 2:
            raise InputError(f"path {self.name!r}: points must have shape (N, 2), got {p.shape}")
        if not np.isfinite(p).all():
            row = int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])
            raise InputError(f"path {self.name!r}: point {row} is not finite: {tuple(p[row].tolist())}")
        if self.closed and len(p) > 1 and math.dist(p[0], p[-1]) >= _SAME_M:
            p = np.vstack([p, p[:1]])
        p = _without_repeats(p)
        if len(p) < 2:
            raise InputError(f"path {self.name!r}: two different points are needed, got {len(p)}")
        if self.closed:
            p[-1] = p[0]
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
        for name, array in (("p_xy", p), ("s", s)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def length(self) -> float:
        """Arc length of the whole path [m]."""
        return float(self.s[-1])

    def at(self, s: ArrayLike) -> Array:
        """Points at arc lengths `s` [m], shape (...) -> (..., 2).

        A closed path repeats with its length; an open one goes on straight beyond its ends.
        """
        s, i = self._segment(s)
        along = ((s - self.s[i]) / (self.s[i + 1] - self.s[i]))[..., None]
        return self.p_xy[i] + along * (self.p_xy[i + 1] - self.p_xy[i])

    def heading(self, s: ArrayLike) -> Array:
        """Direction of travel at arc lengths `s` [rad], in [-pi, pi], shape (...).

        At a corner it is the direction after it.
        """
        _, i = self._segment(s)
        step = self.p_xy[i + 1] - self.p_xy[i]
        return np.arctan2(step[..., 1], step[..., 0])

    def turn(self, s: ArrayLike, reach_m: float) -> Array:
        """Angle between the chords that come to and go from `s`, left positive [rad], shape (...).

        Args:
            s: Arc lengths [m], shape (...).
            reach_m: Length of path that each chord spans [m].
        """
        s = np.asarray(s, float)
        here = self.at(s)
        x0, y0 = np.moveaxis(here - self.at(s - reach_m), -1, 0)
        x1, y1 = np.moveaxis(self.at(s + reach_m) - here, -1, 0)
        return np.arctan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)

    def curvature(self, s: ArrayLike, reach_m: float = 0.02) -> Array:
        """Mean curvature over `reach_m` each way of `s`, left positive [1/m], shape (...).

        The angle between two chords over the arc between their middles, which for an arc of a circle
        of radius R is 1/R. A polyline has none of its own, so choose `reach_m` above its spacing.
        """
        return self.turn(s, reach_m) / reach_m

    def nearest(self, p_xy: ArrayLike) -> tuple[Array, Array]:
        """The nearest point of the path, exactly, to each of many points.

        Every segment is tried, in blocks of points, so time is points x segments (about 10 ns each).

        Args:
            p_xy: Points in world [m], shape (..., 2).

        Returns:
            Arc length of the nearest point [m], and signed distance from the path, left positive [m],
            each of shape (...).
        """
        q = np.asarray(p_xy, float)
        flat = q.reshape(-1, 2)
        step, ds = np.diff(self.p_xy, axis=0), np.diff(self.s)
        unit = step / ds[:, None]
        s, d = np.empty(len(flat)), np.empty(len(flat))
        block = max(1, 200_000 // len(ds))
        for first in range(0, len(flat), block):
            rows = slice(first, first + block)
            x = flat[rows, None, 0] - self.p_xy[:-1, 0]
            y = flat[rows, None, 1] - self.p_xy[:-1, 1]
            along = np.clip(x * unit[:, 0] + y * unit[:, 1], 0.0, ds)
            x -= along * unit[:, 0]
            y -= along * unit[:, 1]
            best = np.argmin(x * x + y * y, axis=1)
            pick = np.arange(len(best)), best
            s[rows] = self.s[best] + along[pick]
            left = unit[best, 0] * y[pick] - unit[best, 1] * x[pick]
            d[rows] = np.copysign(np.hypot(x[pick], y[pick]), left)
        return s.reshape(q.shape[:-1]), d.reshape(q.shape[:-1])

    def prolonged(self, length_m: float) -> "Path":
        """This path driven on until it is at least `length_m` long.

        A closed path gets further laps, an open one is driven back and forth. The result is open.
        """
        times = max(1, math.ceil(length_m / self.length))
        there, back = self.p_xy[1:], (self.p_xy if self.closed else self.p_xy[::-1])[1:]
        parts = [self.p_xy[:1], *((there, back)[n % 2] for n in range(times))]
        return Path(self.name, np.vstack(parts))

    def placed(self, placing: tuple[float, float, float, float]) -> "Path":
        """This path scaled about the world's origin, then moved.

        Args:
            placing: Scale in x and in y, above 0, then shift in x and in y [m].
        """
        if len(placing) != 4 or not (min(placing[:2]) > 0 and all(map(math.isfinite, placing))):
            raise InputError(
                f"placing of path {self.name!r} must be two scales above 0 and two shifts, got {placing}"
            )
        points = self.p_xy * np.array(placing[:2]) + np.array(placing[2:])
        return Path(self.name, points, self.closed, self.file, tuple(map(float, placing)))

    def _segment(self, s: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        s = np.asarray(s, float)
        if self.closed:
            s = s % self.length
        return s, np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)

    def _summary(self) -> Summary:
        """Name, length, extent, and where it begins and ends."""
        (x0, y0), (x1, y1) = self.p_xy.min(axis=0), self.p_xy.max(axis=0)
        (ax, ay), (bx, by) = self.p_xy[0], self.p_xy[-1]
        ends = f"begins and ends at ({ax:z.2f}, {ay:z.2f}) m"
        if not self.closed:
            ends = f"({ax:z.2f}, {ay:z.2f}) to ({bx:z.2f}, {by:z.2f}) m"
        return Summary(
            f"Path {self.name}: {self.length:.4g} m, {'closed' if self.closed else 'open'}, "
            f"{len(self.p_xy):,} points",
            (("over", rectangle(x0, x1, y0, y1)), ("ends", ends), ("file", self.file)),
        )


def sine(
    *,
    amplitude_m: float = 1.2,
    wavenumber_rad_m: float = 2 * math.pi / 2.5,
    phase_rad: float = 0.0,
    y_mid_m: float = 0.0,
    x_first_m: float = -2.5,
    x_last_m: float = 2.5,
) -> Path:
    """A sine wave along x: y = A sin(w x - x0) + y0 (eq. 7 of the neural magnetometer paper).

    Args:
        amplitude_m: A [m].
        wavenumber_rad_m: w [rad/m].
        phase_rad: x0 [rad].
        y_mid_m: y0 [m].
        x_first_m: First x [m].
        x_last_m: Last x [m].
    """
    x = np.linspace(x_first_m, x_last_m, 2001)
    y = amplitude_m * np.sin(wavenumber_rad_m * x - phase_rad) + y_mid_m
    return Path("sine", np.column_stack([x, y]))


def lawnmower(
    *,
    x_first_m: float = -2.5,
    x_last_m: float = 2.5,
    height_m: float = 3.0,
    step_m: float = 0.5,
    y_first_m: float = -1.5,
) -> Path:
    """Sweeps along y, side by side: r = f(a0, ae, h, step) (eq. 8 of the neural magnetometer paper).

    Sweep k stands at x_k = a0 + k step up to ae, and goes from y0 to y0 + h where k is even and back
    where k is odd.

    Args:
        x_first_m: a0, x of the first sweep [m].
        x_last_m: ae, no sweep lies beyond it [m].
        height_m: h, length of a sweep [m].
        step_m: Distance between sweeps [m], away from a0 or back, as a0 and ae say.
        y_first_m: y0, y of the first point [m].
    """
    if not step_m > 0:
        raise InputError(f"step_m of a lawnmower must be above 0 m, got {step_m}")
    sweeps = abs(x_last_m - x_first_m) / step_m + 1
    _check_points("lawnmower", 2 * sweeps, f"step_m {step_m:g} m from x {x_first_m:g} to {x_last_m:g} m")
    count = int(sweeps + 1e-9)
    x = np.repeat(x_first_m + math.copysign(step_m, x_last_m - x_first_m) * np.arange(count), 2)
    y = y_first_m + height_m * np.tile([0.0, 1.0, 1.0, 0.0], count)[: 2 * count]
    return Path("lawnmower", np.column_stack([x, y]))


def figure8(*, half_length_m: float = 2.4, half_width_m: float = 1.2) -> Path:
    """A figure of eight along x, from its crossing: x = a sin u, y = b sin 2u (Lissajous 1:2).

    Args:
        half_length_m: a [m].
        half_width_m: b [m].
    """
    u = np.linspace(0.0, 2 * np.pi, 2001)
    points = np.column_stack([half_length_m * np.sin(u), half_width_m * np.sin(2 * u)])
    return Path("figure8", points, closed=True)


def narrow_figure8(*, half_length_m: float = 2.4, half_width_m: float = 0.3) -> Path:
    """The figure of eight of `figure8`, so narrow that its ends are tight: their radius is 4 b^2 / a.

    Args:
        half_length_m: a [m].
        half_width_m: b [m].
    """
    return Path("narrow_figure8", figure8(half_length_m=half_length_m, half_width_m=half_width_m).p_xy, True)


def curvilinear(
    *, half_length_m: float = 2.6, half_width_m: float = 1.55, lobes: int = 5, depth: float = 0.15
) -> Path:
    """A closed curve that bends left and right, an ellipse with lobes.

    (x, y) = (a cos u, b sin u) (1 + c cos n u) / (1 + c)

    The paper calls two of its drives curvilinear and gives no equation; this one is ours.

    Args:
        half_length_m: a, which |x| does not exceed [m].
        half_width_m: b, which |y| does not exceed [m].
        lobes: n.
        depth: c, from 0, an ellipse, to below 1.
    """
    if not 0 <= depth < 1:
        raise InputError(f"depth of a curvilinear path must be at least 0 and below 1, got {depth!r}")
    if lobes % 1:
        raise InputError(f"lobes of a curvilinear path must be a whole number, got {lobes!r}")
    u = np.linspace(0.0, 2 * np.pi, 2001)
    r = (1 + depth * np.cos(lobes * u)) / (1 + depth)
    points = np.column_stack([half_length_m * r * np.cos(u), half_width_m * r * np.sin(u)])
    return Path("curvilinear", points, closed=True)


def split_lawnmower(
    *,
    x_first_m: float = -2.5,
    x_last_m: float = 2.5,
    y_first_m: float = -1.5,
    y_last_m: float = 1.5,
    y_split_m: float = 0.0,
    step_m: float = 0.5,
) -> Path:
    """A lawnmower over each half of a floor that is split in y: the first from a0 to ae, the other back.

    Args:
        x_first_m: a0, x of the first sweep [m].
        x_last_m: ae, no sweep lies beyond it [m].
        y_first_m: y at which the sweeps of the first half begin [m].
        y_last_m: y at which those of the second half end [m].
        y_split_m: y that parts the halves [m].
        step_m: Distance between sweeps, and of each half from the split line [m].
    """
    near, far = y_split_m - y_first_m, y_last_m - y_split_m
    if not (near * far > 0 and abs(near) > step_m and abs(far) > step_m):
        raise InputError(
            f"y_split_m of a split_lawnmower must lie between y_first_m {y_first_m:g} and y_last_m "
            f"{y_last_m:g}, more than step_m {step_m:g} from both, got {y_split_m:g}"
        )
    margin = math.copysign(step_m / 2, near)
    there = lawnmower(
        x_first_m=x_first_m, x_last_m=x_last_m, y_first_m=y_first_m, height_m=near - margin, step_m=step_m
    )
    x_turn = float(there.p_xy[-1, 0])
    back = lawnmower(
        x_first_m=x_turn,
        x_last_m=x_first_m,
        y_first_m=y_split_m + margin,
        height_m=far - margin,
        step_m=step_m,
    )
    return Path("split_lawnmower", np.vstack([there.p_xy, back.p_xy]))


def continuous_cycle(
    *, amplitude_m: float = 1.5, wavenumber_rad_m: float = 2 * math.pi / 5, half_length_m: float = 2.5
) -> Path:
    """A sine wave along x and its mirror image back, closed: y = -+A sin(w (x + a)).

    Args:
        amplitude_m: A [m].
        wavenumber_rad_m: w [rad/m]; a multiple of pi / 2a closes it on the x axis.
        half_length_m: a [m].
    """
    x = np.linspace(-half_length_m, half_length_m, 1001)
    y = amplitude_m * np.sin(wavenumber_rad_m * (x + half_length_m))
    there, back = np.column_stack([x, -y]), np.column_stack([x, y])[::-1]
    return Path("continuous_cycle", np.vstack([there, back]), closed=True)


def spline(p_xy: ArrayLike, *, closed: bool = False, spacing_m: float = 0.01, name: str = "spline") -> Path:
    """A smooth curve through points: a cubic spline with continuous curvature over their chord length.

    An open one has no curvature at its ends (a natural spline), a closed one is periodic.

    Args:
        p_xy: Points in world [m], shape (N, 2), neighbours apart.
        closed: Whether it goes on from the last point to the first.
        spacing_m: Distance between the points of the path, about [m].
        name: What it is called.

    Raises:
        InputError: There are fewer than three points, or `spacing_m` is not above 0 or makes too many.
    """
    from scipy.interpolate import CubicSpline  # takes half a second

    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise InputError(f"spacing_m of a spline must be above 0 m, got {spacing_m!r}")
    chords = Path(name, np.asarray(p_xy, float), closed)
    if len(chords.p_xy) < 3 + closed:
        raise InputError(f"path {name!r}: a spline needs three points that differ, got {len(chords.p_xy)}")
    curve = CubicSpline(chords.s, chords.p_xy, bc_type="periodic" if closed else "natural")
    points = chords.length / spacing_m + 1
    _check_points(name, points, f"spacing_m {spacing_m:g} m over {chords.length:g} m")
    count = max(len(chords.s), math.ceil(points))
    s = np.union1d(np.linspace(0.0, chords.length, count), chords.s)
    return Path(name, curve(s), closed)


def fast_sine() -> Path:
    """Case A of the paper's Table 1, the high-frequency sine: ten waves of 1.5 m amplitude over 5 m."""
    return Path("fast_sine", sine(amplitude_m=1.5, wavenumber_rad_m=4 * math.pi).p_xy)


def curvilinear_2() -> Path:
    """Case C of the paper's Table 1, its second curvilinear drive; it has no equation there, this is ours."""
    points = curvilinear(half_length_m=2.4, half_width_m=1.5, lobes=3, depth=0.25).p_xy
    return Path("curvilinear_2", points, closed=True)


PATHS: Mapping[str, Callable[..., Path]] = MappingProxyType(
    {
        "sine": sine,
        "lawnmower": lawnmower,
        "split_lawnmower": split_lawnmower,
        "figure8": figure8,
        "narrow_figure8": narrow_figure8,
        "continuous_cycle": continuous_cycle,
        "curvilinear": curvilinear,
        "curvilinear_2": curvilinear_2,
        "fast_sine": fast_sine,
    }
)
"""Functions that make paths, by name; their defaults fit a floor of 6 x 3.5 m, and `magtwin.placement`
brings them onto others."""

CASES: Mapping[str, str] = MappingProxyType(
    {
        "A": "fast_sine",
        "B": "curvilinear",
        "C": "curvilinear_2",
        "D": "split_lawnmower",
        "E": "narrow_figure8",
    }
)
"""Paths of the cases in Table 1 of the neural magnetometer paper (Penumarti et al. 2025)."""


def path_named(name: str) -> Path:
    """The path that `PATHS` calls `name`, or that of a case of `CASES`, with its default size.

    Raises:
        UnknownNameError: No such path; the text names the nearest one.
    """
    return find("path", CASES.get(name, name), PATHS)()


def path_of_points(p_xy: ArrayLike, name: str = "points", file: str = "") -> Path:
    """A polyline through points, as a CSV file of them gives it; closed where it ends where it began.

    Args:
        p_xy: Points in world [m], shape (N, 2), N >= 2. Neighbours that coincide are merged.
        name: What to call it.
        file: The file that they were read from.

    Raises:
        InputError: They are not finite numbers of that shape, or only one point.
    """
    try:
        p = np.asarray(p_xy, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"path {name!r}: points must be numbers of shape (N, 2) [m] ({error})") from error
    if p.ndim != 2 or p.shape[1] != 2 or not len(p):
        raise InputError(f"path {name!r}: points must have shape (N, 2) [m], got {p.shape}")
    line = _without_repeats(p)
    return Path(name, p, len(line) > 2 and math.dist(line[0], line[-1]) < _SAME_M, file)


def resolve_path(path: "str | os.PathLike[str] | ArrayLike") -> Path:
    """A path from a name of `PATHS`, a case A to E of `CASES`, a CSV file, or points of shape (N, 2) [m].

    Raises:
        InputError: It is none of these, or the file is not a path.
    """
    if not isinstance(path, str | os.PathLike):
        return path_of_points(path)
    text = os.fspath(path)
    if text in PATHS or text in CASES:
        return path_named(text)
    file = FilePath(text)
    if file.exists() or file.suffix or file.name != text:
        return read_path_csv(file)
    raise InputError(f"no path {text!r}; {hint(text, PATHS)}; or give a CSV file with x,y in metres")


def read_path_csv(file: str | os.PathLike[str]) -> Path:
    """A polyline from a CSV file of `x,y` in metres, one point a line, with or without a header.

    Neighbours that coincide are merged. A line that ends where it began is closed.

    Raises:
        InputError: The file is missing, empty, or has a line that is not two numbers.
    """
    file = existing(file, "path file")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a text file of x,y in metres ({error})") from error
    points: list[tuple[float, float]] = []
    header_seen = False
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            continue
        if len(cells) != 2:
            raise InputError(f"{file}:{number}: a point is two numbers, x,y in metres; got {line!r}")
        try:
            point = float(cells[0]), float(cells[1])
        except ValueError:
            if points or header_seen:
                raise InputError(
                    f"{file}:{number}: not a number in {line!r}; x,y in metres are wanted"
                ) from None
            header_seen = True
            continue
        if not (math.isfinite(point[0]) and math.isfinite(point[1])):
            raise InputError(f"{file}:{number}: a point must be finite, got {line!r}")
        points.append(point)
    if not points:
        raise InputError(f"{file}: no points in it; one x,y in metres a line is wanted")
    if len(_without_repeats(np.array(points))) < 2:
        raise InputError(f"{file}: only one point in it; a path needs two that differ")
    return path_of_points(points, file.name, file.as_posix())


def check_on_floor(path: Path, floor_m: tuple[float, float], footprint_radius_m: float) -> None:
    """Whether a round robot on the path stays on a floor that is centred on the world's origin.

    Args:
        path: Where its centre goes.
        floor_m: Extent of the floor in x and y [m].
        footprint_radius_m: Radius of the robot [m].

    Raises:
        InputError: It does not; the text gives the first such point and how far it is outside.
    """
    beyond = np.max(np.abs(path.p_xy) + footprint_radius_m - np.array(floor_m) / 2, axis=1)
    outside = np.flatnonzero(beyond > 1e-9)
    if len(outside):
        i = int(outside[0])
        x, y = path.p_xy[i]
        needs = np.ptp(path.p_xy, axis=0) + 2 * footprint_radius_m
        raise InputError(
            f"path {path.name} leaves the floor at point {i + 1} of {len(beyond)}, ({x:.3f}, {y:.3f}) m, by "
            f"{beyond[i]:.3f} m: with a robot of radius {footprint_radius_m:g} m it needs {needs[0]:.2f} x "
            f"{needs[1]:.2f} m, the floor is {floor_m[0]:g} x {floor_m[1]:g} m; "
            f"{_what_fits(path, floor_m, footprint_radius_m)}"
        )


def _what_fits(path: Path, floor_m: tuple[float, float], footprint_radius_m: float) -> str:
    """What would bring a path onto the floor, in words."""
    room = np.array(floor_m) - 2 * footprint_radius_m
    if min(room) <= 0:
        return "the floor is no wider than the robot; enlarge it"
    low, high = path.p_xy.min(axis=0), path.p_xy.max(axis=0)
    with np.errstate(divide="ignore"):
        scale = float(np.min(room / (high - low)))
    if scale >= 1:
        x, y = np.clip(0.0, high - room / 2, low + room / 2) * -1.0 + 0.0
        return f"moved by ({x:.2f}, {y:.2f}) m it fits: give --fit, or move its points"
    return f"scaled by {math.floor(scale * 100) / 100:g} it fits: give --fit, or enlarge the floor"


def check_clear(path: Path, obstacles: Obstacles, footprint_radius_m: float) -> None:
    """Whether a round robot on the path passes all obstacles.

    Args:
        path: Where its centre goes.
        obstacles: What it must not touch.
        footprint_radius_m: Radius of the robot [m].

    Raises:
        InputError: It touches one; the text gives the first such point and the obstacle.
    """
    step = max(footprint_radius_m / 4, path.length / 100_000)  # a straight segment may be long
    s = np.union1d(np.linspace(0.0, path.length, math.ceil(path.length / step) + 1), path.s)
    p = path.at(np.minimum(s, path.length))
    distance, which = obstacles.clearance(p, reach_m=footprint_radius_m)
    touched = np.flatnonzero(distance < footprint_radius_m - 1e-9)
    if len(touched):
        i = int(touched[0])
        raise InputError(
            f"path {path.name} runs into {obstacles.names[which[i]]}: {s[i]:.3f} m along it, at "
            f"({p[i, 0]:.3f}, {p[i, 1]:.3f}) m, a robot of radius {footprint_radius_m:g} m is "
            f"{footprint_radius_m - distance[i]:.3f} m too near; give --fit, or move the path or the obstacle"
        )


def _check_points(name: str, points: float, what: str) -> None:
    """Refuse a path of more points than there is room for, or of no number of them."""
    if not points <= MOST_POINTS:
        raise InputError(f"path {name!r}: {what} would make {points:.3g} points, more than {MOST_POINTS:,}")


def _without_repeats(p: Array) -> Array:
    """Points of (N, 2) whose neighbours differ; the first of equals stays."""
    first = np.ones(len(p), bool)
    first[1:] = np.hypot(*np.diff(p, axis=0).T) >= _SAME_M
    return p[first]
