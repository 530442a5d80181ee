"""Messages: what each ROS 2 topic of the robot says, from the columns of a Run and back.

The one table, for bags and for live robots. Its functions turn columns into the fields of messages, arrays by
the name of the leaf (`pose.position`, shape (M, 3)), and fields into columns; they know neither bytes nor any
library of ROS. Fields are in tesla, as ROS has them, or in nT, as APRILab's robot publishes them.

A Run holds slower signals causally on the magnetometer's clock, so a message says when its value reached the
readings: at the first of them that saw it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.frames import IDENTITY_XYZW, quat_conjugate, quat_multiply, rotate
from magtwin.spec.base import ZERO3, Quat, Vec3
from magtwin.spec.robot import RobotSpec

Array = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]
Fields = dict[str, Any]
Unit = Literal["T", "nT"]

NT_PER_T = 1e9

_STAMPED = "time header.stamp, text header.frame_id, "
_TRANSFORM = (
    "time {0}header.stamp, text {0}header.frame_id, text {0}child_frame_id, "
    "f8[3] {0}transform.translation, f8[4] {0}transform.rotation"
)

TYPES: Mapping[str, str] = MappingProxyType(
    {
        "geometry_msgs/msg/PoseStamped": _STAMPED + "f8[3] pose.position, f8[4] pose.orientation",
        "geometry_msgs/msg/PoseWithCovarianceStamped": _STAMPED
        + "f8[3] pose.pose.position, f8[4] pose.pose.orientation, f8[36] pose.covariance",
        "geometry_msgs/msg/TransformStamped": _TRANSFORM.format(""),
        "geometry_msgs/msg/Twist": "f8[3] linear, f8[3] angular",
        "geometry_msgs/msg/TwistStamped": _STAMPED + "f8[3] twist.linear, f8[3] twist.angular",
        "nav_msgs/msg/Odometry": _STAMPED
        + "text child_frame_id, f8[3] pose.pose.position, f8[4] pose.pose.orientation, "
        "f8[36] pose.covariance, f8[3] twist.twist.linear, f8[3] twist.twist.angular, "
        "f8[36] twist.covariance",
        "sensor_msgs/msg/Imu": _STAMPED
        + "f8[4] orientation, f8[9] orientation_covariance, f8[3] angular_velocity, "
        "f8[9] angular_velocity_covariance, f8[3] linear_acceleration, f8[9] linear_acceleration_covariance",
        "sensor_msgs/msg/BatteryState": _STAMPED
        + "f4 voltage, f4 temperature, f4 current, f4 charge, f4 capacity, f4 design_capacity, "
        "f4 percentage, u1 power_supply_status, u1 power_supply_health, u1 power_supply_technology, "
        "u1 present, "
        "f4[] cell_voltage, f4[] cell_temperature, text location, text serial_number",
        "sensor_msgs/msg/MagneticField": _STAMPED + "f8[3] magnetic_field, f8[9] magnetic_field_covariance",
        "sensor_msgs/msg/LaserScan": _STAMPED
        + "f4 angle_min, f4 angle_max, f4 angle_increment, f4 time_increment, f4 scan_time, f4 range_min, "
        "f4 range_max, f4[] ranges, f4[] intensities",
        "sensor_msgs/msg/JointState": _STAMPED + "text[] name, f8[] position, f8[] velocity, f8[] effort",
        "rosgraph_msgs/msg/Clock": "time clock",
        "std_msgs/msg/Empty": "u1 structure_needs_at_least_one_member",
        "std_msgs/msg/String": "text data",
        "std_msgs/msg/Float64": "f8 data",
        "std_msgs/msg/Float32": "f4 data",
        "std_msgs/msg/Float64MultiArray": "none layout.dim, u4 layout.data_offset, f8[] data",
    }
)
"""Leaves of each type of message, as `magtwin.io.bags.cdr.leaves` reads them; those with parts that have
parts of
their own, tf2_msgs and diagnostic_msgs, are told by `transforms` and `diagnostics`."""


def transforms(count: int) -> str:
    """Leaves of a tf2_msgs/msg/TFMessage of `count` transforms, `0.header.stamp` to begin with."""
    return ", ".join(["u4 count", *(_TRANSFORM.format(f"{k}.") for k in range(count))])


def diagnostics(values: Sequence[int]) -> str:
    """Leaves of a diagnostic_msgs/msg/DiagnosticArray of a status for each of `values`, with as many values.

    Status 0 begins with `0.level` (0 OK, 1 WARN, 2 ERROR, 3 STALE), its value 0 is `0.0.key`, `0.0.value`.
    """
    form = [_STAMPED + "u4 count"]
    for k, count in enumerate(values):
        form.append(f"u1 {k}.level, text {k}.name, text {k}.message, text {k}.hardware_id, u4 {k}.values")
        form += [f"text {k}.{n}.key, text {k}.{n}.value" for n in range(count)]
    return ", ".join(form)


@dataclass(frozen=True)
class Qos:
    """How a topic is offered."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False
    """Whether who comes late gets the last message: transient local."""


