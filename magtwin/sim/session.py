"""Session: what differs from one day of driving to the next, drawn for a data set.

A robot that is switched on and driven several times keeps its IMU's zero, its odometry's error and its
LiDAR's rhythm for all of these runs, and its charge goes on from run to run. The spreads are such that
runs over the named paths have the means and scales of the 20 signals that the real robot's network was
trained on (its scalers, over 73 min of driving); each says what it was taken from.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from magtwin.sim.interference import draw_platform
from magtwin.sim.motion.drive import draw_wheel_errors
from magtwin.spec.drive import DriveSpec
from magtwin.spec.robot import RobotSpec

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

_STREAMS = ("battery", "imu", "lidar", "drive", "platform")
"""Who draws, each from a child generator of its own; append only: the order is the seed."""


def draw_session(robot: RobotSpec, rng: np.random.Generator) -> RobotSpec:
    """The robot as it is on one day: charge, IMU, LiDAR's phase, wheels and odometry, and its own field.

    Args:
        robot: The robot as its asset has it.
        rng: Source of the session.

    Returns:
        The robot with `initial_fraction`, `yaw_zero`, `gyro_bias`, `phase_s`, `wheel_errors` and
        `odometry_scale` drawn, and its platform by `magtwin.sim.interference.draw_platform`. What a run
        draws of wheels and odometry otherwise, it no longer does: their standard deviations are 0. Motion
        capture is as it has become since the survey.
    """
    drive, imu, lidar, mocap = robot.drive, robot.imu, robot.lidar, robot.mocap
    draws = dict(zip(_STREAMS, rng.spawn(len(_STREAMS)), strict=True))
    missing = float(draws["battery"].exponential(CHARGE_SPENT))
    yaw_zero = float(draws["imu"].normal(*YAW_ZERO))
    bias = np.add(imu.gyro_bias, GYRO_BIAS_STD * draws["imu"].standard_normal(3))
    phase = float(draws["lidar"].uniform(0.0, lidar.on_s + lidar.off_s))
    errors = draw_wheel_errors(drive, draws["drive"])
    scale = 1.0 + drive.odometry_noise_std * draws["drive"].standard_normal(2)
    left, right = np.array(drive.odometry_scale) * scale
    forward, leftward = np.add(mocap.offset_m, mocap.offset_drift_m).tolist()
    return replace(
        robot,
        battery=replace(robot.battery, initial_fraction=max(1.0 - missing, LEAST_CHARGE)),
        imu=replace(imu, yaw_zero=yaw_zero, gyro_bias=tuple(bias.tolist())),
        lidar=replace(lidar, phase_s=phase),
        platform=draw_platform(robot.platform, draws["platform"]),
        mocap=replace(
            mocap,
            offset_m=(forward, leftward),
            latency_s=mocap.latency_s + mocap.latency_drift_s,
            offset_drift_m=(0.0, 0.0),
            latency_drift_s=0.0,
        ),
        drive=replace(
            drive,
            wheel_errors=errors,
            wheel_radius_error_std=0.0,
            wheel_separation_error_std=0.0,
            odometry_scale=(float(left), float(right)),
            odometry_noise_std=0.0,
        ),
    )


def session_of(robot: RobotSpec, seed: int, session: int, *, which: int = 0) -> RobotSpec:
    """The robot as it is in one session of a data set, which a seed and the session's number decide.

    Args:
        robot: The robot as its asset has it.
        seed: Seed of the data set.
        session: Number of the session, from 0.
        which: Place of the robot in a scene of several, from 0.
    """
    key = (0, session, which) if which else (0, session)
    return draw_session(
        robot, np.random.default_rng(np.random.SeedSequence((seed, 1), spawn_key=key))
    )  # a child that no run draws from


def offset_generator(
    session: Mapping[str, str | int | float | bool], seed: int, *, which: int = 0
) -> np.random.Generator:
    """Source of a session's part of the model error: the same session, the same part.

    Args:
        session: Metadata of the session, `session_seed` and `session`; without them each seed is a session of
            its own.
        seed: Seed of the run.
        which: Place of the robot in a scene of several, from 0.
    """
    entropy, key = seed, (3, 0, which)
    if "session_seed" in session:
        entropy, key = int(session["session_seed"]), (2, int(session["session"]), which)
    return np.random.default_rng(np.random.SeedSequence((entropy, 1), spawn_key=key))


def draw_speed(drive: DriveSpec, rng: np.random.Generator) -> float:
    """A wanted speed for a run [m/s], as the real robot's runs had, within the drive's."""
    slowest, fastest = (min(speed, drive.v_max) for speed in SPEEDS)
    return float(rng.uniform(slowest, fastest))
