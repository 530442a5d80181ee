"""Views: show, picture or film a file of any kind."""

import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from magtwin.errors import InputError, MismatchWarning
from magtwin.files import check_free, existing
from magtwin.io.convert import twin_to_show
from magtwin.io.formats import read_run
from magtwin.run.run import Run
from magtwin.usd.layers import stage_sha256

STAGES = (".usd", ".usda", ".usdc", ".usdz")

Source = str | Path


def view(files: Sequence[Source], *, scene: Source | None = None, offsets_s: Sequence[float] = ()) -> None:
    """Show runs in the Rerun viewer, or a stage in usdview or a window, until it is closed.

    Args:
        files: Runs in any format, on one timeline; or one stage.
        scene: Stage to show runs in. None: the one of the metadata.
        offsets_s: Seconds to add to the times of each of several runs.

    Raises:
        InputError: A file cannot be read, or there is no viewer.
    """
    paths = [Path(file) for file in files]
    if not paths:
        raise InputError("name a run or a stage to view")
    if offsets_s and (len(offsets_s) != len(paths) or len(paths) < 2):
        raise InputError(
            f"`offsets_s` has one value for each of several runs, got {len(offsets_s)} of {len(paths)}",
            parameter="offsets_s",
        )
    if len(paths) > 1:
        _view_together(paths, scene, offsets_s or [0.0] * len(paths))
    elif paths[0].suffix in STAGES and not paths[0].is_dir():
        _view_stage(paths[0])
    else:
        _view_run(paths[0], scene)


def picture(
    file: Source,
    out: Source,
    *,
    camera: str | None = None,
    time_s: float | None = None,
    size: tuple[int, int] = (1600, 1000),
    scene: Source | None = None,
    force: bool = False,
) -> Sequence[str]:
    """Draw a moment of a run in its lab, a stage, or a recording in the Rerun viewer, as a PNG.

    Args:
        file: Run in any format, stage, or recording.
        out: PNG to write.
        camera: "orbit", "top", "chase" or "x,y,z:x,y,z" [m]. None: orbit; a recording uses the Rerun viewer.
        time_s: Moment of a run or recording [s]. None: its end, or where the viewer starts.
        size: Width and height [pixels].
        scene: Scene of a run. None: the one of the metadata.
        force: Whether an existing output is replaced.

    Returns:
        Messages of the Rerun viewer.

    Raises:
        InputError: The file cannot be read or drawn, or the output exists.
    """
    from magtwin.figures.pictures import check_png, picture_of_stage
    from magtwin.figures.scenery import View, picture_of_run

    file, out = existing(file, "run, stage or recording"), check_free(check_png(out), force=force)
    if file.suffix == ".rrd" and camera is None and scene is None:
        from magtwin.io.rerun.viewer import screenshot

        return screenshot(file, out, time_s=time_s, size=size, force=force)
    if file.suffix in STAGES and time_s is None and scene is None:
        if camera == "chase":
            raise InputError(f"{file}: a stage has no run to follow; take another camera", parameter="camera")
        seen = None if camera is None else View.of(camera).camera()
        picture_of_stage(file, out, size=size, camera=seen, force=force)
    else:
        run, stage = _run_and_scene(file, scene)
        picture_of_run(run, stage, out, time_s=time_s, camera=camera or "orbit", size=size, force=force)
    return ()


def film(
    file: Source,
    out: Source,
    *,
    camera: str = "orbit",
    fps: float = 25.0,
    pace: float | None = None,
    size: tuple[int, int] | None = None,
    scene: Source | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Film a run in its lab, or a stage on a turntable.

    Args:
        file: Run in any format; a stage if the camera is "turntable".
        out: MP4 or GIF to write.
        camera: "orbit", "top", "chase", "x,y,z:x,y,z" [m], or "turntable".
        fps: Frames per second [Hz].
        pace: Simulated seconds per second of film. None: 1, or more for a film of at most 30 s.
        size: Width and height [pixels]. None: 1280 x 720, or 640 x 360 for a GIF.
        scene: Scene of the run. None: the one of the metadata.
        force: Whether an existing output is replaced.
        progress: Called with frames done and frames in all.

    Raises:
        InputError: The file cannot be read or drawn, or the output exists.
    """
    from magtwin.figures.films import film_of_run, film_of_stage

    turns = camera == "turntable"
    file, out = existing(file, "stage" if turns else "run"), check_free(out, force=force)
    if turns and (pace is not None or scene is not None):
        raise InputError("a turntable shows a stage as it is: drop `pace` and `scene`")
    if turns:
        film_of_stage(file, out, fps=fps, size=size, force=force, advance=progress)
        return
    run, stage = _run_and_scene(file, scene)
    film_of_run(run, stage, out, fps=fps, speed=pace, camera=camera, size=size, force=force, advance=progress)


def _run_and_scene(file: Path, scene: Source | None) -> tuple[Run, Path]:
    """A run and its scene; warns if the scene has changed since."""
    from magtwin.twin import scene_of

    run = read_run(file)
    stage = scene_of(run, scene, near=file)
    if "scene_sha256" in run.metadata and run.metadata["scene_sha256"] != stage_sha256(stage):
        warnings.warn(
            f"{stage} has changed since the run; it is drawn as it is now", MismatchWarning, stacklevel=3
        )
    return run, stage


def _view_run(file: Path, scene: Source | None) -> None:
    from magtwin.io.rerun.file import view as view_recording
    from magtwin.io.rerun.file import write_rrd
    from magtwin.io.rerun.viewer import show

    existing(file, "run")
    if file.suffix == ".rrd" and scene is None:
        view_recording(file)
        return
    run = read_run(file)
    twin = twin_to_show(run, file, scene)
    if twin is None:
        view_recording(file)
        return
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / f"{file.stem}.rrd"
        write_rrd(run, rrd, twin)
        show(rrd, shown=file)


def _view_together(files: Sequence[Path], scene: Source | None, offsets_s: Sequence[float]) -> None:
    from magtwin.io.rerun.file import write_comparison
    from magtwin.io.rerun.viewer import show

    alike = len({file.stem for file in files}) < len(files)
    runs = {str(file) if alike else file.stem: read_run(file) for file in files}
    if len(runs) < len(files):
        raise InputError("one run is named twice; name each once")
    twin = twin_to_show(next(iter(runs.values())), files[0], scene)
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / "runs.rrd"
        write_comparison(runs, rrd, twin, offsets_s=dict(zip(runs, offsets_s, strict=True)))
        show(rrd, shown=files[0])


def _view_stage(file: Path) -> None:
    from magtwin.usd.animation import is_animation

    existing(file, "stage")
    if usdview := shutil.which("usdview"):
        result = subprocess.run([usdview, str(file)], check=False)
        if result.returncode:
            raise InputError(f"{file}: usdview ended with status {result.returncode}")
    elif file.suffix != ".usdz" and is_animation(file):
        _view_run(file, file)
    else:
        from magtwin.figures.pictures import show_stage

        show_stage(file)
