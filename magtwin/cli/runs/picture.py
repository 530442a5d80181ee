"""`magtwin picture` and `magtwin film`."""

from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Force, RunScene
from magtwin.cli.terminal import Done, announce, note, progress
from magtwin.errors import InputError


@app.command
def picture(
    file: Path,
    *,
    out: Path,
    camera: str | None = None,
    time_s: float | None = None,
    size: str = "1600x1000",
    scene: RunScene = None,
    force: Force = False,
) -> Done:
    """Draw a moment of a run in its lab, a stage, or a Rerun recording as the viewer shows it.

    Things between the camera and the map or the robot are drawn as a veil. Recordings (.rrd) are drawn by the
    viewer without a window, which needs Vulkan (in software, if there is no graphics card). With --camera or
    --scene, the run of a recording is drawn in its lab.

    Parameters
    ----------
    file
        A run in any format that magtwin reads, a stage, or a Rerun recording.
    out
        PNG to write.
    camera
        orbit, from above at a slant; top, straight from above; chase, behind the robot; or x,y,z:x,y,z, the
        camera's position and target [m]. Default: orbit.
    time_s
        Moment of a run or recording [s]. Default: the end of a run; where the viewer starts a recording.
    size
        Width and height in pixels, as WIDTHxHEIGHT.
    """
    from magtwin.figures.views import picture as draw

    pixels = _size(size)
    announce(f"Drawing {file.name}")
    for message in draw(file, out, camera=camera, time_s=time_s, size=pixels, scene=scene, force=force):
        note(f"the viewer reports: {message}")
    return Done(wrote=out)


@app.command
def film(
    file: Path,
    *,
    out: Path,
    camera: str = "orbit",
    fps: float = 25.0,
    pace: float | None = None,
    size: str | None = None,
    scene: RunScene = None,
    force: Force = False,
) -> Done:
    """Film a run in its lab.

    Things between the camera and the map or the robot are drawn as a veil.

    Parameters
    ----------
    file
        A run in any format that magtwin reads.
    out
        MP4 or GIF to write.
    camera
        orbit, slowly around the lab; top, straight from above; chase, behind the robot; or x,y,z:x,y,z, the
        camera's position and target [m].
    fps
        Frames per second [Hz].
    pace
        Simulated seconds per second of film. Default: 1, or more for a film of at most 30 s.
    size
        Width and height in pixels, as WIDTHxHEIGHT. Default: 1280x720, or 640x360 for a GIF.
    """
    from magtwin.figures.views import film as shoot

    pixels = None if size is None else _size(size)
    with progress("Filming", "frames") as advance:
        shoot(
            file,
            out,
            camera=camera,
            fps=fps,
            pace=pace,
            size=pixels,
            scene=scene,
            force=force,
            advance=advance,
        )
    return Done(wrote=out)


def _size(text: str) -> tuple[int, int]:
    """Width and height from WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and len(text) < 20):
        raise InputError(f"--size is WIDTHxHEIGHT in pixels, such as 1280x720; got {text!r}")
    return int(width), int(height)
