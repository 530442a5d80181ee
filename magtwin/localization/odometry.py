"""Odometry: increments of the pose, and dead reckoning."""

import math
from collections.abc import Sequence

import numpy as np

from magtwin.localization.problem import Array, Estimate, Problem, Reading

STILL_M = 1e-3
"""Motion within which a reading may repeat itself to the bit: metres, and radians / 10."""


def increment(
    before: tuple[float, float, float], now: tuple[float, float, float]
) -> tuple[float, float, float]:
    """The motion between two poses of odometry, in the axes of the robot halfway through the turn.

    Args:
        before: x, y [m] and yaw [rad] in odom.
        now: The same later.

    Returns:
        Forward and leftward distance [m] and turn [rad]. A pose moves by it as
        x += f cos(yaw + a / 2) - l sin(yaw + a / 2), y += f sin(yaw + a / 2) + l cos(yaw + a / 2), yaw += a.
    """
    turn = now[2] - before[2]
    middle = before[2] + turn / 2
    dx, dy = now[0] - before[0], now[1] - before[1]
    c, s = math.cos(middle), math.sin(middle)
    return dx * c + dy * s, dy * c - dx * s, turn


def moved(pose: Sequence[float] | Array, motion: Sequence[float] | Array) -> tuple[float, float, float]:
    """A pose after a motion (forward, left, turn) of `increment`."""
    (x, y, yaw), (forward, left, turn) = pose, motion
    c, s = math.cos(yaw + turn / 2), math.sin(yaw + turn / 2)
    return x + (forward * c - left * s), y + (forward * s + left * c), yaw + turn


class Repeats:
    """Tells the readings of a stuck sensor: equal to the bit although the robot moves."""

    def __init__(self) -> None:
        self._b_nt, self._moved = math.nan, 0.0

    def usable(self, b_nt: float, motion: tuple[float, float, float]) -> bool:
        """Whether a reading after a motion is a number, and no repeat."""
        if b_nt == self._b_nt:
            forward, left, turn = motion
            self._moved += math.hypot(forward, left) + 0.1 * abs(turn)
        else:
            self._b_nt, self._moved = b_nt, 0.0
        return math.isfinite(b_nt) and self._moved <= STILL_M


class Odometry:
    """Dead reckoning: the prior moved by odometry, with first-order covariance. It reads no field.

    The state is x, y, yaw and the scale error s of the distance; P' = F P F' + G Q G' (Thrun, Burgard and Fox
    2005, Probabilistic Robotics, section 7.4).
    """

    def reset(self, problem: Problem) -> None:
        """Begin at the prior's mean; in the middle of the extent where that is unknown."""
        self._model = problem.odometry
        self.pose, sd = problem.start
        self.covariance: Array = np.diag([s**2 for s in sd] + [self._model.scale_std**2])
        self._last: Reading | None = None
        self._lost = any(map(math.isinf, problem.prior.sd))

    def step(self, reading: Reading) -> Estimate:
        """Move by the increment since the last reading."""
        if self._last is not None:
            self._move(increment(self._last.odometry, reading.odometry), reading.t - self._last.t)
        self._last = reading
        x, y, yaw = self.pose
        return Estimate(reading.t, x, y, yaw, self.covariance[:3, :3].copy(), lost=self._lost)

    def _move(self, motion: tuple[float, float, float], dt: float) -> None:
        x, y, _ = self.pose
        self.pose = moved(self.pose, motion)
        forward, left, turn = motion
        dx, dy = self.pose[0] - x, self.pose[1] - y
        f = np.eye(4)
        f[:2, 2] = -dy, dx
        f[:2, 3] = dx, dy
        noise = self._model.variances(math.hypot(forward, left), turn, dt)
        self.covariance = f @ self.covariance @ f.T + np.diag([*noise, 0.0])
