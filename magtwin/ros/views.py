"""Views: what RViz and Foxglove show of a simulation: maps of the lab, readings and the path driven."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import rotate
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.lab import cloud_fields, lab_fields
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.stream import Sent
from magtwin.ros.bus import Bus, Publisher, poses_bytes, to_bytes
from magtwin.ros.topics import PATH, READINGS
from magtwin.run.run import Run
from magtwin.twin import Twin

STEP_M = 0.05
"""Distance between poses of a path [m]."""

MOST_POSES = 1000
"""Largest number of poses of a path; the oldest are dropped."""

EACH_S = 0.2
"""Time whose readings are one cloud [s]."""


def publish_lab(twin: Twin, bus: Bus, frame: str) -> list[Publisher]:
    """Advertise and publish the occupancy grid and the anomaly map of a lab.

    Args:
        twin: The twin.
        bus: The node.
        frame: Name of the frame of the map.

    Returns:
        The publishers. Late subscribers get the messages from them.
    """
    publishers = []
    for topic, fields in lab_fields(twin, frame).items():
        if bus.knows(topic.kind):
            publishers.append(bus.publisher(topic.name, topic.kind, topic.qos))
            publishers[-1].publish(to_bytes(topic.kind, fields))
    return publishers


class Trail:
    """Poses along a path, a distance apart."""

    def __init__(self) -> None:
        """Begin without poses."""
        self.poses: list[NDArray[np.float64]] = []
        """x, y, z [m] and orientation xyzw of each."""

    def add(self, p: ArrayLike, q_xyzw: ArrayLike) -> None:
        """Add a pose if it is far enough from the last one."""
        pose = np.concatenate([np.asarray(p, float), np.asarray(q_xyzw, float)])
        if self.poses and math.dist(self.poses[-1][:2], pose[:2]) < STEP_M - 1e-9:
            return
        self.poses.append(pose)
        del self.poses[:-MOST_POSES]


class Truth:
    """The readings of a simulated robot at their true places, and its true path."""

    def __init__(self, sender: Sender, p_base_sensor: ArrayLike) -> None:
        """Begin without readings.

        Args:
            sender: The robot.
            p_base_sensor: Place of the magnetometer in base_link [m], shape (3,).
        """
        self._sender, self._p_base_sensor = sender, np.asarray(p_base_sensor, float)
        self._trail = Trail()
        self._kept: list[Run] = []

    def add(self, rows: Run) -> Iterator[Sent]:
        """Keep rows; the cloud of readings if `EACH_S` is over."""
        if not rows.rows:
            return
        self._trail.add(rows["p_world_base"][-1], rows["q_world_base_xyzw"][-1])
        self._kept.append(rows)
        if rows["t"][-1] - self._kept[0]["t"][0] < EACH_S:
            return
        kept, self._kept = self._kept, []
        b_nt, t, p, q = (
            np.concatenate([part[name] for part in kept])
            for name in ("b_measured_nt", "t", "p_world_base", "q_world_base_xyzw")
        )
        read = np.isfinite(b_nt)
        if read.any():
            at = p[read] + rotate(q[read], self._p_base_sensor)
            last = np.rint(t[read][-1:] * NS).astype(np.int64)
            columns: dict[str, ArrayLike] = dict(zip("xyz", at.T, strict=True))
            cloud = cloud_fields(self._sender.map_frame, columns | {"b_nt": b_nt[read]})
            yield READINGS, last, {"header.stamp": last, **cloud}

    def path(self, stamp_ns: int) -> bytes:
        """The true path so far."""
        return poses_bytes(PATH.kind, stamp_ns, self._sender.map_frame, self._trail.poses)
