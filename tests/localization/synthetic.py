"""Synthetic drives on synthetic maps, and scores of tracks, for tests of localizers."""

import math
from dataclasses import dataclass

import numpy as np

from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_yaw
from magtwin.localization.problem import OdometryModel, Prior, Problem, SensorModel
from magtwin.localization.track import track
from magtwin.run.run import Run

UNKNOWN = Prior(sd=(math.inf, math.inf, math.inf))
SD = (0.1, 0.1, math.radians(5))
EXTENT = (-2.0, 2.0, -1.5, 1.5)


def tabulated(function, *, extent=EXTENT, cell=0.05, variance=None):
    """A map of a function of x and y, equal at all headings."""
    x0, x1, y0, y1 = extent
    columns, rows = round((x1 - x0) / cell) + 1, round((y1 - y0) / cell) + 1
    x, y = np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows))
    values = np.broadcast_to(function(x, y), (2, rows, columns))
    spread = None if variance is None else np.full(values.shape, float(variance))
    headings = np.array([0.0, math.pi])
    return AnomalyMap(
        values_nt=values,
        origin_m=(x0, y0),
        cell_m=(cell, cell),
        headings_rad=headings,
        variance_nt2=spread,
        name="synthetic",
    )


def linear_map(gx, gy, **options):
    return tabulated(lambda x, y: 40_000 + gx * x + gy * y, **options)


def waves(seed, *, sd=2000.0, length=0.5, waves=60):
    """A Gaussian random field as a sum of waves: its correlation is exp(-d^2 / (2 length^2))."""
    rng = np.random.default_rng(seed)
    k, phase = rng.standard_normal((waves, 2)) / length, rng.uniform(0, 2 * np.pi, waves)
    return lambda x, y: (
        sd
        * math.sqrt(2 / waves)
        * np.sum(np.cos(x[..., None] * k[:, 0] + y[..., None] * k[:, 1] + phase), -1)
    )


def wavy_map(seed=0, **options):
    field = waves(seed)
    return tabulated(lambda x, y: 41_000 + field(x, y), **options)


@dataclass
class Drive:
    problem: Problem
    readings: Run
    truth: np.ndarray


def drive(field, seed, *, seconds=40.0, rate=5.0, prior=None, sd=SD, odometry=None, sensor=None, margin=0.35):
    """A drive between random goals, with the errors of the models."""
    rng = np.random.default_rng((seed, 11))
    odometry, sensor = odometry or OdometryModel(), sensor or SensorModel()
    count, dt = round(seconds * rate), 1 / rate
    truth = wander(rng, field.extent, count, dt, margin)
    reckoned = dead_reckoned(rng, truth, odometry, dt)
    c, s = np.cos(truth[:, 2]), np.sin(truth[:, 2])
    lx, ly = sensor.lever_arm_m
    b = field.mean(truth[:, :2] + np.column_stack([c * lx - s * ly, s * lx + c * ly]), truth[:, 2])
    b = b + sensor.offset_nt * rng.standard_normal() + sensor.white_nt * rng.standard_normal(count)
    b = b + sensor.iron_nt * (rng.standard_normal() * c + rng.standard_normal() * s)
    keeps, drift = math.exp(-dt / sensor.drift_s), sensor.drift_nt * rng.standard_normal()
    for k in range(count):
        b[k] += drift
        drift = keeps * drift + sensor.drift_nt * math.sqrt(1 - keeps**2) * rng.standard_normal()
    if prior is None:
        prior = Prior(mean=tuple((truth[0] + np.array(sd) * rng.standard_normal(3)).tolist()), sd=sd)
    readings = Run(
        {
            "t": np.arange(count) * dt,
            "b_measured_nt": b,
            "odom_p": np.column_stack([reckoned[:, :2], np.zeros(count)]),
            "odom_q_xyzw": quat_from_yaw(reckoned[:, 2]),
        }
    )
    problem = Problem(
        belief=field, extent=field.extent, prior=prior, sensor=sensor, odometry=odometry, rate_hz=rate
    )
    return Drive(problem, readings, truth)


def wander(rng, extent, count, dt, margin):
    x0, x1, y0, y1 = extent
    low, high = np.array([x0, y0]) + margin, np.array([x1, y1]) - margin
    p, yaw, w, goal = rng.uniform(low, high), rng.uniform(-np.pi, np.pi), 0.0, rng.uniform(low, high)
    poses = np.empty((count, 3))
    for k in range(count):
        poses[k] = *p, yaw
        for _ in range(10):
            if math.dist(p, goal) < 0.25:
                goal = rng.uniform(low, high)
            error = (math.atan2(goal[1] - p[1], goal[0] - p[0]) - yaw + math.pi) % (2 * math.pi) - math.pi
            w += (max(-1.0, min(1.0, 2 * error)) - w) * dt / 3
            v = 0.2 * max(0.3, 1 - 0.6 * abs(w))
            yaw += w * dt / 10
            p = p + v * dt / 10 * np.array([math.cos(yaw), math.sin(yaw)])
    return poses


