"""Localization: the estimated path over the map, its errors against time beside the bound, and its page."""

import math
import os
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures import canvas
from magtwin.figures.maps import draw_mean
from magtwin.figures.page import Page, to_html
from magtwin.figures.reports import page_of_report
from magtwin.figures.style import BOUND, DATA, INK, LOST, MODEL, PAPER, styled
from magtwin.files.outputs import output
from magtwin.frames import quat_from_yaw, wrap_angle
from magtwin.io.rerun.localization import write_localization
from magtwin.tasks.localizing import Localization, truth_name

DEAD_LOOK: dict[str, Any] = {"color": DATA, "ls": (0, (4, 2))}
BOUND_LOOK: dict[str, Any] = {"color": BOUND, "ls": (0, (1.5, 1.2))}
RIM = [withStroke(linewidth=3.2, foreground=PAPER)]  # of a line over a map
BAND_LOOK: dict[str, Any] = {"color": MODEL, "alpha": 0.22, "lw": 0}

ELLIPSE_S = 5.0
"""Least time between ellipses [s]."""

MOST_ELLIPSES = 40

WIDE = 30.0
"""Ratio of the largest error to the median from which the axis is logarithmic."""

WIDTH_IN = 10.0

TITLE_WIDTH = 105
"""Most characters of a line of the title."""


@styled
def draw_localization(result: Localization) -> Figure:
    """Draw a localization: paths over the map, and errors against time with the bound.

    The ellipses hold 2 standard deviations along each of their axes (86 % of the poses, if the covariance is
    right) and are drawn every 5 s at most. The band of the position error is twice the root of the
    estimate's variances along x and y. The bound is the least standard deviation that any unbiased method
    can have with this map, see `magtwin.localization.bounds`.

    Without a true pose, the errors are left out and the standard deviations are drawn alone.

    Raises:
        InputError: There is no estimate.
    """
    if not len(result.track.t):
        raise InputError("the run has no readings to draw")
    field = _map_of(result)
    x0, x1, y0, y1 = _extent(result, field)
    tall = float(np.clip((WIDTH_IN - 2.2) * (y1 - y0) / (x1 - x0), 2.5, 7.0))
    figure = canvas.new_figure(WIDTH_IN, tall + 5.7)
    figure.set_layout_engine("constrained", h_pad=0.1)
    grid = GridSpec(3, 1, figure, height_ratios=[tall + 0.5, 2.3, 1.4])
    top, position, heading = (figure.add_subplot(grid[k]) for k in range(3))
    _draw_floor(top, result, field)
    top.set(xlim=(x0, x1), ylim=(y0, y1))
    _draw_position(position, result)
    _draw_heading(heading, result)
    heading.sharex(position)
    canvas.label(heading, "time [s]")
    position.tick_params(labelbottom=False)
    figure.suptitle(_title(result), x=0.01, ha="left")
    return figure


def page_of_localization(result: Localization) -> Page:
    """A localization as a page: the verdict, its figures, the path and the errors."""
    field = _map_of(result)
    x0, x1, y0, y1 = _extent(result, field)
    tall = float(np.clip((canvas.WIDTH_IN - 0.8) * (y1 - y0) / (x1 - x0), 1.5, 6.0))

    def floor(ax: Axes) -> None:
        _draw_floor(ax, result, field)
        ax.set(xlim=(x0, x1), ylim=(y0, y1))

    def timed(draw: Callable[[Axes, Localization], None], ax: Axes) -> None:
        draw(ax, result)
        canvas.label(ax, "time [s]")

    position, heading = partial(timed, _draw_position), partial(timed, _draw_heading)
    charts = (
        canvas.Chart("The estimated path over the map", floor, tall + 2.0, "path"),
        canvas.Chart("Error of the position, and the bound of any method", position, 3.4, "position"),
        canvas.Chart("Error of the heading, and its bound", heading, 2.6, "heading"),
    )
    lead = _title(result).partition("\n")[0]
    return page_of_report(result.report(), "Localization", f"{lead}.", charts)


def _map_of(result: Localization) -> AnomalyMap | None:
    belief = result.problem.belief
    return belief if isinstance(belief, AnomalyMap) else None


