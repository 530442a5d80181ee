"""Runner: the chunks of a suite on processes, shards and clusters, into a folder of results."""

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.bench import results, sealed, store
from magtwin.bench.receipt import (
    differences,
    folder_sha256,
    read_receipt,
    rows_sha256,
    sample,
    write_receipt,
)
from magtwin.bench.results import Results
from magtwin.bench.row import SETUP, Row, run_chunk
from magtwin.bench.suite import SIMULATED, Chunk, Seeds, Suite, load_suite, suite_file
from magtwin.errors import InputError
from magtwin.files.file import sha256, shipped
from magtwin.files.outputs import output
from magtwin.localization.compensators import is_weights
from magtwin.parallel import Failure, Pool, beat, checked_shard, open_pool
from magtwin.report.report import Figure, Report
from magtwin.version import __version__

GRACE_S = 60.0
"""Time beyond twice the suite's limit after which a worker is killed that has reported nothing: a localizer
whose compiled code hangs does not notice the suite's limit [s]."""

Progress = Callable[[int, int, str], Any]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Task:
    """A chunk, and what is known to fail in it."""

    chunk: Chunk
    failures: Mapping[tuple[int, str], str] = field(default_factory=dict)
    """Reasons by run and localizer."""

    done: frozenset[tuple[int, str]] = frozenset()
    """Runs and localizers that are left out."""

    @property
    def size(self) -> int:
        """Number of its runs, each localizer's counted."""
        return self.chunk.runs * len(self.chunk.entries) - len(self.done)


class Plan(Sequence[Task]):
    """What is left to do of a suite: the chunks that lack runs, which are made when they are asked for.

    Args:
        suite: The suite.
        done: Flags of the runs that are done, by scenario and localizer.
        shard: As for `benchmark`.
    """

    def __init__(
        self, suite: Suite, done: Mapping[tuple[str, str], Flags], shard: tuple[int, int] | None = None
    ) -> None:
        self._suite, self.size = suite, 0
        self._done: list[list[Flags]] = []
        parts, before = [], 0
        for number, scenario in enumerate(suite.scenario):
            none = np.zeros(scenario.runs, bool)
            flags = [done.get((scenario.name, name), none) for name in suite.entries_of(scenario)]
            self._done.append(flags)
            if not flags:
                continue
            lacking = np.sum([~each for each in flags], axis=0, dtype=np.int64)
            counts = np.add.reduceat(lacking, np.arange(0, scenario.runs, suite.chunk))
            wanted = counts > 0
            if shard is not None:
                wanted &= (before + np.arange(len(counts))) % shard[1] == shard[0]
            self.size += int(counts[wanted].sum())
            chosen = np.flatnonzero(wanted)
            parts.append(np.column_stack([np.full(len(chosen), number), chosen]))
            before += len(counts)
        self._parts = np.concatenate(parts) if parts else np.empty((0, 2), int)

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, index: Any) -> Any:
        number, part = self._parts[index].tolist()
        chunk = self._suite.chunk_of(self._suite.scenario[number], part)
        runs = slice(chunk.first, chunk.first + chunk.runs)
        flags = zip(chunk.entries, self._done[number], strict=True)
        done = {(chunk.first + k, name) for name, each in flags for k in np.flatnonzero(each[runs]).tolist()}
        return Task(chunk, done=frozenset(done))