def dead_reckoned(rng, truth, model, dt):
    step = np.diff(truth, axis=0)
    middle = truth[:-1, 2] + step[:, 2] / 2
    c, s = np.cos(middle), np.sin(middle)
    forward, left, turn = c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0], step[:, 2]
    sd = np.sqrt(model.variances(np.hypot(forward, left), turn, dt))
    noise = sd * rng.standard_normal(sd.shape)
    scale = 1 + model.scale_std * rng.standard_normal()
    forward, left, turn = forward / scale + noise[:, 0], left / scale + noise[:, 1], turn + noise[:, 2]
    yaw = np.append(0.0, np.cumsum(turn))
    c, s = np.cos(yaw[:-1] + turn / 2), np.sin(yaw[:-1] + turn / 2)
    return np.column_stack(
        [
            np.append(0.0, np.cumsum(forward * c - left * s)),
            np.append(0.0, np.cumsum(forward * s + left * c)),
            yaw,
        ]
    )


@dataclass
class Score:
    error: np.ndarray  # of the place at each reading [m]
    nees: np.ndarray  # per state

    @property
    def rmse(self):
        return math.sqrt(np.mean(self.error**2))


def scored(algorithm, case):
    """The track of an algorithm and its errors."""
    made = track(algorithm, case.problem, case.readings)
    miss = made.pose - case.truth
    miss[:, 2] = (miss[:, 2] + np.pi) % (2 * np.pi) - np.pi
    nees = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(made.covariance), miss) / 3
    return made, Score(np.hypot(miss[:, 0], miss[:, 1]), nees)


def kalman(case, gradient, *, smooth=False):
    """Extended Kalman filter of x, y, yaw, offset and drift in a linear field; means and covariances.

    With `smooth`, the Rauch-Tung-Striebel smoother follows. Odometry has no scale error.
    """
    problem = case.problem
    sensor, model = problem.sensor, problem.odometry
    t, b = case.readings["t"], case.readings["b_measured_nt"]
    p = case.readings["odom_p"]
    yaw = np.unwrap(2 * np.arctan2(case.readings["odom_q_xyzw"][:, 2], case.readings["odom_q_xyzw"][:, 3]))
    x = np.array([*problem.prior.mean, 0.0, 0.0])
    cov = np.diag([*(s**2 for s in problem.prior.sd), sensor.offset_nt**2, sensor.drift_nt**2])
    h = np.array([*gradient, 0.0, 1.0, 1.0])
    means, covariances, forwards = [], [], []
    for k in range(len(t)):
        if k:
            turn, dt = yaw[k] - yaw[k - 1], t[k] - t[k - 1]
            distance = math.dist(p[k, :2], p[k - 1, :2])
            angle = x[2] - yaw[k - 1]
            c, s = math.cos(angle), math.sin(angle)
            step = np.array([[c, -s], [s, c]]) @ (p[k, :2] - p[k - 1, :2])
            f, keeps = np.eye(5), math.exp(-dt / sensor.drift_s)
            f[0, 2], f[1, 2], f[4, 4] = -step[1], step[0], keeps
            q = np.diag([*model.variances(distance, turn, dt), 0.0, (1 - keeps**2) * sensor.drift_nt**2])
            x = np.array([x[0] + step[0], x[1] + step[1], x[2] + turn, x[3], keeps * x[4]])
            cov = f @ cov @ f.T + q
            forwards.append((f, x.copy(), cov.copy()))
        if np.isfinite(b[k]):
            miss = b[k] - 40_000 - h @ x
            gain = cov @ h / (h @ cov @ h + sensor.white_nt**2)
            x, cov = x + gain * miss, cov - np.outer(gain, h @ cov)
        means.append(x)
        covariances.append(cov)
    if smooth:
        for k in range(len(t) - 2, -1, -1):
            f, predicted, spread = forwards[k]
            gain = covariances[k] @ f.T @ np.linalg.inv(spread)
            means[k] = means[k] + gain @ (means[k + 1] - predicted)
            covariances[k] = covariances[k] + gain @ (covariances[k + 1] - spread) @ gain.T
    return np.array(means), np.array(covariances)
