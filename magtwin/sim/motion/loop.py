"""The closed loop of a robot: controller, drive, and stops at obstacles.

The same source runs as plain Python on numbers, which starts at once, and compiled on arrays (`compiled.py`),
which takes half a second to open and then 0.1 us a step. Both give the same bytes. So it uses only numbers,
sequences of them, and operations that round alike in both: no `hypot`, no powers, no long sums.
`closed_loop.py` prepares the input and names the output. What does not change is in a `Drive` and in the
`Gains` of a controller, what a step changes in a `State`: records of named numbers, which are these classes
in plain Python and rows of structured arrays in compiled code.

A step of length dt:

1. The controller sees the pose with its error (`perceived`) and commands a twist (`commanded`): along planned
   nodes (`along_path`), towards points (`towards_point`), or by a script. It has passed `node` nodes, the
   last of them `driven` metres ago.
2. The command is limited (`limited`) to the twist `v_told`, `w_told`. The motors follow it with a first-order
   lag, v(t) = v1 + (v0 - v1) exp(-t / lag), which leaves the wheels' twist `v`, `w` at the end of the step.
   The step has the mean of this, `v_mean`, so that distances and turns are exact at its end.
3. The tyres slip by slip * dv/dt, as a linear tyre under the accelerating force, and by a share of the yaw
   rate. Wheels that differ from their nominal size scale the rest.
4. The resulting twist holds for the step: an arc, whose chord is integrated without Euler's error. The cosine
   and sine of the heading are carried along, and computed afresh every `ANEW` steps.
5. If the chord would bring the round footprint into an obstacle, the robot stops at it (`bump`) and its
   wheels stall. It can turn there and drive away, but does not slide along the obstacle, because a rubber
   bumper grips. `free` is a distance that is surely clear; obstacles are looked at when it is used up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from magtwin.sim.motion.walls import Columns, Numbers, clearance, free_way

COMMANDS, RELEASE, FOLLOWER = range(3)
"""Numbers of the built-in controllers; see `controllers.py`."""

TABLE = 6
"""Columns of a controller's table."""


class Drive(NamedTuple):
    """What does not change of a robot: its limits for steps of one length, then its motors and wheels."""

    v_max: float
    """Speed [m/s]."""
    w_max: float
    """Yaw rate [rad/s]."""
    dv: float
    """Change of the speed in a step [m/s]."""
    dw: float
    """Change of the yaw rate in a step [rad/s]."""
    rim: float
    """Speed of a wheel's rim [m/s]."""
    half: float
    """Half of the distance between the wheels [m]."""
    bend: float
    """Curvature [1/m], which may be infinite."""
    dt: float
    """Length of a step [s]."""
    left_at_end: float = 0.0
    """Share of the last speed that the motors' lag leaves at the end of a step."""
    left_in_mean: float = 0.0
    """Its share in the mean of the step."""
    slip: float = 0.0
    """Slip per change of speed in a step [s/m]."""
    scale_v: float = 1.0
    scale_w: float = 1.0
    """Factors on v and w by the wheels' true size and their slip on curves."""
    timeout: float = 0.0
    """Age at which a command is void [s]."""
    radius: float = 0.0
    """Radius of the footprint [m]."""


class Gains(NamedTuple):
    """What does not change of a controller; a script has none."""

    dt: float = 0.0
    """Time between its commands [s]."""
    delay: float = 0.0
    """Time after which a command has its effect [s]."""
    speed: float = 0.0
    """Wanted speed [m/s]."""
    creep: float = 0.0
    """Least speed [m/s]."""
    brake: float = 0.0
    """Twice the planned deceleration [m/s2]."""
    lost2: float = 0.0
    """Square of the distance at which the robot is lost [m2]."""
    w_path: float = 0.0
    """Yaw rate that the path's own may reach [rad/s]."""
    towards: float = 0.0
    """Gain of the released follower [1/s]."""


@dataclass(slots=True)
class State:
    """What a step changes; see the module."""

    x: float
    y: float
    yaw: float
    v_told: float = 0.0
    w_told: float = 0.0
    v: float = 0.0
    w: float = 0.0
    v_mean: float = 0.0
    free: float = 0.0
    bump: float = 0.0
    node: float = 0.0
    driven: float = 0.0
    cos_yaw: float = 0.0
    sin_yaw: float = 0.0


DRIVE, GAINS, STATE = (
    np.dtype([(name, float) for name in names]) for names in (Drive._fields, Gains._fields, State.__slots__)
)
"""These records as rows of arrays."""

