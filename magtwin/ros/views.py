"""Views: what RViz and Foxglove show of a simulation: maps of the lab, readings and the path driven."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import rotate
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.stream import Sent
from magtwin.path.occupancy import occupancy_of
from magtwin.ros.bus import Bus, Publisher, poses_bytes, to_bytes
from magtwin.ros.topics import FIELD, OCCUPANCY, PATH, READINGS
from magtwin.run.run import Run
from magtwin.twin import Twin, room_of

FLOAT32 = 7
"""sensor_msgs/PointField.FLOAT32."""

STEP_M = 0.05
"""Distance between poses of a path [m]."""

MOST_POSES = 1000
"""Largest number of poses of a path; the oldest are dropped."""

MOST_NODES = 100_000
"""Largest number of nodes of an anomaly map that is shown; of a larger one, every few nodes."""

EACH_S = 0.2
"""Time whose readings are one cloud [s]."""


def publish_lab(twin: Twin, bus: Bus, frame: str) -> list[Publisher]:
    """Advertise and publish the occupancy grid and the anomaly map of a lab.

    The anomaly map is the mean over the headings at which a node is valid.

    Args:
        twin: The twin.
        bus: The node.
        frame: Name of the frame of the map.

    Returns:
        The publishers. Late subscribers get the messages from them.
    """
    occupancy = occupancy_of(room_of(twin))
    shown = twin.field
    values, sd = _mean_and_sd(shown)
    step = max(1, math.ceil(math.sqrt(values.size / MOST_NODES)))
    values, sd = values[::step, ::step], sd[::step, ::step]
    x, y = (np.asarray(axis)[::step] for axis in (shown.x_m, shown.y_m))
    known = np.isfinite(values)
    at = np.stack(np.meshgrid(x, y), axis=-1)[known]
    columns = {"x": at[:, 0], "y": at[:, 1], "z": np.zeros(len(at)), "b_nt": values[known]}
    cloud = cloud_fields(frame, columns | {"sd_nt": sd[known]})
    rows, width = occupancy.cells.shape
    grid = {"header.frame_id": frame, "info.resolution": occupancy.resolution_m, "info.height": rows}
    grid |= {"info.width": width, "info.origin.position": [*occupancy.origin_m, 0.0]}
    grid |= {"info.origin.orientation": [0.0, 0.0, 0.0, 1.0], "data": occupancy.cells.reshape(1, -1)}
    publishers = []
    for topic, fields in ((OCCUPANCY, grid), (FIELD, cloud)):
        if bus.knows(topic.kind):
            publishers.append(bus.publisher(topic.name, topic.kind, topic.qos))
            publishers[-1].publish(to_bytes(topic.kind, fields))
    return publishers


def cloud_fields(frame: str, columns: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Fields of a PointCloud2 of float32 columns, which are named as its fields, each of shape (N,)."""
    table = np.column_stack([np.asarray(values, "<f4") for values in columns.values()])
    fields: dict[str, Any] = {"header.frame_id": frame, "fields": len(columns)}
    for k, name in enumerate(columns):
        fields |= {f"fields.{k}.name": name, f"fields.{k}.offset": 4 * k}
        fields |= {f"fields.{k}.datatype": FLOAT32, f"fields.{k}.count": 1}
    size = 4 * len(columns)
    fields |= {"height": 1, "width": len(table), "point_step": size, "row_step": size * len(table)}
    dense = int(np.isfinite(table).all())
    return fields | {"is_dense": dense, "data": np.frombuffer(table.tobytes(), np.uint8).reshape(1, -1)}


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


def _mean_and_sd(shown: AnomalyMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of the valid headings of each node, and root of their mean variance [nT]; nan if unknown."""
    valid = shown.valid
    count = valid.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(valid, shown.values_nt, 0.0).sum(axis=0) / count
        if shown.variance_nt2 is None:
            return mean, np.full_like(mean, np.nan)
        return mean, np.sqrt(np.where(valid, shown.variance_nt2, 0.0).sum(axis=0) / count)
