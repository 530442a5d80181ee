"""Smoother: all poses of a run at once, by nonlinear least squares on a factor graph with the map."""

import math

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import yaw_from_quat
from magtwin.localization.arrow import Arrow
from magtwin.localization.belief import as_map, table_of
from magtwin.localization.grid.point_mass import PointMass
from magtwin.localization.odometry import STILL_M, increment, moved
from magtwin.localization.problem import Array, Estimate, Problem
from magtwin.localization.readings import readings_of
from magtwin.run.run import Run

WHITE_SHARE = 0.16
"""Share of the map's variance that differs from reading to reading; the rest is correlated along the path."""

LEAST_SD = 1e-4
"""Least standard deviation of a step of odometry [m, rad]."""

UNKNOWN = 100.0
"""Standard deviation that stands for an infinite one in covariances [m, rad]."""

ITERATIONS = 40
"""Most steps per start."""

JUMP_M = 0.5
"""Jump of the forward pass that shows that it was wrong before [m]."""

SETTLES_S = 20.0
"""Time after the start of the forward pass in which such a jump may be [s]."""

UNKNOWN_SD = 3.0
"""A reading at an unknown field costs as one so many standard deviations off."""


class Graph:
    """Factors of a run: prior, odometry, drift, map error and readings.

    The unknowns are x, y, yaw, drift [nT] and, if the map has a variance, its error [standard deviations] at
    each reading; and the odometry's scale, the offset and, if the sensor model has it, iron cos and sin.
    """

    def __init__(self, problem: Problem, readings: Run) -> None:
        if problem.belief is None:
            raise InputError("the smoother needs a map; the problem has none")
        self.problem = problem
        self.map = as_map(problem.belief, problem.extent)
        self.mapped = bool(table_of(self.map, problem.extent).variance.any())
        sensor, model = problem.sensor, problem.odometry
        t = readings["t"]
        yaw = np.unwrap(yaw_from_quat(readings["odom_q_xyzw"]))
        odometry = np.column_stack([readings["odom_p"][:, :2], yaw])
        pairs = zip(odometry[:-1].tolist(), odometry[1:].tolist(), strict=True)
        self.motion = np.array([increment(tuple(a), tuple(b)) for a, b in pairs]).reshape(-1, 3)
        distance, dt = np.hypot(self.motion[:, 0], self.motion[:, 1]), np.diff(t)
        self.motion_sd = np.sqrt(model.variances(distance, self.motion[:, 2], dt) + LEAST_SD**2)
        self.drift_sd = max(sensor.drift_nt, 1e-3)
        self.drift_keeps = np.exp(-dt / sensor.drift_s)
        self.error_keeps = np.exp(-distance / problem.map_length_m)
        disturbance = readings["disturbance_nt"] if "disturbance_nt" in readings else np.zeros(len(t))
        sd = readings["disturbance_sd_nt"] if "disturbance_sd_nt" in readings else np.zeros(len(t))
        self.z = readings["b_measured_nt"] - np.where(np.isfinite(disturbance), disturbance, 0.0)
        white = sensor.white_nt**2 + np.where(np.isfinite(disturbance) & np.isfinite(sd), sd, 0.0) ** 2
        self.read = np.isfinite(self.z)
        stuck = (np.diff(self.z) == 0) & (distance + 0.1 * np.abs(self.motion[:, 2]) > STILL_M)
        self.read[1:] &= ~stuck
        self.z, self.white = np.where(self.read, self.z, 0.0), white
        self.local = 5 if self.mapped else 4
        self.common_sd = np.array(
            [model.scale_std or 1e-9, max(sensor.offset_nt, 1e-6)]
            + [sensor.iron_nt] * (2 * (sensor.iron_nt > 0))
        )

    def start(self, poses: Array) -> tuple[Array, Array]:
        """Unknowns at given poses: the offset is the median residual, everything else 0."""
        local = np.zeros((len(poses), self.local))
        local[:, :3] = poses
        common = np.zeros(len(self.common_sd))
        field = self.map.lookup(*self._sensor(poses)[:2])
        known = self.read & np.isfinite(field)
        if known.any():
            common[1] = np.median((self.z - field)[known])
        return local, common

    def _sensor(self, poses: Array) -> tuple[Array, Array, Array]:
        """Position of the sensor, heading, and d position / d yaw."""
        lx, ly = self.problem.sensor.lever_arm_m
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        arm = np.column_stack([c * lx - s * ly, s * lx + c * ly])
        return poses[:, :2] + arm, poses[:, 2], np.column_stack([-arm[:, 1], arm[:, 0]])

    def fields(self, local: Array, common: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Residuals of the readings, whitened (N,), derivatives (N, b) and (N, g), and which are used."""
        p, yaw, arm = self._sensor(local[:, :3])
        if self.mapped:
            value, sd, slopes = self.map.lookup_all(p, yaw)
        else:
            (value, slopes), sd = self.map.lookup_with_gradient(p, yaw), np.zeros(len(p))
        known = self.read & np.isfinite(value) & np.isfinite(slopes).all(axis=1)
        value, slopes = np.where(known, value, 0.0), np.where(known[:, None], slopes, 0.0)
        sd = np.where(known & np.isfinite(sd), sd, 0.0)
        by_local, by_common = np.zeros((len(p), self.local)), np.zeros((len(p), len(common)))
        by_local[:, :2] = slopes[:, :2]
        by_local[:, 2] = slopes[:, 2] + np.einsum("ni,ni->n", slopes[:, :2], arm)
        by_local[:, 3] = by_common[:, 1] = 1.0
        predicted = value + common[1] + local[:, 3]
        if self.mapped:
            by_local[:, 4] = math.sqrt(1 - WHITE_SHARE) * sd
            predicted += by_local[:, 4] * local[:, 4]
        if len(common) > 2:
            c, s = np.cos(yaw), np.sin(yaw)
            by_common[:, 2], by_common[:, 3] = c, s
            predicted += common[2] * c + common[3] * s
            by_local[:, 2] += common[3] * c - common[2] * s
        weight = known / np.sqrt(self.white + WHITE_SHARE * sd**2)
        residual = (predicted - self.z) * weight
        return residual, by_local * weight[:, None], by_common * weight[:, None], known

    def motions(self, local: Array, common: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals of the odometry, whitened (N - 1, 3), with their derivatives by both poses and scale.

        e = R(middle)' (p_k+1 - p_k) - (1 + scale) (forward, left), yaw_k+1 - yaw_k - turn; the middle is
        halfway between the headings.
        """
        step = np.diff(local[:, :3], axis=0)
        middle = local[:-1, 2] + step[:, 2] / 2
        c, s = np.cos(middle), np.sin(middle)
        forward, left = c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0]
        residual = np.column_stack([forward, left, step[:, 2]]) - self.motion
        residual[:, :2] -= common[0] * self.motion[:, :2]
        before, after = np.zeros((2, len(step), 3, 3))
        after[:, 0, 0], after[:, 0, 1], after[:, 1, 0], after[:, 1, 1] = c, s, -s, c
        before[:, :2, :2] = -after[:, :2, :2]
        before[:, 0, 2] = after[:, 0, 2] = left / 2
        before[:, 1, 2] = after[:, 1, 2] = -forward / 2
        before[:, 2, 2], after[:, 2, 2] = -1.0, 1.0
        scale = np.zeros((len(step), 3))
        scale[:, :2] = -self.motion[:, :2]
        w = 1 / self.motion_sd
        return residual * w, before * w[:, :, None], after * w[:, :, None], scale * w

    def walks(self, local: Array) -> tuple[Array, list[tuple[int, Array, Array]]]:
        """Residuals of the Gauss-Markov processes, and per process its column, decay and sd."""
        processes = [(3, self.drift_keeps, self.drift_sd)]
        if self.mapped:
            processes.append((4, self.error_keeps, 1.0))
        parts, known = [], []
        for column, keeps, sd in processes:
            noise = sd * np.sqrt(np.maximum(1 - keeps**2, 1e-8))
            parts.append(
                np.append(
                    local[0, column] / sd,
                    (np.diff(local[:, column]) + (1 - keeps) * local[:-1, column]) / noise,
                )
            )
            known.append((column, keeps, np.append(sd, noise)))
        return np.concatenate(parts), known

    def prior(self, local: Array, common: Array) -> Array:
        """Residuals of the prior of the first pose and of the common unknowns."""
        prior = self.problem.prior
        away = local[0, :3] - prior.mean
        away[2] = (away[2] + math.pi) % (2 * math.pi) - math.pi
        finite = np.isfinite(prior.sd)
        first = np.where(finite, away, 0.0) / np.where(finite, prior.sd, 1.0)
        return np.concatenate([first, common / self.common_sd])

    def cost(self, local: Array, common: Array) -> float:
        """Sum of squares of all residuals, whitened: twice the negative log-posterior."""
        field, _, _, known = self.fields(local, common)
        others = np.sum(self.walks(local)[0] ** 2) + np.sum(self.prior(local, common) ** 2)
        motion = np.sum(self.motions(local, common)[0] ** 2, axis=1)
        unknown = self.read & ~known
        return float(others + (np.sum(field**2) + motion.sum()) + UNKNOWN_SD**2 * unknown.sum())

    def normal_equations(self, local: Array, common: Array) -> Arrow:
        """The system J' J x = -J' r of a Gauss-Newton step."""
        n, b, g = len(local), self.local, len(common)
        diagonal, below = np.zeros((n, b, b)), np.zeros((n - 1, b, b))
        border, corner = np.zeros((n, b, g)), np.diag(1 / self.common_sd**2)
        gradient, common_gradient = np.zeros((n, b)), common / self.common_sd**2
        r, f, c, _ = self.fields(local, common)
        diagonal += f[:, :, None] * f[:, None, :]
        border += f[:, :, None] * c[:, None, :]
        corner += c.T @ c
        gradient += f * r[:, None]
        common_gradient += c.T @ r
        e, before, after, scale = self.motions(local, common)
        bt, at = before.transpose(0, 2, 1), after.transpose(0, 2, 1)
        diagonal[:-1, :3, :3] += bt @ before
        diagonal[1:, :3, :3] += at @ after
        below[:, :3, :3] += at @ before
        border[:-1, :3, 0] += (bt @ scale[:, :, None])[:, :, 0]
        border[1:, :3, 0] += (at @ scale[:, :, None])[:, :, 0]
        corner[0, 0] += np.sum(scale**2)
        gradient[:-1, :3] += (bt @ e[:, :, None])[:, :, 0]
        gradient[1:, :3] += (at @ e[:, :, None])[:, :, 0]
        common_gradient[0] += np.sum(scale * e)
        for column, keeps, sd in self.walks(local)[1]:
            x = local[:, column]
            inverse = 1 / sd**2
            miss = np.diff(x) + (1 - keeps) * x[:-1]
            diagonal[0, column, column] += inverse[0]
            gradient[0, column] += x[0] * inverse[0]
            diagonal[1:, column, column] += inverse[1:]
            diagonal[:-1, column, column] += keeps**2 * inverse[1:]
            below[:, column, column] -= keeps * inverse[1:]
            gradient[1:, column] += miss * inverse[1:]
            gradient[:-1, column] -= keeps * miss * inverse[1:]
        first = self.prior(local, common)[:3]
        for k, spread in enumerate(self.problem.prior.sd):
            if math.isfinite(spread):
                diagonal[0, k, k] += 1 / spread**2
                gradient[0, k] += first[k] / spread
            else:
                diagonal[0, k, k] += 1 / UNKNOWN**2
        right = np.concatenate([border, -gradient[:, :, None]], axis=2)
        return Arrow(diagonal, below, right, corner, -common_gradient)


