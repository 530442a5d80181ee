"""Particle filters: bootstrap, and Rao-Blackwellised for the errors of the magnetometer."""

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magtwin.compiled import Loops, in_threads
from magtwin.errors import InputError
from magtwin.localization.belief import known_values, mean_variance, table_of, tempering
from magtwin.localization.odometry import Repeats, increment
from magtwin.localization.problem import Array, Estimate, Problem, Reading

LOOPS = Loops("magtwin.localization.particle_loops", pays=0)

MOST = 100_000
"""Greatest number of particles."""

SHARE = 16
"""Blocks of 256 particles that a thread takes at a time."""

FORGET_S = 1000.0
"""Correlation time of the offset and of hard iron [s]. They are constant in the model, but the particles soon
descend from a single one and share its estimate of the constants, whose error they do not spread over."""

WALK_S = 500.0
"""The same where they are sampled, whose values would run out [s]."""

KEEP_S = 5.0
"""Time between two memories of the constants, for a start after a kidnapping [s]. The last but one is used:
what was learned after the kidnapping is wrong."""

INFLATE = 4.0
"""Factor of their covariance then."""

SETTLED_M = 0.5
"""Spread of the particles, sqrt(var x + var y), below which the pose counts as known [m]."""

NARROW_M, MOST_TIMES = 0.06, 5.0
"""The least number of particles grows with their spread above this [m], up to so many times: a wrong position
nearby may agree with the first readings better."""

SHRINK = 0.95
"""Factor of the number of particles at each reading, while there are more than enough."""

_STRIDE, _WORD = 0x9E3779B97F4A7C15 * 0x2545F4914F6CDD1D, (1 << 64) - 1

_PRODUCTS = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])  # of x, y and yaw, among the sums of a block

_LEAST = 1e-10 * np.eye(3)  # outweighs rounding where one particle has all weight

# Fractions of the roots of x^4 = x + 1: the low-discrepancy sequence R3 (Roberts 2018)
_R3 = 1 / 1.2207440846057596 ** np.arange(1, 4)


