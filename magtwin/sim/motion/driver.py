"""Driver: a random, human-like driver; a controller without a path.

Ten times a second, about as fast as people react, the driver decides. Speed and turn wander as
Ornstein-Uhlenbeck processes, dx = -(x - m) dt / tau + s sqrt(2 / tau) dW, exactly discretised, with pauses in
between. The driver heads for a seldom visited place, around obstacles, until it is reached or takes too long.
The robot never bumps: a command is given only if the footprint stays clear of everything until the next
decision and while braking after it, with a margin for lag and wheel errors.
"""

import math

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.sim.motion.drive import Pose
from magtwin.spec.drive import DriveSpec
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles

Array = NDArray[np.float64]

DECIDE_S = 0.1
"""Time between decisions [s]."""

CELL_M = 0.02
"""Spacing of the table of clearances [m]."""

MARGIN_M = 0.04
"""Least planned clearance [m]; wheel errors and lag use some of it."""

SPEED_TAU_S, SPEED_SHARE = 3.0, 0.3
"""Time constant of the speed [s], and its standard deviation as a share of its mean."""

TURN_TAU_S, TURN_STD = 0.8, 0.35
"""Time constant [s] and standard deviation [rad/s] of the random part of the turn."""

PAUSE_EVERY_S, PAUSE_S = 25.0, 1.5
"""Mean time between pauses and mean length of one [s]."""

PLACE_M = 0.25
"""Spacing of the goals [m]."""

NEAR_M, PATIENCE_S = 0.25, 15.0
"""Distance at which a goal counts as reached [m], and time after which it is given up [s]."""

SIGHT_M = 0.5
"""Distance ahead that is checked for obstacles [m]."""

ASIDE = tuple(math.radians(a) for a in (0, 25, -25, 50, -50, 75, -75, 105, -105, 140, -140, 180))
"""Directions that are tried, relative to that of the goal [rad]."""

STEER = 1.8
"""Gain from the angle to the wanted direction to the turn [1/s]."""