SENSOR_DATA = Qos(depth=5, reliable=False)
LATCHED = Qos(depth=1, latched=True)


@dataclass(frozen=True, kw_only=True)
class Sender:
    """What messages tell of their robot beside its readings; a covariance of 0 is one that is not known."""

    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    imu_frame: str = "imu_link"
    magnetometer_frame: str = "magnetometer_link"
    lidar_frame: str = "rplidar_link"
    wheel_joints: tuple[str, str] = ("left_wheel_joint", "right_wheel_joint")

    unit: Unit = "T"
    """Unit of fields in messages."""

    odometry_std: tuple[float, ...] = (0.0,) * 6
    """Standard deviation of odometry's velocities, linear [m/s] and angular [rad/s]."""

    orientation_std: float = 0.0
    """Standard deviation of each small angle of the IMU's orientation [rad]."""

    gyro_std: float = 0.0
    """Standard deviation of its rates at rest [rad/s]."""

    gyro_vibration: Vec3 = ZERO3
    """And for each m/s of speed [rad/m]."""

    accel_std: float = 0.0
    """Standard deviation of its acceleration at rest [m/s2]."""

    accel_vibration: Vec3 = ZERO3
    """And for each m/s of speed [1/s]."""

    vector_std_nt: float = 0.0
    """Standard deviation of each vector axis of the magnetometer [nT]."""

    scan_rate_hz: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)

    links: tuple["Fixed", ...] = ()
    """Links that do not move in base_link, and sensors that stand aslant on theirs."""

    wheels: tuple["Fixed", "Fixed"] | None = None
    """The left and the right wheel at rest."""

    description: str = ""
    """The robot's URDF; "" where it is not known."""


@dataclass(frozen=True)
class Fixed:
    """A frame at rest in another."""

    parent: str
    name: str
    p: Vec3 = ZERO3
    q_xyzw: Quat = IDENTITY_XYZW
    axis: Vec3 = (0.0, 0.0, 1.0)
    """What it turns about, if it turns."""


