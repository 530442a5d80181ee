"""`magtwin plot`."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, RunScene, headings_rad, reads_recordings
from magtwin.cli.terminal import Done, named, note, progress
from magtwin.errors import InputError

MANY, FASTER = 100, "faster with --size 640x360, --fps 10 or a higher --pace"
"""Frames of a film above which it takes minutes without a graphics card, and what is said then."""


@app.command
@reads_recordings
def plot(
    *files: Annotated[Path, Parameter(required=True)],
    out: Path | None = None,
    show: Literal["charts", "picture", "field", "gradient", "variance", "mask", "headings"] | None = None,
    at_s: Annotated[float | None, Parameter(name="--at")] = None,
    camera: str | None = None,
    scene: RunScene = None,
    headings_deg: str | None = None,
    size: str | None = None,
    pace: float | None = None,
    fps: float | None = None,
    force: Force = False,
) -> Done:
    """Draw a run, a stage, a map or a recording as a picture or a film; or compare two runs or two maps.

    A run is drawn as charts; at a moment, or from a camera, in its lab; to a film, as it drives. Things
    between the camera and the map or the robot are drawn as a veil. A recording (.rrd) is drawn as the Rerun
    viewer shows it, which needs Vulkan (in software, if there is no graphics card).

    Parameters
    ----------
    files
        A run in any format that magtwin reads, a stage, a map (layer, or folder of survey CSVs), or the name
        of a scene that ships with magtwin: lab. Two runs or two maps are compared.
    out
        Picture (.png, .jpg; .svg of charts and maps), page (.html of maps) or film (.mp4, .gif) to write.
        Default: a .png named after the file.
    show
        Of a run: charts, or a picture of its end. Of a map, or a stage's map, by heading: the field, its
        gradient along the floor, its standard deviation (variance), the masked nodes (mask), or each heading
        minus the mean of all (headings). Default of a map: the mean, the heading's effect, the standard
        deviation and the gradient.
    at_s
        Moment of a run or recording to draw [s].
    camera
        orbit, from above at a slant; top, straight from above; chase, behind the robot; or x,y,z:x,y,z, the
        camera's position and target [m]. Default: orbit.
    headings_deg
        Headings of a map to draw [deg], such as 0,90,180,270. Default: the map's, or four of more than eight.
    size
        Width and height in pixels, as WIDTHxHEIGHT. Default: 1600x1000; 1280x720 of a film, 640x360 of a GIF.
    pace
        Simulated seconds per second of film. Default: 1, or more for a film of at most 30 s.
    fps
        Frames per second of a film [Hz]. Default: 25.
    """
    from magtwin.figures.drawing import draw

    out = named(out or Path(f"{files[0].stem}.png"), force=force)
    options: dict[str, Any] = {"at_s": at_s, "camera": camera, "scene": scene, "pace": pace, "fps": fps}
    options |= {"headings": headings_deg and headings_rad(headings_deg), "size": size and _size(size)}
    with progress(f"Drawing {files[0].name}", "frames") as advance:

        def drawn(done: int, total: int) -> None:
            advance(done, total, FASTER if total > MANY else "")

        file, messages = draw(files, out, show=show, force=force, advance=drawn, **options)
    for message in messages:
        note(f"the viewer reports: {message}")
    return Done(wrote=file)


def _size(text: str) -> tuple[int, int]:
    """Width and height from WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and len(text) < 20):
        raise InputError(f"--size is WIDTHxHEIGHT in pixels, such as 1280x720; got {text!r}")
    return int(width), int(height)
