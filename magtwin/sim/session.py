"""Session: what differs between sessions of driving, from switching the robot on to switching it off.

In a session the IMU's zero, the odometry's error and the LiDAR's schedule stay the same. The spreads are
chosen so that runs over the named paths have the means and scales of the 20 signals on which the real robot's
network was trained (its scalers, over 73 min of driving).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from magtwin.sim.interference import draw_platform
from magtwin.sim.motion.drive import draw_wheel_errors
from magtwin.sim.plant_families import draw_session_plant
from magtwin.spec.drive import DRAWN, DriveSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec

YAW_ZERO = (np.pi, 0.3)
"""Mean and standard deviation of the heading at which the IMU is switched on [rad].

The real disturbance has the same rank correlation, 0.31, with heading in [0, 360) deg and with the
quaternion's z. That holds only for an IMU whose zero faces -x."""

CHARGE_SPENT = 0.135
"""Mean of the missing charge at the start, exponentially distributed.

The real charge is 0.857 +- 0.140: the mean of the missing charge is like its spread, as in an exponential
distribution."""

LEAST_CHARGE = 0.3
"""Least charge at the start of a session; with less, a robot is docked."""

GYRO_BIAS_STD = 1e-4
"""Standard deviation of the gyroscope bias after the IMU found its zero, each axis [rad/s]; assumed."""

SPEEDS = (0.2, 0.3)
"""Least and largest wanted speed [m/s]: with stops and corners the real 0.233 +- 0.066 m/s."""

_STREAMS = ("battery", "imu", "lidar", "drive", "platform")
"""Who draws, each from its own child generator. Append only: the order is part of the seed."""


def draw_session(robot: RobotSpec, rng: np.random.Generator) -> RobotSpec:
    """The robot in one session: charge, IMU, LiDAR's phase, wheels and odometry, and its own field.

    Returns:
        The robot with `initial_fraction`, `yaw_zero`, `gyro_bias`, `phase_s`, `wheel_errors` and
        `odometry_scale` drawn, and its platform from `magtwin.sim.interference.draw_platform`. The standard
        deviations from which a run would draw wheels and odometry are 0. Motion capture has drifted since the
        survey. A plant is drawn by `magtwin.sim.plant_families.draw_session_plant`.
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
    latency = mocap.latency_s + mocap.latency_drift_s
    drifted: Any = {"offset_drift_m": (0.0, 0.0), "latency_drift_s": 0.0}
    at_rest: Any = dict.fromkeys(DRAWN, 0.0)
    drawn = replace(
        robot,
        battery=replace(robot.battery, initial_fraction=max(1.0 - missing, LEAST_CHARGE)),
        imu=replace(imu, yaw_zero=yaw_zero, gyro_bias=tuple(bias.tolist())),
        lidar=replace(lidar, phase_s=phase),
        platform=draw_platform(robot.platform, draws["platform"]),
        mocap=replace(mocap, offset_m=(forward, leftward), latency_s=latency, **drifted),
        drive=replace(drive, wheel_errors=errors, odometry_scale=(float(left), float(right)), **at_rest),
    )
    if robot.plant == PlantSpec():
        return drawn
    (own,) = draws["platform"].spawn(1)  # a child of this stream, so that no other draw changes
    return draw_session_plant(drawn, own)


def session_of(robot: RobotSpec, seed: int, session: int, *, which: int = 0) -> RobotSpec:
    """The robot in a numbered session of a data set."""
    key = (0, session, which) if which else (0, session)
    child = np.random.SeedSequence((seed, 1), spawn_key=key)  # that no run draws from
    return draw_session(robot, np.random.default_rng(child))


def offset_generator(
    session: Mapping[str, str | int | float | bool], seed: int, *, which: int = 0
) -> np.random.Generator:
    """Generator of the part of the model error that is constant in a session."""
    entropy, key = seed, (3, 0, which)
    if "session_seed" in session:
        entropy, key = int(session["session_seed"]), (2, int(session["session"]), which)
    return np.random.default_rng(np.random.SeedSequence((entropy, 1), spawn_key=key))


def draw_speed(drive: DriveSpec, rng: np.random.Generator) -> float:
    """A wanted speed for a run [m/s], as in the real robot's runs, within the drive's limit."""
    slowest, fastest = (min(speed, drive.v_max) for speed in SPEEDS)
    return float(rng.uniform(slowest, fastest))
