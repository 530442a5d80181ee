"""Runs: the path over the map and the readings against time, as one figure; or the path alone, for a page."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.figures.canvas import (
    INK,
    MAP_INK,
    MEASURED_INK,
    PLAN_INK,
    POINTS,
    WIDTH_IN,
    Array,
    Picture,
    colour_bar,
    coloured_line,
    draw_line,
    evenly,
    label,
    legend_above,
    new_figure,
    picture,
    shade,
)
from magtwin.figures.maps import draw_cells, mean_field_ut
from magtwin.run import mapped
from magtwin.run.compare import FIELDS, POSITIONS
from magtwin.run.figures import prediction_nt
from magtwin.run.run import Run
from magtwin.run.summary import swept

MOST_OTHER = 4
"""Columns drawn of a run that has none of the usual ones."""


def draw_run(run: Run, field: AnomalyMap | None = None, planned: ArrayLike | None = None) -> Figure:
    """Draw a run: the path over the map, and field, disturbance, speed and battery against time.

    Args:
        run: The run. Columns that it lacks are left out; of a run with none of them, its first four columns
            of numbers are drawn.
        field: The map below the path, as the mean over its headings. None draws a bare floor.
        planned: The planned path in world [m], shape (M, 2). None leaves it out.

    Returns:
        A matplotlib figure.

    Raises:
        InputError: The run has no rows, no clock, or no column of numbers.
    """
    if not run.rows:
        raise InputError("the run has no rows to draw")
    if run.rows > mapped.LONG:
        run = run.take(np.arange(0, run.rows, -(-run.rows // mapped.BLOCK)))  # more than a picture shows
        mapped.release()
    place, panels = position_name(run), panels_of(run)
    both = place is not None and bool(panels)
    figure = new_figure(13.5 if both else 8.0, 7.0 if len(panels) > 2 or not both else 5.5)
    sides = figure.subfigures(1, 1 + both, squeeze=False, width_ratios=(1.15, 1)[: 1 + both])[0]
    if place is not None:
        known = np.isfinite(run[place][:, :2]).all(axis=1)
        if not known.any():
            raise InputError(f"no position is known in {place!r} of the run")
        total = "b_total_nt" if "b_total_nt" in run else field_name(run)
        values = run[total][known] / 1000 if total else np.full(np.count_nonzero(known), np.nan)
        ax = sides[0].subplots()
        ax.set_title(_title(run, run[place][known, :2]), fontsize=11)
        draw_path(ax, run[place][known, :2], values, field, planned)
    else:
        sides[0].suptitle(_title(run), fontsize=11)
    if panels:
        heights = [panel.height for panel in panels]
        axes = sides[-1].subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for ax, panel in zip(axes, panels, strict=True):
            panel.draw(ax, run)
        sides[-1].align_ylabels(axes)
        shaded = "; shaded while the LiDAR is on" if "lidar_on" in run else ""
        label(axes[-1], f"time [s]{shaded}")
    elif place is None:
        raise InputError("the run has neither positions nor columns of numbers to draw")
    return figure


@dataclass(frozen=True)
class Panel:
    """One graph of a run against time."""

    title: str
    label: str
    """Name and unit of the quantity."""

    curves: tuple[tuple[str, Array, dict[str, Any]], ...]
    """Name, values and style of each curve."""

    height: float = 1.0
    band: tuple[Array, Array] | None = None
    """Lower and upper edge of a shaded band: two standard deviations."""

    about_zero: bool = False
    """Whether to draw a line at zero."""

    def draw(self, ax: Axes, run: Run) -> None:
        """Draw the curves, with a legend if there are several; shade the time while the LiDAR is on."""
        t = run["t"]
        if self.band is not None:
            rows = evenly(run.rows, POINTS // 2)
            low, high = (edge[rows] for edge in self.band)
            ax.fill_between(t[rows], low, high, color=INK, alpha=0.15, lw=0, label="± 2 sd")
        for name, values, look in self.curves:
            draw_line(ax, t, values, label=name, **look)
        if self.about_zero:
            ax.axhline(0, color="0.7", lw=0.6, zorder=0)
        if len(self.curves) > 1 or self.band is not None:
            legend_above(ax, 4)
        ax.margins(x=0)
        label(ax, y=self.label)
        if "lidar_on" in run:
            shade(ax, t, run["lidar_on"])


def panels_of(run: Run) -> list[Panel]:
    """The graphs that a run has columns for; of a run with none of the usual ones, its first columns."""
    panels = []
    style: dict[str, dict[str, Any]] = {
        "b_measured_nt": {"color": MEASURED_INK, "lw": 1.4},
        "b_map_nt": {"color": MAP_INK},
        "b_total_nt": {"color": INK},
    }
    names = [name for name in style if _has(run, name)]
    other = field_name(run)
    names = names or ([other] if other else [])
    if names:
        curves: tuple[tuple[str, Array, dict[str, Any]], ...] = tuple(
            (name.removeprefix("b_").removesuffix("_nt"), run[name] / 1000, style.get(name, {"color": INK}))
            for name in names
        )
        band = None
        if _has(run, "b_sd_nt", "b_total_nt"):
            low, high = ((prediction_nt(run) + k * run["b_sd_nt"]) / 1000 for k in (-2, 2))
            band = low, high
        text = "field\n[µT]" if len(curves) > 1 else f"{curves[0][0]} field\n[µT]"
        panels.append(Panel("Field", text, curves, 2.0, band))
    curves = ()
    if _has(run, "b_disturbance_nt"):
        curves += (("disturbance", run["b_disturbance_nt"], {"color": MAP_INK}),)
    if _has(run, "b_measured_nt", "b_truth_nt"):
        error = run["b_measured_nt"] - run["b_truth_nt"]
        curves += (("error (measured - exact)", error, {"color": INK}),)
    if curves:
        words = [name.partition(" ")[0] for name, _, _ in curves]
        title = " and ".join(words).capitalize()
        panels.append(Panel(title, f"{', '.join(words)}\n[nT]", curves, 2.0, about_zero=True))
    speeds = {"v_cmd": ("commanded", MAP_INK), "v_base": ("driven", INK)}
    if not _has(run, "v_base"):
        speeds["odom_v"] = ("odometry", INK)
    curves = tuple(
        (name, run[key] if run[key].ndim == 1 else run[key][:, 0], {"color": ink})
        for key, (name, ink) in speeds.items()
        if _has(run, key)
    )
    if curves:
        panels.append(Panel("Forward speed", "speed\n[m/s]", curves))
    if _has(run, "battery_v"):
        shaded = "lidar_on" in run and run["lidar_on"].any()
        title = "Battery voltage" + ("; shaded in all charts while the LiDAR is on" if shaded else "")
        panels.append(Panel(title, "battery\n[V]", (("battery", run["battery_v"], {"color": INK}),)))
    if panels or position_name(run) is not None:
        return panels
    others = [name for name, values in run.items() if values.ndim == 1 and values.dtype.kind in "fiub"]
    return [
        Panel(name, f"{name}\n[{run.spec(name).unit or '-'}]", ((name, run[name], {"color": INK}),))
        for name in [name for name in others if name != "t"][:MOST_OTHER]
    ]


def draw_path(
    ax: Axes, p_xy: Array, total_ut: Array, field: AnomalyMap | None, planned: ArrayLike | None
) -> None:
    """Draw a path over the map, coloured by the field along it.

    Args:
        ax: Where to draw.
        p_xy: Path in world [m], shape (N, 2).
        total_ut: Field along it [µT], shape (N,).
        field: The map below it, or None.
        planned: The planned path in world [m], shape (M, 2), or None.
    """
    flat = {"orientation": "horizontal", "aspect": 40}
    if field is not None:
        known = mean_field_ut(field)
        paper = LinearSegmentedColormap.from_list("paper", ["white", "0.4"])  # lighter than the path
        low, high = colour_limits(known)
        mesh = draw_cells(ax, field.x_m, field.y_m, known, paper, vmin=low, vmax=high)
        colour_bar(ax.figure, mesh, ax, "map, mean over headings [µT]", **flat)
    for ink, width in ((INK, 5.4), ("white", 4.5)):  # one of the two edges differs from the map
        ax.plot(*p_xy[evenly(len(p_xy), 3000)].T, color=ink, lw=width, solid_capstyle="round")
    line = coloured_line(ax, p_xy, total_ut, colour_limits(total_ut, 0), "viridis", 3)
    if planned is not None:
        plan = np.asarray(planned, float)[:, :2]
        ax.plot(*plan.T, color=PLAN_INK, lw=0.8, ls=(0, (4, 3)), zorder=4, label="planned")
    ax.plot(*p_xy[0], marker="o", ms=7, mfc="white", mec=INK, ls="", zorder=5, label="start")
    colour_bar(ax.figure, line, ax, "total field along the path [µT]", **flat)
    ax.set_aspect("equal")
    label(ax, "x [m]", "y [m]")
    ax.legend(loc="upper right", fontsize=8, framealpha=0.85)


def field_name(*runs: Run) -> str | None:
    """The best field column that all of the runs have."""
    return next((name for name in FIELDS if all(_has(run, name) for run in runs)), None)


def position_name(*runs: Run) -> str | None:
    """The best position column that all of the runs have."""
    return next((name for name in POSITIONS if all(_has(run, name) for run in runs)), None)


def _has(run: Run, *names: str) -> bool:
    return all(name in run and np.isfinite(run[name]).any() for name in names)


def path_picture(run: Run, field: AnomalyMap | None, planned: ArrayLike | None) -> Picture | None:
    """The path of a run over its map, or over a bare floor; None if its places or readings are unknown.

    Args:
        run: The run.
        field: The map below the path, or None.
        planned: The planned path in world [m], shape (M, 2), or None.
    """
    position, column = position_name(run), field_name(run)
    if position is None or column is None:
        return None
    known = np.isfinite(run[position][:, :2]).all(axis=1)
    if np.count_nonzero(known) < 2:
        return None
    p_xy = run[position][known, :2]
    wide, tall = np.ptp(p_xy, axis=0) if field is None else np.ptp(np.reshape(field.extent, (2, 2)), axis=1)
    height = float(np.clip((WIDTH_IN - 0.8) * tall / max(wide, 1e-9), 1.5, 6.0))
    figure = new_figure(WIDTH_IN, height + (1.9 if field is not None else 1.2))
    draw_path(figure.subplots(), p_xy, run[column][known] / 1000, field, planned)
    over = "the path" if field is None else f"the path over the map {field.name}"
    alt = f"{over}, coloured by the field along it"
    return picture(figure, f"Path driven, coloured by {column}", alt=alt, kind="png")


def _title(run: Run, p_xy: Array | None = None) -> str:
    """Scene, path and network of a run, and its size."""
    names = [str(run.metadata[key]) for key in ("scene", "path", "network") if run.metadata.get(key)]
    size = [f"{run.rows:,} readings", f"{run.duration_s:.1f} s"]
    if p_xy is not None:
        size.append(f"{np.linalg.norm(np.diff(p_xy, axis=0), axis=1).sum():.1f} m")
    floor = swept(run.metadata).partition(",")[0]
    return f"{', '.join(names) or 'run'}\n{', '.join(size)}{floor and chr(10) + floor}"
