"""ClosedLoop: a robot and its controller, ready to run, alone or with many others, plain or compiled."""

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.compiled import Loops, in_threads
from magtwin.errors import InputError
from magtwin.field.maps import lookup
from magtwin.run import mapped
from magtwin.sim.motion import loop
from magtwin.sim.motion.controllers import Guide
from magtwin.sim.motion.drive import Motion, Pose, limits
from magtwin.sim.motion.pose_error import EXACT, PoseError
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles

Array = NDArray[np.float64]

LOOPS = Loops("magtwin.sim.motion.compiled", pays=140_000)
"""The compiled loop, and the steps of plain Python that take as long as opening it."""

BLOCK = 8192
"""Steps that are recorded at a time; most robots stop long before their last allowed step."""

RECORDED = 40_000_000
"""Most numbers in the records and tables of robots that are driven at once: 0.3 GB."""

SHARE = 200_000
"""Steps for which a thread of compiled code is worth its start."""

TOUCH_M = 1e-9
"""Tolerance of a start beside an obstacle [m]."""


def warm_up() -> None:
    """Open the compiled loop and the compiled look-ups of fields, as pays before long jobs.

    This takes about a second if the machine code is cached, else a few. The bytes of a run stay the same.

    Raises:
        ImportError: numba does not work here. The loop stays in plain Python then.
    """
    LOOPS.open()
    lookup.warm_up()


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosedLoop:
    """A robot and its controller at the start."""

    drive: DriveSpec

    guide: Guide
    """Its controller; driving does not change it."""

    dt: float
    """Length of a control step [s]."""

    pose0: Pose
    """First x [m], y [m], yaw [rad] in world; the robot begins at rest."""

    steps: int
    """Most steps."""

    least_steps: int = 0
    """Expected number of steps."""

    footprint_radius_m: float = 0.0
    """Radius of the footprint that obstacles stop [m]."""

    wheel_errors: tuple[float, float] = (0.0, 0.0)
    """Relative errors of the wheels' radius and separation."""

    pose_error: PoseError = EXACT
    """Error of the pose that the controller gets."""

    def figures(self) -> list[float]:
        """Figures for `loop.drive_on`."""
        drive, dt = self.drive, self.dt
        left = math.exp(-dt / drive.motor_lag_s) if drive.motor_lag_s else 0.0
        in_mean = drive.motor_lag_s / dt * (1.0 - left)
        radius, separation = (1.0 + error for error in self.wheel_errors)
        return [
            dt,
            *limits(drive, dt),
            left,
            in_mean,
            drive.slip_s2_m / dt,
            radius,
            radius / separation * (1.0 - drive.yaw_slip),
            drive.command_timeout_s,
            self.footprint_radius_m,
            *self.guide.gains_within(self.pose_error.reach_m(drive.v_max)),
            *self.pose_error.figures,
        ]

    def state(self) -> list[float]:
        """State at the start for `loop.drive_on`."""
        return [
            *self.pose0,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            self.guide.node,
            self.guide.driven_m,
            0.0,
            0.0,
        ]

    def check(self, obstacles: Obstacles) -> None:
        """Refuse a start in an obstacle, and steps that are too long."""
        if not 0 < self.dt < self.drive.command_timeout_s:
            raise InputError(
                f"a control step of {self.dt:g} s must be above 0 s and below the drive's command_timeout_s, "
                f"{self.drive.command_timeout_s:g} s, or the robot would stop between commands"
            )
        distance, which = obstacles.clearance([self.pose0[:2]], reach_m=self.footprint_radius_m)
        if distance[0] < self.footprint_radius_m - TOUCH_M:
            x, y, _ = self.pose0
            radius, name = self.footprint_radius_m, obstacles.names[which[0]]
            raise InputError(
                f"the robot would begin in {name}: at ({x:.3f}, {y:.3f}) m its footprint of radius "
                f"{radius:g} m is {radius - distance[0]:.3f} m too near; begin elsewhere, or move it"
            )


