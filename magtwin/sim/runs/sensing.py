"""Sensing: all sensors of one robot in one run, read in pieces of any length.

`magtwin.sim.runs.simulate` reads a whole run in one piece, `magtwin.sim.runs.live` a piece in each control
step. Each sensor draws from its own generator, so its bytes do not depend on which others are read.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base, quat_from_yaw, wrap_angle
from magtwin.run import mapped
from magtwin.run.figures import UNMODELLED
from magtwin.run.run import COLUMNS, Column
from magtwin.sim.exact import ExactField
from magtwin.sim.extensions import INTERFERENCE, Interference, SensorFactory, start_sensors
from magtwin.sim.interference import level_gradient_nt_m, rest_current_a, sensor_places, torques_nm
from magtwin.sim.motion.controllers import Controller
from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.engine import KINEMATIC, Engine
from magtwin.sim.motion.sampling import Moving, into_sensor
from magtwin.sim.plant import Plant
from magtwin.sim.runs.neighbours import Neighbour, neighbours_field_nt, touching
from magtwin.sim.sensors.battery import Battery
from magtwin.sim.sensors.clock import SampledSensor
from magtwin.sim.sensors.imu import Imu
from magtwin.sim.sensors.lidar import lidar_on
from magtwin.sim.sensors.magnetometer import LOCK_RATE_HZ, Magnetometer, feels_direction, lost_in, rounded
from magtwin.sim.sensors.mocap import Mocap
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.noise import GaussMarkov
from magtwin.sim.sensors.odometry import Odometry
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.plant import PlantSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

Predicted = NDArray[Any] | tuple[NDArray[Any], NDArray[Any]]
"""Disturbance of each reading [nT], shape (N,), alone or with the standard deviation of its error."""

Outside = Literal["nan", "clamp", "raise"]
LidarMode = Literal["schedule", "on", "off"]

STREAMS = (
    *("odometry", "imu", "battery", "magnetometer", "mocap", "lidar", "drive", "driver"),
    *("model_error", "sensors", "interference"),
)
"""Who draws random numbers, each from its own child generator. Append only: the order is part of the seed."""

_MADE_TOGETHER = {
    "odometry": frozenset(("odom_p", "odom_q_xyzw", "odom_v", "odom_w")),
    "imu": frozenset(("imu_q_xyzw", "imu_w", "imu_a")),
    "mocap": frozenset(("mocap_p", "mocap_q_xyzw", "flag_pose_lost")),
    "battery": frozenset(("battery_v", "battery_a", "battery_fraction")),
}
_UNMODELLED = Column("nT", "", "part of b_disturbance_nt that no network predicts, such as the plant's")
_EXACT = frozenset(("b_vector_nt", "b_truth_nt", "b_vector_measured_nt"))
_READ = frozenset(
    ("b_measured_nt", "b_model_error_nt", "b_noise_nt", "b_vector_measured_nt", "flag_lost_lock")
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions:
    """What all runs of a job have in common; see `magtwin.sim.runs.simulate.simulate`."""

    anomaly_map: AnomalyMap
    obstacles: Obstacles = field(default_factory=Obstacles)
    """What paths must be clear of, what stops robots, and what their LiDARs see."""

    network: bool
    """Whether a network predicts the disturbance."""

    inputs: frozenset[str] = frozenset(COLUMNS)
    """Columns that the network reads."""

    duration_s: float | None = None
    """How long to drive [s]. None for once along the path."""

    rate_hz: float | None = None
    """Magnetometer readings a second [Hz]. None for the scene's."""

    controller: str | Controller = "follower"
    engine: Engine = KINEMATIC
    lidar: LidarMode = "schedule"
    """Whether the LiDAR follows its schedule, or stays on or off."""

    outside: Outside = "nan"
    """What the map reads outside its extent: nan, the nearest value inside, or a refusal."""


def streams(rng: np.random.Generator) -> dict[str, np.random.Generator]:
    """The child generators of a run by name, from the generator that `simulate` is given."""
    return dict(zip(STREAMS, rng.spawn(len(STREAMS)), strict=True))


