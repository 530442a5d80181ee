"""`magtwin info`, `view`, `convert` and `fetch`: what a file holds, how it looks, in another format."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, print_report, progress, say, silence, step
from magtwin.errors import InputError, hint

if TYPE_CHECKING:
    from magtwin.run.run import Run
    from magtwin.twin import Twin

_STAGES = (".usd", ".usda", ".usdc", ".usdz")
_NETS = (".safetensors", ".pth", ".onnx")


@app.command
def info(file: Path, *, json: Json = False) -> None:
    """Tell what a run, a stage, a map or a network holds, and where it came from.

    Parameters
    ----------
    file
        A run (.parquet, .rrd, .mcap, .db3, .csv, .npz, .usd, a .json of the released node, or the folder of a
        bag, of Parquet parts, or of magtwin run), a stage or a map (.usd, .usda, .usdc, .usdz), a folder of
        survey CSVs (0_map.csv, ...), or a network (.safetensors, .pth, .onnx).
    json
        Print it as JSON.
    """
    from magtwin.files import existing
    from magtwin.io.formats import FORMATS

    existing(file, "file")
    if not file.is_dir() and file.suffix not in {*FORMATS, *_STAGES, *_NETS}:
        kinds = hint(file.suffix, {*FORMATS, *_STAGES, *_NETS})
        raise InputError(f"{file}: no kind of file {file.suffix!r} that magtwin knows; {kinds}")
    step(f"Reading {file.name}")
    if file.suffix in _NETS:
        report = _info_of_net(file)
    elif file.suffix in _STAGES and not file.is_dir():
        report = _info_of_usd(file)
    elif file.is_dir() and any(file.glob("*_map.csv")):
        from magtwin.field.maps.card import map_card
        from magtwin.field.survey.gridded import import_survey

        report = map_card(import_survey(file))
    else:
        report = _info_of_run(file)
    print_report(report, json)


@app.command
def view(*files: Path, scene: Path | None = None, offset: list[float] | None = None) -> None:
    """Show a run, several of them together, or a stage.

    Runs are shown in the Rerun viewer: in their lab where their scene is found, else as series; several on
    one timeline, each in its colour. A stage is shown in usdview where that is installed, else in a window.

    Parameters
    ----------
    files
        Runs in any format that magtwin writes, or a stage.
    scene
        Stage to show runs in, in place of the one that they name.
    offset
        Seconds to add to the times of a run among several, once a run, in their order.
    """
    if offset and (len(offset) != len(files) or len(files) < 2):
        raise InputError(
            f"--offset is given once for each of several runs, got {len(offset)} of {len(files)}"
        )
    if not files:
        raise InputError("view needs a file; name a run or a stage")
    if len(files) > 1:
        _view_together(files, scene, offset or [0.0] * len(files))
    elif files[0].suffix in _STAGES and not files[0].is_dir():
        _view_stage(files[0])
    else:
        _view_run(files[0], scene)


@app.command
def convert(
    run: Path,
    out: Path,
    *,
    scene: Path | None = None,
    storage: Literal["mcap", "sqlite3"] | None = None,
    units: Literal["T", "nT"] | None = None,
    usd_fps: Annotated[float | None, Parameter(name="--usd-fps")] = None,
    topic: list[str] | None = None,
    field_unit: Literal["nT", "uT", "T", "mG", "G"] | None = None,
    force: Force = False,
) -> None:
    """Write a run in another format; a robot's own bag becomes a run so.

    Parameters
    ----------
    run
        A run in any format that magtwin reads; also one that did not end, as its parts lie there.
    out
        File to make: .parquet, .csv, .npz, .rrd, .mcap, .usd, .usda or .usdc; or, for a name without an
        ending, the folder of a rosbag2.
    scene
        Stage that it happened in, in place of the one that it names; .rrd, bags and USD show it.
    storage
        How a bag is stored: mcap unless given.
    units
        Unit of the field in a bag: T, as ROS has it, unless given; nT, as the released package publishes it.
    usd_fps
        Frames a second in USD [Hz]; 30 unless given, 0 for one at every reading.
    topic
        What a topic is called in a robot's own bag, as NAME=THEIRS: /robot/enu/pose=/vrpn/pose. Repeatable.
    field_unit
        Unit of the field in a robot's own bag; told by its size unless given.
    force
        Replace what exists.
    """
    from magtwin.files import check_free
    from magtwin.io.formats import format_of, read_run, write_run

    check_free(out, force=force)
    options: dict[str, Any] = {"storage": storage, "units": units, "fps": usd_fps}
    options = {name: value for name, value in options.items() if value is not None}
    if usd_fps == 0:
        options["fps"] = None
    takes = format_of(out).takes
    if scene is not None and not takes & {"twin", "scene_file"}:
        raise InputError(f"{out}: a table shows no scene; drop --scene")
    if out.resolve() == run.resolve():
        raise InputError(f"{out}: is the run itself; name another file")
    named: dict[str, Any] = {"topics": _named(topic) if topic else None, "unit": field_unit}
    step("Reading the run")
    result = read_run(run, **{name: value for name, value in named.items() if value is not None})
    twin = _twin(result, run, scene) if takes & {"twin", "scene_file"} else None
    step(f"Writing {out.name}")
    write_run(result, out, twin, force=force, **options)
    say(f"Wrote {out}: {result.rows:,} rows, {len(result)} columns, {result.duration_s:g} s")


@app.command
def fetch(
    what: Literal["aprilab", "turtlebot4"],
    *,
    dest: Path | None = None,
    base_url: str | None = None,
    force: Force = False,
) -> None:
    """Fetch the originals, at a pinned commit, each file checked against its SHA-256.

    Parameters
    ----------
    what
        aprilab: the survey, the released network and paths (MIT). turtlebot4: the description packages
        (Apache-2.0, BSD-3-Clause).
    dest
        Folder to make; named after the source unless given.
    base_url
        Address of a mirror with the same paths.
    force
        Replace the folder if it exists.
    """
    from magtwin.fetch import fetch as fetch_files

    dest = dest or Path(what)
    with progress(f"Fetching {what}", "files") as advance:
        files = fetch_files(what, dest, base_url=base_url, force=force, progress=advance)
    say(f"Wrote {len(files)} files to {dest}")


def _named(topics: list[str]) -> dict[str, str]:
    """Names of topics, by those that magtwin gives them."""
    pairs = [topic.partition("=") for topic in topics]
    wrong = [topic for topic, (name, _, theirs) in zip(topics, pairs, strict=True) if not (name and theirs)]
    if wrong:
        raise InputError(f"--topic takes NAME=THEIRS, such as /robot/enu/pose=/vrpn/pose, got {wrong[0]!r}")
    return {name: theirs for name, _, theirs in pairs}


def _info_of_usd(file: Path) -> Any:
    from dataclasses import replace

    from magtwin.usd.animation import is_animation
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.maps import is_map_layer

    if file.suffix == ".usdz":
        return info_of_stage(file)
    if not is_animation(file):
        return _info_of_map(file) if is_map_layer(file) else info_of_stage(file)
    run = _info_of_run(file)
    try:
        return replace(run, figures=(*run.figures, *info_of_stage(file).figures))
    except InputError as error:  # the run is whole without its scene
        return replace(run, metadata={**run.metadata, "stage": str(error)})


def _info_of_map(file: Path) -> Any:
    """The map's card, and below it what any stage holds."""
    from dataclasses import replace

    from magtwin.field.maps.card import map_card
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.maps import load_epochs

    epochs = load_epochs(file)
    card = map_card(epochs[-1], epochs)
    stage = [figure for figure in info_of_stage(file).figures if figure.value != 0]
    return replace(card, title=f"{card.title} ({file})", figures=(*card.figures, *stage))


