"""The path follower: what a differential drive is commanded, 50 times a second, to stay on a path.

Before the drive, arrays: the path is cut where it turns too sharply to be driven round, each piece is
smoothed a little, and gets a speed for every 5 mm that keeps the drive's limits. During the drive,
scalars: a control step looks at the pose, and is a few microseconds of plain Python.
"""

import bisect
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError
from magtwin.path import Path
from magtwin.sim.drive import Motion, Pose, limiter
from magtwin.spec import DriveSpec

Array = NDArray[np.float64]

CONTROL_RATE_HZ = 50.0
"""Control steps a second [Hz]."""

LONGEST_S = 86_400.0
"""Longest run [s]: 11.7 million readings at 135 Hz, which still fit into the memory of a laptop."""

_NODE_M = 0.005
"""Spacing of a piece's nodes [m]."""

_JITTER_M = 0.005
"""Points of a path nearer than this to the last one that counts do not count [m]: a recorded path's noise."""

_LOST_M = 0.05
"""Distance from the path beyond which the robot drives straight back to where it left it [m]."""

_STUCK_M = 0.03
"""Way driven without getting abreast of the next node after which it counts as passed [m]."""

_COINCIDENT_M = 1e-5
"""Smoothed nodes of a zigzag that come nearer than this are one [m]."""

_SMOOTH_M = 0.06
"""Half the base of the triangular window that smooths a piece [m]; a corner of 45 deg loses 8 mm."""

_CORNER_REACH_M = 0.03
"""Chords this long before and after a point tell how sharply the path turns there [m]."""

_CORNER_RAD = math.radians(45.0)
"""A turn sharper than this is made standing [rad]: a bend of radius below about 4 cm."""

_LIMIT_SHARE = 0.8
"""Share of the drive's limits that is planned with; the rest is left to feedback."""

_SETTLE_M = 0.15
"""Way in which an error in position dies out, twice the time constant of the feedback [m]."""

_ALIGN = (0.1, 0.35)
"""Heading errors at which driving slows, and at which it stops until the robot has turned [rad]."""

_SLOWEST = 0.02
"""Least planned speed inside a piece [m/s]."""

_CREEP = 0.01
"""Speed at which a piece is begun and ended [m/s]; one step of it is 0.2 mm."""

_TURN_GAIN = 3.9
"""Gain of turning on the spot [1/s]: below alpha_max / w_max = 4.1, so that it need not overshoot."""

_ARRIVED_M = 0.0005
"""A piece has been driven when this much of it is left [m]."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of path between two stops, ready to be followed; lists, as the loop reads scalars."""

    x: list[float]
    """Nodes in world [m], M of them, evenly apart on the path."""

    y: list[float]
    """Nodes in world [m]."""

    heading: list[float]
    """Direction of travel at each node [rad], without jumps."""

    curvature: list[float]
    """Its change per metre [1/m], left positive."""

    speed2: list[float]
    """Squared planned speed at each node [m2/s2], linear between them: constant acceleration."""

    spacing_m: float
    """Distance between nodes [m]."""


