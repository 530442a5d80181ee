"""IMU: closed forms of rates and acceleration, its zero, tilt, bias, vibration and noise."""

import numpy as np
from clocks import held
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.frames import (
    IDENTITY_XYZW,
    quat_conjugate,
    quat_from_yaw,
    quat_multiply,
    yaw_from_quat,
)
from magtwin.sim.motion.drive import Motion
from magtwin.sim.sensors.imu import Imu
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import ImuSpec

T = np.arange(135 * 60) / 135.0
CIRCLE = Motion(DriveSpec(), 0.02, np.full(3000, 0.2), np.full(3000, 0.5), (1.0, -1.0, 2.0))
STILL = Motion(DriveSpec(), 0.02, np.zeros(10), np.zeros(10), (0.0, 0.0, 1.0))
QUIET = {
    "latency_s": 0.0,
    "jitter_s": 0.0,
    "tilt": (0.0, 0.0),
    "level_error": (0.0, 0.0),
    "tilt_std": 0.0,
    "orientation_noise_std": 0.0,
    "gyro_noise_std": 0.0,
    "gyro_bias_walk": 0.0,
    "gyro_vibration": (0.0, 0.0, 0.0),
    "accel_noise_std": 0.0,
    "accel_vibration": (0.0, 0.0, 0.0),
}


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def imu_of(spec: ImuSpec, motion: Motion, t, rng, q_base_imu_xyzw=IDENTITY_XYZW):
    return Imu(spec, q_base_imu_xyzw, rng).sense(motion, t)


def test_an_imu_without_noise_reads_a_circles_rates_and_centripetal_acceleration():
    imu = imu_of(ImuSpec(**QUIET), CIRCLE, T[200:], generator())
    assert_allclose(imu["imu_w"], [[0, 0, 0.5]] * len(T[200:]))
    assert_allclose(imu["imu_a"], [[0, 0.2 * 0.5, 0]] * len(T[200:]), atol=1e-12)
    stamps, latest = held(T[200:], 62.0)
    yaw = CIRCLE.at(stamps).pose[latest, 2]
    assert_allclose(np.cos(yaw_from_quat(imu["imu_q_xyzw"]) - yaw), 1)


def test_the_imus_noise_has_the_spread_of_its_spec_on_every_axis():
    t = np.arange(62 * 200) / 62.0
    still = Motion(DriveSpec(), 0.02, np.zeros(10), np.zeros(10), (0.0, 0.0, 1.0))
    spec = ImuSpec(
        **{**QUIET, "orientation_noise_std": 0.003, "gyro_noise_std": 0.02, "accel_noise_std": 0.3}
    )
    imu = imu_of(spec, still, t, generator())
    off = quat_multiply(quat_conjugate(quat_from_yaw(1.0)), imu["imu_q_xyzw"])
    for noise, sd in ((2 * off[:, :3], 0.003), (imu["imu_w"], 0.02), (imu["imu_a"], 0.3)):
        assert_allclose(noise.std(axis=0), sd, rtol=0.04)  # 12,400 draws: 0.6 % is one sigma
        assert_allclose(noise.mean(axis=0), 0, atol=4 * sd / np.sqrt(len(t)))


def test_a_bias_is_read_on_every_axis_and_makes_yaw_run_away():
    imu = imu_of(ImuSpec(**QUIET, gyro_bias=(0.01, -0.02, 0.003)), STILL, T, generator())
    assert_allclose(imu["imu_w"], [[0.01, -0.02, 0.003]] * len(T))
    stamps, latest = held(T, 62.0)
    assert_allclose(yaw_from_quat(imu["imu_q_xyzw"]), 1.0 + 0.003 * stamps[latest], atol=1e-12)


def test_vibration_grows_with_the_speed_and_a_robot_that_stands_does_not_shake():
    spec = ImuSpec(**{**QUIET, "gyro_vibration": (0.1, 0.2, 0.3), "accel_vibration": (1.0, 2.0, 3.0)})
    t = np.arange(62 * 55) / 62.0
    still = imu_of(spec, STILL, t, generator())
    assert_array_equal(still["imu_w"], 0)
    assert_array_equal(still["imu_a"], 0)
    for speed in (0.1, 0.3):
        driving = Motion(DriveSpec(), 0.02, np.full(3000, speed), np.zeros(3000))
        imu = imu_of(spec, driving, t, generator())
        rows = t > 1
        assert_allclose(imu["imu_w"][rows].std(axis=0), speed * np.array([0.1, 0.2, 0.3]), rtol=0.06)
        assert_allclose(imu["imu_a"][rows].std(axis=0), speed * np.array([1.0, 2.0, 3.0]), rtol=0.06)