RECORD = 10
"""Columns of a step: x, y, yaw at its end; v, w of the body; v, w of the wheels at their nominal size;
commanded v, w; whether an obstacle was touched."""

WAVES = 3
"""Sine waves of the error of each coordinate of a pose; see `perceived`."""

TURN = 2 * math.pi

REST_M_S = 1e-3
"""Speed of the rims below which friction stops a robot that is commanded to stand [m/s]."""

A1, A2, A3 = 1 / 6, 1 / 20, 1 / 42
"""sin(x)/x = 1 - A1 x^2 (1 - A2 x^2 (1 - A3 x^2 ...))."""

B1, B2, B3 = 1 / 2, 1 / 12, 1 / 30
"""cos(x) = 1 - B1 x^2 (1 - B2 x^2 (1 - B3 x^2 ...))."""

ANEW = 64
"""Steps after which the cosine and sine of the heading are computed afresh."""

SHORT = 4e-4
"""Square of half a turn below which four terms of the series of sin(x)/x and cos(x) are exact."""

LATE_S = 1e-9
"""Tolerance of times [s]."""

STUCK_M = 0.03
"""Distance driven without reaching the next node after which the node counts as passed [m]."""

ARRIVED_M = 0.0005
"""Remaining length at which a piece counts as driven [m]."""

SETTLE_M = 0.15
"""Distance in which a position error decays, twice the time constant of the feedback [m]."""

TURN_GAIN = 3.9
"""Gain of turning on the spot [1/s]: below alpha_max / w_max = 4.1, which avoids overshoot."""

GAIN = 4.0 / SETTLE_M
V_TURN = TURN_GAIN / GAIN

ALIGN = 0.1
"""Heading error at which driving slows, and above which a standing robot turns first [rad]."""

ASTRAY = 0.35
"""Heading error at which driving stops until the robot has turned [rad]."""

RELEASE_NEAR_M = 0.25
"""Distance from a point at which the released follower takes the next [m], as published."""


def wrapped(angle: float) -> float:
    """An angle wrapped to [-pi, pi) [rad]."""
    if -math.pi <= angle < math.pi:
        return angle
    return angle - TURN * math.floor((angle + math.pi) / TURN)


def limited(limits: Drive, v_wanted: float, w_wanted: float, v: float, w: float) -> tuple[float, float]:
    """The nearest twist to a wanted one within every limit of a drive, from the last one, v and w.

    If a wheel would turn too fast, the forward speed is reduced, as quickly as it may change. A robot that
    steers like a car has a yaw rate of at most the highest curvature times its speed.
    """
    v_max, w_max, dv, dw = limits.v_max, limits.w_max, limits.dv, limits.dw
    rim, half, bend = limits.rim, limits.half, limits.bend
    slowest = abs(v) - dv
    low, high = v - dv, v + dv
    if low < -v_max:
        low = -v_max
    if high > v_max:
        high = v_max
    v = low if v_wanted < low else high if v_wanted > high else v_wanted
    low, high = w - dw, w + dw
    if low < -w_max:
        low = -w_max
    if high > w_max:
        high = w_max
    w = low if w_wanted < low else high if w_wanted > high else w_wanted
    room = rim - abs(w) * half
    if abs(v) > room:
        if slowest < 0.0:
            slowest = 0.0
        if room < slowest:
            room = slowest
            w = math.copysign((rim - room) / half, w)
        v = math.copysign(room, v)
    bend *= abs(v)
    if abs(w) > bend:  # never if it is infinite, or infinity times 0
        w = math.copysign(bend, w)
    return v, w


def towards_point(
    xs: Numbers, ys: Numbers, speed: float, gain: float, node: int, x: float, y: float, yaw: float
) -> tuple[float, float, int]:
    """Command of the released follower, and its next point.

    w = (angle to the point - yaw) + atan(k d / v) for a point at distance d, v constant; a point nearer than
    0.25 m counts as passed. The second term is positive on both sides of a path, so it drives to the left of
    its points: as published, and as the real robot does.
    """
    ex, ey = xs[node] - x, ys[node] - y
    away = math.sqrt(ex * ex + ey * ey)
    w = wrapped(math.atan2(ey, ex) - yaw) + math.atan2(gain * away, speed)
    return speed, w, node + 1 if away < RELEASE_NEAR_M else node


