"""Point-mass filter: the posterior on a grid over x, y and heading that follows and refines itself."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.compiled import Loops
from magtwin.errors import InputError
from magtwin.localize.belief import table_of
from magtwin.localize.odometry import increment
from magtwin.localize.problem import Array, Estimate, Extent, Problem, Reading

LOOPS = Loops("magtwin.localize.grid_loops", pays=0.0)
"""Compiled loops; a grid in plain Python would take minutes."""

CUT = 20.0
"""Nodes whose mass is below exp(-CUT) of the greatest are dropped."""

SPAN = 3.6
"""Half width of a window that follows a posterior [standard deviations]."""

FINE = 0.8
"""Greatest distance of nodes at which a window follows [standard deviations]; else the grid is refined."""

MOST_NODES = 1_500_000
"""Most nodes of a grid, with and without mass."""

SPREAD = 0.02
"""Noise of the motion that is collected before the grid is convolved [variance per squared distance]."""

SLACK = 1.5
"""Surprise that is expected per reading, and forgotten [nats]."""

UNKNOWN_PENALTY = 1.0
"""Penalty of a node outside the extent per reading [nats]."""

WHITE_SHARE = 0.16
"""Share of the map's variance that differs from reading to reading; the rest is correlated along the path."""


@dataclass(eq=False)
class Grid:
    """Nodes over x, y and heading, with mass and linear states; `grid_loops` has the layout of the arrays."""

    layers: Array
    """Heading and origin of each layer, shape (3 H,)."""

    axes: Array
    """A by rows and the distance between layers, shape (5,)."""

    shape: NDArray[np.int64]
    """Layers, rows, columns and linear states."""

    logw: Array
    """Logarithm of the mass, shape (H Y X,)."""

    state: Array
    """Mean and upper triangle of the covariance of the linear states."""

    circle: bool = False
    """Whether the layers cover all headings."""

    @classmethod
    def empty(cls, layers: Array, axes: Array, counts: tuple[int, int, int], n: int, circle: bool) -> "Grid":
        nodes = counts[0] * counts[1] * counts[2]
        return cls(
            np.ascontiguousarray(layers, float).ravel(),
            axes,
            np.array([*counts, n]),
            np.full(nodes, -np.inf),
            np.zeros(nodes * (n + n * (n + 1) // 2)),
            circle,
        )

    def poses(self) -> Array:
        """x, y and heading of all nodes, shape (H Y X, 3)."""
        h, j, i = np.indices(self.shape[:3])
        yaw, ox, oy = self.layers.reshape(-1, 3).T
        a = self.axes
        x, y = ox[h] + a[0] * i + a[1] * j, oy[h] + a[2] * i + a[3] * j
        return np.stack([x, y, yaw[h]], axis=-1).reshape(-1, 3)


class PointMass:
    """Point-mass filter, with the readings' offset, drift and iron marginalised in each node.

    The posterior of x, y and yaw is a mass per node of a grid (Bucy and Senne 1971, Automatica 7:287),
    with a grid that is truncated, refined and moved (Bergman 1999, Recursive Bayesian Estimation, chapter 5):

        p(x_k | z_1..k) ~ N(z_k; m(x_k) + h' b, h' P h + R) sum_i K(x_k, x_i) p(x_i | z_1..k-1)

    with the kernel K of the odometry's noise. The grid itself moves with the odometry, so that only the noise
    is convolved and no interpolation blurs the mass. Each node has a Kalman filter of the linear states b
    given its pose: offset, drift (FOGM in time), error of the map (FOGM along the path, if the map has a
    variance), and iron cos and sin (if the sensor model has them). Nodes that meet are merged by moments. The
    field's variation within a cell counts as noise.

    While the posterior has several modes, cells are halved whenever mass leaves enough nodes empty. Then a
    window of about 3,000 nodes follows, sheared and scaled as the posterior.

    Args:
        cell_m: Distance of nodes at a global start, at most [m].
        heading_deg: Distance of headings at a global start, at most [deg].
        temper: Divisor of the log-likelihood, above 1 to allow for errors that the noise model lacks. Default:
            1, or 1.5 if the map has a variance.
        reset_at: Surprise [nats] at which the filter starts again from an unknown pose; infinity never does.
        scale_m: Distance over which the odometry's scale error counts as random [m].
    """

    def __init__(
        self,
        *,
        cell_m: float = 0.08,
        heading_deg: float = 7.5,
        temper: float | None = None,
        reset_at: float = 12.0,
        scale_m: float = 1.0,
    ) -> None:
        for name, value in (("cell_m", cell_m), ("heading_deg", heading_deg), ("reset_at", reset_at)):
            if not value > 0:
                raise InputError(f"{name} of PointMass must be above 0, got {value}", parameter=name)
        if temper is not None and not temper > 0:
            raise InputError(f"temper of PointMass must be above 0, got {temper}", parameter="temper")
        if not 0 <= scale_m < math.inf:
            raise InputError(
                f"scale_m of PointMass must be finite and not negative, got {scale_m}", parameter="scale_m"
            )
        self._cell, self._step_yaw = cell_m, math.radians(heading_deg)
        self._temper, self._reset_at, self._scale_m = temper, reset_at, scale_m

    def reset(self, problem: Problem) -> None:
        """Spread the prior on a grid.

        Raises:
            InputError: The problem has no map.
        """
        if problem.belief is None:
            raise InputError("the point-mass filter needs a map; the problem has none")
        self._code = LOOPS.open()
        self._problem, sensor = problem, problem.sensor
        self._table, self._spreads = table_of(problem.belief, problem.extent)
        self._mapped, self._iron = len(self._spreads) > 0, sensor.iron_nt > 0
        temper = self._temper or (1.5 if self._mapped else 1.0)
        self._power = 1 / temper
        values, masks = self._field_of_table()
        self._wide = (float(values[masks].mean()), float(values[masks].var()) + 1.0)
        sd = [sensor.offset_nt, sensor.drift_nt]
        sd += [1.0] * self._mapped + [sensor.iron_nt] * (2 * self._iron)
        self._start = np.array(sd) ** 2
        self._last: Reading | None = None
        self._pending = np.zeros(4)
        self._surprise = 0.0
        self._lost = any(math.isinf(s) for s in problem.prior.sd)
        self.grid = self._prior_grid(problem.prior.mean, problem.prior.sd)
        self._mean = np.array(problem.prior.mean, float)
        if problem.prior.is_global:
            x0, x1, y0, y1 = problem.extent
            self._mean[:2] = (x0 + x1) / 2, (y0 + y1) / 2

    def step(self, reading: Reading) -> Estimate:
        """Move the grid by the odometry, use the field, and fit the grid to the posterior."""
        dt = distance = 0.0
        if self._last is not None:
            dt = reading.t - self._last.t
            forward, left, turn = increment(self._last.odometry, reading.odometry)
            distance = math.hypot(forward, left)
            self._move(forward, left, turn, dt)
        self._last = reading
        stats = self._update(reading, dt, distance)
        if self._surprised(stats[0], reading):
            self.grid = self._prior_grid((0.0, 0.0, 0.0), (math.inf,) * 3)
            self._lost, self._surprise = True, 0.0
            stats = self._update(reading, 0.0, 0.0)
        return self._estimate(reading.t, stats)

    def particles(self) -> Array:
        """The heaviest nodes, at most 2,000: x, y [m], yaw [rad] and mass, shape (P, 4)."""
        w = np.exp(self.grid.logw)
        some = np.argsort(-w)[:2000]
        some = some[w[some] > 0]
        return np.column_stack([self.grid.poses()[some], w[some] / w[some].sum()])

    def _field_of_table(self) -> tuple[Array, NDArray[np.bool_]]:
        from magtwin.field.maps.trilinear import planes

        begin, end, *_ = planes(self._table)
        masked = self._table[end:]
        return self._table[begin:end], masked == 0 if len(masked) else np.ones(end - begin, bool)

    def _prior_grid(self, mean: tuple[float, float, float], sd: tuple[float, float, float]) -> Grid:
        """A grid over the prior: Gaussian or uniform in place and in heading."""
        x0, x1, y0, y1 = self._problem.extent
        circle = math.isinf(sd[2])
        if circle:
            count = max(8, math.ceil(2 * math.pi / self._step_yaw))
            dyaw = 2 * math.pi / count
            yaw = mean[2] + dyaw * np.arange(count)
        else:
            dyaw = min(self._step_yaw, 0.35 * sd[2])
            count = 2 * math.ceil(SPAN * sd[2] / dyaw) + 1
            yaw = mean[2] + dyaw * (np.arange(count) - count // 2)
        if math.isinf(sd[0]):
            columns, rows = (max(3, math.ceil(s / self._cell)) for s in (x1 - x0, y1 - y0))
            dx, dy = (x1 - x0) / columns, (y1 - y0) / rows
            origin = x0 + dx / 2, y0 + dy / 2
        else:
            dx, dy = (min(self._cell, 0.3 * s) for s in sd[:2])
            columns, rows = (2 * math.ceil(SPAN * s / d) + 1 for s, d in ((sd[0], dx), (sd[1], dy)))
            origin = mean[0] - dx * (columns // 2), mean[1] - dy * (rows // 2)
        layers = np.column_stack([yaw, np.full(count, origin[0]), np.full(count, origin[1])])
        n = len(self._start)
        axes = np.array([dx, 0.0, 0.0, dy, dyaw])
        grid = Grid.empty(layers, axes, (count, rows, columns), n, circle)
        shape = (count, rows, columns)
        logw = np.zeros(shape)
        if not circle:
            logw -= 0.5 * (((yaw - mean[2]) / sd[2]) ** 2)[:, None, None]
        if not math.isinf(sd[0]):
            logw -= 0.5 * (((origin[0] + dx * np.arange(columns) - mean[0]) / sd[0]) ** 2)
            logw -= 0.5 * (((origin[1] + dy * np.arange(rows) - mean[1]) / sd[1]) ** 2)[:, None]
        grid.logw[:] = (logw - np.log(np.exp(logw).sum())).ravel()
        upper = np.zeros((n, n))
        np.fill_diagonal(upper, self._start)
        grid.state.reshape(-1, n + n * (n + 1) // 2)[:, n:] = upper[np.triu_indices(n)]
        self._following = False
        return grid

    def _move(self, forward: float, left: float, turn: float, dt: float) -> None:
        """Move all layers, and convolve the noise once enough of it is collected."""
        grid, model = self.grid, self._problem.odometry
        layers = grid.layers.reshape(-1, 3)
        middle = layers[:, 0] + turn / 2
        c, s = np.cos(middle), np.sin(middle)
        layers[:, 0] += turn
        layers[:, 1] += forward * c - left * s
        layers[:, 2] += forward * s + left * c
        position, _, yaw = model.variances(math.hypot(forward, left), turn, dt)
        distance = math.hypot(forward, left)
        along = model.scale_std**2 * distance * self._scale_m
        self._pending += position, along, yaw, turn
        a = grid.axes
        inverse = np.array([[a[3], -a[1]], [-a[2], a[0]]]) / (a[0] * a[3] - a[1] * a[2])
        headings = layers[:, 0] - self._pending[3] / 2
        direction = inverse @ np.stack([np.cos(headings), np.sin(headings)])
        noise = self._pending[0] * (inverse @ inverse.T)
        uu = noise[0, 0] + self._pending[1] * direction[0] ** 2
        vv = noise[1, 1] + self._pending[1] * direction[1] ** 2
        uv = noise[0, 1] + self._pending[1] * direction[0] * direction[1]
        ww = self._pending[2] / a[4] ** 2
        most = max(float((uu + vv).max()) / 2, ww)
        if most < SPREAD:
            return
        self._pending[:] = 0.0
        rounds = max(1, math.ceil((float((uu + vv).max()) + ww) / 0.6))
        uv = np.clip(uv, -np.minimum(uu, vv), np.minimum(uu, vv))
        cross = np.abs(uv) / 2
        taps = np.zeros((len(layers), 3, 3))
        taps[:, 1, 0] = taps[:, 1, 2] = uu / 2 - cross
        taps[:, 0, 1] = taps[:, 2, 1] = vv / 2 - cross
        taps[:, 0, 0] = taps[:, 2, 2] = np.maximum(uv, 0) / 2
        taps[:, 0, 2] = taps[:, 2, 0] = np.maximum(-uv, 0) / 2
        taps /= rounds
        taps[:, 1, 1] = 1 - taps.sum(axis=(1, 2))
        for _ in range(rounds):
            logw, state = np.empty_like(grid.logw), np.empty_like(grid.state)
            self._code.mix(
                grid.logw,
                grid.state,
                logw,
                state,
                grid.layers,
                grid.axes,
                grid.shape,
                taps.ravel(),
                ww / 2 / rounds,
                grid.circle,
            )
            grid.logw, grid.state = logw, state

    def _update(self, reading: Reading, dt: float, distance: float) -> Array:
        sensor = self._problem.sensor
        in_time = math.exp(-dt / sensor.drift_s)
        along = math.exp(-distance / self._problem.map_length_m)
        decay = [1.0, in_time] + [along] * self._mapped + [1.0, 1.0] * self._iron
        noise = [0.0, (1 - in_time**2) * sensor.drift_nt**2]
        noise += [1 - along**2] * self._mapped + [0.0, 0.0] * self._iron
        white = sensor.white_nt**2 + reading.disturbance_sd_nt**2
        numbers = np.array(
            [
                reading.b_nt - reading.disturbance_nt,
                *sensor.lever_arm_m,
                white,
                WHITE_SHARE,
                self._power,
                self._mapped,
                self._iron,
                *self._wide,
                *self._problem.extent,
                UNKNOWN_PENALTY,
                CUT,
                *self._mean,
                *decay,
                *noise,
            ]
        )
        stats = np.empty(self._code.STATS)
        grid = self.grid
        self._code.update(
            self._table,
            self._spreads,
            grid.logw,
            grid.state,
            grid.layers,
            grid.axes,
            grid.shape,
            numbers,
            stats,
        )
        return stats

    def _surprised(self, evidence: float, reading: Reading) -> bool:
        """Cumulated surprise of the readings (Page's test) exceeds the threshold."""
        if not math.isfinite(reading.b_nt) or self._last is None:
            return False
        sensor = self._problem.sensor
        expected = sensor.white_nt**2 + reading.disturbance_sd_nt**2 + 0.02 * sensor.drift_nt**2
        expected += self._typical_variance()
        reference = -0.5 - 0.5 * math.log(expected)
        if self._lost:
            self._surprise = 0.0
            return False
        self._surprise = max(0.0, self._surprise + reference - evidence - SLACK)
        return self._surprise > self._reset_at

    def _typical_variance(self) -> float:
        return WHITE_SHARE * float(np.mean(self._spreads)) if self._mapped else 0.0

    def _estimate(self, t: float, stats: Array) -> Estimate:
        """Mean and covariance of the mass; afterwards the grid is fitted to them."""
        nodes, total = int(stats[1]), stats[3]
        if nodes == 0 or not total > 0:  # no node explains the readings: start again
            self.grid = self._prior_grid((0.0, 0.0, 0.0), (math.inf,) * 3)
            self._lost = True
            x0, x1, y0, y1 = self._problem.extent
            spread = np.diag([(x1 - x0) ** 2 / 12, (y1 - y0) ** 2 / 12, math.pi**2 / 3])
            return Estimate(t, *self._mean.tolist(), spread, None, True)
        shift = stats[4:7] / total
        second = np.array(
            [
                [stats[7], stats[8], stats[9]],
                [stats[8], stats[10], stats[11]],
                [stats[9], stats[11], stats[12]],
            ]
        )
        covariance = second / total - np.outer(shift, shift)
        layers, axes = self.grid.layers.reshape(-1, 3), self.grid.axes
        cell = axes[:4].reshape(2, 2)
        within = np.zeros((3, 3))
        within[:2, :2], within[2, 2] = cell @ cell.T / 12, axes[4] ** 2 / 12
        self._mean = self._mean + shift
        spread = math.sqrt(covariance[0, 0] + covariance[1, 1])
        if self._lost and spread < 0.3:
            self._lost = False
        if self._lost:  # the heaviest node, with the spread of all mass about it
            k = int(stats[2])
            h, rest = divmod(k, int(self.grid.shape[1] * self.grid.shape[2]))
            j, i = divmod(rest, int(self.grid.shape[2]))
            pose = np.array([*(layers[h, 1:] + cell @ (i, j)), layers[h, 0]])
            away = pose - self._mean
            away[2] -= 2 * math.pi * math.floor(away[2] / (2 * math.pi) + 0.5)
            reported = covariance + within + np.outer(away, away)
        else:
            pose, reported = self._mean, covariance if self._following else covariance + within
        bias = float(stats[13] / total) if total > 0 else None
        self._fit(covariance, stats)
        x, y, yaw = pose.tolist()
        return Estimate(t, x, y, yaw, reported + 1e-12 * np.eye(3), bias, self._lost)

    def _fit(self, covariance: Array, stats: Array) -> None:
        """Refine the grid while it is coarse beside the posterior; follow the posterior once it is not."""
        grid = self.grid
        a = grid.axes
        cell = a[:4].reshape(2, 2)
        sd_yaw = math.sqrt(max(covariance[2, 2], 0.0))
        slope = covariance[:2, 2] / max(covariance[2, 2], 1e-18)
        across = covariance[:2, :2] - np.outer(slope, covariance[:2, 2])
        inverse = np.linalg.inv(cell)
        in_cells = inverse @ across @ inverse.T
        least = math.sqrt(max(np.linalg.eigvalsh(in_cells)[0], 0.0))
        turns = sd_yaw / a[4]
        if not self._following:
            if min(least, turns) * FINE < 1 or math.sqrt(covariance[0, 0] + covariance[1, 1]) > 0.3:
                self._refine(stats, least * FINE < 1, turns * FINE < 1)
                return
        elif self._fits(covariance, slope, in_cells, turns):
            return
        self._follow(across, slope, sd_yaw)

    def _fits(self, covariance: Array, slope: Array, in_cells: Array, turns: float) -> bool:
        """Whether the window still has the place and the scale of the posterior."""
        grid, nodes = self.grid, self._nodes
        sd = math.sqrt(in_cells[0, 0]), math.sqrt(in_cells[1, 1])
        half = (nodes - 1) / 2
        wanted = half / SPAN
        scales = [sd[0] / wanted, sd[1] / wanted, turns / wanted]
        if min(scales) < 0.75 or max(scales) > 1.25 or abs(in_cells[0, 1]) > 0.5 * sd[0] * sd[1]:
            return False
        layers = grid.layers.reshape(-1, 3)
        middle = layers[len(layers) // 2]
        cell = grid.axes[:4].reshape(2, 2)
        centre = middle[1:] + cell @ (half, half)
        off = np.linalg.solve(cell, self._mean[:2] - slope * (self._mean[2] - middle[0]) - centre)
        shear = (layers[-1, 1:] - layers[0, 1:]) / (layers[-1, 0] - layers[0, 0]) - slope
        sheared = np.linalg.solve(cell, shear) * grid.axes[4] * turns
        away = abs(self._mean[2] - middle[0]) / grid.axes[4]
        return bool(max(abs(off).max(), away) < 0.6 * wanted and abs(sheared).max() < 0.5 * wanted)

    _nodes = 15
    """Nodes of a following window along each axis."""

    def _follow(self, across: Array, slope: Array, sd_yaw: float) -> None:
        """A window about the mean, sheared and scaled as the posterior."""
        count = self._nodes
        half = (count - 1) / 2
        values, vectors = np.linalg.eigh(across)
        sd = np.sqrt(np.maximum(values, 1e-8))  # not below 0.1 mm
        cell = vectors * (sd * SPAN / half)
        dyaw = max(sd_yaw, 1e-5) * SPAN / half
        steps = dyaw * (np.arange(count) - half)
        origin = self._mean[:2] - cell @ (half, half)
        layers = np.column_stack([self._mean[2] + steps, origin + steps[:, None] * slope])
        axes = np.array([*cell.ravel(), dyaw])
        self._regrid(Grid.empty(layers, axes, (count, count, count), len(self._start), False))
        self._following = True

    def _refine(self, stats: Array, places: bool, turns: bool) -> None:
        """Halve the distances of nodes within the box of the mass, if the nodes are not too many."""
        grid = self.grid
        h0, h1, j0, j1, i0, i1 = (int(v) for v in stats[16:22])
        divide = 2 if places else 1, 2 if turns else 1
        if divide == (1, 1):
            return
        circle = grid.circle and h1 - h0 + 1 > 0.75 * grid.shape[0]
        if circle:
            h0, h1 = 0, int(grid.shape[0]) - 1
        pad = 1
        low, high = (j0 - pad, i0 - pad), (j1 + pad, i1 + pad)
        counts = [divide[0] * (high[a] - low[a]) + 1 for a in range(2)]
        turned = h1 - h0 + 1 if circle else h1 - h0 + 1 + 2 * pad
        layers_count = divide[1] * turned if circle else divide[1] * (turned - 1) + 1
        factor = divide[0] ** 2 * divide[1]
        size = layers_count * counts[0] * counts[1]
        if factor * stats[1] > min(self._budget(), 0.9 * len(grid.logw) + 8000) or size > MOST_NODES:
            return
        layers = grid.layers.reshape(-1, 3)
        level = h0 - (0 if circle else pad) + np.arange(layers_count) / divide[1]
        number = len(layers)
        if grid.circle:
            around = np.vstack([layers, layers[:1]])
            turns_of = np.floor(level / number)
            inside = level - number * turns_of
            ox, oy = (np.interp(inside, np.arange(number + 1), around[:, a]) for a in (1, 2))
        else:
            ox, oy = (_extended(level, layers[:, a]) for a in (1, 2))
        yaw = layers[0, 0] + level * grid.axes[4]
        cell = grid.axes[:4].reshape(2, 2)
        shift = cell @ (low[1], low[0])
        axes = np.array([*(cell / divide[0]).ravel(), grid.axes[4] / divide[1]])
        made = np.column_stack([yaw, ox + shift[0], oy + shift[1]])
        target = (layers_count, counts[0], counts[1])
        self._regrid(Grid.empty(made, axes, target, len(self._start), circle))

    def _budget(self) -> float:
        return 150_000.0

    def _regrid(self, target: Grid) -> None:
        grid = self.grid
        floor = float(grid.logw.max()) - 2 * CUT
        self._code.regrid(
            grid.logw,
            grid.state,
            grid.layers,
            grid.axes,
            grid.shape,
            target.logw,
            target.state,
            target.layers,
            target.axes,
            target.shape,
            grid.circle,
            floor,
        )
        most = target.logw.max()
        if not np.isfinite(most):
            return
        target.logw -= most + math.log(np.exp(target.logw - most).sum())
        self.grid = target


def _extended(level: Array, values: Array) -> Array:
    """Linear interpolation in a row of numbers, continued beyond its ends."""
    last = len(values) - 1
    low = np.clip(np.floor(level).astype(int), 0, max(last - 1, 0))
    high = np.minimum(low + 1, last)
    made: Array = values[low] + (level - low) * (values[high] - values[low])
    return made


def inside(extent: Extent, x: float, y: float) -> bool:
    """Whether a point lies on the floor."""
    return extent[0] <= x <= extent[1] and extent[2] <= y <= extent[3]
