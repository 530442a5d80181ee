"""IMU: orientation, rates and acceleration of a robot that rocks a little on its floor."""

from typing import Any

import numpy as np

from magtwin.frames import canonical, quat_from_rpy, quat_multiply
from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.sampling import axes_in_base, into_sensor
from magtwin.sim.sensors.clock import Array, Columns, SampleClock, SampledSensor
from magtwin.sim.sensors.noise import accumulate, gauss_markov, random_walk
from magtwin.spec.base import Quat
from magtwin.spec.sensors import ImuSpec


class Imu(SampledSensor):
    """Orientation, rates and acceleration with gravity removed.

    In base_link w = (0, 0, yaw rate) and a = (dv/dt, v w, 0). Both are turned into the sensor's axes; the IMU
    is taken to be at base_link's origin. Then

    * rates have a bias that walks from `gyro_bias`, white noise, and vibration;
    * acceleration has white noise and vibration;
    * orientation has the heading from the IMU's own zero, which drifts with the bias about base_link's z; the
      tilt of the mount and a wandering tilt (first-order Gauss-Markov) from the floor and the casters; the
      error of the IMU's level, which does not turn with the robot; and white noise, three small angles in the
      sensor's axes.

    Vibration is white and grows with the forward speed. The tilt wanders too slowly to be seen in the rates.
    Columns: imu_q_xyzw (w >= 0), imu_w, imu_a.
    """

    def __init__(
        self,
        spec: ImuSpec,
        q_base_imu_xyzw: Quat,
        rng: np.random.Generator,
        *,
        rate_hz: float | None = None,
    ) -> None:
        """Switch the sensor on."""
        delays, noise = rng.spawn(2)
        start: Any = {"tilt": noise.standard_normal(2), "bias": spec.gyro_bias, "yaw_zero": spec.yaw_zero}
        super().__init__(noise, walk=np.zeros(3), drift=0.0, **start)
        self._spec, self._q_base_imu = spec, q_base_imu_xyzw
        self._rate = spec.rate_hz if rate_hz is None else rate_hz
        self.clock = SampleClock(self._rate, spec.latency_s, spec.jitter_s, delays)

    def sample(self, stamps: Array, now: Moment) -> Columns:
        """As for `SampledSensor`."""
        spec, state, q_base_imu = self._spec, self.state, self._q_base_imu
        white = self.normal(len(stamps), 14)
        zero, shaking = np.zeros(now.v.shape), np.abs(now.v)[..., None]
        walk, state["walk"] = random_walk(white[..., 9:12], state["walk"], self._rate)
        bias = state["bias"] + spec.gyro_bias_walk * walk
        rates = into_sensor(np.stack([zero, zero, now.w], axis=-1), q_base_imu) + bias
        rates += np.hypot(spec.gyro_noise_std, shaking * np.array(spec.gyro_vibration)) * white[..., 3:6]
        acceleration = into_sensor(np.stack([now.a, now.v * now.w, zero], axis=-1), q_base_imu)
        shaken = np.hypot(spec.accel_noise_std, shaking * np.array(spec.accel_vibration))
        acceleration += shaken * white[..., 6:9]
        along_z = np.sum(bias * axes_in_base(tuple(q_base_imu))[2], axis=-1)
        drift = accumulate(state["drift"], along_z / self._rate)
        state["drift"] = drift[-1]
        heading = now.pose[..., 2] - state["yaw_zero"] + drift[:-1]
        tilt, state["tilt"] = gauss_markov(white[..., 12:14], state["tilt"], spec.tilt_time_s, self._rate)
        rpy = np.concatenate([spec.tilt + spec.tilt_std * tilt, heading[..., None]], axis=-1)
        q = quat_multiply(quat_from_rpy(rpy), q_base_imu)
        q = quat_multiply(quat_from_rpy([*spec.level_error, 0.0]), q)
        q = quat_multiply(q, quat_from_rpy(spec.orientation_noise_std * white[..., :3]))
        return {"imu_q_xyzw": canonical(q), "imu_w": rates, "imu_a": acceleration}
