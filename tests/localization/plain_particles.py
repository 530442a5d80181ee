"""The particle filter of `magtwin.localization.particles` in plain numpy, for tests and benchmarks."""

import math

import numpy as np

from magtwin.localization.odometry import increment
from magtwin.localization.problem import Estimate

GOLDEN = 0x9E3779B97F4A7C15
WORD = (1 << 64) - 1


def mixed(z):
    """splitmix64's finalizer, uint64 (...)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def hashed_normals(key, draw, count):
    """Two standard normal numbers per particle, as the compiled filter draws them, shapes (count,)."""
    start = key + int(mixed(np.array([(draw * GOLDEN) & WORD], np.uint64))[0])
    z = mixed(np.uint64(start & WORD) + np.arange(count, dtype=np.uint64) * np.uint64(GOLDEN))
    high, low = (z >> np.uint64(32)).astype(float), (z & np.uint64(0xFFFFFFFF)).astype(float)
    radius, turn = np.sqrt(-2 * np.log(1 - high / 2**32)), 2 * np.pi * (low / 2**32 - 0.5)
    return radius * np.cos(turn), radius * np.sin(turn)


class PlainFilter:
    """A filter that starts from the particles of a compiled one and does the same in numpy.

    Args:
        compiled: A filter after `reset`.
        hashed: Draw the same random numbers as it; else those of numpy's generator.
    """

    def __init__(self, compiled, *, hashed):
        k = compiled._loops
        n, size = compiled._count, len(compiled._kinds)
        self.hashed, self.rng = hashed, np.random.default_rng(1)
        self.problem, self.kinds, self.k = compiled._problem, compiled._kinds, k
        self.map = self.problem.belief
        self.seed, self.steps, self.uniform = compiled._seed, 0, compiled._rng.random
        self.x, self.y, self.yaw, self.scale = (row.copy() for row in compiled._state[:4, :n])
        self.mean = compiled._state[k.LINEAR : k.LINEAR + size, :n].copy()
        self.p = np.zeros((size, size, n))
        for i in range(size):
            for j in range(i + 1):
                row = compiled._state[k.LINEAR + size + i * (i + 1) // 2 + j, :n]
                self.p[i, j] = self.p[j, i] = row
        self.log_w = np.full(n, -math.log(n))
        self.sampled, self.kappa, self.least = compiled.sampled, compiled._kappa, compiled.least
        self.variances, self.rates = compiled._prior_variances, compiled._rates
        self.map_white = compiled._map_white
        self.elsewhere = compiled._field_mean, compiled._field_variance
        self.scale_variance = self.problem.odometry.scale_std**2
        self.last = None

    def normals(self, draw):
        if not self.hashed:
            return self.rng.standard_normal(len(self.x)), self.rng.standard_normal(len(self.x))
        key = (self.seed + self.steps * GOLDEN * 0x2545F4914F6CDD1D) & WORD
        return hashed_normals(key, draw, len(self.x))

    def step(self, reading):
        self.steps += 1
        forward = left = turn = dt = 0.0
        if self.last is not None:
            forward, left, turn = increment(self.last.odometry, reading.odometry)
            dt = reading.t - self.last.t
        self.last = reading
        distance = math.hypot(forward, left)
        decay = np.exp(-dt * self.rates[0] - distance * self.rates[1])
        self.move(distance, math.atan2(left, forward), turn, dt)
        noise = self.variances * (1 - decay**2)
        self.mean *= decay[:, None]
        if self.sampled:
            for i in np.flatnonzero(noise).tolist():
                self.mean[i] += math.sqrt(noise[i]) * self.normals(2 + i)[0]
        else:
            self.p *= np.outer(decay, decay)[:, :, None]
            self.p[np.arange(len(decay)), np.arange(len(decay))] += noise[:, None]
        if math.isfinite(reading.b_nt):
            self.weigh(reading.b_nt)
        estimate = self.estimate(reading.t)
        spread = math.sqrt(estimate.covariance[0, 0] + estimate.covariance[1, 1])
        count = len(self.x)
        enough = int(self.least * min(max(spread / 0.06, 1.0), 5.0))
        wanted = min(count, max(enough, int(0.95 * count))) if spread < 0.5 else count
        if wanted < count or 1 / np.sum(self.w**2) < count / 2:
            self.resample(wanted)
        return estimate

    def move(self, distance, direction, turn, dt):
        model = self.problem.odometry
        across, _, yaw = model.variances(distance, turn, dt)
        along = across + distance**2 * self.scale_variance
        gain = distance * self.scale_variance / along if along > 0 else 0.0
        least = (0.1 * model.scale_std) ** 2
        self.scale_variance = max(self.scale_variance * (1 - gain * distance), least)
        e1, e2 = self.normals(0)
        e3 = self.normals(1)[0] if self.hashed else self.rng.standard_normal(len(self.x))
        way = self.yaw + (turn / 2 + direction)
        c, s = np.cos(way), np.sin(way)
        e1, e2 = e1 * math.sqrt(along), e2 * math.sqrt(across)
        far = distance * (1 + self.scale) + e1
        self.x += far * c - e2 * s
        self.y += far * s + e2 * c
        self.yaw += turn + math.sqrt(yaw) * e3
        self.scale += gain * e1

    def weigh(self, b_nt):
        k, sensor = self.k, self.problem.sensor
        ax, ay = sensor.lever_arm_m
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        p = np.column_stack([self.x + ax * c - ay * s, self.y + ax * s + ay * c])
        if self.map.variance_nt2 is None:
            field, v = self.map.lookup(p, self.yaw), np.zeros(len(p))
        else:
            field, sd = self.map.lookup_with_sd(p, self.yaw)
            v = sd**2
        known = np.isfinite(field)
        v = np.where(known, v, 0.0)
        white = sensor.white_nt**2 + np.where(known, self.map_white * v, self.elsewhere[1])
        h = np.ones_like(self.mean)
        for i, kind in enumerate(self.kinds):
            if kind not in (k.CONSTANT, k.DRIFT):
                h[i] = {k.COSINE: c, k.SINE: s, k.MAP_SD: np.sqrt(v)}[kind]
        nu = b_nt - np.where(known, field, self.elsewhere[0]) - np.sum(h * self.mean, axis=0)
        gain = np.einsum("ijn,jn->in", self.p, h)
        total = np.sum(gain * h, axis=0) + white
        self.log_w += -0.5 * (nu**2 / total + np.log(total)) / self.kappa
        if not self.sampled:
            self.mean += gain * (nu / total)
            self.p -= gain[:, None] * (gain / total)

    def estimate(self, t):
        w = np.exp(self.log_w - self.log_w.max())
        self.log_w -= self.log_w.max() + math.log(w.sum())
        self.w = w = w / w.sum()
        yaw = math.atan2(w @ np.sin(self.yaw), w @ np.cos(self.yaw))
        x, y = float(w @ self.x), float(w @ self.y)
        a = self.yaw - yaw
        d = np.stack([self.x - x, self.y - y, a - 2 * np.pi * np.floor(a / (2 * np.pi) + 0.5)])
        d -= (d @ w)[:, None]
        return Estimate(t, x, y, yaw, (w * d) @ d.T, float(w @ self.mean[0]))

    def resample(self, count):
        below = np.cumsum(self.w)
        chosen = np.searchsorted(below / below[-1] * count - self.uniform(), np.arange(count), side="right")
        chosen = np.minimum(chosen, len(self.x) - 1)
        for name in ("x", "y", "yaw", "scale"):
            setattr(self, name, getattr(self, name)[chosen])
        self.mean, self.p = self.mean[:, chosen], self.p[:, :, chosen]
        self.log_w = np.full(count, -math.log(count))
