"""`magtwin dataset`: recordings with labels on a map, to train a magnetometer on."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.options import RECORDED, Folder, Force, Jobs, RecordedOptions, pairs
from magtwin.cli.terminal import Done, named, progress, step
from magtwin.errors import InputError

dataset_app = App(name="dataset", help="Data sets: recordings with labels on a map, to train on.")
app.command(dataset_app)

By = Literal["metadata", "file", "folder"]


@dataset_app.command
def build(
    run: Annotated[list[Path], Parameter(negative="")],
    *,
    map: Path,  # noqa: A002
    out: Folder,
    alignment: Literal["fit", "none"] = "none",
    lever_arm_m: tuple[float, float] | None = None,
    latency_s: float | None = None,
    session_by: By = "metadata",
    path_by: By = "metadata",
    rate_hz: float | None = None,
    recorded: RecordedOptions = RECORDED,
    column: Annotated[list[str] | None, Parameter(negative="")] = None,
    jobs: Jobs = None,
    force: Force = False,
) -> Done:
    """Label recordings on a map and write them as a data set: measured total field minus the map.

    Parameters
    ----------
    run
        Recordings of any kind: Parquet, CSV, npz, Rerun, rosbag2, USD, the released node's own .json; a
        folder that `magtwin sweep` made stands for all of its runs.
    map
        Map that the labels are made on: a layer or stage, or a folder of survey CSVs.
    alignment
        fit: fit the sensor's lever arm and latency to all recordings; none: use pose and reading as they are.
    lever_arm_m
        Place of the sensor, forward and left of the map's reference [m], if known.
    latency_s
        Age of a reading at its stamp [s], if known.
    session_by
        Source of the session: the recording's metadata "session" (else its name), its file, or its folder.
    path_by
        Source of the driven path: the recording's metadata "path" (else its name), its file, or its folder.
    rate_hz
        Highest rate of readings to keep [Hz]. Default: all.
    column
        Name of a column in a CSV or Parquet of another program, as NAME=THEIRS, of a vector by its parts:
        b_measured_nt=field, p_world_base_x=east. Repeatable. A p_world_base without z is on the floor.
    jobs
        Number of processes that share the recordings. Default: one, with several threads.
    """
    from magtwin.learn.data.alignment import Alignment
    from magtwin.tasks.learning import build_dataset

    given = lever_arm_m is not None or latency_s is not None
    if given and alignment == "fit":
        raise InputError("--alignment fit finds both; drop it, or --lever-arm-m and --latency-s")
    known: Any = Alignment(lever_arm_m or (0.0, 0.0), latency_s or 0.0) if given else None
    columns = pairs("column", column, "NAME=THEIRS, such as yaw=heading")
    if len(set(columns.values())) < len(columns):
        raise InputError(f"--column names one column twice, got {' '.join(column or ())}")
    how: Any = {"session_by": session_by, "path_by": path_by, "rate_hz": rate_hz, "jobs": jobs}
    how |= {"alignment": "fit" if alignment == "fit" else known, "force": force}
    reading = recorded.options | ({"columns": columns} if columns else {})
    out = named(out, force=force)
    with progress("Labelling", "recordings") as advance:
        made = build_dataset(run, out=out, anomaly_map=map, progress=advance, **how, **reading)
    train = ("magtwin", "train", out, "--out", f"{out.name}.safetensors")
    return Done(made.report(), out, next=(train, ("magtwin", "dataset", "info", out)))


@dataset_app.command
def info(dataset: Path) -> Done:
    """Show what a data set holds, and check each shard against its checksum.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    """
    from dataclasses import replace

    from magtwin.learn.data.dataset import open_dataset

    step("Checking the shards")
    opened = open_dataset(dataset)
    opened.check()
    report = opened.report()
    recordings = {
        each.name: f"session {each.session}, path {each.path}, {each.rows:,} readings, {each.labelled:,} "
        f"labels, {each.label_mean_nt:.0f} ± {each.label_sd_nt:.0f} nT"
        for each in opened.recordings
    }
    return Done(replace(report, metadata={**report.metadata, "recordings": recordings}), whole=True)
