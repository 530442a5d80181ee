"""Simulate: a twin and a path become a Run."""

import importlib
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, MismatchWarning, find
from magtwin.path import Path
from magtwin.report.verdict import OWN
from magtwin.run.run import Run
from magtwin.sim.motion.drive_input import DriveInput, drive_input, path_metadata
from magtwin.spec.plant import PlantSpec
from magtwin.twin.session import in_session, in_session_of, model_error_of, room_of, trained_on, with_plant
from magtwin.twin.twin import (
    OF_SCENE,
    Kind,
    Metadata,
    Network,
    Place,
    Session,
    Twin,
    checked_seed,
    opened,
    remember,
    scene_sha256,
)
from magtwin.version import __version__

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer, Read
    from magtwin.sim.extensions import Interference, SensorFactory
    from magtwin.sim.motion.commands import Commands
    from magtwin.sim.motion.controllers import Controller
    from magtwin.sim.motion.engine import Engine
    from magtwin.sim.runs.simulate import Finish, Sensed
    from magtwin.sim.sensors.lidar import Scans


_ON_STAGE = {"newton": "magtwin.twin.physics:newton"}
"""Engines that need the stage, and what makes them of a twin."""


def simulate(
    twin: Twin | Place,
    path: "Path | Commands | Run | str | FilePath | ArrayLike" = "figure8",
    *,
    seed: int = 0,
    session: Session | None = None,
    plant: PlantSpec | str | None = None,
    fit: bool = False,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    network: Network = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: "str | Controller" = "follower",
    engine: "str | Engine" = "kinematic",
    sensors: "Iterable[str | SensorFactory]" = (),
    interference: "Iterable[str | Interference]" = (),
    progress: Callable[[int, int, str], Any] | None = None,
    each: Callable[[Run], Any] | None = None,
) -> Run:
    """Drive the scene's robot along a path and read every sensor.

    Args:
        twin: An opened twin, or a scene as for `open_twin`.
        path: What to drive: the name of a path, a CSV file of x, y [m], points in world [m], shape (N, 2), or
            a `Path`; "random" for a random drive; `Commands` to play back; or a `Run` to drive again as
            recorded, with the scene's sensors.
        seed: Seed of all noise. The same seed gives byte-identical output.
        session: Session of the robot; see the function `in_session`. Default: session 0 of the seed.
            "survey" is the robot as it was during the survey of the map; a network trained on later
            sessions is not valid for it.
        plant: Effects in the robot's field that the linear platform model lacks and no network was trained
            on: "hysteresis", "warm-up", "nonlinear", "moving-part", or "drawn" for larger differences between
            sessions; "all" of these; or "nominal" for none. "NAME:SEED" draws the constants of an effect from
            another seed. Or a `PlantSpec`. Default: the scene's. See `draw_plant`.
        fit: Whether to move and shrink a path until it fits the floor and what stands on it.
        speed: Forward speed on straight parts [m/s].
        duration_s: Duration [s]. Default: once along the path. A longer duration drives further laps.
        rate_hz: Magnetometer readings per second [Hz]. Default: the scene's.
        network: As for `open_twin`; only if `twin` is not an opened twin.
        magnetometer: As for `open_twin`; only if `twin` is not an opened twin.
        model_error: Whether readings of a neural magnetometer include model error; see `open_twin`.
        lidar: Whether the LiDAR follows its schedule, or stays on or off.
        outside: What the map reads outside its extent: nan, the nearest value inside, or an error.
        controller: "follower" or "release", or a custom `magtwin.sim.motion.controllers.Controller`.
        engine: "kinematic"; "newton" for physics in the stage (`magtwin[physics]`); the name of a registered
            engine; or a custom `magtwin.sim.motion.engine.Engine`.
        sensors: Custom sensors: names of registered sensors, or functions that make a sensor. Their columns
            are added to the run; see `magtwin.sim.extensions`.
        interference: Custom terms of the field at the magnetometer: names of registered ones, or functions.
        progress: Called by slow engines as progress(steps done, maximum number of steps, simulated time
            as text), and in a long run with readings in place of steps.
        each: Called with each block of readings of a long run as soon as they are made.

    Returns:
        A Run with the columns of `magtwin.COLUMNS`. Its metadata contain everything that is needed to
        reproduce it. The columns of a run of more than 524,288 readings are in unnamed files in TMPDIR.

    Raises:
        InputError: The path leaves the floor or hits an obstacle; the whole path is outside the map; an
            option is out of range; or the scene's field is constant.
    """
    from magtwin.sim.exact import check_field, check_read
    from magtwin.sim.runs.simulate import simulate as run_scene

    seed = checked_seed(seed)
    twin = opened(twin, network, magnetometer, model_error, "simulate")
    if twin.scene.others:
        first, *others = (repr(placed.robot.name) for placed in twin.scene.robots)
        text = f"simulate drives {first} alone, without {', '.join(others)}; simulate_robots drives all"
        warnings.warn(text, MismatchWarning, stacklevel=2)
    twin = in_session(with_plant(twin, plant), session, seed=seed)
    check_field(twin.scene, twin.field)
    remember(twin)
    path = drive_input(path, room_of(twin), fit=fit)
    check_commands(path, twin.magnetometer)
    run = run_scene(
        twin.scene,
        path,
        anomaly_map=twin.field,
        rng=np.random.default_rng(seed),
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        network=twin.magnetometer is not None,
        finish=finisher(twin, path, seed, duration_s),
        outside=outside,
        lidar=lidar,
        obstacles=twin.obstacles,
        controller=controller,
        engine=engine_named(engine, twin, progress=progress) if isinstance(engine, str) else engine,
        sensors=sensors,
        interference=interference,
        progress=progress,
        each=each,
    )
    check_read(run, twin.field)
    return run