def corners(path: Path) -> Array:
    """Arc lengths at which a path turns too sharply to be driven round [m], ascending, shape (C,).

    Of points nearer to each other than the chords that measure the turn, only the sharpest counts.
    """
    s = path.s[1:-1]
    turn = np.abs(path.turn(s, _CORNER_REACH_M))
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

    A planned speed is at most `speed`, keeps w = k v and dw/dt = (dk/ds) v^2 within the drive's
    limits, and is reached and left again with the drive's acceleration, from and to a stop.

    Args:
        path: Where to drive, taken as an open line.
        drive: Limits.
        speed: Wanted forward speed [m/s].

    Raises:
        RefusedError: `speed` is not above 0 or is more than the drive allows.
    """
    if not 0 < speed <= drive.v_max:
        raise RefusedError(
            f"speed must be above 0 and at most {drive.v_max:g} m/s, the drive's v_max; got {speed!r}"
        )
    stops = np.concatenate([[0.0], corners(path), [path.length]])
    return [_piece(path, a, b, drive, speed) for a, b in itertools.pairwise(stops)]


def _piece(path: Path, s_first: float, s_last: float, drive: DriveSpec, speed: float) -> Piece:
    count = max(3, math.ceil((s_last - s_first) / _NODE_M) + 1)
    s = np.linspace(s_first, s_last, count)
    p = path.at(np.minimum(s, path.length))
    # Past its ends the piece goes on turned by half a circle about them, so that the ends stay.
    reach = min(round(_SMOOTH_M / 2 / _NODE_M), count - 1)
    before, after = 2 * p[0] - p[reach:0:-1], 2 * p[-1] - p[-2 : -reach - 2 : -1]
    window = 1.0 - np.abs(np.arange(-reach, reach + 1)) / (reach + 1)
    longer = np.vstack([before, p, after])
    x, y = (np.convolve(axis, window / window.sum(), mode="valid") for axis in longer.T)
    apart = np.hypot(np.diff(x, prepend=np.inf), np.diff(y, prepend=np.inf)) > _COINCIDENT_M
    keep = np.flatnonzero(apart[:-1])
    if not apart[-1] and len(keep) > 1:
        keep = keep[:-1]  # so that the end stays, and no segment is without length
    x, y = np.append(x[keep], x[-1]), np.append(y[keep], y[-1])

    dx, dy = np.gradient(x), np.gradient(y)
    ds = np.maximum(np.hypot(dx, dy), 1e-9)
    heading = np.unwrap(np.arctan2(dy, dx))
    curvature = np.gradient(heading) / ds
    bend = np.abs(np.gradient(curvature)) / ds
    with np.errstate(divide="ignore"):
        v = np.minimum(
            _LIMIT_SHARE * drive.w_max / np.abs(curvature), np.sqrt(_LIMIT_SHARE * drive.alpha_max / bend)
        )
    v2 = np.clip(v, min(_SLOWEST, speed), speed) ** 2
    v2[[0, -1]] = 0.0
    gain = (
        2 * _LIMIT_SHARE * drive.a_max * np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    )
    v2 = np.minimum.accumulate(v2 - gain) + gain
    v2 = (np.minimum.accumulate((v2 + gain)[::-1]))[::-1] - gain
    v2 = np.maximum(v2, 0.0)
    return Piece(
        x.tolist(),
        y.tolist(),
        heading.tolist(),
        curvature.tolist(),
        v2.tolist(),
        (s_last - s_first) / (count - 1),
    )


class Follower:
    """A controller: the twist to command at a pose, step by step along a path.

    Position: the wanted heading leans towards the path, by atan(d / L) for a distance d from it.
    Heading: w = v k + (4 / L) max(v, v_turn) (wanted - actual), which for small errors is critically
    damped, with both poles at -2 / L per metre driven. Forward speed is the planned one, none while
    the heading is far off: so corners are turned on the spot. A robot that was carried away drives
    straight back to where it left the path.
    """

    def __init__(self, pieces: list[Piece], drive: DriveSpec, *, speed: float, dt: float) -> None:
        self._pieces = pieces
        self._limit = limiter(drive, dt)
        self._dt = dt
        self._gain = 4.0 / _SETTLE_M
        self._v_turn = _TURN_GAIN / self._gain
        self._w_path = _LIMIT_SHARE * drive.w_max
        self._brake = 2 * _LIMIT_SHARE * drive.a_max
        self._lost2 = (_LOST_M + drive.v_max * dt) ** 2
        self._speed = speed
        self._creep = min(_CREEP, speed)
        self._number = 0
        self._node = 0
        self._driven = 0.0

    @property
    def done(self) -> bool:
        """Whether the end of the path was reached; commands then bring the robot to a stand."""
        return self._number == len(self._pieces)

    def command(self, x: float, y: float, yaw: float, v: float, w: float) -> tuple[float, float]:
        """The next forward speed [m/s] and yaw rate [rad/s], within the drive's limits.

        Args:
            x: Position in world [m].
            y: Position in world [m].
            yaw: Heading in world [rad].
            v: Last forward speed [m/s].
            w: Last yaw rate [rad/s].
        """
        if self._number == len(self._pieces):
            return self._limit(0.0, 0.0, v, w)
        piece = self._pieces[self._number]
        xs, ys, headings = piece.x, piece.y, piece.heading
        i, last = self._node, len(xs) - 2
        ex, ey = x - xs[i], y - ys[i]
        if ex * ex + ey * ey > self._lost2:
            planned = min(self._speed, math.sqrt(self._brake * math.hypot(ex, ey)))
            return self._steer(planned, 0.0, math.atan2(-ey, -ex) - yaw, v, w)
        self._driven += v * self._dt
        if self._driven > _STUCK_M and i < last:  # a knot, in which nodes lie behind each other
            i += 1
            self._driven = 0.0
            ex, ey = x - xs[i], y - ys[i]
        while True:  # the segment that the robot is abreast of, never going back
            dx, dy = xs[i + 1] - xs[i], ys[i + 1] - ys[i]
            length2 = dx * dx + dy * dy
            along = (ex * dx + ey * dy) / length2
            if along < 1.0 or i == last:
                break
            i += 1
            self._driven = 0.0
            ex, ey = x - xs[i], y - ys[i]
        self._node = i
        spacing = piece.spacing_m
        left_m = (last + 1 - i - along) * spacing
        if left_m < _ARRIVED_M:
            self._number += 1
            self._node, self._driven = 0, 0.0
            return self._limit(0.0, 0.0, v, w)
        offset = (dx * ey - dy * ex) / math.sqrt(length2)
        # The plan is read where this step will end.
        ahead = i + (along if along > 0.0 else 0.0) + v * self._dt / spacing
        j = int(ahead)
        part = ahead - j
        if j > last:
            j, part = last, 1.0
        speed2 = piece.speed2
        planned = math.sqrt(speed2[j] + part * (speed2[j + 1] - speed2[j]))
        heading = headings[j] + part * (headings[j + 1] - headings[j])
        curvature = piece.curvature[j] + part * (piece.curvature[j + 1] - piece.curvature[j])
        if planned < self._creep:
            planned = self._creep
        if planned * self._dt > left_m:
            planned = left_m / self._dt
        bend = v * curvature
        if abs(bend) > self._w_path:
            bend = math.copysign(self._w_path, bend)
        error = heading - math.atan(offset / _SETTLE_M) - (yaw + w * self._dt)
        return self._steer(planned, bend, error, v, w)

    def _steer(self, planned: float, bend: float, error: float, v: float, w: float) -> tuple[float, float]:
        """The twist for a planned speed, the path's own yaw rate, and an error in heading."""
        if not -math.pi <= error < math.pi:
            error = (error + math.pi) % (2 * math.pi) - math.pi
        off = abs(error)
        if off > _ALIGN[0]:
            planned *= (_ALIGN[1] - off) / (_ALIGN[1] - _ALIGN[0]) if off < _ALIGN[1] else 0.0
        turn = self._gain * (v if v > self._v_turn else self._v_turn) * error
        return self._limit(planned, bend + turn, v, w)


