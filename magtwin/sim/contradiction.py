"""Contradiction: the difference between a map and the field of a scene's Earth and magnetised things."""

from dataclasses import dataclass

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.sim.at_rest import field_at_rest_nt, in_steel, sensor_height_m
from magtwin.sim.interference import ambient_gradient_nt_m
from magtwin.spec.scene import Scene

LEAST_NT = 500.0
"""Difference (rms) up to which a map and sources always agree [nT]: fit error, change of hard iron."""

PART = 0.3
"""Difference (rms) up to which they agree, as a share of the map's standard deviation. A coarse survey of the
same field has 0.2, the map of another room 1.4."""

MOST_NODES = 20_000
"""Most nodes that are compared; a larger map is thinned."""


@dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Map minus exact field, over the valid nodes of the map."""

    rms_nt: float
    """Root mean square [nT]."""

    largest_nt: float
    """Largest difference, with its sign [nT]."""

    x_m: float
    y_m: float
    """Place of the largest difference in world [m]."""

    yaw: float
    """Heading there [rad]."""

    allowed_nt: float
    """Root mean square up to which map and sources agree [nT]."""

    nodes: int
    """Number of nodes compared."""

    @property
    def agrees(self) -> bool:
        """Whether the map can be a map of these sources."""
        return self.rms_nt <= self.allowed_nt

    def __str__(self) -> str:
        return (
            f"{self.rms_nt:,.0f} nT rms over {self.nodes:,} nodes, at most {abs(self.largest_nt):,.0f} nT, "
            f"at x {self.x_m:.2f} m, y {self.y_m:.2f} m, heading {np.degrees(self.yaw):.0f} deg"
        )


def contradiction_nt(scene: Scene, anomaly_map: AnomalyMap) -> Contradiction:
    """Compare a map with the exact field that the scene's robot reads at rest at each node.

    Nodes where the robot would stand in something magnetised or lose lock are left out, because a survey has
    no reading there.

    Returns:
        The difference. `agrees` is true up to `LEAST_NT`, or `PART` of the map's standard deviation.
    """
    p_xy, yaw = anomaly_map.grid.poses()
    read = anomaly_map.recorded_yaw
    if read is not None:
        yaw = np.where(np.isfinite(read), read, yaw)
    valid = np.flatnonzero(anomaly_map.valid)
    if not len(valid):
        raise InputError(f"map {anomaly_map.name!r} has no valid node, so nothing to compare")
    valid = valid[:: -(-len(valid) // MOST_NODES)]
    p_xy, yaw, values = p_xy.reshape(-1, 2)[valid], yaw.ravel()[valid], anomaly_map.values_nt.ravel()[valid]
    height = sensor_height_m(scene) if anomaly_map.height_m is None else anomaly_map.height_m
    clear = ~in_steel(scene, p_xy, height)
    p_xy, yaw, values = p_xy[clear], yaw[clear], values[clear]
    off = values - field_at_rest_nt(scene, p_xy, yaw, height_m=anomaly_map.height_m)
    kept = _in_lock(scene, p_xy, height, np.abs(off) > LEAST_NT)
    p_xy, yaw, values, off = p_xy[kept], yaw[kept], values[kept], off[kept]
    if not len(off):
        raise InputError(
            f"map {anomaly_map.name!r} has no node that is clear of what scene {scene.name!r} has there"
        )
    worst = int(np.argmax(np.abs(off)))
    return Contradiction(
        rms_nt=float(np.sqrt(np.mean(off * off))),
        largest_nt=float(off[worst]),
        x_m=float(p_xy[worst, 0]),
        y_m=float(p_xy[worst, 1]),
        yaw=float(yaw[worst]),
        allowed_nt=max(LEAST_NT, PART * float(values.std())),
        nodes=len(off),
    )


def _in_lock(scene: Scene, p_xy: np.ndarray, height_m: float, asked: np.ndarray) -> np.ndarray:
    """Whether the magnetometer keeps lock at points (N, 2), shape (N,); true if not `asked`."""
    steepest = scene.robot.magnetometer.gradient_max_nt_m
    kept = np.ones(len(p_xy), bool)
    if steepest and asked.any():
        at = np.column_stack([p_xy[asked], np.full(np.count_nonzero(asked), height_m)])
        kept[asked] = ambient_gradient_nt_m(scene, at) <= steepest
    return kept


def check_agrees(scene: Scene, anomaly_map: AnomalyMap, where: str) -> Contradiction | None:
    """Refuse a scene whose map contradicts its Earth and sources.

    Returns:
        The difference if it is small enough; None if there is nothing to contradict.
    """
    if scene.earth is None or not scene.magnets:
        return None
    difference = contradiction_nt(scene, anomaly_map)
    if not difference.agrees:
        raise InputError(
            f"{where}: the map differs from the field of the scene's Earth, sources and furniture by "
            f"{difference} ({difference.allowed_nt:,.0f} nT rms is allowed); if the map is right, remove the "
            "sources and the furniture (or their magnetization); if they are right, survey them: "
            "magtwin map survey"
        )
    return difference
