"""Session: what differs from one day of driving to the next, drawn for a data set.

A robot that is switched on and driven several times keeps its IMU's zero, its odometry's error and its
LiDAR's rhythm for all of these runs, and its charge goes on from run to run. The spreads are such that
runs over the named paths have the means and scales of the 20 signals that the real robot's network was
trained on (its scalers, over 73 min of driving); each says what it was taken from.
"""

from dataclasses import replace

import numpy as np

from magtwin.spec import DriveSpec, RobotSpec

YAW_ZERO = (np.pi, 0.3)
"""Mean and standard deviation of the heading at which the IMU is switched on [rad].

The real disturbance has the same rank correlation with heading in [0, 360) deg and with the quaternion's
z, 0.31: both order the headings alike, which they do for an IMU whose zero faces -x and for no other."""

CHARGE_SPENT = 0.135
"""Mean of the charge that is missing at the start, exponentially distributed.

The real charge is 0.857 +- 0.140: what is missing has a mean like its spread, as an exponential
distribution has, and not as an even one between full and empty."""

LEAST_CHARGE = 0.3
"""No session begins with less charge: the robot would be docked."""

GYRO_BIAS_STD = 1e-4
"""Standard deviation of each axis's bias that is left when the IMU has found its zero [rad/s]; ours."""

SPEEDS = (0.2, 0.3)
"""Least and most wanted speed [m/s]: with stops and corners the real 0.233 +- 0.066 m/s, and below v_max."""


def draw_session(robot: RobotSpec, rng: np.random.Generator) -> RobotSpec:
    """The robot as it is on one day: charge, IMU's zero and bias, LiDAR's phase, odometry's scale.

    Args:
        robot: The robot as its asset has it.
        rng: Source of the session.

    Returns:
        The robot with `initial_fraction`, `yaw_zero`, `gyro_bias`, `phase_s` and `odometry_scale` drawn.
        Its `odometry_noise_std` is 0, as the scale is the same in all runs of a session.
    """
    drive, imu, lidar = robot.drive, robot.imu, robot.lidar
    missing = float(rng.exponential(CHARGE_SPENT))
    yaw_zero = float(rng.normal(*YAW_ZERO))
    bias = np.add(imu.gyro_bias, GYRO_BIAS_STD * rng.standard_normal(3))
    phase = float(rng.uniform(0.0, lidar.on_s + lidar.off_s))
    left, right = np.array(drive.odometry_scale) * (1.0 + drive.odometry_noise_std * rng.standard_normal(2))
    return replace(
        robot,
        battery=replace(robot.battery, initial_fraction=max(1.0 - missing, LEAST_CHARGE)),
        imu=replace(imu, yaw_zero=yaw_zero, gyro_bias=tuple(bias.tolist())),
        lidar=replace(lidar, phase_s=phase),
        drive=replace(drive, odometry_scale=(float(left), float(right)), odometry_noise_std=0.0),
    )


def draw_speed(drive: DriveSpec, rng: np.random.Generator) -> float:
    """A wanted speed for a run [m/s], as the real robot's runs had, within the drive's."""
    slowest, fastest = (min(speed, drive.v_max) for speed in SPEEDS)
    return float(rng.uniform(slowest, fastest))
