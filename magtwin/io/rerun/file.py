"""File: a Run, or several to compare, as a Rerun recording with a layout, and back."""

import os
import tempfile
import warnings
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.outputs import output
from magtwin.io.rerun.layout import RUN_COLOURS, Shown, comparison_layout, plotted, raised
from magtwin.io.rerun.recording import (
    ROOM,
    content_id,
    flush,
    recording_of,
    send_whole,
    size_of,
    stream,
    title_of,
)
from magtwin.io.rerun.series import COLUMNS_ENTITY, entity_of, table_of
from magtwin.io.rerun.viewer import check_decodes, show
from magtwin.io.rerun.world import Interior, Robot, heading_of, send_room
from magtwin.path import Path
from magtwin.run import mapped
from magtwin.run.arrow import without_pandas
from magtwin.run.run import Run
from magtwin.run.spool import blocks
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import Twin


@without_pandas()
def write_rrd(
    run: Run,
    path: str | os.PathLike[str],
    twin: Twin | None = None,
    *,
    planned: Path | None = None,
    scans: Scans | None = None,
    force: bool = False,
) -> None:
    """Write a run as a Rerun recording (.rrd) with a layout; one without rows is refused.

    Every column is stored exactly and at full rate on the timeline `sim_time`; poses are drawn at 50 Hz at
    most. The recording's id comes from the run's content, so two files of one run hold the same recording.
    Only Rerun's own ids of chunks, rows and views differ, which `rerun rrd compare --unordered` ignores.

    The `twin` is where the run took place: its stage and its map are shown, with the `planned` path and the
    LiDAR's `scans` as points in world. Without it there are only series. `force` replaces an existing file.
    """
    _check_rows(run, path)
    name, size = title_of(run) or FilePath(path).stem, size_of(run, scans)
    shown: dict[str, Any] = {"planned": planned, "scans": scans}
    if run.rows > mapped.LONG:  # the layout looks at some rows, and at the last one
        some = np.append(np.arange(0, run.rows - 1, -(-run.rows // mapped.BLOCK)), run.rows - 1)
        shown |= {"known": run.take(some), "events": raised(run)}
        mapped.release()
    shown |= {"room": size, "final": FilePath(path)}
    with (
        output(path, force=force) as aside,
        recording_of(run, content_id(run), name, twin, file=aside, **shown) as recording,
    ):
        for block in blocks(run):
            recording.append(block)
            if block.rows < run.rows:  # Rerun queues what it has not written
                flush(recording.rec, aside.parent)
        recording.close()


def write_comparison(
    runs: Mapping[str, Run],
    path: str | os.PathLike[str],
    twin: Twin | None = None,
    *,
    planned: Path | None = None,
    force: bool = False,
) -> None:
    """Write several runs by name into one recording, on a common timeline, each in its own colour."""
    if not runs:
        raise InputError(f"{path}: there are no runs to compare; name at least one")
    for run in runs.values():
        _check_rows(run, path)
    entities = {entity_of("", name) for name in runs}
    if len(entities) < len(runs) or "" in entities:
        raise InputError(f"{path}: runs that are compared need names that differ, got {', '.join(runs)}")
    colours = cycle(RUN_COLOURS)
    compared = [Shown.of(run, name=name, colour=next(colours)) for name, run in runs.items()]
    first = next(iter(runs.values()))
    lab, heading = (None, 0.0) if twin is None else (twin.scene.lab, heading_of(twin.field, first))
    size = ROOM + sum(map(size_of, runs.values()))
    if twin is not None:
        interior = Interior.of(twin)
        size += interior.size(twin.field)
    title = " and ".join(runs) if len(runs) < 4 else f"{len(runs)} runs"
    views = comparison_layout(compared, lab, heading=heading)
    with (
        output(path, force=force) as aside,
        stream(content_id(*runs.values()), title, views, file=aside, final=FilePath(path), room=size) as rec,
    ):
        if twin is not None:
            send_room(rec, interior, twin.field, first, planned)
        for shown in compared:
            robot = None if twin is None else Robot(rec, interior, colour=shown.colour, name=shown.name)
            send_whole(rec, runs[shown.name], shown.name, robot)


def show_run(run: Run, twin: Twin | None = None, *, file: str | os.PathLike[str]) -> None:
    """Show a run in the Rerun viewer; returns when the viewer is closed.

    Without the twin, only series are shown. Errors and the window name `file`, from which the run was read.
    """
    _check_rows(run, file)
    if twin is None and not plotted(run):
        raise InputError(f"{file}: holds none of the columns that are plotted, such as b_total_nt")
    with tempfile.TemporaryDirectory() as folder:
        rrd = FilePath(folder) / f"{FilePath(file).stem}.rrd"
        write_rrd(run, rrd, twin)
        show(rrd, source=file)


def read_run(path: str | os.PathLike[str]) -> Run:
    """The run of a recording, equal to the written one to the bit; refused if it holds none, or several."""
    runs = read_runs(path)
    if len(runs) > 1:
        advice = "read the file of one of them, or use magtwin.io.rerun.file.read_runs"
        raise InputError(f"{path}: compares {len(runs)} runs ({', '.join(runs)}); {advice}")
    return next(iter(runs.values()))


def read_runs(path: str | os.PathLike[str]) -> dict[str, Run]:
    """The runs of a recording by name; a single run is called "run"."""
    path = existing(path, "recording")
    chunks: dict[str, list] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one that was cut short has no end
        check_decodes(path)
        try:
            for chunk in RrdReader(path).stream().filter(content=f"/{COLUMNS_ENTITY}/**").to_chunks():
                chunks.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
        except (RuntimeError, ValueError, OSError) as error:
            reason = str(error).splitlines()[0].removeprefix(f"Failed to read RRD file at {path}: ")
            text = f"not a Rerun recording that can be read ({reason}); write it again"
            raise InputError(f"{path}: {text}") from error
    if not chunks:
        text = f"a Rerun recording without a run of magtwin's: the entity /{COLUMNS_ENTITY} is missing"
        raise InputError(f"{path}: {text}")
    runs = {}
    for batches in chunks.values():
        name, run, rows = table_of(batches, str(path))
        if rows != run.rows:
            what = "a run that did not end" if rows is None else f"{rows:,}"
            raise InputError(f"{path}: was cut short: it holds {run.rows:,} rows of {what}; write it again")
        runs[name] = run
    return runs


def _check_rows(run: Run, path: str | os.PathLike[str]) -> None:
    if not run.rows or "t" not in run.columns:
        raise InputError(f"{path}: the run has no rows, there is nothing to record")
    if not np.isfinite(run["t"]).all():
        row = int(np.argmin(np.isfinite(run["t"]))) + 1
        raise InputError(f"{path}: t of row {row} is not finite; a recording needs the time of each row")
