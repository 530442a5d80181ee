"""Runs: many runs, driven at once and read in blocks when they are asked for.

The bytes of a run depend only on its own scene, path and seed: the closed loop drives each robot as if it
were alone, sensors draw from their own generators, and a network treats each row by itself. So runs can be
made in any order and in blocks of any size, and any run can be made again.
"""

import hashlib
import importlib
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol, overload

import numpy as np

from magtwin.errors import InputError, find
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.motion.closed_loop import LOOPS, warm_up
from magtwin.sim.motion.drive_input import DriveInput, path_metadata
from magtwin.sim.motion.engine import Travel
from magtwin.sim.runs.driving import Course, Metadata, Trip, course_of, drive, labelled
from magtwin.sim.runs.sensing import Conditions, Sensing, streams
from magtwin.sim.runs.simulate import Sensed, check_run, read_all, readings, sense_all
from magtwin.spec.drive import DRAWN
from magtwin.spec.scene import Scene

BLOCK = 16
"""Runs made at a time: 130,000 readings of a minute each, 0.1 GB, and work for every thread."""


UNPLANNED: Any = {"wheel_errors": (0.0, 0.0), "odometry_scale": (1.0, 1.0), **dict.fromkeys(DRAWN, 0.0)}
"""Figures of a drive on which no plan depends."""

PLANNED = 1 << 27
"""Bytes of plans that are kept, beside the last: 1,000 of a minute each, or none of a day."""


@dataclass(frozen=True, eq=False)
class Job:
    """A run to be made."""

    scene: Scene
    """Lab, robot and sensors."""

    path: DriveInput
    """What to drive, as for `magtwin.sim.runs.simulate.simulate`."""

    seed: int
    """Seed of all noise."""

    speed: float
    """Forward speed on straight parts of the path [m/s]."""

    conditions: Conditions
    """Map, obstacles and options."""

    place: int | None = None
    """Number of its scene among several, from 0. None if all runs have one."""


class Finish(Protocol):
    """From jobs and their sensed runs to whole runs: where a network predicts, for all rows at once."""

    def __call__(self, jobs: Sequence[Job], sensed: Sequence[Sensed], *, check: bool = True) -> list[Run]:
        """Whole runs; `check` is False for blocks of a run."""

    def check(self, job: Job, run: Run) -> None:
        """Refuse a run that is not to be kept."""


@dataclass(frozen=True, eq=False)
class _Driven:
    """A long run that has been driven, and is sensed block by block."""

    sensing: Sensing
    motion: Travel
    metadata: Metadata


