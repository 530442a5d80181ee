"""Bank of extended Kalman filters: many starts at once, until one place is left."""

import math

import numpy as np

from magtwin.compiled import Loops
from magtwin.localization.belief import Table, known_values
from magtwin.localization.grid.state import Known, Motion, Sums
from magtwin.localization.odometry import increment
from magtwin.localization.problem import Array, Problem, Reading

LOOPS = Loops("magtwin.localization.grid.bank_loops", pays=0.0)
"""Compiled loops; a bank in plain Python would take minutes."""

SPAN = 3.6
"""Half width of a Gaussian that is kept [standard deviations]."""

OVERLAP = 0.45
"""Standard deviation of a component by the distance to the next one."""


class Likelihood:
    """What all compiled updates are told of a problem: tables, noise, and dynamics of the linear states.

    Args:
        problem: The problem, with a belief.
        table: Table of the field.
        spreads: Table of its variance, of length 0 if there is none.
        temper: Divisor of the log-likelihood.
    """

    def __init__(self, problem: Problem, table: Array, spreads: Array, temper: float) -> None:
        self.problem, self.table, self.spreads, self.temper = problem, table, spreads, temper
        self.mapped, self.iron = len(spreads) > 0, problem.sensor.iron_nt > 0
        values = known_values(Table(table, spreads))
        self.wide = (float(values.mean()), float(values.var()) + 1.0)
        sensor = problem.sensor
        sd = [sensor.offset_nt, sensor.drift_nt]
        self.start = np.array(sd + [1.0] * self.mapped + [sensor.iron_nt] * (2 * self.iron)) ** 2
        """Prior variances of the linear states: offset, drift, map error, iron cos and sin."""

    def known(self, reading: Reading, reference: Array) -> Known:
        """What a reading tells the compiled updates."""
        sensor = self.problem.sensor
        values = (
            reading.b_nt - reading.disturbance_nt,
            *sensor.lever_arm_m,
            sensor.white_nt**2 + reading.disturbance_sd_nt**2,
            1 / self.temper,
            self.mapped,
            self.iron,
            *self.wide,
            *self.problem.extent,
            *reference.tolist(),
        )
        return Known(*map(float, values))

    def dynamics(self, dt: float, distance: float) -> tuple[Array, Array]:
        """Decay and noise variance of the linear states over a step."""
        sensor = self.problem.sensor
        time = math.exp(-dt / sensor.drift_s)
        along = math.exp(-distance / self.problem.map_length_m)
        decay = [1.0, time] + [along] * self.mapped + [1.0, 1.0] * self.iron
        noise = [0.0, (1 - time**2) * sensor.drift_nt**2] + [1 - along**2] * self.mapped
        return np.array(decay), np.array(noise + [0.0, 0.0] * self.iron)


def moments(sums: Sums) -> tuple[Array, Array]:
    """Mean, minus the reference, and covariance of x, y and yaw from the sums of a compiled update."""
    shift = np.array([sums.x, sums.y, sums.yaw]) / sums.mass
    upper = np.array([sums.xx, sums.xy, sums.x_yaw, sums.yy, sums.y_yaw, sums.yaw_yaw])
    second = np.empty((3, 3))
    second[np.triu_indices(3)] = upper
    second.T[np.triu_indices(3)] = upper
    return shift, second / sums.mass - np.outer(shift, shift)