def along_path(
    table: Columns,
    gains: Gains,
    node: int,
    driven: float,
    x: float,
    y: float,
    yaw: float,
    v: float,
    w: float,
) -> tuple[float, float, int, float]:
    """Command of the follower along planned nodes, the next node, and the distance since it changed.

    Its wanted heading leans towards the path, by u (1 - 0.3 u^2) for a distance u L from it, which is atan(u)
    to a milliradian unless the robot is lost; and w = v k + (4 / L) max(v, v_turn) (wanted - actual), which
    for small errors is critically damped, with both poles at -2 / L per metre driven. It stops and turns on
    the spot if its heading is far off, as in corners. A robot that was carried away drives straight back to
    where it left the path.

    Args:
        table: x, y [m], heading [rad], curvature [1/m], squared planned speed [m2/s2], and way left in its
            piece [m] of each node, which is 0 at the last node of a piece.
        gains: The follower's.
        node: Node that begins the segment that the robot was abreast of.
        driven: Way since then [m].
        x: Position in world [m].
        y: Position in world [m].
        yaw: Heading in world [rad].
        v: Forward speed [m/s].
        w: Yaw rate [rad/s].
    """
    xs, ys, headings, curvatures, squares, lefts = table
    dt, delay, speed = gains.dt, gains.delay, gains.speed
    i = node
    ex, ey = x - xs[i], y - ys[i]
    away2 = ex * ex + ey * ey
    if away2 > gains.lost2:
        planned = math.sqrt(gains.brake * math.sqrt(away2))
        if planned > speed:
            planned = speed
        error = wrapped(math.atan2(-ey, -ex) - yaw)
        off = abs(error)
        if off > ALIGN:
            planned *= (ASTRAY - off) / (ASTRAY - ALIGN) if off < ASTRAY else 0.0
        return planned, GAIN * (v if v > V_TURN else V_TURN) * error, i, driven
    driven += v * dt
    if driven > STUCK_M and lefts[i + 1] > 0.0:  # a knot, in which nodes lie behind each other
        i += 1
        driven = 0.0
        ex, ey = x - xs[i], y - ys[i]
    while True:  # the segment that the robot is abreast of, never going back
        dx, dy = xs[i + 1] - xs[i], ys[i + 1] - ys[i]
        length2 = dx * dx + dy * dy
        along = (ex * dx + ey * dy) / length2
        if along < 1.0 or lefts[i + 1] <= 0.0:
            break
        i += 1
        driven = 0.0
        ex, ey = x - xs[i], y - ys[i]
    left = lefts[i]
    spacing = left - lefts[i + 1]
    per_m = 1.0 / spacing
    last = i + int(left * per_m + 0.5) - 1
    left -= along * spacing
    if left < ARRIVED_M:
        return 0.0, 0.0, last + 2, 0.0
    if along < 0.0:
        along = 0.0
    # The plan is read where the robot will be when the motors have done what they are told.
    ahead = along + (v * delay * per_m if v > 0.0 else 0.0)
    j = int(ahead)
    part = ahead - j
    j += i
    if j > last:
        j, part = last, 1.0
    planned = math.sqrt(squares[j] + part * (squares[j + 1] - squares[j]))
    if planned < gains.creep:
        planned = gains.creep
    if planned * dt > left:
        planned = left / dt
    bend = v * (curvatures[j] + part * (curvatures[j + 1] - curvatures[j]))
    if bend > gains.w_path:
        bend = gains.w_path
    elif bend < -gains.w_path:
        bend = -gains.w_path
    lean = (dx * ey - dy * ex) / (math.sqrt(length2) * SETTLE_M)
    lean *= 1.0 - 0.3 * lean * lean
    wanted = headings[j] + part * (headings[j + 1] - headings[j]) - lean
    error = wrapped(wanted - (yaw + w * delay))
    off = abs(error)
    if off > ALIGN:
        planned *= (ASTRAY - off) / (ASTRAY - ALIGN) if off < ASTRAY else 0.0
    return planned, bend + GAIN * (v if v > V_TURN else V_TURN) * error, i, driven


def perceived(
    errors: Numbers, t: float, x: float, y: float, yaw: float, v: float, w: float
) -> tuple[float, float, float]:
    """The pose that a path follower gets: late, and with the slow errors of a localization.

    It is the pose of `latency` ago if v and w were constant, plus a e(t) for each of x, y and yaw with
    e(t) = sqrt(2 / M) sum_m cos(W_m t + F_m), the spectral representation of a stationary process
    (Shinozuka and Deodatis 1991). `pose_error.py` draws W and F.

    Args:
        errors: Latency [s]; a of x [m], y [m] and yaw [rad], each times sqrt(2 / M); then W [rad/s] and
            F [rad] of the M waves of x, of y, and of yaw.
        t: Time since the start [s].
        x: Position in world [m].
        y: Position in world [m].
        yaw: Heading in world [rad].
        v: Forward speed [m/s].
        w: Yaw rate [rad/s].
    """
    late = errors[0]
    at = 4
    x -= late * v * math.cos(yaw - 0.5 * late * w)
    y -= late * v * math.sin(yaw - 0.5 * late * w)
    yaw -= late * w
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    x += errors[1] * wave
    at += 2 * WAVES
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    y += errors[2] * wave
    at += 2 * WAVES
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    return x, y, yaw + errors[3] * wave


