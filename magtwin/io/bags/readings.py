"""Readings out of a rosbag2, sqlite3 or MCAP, without ROS: a survey that a robot drove.

Messages are decoded by the definitions that magtwin's own library has of them, never by those that a
bag brings along.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.survey.readings import Readings
from magtwin.field.units import GREATEST_MEAN_NT, LEAST_MEAN_NT, NT_PER, check_unit
from magtwin.files import existing, sha256
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate, yaw_from_quat
from magtwin.run.resample import linear, quaternion

Array = NDArray[np.float64]

ODOMETRY = "nav_msgs/msg/Odometry"

POSES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda m: (m.transform.translation, m.transform.rotation),
    ODOMETRY: lambda m: (m.pose.pose.position, m.pose.pose.orientation),
}
"""Types of messages that tell a pose: where in them position and orientation stand."""

FIELDS: dict[str, Callable[[Any], tuple[float, ...]]] = {
    "sensor_msgs/msg/MagneticField": lambda m: (m.magnetic_field.x, m.magnetic_field.y, m.magnetic_field.z),
    "std_msgs/msg/Float64": lambda m: (m.data,),
    "std_msgs/msg/Float32": lambda m: (m.data,),
}
"""Types of messages that tell a field: its three components, or its magnitude."""

GAP = 5.0
"""Poses farther apart than this many of their usual intervals are not interpolated between."""

LEAST_GAP_S = 0.1
"""Nor any farther apart than `GAP` intervals unless they are this near [s]."""


def read_bag_readings(
    path: str | os.PathLike[str],
    *,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    unit: Literal["nT", "uT", "T", "mG", "G"] | None = None,
    scale: float | None = None,
) -> Readings:
    """The readings of a bag: each message of the field, at the pose that the robot had at its stamp.

    Positions are interpolated linearly between poses, orientations along the great arc (slerp;
    Shoemake 1985, section 3.3). A message of the field before the first pose, after the last one, or in
    a gap of the poses is left out, and so is one without a number. Stamps are those of the headers;
    where a message has no header, or a stamp of 0, those of receipt, for both topics.

    Args:
        path: Folder of a rosbag2, or its storage file (.db3, .mcap).
        pose_topic: Topic of the poses, of a type in `POSES`; the only such topic unless given, or the only
            one that is not odometry, which drifts.
        field_topic: Topic of the field, of a type in `FIELDS`; the only such topic unless given.
        unit: Unit of the field; that which makes it the Earth's unless given: 1e-5..1e-4 is T,
            10,000..100,000 nT, and so on, which do not overlap.
        scale: Factor from the bag's values to nT, in place of a unit.

    Returns:
        Readings in the order of their stamps. A MagneticField with y = z = 0 is a magnitude in x, as
        APRILab's robot publishes it; another is a vector in the axes of the robot, which the poses
        make level.

    Raises:
        InputError: There is no bag, or it is damaged; a topic is missing, or there are several to
            choose from; no message of the field lies between poses; the unit cannot be.
    """
    path = existing(path, "bag")
    messages = _Bag(path)
    poses = messages.read("pose", pose_topic, POSES)
    fields = messages.read("field", field_topic, FIELDS)
    by_receipt = not (poses.stamped and fields.stamped)
    clock = "receipt" if by_receipt else "header"
    pose_t, pose = _in_order(poses.received if by_receipt else poses.header, poses.values)
    t, b = _in_order(fields.received if by_receipt else fields.header, fields.values)
    finite = np.isfinite(b).all(axis=1)
    p, q, inside = poses_at(t, pose_t, pose)
    known = finite & inside
    if not known.any():
        raise InputError(
            f"{path}: no field lies between poses: by the stamps of {clock} poses span "
            f"{_span(pose_t)}, the field {_span(t)}; are they of one clock?"
        )
    t, b, p, q = t[known], b[known], p[known], q[known]
    vector = b if b.shape[1] == 3 and np.any(b[:, 1:] != 0) else None
    size = np.abs(b[:, 0]) if vector is None else np.linalg.norm(b, axis=1)
    if scale is not None:
        factor, label, told = scale, f"units of {scale:g} nT", "given"
    else:
        label = unit or unit_of(float(size.mean()), path, fields.topic)
        factor, told = NT_PER[label], "given" if unit else "told by its size"
    check_unit(factor * size, str(path), fields.topic, "nT" if scale else label, scale=scale)
    nought = np.flatnonzero(size == 0)
    if len(nought):
        raise InputError(
            f"{path}: {fields.topic} is 0 {label} at {t[nought[0]]:.3f} s; a magnitude is above 0"
        )
    level = None
    if vector is not None:
        level = factor * rotate(quat_conjugate(quat_from_yaw(yaw_from_quat(q))), rotate(q, vector))
    left = f", {np.count_nonzero(~known)} of {len(known)} fields not between poses or not a number left out"
    return Readings(
        p_xy=p[:, :2],
        yaw=yaw_from_quat(q),
        b_nt=factor * size,
        b_body_nt=level,
        t=t - t[0],
        runs=(path.stem,),
        name=path.stem,
        source=f"{messages.sums()} (poses {poses.topic}, field {fields.topic} in {label}, {told}; stamps of "
        f"{clock}{left if not known.all() else ''})",
    )


class _Topic:
    """The messages of a topic."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.received: Any = []
        self.header: Any = []
        self.values: Any = []

    def add(self, received_ns: int, stamp: Any, values: tuple[float, ...]) -> None:
        self.received.append(received_ns)
        self.header.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        self.values.append(values)

    @property
    def stamped(self) -> bool:
        """Whether every message has a stamp in its header."""
        return all(self.header)


