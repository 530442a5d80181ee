"""Canvas: empty figures, the style that all of them share, and their bytes as PNG or SVG.

A figure is drawn without pyplot and without a window system. The same input gives the same bytes.
"""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.outputs import output
from magtwin.report.summary import printable_lines
from magtwin.run.thinning import newest

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg")
DPI, PAGE_DPI = 110, 160

WIDTH_IN = 5.2
"""Width of a picture on a page [inch]: narrow, so that its text stays readable on a phone and on paper."""

POINTS = 1200
"""Points of a line. More cannot be told apart in a picture of that width."""

SEGMENTS = 3000
"""Segments of a coloured line. More cannot be told apart."""

LONGEST_NAME = 28
"""Characters of a name in a legend or caption."""

INK, MAP_INK, OTHER_INK, MEASURED_INK = "#1f2430", "#e08214", "#1971c2", "0.62"
LIDAR_INK, PLAN_INK = "#d9e6f2", "#d6336c"


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


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on its own canvas."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")


def picture(figure: Figure, title: str, *, alt: str = "", file: str = "", kind: str = "svg") -> Picture:
    """A figure as a picture for a page. Default of `alt`: the title."""
    figure.set_dpi(PAGE_DPI)
    width, height = figure.get_size_inches()
    return Picture(title, alt or title, kind, render(figure, f".{kind}"), width / height, file)


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


def render(figure: Figure, suffix: str) -> bytes:
    """A figure as the bytes of a .png or .svg file, without date and version."""
    file = io.BytesIO()
    plain_text(figure)
    if suffix == ".png":
        FigureCanvasAgg(figure).print_png(file, metadata={"Software": None})
    else:  # a fixed salt for the names of its parts; text stays text
        with rc_context({"svg.hashsalt": "magtwin", "svg.fonttype": "none"}):
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
    """Axis labels with units, and a title at the left, in the shared text size."""
    ax.tick_params(labelsize=9)
    if x:
        ax.set_xlabel(x, fontsize=9)
    if y:
        ax.set_ylabel(y, fontsize=9)
    if title:
        ax.set_title(title, fontsize=9, loc="left")


def open_frame(ax: Axes) -> None:
    """Remove the upper and the right edge of the frame."""
    ax.spines[["top", "right"]].set_visible(False)


def legend_above(ax: Axes, columns: int = 1) -> None:
    """A legend above the axes, if any line has a name."""
    if ax.get_legend_handles_labels()[0]:
        place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0}
        ax.legend(ncols=columns, fontsize=9, frameon=False, **place)


def legend_below(figure: Figure, *entries: Any) -> None:
    """A legend in two columns below the whole figure."""
    figure.legend(*entries, loc="outside lower center", ncols=2, fontsize=9, frameon=False)


def colour_bar(figure: Any, drawn: ScalarMappable, axes: Any, title: str, **options: Any) -> None:
    """A colour bar with a title; `options` are those of `Figure.colorbar`."""
    bar = figure.colorbar(drawn, ax=axes, **{"shrink": 0.9, "pad": 0.02, **options})
    bar.set_label(title, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def evenly(size: int, count: int) -> NDArray[np.intp]:
    """At most `count` evenly spaced indices into `size` rows, with the first and the last."""
    return np.unique(np.linspace(0, size - 1, count).astype(np.intp))


def draw_line(ax: Axes, t: Array, values: Array, **look: Any) -> None:
    """Draw a line, thinned to what can be seen."""
    ax.plot(*thinned(t, values), **{"lw": 0.9, **look})


def coloured_line(
    ax: Axes, points: Array, values: Array, limits: tuple[float, float], colours: str, width: float
) -> LineCollection:
    """Draw a line coloured by the values at its points; segments beside an unknown value are left out.

    Args:
        ax: Where to draw.
        points: Shape (N, 2), finite.
        values: Shape (N,).
        limits: Values at the ends of the colour scale.
        colours: Name of the colour scale.
        width: Width of the line [points].
    """
    rows = newest(evenly(len(points), SEGMENTS + 1), np.isfinite(values))
    points, values = points[rows], values[rows]
    line = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        array=np.ma.masked_invalid((values[:-1] + values[1:]) / 2),
        cmap=colours,
        clim=limits,
        lw=width,
        capstyle="round",
        zorder=3,
    )
    ax.add_collection(line)
    return line


def shade(ax: Axes, t: Array, on: NDArray[np.bool_]) -> None:
    """Shade the spans of time in which a flag is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    for first, last in edges.reshape(-1, 2):
        ax.axvspan(t[first], t[min(last, len(t) - 1)], color=LIDAR_INK, lw=0, zorder=-1)


def thinned(t: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """A line of fewer points that looks the same: the least and the greatest value of each stretch.

    Args:
        t: Ascending positions of the values, shape (N,).
        values: Shape (N,); values that are not finite make gaps.
        points: Approximate number of points to keep.
    """
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


def short_pair(names: tuple[str, str]) -> tuple[str, str]:
    """Short names of two runs, which always differ."""
    a, b = (short_name(name) for name in names)
    return (a, b) if a != b else (f"A: {a}", f"B: {b}")