class Sensing:
    """The sensors of a robot: `sense` reads all but the magnetometer's scalar, `read` then reads that."""

    def __init__(
        self,
        scene: Scene,
        draws: Mapping[str, np.random.Generator],
        conditions: Conditions,
        *,
        wanted: Iterable[str] = COLUMNS,
        neighbours: Sequence[Neighbour] = (),
        sensors: Iterable[str | SensorFactory] = (),
        interference: Iterable[str | Interference] = (),
    ) -> None:
        """Switch the sensors on.

        A column that is neither wanted nor an input of the network is not computed. The magnetometer reads
        the iron of neighbours if the Earth's field is known; like custom interference, it is added to what a
        network predicts.
        """
        robot = scene.robot
        spec = robot.magnetometer
        self.scene, self.conditions, self.wanted = scene, conditions, frozenset(wanted)
        self.rate_hz = spec.rate_hz if conditions.rate_hz is None else conditions.rate_hz
        self._map, self._outside = conditions.anomaly_map, conditions.outside
        network = conditions.network
        terms = [INTERFERENCE[term] if isinstance(term, str) else term for term in interference]
        self._terms = list(zip(terms, draws["interference"].spawn(len(terms)), strict=True))
        self._custom = start_sensors(sensors, scene, draws["sensors"])
        needed = self.wanted | (conditions.inputs if network else frozenset())
        needed = frozenset(COLUMNS) if terms else needed
        self._exact = ExactField(scene=scene, anomaly_map=self._map, outside=self._outside)
        self._physical = not network and spec.kind == "physical"
        self._neighbours, self._near = neighbours, neighbours if scene.earth is not None else ()
        self._plant = None if robot.plant == PlantSpec() else Plant(robot.plant)
        added = bool(self._near or terms or self._plant)
        if (terms or self._plant) and self._exact.of == "none":
            what = "interference" if terms else "the robot's plant"
            text = f"has a constant map and no Earth field, so {what} has nothing to add to"
            raise InputError(f"scene {scene.name!r} {text}; give the scene an Earth field")
        self._unmodelled = network and added
        self._reads = bool(self.wanted & _READ)
        self._reads_axes = network and "b_vector_measured_nt" in needed
        directed = self._reads and feels_direction(spec)
        exact = bool(self.wanted & _EXACT)
        self._vector = self._reads_axes or exact or self._physical or directed or added
        self._known = self._exact.of == "sources" or (self._exact.of == "map" and (self._physical or added))
        self._sloped = "b_map_gradient_nt_m" in needed
        self.lidar_on = partial(lidar_on, robot.lidar, mode=conditions.lidar)
        self._battery = Battery(robot.battery, robot.drive, self.lidar_on, draws["battery"])
        every: dict[str, SampledSensor] = {
            "odometry": Odometry(robot.drive, draws["odometry"]),
            "imu": Imu(robot.imu, robot.q_base_imu_xyzw, draws["imu"]),
            "mocap": Mocap(robot.mocap, robot.base_height_m, draws["mocap"]),
            "battery": self._battery,
        }
        read = {name for name in every if needed & _MADE_TOGETHER[name]}
        read |= {"battery"} if self._vector else set()
        self.sampled = {name: one for name, one in every.items() if name in read}
        """The sensors with their own clocks that are read, by name."""

        self._magnetometer = Magnetometer(spec, self.rate_hz, draws["magnetometer"])
        self._error_rng = draws["model_error"]
        self._error_process: GaussMarkov | None = None
        self._checks, self._steep = 0, False
        self._beside_nt: Array | float = 0.0

    @property
    def specs(self) -> dict[str, Column]:
        """What columns beside those of `COLUMNS` hold: those of custom sensors, and `UNMODELLED`."""
        custom = {name: column for one in self._custom for name, column in one.columns.items()}
        return custom | ({UNMODELLED: _UNMODELLED} if self._unmodelled else {})

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata on the true field, if the magnetometer reads it."""
        return dict(self._exact.metadata) if self._physical else {}

    def sense(self, motion: Moving, t: Array, until_s: float | None = None) -> Columns:
        """Columns of the next readings, all but those that depend on the disturbance.

        Args:
            motion: What the robot did, known until `until_s`.
            t: Times of the readings, not before those of earlier calls [s], shape (N,).
            until_s: Time up to which sensors take samples [s]. Default: just past the last reading.
        """
        scene, robot = self.scene, self.scene.robot
        now = motion.at(t)
        columns = truth(now, t, robot.base_height_m)
        for sensor in self.sampled.values():
            columns |= sensor.sense(motion, t, until_s)
        for custom in self._custom:
            columns |= custom.sense(motion, t, until_s)
        columns["lidar_on"] = self.lidar_on(t)
        columns |= self._mapped(now.pose[:, :2], columns["yaw"])
        if self._vector:
            columns |= self._true_field(motion, t, now, columns, until_s)
        if self._reads or self._reads_axes:
            steep = self._steepness(motion, t)
            vector = columns.get("b_vector_nt", np.full((len(t), 3), np.nan))
            if self._reads_axes or "b_vector_measured_nt" in self.wanted:
                columns["b_vector_measured_nt"] = self._magnetometer.axes(vector, steep=steep)
            else:
                self._magnetometer.skip_axes(vector, steep=steep)
        off = scene.lab.inside_m(now.pose[:, :2]) + 1e-9 < robot.footprint_radius_m
        columns["flag_bump"] = now.bump | off
        if self._neighbours:
            columns["flag_bump"] |= touching(t, motion, robot, self._neighbours)
        columns["flag_out_of_distribution"] = np.zeros(len(t), bool)
        columns["b_sd_nt"] = np.full(len(t), np.nan)
        return columns

    def read(
        self,
        columns: Mapping[str, NDArray[Any]],
        predicted: Predicted | None = None,
        model_error: ModelError | None = None,
    ) -> Columns:
        """All wanted columns of the readings that `sense` gave last, in the order of `COLUMNS`.

        Args:
            columns: What `sense` gave.
            predicted: What a network predicts; None for a magnetometer without one.
            model_error: Statistics of the error of the prediction. None draws no error, and so does a
                prediction without a standard deviation.
        """
        columns, spec = dict(columns), self.scene.robot.magnetometer
        rows = len(columns["t"])
        error = np.zeros(rows)
        if predicted is None:
            disturbance = columns["b_truth_nt"] - columns["b_map_nt"] if self._physical else np.zeros(rows)
        else:
            mean, sd = predicted if isinstance(predicted, tuple) else (predicted, None)
            disturbance = np.asarray(mean, float)
            if disturbance.shape != (rows,):
                raise InputError(f"disturbance_nt must give shape {(rows,)}, got {disturbance.shape}")
            if model_error is not None and sd is not None:
                if self._error_process is None:
                    self._error_process = model_error.process(self._error_rng, self.rate_hz)
                error = model_error.error_nt(sd, self._error_process.next(rows))
                error = rounded(error, spec.resolution_nt)
            disturbance = disturbance + self._beside_nt
            columns[UNMODELLED] = np.zeros(rows) + self._beside_nt
        columns["b_disturbance_nt"] = disturbance
        columns["b_total_nt"] = columns["b_map_nt"] + disturbance
        columns["b_model_error_nt"] = error
        if self._reads:
            vector = columns.get("b_vector_nt", np.full((rows, 3), np.nan))
            columns |= self._magnetometer.read(columns["b_total_nt"], vector)
            # The error was estimated from readings, so the low-pass does not apply. A stuck reading has none.
            lost = columns["flag_lost_lock"]
            columns["b_measured_nt"] = columns["b_measured_nt"] + np.where(lost, 0.0, error)
            columns["b_noise_nt"] = columns["b_noise_nt"] - np.where(lost, error, 0.0)
        names = [*(name for name in COLUMNS if name in self.wanted), *self.specs]
        return {name: columns[name] for name in names}

    def rows_at_once(self, count: int) -> int:
        """Readings of a run of `count` readings that are sensed at a time: all, or a block of a long run."""
        rates = [sensor.clock.rate_hz for sensor in self.sampled.values()]
        samples = max([self.rate_hz, *rates]) / self.rate_hz  # at most, for each reading
        return count if count * samples <= mapped.LONG else max(1, int(mapped.BLOCK / samples))

    def forget(self) -> None:
        """Drop the samples that nobody took, so that they do not pile up in a long run."""
        for sensor in self.sampled.values():
            sensor.clock.take_fresh()

    def _mapped(self, xy: Array, yaw: Array) -> Columns:
        """Map at base_link's poses, its gradient in base_link's axes if needed, and whether it is known."""
        columns = {}
        if self._sloped:
            b, slopes = self._map.lookup_with_gradient(xy, yaw, outside=self._outside)
            columns["b_map_gradient_nt_m"] = into_base(slopes[:, :2], yaw)
        else:
            b = self._map.lookup(xy, yaw, outside=self._outside)
        unknown = np.isnan(b)
        if self._outside == "clamp":
            unknown = unknown | ~self._map.contains(xy)
        return {"b_map_nt": b, **columns, "flag_outside_map": unknown}

    def _true_field(
        self, motion: Moving, t: Array, now: Moment, columns: Columns, until_s: float | None
    ) -> Columns:
        """Field at the magnetometer, vector in its axes and magnitude; nan if unknown."""
        unknown = {"b_vector_nt": np.full((len(t), 3), np.nan), "b_truth_nt": np.full(len(t), np.nan)}
        if not self._known or not len(t):
            return unknown
        supply_a, ambient = self._battery.supply_a(t), None
        if self._plant:
            ambient = self._exact.ambient_nt(self.scene, now, columns["b_map_nt"])
        base = self._exact.at_sensor_nt(
            self.scene,
            motion,
            t,
            true=now,
            lidar_on=columns["lidar_on"],
            supply_a=supply_a,
            at_rest_nt=columns["b_map_nt"],
            ambient=ambient,
        )
        mount = self.scene.robot.q_base_magnetometer_xyzw
        vector = into_sensor(base, mount)
        size = self._exact.magnitude_nt(base, columns["b_map_nt"])
        if self._near or self._terms or self._plant:
            added = np.zeros((len(t), 3))
            if self._plant and ambient:
                robot = self.scene.robot
                needed = self._plant.needs_torques
                added += self._plant.field_nt(
                    t,
                    ambient[0],
                    torques_nm=torques_nm(robot, motion, t, now) if needed else (0.0, 0.0),
                    speed=now.v,
                    lidar_on=columns["lidar_on"],
                    supply_a=supply_a - rest_current_a(robot.battery),
                )
            if self._near:
                known_s = math.inf if until_s is None else until_s
                added += neighbours_field_nt(self.scene, self._near, motion, t, now, known_s)
            for term, rng in self._terms:
                added += term(columns, self.scene.robot, rng)
            vector = vector + into_sensor(added, mount)
            x, y, z = vector.T
            total = np.sqrt(x * x + y * y + z * z)
            self._beside_nt, size = total - size, total
        if self._exact.of == "map" and not self._physical:
            return unknown  # the robot's spec is no measurement to judge a network by
        return {"b_vector_nt": vector, "b_truth_nt": size}

    def _steepness(self, motion: Moving, t: Array) -> NDArray[np.bool_]:
        """Whether lock is lost to the gradient at each reading: the exact one, or else the map's."""
        spec = self.scene.robot.magnetometer
        if not spec.gradient_max_nt_m or not len(t):
            return np.zeros(len(t), bool)
        latest = (t * LOCK_RATE_HZ + 1e-9).astype(int)
        checks = np.arange(self._checks, latest[-1] + 1)
        flags = np.array([self._steep])
        if len(checks):
            pose = motion.at(checks / LOCK_RATE_HZ).pose
            if self._exact.of == "sources":
                places = sensor_places(self.scene.robot, pose)
                gradient = level_gradient_nt_m(self.scene, places[:, :2], places[0, 2])
            else:
                gradient = np.hypot(*self._map.gradient(pose[:, :2], pose[:, 2])[:, :2].T)
            flags = np.concatenate([flags, lost_in(spec, gradient, before=self._steep)])
        steep = flags[latest - self._checks + 1]
        self._checks, self._steep = int(latest[-1]) + 1, bool(flags[-1])
        return np.asarray(steep)


def truth(now: Moment, t: Array, height_m: float) -> Columns:
    """The columns of what the robot did and was commanded."""
    zero, yaw = np.zeros(len(t)), wrap_angle(now.pose[:, 2])
    return {
        "t": t,
        "p_world_base": np.column_stack([now.pose[:, :2], zero + height_m]),
        "q_world_base_xyzw": quat_from_yaw(yaw),
        "yaw": yaw,
        "v_base": np.column_stack([now.v, zero, zero]),
        "w_base": np.column_stack([zero, zero, now.w]),
        "v_cmd": now.v_cmd,
        "w_cmd": now.w_cmd,
        "wheel_angle": now.wheel_angle,
    }
