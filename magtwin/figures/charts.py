"""Charts: small pictures for pages, of one run or of two laid over each other.

They are drawn narrow, so that their words stay readable on a phone and on paper.
"""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.plots import INK, MAP_INK, draw_path, drawn, new_figure, save, shade
from magtwin.run.compare import FIELDS, POSITIONS, Comparison
from magtwin.run.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

LONGEST_NAME = 28
"""Characters of a run's name that a chart shows."""

POINTS = 1200
"""Points of a line: more cannot be told apart in a picture of this width."""

WIDTH_IN = 5.2

OTHER_INK, MEASURED_INK = "#1971c2", "0.62"


@dataclass(frozen=True)
class Picture:
    """A picture for a page."""

    title: str
    """What it shows, for a caption."""
    alt: str
    """The same in words, for who cannot see it."""
    kind: str
    """"png" or "svg+xml"."""
    data: bytes
    file: str = ""
    """Where it lies, seen from a page of Markdown; "" where that shows no pictures."""

    def aspect(self) -> float:
        """Width over height."""
        if self.kind == "png":
            width, height = (int.from_bytes(self.data[at : at + 4]) for at in (16, 20))
            return width / height
        found = re.search(rb'viewBox="0 0 ([\d.]+) ([\d.]+)"', self.data[:2000])
        assert found is not None  # as matplotlib writes every figure
        return float(found[1]) / float(found[2])


def pictures_of_run(
    run: Run, field: AnomalyMap | None = None, planned: ArrayLike | None = None
) -> list[Picture]:
    """The pictures that a run has the columns for: its path, its field, its errors, its motion, its battery.

    Args:
        run: What happened.
        field: The map below the path; none for a bare floor.
        planned: The path that was to be driven [m], shape (M, 2).
    """
    made = [_path(run, field, planned)]
    for chart in (_field, _errors, _motion, _battery):
        figure = new_figure(WIDTH_IN, 2.5)
        ax = figure.subplots()
        title = chart(run, ax)
        if title:
            _finish(run, ax)
            made.append(Picture(title, f"{title} against time", "svg+xml", drawn(figure, ".svg")))
    return [picture for picture in made if picture is not None]


def plot_comparison(
    a: Run,
    b: Run,
    found: Comparison,
    out: str | os.PathLike[str],
    *,
    names: tuple[str, str] = ("A", "B"),
    force: bool = False,
) -> None:
    """Draw two runs side by side, as their clocks stand and as they were laid over each other.

    Args:
        a: The first run.
        b: The second.
        found: What `compare` found of the two.
        out: PNG or SVG to write.
        names: What to call them.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: `out` is no picture or exists.
    """
    save(_comparison(a, b, found, names), out, force)


def pictures_of_comparison(a: Run, b: Run, found: Comparison, names: tuple[str, str]) -> list[Picture]:
    """Draw the same for a page, one picture per panel."""
    made = []
    for panel in _panels(a, b, found, names):
        figure = new_figure(WIDTH_IN, 2.5 * panel.height)
        panel.draw(figure.subplots())
        made.append(Picture(panel.title, panel.title, "svg+xml", drawn(figure, ".svg")))
    return made


def short_names(names: tuple[str, str]) -> tuple[str, str]:
    """Names of two runs for legends and captions: the middle of a long one is left out, and they differ."""
    a, b = (short_name(name) for name in names)
    return (a, b) if a != b else (f"A: {a}", f"B: {b}")


def short_name(name: str, most: int = LONGEST_NAME) -> str:
    """A name, without its middle where it is long."""
    half = (most - 1) // 2
    return name if len(name) <= most else f"{name[:half]}…{name[-half:]}"


