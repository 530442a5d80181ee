"""Twin case: a drive in a twin, with the errors of a scenario, as a problem with its truth.

All draws of a run come from its seed, so that a run is the same in any order and on any machine.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magtwin.bench import world
from magtwin.bench.case import Case, Truth
from magtwin.bench.draws import chained, drawn_prior, moves, noisy_odometry
from magtwin.bench.suite import Scenario
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_yaw, wrap_angle, yaw_from_quat
from magtwin.localization.problem import FieldBelief, Problem, SensorModel
from magtwin.run.run import Run
from magtwin.sim.sensors.noise import decaying

if TYPE_CHECKING:
    from magtwin.twin import Twin

Array = NDArray[np.float64]

STREAMS = ("odometry", "noise", "prior", "map", "kidnap", "moved", "localizer")
"""Who draws, each from its own child generator. Append only: the order is part of the seed."""

SESSION = 7
"""Second word of the seed of what a session has in common."""

ROBOT = ("platform_sha256", "sensor_m", "plant", "session")
"""Metadata of a drive by which a network knows the robot of its training."""

ONBOARD = ("imu_*", "odom_v", "odom_w", "battery_v", "battery_a", "lidar_on", "v_cmd", "w_cmd")
"""Columns of a drive that localizers get besides odometry and readings."""

Place = tuple[str, str]
"""Stage of a scene and its lab, as `open_twin` takes them."""


def twin_case(scenario: Scenario, scene: str, seed: int, session: int, fields: Path | None = None) -> Case:
    """One run of a scenario in a twin.

    Args:
        scenario: The scenario.
        scene: Stage of its scene.
        seed: Seed of the run.
        session: Number of its session.
        fields: Folder of `world.fit_field` if the scenario's data are a survey. None: the scene's map is the
            true field.

    Raises:
        InputError: A path or the scene is unknown, or the drive leaves no room for a kidnap.
    """
    place = scene, scenario.lab
    rngs = dict(zip(STREAMS, np.random.default_rng((seed, 1)).spawn(len(STREAMS)), strict=True))
    field = _field(place, fields)
    drive = _drive(scenario, place, seed, session)
    return case_of(
        scenario,
        drive,
        field,
        lambda rng: _belief(scenario, place, fields, rng),
        np.random.default_rng((session, SESSION)).normal(0.0, 1.0, 2),
        rngs,
        calibration=_calibration(scenario, place, session),
    )


def case_of(
    scenario: Scenario,
    drive: Run,
    field: AnomalyMap,
    belief: Callable[[np.random.Generator], FieldBelief | None],
    iron: Array,
    rngs: Mapping[str, np.random.Generator],
    *,
    calibration: Run | None = None,
    scale_m: float | None = None,
) -> Case:
    """A drive with the errors of a scenario.

    Args:
        scenario: The scenario.
        drive: True poses, on-board columns, and the sensor's place in its metadata.
        field: The true field.
        belief: Draws what localizers know of it.
        iron: The session's iron, standard normal, shape (2,).
        rngs: Generators of all `STREAMS`.
        calibration: A labelled drive of the session.
        scale_m: As `Truth.scale_m`.
    """
    t, pose, cuts, rows = _kidnapped(scenario, drive, rngs["kidnap"])
    true_field = world.certain(field)
    if scenario.moved_nt:
        true_field = world.with_moved_object(field, scenario.moved_nt, rngs["moved"])
    odometry = _odometry(scenario, drive, pose, rows, cuts, t, rngs["odometry"])
    if scenario.truth == "map":
        iron = iron * scenario.sensor.iron_nt
        lever = np.add(_lever(drive), scenario.lever_error_m)
        b = _readings(scenario, true_field, t, pose, lever, iron, rngs["noise"])
    else:
        b = drive["b_measured_nt"][rows]
        if scenario.offset_s:
            b = np.interp(t - scenario.offset_s, t, b)
    if scenario.stuck_s:
        begin = t[0] + (t[-1] - t[0]) / 3
        held = (t >= begin) & (t < begin + scenario.stuck_s)
        if held.any():
            b = np.where(held, b[np.argmax(held)], b)
    signals = drive.select(*ONBOARD) if "odom_v" in drive else {}
    readings = Run(
        {
            **{name: values[rows] for name, values in signals.items()},
            "t": t,
            "odom_p": np.column_stack([odometry[:, :2], np.zeros(len(t))]),
            "odom_q_xyzw": quat_from_yaw(odometry[:, 2]),
            "b_measured_nt": b,
        },
        {name: drive.metadata[name] for name in ROBOT if name in drive.metadata},
    )
    problem = Problem(
        belief=belief(rngs["map"]),
        extent=field.extent,
        prior=drawn_prior(scenario.prior, pose[0], rngs["prior"]),
        sensor=replace(scenario.sensor, lever_arm_m=_lever(drive)),
        odometry=scenario.told_odometry,
        map_length_m=scenario.map_length_m,
        rate_hz=scenario.rate_hz,
        calibration=calibration,
        seed=int(rngs["localizer"].integers(2**31)),
    )
    truth = Truth(t, pose, true_field, tuple(t[cuts].tolist()), scale_m)
    return Case(problem, readings, truth)


@lru_cache(maxsize=4)
def _twin(place: Place, magnetometer: str) -> "Twin":
    from magtwin.twin import open_twin

    scene, lab = place
    return open_twin(scene, lab=lab, magnetometer=magnetometer)  # type: ignore[arg-type]


@lru_cache(maxsize=64)
def _in_session(place: Place, magnetometer: str, session: int) -> "Twin":
    from magtwin.twin import in_session

    return in_session(_twin(place, magnetometer), session)


def _field(place: Place, fields: Path | None) -> AnomalyMap:
    """The true field of the twin, or of a survey."""
    if fields is None:
        return _twin(place, "map-only").field
    return world.fitted_field(fields / "truth.npz")


def _drive(
    scenario: Scenario, place: Place, seed: int, session: int, *, duration_s: float | None = None
) -> Run:
    """A simulated drive, long enough for the kidnaps."""
    from magtwin.sim.motion.drive_input import drive_input
    from magtwin.twin import room_of, simulate

    kind = "map-only" if scenario.truth == "map" else "physical"
    twin = _in_session(place, kind, session)
    path = drive_input(scenario.paths[seed % len(scenario.paths)], room_of(twin), fit=True)
    length = scenario.duration_s * (2 if scenario.kidnaps else 1) if duration_s is None else duration_s
    run = simulate(twin, path, seed=seed, duration_s=length, rate_hz=scenario.rate_hz, outside="clamp")
    if run.rows < 2:
        raise InputError(f"scenario {scenario.name!r}: a drive of {length:g} s has fewer than two readings")
    return run


def _pose(run: Run) -> Array:
    return np.column_stack([run["p_world_base"][:, :2], np.unwrap(run["yaw"])])


def _lever(run: Run) -> tuple[float, float]:
    words = str(run.metadata["sensor_m"]).split(",")
    return float(words[0]), float(words[1])


def _kidnapped(
    scenario: Scenario, drive: Run, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp]]:
    """Times, true poses, rows after a kidnap, and the rows of the drive."""
    pose = _pose(drive)
    count = min(round(scenario.duration_s * scenario.rate_hz), drive.rows)
    if not scenario.kidnaps:
        rows = np.arange(count)
        return drive["t"][rows], pose[rows], np.empty(0, np.intp), rows
    length = count // (scenario.kidnaps + 1)
    begin = int(rng.integers(drive.rows - length))
    pieces = [np.arange(begin, begin + length)]
    least, most = scenario.kidnap_m
    for k in range(scenario.kidnaps):
        last = k == scenario.kidnaps - 1
        rest = count - (scenario.kidnaps) * length if last else length
        starts = np.arange(drive.rows - rest)
        away = np.hypot(*(pose[starts, :2] - pose[pieces[-1][-1], :2]).T)
        near = starts[(away >= least) & (away <= most)]
        if not len(near):
            raise InputError(f"scenario {scenario.name!r}: no place {least:g} to {most:g} m away on the path")
        begin = int(rng.choice(near))
        pieces.append(np.arange(begin, begin + rest))
    rows = np.concatenate(pieces)
    cuts = np.cumsum([len(piece) for piece in pieces])[:-1]
    t = drive["t"][0] + np.arange(len(rows)) / scenario.rate_hz
    return t, pose[rows], cuts, rows


def _odometry(
    scenario: Scenario,
    drive: Run,
    pose: Array,
    rows: NDArray[np.intp],
    cuts: NDArray[np.intp],
    t: Array,
    rng: np.random.Generator,
) -> Array:
    """Poses in odom; a kidnap is not seen by the wheels."""
    if scenario.odometry == "model":
        steps = moves(pose)
        steps[cuts - 1] = 0.0
        return noisy_odometry(chained(steps), t, scenario.told_odometry, rng)
    yaw = np.unwrap(yaw_from_quat(drive["odom_q_xyzw"]))
    steps = moves(np.column_stack([drive["odom_p"][:, :2], yaw])[rows])
    steps[:, 2] = wrap_angle(steps[:, 2])
    steps[cuts - 1] = 0.0
    return chained(steps)


def _readings(
    scenario: Scenario,
    field: AnomalyMap,
    t: Array,
    pose: Array,
    lever: Array,
    iron: Array,
    rng: np.random.Generator,
) -> Array:
    """Readings of the field with the noise of the sensor's model."""
    at = pose
    if scenario.offset_s:
        at = np.column_stack([np.interp(t - scenario.offset_s, t, pose[:, k]) for k in range(3)])
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    place = at[:, :2] + np.column_stack([c * lever[0] - s * lever[1], s * lever[0] + c * lever[1]])
    b = field.lookup(place, at[:, 2], outside="clamp")
    offset = scenario.sensor.offset_nt * rng.standard_normal()
    drift = fogm(t, scenario.sensor, rng)
    white = scenario.sensor.white_nt * rng.standard_normal(len(t))
    return b + offset + drift + white + iron[0] * c + iron[1] * s


