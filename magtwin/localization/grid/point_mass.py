"""Point-mass filter: the posterior on a grid over x, y and heading that follows it."""

import math
from dataclasses import replace

import numpy as np

from magtwin.compiled import Loops
from magtwin.errors import InputError
from magtwin.localization.belief import table_of
from magtwin.localization.grid.bank import SPAN, Bank, Likelihood, moments
from magtwin.localization.grid.state import CUT, WHITE_SHARE, Lattice, Sums
from magtwin.localization.odometry import Repeats, increment, moved
from magtwin.localization.problem import Array, Estimate, Problem, Reading

LOOPS = Loops("magtwin.localization.grid.loops", pays=0.0)
"""Compiled loops; a grid in plain Python would take minutes."""

NODES = 15
"""Nodes of the window along each of its three axes, odd."""

CELL_M, HEADING_RAD = 0.08, math.radians(7.5)
"""Greatest distance of starts, and of their headings."""

TEMPER = 1.5
"""Divisor of the log likelihood if the map has a variance, for errors that the noise model lacks."""

RESET_AT = 12.0
"""Surprise at which the filter starts again from an unknown pose [nats]."""

SCALE_M = 1.0
"""Distance over which the odometry's scale error counts as random [m]."""

COMPACT_M = 0.15
"""Spread of the place at which the grid takes over from the bank of starts [m]."""

FOUND_M = 0.3
"""Spread of the place below which the filter is not lost [m]."""

NOISE = 0.02
"""Noise of the motion that is collected before the grid is convolved [variance per squared distance]."""

SLACK = 1.5
"""Surprise that is expected per reading, and forgotten [nats]."""


