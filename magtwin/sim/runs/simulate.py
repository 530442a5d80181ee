"""simulate: drive a scene's robot, read its sensors, and return a Run with every column."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.path import Path, check_on_floor
from magtwin.run.run import Run
from magtwin.run.spool import Spool
from magtwin.sim.exact import check_truth
from magtwin.sim.extensions import Interference, SensorFactory
from magtwin.sim.motion.drive_input import DriveInput
from magtwin.sim.motion.engine import Travel
from magtwin.sim.runs.driving import Metadata, Trip, course_of, drive
from magtwin.sim.runs.sensing import Conditions, Predicted, Sensing, streams
from magtwin.sim.sensors.lidar import lidar_on
from magtwin.sim.sensors.model_error import ModelError
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Predict = Callable[[Run], Predicted]
"""From a Run to what a network predicts for it."""

HIGHEST_HZ = 10_000.0
"""Highest rate of a sensor beside the magnetometer [Hz]."""

HIGHEST_READINGS_HZ = 100_000.0
"""Highest rate of a magnetometer [Hz]."""

LATEST_S = 3_600.0
"""Largest offset of a magnetometer's clock [s]."""

FASTEST = 1e6
"""Highest speed of a drive [m/s, rad/s]."""

MOST_READINGS = 20_000_000
"""Most readings of a run: about 12 GB of columns on the disk."""


@dataclass(frozen=True, eq=False)
class Sensed:
    """A run in which all sensors but the magnetometer's scalar have been read."""

    run: Run
    """Every column but those that depend on the disturbance."""

    sensing: Sensing
    """The sensors."""

    @property
    def wanted(self) -> frozenset[str]:
        """Columns of `COLUMNS` that the whole run has."""
        return self.sensing.wanted

    def read(self, predicted: Predicted | None = None, model_error: ModelError | None = None) -> Run:
        """Read the magnetometer, once; returns the whole run. Arguments as for `Sensing.read`."""
        columns = self.sensing.read(self.run.columns, predicted, model_error)
        return Run(columns, self.run.metadata, self.sensing.specs)

    def predicted(self, predict: Predict, model_error: ModelError | None = None) -> Run:
        """Read the magnetometer with what a network predicts of the other columns."""
        return self.read(predict(self.run), model_error)


Finish = Callable[[Sensed], Run]
"""Makes a whole run, or a block of a long one, in which all but the magnetometer has been read."""


def simulate(
    scene: Scene,
    path: DriveInput,
    *,
    anomaly_map: AnomalyMap,
    rng: np.random.Generator,
    speed: float = 0.2,
    network: bool = False,
    finish: Finish = Sensed.read,
    sensors: Iterable[str | SensorFactory] = (),
    interference: Iterable[str | Interference] = (),
    progress: Callable[[int, int, str], Any] | None = None,
    each: Callable[[Run], Any] | None = None,
    **options: Any,
) -> Run:
    """Drive a scene's robot along a path and read its sensors; see `magtwin.twin.simulation.simulate`.

    b_total = b_map + b_disturbance with b_map at base_link's pose, and b_measured = b_total + b_model_error +
    b_noise. The disturbance depends on the kind of the magnetometer. A neural one takes what `finish`
    gives it. A physical one takes b_truth - b_map: the exact field of the lab and of the robot at the
    magnetometer, less the map. One of the kind "map-only" has none. `magtwin.sim.exact` defines the exact
    field. If Earth and sources make it, b_truth and b_vector are given for all kinds; if the map does, for a
    physical magnetometer only.

    Args:
        scene: Lab, robot and sensors.
        path: What to drive. On a Path the robot begins at its first point, along it. Commands are played from
            the scene's start. A Run is driven as it was recorded, and its sensors are read anew. "random" is
            a human-like driver from the scene's start.
        anomaly_map: The map of `scene.map_layer`.
        rng: Source of all noise.
        speed: Forward speed on straight parts of the path [m/s].
        network: Whether a network predicts the disturbance.
        finish: Reads the magnetometer of the run, or of each block of a long one, with what a network
            predicts for it, and returns it as it is to be kept; see `Sensed`.
        sensors: Custom sensors: names or factories; see `magtwin.sim.extensions`.
        interference: Custom terms of the field at the magnetometer: names or functions.
        progress: Called with readings made, readings in all and the simulated time as text, in a long run.
        each: Called with each block of a long run, as `finish` gave it.
        options: The fields of `Conditions` that have a default.

    Returns:
        A Run with every column of `COLUMNS`, in their order. `b_sd_nt` is nan and `flag_out_of_distribution`
        is false, because both depend on the network.
    """
    conditions = Conditions(anomaly_map=anomaly_map, network=network, **options)
    check_run(scene, path, conditions)
    draws = streams(rng)
    sensing = Sensing(scene, draws, conditions, sensors=sensors, interference=interference)
    course = course_of(scene, path, speed, conditions)
    (motion,) = drive([Trip(scene, course, draws)], conditions)

    return read_all(sensing, motion, course.metadata, finish, progress=progress, each=each)


def check_run(scene: Scene, path: DriveInput, conditions: Conditions) -> None:
    """Check the arguments of `simulate`."""
    robot = scene.robot
    rate = robot.magnetometer.rate_hz if conditions.rate_hz is None else conditions.rate_hz
    check_asked(conditions.duration_s, rate)
    if not conditions.network:
        if robot.magnetometer.kind == "neural":
            raise InputError(
                f"scene {scene.name!r} has a neural magnetometer, and no network predicts its disturbance; "
                'open it as a twin that names one, or take the kind "physical" or "map-only"'
            )
        check_truth(scene, conditions.anomaly_map)
    _check_numbers(robot)
    lidar_on(robot.lidar, 0.0, conditions.lidar)  # refuses an unknown mode before anything is computed
    if isinstance(path, Path):
        check_on_floor(path, scene.lab, robot.footprint_radius_m)
    if conditions.duration_s is not None:
        _check_readings(conditions.duration_s, rate)


