"""simulate: a scene and a path go in, a Run with every column comes out."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base, quat_from_yaw, wrap_angle
from magtwin.path import Path, check_on_floor
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.engines.replay import replayed
from magtwin.sim.exact import ExactField, check_truth
from magtwin.sim.interference import level_gradient_nt_m, sensor_places
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.controllers import Controller
from magtwin.sim.motion.drive import Moment, draw_wheel_errors
from magtwin.sim.motion.driver import Driver
from magtwin.sim.motion.engine import Engine, Kinematic, Travel
from magtwin.sim.motion.follow import follow, play
from magtwin.sim.motion.sampling import Moving, into_sensor
from magtwin.sim.runs.companions import Companion, companions_field_nt, touching
from magtwin.sim.sensors.battery import discharge, sense_battery
from magtwin.sim.sensors.imu import sense_imu
from magtwin.sim.sensors.lidar import lidar_on
from magtwin.sim.sensors.magnetometer import (
    LOCK_RATE_HZ,
    feels_direction,
    lost_in,
    rounded,
    sense_axes,
    sense_magnetometer,
)
from magtwin.sim.sensors.mocap import sense_mocap
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.odometry import sense_odometry
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

Predicted = NDArray[Any] | tuple[NDArray[Any], NDArray[Any]]
"""Disturbance of each reading [nT], shape (N,), and the standard deviation of its error where it is known."""

Predict = Callable[[Run], Predicted]
"""From a Run to what a network predicts of it."""

RANDOM_S = 60.0
"""How long a driver drives about unless told otherwise [s]."""

MOST_READINGS = 20_000_000
"""Most readings of a run: about 8 GB of columns."""

_STREAMS = (
    *("odometry", "imu", "battery", "magnetometer", "mocap", "lidar", "drive", "driver"),
    "model_error",
)
"""Who draws random numbers, each from a child generator of its own; append only: the order is the seed."""


_ODOMETRY = frozenset(("odom_p", "odom_q_xyzw", "odom_v", "odom_w"))
_IMU = frozenset(("imu_q_xyzw", "imu_w", "imu_a"))
_MOCAP = frozenset(("mocap_p", "mocap_q_xyzw", "flag_pose_lost"))
_BATTERY = frozenset(("battery_v", "battery_a", "battery_fraction"))
_EXACT = frozenset(("b_vector_nt", "b_truth_nt", "b_vector_measured_nt"))
_READ = frozenset(
    ("b_measured_nt", "b_model_error_nt", "b_noise_nt", "b_vector_measured_nt", "flag_lost_lock")
)
"""Columns that are made together."""


def streams(rng: np.random.Generator) -> dict[str, np.random.Generator]:
    """A generator for each who draws, children of the one that `simulate` is given."""
    return dict(zip(_STREAMS, rng.spawn(len(_STREAMS)), strict=True))


def simulate(
    scene: Scene,
    path: Path | Commands | Run | str,
    *,
    anomaly_map: AnomalyMap,
    rng: np.random.Generator,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    obstacles: Obstacles | None = None,
    controller: str | Controller = "follower",
    disturbance_nt: Predict | None = None,
    model_error: ModelError | None = None,
    outside: Literal["nan", "clamp", "raise"] = "nan",
    lidar: Literal["schedule", "on", "off"] = "schedule",
    engine: Engine | None = None,
) -> Run:
    """Drive a scene's robot along a path and read its sensors.

    b_total = b_map + b_disturbance, b_map at base_link's pose, and b_measured = b_total + b_noise, and of a
    neural magnetometer b_model_error besides. The
    disturbance is what `disturbance_nt` predicts, for a neural magnetometer; without it, for a physical
    one, b_truth - b_map: the exact field of the lab and of the robot itself at the magnetometer, less the
    map; for one of the kind "map-only" it is 0. `magtwin.sim.exact` says what makes the exact field. Where
    Earth and sources do, b_truth and b_vector are given whatever the kind; where the map does, for a physical
    magnetometer alone.

    Args:
        scene: Lab, robot and sensors.
        path: Where to drive; the robot begins on its first point, along it. Commands are played from the
            scene's start; a Run is driven once more as it was recorded, for its sensors to be read anew;
            "random" is wherever a human-like driver goes from the scene's start.
        anomaly_map: What `scene.map_layer` holds.
        rng: Source of all noise.
        speed: Forward speed where the path is straight [m/s].
        duration_s: How long to drive [s]; None is once along the path. Longer gives further laps of
            a closed path, and takes an open one back and forth.
        rate_hz: Magnetometer readings a second, at t = k / rate_hz [Hz]; None takes the scene's.
        obstacles: What the path must be clear of, and what stops the robot if it leaves its path.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`, or a controller of one's own.
        disturbance_nt: From a Run in which every other sensor has been read, the vector axes too, to the
            disturbance of each reading [nT], shape (N,), or that and the standard deviation of its error.
            Called once.
        model_error: Statistics of that error, which is drawn then; None draws none.
        outside: What the map reads outside its extent: nan, the nearest value inside, or a refusal.
        lidar: Whether the LiDAR follows its schedule, or stays on or off.
        engine: What moves the robot; None is the kinematic one. A Run is not moved anew.

    Returns:
        A Run with every column of `COLUMNS`, in their order. `b_sd_nt` is nan and
        `flag_out_of_distribution` false: both are for the caller who knows a network.

    Raises:
        InputError: The path leaves the floor or touches an obstacle, an option is out of range, or nothing
            gives the disturbance. Nothing has been computed then.
    """
    rate = check_run(
        scene,
        path,
        anomaly_map=anomaly_map,
        rate_hz=rate_hz,
        duration_s=duration_s,
        lidar=lidar,
        network=disturbance_nt is not None,
    )
    draws = streams(rng)
    motion, metadata = travel(
        scene, path, draws, speed, duration_s, obstacles or Obstacles(), controller, engine or Kinematic()
    )
    sensed = sense(
        scene,
        motion,
        draws,
        anomaly_map=anomaly_map,
        rate_hz=rate,
        duration_s=duration_s,
        outside=outside,
        lidar=lidar,
        metadata=metadata,
        network=disturbance_nt is not None,
    )
    return sensed.read(None if disturbance_nt is None else disturbance_nt(sensed.run), model_error)


def travel(
    scene: Scene,
    path: Path | Commands | Run | str,
    draws: Mapping[str, np.random.Generator],
    speed: float,
    duration_s: float | None,
    obstacles: Obstacles,
    controller: str | Controller,
    engine: Engine,
) -> tuple[Travel, dict[str, str | int | float | bool]]:
    """What the robot did, and how that came about."""
    robot = scene.robot
    if isinstance(path, Run):
        told = {
            name: path.metadata[name] for name in ("path", "controller", "speed_m_s") if name in path.metadata
        }
        return replayed(path, robot.drive), {**told, "engine": "replay"}
    room: dict[str, Any] = {
        "duration_s": duration_s,
        "obstacles": obstacles,
        "footprint_radius_m": robot.footprint_radius_m,
        "wheel_errors": draw_wheel_errors(robot.drive, draws["drive"]),
        "engine": engine,
    }
    metadata: dict[str, str | int | float | bool] = {}
    if engine.name != "kinematic":
        metadata["engine"] = engine.name
    if isinstance(path, Path):
        name = controller if isinstance(controller, str) else type(controller).__name__
        motion = follow(path, robot.drive, speed=speed, controller=controller, **room)
        return motion, {"path": path.name, "controller": name, "speed_m_s": float(speed), **metadata}
    if isinstance(path, Commands):
        motion = play(path.rows, robot.drive, start=scene.start, **room)
        return motion, {"path": path.name, "controller": "commands", **metadata}
    if not isinstance(path, str) or path != "random":
        raise InputError(f'what to drive must be a Path, Commands, a Run or "random", got {path!r}')
    room["duration_s"] = RANDOM_S if duration_s is None else duration_s
    driver = Driver(
        robot.drive,
        draws["driver"],
        floor_m=scene.lab.floor_m,
        obstacles=obstacles,
        footprint_radius_m=robot.footprint_radius_m,
        start=scene.start,
        speed=speed,
        duration_s=room["duration_s"],
    )
    motion = play([[0.0, 0.0, 0.0]], robot.drive, start=scene.start, controller=driver, **room)
    return motion, {"path": "random", "controller": "driver", "speed_m_s": float(speed), **metadata}


def check_run(
    scene: Scene,
    path: Path | Commands | Run | str,
    *,
    anomaly_map: AnomalyMap,
    rate_hz: float | None,
    duration_s: float | None,
    lidar: Literal["schedule", "on", "off"],
    network: bool,
) -> float:
    """The magnetometer's rate [Hz] in a run against which nothing speaks; arguments as for `simulate`.

    Raises:
        InputError: The path leaves the floor, an option is out of range, or nothing gives the disturbance.
    """
    robot = scene.robot
    rate = robot.magnetometer.rate_hz if rate_hz is None else rate_hz
    if not 0 < rate < math.inf:
        raise InputError(f"rate_hz of the magnetometer must be above 0 Hz and finite, got {rate!r}")
    if not network:
        _check_kind(scene)
        check_truth(scene, anomaly_map)
    lidar_on(robot.lidar, 0.0, lidar)  # refuses an unknown mode before anything is computed
    if isinstance(path, Path):
        check_on_floor(path, scene.lab.floor_m, robot.footprint_radius_m)
    if duration_s is not None:
        _check_readings(duration_s, rate)
    return rate


def add_error(columns: dict[str, NDArray[Any]]) -> None:
    """Add the model error to readings, but to those that latched, in place.

    It was estimated from readings, so it does not go through the sensor's low-pass.
    """
    error, lost = columns["b_model_error_nt"], columns["flag_lost_lock"]
    columns["b_measured_nt"] = columns["b_measured_nt"] + np.where(lost, 0.0, error)
    columns["b_noise_nt"] = columns["b_noise_nt"] - np.where(lost, error, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensed:
    """A run in which every sensor has been read but the magnetometer."""

    run: Run
    """Every column but those that the disturbance makes."""

    scene: Scene

    rate_hz: float
    """Magnetometer readings a second [Hz]."""

    steep: NDArray[np.bool_]
    """Whether lock is lost to the gradient at each reading, shape (N,)."""

    rng: np.random.Generator
    """Source of the magnetometer's noise; spent by one reading."""

    error_rng: np.random.Generator
    """Source of the error of a network's predictions; spent by one reading."""

    wanted: frozenset[str]
    """Columns of `COLUMNS` that the whole run is to have."""

    beside_nt: Array | float = 0.0
    """What other robots add to the field's magnitude at each reading [nT], shape (N,); 0 without others."""

    def read(
        self,
        predicted: Predicted | None = None,
        model_error: ModelError | None = None,
    ) -> Run:
        """The whole run, of the columns that are wanted.

        Args:
            predicted: What a network predicts; None for a magnetometer without one.
            model_error: Statistics of the error of that; None draws none, nor does a prediction without a
                standard deviation.
        """
        columns, spec = dict(self.run.columns), self.scene.robot.magnetometer
        rows = len(columns["t"])
        error = np.zeros(rows)
        if predicted is None:
            exact = columns["b_truth_nt"] - columns["b_map_nt"]
            disturbance = exact if spec.kind == "physical" else np.zeros(rows)
        else:
            mean, sd = predicted if isinstance(predicted, tuple) else (predicted, None)
            disturbance = np.asarray(mean, float)
            if model_error is not None and sd is not None:
                white = self.error_rng.standard_normal(rows)
                error = model_error.error_nt(sd, model_error.process(white, self.rate_hz))
                error = rounded(error, spec.resolution_nt)
            if disturbance.shape != (rows,):
                raise InputError(f"disturbance_nt must give shape {(rows,)}, got {disturbance.shape}")
            disturbance = disturbance + self.beside_nt
        columns["b_disturbance_nt"] = disturbance
        columns["b_total_nt"] = columns["b_map_nt"] + disturbance
        columns["b_model_error_nt"] = error
        if self.wanted & _READ:
            columns |= sense_magnetometer(
                spec,
                columns["b_total_nt"],
                columns["b_vector_nt"] if "b_vector_nt" in columns else np.full((rows, 3), np.nan),
                self.rng,
                rate_hz=self.rate_hz,
                steep=self.steep,
                axes="b_vector_measured_nt" in self.wanted,
            )
            add_error(columns)
        return Run({name: columns[name] for name in COLUMNS if name in self.wanted}, self.run.metadata)


def sense(
    scene: Scene,
    motion: Travel,
    draws: Mapping[str, np.random.Generator],
    *,
    anomaly_map: AnomalyMap,
    rate_hz: float,
    duration_s: float | None,
    outside: Literal["nan", "clamp", "raise"],
    lidar: Literal["schedule", "on", "off"],
    metadata: Mapping[str, str | int | float | bool],
    network: bool,
    wanted: Iterable[str] = COLUMNS,
    inputs: Iterable[str] = COLUMNS,
    companions: Sequence[Companion] = (),
) -> Sensed:
    """Read every sensor but the magnetometer in what a robot did.

    What neither is wanted nor goes into what is, is not computed; as each sensor draws from a generator of
    its own, the bits of the others do not depend on that.

    Args:
        scene: As for `simulate`.
        motion: What the robot did.
        draws: What `streams` gave.
        anomaly_map: As for `simulate`.
        rate_hz: Magnetometer readings a second [Hz].
        duration_s: How long [s]; None is as long as the motion.
        outside: As for `simulate`.
        lidar: As for `simulate`.
        metadata: How the motion came about.
        network: Whether a network will predict the disturbance.
        wanted: Columns of `COLUMNS` that the whole run is to have.
        inputs: Columns that the network reads.
        companions: Other robots in the lab, whose iron the magnetometer reads too where the Earth's field is
            known: what a network predicts is without it.
    """
    robot, wanted = scene.robot, frozenset(wanted)
    needed = wanted | frozenset(inputs if network else ())
    read = bool(wanted & _READ)
    felt = network and "b_vector_measured_nt" in needed
    beside_others = bool(companions and scene.earth is not None)
    exact = bool(
        felt
        or wanted & _EXACT
        or (not network and robot.magnetometer.kind == "physical")
        or (read and feels_direction(robot.magnetometer))
        or beside_others
    )
    field = ExactField(scene=scene, anomaly_map=anomaly_map, outside=outside)
    physical = not network and robot.magnetometer.kind == "physical"
    known = field.of == "sources" or (field.of == "map" and (physical or beside_others))
    end = motion.duration_s if duration_s is None else duration_s
    _check_readings(end, rate_hz)
    t = np.arange(max(1, math.ceil(end * rate_hz - 1e-9))) / rate_hz
    true = motion.at(t)
    columns, beside = truth(true, t, robot.base_height_m), np.zeros(len(t))
    if needed & _ODOMETRY:
        columns |= sense_odometry(robot.drive, motion, t, draws["odometry"])
    if needed & _IMU:
        columns |= sense_imu(robot.imu, robot.q_base_imu_xyzw, motion, t, draws["imu"])
    if needed & _MOCAP:
        columns |= sense_mocap(robot.mocap, robot.base_height_m, motion, t, draws["mocap"])
    columns["lidar_on"] = lidar_on(robot.lidar, t, lidar)
    sloped = "b_map_gradient_nt_m" in needed
    columns |= mapped(anomaly_map, true.pose[:, :2], columns["yaw"], outside, gradient=sloped)
    if exact or needed & _BATTERY:
        pack = discharge(robot.battery, robot.drive, motion, partial(lidar_on, robot.lidar, mode=lidar), end)
        columns |= sense_battery(robot.battery, pack, t, draws["battery"])
        if exact:
            supply_a = pack.current_a[pack.index(t)]
            columns |= exact_field(field if known else None, scene, motion, t, true, columns, supply_a)
            if beside_others:
                added = companions_field_nt(scene, companions, motion, t, true)
                before = columns["b_truth_nt"]
                columns |= _with(columns["b_vector_nt"], into_sensor(added, robot.q_base_magnetometer_xyzw))
                beside = columns["b_truth_nt"] - before
            if field.of == "map" and not physical:  # the robot's spec is no measurement to judge a network by
                columns |= exact_field(None, scene, motion, t, true, columns, supply_a)
    steep = _steep(field, motion, t) if read or felt else np.zeros(len(t), bool)
    if felt:
        columns["b_vector_measured_nt"] = sense_axes(
            robot.magnetometer, columns["b_vector_nt"], draws["magnetometer"], rate_hz=rate_hz, steep=steep
        )
    columns |= flags(scene, true)
    if companions:
        columns["flag_bump"] = columns["flag_bump"] | touching(t, motion, robot, companions)
    columns["b_sd_nt"] = np.full(len(t), np.nan)
    told: dict[str, str | int | float | bool] = {
        "scene": scene.name,
        **metadata,
        **robot_metadata(robot),
        "rate_hz": float(rate_hz),
        "duration_s": round(float(end), 9),
        "outside": outside,
        "lidar": lidar,
        "magnetometer": "neural" if network else robot.magnetometer.kind,
        **(field.metadata if physical else {}),
    }
    return Sensed(
        run=Run(columns, told),
        scene=scene,
        rate_hz=rate_hz,
        steep=steep,
        rng=draws["magnetometer"],
        error_rng=draws["model_error"],
        wanted=wanted,
        beside_nt=beside,
    )


def robot_metadata(robot: RobotSpec) -> dict[str, str | int | float | bool]:
    """What a run tells of its robot, for a network that learns from it: name, sensor, motion capture.

    `mocap_latency_s` is the mean age of motion capture's pose: latency, mean jitter and half a period.
    """
    mocap = robot.mocap
    return {
        "robot_name": robot.name,
        "sensor_m": _listed(robot.p_base_magnetometer),
        "mocap_offset_m": _listed(mocap.offset_m),
        "mocap_latency_s": round(mocap.latency_s + mocap.jitter_s + 0.5 / mocap.rate_hz, 6),
    }


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def _check_kind(scene: Scene) -> None:
    """Refuse a magnetometer of which nothing gives the disturbance."""
    kind = scene.robot.magnetometer.kind
    if kind == "neural":
        raise InputError(
            f"scene {scene.name!r} has a neural magnetometer, and no network predicts its disturbance; open "
            'it as a twin that names one, or take the kind "physical" or "map-only"'
        )


def _check_readings(duration_s: float, rate_hz: float) -> None:
    """Refuse a run of which no memory could hold the columns."""
    if not math.isfinite(duration_s):
        raise InputError(f"duration_s must be above 0 s and finite, got {duration_s!r}")
    if duration_s * rate_hz > MOST_READINGS:
        raise InputError(
            f"{duration_s:g} s at {rate_hz:g} Hz make {duration_s * rate_hz:.3g} readings, more than "
            f"{MOST_READINGS:,}; lower rate_hz to {MOST_READINGS / duration_s:.4g} Hz, or duration_s "
            f"to {MOST_READINGS / rate_hz:.4g} s"
        )


def truth(true: Moment, t: Array, height_m: float) -> dict[str, NDArray[Any]]:
    """The columns of what the robot did and was told."""
    zero, yaw = np.zeros(len(t)), wrap_angle(true.pose[:, 2])
    return {
        "t": t,
        "p_world_base": np.column_stack([true.pose[:, :2], zero + height_m]),
        "q_world_base_xyzw": quat_from_yaw(yaw),
        "yaw": yaw,
        "v_base": np.column_stack([true.v, zero, zero]),
        "w_base": np.column_stack([zero, zero, true.w]),
        "v_cmd": true.v_cmd,
        "w_cmd": true.w_cmd,
        "wheel_angle": true.wheel_angle,
    }


def mapped(
    anomaly_map: AnomalyMap,
    xy: Array,
    yaw: Array,
    outside: Literal["nan", "clamp", "raise"],
    *,
    gradient: bool,
) -> dict[str, NDArray[Any]]:
    """Map at base_link's poses, its gradient in base_link's axes if wanted, and where there is none."""
    columns = {}
    if gradient:
        b, slopes = anomaly_map.lookup_with_gradient(xy, yaw, outside=outside)
        columns["b_map_gradient_nt_m"] = into_base(slopes[:, :2], yaw)
    else:
        b = anomaly_map.lookup(xy, yaw, outside=outside)
    off = np.isnan(b)
    if outside == "clamp":
        off = off | ~anomaly_map.contains(xy)
    return {"b_map_nt": b, **columns, "flag_outside_map": off}


def exact_field(
    field: ExactField | None,
    scene: Scene,
    motion: Moving,
    t: Array,
    true: Moment,
    columns: Mapping[str, NDArray[Any]],
    supply_a: Array,
) -> dict[str, NDArray[Any]]:
    """Field at the magnetometer, vector in its axes and magnitude; nan where it is not known."""
    if field is None or field.of == "none":
        return {"b_vector_nt": np.full((len(t), 3), np.nan), "b_truth_nt": np.full(len(t), np.nan)}
    vector = field.at_sensor_nt(
        scene,
        motion,
        t,
        true=true,
        lidar_on=columns["lidar_on"],
        supply_a=supply_a,
        at_rest_nt=columns["b_map_nt"],
    )
    return {
        "b_vector_nt": into_sensor(vector, scene.robot.q_base_magnetometer_xyzw),
        "b_truth_nt": field.magnitude_nt(vector, columns["b_map_nt"]),
    }


def _with(b_vector_nt: Array, added_nt: Array) -> dict[str, NDArray[Any]]:
    """Field at the magnetometer with one that comes to it, both in its axes."""
    vector = b_vector_nt + added_nt
    x, y, z = vector.T
    return {"b_vector_nt": vector, "b_truth_nt": np.sqrt(x * x + y * y + z * z)}


def _steep(field: ExactField, motion: Moving, t: Array) -> NDArray[np.bool_]:
    """Where the magnetometer has lost lock to the gradient: the exact one, or the map's where that is all."""
    scene, spec = field.scene, field.scene.robot.magnetometer
    if not spec.gradient_max_nt_m:
        return np.zeros(len(t), bool)
    seen = (t * LOCK_RATE_HZ + 1e-9).astype(int)
    pose = motion.at(np.arange(seen[-1] + 1) / LOCK_RATE_HZ).pose
    if field.of != "sources":
        gradient = np.hypot(*field.anomaly_map.gradient(pose[:, :2], pose[:, 2])[:, :2].T)
    else:
        places = sensor_places(scene.robot, pose)
        gradient = level_gradient_nt_m(scene, places[:, :2], places[0, 2])
    return lost_in(spec, gradient)[seen]


def flags(scene: Scene, true: Moment) -> dict[str, NDArray[Any]]:
    """Touching an obstacle, or the floor's border; and what only a caller with a network knows."""
    x, y = np.abs(true.pose[:, 0]), np.abs(true.pose[:, 1])
    most_x, most_y = np.array(scene.lab.floor_m) / 2 + 1e-9
    radius = scene.robot.footprint_radius_m
    return {
        "flag_bump": true.bump | (x + radius > most_x) | (y + radius > most_y),
        "flag_out_of_distribution": np.zeros(len(true.v), bool),
    }
