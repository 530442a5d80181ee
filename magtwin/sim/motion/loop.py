"""The closed loop of a robot: controller, drive, and stops at obstacles.

The same source runs as plain Python on lists, which starts at once, and compiled on arrays (`compiled.py`),
which takes half a second to open and then 0.1 us a step. Both give the same bytes. So it uses only numbers,
sequences of them, and operations that round alike in both: no `hypot`, no powers, no long sums.
`closed_loop.py` prepares the input and names the output.

A step of length dt: the command is limited (`limited`). The motors follow it with a first-order lag,
v(t) = v1 + (v0 - v1) exp(-t / lag); the step has the mean of this, so that distances and turns are exact at
its end. The tyres slip by slip * dv/dt, as a linear tyre under the accelerating force, and by a share of the
yaw rate. Wheels that differ from their nominal size scale the rest. The resulting twist holds for the step:
an arc, whose chord is integrated without Euler's error. If the chord would bring the round footprint into an
obstacle, the robot stops at it and its wheels stall. It can turn there and drive away, but does not slide
along the obstacle, because a rubber bumper grips.
"""

import math
from collections.abc import MutableSequence, Sequence
from typing import Any

from magtwin.sim.motion.walls import Columns, Numbers, clearance, free_way

COMMANDS, RELEASE, FOLLOWER, STANLEY, PURE_PURSUIT = range(5)
"""Numbers of the built-in controllers; see `controllers.py`."""

FIGURES = 23 + 4 + 2 * 3 * 3
"""Number of figures of a robot and its controller; see `drive_on`."""

TABLE = 6
"""Columns of a controller's table."""

STATE = 14
"""x, y, yaw; limited command v, w; wheels' v, w; mean v of the last step; distance that is surely free; bump;
next node; distance driven since that changed; cosine and sine of yaw."""

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

STANLEY_GAIN = 2.5
"""Gain k of Stanley's controller [1/s], as published."""

STANLEY_SOFT = 0.1
"""Speed k_s that calms it at low speed [m/s]; assumed."""

STANLEY_MOST = 1.2
"""Largest angle of its steered wheel [rad]; assumed."""

NOWHERE_M2 = 1e-12
"""Added to the square that pure pursuit divides by, since the goal can be at the robot [m2]."""

RELEASE_NEAR_M = 0.25
"""Distance from a point at which the released follower takes the next [m], as published."""


def wrapped(angle: float) -> float:
    """An angle wrapped to [-pi, pi) [rad]."""
    if -math.pi <= angle < math.pi:
        return angle
    return angle - TURN * math.floor((angle + math.pi) / TURN)


