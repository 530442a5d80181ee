"""Canvas: empty figures, the style that all of them share, and their bytes as PNG or SVG.

A figure is drawn without pyplot and without a window system. The same input gives the same bytes.
"""

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, StrMethodFormatter
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.figures.style import LIDAR, styled
from magtwin.files.outputs import output
from magtwin.report.summary import printable_lines
from magtwin.run.thinning import newest, stretches

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg")
DPI, PAGE_DPI = 110, 200

WIDTH_IN = 4.4
"""Width of a picture on a page [inch]: narrow, so that its text stays readable on a phone and on paper."""

POINTS = 1200
"""Points of a line. More cannot be told apart in a picture of that width."""

SEGMENTS = 3000
"""Segments of a coloured line. More cannot be told apart."""

SHORT_NAME = 18
"""Characters of names of which two stand side by side on a page."""

LONGEST_NAME = 28
"""Characters of a name in a legend or caption."""


@dataclass(frozen=True)
class Picture:
    """A picture for a page."""

    title: str
    """Caption."""

    alt: str
    """Text for readers who cannot see the picture."""

    kind: str
    """"png" or "svg"."""

    data: bytes

    aspect: float
    """Width divided by height."""

    file: str = ""
    """Name of its file beside a page, without the suffix. Default: picture_0 and so on."""


@styled
def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on its own canvas."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def picture(figure: Figure, title: str, *, alt: str = "", file: str = "", kind: str = "svg") -> Picture:
    """A figure as a picture for a page. Default of `alt`: the title."""
    figure.set_dpi(PAGE_DPI)
    width, height = figure.get_size_inches()
    data = render(figure, f".{kind}")
    return Picture(title, alt or title, kind, data if kind == "svg" else small(data), width / height, file)


@dataclass(frozen=True)
class Chart:
    """A drawing on axes of its own: alone on a page, or one of several in a figure."""

    title: str
    draw: Callable[[Axes], None]
    height_in: float = 2.7
    """Height on a page [inch]."""

    file: str = ""
    """Name of its file beside a page, without the suffix."""

    @styled
    def picture(self) -> Picture:
        """The chart alone, with its title as the caption."""
        figure = new_figure(WIDTH_IN, self.height_in)
        self.draw(figure.subplots())
        return picture(figure, self.title, file=self.file)


def small(png: bytes) -> bytes:
    """A PNG of a drawing in 256 colours: a third of its size."""
    from PIL import Image

    out = io.BytesIO()
    drawn = Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    drawn.save(out, "PNG", optimize=True)
    return out.getvalue()


