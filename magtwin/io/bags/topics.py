"""Topics: what each ROS 2 topic of the robot carries, from the columns of a Run and back.

One table, for bags and for live robots. Its functions turn columns into fields of messages, which are arrays
by leaf name (`pose.position`, shape (M, 3)), and fields into columns. They use neither bytes nor a ROS
library. Magnetic fields are in tesla, as in ROS, or in nT, as APRILab's robot publishes them.

A Run holds slower signals causally on the magnetometer's clock. A message is therefore sent at the first
reading that has its value.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import enu_from_ned, quat_conjugate, quat_multiply, rotate
from magtwin.io.bags.sender import Sender

Array = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]
Fields = dict[str, Any]

NT_PER_T = 1e9


@dataclass(frozen=True)
class Qos:
    """Quality of service of a topic."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False  # Whether late subscribers get the last message (transient local)

    @property
    def heard(self) -> "Qos":
        """QoS of a subscription: best effort, which matches every publisher; reliable only if latched."""
        return replace(self, reliable=self.latched)


SENSOR_DATA = Qos(depth=5, reliable=False)
"""For subscriptions: it matches every publisher. Offers are reliable, which serves every subscriber."""

LATCHED = Qos(depth=1, latched=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class Topic:
    """A topic: its name, its message type, and the columns that it carries."""

    name: str
    kind: str  # Message type
    qos: Qos = field(default_factory=Qos)
    needs: tuple[str, ...] = ()  # Columns without which it is not written
    carried: bool = False  # Whether a bag's reader takes the columns of `needs` from this topic
    # When messages are sent: when a needed column changes and again every `every_s` while it stays; at each
    # reading that has a value; in even steps of `every_s`; or once
    sent: Literal["changed", "each", "ticks", "once"] = "changed"
    every_s: float = 0.1  # Time after which an unchanged value is sent again, or the length of a step [s]
    lost: str = ""  # Column of flags that suspend sending again
    frame: str = ""  # Attribute of the sender with the frame of the header. Default: no header.
    # Columns of flags that select the text of a message; messages are written for equal flags at a time
    by: tuple[str, ...] = ()
    # Fields of messages beyond the header and the columns of `reads`; also called with the stamps [ns]
    more: Callable[[Columns, NDArray[np.int64], Sender], Fields] = lambda c, stamp, sender: {}
    # By message type: the leaf of each column that is read, a leaf and an index, or several leaves
    reads: Mapping[str, Mapping[str, str | tuple[str, int] | tuple[str, ...]]] = field(default_factory=dict)
    # By message type: the columns in the axes of REP 103, of columns in others
    turned: Mapping[str, Callable[[dict[str, Array]], dict[str, Array]]] = field(default_factory=dict)

    def write(self, c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
        """Fields of messages, from the columns of some rows and their stamps [ns]."""
        fields = _header(stamp, getattr(sender, self.frame)) if self.frame else {}
        carried = self.reads.get(self.kind, {}).items()
        fields |= {leaf: c[name] for name, leaf in carried if name in self.needs and isinstance(leaf, str)}
        return fields | self.more(c, stamp, sender)

    def leaves(self, kind: str) -> list[str]:
        """Names of the leaves of a message type that are read."""
        leaves = [(leaf,) if isinstance(leaf, str) else leaf for leaf in self.reads[kind].values()]
        return [name for parts in leaves for name in parts if isinstance(name, str)]

    def read(self, kind: str, fields: Fields) -> dict[str, NDArray[Any]]:
        """The columns that the fields of messages give."""
        columns = {}
        for name, leaf in self.reads[kind].items():
            if isinstance(leaf, str):
                values = fields[leaf]
            elif isinstance(leaf[1], int):
                values = fields[leaf[0]][:, leaf[1]]
            else:
                values = np.stack([fields[str(part)] for part in leaf], axis=-1)
            # ROS counts current into the battery, magtwin out of it
            columns[name] = -values.astype(float) if name == "battery_a" else values.astype(float, copy=False)
        return self.turned[kind](columns) if kind in self.turned else columns


def nt_per(sender: Sender) -> float:
    """Nanotesla per unit of magnetic field in a sender's messages."""
    return NT_PER_T if sender.unit == "T" else 1.0


def _header(stamp: NDArray[np.int64], frame: str) -> Fields:
    return {"header.stamp": stamp, "header.frame_id": frame}


def _diagonal(variances: Any) -> Array:
    """Covariance matrices of independent errors, row by row, shape (..., n) -> (..., n * n)."""
    variances = np.asarray(variances, float)
    n = variances.shape[-1]
    out = np.zeros((*variances.shape[:-1], n * n))
    out[..., :: n + 1] = variances
    return out


def _odometry(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    covariance = _diagonal(np.square(sender.odometry_std))
    return {"child_frame_id": sender.base_frame, "twist.covariance": covariance}


def _imu(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    speed = np.abs(c["odom_v"][:, :1]) if "odom_v" in c else np.zeros((len(stamp), 1))
    speed = np.where(np.isfinite(speed), speed, 0.0)
    rates = sender.gyro_std**2 + (speed * np.array(sender.gyro_vibration)) ** 2
    accelerations = sender.accel_std**2 + (speed * np.array(sender.accel_vibration)) ** 2
    return {
        "orientation_covariance": _diagonal([sender.orientation_std**2] * 3),
        "angular_velocity_covariance": _diagonal(rates),
        "linear_acceleration_covariance": _diagonal(accelerations),
    }


def _battery(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    unknown = dict.fromkeys(("temperature", "charge", "capacity", "design_capacity"), np.nan)
    discharging = 2 * (c["battery_a"] > 0)  # else unknown
    return {**unknown, "current": -c["battery_a"], "power_supply_status": discharging, "present": 1}


def _magnitude(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    """The magnitude in x, as APRILab's robot publishes it, with its predicted variance."""
    zero = np.zeros(len(stamp))
    sd = c["b_sd_nt"] / nt_per(sender) if "b_sd_nt" in c else zero
    variance = np.where(np.isfinite(sd), sd, 0.0) ** 2
    return {
        "magnetic_field": np.column_stack([c["b_measured_nt"] / nt_per(sender), zero, zero]),
        "magnetic_field_covariance": np.column_stack([variance, *[zero] * 8]),
    }


def _field(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    return {
        "magnetic_field": c["b_vector_measured_nt"] / nt_per(sender),
        "magnetic_field_covariance": _diagonal([(sender.vector_std_nt / nt_per(sender)) ** 2] * 3),
    }


def _command(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    zero = np.zeros(len(stamp))
    return {
        "linear": np.column_stack([c["v_cmd"], zero, zero]),
        "angular": np.column_stack([zero, zero, c["w_cmd"]]),
    }


def _joints(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    """Angles of the wheels' joints, all of which robot_state_publisher needs to place the links."""
    joints = sender.wheel_joints
    angle = c["wheel_angle"][:, [joint.side for joint in joints]] * [float(joint.sense) for joint in joints]
    return {**_header(stamp, ""), "name": tuple(joint.name for joint in joints), "position": angle}


def transform_fields(stamp: Any, transforms: list[tuple[str, str, Any, Any]]) -> Fields:
    """A TFMessage of transforms: parent, child, translation and rotation (xyzw) of each."""
    fields: Fields = {"transforms": len(transforms)}
    for k, (parent, child, p, q_xyzw) in enumerate(transforms):
        fields |= {
            f"transforms.{k}.header.stamp": stamp,
            f"transforms.{k}.header.frame_id": parent,
            f"transforms.{k}.child_frame_id": child,
            f"transforms.{k}.transform.translation": p,
            f"transforms.{k}.transform.rotation": q_xyzw,
        }
    return fields


def map_to_odom(p_base: Array, q_base: Array, p_odom: Array, q_odom: Array) -> tuple[Array, Array]:
    """Translation and rotation of odom in the map that put base_link at a pose; poses as p and xyzw."""
    q = quat_multiply(q_base, quat_conjugate(q_odom))
    return p_base - rotate(q, p_odom), q


def _transforms(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    """Of the drive, what `sender.transforms` asks for; then base_link to each wheel.

    Map to odom is such that base_link is at its true pose. Where another node publishes map to odom, the true
    pose is a frame of its own in the map.
    """
    p_odom, q_odom = c["odom_p"], c["odom_q_xyzw"]
    p_base, q_base = c["p_world_base"], c["q_world_base_xyzw"]
    chain: list[tuple[str, str, Any, Any]] = []
    if sender.transforms == "all":
        chain.append((sender.map_frame, sender.odom_frame, *map_to_odom(p_base, q_base, p_odom, q_odom)))
    else:
        chain.append((sender.map_frame, sender.truth_frame, p_base, q_base))
    if sender.transforms != "none":
        chain.append((sender.odom_frame, sender.base_frame, p_odom, q_odom))
    if sender.wheels and "wheel_angle" in c:
        for wheel, joint in zip(sender.wheels, sender.wheel_joints, strict=True):
            half = c["wheel_angle"][:, joint.side, None] / 2
            turn = np.concatenate([np.sin(half) * np.array(wheel.axis), np.cos(half)], axis=1)
            p = np.broadcast_to(np.array(wheel.p), (len(stamp), 3))
            chain.append((wheel.parent, wheel.name, p, quat_multiply(wheel.q_xyzw, turn)))
    return transform_fields(stamp, chain)


def _static(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    links = [(link.parent, link.name, np.array(link.p), np.array(link.q_xyzw)) for link in sender.links]
    return transform_fields(stamp, links)


_FAULTS: Mapping[str, tuple[str, int, str]] = {
    "flag_lost_lock": ("magnetometer", 2, "it lost lock"),
    "flag_outside_map": ("magnetometer", 1, "outside the map"),
    "flag_out_of_distribution": ("network", 1, "an input left its training range"),
    "flag_pose_lost": ("motion capture", 1, "it lost the robot"),
    "flag_bump": ("drive", 1, "it touched an obstacle"),
}
"""By flag: the part that it is about, its level in a DiagnosticStatus (1: warn, 2: error), and its text."""


def _diagnosed(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    """The state of each part of the robot; the flags of all rows are equal."""
    known = {flag: fault for flag, fault in _FAULTS.items() if flag in c}
    fields: Fields = {"header.stamp": stamp, "status": len({part for part, _, _ in known.values()})}
    for k, name in enumerate(dict.fromkeys(part for part, _, _ in known.values())):
        faults = [(level, text) for flag, (part, level, text) in known.items() if part == name and c[flag][0]]
        fields |= {
            f"status.{k}.name": name,
            f"status.{k}.level": max((level for level, _ in faults), default=0),
            f"status.{k}.message": "; ".join(text for _, text in faults) or "ok",
            f"status.{k}.values": 0,
        }
    return fields


def _scan(c: Columns, stamp: NDArray[np.int64], sender: Sender) -> Fields:
    """Ranges along `magtwin.sim.sensors.lidar.ray_angles`, as in REP 117; one stamp per scan."""
    step = 2 * np.pi / c["ranges_m"].shape[1]
    return {
        "angle_min": -np.pi,
        "angle_max": np.pi - step,
        "angle_increment": step,
        "scan_time": 1 / sender.scan_rate_hz if sender.scan_rate_hz else 0.0,
        "range_min": sender.range_m[0],
        "range_max": sender.range_m[1],
        "ranges": c["ranges_m"],
    }


def _pose_at(prefix: str, p: str = "position", q: str = "orientation") -> dict[str, str]:
    return {"mocap_p": prefix + p, "mocap_q_xyzw": prefix + q}


def _carrier(
    kind: str, leaves: dict[str, str], others: Mapping[str, Any] = MappingProxyType({}), **rest: Any
) -> Topic:
    """A topic whose message type holds each of its columns in a leaf; `others` are `reads` of other types."""
    return Topic(kind=kind, needs=tuple(leaves), carried=True, reads={kind: leaves, **others}, **rest)


def _of_frd(columns: dict[str, Array]) -> dict[str, Array]:
    """Vectors in forward-right-down axes as forward-left-up."""
    return {name: values * (1.0, -1.0, -1.0) for name, values in columns.items()}


def _of_ned(columns: dict[str, Array], name: str = "odom") -> dict[str, Array]:
    """Odometry of PX4, from north-east-down and forward-right-down to ENU and forward-left-up.

    Its quaternion is w first, and its velocity is in north-east-down.
    """
    q_ned_frd = columns[f"{name}_q_xyzw"][:, [1, 2, 3, 0]]
    p = columns[f"{name}_p"][:, [1, 0, 2]] * (1.0, 1.0, -1.0)
    turned = _of_frd({"odom_w": columns["odom_w"]}) if "odom_w" in columns else {}
    if "odom_v" in columns:
        turned |= _of_frd({"odom_v": rotate(quat_conjugate(q_ned_frd), columns["odom_v"])})
    return {f"{name}_p": p, f"{name}_q_xyzw": enu_from_ned(q_ned_frd)} | turned


def _of_array(columns: dict[str, Array]) -> dict[str, Array]:
    """Vectors of three numbers, or magnitudes, of messages that hold any number of numbers."""
    for name, values in columns.items():
        if values.shape[1] not in (1, 3):
            count = values.shape[1]
            raise InputError(f"its {name} has {count} numbers; a magnitude is one, a vector x, y, z")
    return {name: values if values.shape[1] == 3 else values[:, 0] for name, values in columns.items()}


PATH_KIND = "nav_msgs/msg/Path"  # Whose last message has the poses driven so far, if each has a stamp
_PX4 = "px4_msgs/msg/"
_FIELD = "sensor_msgs/msg/MagneticField"
_ARRAYS = {f"std_msgs/msg/Float{size}MultiArray": {"magnetic_field": "data"} for size in (64, 32)}

POSE = _carrier(
    "geometry_msgs/msg/PoseStamped",
    _pose_at("pose."),
    {
        "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_at("pose.pose."),
        "geometry_msgs/msg/TransformStamped": _pose_at("transform.", "translation", "rotation"),
        "nav_msgs/msg/Odometry": _pose_at("pose.pose."),
        _PX4 + "VehicleOdometry": {"mocap_p": "position", "mocap_q_xyzw": "q"},
        PATH_KIND: _pose_at("poses."),
    },
    turned={_PX4 + "VehicleOdometry": lambda c: _of_ned(c, "mocap")},
    name="/robot/enu/pose",
    lost="flag_pose_lost",
    frame="map_frame",
)
ODOMETRY = _carrier(
    "nav_msgs/msg/Odometry",
    {
        "odom_p": "pose.pose.position",
        "odom_q_xyzw": "pose.pose.orientation",
        "odom_v": "twist.twist.linear",
        "odom_w": "twist.twist.angular",
    },
    {
        _PX4 + "VehicleOdometry": {
            "odom_p": "position",
            "odom_q_xyzw": "q",
            "odom_v": "velocity",
            "odom_w": "angular_velocity",
        }
    },
    turned={_PX4 + "VehicleOdometry": _of_ned},
    name="/robot/odom",
    frame="odom_frame",
    more=_odometry,
)
IMU = _carrier(
    "sensor_msgs/msg/Imu",
    {"imu_q_xyzw": "orientation", "imu_w": "angular_velocity", "imu_a": "linear_acceleration"},
    {_PX4 + "SensorCombined": {"imu_w": "gyro_rad", "imu_a": "accelerometer_m_s2"}},
    turned={_PX4 + "SensorCombined": lambda c: _of_frd(c) | {"imu_q_xyzw": np.zeros((len(c["imu_w"]), 4))}},
    name="/robot/imu",
    frame="imu_frame",
    more=_imu,
)
BATTERY = _carrier(
    "sensor_msgs/msg/BatteryState",
    {"battery_v": "voltage", "battery_a": "current", "battery_fraction": "percentage"},
    name="/robot/battery_state",
    every_s=4.0,
    frame="base_frame",
    more=_battery,
)
MAGNITUDE = Topic(
    name="/robot/qtfm/magnitude",
    kind=_FIELD,
    needs=("b_measured_nt",),
    carried=True,
    sent="each",
    frame="magnetometer_frame",
    more=_magnitude,
    reads={
        _FIELD: {"magnetic_field": "magnetic_field"},
        "geometry_msgs/msg/Vector3Stamped": {"magnetic_field": "vector"},
        "geometry_msgs/msg/Vector3": {"magnetic_field": ("x", "y", "z")},
        "std_msgs/msg/Float64": {"magnetic_field": "data"},
        "std_msgs/msg/Float32": {"magnetic_field": "data"},
        **_ARRAYS,
        _PX4 + "VehicleMagnetometer": {"magnetic_field": "magnetometer_ga"},
        _PX4 + "SensorMag": {"magnetic_field": ("x", "y", "z")},
    },
    turned=dict.fromkeys((_PX4 + "VehicleMagnetometer", _PX4 + "SensorMag"), _of_frd)
    | dict.fromkeys(_ARRAYS, _of_array),
)
VECTOR = Topic(
    name="/robot/qtfm/field",
    kind=_FIELD,
    needs=("b_vector_measured_nt",),
    carried=True,
    sent="each",
    frame="magnetometer_frame",
    more=_field,
    reads={
        _FIELD: {"magnetic_field": "magnetic_field"},
        "geometry_msgs/msg/Vector3Stamped": {"magnetic_field": "vector"},
        **_ARRAYS,
    },
    turned=dict.fromkeys(_ARRAYS, _of_array),
)
COMMAND = Topic(
    name="/robot/cmd_vel",
    kind="geometry_msgs/msg/Twist",
    needs=("v_cmd", "w_cmd"),
    more=_command,
    reads={
        "geometry_msgs/msg/Twist": {"v_cmd": ("linear", 0), "w_cmd": ("angular", 2)},
        "geometry_msgs/msg/TwistStamped": {"v_cmd": ("twist.linear", 0), "w_cmd": ("twist.angular", 2)},
    },
)
JOINTS = Topic(
    name="/robot/joint_states",
    kind="sensor_msgs/msg/JointState",
    needs=("wheel_angle",),
    sent="ticks",
    every_s=1 / 62,
    more=_joints,
)
TF = Topic(
    name="/tf",
    kind="tf2_msgs/msg/TFMessage",
    qos=Qos(depth=100),
    needs=("odom_p", "odom_q_xyzw", "p_world_base", "q_world_base_xyzw"),
    sent="ticks",
    every_s=1 / 62,
    more=_transforms,
)
CLOCK = Topic(
    name="/clock",
    kind="rosgraph_msgs/msg/Clock",
    needs=("t",),
    sent="ticks",
    every_s=0.025,
    more=lambda c, stamp, sender: {"clock": stamp},
)
TF_STATIC = Topic(name="/tf_static", kind="tf2_msgs/msg/TFMessage", qos=LATCHED, sent="once", more=_static)
DESCRIPTION = Topic(
    name="/robot/robot_description",
    kind="std_msgs/msg/String",
    qos=LATCHED,
    sent="once",
    more=lambda c, stamp, sender: {"data": sender.description},
)
SCAN = Topic(
    name="/robot/scan",
    kind="sensor_msgs/msg/LaserScan",
    frame="lidar_frame",
    more=_scan,
    reads={"sensor_msgs/msg/LaserScan": {"stamp": "header.stamp"}},
)
OCCUPANCY = Topic(name="/map", kind="nav_msgs/msg/OccupancyGrid", qos=LATCHED, sent="once")
FIELD = Topic(name="/anomaly_map", kind="sensor_msgs/msg/PointCloud2", qos=LATCHED, sent="once")
DIAGNOSTICS = Topic(
    name="/diagnostics",
    kind="diagnostic_msgs/msg/DiagnosticArray",
    needs=("t",),
    sent="ticks",
    every_s=1.0,
    more=_diagnosed,
    by=tuple(_FAULTS),
)
NAMES = Topic(name="/magtwin/columns", kind="std_msgs/msg/String", qos=LATCHED, sent="once")
READING = Topic(
    name="/magtwin/reading",
    kind="std_msgs/msg/Float64MultiArray",
    sent="each",
    more=lambda c, stamp, sender: {"data": c["data"]},
)

TOPICS: Mapping[str, Topic] = MappingProxyType(
    {
        topic.name: topic
        for topic in (
            *(POSE, ODOMETRY, IMU, BATTERY, MAGNITUDE, VECTOR, COMMAND, JOINTS, SCAN),
            *(TF, TF_STATIC, DESCRIPTION, CLOCK, DIAGNOSTICS, OCCUPANCY, FIELD, NAMES, READING),
        )
    }
)
"""Topics by name. /magtwin/reading holds the columns that no ROS message carries, in the order that
/magtwin/columns gives."""
