"""`magtwin info`, `view`, `convert` and `fetch`."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.maps.fit import READING, ReadingOptions
from magtwin.cli.terminal import Done, named, progress, silence, step


@app.command
def info(file: Path, *, reading: ReadingOptions = READING, remap: opt.Remap = None) -> Done:
    """Print what a run, a stage, a map or a network holds, and its origin.

    Parameters
    ----------
    file
        A run (.parquet, .rrd, .mcap, .db3, .bag, .csv, .npz, .usd, a .json of the released node, the folder
        of a bag, of Parquet parts, or of magtwin run), a stage or a map (.usd, .usda, .usdc, .usdz), a
        survey (a table, the log of a phone or vehicle, a folder of 0_map.csv, ...), or a network
        (.safetensors, .pth, .onnx).
    """
    from magtwin.io.info import info_of

    step(f"Reading {file.name}")
    told = {name: getattr(reading.columns, name) for name in ("unit", "scale")}
    told |= {name: getattr(reading, name) for name in ("field_topic", "pose_topic")}
    how = opt.Recorded(remap=remap, **told).options
    how |= {name: getattr(reading, name) for name in ("columns", "waypoints", "step_m")}
    return Done(info_of(file, **how), whole=True)


@app.command
@opt.reads_recordings
def view(*files: Annotated[Path, Parameter(required=True)], scene: opt.RunScene = None) -> Done:
    """Show runs or a stage in a viewer until it is closed.

    Runs are shown in the Rerun viewer, in their lab if their scene is found. Several runs share one timeline,
    each in its colour. A stage is shown in a window.

    Parameters
    ----------
    files
        Runs in any format that magtwin reads, or one stage.
    """
    from magtwin.figures.views import view as show

    with silence():
        show(files, scene=scene)
    return Done()


@app.command
def convert(
    run: Path,
    out: Path,
    *,
    scene: opt.RunScene = None,
    out_unit: opt.OutUnit = None,
    usd_fps: opt.UsdFps = None,
    recorded: opt.RecordedOptions = opt.RECORDED,
    force: opt.Force = False,
) -> Done:
    """Convert a run to another format, or import a ROS bag.

    Parameters
    ----------
    run
        A run in any format that magtwin reads, or the parts of a run that did not end.
    out
        File to make: .parquet, .csv, .npz, .rrd, .mcap, .usd, .usda or .usdc. A name without a suffix is the
        folder of a rosbag2.
    """
    from magtwin.io.convert import convert_run

    out = named(out, force=force)
    step("Converting the run")
    how: Any = {"scene": scene, "out_unit": out_unit, "usd_fps": usd_fps, "force": force}
    result = convert_run(run, out, **how, **recorded.options)
    rows = f"{result.rows:,} rows, {len(result)} columns, {result.duration_s:g} s"
    data = {"rows": result.rows, "columns": len(result), "duration_s": result.duration_s}
    look = "view" if out.suffix.lower() in (".rrd", ".usd", ".usda", ".usdc") else "report"
    return Done(wrote=out, text=rows, data=data, next=[("magtwin", look, out), ("magtwin", "info", out)])


@app.command
def fetch(
    assets: Literal["aprilab", "isaac-rules", "turtlebot4", "magnetic-data", "magslam"],
    *,
    out: Path | None = None,
    base_url: str | None = None,
    force: opt.Force = False,
) -> Done:
    """Download original data at a pinned commit, and check each file's SHA-256.

    Parameters
    ----------
    assets
        aprilab: survey, released network and paths (MIT). isaac-rules: Isaac Sim's rules for assets, which
        `magtwin validate --against isaac` runs (Apache-2.0). turtlebot4: description packages (Apache-2.0,
        BSD-3-Clause). magnetic-data: five drives of a robot in a room, with true positions (no licence
        stated). magslam: loops of a model ship (no licence stated) and hand-held loops (MIT).
    out
        Folder to make. Default: the name of the assets; for isaac-rules, the user's cache.
    base_url
        Address of a mirror with the same paths.
    """
    from magtwin.fetch import default_folder, is_complete
    from magtwin.fetch import fetch as fetch_files

    folder = out or default_folder(assets)
    if not force and is_complete(assets, folder):
        return Done(text=f"{folder}: all files are there already, as published", data={"wrote": []})
    if out is not None or assets != "isaac-rules":  # these are looked for in one place
        folder = named(folder, force=force)
    with progress(f"Fetching {assets}", "files") as advance:
        files = fetch_files(assets, folder, base_url=base_url, force=force, progress=advance)
    return Done(wrote=folder, text=f"{len(files)} files")