def sender_of(
    robot: RobotSpec,
    *,
    unit: Unit = "T",
    rate_hz: float | None = None,
    links: tuple[Fixed, ...] = (),
    wheels: tuple[Fixed, Fixed] | None = None,
    description: str = "",
) -> Sender:
    """What the messages of a robot tell of it.

    Args:
        robot: Its sensors and drive.
        unit: Unit of fields in messages.
        rate_hz: Readings of the magnetometer a second [Hz]; None takes the robot's own.
        links: Links that do not move in base_link.
        wheels: The left and the right wheel at rest.
        description: Its URDF.
    """
    mounts = {"magnetometer": robot.magnetometer, "imu": robot.imu, "lidar": robot.lidar}
    frames, aslant = {}, []
    for name, mount in mounts.items():
        straight = (mount.p_link_sensor, mount.q_link_sensor_xyzw) == (ZERO3, IDENTITY_XYZW)
        frames[name] = mount.link if straight else name
        if not straight:
            aslant.append(Fixed(mount.link, name, mount.p_link_sensor, mount.q_link_sensor_xyzw))
    rate = robot.magnetometer.rate_hz if rate_hz is None else rate_hz
    return Sender(
        imu_frame=frames["imu"],
        magnetometer_frame=frames["magnetometer"],
        lidar_frame=frames["lidar"],
        wheel_joints=(robot.drive.left_wheel_joint, robot.drive.right_wheel_joint),
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
        links=(*links, *aslant),
        wheels=wheels,
        description=description,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Topic:
    """A topic: what it is called, what its messages are, and which columns they carry."""

    name: str
    kind: str
    qos: Qos = field(default_factory=Qos)

    needs: tuple[str, ...] = ()
    """Columns that there must be for it to be written."""

    carries: tuple[str, ...] = ()
    """Columns that are read from it."""

    sent: Literal["changed", "each", "ticks", "once"] = "changed"
    """When one is sent: when a needed column changes, and again where it stands; at each reading that has a
    number; in even steps; or once."""

    every_s: float = 0.1
    """After which time one is sent again where nothing changes, or the length of a step [s]."""

    lost: str = ""
    """Column of flags while which it is not sent again."""

    write: Callable[[Columns, NDArray[np.int64], Sender], Fields]
    """Fields of the messages of some rows, from their columns and stamps [ns]."""

    read: Mapping[str, Callable[[Fields], dict[str, NDArray[Any]]]] = field(default_factory=dict)
    """By each type that may come in under its name: the columns that fields give."""

    leaves: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By the same types: the leaves that `read` needs."""


def _header(stamp: NDArray[np.int64], frame: str) -> Fields:
    return {"header.stamp": stamp, "header.frame_id": frame}


def _diagonal(variances: Any) -> Array:
    """Covariance matrices, by rows, of independent errors, shape (..., n) -> (..., n * n)."""
    variances = np.asarray(variances, float)
    n = variances.shape[-1]
    out = np.zeros((*variances.shape[:-1], n * n))
    out[..., :: n + 1] = variances
    return out


def _pose(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    return {
        **_header(stamp, who.map_frame),
        "pose.position": c["mocap_p"],
        "pose.orientation": c["mocap_q_xyzw"],
    }


def _odometry(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    return {
        **_header(stamp, who.odom_frame),
        "child_frame_id": who.base_frame,
        "pose.pose.position": c["odom_p"],
        "pose.pose.orientation": c["odom_q_xyzw"],
        "twist.twist.linear": c["odom_v"],
        "twist.twist.angular": c["odom_w"],
        "twist.covariance": _diagonal(np.square(who.odometry_std)),
    }


def _imu(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    speed = np.abs(c["odom_v"][:, :1]) if "odom_v" in c else np.zeros((len(stamp), 1))
    speed = np.where(np.isfinite(speed), speed, 0.0)
    rates = who.gyro_std**2 + (speed * np.array(who.gyro_vibration)) ** 2
    accelerations = who.accel_std**2 + (speed * np.array(who.accel_vibration)) ** 2
    return {
        **_header(stamp, who.imu_frame),
        "orientation": c["imu_q_xyzw"],
        "orientation_covariance": _diagonal([who.orientation_std**2] * 3),
        "angular_velocity": c["imu_w"],
        "angular_velocity_covariance": _diagonal(rates),
        "linear_acceleration": c["imu_a"],
        "linear_acceleration_covariance": _diagonal(accelerations),
    }


def _battery(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    unknown = np.nan
    return {
        **_header(stamp, who.base_frame),
        "voltage": c["battery_v"],
        "temperature": unknown,
        "current": -c["battery_a"],  # ROS counts what flows in
        "charge": unknown,
        "capacity": unknown,
        "design_capacity": unknown,
        "percentage": c["battery_fraction"],
        "power_supply_status": 2 * (c["battery_a"] > 0),  # discharging, else unknown
        "present": 1,
    }


def _magnitude(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    """The magnitude in x, as APRILab's robot publishes it, with the variance that is predicted for it."""
    zero = np.zeros(len(stamp))
    variance = c["b_sd_nt"] / _nt_per(who.unit) if "b_sd_nt" in c else zero
    variance = np.where(np.isfinite(variance), variance, 0.0) ** 2
    return {
        **_header(stamp, who.magnetometer_frame),
        "magnetic_field": np.column_stack([c["b_measured_nt"] / _nt_per(who.unit), zero, zero]),
        "magnetic_field_covariance": np.column_stack([variance, *[zero] * 8]),
    }


def _field(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    return {
        **_header(stamp, who.magnetometer_frame),
        "magnetic_field": c["b_vector_measured_nt"] / _nt_per(who.unit),
        "magnetic_field_covariance": _diagonal([(who.vector_std_nt / _nt_per(who.unit)) ** 2] * 3),
    }


def _command(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    zero = np.zeros(len(stamp))
    return {
        "linear": np.column_stack([c["v_cmd"], zero, zero]),
        "angular": np.column_stack([zero, zero, c["w_cmd"]]),
    }


def _joints(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    return {**_header(stamp, ""), "name": who.wheel_joints, "position": c["wheel_angle"]}


def _transforms(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    """From map to odom, such that base_link is where it truly is; to base_link; to each wheel."""
    p_odom, q_odom = c["odom_p"], c["odom_q_xyzw"]
    q = quat_multiply(c["q_world_base_xyzw"], quat_conjugate(q_odom))
    chain = [
        (who.map_frame, who.odom_frame, c["p_world_base"] - rotate(q, p_odom), q),
        (who.odom_frame, who.base_frame, p_odom, q_odom),
    ]
    if who.wheels is not None and "wheel_angle" in c:
        for wheel, angle in zip(who.wheels, c["wheel_angle"].T, strict=True):
            half = angle[:, None] / 2
            turn = np.concatenate([np.sin(half) * np.array(wheel.axis), np.cos(half)], axis=1)
            p = np.broadcast_to(np.array(wheel.p), (len(stamp), 3))
            chain.append((wheel.parent, wheel.name, p, quat_multiply(wheel.q_xyzw, turn)))
    fields: Fields = {"count": len(chain)}
    for k, (parent, child, p, turn) in enumerate(chain):
        fields |= {
            f"{k}.header.stamp": stamp,
            f"{k}.header.frame_id": parent,
            f"{k}.child_frame_id": child,
            f"{k}.transform.translation": p,
            f"{k}.transform.rotation": turn,
        }
    return fields


def _static(c: Columns, stamp: NDArray[np.int64], who: Sender) -> Fields:
    fields: Fields = {"count": len(who.links)}
    for k, link in enumerate(who.links):
        fields |= {
            f"{k}.header.stamp": stamp,
            f"{k}.header.frame_id": link.parent,
            f"{k}.child_frame_id": link.name,
            f"{k}.transform.translation": np.array(link.p),
            f"{k}.transform.rotation": np.array(link.q_xyzw),
        }
    return fields


def scan_fields(ranges_m: NDArray[np.float32], stamp: NDArray[np.int64], who: Sender) -> Fields:
    """LaserScans of ranges along `magtwin.sim.sensors.lidar.ray_angles`, all of a scan at one moment.

    Args:
        ranges_m: Ranges [m], shape (S, rays), as REP 117 has them.
        stamp: Moment of each scan [ns], shape (S,).
        who: The robot.
    """
    step = 2 * np.pi / ranges_m.shape[1]
    return {
        **_header(stamp, who.lidar_frame),
        "angle_min": -np.pi,
        "angle_max": np.pi - step,
        "angle_increment": step,
        "scan_time": 1 / who.scan_rate_hz if who.scan_rate_hz else 0.0,
        "range_min": who.range_m[0],
        "range_max": who.range_m[1],
        "ranges": ranges_m,
    }


def _nt_per(unit: Unit) -> float:
    return NT_PER_T if unit == "T" else 1.0


def _read_pose(position: str, orientation: str) -> Callable[[Fields], dict[str, NDArray[Any]]]:
    return lambda f: {"mocap_p": f[position], "mocap_q_xyzw": f[orientation]}


def _read_odometry(f: Fields) -> dict[str, NDArray[Any]]:
    return {
        "odom_p": f["pose.pose.position"],
        "odom_q_xyzw": f["pose.pose.orientation"],
        "odom_v": f["twist.twist.linear"],
        "odom_w": f["twist.twist.angular"],
    }


def _read_imu(f: Fields) -> dict[str, NDArray[Any]]:
    return {
        "imu_q_xyzw": f["orientation"],
        "imu_w": f["angular_velocity"],
        "imu_a": f["linear_acceleration"],
    }


def _read_battery(f: Fields) -> dict[str, NDArray[Any]]:
    return {
        "battery_v": f["voltage"].astype(float),
        "battery_a": -f["current"].astype(float),
        "battery_fraction": f["percentage"].astype(float),
    }


def _read_command(linear: str, angular: str) -> Callable[[Fields], dict[str, NDArray[Any]]]:
    return lambda f: {"v_cmd": f[linear][:, 0], "w_cmd": f[angular][:, 2]}


_POSES = {
    "geometry_msgs/msg/PoseStamped": ("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform.translation", "transform.rotation"),
    "nav_msgs/msg/Odometry": ("pose.pose.position", "pose.pose.orientation"),
}
_COMMANDS = {
    "geometry_msgs/msg/Twist": ("linear", "angular"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear", "twist.angular"),
}
_ODOMETRY = ("pose.pose.position", "pose.pose.orientation", "twist.twist.linear", "twist.twist.angular")
_IMU = ("orientation", "angular_velocity", "linear_acceleration")
_FIELD = "sensor_msgs/msg/MagneticField"

POSE = Topic(
    name="/robot/enu/pose",
    kind="geometry_msgs/msg/PoseStamped",
    needs=("mocap_p", "mocap_q_xyzw"),
    carries=("mocap_p", "mocap_q_xyzw"),
    lost="flag_pose_lost",
    write=_pose,
    read={kind: _read_pose(*names) for kind, names in _POSES.items()},
    leaves=_POSES,
)
ODOMETRY = Topic(
    name="/robot/odom",
    kind="nav_msgs/msg/Odometry",
    qos=SENSOR_DATA,
    needs=("odom_p", "odom_q_xyzw", "odom_v", "odom_w"),
    carries=("odom_p", "odom_q_xyzw", "odom_v", "odom_w"),
    write=_odometry,
    read={"nav_msgs/msg/Odometry": _read_odometry},
    leaves={"nav_msgs/msg/Odometry": _ODOMETRY},
)
IMU = Topic(
    name="/robot/imu",
    kind="sensor_msgs/msg/Imu",
    qos=SENSOR_DATA,
    needs=("imu_q_xyzw", "imu_w", "imu_a"),
    carries=("imu_q_xyzw", "imu_w", "imu_a"),
    write=_imu,
    read={"sensor_msgs/msg/Imu": _read_imu},
    leaves={"sensor_msgs/msg/Imu": _IMU},
)
BATTERY = Topic(
    name="/robot/battery_state",
    kind="sensor_msgs/msg/BatteryState",
    qos=SENSOR_DATA,
    needs=("battery_v", "battery_a", "battery_fraction"),
    carries=("battery_v", "battery_a", "battery_fraction"),
    every_s=4.0,
    write=_battery,
    read={"sensor_msgs/msg/BatteryState": _read_battery},
    leaves={"sensor_msgs/msg/BatteryState": ("voltage", "current", "percentage")},
)
MAGNITUDE = Topic(
    name="/robot/qtfm/magnitude",
    kind=_FIELD,
    needs=("b_measured_nt",),
    carries=("b_measured_nt",),
    sent="each",
    write=_magnitude,
    read={
        _FIELD: lambda f: {"magnetic_field": f["magnetic_field"]},
        "std_msgs/msg/Float64": lambda f: {"magnetic_field": f["data"]},
        "std_msgs/msg/Float32": lambda f: {"magnetic_field": f["data"].astype(float)},
    },
    leaves={
        _FIELD: ("magnetic_field",),
        "std_msgs/msg/Float64": ("data",),
        "std_msgs/msg/Float32": ("data",),
    },
)
VECTOR = Topic(
    name="/robot/qtfm/field",
    kind=_FIELD,
    needs=("b_vector_measured_nt",),
    carries=("b_vector_measured_nt",),
    sent="each",
    write=_field,
    read={_FIELD: lambda f: {"magnetic_field": f["magnetic_field"]}},
    leaves={_FIELD: ("magnetic_field",)},
)
COMMAND = Topic(
    name="/robot/cmd_vel",
    kind="geometry_msgs/msg/Twist",
    needs=("v_cmd", "w_cmd"),
    write=_command,
    read={kind: _read_command(*names) for kind, names in _COMMANDS.items()},
    leaves=_COMMANDS,
)
JOINTS = Topic(
    name="/robot/joint_states",
    kind="sensor_msgs/msg/JointState",
    needs=("wheel_angle",),
    sent="ticks",
    every_s=1 / 62,
    write=_joints,
    leaves={"sensor_msgs/msg/JointState": ("name", "position")},
)
TF = Topic(
    name="/tf",
    kind="tf2_msgs/msg/TFMessage",
    qos=Qos(depth=100),
    needs=("odom_p", "odom_q_xyzw", "p_world_base", "q_world_base_xyzw"),
    sent="ticks",
    every_s=1 / 62,
    write=_transforms,
)
CLOCK = Topic(
    name="/clock",
    kind="rosgraph_msgs/msg/Clock",
    qos=Qos(depth=1, reliable=False),
    needs=("t",),
    sent="ticks",
    every_s=0.025,
    write=lambda c, stamp, who: {"clock": stamp},
)
TF_STATIC = Topic(name="/tf_static", kind="tf2_msgs/msg/TFMessage", qos=LATCHED, sent="once", write=_static)
DESCRIPTION = Topic(
    name="/robot/robot_description",
    kind="std_msgs/msg/String",
    qos=LATCHED,
    sent="once",
    write=lambda c, stamp, who: {"data": who.description},
)
SCAN = Topic(
    name="/robot/scan",
    kind="sensor_msgs/msg/LaserScan",
    qos=SENSOR_DATA,
    write=lambda c, stamp, who: scan_fields(c["ranges_m"], stamp, who),
    leaves={"sensor_msgs/msg/LaserScan": ("header.stamp",)},
)
NAMES = Topic(
    name="/magtwin/columns",
    kind="std_msgs/msg/String",
    qos=LATCHED,
    sent="once",
    write=lambda c, stamp, who: {},  # what it says is known to who writes the table below
)
READING = Topic(
    name="/magtwin/reading",
    kind="std_msgs/msg/Float64MultiArray",
    sent="each",
    write=lambda c, stamp, who: {"data": c["data"]},
)

TOTAL_FIELD = Topic(
    name="/robot/qtfm/total_field_nt",
    kind="std_msgs/msg/Float64",
    needs=("b_measured_nt",),
    sent="each",
    write=lambda c, stamp, who: {"data": c["b_measured_nt"]},
)
"""The magnitude in nT, whatever the unit of the others; of live robots only, as bags have it in MAGNITUDE."""

TOPICS: Mapping[str, Topic] = MappingProxyType(
    {
        topic.name: topic
        for topic in (
            *(POSE, ODOMETRY, IMU, BATTERY, MAGNITUDE, VECTOR, COMMAND, JOINTS, SCAN),
            *(TF, TF_STATIC, DESCRIPTION, CLOCK, NAMES, READING),
        )
    }
)
"""Every topic by name. /magtwin/reading holds what no message of ROS carries, a number a part of a column in
the order that /magtwin/columns tells, and so does no robot."""
