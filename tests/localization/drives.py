"""Synthetic fields and drives with known noise, for the tests of localizers."""

import math

import numpy as np

from magtwin.bench.draws import chained, moves
from magtwin.field.maps.map import AnomalyMap
from magtwin.localization.problem import OdometryModel, Prior, Problem, Reading, SensorModel

EXTENT = (-3.0, 3.0, -2.0, 2.0)


def rough_map(seed=0, *, sd_nt=3000.0, length_m=0.6, variance_nt2=None, headings=8):
    """A field of random plane waves, with a heading effect, at nodes 5 cm apart."""
    rng = np.random.default_rng(seed)
    x, y = np.arange(-60, 61) * 0.05, np.arange(-40, 41) * 0.05
    yaw = np.arange(headings) * 2 * np.pi / headings
    k = rng.standard_normal((60, 2)) / length_m
    phase = rng.uniform(0, 2 * np.pi, 60)
    gx, gy = np.meshgrid(x, y)
    waves = np.cos(k[:, 0, None, None] * gx + k[:, 1, None, None] * gy + phase[:, None, None])
    values = 40_000 + sd_nt * math.sqrt(2 / 60) * waves.sum(axis=0) + 200 * np.cos(yaw)[:, None, None]
    variance = None if variance_nt2 is None else np.full(values.shape, variance_nt2)
    return AnomalyMap(
        values_nt=values,
        origin_m=(-3.0, -2.0),
        cell_m=(0.05, 0.05),
        headings_rad=yaw,
        variance_nt2=variance,
    )


def flat_map():
    return AnomalyMap(
        values_nt=np.full((1, 2, 2), 40_000.0), origin_m=(-50, -50), cell_m=(100, 100), headings_rad=[0.0]
    )


def circle(count, *, speed=0.25, dt=0.2, radius=1.2, start=0.0):
    """Poses on an ellipse within the map, shape (N, 3)."""
    u = start + np.arange(count) * speed * dt / radius
    x, y = 1.5 * radius * np.cos(u), radius * np.sin(u)
    yaw = np.unwrap(np.arctan2(radius * np.cos(u), -1.5 * radius * np.sin(u)))
    return np.column_stack([x, y, yaw])


def drive(field, pose, seed=0, *, sensor=None, odometry=None, prior_sd=(0.1, 0.1, 0.05), belief=None, dt=0.2):
    """A problem and the readings of a drive along poses, with the noise of the models."""
    rng = np.random.default_rng(seed)
    sensor, odometry = sensor or SensorModel(), odometry or OdometryModel()
    t = dt * np.arange(len(pose))
    steps = moves(pose)
    sd = np.sqrt(odometry.variances(np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2], dt))
    noise = sd * rng.standard_normal(steps.shape)
    steps[:, :2] /= 1 + odometry.scale_std * rng.standard_normal()
    odom = chained(steps + noise)
    keep = math.exp(-dt / sensor.drift_s)
    drift = sensor.drift_nt * rng.standard_normal(len(t))
    for k in range(1, len(t)):
        drift[k] = keep * drift[k - 1] + math.sqrt(1 - keep**2) * drift[k]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    ax, ay = sensor.lever_arm_m
    p = pose[:, :2] + np.column_stack([ax * c - ay * s, ax * s + ay * c])
    iron = sensor.iron_nt * rng.standard_normal(2)
    b = field.lookup(p, pose[:, 2], outside="clamp") + iron[0] * c + iron[1] * s + drift
    b += sensor.offset_nt * rng.standard_normal() + sensor.white_nt * rng.standard_normal(len(t))
    mean = pose[0] + np.where(np.isfinite(prior_sd), prior_sd, 0.0) * rng.standard_normal(3)
    problem = Problem(
        belief=belief or field,
        extent=EXTENT,
        prior=Prior(mean=tuple(mean.tolist()), sd=tuple(prior_sd)),
        sensor=sensor,
        odometry=odometry,
        seed=seed,
    )
    rows = zip(t.tolist(), b.tolist(), odom.tolist(), strict=True)
    return problem, [Reading(time, field_nt, tuple(at)) for time, field_nt, at in rows]


def estimates(algorithm, problem, readings):
    algorithm.reset(problem)
    return [algorithm.step(reading) for reading in readings]


def poses(made):
    return np.array([(e.x, e.y, e.yaw) for e in made])


def squared_errors(made, pose):
    """Normalised squared errors of x, y, yaw, shape (N,)."""
    off = poses(made) - pose
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv([e.covariance for e in made]), off)
