"""Model: how the state of magnetic SLAM moves and what the magnetometer reads, with derivatives.

A pose is a position p and a rotation R from base_link to world; its error is (dp, a) with p + dp and
exp([a]x) R. The robot's state also has the drift d of the magnetometer. Constants of a run are g: the scale
error s and the velocity error u of odometry, the magnetometer's offset o and soft iron W (or c and s of the
session's iron), the uniform field f0 and the weights m of the eigenfunctions. With odometry's increments
(l, D) between two readings,

    body axes:   p' = p + R ((1 + s) l + u dt),  R' = R D
    world axes:  p' = p + (1 + s) l + u dt,      R' = D R
    d' = exp(-dt / tau) d + noise

Three axes, at the sensor q = p + R r:  y = (I + W) R' (f0 + grad Phi(q) m) + o + d + noise, R' transposed.
Magnitude:                              y = f0 + phi(q) m + c cos(yaw) + s sin(yaw) + d + noise.

The magnitude needs only x, y and yaw. Viset, Helmons and Kok 2022, An extended Kalman filter for magnetic
field SLAM using Gaussian process regression, Sensors 22(8), 2833, has the three-axis model in world axes with
f0 and m alone.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtwin.errors import InputError
from magtwin.localization.problem import Estimate, Problem
from magtwin.localization.slam.hilbert import Basis, basis
from magtwin.localization.slam.samples import Samples, about_z
from magtwin.localization.slam.settings import Settings

Array = NDArray[np.float64]

LEAST_STD_M, LEAST_STD_RAD, LEAST_STD_NT = 1e-4, 1e-5, 1e-2
"""Least standard deviations of a step, so that weights stay finite."""

MARGIN_M = 1.0
"""Space between the floor's extent and the border of the eigenfunctions' box [m]."""

MOST_TILT = math.radians(1)
"""Most standard deviation of roll and pitch at the start [rad]."""


class State(NamedTuple):
    """A trajectory of N poses and the constants of the run."""

    p: Array
    """Positions [m], shape (N, 3)."""

    R: Array
    """Rotations from base_link to world, shape (N, 3, 3)."""

    drift: Array
    """Drift of the magnetometer [nT], shape (N, m), or (N, 0) without drift."""

    g: Array
    """Constants of the run, shape (G,)."""


class Steps(NamedTuple):
    """Increments of odometry between consecutive samples, each with shape (N - 1, ...)."""

    local: Array
    """Translation l [m], (3,)."""

    turn: Array
    """Rotation D, (3, 3)."""

    dt: Array
    """Time [s], ()."""

    variance: Array
    """Variances of the state's errors, (D,)."""


@dataclass(frozen=True)
class Layout:
    """Places of the constants in g; empty slices for those that are not estimated."""

    scale: slice
    velocity: slice
    offset: slice
    soft: slice
    iron: slice
    uniform: slice
    weights: slice

    @property
    def motion(self) -> slice:
        """Scale and velocity error."""
        return slice(0, self.velocity.stop)

    @property
    def count(self) -> int:
        """Number of constants."""
        return self.weights.stop


