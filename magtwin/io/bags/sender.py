"""Sender: what the messages of a robot hold beside its readings: frames, covariances, links, units."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from magtwin.frames import IDENTITY_XYZW
from magtwin.spec.base import ZERO3, Quat, Vec3
from magtwin.spec.robot import RobotSpec

Unit = Literal["T", "nT"]

Transforms = Literal["all", "odom", "none"]
"""Which part of the chain from map to base_link is on /tf: all of it, odom to base_link, or nothing."""


@dataclass(frozen=True)
class FixedFrame:
    """A frame at rest in another."""

    parent: str
    name: str
    p: Vec3 = ZERO3
    q_xyzw: Quat = IDENTITY_XYZW
    axis: Vec3 = (0.0, 0.0, 1.0)  # Axis about which a wheel that rolls forward turns by a positive angle


@dataclass(frozen=True)
class WheelJoint:
    """The joint of a driven wheel."""

    name: str
    side: int  # 0 for left, 1 for right
    sense: int = 1  # -1 if the wheel rolls backward as the joint's angle grows


@dataclass(frozen=True, kw_only=True)
class Sender:
    """The robot that sends messages; a standard deviation of 0 is unknown."""

    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    truth_frame: str = "ground_truth"  # True pose of base_link in map; on /tf if that is not odom's parent
    imu_frame: str = "imu_link"
    magnetometer_frame: str = "magnetometer_link"
    lidar_frame: str = "rplidar_link"
    # Joints of all driven wheels, with their names in the description
    wheel_joints: tuple[WheelJoint, ...] = (
        WheelJoint("left_wheel_joint", 0),
        WheelJoint("right_wheel_joint", 1),
    )
    # Transforms of the drive on /tf. With "all", map to odom puts base_link at its true pose.
    transforms: Transforms = "all"
    unit: Unit = "T"  # Unit of magnetic fields in messages
    odometry_std: tuple[float, ...] = (0.0,) * 6  # Of odometry's velocities, [m/s] and [rad/s]
    orientation_std: float = 0.0  # Standard deviation of each small angle of the IMU's orientation [rad]
    gyro_std: float = 0.0  # Standard deviation of the gyroscope at rest [rad/s]
    gyro_vibration: Vec3 = ZERO3  # Additional gyroscope noise per speed [rad/m]
    accel_std: float = 0.0  # Standard deviation of the accelerometer at rest [m/s2]
    accel_vibration: Vec3 = ZERO3  # Additional accelerometer noise per speed [1/s]
    vector_std_nt: float = 0.0  # Standard deviation of each vector axis of the magnetometer [nT]
    scan_rate_hz: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)

    links: tuple[FixedFrame, ...] = ()  # Links fixed in base_link, and sensors at an angle on their links
    wheels: tuple[FixedFrame, ...] = ()  # The wheels of `wheel_joints` at rest; empty if they are not known
    description: str = ""  # The robot's URDF; "" if unknown


def sender_of(robot: RobotSpec, *, unit: Unit = "T", rate_hz: float | None = None, **rest: Any) -> Sender:
    """The sender of a robot's messages at a rate of the magnetometer [Hz]; `rest` are fields of `Sender`."""
    mounts = {"magnetometer": robot.magnetometer, "imu": robot.imu, "lidar": robot.lidar}
    frames, tilted = {}, []
    for name, mount in mounts.items():
        straight = (mount.p_link_sensor, mount.q_link_sensor_xyzw) == (ZERO3, IDENTITY_XYZW)
        frames[name] = mount.link if straight else name
        if not straight:
            tilted.append(FixedFrame(mount.link, name, mount.p_link_sensor, mount.q_link_sensor_xyzw))
    rate = robot.magnetometer.rate_hz if rate_hz is None else rate_hz
    return Sender(
        imu_frame=frames["imu"],
        magnetometer_frame=frames["magnetometer"],
        lidar_frame=frames["lidar"],
        unit=unit,
        odometry_std=(*robot.drive.odometry_v_noise_std, *robot.drive.odometry_w_noise_std),
        orientation_std=robot.imu.orientation_noise_std,
        gyro_std=robot.imu.gyro_noise_std,
        gyro_vibration=robot.imu.gyro_vibration,
        accel_std=robot.imu.accel_noise_std,
        accel_vibration=robot.imu.accel_vibration,
        vector_std_nt=robot.magnetometer.vector_noise_density_nt * float(np.sqrt(rate / 2)),
        scan_rate_hz=robot.lidar.scan_rate_hz,
        range_m=(robot.lidar.range_min_m, robot.lidar.range_max_m),
        **{
            "wheel_joints": tuple(WheelJoint(name, side) for name, side in robot.drive.sides.items()),
            **rest,
            "links": (*rest.get("links", ()), *tilted),
        },
    )


def prefixed(sender: Sender, prefix: str) -> Sender:
    """The sender with a prefix before the names of its frames, as `frame_prefix` of robot_state_publisher.

    The frame of the map is shared by robots and keeps its name. Joints keep theirs.
    """

    def moved(frame: FixedFrame) -> FixedFrame:
        return replace(frame, parent=prefix + frame.parent, name=prefix + frame.name)

    names = ("odom_frame", "base_frame", "truth_frame", "imu_frame", "magnetometer_frame", "lidar_frame")
    wheels = tuple(map(moved, sender.wheels))
    frames: dict[str, Any] = {name: prefix + getattr(sender, name) for name in names}
    return replace(sender, links=tuple(map(moved, sender.links)), wheels=wheels, **frames)