class Driver:
    """A human-like driver; a `magtwin.sim.motion.controllers.Controller`."""

    def __init__(
        self,
        drive: DriveSpec,
        rng: np.random.Generator,
        *,
        lab: LabSpec,
        obstacles: Obstacles,
        footprint_radius_m: float,
        start: Pose,
        speed: float = 0.2,
        duration_s: float = 60.0,
    ) -> None:
        """Measure the room."""
        if not 0 < speed <= drive.v_max:
            most = f"at most {drive.v_max:g} m/s, the drive's v_max"
            raise InputError(f"speed must be above 0 and {most}; got {speed!r}")
        self._drive, self._rng, self._speed, self._duration_s = drive, rng, speed, duration_s
        self._keep = footprint_radius_m + MARGIN_M
        x0, x1, y0, y1 = lab.extent_m
        self._low = x0, y0
        self._clear = _clearances(lab, obstacles)
        if self._clearance(start[0], start[1]) < self._keep:
            near = f"less than {self._keep:.3f} m from a wall or an obstacle"
            at = f"({start[0]:.3f}, {start[1]:.3f}) m"
            raise InputError(f"a driver has no room at {at}: {near}; begin elsewhere")
        across = [np.arange(low + PLACE_M / 2, high, PLACE_M) for low, high in ((x0, x1), (y0, y1))]
        grid = np.array([(x, y) for x in across[0] for y in across[1]])
        free = [self._clearance(x, y) > self._keep + 0.05 for x, y in grid.tolist()]
        self._places = grid[free] if any(free) else np.array([start[:2]])
        self._visits = np.zeros(len(self._places))
        self._goal, self._goal_until = 0, -1.0
        self._ou_v, self._ou_w = rng.standard_normal(2).tolist()
        self._pause_until, self._next_decision = 0.0, 0.0
        self._command = 0.0, 0.0
        self._t = 0.0

    @property
    def done(self) -> bool:
        """Whether the time is over."""
        return self._t >= self._duration_s

    def command(self, t: float, x: float, y: float, yaw: float, v: float, w: float) -> tuple[float, float]:
        """As for `magtwin.sim.motion.controllers.Controller`."""
        self._t = t
        if self.done:
            return 0.0, 0.0
        if t >= self._next_decision - 1e-9:
            self._next_decision = t + DECIDE_S
            self._command = self._decide(t, x, y, yaw, v)
        return self._command

    def _decide(self, t: float, x: float, y: float, yaw: float, v: float) -> tuple[float, float]:
        """Decide on a command."""
        drive = self._drive
        for name, tau in (("_ou_v", SPEED_TAU_S), ("_ou_w", TURN_TAU_S)):
            left, noise = math.exp(-DECIDE_S / tau), self._rng.standard_normal()
            setattr(self, name, left * getattr(self, name) + math.sqrt(1 - left * left) * noise)
        begins = self._rng.random()
        self._visit(t, x, y)
        if t < self._pause_until:
            return 0.0, 0.0
        if begins < DECIDE_S / PAUSE_EVERY_S:
            self._pause_until = t + self._rng.exponential(PAUSE_S)
            return 0.0, 0.0
        off = self._direction(x, y, yaw)
        wanted_w = STEER * off + TURN_STD * self._ou_w
        wanted_w = min(max(wanted_w, -0.9 * drive.w_max), 0.9 * drive.w_max)
        ahead = max(0.0, math.cos(min(abs(off), math.pi / 2)))
        wanted_v = self._speed * (1.0 + SPEED_SHARE * self._ou_v) * ahead
        wanted_v = min(max(wanted_v, 0.0), drive.v_max)
        for share in (1.0, 0.6, 0.3, 0.1):
            if self._safe(x, y, yaw, max(wanted_v * share, 0.0), v, wanted_w):
                return wanted_v * share, wanted_w
        return 0.0, wanted_w if abs(off) > 0.2 else math.copysign(0.8, off)

    def _visit(self, t: float, x: float, y: float) -> None:
        """Count the visit, and choose a new goal if needed."""
        away = np.hypot(self._places[:, 0] - x, self._places[:, 1] - y)
        self._visits[away < PLACE_M] += DECIDE_S
        if t < self._goal_until and away[self._goal] > NEAR_M:
            return
        self._visits[self._goal] += 1.0  # reached, or given up
        seldom = np.exp(-(self._visits - self._visits.min()) / 2.0) * (0.2 + np.exp(-away / 2.0))
        self._goal = int(self._rng.choice(len(seldom), p=seldom / seldom.sum()))
        self._goal_until = t + PATIENCE_S

    def _direction(self, x: float, y: float, yaw: float) -> float:
        """Direction to drive, relative to the heading [rad]: to the goal, or past obstacles."""
        gx, gy = self._places[self._goal].tolist()
        far = math.hypot(gx - x, gy - y)
        towards = math.atan2(gy - y, gx - x)
        best, best_free = towards, -1.0
        for aside in ASIDE:
            angle = towards + aside
            reach = min(SIGHT_M, max(far, 0.1)) if aside == 0 else SIGHT_M
            free = self._sight(x, y, angle, reach)
            if free >= reach:
                best = angle
                break
            if free > best_free:
                best, best_free = angle, free
        return (best - yaw + math.pi) % (2 * math.pi) - math.pi

    def _sight(self, x: float, y: float, angle: float, reach: float) -> float:
        """Distance that the footprint can go straight, up to `reach` [m]."""
        cos, sin = math.cos(angle), math.sin(angle)
        way = 0.0
        while way < reach:
            way += 0.05
            if self._clearance(x + way * cos, y + way * sin) < self._keep:
                return way - 0.05
        return reach

    def _safe(self, x: float, y: float, yaw: float, v_cmd: float, v: float, w: float) -> bool:
        """Whether a command is safe until the next decision, and while braking after it."""
        drive = self._drive
        fastest = max(v_cmd, v)
        way = fastest * (DECIDE_S + 2 * drive.motor_lag_s + 0.02) + fastest * fastest / (2 * drive.a_max)
        here = self._clearance(x, y)
        if here - way >= self._keep:
            return True
        for turn in (w, w / 2, 0.0):
            bend = turn / max(fastest, 0.05)
            px, py, heading = x, y, yaw
            parts = max(2, math.ceil(way / 0.02))
            step = way / parts
            for _ in range(parts):
                px += step * math.cos(heading + bend * step / 2)
                py += step * math.sin(heading + bend * step / 2)
                heading += bend * step
                near = self._clearance(px, py)
                if near < self._keep and near < here:
                    return False
        return True

    def _clearance(self, x: float, y: float) -> float:
        """Lower bound of the distance of a point from everything [m]."""
        low_x, low_y = self._low
        i, j = round((x - low_x) / CELL_M), round((y - low_y) / CELL_M)
        rows = self._clear
        return rows[i][j] if 0 <= i < len(rows) and 0 <= j < len(rows[0]) else 0.0


def _clearances(lab: LabSpec, obstacles: Obstacles) -> list[list[float]]:
    """Distances of a grid's nodes from the floor's border and all obstacles, less half a cell [m]."""
    x0, x1, y0, y1 = lab.extent_m
    x = x0 + CELL_M * np.arange(round((x1 - x0) / CELL_M) + 1)
    y = y0 + CELL_M * np.arange(round((y1 - y0) / CELL_M) + 1)
    p = np.column_stack([np.repeat(x, len(y)), np.tile(y, len(x))])
    distance, _ = obstacles.clearance(p, reach_m=1.0)
    nearest = np.minimum(distance, lab.inside_m(p)) - CELL_M * math.sqrt(0.5)
    rows: list[list[float]] = nearest.reshape(len(x), len(y)).tolist()
    return rows
