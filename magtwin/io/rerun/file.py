"""Rerun: a Run, or several to compare, as a recording with a ready layout, and back."""

import os
import struct
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path as FilePath

import numpy as np
from rerun.chunk import RrdReader

from magtwin.errors import InputError
from magtwin.files import existing, output
from magtwin.io.recorder import PARTIAL
from magtwin.io.rerun.layout import RUN_COLOURS, Shown, comparison_layout, layout, plotted
from magtwin.io.rerun.recording import (
    ROOM,
    Recording,
    content_id,
    metadata_page,
    send_properties,
    size_of,
    stream,
    title_of,
)
from magtwin.io.rerun.series import COLUMNS_ENTITY, entity_of, table_of
from magtwin.io.rerun.viewer import check_decodes, show
from magtwin.io.rerun.world import Interior, Room, heading_of
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import Twin


def write_rrd(
    run: Run,
    path: str | os.PathLike[str],
    twin: Twin | None = None,
    *,
    planned: Path | None = None,
    scans: Scans | None = None,
    force: bool = False,
) -> None:
    """Write a run as a Rerun recording that opens in a ready layout.

    Every column is in it at full rate and to the bit, on the timeline `sim_time`; poses are drawn at 50 Hz
    or less. The recording's id comes from the run's content, so two files of one run hold the same
    recording; only what Rerun stamps itself varies between them (ids of chunks, rows and views), which
    `rerun rrd compare --unordered` does not look at.

    Args:
        run: What happened.
        path: The .rrd file to make.
        twin: What it happened in: its stage and its map are shown. Without it there are series only.
        planned: The path that was to be driven; none where there was none.
        scans: What the LiDAR saw, drawn as points in world; none draws none.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: The file exists and `force` was not given or it cannot be written, the stage cannot be
            read, or the run has no rows.
    """
    _check_rows(run, path)
    lab, heading = (None, 0.0) if twin is None else (twin.scene.lab, heading_of(twin.field, run))
    interior = None if twin is None else Interior.of(twin)
    room = ROOM + size_of(run, scans) + (interior.size if interior else 0)
    views = layout(run, lab, heading=heading)
    name = title_of(run) or FilePath(path).stem
    with (
        output(path, force=force) as aside,
        stream(content_id(run), name, views, file=aside, said=FilePath(path), room=room) as rec,
    ):
        send_properties(rec, run.metadata)
        rec.log("metadata", metadata_page(run.metadata, run.rows), static=True)
        robot = None
        if interior is not None:
            robot = Room.enter(rec, interior, run, planned=planned).robot()
        recording = Recording(rec, robot=robot, scans=scans)
        recording.append(run)
        recording.close()


def write_comparison(
    runs: Mapping[str, Run],
    path: str | os.PathLike[str],
    twin: Twin | None = None,
    *,
    offsets_s: Mapping[str, float] | None = None,
    planned: Path | None = None,
    force: bool = False,
) -> None:
    """Write several runs into one recording, on a common timeline, each in a colour of its own.

    Args:
        runs: Runs by the names that they are to have.
        path: The .rrd file to make.
        twin: What they happened in; without it there are series only.
        offsets_s: What to add to the times of some of them [s], by name.
        planned: The path that was to be driven.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: There is no run or one has no rows, two names would be one in Rerun, an offset is of
            no run or not finite, or the file cannot be made as in `write_rrd`.
    """
    if not runs:
        raise InputError(f"{path}: there are no runs to compare; name at least one")
    for run in runs.values():
        _check_rows(run, path)
    if len({entity_of("", name) for name in runs}) < len(runs) or not all(
        entity_of("", name) for name in runs
    ):
        raise InputError(f"{path}: runs that are compared need names that differ, got {', '.join(runs)}")
    offsets = dict(offsets_s or {})
    for name, offset in offsets.items():
        if name not in runs or not np.isfinite(offset):
            raise InputError(
                f"{path}: the offset {offset!r} s of {name!r} is not a finite one of a run; "
                f"runs are {', '.join(runs)}"
            )
    shown = [
        Shown.of(
            run,
            name=name,
            offset_s=float(offsets.get(name, 0.0)),
            colour=RUN_COLOURS[number % len(RUN_COLOURS)],
        )
        for number, (name, run) in enumerate(runs.items())
    ]
    first = next(iter(runs.values()))
    lab, heading = (None, 0.0) if twin is None else (twin.scene.lab, heading_of(twin.field, first))
    interior = None if twin is None else Interior.of(twin)
    size = sum(map(size_of, runs.values())) + (interior.size if interior else 0)
    title = " and ".join(runs) if len(runs) < 4 else f"{len(runs)} runs"
    with (
        output(path, force=force) as aside,
        stream(
            content_id(*runs.values()),
            title,
            comparison_layout(shown, lab, heading=heading),
            file=aside,
            said=FilePath(path),
            room=ROOM + size,
        ) as rec,
    ):
        room = None if interior is None else Room.enter(rec, interior, first, planned=planned)
        for one in shown:
            robot = None
            if room is not None:
                robot = room.one_of_several(one.name, one.colour, one.offset_s)
            recording = Recording(rec, one.name, one.offset_s, robot)
            recording.append(runs[one.name])
            recording.close()


