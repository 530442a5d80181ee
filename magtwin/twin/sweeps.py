"""Sweep: many runs of one scene, driven at once and made when asked for."""

import dataclasses
import functools
import importlib
import logging
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, MismatchWarning, RepairWarning
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.motion.drive_input import DriveInput, drive_input, each_input, path_metadata
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.twin.session import in_session, model_error_of, room_of, trained_on, with_plant
from magtwin.twin.simulation import check_commands, finished, stated
from magtwin.twin.twin import (
    Kind,
    Network,
    Place,
    Twin,
    checked_seed,
    opened,
    scene_in,
    scene_sha256,
    without_model_error,
)

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import Read
    from magtwin.sim.motion.commands import Commands
    from magtwin.sim.runs.batch import Job, Runs
    from magtwin.sim.runs.sensing import Conditions
    from magtwin.sim.runs.simulate import Sensed

MIXTURE = ("sine", "lawnmower", "figure8", "continuous_cycle", "random")
"""Paths that a sweep drives by default. A model trained on one kind of path fails on the others."""


MOST_RUNS = 1_000_000
"""Largest number of runs of one sweep; their seeds and jobs are held in memory."""


def check_count(count: int) -> None:
    """Refuse more runs than one sweep makes."""
    if count > MOST_RUNS:
        text = f"{count:,} runs are too many for one sweep (at most {MOST_RUNS:,})"
        raise InputError(f"{text}; make several, each with another `seed`", parameter="count")


