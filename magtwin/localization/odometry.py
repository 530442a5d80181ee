"""Odometry: increments of the pose, and dead reckoning."""

import math

import numpy as np

from magtwin.localization.problem import Array, Estimate, Problem, Reading

MOST_SD = 1e3
"""Standard deviation that stands for an unknown start [m, rad]."""

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


def repeats(before: Reading | None, now: Reading) -> bool:
    """Whether a reading equals the one before to the bit although the robot moved: the sensor is stuck."""
    if before is None or before.b_nt != now.b_nt:
        return False
    forward, left, turn = increment(before.odometry, now.odometry)
    return math.hypot(forward, left) + 0.1 * abs(turn) > STILL_M


class Odometry:
    """Dead reckoning: the prior moved by odometry, with first-order covariance. It reads no field.

    The state is x, y, yaw and the scale error s of the distance; P' = F P F' + G Q G' (Thrun, Burgard and Fox
    2005, Probabilistic Robotics, section 7.4).
    """

    def reset(self, problem: Problem) -> None:
        """Begin at the prior's mean; in the middle of the extent where that is unknown."""
        self._model, self._rate = problem.odometry, problem.rate_hz
        x0, x1, y0, y1 = problem.extent
        sd, mean = problem.prior.sd, problem.prior.mean
        self.pose = mean if not problem.prior.is_global else ((x0 + x1) / 2, (y0 + y1) / 2, mean[2])
        spread = [(x1 - x0) / math.sqrt(12), (y1 - y0) / math.sqrt(12), math.pi / math.sqrt(3)]
        known = [s if math.isfinite(s) else wide for s, wide in zip(sd, spread, strict=True)]
        self.covariance: Array = np.diag([s**2 for s in known] + [self._model.scale_std**2])
        self._last: Reading | None = None
        self._lost = any(math.isinf(s) for s in sd)

    def step(self, reading: Reading) -> Estimate:
        """Move by the increment since the last reading."""
        if self._last is not None:
            forward, left, turn = increment(self._last.odometry, reading.odometry)
            self._move(forward, left, turn, reading.t - self._last.t)
        self._last = reading
        x, y, yaw = self.pose
        return Estimate(reading.t, x, y, yaw, self.covariance[:3, :3].copy(), lost=self._lost)

    def _move(self, forward: float, left: float, turn: float, dt: float) -> None:
        x, y, yaw = self.pose
        c, s = math.cos(yaw + turn / 2), math.sin(yaw + turn / 2)
        dx, dy = forward * c - left * s, forward * s + left * c
        self.pose = (x + dx, y + dy, yaw + turn)
        f = np.eye(4)
        f[:2, 2] = -dy, dx
        f[:2, 3] = dx, dy
        noise = self._model.variances(math.hypot(forward, left), turn, dt)
        self.covariance = f @ self.covariance @ f.T + np.diag([*noise, 0.0])