def commanded(
    law: int,
    table: Columns,
    gains: Gains,
    timeout: float,
    node: int,
    driven: float,
    t: float,
    x: float,
    y: float,
    yaw: float,
    v: float,
    w: float,
) -> tuple[float, float, int, float]:
    """Command of any controller at a time t [s], the next node, and the distance since it changed.

    A controller is done when the next node is the number of its nodes; it then commands a stop. A scripted
    command holds until it is older than `timeout` [s]. Other arguments as for `along_path`.
    """
    times = table[0]
    count = len(times)
    if node >= count:
        return 0.0, 0.0, node, driven
    if law == FOLLOWER:
        return along_path(table, gains, node, driven, x, y, yaw, v, w)
    if law == RELEASE:
        v_cmd, w_cmd, node = towards_point(times, table[1], gains.speed, gains.towards, node, x, y, yaw)
        return v_cmd, w_cmd, node, driven
    t += LATE_S
    while node + 1 < count and times[node + 1] <= t:
        node += 1
    age = t - times[node]
    if age < 0.0:
        return 0.0, 0.0, node, driven
    if age > timeout + 2.0 * LATE_S:
        return 0.0, 0.0, count if node + 1 == count else node, driven
    return table[1][node], table[2][node], node, driven


def way_open(
    fence: Columns, spans: Sequence[int], radius: float, x: float, y: float, ux: float, uy: float, way: float
) -> tuple[float, float]:
    """Share of a way that a footprint can go, and the distance that is surely free after it [m].

    Arguments as for `free_way`.
    """
    free = clearance(fence, spans, x, y, radius + 1.0 + way) - radius - way
    if free >= 0.0:
        return 1.0, free
    until = free_way(fence, spans, radius, x, y, ux, uy, way)
    return (until / way if until < way else 1.0), 0.0


