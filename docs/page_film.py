"""Film the page of a run: screenshots of Chromium at `#t=`, as a GIF and its middle as a PNG.

python docs/page_film.py PAGE.html docs/page.gif docs/page.png
"""

import io
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

BROWSER = (
    "chromium --headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist --hide-scrollbars --window-size=1280,760 --virtual-time-budget=6000"
)
FRAMES, FRAME_S, WIDTH = 24, 0.3, 800
STILL_S = 45.4
"""Frames of the film, seconds that each is shown, its width [pixel]; time of the PNG in the run [s]."""


def shot(page: Path, t: float) -> bytes:
    """The page at a time [s], as a PNG."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "shot.png"
        where = [f"--user-data-dir={folder}/profile", f"--screenshot={out}", f"{page.as_uri()}#t={t:.2f}"]
        subprocess.run([*BROWSER.split(), *where], check=True, capture_output=True, timeout=300)
        return out.read_bytes()


def palette_of(image: Image.Image) -> Image.Image:
    """256 colours of an image: its usual ones, and as many that span all of them, as a map's do."""
    kinds = (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([v for kind in kinds for v in (image.quantize(128, kind).getpalette() or [])[:384]])
    return palette


def main(page: Path, film: Path, still: Path) -> None:
    """Write film and still."""
    end = float(re.search(r"<dt>duration</dt><dd>([\d,.]+) s", page.read_text("utf-8"))[1].replace(",", ""))  # type: ignore[index]
    still.write_bytes(shot(page, STILL_S))
    frames = []
    for k in range(FRAMES):
        image = Image.open(io.BytesIO(shot(page, end * k / (FRAMES - 1)))).convert("RGB")
        image = image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS)
        frames.append(image)
    palette = palette_of(frames[-1])  # one for all: what stands still keeps its colours
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    shown = [int(1000 * FRAME_S)] * (FRAMES - 1) + [2000]
    drawn[0].save(film, save_all=True, append_images=drawn[1:], duration=shown, loop=0, optimize=True)


if __name__ == "__main__":
    main(*(Path(name).resolve() for name in sys.argv[1:4]))
