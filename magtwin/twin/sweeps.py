"""Sweep: many runs of one scene, driven at once and made when asked for."""

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, RepairWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.motion.drive_input import drive_inputs, path_metadata
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.twin.session import in_session, model_error_of, room_of, trained_on, with_plant
from magtwin.twin.simulation import check_commands, finished, stated
from magtwin.twin.twin import Kind, Network, Twin, checked_seed, opened, scene_sha256, without_model_error

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer
    from magtwin.sim.motion.commands import Commands
    from magtwin.sim.runs.batch import Job, Runs
    from magtwin.sim.runs.simulate import Sensed

MIXTURE = ("sine", "lawnmower", "figure8", "continuous_cycle", "random")
"""Paths that a sweep drives by default. A model trained on one kind of path fails on the others."""


MOST_RUNS = 1_000_000
"""Largest number of runs of one sweep; their seeds and jobs are held in memory."""


def check_count(count: int) -> None:
    """Refuse more runs than one sweep makes."""
    if count > MOST_RUNS:
        raise InputError(
            f"{count:,} runs are too many for one sweep (at most {MOST_RUNS:,}); make several, each with "
            "another `seed`",
            parameter="count",
        )


def sweep(
    twin: Twin | Scene | str | FilePath,
    paths: "Path | Commands | Run | str | FilePath | ArrayLike | Iterable[Any] | None" = None,
    seeds: int | Iterable[int] = 100,
    *,
    seed: int = 0,
    sessions: int | Literal["survey"] | None = None,
    plant: PlantSpec | str | None = None,
    speeds: float | Iterable[float] | Literal["drawn"] = 0.2,
    robots: RobotSpec | Twin | Iterable[RobotSpec | Twin] | None = None,
    columns: Iterable[str] | None = None,
    block: int | None = None,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    network: Network = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: str = "follower",
) -> "Runs":
    """Simulate many runs, each with the robot alone in the scene.

    `sweep(twin, paths, seeds)[i]` equals `simulate(twin, paths[i], seed=seeds[i])` to the bit, whatever the
    number of runs, their order and the block. Everything is checked at once; runs are made when asked for:
    iterate over the result to bound memory, or `save` it to a folder.

    Args:
        twin: An opened twin, a `Scene`, or the file of a stage.
        paths: What to drive, as for `simulate`: one for all runs, or several, taken in turn. Default:
            `magtwin.twin.MIXTURE`.
        seeds: A seed for each run; or the number of runs, whose seeds then are `seed`, `seed` + 1, ...
        seed: First seed if `seeds` is a number. It also draws sessions and speeds.
        sessions: Number of sessions, drawn from `seed`; each takes an equal share of the runs, one after the
            other. "survey" is the robot as it was when the map was surveyed. Default: each run has its own
            session, drawn from its seed.
        plant: As for `simulate`; all runs have the same constants.
        speeds: Forward speed of each run on straight parts [m/s], or one for all; "drawn" draws a speed for
            each run, as people drive.
        robots: What drives each run, or one for all: a `RobotSpec`, or a twin in a session. Default: the
            scene's robot in the session above.
        columns: Columns to keep beside t. Default: all.
        block: Runs that are made at a time. Default: as many as fit into 0.1 GB for runs of a minute.
        duration_s: As for `simulate`, of each run.
        rate_hz: As for `simulate`.
        network: As for `simulate`.
        magnetometer: As for `simulate`.
        model_error: As for `simulate`.
        lidar: As for `simulate`.
        outside: As for `simulate`.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.

    Returns:
        A sequence of runs.

    Raises:
        InputError: There is no run, the numbers of speeds or robots differ from that of the runs, a robot's
            magnetometer is not the twin's, or `simulate` would refuse a run.
    """
    from magtwin.sim.exact import check_field
    from magtwin.sim.runs.batch import BLOCK, Job, Runs
    from magtwin.sim.runs.sensing import Conditions
    from magtwin.sim.runs.simulate import check_asked

    twin = opened(twin, network, magnetometer, model_error, "sweep")
    if plant is not None and robots is not None:
        raise InputError("robots are used as they are; give robots or plant, not both", parameter="plant")
    twin = with_plant(twin, plant)
    check_field(twin.scene, twin.field)
    if not isinstance(controller, str):
        raise InputError(
            f"controller must be a name, got {type(controller).__name__}; a custom controller has the state "
            "of one run: give it to simulate"
        )
    first = checked_seed(seed)
    if isinstance(seeds, int | np.integer):
        if isinstance(seeds, bool) or seeds < 1:
            raise InputError(f"seeds must be at least one run, got {seeds}")
        check_count(int(seeds))
        seeds = range(first, first + int(seeds))
    numbers = [checked_seed(number) for number in seeds]
    count = len(numbers)
    ways = drive_inputs(MIXTURE if paths is None else paths, room_of(twin))
    if robots is not None and sessions is not None:
        raise InputError("robots are used as they are; give robots or sessions, not both")
    twins = _twins(twin, robots, sessions, numbers, first, model_error)
    if isinstance(speeds, str):
        if speeds != "drawn":
            raise InputError(f'speeds must be numbers or "drawn", got {speeds!r}')
        speeds = _drawn_speeds(twin, count, first)
    jobs: list[Job] = []
    known: dict[int, tuple[Twin, str]] = {}
    for k, (number, speed, own) in enumerate(
        zip(numbers, _each("speeds", speeds, count), twins, strict=True)
    ):
        path = ways[k % len(ways)] if isinstance(ways, list) else ways
        if id(own.scene) not in known:
            known[id(own.scene)] = own, scene_sha256(own.scene)
        check_commands(path, twin.magnetometer)
        jobs.append(Job(own.scene, path, number, speed))
    predictor = twin.magnetometer
    check_asked(duration_s, rate_hz)
    finish = _Finish(predictor, twin.field, tuple(known.values()), duration_s)
    conditions = Conditions(
        anomaly_map=twin.field,
        obstacles=twin.obstacles,
        network=predictor is not None,
        inputs=frozenset(predictor.columns if predictor else ()),
        duration_s=duration_s,
        rate_hz=rate_hz,
        controller=controller,
        lidar=lidar,
        outside=outside,
    )
    if block is None:  # fewer runs at a time if they are longer than 10 minutes
        block = max(1, min(BLOCK, int(BLOCK * 600 / (duration_s or 600))))
    return Runs(jobs, conditions, finish, columns=columns, block=block)


