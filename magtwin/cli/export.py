"""`magtwin export`: a stage with all that it needs, for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, announcer, print_report, say
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.run.run import Run


@app.command
def export(
    scene: Path,
    *,
    out: Path,
    profile: Literal["omniverse", "isaac", "newton", "viewer"] | None = None,
    run: Path | None = None,
    convert_units: bool = False,
    onnx: bool = True,
    thumbnail: bool = True,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a stage with all that it needs, so that other programs open it wherever it lies.

    Parameters
    ----------
    scene
        A scene, or any other stage: .usd, .usda, .usdc or .usdz; or the name of one that ships with
        magtwin: lab.
    out
        What to make: a folder, a package .usdz, a single layer .usd or .usdc, or a .glb for the web.
    profile
        For whom: omniverse; isaac, with an Action Graph for ROS 2; newton; or viewer, one layer that simple
        viewers show. omniverse for folders and packages, viewer for the others, unless given.
    run
        A run, in any format that magtwin reads, to play over the stage.
    convert_units
        Convert a stage that is not in metres with Z up; it is refused otherwise.
    onnx
        Write networks as ONNX too, beside their weights, where the extra onnx is installed.
    thumbnail
        Draw a picture of a folder's stage where asset browsers look for one.
    force
        Replace what exists.
    json
        Print the summary as JSON.
    """
    from magtwin.export.package import export_scene
    from magtwin.files import check_free

    check_free(out, force=force)
    played = None if run is None else _read(run)
    made = export_scene(
        _stage(scene),
        out,
        profile=profile,
        animation=played,
        to_onnx=_write_onnx if onnx and _has_onnx() else None,
        thumbnail=_draw if thumbnail and profile != "viewer" else None,
        convert_units=convert_units,
        force=force,
        progress=announcer(quiet=json),
    )
    print_report(made.report(), json)
    if not json:
        say(f"Wrote {', '.join(map(str, made.files))}")


def _stage(scene: Path) -> Path:
    """A stage's file, or that of one that ships with magtwin."""
    if scene.suffix == ".toml":
        raise InputError(
            f"{scene}: says what a stage is to be; make it with `magtwin scene {scene} --out DIR`"
        )
    if scene.suffix or scene.exists():
        return scene
    from magtwin.errors import find
    from magtwin.files import shipped

    return find(
        "scene",
        str(scene),
        {
            file.stem: file
            for file in sorted(shipped("scenes").glob("*/*.usda"))
            if file.stem == file.parent.name
        },
    )


def _read(run: Path) -> "Run":
    from magtwin.files import existing
    from magtwin.io.formats import read_run

    return read_run(existing(run, "run"))


def _write_onnx(weights: Path, out: Path) -> None:
    from magtwin.learn.inference.onnx import export_onnx

    export_onnx(weights, out)


def _has_onnx() -> bool:
    """Whether the extra is installed that networks are written as ONNX with."""
    from importlib.util import find_spec

    return bool(find_spec("onnx") and find_spec("onnxruntime"))


def _draw(stage: Path, out: Path) -> None:
    from magtwin.figures.pictures import picture_of_stage

    picture_of_stage(stage, out, size=(256, 256), legend=False)  # whose numbers would not fit