def drivable(path: Path) -> Path:
    """A path without the noise of its recording: points at least 5 mm from the one before.

    Its first and last points stay. A robot that was recorded while it stood leaves a knot of points,
    which no robot could follow.

    Raises:
        RefusedError: The whole path lies within 5 mm.
    """
    near2 = _JITTER_M**2
    points = path.p_xy.tolist()
    kept = [points[0]]
    x, y = points[0]
    for px, py in points[1:]:
        if (px - x) ** 2 + (py - y) ** 2 >= near2:
            kept.append([px, py])
            x, y = px, py
    if len(kept) == 1:
        raise RefusedError(f"path {path.name}: it lies within {_JITTER_M:g} m, so there is nowhere to drive")
    if kept[-1] != points[-1]:
        if len(kept) > 2:
            kept.pop()
        kept.append(points[-1])
    return Path(path.name, np.array(kept), path.closed)


def follow(
    path: Path,
    drive: DriveSpec,
    *,
    speed: float,
    duration_s: float | None = None,
    start: Pose | None = None,
    rate_hz: float = CONTROL_RATE_HZ,
) -> Motion:
    """Drive along a path.

    Args:
        path: Where to drive.
        drive: Limits and wheels.
        speed: Wanted forward speed [m/s].
        duration_s: How long to drive [s]: further laps of a closed path, back and forth on an open
            one. None means to the end of the path, or one lap, and to stop there.
        start: First x [m], y [m], yaw [rad] in world, from where the robot drives straight to the
            path's first point; None means on that point, along the path.
        rate_hz: Control steps a second [Hz].

    Raises:
        RefusedError: `speed`, `duration_s` or `rate_hz` is out of range, or the end of the path was
            not reached in a time that suffices for any path.
    """
    if not 0 < rate_hz < math.inf:
        raise RefusedError(f"rate_hz of a controller must be above 0 Hz and finite, got {rate_hz!r}")
    if duration_s is not None and not 0 < duration_s <= LONGEST_S:
        raise RefusedError(
            f"duration_s must be above 0 s and finite, at most {LONGEST_S:g}, a day; got {duration_s!r}"
        )
    dt = 1.0 / rate_hz
    way = drivable(path)
    if duration_s is not None:
        way = way.prolonged(speed * duration_s)
    if start is not None:
        way = Path(way.name, np.vstack([start[:2], way.p_xy]))
    if duration_s is None and way.length > speed * LONGEST_S > 0:
        raise RefusedError(
            f"path {path.name}: its {way.length:.4g} m take {way.length / speed:.3g} s at {speed:g} m/s, "
            f"more than {LONGEST_S:g} s, a day; drive faster than {way.length / LONGEST_S:.2g} m/s, or "
            "give duration_s"
        )
    pieces = plan(way, drive, speed=speed)
    if duration_s is None:
        patience_s = 60 + 10 * len(pieces) + 4 * way.length / min(_SLOWEST, speed)
        steps = math.ceil(min(patience_s, LONGEST_S) / dt)
    else:
        steps = math.ceil(duration_s / dt - 1e-9)
    x, y, yaw = start if start is not None else (pieces[0].x[0], pieces[0].y[0], pieces[0].heading[0])
    follower = Follower(pieces, drive, speed=speed, dt=dt)
    command, sin, cos = follower.command, math.sin, math.cos
    pose0 = (x, y, yaw)
    v = w = 0.0
    vs, ws = [0.0] * steps, [0.0] * steps
    for k in range(steps):
        v, w = command(x, y, yaw, v, w)
        vs[k], ws[k] = v, w
        half = w * dt / 2  # as in `advance`, on scalars
        chord = v * dt * (sin(half) / half if half else 1.0)
        x += chord * cos(yaw + half)
        y += chord * sin(yaw + half)
        yaw += half + half
        if v == 0.0 and w == 0.0 and follower.done:
            if duration_s is None:
                del vs[k + 1 :], ws[k + 1 :]
            break
    else:
        if duration_s is None:
            raise RefusedError(
                f"path {path.name}: its end was not reached in {steps * dt:.0f} s at {speed:g} m/s; "
                "it winds too tightly for this drive: smooth it, or drive more slowly"
            )
    return Motion(drive, dt, np.array(vs), np.array(ws), pose0)
