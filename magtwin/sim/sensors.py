"""What the robot's sensors read: each `sense_` function gives columns of a Run.

A sensor samples at its own rate, at k / rate_hz, and its latest sample is held until the next one:
a reading of the magnetometer at time t sees the sample with the latest stamp that is not after t.
Noise is drawn sample by sample, so a longer run begins with the same numbers as a shorter one.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import (
    canonical,
    matrix_from_quat,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    wrap_angle,
)
from magtwin.names import RefusedError
from magtwin.sim.drive import Motion, twist_from_wheels, wheel_rates
from magtwin.spec import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, Quat

Array = NDArray[np.float64]
Columns = dict[str, NDArray[np.float64]]

SECONDS_PER_HOUR = 3600.0


def held(t: ArrayLike, rate_hz: float) -> tuple[Array, NDArray[np.intp]]:
    """The samples of a sensor that readings see, held causally.

    Args:
        t: Times of the readings, ascending from 0 or later [s], shape (N,), N >= 1.
        rate_hz: Samples a second [Hz].

    Returns:
        Stamps of the samples k / rate_hz up to the last reading [s], shape (M,); and for each reading
        the index of the latest sample that is not after it, shape (N,).
    """
    t = np.asarray(t, float)
    stamps = np.arange(int(t[-1] * rate_hz) + 2) / rate_hz
    stamps = stamps[: int(np.searchsorted(stamps, t[-1], side="right"))]
    return stamps, np.searchsorted(stamps, t, side="right") - 1


def into_sensor(v_base: Array, q_base_sensor_xyzw: Quat) -> Array:
    """Vectors (N, 3) turned from base_link's axes into those of a sensor."""
    # einsum, as a product of so few columns is no work for the threads of a BLAS that `@` wakes.
    return np.einsum("ni,ij->nj", v_base, matrix_from_quat(q_base_sensor_xyzw))


def sense_odometry(motion: Motion, t: ArrayLike, rng: np.random.Generator) -> Columns:
    """Wheel odometry, in a frame of its own that begins at the robot's first pose.

    Each wheel's travel is off by a factor 1 + e, e drawn once a run with the drive's
    `odometry_noise_std`: so the estimate drifts as that of a robot with worn wheels does.

    Args:
        motion: What the robot did, and with which drive.
        t: Times of the readings [s], shape (N,).
        rng: Source of the two factors.

    Returns:
        odom_p, odom_q_xyzw, odom_v, odom_w at `odometry_rate_hz`, held.
    """
    drive = motion.drive
    factors = 1.0 + drive.odometry_noise_std * rng.standard_normal(2)
    v, w = twist_from_wheels(wheel_rates(motion.v, motion.w, drive) * factors, drive)
    stamps, latest = held(t, drive.odometry_rate_hz)
    seen = Motion(drive, motion.dt, v, w).at(stamps)
    zero = np.zeros(len(stamps))
    return {
        "odom_p": np.column_stack([seen.pose[:, :2], zero])[latest],
        "odom_q_xyzw": quat_from_yaw(wrap_angle(seen.pose[:, 2]))[latest],
        "odom_v": np.column_stack([seen.v, zero, zero])[latest],
        "odom_w": np.column_stack([zero, zero, seen.w])[latest],
    }


