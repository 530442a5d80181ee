"""Sweeps on disk: a folder with a Parquet file per run, and runs.csv, which lists them.

Processes, shards and clusters write to OUT.parts first. Whoever finishes the last block of runs renames that
folder to OUT, which then has the same files as those of one process.
"""

import csv
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from magtwin.errors import InputError
from magtwin.files.file import read_bytes, read_text
from magtwin.files.outputs import HIDDEN, check_free, output
from magtwin.io.tables import parquet_of, write_parquet
from magtwin.parallel import checked_shard, in_shard, open_pool
from magtwin.report.report import Figure, Report
from magtwin.report.verdict import HOLDS, HOLDS_ONE, Tally
from magtwin.run.run import Run
from magtwin.version import __version__

LISTING = "runs.csv"
SCENE = ("scene", "scene_name")
LISTED = ("path", "seed", "session", "speed_m_s")
ABOUT = "sweep.json"

BLOCKS, BLOCK = 32, 16  # Processes get blocks of runs: at least so many blocks, of at most so many runs

Progress = Callable[[int, int], Any]


@dataclass
class Listed:
    """What is said of some runs."""

    rows: list[list[Any]] = field(default_factory=list)  # Rows of runs.csv
    paths: dict[str, None] = field(default_factory=dict)
    sessions: dict[str, str] = field(default_factory=dict)  # Session by session and its seed
    driven_s: float = 0.0
    tally: Tally = field(default_factory=Tally)

    def add(self, name: str, run: Run, scene: int | None = None) -> None:
        """Add a run, of the scene of that number if there are several."""
        run.add_to(self.tally)
        of = [] if scene is None else [scene, run.metadata.get("scene", "")]
        self.rows.append([name, *of, *(run.metadata.get(key, "") for key in LISTED), run.rows])
        self.paths[str(run.metadata.get("path", ""))] = None
        session, seed = (str(run.metadata.get(key)) for key in ("session", "session_seed"))
        self.sessions[f"{session} {seed}"] = session
        self.driven_s += float(run.metadata["duration_s"])

    def extend(self, other: "Listed") -> None:
        """Add what is said of other runs."""
        self.rows += other.rows
        self.paths |= other.paths
        self.sessions |= other.sessions
        self.driven_s += other.driven_s
        self.tally.extend(other.tally)

    def to_json(self) -> bytes:
        """As `from_json` reads it."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, text: bytes) -> "Listed":
        """What `to_json` gave."""
        values = json.loads(text)
        return cls(**{**values, "tally": Tally(**values["tally"])})

    def csv(self) -> bytes:
        """The file runs.csv."""
        file = io.StringIO(newline="")
        table: Any = csv.writer(file, lineterminator="\n")
        several = bool(self.rows) and len(self.rows[0]) > len(LISTED) + 2
        table.writerow(("file", *(SCENE if several else ()), *LISTED, "readings"))
        table.writerows(self.rows)
        return file.getvalue().encode()

    def report(self, title: str, took_s: float, made: int) -> Report:
        """Numbers of runs and readings, duration, rate, and how well 90 % intervals hold."""
        names = set(self.sessions.values())
        count, sessions = len(self.rows), len(self.sessions)
        runs = "one run" if count == 1 else f"{count} runs"
        return Report(
            title,
            (
                Figure("runs", count),
                Figure("readings", sum(row[-1] for row in self.rows)),
                Figure("driven", self.driven_s, "s"),
                Figure("took", round(took_s, 3), "s"),
                Figure("rate", made / took_s, "runs/s"),
            ),
            {"paths": ", ".join(self.paths), "sessions": "survey" if names == {"survey"} else sessions},
            self.tally.verdict(
                f"the exact field of {runs} in {'one session' if sessions == 1 else f'{sessions} sessions'}",
                holds=HOLDS_ONE if sessions == 1 else HOLDS,
            ),
        )


def save_runs(
    runs: Sequence[Run],
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    jobs: int | None = None,
    shard: tuple[int, int] | None = None,
    dask: str | None = None,
    progress: Progress = lambda done, total: None,
) -> Report:
    """Write runs to a folder: run_00000.parquet and so on, and runs.csv.

    runs.csv has a row per run with file, path, seed, session, speed_m_s and readings; of a sweep over several
    scenes also `scene`, its number from 0, and scene_name. The files are the same
    with any number of jobs and shards. With jobs, shards or dask, unfinished work is kept in the folder
    OUT.parts, and a repeat continues it.

    Args:
        runs: Runs, such as `magtwin.sweep` gives. They are made one block at a time.
        out: Folder to make.
        force: Whether to replace a folder that exists.
        jobs: Processes that make the runs. Default: this process makes them, with several threads.
        shard: (i, n) makes every n-th block of runs, from the i-th, counted from 0; others make the rest.
        dask: Address of a dask scheduler whose workers make the runs.
        progress: Called with runs done and runs in all.

    Returns:
        Number of runs and readings, duration, speed, and how well the 90 % intervals hold.

    Raises:
        InputError: The folder exists, OUT.parts is of another sweep, or a run cannot be made.
    """
    if jobs is None and shard is None and dask is None:
        return _save_here(runs, out, force, progress)
    if getattr(runs, "identity", None) is None:
        text = "`jobs`, `shard` and `dask` need the runs that magtwin.sweep gives, not a list of runs"
        raise InputError(text, parameter="jobs")
    if shard is not None and force:
        text = "other shards may have written there; remove the folder yourself, and drop `force`"
        raise InputError(text, parameter="force")
    parts = _Parts(runs, Path(out), force, at_hand=dask is None)
    check_free(out, force=force)
    if shard is not None:
        checked_shard(shard)
        jobs = 1 if jobs is None and dask is None else jobs
    with open_pool(jobs, dask=dask) as pool:
        return parts.save(pool, shard, progress)


def _save_here(runs: Sequence[Run], out: str | os.PathLike[str], force: bool, progress: Progress) -> Report:
    """Make runs in this process and write them."""
    said, start = Listed(), time.monotonic()
    scene_of = getattr(runs, "scene_of", lambda number: None)
    with output(out, force=force) as folder:
        folder.mkdir()
        progress(0, len(runs))
        for k, run in enumerate(runs):
            name = _file(k)
            write_parquet(run, folder / name)
            said.add(name, run, scene_of(k))
            progress(k + 1, len(runs))
        (folder / LISTING).write_bytes(said.csv())
    return said.report(f"{len(runs)} runs in {out}", time.monotonic() - start, len(runs))


def _file(number: int) -> str:
    return f"run_{number:05d}.parquet"


def make_block(runs: Any, folder: Path | None, numbers: range) -> tuple[list[tuple[str, bytes]], Listed]:
    """Names and contents of the files of some runs, and what is said of them; in a worker.

    A worker that has the folder writes the files itself, one run at a time, and returns none.
    """
    files, said = [], Listed()
    for number, run in zip(numbers, runs.made(numbers), strict=True):
        if folder is None:
            files.append((_file(number), parquet_of(run)))
        else:
            write_parquet(run, folder / _file(number), force=True)
        said.add(_file(number), run, runs.scene_of(number))
    return files, said


class _Parts:
    """The folder OUT.parts of an unfinished sweep: runs, a part-00000.json per block, and sweep.json."""

    def __init__(self, runs: Any, out: Path, force: bool, *, at_hand: bool) -> None:
        """Prepare; the workers can write there themselves if the folder is `at_hand`."""
        self.runs, self.out, self.force, self.at_hand = runs, out, force, at_hand
        self.folder = out.with_name(f"{out.name}.parts")
        size = max(1, min(BLOCK, len(runs) // BLOCKS))
        self.blocks = [range(k, min(k + size, len(runs))) for k in range(0, len(runs), size)]
        self.about = {"magtwin": __version__, "sweep": runs.identity, "runs": len(runs)}

    def save(self, pool: Any, shard: tuple[int, int] | None, progress: Progress) -> Report:
        """Make the blocks of a shard that are not there yet; rename the folder once all are."""
        self._begin()
        blocks = [k for k in range(len(self.blocks)) if in_shard(k, shard) and not self._part(k).exists()]
        total, made, start = sum(len(self.blocks[k]) for k in blocks), 0, time.monotonic()
        progress(0, total)
        try:
            folder = self.folder.absolute() if self.at_hand else None
            work = partial(make_block, self.runs, folder)
            for outcome in pool.run(work, [self.blocks[k] for k in blocks]):
                files, said = outcome.result()
                block = blocks[outcome.index]
                for name, content in (*files, (self._part(block).name, said.to_json())):
                    with output(self.folder / name, force=True) as aside:
                        aside.write_bytes(content)
                made += len(self.blocks[block])
                progress(made, total)
        except BaseException:
            if not any(self.folder.glob("part-*.json")):
                shutil.rmtree(self.folder, ignore_errors=True)
            raise
        took_s = max(time.monotonic() - start, 1e-9)
        said = Listed()
        parts = [part for part in map(self._part, range(len(self.blocks))) if part.exists()]
        for part in parts:
            said.extend(Listed.from_json(read_bytes(part, "part of a sweep", "JSON")))
        if len(parts) == len(self.blocks) and self._finish(said):
            return said.report(f"{len(self.runs)} runs in {self.out}", took_s, made)
        title = f"{len(said.rows)} of {len(self.runs)} runs in {self.folder}; other shards make the rest"
        return said.report(title, took_s, made)

    def _part(self, block: int) -> Path:
        return self.folder / f"part-{block:05d}.json"

    def _begin(self) -> None:
        """Make the folder, or check that it is of this sweep."""
        with suppress(OSError, ValueError):  # missing or damaged
            if json.loads(read_text(self.folder / ABOUT, "description of a sweep", "JSON")) == self.about:
                return
        if self.folder.exists() and any(not file.name.startswith(".") for file in self.folder.iterdir()):
            if not self.force:
                text = "unfinished runs of another sweep; give `force=True` to replace them, or another name"
                raise InputError(f"{self.folder}: {text}", parameter="force")
            shutil.rmtree(self.folder)
        with output(self.folder / ABOUT, force=True) as aside:
            aside.write_text(json.dumps(self.about), encoding="utf-8")

    def _finish(self, said: Listed) -> bool:
        """Rename the folder, which has all runs; False if another shard does so at the same time."""
        try:
            with output(self.folder / LISTING, force=True) as aside:
                aside.write_bytes(said.csv())
            if self.out.exists():  # checked in the beginning: to be replaced
                shutil.rmtree(self.out)
            self.folder.rename(self.out)
        except (FileNotFoundError, InputError):
            if self.folder.exists():
                raise
            return self.out.exists()
        for left in self.out.glob(f".*{HIDDEN}*"):  # of processes that were killed
            shutil.rmtree(left, ignore_errors=True)
        for file in (*self.out.glob("part-*.json"), self.out / ABOUT):  # sweep.json last
            file.unlink(missing_ok=True)
        return True