def _extent(result: Localization, field: AnomalyMap | None) -> tuple[float, float, float, float]:
    """The map, and what of the paths lies beside it."""
    parts = [result.track.pose[:, :2]]
    if result.truth is not None:
        parts.append(result.truth[:, :2])
    if field is not None:
        parts = [np.reshape(field.extent, (2, 2)).T]
    p = np.concatenate(parts)
    low, high = np.nanmin(p, axis=0), np.nanmax(p, axis=0)
    room = 0.0 if field is not None else 0.05 * float(max(*(high - low), 0.5))
    return float(low[0] - room), float(high[0] + room), float(low[1] - room), float(high[1] + room)


def _draw_floor(ax: Axes, result: Localization, field: AnomalyMap | None) -> None:
    t, pose = result.track.t, result.track.pose
    if field is not None:
        draw_mean(ax, field)
    entries: list[Line2D | Patch] = []

    def path(p: canvas.Array, name: str, **look: Any) -> None:
        entries.extend(ax.plot(*p[canvas.evenly(len(p), 3000), :2].T, label=name, path_effects=RIM, **look))

    if result.dead_reckoning is not None:
        path(result.dead_reckoning.pose, _dead_name(result), zorder=3, **DEAD_LOOK)
    if result.truth is not None:
        name = "true path" if truth_name(result.run) == "true pose" else "motion capture"
        path(result.truth, name, color=INK, lw=2.0, zorder=4)
    trusted = np.where(result.track.lost[:, None], np.nan, pose)
    path(trusted, "estimate", color=MODEL, lw=1.6, zorder=5)
    ticks = np.arange(t[0], t[-1] + 1e-9, max(ELLIPSE_S, (t[-1] - t[0]) / MOST_ELLIPSES))
    rows = np.unique(np.searchsorted(t, ticks))
    rows = rows[~result.track.lost[rows]]
    rows = rows[np.isfinite(result.track.covariance[rows]).all(axis=(1, 2))]
    if len(rows):
        lines = [ellipse(pose[k, :2], result.track.covariance[k, :2, :2]) for k in rows]
        ax.add_collection(LineCollection(lines, colors=MODEL, lw=1.0, zorder=6))
        entries.append(Line2D([], [], color=MODEL, lw=1.0, marker="o", mfc="none", ms=9, ls=""))
        entries[-1].set_label("its 2-sigma ellipse")
    start = result.truth if result.truth is not None else pose
    square: dict[str, Any] = {"marker": "s", "ms": 7, "mfc": PAPER, "mec": INK, "ls": "", "zorder": 7}
    entries.extend(ax.plot(*start[0, :2], label="start", **square))
    ax.set_aspect("equal")
    canvas.label(ax, "x [m]", "y [m]")
    canvas.legend_above(ax, 6, handles=entries)


def ellipse(p_xy: canvas.Array, covariance: canvas.Array, sigmas: float = 2.0) -> canvas.Array:
    """Points of the ellipse of a covariance [m^2], shape (2, 2), about p_xy [m]; shape (49, 2)."""
    values, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 49)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(p_xy + sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ axes.T)


def _draw_position(ax: Axes, result: Localization) -> None:
    t, track = result.track.t, result.track
    sd = 2 * np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
    error = dead = None
    if result.truth is not None:
        error = np.hypot(*(track.pose - result.truth)[:, :2].T)
        if result.dead_reckoning is not None:
            dead = np.hypot(*(result.dead_reckoning.pose - result.truth)[:, :2].T)
    ends = [values for values in (error, sd) if values is not None and np.isfinite(values).any()]
    most = max((float(np.nanmax(values)) for values in ends), default=1.0)
    middle = min((float(np.nanmedian(values)) for values in ends), default=1.0)
    log = most > WIDE * max(middle, 1e-6)
    floor = max(middle / 20, 1e-4) if log else 0.0
    if np.isfinite(sd).any():
        ax.fill_between(t, floor, np.maximum(sd, floor), label="2 sigma", **BAND_LOOK)
    if dead is not None:
        canvas.draw_line(ax, t, dead, label=_dead_name(result), **DEAD_LOOK)
    if error is not None:
        canvas.draw_line(ax, t, error, color=MODEL, label="estimate")
    if result.bounds is not None:
        canvas.draw_line(ax, t, result.bounds.correlated, lw=1.8, label="bound, 1 sigma", **BOUND_LOOK)
    canvas.shade(ax, t, track.lost, colour=LOST, name="flagged lost")
    most = max(most, float(np.nanmax(dead)) if dead is not None else 0.0)
    if log:
        ax.set_yscale("log")
        ax.set_ylim(floor, 1.5 * most)
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    else:
        ax.set_ylim(0, 1.08 * most)
    ax.set_xlim(t[0], t[-1])
    canvas.label(ax, y="position\nerror [m]")
    canvas.legend_above(ax, 6)


