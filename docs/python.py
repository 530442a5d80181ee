"""Run the blocks of python.md and draw its pictures: `python docs/python.py`.

With the name of a file, the blocks are written there and not run: for `make typed`.
"""

import os
import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
BLOCK = re.compile(
    r"^(?:```python\n(?P<code>.*?)^```$|!\[.*?\]\(python/(?P<picture>\w+)\.png\)$)", re.M | re.S
)
COLOURS = 256
"""Colours of a picture, which then has about 40 kB."""


def steps(page: str) -> list[tuple[str, str]]:
    """Code and names of pictures of the page, in order: ("code", ...) and ("picture", ...)."""
    return [
        next((kind, text) for kind, text in found.groupdict().items() if text)
        for found in BLOCK.finditer(page)
    ]


def files(page: str, folder: Path) -> None:
    """Write the files that the page shows."""
    for name, text in re.findall(r"<summary>(\S+)</summary>\n\n```xml\n(.*?)```", page, re.S):
        (folder / name).write_text(text, encoding="utf-8")


def draw(namespace: dict[str, Any], name: str, out: Path) -> None:
    """Draw the room, the run or the runs of the code above a picture."""
    from PIL import Image

    if name == "ell":
        figure = namespace["drive"].plot(scene=namespace["ell"])
    elif name == "a_hundred_variants":
        figure = namespace["runs"][99].plot(scene=namespace["variants"][99])
    else:
        figure = namespace["room"].plot()
    figure.savefig(out, dpi=72)
    with Image.open(out) as image:
        image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(out, optimize=True)


def main() -> None:
    """Run every block in a temporary folder, and draw the pictures."""
    page = (HERE / "python.md").read_text(encoding="utf-8")
    if sys.argv[1:]:
        code = "\n\n".join(text for kind, text in steps(page) if kind == "code")
        Path(sys.argv[1]).write_text(code, encoding="utf-8")
        return
    (HERE / "python").mkdir(exist_ok=True)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        files(page, Path(folder))
        for kind, text in steps(page):
            if kind == "code":
                exec(compile(text, "docs/python.md", "exec"), namespace)
            else:
                draw(namespace, text, HERE / "python" / f"{text}.png")
        os.chdir(HERE)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(main())