class _Bag:
    """A rosbag2; every fault of its bytes is refused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise InputError(f"{path}: no bag: metadata.yaml is missing; give the folder that holds it")
        self.types = dict(self._refusing(self._topics))

    def sums(self) -> str:
        """Its storage files with checksums."""
        files = [self.path] if self.path.is_file() else sorted(self.path.iterdir())
        return "; ".join(f"{f.name} sha256:{sha256(f)}" for f in files if f.is_file())

    def read(
        self, kind: str, topic: str | None, known: dict[str, Callable[[Any], tuple[Any, ...]]]
    ) -> _Topic:
        """All messages of a topic, or of the only one of a known type, odometry last."""
        topic = self._choose(kind, topic, known)
        messages: _Topic = self._refusing(lambda: self._messages(topic, known[self.types[topic]]))
        if not messages.values:
            raise InputError(f"{self.path}: topic {topic} has no message")
        return messages

    def _choose(self, kind: str, topic: str | None, known: dict[str, Any]) -> str:
        fitting = sorted(t for t, of in self.types.items() if of in known)
        option = f"--{kind}-topic"
        if topic is not None:
            if topic not in self.types:
                raise InputError(f"{self.path}: no topic {topic!r}; {hint(topic, self.types)}")
            if topic not in fitting:
                kinds = ", ".join(known)
                raise InputError(
                    f"{self.path}: topic {topic} is a {self.types[topic]}; a {kind} is one of {kinds}"
                )
            return topic
        if not fitting:
            seen = ", ".join(f"{t} ({of})" for t, of in sorted(self.types.items())) or "none"
            raise InputError(f"{self.path}: no topic of a {kind} ({', '.join(known)}); topics in it: {seen}")
        fixed = [t for t in fitting if self.types[t] != ODOMETRY]
        if len(fitting) > 1 and len(fixed) == 1:
            return fixed[0]
        if len(fitting) > 1:
            raise InputError(
                f"{self.path}: {len(fitting)} topics of a {kind}, {', '.join(fitting)}; choose with {option}"
            )
        return fitting[0]

    def _topics(self) -> list[tuple[str, str]]:
        from rosbags.rosbag2 import Reader

        with Reader(self.path) as reader:
            return [(c.topic, c.msgtype) for c in reader.connections]

    def _messages(self, topic: str, parts: Callable[[Any], tuple[Any, ...]]) -> _Topic:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        found = _Topic(topic)
        with Reader(self.path) as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for connection, received_ns, data in reader.messages(connections=connections):
                message: Any = store.deserialize_cdr(data, connection.msgtype)
                values = parts(message)
                if len(values) == 2:
                    p, q = values
                    values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
                header = getattr(message, "header", None)
                found.add(received_ns, header and header.stamp, values)
        return found

    def _refusing(self, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except (InputError, MemoryError):
            raise
        except (
            Exception
        ) as error:  # rosbags raises of all kinds on damaged bytes: sqlite's, struct's, its own
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{self.path}: damaged bag, or none ({reason[:200]})") from error


def _in_order(stamps_ns: list[int], values: list[tuple[float, ...]]) -> tuple[Array, Array]:
    """Times [s], ascending, each once, and the values at them."""
    ns, first = np.unique(np.array(stamps_ns, np.int64), return_index=True)
    return ns / 1e9, np.array(values, float)[first]


def poses_at(t: Array, pose_t: Array, pose: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Positions (N, 3) and orientations xyzw (N, 4) at times `t`, and whether poses tell them."""
    sound = np.isfinite(pose).all(axis=1)
    length = np.linalg.norm(pose[:, 3:], axis=1)
    sound &= np.abs(length - 1) < 0.01
    pose_t, pose = pose_t[sound], pose[sound]
    if len(pose_t) < 2:
        return np.zeros((len(t), 3)), np.zeros((len(t), 4)), np.zeros(len(t), bool)
    steps = np.diff(pose_t)
    widest = max(GAP * float(np.median(steps)), LEAST_GAP_S)
    low = np.clip(np.searchsorted(pose_t, t, side="right") - 1, 0, len(steps) - 1)
    part = (t - pose_t[low]) / steps[low]
    bridged = (steps[low] <= widest) | (part == 0) | (part == 1)
    inside = (part >= 0) & (part <= 1) & bridged
    share = np.clip(part, 0, 1)
    q = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return linear(pose[:, :3], low, share), quaternion(q, low, share), inside


def unit_of(mean: float, path: Path, topic: str) -> Any:
    """The unit in which a magnitude of this mean is the Earth's field; the units' ranges do not overlap."""
    for unit, factor in NT_PER.items():
        if LEAST_MEAN_NT <= mean * factor < GREATEST_MEAN_NT:
            return unit
    raise InputError(f"{path}: the mean of {topic} is {mean:.6g}; in no unit is that the Earth's field")


def _span(t: Array) -> str:
    return f"{t[0]:.3f}..{t[-1]:.3f} s"
