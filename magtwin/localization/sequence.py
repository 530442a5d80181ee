"""Sequence matching: the last metres of readings against the map, at every place and heading."""

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.localization.belief import as_map
from magtwin.localization.grid.point_mass import LOOPS
from magtwin.localization.odometry import Odometry, increment, repeats
from magtwin.localization.problem import Array, Estimate, Prior, Problem, Reading
from magtwin.localization.smoother import WHITE_SHARE, Graph, MapSmoother, moved_back
from magtwin.run.run import Run

TURN_RAD = 0.15
"""Turn after which a reading is kept even if the robot has not moved on [rad]."""

MARGIN = 60.0
"""Misfit above the least one at which a placement is given up."""

KEPT = 12
"""Placements that are refined."""

SURE = 0.95
"""Share of the likelihood of the best placement at which the pose is known."""

CHECK_M = 2.0
"""Distance after which all placements are searched again [m]."""

BETTER = 12.0
"""Difference of log-likelihoods at which another placement replaces a known pose."""

WANDER_M = 0.15
"""Distance over which the field's slope, and the error of a placement between nodes, stays alike [m]."""


SAME_M = 0.03
"""Distance of fits that count as one [m]."""


class Fit(NamedTuple):
    """A refined placement of a sequence."""

    likelihood: float
    """Logarithm, by Laplace's method, without constants."""

    pose: Array
    """Last x, y [m] and yaw [rad]."""

    covariance: Array
    """Of that pose, shape (3, 3)."""

    misfit: float
    """Sum of squares of the whitened residuals."""

    offset_nt: float
    """Offset and drift at the last reading [nT]."""


