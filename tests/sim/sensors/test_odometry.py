"""Odometry: closed forms, drift by the wheels' errors and by slip, noise."""

import dataclasses

import numpy as np
from clocks import held
from numpy.testing import assert_allclose

from magtwin.frames import yaw_from_quat
from magtwin.sim.motion.drive import Motion
from magtwin.sim.sensors.odometry import Odometry
from magtwin.spec.drive import DriveSpec

T = np.arange(135 * 60) / 135.0
QUIET = DriveSpec(
    odometry_latency_s=0.0,
    odometry_jitter_s=0.0,
    odometry_noise_std=0.0,
    odometry_v_noise_std=(0.0, 0.0, 0.0),
    odometry_w_noise_std=(0.0, 0.0, 0.0),
)
CIRCLE = Motion(QUIET, 0.02, np.full(3000, 0.2), np.full(3000, 0.5), (1.0, -1.0, 2.0))
STRAIGHT = Motion(QUIET, 0.02, np.full(3000, 0.2), np.zeros(3000))


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_odometry_without_error_is_the_motion_seen_from_its_start():
    odometry = Odometry(QUIET, generator()).sense(CIRCLE, T)
    stamps, latest = held(T, 62.0)
    still = dataclasses.replace(CIRCLE, pose0=(0.0, 0.0, 0.0), poses=None).at(stamps).pose[latest]
    assert_allclose(odometry["odom_p"][:, :2], still[:, :2], atol=1e-9)
    assert_allclose(np.cos(yaw_from_quat(odometry["odom_q_xyzw"]) - still[:, 2]), 1)
    assert_allclose(odometry["odom_p"][0], 0)
    assert_allclose(odometry["odom_q_xyzw"][0], [0, 0, 0, 1])
    moving = (stamps[latest] > 0) & (stamps[latest] < CIRCLE.duration_s)
    assert_allclose(odometry["odom_v"][moving], [[0.2, 0, 0]] * moving.sum(), atol=1e-12)
    assert_allclose(odometry["odom_w"][moving], [[0, 0, 0.5]] * moving.sum(), atol=1e-12)


def test_the_twist_is_the_mean_one_since_the_last_sample():
    v = np.minimum(0.3, 0.3 * 0.02 * np.arange(3000))  # 0.3 m/s2 up to 0.3 m/s
    motion = Motion(QUIET, 0.02, v, np.zeros(3000))
    odometry = Odometry(QUIET, generator()).sense(motion, T)
    stamps, latest = held(T, 62.0)
    way = motion.at(np.maximum([stamps[latest], stamps[latest] - 1 / 62], 0).ravel()).pose[:, 0]
    assert_allclose(odometry["odom_v"][:, 0], (way[: len(T)] - way[len(T) :]) * 62, atol=1e-9)


def test_odometry_drifts_by_the_wheels_errors():
    drive = dataclasses.replace(QUIET, odometry_noise_std=0.002, odometry_scale=(1.01, 0.98))
    odometry = Odometry(drive, generator(4)).sense(STRAIGHT, T)
    left, right = np.array([1.01, 0.98]) * (1 + 0.002 * generator(4).standard_normal(2))
    w = 0.2 * (right - left) / 0.233
    stamps, latest = held(T, 62.0)
    moving = stamps[latest] > 0
    assert_allclose(odometry["odom_w"][moving][:100], [[0, 0, w]] * 100, atol=1e-12)
    assert_allclose(odometry["odom_v"][moving][:100], [[0.2 * (left + right) / 2, 0, 0]] * 100, atol=1e-12)
    assert_allclose(yaw_from_quat(odometry["odom_q_xyzw"]), w * stamps[latest], atol=1e-9)


def test_noise_of_the_twist_has_the_spread_of_each_axis_and_leaves_the_pose_alone():
    noisy = dataclasses.replace(
        QUIET, odometry_v_noise_std=(0.01, 0.02, 0.03), odometry_w_noise_std=(0.1, 0.2, 0.3)
    )
    t = np.arange(62 * 60) / 62.0
    a, b = (Odometry(drive, generator()).sense(CIRCLE, t) for drive in (QUIET, noisy))
    for name, sd in (("odom_v", [0.01, 0.02, 0.03]), ("odom_w", [0.1, 0.2, 0.3])):
        assert_allclose((b[name] - a[name]).std(axis=0), sd, rtol=0.06)  # 3,720 draws: 1.2 % is one sigma
    for name in ("odom_p", "odom_q_xyzw"):
        assert a[name].tobytes() == b[name].tobytes()