def sense_all(sensing: Sensing, motion: Travel, metadata: Mapping[str, str | int | float | bool]) -> Sensed:
    """Read the sensors of a whole run."""
    count, known = readings(sensing, motion, metadata)
    t = np.arange(count) / sensing.rate_hz
    return Sensed(Run(sensing.sense(motion, t), known, sensing.specs), sensing)


def read_all(
    sensing: Sensing,
    motion: Travel,
    metadata: Mapping[str, str | int | float | bool],
    finish: Finish,
    *,
    progress: Callable[[int, int, str], Any] | None = None,
    each: Callable[[Run], Any] | None = None,
) -> Run:
    """Read the sensors of a whole run, a long one block by block; the bytes do not depend on the blocks."""
    count, known = readings(sensing, motion, metadata)
    whole, rows = Spool(count), sensing.rows_at_once(count)
    for first in range(0, count, rows):
        t = np.arange(first, min(first + rows, count)) / sensing.rate_hz
        block = finish(Sensed(Run(sensing.sense(motion, t), known, sensing.specs), sensing))
        whole.append(block)
        if rows == count:
            break
        sensing.forget()
        if each is not None:
            each(block)
        if progress is not None:
            progress(first + len(t), count, f"{t[-1]:,.0f} s")
    return whole.run


def readings(
    sensing: Sensing, motion: Travel, metadata: Mapping[str, str | int | float | bool]
) -> tuple[int, Metadata]:
    """Number of the readings of a run, and its metadata; arguments as for `sense_all`."""
    conditions = sensing.conditions
    end = motion.duration_s if conditions.duration_s is None else conditions.duration_s
    _check_readings(end, sensing.rate_hz)
    count = max(1, math.ceil(end * sensing.rate_hz - 1e-9))
    return count, {**run_metadata(sensing), **metadata, "duration_s": round(float(end), 9)}


def run_metadata(sensing: Sensing) -> Metadata:
    """Metadata of a run on its scene, robot and sensors."""
    robot = sensing.scene.robot
    return {
        "scene": sensing.scene.name,
        **robot_metadata(robot),
        "rate_hz": float(sensing.rate_hz),
        "outside": sensing.conditions.outside,
        "lidar": sensing.conditions.lidar,
        "magnetometer": "neural" if sensing.conditions.network else robot.magnetometer.kind,
        **sensing.metadata,
    }


def robot_metadata(robot: RobotSpec) -> Metadata:
    """Metadata on a robot for a network that learns from its runs: name, sensor, motion capture.

    `mocap_latency_s` is the mean age of motion capture's pose: latency, mean jitter and half a period.
    """
    mocap = robot.mocap
    return {
        "robot_name": robot.name,
        "sensor_m": ", ".join(f"{value:.6g}" for value in robot.p_base_magnetometer),
        "mocap_offset_m": ", ".join(f"{value:.6g}" for value in mocap.offset_m),
        "mocap_latency_s": round(mocap.latency_s + mocap.jitter_s + 0.5 / mocap.rate_hz, 6),
    }


def _check_numbers(robot: RobotSpec) -> None:
    """Refuse numbers of a robot that no run can compute or hold in memory."""
    for spec, name, most in (
        (robot.drive, "odometry_rate_hz", HIGHEST_HZ),
        (robot.imu, "rate_hz", HIGHEST_HZ),
        (robot.mocap, "rate_hz", HIGHEST_HZ),
        (robot.battery, "rate_hz", HIGHEST_HZ),
        (robot.magnetometer, "clock_offset_s", LATEST_S),
        (robot.drive, "v_max", FASTEST),
        (robot.drive, "w_max", FASTEST),
    ):
        value = getattr(spec, name)
        if abs(value) > most:
            text = f"{name} of {type(spec).__name__} must be at most {most:g}, got {value!r}"
            raise InputError(f"robot {robot.name!r}: {text}")


def check_asked(duration_s: float | None, rate_hz: float | None, speed: float = 0.2) -> None:
    """Refuse values that no robot allows. It needs no scene, so it comes before one is opened."""
    if not 0 < speed <= FASTEST:
        text = f"speed must be above 0 m/s and at most the drive's v_max, got {speed!r}"
        raise InputError(text, parameter="speed")
    asked = (duration_s, "duration_s", "s"), (rate_hz, "rate_hz of the magnetometer", "Hz")
    for value, what, unit in asked:
        if value is not None and not 0 < value < math.inf:
            text = f"{what} must be above 0 {unit} and finite, got {value!r}"
            raise InputError(text, parameter=what.partition(" ")[0])


def _check_readings(duration_s: float, rate_hz: float) -> None:
    """Refuse a run whose columns no memory can hold, or a rate of no magnetometer."""
    if duration_s * rate_hz > MOST_READINGS:
        raise InputError(
            f"{duration_s:g} s at {rate_hz:g} Hz make {duration_s * rate_hz:.3g} readings, more than "
            f"{MOST_READINGS:,}; lower `rate_hz` to {MOST_READINGS / duration_s:.4g} Hz, or `duration_s` "
            f"to {MOST_READINGS / rate_hz:.4g} s"
        )
    if rate_hz > HIGHEST_READINGS_HZ:
        most = f"at most {HIGHEST_READINGS_HZ:,.0f} Hz for a magnetometer"
        raise InputError(f"rate_hz must be {most}, got {rate_hz:g}", parameter="rate_hz")