def save(figure: Figure, out: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a figure as PNG or SVG, whichever its file name ends in.

    Raises:
        InputError: The name has another ending, or the file exists and `force` was not given.
    """
    suffix = Path(out).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{out}: a picture ends in {' or '.join(SUFFIXES)}")
    data = render(figure, suffix)
    with output(out, force=force) as path:
        path.write_bytes(data)


@styled
def render(figure: Figure, suffix: str) -> bytes:
    """A figure as the bytes of a .png or .svg file, without date and version."""
    file = io.BytesIO()
    plain_text(figure)
    if suffix == ".png":
        FigureCanvasAgg(figure).print_png(file, metadata={"Software": None})
    else:
        FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None, "Creator": None})
    return file.getvalue()


def plain_text(figure: Figure) -> None:
    """Turn off formulas, and escape control characters: names come from files, and no SVG may hold these."""
    for text in figure.findobj(Text):
        shown = text.get_text()  # type: ignore[attr-defined]
        if (plain := printable_lines(shown)) != shown:
            text.set_text(plain)  # type: ignore[attr-defined]
        text.set_parse_math(False)  # type: ignore[attr-defined]


def label(ax: Axes, x: str = "", y: str = "", *, title: str = "") -> None:
    """Axis labels with units, and a title at the left; thousands of nT are told apart by commas."""
    for axis, text in ((ax.xaxis, x), (ax.yaxis, y)):
        if text:
            axis.set_label_text(text)
        if "[nT" in text:
            axis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
    if title:
        ax.set_title(title)


def legend_above(ax: Axes, columns: int = 4, **options: Any) -> None:
    """A legend above the axes, if any line has a name; on a page in as many columns as its names allow."""
    names = [str(entry) for entry in options.get("labels", ax.get_legend_handles_labels()[1])]
    if ax.figure.bbox.width < (WIDTH_IN + 0.1) * ax.figure.dpi:
        columns = 2 if max(map(len, names), default=0) <= SHORT_NAME else 1
    if options or names:
        ax.legend(ncols=columns, loc="lower left", bbox_to_anchor=(0, 1), **options)


def colour_bar(figure: Any, drawn: ScalarMappable, axes: Any, title: str, **options: Any) -> None:
    """A colour bar with a title, to the right or, with `below`, under the axes."""
    flat = {"orientation": "horizontal", "aspect": 36, "ticks": MaxNLocator(4)}
    below = flat if options.pop("below", False) else {}
    bar = figure.colorbar(drawn, ax=axes, **{"shrink": 0.9, "pad": 0.02, **below, **options})
    bar.outline.set_visible(False)
    label(bar.ax, **({"x": title} if below else {"y": title}))


def evenly(size: int, count: int) -> NDArray[np.intp]:
    """At most `count` evenly spaced indices into `size` rows, with the first and the last."""
    return np.unique(np.linspace(0, size - 1, count).astype(np.intp))


def draw_line(ax: Axes, t: Array, values: Array, **look: Any) -> None:
    """Draw a line, thinned to what can be seen."""
    ax.plot(*thinned(t, values), **look)


def coloured_line(
    ax: Axes, points: Array, values: Array, limits: tuple[float, float], colours: str, width: float
) -> LineCollection:
    """Draw a line through finite points (N, 2) coloured by the values (N,) at them, of a width in points.

    Segments beside an unknown value are left out. `limits` are the values at the ends of the colour scale.
    """
    rows = newest(evenly(len(points), SEGMENTS + 1), np.isfinite(values))
    points, values = points[rows], values[rows]
    middle = np.ma.masked_invalid((values[:-1] + values[1:]) / 2)
    look: dict[str, Any] = {"lw": width, "capstyle": "round", "zorder": 3, "rasterized": True}
    segments = list(np.stack([points[:-1], points[1:]], axis=1))
    line = LineCollection(segments, array=middle, cmap=colours, clim=limits, **look)
    ax.add_collection(line)
    return line


def shade(ax: Axes, t: Array, on: NDArray[np.bool_], *, colour: str = LIDAR, name: str = "_") -> None:
    """Shade the spans of time in which a flag is set, the first of them with a name for the legend."""
    for k, (first, last) in enumerate(stretches(on)):
        end = t[min(last, len(t) - 1)]
        ax.axvspan(t[first], end, color=colour, lw=0, zorder=-1, label="_" if k else name)


def thinned(t: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """A line (N,) of about as many points that looks the same: the least and greatest of each stretch."""
    size = max(1, 2 * len(t) // points)
    if size == 1:
        return t, values
    whole = len(t) // size * size
    if not np.isfinite(values).any():
        return t[:1], values[:1]
    stretches = values[:whole].reshape(-1, size)
    rows = np.arange(0, whole, size)
    low = rows + np.argmin(np.where(np.isfinite(stretches), stretches, np.inf), axis=1)
    high = rows + np.argmax(np.where(np.isfinite(stretches), stretches, -np.inf), axis=1)
    kept = np.unique(np.concatenate([[0], low, high, [len(t) - 1]]))
    return t[kept], values[kept]


def short_name(name: str, most: int = LONGEST_NAME) -> str:
    """A name of at most `most` characters; a long one loses its middle."""
    half = (most - 1) // 2
    return name if len(name) <= most else f"{name[:half]}…{name[-half:]}"