def thinned(t: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """A line of fewer points that looks the same: the least and the greatest value of each stretch.

    Args:
        t: Where the values are, ascending, shape (N,).
        values: The line, shape (N,); what is not finite makes gaps.
        points: About how many to keep.
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


def field_name(*runs: Run) -> str | None:
    """The best column of field that all of some runs have."""
    return next((name for name in FIELDS if all(_has(run, name) for run in runs)), None)


def position_name(*runs: Run) -> str | None:
    """The best column of position that all of some runs have."""
    return next((name for name in POSITIONS if all(_has(run, name) for run in runs)), None)


def _has(run: Run, *names: str) -> bool:
    return all(name in run and np.isfinite(run[name]).any() for name in names)


def _line(ax: "Axes", t: Array, values: Array, **look: Any) -> None:
    ax.plot(*thinned(t, values), **{"lw": 0.9, **look})


def _finish(run: Run, ax: "Axes") -> None:
    ax.margins(x=0)
    ax.tick_params(labelsize=9)
    ax.set_xlabel("time [s]", fontsize=9)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=4, fontsize=9, frameon=False, borderaxespad=0
        )
    if "lidar_on" in run:
        shade(ax, run["t"], run["lidar_on"])


def _path(run: Run, field: AnomalyMap | None, planned: ArrayLike | None) -> Picture | None:
    position, column = position_name(run), field_name(run)
    if position is None or column is None or run.rows < 2:
        return None
    p_xy = run[position][:, :2]
    known = np.isfinite(p_xy).all(axis=1)
    if np.count_nonzero(known) < 2:
        return None
    extent = (
        np.ptp(p_xy[known], axis=0) if field is None else np.ptp(np.reshape(field.extent, (2, 2)), axis=1)
    )
    height = float(np.clip((WIDTH_IN - 0.8) * extent[1] / max(extent[0], 1e-9), 1.5, 6.0))
    figure = new_figure(WIDTH_IN, height + (1.9 if field is not None else 1.2))
    draw_path(figure.subplots(), p_xy[known], run[column][known] / 1000, field, planned)
    figure.set_dpi(160)
    over = "the path" if field is None else f"the path over the map {field.name}"
    return Picture(
        f"Path driven, coloured by {column}",
        f"{over}, coloured by the field along it",
        "png",
        drawn(figure, ".png"),
    )


def _field(run: Run, ax: "Axes") -> str:
    t, shown = run["t"], False
    if _has(run, "b_sd_nt", "b_total_nt"):
        low, high = ((run["b_total_nt"] + k * run["b_sd_nt"]) / 1000 for k in (-2, 2))
        rows = np.unique(np.linspace(0, run.rows - 1, POINTS // 2).astype(int))
        ax.fill_between(t[rows], low[rows], high[rows], color=INK, alpha=0.15, lw=0, label="± 2 sd")
    for name, label, look in (
        ("b_measured_nt", "measured", {"color": MEASURED_INK, "lw": 1.4}),
        ("b_map_nt", "map", {"color": MAP_INK}),
        ("b_total_nt", "total", {"color": INK}),
    ):
        if _has(run, name):
            _line(ax, t, run[name] / 1000, label=label, **look)
            shown = True
    ax.set_ylabel("field [µT]", fontsize=9)
    return "Field" if shown else ""


def _errors(run: Run, ax: "Axes") -> str:
    t, told = run["t"], []
    if _has(run, "b_disturbance_nt"):
        _line(ax, t, run["b_disturbance_nt"], color=MAP_INK, label="disturbance")
        told.append("Disturbance")
    if _has(run, "b_measured_nt", "b_truth_nt"):
        error = run["b_measured_nt"] - run["b_truth_nt"]
        _line(ax, t, error, color=INK, label="error (measured - exact)")
        told.append("error")
    ax.axhline(0, color="0.7", lw=0.6, zorder=0)
    ax.set_ylabel(f"{', '.join(told).lower()} [nT]", fontsize=9)
    return " and ".join(told).capitalize()


def _motion(run: Run, ax: "Axes") -> str:
    shown = False
    for name, label, look in (
        ("v_cmd", "commanded", {"color": MAP_INK}),
        ("v_base", "driven", {"color": INK}),
    ):
        if _has(run, name):
            values = run[name] if run[name].ndim == 1 else run[name][:, 0]
            _line(ax, run["t"], values, label=label, **look)
            shown = True
    ax.set_ylabel("speed [m/s]", fontsize=9)
    return "Forward speed" if shown else ""


def _battery(run: Run, ax: "Axes") -> str:
    if not _has(run, "battery_v"):
        return ""
    _line(ax, run["t"], run["battery_v"], color=INK)
    ax.set_ylabel("battery [V]", fontsize=9)
    shaded = "lidar_on" in run and run["lidar_on"].any()
    return "Battery voltage" + ("; shaded in all charts while the LiDAR is on" if shaded else "")


@dataclass(frozen=True)
class _Panel:
    """A part of a picture of two runs."""

    title: str
    height: float
    draw: Callable[["Axes"], None]


def _panels(a: Run, b: Run, found: Comparison, names: tuple[str, str]) -> list[_Panel]:
    """Field as recorded, field laid over each other, distance between the two, and the two paths."""
    column, position, names = field_name(a, b), position_name(a, b), short_names(names)
    moved = f"{names[1]} moved by {found.shift:+.3f} {found.unit}"
    along = "length driven [m]" if found.align == "path" else "time [s]"
    inks = (INK, OTHER_INK)

    def recorded(ax: "Axes") -> None:
        for run, name, ink in zip((a, b), names, inks, strict=True):
            _line(ax, run["t"] - run["t"][0], run[str(column)] / 1000, color=ink, label=name)
        _label(ax, "time from each run's own start [s]", "field [µT]")

    def aligned(ax: "Axes") -> None:
        for values, name, ink in zip(found.fields[str(column)], names, inks, strict=True):
            _line(ax, found.at, values / 1000, color=ink, label=name)
        _label(ax, along, "field [µT]")

    def apart(ax: "Axes") -> None:
        for values, name, ink in ((found.along_m, "along", MAP_INK), (found.cross_m, "across", INK)):
            _line(ax, found.at, values, color=ink, label=name)
        ax.axhline(0, color="0.7", lw=0.6, zorder=0)
        _label(ax, along, "distance [m]")

    def paths(ax: "Axes") -> None:
        looks: tuple[dict[str, Any], ...] = ({"lw": 2.6, "alpha": 0.45}, {"lw": 1.0})
        for run, name, ink, look in zip((a, b), names, inks, looks, strict=True):
            rows = np.unique(np.linspace(0, run.rows - 1, POINTS).astype(int))
            ax.plot(*run[str(position)][rows, :2].T, label=name, color=ink, **look)
        ax.set_aspect("equal")
        ax.margins(0.05)
        _label(ax, "x [m]", "y [m]")

    panels = []
    if column is not None:
        rms = next((one for one in found.agreements() if one.name == column), None)
        told = "" if rms is None else f": RMS {rms.rms:,.0f} nT"
        if rms is not None and rms.correlation is not None:
            told += f", correlation {rms.correlation:.3f}"
        how = "clocks as they stand" if found.align == "none" else moved
        panels += [_Panel(f"{column} as recorded", 1.0, recorded), _Panel(how + told, 1.0, aligned)]
    if position is not None:
        panels.append(_Panel(f"Distance of {names[1]} from {names[0]}", 1.0, apart))
        panels.append(_Panel("Paths", 1.5, paths))
    return panels


def _comparison(a: Run, b: Run, found: Comparison, names: tuple[str, str]) -> "Figure":
    """All panels, one below the other."""
    panels = _panels(a, b, found, names)
    heights = [panel.height for panel in panels]
    figure = new_figure(9.0, 2.3 * sum(heights))
    axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, panel in zip(axes, panels, strict=True):
        panel.draw(ax)
        ax.set_title(panel.title, fontsize=10, loc="right")
    return figure


def _label(ax: "Axes", x: str, y: str) -> None:
    if ax.get_aspect() == "auto":
        ax.margins(x=0)
    ax.set_xlabel(x, fontsize=9)
    ax.set_ylabel(y, fontsize=9)
    ax.tick_params(labelsize=9)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=1, fontsize=9, frameon=False, borderaxespad=0)
