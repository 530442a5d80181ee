"""ExactField: the true field of a simulated lab, and the field at a magnetometer in it.

If a scene has the Earth's field and magnetised things, they make the field. If it has only a survey, the
fitted map is the field. A map is a magnitude, so the direction of the field comes from the harmonic fit, or
else from the scene's [earth], or else it is assumed: `DIP` below the horizon, towards world +y. Magnitudes
alone hardly determine the direction of a fit, so one that is more than `BENT` off [earth] is not used.

A map that depends on the heading was surveyed by a robot that turned. It contains the permanent and induced
field of that robot in the session of the survey, and the robot of the scene is taken to be that robot. It
adds only what was absent during the survey: the change of its permanent field since
(`PlatformFieldSpec.hard_iron_change_nt`), eddy currents, motors, LiDAR, supply current and the iron in its
wheels. So at rest, in the session of the survey, it reads exactly the map.

A map that is the same for all headings, or has only one, is taken as the field of the lab at the sensor, and
the robot adds its whole platform field.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap, Outside
from magtwin.run.run import Run
from magtwin.sim.interference import (
    ambient_at_sensor_nt,
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
"""Assumed dip of a field of unknown direction [rad]: that of magnetic latitude 41 deg north."""

BENT = np.radians(10.0)
"""Largest angle between [earth] and the uniform part of a harmonic fit that a building explains [rad]:
the 3,000 nT of the default lab turn the field by 4 deg."""

OFF_HEIGHT_M = 0.03
"""Difference of the sensor's height from the map's that is noted in a run [m]: the field of iron 0.5 m below
changes by a sixth over it."""

ROUNDING_NT = 1e-9
"""Largest rounding error of a magnitude that was a vector in between [nT]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExactField:
    """The true field of a scene; see the module."""

    scene: Scene
    anomaly_map: AnomalyMap
    outside: Outside = "nan"
    """Reading of the map outside its extent."""

    @cached_property
    def of(self) -> Literal["sources", "map", "none"]:
        """The origin of the field: Earth and sources, the map, or none (a constant map and no Earth).

        Earth without sources over a constant map is a uniform field, and counts as sources.
        """
        if self.scene.earth is not None and self.scene.magnets:
            return "sources"
        if not self.anomaly_map.is_constant:
            return "map"
        return "none" if self.scene.earth is None else "sources"

    @cached_property
    def holds_robot(self) -> bool:
        """Whether the map contains the surveying robot: its values depend on the heading."""
        return self.anomaly_map.turns

    @cached_property
    def direction(self) -> Literal["fit", "earth", "assumed"]:
        """The origin of the field's direction where the map is the field; see the module."""
        if self.anomaly_map.harmonic is not None and self._bend <= BENT:
            return "fit"
        return "assumed" if self.scene.earth is None else "earth"

    @cached_property
    def _bend(self) -> float:
        """Angle between the uniform part of the harmonic fit and [earth] [rad]; 0 if either is absent."""
        if self.anomaly_map.harmonic is None or self.scene.earth is None:
            return 0.0
        a, b = self.anomaly_map.harmonic.b_uniform_nt, np.asarray(self.scene.earth.b_world_nt, float)
        return float(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))

    @property
    def metadata(self) -> Mapping[str, str]:
        """Metadata of a run on its true field; empty if Earth and sources make it."""
        if self.of != "map":
            return {}
        added = "the whole platform field from the robot's spec, as a map without headings holds none"
        if self.holds_robot:
            added = (
                "platform field from the robot's spec, without the part that the map holds from its survey"
            )
        off = f", as that of the harmonic fit is {np.degrees(self._bend):.0f} deg off (fit --earth)"
        direction = {
            "fit": "from the harmonic fit"
            + (", unchecked, as there is no [earth]" if self.scene.earth is None else ""),
            "earth": "that of [earth]" + (off if self.anomaly_map.harmonic is not None else ""),
            "assumed": f"assumed {np.degrees(DIP):.0f} deg down towards +y, as there is no [earth]",
        }[self.direction]
        text = f"the fitted map; {added}; direction of the field {direction}"
        at, sensor = self.anomaly_map.height_m, self.scene.robot.base_height_m
        sensor += self.scene.robot.p_base_magnetometer[2]
        if at is not None and abs(sensor - at) > OFF_HEIGHT_M:
            text += f"; it holds {at:.3g} m above the floor, and the sensor is at {sensor:.3g} m (map upward)"
        return {"truth": text}

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
        ambient: tuple[Array, Array | float] | None = None,
    ) -> Array:
        """The field at the magnetometer of a robot that drives, without its plant.

        Args:
            scene: The scene, with its robot as it is in this session.
            motion: What the robot did.
            t: Times of the readings [s], shape (N,).
            true: The motion at these times.
            lidar_on: Whether the LiDAR spins, shape (N,).
            supply_a: Current drawn from the battery [A], shape (N,).
            at_rest_nt: The map at each pose [nT], shape (N,), if the caller has looked it up. A map of one
                heading is looked up at the sensor instead.
            ambient: What `ambient_nt` gave for this motion, if the caller has it.

        Returns:
            Field in base_link axes [nT], shape (N, 3); nan where the map is nan or nothing is known.
        """
        if self.of == "none":
            return np.full((len(true.pose), 3), np.nan)
        b_base, b_rate = ambient or self.ambient_nt(scene, true, at_rest_nt)
        robot = scene.robot
        if self.of == "map" and self.holds_robot:
            platform = replace(
                robot.platform, hard_iron_nt=robot.platform.hard_iron_change_nt, soft_iron=ZERO9
            )
            robot = replace(robot, platform=platform)
        return own_field_nt(robot, motion, t, b_base, b_rate, true=true, lidar_on=lidar_on, supply_a=supply_a)

    def ambient_nt(
        self, scene: Scene, true: Moment, at_rest_nt: Array | None = None
    ) -> tuple[Array, Array | float]:
        """The field at the magnetometer before the robot adds its own, and its rate of change.

        Arguments as for `at_sensor_nt`. A map that holds its surveying robot gives the field with that robot.

        Returns:
            Field [nT] and rate [nT/s] in base_link axes, shape (N, 3) each; the rate is 0 if no eddy currents
            need it.
        """
        if self.of == "sources":
            return ambient_at_sensor_nt(scene, true)
        eddy = any(np.ravel(scene.robot.platform.eddy_s))
        return self._mapped(scene, true, at_rest_nt, eddy=eddy)

    def magnitude_nt(self, vector_nt: Array, at_rest_nt: Array) -> Array:
        """Magnitudes of vectors (N, 3) [nT], shape (N,); the exact bytes of the map if nothing is added."""
        x, y, z = vector_nt.T
        size = np.sqrt(x * x + y * y + z * z)
        if self.of != "map":
            return np.asarray(size)
        return np.where(np.abs(size - at_rest_nt) < ROUNDING_NT, at_rest_nt, size)

    def _mapped(
        self, scene: Scene, true: Moment, at_rest_nt: Array | None, *, eddy: bool
    ) -> tuple[Array, Array | float]:
        """The map as a vector [nT], and its rate of change for eddy currents [nT/s], in base_link axes."""
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
        if self.holds_robot and field.harmonic is not None and self.direction == "fit":
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
        """Direction of the field without the robot, of any length, in world axes, shape (N, 3)."""
        harmonic = self.anomaly_map.harmonic
        if harmonic is None or self.direction != "fit":
            uniform = self.scene.earth.b_world_nt if self.scene.earth else (0.0, np.cos(DIP), -np.sin(DIP))
            return np.broadcast_to(np.asarray(uniform, float), (len(cos), 3))
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
    """Refuse a physical magnetometer without a field: a constant map and no Earth's field."""
    physical = scene.robot.magnetometer.kind == "physical"
    if physical and ExactField(scene=scene, anomaly_map=anomaly_map).of == "none":
        raise InputError(
            f"scene {scene.name!r} has a constant map and no Earth field, so there is no field to read; name "
            "a map that was fitted to a survey, or give the scene an Earth field and sources"
        )