def limited(
    limits: tuple[float, float, float, float, float, float, float],
    v_wanted: float,
    w_wanted: float,
    v: float,
    w: float,
) -> tuple[float, float]:
    """The nearest twist to a wanted one within every limit of a drive.

    If a wheel would turn too fast, the forward speed is reduced, as quickly as it may change. A robot that
    steers like a car has a yaw rate of at most the highest curvature times its speed.

    Args:
        limits: Highest speed [m/s], yaw rate [rad/s], change of either in a step, speed of a wheel's rim
            [m/s], half the distance between wheels [m], and highest curvature [1/m], which may be infinite.
        v_wanted: Forward speed [m/s].
        w_wanted: Yaw rate [rad/s].
        v: Last forward speed, within the limits [m/s].
        w: Last yaw rate, within the limits [rad/s].
    """
    v_max, w_max, dv, dw, rim, half, bend = limits
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
    law: int,
    table: Columns,
    gains: tuple[float, float, float, float, float, float, float, float],
    node: int,
    driven: float,
    x: float,
    y: float,
    yaw: float,
    v: float,
    w: float,
) -> tuple[float, float, int, float]:
    """Command of a controller along planned nodes, the next node, and the distance since it changed.

    All share the place on the path and the planned speed there, and differ in steering. The follower's wanted
    heading leans towards the path, by u (1 - 0.3 u^2) for a distance u L from it, which is atan(u) to a
    milliradian unless the robot is lost; and w = v k + (4 / L) max(v, v_turn) (wanted - actual), which for
    small errors is critically damped, with both poles at -2 / L per metre driven. Stanley's (Hoffmann et al.,
    ACC 2007, eq. 5): a point b ahead of the axle is a steered wheel, turned by the path's heading there less
    the robot's and by atan(-k e / (k_s + v)) for its distance e from the path; w = v tan(that) / b. Pure
    pursuit (Coulter, CMU-RI-TR-92-01): the arc through a goal on the path some way ahead, w = v 2 y / D^2 for
    a goal at distance D that is y to the left.

    Each stops and turns on the spot if its heading is far off, as in corners. A robot that was carried away
    drives straight back to where it left the path.

    Args:
        law: FOLLOWER, STANLEY or PURE_PURSUIT.
        table: x, y [m], heading [rad], curvature [1/m], squared planned speed [m2/s2], and way left in its
            piece [m] of each node, which is 0 at the last node of a piece.
        gains: dt [s]; time after which a command has its effect [s]; wanted and least speed [m/s]; twice
            the planned deceleration [m/s2]; square of the distance at which the robot is lost [m2]; yaw
            rate that the path's own may reach [rad/s]; distance that Stanley or pure pursuit looks ahead [m].
        node: Node that begins the segment that the robot was abreast of.
        driven: Way since then [m].
        x: Position in world [m].
        y: Position in world [m].
        yaw: Heading in world [rad].
        v: Forward speed [m/s].
        w: Yaw rate [rad/s].
    """
    xs, ys, headings, curvatures, squares, lefts = table
    dt, delay, speed, creep, brake, lost2, w_path, look = gains
    i = node
    ex, ey = x - xs[i], y - ys[i]
    away2 = ex * ex + ey * ey
    if away2 > lost2:
        planned = math.sqrt(brake * math.sqrt(away2))
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
    if planned < creep:
        planned = creep
    if planned * dt > left:
        planned = left / dt
    if law == FOLLOWER:
        bend = v * (curvatures[j] + part * (curvatures[j + 1] - curvatures[j]))
        if bend > w_path:
            bend = w_path
        elif bend < -w_path:
            bend = -w_path
        lean = (dx * ey - dy * ex) / (math.sqrt(length2) * SETTLE_M)
        lean *= 1.0 - 0.3 * lean * lean
        wanted = headings[j] + part * (headings[j + 1] - headings[j]) - lean
        error = wrapped(wanted - (yaw + w * delay))
        off = abs(error)
        if off > ALIGN:
            planned *= (ASTRAY - off) / (ASTRAY - ALIGN) if off < ASTRAY else 0.0
        return planned, bend + GAIN * (v if v > V_TURN else V_TURN) * error, i, driven
    ahead = along + look * per_m
    j = int(ahead)
    part = ahead - j
    j += i
    beyond = 0.0  # past its end a piece goes on straight
    if j > last:
        beyond = (ahead - (last + 1 - i)) * spacing
        j, part = last, 1.0
    heading = headings[j] + part * (headings[j + 1] - headings[j])
    gx = xs[j] + part * (xs[j + 1] - xs[j]) + beyond * math.cos(heading) - x
    gy = ys[j] + part * (ys[j + 1] - ys[j]) + beyond * math.sin(heading) - y
    cos, sin = math.cos(yaw), math.sin(yaw)
    if law == STANLEY:
        error = wrapped(heading - yaw)
        fx, fy = gx - look * cos, gy - look * sin  # from the steered wheel to the path beside it
        beside = math.cos(heading) * fy - math.sin(heading) * fx
        steer = error + math.atan(STANLEY_GAIN * beside / (STANLEY_SOFT + (v if v > 0.0 else 0.0)))
        if steer > STANLEY_MOST:
            steer = STANLEY_MOST
        elif steer < -STANLEY_MOST:
            steer = -STANLEY_MOST
        bent = math.tan(steer) / look
    else:
        error = wrapped(math.atan2(gy, gx) - yaw)
        bent = 2.0 * (cos * gy - sin * gx) / (gx * gx + gy * gy + NOWHERE_M2)
    off = abs(error)
    if off > ASTRAY or (off > ALIGN and v <= 2.0 * creep):
        return 0.0, TURN_GAIN * error, i, driven
    return planned, v * bent, i, driven


def perceived(
    errors: Numbers, first: int, t: float, x: float, y: float, yaw: float, v: float, w: float
) -> tuple[float, float, float]:
    """The pose that a path follower gets: late, and with the slow errors of a localization.

    It is the pose of `latency` ago if v and w were constant, plus a e(t) for each of x, y and yaw with
    e(t) = sqrt(2 / M) sum_m cos(W_m t + F_m), the spectral representation of a stationary process
    (Shinozuka and Deodatis 1991). `closed_loop.PoseError` draws W and F.

    Args:
        errors: From `first` on: latency [s]; a of x [m], y [m] and yaw [rad], each times sqrt(2 / M); then
            W [rad/s] and F [rad] of the M waves of x, of y, and of yaw.
        first: Where they begin.
        t: Time since the start [s].
        x: Position in world [m].
        y: Position in world [m].
        yaw: Heading in world [rad].
        v: Forward speed [m/s].
        w: Yaw rate [rad/s].
    """
    late = errors[first]
    at = first + 4
    x -= late * v * math.cos(yaw - 0.5 * late * w)
    y -= late * v * math.sin(yaw - 0.5 * late * w)
    yaw -= late * w
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    x += errors[first + 1] * wave
    at += 2 * WAVES
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    y += errors[first + 2] * wave
    at += 2 * WAVES
    wave = 0.0
    for m in range(WAVES):
        wave += math.cos(errors[at + 2 * m] * t + errors[at + 2 * m + 1])
    return x, y, yaw + errors[first + 3] * wave