def _info_of_run(file: Path) -> Any:
    """Rows, what was driven and read, what it came from, and every column with its unit."""
    from dataclasses import replace

    from magtwin.io.formats import read_run
    from magtwin.report import Figure

    run = read_run(file)
    report = run.report(str(file))
    columns = {}
    for name, values in run.items():
        spec = run.spec(name)
        shape = f" x {values.shape[1]}" if values.ndim > 1 else ""
        columns[name + shape] = "  ".join(
            filter(None, (spec.unit or "-", spec.frame and f"in {spec.frame}", spec.doc))
        )
    figures = [*report.figures[:2], Figure("columns", len(run)), *report.figures[2:]]
    return replace(report, figures=tuple(figures), metadata={**report.metadata, "columns": columns})


def _info_of_net(file: Path) -> Any:
    if file.suffix == ".onnx":
        from magtwin.learn.inference.onnx import report_onnx

        return report_onnx(file)
    from magtwin.learn.models.predictor import load_predictor

    return load_predictor(file).report(str(file))


def _twin(run: "Run", file: Path, scene: Path | None) -> "Twin | None":
    """The scene to show a run in; where it is not there and was not asked for, says so and goes on."""
    from magtwin.twin import led_by, open_twin, scene_of

    try:
        twin = open_twin(scene_of(run, scene, near=file), magnetometer="map-only")  # needs no network
        if "robot" in run.metadata:
            twin = led_by(twin, str(run.metadata["robot"]))
    except InputError as error:
        if scene is not None:
            raise
        _note(f"without a scene: {error}")
        return None
    then = run.metadata.get("scene_sha256")
    if then is not None and then != twin.metadata.get("scene_sha256") and scene != file:
        _note(f"{twin.scene_file}: has changed since the run; it is shown as it is now")
    return twin