def fogm(t: Array, sensor: SensorModel, rng: np.random.Generator) -> Array:
    """A first-order Gauss-Markov process at times t [s]: the drift of a sensor [nT], shape (N,)."""
    z = rng.standard_normal(len(t))
    if len(t) < 2:
        return sensor.drift_nt * z
    keep = math.exp(-float(np.median(np.diff(t))) / sensor.drift_s)
    z[1:] *= math.sqrt(1 - keep**2)
    return sensor.drift_nt * decaying(z, keep)


def _belief(
    scenario: Scenario, place: Place, fields: Path | None, rng: np.random.Generator
) -> AnomalyMap | None:
    """What the localizer gets."""
    if scenario.belief == "none":
        return None
    if scenario.belief == "trilinear":
        if fields is not None:
            return world.fitted_field(fields / "nodes.npz")
        return _sparse(place, scenario.survey_spacing_m)
    if scenario.map_error_nt:
        return world.with_error(_field(place, fields), scenario.map_error_nt, scenario.map_length_m, rng)
    if scenario.truth == "scene":
        return _field(place, fields)  # with the variance of its survey
    return _certain(place, fields)


@lru_cache(maxsize=4)
def _certain(place: Place, fields: Path | None) -> AnomalyMap:
    return world.certain(_field(place, fields))


@lru_cache(maxsize=4)
def _sparse(place: Place, spacing_m: float) -> AnomalyMap:
    return world.trilinear(_field(place, None), spacing_m)


def _calibration(scenario: Scenario, place: Place, session: int) -> Run | None:
    """A labelled drive of the session, with true poses."""
    if not scenario.calibration_s:
        return None
    if scenario.truth != "scene":
        raise InputError(f'scenario {scenario.name!r}: calibration_s needs truth = "scene"')
    drive = _drive(
        replace(scenario, paths=("figure8",)), place, session, session, duration_s=scenario.calibration_s
    )
    truth = ("p_world_base", "q_world_base_xyzw", "yaw", "odom_p", "odom_q_xyzw", "b_measured_nt")
    return drive.select(*truth, *ONBOARD)
