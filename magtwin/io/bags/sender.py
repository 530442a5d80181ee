"""Sender: what the messages of a robot hold beside its readings: frames, covariances, links, units."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import IDENTITY_XYZW, quat_from_rpy
from magtwin.spec.base import ZERO3, Quat, Vec3
from magtwin.spec.robot import RobotSpec

if TYPE_CHECKING:
    from magtwin.twin import Twin

Unit = Literal["T", "nT"]

Transforms = Literal["all", "odom", "none"]
"""Which part of the chain from map to base_link is on /tf: all of it, odom to base_link, or nothing."""

FOOTPRINT = "base_footprint"
"""Name of the frame below base_link on the floor, as in REP 120."""


@dataclass(frozen=True)
class FixedFrame:
    """A frame at rest in another."""

    parent: str
    name: str
    p: Vec3 = ZERO3
    q_xyzw: Quat = IDENTITY_XYZW
    axis: Vec3 = (0.0, 0.0, 1.0)
    """Axis about which a wheel that rolls forward turns by a positive angle."""


@dataclass(frozen=True)
class WheelJoint:
    """The joint of a driven wheel."""

    name: str
    side: int
    """0 for left, 1 for right."""
    sense: int = 1
    """-1 if the wheel rolls backward as the joint's angle grows."""


@dataclass(frozen=True, kw_only=True)
class Sender:
    """The robot that sends messages; a standard deviation of 0 is unknown."""

    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    truth_frame: str = "ground_truth"
    """Frame at the true pose of base_link, in the map; on /tf if the map is not the parent of odom."""

    imu_frame: str = "imu_link"
    magnetometer_frame: str = "magnetometer_link"
    lidar_frame: str = "rplidar_link"
    wheel_joints: tuple[WheelJoint, ...] = (
        WheelJoint("left_wheel_joint", 0),
        WheelJoint("right_wheel_joint", 1),
    )
    """Joints of all driven wheels, with their names in the description."""

    transforms: Transforms = "all"
    """Transforms of the drive on /tf. With "all", map to odom puts base_link at its true pose."""

    unit: Unit = "T"
    """Unit of magnetic fields in messages."""

    odometry_std: tuple[float, ...] = (0.0,) * 6
    """Standard deviation of odometry's velocities, linear [m/s] and angular [rad/s]."""

    orientation_std: float = 0.0
    """Standard deviation of each small angle of the IMU's orientation [rad]."""

    gyro_std: float = 0.0
    """Standard deviation of the gyroscope at rest [rad/s]."""

    gyro_vibration: Vec3 = ZERO3
    """Additional gyroscope noise per speed [rad/m]."""

    accel_std: float = 0.0
    """Standard deviation of the accelerometer at rest [m/s2]."""

    accel_vibration: Vec3 = ZERO3
    """Additional accelerometer noise per speed [1/s]."""

    vector_std_nt: float = 0.0
    """Standard deviation of each vector axis of the magnetometer [nT]."""

    scan_rate_hz: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)

    links: tuple[FixedFrame, ...] = ()
    """Links fixed in base_link, and sensors mounted at an angle on their links."""

    wheels: tuple[FixedFrame, ...] = ()
    """The wheels of `wheel_joints` at rest; empty if they are not known."""

    description: str = ""
    """The robot's URDF; "" if unknown."""


def sender_of(robot: RobotSpec, *, unit: Unit = "T", rate_hz: float | None = None, **rest: Any) -> Sender:
    """The sender of a robot's messages.

    Args:
        robot: Its sensors and drive.
        unit: Unit of magnetic fields in messages.
        rate_hz: Rate of the magnetometer [Hz]. Default: the robot's.
        rest: `links`, `wheels`, `wheel_joints` and `description` of the sender.
    """
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


def sender_for(twin: "Twin | None", unit: Unit, rate_hz: Any = None) -> Sender:
    """The sender of a twin's robot; without a twin, a robot of default frames and unknown noise.

    Raises:
        InputError: The unit is neither T nor nT.
    """
    if unit not in ("T", "nT"):
        raise InputError(f'units of a bag must be "T" or "nT", got {unit!r}')
    if twin is None:
        return Sender(unit=unit)
    from magtwin.author.robot import read_description
    from magtwin.usd.geometry import BASE_LINK, read_links
    from magtwin.usd.robot import description_names

    robot = twin.scene.robot
    links, names = description_names(robot.asset)
    sides, senses = robot.drive.sides, dict[str, int]()
    frames: dict[str, FixedFrame] = {}  # by joint; links that do not turn by name
    for link in read_links(robot.asset).values():
        if link.name != BASE_LINK:
            axis = link.rolling_axis or (0.0, 0.0, 1.0)
            name = links.get(link.name, link.name)
            frame = FixedFrame(BASE_LINK, name, link.p_base_link, link.q_base_link_xyzw, axis)
            frames[link.joint if link.joint in sides else f"/{name}"] = frame
            senses[link.joint] = link.sense
    wheels = tuple(frames.pop(joint) for joint in sides if joint in frames)
    joints = (WheelJoint(names.get(n, n), side, senses.get(n, 1)) for n, side in sides.items())
    description = read_description(robot.asset)
    below = _footprint(description) if f"/{FOOTPRINT}" not in frames else ()
    mounts = {"magnetometer": robot.magnetometer, "imu": robot.imu, "lidar": robot.lidar}
    called: dict[str, Any] = {
        n: replace(mount, link=links.get(mount.link, mount.link)) for n, mount in mounts.items()
    }
    return sender_of(
        replace(robot, **called),
        unit=unit,
        rate_hz=float(rate_hz) if isinstance(rate_hz, int | float) and rate_hz > 0 else None,
        links=(*frames.values(), *below),
        wheels=wheels if len(wheels) == len(sides) else (),
        wheel_joints=tuple(joints),
        description=description,
    )


def _footprint(description: str) -> tuple[FixedFrame, ...]:
    """The frame base_footprint of a URDF whose root is base_link. It has no body, so stages have no link."""
    if not description:
        return ()
    from magtwin.urdf.source.markup import parse_markup

    for joint in parse_markup(description.encode(), Path("robot_description")).root.findall("joint"):
        ends = [element.get("link") for element in (*joint.findall("parent"), *joint.findall("child"))]
        if joint.get("type") == "fixed" and ends == ["base_link", FOOTPRINT]:
            origin = joint.find("origin")
            text = {} if origin is None else origin.attrib
            xyz, rpy = (np.array(text.get(name, "0 0 0").split(), float) for name in ("xyz", "rpy"))
            q = np.array(text["quat_xyzw"].split(), float) if "quat_xyzw" in text else quat_from_rpy(rpy)
            return (FixedFrame("base_link", FOOTPRINT, tuple(xyz.tolist()), tuple(q.tolist())),)
    return ()