class Grid:
    """A window of nodes over x, y and heading.

    Args:
        mean: x, y and yaw of its middle.
        covariance: Covariance that it covers to `SPAN` standard deviations, shape (3, 3).
        count: Nodes along each axis.
        n: Number of linear states.
    """

    def __init__(self, mean: Array, covariance: Array, count: int, n: int) -> None:
        half = (count - 1) / 2
        sd_yaw = max(math.sqrt(max(covariance[2, 2], 0.0)), 1e-5)
        slope = covariance[:2, 2] / sd_yaw**2
        values, vectors = np.linalg.eigh(covariance[:2, :2] - np.outer(slope, covariance[:2, 2]))
        self.cell: Array = vectors * (np.sqrt(np.maximum(values, 1e-8)) * SPAN / half)  # at least 0.1 mm
        """Distances between nodes in x and y, shape (2, 2)."""

        step = sd_yaw * SPAN / half
        turns = step * (np.arange(count) - half)
        origin = mean[:2] - self.cell @ (half, half)
        x, y = np.ascontiguousarray((origin + turns[:, None] * slope).T)
        (x_i, x_j), (y_i, y_j) = self.cell.tolist()
        self.lattice = Lattice(mean[2] + turns, x, y, x_i, x_j, y_i, y_j, float(step), count, count)
        self.states = n
        self.logw: Array = np.full(count**3, -np.inf)
        self.state: Array = np.zeros(count**3 * (n + n * (n + 1) // 2))

    def poses(self) -> Array:
        """x, y and heading of all nodes, shape (H Y X, 3)."""
        at = self.lattice
        h, j, i = np.indices((len(at.yaw), at.rows, at.columns))
        x, y = at.x[h] + at.x_i * i + at.x_j * j, at.y[h] + at.y_i * i + at.y_j * j
        return np.stack([x, y, at.yaw[h]], axis=-1).reshape(-1, 3)

    def move(self, forward: float, left: float, turn: float) -> None:
        """Move all nodes by a motion of the robot."""
        middle = self.lattice.yaw + turn / 2
        c, s = np.cos(middle), np.sin(middle)
        self.lattice.yaw[:] += turn
        self.lattice.x[:] += forward * c - left * s
        self.lattice.y[:] += forward * s + left * c

    def fits(self, mean: Array, covariance: Array) -> bool:
        """Whether the window still has place, scale and shear of a posterior."""
        at, cell = self.lattice, self.cell
        origins = np.column_stack([at.x, at.y])
        half = (len(at.yaw) - 1) / 2
        wanted = half / SPAN  # nodes per standard deviation
        inverse = np.linalg.inv(cell)
        slope = covariance[:2, 2] / max(covariance[2, 2], 1e-18)
        across = inverse @ (covariance[:2, :2] - np.outer(slope, covariance[:2, 2])) @ inverse.T
        u, v, turns = (math.sqrt(max(c, 0.0)) for c in (across[0, 0], across[1, 1], covariance[2, 2]))
        turns /= at.step
        if min(u, v, turns) < 0.75 * wanted or max(u, v, turns) > 1.25 * wanted:
            return False
        middle = len(at.yaw) // 2
        away = mean[2] - at.yaw[middle]
        off = inverse @ (mean[:2] - slope * away - origins[middle] - cell @ (half, half))
        shear = (origins[-1] - origins[0]) / (at.yaw[-1] - at.yaw[0]) - slope
        sheared = (inverse @ shear) * at.step * turns
        placed = max(abs(off).max(), abs(away) / at.step) < 0.6 * wanted
        return bool(placed and abs(sheared).max() < 0.5 * wanted and abs(across[0, 1]) < 0.5 * u * v)

    def normalise(self) -> bool:
        """Scale the mass to 1; False if there is none."""
        most = float(self.logw.max())
        if not math.isfinite(most):
            return False
        self.logw -= most + math.log(np.exp(self.logw - most).sum())
        return True


class PointMass:
    """Point-mass filter, with the readings' offset, drift and iron marginalised in each node.

    The posterior of x, y and yaw is a mass per node of a grid (Bucy and Senne 1971, Automatica 7:287), with
    a grid that is truncated, scaled and moved (Bergman 1999, Recursive Bayesian Estimation, chapter 5):

        p(x_k | z_1..k) ~ N(z_k; m(x_k) + h' b, h' P h + R) sum_i K(x_k, x_i) p(x_i | z_1..k-1)

    with the kernel K of the odometry's noise. The grid itself moves with the odometry, so that only the noise
    is convolved and no interpolation blurs the mass. Each node has a Kalman filter of the linear states b
    given its pose: offset, drift (FOGM in time), error of the map (FOGM along the path, if the map has a
    variance), and iron cos and sin (if the sensor model has them). Nodes that meet are merged by moments.

    The window is sheared and scaled as the posterior. Until the posterior is compact, a bank of Kalman
    filters on a grid of starts (`magtwin.localization.grid.bank`) stands for it: as cells with a slope.

    A reading that repeats itself to the bit while the robot moves is not used, nor is nan.
    """

    def reset(self, problem: Problem) -> None:
        """Begin at the prior.

        Raises:
            InputError: The problem has no map.
        """
        if problem.belief is None:
            raise InputError("the point-mass filter needs a map; the problem has none")
        self._code = LOOPS.open()
        self._problem = problem
        table, spreads = table_of(problem.belief, problem.extent)
        spreads = spreads if spreads.any() else spreads[:0]
        self._likelihood = Likelihood(problem, table, spreads, TEMPER if len(spreads) else 1.0)
        self._last: Reading | None = None
        self._repeats = Repeats()
        self._mean, self._lost = np.zeros(3), True
        self._begin(problem.prior.mean, problem.prior.sd)

    def step(self, reading: Reading) -> Estimate:
        """Move by the odometry, use the field, and fit the window to the posterior."""
        last, self._last = self._last, reading
        motion = (0.0, 0.0, 0.0) if last is None else increment(last.odometry, reading.odometry)
        if not self._repeats.usable(reading.b_nt, motion):
            reading = replace(reading, b_nt=math.nan)
        if self.grid is not None:
            sums = self._step_grid(last, reading)
            if not sums.mass > 0 or self._surprised(sums.evidence, reading):
                self._begin((0.0, 0.0, 0.0), (math.inf,) * 3)
                last = None  # the starts are poses at this reading
        if self.grid is None:
            sums = self.bank.step(last, reading, self._mean)
        shift, covariance = moments(sums)
        self._mean = self._mean + shift
        spread = math.sqrt(max(covariance[0, 0] + covariance[1, 1], 0.0))
        self._lost = self._lost and spread > FOUND_M
        pose, reported = self._mean, covariance
        if self._lost:  # the heaviest component, with the spread of all mass about it
            pose = self.bank.heaviest(sums)
            away = pose - self._mean
            away[2] -= 2 * math.pi * math.floor(away[2] / (2 * math.pi) + 0.5)
            reported = covariance + np.outer(away, away)
        self._fit(covariance, spread)
        x, y, yaw = pose.tolist()
        return Estimate(reading.t, x, y, yaw, reported, sums.offset / sums.mass, self._lost)

    def particles(self) -> Array:
        """The heaviest nodes or starts, at most 2,000: x, y [m], yaw [rad] and mass, shape (P, 4)."""
        source = self.bank.logw if self.grid is None else self.grid.logw
        poses = self.bank.means[:, :3] if self.grid is None else self.grid.poses()
        some = np.argsort(-source)[:2000]
        some = some[np.isfinite(source[some])]
        w = np.exp(source[some] - source[some[0]])
        return np.column_stack([poses[some], w / w.sum()])

    def _begin(self, mean: tuple[float, float, float], sd: tuple[float, float, float]) -> None:
        self.bank = Bank(self._likelihood, mean, sd, cell_m=CELL_M, step_rad=HEADING_RAD)
        self.grid: Grid | None = None
        self._lost, self._surprise = any(math.isinf(s) for s in sd), 0.0
        x0, x1, y0, y1 = self._problem.extent
        place = ((x0 + x1) / 2, (y0 + y1) / 2) if math.isinf(sd[0]) else mean[:2]
        self._mean = np.array([*place, mean[2]])
        self._pending = np.zeros(3)

    def _step_grid(self, last: Reading | None, reading: Reading) -> Sums:
        grid = self.grid
        assert grid is not None
        assert last is not None
        motion, dt = increment(last.odometry, reading.odometry), reading.t - last.t
        grid.move(*motion)
        distance = math.hypot(motion[0], motion[1])
        self._mean = np.asarray(moved(self._mean, motion), float)
        self._convolve(grid, self._problem.odometry.variances(distance, motion[2], dt), distance)
        known, dynamics = self._likelihood.known(reading, self._mean), self._likelihood.dynamics(dt, distance)
        tables = self._likelihood.table, self._likelihood.spreads
        sums: Sums = self._code.update(*tables, grid.logw, grid.state, grid.lattice, known, *dynamics)
        return sums

    def _convolve(self, grid: Grid, variances: Array, distance: float) -> None:
        """Collect the noise of motions; once it is enough, spread the mass with a kernel of its variance."""
        along = self._problem.odometry.scale_std**2 * distance * SCALE_M
        self._pending += variances[0], along, variances[2]
        at = grid.lattice
        inverse = np.array([[at.y_j, -at.x_j], [-at.y_i, at.x_i]]) / (at.x_i * at.y_j - at.x_j * at.y_i)
        u, v = inverse @ np.stack([np.cos(at.yaw), np.sin(at.yaw)])
        place, along, yaw = self._pending
        both = place * (inverse @ inverse.T)
        uu, vv, uv = both[0, 0] + along * u * u, both[1, 1] + along * v * v, both[0, 1] + along * u * v
        turns = yaw / at.step**2
        most = float((uu + vv).max())
        if max(most / 2, turns) < NOISE:
            return
        self._pending[:] = 0.0
        rounds = max(1, math.ceil((most + turns) / 0.6))
        uv = np.clip(uv, -np.minimum(uu, vv), np.minimum(uu, vv))
        taps = np.zeros((len(at.yaw), 3, 3))
        taps[:, 1, 0] = taps[:, 1, 2] = (uu - np.abs(uv)) / 2
        taps[:, 0, 1] = taps[:, 2, 1] = (vv - np.abs(uv)) / 2
        taps[:, 0, 0] = taps[:, 2, 2] = np.maximum(uv, 0) / 2
        taps[:, 0, 2] = taps[:, 2, 0] = np.maximum(-uv, 0) / 2
        taps /= rounds - turns  # only the mass that keeps its heading moves
        taps[:, 1, 1] = 1 - taps.sum(axis=(1, 2))
        for _ in range(rounds):
            logw, state = np.empty_like(grid.logw), np.empty_like(grid.state)
            share = turns / 2 / rounds
            self._code.mix(grid.logw, grid.state, logw, state, at, grid.states, taps.ravel(), share)
            grid.logw, grid.state = logw, state

    def _surprised(self, evidence: float, reading: Reading) -> bool:
        """Whether the collected surprise of the readings exceeds the threshold (Page 1954, Biometrika 41)."""
        if not math.isfinite(reading.b_nt):
            return False
        sensor = self._problem.sensor
        expected = sensor.white_nt**2 + reading.disturbance_sd_nt**2 + 0.02 * sensor.drift_nt**2
        if self._likelihood.mapped:
            expected += WHITE_SHARE * float(np.mean(self._likelihood.spreads))
        reference = -0.5 - 0.5 * math.log(expected)
        self._surprise = max(0.0, self._surprise + reference - evidence - SLACK)
        return self._surprise > RESET_AT

    def _fit(self, covariance: Array, spread: float) -> None:
        """Go from the bank to the window, or move and scale the window."""
        n = len(self._likelihood.start)
        if self.grid is None:
            if spread < COMPACT_M and self.bank.smooth(covariance):
                grid = Grid(self._mean, covariance, NODES, n)
                logw, state = self.bank.splat(grid.poses())
                grid.logw[:], grid.state[:] = logw, state.ravel()
                if grid.normalise():
                    self.grid = grid
                    self._pending[:] = 0.0
            return
        old = self.grid
        if old.fits(self._mean, covariance):
            return
        new = Grid(self._mean, covariance, NODES, n)
        floor = float(old.logw.max()) - 2 * CUT
        before = old.logw, old.state, old.lattice
        self._code.regrid(*before, new.logw, new.state, new.lattice, n, floor)
        if new.normalise():
            self.grid = new