def benchmark(
    suite: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenarios: Sequence[str] = (),
    localizers: Sequence[str] = (),
    runs: int | None = None,
    seeds: Seeds = "public",
    salt: str = "",
    data: Mapping[str, str] | None = None,
    jobs: int | None = None,
    shard: tuple[int, int] | None = None,
    dask: str | None = None,
    tracks: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> Results:
    """Run the localizers of a suite on its scenarios.

    Runs that are in `out` already are not run again, so that a repeat continues an interrupted benchmark, and
    shards can share a folder. The rows depend on neither jobs nor shards nor the machine. A localizer that
    raises, exceeds the suite's time limit or ends its process has rows of status "failed" with the reason.

    Args:
        suite: File of the suite, or the name of one that ships with magtwin.
        out: Folder of results.
        scenarios: Scenarios to run. Default: all.
        localizers: Localizers to run, of the suite or any other. Default: all of the suite.
        runs: Most runs of each scenario.
        seeds: "public", or "held-out" for the final measurement.
        salt: Salt of the held-out places and seeds, in hexadecimal digits, if the suite has one.
        data: Folders of data by name.
        jobs: Processes. Default: one for each processor.
        shard: (i, n) runs every n-th chunk, from the i-th, counted from 0. Default: all.
        dask: Address of a dask scheduler whose workers run the chunks.
        tracks: Whether to keep errors over time for the report.
        force: Whether to replace results that exist.
        progress: Called with the runs done, all runs, and the scenario of the last.

    Returns:
        The results in `out`, with those of other shards that are there.

    Raises:
        InputError: The suite or an option is wrong, data are missing, `out` holds other results, or there is
            too little memory for `jobs`.
    """
    _check_runs(runs)
    file, out = suite_file(suite), Path(out)
    whole = load_suite(file)
    chosen = whole.limited(
        scenarios=scenarios, localizers=localizers, runs=runs, seeds=seeds, data=data, salt=salt
    )
    try:
        chosen.check(file, sealed.check_localizer)
    finally:
        sealed.close()
    if shard is not None:
        checked_shard(shard)
        if force:
            text = "other shards may have written there; remove the folder yourself, and drop `force`"
            raise InputError(text, parameter="force")
    whole = whole.limited(seeds=seeds, salt=salt)
    with open_pool(jobs, dask=dask) as pool:
        if force and (out / results.ABOUT).is_file():
            shutil.rmtree(out)
        results.begin_results(out, file.read_bytes(), about(whole, chosen))
        order = store.Order(whole)
        store.merge(out, order)
        plan = Plan(chosen, store.done_runs(out, chosen), shard)
        if plan:
            with store.Journal(out, order) as journal:
                _run(pool, chosen, plan, out, journal, tracks, progress or (lambda done, total, what: None))
    with store.alone(out):
        made = replace(results.results_in(out), new=plan.size)
        write_receipt(out, made.about, chosen, made.rows)
    return made


def verify(
    receipt: str | os.PathLike[str],
    *,
    suite: str | os.PathLike[str] | None = None,
    runs: int = 12,
    salt: str = "",
    data: Mapping[str, str] | None = None,
    jobs: int | None = None,
) -> Report:
    """Make a sample of the runs of results again, and compare all values of their rows.

    Args:
        receipt: Receipt in a folder of results, or the folder.
        suite: The suite. Default: the copy in that folder; one with files of its own needs its own folder.
        runs: Number of runs in the sample, each by all of its localizers.
        salt: As for `benchmark`.
        data: As for `benchmark`.
        jobs: As for `benchmark`.

    Raises:
        InputError: It is no receipt or of another version, the rows or the suite are not those of the
            receipt, or a localizer is missing here.
    """
    _check_runs(runs)
    told = read_receipt(receipt)
    folder = Path(receipt) if Path(receipt).is_dir() else Path(receipt).parent
    there = results.read_results(folder)
    if rows_sha256(there.rows) != told["rows"]["sha256"]:
        raise InputError(f"{folder}: the rows are not those of the receipt; they were changed or added to")
    names = list(dict.fromkeys(there.rows["localizer"].tolist()))
    file = folder / results.SUITE if suite is None else suite_file(suite)
    whole = load_suite(file).limited(seeds=there.about["seeds"], salt=salt, data=data)
    if whole.sha256 != told["suite"]["sha256"]:
        raise InputError(f"{file}: not the suite of the receipt; give that by `suite`", parameter="suite")
    chosen = whole.limited(localizers=names, seeds=whole.seeds, salt=salt)
    try:
        chosen.check(file, sealed.check_localizer)
    finally:
        sealed.close()
    drawn = sample(there.rows, runs, told["rows"]["sha256"])
    tasks = [
        Task(Chunk(scenario=scenario, part=0, first=run, runs=1, entries=entries))
        for scenario, run, entries in drawn
    ]
    with open_pool(jobs) as pool:
        work = partial(run_task, chosen, _fields(chosen, folder))
        limit_s = 2 * chosen.time_limit_s + GRACE_S
        made = [outcome.result() for outcome in pool.run(work, tasks, limit_s=limit_s)]
    wrong = [said for each in made for said in differences(there.rows, each)]
    count = sum(len(entries) for *_, entries in drawn)
    kinds = told["localizers"]
    return Report(
        f"{folder}: {'the sample is as it was' if not wrong else 'NOT the same rows'}",
        (
            Figure("rows", told["rows"]["count"]),
            Figure("made again", count),
            Figure("different", len(wrong)),
            Figure("not sealed", sum(kind == "not sealed" for kind in kinds.values())),
        ),
        {"differences": dict(enumerate(wrong))} if wrong else {},
    )


def _check_runs(runs: int | None) -> None:
    if runs is not None and runs < 1:
        raise InputError(f"`runs` must be at least 1, got {runs}", parameter="runs")


def about(whole: Suite, chosen: Suite) -> dict[str, Any]:
    """What identifies results: the suite, its data, and magtwin."""
    return {
        "name": whole.name,
        "version": whole.version,
        "sha256": whole.sha256,
        "seeds": whole.seeds,
        "magtwin": __version__,
        "data": {name: folder_sha256(folder) for name, folder in _data(chosen).items()} | _inputs(chosen),
    }


def _data(suite: Suite) -> dict[str, Path]:
    """Folders of the data that a suite's scenarios need, by name."""
    needed = [each for each in suite.scenario if each.data or each.source not in SIMULATED]
    return {each.data: suite.folder(each) for each in needed}


def _inputs(suite: Suite) -> dict[str, str]:
    """Checksums of a suite's own files: layers beside its scenes, CSV files of paths, weights.

    What ships with magtwin is left out: its version identifies that.
    """
    sums = {}
    ours = shipped("scenes").resolve()
    for scenario in suite.scenario:
        if scenario.source != "twin":
            continue
        scene = suite.scene(scenario).resolve()
        if not scene.is_relative_to(ours):
            sums[f"scene {scenario.scene}"] = folder_sha256(scene.parent, "*.usd*")
        files = {f"path {name}": Path(suite.path(name)) for name in scenario.paths}
        sums |= {name: sha256(file) for name, file in files.items() if file.is_file()}
    models = {each.compensator for each in suite.localizer if is_weights(each.compensator)}
    return sums | {f"weights {name}": sha256(suite.path(name)) for name in sorted(models)}


def _run(
    pool: Pool,
    suite: Suite,
    plan: Plan,
    out: Path,
    journal: store.Journal,
    tracks: bool,
    progress: Progress,
) -> None:
    """Run what is planned into a journal."""
    count = _Count(plan, progress)
    work = partial(run_task, suite, _fields(suite, out))
    tasks: Sequence[Task] = plan
    while tasks:
        again = []
        count.start(tasks)
        for outcome in pool.run(work, tasks, limit_s=2 * suite.time_limit_s + GRACE_S, heard=count.heard):
            task = tasks[outcome.index]
            if outcome.failure is not None and outcome.failure.refused is None:
                again.append(_blamed(task, outcome.failure))
                continue
            made = outcome.result()
            journal.add({kind: rows for kind, rows in made.items() if tracks or kind in _ALWAYS})
            count.finished(outcome.index)
        tasks = again


class _Count:
    """The runs that are made, those of unfinished chunks included."""

    def __init__(self, plan: Plan, progress: Progress) -> None:
        self._total, self._progress, self._finished = plan.size, progress, 0
        self.start(plan)
        self._say(plan[0].chunk.scenario)

    def start(self, tasks: Sequence[Task]) -> None:
        """Chunks are handed out: at first all of them, then those that failed."""
        self.tasks, self._begun = tasks, dict[int, int]()

    def heard(self, index: int, at: str) -> None:
        """A worker begins with a run."""
        task = self.tasks[index]
        self._begun[index] = _before(task, at)
        self._say(task.chunk.scenario)

    def finished(self, index: int) -> None:
        """A chunk is finished."""
        self._begun.pop(index, None)
        self._finished += self.tasks[index].size
        self._say(self.tasks[index].chunk.scenario)

    def _say(self, scenario: str) -> None:
        self._progress(self._finished + sum(self._begun.values()), self._total, scenario)


_ALWAYS = (store.ROWS, store.TIMES)
"""Kinds of tables that are kept without `tracks`."""


def _before(task: Task, at: str) -> int:
    """Runs of a task that are made when it says that it begins with one."""
    run, _, name = at.partition(" ")
    chunk = task.chunk
    if not run.isdecimal():
        return 0
    place = chunk.entries.index(name) if name in chunk.entries else 0
    this = (int(run), place)
    skipped = sum((k, chunk.entries.index(entry)) < this for k, entry in task.done)
    return (int(run) - chunk.first) * len(chunk.entries) + place - skipped


def run_task(suite: Suite, fields: Path | None, task: Task) -> dict[str, list[Row]]:
    """`run_chunk` of a task, in a worker."""
    if fields is not None and not fields.is_dir():
        text = f"{fields}: this machine does not see the folder of results; put it where all workers do"
        raise InputError(text, parameter="out")
    beat(times=SETUP)
    return run_chunk(suite, task.chunk, fields, task.failures, task.done)


def _blamed(task: Task, failure: Failure) -> Task:
    """The task with the run during which its worker failed marked as failed.

    Raises:
        InputError: The worker failed before a localizer had begun.
    """
    run, _, name = failure.at.partition(" ")
    reason = {
        "late": "took longer than its time limit, and did not stop",
        "lost": failure.reason.replace("its worker process", "the process"),
        "raised": f"ended with {failure.reason}",
    }[failure.kind]
    if not name or (int(run), name) in task.failures:
        where = f"scenario {task.chunk.scenario!r}, run {run or task.chunk.first}"
        raise InputError(f"{where}: cannot be made: {failure.reason}")
    return replace(task, failures={**task.failures, (int(run), name): reason})


def _fields(suite: Suite, out: Path) -> Path | None:
    """Folder of the true fields that are fitted to surveys, made once; None if the suite needs none."""
    from magtwin.bench.world import fit_field

    needed = {each.data: suite.folder(each) for each in suite.scenario if each.source == "twin" and each.data}
    folder = out / "fields"
    for name, survey in needed.items():
        if not (folder / name).is_dir():
            with output(folder / name, force=True) as aside:
                fit_field(survey, aside)
    return folder.resolve() if needed else None