class Model:
    """The model of one run.

    Args:
        problem: Extent, prior and noise.
        settings: Prior of the field.
        first: The first sample: it sets the start of the height, of roll and of pitch.
        vector: Whether readings have three axes.

    Raises:
        InputError: The start is unknown.
    """

    def __init__(self, problem: Problem, settings: Settings, first: Samples, vector: bool) -> None:
        prior, sensor = problem.prior, problem.sensor
        if not all(math.isfinite(s) for s in prior.sd):
            raise InputError("SLAM needs a prior with finite standard deviations: its map starts there")
        self.problem, self.settings, self.vector = problem, settings, vector
        self.width = 3 if vector else 1
        self.active = np.arange(6) if vector else np.array([0, 1, 5])
        self.drifts = self.width if sensor.drift_nt > 0 else 0
        self.size = len(self.active) + self.drifts
        self.lever = np.array([*sensor.lever_arm_m, 0.0])
        self._odometry_yaw = math.atan2(first.R_odom[0, 1, 0], first.R_odom[0, 0, 0])
        R0 = about_z(np.array(prior.mean[2] - self._odometry_yaw)) @ first.R_odom[0]
        p0 = np.array([prior.mean[0], prior.mean[1], first.p_odom[0, 2]])
        tilt = min(prior.sd[2], MOST_TILT)
        pose_sd = np.array([prior.sd[0], prior.sd[1], LEAST_STD_M, tilt, tilt, prior.sd[2]])[self.active]
        self.start_variance = np.concatenate([pose_sd**2, np.full(self.drifts, sensor.drift_nt**2)])
        self.basis, variances = self._field(float(p0[2]))
        self.layout, self.constants_variance = self._constants(variances)
        zero = np.zeros(self.layout.count)
        self.start = State(p0[None], R0[None], np.zeros((1, self.drifts)), zero)

    def _field(self, height: float) -> tuple[Basis, Array]:
        settings, margin = self.settings, MARGIN_M
        x0, x1, y0, y1 = self.problem.extent
        low, high = [x0 - margin, y0 - margin], [x1 + margin, y1 + margin]
        sd = settings.sd_nt
        if self.vector:
            low, high = [*low, height - margin], [*high, height + margin]
            sd *= settings.length_m  # the potential's, whose slope has the sd of the field
        functions = basis(low, high, int(settings.functions))
        return functions, functions.variances(sd=sd, length_m=settings.length_m)

    def _constants(self, variances: Array) -> tuple[Layout, Array]:
        s, sensor, odometry = self.settings, self.problem.sensor, self.problem.odometry
        offset, iron = (sensor.offset_nt, sensor.iron_nt) if s.calibrate else (0.0, 0.0)
        soft = s.soft_iron_sd if s.calibrate else 0.0
        hard = math.hypot(offset, iron)
        uniform = s.uniform_sd_nt if self.vector else math.hypot(s.uniform_sd_nt, offset)
        parts = [
            np.full(1 if odometry.scale_std > 0 else 0, odometry.scale_std**2),
            np.full(2 if s.velocity_sd_m_s > 0 else 0, s.velocity_sd_m_s**2),
            np.full(3 if self.vector and hard > 0 else 0, hard**2),
            np.full(9 if self.vector and soft > 0 else 0, soft**2),
            np.full(0 if self.vector or not iron > 0 else 2, iron**2),
            np.full(self.width, uniform**2),
            variances,
        ]
        ends = np.cumsum([0] + [len(part) for part in parts]).tolist()
        return Layout(*[slice(a, b) for a, b in pairwise(ends)]), np.concatenate(parts)

    def steps(self, samples: Samples) -> Steps:
        """Odometry's increments between samples and their variances."""
        before, after = samples.R_odom[:-1], samples.R_odom[1:]
        moved, dt = np.diff(samples.p_odom, axis=0), np.diff(samples.t)
        if self.settings.odometry_axes == "body":
            turn = before.transpose(0, 2, 1) @ after
            local = (before.transpose(0, 2, 1) @ moved[..., None])[..., 0]
        else:  # the odometry's frame turned onto the world's at the start
            turn, local = after @ before.transpose(0, 2, 1), moved
            onto = about_z(np.array(self.problem.prior.mean[2] - self._odometry_yaw))
            turn, local = onto @ turn @ onto.T, local @ onto.T
        yaw = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
        x, y, heading = self.problem.odometry.variances(np.linalg.norm(local[:, :2], axis=1), yaw, dt).T
        tilt, z = self.settings.tilt_std_s**2 * dt, self.settings.vertical_std_s**2 * dt
        q = np.stack([x, y, z, tilt, tilt, heading], axis=1)
        q[:, :3], q[:, 3:] = np.maximum(q[:, :3], LEAST_STD_M**2), np.maximum(q[:, 3:], LEAST_STD_RAD**2)
        sensor = self.problem.sensor
        kept = -np.expm1(-2 * dt / sensor.drift_s) * sensor.drift_nt**2
        drift = np.repeat(np.maximum(kept, LEAST_STD_NT**2)[:, None], self.drifts, axis=1)
        return Steps(local, turn, dt, np.concatenate([q[:, self.active], drift], axis=1))

    def move(self, state: State, steps: Steps) -> tuple[State, Array, Array]:
        """States one step later, without noise.

        Args:
            state: N states.
            steps: N steps.

        Returns:
            The states; their derivatives by the states' errors, shape (N, D, D), and by scale and velocity
            error, shape (N, D, K).
        """
        layout, count = self.layout, len(steps.dt)
        moved = steps.local
        if layout.scale.stop > layout.scale.start:
            moved = moved * (1 + state.g[layout.scale])
        has_velocity = layout.velocity.stop > layout.velocity.start
        if has_velocity:
            moved = moved + np.outer(steps.dt, [*state.g[layout.velocity], 0.0])
        f = np.zeros((count, 6, 6))
        f[:, :3, :3] = np.eye(3)
        if self.settings.odometry_axes == "body":
            into = state.R
            d = (into @ moved[..., None])[..., 0]
            R = state.R @ steps.turn
            f[:, :3, 3:] = -cross(d)
            f[:, 3:, 3:] = np.eye(3)
        else:
            into = np.broadcast_to(np.eye(3), (count, 3, 3))
            d = moved
            R = steps.turn @ state.R
            f[:, 3:, 3:] = steps.turn
        by_motion = np.zeros((count, 6, layout.motion.stop))
        if layout.scale.stop > layout.scale.start:
            by_motion[:, :3, 0] = (into @ steps.local[..., None])[..., 0]
        if has_velocity:
            by_motion[:, :3, layout.velocity] = into[:, :, :2] * steps.dt[:, None, None]
        keep = np.exp(-steps.dt / self.problem.sensor.drift_s)
        by_state = np.zeros((count, self.size, self.size))
        n = len(self.active)
        by_state[:, :n, :n] = f[:, self.active[:, None], self.active]
        by_state[:, range(n, self.size), range(n, self.size)] = keep[:, None]
        by_constants = np.zeros((count, self.size, layout.motion.stop))
        by_constants[:, :n] = by_motion[:, self.active]
        drift = state.drift * keep[:, None]
        return State(state.p + d, R, drift, state.g), by_state, by_constants

    def measure(self, state: State) -> tuple[Array, Array, Array]:
        """Expected readings [nT], shape (N, m).

        Returns:
            The readings; their derivatives by the states' errors, shape (N, m, D), and by the constants,
            shape (N, m, G).
        """
        return self._three_axes(state) if self.vector else self._magnitude(state)

    def expected(self, state: State) -> Array:
        """Expected readings [nT], shape (N, m)."""
        if not self.vector:
            return self._magnitude(state)[0]
        f = self.basis.slopes(state.p + state.R @ self.lever, state.g[self.layout.weights])
        f += state.g[self.layout.uniform]
        return self._sensed((f[:, None] @ state.R)[:, 0], state)

    def _sensed(self, b: Array, state: State) -> Array:
        """What the magnetometer makes of the field in the robot's axes, shape (N, 3)."""
        layout, y = self.layout, b
        if layout.soft.stop > layout.soft.start:
            y = y + b @ state.g[layout.soft].reshape(3, 3).T
        if layout.offset.stop > layout.offset.start:
            y = y + state.g[layout.offset]
        return y + state.drift if self.drifts else y

    def _three_axes(self, state: State) -> tuple[Array, Array, Array]:
        layout, count = self.layout, len(state.p)
        weights = state.g[layout.weights]
        arm = state.R @ self.lever
        q = state.p + arm
        gradients, slope, hessian = self.basis.derivatives(q, weights)
        f = slope + state.g[layout.uniform]
        into = state.R.transpose(0, 2, 1)
        b = (into @ f[..., None])[..., 0]
        y = self._sensed(b, state)
        has_soft = layout.soft.stop > layout.soft.start
        if has_soft:
            into = (np.eye(3) + state.g[layout.soft].reshape(3, 3)) @ into
        by_state = np.zeros((count, 3, self.size))
        by_state[:, :, :3] = into @ hessian
        by_state[:, :, 3:6] = into @ cross(f) - by_state[:, :, :3] @ cross(arm)
        by_constants = np.zeros((count, 3, layout.count))
        if layout.offset.stop > layout.offset.start:
            by_constants[:, :, layout.offset] = np.eye(3)
        if has_soft:
            for row in range(3):
                start = layout.soft.start + 3 * row
                by_constants[:, row, start : start + 3] = b
        if self.drifts:
            by_state[:, :, 6:] = np.eye(3)
        by_constants[:, :, layout.uniform] = into
        np.matmul(into, gradients, out=by_constants[:, :, layout.weights])
        return y, by_state, by_constants

    def _magnitude(self, state: State) -> tuple[Array, Array, Array]:
        layout, count = self.layout, len(state.p)
        weights = state.g[layout.weights]
        arm = state.R @ self.lever
        q = (state.p + arm)[:, :2]
        values = self.basis.values(q)
        slope = self.basis.gradients(q) @ weights
        y = (values @ weights + state.g[layout.uniform])[:, None]
        by_state = np.zeros((count, 1, self.size))
        by_state[:, 0, :2] = slope
        by_state[:, 0, 2] = slope[:, 1] * arm[:, 0] - slope[:, 0] * arm[:, 1]
        by_constants = np.zeros((count, 1, layout.count))
        if layout.iron.stop > layout.iron.start:
            c, s = state.R[:, 0, 0], state.R[:, 1, 0]
            along, across = state.g[layout.iron]
            y = y + (along * c + across * s)[:, None]
            by_state[:, 0, 2] += across * c - along * s
            by_constants[:, 0, layout.iron] = np.column_stack([c, s])
        if self.drifts:
            y = y + state.drift
            by_state[:, 0, 3] = 1.0
        by_constants[:, 0, layout.uniform] = 1.0
        by_constants[:, 0, layout.weights] = values
        return y, by_state, by_constants

    def add(self, state: State, states_error: Array, constants_error: Array) -> State:
        """States plus errors of shape (N, D), and constants plus an error of shape (G,)."""
        n = len(self.active)
        error = np.zeros((len(state.p), 6))
        error[:, self.active] = states_error[:, :n]
        R = Rotation.from_rotvec(error[:, 3:]).as_matrix() @ state.R
        return State(state.p + error[:, :3], R, state.drift + states_error[:, n:], state.g + constants_error)

    def difference(self, after: State, before: State) -> Array:
        """The states' error e with `add(before, e) = after`, shape (N, D)."""
        turned = Rotation.from_matrix(after.R @ before.R.transpose(0, 2, 1)).as_rotvec()
        pose = np.concatenate([after.p - before.p, turned], axis=1)[:, self.active]
        return np.concatenate([pose, after.drift - before.drift], axis=1)

    def estimate(self, t: float, p: Array, R: Array, covariance: Array, drift: Array) -> Estimate:
        """A pose and its covariance, shape (D, D), as x, y and yaw."""
        yaw = math.atan2(R[1, 0], R[0, 0])
        rows = np.zeros((3, self.size))
        rows[0, 0] = rows[1, 1] = 1.0
        if self.vector:  # d yaw = a_z + tan(pitch) (a_x cos(yaw) + a_y sin(yaw)), pitch positive upwards
            climb = R[2, 0] / math.hypot(R[0, 0], R[1, 0])
            rows[2, 3:6] = -climb * math.cos(yaw), -climb * math.sin(yaw), 1.0
        else:
            rows[2, 2] = 1.0
        bias = None if self.vector or not self.drifts else float(drift[0])
        return Estimate(t, float(p[0]), float(p[1]), yaw, rows @ covariance @ rows.T, bias)


def cross(v: Array) -> Array:
    """Matrices [v]x with [v]x w = v x w, shape (N, 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out