def drive_on(
    law: int,
    drive: Drive,
    gains: Gains,
    errors: Numbers,
    table: Columns,
    fence: Columns,
    spans: Sequence[int],
    state: State,
    first: int,
    steps: int,
    record: Sequence[Any],
) -> int:
    """Drive a robot from a state until its controller is done and it stands.

    Args:
        law: Number of its controller.
        drive: The robot.
        gains: Those of its controller.
        errors: As for `perceived`; scripts ignore them.
        table: For COMMANDS time [s], v [m/s], w [rad/s] of each; for RELEASE x, y of each point [m]; for
            FOLLOWER as in `along_path`. Other columns are not read.
        fence: As for `clearance`.
        spans: As for `clearance`.
        state: Where it is, which is changed.
        first: Number of the first step since the start.
        steps: Most steps.
        record: RECORD columns of at least `steps` numbers each, which are filled.

    Returns:
        How many steps were made.
    """
    dt, left_at_end, left_in_mean = drive.dt, drive.left_at_end, drive.left_in_mean
    slip, scale_v, scale_w = drive.slip, drive.scale_v, drive.scale_w
    rest_w = REST_M_S / drive.half
    blurred = law != COMMANDS and (
        errors[0] != 0.0 or errors[1] != 0.0 or errors[2] != 0.0 or errors[3] != 0.0
    )
    count = len(table[0])
    x, y, yaw, cos_yaw, sin_yaw = state.x, state.y, state.yaw, state.cos_yaw, state.sin_yaw
    v_told, w_told, v, w, v_mean = state.v_told, state.w_told, state.v, state.w, state.v_mean
    free, bump, node, driven = state.free, state.bump, int(state.node), state.driven
    to_x, to_y, to_yaw, to_v, to_w, to_wheel_v, to_wheel_w, to_v_cmd, to_w_cmd, to_bump = record
    half_dt = dt / 2
    made = steps
    for k in range(steps):
        t = (first + k) * dt
        px, py, pyaw = x, y, yaw
        if blurred:
            px, py, pyaw = perceived(errors, t, x, y, yaw, v, w)
        v_cmd, w_cmd, node, driven = commanded(
            law, table, gains, drive.timeout, node, driven, t, px, py, pyaw, v, w
        )
        v_told, w_told = limited(drive, v_cmd, w_cmd, v_told, w_told)
        was = v_mean
        v_mean = v_told + left_in_mean * (v - v_told)
        w_mean = w_told + left_in_mean * (w - w_told)
        v = v_told + left_at_end * (v - v_told)
        w = w_told + left_at_end * (w - w_told)
        if v_told == 0.0 and w_told == 0.0 and abs(v) < REST_M_S and abs(w) < rest_w:
            v = w = 0.0
        slipped = slip * (v_mean - was)
        if v_mean < 0.0:  # backwards, what speeds up is a change below 0
            slipped = -slipped
        v_body = v_mean * (1.0 - slipped) * scale_v
        w_body = w_mean * scale_w
        if (first + k) % ANEW == 0:
            cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        half = w_body * half_dt
        square = half * half
        if square < SHORT:
            share = 1.0 - square * A1 * (1.0 - square * A2 * (1.0 - square * A3))
            sin_half = half * share
            cos_half = 1.0 - square * B1 * (1.0 - square * B2 * (1.0 - square * B3))
        else:
            sin_half, cos_half = math.sin(half), math.cos(half)
            share = sin_half / half
        chord = v_body * dt * share
        cos, sin = cos_yaw * cos_half - sin_yaw * sin_half, sin_yaw * cos_half + cos_yaw * sin_half
        cos_yaw, sin_yaw = cos * cos_half - sin * sin_half, sin * cos_half + cos * sin_half
        free -= abs(chord)
        if free < 0.0:
            sign = 1.0 if chord > 0.0 else -1.0
            part, free = way_open(fence, spans, drive.radius, x, y, sign * cos, sign * sin, abs(chord))
            bump = 0.0
            if part < 1.0:
                chord *= part
                v_body *= part
                v_mean *= part
                v = v_told = 0.0
                bump = 1.0
        x += chord * cos
        y += chord * sin
        yaw += half + half
        to_x[k], to_y[k], to_yaw[k] = x, y, yaw
        to_v[k], to_w[k] = v_body, w_body
        to_wheel_v[k], to_wheel_w[k] = v_mean, w_mean
        to_v_cmd[k], to_w_cmd[k] = v_cmd, w_cmd
        to_bump[k] = bump
        if node >= count and v == 0.0 and w == 0.0:
            made = k + 1
            break
    state.x, state.y, state.yaw, state.cos_yaw, state.sin_yaw = x, y, yaw, cos_yaw, sin_yaw
    state.v_told, state.w_told, state.v, state.w, state.v_mean = v_told, w_told, v, w, v_mean
    state.free, state.bump, state.node, state.driven = free, bump, float(node), driven
    return made


def robots(
    laws: Any,
    drives: Any,
    gains: Any,
    errors: Any,
    tables: Any,
    begin: Any,
    end: Any,
    fence: Any,
    boxes: Any,
    spans: Any,
    state: Any,
    first: int,
    steps: int,
    record: Any,
    made: Any,
) -> None:
    """`drive_on` for many robots in one room, on arrays; each is driven as if it were alone.

    Args:
        laws: Numbers of the controllers, shape (N,).
        drives: Fields of `Drive` of each robot, shape (N,).
        gains: Fields of `Gains` of each controller, shape (N,).
        errors: Errors of each pose, shape (N, 4 + 6 WAVES).
        tables: All tables, one after the other, shape (TABLE, M).
        begin: Start of each robot's table, shape (N,).
        end: End of each robot's table, shape (N,).
        fence: x0, y0, x1, y1 of the obstacles' edges, shape (4, E).
        boxes: Lower and upper corners about each obstacle, shape (4, O).
        spans: Edge that begins each obstacle, and E, shape (O + 1,).
        state: Fields of `State` of each robot, which are changed, shape (N,).
        first: Number of the first step since the start.
        steps: Most steps.
        record: Takes what happened, shape (N, RECORD, steps).
        made: Takes how many steps each made, shape (N,).
    """
    walls = (fence[0], fence[1], fence[2], fence[3], boxes[0], boxes[1], boxes[2], boxes[3])
    for n in range(len(laws)):
        a, b = begin[n], end[n]
        columns = tables[:, a:b]
        table = (columns[0], columns[1], columns[2], columns[3], columns[4], columns[5])
        r = record[n]
        to = (r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9])
        made[n] = drive_on(
            laws[n], drives[n], gains[n], errors[n], table, walls, spans, state[n], first, steps, to
        )
