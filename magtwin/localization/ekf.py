"""Extended Kalman filter on the map of the field."""

import math

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.trilinear import sd_at
from magtwin.localization.belief import Table, as_map, mean_variance, tempering
from magtwin.localization.odometry import Repeats, increment
from magtwin.localization.problem import Array, Estimate, Problem, Reading

SETTLED_M = 0.5
"""Standard deviation of the position, sqrt(var x + var y), below which it counts as known [m]."""

MAP_CORRELATED = 0.8
"""Share of the map's variance that is correlated; the rest is white."""

X, Y, YAW, SCALE, OFFSET = range(5)


class Ekf:
    """Extended Kalman filter (Bar-Shalom, Li and Kirubarajan 2001, sections 10.3 and 10.5).

    The state is x, y, yaw, the scale error of the odometry, the offset of the magnetometer and, where the
    problem has them, its drift (FOGM over time), hard iron c cos(yaw) + s sin(yaw), and the map's error (FOGM
    over distance, relative to the map's standard deviation). With b the reading and h its gradient,

        nu = b - B(p + R(yaw) l, yaw) - offset - drift - c cos(yaw) - s sin(yaw) - sd(p) e
        S = h P h' + R,  x' = x + P h' nu / S,  P' = (I - K h) P (I - K h)' + K R K'

    It follows one mode only: it needs a prior of about the size of the
    features of the field, and cannot start globally, where it is dead reckoning from the middle of the floor.
    Off the map it only predicts. A reading that repeats itself to the bit while the robot moves is not used.

    `lost` is set while the position has a standard deviation above 0.5 m, and once the readings contradict
    the state: the mean of nu^2 / S over about 5 s is above 4.
    """

    def reset(self, problem: Problem) -> None:
        """Begin at the prior's mean, with all errors of the sensors at 0.

        Raises:
            InputError: The problem has no map.
        """
        if problem.belief is None:
            raise InputError("the EKF needs a map; without one, use incremental-slam")
        self._problem = problem
        self._map = as_map(problem.belief, problem.extent)
        table, spreads = self._map.tables()
        self._table, self._spreads = memoryview(table.data), memoryview(spreads.data)
        sensor, (pose, sd) = problem.sensor, problem.start
        self._blind = any(map(math.isinf, problem.prior.sd))
        variances = [*(s**2 for s in sd), problem.odometry.scale_std**2, sensor.offset_nt**2]
        self._rates: list[tuple[float, float]] = [(0.0, 0.0)] * 5
        self._drift = self._iron = self._error = 0
        if sensor.drift_nt > 0:
            self._drift = len(variances)
            variances.append(sensor.drift_nt**2)
            self._rates.append((1 / sensor.drift_s, 0.0))
        if sensor.iron_nt > 0:
            self._iron = len(variances)
            variances += [sensor.iron_nt**2] * 2
            self._rates += [(0.0, 0.0)] * 2
        tables = Table(table, spreads)
        variance = mean_variance(tables)
        self._kappa = tempering(tables, sensor.white_nt)
        if len(variance):
            self._error = len(variances)
            variances.append(MAP_CORRELATED)
            self._rates.append((0.0, 1 / problem.map_length_m))
        self._stationary = np.array(variances)
        self.state = np.array([*pose, *[0.0] * (len(variances) - 3)])
        """State in the order of the class's text."""

        self.covariance = np.diag(variances)
        """Its covariance."""

        self._last: Reading | None = None
        self._repeats, self._surprise = Repeats(), 1.0

    def step(self, reading: Reading) -> Estimate:
        """Predict by the odometry, update by the reading."""
        motion = (0.0, 0.0, 0.0)
        if self._last is not None:
            motion = increment(self._last.odometry, reading.odometry)
            self._predict(*motion, reading.t - self._last.t)
        self._last = reading
        if self._repeats.usable(reading.b_nt, motion):
            self._update(reading.b_nt, self._problem.rate_hz)
        covariance = self.covariance[:3, :3]
        x, y, yaw = self.state[:3].tolist()
        lost = math.sqrt(covariance[0, 0] + covariance[1, 1]) > SETTLED_M or self._surprise > 4 or self._blind
        return Estimate(reading.t, x, y, yaw, covariance.copy(), float(self.state[OFFSET]), lost)

    def _predict(self, forward: float, left: float, turn: float, dt: float) -> None:
        z, size = self.state, len(self.state)
        distance = math.hypot(forward, left)
        middle = z[YAW] + turn / 2
        c, s = math.cos(middle), math.sin(middle)
        ux, uy = forward * c - left * s, forward * s + left * c
        dx, dy = (1 + z[SCALE]) * ux, (1 + z[SCALE]) * uy
        decay = np.array([math.exp(-dt * by_time - distance * by_way) for by_time, by_way in self._rates])
        f = np.diag(decay)
        f[X, YAW], f[Y, YAW], f[X, SCALE], f[Y, SCALE] = -dy, dx, ux, uy
        self.state = decay * z
        self.state[:3] += dx, dy, turn
        noise = self._stationary * (1 - decay**2)
        noise[:3] = self._problem.odometry.variances(distance, turn, dt)
        covariance = f @ self.covariance @ f.T
        covariance[np.arange(size), np.arange(size)] += noise
        self.covariance = covariance

    def _expected(self, z: Array) -> tuple[float, Array, float] | None:
        """Reading at a state, its gradient, and the white variance; None where the map is unknown."""
        x, y, yaw = z[:3].tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        ax, ay = self._problem.sensor.lever_arm_m
        arm_x, arm_y = ax * c - ay * s, ax * s + ay * c
        px, py = x + arm_x, y + arm_y
        b, bx, by, turn = self._map.at_with_gradient(px, py, yaw)
        if not math.isfinite(b + bx + by + turn):
            return None
        h = np.zeros(len(z))
        h[X], h[Y], h[YAW], h[OFFSET] = bx, by, turn - bx * arm_y + by * arm_x, 1.0
        b += z[OFFSET]
        if self._drift:
            h[self._drift] = 1.0
            b += z[self._drift]
        if i := self._iron:
            h[i : i + 2] = c, s
            b += z[i] * c + z[i + 1] * s
            h[YAW] += z[i + 1] * c - z[i] * s
        sd = sd_at(self._table, self._spreads, px, py, yaw, False) if len(self._spreads) else 0.0
        white = sd**2
        if self._error:
            white *= 1 - MAP_CORRELATED
            h[self._error] = sd
            b += z[self._error] * sd
        return float(b), h, self._kappa * (self._problem.sensor.white_nt**2 + white)

    def _update(self, b_nt: float, rate_hz: float) -> None:
        first = self._expected(self.state)
        if first is None:
            return
        b, h, white = first
        p = self.covariance
        ph = p @ h
        total = float(h @ ph) + white
        nis = (b_nt - b) ** 2 / total
        self._surprise += (min(nis, 25.0) - self._surprise) / max(1.0, 5.0 * rate_hz)
        self.state = self.state + ph * ((b_nt - b) / total)
        gain = ph / total
        left = np.eye(len(gain)) - np.outer(gain, h)
        p = left @ p @ left.T + white * np.outer(gain, gain)
        self.covariance = (p + p.T) / 2
