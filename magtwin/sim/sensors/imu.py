"""IMU: orientation, rates and acceleration of a robot that rocks a little on its floor."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import canonical, quat_from_rpy, quat_multiply
from magtwin.sim.motion.sampling import Columns, Moving, axes_in_base, held, into_sensor, moment_at
from magtwin.sim.sensors.noise import gauss_markov, random_walk
from magtwin.spec.base import Quat
from magtwin.spec.sensors import ImuSpec

Array = NDArray[np.float64]


def sense_imu(
    spec: ImuSpec, q_base_imu_xyzw: Quat, motion: Moving, t: ArrayLike, rng: np.random.Generator
) -> Columns:
    """Orientation, rates and acceleration with gravity removed.

    In base_link w = (0, 0, yaw rate) and a = (dv/dt, v w, 0), both brought into the sensor's axes; the
    IMU is taken as being at base_link's origin. Then

    * rates: a bias that walks from `gyro_bias`, white noise, and vibration;
    * acceleration: white noise and vibration;
    * orientation: heading from the IMU's own zero, running away with the bias about base_link's z; the
      tilt with which the sensor is mounted, and a wandering one (first-order Gauss-Markov) from the floor
      and the casters; the error of what it takes for level, which does not turn with the robot; white noise
      as three small angles in the sensor's axes.

    Vibration is white and grows with the forward speed: a robot that stands does not shake. The tilt
    wanders too slowly to be seen in the rates.

    Args:
        spec: Rate, delays, zero, bias, tilt and noise.
        q_base_imu_xyzw: The sensor's axes in base_link, which its link and its mount there make.
        motion: What the robot did.
        t: Times of the readings [s], shape (N,).
        rng: Source of delays and noise.

    Returns:
        imu_q_xyzw (w >= 0), imu_w, imu_a at `rate_hz`, held.
    """
    delays, fast, slow = rng.spawn(3)
    stamps, latest = held(t, spec.rate_hz, latency_s=spec.latency_s, jitter_s=spec.jitter_s, rng=delays)
    true = moment_at(motion, stamps)
    zero = np.zeros(len(stamps))
    noise, wander = fast.standard_normal((len(stamps), 9)), slow.standard_normal((len(stamps), 5))
    shaking = np.abs(true.v)[:, None]

    bias = spec.gyro_bias + spec.gyro_bias_walk * random_walk(wander[:, :3], spec.rate_hz)
    rates = into_sensor(np.column_stack([zero, zero, true.w]), q_base_imu_xyzw) + bias
    rates += np.hypot(spec.gyro_noise_std, shaking * np.array(spec.gyro_vibration)) * noise[:, 3:6]
    acceleration = into_sensor(np.column_stack([true.a, true.v * true.w, zero]), q_base_imu_xyzw)
    acceleration += np.hypot(spec.accel_noise_std, shaking * np.array(spec.accel_vibration)) * noise[:, 6:]

    ran_away = np.cumsum(bias @ axes_in_base(q_base_imu_xyzw)[2]) / spec.rate_hz
    heading = true.pose[:, 2] - spec.yaw_zero + (ran_away - ran_away[0])
    tilt = spec.tilt + spec.tilt_std * gauss_markov(wander[:, 3:], spec.tilt_time_s, spec.rate_hz)
    q = quat_multiply(quat_from_rpy(np.column_stack([tilt, heading])), q_base_imu_xyzw)
    q = quat_multiply(quat_from_rpy([*spec.level_error, 0.0]), q)
    q = quat_multiply(q, quat_from_rpy(spec.orientation_noise_std * noise[:, :3]))
    return {
        "imu_q_xyzw": canonical(q).take(latest, axis=0),
        "imu_w": rates.take(latest, axis=0),
        "imu_a": acceleration.take(latest, axis=0),
    }