def read_run(path: str | os.PathLike[str]) -> Run:
    """The run that a recording holds, equal to the bit to the one that was written.

    A recording that was never finished, as its name `.partial.rrd` tells, is read as far as it goes.

    Args:
        path: The .rrd file.

    Raises:
        InputError: The file is missing, is no recording, was cut short, or holds no run or several.
    """
    runs = read_runs(path)
    if len(runs) > 1:
        raise InputError(
            f"{path}: compares {len(runs)} runs ({', '.join(runs)}); read the file of one of them, or use "
            "magtwin.io.rerun.file.read_runs"
        )
    return next(iter(runs.values()))


def read_runs(path: str | os.PathLike[str]) -> dict[str, Run]:
    """The runs that a recording holds, by name; a run that is alone is called "run".

    Args:
        path: The .rrd file.

    Raises:
        InputError: As for `read_run`.
    """
    path = existing(path, "recording")
    if path.is_dir():
        raise InputError(f"{path}: a folder; name the .rrd file in it")
    partial = PARTIAL in path.suffixes
    chunks: dict[str, list] = {}
    with _readable(path, partial=partial) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a file without an end has none
        check_decodes(file, path)
        try:
            found = RrdReader(file).stream().filter(content=f"/{COLUMNS_ENTITY}/**").to_chunks()
            for chunk in found:
                chunks.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(
                f"{path}: not a Rerun recording that can be read ({_first_line(error, file)}); write it again"
            ) from error
    if not chunks:
        raise InputError(
            f"{path}: a Rerun recording without a run of magtwin's: the entity /{COLUMNS_ENTITY} is missing"
        )
    runs = {}
    for batches in chunks.values():
        name, run, rows = table_of(batches, str(path))
        if rows != run.rows and not partial:
            raise InputError(
                f"{path}: was cut short: it holds {run.rows:,} rows of "
                f"{'a run that did not end' if rows is None else f'{rows:,}'}; to read what there is, "
                f"rename it to {path.stem}{PARTIAL}.rrd"
            )
        if partial and "t" not in run.columns:
            raise InputError(f"{path}: holds no rows: it was broken off before the first of them")
        runs[name] = run
    return runs


@contextmanager
def _readable(path: FilePath, *, partial: bool) -> Iterator[FilePath]:
    """A file that Rerun can read: of one that broke off in the middle of a message, what comes before."""
    if not partial:
        yield path
        return
    end = _whole_messages(path)
    if end == path.stat().st_size:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder, open(path, "rb") as source:
        file = FilePath(folder) / path.name
        with open(file, "wb") as target:
            while end > 0 and (part := source.read(min(end, 1 << 20))):
                target.write(part)
                end -= len(part)
        yield file


def _whole_messages(path: FilePath) -> int:
    """Bytes up to the end of the last whole message: a header of 12, then of each kind, length and body."""
    size, at = path.stat().st_size, 12
    with open(path, "rb") as file:
        while at + 16 <= size:
            file.seek(at)
            length = struct.unpack("<QQ", file.read(16))[1]
            if at + 16 + length > size:
                break
            at += 16 + length
    return min(at, size)


def _first_line(error: Exception, file: FilePath) -> str:
    """What Rerun says, without the name of the file and what it knows of its own insides."""
    text = str(error).splitlines()[0]
    return text.removeprefix(f"Failed to read RRD file at {file}: ")


def view(path: str | os.PathLike[str]) -> None:
    """Show a recording in the Rerun viewer, and return when it is closed.

    Args:
        path: A .rrd file, or any file of a run, whose series are then shown.

    Raises:
        InputError: The file is missing, holds no run, or the viewer cannot run here.
    """
    from magtwin.io.formats import read_run as read_any

    path = existing(path, "recording")
    if path.suffix == ".rrd":
        show(path)
        return
    run = read_any(path)
    _check_rows(run, path)
    if not plotted(run):
        raise InputError(f"{path}: holds none of the columns that are plotted, such as b_total_nt")
    with tempfile.TemporaryDirectory() as folder:
        rrd = FilePath(folder) / f"{path.stem}.rrd"
        write_rrd(run, rrd)
        show(rrd, shown=path)


def _check_rows(run: Run, path: str | os.PathLike[str]) -> None:
    if not run.rows or "t" not in run.columns:
        raise InputError(f"{path}: the run has no rows, there is nothing to record")
    if not np.isfinite(run["t"]).all():
        row = int(np.argmin(np.isfinite(run["t"]))) + 1
        raise InputError(f"{path}: t of row {row} is not finite; a recording needs the time of each row")