def _note(text: str) -> None:
    print(f"  {text}", file=sys.stderr)  # noqa: T201


def _view_run(file: Path, scene: Path | None) -> None:
    import tempfile

    from magtwin.files import existing
    from magtwin.io.formats import read_run
    from magtwin.io.rerun.file import view as view_recording
    from magtwin.io.rerun.file import write_rrd
    from magtwin.io.rerun.viewer import show

    existing(file, "run")
    if file.suffix == ".rrd" and scene is None:
        with silence():
            view_recording(file)
        return
    step("Reading the run")
    run = read_run(file)
    twin = _twin(run, file, scene)
    if twin is None:
        with silence():
            view_recording(file)
        return
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / f"{file.stem}.rrd"
        step("Writing a recording for the viewer")
        write_rrd(run, rrd, twin)
        with silence():
            show(rrd, shown=file)


def _view_together(files: tuple[Path, ...], scene: Path | None, offsets: list[float]) -> None:
    import tempfile

    from magtwin.io.formats import read_run
    from magtwin.io.rerun.file import write_comparison
    from magtwin.io.rerun.viewer import show

    alike = len({file.stem for file in files}) < len(files)
    runs = {str(file) if alike else file.stem: read_run(file) for file in files}
    if len(runs) < len(files):
        raise InputError("one run is named twice; name each once")
    twin = _twin(next(iter(runs.values())), files[0], scene)
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / "runs.rrd"
        write_comparison(runs, rrd, twin, offsets_s=dict(zip(runs, offsets, strict=True)))
        with silence():
            show(rrd, shown=files[0])


def _view_stage(file: Path) -> None:
    import shutil
    import subprocess

    from magtwin.files import existing
    from magtwin.usd.animation import is_animation

    existing(file, "stage")
    if usdview := shutil.which("usdview"):
        with silence():
            result = subprocess.run([usdview, str(file)], check=False)
        if result.returncode:
            raise InputError(f"{file}: usdview ended with status {result.returncode}")
    elif file.suffix != ".usdz" and is_animation(file):
        _view_run(file, file)
    else:
        from magtwin.figures.pictures import show_stage

        with silence():
            show_stage(file)