def check_field(scene: Scene, anomaly_map: AnomalyMap) -> None:
    """Refuse a scene whose field is constant, because all places in it are alike to a magnetometer."""
    made = scene.magnets or scene.others  # other robots have iron too
    if not anomaly_map.is_constant or (scene.earth is not None and made):
        return
    known = anomaly_map.known
    what = f"{known.mean_nt:,.0f} nT at every node" if known.nodes else "without a valid node"
    raise InputError(
        f"scene {scene.name!r} has a constant field: its map {anomaly_map.name!r} is {what}, and nothing "
        "in it is magnetised; name a map that was fitted to a survey, or add [earth] with [[source]] or "
        "[[furniture]] tables (docs/sources.md)"
    )


def check_read(run: Run, anomaly_map: AnomalyMap) -> None:
    """Refuse a run that was driven off the map, so that its readings are nan or constant."""
    if not {"p_world_base", "b_map_nt", "b_total_nt"} <= set(run) or not run.rows:
        return
    mapped, p = run["b_map_nt"], run["p_world_base"][:, :2]
    moved = run.rows > 1 and np.ptp(p, axis=0).any()
    if np.isfinite(run["b_total_nt"]).any():
        if not moved or np.ptp(mapped) > 0 or anomaly_map.contains(p).any():
            return
        what = f"{mapped[0]:,.0f} nT, the map's nearest value"
    elif np.isfinite(mapped).any():
        raise InputError(
            f"all {run.rows:,} readings are nan though the robot drove on the map: the network gives nan, as "
            "one of its inputs is not known here; take a physical magnetometer, or another network"
        )
    else:
        what = "nan"
    x0, x1, y0, y1 = anomaly_map.extent
    low, high = p.min(axis=0), p.max(axis=0)
    raise InputError(
        f"all {run.rows:,} readings are {what}, as the robot drove x {low[0]:.2f}..{high[0]:.2f}, "
        f"y {low[1]:.2f}..{high[1]:.2f} m, where the map {anomaly_map.name!r} (x {x0:g}..{x1:g}, "
        f"y {y0:g}..{y1:g} m) has no valid node; choose a path on it"
    )
