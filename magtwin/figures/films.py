"""Films: a run in its lab as an MP4 or a GIF, drawn off screen."""

import math
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.figures.scenery import Scenery, View
from magtwin.files.children import end, environment
from magtwin.files.outputs import check_free, output
from magtwin.run.run import Run

Image = NDArray[np.uint8]

SUFFIXES = (".mp4", ".gif")
SIZES = {".mp4": (1280, 720), ".gif": (640, 360)}
"""Default width and height [pixel]."""

LONGEST_S = 30.0
"""Length of a film by default: a longer run is shown faster [s]."""

MOST_FRAMES = {".mp4": 100_000, ".gif": 2_000}
"""Frames of a film. Those of a GIF are held in memory until it is written."""

MOST_FPS = {".mp4": 120.0, ".gif": 50.0}
"""Frame rates. GIF counts in hundredths of a second, and viewers slow down frames shorter than two."""

LEAST_FPS = 0.01
"""Lowest frame rate. GIF stores the duration of a frame in 16 bits."""


def film_of_run(
    run: Run,
    scene_file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    fps: float = 25.0,
    speed: float | None = None,
    camera: str = "orbit",
    size: tuple[int, int] | None = None,
    force: bool = False,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Draw a run as a film.

    Default of `speed` relative to the run: 1, or more for a film of at most 30 s; of `size`: `SIZES`.
    `camera` is as for `View.of`; `advance` is called with the number of frames drawn, and their total.

    Raises:
        InputError: As for `magtwin.figures.scenery.Scenery`; an option is out of range; `out` is not a film,
            exists, or cannot be written.
    """
    out, view = Path(out), View.of(camera)
    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{out}: films end in {' or '.join(SUFFIXES)}")
    check_free(out, force=force)
    size = size or SIZES[suffix]
    if suffix == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise InputError(f"an MP4's width and height must be even, got {size[0]} x {size[1]}")
    if fps > MOST_FPS[suffix]:
        kind = suffix[1:].upper()
        raise InputError(f"fps must be at most {MOST_FPS[suffix]:g} in a {kind}, got {fps:g}")
    if 0 < fps < LEAST_FPS:
        raise InputError(f"fps must be at least {LEAST_FPS:g}, got {fps:g}")
    times, speed = frame_times(run, fps, speed, MOST_FRAMES[suffix])
    with Scenery(run, scene_file, times, view=view, size=size, speed=speed) as scenery:

        def frames() -> Generator[Image, None, None]:
            for k in range(len(times)):
                yield scenery.frame(k)
                advance(k + 1, len(times))

        with output(out, force=force) as aside, closing(frames()) as images:
            if suffix == ".gif":
                _write_gif(images, aside, fps, out)
            else:
                _write_mp4(images, aside, size, fps, out)
    return out


def frame_times(
    run: Run, fps: float, speed: float | None, most: int = MOST_FRAMES[".mp4"]
) -> tuple[NDArray[np.float64], float]:
    """Times of a film's frames on the run's clock [s], and the playback speed.

    Raises:
        InputError: The run has fewer than two readings, or an option is out of range.
    """
    if run.rows < 2 or "t" not in run:
        raise InputError(f"the run has {run.rows} readings; two or more are needed to show it")
    for name, value, flag in (("fps", fps, "fps"), ("speed", speed, "pace")):
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"{name} must be above 0 and finite, got {value:g}", parameter=flag)
    if speed is None:
        speed = max(1.0, run.duration_s / LONGEST_S)
    wanted = run.duration_s * fps / speed
    if not wanted < most:
        count = f"{wanted:,.0f}" if wanted < 1e15 else f"{wanted:.3g}"
        text = f"the film would have {count} frames, and {most:,} are the most; raise the speed"
        raise InputError(text, parameter="pace")
    times = run["t"][0] + np.arange(int(wanted + 1e-9) + 1) * (speed / fps)
    return np.minimum(times, run["t"][-1]), speed


def _write_mp4(frames: Iterator[Image], aside: Path, size: tuple[int, int], fps: float, out: Path) -> None:
    """Frames as H.264 that every browser plays, without date and encoder version."""
    with tempfile.TemporaryFile() as log, _ffmpeg(aside, size, fps, log) as process:
        assert process.stdin is not None
        try:
            for image in frames:
                process.stdin.write(image.tobytes())
            process.stdin.close()
        except OSError as error:  # the encoder ended before the frames did
            process.wait()
            raise InputError(_unwritten(out, _last_line(log) or error.strerror or "")) from error
        if process.wait():
            raise InputError(_unwritten(out, _last_line(log)))


def _unwritten(out: Path, reason: str) -> str:
    """What is said of a film that the encoder could not write; it may not tell that the disk is full."""
    known = "No space left" in reason
    return f"{out}: cannot be written: {reason.rstrip('.')}{'' if known else '; is the disk full?'}"


@contextmanager
def _ffmpeg(
    aside: Path, size: tuple[int, int], fps: float, log: IO[bytes]
) -> "Iterator[subprocess.Popen[bytes]]":
    """The encoder of imageio-ffmpeg, which reads frames from its stdin; ended with the block."""
    import imageio_ffmpeg

    source = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps:g} -i -"
    video = "-an -c:v libx264 -preset veryfast -crf 21 -pix_fmt yuv420p -movflags +faststart"
    exact = "-map_metadata -1 -fflags +bitexact -flags:v +bitexact"
    options = f"-nostdin -v error -y {source} {video} {exact}".split()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *options, str(aside)]
    streams: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": log}
    process = subprocess.Popen(command, env=environment(os.devnull), **streams)
    try:
        yield process
    finally:
        process.kill()
        end(process)


def _last_line(log: IO[bytes]) -> str:
    log.seek(0)
    lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return re.sub(r"^\[[^]]*] ", "", lines[-1]) if lines else ""  # without the component's name


def _write_gif(frames: Iterator[Image], aside: Path, fps: float, out: Path) -> None:
    """Frames in the palette of the first one, with durations rounded so that errors do not add up."""
    from PIL import Image as Pillow

    palette: Any = None
    pictures, ends = [], []
    for k, image in enumerate(frames):
        picture = Pillow.fromarray(np.ascontiguousarray(image))
        if palette is None:
            palette = picture.quantize(256, method=Pillow.Quantize.MEDIANCUT)
        pictures.append(picture.quantize(palette=palette, dither=Pillow.Dither.NONE))
        ends.append(10 * round(100 * (k + 1) / fps))
    options: dict[str, Any] = {"append_images": pictures[1:], "duration": np.diff([0, *ends]).tolist()}
    try:
        pictures[0].save(aside, format="gif", save_all=True, loop=0, optimize=False, **options)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
