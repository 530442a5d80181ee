"""`magtwin export`."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import Done, named, step
from magtwin.errors import InputError


@app.command
def export(
    scene: Path,
    *,
    out: Path,
    target: Literal["omniverse", "isaac", "newton", "viewer", "gazebo"] | None = None,
    run: Path | None = None,
    onnx: bool = True,
    thumbnail: bool = True,
    force: Force = False,
) -> Done:
    """Export a stage with everything that it needs, so that other programs open it anywhere.

    Parameters
    ----------
    scene
        A scene or any other stage (.usd, .usda, .usdc, .usdz), or the name of a shipped one: lab.
    out
        What to make: a folder, a package (.usdz), one layer (.usd, .usdc), a .glb for the web, a page that
        shows lab, map and run in a browser (.html), or a world of Gazebo (.sdf).
    target
        Program to export for: omniverse; isaac, with an Action Graph for ROS 2; newton; viewer, one layer for
        simple viewers; or gazebo, the lab without robots. Default: omniverse for folders and packages, gazebo
        for .sdf, else viewer.
    run
        Run in any format that magtwin reads, to play over the stage.
    onnx
        Write networks as ONNX beside their weights, if the extra onnx is installed.
    thumbnail
        Draw a picture of a folder's stage where asset browsers look for one.
    """
    from magtwin.export.package import export_scene
    from magtwin.files.file import existing
    from magtwin.files.kinds import scene_file

    stage = scene_file(scene)
    if out.suffix.lower() == ".html":
        from magtwin.figures.reporting import report_runs, report_scene

        if target is not None:
            raise InputError("a page is for browsers; leave out --target")
        out = named(out, force=force)
        if run is None:
            return Done(wrote=report_scene(stage, out, force=force))
        report_runs([existing(run, "run")], out, scene=stage, force=force)
        return Done(wrote=out)
    out = named(out, beside=("_magtwin",) if out.suffix.lower() == ".usdz" else (), force=force)
    if target == "gazebo" or (target is None and out.suffix.lower() == ".sdf"):
        from magtwin.export.gazebo import export_world

        if run is not None:
            raise InputError("a world of Gazebo plays no run; leave out --run")
        return Done(wrote=export_world(stage, out, force=force))
    animation = None
    if run is not None:
        from magtwin.io.formats import read_run

        animation = read_run(existing(run, "run"))
    how: Any = {"profile": target, "animation": animation, "force": force, "progress": step}
    how["to_onnx"] = _write_onnx if onnx and find_spec("onnx") and find_spec("onnxruntime") else None
    how["thumbnail"] = _draw if thumbnail and target != "viewer" else None
    made = export_scene(stage, out, **how)
    check = ("magtwin", "validate", made.root)
    return Done(made.report(), tuple(made.files), next=() if out.suffix.lower() == ".glb" else (check,))


def _write_onnx(weights: Path, out: Path) -> None:
    from magtwin.learn.inference.onnx import export_onnx

    export_onnx(weights, out)


def _draw(stage: Path, out: Path) -> None:
    from magtwin.figures.pictures import picture_of_stage

    picture_of_stage(stage, out, size=(256, 256), legend=False)  # its numbers would not fit