def run_loops(loops: Sequence[ClosedLoop], obstacles: Obstacles | None = None) -> list[Motion]:
    """Drive robots, each as if it were alone; the bytes depend on neither their number nor their order.

    Args:
        loops: The robots; all with the same length of a step.
        obstacles: What stands in the room; robots do not meet each other.

    Returns:
        The motion of each, until its controller was done and it stood, or its steps were over.

    Raises:
        InputError: A robot would begin in an obstacle, or the lengths of steps differ.
    """
    obstacles = obstacles or Obstacles()
    starts = {(c.pose0, c.footprint_radius_m, c.dt, c.drive.command_timeout_s): c for c in loops}
    for closed_loop in starts.values():
        closed_loop.check(obstacles)
    if len({closed_loop.dt for closed_loop in loops}) > 1:
        raise InputError("robots that are driven at once must have the same length of a step")
    code = LOOPS.after(sum(closed_loop.least_steps for closed_loop in loops))
    if code is None:
        return [_in_python(closed_loop, obstacles) for closed_loop in loops]
    motions: list[Motion] = []
    group: list[ClosedLoop] = []
    size = 0
    for closed_loop in loops:
        own = min(closed_loop.steps, BLOCK) * loop.RECORD + closed_loop.guide.table.size
        if group and size + own > RECORDED:
            motions += _compiled(group, obstacles)
            group, size = [], 0
        group.append(closed_loop)
        size += own
    return motions + (_compiled(group, obstacles) if group else [])


def fence_of(obstacles: Obstacles) -> tuple[Array, Array, NDArray[np.int64]]:
    """Obstacles for `loop.robots`: edges (4, E), boxes (4, O), and first edge of each obstacle (O + 1,)."""
    edges, begins = obstacles.edges
    boxes = [np.concatenate([o.min(axis=0), o.max(axis=0)]) for o in obstacles.outlines]
    box = np.array(boxes).reshape(-1, 4)
    return np.ascontiguousarray(edges.T), np.ascontiguousarray(box.T), begins.astype(np.int64)


def _in_python(closed_loop: ClosedLoop, obstacles: Obstacles) -> Motion:
    """Drive one robot in plain Python."""
    edges, boxes, begins = fence_of(obstacles)
    fence, spans = [*edges.tolist(), *boxes.tolist()], begins.tolist()
    figures, state, table = closed_loop.figures(), closed_loop.state(), closed_loop.guide.columns
    state[8] = math.inf if not len(obstacles) else 0.0
    records, first = [], 0
    while first < closed_loop.steps:
        steps = min(BLOCK, closed_loop.steps - first)
        record = [array("d", bytes(8 * steps)) for _ in range(loop.RECORD)]
        made = loop.drive_on(closed_loop.guide.law, figures, table, fence, spans, state, first, steps, record)
        records.append(np.array([np.frombuffer(column)[:made] for column in record]))
        mapped.settle(records)
        first += made
        if made < steps:
            break
    return _motion(closed_loop, mapped.joined(records))


def _compiled(loops: Sequence[ClosedLoop], obstacles: Obstacles) -> list[Motion]:
    """Drive robots in the compiled loop."""
    room = fence_of(obstacles)
    figures = np.array([closed_loop.figures() for closed_loop in loops])
    state = np.array([closed_loop.state() for closed_loop in loops])
    state[:, 8] = np.inf if not len(obstacles) else 0.0
    most = np.array([closed_loop.steps for closed_loop in loops])
    records: list[list[Array]] = [[] for _ in loops]
    first, going = 0, np.arange(len(loops))
    while len(going):
        steps = min(BLOCK, int(most[going].min()) - first)
        part = state[going]
        record, made = _block([loops[int(n)].guide for n in going], figures[going], part, room, first, steps)
        state[going] = part
        for n, rows, count in zip(going, record, made, strict=True):
            records[n].append(rows[:, :count].copy())
            mapped.settle(records[n])
        first += steps
        going = going[(made == steps) & (most[going] > first)]
    return [_motion(c, mapped.joined(r)) for c, r in zip(loops, records, strict=True)]


def _block(
    guides: Sequence[Guide],
    figures: Array,
    state: Array,
    room: tuple[Array, Array, NDArray[np.int64]],
    first: int,
    steps: int,
) -> tuple[Array, NDArray[np.int64]]:
    """Drive robots for some steps, on several threads if that pays; changes `state`.

    Returns:
        Their records, shape (N, RECORD, steps), and the number of steps of each, shape (N,).
    """
    robots, count = LOOPS.open().robots, len(guides)
    distinct = {id(guide.table): guide.table for guide in guides}  # robots on one path share its table
    ends = np.cumsum([table.shape[1] for table in distinct.values()])
    places = dict(zip(distinct, ends, strict=True))
    last = np.array([places[id(guide.table)] for guide in guides], np.int64)
    begin = last - [guide.table.shape[1] for guide in guides]
    tables = next(iter(distinct.values()))
    if len(distinct) > 1:
        tables = np.concatenate(list(distinct.values()), axis=1)
    laws = np.array([guide.law for guide in guides], np.int64)
    record, made = np.empty((count, loop.RECORD, steps)), np.empty(count, np.int64)

    def work(rows: slice) -> None:
        drives = laws[rows], figures[rows], tables, begin[rows], last[rows]
        robots(*drives, *room, state[rows], first, steps, record[rows], made[rows])

    in_threads(work, count, math.ceil(SHARE / steps))
    return record, made