def _draw_heading(ax: Axes, result: Localization) -> None:
    t, track = result.track.t, result.track
    sd = np.degrees(2 * np.sqrt(track.covariance[:, 2, 2]))
    most = 1.0
    if np.isfinite(sd).any():
        ax.fill_between(t, -sd, sd, **BAND_LOOK)
        most = float(np.nanquantile(sd, 0.9))
    if result.truth is not None:
        error = np.degrees(wrap_angle(track.pose[:, 2] - result.truth[:, 2]))
        canvas.draw_line(ax, t, error, color=MODEL)
        most = max(most, float(np.nanquantile(np.abs(error), 0.98)))
    if result.bounds is not None:
        for sign in (-1, 1):
            canvas.draw_line(ax, t, sign * np.degrees(result.bounds.heading), lw=1.6, **BOUND_LOOK)
    canvas.shade(ax, t, track.lost, colour=LOST)
    ax.set(xlim=(t[0], t[-1]), ylim=(-1.25 * most, 1.25 * most))
    canvas.label(ax, y="heading\nerror [°]")


def _dead_name(result: Localization) -> str:
    """Name of dead reckoning, whose start the prior may not give."""
    known = all(map(math.isfinite, result.problem.prior.sd))
    return "dead reckoning" if known else "dead reckoning from the true start"


def _title(result: Localization) -> str:
    run = result.run
    where = ", ".join(str(run.metadata[key]) for key in ("scene", "path") if run.metadata.get(key))
    seed = f"seed {result.problem.seed}"
    belief = result.problem.belief
    on = "without a map" if belief is None else f"on map {getattr(belief, 'name', '') or 'belief'}"
    method, ran = canvas.short_name(result.method, 40), f"run {where or 'recorded'}, {run.duration_s:.0f} s"
    head = f"{method} {on}, {seed}; {ran}"
    judged = result.truth is not None or not result.read_share
    return "\n".join([head, *(textwrap.wrap(result.report().verdict, TITLE_WIDTH) if judged else ())])


def save_localization(result: Localization, out: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the folder of a localization.

    It has run.parquet, localize.rrd, .png and .html, estimate.tum and, if the true pose is known, truth.tum.

    Raises:
        InputError: The folder exists, or cannot be written.
    """
    with output(out, force=force) as folder:
        folder.mkdir()
        result.run.save(folder / "run.parquet")
        shown: dict[str, Any] = {"anomaly_map": _map_of(result), "particles": result.track.particles}
        shown["dead_reckoning"] = None if result.dead_reckoning is None else result.dead_reckoning.pose
        shown["bound_m"] = None if result.bounds is None else result.bounds.correlated
        write_localization(result.run, folder / "localize.rrd", truth=result.truth, **shown)
        canvas.save(draw_localization(result), folder / "localize.png")
        (folder / "localize.html").write_text(to_html(page_of_localization(result)), encoding="utf-8")
        _save_tum(folder / "estimate.tum", result.track.t, result.track.pose)
        if result.truth is not None:
            known = np.isfinite(result.truth).all(axis=1)
            _save_tum(folder / "truth.tum", result.track.t[known], result.truth[known])
    return Path(out)


def _save_tum(path: Path, t: canvas.Array, pose: canvas.Array) -> None:
    """Write planar poses as lines `t x y z qx qy qz qw` of the TUM benchmark (Sturm et al. 2012, IROS)."""
    table = np.column_stack([t, pose[:, :2], np.zeros(len(t)), quat_from_yaw(pose[:, 2])])
    header = "# t [s] x y z [m] qx qy qz qw, base_link in world"
    np.savetxt(path, table, "%.9f", header=header, comments="")
