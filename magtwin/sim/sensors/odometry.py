"""Odometry: what a robot makes of how far its wheels have turned."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import quat_from_yaw, wrap_angle
from magtwin.sim.motion.sampling import Columns, Moving, held, moment_at
from magtwin.spec.drive import DriveSpec

Array = NDArray[np.float64]


def sense_odometry(drive: DriveSpec, motion: Moving, t: ArrayLike, rng: np.random.Generator) -> Columns:
    """Wheel odometry, in a frame of its own that begins at the robot's first pose.

    The wheels' angles are read at each sample. Between two of them the robot is taken as having gone along
    an arc, of which the wheels tell the length and the angle: so the estimate drifts as a robot's does,
    by slip, and because each wheel's travel is mistaken by a factor: `odometry_scale` of the session
    times 1 + e, e drawn once a run with `odometry_noise_std`. The twist is the mean one since the last
    sample, plus white noise on each axis, which stands for what the real one has there: it blends its
    inertial unit in. Noise of the twist does not enter the pose.

    Args:
        drive: The wheels as the robot knows them, rate, delays and noise.
        motion: What the robot did.
        t: Times of the readings [s], shape (N,).
        rng: Source of the two factors, the delays and the noise.

    Returns:
        odom_p, odom_q_xyzw, odom_v, odom_w at `odometry_rate_hz`, held.
    """
    delays, noise = rng.spawn(2)
    factors = np.array(drive.odometry_scale) * (1.0 + drive.odometry_noise_std * rng.standard_normal(2))
    stamps, latest = held(
        t,
        drive.odometry_rate_hz,
        latency_s=drive.odometry_latency_s,
        jitter_s=drive.odometry_jitter_s,
        rng=delays,
    )
    before = stamps[:1] - 1 / drive.odometry_rate_hz
    angle = moment_at(motion, np.concatenate([before, stamps])).wheel_angle
    left, right = (np.diff(angle, axis=0) * (drive.wheel_radius_m * factors)).T
    way, turn = (left + right) / 2, (right - left) / drive.wheel_separation_m

    yaw = np.cumsum(turn)
    chord, middle = way * np.sinc(turn / (2 * np.pi)), yaw - turn / 2
    p = np.zeros((len(stamps), 3))
    np.cumsum(chord * np.cos(middle), out=p[:, 0])
    np.cumsum(chord * np.sin(middle), out=p[:, 1])
    twist = noise.standard_normal((len(stamps), 6))
    twist *= (*drive.odometry_v_noise_std, *drive.odometry_w_noise_std)
    twist[:, 0] += way * drive.odometry_rate_hz
    twist[:, 5] += turn * drive.odometry_rate_hz
    return {
        "odom_p": p.take(latest, axis=0),
        "odom_q_xyzw": quat_from_yaw(wrap_angle(yaw)).take(latest, axis=0),
        "odom_v": twist[:, :3].take(latest, axis=0),
        "odom_w": twist[:, 3:].take(latest, axis=0),
    }