def _motion(closed_loop: ClosedLoop, record: Array) -> Motion:
    """The motion in a record of `loop.drive_on`, shape (RECORD, K)."""
    x, y, yaw, v, w, wheel_v, wheel_w, v_cmd, w_cmd, bump = record
    poses = mapped.empty((len(x) + 1, 3))
    poses[0] = closed_loop.pose0
    for rows in mapped.parts(len(x)):
        poses[rows.start + 1 : rows.stop + 1] = np.stack([x[rows], y[rows], yaw[rows]], axis=1)
    return Motion(
        closed_loop.drive,
        closed_loop.dt,
        v,
        w,
        closed_loop.pose0,
        wheel_v=wheel_v,
        wheel_w=wheel_w,
        v_cmd=v_cmd,
        w_cmd=w_cmd,
        bump=bump > 0,
        poses=poses,
    )


class Chassis:
    """A robot that is commanded step by step: by a custom controller, a keyboard, or a learner."""

    def __init__(self, closed_loop: ClosedLoop, obstacles: Obstacles | None = None) -> None:
        """Put a robot at its start; the guide is not used.

        Raises:
            InputError: It would begin in an obstacle.
        """
        obstacles = obstacles or Obstacles()
        closed_loop.check(obstacles)
        edges, boxes, spans = fence_of(obstacles)
        self._course = closed_loop
        self._fence, self._spans = [*edges.tolist(), *boxes.tolist()], spans.tolist()
        self._figures, self._state = closed_loop.figures(), closed_loop.state()
        self._state[8] = math.inf if not len(obstacles) else 0.0
        self._record = [array("d") for _ in range(loop.RECORD)]
        self._earlier: list[Array] = []
        self._steps = 0  # in earlier records
        self._last = (0.0, 0.0)
        self._age_s = 0.0

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return (self._steps + len(self._record[0])) * self._course.dt

    @property
    def pose(self) -> Pose:
        """Its x [m], y [m], yaw [rad] in world."""
        x, y, yaw = self._state[:3]
        return x, y, yaw

    @property
    def twist(self) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s] of the wheels."""
        return self._state[5], self._state[6]

    @property
    def bump(self) -> bool:
        """Whether it touches an obstacle."""
        return self._state[9] > 0

    def step(self, command: tuple[float, float] | None) -> None:
        """Drive for one control step.

        Args:
            command: Forward speed [m/s] and yaw rate [rad/s]. None keeps the last command until the drive's
                command_timeout_s is over.

        Raises:
            InputError: The command is not finite.
        """
        if command is None:
            self._age_s += self._course.dt
            if self._age_s > self._course.drive.command_timeout_s + loop.LATE_S:
                self._last = (0.0, 0.0)
        else:
            v, w = command
            if not (math.isfinite(v) and math.isfinite(w)):
                raise InputError(
                    f"the command at {self.t:.3f} s is not finite: v = {v!r} m/s, w = {w!r} rad/s"
                )
            self._last, self._age_s = (float(v), float(w)), 0.0
        if len(self._record[0]) == BLOCK:
            self._earlier.append(self._recorded())
            mapped.settle(self._earlier)
            self._steps += BLOCK
            self._record = [array("d") for _ in range(loop.RECORD)]
        for column in self._record:
            column.append(0.0)
        k = self._steps + len(self._record[0]) - 1
        now = [memoryview(column)[-1:] for column in self._record]
        table = ([k * self._course.dt], [self._last[0]], [self._last[1]])
        self._state[10] = 0.0
        loop.drive_on(loop.COMMANDS, self._figures, table, self._fence, self._spans, self._state, k, 1, now)

    @property
    def last(self) -> Array:
        """The record of the last step, shape (loop.RECORD,)."""
        return np.array([column[-1] for column in self._record])

    def motion(self) -> Motion:
        """The motion so far."""
        return _motion(self._course, mapped.joined([*self._earlier, self._recorded()]))

    def _recorded(self) -> Array:
        """Record of the last steps, shape (loop.RECORD, K)."""
        return np.array([np.frombuffer(column) for column in self._record])
