"""Named paths: curves by an equation, each with a default size.

To add one without a fork, decorate a function that returns a `Path` and has defaults for all parameters, or
name it as an entry point of group `magtwin.paths`:

    from magtwin.path import Path, path

    @path("triangle")
    def triangle() -> Path:
        return Path("triangle", [[0, 0], [2, 0], [1, 1]], closed=True)

Default sizes fit a floor of 6 x 3.5 m; `magtwin.path.room.path_in` scales a path to other floors.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.path.polyline import Path

MOST_POINTS = 1_000_000  # Most points of a path
PATHS: Registry[Callable[..., Path]] = Registry("path", "paths")  # Functions that make paths, by name
path = PATHS.register  # Decorator that gives a function a name in `PATHS`


@path("sine")
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


@path("lawnmower")
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
    if not 2 * sweeps <= MOST_POINTS:
        what = (
            f"step_m {step_m:g} m from x {x_first_m:g} to {x_last_m:g} m would make {2 * sweeps:.3g} points"
        )
        raise InputError(f"path 'lawnmower': {what}, more than {MOST_POINTS:,}")
    count = int(sweeps + 1e-9)
    x = np.repeat(x_first_m + math.copysign(step_m, x_last_m - x_first_m) * np.arange(count), 2)
    y = y_first_m + height_m * np.tile([0.0, 1.0, 1.0, 0.0], count)[: 2 * count]
    return Path("lawnmower", np.column_stack([x, y]))


@path("split_lawnmower")
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
    halves, ends = [], (x_first_m, x_last_m)
    for y_m, height_m in ((y_first_m, near - margin), (y_split_m + margin, far - margin)):
        sweeps = {"x_first_m": ends[0], "x_last_m": ends[1], "y_first_m": y_m, "height_m": height_m}
        halves.append(lawnmower(step_m=step_m, **sweeps).p_xy)
        ends = float(halves[0][-1, 0]), x_first_m
    return Path("split_lawnmower", np.vstack(halves))


@path("figure8")
def figure8(*, half_length_m: float = 2.4, half_width_m: float = 1.2) -> Path:
    """A figure of eight along x, from its crossing: x = a sin u, y = b sin 2u (Lissajous 1:2).

    Args:
        half_length_m: a [m].
        half_width_m: b [m].
    """
    u = np.linspace(0.0, 2 * np.pi, 2001)
    points = np.column_stack([half_length_m * np.sin(u), half_width_m * np.sin(2 * u)])
    return Path("figure8", points, closed=True)


@path("narrow_figure8")
def narrow_figure8(*, half_length_m: float = 2.4, half_width_m: float = 0.3) -> Path:
    """The figure of eight of `figure8`, so narrow that its ends are tight: their radius is 4 b^2 / a.

    Args:
        half_length_m: a [m].
        half_width_m: b [m].
    """
    return Path("narrow_figure8", figure8(half_length_m=half_length_m, half_width_m=half_width_m).p_xy, True)


@path("continuous_cycle")
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


@path("loops")
def loops(
    *, count: int = 5, radius_m: float = 0.5, half_length_m: float = 2.3, half_width_m: float = 1.2
) -> Path:
    """Loops across the floor, to calibrate a magnetometer by: every heading in every part, in a minute.

    A point on a circle whose middle moves along a sine wave, u from 0 to 1,

        x = (a - r) (2 u - 1) + r cos(2 pi n u),   y = (b - r) sin(2 pi u) + r sin(2 pi n u)

    Args:
        count: Number of loops n.
        radius_m: Radius r [m].
        half_length_m: a [m].
        half_width_m: b [m].
    """
    u = np.linspace(0.0, 1.0, 4001)
    turn = 2 * np.pi * count * u
    x = (half_length_m - radius_m) * (2 * u - 1) + radius_m * np.cos(turn)
    y = (half_width_m - radius_m) * np.sin(2 * np.pi * u) + radius_m * np.sin(turn)
    return Path("loops", np.column_stack([x, y]))


@path("curvilinear")
def curvilinear(
    *, half_length_m: float = 2.6, half_width_m: float = 1.55, lobes: int = 5, depth: float = 0.15
) -> Path:
    """A closed curve that bends left and right, an ellipse with lobes.

    (x, y) = (a cos u, b sin u) (1 + c cos n u) / (1 + c)

    The paper calls two of its drives curvilinear without an equation; this one is ours.

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


@path("curvilinear_2")
def curvilinear_2() -> Path:
    """Case C of the paper's Table 1, its second curvilinear drive; no equation is published, this is ours."""
    points = curvilinear(half_length_m=2.4, half_width_m=1.5, lobes=3, depth=0.25).p_xy
    return Path("curvilinear_2", points, closed=True)


@path("fast_sine")
def fast_sine() -> Path:
    """Case A of the paper's Table 1, the high-frequency sine: ten waves of 1.5 m amplitude over 5 m."""
    return Path("fast_sine", sine(amplitude_m=1.5, wavenumber_rad_m=4 * math.pi).p_xy)


# Paths of the cases in Table 1 of the neural magnetometer paper (Penumarti et al. 2025).
_OF_CASES = ("fast_sine", "curvilinear", "curvilinear_2", "split_lawnmower", "narrow_figure8")
CASES: Mapping[str, str] = MappingProxyType(dict(zip("ABCDE", _OF_CASES, strict=True)))


def path_named(name: str) -> Path:
    """The path that `PATHS` calls `name`, or that of a case of `CASES`, with its default size.

    Raises:
        UnknownNameError: There is no such path; the text has the nearest name.
    """
    return PATHS[CASES.get(name, name)]()
