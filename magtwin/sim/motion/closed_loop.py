"""ClosedLoop: a robot and its controller, ready to run, alone or with many others, plain or compiled."""

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType

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

Room = tuple[Array, Array, NDArray[np.int64]]
"""Obstacles as `loop.robots` takes them; see `fence_of`."""

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

    def parts(self) -> tuple[loop.Drive, loop.Gains, loop.State]:
        """The robot, its controller and its state at the start, for `loop.drive_on`."""
        drive, dt = self.drive, self.dt
        left = math.exp(-dt / drive.motor_lag_s) if drive.motor_lag_s else 0.0
        radius, separation = (1.0 + error for error in self.wheel_errors)
        fixed = limits(drive, dt)._replace(
            left_at_end=left,
            left_in_mean=drive.motor_lag_s / dt * (1.0 - left),
            slip=drive.slip_s2_m / dt,
            scale_v=radius,
            scale_w=radius / separation * (1.0 - drive.yaw_slip),
            timeout=drive.command_timeout_s,
            radius=self.footprint_radius_m,
        )
        gains = self.guide.gains_within(self.pose_error.reach_m(drive.v_max))
        state = loop.State(*self.pose0, node=self.guide.node, driven=self.guide.driven_m)
        return fixed, gains, state

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

    Returns:
        The motion of each, until its controller was done and it stood, or its steps were over.
    """
    obstacles = obstacles or Obstacles()
    starts = {(c.pose0, c.footprint_radius_m, c.dt, c.drive.command_timeout_s): c for c in loops}
    for closed_loop in starts.values():
        closed_loop.check(obstacles)
    if len({closed_loop.dt for closed_loop in loops}) > 1:
        raise InputError("robots that are driven at once must have the same length of a step")
    code = LOOPS.after(sum(closed_loop.least_steps for closed_loop in loops))
    motions: list[Motion] = []
    group: list[ClosedLoop] = []
    size = 0
    for closed_loop in loops:
        own = min(closed_loop.steps, BLOCK) * loop.RECORD + closed_loop.guide.table.size
        if group and size + own > RECORDED:
            motions += _driven(group, obstacles, code)
            group, size = [], 0
        group.append(closed_loop)
        size += own
    return motions + (_driven(group, obstacles, code) if group else [])


def _driven(loops: Sequence[ClosedLoop], obstacles: Obstacles, code: ModuleType | None) -> list[Motion]:
    """Drive robots to their ends, block by block."""
    robots, most = Robots(loops, obstacles), np.array([closed_loop.steps for closed_loop in loops])
    records: list[list[Array]] = [[] for _ in loops]
    first, going = 0, np.arange(len(loops))
    while len(going):
        steps = min(BLOCK, int(most[going].min()) - first)
        record, made = robots.step(first, steps, going, code=code)
        for n, rows, count in zip(going, record, made, strict=True):
            records[n].append(rows[:, :count].copy())
            mapped.settle(records[n])
        first += steps
        going = going[(made == steps) & (most[going] > first)]
    return [motion_of(c, mapped.joined(r)) for c, r in zip(loops, records, strict=True)]


class Robots:
    """Robots in one room where they are now. Each drives as if it were alone."""

    def __init__(self, loops: Sequence[ClosedLoop], obstacles: Obstacles) -> None:
        """Put robots to their starts, which `ClosedLoop.check` has checked."""
        count = len(loops)
        self._room = fence_of(obstacles)
        self._free = 0.0 if len(obstacles) else math.inf
        self._guides = [closed_loop.guide for closed_loop in loops]
        self._drives, self._gains = np.zeros(count, loop.DRIVE), np.zeros(count, loop.GAINS)
        self._errors, self.state = np.zeros((count, len(EXACT.figures))), np.zeros(count, loop.STATE)
        for n, closed_loop in enumerate(loops):
            self.put(n, closed_loop)

    def put(self, n: int, closed_loop: ClosedLoop) -> None:
        """Put another robot, or the same one anew, in place of a robot."""
        self._guides[n] = closed_loop.guide
        drive, gains, state = closed_loop.parts()
        self._drives[n], self._gains[n], self._errors[n] = drive, gains, closed_loop.pose_error.figures
        self.state[n] = _row(replace(state, free=self._free))

    def step(
        self,
        first: int,
        steps: int,
        which: NDArray[np.intp],
        *,
        twists: Array | None = None,
        code: ModuleType | None,
    ) -> tuple[Array, NDArray[np.int64]]:
        """Drive on until their controllers are done and they stand, or the steps are over.

        Args:
            first: Number of the first step since their starts.
            steps: Most steps.
            which: Numbers of the robots; the others stay as they are.
            twists: Forward speed [m/s] and yaw rate [rad/s] that each is commanded in these steps, shape
                (N, 2). Default: their guides command.
            code: `compiled.py`, which drives on several threads if that pays, or None for plain Python.

        Returns:
            Their records, shape (N, RECORD, steps), and the number of steps of each, shape (N,).
        """
        count = len(which)
        guides = [self._guides[n] for n in which]
        state, laws = self.state[which], np.array([guide.law for guide in guides], np.int64)
        if twists is None:
            tables, begin, end = _tables(guides)
        else:
            laws[:], state["node"] = loop.COMMANDS, 0.0
            tables, begin = np.zeros((loop.TABLE, count)), np.arange(count)
            tables[0], tables[1:3], end = first * self._drives["dt"][which], twists.T, begin + 1
        record, made = np.empty((count, loop.RECORD, steps)), np.empty(count, np.int64)
        drives, gains, errors = self._drives[which], self._gains[which], self._errors[which]

        def work(rows: slice) -> None:
            assert code is not None
            robots = laws[rows], drives[rows], gains[rows], errors[rows], tables, begin[rows], end[rows]
            code.robots(*robots, *self._room, state[rows], first, steps, record[rows], made[rows])

        if code is not None:
            in_threads(work, count, math.ceil(SHARE / steps))
        else:
            room = _lists(self._room)
            for i, guide in enumerate(guides):
                table = guide.columns if twists is None else tables[:, i : i + 1].tolist()
                drive, gain = loop.Drive(*drives[i].item()), loop.Gains(*gains[i].item())
                now = loop.State(*state[i].item())
                columns = [array("d", bytes(8 * steps)) for _ in range(loop.RECORD)]  # faster than an array
                made[i] = loop.drive_on(
                    laws[i], drive, gain, errors[i].tolist(), table, *room, now, first, steps, columns
                )
                record[i], state[i] = columns, _row(now)
        self.state[which] = state
        return record, made


def _lists(room: Room) -> tuple[list[list[float]], list[int]]:
    """A room for plain Python: edges and boxes, and first edge of each obstacle."""
    edges, boxes, spans = room
    return [*edges.tolist(), *boxes.tolist()], spans.tolist()


def _row(state: loop.State) -> tuple[float, ...]:
    """A state as a row of an array."""
    return tuple(getattr(state, name) for name in loop.STATE.names or ())


def _tables(guides: Sequence[Guide]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """The tables of all guides in one, and where each begins and ends; those of one path share theirs."""
    distinct = {id(guide.table): guide.table for guide in guides}
    ends = np.cumsum([table.shape[1] for table in distinct.values()])
    places = dict(zip(distinct, ends, strict=True))
    last = np.array([places[id(guide.table)] for guide in guides], np.int64)
    begin = last - [guide.table.shape[1] for guide in guides]
    tables = next(iter(distinct.values()))
    if len(distinct) > 1:
        tables = np.concatenate(list(distinct.values()), axis=1)
    return tables, begin, last


def fence_of(obstacles: Obstacles) -> Room:
    """Obstacles for `loop.robots`: edges (4, E), boxes (4, O), and first edge of each obstacle (O + 1,)."""
    edges, begins = obstacles.edges
    boxes = [np.concatenate([o.min(axis=0), o.max(axis=0)]) for o in obstacles.outlines]
    box = np.array(boxes).reshape(-1, 4)
    return np.ascontiguousarray(edges.T), np.ascontiguousarray(box.T), begins.astype(np.int64)


def motion_of(closed_loop: ClosedLoop, record: Array) -> Motion:
    """The motion in a record of `loop.drive_on`, shape (RECORD, K)."""
    x, y, yaw, v, w, wheel_v, wheel_w, v_cmd, w_cmd, bump = record
    poses = mapped.empty((len(x) + 1, 3))
    poses[0] = closed_loop.pose0
    for rows in mapped.parts(len(x)):
        poses[rows.start + 1 : rows.stop + 1] = np.stack([x[rows], y[rows], yaw[rows]], axis=1)
    known = {"wheel_v": wheel_v, "wheel_w": wheel_w, "v_cmd": v_cmd, "w_cmd": w_cmd, "poses": poses}
    return Motion(closed_loop.drive, closed_loop.dt, v, w, closed_loop.pose0, bump=bump > 0, **known)


class Chassis:
    """A robot that is commanded step by step: by a custom controller, a keyboard, or a learner."""

    def __init__(self, closed_loop: ClosedLoop, obstacles: Obstacles | None = None) -> None:
        """Put a robot at its start; the guide is not used."""
        obstacles = obstacles or Obstacles()
        closed_loop.check(obstacles)
        self._course = closed_loop
        self._drive, self._gains, self._now = closed_loop.parts()
        self._now.free = 0.0 if len(obstacles) else math.inf
        self._room = _lists(fence_of(obstacles))
        self._steps, self._last, self._age_s = 0, (0.0, 0.0), 0.0

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self._steps * self._course.dt

    @property
    def pose(self) -> Pose:
        """Its x [m], y [m], yaw [rad] in world."""
        return self._now.x, self._now.y, self._now.yaw

    @property
    def twist(self) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s] of the wheels."""
        return self._now.v, self._now.w

    @property
    def bump(self) -> bool:
        """Whether it touches an obstacle."""
        return self._now.bump > 0

    def step(self, command: tuple[float, float] | None) -> Array:
        """Drive for one control step.

        Args:
            command: Forward speed [m/s] and yaw rate [rad/s]. None keeps the last command until the drive's
                command_timeout_s is over.

        Returns:
            The record of the step, shape (loop.RECORD,).
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
        table, record = [[self.t], [self._last[0]], [self._last[1]]], [[0.0] for _ in range(loop.RECORD)]
        self._now.node = 0.0
        robot = loop.COMMANDS, self._drive, self._gains, EXACT.figures, table, *self._room, self._now
        loop.drive_on(*robot, self._steps, 1, record)
        self._steps += 1
        return np.array([column[0] for column in record])