def scan(twin: Twin | Place, run: Run, *, seed: int = 0) -> "Scans":
    """The scans of the robot's LiDAR during a run, one per revolution while it was on.

    Args:
        twin: An opened twin in the run's session; or a `Scene` or the file of a stage.
        run: A run with t, p_world_base, yaw and lidar_on.
        seed: Seed of the noise.
    """
    from magtwin.sim.runs.sensing import streams
    from magtwin.sim.sensors.lidar import scans_of

    if not isinstance(twin, Twin):
        twin = in_session_of(opened(twin, None, "map-only", True, "scan"), run.metadata)
    rng = streams(np.random.default_rng(seed))["lidar"]
    return scans_of(run, twin.scene.robot, twin.obstacles, rng)


def engine_named(
    name: str, twin: Twin, *, progress: Callable[[int, int, str], Any] | None = None
) -> "Engine":
    """The engine that moves a twin's robot.

    Args:
        name: "kinematic", "newton", or the name of a registered engine.
        twin: The twin that it moves in.
        progress: Called by slow engines with steps done, steps at most, and the simulated time as text.

    Raises:
        InputError: No engine has that name, or it is not installed; the text names the extra.
    """
    from magtwin.sim.motion.engine import ENGINES

    find("engine", name, dict.fromkeys([*ENGINES, *_ON_STAGE]))
    if name not in _ON_STAGE:
        return ENGINES[name]
    module, _, function = _ON_STAGE[name].partition(":")
    engine: Engine = getattr(importlib.import_module(module), function)(twin, progress)
    return engine


def stated(twin: Twin, run: Run, read: "Read | None", *, add: bool = True) -> Run:
    """A run with what its network states of each reading; `add`: columns that the run lacks, too."""
    if read is None:
        return run
    spec = twin.scene.robot.magnetometer
    noise = spec.noise_density_nt * np.sqrt(float(run.metadata["rate_hz"]) / 2)
    columns: dict[str, NDArray[Any]] = {"b_sd_nt": np.hypot(read.stated_sd_nt, noise)}
    if read.outside is not None:
        columns["flag_out_of_distribution"] = read.outside
    return run.with_columns(**{name: array for name, array in columns.items() if add or name in run})


def finished(
    twin: Twin,
    run: Run,
    path: Metadata,
    read: "Read | None",
    *,
    seed: int,
    duration_s: float | None,
    config_sha256: str,
) -> Run:
    """A run with the metadata that reproduce it.

    Args:
        twin: The twin in its session.
        run: What the simulator made.
        path: What `path_metadata` gave for what was driven.
        read: What the network read. None without a network.
        seed: Seed of the run.
        duration_s: Duration that was asked for [s].
        config_sha256: `scene_sha256` of the twin's scene.
    """
    metadata: Metadata = {"magtwin": __version__, "numpy": np.__version__, "seed": seed}
    if duration_s is not None:
        metadata["asked_duration_s"] = float(duration_s)
    if twin.scene.robot.plant != PlantSpec():
        metadata["plant"] = OF_SCENE  # unless the twin's metadata name another
    if read is not None and read.intervals != OWN:
        metadata["network_intervals"] = read.intervals
    metadata |= dict(twin.session) | path | dict(twin.metadata)
    return run.with_metadata(**{**metadata, "config_sha256": config_sha256})


def check_commands(path: "Path | Commands | Run | str", network: "NeuralMagnetometer | None") -> None:
    """Refuse to replay a run without commands if the network reads them."""
    if network is None or not isinstance(path, Run):
        return
    for column in ("v_cmd", "w_cmd"):
        if column in network.columns and column not in path:
            what = f"the run to replay has no column {column!r}, which the network {network.name} reads"
            way = 'take a network that does not, such as the paper\'s, or `network="none"`'
            raise InputError(f"{what}; {way}", parameter="network")


def reader(twin: Twin, seed: int, *, which: int = 0) -> "Callable[[Sensed], tuple[Run, Read | None]]":
    """What reads the magnetometer of runs, or of blocks, in which all else has been sensed.

    `which` is the place of the robot in its scene.
    """
    network, trained = twin.magnetometer, trained_on(twin)
    error = model_error_of(twin, seed, which=which)

    def read_in(sensed: "Sensed") -> tuple[Run, "Read | None"]:
        if network is None:
            return sensed.read(), None
        if not sensed.run.rows:
            return sensed.read((np.zeros(0), np.zeros(0)), error), None
        (read,) = network.read([sensed.run], known=[trained])
        return stated(twin, sensed.read((read.disturbance_nt, read.sd_nt), error), read), read

    return read_in


def finisher(
    twin: Twin, path: DriveInput, seed: int, duration_s: float | None, *, which: int = 0
) -> "Finish":
    """What makes whole runs of those that a twin's robot has sensed; `which` as for `reader`."""
    read_in, driven = reader(twin, seed, which=which), path_metadata(path)
    known: Any = {"seed": seed, "duration_s": duration_s, "config_sha256": scene_sha256(twin.scene)}

    def finish(sensed: "Sensed") -> Run:
        run, read = read_in(sensed)
        return finished(twin, run, driven, read, **known)

    return finish