def commanded(
    law: int,
    table: Columns,
    gains: tuple[float, float, float, float, float, float, float, float],
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
    command holds until it is older than `timeout` [s]. Other arguments as for `along_path`; the released
    follower has its gain in the place of the distance to look ahead.
    """
    times = table[0]
    count = len(times)
    if node >= count:
        return 0.0, 0.0, node, driven
    if law >= FOLLOWER:
        return along_path(law, table, gains, node, driven, x, y, yaw, v, w)
    if law == RELEASE:
        v_cmd, w_cmd, node = towards_point(times, table[1], gains[2], gains[7], node, x, y, yaw)
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


def drive_on(
    law: int,
    figures: Numbers,
    table: Columns,
    fence: Columns,
    spans: Sequence[int],
    state: MutableSequence[float],
    first: int,
    steps: int,
    record: Sequence[Any],
) -> int:
    """Drive a robot from a state until its controller is done and it stands.

    Args:
        law: Number of its controller.
        figures: dt [s]; the seven limits of `limited`; share of the last speed that is left at the end of a
            step, and its share in the mean of the step; slip per change of speed in a step [s/m]; scales of v
            and w; age at which a command is void [s]; radius of the footprint [m]; the eight
            `gains` of `along_path`; the errors of `perceived`, which scripts ignore.
        table: For COMMANDS time [s], v [m/s], w [rad/s] of each; for RELEASE x, y of each point [m]; for
            the others as in `along_path`. Other columns are not read.
        fence: As for `clearance`.
        spans: As for `clearance`.
        state: STATE numbers, which are changed.
        first: Number of the first step since the start.
        steps: Most steps.
        record: RECORD columns of at least `steps` numbers each, which are filled.

    Returns:
        How many steps were made.
    """
    dt = figures[0]
    limits = (figures[1], figures[2], figures[3], figures[4], figures[5], figures[6], figures[7])
    left_at_end, left_in_mean, slip = figures[8], figures[9], figures[10]
    scale_v, scale_w = figures[11], figures[12]
    timeout, radius, rest_w = figures[13], figures[14], REST_M_S / figures[6]
    gains = (
        figures[15],
        figures[16],
        figures[17],
        figures[18],
        figures[19],
        figures[20],
        figures[21],
        figures[22],
    )
    blurred = law != COMMANDS and (
        figures[23] != 0.0 or figures[24] != 0.0 or figures[25] != 0.0 or figures[26] != 0.0
    )
    count = len(table[0])
    x, y, yaw = state[0], state[1], state[2]
    v_told, w_told, v, w, v_mean, free = state[3], state[4], state[5], state[6], state[7], state[8]
    bump, node, driven = state[9], int(state[10]), state[11]
    cos_yaw, sin_yaw = state[12], state[13]
    to_x, to_y, to_yaw, to_v, to_w, to_wheel_v, to_wheel_w, to_v_cmd, to_w_cmd, to_bump = record
    half_dt = dt / 2
    made = steps
    for k in range(steps):
        t = (first + k) * dt
        px, py, pyaw = x, y, yaw
        if blurred:
            px, py, pyaw = perceived(figures, 23, t, x, y, yaw, v, w)
        v_cmd, w_cmd, node, driven = commanded(
            law, table, gains, timeout, node, driven, t, px, py, pyaw, v, w
        )
        v_told, w_told = limited(limits, v_cmd, w_cmd, v_told, w_told)
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
            way = abs(chord)
            free = clearance(fence, spans, x, y, radius + 1.0 + way) - radius - way
            bump = 0.0
            if free < 0.0:
                sign = 1.0 if chord > 0.0 else -1.0
                until = free_way(fence, spans, radius, x, y, sign * cos, sign * sin, way)
                free = 0.0
                if until < way:
                    part = until / way
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
    state[0], state[1], state[2] = x, y, yaw
    state[3], state[4], state[5], state[6], state[7], state[8] = v_told, w_told, v, w, v_mean, free
    state[9], state[10], state[11], state[12], state[13] = bump, float(node), driven, cos_yaw, sin_yaw
    return made


def robots(
    laws: Any,
    figures: Any,
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
        figures: Figures of each robot, shape (N, FIGURES).
        tables: All tables, one after the other, shape (TABLE, M).
        begin: Start of each robot's table, shape (N,).
        end: End of each robot's table, shape (N,).
        fence: x0, y0, x1, y1 of the obstacles' edges, shape (4, E).
        boxes: Lower and upper corners about each obstacle, shape (4, O).
        spans: Edge that begins each obstacle, and E, shape (O + 1,).
        state: State of each robot, which is changed, shape (N, STATE).
        first: Number of the first step since the start.
        steps: Most steps.
        record: Takes what happened, shape (N, RECORD, steps).
        made: Takes how many steps each made, shape (N,).
    """
    walls = (fence[0], fence[1], fence[2], fence[3], boxes[0], boxes[1], boxes[2], boxes[3])
    for n in range(len(laws)):
        a, b = begin[n], end[n]
        table = (
            tables[0, a:b],
            tables[1, a:b],
            tables[2, a:b],
            tables[3, a:b],
            tables[4, a:b],
            tables[5, a:b],
        )
        to = (
            record[n, 0],
            record[n, 1],
            record[n, 2],
            record[n, 3],
            record[n, 4],
            record[n, 5],
            record[n, 6],
            record[n, 7],
            record[n, 8],
            record[n, 9],
        )
        made[n] = drive_on(laws[n], figures[n], table, walls, spans, state[n], first, steps, to)
