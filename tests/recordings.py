"""Recordings of a robot, message by message, as bags."""

import json
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from magtwin.io.bags import RawBagWriter
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.topics import Qos
from magtwin.ros.bus import to_bytes

STORE = get_typestore(Stores.ROS2_HUMBLE)
START, NS = 1_700_000_000, 10**9
"""Time of the first message [s], and nanoseconds in a second."""

UPRIGHT = Rotation.identity()


def stamped(t, frame=""):
    """The header of a message at a time since `START` [s]; None leaves its stamp 0."""
    ns = 0 if t is None else START * NS + round(t * NS)
    return {"header.stamp": np.int64(ns), "header.frame_id": frame}


def magnetic(t, *b, frame="mag_link", kind="sensor_msgs/msg/MagneticField"):
    """A field; one component is in x."""
    b = np.array([*b, 0.0, 0.0][:3], float)
    return kind, {**stamped(t, frame), "magnetic_field" if "Magnetic" in kind else "vector": b}


def pose(
    t, p, q, kind="geometry_msgs/msg/PoseStamped", *, frame="map", child="base_link", v=(0, 0, 0), w=(0, 0, 0)
):
    """A pose of any type."""
    place = {"PoseStamped": "pose.", "TransformStamped": "transform."}.get(
        kind.rpartition("/")[2], "pose.pose."
    )
    leaves = ("translation", "rotation") if place == "transform." else ("position", "orientation")
    fields = dict(zip((place + leaf for leaf in leaves), (np.array(p, float), q.as_quat()), strict=True))
    twist = {"twist.twist.linear": np.array(v, float), "twist.twist.angular": np.array(w, float)}
    more = twist | {"child_frame_id": child} if "Odometry" in kind else {"child_frame_id": child}
    return kind, stamped(t, frame) | fields | (
        more if kind.endswith(("Odometry", "TransformStamped")) else {}
    )


def inertial(t, q, w, a, frame="imu_link"):
    """An IMU's message."""
    fields = {"orientation": q.as_quat() if isinstance(q, Rotation) else np.array(q)}
    fields |= {"angular_velocity": np.array(w, float), "linear_acceleration": np.array(a, float)}
    return "sensor_msgs/msg/Imu", stamped(t, frame) | fields


def moved(t, *transforms):
    """A TFMessage of transforms: parent, child, place and rotation."""
    fields = {"transforms": len(transforms)}
    for k, (parent, child, p, q) in enumerate(transforms):
        each = stamped(t, parent) | {"child_frame_id": child}
        each |= {"transform.translation": np.array(p, float), "transform.rotation": q.as_quat()}
        fields |= {f"transforms.{k}.{name}": value for name, value in each.items()}
    return "tf2_msgs/msg/TFMessage", fields


def record(path, topics):
    """A bag of messages: by topic a list of time of receipt [s], type and fields."""
    writer = RawBagWriter(path)
    for topic, said in topics.items():
        for t, kind, fields in said or [(None, "geometry_msgs/msg/PoseStamped", {})]:
            writer.add(topic, kind, Qos())
            if t is not None:
                writer.write(topic, START * NS + round(t * NS), to_bytes(kind, fields))
    writer.close()
    return path


def as_db3(source, target):
    """A bag as rosbags writes it in sqlite3: a folder, or a file if the name of the target ends in .db3."""
    folder = Path(target).with_suffix("")
    with Bag(source) as bag:
        metadata = bag.metadata()
    with Reader(source) as reader, Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        links = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=STORE) for c in reader.connections}
        for connection, t, data in reader.messages():
            writer.write(links[connection.id], t, data)
        for name, value in metadata.items():
            writer.set_custom_data(f"magtwin.{name}", json.dumps(value))
    if folder != Path(target):
        next(folder.glob("*.db3")).rename(target)
        (folder / "metadata.yaml").unlink()
        folder.rmdir()
    return target
