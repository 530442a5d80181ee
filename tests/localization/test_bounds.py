"""Bounds, against a Kalman filter and the joint Gaussian of a whole path, both written out plainly."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.localization.bounds import bounds
from magtwin.localization.problem import Prior, Problem, SensorModel


class Waves:
    """A field with gradients of some uT/m, and 150 nT of doubt that grows along x."""

    def mean(self, p, yaw):
        x, y = np.moveaxis(np.asarray(p, float), -1, 0)
        return 1000 * np.sin(3 * x) * np.cos(2 * y) + 300 * np.cos(yaw)

    def gradient(self, p, yaw):
        x, y = np.moveaxis(np.asarray(p, float), -1, 0)
        dx, dy = 3000 * np.cos(3 * x) * np.cos(2 * y), -2000 * np.sin(3 * x) * np.sin(2 * y)
        return np.stack([dx, dy, -300 * np.sin(yaw) + 0 * x], axis=-1)

    def variance(self, p, yaw):
        return (150 + 20 * np.asarray(p, float)[..., 0]) ** 2


class Slope(Waves):
    """A linear field, for which the bound is the covariance of the Kalman filter itself."""

    def gradient(self, p, yaw):
        return np.broadcast_to([4000.0, -2500.0, 0.0], (*np.shape(yaw), 3))


def problem(**changes):
    sensor = SensorModel(lever_arm_m=(-0.1, 0.05), iron_nt=400, drift_nt=80, drift_s=4)
    plain = Problem(
        belief=Waves(), extent=(-3, 3, -1.75, 1.75), sensor=sensor, prior=Prior(sd=(0.1, 0.2, 0.05))
    )
    return replace(plain, **changes)


def path(n=120, start=(0.4, -0.3), turn=0.05):
    t = 10 + np.arange(n) * 0.2 + 0.02 * np.sin(np.arange(n))
    yaw = 0.3 + turn * np.arange(n) + 0.3 * np.sin(np.arange(n) / 9)
    step = 0.04 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return np.column_stack([np.cumsum(step, axis=0) + start, yaw]), t


def kalman(problem, pose, t, field, *, extra=None, known=False, reading=True):
    """Covariance of x, y, yaw after each reading; the state is x, y, yaw, scale, offset, drift, c, s."""
    sensor, odometry = problem.sensor, problem.odometry
    rest = [0.0] * 4 if known else [sensor.offset_nt, sensor.drift_nt, sensor.iron_nt, sensor.iron_nt]
    P = np.diag(np.square([*problem.prior.sd, odometry.scale_std, *rest]))
    out = []
    for k in range(len(t)):
        if k:
            dx, dy, turn = pose[k] - pose[k - 1]
            dt = t[k] - t[k - 1]
            F = np.eye(8)
            F[0, 2], F[1, 2], F[0, 3], F[1, 3] = -dy, dx, dx, dy
            F[5, 5] = math.exp(-dt / sensor.drift_s)
            d = math.hypot(dx, dy)
            q_xy = odometry.position_std**2 * d + odometry.position_std_s**2 * dt
            q_yaw = odometry.yaw_std**2 * d + odometry.turn_std**2 * abs(turn) + odometry.yaw_std_s**2 * dt
            q_drift = 0.0 if known else sensor.drift_nt**2 * (1 - F[5, 5] ** 2)
            P = F @ P @ F.T + np.diag([q_xy, q_xy, q_yaw, 0, 0, q_drift, 0, 0])
        c, s = math.cos(pose[k, 2]), math.sin(pose[k, 2])
        arm = np.array([[c, -s], [s, c]]) @ sensor.lever_arm_m
        gx, gy, gyaw = field.gradient((pose[k, :2] + arm)[None], pose[k : k + 1, 2])[0]
        H = np.array([gx, gy, gyaw - gx * arm[1] + gy * arm[0], 0, 1, 1, c, s])
        R = sensor.white_nt**2 + (0 if extra is None else extra[k] ** 2)
        if reading is True or (reading is not False and reading[k]):
            P = P - np.outer(P @ H, H @ P) / (H @ P @ H + R)
        out.append(P[:3, :3])
    return np.array(out)


def root(P):
    return np.sqrt(P[:, 0, 0] + P[:, 1, 1])


@pytest.mark.parametrize("field", [Waves(), Slope()])
def test_bounds_are_the_covariance_of_a_kalman_filter_along_the_true_path(field):
    pose, t = path()
    plain = problem()
    made = bounds(plain, pose, t, field)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    at = pose[:, :2] + np.column_stack([-0.1 * c - 0.05 * s, -0.1 * s + 0.05 * c])
    sd = np.sqrt(Waves().variance(at, pose[:, 2]))
    assert_allclose(
        made.dead_reckoning, root(kalman(plain, pose, t, field, reading=False)), rtol=1e-7
    )  # rounding of positions of 1 m squared
    assert_allclose(made.exact, root(kalman(plain, pose, t, field)), rtol=1e-7)
    assert_allclose(made.white, root(kalman(plain, pose, t, field, extra=sd)), rtol=1e-7)
    assert_allclose(made.oracle, root(kalman(plain, pose, t, field, known=True)), rtol=1e-7)
    nearly = bounds(plain, pose, t, field, map_error_nt=0.0)
    heading = np.sqrt(kalman(plain, pose, t, field)[:, 2, 2])
    assert_allclose(nearly.heading, heading, rtol=1e-7)
    assert_allclose(nearly.correlated, made.exact, rtol=1e-7)


def test_correlated_and_smoothed_bounds_are_those_of_the_joint_gaussian_of_the_path():
    pose, t = path(60)
    plain = problem(map_length_m=0.25)
    sensor, odometry = plain.sensor, plain.odometry
    n = len(t)
    # Every pose error as a matrix times the independent errors: start and scale (4), then 3 a step
    roots = [np.array([*plain.prior.sd, odometry.scale_std])]
    maps = [np.zeros((3, 4 + 3 * (n - 1)))]
    maps[0][:, :3] = np.eye(3)
    for k in range(1, n):
        dx, dy, turn = pose[k] - pose[k - 1]
        step = maps[-1].copy()
        step[0] += -dy * maps[-1][2]
        step[1] += dx * maps[-1][2]
        step[0, 3] += dx
        step[1, 3] += dy
        step[:, 1 + 3 * k : 4 + 3 * k] = np.eye(3)
        maps.append(step)
        roots.append(np.sqrt(odometry.variances(math.hypot(dx, dy), turn, t[k] - t[k - 1])))
    prior = np.diag(np.concatenate(roots) ** 2)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.column_stack([-0.1 * c - 0.05 * s, -0.1 * s + 0.05 * c])
    at = pose[:, :2] + arm
    gradient = Waves().gradient(at, pose[:, 2])
    turned = gradient[:, 2] - gradient[:, 0] * arm[:, 1] + gradient[:, 1] * arm[:, 0]
    H = np.array(
        [gradient[k, 0] * maps[k][0] + gradient[k, 1] * maps[k][1] + turned[k] * maps[k][2] for k in range(n)]
    )
    S = H @ prior @ H.T + sensor.white_nt**2 * np.eye(n)
    for i in range(n):
        for j in range(n):
            S[i, j] += sensor.offset_nt**2 + sensor.iron_nt**2 * math.cos(pose[i, 2] - pose[j, 2])
            S[i, j] += sensor.drift_nt**2 * math.exp(-abs(t[i] - t[j]) / sensor.drift_s)
            far = math.dist(at[i], at[j])
            sd = (150 + 20 * at[i, 0]) * (150 + 20 * at[j, 0])
            S[i, j] += sd * math.exp(-(far**2) / (2 * 0.25**2))
    causal, smoothed = [], []
    for k in range(n):
        for last, out in ((k + 1, causal), (n, smoothed)):
            across = maps[k] @ prior @ H[:last].T
            left = maps[k] @ prior @ maps[k].T - across @ np.linalg.solve(S[:last, :last], across.T)
            out.append(left)
    made = bounds(plain, pose, t)
    assert_allclose(made.correlated, root(np.array(causal)), rtol=1e-6)
    assert_allclose(made.heading, np.sqrt(np.array(causal)[:, 2, 2]), rtol=1e-6)
    assert_allclose(made.smoothed, root(np.array(smoothed)), rtol=1e-6)


def test_readings_that_are_not_used_carry_no_information():
    pose, t = path()
    none = bounds(problem(), pose, t, used=np.zeros(len(t), bool))
    assert_allclose(none.correlated, none.dead_reckoning, rtol=1e-7)
    half = np.arange(len(t)) % 2 == 0
    some = bounds(problem(), pose, t, used=half)
    assert_allclose(some.exact, root(kalman(problem(), pose, t, Waves(), reading=half)), rtol=1e-7)


def test_after_a_kidnapping_the_pose_is_unknown_and_the_offset_is_not():
    pose, t = path()
    pose[60:, :2] += (0.8, -1.0)
    made = bounds(problem(), pose, t, kidnapped_s=(t[60],))
    assert made.dead_reckoning[60] == pytest.approx(math.hypot(6, 3.5) / math.sqrt(12), rel=1e-6)
    assert made.exact[59] < 0.3 < made.exact[60] < made.dead_reckoning[60]
    unknown = problem(prior=Prior(sd=(math.inf, math.inf, math.inf)))
    anew = bounds(unknown, pose[60:], t[60:])
    assert np.all(made.exact[60:] <= anew.exact * (1 + 1e-7))
    assert made.exact[70] < 0.99 * anew.exact[10]


def test_what_is_no_path_is_refused():
    pose, t = path()
    with pytest.raises(InputError, match="shape"):
        bounds(problem(), pose[:, :2], t)
    with pytest.raises(InputError, match="finite"):
        bounds(problem(), pose, t[::-1])
    with pytest.raises(InputError, match="no belief"):
        bounds(problem(belief=None), pose, t)
