"""Odometry: the pose and speed that a robot computes from how far its wheels have turned."""

import numpy as np

from magtwin.frames import quat_from_yaw, wrap_angle
from magtwin.sim.motion.drive import Moment
from magtwin.sim.sensors.clock import Array, Columns, SampleClock, SampledSensor
from magtwin.sim.sensors.noise import accumulate
from magtwin.spec.drive import DriveSpec


class Odometry(SampledSensor):
    """Wheel odometry, in a frame that begins at the robot's first pose.

    The wheels' angles are read at each sample. Between two samples the robot is taken to drive an arc with
    the length and angle that the wheels give. So the estimate drifts as a robot's does: by slip, and because
    each wheel's travel is off by a factor, `odometry_scale` of the session times 1 + e, with e drawn once a
    run (`odometry_noise_std`). The twist is the mean twist since the last sample, plus white noise on each
    axis, as the real robot blends in its inertial unit. Noise of the twist does not enter the pose.
    Columns: odom_p, odom_q_xyzw, odom_v, odom_w.
    """

    def __init__(self, drive: DriveSpec, rng: np.random.Generator, *, rate_hz: float | None = None) -> None:
        """Begin at the origin."""
        delays, noise = rng.spawn(2)
        factors = np.array(drive.odometry_scale) * (1.0 + drive.odometry_noise_std * rng.standard_normal(2))
        super().__init__(noise, factors=factors, angle=np.full(2, np.nan), yaw=0.0, xy=np.zeros(2))
        self._drive = drive
        self._rate = drive.odometry_rate_hz if rate_hz is None else rate_hz
        self.clock = SampleClock(self._rate, drive.odometry_latency_s, drive.odometry_jitter_s, delays)

    def sample(self, stamps: Array, now: Moment) -> Columns:
        """As for `SampledSensor`."""
        drive, state = self._drive, self.state
        before = np.where(np.isnan(state["angle"]), now.wheel_angle[0], state["angle"])
        state["angle"] = now.wheel_angle[-1]
        turned = np.diff(now.wheel_angle, axis=0, prepend=before[None])
        rolled = turned * (drive.wheel_radius_m * state["factors"])
        left, right = rolled[..., 0], rolled[..., 1]
        length, turn = (left + right) / 2, (right - left) / drive.wheel_separation_m
        yaw = accumulate(state["yaw"], turn)[1:]
        chord, middle = length * np.sinc(turn / (2 * np.pi)), yaw - turn / 2
        steps = np.stack([chord * np.cos(middle), chord * np.sin(middle)], axis=-1)
        xy = accumulate(state["xy"], steps)[1:]
        state["yaw"], state["xy"] = yaw[-1], xy[-1]
        twist = self.normal(len(stamps), 6) * (*drive.odometry_v_noise_std, *drive.odometry_w_noise_std)
        twist[..., 0] += length * self._rate
        twist[..., 5] += turn * self._rate
        return {
            "odom_p": np.concatenate([xy, np.zeros((*yaw.shape, 1))], axis=-1),
            "odom_q_xyzw": quat_from_yaw(wrap_angle(yaw)),
            "odom_v": twist[..., :3],
            "odom_w": twist[..., 3:],
        }
