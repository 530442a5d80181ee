"""sweep: thousands of robots, each as if it were alone, driven at once and read in blocks.

A robot's bits depend on nothing but its own scene, path and seed: the closed loop drives each as it would
alone, sensors draw from generators of its own, and a network gives a row the same whatever is beside it. So
runs can be made in any order, in blocks of any size, and any of them anew.
"""

import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.path import Path
from magtwin.run.run import COLUMNS, Metadata, Run
from magtwin.sim.motion.closed_loop import LOOPS, ClosedLoop, run_loops, warm_up
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.drive import Motion, Pose, draw_wheel_errors
from magtwin.sim.motion.engine import Kinematic, Travel
from magtwin.sim.motion.follow import check_arrived, loop_along, loop_by_commands
from magtwin.sim.runs.sensing import LidarMode, Outside, Sensing, streams
from magtwin.sim.runs.simulate import Sensed, check_run, sense_all, travel
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene
from magtwin.summary import Summarized, Summary, listed

BLOCK = 16
"""Runs made at a time: 130,000 readings of a minute each, 0.1 GB, and work for every thread."""


@dataclass(frozen=True, eq=False)
class Job:
    """A run that is wanted."""

    scene: Scene
    """Lab, robot and sensors."""

    path: Path | Commands | Run | str
    """Where to drive, as for `magtwin.sim.runs.simulate.simulate`."""

    seed: int
    """Seed of all noise."""

    speed: float
    """Forward speed where the path is straight [m/s]."""


