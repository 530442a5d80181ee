"""Poses: messages of estimated poses, clouds and starts, and back."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw, yaw_from_quat
from magtwin.localization.problem import Array, Prior
from magtwin.ros.bus import Message, poses_bytes, to_bytes

POSE_KIND = "geometry_msgs/msg/PoseWithCovarianceStamped"
CLOUD_KIND = "geometry_msgs/msg/PoseArray"
LOST_KIND = "std_msgs/msg/Bool"
PATH_KIND = "nav_msgs/msg/Path"

ESTIMATE, CLOUD, LOST = "estimate/pose", "estimate/particles", "estimate/lost"
PATH = "estimate/path"
"""Topics of a localizer, in the robot's namespace."""

INITIAL = "/initialpose"
"""Topic on which RViz and others set a pose."""

START_SD = (0.1, 0.1, math.radians(5))
"""Standard deviation of a pose that comes without one: x, y [m] and yaw [rad]."""

PLANAR = (0, 1, 5)
"""Rows of x, y and yaw in the 6 x 6 covariance of a pose, whose order is x, y, z, roll, pitch, yaw."""


def pose_bytes(
    stamp_ns: int, frame: str, pose: tuple[float, float, float], covariance: NDArray[Any] | None
) -> bytes:
    """A PoseWithCovarianceStamped of x, y [m] and yaw [rad]; a covariance of None is sent as zeros."""
    whole = np.zeros((6, 6))
    if covariance is not None:
        whole[np.ix_(PLANAR, PLANAR)] = covariance
    x, y, yaw = pose
    fields = {
        "header.stamp": np.int64(stamp_ns),
        "header.frame_id": frame,
        "pose.pose.position": [x, y, 0.0],
        "pose.pose.orientation": quat_from_yaw(yaw),
        "pose.covariance": whole.ravel(),
    }
    return to_bytes(POSE_KIND, fields)


def read_pose(message: Message) -> tuple[int, str, Array, Array | None]:
    """Stamp [ns], frame, x, y [m], yaw [rad] and covariance (3, 3) of a PoseWithCovarianceStamped.

    The covariance is None if all of it is 0, which means unknown.

    Raises:
        InputError: A number is not finite, or the quaternion has not the length 1.
    """
    p, q, c = "pose.pose.position", "pose.pose.orientation", "pose.covariance"
    read = message.read(["header.stamp", "header.frame_id", p, q, c])
    whole = np.asarray(read[c], float).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]
    numbers = np.concatenate([read[p][:2], read[q], whole.ravel()])
    if not np.isfinite(numbers).all() or abs(float(np.linalg.norm(read[q])) - 1) > 0.1:
        raise InputError("a pose whose numbers are not finite, or whose quaternion has not the length 1")
    pose = np.array([*read[p][:2], float(yaw_from_quat(np.asarray(read[q], float)))])
    return int(read["header.stamp"]), str(read["header.frame_id"]), pose, whole if whole.any() else None


def prior_from(message: Message) -> tuple[str, Prior]:
    """Frame and prior of a message on /initialpose; without a covariance, 0.1 m and 5 deg.

    Raises:
        InputError: As for `read_pose`.
    """
    _, frame, pose, covariance = read_pose(message)
    sd = START_SD
    if covariance is not None and (covariance.diagonal() > 0).all():
        x, y, yaw = np.sqrt(covariance.diagonal()).tolist()
        sd = (x, y, yaw)
    x, y, yaw = pose.tolist()
    return frame, Prior(mean=(x, y, yaw), sd=sd)


def cloud_bytes(stamp_ns: int, frame: str, cloud: Array, most: int) -> bytes:
    """A PoseArray of at most `most` particles, drawn evenly by weight.

    Args:
        stamp_ns: Stamp [ns].
        frame: Frame of the poses.
        cloud: x, y [m], yaw [rad] and weight of each particle, shape (P, 4).
        most: Largest number of poses, which have the same weight.
    """
    total = np.cumsum(cloud[:, 3])
    count = min(most, len(cloud))
    rows = np.searchsorted(total, (np.arange(count) + 0.5) / max(count, 1) * total[-1])
    kept = cloud[np.minimum(rows, len(cloud) - 1)]
    table = np.column_stack([kept[:, :2], np.zeros(count), quat_from_yaw(kept[:, 2])])
    return poses_bytes(CLOUD_KIND, stamp_ns, frame, table)