class Runs(Summarized, Sequence[Run]):
    """Runs that are made when they are asked for.

    `runs[i]` makes one run. `for run in runs` makes all, block by block, so that memory stays bounded.
    `list(runs)` keeps them. A run that is asked for again is made again, with the same bytes. While one block
    goes through the network, the next is driven and sensed, unless a run in it is long.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        finish: Finish,
        *,
        columns: Iterable[str] | None = None,
        block: int = BLOCK,
    ) -> None:
        """Check every job; nothing is driven yet."""
        if not jobs:
            raise InputError("no runs are asked for; give a seed for each")
        if not isinstance(block, int) or block < 1:
            raise InputError(f"block must be a whole number from 1 up, got {block!r}")
        self._jobs, self._finish, self._block = jobs, finish, block
        self._columns = frozenset(COLUMNS if columns is None else {"t", *columns})
        for name in sorted(self._columns):
            find("column", name, COLUMNS)
        self._planned: dict[Any, Course] = {}
        self._kept, self._steps = 0, 0  # bytes of plans, and expected steps
        checked = set()
        for i, job in enumerate(jobs):
            with labelled(self._label(i)):
                key = (id(job.scene), id(job.path))
                if key not in checked:
                    check_run(job.scene, job.path, job.conditions)
                    checked.add(key)
                if planned := self._course(job).loop:
                    self._steps += planned.least_steps
        self._open_loops()

    def _open_loops(self) -> None:
        """Open compiled loops if that pays."""
        if self._steps >= LOOPS.pays:
            with suppress(ImportError):  # plain Python gives the same bytes
                warm_up()

    def scene_of(self, index: int) -> int | None:
        """Number of a run's scene among those of the sweep, from 0. None if there is one."""
        return self._jobs[index].place

    def __len__(self) -> int:
        return len(self._jobs)

    @overload
    def __getitem__(self, index: int) -> Run: ...

    @overload
    def __getitem__(self, index: slice) -> list[Run]: ...

    def __getitem__(self, index: int | slice) -> Run | list[Run]:
        numbers = range(len(self))[index]
        if isinstance(numbers, int):
            return next(self._finished([self._jobs[numbers]], self._sensed([numbers])))
        return list(self.made(numbers))

    def __iter__(self) -> Iterator[Run]:
        return self.made(range(len(self)))

    @property
    def identity(self) -> str | None:
        """SHA-256 of what is driven, where and how, the same in every process; None if that is unknown.

        Processes that share a folder check with it that they make the same runs.
        """
        told = getattr(self._finish, "identity", None)
        if told is None:
            return None
        common, total = self._jobs[0].conditions, hashlib.sha256()
        options = (common.duration_s, common.rate_hz, common.controller, common.lidar, common.outside)
        total.update(repr((options, sorted(self._columns))).encode())
        paths = {id(job.path): _content(job.path) for job in self._jobs}
        for job in self._jobs:
            total.update(repr((told(job), job.seed, float(job.speed), paths[id(job.path)])).encode())
        return total.hexdigest()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open_loops()

    def save(self, out: str | os.PathLike[str], **options: Any) -> Any:
        """Write the runs to a folder as Parquet files; see `magtwin.io.sweeps.save_runs`."""
        return importlib.import_module("magtwin").save_runs(self, out, **options)

    def made(self, numbers: Sequence[int]) -> Iterator[Run]:
        """Runs by number, in their order; only those of a block are held at a time."""
        blocks = [numbers[k : k + self._block] for k in range(0, len(numbers), self._block)]
        if not blocks:
            return
        with ThreadPoolExecutor(1) as pool:
            ahead = pool.submit(self._sensed, blocks[0])
            for block, after in zip(blocks, [*blocks[1:], None], strict=True):
                sensed = ahead.result()
                long = any(isinstance(one, _Driven) for one in sensed)  # two at a time would take much memory
                if after is not None and not long:
                    ahead = pool.submit(self._sensed, after)
                yield from self._finished([self._jobs[i] for i in block], sensed)
                if after is not None and long:
                    ahead = pool.submit(self._sensed, after)

    def _finished(self, jobs: Sequence[Job], sensed: list[Any]) -> Iterator[Run]:
        """Whole runs: all at once, or one by one if any of them is long."""
        if all(isinstance(one, Sensed) for one in sensed):
            yield from self._finish(jobs, sensed)
            return
        for job in jobs:
            yield self._read(job, sensed.pop(0))

    def _read(self, job: Job, sensed: "Sensed | _Driven") -> Run:
        """A run, which is sensed block by block if it is long."""
        if isinstance(sensed, Sensed):
            return self._finish([job], [sensed])[0]

        def read(block: Sensed) -> Run:
            return self._finish([job], [block], check=False)[0]

        run = read_all(sensed.sensing, sensed.motion, sensed.metadata, read)
        self._finish.check(job, run)
        return run

    def _sensed(self, numbers: Sequence[int]) -> list[Any]:
        """Drive some runs, and sense those that are not long."""
        jobs = [self._jobs[i] for i in numbers]
        trips = [
            Trip(job.scene, self._course(job), streams(np.random.default_rng(job.seed)), self._label(i))
            for i, job in zip(numbers, jobs, strict=True)
        ]
        together: dict[int, list[int]] = {}  # those in the same room are driven at once
        for n, job in enumerate(jobs):
            together.setdefault(id(job.conditions), []).append(n)
        motions: dict[int, Travel] = {}
        for those in together.values():
            motions |= zip(those, drive([trips[n] for n in those], jobs[those[0]].conditions), strict=True)
        sensed: list[Sensed | _Driven] = []
        for n, (job, trip) in enumerate(zip(jobs, trips, strict=True)):
            with labelled(trip.label):
                motion, metadata = motions.pop(n), trip.course.metadata
                sensing = Sensing(trip.scene, trip.draws, job.conditions, wanted=self._columns)
                count, _ = readings(sensing, motion, metadata)
                long = sensing.rows_at_once(count) < count
                make = _Driven if long else sense_all
                sensed.append(make(sensing, motion, metadata))
        return sensed

    def _course(self, job: Job) -> Course:
        """What a job drives, planned once for jobs that share it, and again beyond `PLANNED` bytes."""
        if isinstance(job.path, Run):
            return course_of(job.scene, job.path, job.speed, job.conditions)
        robot = job.scene.robot
        alike = replace(robot.drive, **UNPLANNED), robot.footprint_radius_m
        key = (job.path, job.speed, alike, job.scene.start, job.conditions)
        if key in self._planned:
            return self._planned[key]
        if self._kept > PLANNED:
            self._planned.clear()
            self._kept = 0
        course = course_of(job.scene, job.path, job.speed, job.conditions)
        self._kept += course.loop.guide.table.nbytes if course.loop else 0
        self._planned[key] = course
        return course

    def _label(self, index: int) -> str:
        """The number of a run, for refusals."""
        return f"run {index} of {len(self)}, counted from 0"

    def _summary(self) -> Summary:
        paths = ["a recorded run" if isinstance(job.path, Run) else job.path for job in self._jobs]
        rows = {
            "paths": list(dict.fromkeys(str(getattr(path, "name", path)) for path in paths)),
            "seeds": [str(job.seed) for job in self._jobs],
            "columns": [name for name in COLUMNS if name in self._columns],
        }
        title = f"Runs: {len(self):,}, made when they are asked for"
        return Summary(title, tuple((label, listed(names)) for label, names in rows.items()))


def _content(path: DriveInput) -> str:
    """What is driven, as a text: a name, or a name with a checksum of the points, commands or columns."""
    sums = [value for name, value in path_metadata(path).items() if name.endswith("_sha256")]
    return " ".join([path if isinstance(path, str) else getattr(path, "name", "run"), *map(str, sums)])
