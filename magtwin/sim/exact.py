"""ExactField: what the simulation takes for the true field of a lab, and what a magnetometer there reads.

Where a scene has the Earth's field and magnetised things, these make the field. Where it has only a survey,
the fitted map is the field. A map is a magnitude, so the direction of the field comes from the harmonic fit,
else from the scene's [earth], else it is assumed: `DIP` below the horizon, towards world +y.

A map that depends on the heading was read by a robot that turned: it holds the permanent and induced field
of that robot, as it was in the session of the survey. The robot of the scene is taken to be that robot. It
adds what was not there when it stood and surveyed: the change of its permanent field since
(`PlatformFieldSpec.hard_iron_change_nt`), eddy currents, motors, LiDAR, supply current and the iron in its
wheels. So at rest, in the session of the survey, it reads exactly the map.

A map that is alike in all headings, or has one, cannot tell the robot from the lab. It is taken to be the
field of the lab at the sensor, and the robot adds its whole platform field.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import CONSTANT_NT, AnomalyMap, Outside
from magtwin.run.run import Run
from magtwin.sim.interference import (
    field_at_sensor_nt,
    into_base_axes,
    own_field_nt,
    sensor_places,
)
from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.sampling import Moving
from magtwin.spec.base import ZERO9
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

DIP = np.radians(60.0)
"""Dip of the field where nothing tells its direction [rad]: that of magnetic latitude 41 deg north."""


OFF_HEIGHT_M = 0.03
"""Difference of the sensor's height from the map's from which a run says so [m]: iron in a floor 0.5 m below
makes a field that changes by a sixth in it."""

ROUNDING_NT = 1e-9
"""What a magnitude loses when it becomes a vector and a magnitude again, at most [nT]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExactField:
    """The true field of a scene; see the module."""

    scene: Scene
    anomaly_map: AnomalyMap
    outside: Outside = "nan"
    """What the map reads outside its extent."""

    @cached_property
    def of(self) -> Literal["sources", "map", "none"]:
        """What makes it: Earth and sources, the map, or nothing, with a constant map and no Earth.

        Earth without sources over a constant map is a uniform field, and counts as sources.
        """
        if self.scene.earth is not None and self.scene.magnets:
            return "sources"
        if not self.anomaly_map.is_constant:
            return "map"
        return "none" if self.scene.earth is None else "sources"

    @cached_property
    def holds_robot(self) -> bool:
        """Whether the map holds the robot as it surveyed: its values depend on the heading."""
        values = np.where(self.anomaly_map.valid, self.anomaly_map.values_nt, np.nan)
        return bool(np.any(np.abs(values - values[:1]) > CONSTANT_NT))

    @property
    def metadata(self) -> Mapping[str, str]:
        """What a run is to say of its truth; empty where Earth and sources make it."""
        if self.of != "map":
            return {}
        if self.holds_robot:
            added = (
                "platform field from the robot's spec, without the part that the map holds from its survey"
            )
        else:
            added = "the whole platform field from the robot's spec, as a map without headings holds none"
        if self.anomaly_map.harmonic is not None:
            way = "from the harmonic fit"
        elif self.scene.earth is not None:
            way = "that of [earth]"
        else:
            way = f"assumed {np.degrees(DIP):.0f} deg down towards +y, as there is no [earth]"
        told = f"the fitted map; {added}; direction of the field {way}"
        at, sensor = self.anomaly_map.height_m, self.scene.robot.base_height_m
        sensor += self.scene.robot.p_base_magnetometer[2]
        if at is not None and abs(sensor - at) > OFF_HEIGHT_M:
            told += (
                f"; it holds {at:.3g} m above the floor, and the sensor is at {sensor:.3g} m (map continue)"
            )
        return {"truth": told}

    def at_sensor_nt(
        self,
        scene: Scene,
        motion: Moving,
        t: ArrayLike,
        *,
        true: Moment,
        lidar_on: ArrayLike,
        supply_a: ArrayLike,
        at_rest_nt: Array | None = None,
    ) -> Array:
        """The field at the magnetometer of a robot that drives.

        Args:
            scene: The scene, with its robot as it is in this session.
            motion: What the robot did.
            t: Times of the readings [s], shape (N,).
            true: The motion at these times.
            lidar_on: Whether the LiDAR spins, shape (N,).
            supply_a: Current drawn from the battery [A], shape (N,).
            at_rest_nt: What the map gives at each pose [nT], shape (N,), where the caller has looked it up;
                a map of one heading is looked up at the sensor instead.

        Returns:
            Field in base_link axes [nT], shape (N, 3); nan where the map is, or where there is no truth.
        """
        if self.of == "none":
            return np.full((len(true.pose), 3), np.nan)
        if self.of == "sources":
            return field_at_sensor_nt(scene, motion, t, true=true, lidar_on=lidar_on, supply_a=supply_a)
        robot, held = scene.robot, self.holds_robot
        eddy = any(np.ravel(robot.platform.eddy_s))
        b_base, b_rate = self._mapped(scene, true, at_rest_nt, eddy=eddy)
        if held:
            platform = replace(
                robot.platform, hard_iron_nt=robot.platform.hard_iron_change_nt, soft_iron=ZERO9
            )
            robot = replace(robot, platform=platform)
        return own_field_nt(robot, motion, t, b_base, b_rate, true=true, lidar_on=lidar_on, supply_a=supply_a)

    def magnitude_nt(self, vector_nt: Array, at_rest_nt: Array) -> Array:
        """Magnitudes of vectors (N, 3) [nT], shape (N,); the map's own to the bit if nothing is added."""
        x, y, z = vector_nt.T
        size = np.sqrt(x * x + y * y + z * z)
        if self.of != "map":
            return np.asarray(size)
        return np.where(np.abs(size - at_rest_nt) < ROUNDING_NT, at_rest_nt, size)

    def _mapped(
        self, scene: Scene, true: Moment, at_rest_nt: Array | None, *, eddy: bool
    ) -> tuple[Array, Array | float]:
        """The map at the robot as a vector (N, 3) [nT], and its rate of change [nT/s], in base_link axes.

        The rate is for eddy currents; 0.0 without them.
        """
        field, robot, yaw = self.anomaly_map, scene.robot, true.pose[:, 2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        place = true.pose[:, :2] if self.holds_robot else sensor_places(robot, true.pose)[:, :2]
        slopes = None
        if eddy:
            size, slopes = field.lookup_with_gradient(place, yaw, outside=self.outside)
        elif at_rest_nt is None or not self.holds_robot:
            size = field.lookup(place, yaw, outside=self.outside)
        if at_rest_nt is not None and self.holds_robot:
            size = at_rest_nt
        ambient = self._ambient(scene, true, cos, sin)
        unit = into_base_axes(ambient, cos, sin)
        if self.holds_robot and field.harmonic is not None:
            unit = unit + unit @ field.harmonic.soft_iron.T + field.harmonic.hard_iron_nt
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        b_base = size[:, None] * unit
        if slopes is None:
            return b_base, 0.0
        # d/dt (|B| u) with u fixed in the world: along u as the map changes, and the turning of the axes.
        px, py = place.T - true.pose[:, :2].T
        vx, vy = true.v * cos - true.w * py, true.v * sin + true.w * px
        along = vx * slopes[:, 0] + vy * slopes[:, 1]
        rate = along[:, None] * unit
        rate[:, 0] += true.w * b_base[:, 1]
        rate[:, 1] -= true.w * b_base[:, 0]
        return b_base, np.nan_to_num(rate)

    def _ambient(self, scene: Scene, true: Moment, cos: Array, sin: Array) -> Array:
        """The field without the robot, of any length, in world axes, shape (N, 3)."""
        harmonic = self.anomaly_map.harmonic
        if harmonic is None:
            way = self.scene.earth.b_world_nt if self.scene.earth else (0.0, np.cos(DIP), -np.sin(DIP))
            return np.broadcast_to(np.asarray(way, float), (len(cos), 3))
        from magtwin.field.sources.compiled_dipoles import dipole_field_nt  # compiled, as simulations are

        if self.holds_robot:
            x, y, z = harmonic.p_base_sensor
            at = true.pose[:, :2] + np.column_stack([x * cos - y * sin, x * sin + y * cos])
            at = np.column_stack([at, np.full(len(cos), z)])
        else:
            at = sensor_places(scene.robot, true.pose)
            at[:, 2] = harmonic.height_m
        return dipole_field_nt(at, harmonic.p_world_dipole, harmonic.m_world) + harmonic.b_uniform_nt


def check_truth(scene: Scene, anomaly_map: AnomalyMap) -> None:
    """Refuse a physical magnetometer where neither sources nor a map make a field.

    Raises:
        InputError: The map is constant, and there is no Earth's field.
    """
    physical = scene.robot.magnetometer.kind == "physical"
    if physical and ExactField(scene=scene, anomaly_map=anomaly_map).of == "none":
        raise InputError(
            f"scene {scene.name!r} has a constant map and no Earth field, so there is no field to read; name "
            "a map that was fitted to a survey, or give the scene an Earth field and sources"
        )


def check_field(scene: Scene, anomaly_map: AnomalyMap) -> None:
    """Refuse a scene whose field is constant: no magnetometer can tell one place from another.

    Raises:
        InputError: The map is constant, and nothing on the stage is magnetised.
    """
    made = scene.magnets or scene.others  # other robots have iron too
    if not anomaly_map.is_constant or (scene.earth is not None and made):
        return
    values = anomaly_map.values_nt[anomaly_map.valid]
    what = f"{values.mean():,.0f} nT at every node" if values.size else "without a valid node"
    raise InputError(
        f"scene {scene.name!r} has a constant field: its map {anomaly_map.name!r} is {what}, and nothing "
        "in it is magnetised; name a map that was fitted to a survey, or add [earth] with [[source]] or "
        "[[furniture]] tables (docs/sources.md)"
    )


def check_read(run: Run, anomaly_map: AnomalyMap) -> None:
    """Refuse a run that read no field, or one field all along, because it was driven off the map.

    Raises:
        InputError: Every reading is nan, or all are the nearest value of a map that the robot never met.
    """
    if not {"p_world_base", "b_map_nt", "b_total_nt"} <= set(run) or not run.rows:
        return
    mapped, p = run["b_map_nt"], run["p_world_base"][:, :2]
    x0, x1, y0, y1 = anomaly_map.extent
    if np.isfinite(run["b_total_nt"]).any():
        if (
            run.rows == 1
            or np.ptp(mapped) > 0
            or anomaly_map.contains(p).any()
            or not np.ptp(p, axis=0).any()
        ):
            return
        what = f"all {run.rows:,} readings are {mapped[0]:,.0f} nT, the map's nearest value, as the robot"
    elif np.isfinite(mapped).any():
        raise InputError(
            f"all {run.rows:,} readings are nan though the robot drove on the map: the network gives nan, as "
            "one of its inputs is not known here; take a physical magnetometer, or another network"
        )
    else:
        what = f"all {run.rows:,} readings are nan, as the robot"
    low, high = p.min(axis=0), p.max(axis=0)
    raise InputError(
        f"{what} drove x {low[0]:.2f}..{high[0]:.2f}, y {low[1]:.2f}..{high[1]:.2f} m, where the map "
        f"{anomaly_map.name!r} (x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m) has no valid node; choose a path on it"
    )