Finish = Callable[[Sequence[Job], Sequence[Sensed]], list[Run]]
"""From jobs, and what was sensed in each, to whole runs: where a network predicts, all rows in one stream."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions:
    """What all runs have in common."""

    anomaly_map: AnomalyMap
    obstacles: Obstacles
    network: bool
    """Whether a network predicts the disturbance."""

    inputs: frozenset[str] = frozenset()
    """Columns that it reads."""

    duration_s: float | None = None
    rate_hz: float | None = None
    controller: str = "follower"
    lidar: LidarMode = "schedule"
    outside: Outside = "nan"


class Runs(Summarized, Sequence[Run]):
    """Runs that are made when they are asked for.

    `runs[i]` makes one, `for run in runs` all, block by block, so that memory stays bounded however many
    there are; `list(runs)` keeps them. Asked again, a run is made again, to the same bits. While one block
    goes through the network, the next is driven and sensed.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        conditions: Conditions,
        finish: Finish,
        *,
        columns: Iterable[str] | None = None,
        block: int = BLOCK,
    ) -> None:
        """Check every job; nothing is driven yet.

        Args:
            jobs: The runs, at least one.
            conditions: What they have in common.
            finish: What makes whole runs of what was sensed.
            columns: Those to keep, beside t; None keeps all.
            block: Runs made at a time.

        Raises:
            InputError: There is no job, a column or `block` is not as said, or `simulate` would refuse a
                job; the text then gives its number.
        """
        if not jobs:
            raise InputError("no runs are asked for; give a seed for each")
        if not isinstance(block, int) or block < 1:
            raise InputError(f"block must be a whole number from 1 up, got {block!r}")
        self._jobs, self._conditions, self._finish, self._block = jobs, conditions, finish, block
        self._columns = frozenset(COLUMNS if columns is None else {"t", *columns})
        for name in sorted(self._columns):
            find("column", name, COLUMNS)
        self._planned: dict[tuple[Path | Commands, float, DriveSpec, float, Pose], ClosedLoop] = {}
        self._courses: list[ClosedLoop | None] = []
        checked = set()
        steps = 0
        for i in range(len(jobs)):
            job = jobs[i]
            with self._numbered(i):
                key = (id(job.scene), id(job.path))
                if key not in checked:
                    self._rate(job)
                    checked.add(key)
                course = self._course(job)
                steps += course.least_steps if course else 0
                self._courses.append(course)
        if steps >= LOOPS.pays:
            with suppress(ImportError):  # plain Python gives the same bits
                warm_up()

    def __len__(self) -> int:
        return len(self._jobs)

    @overload
    def __getitem__(self, index: int) -> Run: ...

    @overload
    def __getitem__(self, index: slice) -> list[Run]: ...

    def __getitem__(self, index: int | slice) -> Run | list[Run]:
        numbers = range(len(self))[index]
        if isinstance(numbers, int):
            return self._finished([numbers], self._sensed([numbers]))[0]
        return list(self._made(numbers))

    def __iter__(self) -> Iterator[Run]:
        return self._made(range(len(self)))

    def save(self, out: str | os.PathLike[str], **options: Any) -> Any:
        """Write the runs to a folder as Parquet files; see `magtwin.io.sweeps.save_runs`."""
        return importlib.import_module("magtwin").save_runs(self, out, **options)

    def _made(self, numbers: Sequence[int]) -> Iterator[Run]:
        """Runs by number, in their order."""
        blocks = [numbers[k : k + self._block] for k in range(0, len(numbers), self._block)]
        if not blocks:
            return
        with ThreadPoolExecutor(1) as pool:
            ahead = pool.submit(self._sensed, blocks[0])
            for block, after in zip(blocks, [*blocks[1:], None], strict=True):
                sensed = ahead.result()
                if after is not None:
                    ahead = pool.submit(self._sensed, after)
                yield from self._finished(block, sensed)

    def _sensed(self, numbers: Sequence[int]) -> list[Sensed]:
        """Drive and sense some runs."""
        draws = {i: streams(np.random.default_rng(self._jobs[i].seed)) for i in numbers}
        courses: dict[int, ClosedLoop] = {}
        for i in numbers:
            if (course := self._courses[i]) is not None:
                drive = self._jobs[i].scene.robot.drive
                errors = draw_wheel_errors(drive, draws[i]["drive"])
                courses[i] = replace(course, drive=drive, wheel_errors=errors)
        together = dict(
            zip(courses, run_loops(list(courses.values()), self._conditions.obstacles), strict=True)
        )
        done = []
        for i in numbers:
            with self._numbered(i):
                if i in together:
                    motion, metadata = self._travelled(self._jobs[i], courses[i], together.pop(i))
                else:
                    motion, metadata = self._travel(self._jobs[i], draws[i])
                done.append(self._sense(self._jobs[i], draws[i], motion, metadata))
        return done

    def _travelled(self, job: Job, course: ClosedLoop, motion: Motion) -> tuple[Travel, Metadata]:
        """What a robot did that was driven among others."""
        common = self._conditions
        if isinstance(job.path, Commands):
            return motion, {"path": job.path.name, "controller": "commands"}
        assert isinstance(job.path, Path)
        if common.duration_s is None:
            check_arrived(job.path, job.speed, course, motion)
        name, speed = job.path.name, float(job.speed)
        return motion, {"path": name, "controller": common.controller, "speed_m_s": speed}

    def _travel(self, job: Job, draws: dict[str, np.random.Generator]) -> tuple[Travel, Metadata]:
        """What a robot does that somebody drives, or did when it was recorded."""
        common = self._conditions
        return travel(
            job.scene,
            job.path,
            draws,
            job.speed,
            common.duration_s,
            common.obstacles,
            common.controller,
            Kinematic(),
        )

    def _sense(
        self, job: Job, draws: dict[str, np.random.Generator], motion: Travel, metadata: Metadata
    ) -> Sensed:
        common = self._conditions
        rate = job.scene.robot.magnetometer.rate_hz if common.rate_hz is None else common.rate_hz
        sensing = Sensing(
            job.scene,
            draws,
            anomaly_map=common.anomaly_map,
            rate_hz=rate,
            outside=common.outside,
            lidar=common.lidar,
            network=common.network,
            wanted=self._columns,
            inputs=common.inputs,
        )
        how = {**metadata, "outside": common.outside, "lidar": common.lidar}
        return sense_all(sensing, motion, common.duration_s, how)

    def _finished(self, numbers: Sequence[int], sensed: list[Sensed]) -> list[Run]:
        """Whole runs of what was sensed."""
        return self._finish([self._jobs[i] for i in numbers], sensed)

    def _rate(self, job: Job) -> float:
        common = self._conditions
        return check_run(
            job.scene,
            job.path,
            anomaly_map=common.anomaly_map,
            rate_hz=common.rate_hz,
            duration_s=common.duration_s,
            lidar=common.lidar,
            network=common.network,
        )

    def _course(self, job: Job) -> ClosedLoop | None:
        """The course of a job, without its wheels' errors: planned once for all who drive alike.

        None where it is not known beforehand: where somebody drives, or a run is driven once more.
        """
        if isinstance(job.path, Run):
            return None
        common, radius = self._conditions, job.scene.robot.footprint_radius_m
        alike = replace(
            job.scene.robot.drive,
            wheel_errors=(0.0, 0.0),
            wheel_radius_error_std=0.0,
            wheel_separation_error_std=0.0,
            odometry_scale=(1.0, 1.0),
            odometry_noise_std=0.0,
        )
        if isinstance(job.path, str):
            still = loop_by_commands(
                [[0.0, 0.0, 0.0]], alike, start=job.scene.start, footprint_radius_m=radius
            )
            still.check(common.obstacles)
            return None
        key = (job.path, job.speed, alike, radius, job.scene.start)
        if key in self._planned:
            return self._planned[key]
        if isinstance(job.path, Path):
            course = loop_along(
                job.path,
                alike,
                speed=job.speed,
                duration_s=common.duration_s,
                controller=common.controller,
                obstacles=common.obstacles,
                footprint_radius_m=radius,
            )
        else:
            course = loop_by_commands(
                job.path.rows,
                alike,
                start=job.scene.start,
                duration_s=common.duration_s,
                footprint_radius_m=radius,
            )
            course.check(common.obstacles)
        self._planned[key] = course
        return course

    @contextmanager
    def _numbered(self, index: int) -> Iterator[None]:
        """Refusals say of which run they are."""
        try:
            yield
        except InputError as error:
            raise InputError(f"run {index} of {len(self)}, counted from 0: {error}") from error

    def _summary(self) -> Summary:
        """How many runs, along what, with which seeds."""
        names = dict.fromkeys(
            getattr(job.path, "name", job.path) if not isinstance(job.path, Run) else "a run once more"
            for job in self._jobs
        )
        seeds = [job.seed for job in self._jobs]
        return Summary(
            f"Runs: {len(self):,}, made when they are asked for",
            (
                ("paths", listed([str(name) for name in names])),
                ("seeds", listed([str(seed) for seed in seeds])),
                ("columns", listed([name for name in COLUMNS if name in self._columns])),
            ),
        )
