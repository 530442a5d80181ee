"""The SLAM methods: against a plain filter, on a simulated drive, and with readings that are missing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oval import LENGTH_M, SD_NT, oval

from magtwin.errors import InputError
from magtwin.localization.localizers import load_localizer
from magtwin.localization.slam import incremental_slam
from magtwin.localization.slam.hilbert import basis
from magtwin.localization.track import track

OPTIONS = {"functions": 60, "length_m": LENGTH_M, "sd_nt": SD_NT, "vertical_std_s": 1e-3, "tilt_std_s": 1e-3}
METHODS, EKF = ("incremental-slam", "slam-smoother"), {"every": 10**9}


def rmse(made, truth):
    return float(np.sqrt(((made.pose[:, :2] - truth[:, :2]) ** 2).sum(axis=1).mean()))


def plain_filter(problem, run, functions, variances, uniform_sd):
    """EKF-SLAM on the magnitude, written out: state x, y, yaw, uniform field, weights."""
    size = 4 + functions.count
    x = np.concatenate([problem.prior.mean, np.zeros(size - 3)])
    cov = np.diag(np.concatenate([np.square(problem.prior.sd), [uniform_sd**2], variances]))
    p = run["odom_p"]
    q = run["odom_q_xyzw"]
    yaw = np.unwrap(2 * np.arctan2(q[:, 2], q[:, 3]))
    poses, covariances = [], []
    for k in range(run.rows):
        if k:
            dx, dy = p[k, :2] - p[k - 1, :2]
            c, s = math.cos(yaw[k - 1]), math.sin(yaw[k - 1])
            forward, left, turn = dx * c + dy * s, dy * c - dx * s, yaw[k] - yaw[k - 1]
            c, s = math.cos(x[2]), math.sin(x[2])
            ux, uy = forward * c - left * s, forward * s + left * c
            f = np.eye(size)
            f[0, 2], f[1, 2] = -uy, ux
            x[:3] += ux, uy, turn
            dt = run["t"][k] - run["t"][k - 1]
            noise = np.zeros(size)
            noise[:2] = problem.odometry.position_std_s**2 * dt
            noise[2] = problem.odometry.yaw_std_s**2 * dt
            cov = f @ cov @ f.T + np.diag(noise)
        h = np.zeros(size)
        h[:2] = functions.gradients(x[:2]) @ x[4:]
        h[3:] = np.concatenate([[1.0], functions.values(x[:2])])
        gain = cov @ h / (h @ cov @ h + problem.sensor.white_nt**2)
        x = x + gain * (run["b_measured_nt"][k] - h[3:] @ x[3:])
        cov = (np.eye(size) - np.outer(gain, h)) @ cov
        poses.append(x[:3].copy())
        covariances.append(cov[:3, :3].copy())
    return np.array(poses), np.array(covariances)


def test_the_filter_equals_a_plain_loop_on_the_magnitude():
    problem, run, _ = oval(rows=120, vector=False)
    made = track(load_localizer("incremental-slam", OPTIONS | EKF), problem, run)
    functions = basis([-2.5, -1.9], [2.5, 1.9], 60)
    variances = functions.variances(sd=SD_NT, length_m=LENGTH_M)
    poses, covariances = plain_filter(problem, run, functions, variances, math.hypot(50_000, 600))
    turned = np.angle(np.exp(1j * (made.pose[:, 2] - poses[:, 2])))
    assert_allclose(made.pose[:, :2], poses[:, :2], atol=1e-7)
    assert_allclose(turned, 0, atol=1e-7)
    assert_allclose(made.covariance, covariances, atol=1e-5 * covariances.max())


@pytest.mark.parametrize(
    ("method", "share", "most_anees"),
    [("incremental-slam", 0.6, 2.5), ("slam-smoother", 0.45, 2.0)],
)
@pytest.mark.parametrize("vector", [True, False])
def test_every_method_beats_dead_reckoning_and_states_its_error(method, share, most_anees, vector):
    errors, reckoned, nees = [], [], []
    for seed in range(3):
        problem, run, truth = oval(seed=seed, vector=vector)
        made = track(load_localizer(method, OPTIONS), problem, run)
        errors.append(rmse(made, truth))
        reckoned.append(rmse(track(load_localizer("odometry"), problem, run), truth))
        error = (made.pose - truth)[1:]
        error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(made.covariance[1:]), error).mean() / 3)
    assert np.mean(errors) < share * np.mean(reckoned)
    assert 0.2 < np.mean(nees) < most_anees


def test_the_incremental_estimate_uses_no_later_reading(monkeypatch):
    problem, run, _ = oval(rows=100)
    options = OPTIONS | {"every": 7}
    monkeypatch.setattr(incremental_slam, "RESTART", 20)
    whole = track(load_localizer("incremental-slam", options), problem, run)
    part = track(load_localizer("incremental-slam", options), problem, run.take(slice(0, 50)))
    assert_allclose(part.pose, whole.pose[:50], rtol=0, atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_missing_readings_and_a_single_reading_are_survived(method):
    problem, run, _ = oval(rows=60)
    b = np.array(run["b_vector_measured_nt"])
    b[10:20] = np.nan
    made = track(load_localizer(method, OPTIONS), problem, run.with_columns(b_vector_measured_nt=b))
    assert np.isfinite(made.pose).all()
    alone = track(load_localizer(method, OPTIONS), problem, run.take(slice(0, 1)))
    assert_allclose(alone.pose[0, :2], problem.prior.mean[:2], atol=5e-3)


def test_a_magnitude_with_iron_and_drift_is_calibrated():
    problem, run, truth = oval(vector=False)
    sensor = replace(problem.sensor, drift_nt=100.0, drift_s=5.0, iron_nt=1_000.0)
    swung = run["b_measured_nt"] + 1_500 * np.cos(truth[:, 2]) - 900 * np.sin(truth[:, 2])
    run, problem = run.with_columns(b_measured_nt=swung), replace(problem, sensor=sensor)
    method = load_localizer("slam-smoother", OPTIONS)
    assert np.isfinite(track(method, problem, run).bias_nt).all()
    assert_allclose(method.state.g[method.model.layout.iron], [1_500, -900], atol=900)  # prior: 1,000


@pytest.mark.parametrize(
    ("method", "option"), [("incremental-slam", {"every": 0}), ("slam-smoother", {"starts": 3})]
)
def test_wrong_options_are_refused(method, option):
    with pytest.raises(InputError, match=next(iter(option))):
        load_localizer(method, option)
