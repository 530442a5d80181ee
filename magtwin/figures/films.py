"""Films: a run in its lab, or a stage on a turntable, as an MP4 or a GIF, frame by frame off screen."""

import math
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.figures.pictures import turntable
from magtwin.figures.scenery import Scenery, View
from magtwin.files import check_free, output
from magtwin.run.run import Run

Image = NDArray[np.uint8]

SUFFIXES = (".mp4", ".gif")
SIZES = {".mp4": (1280, 720), ".gif": (640, 360)}
"""Width and height unless told otherwise [pixel]."""

LONGEST_S = 30.0
"""A run longer than this is shown faster, so that the film is no longer, unless a speed is given [s]."""

TURN_S = 10.0
"""Time that a turntable takes to go round once [s]."""

MOST_FRAMES = 100_000
MOST_GIF_FRAMES = 2_000
"""Frames of a GIF, all of which are held until it is written."""

MOST_FPS = 120.0
MOST_GIF_FPS = 50.0
"""GIF counts in hundredths of a second, and viewers slow down what is shorter than two."""


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

    Args:
        run: What happened.
        scene_file: The stage that it happened in.
        out: MP4 (H.264) or GIF to write.
        fps: Frames a second.
        speed: How many times faster it is shown than it happened; as it happened unless given, and what lasts
            longer than 30 s in 30 s.
        camera: "orbit", "top", "chase" or "x,y,z:x,y,z", as for `magtwin.figures.scenery.View.of`.
        size: Width and height [pixel]; 1280 x 720, of a GIF 640 x 360, unless given.
        force: Whether a file that is there is replaced.
        advance: Called after each frame with how many are done, and of how many.

    Raises:
        InputError: As for `magtwin.figures.scenery.Scenery`; an option is out of range; `out` is no film, is
            there already or cannot be written.
    """
    out, view = Path(out), View.of(camera)
    size = _checked(out, size, fps, force=force)
    times, speed = frame_times(run, fps, speed, _most_frames(out))

    with Scenery(run, scene_file, times, view=view, size=size, speed=speed) as scenery:

        def frames() -> Generator[Image, None, None]:
            for k in range(len(times)):
                yield scenery.frame(k)
                advance(k + 1, len(times))

        return _write(frames(), out, size, fps, force=force)


def film_of_stage(
    stage_file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    fps: float = 25.0,
    size: tuple[int, int] | None = None,
    force: bool = False,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Draw a stage as it stands, on a turntable: once round in `TURN_S`, so that the film can be repeated.

    Args:
        stage_file: The stage.
        out: MP4 (H.264) or GIF to write.
        fps: Frames a second.
        size: Width and height [pixel]; as for `film_of_run` unless given.
        force: Whether a file that is there is replaced.
        advance: Called after each frame with how many are done, and of how many.

    Raises:
        InputError: As for `magtwin.figures.pictures.picture_of_stage`; an option is out of range; `out` is no
            film, is there already or cannot be written.
    """
    out = Path(out)
    size = _checked(out, size, fps, force=force)
    count = max(1, round(TURN_S * fps))

    def frames() -> Generator[Image, None, None]:
        for k, image in enumerate(turntable(stage_file, count, size=size)):
            yield image
            advance(k + 1, count)

    return _write(frames(), out, size, fps, force=force)


def _checked(out: Path, size: tuple[int, int] | None, fps: float, *, force: bool) -> tuple[int, int]:
    """The size of a film, once it, its rate and its name are not refused."""
    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{out}: films end in {' or '.join(SUFFIXES)}")
    check_free(out, force=force)
    size = size or SIZES[suffix]
    if suffix == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise InputError(f"an MP4's width and height must be even, got {size[0]} x {size[1]}")
    most = MOST_GIF_FPS if suffix == ".gif" else MOST_FPS
    if not 0 < fps < math.inf:
        raise InputError(f"fps must be above 0 and finite, got {fps:g}")
    if fps > most:
        raise InputError(f"fps must be at most {most:g} in a {suffix[1:].upper()}, got {fps:g}")
    return size


def _most_frames(out: Path) -> int:
    return MOST_GIF_FRAMES if out.suffix.lower() == ".gif" else MOST_FRAMES


