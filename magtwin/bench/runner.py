"""Runner: the chunks of a suite on processes, shards and clusters, into a folder of results."""

import hashlib
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from magtwin.bench import results, sealed
from magtwin.bench.results import Results, Run, runs_of
from magtwin.bench.row import SETUP, Row, run_chunk
from magtwin.bench.suite import Chunk, Seeds, Suite, load_suite, suite_file
from magtwin.errors import InputError
from magtwin.files.file import sha256, shipped
from magtwin.files.outputs import output
from magtwin.localization.compensators import is_weights
from magtwin.parallel import Failure, Pool, beat, checked_shard, in_shard, open_pool
from magtwin.version import __version__

GRACE_S = 60.0
"""Time beyond twice the suite's limit after which a worker is killed that has reported nothing: a localizer
whose compiled code hangs does not notice the suite's limit [s]."""

Progress = Callable[[int, int, str], Any]


@dataclass(frozen=True)
class Task:
    """A chunk, and what is known to fail in it."""

    chunk: Chunk
    failures: Mapping[tuple[int, str], str] = field(default_factory=dict)
    """Reasons by run and localizer."""


def benchmark(
    suite: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenarios: Sequence[str] = (),
    localizers: Sequence[str] = (),
    runs: int | None = None,
    seeds: Seeds = "public",
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
    if runs is not None and runs < 1:
        raise InputError(f"`runs` must be at least 1, got {runs}", parameter="runs")
    file, out = suite_file(suite), Path(out)
    whole = load_suite(file)
    chosen = whole.limited(scenarios=scenarios, localizers=localizers, runs=runs, seeds=seeds, data=data)
    try:
        chosen.check(file, sealed.check_localizer)
    finally:
        sealed.close()
    if shard is not None:
        checked_shard(shard)
        if force:
            text = "other shards may have written there; remove the folder yourself, and drop `force`"
            raise InputError(text, parameter="force")
    whole = whole.limited(seeds=seeds)
    with open_pool(jobs, dask=dask) as pool:
        if force and (out / results.ABOUT).is_file():
            shutil.rmtree(out)
        results.begin_results(out, file.read_bytes(), about(whole, chosen))
        chunks = [chunk for k, chunk in enumerate(chosen.chunks()) if in_shard(k, shard)]
        done = results.done_runs(out, chosen.scenarios)
        tasks = [Task(part) for chunk in chunks for part in without(chunk, done)]
        if tasks:
            _run(pool, chosen, whole, tasks, out, tracks, progress or (lambda done, total, what: None))
    return replace(results.results_in(out), new=sum(map(_size, tasks)))


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


def folder_sha256(folder: Path, pattern: str = "*") -> str:
    """SHA-256 of the files of a folder that match `pattern`, and their names; hidden files do not count."""
    sum_ = hashlib.sha256()
    for file in sorted(folder.rglob(pattern)):
        inside = file.relative_to(folder)
        if file.is_file() and not any(part.startswith(".") for part in inside.parts):
            with open(file, "rb") as content:
                sum_.update(
                    f"{inside.as_posix()} {hashlib.file_digest(content, 'sha256').hexdigest()}\n".encode()
                )
    return sum_.hexdigest()


def _data(suite: Suite) -> dict[str, Path]:
    """Folders of the data that a suite's scenarios need, by name."""
    needed = [each for each in suite.scenario if each.data or each.source != "twin"]
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


def without(chunk: Chunk, done: Collection[Run]) -> list[Chunk]:
    """The parts of a chunk that are not done: localizers that lack the same runs stay together."""
    lacking: dict[tuple[int, ...], list[str]] = {}
    for name in chunk.entries:
        runs = tuple(run for run in runs_of(chunk) if (chunk.scenario, name, run) not in done)
        if runs:
            lacking.setdefault(runs, []).append(name)
    parts = []
    for runs, names in lacking.items():
        starts = [k for k, run in enumerate(runs) if k == 0 or runs[k - 1] != run - 1]
        for start, end in zip(starts, [*starts[1:], len(runs)], strict=True):
            parts.append(replace(chunk, first=runs[start], runs=end - start, entries=tuple(names)))
    return parts


def _run(
    pool: Pool, suite: Suite, whole: Suite, tasks: list[Task], out: Path, tracks: bool, progress: Progress
) -> None:
    """Run tasks and write their parts."""
    names = set(whole.chunks())
    total, count = sum(map(_size, tasks)), 0
    progress(0, total, tasks[0].chunk.scenario)
    work = partial(run_task, suite, _fields(suite, out))
    while tasks:
        again = []
        for outcome in pool.run(work, tasks, limit_s=2 * suite.time_limit_s + GRACE_S):
            task = tasks[outcome.index]
            if outcome.failure is not None and outcome.failure.refused is None:
                again.append(_blamed(task, outcome.failure))
                continue
            rows, times, kept = outcome.result()
            more = {results.TIMES: times, **({results.TRACKS: kept} if tracks else {})}
            name = results.part_name(task.chunk, names)
            results.write_part(out, task.chunk.scenario, name, rows, **more)
            count += _size(task)
            progress(count, total, task.chunk.scenario)
        tasks = again


def _size(task: Task) -> int:
    return task.chunk.runs * len(task.chunk.entries)


def run_task(suite: Suite, fields: Path | None, task: Task) -> tuple[list[Row], list[Row], list[Row]]:
    """`run_chunk` of a task, in a worker."""
    if fields is not None and not fields.is_dir():
        text = f"{fields}: this machine does not see the folder of results; put it where all workers do"
        raise InputError(text, parameter="out")
    beat(times=SETUP)
    return run_chunk(suite, task.chunk, fields, task.failures)


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
