"""Lab: the occupancy grid and the anomaly map of a lab, as messages that RViz and Foxglove show."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.io.bags.topics import FIELD, OCCUPANCY, Topic

if TYPE_CHECKING:
    from magtwin.twin import Twin

FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32
MOST_NODES = 100_000  # Most nodes of an anomaly map that are shown; of more, every few nodes


def lab_fields(twin: "Twin", frame: str) -> dict[Topic, dict[str, Any]]:
    """Fields of the messages of a lab, by topic; `frame` is the name of the frame of the map.

    The anomaly map is the mean over the headings at which a node is valid.
    """
    from magtwin.path.occupancy import occupancy_of
    from magtwin.twin import room_of

    occupancy = occupancy_of(room_of(twin))
    rows, width = occupancy.cells.shape
    grid = {"header.frame_id": frame, "info.resolution": occupancy.resolution_m, "info.height": rows}
    grid |= {"info.width": width, "info.origin.position": [*occupancy.origin_m, 0.0]}
    grid |= {"info.origin.orientation": [0.0, 0.0, 0.0, 1.0], "data": occupancy.cells.reshape(1, -1)}
    shown = twin.field
    if not isinstance(shown, AnomalyMap):
        return {OCCUPANCY: grid}
    values, sd = _mean_and_sd(shown)
    step = max(1, math.ceil(math.sqrt(values.size / MOST_NODES)))
    values, sd = values[::step, ::step], sd[::step, ::step]
    x, y = (np.asarray(axis)[::step] for axis in (shown.x_m, shown.y_m))
    known = np.isfinite(values)
    at = np.stack(np.meshgrid(x, y), axis=-1)[known]
    columns = {"x": at[:, 0], "y": at[:, 1], "z": np.zeros(len(at)), "b_nt": values[known]}
    cloud = cloud_fields(frame, columns | {"sd_nt": sd[known]})
    return {OCCUPANCY: grid, FIELD: cloud}


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


def _mean_and_sd(shown: AnomalyMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of the valid headings of each node, and root of their mean variance [nT]; nan if unknown."""
    valid = shown.valid
    count = valid.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(valid, shown.values_nt, 0.0).sum(axis=0) / count
        if shown.variance_nt2 is None:
            return mean, np.full_like(mean, np.nan)
        return mean, np.sqrt(np.where(valid, shown.variance_nt2, 0.0).sum(axis=0) / count)
