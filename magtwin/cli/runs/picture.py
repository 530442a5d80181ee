"""`magtwin picture` and `magtwin film`: a run, a stage or a recording, to look at."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import announce, progress, say, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.run.run import Run

STAGES = (".usd", ".usda", ".usdc", ".usdz")


@app.command
def picture(
    file: Path,
    *,
    out: Path,
    camera: str | None = None,
    at: Annotated[float | None, Parameter(name="--time")] = None,
    size: str = "1600x1000",
    scene: Path | None = None,
    force: Force = False,
) -> None:
    """Draw a moment of a run in its lab, a stage as it stands, or a recording as the Rerun viewer shows it.

    In pictures of a lab, what stands between the camera and the map or the robot is drawn as a veil.
    Recordings (.rrd) are drawn by the viewer, without a window; it needs Vulkan, in software if there is no
    graphics card. With --camera or --scene, the run in a recording is drawn in its lab.

    Parameters
    ----------
    file
        A run, in any format that magtwin reads; a stage; or a Rerun recording.
    out
        PNG to write.
    camera
        orbit, from above at a slant; top, straight from above; chase, from behind the robot; or
        x,y,z:x,y,z, the camera's place and its target in metres. Default: orbit.
    at
        Moment of a run or recording [s]. Default: the end of a run; where the viewer starts in a recording.
    size
        Width and height in pixels.
    scene
        The scene of a run. Default: where the run's metadata has it.
    force
        Replace what exists.
    """
    from magtwin.figures.pictures import check_png
    from magtwin.files import check_free, existing

    existing(file, "run, stage or recording")
    check_free(check_png(out), force=force)
    pixels, steps = _size(size), announce
    if file.suffix == ".rrd" and camera is None and scene is None:
        from magtwin.io.rerun.viewer import screenshot

        steps("Drawing the recording in the Rerun viewer")
        for complaint in screenshot(file, out, time_s=at, size=pixels, force=force):
            print(f"  the viewer reports: {complaint}", file=sys.stderr)  # noqa: T201
    elif file.suffix in STAGES and at is None and scene is None:
        from magtwin.figures.pictures import picture_of_stage
        from magtwin.figures.scenery import View

        if camera == "chase":
            raise InputError(f"{file}: a stage as it stands has nothing to follow; take another camera")
        steps("Drawing the stage")
        seen = None if camera is None else View.of(camera).camera()
        picture_of_stage(file, out, size=pixels, camera=seen, force=force)
    else:
        from magtwin.figures.scenery import picture_of_run

        run, stage = _run_and_scene(file, scene)
        steps("Drawing the run")
        picture_of_run(run, stage, out, time_s=at, camera=camera or "orbit", size=pixels, force=force)
    say(f"Wrote {out}")


@app.command
def film(
    file: Path,
    *,
    out: Path,
    camera: str = "orbit",
    fps: float = 25.0,
    speed: float | None = None,
    size: str | None = None,
    scene: Path | None = None,
    force: Force = False,
) -> None:
    """Draw a run in its lab as a film, or a stage on a turntable.

    What stands between the camera and the map or the robot is drawn as a veil.

    Parameters
    ----------
    file
        A run, in any format that magtwin reads; or, for a turntable, a stage.
    out
        MP4 or GIF to write.
    camera
        orbit, slowly round the lab; top, straight from above; chase, from behind the robot; x,y,z:x,y,z, the
        camera's place and its target in metres; or turntable, once round a stage as it stands, in 10 s.
    fps
        Frames per second.
    speed
        Playback speed, relative to the run. Default: 1, or more for a film of at most 30 s.
    size
        Width and height in pixels. Default: 1280x720, or 640x360 for a GIF.
    scene
        The scene of the run. Default: where the run's metadata has it.
    force
        Replace what exists.
    """
    from magtwin.figures.films import film_of_run, film_of_stage
    from magtwin.files import check_free, existing

    existing(file, "stage" if camera == "turntable" else "run")
    check_free(out, force=force)
    pixels = None if size is None else _size(size)
    turned = camera == "turntable"
    if turned and (speed is not None or scene is not None):
        raise InputError("a turntable shows a stage as it stands: it takes no --speed and no --scene")
    run, stage = (None, file) if turned else _run_and_scene(file, scene)
    with progress("Filming", "frames") as advance:

        def told(k: int, n: int) -> None:
            advance(k, n)

        if run is None:
            film_of_stage(stage, out, fps=fps, size=pixels, force=force, advance=told)
        else:
            film_of_run(
                run,
                stage,
                out,
                fps=fps,
                speed=speed,
                camera=camera,
                size=pixels,
                force=force,
                advance=told,
            )
    say(f"Wrote {out}")


def _run_and_scene(file: Path, scene: Path | None) -> "tuple[Run, Path]":
    """A run and the stage that it happened in; says so where that has changed since."""
    from magtwin.io.formats import read_run
    from magtwin.twin import scene_of
    from magtwin.usd.layers import stage_sha256

    step("Reading the run")
    run = read_run(file)
    stage = scene_of(run, scene, near=file)
    if "scene_sha256" in run.metadata and run.metadata["scene_sha256"] != stage_sha256(stage):
        print(f"  {stage} has changed since the run; it is drawn as it is now", file=sys.stderr)  # noqa: T201
    return run, stage


def _size(text: str) -> tuple[int, int]:
    """Width and height from WxH."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and len(text) < 20):
        raise InputError(f"size is WIDTHxHEIGHT in pixels, such as 1280x720; got {text!r}")
    return int(width), int(height)