class MapSmoother:
    """Factor-graph smoother with a map (Dellaert and Kaess 2017, Foundations and Trends in Robotics 6).

    It minimises over all poses, the drift (FOGM in time), the map's error (FOGM along the path), the
    odometry's scale, the offset and the iron

        sum |r_field|^2 + sum |r_odometry|^2 + sum |r_drift|^2 + sum |r_error|^2 + |r_prior|^2

    by Levenberg-Marquardt (Marquardt 1963). The normal equations are block tridiagonal with a border, so
    that a step costs O(N). It starts at the forward pass of a filter, with dead reckoning back from the time
    at which that is no longer lost, and at dead reckoning from the prior if there is one; the lower cost
    wins. The covariances are those of the linearised problem.
    """

    def run(self, problem: Problem, readings: Run) -> list[Estimate]:
        """Estimates at all readings.

        Raises:
            InputError: The problem has no map.
        """
        graph = Graph(problem, readings)
        forward = PointMass()
        forward.reset(problem)
        passed = [forward.step(reading) for reading in readings_of(readings)]
        lost = np.array([estimate.lost for estimate in passed])
        best = None
        for poses in self._starts(graph, passed, readings["t"]):
            local, common, cost = self.minimise(graph, *graph.start(poses))
            if best is None or cost < best[2]:
                best = local, common, cost
        assert best is not None
        local, common, _ = best
        covariance = graph.normal_equations(local, common).solve().pose_covariances()
        bias = common[1] + local[:, 3]
        return [
            Estimate(t, x, y, yaw, covariance[k, :3, :3], float(bias[k]), bool(lost[-1]))
            for k, (t, (x, y, yaw)) in enumerate(
                zip(readings["t"].tolist(), local[:, :3].tolist(), strict=True)
            )
        ]

    def minimise(self, graph: Graph, local: Array, common: Array) -> tuple[Array, Array, float]:
        """Levenberg-Marquardt: the unknowns and the cost."""
        damping, cost = 1e-4, graph.cost(local, common)
        for _ in range(ITERATIONS):
            system, before = graph.normal_equations(local, common), cost
            while damping < 1e8:
                try:
                    step = system.damped(damping).solve()
                except np.linalg.LinAlgError:
                    damping *= 10
                    continue
                tried = graph.cost(local + step.x, common + step.g)
                if tried <= cost:
                    local, common, cost = local + step.x, common + step.g, tried
                    damping = max(damping / 10, 1e-9)
                    break
                damping *= 10
            else:
                damping = 1e-4
            if before - cost < 1e-5:
                break
        return local, common, cost

    def _starts(self, graph: Graph, passed: list[Estimate], t: NDArray[np.float64]) -> list[Array]:
        """Trajectories to start from: the forward pass, and dead reckoning from the prior."""
        poses = np.array([(e.x, e.y, e.yaw) for e in passed])
        poses[:, 2] = np.unwrap(poses[:, 2])
        lost = np.array([e.lost for e in passed])
        found = int(np.argmin(lost)) if not lost.all() else 0
        predicted = np.array([moved(p, m) for p, m in zip(poses[:-1], graph.motion, strict=True)])
        jumps = np.hypot(*(poses[1:, :2] - predicted[:, :2]).T) if len(poses) > 1 else np.zeros(0)
        late = np.flatnonzero(
            (jumps > JUMP_M) & (np.arange(1, len(t)) > found) & (t[1:] < t[found] + SETTLES_S)
        )
        found = int(late[-1]) + 1 if len(late) else found
        for k in range(found - 1, -1, -1):
            poses[k] = moved_back(poses[k + 1], graph.motion[k])
        starts = [poses]
        prior = graph.problem.prior
        if not prior.is_global and math.isfinite(prior.sd[2]):
            reckoned = [prior.mean]
            for motion in graph.motion:
                reckoned.append(moved(reckoned[-1], motion))
            starts.append(np.array(reckoned))
        return starts


def moved_back(pose: Array, motion: Array) -> Array:
    """The pose from which a motion leads to `pose`."""
    c, s = math.cos(pose[2] - motion[2] / 2), math.sin(pose[2] - motion[2] / 2)
    made: Array = pose - np.array([motion[0] * c - motion[1] * s, motion[0] * s + motion[1] * c, motion[2]])
    return made