def sweep(
    twin: Twin | Place | Iterable[Twin | Place],
    paths: "Path | Commands | Run | str | FilePath | ArrayLike | Iterable[Any] | None" = None,
    seeds: int | Iterable[int] | None = None,
    *,
    seed: int = 0,
    sessions: int | Literal["survey"] | None = None,
    plant: PlantSpec | str | None = None,
    fit: bool = False,
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
    """Simulate many runs, each with the robot alone in its scene: of one scene, or of several.

    `sweep(twin, paths, seeds)[i]` equals `simulate(twin, paths[i], seed=seeds[i])` to the bit, whatever the
    number of runs, their order and the block. Everything is checked at once; runs are made when asked for:
    iterate over the result to bound memory, or `save` it to a folder.

    Args:
        twin: An opened twin, or a scene as for `open_twin`; or several of them, taken in turn, such as
            variants that `Scene.with_` gives. A `Scene` among several is opened without writing its stage. Of
            n scenes, run k has number k modulo n, which `runs.csv` lists, and the seed `seed` + k: scenes do
            not share seeds unless `seeds` says so, such as `[7] * n`.
        paths: What to drive, as for `simulate`: one for all runs, or several, taken in turn. Default:
            `magtwin.twin.MIXTURE`.
        seeds: A seed for each run; or the number of runs, whose seeds then are `seed`, `seed` + 1, ...
            Default: 100 runs of one scene, or one run of each of several.
        seed: First seed if `seeds` is a number. It also draws sessions and speeds.
        sessions: Number of sessions, drawn from `seed`; each takes an equal share of the runs, one after the
            other. "survey" is the robot as it was when the map was surveyed. Default: each run has its own
            session, drawn from its seed.
        plant: As for `simulate`; all runs have the same constants.
        fit: As for `simulate`, of each path.
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
    from magtwin.sim.runs.simulate import check_asked

    if plant is not None and robots is not None:
        raise InputError("robots are used as they are; give robots or plant, not both", parameter="plant")
    bases = _bases(twin, network, magnetometer, model_error)
    bases = [with_plant(base, plant) for base in bases]
    for base in bases:
        check_field(base.scene, base.field)
    if not isinstance(controller, str):
        raise InputError(
            f"controller must be a name, got {type(controller).__name__}; a custom controller has the state "
            "of one run: give it to simulate"
        )
    first = checked_seed(seed)
    if seeds is None:
        seeds = 100 if len(bases) == 1 else len(bases)
    if isinstance(seeds, int | np.integer):
        if isinstance(seeds, bool) or seeds < 1:
            raise InputError(f"seeds must be at least one run, got {seeds}")
        check_count(int(seeds))
        seeds = range(first, first + int(seeds))
    numbers = [checked_seed(number) for number in seeds]
    count = len(numbers)
    ways = _Ways(each_input(MIXTURE if paths is None else paths), fit)
    if robots is not None and sessions is not None:
        raise InputError("robots are used as they are; give robots or sessions, not both")
    turns = [bases[k % len(bases)] for k in range(count)]
    twins = _twins(turns, robots, sessions, numbers, first, model_error)
    if isinstance(speeds, str):
        if speeds != "drawn":
            raise InputError(f'speeds must be numbers or "drawn", got {speeds!r}')
        speeds = _drawn_speeds(turns, first)
    check_asked(duration_s, rate_hz)
    common: Any = {"duration_s": duration_s, "rate_hz": rate_hz, "controller": controller}
    common |= {"lidar": lidar, "outside": outside}
    rooms = {id(base): _conditions(base, common) for base in bases}
    jobs: list[Job] = []
    known: dict[int, tuple[Twin, str]] = {}
    each_speed = _each("speeds", speeds, count)
    for k, (number, speed, base, own) in enumerate(zip(numbers, each_speed, turns, twins, strict=True)):
        path = ways.of(k, base)
        if id(own.scene) not in known:
            known[id(own.scene)] = own, scene_sha256(own.scene)
        check_commands(path, base.magnetometer)
        place = k % len(bases) if len(bases) > 1 else None
        jobs.append(Job(own.scene, path, number, speed, rooms[id(base)], place))
    finish = _Finish(tuple(known.values()), duration_s)
    if block is None:  # fewer runs at a time if they are longer than 10 minutes
        block = max(1, min(BLOCK, int(BLOCK * 600 / (duration_s or 600))))
    return Runs(jobs, finish, columns=columns, block=block)


def _bases(twins: Any, network: Network, magnetometer: Kind | None, model_error: bool) -> list[Twin]:
    """The opened twins of a sweep's first argument. What is told of many scenes is told once."""
    single = isinstance(twins, str | FilePath | Twin | Scene) or hasattr(twins, "GetRootLayer")
    if single or not hasattr(twins, "__iter__"):
        return [opened(twins, network, magnetometer, model_error, "sweep")]
    made, known, told = list[Twin](), dict[object, Any](), list[str]()
    scenes = list(twins)
    for number, each in enumerate(scenes):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                scene = each if isinstance(each, Twin) else scene_in(each)
                if isinstance(scene, Scene):
                    options: Any = {"network": network, "magnetometer": magnetometer}
                    open_unwritten = importlib.import_module("magtwin.twin.opening").open_unwritten
                    made.append(open_unwritten(scene, known, model_error=model_error, **options))
                else:
                    made.append(opened(scene, network, magnetometer, model_error, "sweep"))
            except InputError as error:
                text = f"scene {number}, counted from 0: {error}"
                raise InputError(text, parameter=error.parameter) from error
        logging.getLogger("magtwin").info("opened scene %d of %d", number + 1, len(scenes))
        told += [f"scene {number}, counted from 0: {warning.message}" for warning in caught]
    if not made:
        raise InputError("sweep got no scene", parameter="twin")
    if told:
        more = f" (and {len(told) - 1} more warnings of these scenes; each run has its own in its metadata)"
        warnings.warn(told[0] + more * (len(told) > 1), MismatchWarning, stacklevel=4)
    return made


def _conditions(base: Twin, common: Mapping[str, Any]) -> "Conditions":
    """What the runs of a twin have in common."""
    from magtwin.sim.runs.sensing import Conditions

    predictor = base.magnetometer
    return Conditions(
        anomaly_map=base.field,
        obstacles=base.obstacles,
        network=predictor is not None,
        inputs=frozenset(predictor.columns if predictor else ()),
        **common,
    )


class _Ways:
    """What runs drive, each path placed in the room of its twin once."""

    def __init__(self, paths: list[Any], fit: bool) -> None:
        self._paths, self._fit, self._known = paths, fit, dict[Any, DriveInput]()

    def of(self, number: int, base: Twin) -> DriveInput:
        """What a run drives in the room of its twin."""
        path = self._paths[number % len(self._paths)]
        key = id(base), path if isinstance(path, str | FilePath) else id(path)
        if key not in self._known:
            self._known[key] = drive_input(path, room_of(base), fit=self._fit)
        return self._known[key]


@dataclasses.dataclass(frozen=True, eq=False)
class _Finish:
    """Makes whole runs of sensed ones; an object, so that other processes can have it."""

    twins: tuple[tuple[Twin, str], ...]
    """Twins of the runs, each with the checksum of its scene."""

    duration_s: float | None

    def __call__(self, jobs: Sequence["Job"], sensed: Sequence["Sensed"], *, check: bool = True) -> list[Run]:
        known = self._known
        flagged = "flag_out_of_distribution" in sensed[0].wanted
        rows = [each.run for each in sensed]
        twins = [known[id(job.scene)][0] for job in jobs]
        reads: list[Read | None] = [None] * len(rows)
        predictors = {id(own.magnetometer): own.magnetometer for own in twins if own.magnetometer}
        for predictor in predictors.values():
            those = [n for n, own in enumerate(twins) if own.magnetometer is predictor]
            options: Any = {"outside": flagged, "known": [trained_on(twins[n]) for n in those]}
            for n, made in zip(those, predictor.read([rows[n] for n in those], **options), strict=True):
                reads[n] = made
        runs = []
        for job, each, read in zip(jobs, sensed, reads, strict=True):
            own, config = known[id(job.scene)]
            predicted = (read.disturbance_nt, read.sd_nt) if read else None
            run = each.read(predicted, model_error_of(own, job.seed))
            if check:
                self.check(job, run)
            options = {"duration_s": self.duration_s, "config_sha256": config}
            run = stated(own, run, read, add=False)
            runs.append(finished(own, run, path_metadata(job.path), read, seed=job.seed, **options))
        return runs

    def check(self, job: "Job", run: Run) -> None:
        """Refuse a run that was driven off the map."""
        from magtwin.sim.exact import check_read

        check_read(run, self._known[id(job.scene)][0].field)

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
    bases: Sequence[Twin],
    robots: RobotSpec | Twin | Iterable[RobotSpec | Twin] | None,
    sessions: int | Literal["survey"] | None,
    seeds: Sequence[int],
    seed: int,
    model_error: bool,
) -> list[Twin]:
    """The twin of each run, in its session, from the opened twin of each; arguments as for `sweep`."""
    count, made = len(seeds), dict[Any, Twin]()

    def once(key: Any, make: Callable[[], Twin]) -> Twin:
        if key not in made:
            made[key] = make()
        return made[key]

    if robots is not None:
        given = _each("robots", robots, count)
        both = zip(bases, given, strict=True)
        return [once((id(b), id(r)), partial(_with_robot, b, r, model_error)) for b, r in both]
    if sessions is None:
        pairs = zip(bases, seeds, strict=True)
        return [once((id(base), k), partial(in_session, base, seed=k)) for base, k in pairs]
    if sessions == "survey":
        return [once(id(base), partial(in_session, base, "survey")) for base in bases]
    if not isinstance(sessions, int | np.integer) or isinstance(sessions, bool) or sessions < 1:
        raise InputError(f'sessions must be a whole number from 1 up, or "survey", got {sessions!r}')
    most = min(int(sessions), count)
    if most < sessions:
        text = f"{sessions} sessions of {count} run{'s' if count > 1 else ''}: only {most} can be driven"
        warnings.warn(text, RepairWarning, stacklevel=3)
    numbers = [k * most // count for k in range(count)]
    pairs = zip(bases, numbers, strict=True)
    return [once((id(base), k), partial(in_session, base, k, seed=seed)) for base, k in pairs]


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


def _drawn_speeds(twins: Sequence[Twin], seed: int) -> list[float]:
    """A speed for each run [m/s]."""
    from magtwin.sim.session import draw_speed

    generator = np.random.default_rng((seed, 1)).spawn(2)[1]
    each = zip(twins, generator.spawn(len(twins)), strict=True)
    return [draw_speed(twin.scene.robot.drive, rng) for twin, rng in each]


def _each(name: str, values: Any, count: int) -> Sequence[Any]:
    """A value for each run, from as many values or from one for all."""
    if isinstance(values, str | Run) or not isinstance(values, Iterable):
        return [values] * count
    values = list(values)
    if len(values) != count:
        raise InputError(f"{name} must be one value or one for each of {count} runs, got {len(values)}")
    return values