def sense_imu(
    spec: ImuSpec, q_base_imu_xyzw: Quat, motion: Motion, t: ArrayLike, rng: np.random.Generator
) -> Columns:
    """Orientation, rates and acceleration with gravity removed, of a robot on a level floor.

    a = (dv/dt, v w, 0) and w = (0, 0, w) in base_link, brought into the sensor's axes; then white
    noise on each axis, for the orientation as three small angles in the sensor's axes. The IMU is
    taken as being at base_link's origin.

    Args:
        spec: Rate and noise.
        q_base_imu_xyzw: The sensor's axes in base_link, which its link and its mount there make.
        motion: What the robot did.
        t: Times of the readings [s], shape (N,).
        rng: Source of noise.

    Returns:
        imu_q_xyzw (w >= 0), imu_w, imu_a at `rate_hz`, held.
    """
    stamps, latest = held(t, spec.rate_hz)
    true = motion.at(stamps)
    zero = np.zeros(len(stamps))
    noise = rng.standard_normal((len(stamps), 9))
    rates = into_sensor(np.column_stack([zero, zero, true.w]), q_base_imu_xyzw)
    acceleration = into_sensor(np.column_stack([true.a, true.v * true.w, zero]), q_base_imu_xyzw)
    q = quat_multiply(quat_from_yaw(true.pose[:, 2]), q_base_imu_xyzw)
    q = quat_multiply(q, quat_from_rpy(spec.orientation_noise_std * noise[:, :3]))
    return {
        "imu_q_xyzw": canonical(q)[latest],
        "imu_w": (rates + spec.gyro_noise_std * noise[:, 3:6])[latest],
        "imu_a": (acceleration + spec.accel_noise_std * noise[:, 6:])[latest],
    }


def charge(spec: BatterySpec, t: ArrayLike) -> Array:
    """Charge left, 0 to 1, after a time `t` [s] of a constant load: f0 - P t / E, not below 0."""
    spent = spec.load_w * np.asarray(t, float) / (spec.capacity_wh * SECONDS_PER_HOUR)
    return np.clip(spec.initial_fraction - spent, 0.0, 1.0)


def open_voltage(spec: BatterySpec, fraction: ArrayLike) -> Array:
    """Mean voltage at a charge [V]: linear between empty and full."""
    return spec.voltage_empty_v + (spec.voltage_full_v - spec.voltage_empty_v) * np.asarray(fraction, float)


def sense_battery(spec: BatterySpec, t: ArrayLike, rng: np.random.Generator) -> Columns:
    """Charge that falls linearly, and a voltage that follows it with Gaussian noise.

    Args:
        spec: Pack, load, rate and noise.
        t: Times of the readings [s], shape (N,).
        rng: Source of noise.

    Returns:
        battery_v, battery_fraction at `rate_hz`, held.
    """
    stamps, latest = held(t, spec.rate_hz)
    fraction = charge(spec, stamps)
    noise = spec.voltage_noise_std_v * rng.standard_normal(len(stamps))
    voltage = open_voltage(spec, fraction) + noise
    return {"battery_v": voltage[latest], "battery_fraction": fraction[latest]}


def lidar_on(
    spec: LidarSpec, t: ArrayLike, mode: Literal["schedule", "on", "off"] = "schedule"
) -> NDArray[np.bool_]:
    """Whether the LiDAR spins at times `t` [s], shape (...).

    Args:
        spec: The schedule: off for off_s, then on for on_s, and again.
        t: Times since the start [s].
        mode: "schedule", or always "on" or "off".

    Raises:
        RefusedError: `mode` is none of these.
    """
    t = np.asarray(t, float)
    if mode == "schedule":
        cycle = spec.on_s + spec.off_s
        if spec.on_s == 0:
            return np.zeros(t.shape, bool)
        return t % cycle >= spec.off_s
    if mode not in ("on", "off"):
        raise RefusedError(f'lidar must be "schedule", "on" or "off", got {mode!r}')
    return np.full(t.shape, mode == "on")


def sense_magnetometer(spec: MagnetometerSpec, b_total_nt: ArrayLike, rng: np.random.Generator) -> Columns:
    """What a scalar magnetometer makes of a field: white noise, then the nearest of its steps.

    Args:
        spec: Noise and resolution.
        b_total_nt: Field magnitude at each reading [nT], shape (N,); nan stays nan.
        rng: Source of noise.

    Returns:
        b_measured_nt.
    """
    b = np.asarray(b_total_nt, float)
    b = b + spec.noise_std_nt * rng.standard_normal(b.shape)
    if spec.resolution_nt > 0:
        b = np.rint(b / spec.resolution_nt) * spec.resolution_nt
    return {"b_measured_nt": b}