class Bank:
    """Gaussian sum filter (Alspach and Sorenson 1972, IEEE TAC 17:439) on a grid of starts.

    Each component is an extended Kalman filter of x, y, yaw, odometry scale and the linear states, and starts
    at a node of a grid over the prior. Components whose mass vanishes are dropped.

    Args:
        likelihood: Tables and noise.
        mean: Mean of x, y and yaw.
        sd: Their standard deviations; uniform over the extent or all headings where infinite.
        cell_m: Greatest distance of starts [m].
        step_rad: Greatest distance of their headings [rad].
    """

    def __init__(
        self,
        likelihood: Likelihood,
        mean: tuple[float, float, float],
        sd: tuple[float, float, float],
        *,
        cell_m: float,
        step_rad: float,
    ) -> None:
        self._code, self.likelihood = LOOPS.open(), likelihood
        x0, x1, y0, y1 = likelihood.problem.extent
        ranges = ((x0, x1, cell_m), (y0, y1, cell_m), (mean[2] - math.pi, mean[2] + math.pi, step_rad))
        axes, spreads, masses = [], [], []
        for (low, high, step), middle, s in zip(ranges, mean, sd, strict=True):
            if math.isinf(s):
                count = max(2, math.ceil((high - low) / step))
                step = (high - low) / count
                axis = low + step * (np.arange(count) + 0.5)
                mass = np.zeros(count)
            elif s <= 0.7 * step:
                axis, mass, step = np.array([middle]), np.zeros(1), s / OVERLAP
            else:  # a sum of Gaussians with the variance of the prior
                wide = math.sqrt(s * s - (OVERLAP * step) ** 2)
                half = math.ceil(SPAN * wide / step)
                axis = middle + step * np.arange(-half, half + 1)
                mass = np.asarray(-0.5 * ((axis - middle) / wide) ** 2, float)
            axes.append(axis)
            spreads.append((OVERLAP * step) ** 2)
            masses.append(mass)
        yaw, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        logw = masses[2][:, None, None] + masses[1][:, None] + masses[0]
        self.n = 4 + len(likelihood.start)
        variances = [*spreads, likelihood.problem.odometry.scale_std**2, *likelihood.start]
        states = np.zeros((logw.size, self.n + self.n**2))
        states[:, 0], states[:, 1], states[:, 2] = x.ravel(), y.ravel(), yaw.ravel()
        states[:, self.n :: self.n + 1] = variances
        self.logw: Array = np.asarray(logw - np.log(np.exp(logw).sum()), float).ravel()
        self._state: Array = states.ravel()

    @property
    def means(self) -> Array:
        """Means of the components, shape (K, n)."""
        return self._state.reshape(len(self.logw), -1)[:, : self.n]

    @property
    def covariances(self) -> Array:
        """Their covariances, shape (K, n, n)."""
        return self._state.reshape(len(self.logw), -1)[:, self.n :].reshape(-1, self.n, self.n)

    def step(self, last: Reading | None, reading: Reading, reference: Array) -> Sums:
        """Move by the odometry, use a reading, and drop components without mass.

        Args:
            last: The reading before, or None.
            reading: The reading.
            reference: x, y and yaw from which the sums are taken.
        """
        dt, motion = 0.0, (0.0, 0.0, 0.0)
        if last is not None:
            dt, motion = reading.t - last.t, increment(last.odometry, reading.odometry)
        distance = math.hypot(motion[0], motion[1])
        place, _, yaw = self.likelihood.problem.odometry.variances(distance, motion[2], dt).tolist()
        forward, left, turn = map(float, motion)
        known, moved = self.likelihood.known(reading, reference), Motion(forward, left, turn, place, yaw)
        tables = self.likelihood.table, self.likelihood.spreads
        dynamics = self.likelihood.dynamics(dt, distance)
        sums: Sums = self._code.update_bank(*tables, self.logw, self._state, known, moved, *dynamics)
        if sums.kept < 0.8 * len(self.logw):
            kept = np.isfinite(self.logw)
            self._state = np.ascontiguousarray(self._state.reshape(len(kept), -1)[kept]).ravel()
            self.logw = np.ascontiguousarray(self.logw[kept])
            sums = sums._replace(best=int(np.argmax(self.logw)))
        return sums

    def heaviest(self, sums: Sums) -> Array:
        """x, y and yaw of the component with the most mass."""
        made: Array = self.means[sums.best, :3].copy()
        return made

    def smooth(self, covariance: Array) -> bool:
        """Whether the components overlap so much that nodes at half a standard deviation resolve them."""
        w = np.exp(self.logw)
        within = np.einsum("k,kij->ij", w, self.covariances[:, :3, :3])
        root = np.linalg.cholesky(np.linalg.inv(covariance + 1e-14 * np.eye(3)))
        return bool(np.linalg.eigvalsh(root.T @ within @ root)[0] > 0.3)

    def splat(self, poses: Array) -> tuple[Array, Array]:
        """Log mass of the mixture at nodes, shape (N, 3), and their linear states given the pose, (N, s)."""
        some = np.argsort(-self.logw)[:60]
        some = some[self.logw[some] > self.logw[some[0]] - 8]
        means, covariances = self.means[some], self.covariances[some]
        pose = covariances[:, :3, :3]
        inverses = np.linalg.inv(pose)
        slopes = covariances[:, 4:, :3] @ inverses
        rest = covariances[:, 4:, 4:] - slopes @ covariances[:, :3, 4:]
        away = poses[:, None] - means[:, :3]
        away[..., 2] -= 2 * math.pi * np.floor(away[..., 2] / (2 * math.pi) + 0.5)
        logs = self.logw[some] - 0.5 * np.linalg.slogdet(pose)[1]
        logs = logs - 0.5 * np.einsum("kgi,gij,kgj->kg", away, inverses, away)
        most = logs.max(axis=1, keepdims=True)
        shares = np.exp(logs - most)
        mass = shares.sum(axis=1, keepdims=True)
        shares /= mass
        each = means[:, 4:] + np.einsum("gni,kgi->kgn", slopes, away)
        mean = np.einsum("kg,kgn->kn", shares, each)
        each -= mean[:, None]
        a, b = np.triu_indices(self.n - 4)
        spread = np.einsum("kg,gm->km", shares, rest[:, a, b])
        spread += np.einsum("kg,kgn,kgn->kn", shares, each[..., a], each[..., b])
        return (most + np.log(mass))[:, 0], np.concatenate([mean, spread], axis=1)
