"""Sweeps on disk: a folder with a Parquet file per run, and runs.csv, which lists them."""

import csv
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from magtwin.files import output
from magtwin.io.tables import write_parquet
from magtwin.report import Figure, Report
from magtwin.run.run import Run
from magtwin.verdict import HOLDS, HOLDS_ONE, Tally

LISTING = "runs.csv"
LISTED = ("path", "seed", "session", "speed_m_s")


def save_runs(
    runs: Sequence[Run],
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    progress: Callable[[int, int], Any] = lambda done, total: None,
) -> Report:
    """Write runs to a folder: run_00000.parquet and so on, and runs.csv.

    runs.csv has a row per run with file, path, seed, session, speed_m_s and readings.

    Args:
        runs: Runs, such as `magtwin.sweep` gives. They are made one block at a time.
        out: Folder to make.
        force: Whether to replace a folder that exists.
        progress: Called with runs done and runs in all.

    Returns:
        Number of runs and readings, duration, speed, and how well the 90 % intervals hold.

    Raises:
        InputError: The folder exists, or a run cannot be made.
    """
    tally, readings, driven_s, start = Tally(), 0, 0.0, time.monotonic()
    paths: dict[str, None] = {}
    sessions = set()
    with output(out, force=force) as folder:
        folder.mkdir()
        with open(folder / LISTING, "w", encoding="utf-8", newline="") as file:
            table: Any = csv.writer(file, lineterminator="\n")
            table.writerow(("file", *LISTED, "readings"))
            progress(0, len(runs))
            for k, run in enumerate(runs):
                name = f"run_{k:05d}.parquet"
                write_parquet(run, folder / name)
                run.add_to(tally)
                table.writerow((name, *(run.metadata.get(key, "") for key in LISTED), run.rows))
                paths[str(run.metadata.get("path", ""))] = None
                sessions.add(tuple(run.metadata.get(key) for key in ("session", "session_seed")))
                readings, driven_s = readings + run.rows, driven_s + float(run.metadata["duration_s"])
                progress(k + 1, len(runs))
    took_s = time.monotonic() - start
    names = {str(session) for session, _ in sessions}
    return Report(
        f"{len(runs)} runs in {out}",
        (
            Figure("runs", len(runs)),
            Figure("readings", readings),
            Figure("driven", driven_s, "s"),
            Figure("took", round(took_s, 3), "s"),
            Figure("rate", len(runs) / took_s, "runs/s"),
        ),
        {"paths": ", ".join(paths), "sessions": "survey" if names == {"survey"} else len(sessions)},
        tally.verdict(
            f"the exact field of {len(runs)} runs in {len(sessions)} sessions",
            holds=HOLDS_ONE if len(sessions) == 1 else HOLDS,
        ),
    )