def _write(
    frames: Generator[Image, None, None], out: Path, size: tuple[int, int], fps: float, *, force: bool
) -> Path:
    """Frames as what the film's name ends in."""
    with output(out, force=force) as aside, closing(frames):
        if out.suffix.lower() == ".gif":
            _write_gif(frames, aside, fps, out)
        else:
            _write_mp4(frames, aside, size, fps, out)
    return out


def frame_times(
    run: Run, fps: float, speed: float | None, most: int = MOST_FRAMES
) -> tuple[NDArray[np.float64], float]:
    """When the frames of a film are, on the run's clock [s], and how many times faster it is shown.

    Raises:
        InputError: The run has too few readings, or an option is out of range.
    """
    if run.rows < 2 or "t" not in run:
        raise InputError(f"the run has {run.rows} readings; two or more are needed to show it")
    for name, value in (("fps", fps), ("speed", speed)):
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"{name} must be above 0 and finite, got {value:g}")
    if speed is None:
        speed = max(1.0, run.duration_s / LONGEST_S)
    count = int(run.duration_s * fps / speed + 1e-9) + 1
    if count > most:
        raise InputError(f"the film would have {count:,} frames, and {most:,} are the most; raise the speed")
    times = run["t"][0] + np.arange(count) * (speed / fps)
    return np.minimum(times, run["t"][-1]), speed


def _write_mp4(frames: Iterator[Image], aside: Path, size: tuple[int, int], fps: float, out: Path) -> None:
    """Frames as H.264 that every browser plays, without a word of when and by what it was made."""
    with tempfile.TemporaryFile() as said, _ffmpeg(aside, size, fps, said) as process:
        assert process.stdin is not None
        try:
            for image in frames:
                process.stdin.write(image.tobytes())
            process.stdin.close()
        except OSError as error:  # it ended before the frames did
            process.wait()
            raise InputError(f"{out}: cannot be written: {_last_line(said) or error.strerror}") from error
        if process.wait():
            raise InputError(f"{out}: cannot be written: {_last_line(said)}")


@contextmanager
def _ffmpeg(
    aside: Path, size: tuple[int, int], fps: float, said: IO[bytes]
) -> "Iterator[subprocess.Popen[bytes]]":
    """The encoder that comes with imageio-ffmpeg, fed by its stdin; ended with the block."""
    import imageio_ffmpeg

    options: dict[str, Any] = {
        "-f": "rawvideo",
        "-pix_fmt": "rgb24",
        "-s": f"{size[0]}x{size[1]}",
        "-r": f"{fps:g}",
    }
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-y"]
    command += [word for option in options.items() for word in option]
    command += [
        "-i",
        "-",
        "-an",
        "-c:v",
        "libx264",
        "-preset",
        "veryfast",
        "-crf",
        "21",
        "-pix_fmt",
        "yuv420p",
    ]
    command += ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    command += ["-movflags", "+faststart", str(aside)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdin is not None:
            with suppress(OSError):
                process.stdin.close()


def _last_line(said: IO[bytes]) -> str:
    said.seek(0)
    lines = [line.strip() for line in said.read().decode(errors="replace").splitlines() if line.strip()]
    return re.sub(r"^\[[^]]*] ", "", lines[-1]) if lines else ""  # the part of ffmpeg that speaks


def _write_gif(frames: Iterator[Image], aside: Path, fps: float, out: Path) -> None:
    """Frames in the colours of the first, each shown for hundredths of a second that add up."""
    from PIL import Image as Pillow

    palette: Any = None
    made, ends = [], []
    for k, image in enumerate(frames):
        picture = Pillow.fromarray(np.ascontiguousarray(image))
        if palette is None:
            palette = picture.quantize(256, method=Pillow.Quantize.MEDIANCUT)
        made.append(picture.quantize(palette=palette, dither=Pillow.Dither.NONE))
        ends.append(10 * round(100 * (k + 1) / fps))
    durations = np.diff([0, *ends]).tolist()
    try:
        made[0].save(
            aside,
            format="gif",
            save_all=True,
            append_images=made[1:],
            duration=durations,
            loop=0,
            optimize=False,
        )
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
