"""Comparisons: two runs laid over each other, and one path driven twice as in Figure 8 of the paper."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes

from magtwin.figures.canvas import (
    INK,
    MAP_INK,
    OTHER_INK,
    POINTS,
    WIDTH_IN,
    Picture,
    draw_line,
    evenly,
    label,
    legend_above,
    new_figure,
    picture,
    save,
    short_names,
)
from magtwin.figures.page import Section, Table
from magtwin.figures.runs import field_name, position_name
from magtwin.run.compare import Agreement, Comparison, Traversals
from magtwin.run.run import Metadata, Run

ALIGNED = {
    "recorded": "by time from each start",
    "timed": "by time, clocks aligned",
    "placed": "by distance driven",
}
"""How two traversals of a path are aligned."""

MEASURES = ("mean", "RMS", "MAE", "maximum")
"""Figures of an `Agreement`, as `measures` gives them."""


def measures(agreement: Agreement) -> tuple[float, float, float, float]:
    """Mean, RMS, mean absolute and greatest difference."""
    return agreement.mean, agreement.rms, agreement.mae, agreement.greatest


def correlation_text(agreement: Agreement) -> str:
    """Correlation to four digits; "" if there is none."""
    return "" if agreement.correlation is None else f"{agreement.correlation:.4f}"


def plot_comparison(
    a: Run,
    b: Run,
    comparison: Comparison,
    out: str | os.PathLike[str],
    *,
    names: tuple[str, str] = ("A", "B"),
    force: bool = False,
) -> None:
    """Draw two runs by their own clocks, and aligned.

    Args:
        a: The first run.
        b: The second run.
        comparison: Result of `magtwin.run.compare.compare` for the two.
        out: PNG or SVG to write.
        names: Names of the two runs in the picture.
        force: Whether to replace an existing file.

    Raises:
        InputError: `out` is not a picture or exists.
    """
    panels = _panels(a, b, comparison, names)
    heights = [panel.height for panel in panels]
    figure = new_figure(9.0, 2.3 * sum(heights))
    axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, panel in zip(axes, panels, strict=True):
        panel.draw(ax)
        ax.set_title(panel.title, fontsize=10, loc="right")
    save(figure, out, force)


def pictures_of_comparison(a: Run, b: Run, comparison: Comparison, names: tuple[str, str]) -> list[Picture]:
    """The panels of `plot_comparison` as pictures for a page."""
    pictures = []
    for panel in _panels(a, b, comparison, names):
        figure = new_figure(WIDTH_IN, 2.5 * panel.height)
        panel.draw(figure.subplots())
        pictures.append(picture(figure, panel.title))
    return pictures


def section_of_traversals(both: Traversals, names: tuple[str, str]) -> Section:
    """A section of a report: one path driven twice, with and without alignment.

    Args:
        both: Result of `magtwin.run.compare.traversals`.
        names: Names of the two runs.
    """
    runs = [f"{name}: {_driven(run.metadata)}" for name, run in zip(names, (both.a, both.b), strict=True)]
    rows = tuple(
        (text, row.name, row.unit, *measures(row), correlation_text(row))
        for key, text in ALIGNED.items()
        for row in getattr(both, key).agreements()
    )
    head = ("aligned", "quantity", "unit", *MEASURES, "correlation")
    note = f"{names[1]} minus {names[0]}. Along-track: ahead of the first run; cross-track: to its left."
    title = "One path, driven twice"
    drawing = _traversals_picture(both, names)
    pictures = () if drawing is None else (drawing,)
    return Section(title, "; ".join(runs) + ".", pictures, (Table(title, head, rows, note),))


@dataclass(frozen=True)
class _Panel:
    title: str
    height: float
    draw: Callable[[Axes], None]


def _panels(a: Run, b: Run, comparison: Comparison, names: tuple[str, str]) -> list[_Panel]:
    """Field as recorded, field aligned, distance between the two, and both paths."""
    column, position, names = field_name(a, b), position_name(a, b), short_names(names)
    along = "distance driven [m]" if comparison.align == "path" else "time [s]"
    lines = tuple(zip((a, b), names, (INK, OTHER_INK), strict=True))

    def recorded(ax: Axes) -> None:
        for run, name, ink in lines:
            draw_line(ax, run["t"] - run["t"][0], run[str(column)] / 1000, color=ink, label=name)
        _finish(ax, "time from the start of each run [s]", "field [µT]")

    def aligned(ax: Axes) -> None:
        for values, (_, name, ink) in zip(comparison.fields[str(column)], lines, strict=True):
            draw_line(ax, comparison.at, values / 1000, color=ink, label=name)
        _finish(ax, along, "field [µT]")

    def paths(ax: Axes) -> None:
        looks: tuple[dict[str, Any], ...] = ({"lw": 2.6, "alpha": 0.45}, {"lw": 1.0})
        for (run, name, ink), look in zip(lines, looks, strict=True):
            rows = evenly(run.rows, POINTS)
            ax.plot(*run[str(position)][rows, :2].T, label=name, color=ink, **look)
        ax.set_aspect("equal")
        ax.margins(0.05)
        label(ax, "x [m]", "y [m]")
        legend_above(ax)

    panels = []
    if column is not None:
        match = next((row for row in comparison.agreements() if row.name == column), None)
        title = f"{names[1]} moved by {comparison.shift:+.3f} {comparison.unit}"
        if comparison.align == "none":
            title = "clocks unchanged"
        if match is not None:
            title += f": RMS {match.rms:,.0f} nT"
            title += "" if match.correlation is None else f", correlation {match.correlation:.3f}"
        panels += [_Panel(f"{column} as recorded", 1.0, recorded), _Panel(title, 1.0, aligned)]
    if position is not None:
        title = f"Distance of {names[1]} from {names[0]}"
        panels.append(_Panel(title, 1.0, lambda ax: _draw_distance(ax, comparison, along)))
        panels.append(_Panel("Paths", 1.5, paths))
    return panels


def _draw_distance(ax: Axes, comparison: Comparison, along: str) -> None:
    for values, name, ink in (
        (comparison.along_m, "along-track", MAP_INK),
        (comparison.cross_m, "cross-track", INK),
    ):
        draw_line(ax, comparison.at, values, color=ink, label=name)
    ax.axhline(0, color="0.7", lw=0.6, zorder=0)
    _finish(ax, along, "distance [m]")


def _finish(ax: Axes, x: str, y: str) -> None:
    ax.margins(x=0)
    label(ax, x, y)
    legend_above(ax)


def _driven(metadata: Metadata) -> str:
    """How a run was driven, by its metadata."""
    path, engine = metadata.get("path", "a custom path"), metadata.get("engine", "kinematic")
    seed = f"seed {metadata['seed']}" if "seed" in metadata else "recorded"
    return f"{path}, engine {engine}, {seed}"


def _traversals_picture(both: Traversals, names: tuple[str, str]) -> Picture | None:
    column, position = field_name(both.a, both.b), position_name(both.a, both.b)
    if column is None or position is None:
        return None
    figure = new_figure(WIDTH_IN, 8.6)
    axes = figure.subplots(4, 1, height_ratios=[1.0, 1.0, 1.0, 0.8])
    for ax, (key, text) in zip(axes, ALIGNED.items(), strict=False):
        comparison: Comparison = getattr(both, key)
        for values, name, ink, width in zip(
            comparison.fields[column], names, (INK, OTHER_INK), (1.6, 0.9), strict=True
        ):
            draw_line(ax, comparison.at, values / 1000, color=ink, lw=width, label=name)
        match = next(row for row in comparison.agreements() if row.name == column)
        shift = f" ({comparison.shift:+.3f} {comparison.unit})" if key != "recorded" else ""
        alike = "" if match.correlation is None else f", corr. {match.correlation:.3f}"
        x = "distance driven [m]" if comparison.align == "path" else "time [s]"
        label(ax, x, "field [µT]", title=f"{text}{shift}: MAE {match.mae:,.0f} nT{alike}")
        ax.margins(x=0)
    axes[0].legend(fontsize=9, loc="best", framealpha=0.85)
    _draw_distance(axes[3], both.recorded, "time [s]")
    axes[3].set_title("distance between the two, by time from each start", fontsize=9, loc="right")
    title = f"Figure 8: {column} of one path, driven twice, with and without alignment"
    return picture(figure, title, file="figure_8")
