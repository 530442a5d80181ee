"""Plan: a path cut at sharp corners and smoothed, with a speed for every 5 mm."""

import bisect
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.path import Path
from magtwin.run import mapped
from magtwin.spec.drive import DriveSpec

Array = NDArray[np.float64]

LIMIT_SHARE = 0.8
"""Share of the drive's limits used by the plan; feedback has the rest."""

SLOWEST = 0.02
"""Least planned speed inside a piece [m/s]."""

_WHEEL_SHARE = 0.95
"""Share of the wheels' highest rate used by the plan; feedback needs the rest in sharp bends only."""

NODE_M = 0.005
"""Spacing of a piece's nodes [m]."""

_JITTER_M = 0.005
"""Distance below which a point of a path is dropped as noise of its recording [m]."""

_COINCIDENT_M = 1e-5
"""Distance below which smoothed nodes of a zigzag are merged [m]."""

_SMOOTH_M = 0.06
"""Half the base of the triangular window that smooths a piece [m]; a corner of 45 deg loses 8 mm."""

_CORNER_REACH_M = 0.03
"""Length of the chords before and after a point that measure its turn [m]."""

_CORNER_RAD = math.radians(45.0)
"""Angle above which the robot stops to turn [rad]: a bend of radius below about 4 cm."""


_TURN_SHARE, _TURN_SLACK = 0.2, 1.02
"""Length of the chords that measure how tightly a path turns, in turning radii, and the tolerance of it."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a path between two stops, ready to be driven; arrays of its M nodes."""

    x: Array
    """Nodes in world [m], evenly apart on the path."""

    y: Array
    """Nodes in world [m]."""

    heading: Array
    """Direction of travel at each node [rad], without jumps."""

    curvature: Array
    """Its change per metre [1/m], left positive."""

    speed2: Array
    """Squared planned speed at each node [m2/s2], linear between them: constant acceleration."""

    left_m: Array
    """Distance from each node to the end of the piece along the path [m]."""


def corners(path: Path) -> Array:
    """Arc lengths of the sharp corners of a path [m], ascending, shape (C,).

    Among points nearer to each other than the chords that measure the turn, only the sharpest counts.
    """
    s = path.s[1:-1]
    turn = np.empty(len(s))
    for rows in _blocks(len(s)):
        turn[rows] = np.abs(path.turn(s[rows], _CORNER_REACH_M))
    sharp = np.flatnonzero(turn > _CORNER_RAD)
    chosen: list[float] = []
    for i in sharp[np.argsort(-turn[sharp], kind="stable")]:
        place = bisect.bisect(chosen, s[i])
        near = chosen[max(place - 1, 0) : place + 1]
        if all(abs(s[i] - other) >= _CORNER_REACH_M for other in near):
            chosen.insert(place, float(s[i]))
    return np.array(chosen)


def plan(path: Path, drive: DriveSpec, *, speed: float) -> list[Piece]:
    """The pieces of a path with their planned speeds.

    A planned speed is at most `speed` and keeps w = k v, dw/dt = (dk/ds) v^2 and the rate of the outer wheel,
    v (1 + |k| b / 2) / r, within the drive's limits. Each piece begins and ends with a stop, within the limit
    of acceleration.
    """
    check_speed(speed, drive)
    if drive.turning_radius_m:
        _check_turns(path, drive.turning_radius_m)
    stops = np.concatenate([[0.0], corners(path), [path.length]])
    return [_piece(path, a, b, drive, speed) for a, b in itertools.pairwise(stops)]


def check_speed(speed: float, drive: DriveSpec) -> None:
    """Refuse a speed [m/s] that is not above 0 or is more than the drive allows."""
    top = min(drive.v_max, drive.wheel_rate_max * drive.wheel_radius_m)
    if not 0 < speed <= top:
        which = "v_max" if top == drive.v_max else "wheel_rate_max times its wheels' radius"
        text = f"speed must be above 0 and at most {top:g} m/s, the drive's {which}; got {speed!r}"
        raise InputError(text, parameter="speed")