class Sequence:
    """Sequence matching with refinement.

    The path of the last metres, by odometry, is laid onto the map at every node of a grid over x, y and
    heading. The misfit of a placement is the mean square difference of terrain contour matching (Golden 1980,
    SPIE 238:10), generalised to correlated errors: r' K^-1 r, where K has the readings' noise, offset, drift,
    iron and map error and the typical effect of bent odometry and of the distance to the next node. The
    offset thereby drops out. A placement is given up once its misfit exceeds the best one by a margin.

    The least separate minima are then refined: poses, offset, drift and scale along the path by
    least squares (`magtwin.localization.smoother.Graph`), which lets the path bend. Their likelihoods by
    Laplace's method give the probability of the best one; its covariance is that of the last pose.

    Between matches the pose moves by odometry. Around a known pose, the prediction and the best placements
    nearby are refined and merged by moments. All placements are searched again after 2 m, or when the misfit
    is improbable.

    Args:
        length_m: Length of path that is matched [m].
        shortest_m: Least length for a first match without a known start [m].
        every_m: Distance between matches [m].
        spacing_m: Distance between the readings of a sequence [m].
        cell_m: Distance of places that are tried, at most [m].
        heading_deg: Distance of headings that are tried, at most [deg].
        temper: Divisor of the log-likelihood, for what the linearised fits lack; covariances grow by it.
    """

    def __init__(
        self,
        *,
        length_m: float = 3.0,
        shortest_m: float = 0.8,
        every_m: float = 0.2,
        spacing_m: float = 0.05,
        cell_m: float = 0.08,
        heading_deg: float = 6.0,
        temper: float = 1.5,
    ) -> None:
        for name, value in list(locals().items())[1:]:
            if not (isinstance(value, int | float) and 0 < value < math.inf):
                raise InputError(f"{name} of Sequence must be above 0, got {value}", parameter=name)
        self._length, self._shortest, self._every, self._spacing = length_m, shortest_m, every_m, spacing_m
        self._cell, self._heading, self._temper = cell_m, math.radians(heading_deg), temper

    def reset(self, problem: Problem) -> None:
        """Begin at the prior.

        Raises:
            InputError: The problem has no map.
        """
        if problem.belief is None:
            raise InputError("sequence matching needs a map; the problem has none")
        self._code = LOOPS.open()
        self._map = as_map(problem.belief, problem.extent)
        self._problem = replace(problem, belief=self._map)
        self._table, _ = self._map.tables()
        gx, gy = np.meshgrid(self._map.x_m[::2], self._map.y_m[::2])
        slopes = self._map.gradient(np.stack([gx, gy], axis=-1), np.zeros(gx.shape))
        self._slope = math.sqrt(float(np.nanmean(np.sum(slopes[..., :2] ** 2, axis=-1)))) or 1.0
        self._variance = 0.0
        if self._map.variance_nt2 is not None:
            self._variance = float(np.mean(self._map.variance_nt2[self._map.valid]))
        self._odometry = Odometry()
        self._odometry.reset(problem)
        prior = problem.prior
        self._known = not prior.is_global and math.isfinite(prior.sd[2])
        self._window: deque[Reading] = deque()
        self._whole = True
        self._turned = 0.0
        self._last: Reading | None = None
        self._since_match = self._since_check = math.inf
        self._fit = MapSmoother(iterations=15)
        self._bias: float | None = None

    def step(self, reading: Reading) -> Estimate:
        """Move by the odometry, and match the sequence if it has grown enough."""
        if self._last is not None:
            forward, left, turn = increment(self._last.odometry, reading.odometry)
            self._since_match += math.hypot(forward, left)
            self._since_check += math.hypot(forward, left)
            self._turned += turn
        stuck, self._last = repeats(self._last, reading), reading
        moved = self._odometry.step(reading)
        if math.isfinite(reading.b_nt) and not stuck:
            self._keep(reading)
            if self._since_match >= self._every and self._window[-1] is reading:
                self._match()
                x, y, yaw = self._odometry.pose
                moved = Estimate(reading.t, x, y, yaw, self._odometry.covariance[:3, :3].copy())
        return replace(moved, bias_nt=self._bias, lost=not self._known)

    def _keep(self, reading: Reading) -> None:
        """Append a reading that is far enough from the last one, and forget those beyond the length."""
        window = self._window
        if window:
            forward, left, turn = increment(window[-1].odometry, reading.odometry)
            if math.hypot(forward, left) < self._spacing and abs(turn) < TURN_RAD:
                return
        window.append(reading)
        steps = self._steps()
        while len(window) > 3 and steps[1:].sum() > self._length:
            window.popleft()
            steps = steps[1:]
            self._whole = False

    def _steps(self) -> Array:
        p = np.array([r.odometry[:2] for r in self._window])
        return np.hypot(*np.diff(p, axis=0).T) if len(p) > 1 else np.zeros(0)

    def _match(self) -> None:
        prior = self._problem.prior
        anchored = self._whole and not prior.is_global
        length = float(self._steps().sum())
        if len(self._window) < 3 or (not self._known and length < self._shortest):
            return
        self._since_match = 0.0
        graph = self._graph()
        known: list[Fit] = []
        if self._known:
            starts = [np.array(self._odometry.pose), *self._placements(near=True)]
            known = _distinct([self._refined(graph, pose) for pose in starts])
            misfit, count = known[0].misfit, len(self._window)
            improbable = misfit > count + 5 * math.sqrt(2 * count)
            if anchored or length < self._shortest or (self._since_check < CHECK_M and not improbable):
                self._take(known)
                return
        self._since_check = 0.0
        found = _distinct([self._refined(graph, pose) for pose in self._placements()])
        if known and found[0].likelihood < known[0].likelihood + BETTER:
            self._take(known)
            return
        total = sum(math.exp((fit.likelihood - found[0].likelihood) / self._temper) for fit in found)
        self._known = 1 / total > SURE
        self._take(found[:1])

    def _take(self, fits: "list[Fit]") -> None:
        """Continue dead reckoning from a match: mean and covariance of fits, weighted by their likelihood."""
        w = np.array([math.exp((fit.likelihood - fits[0].likelihood) / self._temper) for fit in fits])
        w /= w.sum()
        away = np.array([fit.pose - fits[0].pose for fit in fits])
        away[:, 2] = (away[:, 2] + math.pi) % (2 * math.pi) - math.pi
        shift = w @ away
        covariance = self._temper * np.einsum("k,kij->ij", w, np.array([fit.covariance for fit in fits]))
        covariance += (away * w[:, None]).T @ away - np.outer(shift, shift)
        x, y, yaw = (fits[0].pose + shift).tolist()
        self._odometry.pose = (x, y, yaw)
        self._odometry.covariance[:] = 0.0
        self._odometry.covariance[:3, :3] = covariance
        self._odometry.covariance[3, 3] = self._problem.odometry.scale_std**2
        self._bias = fits[0].offset_nt

    def _graph(self) -> Graph:
        """Factor graph of the sequence; it has the prior if it begins at the first reading."""
        window = list(self._window)
        yaw = np.array([r.odometry[2] for r in window])
        p = np.array([(*r.odometry[:2], 0.0) for r in window])
        columns = {
            "t": np.array([r.t for r in window]),
            "b_measured_nt": np.array([r.b_nt for r in window]),
            "odom_p": p,
            "odom_q_xyzw": quat_from_yaw(yaw),
            "disturbance_nt": np.array([r.disturbance_nt for r in window]),
            "disturbance_sd_nt": np.array([r.disturbance_sd_nt for r in window]),
        }
        unknown = Prior(sd=(math.inf, math.inf, math.inf))
        return Graph(self._problem if self._whole else replace(self._problem, prior=unknown), Run(columns))

    def _refined(self, graph: Graph, pose: Array) -> "Fit":
        """The best fit near a placement."""
        poses = [pose]
        for motion in graph.motion[::-1]:
            poses.append(moved_back(poses[-1], motion))
        local, common, cost, weights = self._fit.minimise(graph, *graph.start(np.array(poses[::-1])))
        matrix = graph.normal_equations(local, common, *weights)[0]
        covariance, determinant = matrix.last_covariance()
        likelihood = -0.5 * (cost + determinant)
        offset = float(common[1] + local[-1, 3])
        return Fit(likelihood, local[-1, :3], covariance[:3, :3], cost, offset)

    def _placements(self, *, near: bool = False) -> list[Array]:
        """Separate minima of the misfit over all places and headings, or over those near the known pose."""
        path, z, covariance = self._sequence()
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        cell, turn, kept = self._cell, self._heading, KEPT
        x0, x1, y0, y1 = self._problem.extent
        yaws = self._headings()
        if near:
            pose, sd = self._odometry.pose, np.sqrt(np.diag(self._odometry.covariance)).tolist()
            cell, turn, kept = cell / 2, turn / 2, 2
            reach = [min(max(3 * sd[0], 3 * self._cell), 1.0), min(max(3 * sd[1], 3 * self._cell), 1.0)]
            x0, x1, y0, y1 = pose[0] - reach[0], pose[0] + reach[0], pose[1] - reach[1], pose[1] + reach[1]
            yaws = np.asarray(pose[2] + turn * np.arange(-3, 4), float)
        ranges = ((x0, x1, math.ceil((x1 - x0) / cell)), (y0, y1, math.ceil((y1 - y0) / cell)))
        xs, ys = (low + (high - low) * (np.arange(n) + 0.5) / n for low, high, n in ranges)
        costs = np.empty(len(yaws) * len(ys) * len(xs))
        flat = np.ascontiguousarray(path).ravel(), z, np.ascontiguousarray(whitening).ravel()
        self._code.match(self._table, *flat, xs, ys, yaws, MARGIN, costs)
        order = np.argsort(costs)[:3000]
        order = order[np.isfinite(costs[order])]
        h, j, i = np.unravel_index(order, (len(yaws), len(ys), len(xs)))
        poses = np.column_stack([xs[i], ys[j], yaws[h]])
        made: list[Array] = []
        while len(poses) and len(made) < kept:
            made.append(poses[0])
            turned = np.abs((poses[:, 2] - poses[0, 2] + math.pi) % (2 * math.pi) - math.pi)
            far = np.hypot(*(poses[:, :2] - poses[0, :2]).T) > 2.5 * cell
            poses = poses[far | (turned > 2.5 * turn)]
        return made

    def _headings(self) -> Array:
        """Headings of the newest pose that the prior allows."""
        sd, mean = self._problem.prior.sd[2], self._problem.prior.mean[2]
        reach = math.pi
        if math.isfinite(sd):
            walk = math.sqrt(sd**2 + self._odometry.covariance[2, 2])
            reach = min(math.pi, 4 * walk)
        count = max(3, math.ceil(2 * reach / self._heading))
        middle = mean + self._turned if math.isfinite(sd) else 0.0
        made: Array = middle - reach + 2 * reach * (np.arange(count) + 0.5) / count
        return made

    def _sequence(self) -> tuple[Array, Array, Array]:
        """Sensor's path relative to the newest pose, readings, newest first, and their covariance."""
        window = list(self._window)[::-1]
        odometry = np.array([r.odometry for r in window])
        sensor, model = self._problem.sensor, self._problem.odometry
        c, s = math.cos(odometry[0, 2]), math.sin(odometry[0, 2])
        away, turned = odometry[:, :2] - odometry[0, :2], odometry[:, 2] - odometry[0, 2]
        lx, ly = sensor.lever_arm_m
        path = np.column_stack(
            [
                away @ (c, s) + np.cos(turned) * lx - np.sin(turned) * ly,
                away @ (-s, c) + np.sin(turned) * lx + np.cos(turned) * ly,
                turned,
            ]
        )
        z = np.array([r.b_nt - r.disturbance_nt for r in window])
        t = np.array([r.t for r in window])
        steps = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
        s_along = np.append(0.0, np.cumsum(steps))
        apart = np.abs(s_along[:, None] - s_along)
        k = sensor.drift_nt**2 * np.exp(-np.abs(t[:, None] - t) / sensor.drift_s) + sensor.offset_nt**2
        k += sensor.iron_nt**2 * np.cos(turned[:, None] - turned)
        k += (1 - WHITE_SHARE) * self._variance * np.exp(-apart / self._problem.map_length_m)
        noise = sensor.white_nt**2 + np.array([r.disturbance_sd_nt for r in window]) ** 2
        noise += WHITE_SHARE * self._variance
        # errors of the placement: half a cell everywhere, and the walk of the odometry
        reach = np.hypot(*away.T)
        bend = model.position_std**2 * s_along + model.yaw_std**2 * s_along**3 / 3
        bend += (model.scale_std**2 + self._heading**2 / 12) * reach**2 + self._cell**2 / 12
        sd = self._slope * np.sqrt(bend)
        k += np.outer(sd, sd) * np.exp(-apart / WANDER_M)
        return path, z, k + np.diag(noise)


def _distinct(fits: list[Fit]) -> list[Fit]:
    """Fits by falling likelihood, without those that are at the place of a better one."""
    made: list[Fit] = []
    for fit in sorted(fits, key=lambda fit: -fit.likelihood):
        if all(math.dist(fit.pose[:2], other.pose[:2]) > SAME_M for other in made):
            made.append(fit)
    return made