@dataclasses.dataclass(frozen=True, eq=False)
class _Finish:
    """Makes whole runs of sensed ones; an object, so that other processes can have it."""

    predictor: "NeuralMagnetometer | None"
    field: AnomalyMap

    twins: tuple[tuple[Twin, str], ...]
    """Twins of the runs, each with the checksum of its scene."""

    duration_s: float | None

    def __call__(self, jobs: Sequence["Job"], sensed: Sequence["Sensed"], *, check: bool = True) -> list[Run]:
        predictor, known = self.predictor, self._known
        flagged = "flag_out_of_distribution" in sensed[0].wanted
        rows = [each.run for each in sensed]
        trained = [trained_on(known[id(job.scene)][0]) for job in jobs]
        reads = predictor.read(rows, outside=flagged, known=trained) if predictor else [None] * len(rows)
        runs = []
        for job, each, read in zip(jobs, sensed, reads, strict=True):
            own, config = known[id(job.scene)]
            run = each.read(
                (read.disturbance_nt, read.sd_nt) if read else None, model_error_of(own, job.seed)
            )
            if check:
                self.check(run)
            options: Any = {"duration_s": self.duration_s, "config_sha256": config}
            run = stated(own, run, read, add=False)
            runs.append(finished(own, run, path_metadata(job.path), read, seed=job.seed, **options))
        return runs

    def check(self, run: Run) -> None:
        """Refuse a run that was driven off the map."""
        from magtwin.sim.exact import check_read

        check_read(run, self.field)

    def identity(self, job: "Job") -> str:
        """What tells a run of a job from others, but for what all runs of the sweep have in common."""
        own, config = self._known[id(job.scene)]
        return f"{config} {own.errors} {sorted(own.metadata.items())} {sorted(own.session.items())}"

    @functools.cached_property
    def _known(self) -> dict[int, tuple[Twin, str]]:
        return {id(own.scene): (own, config) for own, config in self.twins}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_known"}


def _twins(
    twin: Twin,
    robots: RobotSpec | Twin | Iterable[RobotSpec | Twin] | None,
    sessions: int | Literal["survey"] | None,
    seeds: Sequence[int],
    seed: int,
    model_error: bool,
) -> list[Twin]:
    """The twin of each run, in its session; arguments as for `sweep`."""
    count = len(seeds)
    if robots is not None:
        given = _each("robots", robots, count)
        own = {id(robot): _with_robot(twin, robot, model_error) for robot in given}
        return [own[id(robot)] for robot in given]
    if sessions is None:
        drawn = {number: in_session(twin, seed=number) for number in set(seeds)}
        return [drawn[number] for number in seeds]
    if sessions == "survey":
        return [in_session(twin, "survey")] * count
    if not isinstance(sessions, int | np.integer) or isinstance(sessions, bool) or sessions < 1:
        raise InputError(f'sessions must be a whole number from 1 up, or "survey", got {sessions!r}')
    most = min(int(sessions), count)
    if most < sessions:
        text = f"{sessions} sessions of {count} run{'s' if count > 1 else ''}: only {most} can be driven"
        warnings.warn(text, RepairWarning, stacklevel=3)
    numbered = [in_session(twin, k, seed=seed) for k in range(most)]
    return [numbered[k * most // count] for k in range(count)]


def _with_robot(twin: Twin, robot: RobotSpec | Twin, model_error: bool) -> Twin:
    """The twin with the robot of a run, whose magnetometer must be the twin's."""
    spec = robot.scene.robot if isinstance(robot, Twin) else robot
    ours, its = twin.scene.robot.magnetometer, spec.magnetometer
    if (its.kind, its.network) != (ours.kind, ours.network):
        raise InputError(
            f"robot {spec.name!r} has a {its.kind!r} magnetometer with the network {its.network}, the twin "
            f"has {ours.kind!r} with {ours.network}; open a twin for each"
        )
    if isinstance(robot, Twin):
        return robot if model_error else without_model_error(robot)
    return dataclasses.replace(twin, scene=dataclasses.replace(twin.scene, robot=robot))


def _drawn_speeds(twin: Twin, count: int, seed: int) -> list[float]:
    """A speed for each run [m/s]."""
    from magtwin.sim.session import draw_speed

    generator = np.random.default_rng((seed, 1)).spawn(2)[1]
    return [draw_speed(twin.scene.robot.drive, rng) for rng in generator.spawn(count)]


def _each(name: str, values: Any, count: int) -> Sequence[Any]:
    """A value for each run, from as many values or from one for all."""
    if isinstance(values, str | Run) or not isinstance(values, Iterable):
        return [values] * count
    values = list(values)
    if len(values) != count:
        raise InputError(f"{name} must be one value or one for each of {count} runs, got {len(values)}")
    return values