class RaoBlackwell:
    """Particle filter whose particles carry a Kalman filter for the errors of the magnetometer.

    A particle is a pose with a Gaussian z | pose history of linear states: the offset of the run, the drift
    (FOGM over time) and, if the map has a variance, the map's error (FOGM over distance). Marginalising them
    is Rao-Blackwellisation (Schön, Gustafsson and Nordlund 2005, IEEE Trans. Signal Process. 53). The scale
    error of the odometry is marginalised too: the sampled distances are its readings. The proposal is the
    odometry; see `magtwin.localization.particle_loops.step` for the equations.

    * Start: five times `particles`, or more where the region is large; R3 points over the unknown parts.
    * Resampling: systematic, once the effective number is below half of the particles. While they are within
      0.5 m, 5 % fewer remain at each reading, down to `particles`, or up to five times as many for a spread
      above 0.06 m.
    * Map error: the share `map_correlated` of the map's variance is the FOGM state of length
      `Problem.map_length_m`, the rest is white.
    * Where the map is unknown, a reading has the mean and the variance of the whole map.
    * Kidnapping: a cumulative sum of surprise, c = max(0, c + ref - log p - 1.5), with p the likelihood of a
      reading and ref the mean log likelihood of a Gaussian with the variance of the readings that the
      particles predict. Above 12, particles over the whole floor join those that there are, half of them with
      the offset and hard iron that were known 5 to 10 s before. So a false alarm does not lose the pose. A
      pose more than 0.25 m off the floor adds at least 1 per reading: without a map any reading fits.
    * Stale map: an alarm need not be a kidnapping. Odometry alone moves a copy of the old particles on. Once
      the others have been within 0.5 m for 5 s, more than 1 m away from these, both compete with equal
      weights. The copy also joins the start of a further alarm before that.
    * A reading that repeats itself to the bit while the robot moves is not used, nor is nan.

    `lost` is set while the particles spread over more than 0.5 m, and after such a start until they have been
    within 0.5 m for 5 s: where the map is stale, they may gather at a wrong place first.

    Args:
        particles: Least number of particles. Default: 3,000; 6,000 for the bootstrap filter.
        kappa: Divisor of the log likelihood (tempering): above 1 for a map whose errors depend on each other
            more than their model, as at a place that is passed again. Default: `tempering`.
        map_correlated: Share of the map's variance that is correlated.
        resets: Whether to test for kidnapping.
    """

    reset_count = 0
    """How often the filter has started again."""

    _memory: Array
    _resampled: NDArray[np.int64]
    _state: Array

    sampled: ClassVar[bool] = False
    iron: ClassVar[bool] = False
    network: ClassVar[bool] = False
    least: int = 3000
    start_per_m2: ClassVar[float] = 500.0
    """At the start, per square metre of an unknown position; four times as many if the heading is unknown."""

    def __init__(
        self,
        *,
        particles: int | None = None,
        kappa: float | None = None,
        map_correlated: float = 0.8,
        resets: bool = True,
    ) -> None:
        self.least = self.least if particles is None else particles
        if not (isinstance(self.least, int) and 2 <= self.least <= MOST):
            raise InputError(
                f"particles must be a whole number between 2 and {MOST}, got {self.least}",
                parameter="particles",
            )
        if not ((kappa is None or kappa > 0) and 0 <= map_correlated <= 1):
            raise InputError(
                f"kappa must be above 0 and map_correlated between 0 and 1, got {kappa}, {map_correlated}"
            )
        self.kappa, self.map_correlated, self.resets = kappa, map_correlated, resets

    def reset(self, problem: Problem) -> None:
        """Draw the particles from the prior.

        Raises:
            InputError: The problem has no map.
        """
        if problem.belief is None:
            raise InputError("particle filters need a map; without one, use incremental-slam")
        self._loops: Any = LOOPS.open()
        self._problem = problem
        self._rng = np.random.default_rng(problem.seed)
        self._seed, self._count_steps = int(self._rng.integers(1 << 63)), 0
        table = table_of(problem.belief, problem.extent)
        self._table, self._variance = table.field, mean_variance(table)
        known = known_values(table)
        self._field_mean, self._field_variance = float(known.mean()), float(known.var())
        sensor = problem.sensor
        self._kappa = self.kappa or tempering(table, sensor.white_nt)
        self._states(len(self._variance) > 0)
        self._scale_variance = problem.odometry.scale_std**2
        self.reset_count = 0
        self._doubt, self._spread_t = False, -math.inf
        self._old: Array | None = None  # moved by odometry alone since an alarm
        self._last: Reading | None = None
        self._repeats = Repeats()
        self._start(problem.prior.mean, problem.prior.sd)

    def _states(self, has_variance: bool) -> None:
        """Linear states: prior variance, correlation time [s], correlation length [m] and factor of each."""
        k, sensor, problem = self._loops, self._problem.sensor, self._problem
        iron = sensor.iron_nt**2
        states = [(sensor.offset_nt**2, math.inf, math.inf, k.CONSTANT)]
        drift = sensor.drift_nt**2 + (0.0 if self.iron else iron)
        if drift > 0:
            states.append((drift, sensor.drift_s, math.inf, k.DRIFT))
        if self.iron and iron > 0:
            states += [(iron, math.inf, math.inf, k.COSINE), (iron, math.inf, math.inf, k.SINE)]
        correlated = self.map_correlated if has_variance and problem.map_length_m > 0 else 0.0
        if correlated > 0:
            states.append((correlated, math.inf, problem.map_length_m, k.MAP_SD))
        variances, times, lengths, kinds = zip(*states, strict=True)
        slow = WALK_S if self.sampled else FORGET_S
        times = tuple(
            slow if math.isinf(t) and math.isinf(d) else t for t, d in zip(times, lengths, strict=True)
        )
        self._prior_variances = np.array(variances, float)
        self._rates = 1 / np.array(times), 1 / np.array(lengths)
        self._kinds = np.array(kinds, np.int64)
        self._constant = np.isin(times, (FORGET_S, WALK_S)) & np.isinf(lengths)
        self._map_white = 1 - correlated

    def _start(
        self,
        mean: tuple[float, float, float],
        sd: tuple[float, float, float],
        errors: tuple[Array, Array] | None = None,
        kept: Array | None = None,
    ) -> None:
        """Draw all particles: Gaussian, and R3 where the standard deviation is infinite.

        Every other particle gets the mean and covariance `errors` of the constants, the rest their prior.
        Particles `kept`, columns of the state, stay beside them.
        """
        x0, x1, y0, y1 = self._problem.extent
        wide = [math.sqrt(2 * math.pi * math.e) * s for s in sd]  # side of the uniform of the same entropy
        area = (x1 - x0) * (y1 - y0) if math.isinf(sd[0]) else wide[0] * wide[1]
        turn = min(1.0, wide[2] / (2 * math.pi))
        wanted = self.start_per_m2 * area * (1 + 3 * turn)
        count = int(min(max(wanted, MOST_TIMES * self.least), MOST))
        size = len(self._kinds)
        k = self._loops
        old = 0 if kept is None else kept.shape[1]
        self._open(k.LINEAR + size + size * (size + 1) // 2, old + count)
        if kept is not None:
            self._state[:, :old] = kept
        state = self._state[:, old : self._count]
        unit = (self._rng.random(3)[:, None] + _R3[:, None] * np.arange(1, count + 1)) % 1.0
        middle, span = ((x0 + x1) / 2, (y0 + y1) / 2, 0.0), (x1 - x0, y1 - y0, 2 * math.pi)
        normal = self._rng.standard_normal((3, count))
        for row in range(3):
            if math.isinf(sd[row]):
                state[row] = middle[row] + (unit[row] - 0.5) * span[row]
            else:
                state[row] = mean[row] + sd[row] * normal[row]
        state[k.SCALE : k.LINEAR] = 0.0
        state[k.LINEAR :] = 0.0
        self._draw_errors(state, slice(None), np.zeros(size), np.diag(self._prior_variances))
        if errors is not None:
            known, covariance = np.zeros(size), np.diag(self._prior_variances)
            known[self._constant] = errors[0]
            covariance[np.ix_(self._constant, self._constant)] = errors[1]
            self._draw_errors(state, slice(None, None, 2), known, covariance)
        self._scale_variance = self._problem.odometry.scale_std**2
        self._share(old, count)
        if not old:
            self._reference = mean if math.isfinite(sd[0]) else (middle[0], middle[1], mean[2])
        self._surprise, self._settled = 0.0, False
        self._kept: list[tuple[Array, Array]] = []
        self._kept_t = -math.inf

    def _share(self, old: int, count: int) -> None:
        """Give the first `old` particles half of the weight, and the `count` others the rest."""
        k = self._loops
        state = self._state[:, : old + count]
        state[k.LOG_WEIGHT : k.WEIGHT] = 0.0
        state[k.LOG_WEIGHT, :old] = math.log(count / max(old, 1))
        state[k.WEIGHT] = np.exp(state[k.LOG_WEIGHT])
        total = count * (2.0 if old else 1.0)
        self._shift = math.log(total)
        self._scales = np.full(self._blocks(old + count), 1.0 / total)

    def _draw_errors(self, state: Array, part: slice, mean: Array, covariance: Array) -> None:
        """Give some particles a mean and a covariance of the linear states, or draws of them."""
        k, size = self._loops, len(mean)
        means, triangle = state[k.LINEAR : k.LINEAR + size, part], state[k.LINEAR + size :, part]
        if self.sampled:
            root = np.linalg.cholesky(covariance + 1e-12 * np.eye(size))
            means[:] = mean[:, None] + root @ self._rng.standard_normal(means.shape)
        else:
            means[:] = mean[:, None]
            triangle[:] = covariance[np.tril_indices(size)][:, None]

    def _errors(self) -> tuple[Array, Array]:
        """Mean and covariance of the constants: offset and hard iron."""
        k, count, size = self._loops, self._count, len(self._kinds)
        w = self._state[k.WEIGHT, :count] * np.repeat(self._scales, k.BLOCK)[:count]
        rows = np.flatnonzero(self._constant)
        means = self._state[k.LINEAR + rows, :count]
        mean = means @ w
        covariance = (w * (means - mean[:, None])) @ (means - mean[:, None]).T
        for i, high in enumerate(rows.tolist()):
            for j, low in enumerate(rows[: i + 1].tolist()):
                inner = float(self._state[k.LINEAR + size + high * (high + 1) // 2 + low, :count] @ w)
                covariance[i, j] += inner
                covariance[j, i] = covariance[i, j]
        return mean, covariance

    def step(self, reading: Reading) -> Estimate:
        """Move the particles, weigh them by the reading, and resample if need be."""
        forward = left = turn = dt = 0.0
        if self._last is not None:
            forward, left, turn = increment(self._last.odometry, reading.odometry)
            dt = reading.t - self._last.t
        self._last = reading
        distance = math.hypot(forward, left)
        used = self._repeats.usable(reading.b_nt, (forward, left, turn))
        own, own_sd = (reading.disturbance_nt, reading.disturbance_sd_nt) if self.network else (0.0, 0.0)
        x, y, yaw = self._reference
        yaw += turn
        middle = yaw - turn / 2
        x += forward * math.cos(middle) - left * math.sin(middle)
        y += forward * math.sin(middle) + left * math.cos(middle)
        along_sd, across_sd, yaw_sd, gain = self._motion_noise(distance, turn, dt)
        sensor = self._problem.sensor
        numbers = self._loops.Step(
            distance=distance,
            direction=math.atan2(left, forward),
            turned=turn,
            along_sd=along_sd,
            across_sd=across_sd,
            yaw_sd=yaw_sd,
            scale_gain=gain,
            arm_x=float(sensor.lever_arm_m[0]),
            arm_y=float(sensor.lever_arm_m[1]),
            shift=self._shift,
            used=float(used),
            field=float(reading.b_nt - own) if used else 0.0,
            white=float(sensor.white_nt**2 + own_sd**2),
            map_white=float(self._map_white),
            kappa=float(self._kappa),
            elsewhere=self._field_mean,
            elsewhere_variance=self._field_variance,
            x_ref=x,
            y_ref=y,
            yaw_ref=yaw,
        )
        decay = np.exp(-dt * self._rates[0] - distance * self._rates[1])
        noise = self._prior_variances * (1 - decay**2)
        self._run(numbers, decay, noise)
        estimate = self._estimate(reading.t, used, (x, y, yaw))
        self._maintain(estimate)
        return estimate

    def _motion_noise(self, distance: float, turn: float, dt: float) -> tuple[float, float, float, float]:
        """Standard deviations along, across and of the yaw, and gain of the scale error.

        The sampled distances update the variance of the scale error.
        """
        model = self._problem.odometry
        along, _, yaw = model.variances(distance, turn, dt).tolist()
        total = along + distance**2 * self._scale_variance
        gain = distance * self._scale_variance / total if total > 0 else 0.0
        least = (0.1 * model.scale_std) ** 2
        self._scale_variance = max(self._scale_variance * (1 - gain * distance), least)
        return math.sqrt(total), math.sqrt(along), math.sqrt(yaw), gain

    def _run(self, numbers: Any, decay: Array, noise: Array) -> None:
        """One step of all blocks, on several threads if there are many; the old particles beside them."""
        self._count_steps += 1
        before = self._state
        if len(self._resampled):
            self._state = self._next_state(len(before))
        self._sums = self._moved(before, self._resampled, self._state, self._count, numbers, decay, noise)
        self._resampled = self._resampled[:0]
        if (old := self._old) is not None:
            alone = numbers._replace(used=0.0)
            self._moved(old, self._resampled, old, old.shape[1], alone, decay, noise, sign=-1)

    def _moved(
        self,
        before: Array,
        chosen: NDArray[np.int64],
        state: Array,
        count: int,
        numbers: Any,
        decay: Array,
        noise: Array,
        sign: int = 1,
    ) -> Array:
        """Do a step with some particles; returns the sums of their blocks. `sign` selects their draws."""
        k = self._loops
        key = np.uint64((self._seed + sign * self._count_steps * _STRIDE) & _WORD)
        blocks = self._blocks(count)
        sums = np.empty((blocks, k.PLAIN_SUM + 1))

        def work(part: slice) -> None:
            k.step(
                part.start, part.stop, count, before, chosen, state, sums, self._table, self._variance,
                numbers, decay, noise, self._kinds, key, self.sampled,
            )  # fmt: skip

        in_threads(work, blocks, SHARE)
        return sums

    def _estimate(self, t: float, used: bool, reference: tuple[float, float, float]) -> Estimate:
        """Weighted mean and covariance, from sums about a reference pose; the sum of surprise."""
        k, sums = self._loops, self._sums
        top = float(sums[:, k.TOP].max())
        scales, before = np.exp(sums[:, k.TOP] - top), self._scales
        total = scales @ sums
        weight = float(total[k.SUM])
        self._effective = weight**2 / float(scales**2 @ sums[:, k.SQUARES])
        self._shift = top + math.log(weight)
        self._scales = scales / weight
        x, y, yaw = reference
        part = total[k.SUM : k.YAW_YAW + 1] / weight
        mean_yaw = math.atan2(total[k.SIN], total[k.COS])
        if abs(_wrapped(mean_yaw - yaw - part[3])) > 0.05:  # the heading is spread around the circle
            out = np.empty(k.YAW_YAW + 1)
            k.moments(self._count, self._state, self._scales, x, y, mean_yaw, out)
            part, yaw = out[k.SUM :] / out[k.SUM], mean_yaw
        pose = x + float(part[1]), y + float(part[2]), mean_yaw
        covariance = part[_PRODUCTS] - np.outer(part[1:4], part[1:4]) + _LEAST
        self.spread = math.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1]))
        if self.spread > SETTLED_M and self.reset_count:
            pose, covariance = self._held(pose, covariance, (x, y))
        self._reference = pose
        self._settled = self._settled or self.spread < SETTLED_M
        if used and self._settled:
            top = float(sums[:, k.PLAIN_TOP].max())
            likelihood = top + math.log(float(np.exp(sums[:, k.PLAIN_TOP] - top) @ sums[:, k.PLAIN_SUM]))
            mean = float(before @ sums[:, k.NU])
            variance = float(before @ sums[:, k.NU_NU]) - mean**2 + float(before @ sums[:, k.PRIOR_S])
            expected = -0.5 - 0.5 * math.log(variance)
            more = min(expected - likelihood - SLACK, MOST_SURPRISE)
            if self._off_the_floor(pose):
                more = max(more, OFF_SURPRISE)
            self._surprise = max(0.0, self._surprise + more)
        lost = self._doubted(t)
        bias = float(total[k.OFFSET]) / weight
        return Estimate(t, *pose, covariance, bias, lost)

    def _off_the_floor(self, pose: tuple[float, float, float]) -> bool:
        x0, x1, y0, y1 = self._problem.extent
        return max(x0 - pose[0], pose[0] - x1, y0 - pose[1], pose[1] - y1) > OFF_M

    def _doubted(self, t: float) -> bool:
        """Whether the particles are spread out, or have met only lately after a start again."""
        if self.spread > SETTLED_M:
            self._spread_t = t
            return True
        return self._doubt

    def _held(
        self, pose: tuple[float, float, float], covariance: Array, place: tuple[float, float]
    ) -> tuple[tuple[float, float, float], Array]:
        """After an alarm: the particles about the last pose, while they have most of the weight.

        The covariance stays that of all particles.
        """
        k, count = self._loops, self._count
        state = self._state[:, :count]
        near = np.hypot(state[k.X] - place[0], state[k.Y] - place[1]) < NEAR_M
        weight = state[k.WEIGHT] * np.repeat(self._scales, k.BLOCK)[:count]
        weight /= weight.sum()
        if weight[near].sum() < 0.5:
            return pose, covariance
        weight, (x, y, yaw) = weight[near] / weight[near].sum(), state[:3, near]
        turn = math.atan2(float(weight @ np.sin(yaw)), float(weight @ np.cos(yaw)))
        held = float(weight @ x), float(weight @ y), turn
        off = np.array([pose[0] - held[0], pose[1] - held[1], _wrapped(pose[2] - held[2])])
        return held, covariance + np.outer(off, off)

    def _maintain(self, estimate: Estimate) -> None:
        """Resample, shrink, or start again."""
        if self.resets and self._surprise > RESET_ABOVE:
            self.reset_count += 1
            self._doubt, self._spread_t = True, estimate.t
            errors = None if len(self._kept) < 2 else (self._kept[0][0], INFLATE * self._kept[0][1])
            kept = self._state[:, self._chosen(min(KEPT, self._count))]
            if self._old is None:
                self._old = kept.copy()
            else:
                kept = np.concatenate([kept, self._old], axis=1)
            self._start((0.0, 0.0, 0.0), (math.inf, math.inf, math.inf), errors, kept)
            return
        if self._doubt and estimate.t >= self._spread_t + DOUBT_S:
            old, self._old = self._old, None
            self._doubt = old is not None and not self._agrees(old, estimate)
            if self._doubt and old is not None:
                self._let_compete(old)
                self._spread_t = estimate.t
                return
        if self._settled and estimate.t >= self._kept_t + KEEP_S:
            self._kept, self._kept_t = [*self._kept[-1:], self._errors()], estimate.t
        wanted = self._count
        if self.spread < SETTLED_M:
            wanted = min(self._count, max(self._enough(self.spread), int(SHRINK * self._count)))
        if wanted < self._count or self._effective < self._count / 2:
            self._resample(wanted)

    def _agrees(self, old: Array, estimate: Estimate) -> bool:
        """Whether odometry puts the particles that there were before an alarm near an estimate."""
        return math.hypot(float(old[0].mean()) - estimate.x, float(old[1].mean()) - estimate.y) < NEAR_M

    def _let_compete(self, old: Array) -> None:
        """Give half of the weight to the particles that there were before an alarm."""
        others = self._state[:, self._chosen(self._count)]
        size, count = old.shape[1], self._count
        self._open(len(others), size + count)
        self._state[:, :size], self._state[:, size : self._count] = old, others
        self._share(size, count)

    def _open(self, rows: int, count: int) -> None:
        """Memory for a number of particles, of a start or of a competition."""
        self._count = count
        self._memory = np.empty((2, rows * _padded(count)))
        self._columns = np.empty(count, np.int64)
        self._resampled = self._columns[:0]
        self._state = self._next_state(rows)

    def _next_state(self, rows: int) -> Array:
        """Memory of a state, beside that of the present one."""
        self._memory, columns = self._memory[::-1], _padded(self._count)
        return self._memory[0, : rows * columns].reshape(rows, columns)

    def _enough(self, spread: float) -> int:
        """Least number of particles for a spread [m]."""
        return min(MOST, int(self.least * min(max(spread / NARROW_M, 1.0), MOST_TIMES)))

    def _blocks(self, count: int) -> int:
        return -(-count // self._loops.BLOCK)

    def _chosen(self, count: int) -> NDArray[np.int64]:
        """Particles drawn by their weights, systematically."""
        k = self._loops
        below = np.concatenate([[0.0], np.cumsum(self._scales * self._sums[:, k.SUM])])
        chosen, start = self._columns[:count], float(self._rng.random())

        def work(part: slice) -> None:
            k.choose(part.start, part.stop, self._count, self._state, self._scales, below, start, chosen)

        in_threads(work, len(below) - 1, SHARE)
        return chosen

    def _resample(self, count: int) -> None:
        """Choose the particles that the next step starts from, which copies them."""
        self._resampled = self._chosen(count)
        self._count, self._shift = count, 0.0
        self._scales = np.full(self._blocks(count), 1.0 / count)

    def particles(self) -> Array:
        """x, y, yaw and weight of the particles, shape (P, 4)."""
        k, count = self._loops, self._count
        if len(self._resampled):
            return np.column_stack([*self._state[:3, self._resampled], np.full(count, 1 / count)])
        weight = self._state[k.WEIGHT, :count] * np.repeat(self._scales, k.BLOCK)[:count]
        return np.column_stack([*self._state[:3, :count], weight / weight.sum()])


class Bootstrap(RaoBlackwell):
    """Bootstrap particle filter: the errors of the magnetometer are sampled, not marginalised.

    (Gordon, Salmond and Smith 1993, IEE Proc. F 140.) The offset is a FOGM of 500 s, so that resampling does
    not use up its values. Otherwise as `RaoBlackwell`.
    """

    sampled = True
    least = 6000
    start_per_m2 = 2000.0


class RaoBlackwellIron(RaoBlackwell):
    """`RaoBlackwell` with two more linear states: hard iron c cos(yaw) + s sin(yaw), learned online."""

    iron = True


class RaoBlackwellNetwork(RaoBlackwellIron):
    """`RaoBlackwellIron` on readings less the predicted disturbance; its variance joins the white noise."""

    network = True


SLACK = 1.5
"""Surprise of a reading that is ignored."""

MOST_SURPRISE = 6.0
"""Most that one reading adds to the surprise: a step of the robot's own field is no kidnapping [nats]."""

OFF_M, OFF_SURPRISE = 0.25, 1.0
"""Distance from the floor beyond which a reading adds at least so much to the surprise [m, nats]: without a
map any reading fits."""

NEAR_M = 1.0
"""Distance from the last pose within which particles belong to it after an alarm [m]."""

KEPT = 1000
"""Particles that stay when the filter starts again, with half of the weight."""

RESET_ABOVE = 12.0
"""Sum of surprise at which the filter starts again."""

DOUBT_S = 5.0
"""Time after a start again for which the particles must stay together until the pose is trusted [s]."""


def _padded(count: int) -> int:
    """Columns of the state: not a multiple of a page, whose rows would compete for the same cache lines."""
    return -(-count // 8) * 8 + 8 * (1 + count // 8 % 2)


def _wrapped(angle: float) -> float:
    return angle - 2 * math.pi * math.floor(angle / (2 * math.pi) + 0.5)
