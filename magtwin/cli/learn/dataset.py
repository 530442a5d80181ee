"""`magtwin dataset`: recordings with labels on a map, to learn a magnetometer from."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Remap, Unit
from magtwin.cli.terminal import Done, progress, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.learn.data.recording import Source

dataset_app = App(name="dataset", help="Data sets: recordings with labels on a map, to learn from.")
app.command(dataset_app)

By = Literal["metadata", "file", "folder"]


@dataset_app.command
def build(
    run: Annotated[list[Path], Parameter(negative="")],
    *,
    map: Path,  # noqa: A002
    out: Path,
    alignment: Literal["fit", "none"] = "none",
    lever_arm_m: tuple[float, float] | None = None,
    latency_s: float | None = None,
    session_by: By = "metadata",
    path_by: By = "metadata",
    rate_hz: float | None = None,
    remap: Remap = None,
    unit: Unit = None,
    column: Annotated[list[str] | None, Parameter(negative="")] = None,
    force: Force = False,
) -> Done:
    """Label recordings on a map and write them as a data set: measured total field less the map.

    Parameters
    ----------
    run
        Recordings of any kind: Parquet, CSV, npz, Rerun, rosbag2, USD, the released node's own .json; a
        folder that `magtwin runs` made stands for all of its runs.
    map
        Map that the labels are made on: a layer or stage, or a folder of survey CSVs.
    out
        Folder to make.
    alignment
        fit: find the sensor's lever arm and latency from all recordings together; none: take pose and
        reading as they stand.
    lever_arm_m
        Where the sensor is, forward and left of where the map has it [m], if known.
    latency_s
        How much older a reading is than its stamp [s], if known.
    session_by
        What tells sessions apart, a day or a switching on: the recording's metadata "session" (its name where
        it has none), its file, or its folder.
    path_by
        What tells which path was driven: the recording's metadata "path" (its name where it has none), its
        file, or its folder.
    rate_hz
        Keep at most so many readings a second [Hz]; all unless given.
    column
        What a CSV or Parquet of another program calls a column of a run, as NAME=THEIRS, a vector's by its
        parts: b_measured_nt=field, p_world_base_x=east. Repeatable. A p_world_base without z is on the floor.
    """
    from magtwin.cli.runs.file import pairs
    from magtwin.files import check_free, sha256
    from magtwin.io.surveys.maps import open_map
    from magtwin.learn.data.dataset import build_dataset
    from magtwin.learn.data.labels import Alignment

    check_free(out, force=force)
    given = lever_arm_m is not None or latency_s is not None
    if given and alignment == "fit":
        raise InputError("--alignment fit finds both; drop it, or --lever-arm-m and --latency-s")
    options: dict[str, Any] = {"topics": pairs("remap", remap) if remap else None, "unit": unit}
    options["columns"] = _columns(column) if column else None
    options = {name: value for name, value in options.items() if value is not None}
    sources = _sources(_files(run), session_by, path_by, options)
    aligned: Any = "fit" if alignment == "fit" else None
    if given:
        aligned = Alignment(lever_arm_m or (0.0, 0.0), latency_s or 0.0)
    with progress("Labelling", "recordings") as advance:
        made = build_dataset(
            sources,
            open_map(map),
            out,
            alignment=aligned,
            map_sha256=sha256(map) if map.is_file() else "",
            rate_hz=rate_hz,
            force=force,
            progress=advance,
        )
    return Done(made.report(), out)


@dataset_app.command
def info(dataset: Path) -> Done:
    """What a data set holds, each shard read against its checksum.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    """
    from dataclasses import replace

    from magtwin.learn.data.dataset import open_dataset

    step("Checking the shards")
    found = open_dataset(dataset)
    found.check()
    report = found.report()
    each = {
        one.name: f"session {one.session}, path {one.path}, {one.rows:,} readings, {one.labelled:,} labels, "
        f"{one.label_mean_nt:.0f} ± {one.label_sd_nt:.0f} nT"
        for one in found.recordings
    }
    return Done(replace(report, metadata={**report.metadata, "recordings": each}))


@dataset_app.command
def correlate(
    dataset: Path,
    *,
    features: str = "full",
    out: Path | None = None,
    force: Force = False,
) -> Done:
    """Correlate each input with the disturbance: Spearman's rank correlation, as in the paper's Figure 2.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    features
        Set of inputs, or names with commas between.
    out
        Picture to write, .png or .svg.
    """
    import numpy as np

    from magtwin.files import check_free
    from magtwin.learn.data.correlation import correlations
    from magtwin.learn.data.dataset import open_dataset

    if out is not None:
        check_free(out, force=force)
    step("Reading the data set")
    found = open_dataset(dataset)
    rows = found.rows(features)
    sessions = [found.recording(name).session for name in rows.names]
    of = rows.names if len(set(sessions)) < 2 else sessions
    number = {key: i for i, key in enumerate(dict.fromkeys(of))}
    groups = np.array([number[key] for key in of])[rows.recording]
    step("Ranking the inputs")
    result = correlations(rows.x, rows.y, rows.features, groups)
    if out is not None:
        from magtwin.figures.training import plot_correlations

        plot_correlations(result, out, title=f"{dataset}", force=force)
    return Done(result.report(f"Correlation with the disturbance in {dataset}"), out or ())


def _columns(given: Sequence[str]) -> dict[str, str]:
    """Names of a table's columns, by those of a Run."""
    found: dict[str, str] = {}
    for word in given:
        name, _, theirs = word.partition("=")
        if not (name and theirs) or name in found or theirs in found.values():
            raise InputError(f"--column takes NAME=THEIRS, each once, such as yaw=heading, got {word!r}")
        found[name] = theirs
    return found


def _files(given: Sequence[Path]) -> list[Path]:
    """Recordings, a folder of `magtwin runs` by the files in it."""
    found: list[Path] = []
    for path in given:
        if (path / "runs.csv").is_file():
            inside = sorted(path.glob("run_*.parquet"))
            if not inside:
                raise InputError(f"{path}: its runs.csv stands alone, without run_*.parquet")
            found += inside
        else:
            found.append(path)
    return found


def _sources(files: Sequence[Path], session_by: By, path_by: By, options: dict[str, Any]) -> "list[Source]":
    """Recordings by a name each: that of the file, with its folder's before it where two have one name."""
    from functools import partial

    from magtwin.files import existing
    from magtwin.io.formats import read_run
    from magtwin.learn.data.recording import Source

    def named(word: str) -> str:
        return re.sub(r"\.\.+", ".", re.sub(r"[^A-Za-z0-9_.+-]", "_", word)).lstrip(".+-")[:180] or "_"

    short = [named(existing(path, "recording").resolve().stem) for path in files]
    long = [named(f"{path.resolve().parent.name}_{path.resolve().stem}") for path in files]
    names = [one if short.count(one) == 1 else other for one, other in zip(short, long, strict=True)]
    by = {"metadata": lambda path, name: "", "file": lambda path, name: name}
    by["folder"] = lambda path, name: path.resolve().parent.name or name
    return [
        Source(name, partial(read_run, path, **options), by[session_by](path, name), by[path_by](path, name))
        for path, name in zip(files, names, strict=True)
    ]