def _check_turns(path: Path, turning_radius_m: float) -> None:
    """Refuse a path that turns more tightly than a robot can.

    The radius at a point is L / a, for chords of length L before and after it that differ by the angle a.
    """
    chord = max(_CORNER_REACH_M, _TURN_SHARE * turning_radius_m)
    s = np.arange(chord, path.length - chord, chord / 2)
    turn = np.abs(path.turn(s, chord))
    if len(s) and turn.max() * turning_radius_m > _TURN_SLACK * chord:
        place = s[int(np.argmax(turn))]
        (x, y), radius = path.at(np.array([place]))[0], chord / turn.max()
        raise InputError(
            f"path {path.name}: it turns with a radius of {radius:.2g} m at ({x:.2f}, {y:.2f}) m, and this "
            f"robot steers like a car, with a turning_radius_m of {turning_radius_m:.3g}; take a wider path",
            parameter="path",
        )


def _piece(path: Path, s_first: float, s_last: float, drive: DriveSpec, speed: float) -> Piece:
    count = max(3, math.ceil((s_last - s_first) / NODE_M) + 1)
    s, p = np.linspace(s_first, s_last, count), np.empty((count, 2))
    for rows in _blocks(count):
        p[rows] = path.at(np.minimum(s[rows], path.length))
    # Past its ends the piece is continued by point reflection, so that smoothing leaves the ends in place.
    reach = min(round(_SMOOTH_M / 2 / NODE_M), count - 1)
    before, after = 2 * p[0] - p[reach:0:-1], 2 * p[-1] - p[-2 : -reach - 2 : -1]
    window = 1.0 - np.abs(np.arange(-reach, reach + 1)) / (reach + 1)
    longer = np.vstack([before, p, after])
    x, y = (np.convolve(axis, window / window.sum(), mode="valid") for axis in longer.T)
    apart = np.hypot(np.diff(x, prepend=np.inf), np.diff(y, prepend=np.inf)) > _COINCIDENT_M
    keep = np.flatnonzero(apart[:-1])
    if not apart[-1] and len(keep) > 1:
        keep = keep[:-1]  # keeps the end, and no segment has length 0
    x, y = np.append(x[keep], x[-1]), np.append(y[keep], y[-1])
    del s, p, longer, apart, keep  # a piece of a day takes 33 MB a column

    dx, dy = np.gradient(x), np.gradient(y)
    ds = np.maximum(np.hypot(dx, dy), 1e-9)
    heading = np.unwrap(np.arctan2(dy, dx))
    curvature = np.gradient(heading) / ds
    bend = np.abs(np.gradient(curvature)) / ds
    del dx, dy, ds
    rim = _WHEEL_SHARE * drive.wheel_rate_max * drive.wheel_radius_m
    with np.errstate(divide="ignore"):
        v = LIMIT_SHARE * drive.w_max / np.abs(curvature)
        v = np.minimum(v, np.sqrt(LIMIT_SHARE * drive.alpha_max / bend))
    v = np.minimum(v, rim / (1 + np.abs(curvature) * drive.wheel_separation_m / 2))
    v2 = np.clip(v, min(SLOWEST, speed), speed) ** 2
    del v, bend
    v2[[0, -1]] = 0.0
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    gain = 2 * LIMIT_SHARE * drive.a_max * driven
    v2 = np.minimum.accumulate(v2 - gain) + gain
    v2 = (np.minimum.accumulate((v2 + gain)[::-1]))[::-1] - gain
    left = np.arange(len(x) - 1, -1, -1) * ((s_last - s_first) / (count - 1))
    return Piece(x, y, heading, curvature, np.maximum(v2, 0.0), np.asarray(left, float))


def _blocks(count: int) -> list[slice]:
    """Slices of at most `mapped.BLOCK` rows, to compute long columns with little memory."""
    return [slice(first, first + mapped.BLOCK) for first in range(0, count, mapped.BLOCK)]


def drivable(path: Path) -> Path:
    """A path without the noise of its recording: points at least 5 mm from the one before.

    Its first and last points stay. A robot that was recorded at rest leaves a knot of points that no robot
    can follow.
    """
    if np.diff(path.s).min() >= _JITTER_M:
        return path
    near2 = _JITTER_M**2
    points = path.p_xy.tolist()
    kept = [points[0]]
    x, y = points[0]
    for px, py in points[1:]:
        if (px - x) ** 2 + (py - y) ** 2 >= near2:
            kept.append([px, py])
            x, y = px, py
    if len(kept) == 1:
        raise InputError(f"path {path.name}: it lies within {_JITTER_M:g} m, so there is nowhere to drive")
    if kept[-1] != points[-1]:
        if len(kept) > 2:
            kept.pop()
        kept.append(points[-1])
    return Path(path.name, np.array(kept), path.closed)
