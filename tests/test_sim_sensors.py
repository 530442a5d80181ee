"""The robot's sensors: rates, causality, statistics of noise, closed forms."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.frames import (
    IDENTITY_XYZW,
    quat_conjugate,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    rotate,
    yaw_from_quat,
)
from magtwin.names import RefusedError
from magtwin.sim.drive import Motion
from magtwin.sim.sensors import (
    charge,
    held,
    lidar_on,
    open_voltage,
    sense_battery,
    sense_imu,
    sense_magnetometer,
    sense_odometry,
)
from magtwin.spec import BatterySpec, DriveSpec, ImuSpec, LidarSpec, MagnetometerSpec

T = np.arange(135 * 60) / 135.0
CIRCLE = Motion(DriveSpec(), 0.02, np.full(3000, 0.2), np.full(3000, 0.5), (1.0, -1.0, 2.0))
QUIET = {"orientation_noise_std": 0.0, "gyro_noise_std": 0.0, "accel_noise_std": 0.0}


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def imu_of(spec: ImuSpec, motion: Motion, t, rng, q_base_imu_xyzw=IDENTITY_XYZW):
    return sense_imu(spec, q_base_imu_xyzw, motion, t, rng)


@given(rate=st.floats(0.01, 500), reading=st.floats(1, 500), count=st.integers(1, 500))
def test_a_held_sample_is_never_from_the_future_and_is_the_latest(rate, reading, count):
    t = np.arange(count) / reading
    stamps, latest = held(t, rate)
    assert np.all(stamps[latest] <= t)
    assert np.all((np.arange(len(stamps) + 1) / rate)[latest + 1] > t)
    assert_allclose(np.diff(stamps), 1 / rate, rtol=1e-9)
    assert latest[-1] == len(stamps) - 1


def test_each_sensor_changes_at_its_own_rate():
    t = np.arange(10_000) / 1000.0
    imu = imu_of(ImuSpec(), CIRCLE, t, generator())
    battery = sense_battery(BatterySpec(), t, generator())
    assert np.count_nonzero(np.diff(imu["imu_a"][:, 0])) == np.floor(9.999 * 62)
    assert np.count_nonzero(np.diff(battery["battery_v"])) == np.floor(9.999 * 0.5)


def test_odometry_without_error_is_the_motion_seen_from_its_start():
    drive = DriveSpec(odometry_noise_std=1e-12)
    motion = dataclasses.replace(CIRCLE, drive=drive)
    odometry = sense_odometry(motion, T, generator())
    stamps, latest = held(T, 62.0)
    still = dataclasses.replace(motion, pose0=(0.0, 0.0, 0.0)).at(stamps).pose[latest]
    assert_allclose(odometry["odom_p"][:, :2], still[:, :2], atol=1e-9)
    assert_allclose(np.cos(yaw_from_quat(odometry["odom_q_xyzw"]) - still[:, 2]), 1)
    assert_allclose(odometry["odom_p"][0], 0)
    assert_allclose(odometry["odom_q_xyzw"][0], [0, 0, 0, 1])
    moving = stamps[latest] < motion.duration_s
    assert_allclose(odometry["odom_v"][moving], [[0.2, 0, 0]] * moving.sum())
    assert_allclose(odometry["odom_w"][moving], [[0, 0, 0.5]] * moving.sum())


def test_odometry_drifts_by_the_wheels_errors():
    straight = Motion(DriveSpec(), 0.02, np.full(3000, 0.2), np.zeros(3000))
    odometry = sense_odometry(straight, T, generator(4))
    left, right = 1 + DriveSpec().odometry_noise_std * generator(4).standard_normal(2)
    w = 0.2 * (right - left) / 0.233
    assert_allclose(odometry["odom_w"][5], [0, 0, w])
    assert_allclose(odometry["odom_v"][5], [0.2 * (left + right) / 2, 0, 0])
    stamps, latest = held(T, 62.0)
    assert_allclose(yaw_from_quat(odometry["odom_q_xyzw"]), w * stamps[latest], atol=1e-9)


def test_odometry_errors_have_the_spread_of_the_spec():
    straight = Motion(DriveSpec(odometry_noise_std=0.02), 0.02, np.full(5, 0.2), np.zeros(5))
    t = np.array([0.0])
    rng = generator()
    v = [sense_odometry(straight, t, rng)["odom_v"][0, 0] for _ in range(2000)]
    # The mean of two wheels: 0.02 / sqrt 2; a spread from 2000 draws is known to 1.6 %.
    assert np.std(v) / 0.2 == pytest.approx(0.02 / np.sqrt(2), rel=0.06)


def test_an_imu_without_noise_reads_a_circles_rates_and_centripetal_acceleration():
    imu = imu_of(ImuSpec(**QUIET), CIRCLE, T[200:], generator())
    assert_allclose(imu["imu_w"], [[0, 0, 0.5]] * len(T[200:]))
    assert_allclose(imu["imu_a"], [[0, 0.2 * 0.5, 0]] * len(T[200:]), atol=1e-12)
    stamps, latest = held(T[200:], 62.0)
    yaw = CIRCLE.at(stamps).pose[latest, 2]
    assert_allclose(np.cos(yaw_from_quat(imu["imu_q_xyzw"]) - yaw), 1)


def test_forward_acceleration_is_the_change_of_speed():
    v = np.minimum(0.3, 0.4 * 0.02 * np.arange(1, 101))  # 0.4 m/s2 up to 0.3 m/s
    imu = imu_of(ImuSpec(**QUIET), Motion(DriveSpec(), 0.02, v, np.zeros(100)), T[:200], generator())
    assert_allclose(imu["imu_a"][:90, 0], 0.4, atol=1e-9)
    assert_allclose(imu["imu_a"][110:, 0], 0, atol=1e-9)


def test_an_imu_mounted_askew_reads_in_its_own_axes():
    upside_down = (1.0, 0.0, 0.0, 0.0)
    imu = imu_of(ImuSpec(**QUIET), CIRCLE, T[200:], generator(), upside_down)
    assert_allclose(imu["imu_w"], [[0, 0, -0.5]] * len(T[200:]), atol=1e-12)
    assert_allclose(imu["imu_a"], [[0, -0.1, 0]] * len(T[200:]), atol=1e-12)


def test_an_imus_noise_is_in_its_own_axes_however_it_is_mounted():
    askew = tuple(quat_from_rpy([0.3, -0.2, 1.0]).tolist())
    a, b = (imu_of(ImuSpec(), CIRCLE, T, generator(3), q) for q in (IDENTITY_XYZW, askew))
    clean_a, clean_b = (imu_of(ImuSpec(**QUIET), CIRCLE, T, generator(3), q) for q in (IDENTITY_XYZW, askew))
    for name in ("imu_w", "imu_a"):
        assert_allclose(rotate(np.array(askew), clean_b[name]), clean_a[name], atol=1e-12)
        assert_allclose(b[name] - clean_b[name], a[name] - clean_a[name], atol=1e-12)
    turn = quat_multiply(quat_conjugate(clean_a["imu_q_xyzw"]), clean_b["imu_q_xyzw"])
    assert_allclose(np.abs(turn @ np.array(askew)), 1, atol=1e-12)


def test_the_imus_quaternion_is_of_unit_length_with_w_not_below_0():
    q = imu_of(ImuSpec(), CIRCLE, T, generator())["imu_q_xyzw"]
    assert_allclose(np.linalg.norm(q, axis=1), 1)
    assert q[:, 3].min() >= 0
    assert np.ptp(yaw_from_quat(q)) > 6  # it did turn all the way round


def test_the_imus_noise_has_the_spread_of_its_spec_on_every_axis():
    t = np.arange(62 * 200) / 62.0
    still = Motion(DriveSpec(), 0.02, np.zeros(10), np.zeros(10), (0.0, 0.0, 1.0))
    spec = ImuSpec(orientation_noise_std=0.003, gyro_noise_std=0.02, accel_noise_std=0.3)
    imu = imu_of(spec, still, t, generator())
    off = quat_multiply(quat_conjugate(quat_from_yaw(1.0)), imu["imu_q_xyzw"])
    for noise, sd in ((2 * off[:, :3], 0.003), (imu["imu_w"], 0.02), (imu["imu_a"], 0.3)):
        assert_allclose(noise.std(axis=0), sd, rtol=0.04)  # 12,400 draws: 0.6 % is one sigma
        assert_allclose(noise.mean(axis=0), 0, atol=4 * sd / np.sqrt(len(t)))


def test_small_angles_of_the_orientation_are_roll_pitch_yaw_in_the_sensors_axes():
    spec = ImuSpec(orientation_noise_std=0.01)
    still = Motion(DriveSpec(), 0.02, np.zeros(10), np.zeros(10), (0.0, 0.0, -2.0))
    q = imu_of(spec, still, np.array([0.0]), generator(7))["imu_q_xyzw"][0]
    angles = 0.01 * generator(7).standard_normal(9)[:3]
    wanted = quat_multiply(quat_from_yaw(-2.0), quat_from_rpy(angles))
    assert_allclose(np.abs(q @ wanted), 1, atol=1e-14)


def test_charge_falls_by_load_over_capacity_an_hour_and_never_below_0():
    spec = BatterySpec(capacity_wh=26.0, load_w=13.0, initial_fraction=0.75)
    assert_allclose(charge(spec, [0.0, 3600.0, 5400.0, 1e6]), [0.75, 0.25, 0.0, 0.0])
    late = sense_battery(spec, np.array([0.0, 5401.0, 9000.0]), generator())
    assert_array_equal(late["battery_fraction"], [0.75, 0.0, 0.0])
    assert_allclose(late["battery_v"][1:], spec.voltage_empty_v, atol=0.1)


def test_voltage_follows_the_charge_with_gaussian_noise():
    spec = BatterySpec(rate_hz=10.0, voltage_noise_std_v=0.05)
    t = np.arange(20_000) / 10.0
    battery = sense_battery(spec, t, generator())
    noise = battery["battery_v"] - open_voltage(spec, battery["battery_fraction"])
    assert noise.std() == pytest.approx(0.05, rel=0.03)  # one sigma: 0.5 %
    assert noise.mean() == pytest.approx(0.0, abs=4 * 0.05 / np.sqrt(len(t)))
    assert_allclose(open_voltage(spec, [0.0, 1.0]), [spec.voltage_empty_v, spec.voltage_full_v])


def test_the_lidars_schedule_begins_off():
    spec = LidarSpec(off_s=40.0, on_s=20.0)
    assert_array_equal(
        lidar_on(spec, [0.0, 39.9, 40.0, 59.9, 60.0, 99.9, 100.0]),
        [False, False, True, True, False, False, True],
    )


def test_a_schedule_without_a_part_is_constant_and_modes_override_it():
    t = np.linspace(0, 200, 1001)
    assert not lidar_on(LidarSpec(on_s=0.0), t).any()
    assert lidar_on(LidarSpec(off_s=0.0), t).all()
    assert not lidar_on(LidarSpec(on_s=0.0, off_s=0.0), t).any()
    assert lidar_on(LidarSpec(), t, "on").all()
    assert not lidar_on(LidarSpec(), t, "off").any()
    with pytest.raises(RefusedError, match='must be "schedule", "on" or "off", got \'sometimes\''):
        lidar_on(LidarSpec(), t, "sometimes")  # type: ignore[arg-type]


def test_a_magnetometer_adds_its_noise_and_rounds_to_its_steps():
    spec = MagnetometerSpec(noise_std_nt=2.0, resolution_nt=0.5)
    b = np.full(50_000, 41_000.2)
    read = sense_magnetometer(spec, b, generator())["b_measured_nt"]
    assert_allclose(read % 0.5, 0, atol=1e-9)
    assert read.mean() == pytest.approx(41_000.2, abs=4 * 2 / np.sqrt(len(b)))
    assert read.std() == pytest.approx(np.hypot(2.0, 0.5 / np.sqrt(12)), rel=0.015)


def test_a_magnetometer_without_noise_or_steps_reads_the_field_and_nan_stays_nan():
    spec = MagnetometerSpec(noise_std_nt=0.0, resolution_nt=0.0)
    b = np.array([41_000.123456, np.nan])
    assert_array_equal(sense_magnetometer(spec, b, generator())["b_measured_nt"], b)


def test_a_longer_run_begins_with_the_noise_of_a_shorter_one():
    for sense in (
        lambda t: imu_of(ImuSpec(), CIRCLE, t, generator(1)),
        lambda t: sense_odometry(CIRCLE, t, generator(1)),
        lambda t: sense_battery(BatterySpec(), t, generator(1)),
        lambda t: sense_magnetometer(MagnetometerSpec(), np.zeros(len(t)), generator(1)),
    ):
        short, long = sense(T[:1000]), sense(T)
        for name, values in short.items():
            assert_array_equal(values, long[name][:1000])
