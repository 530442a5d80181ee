"""Plots of maps and runs as PNG files: the same input gives the same bytes.

Figures are drawn on Agg canvases of their own, so that no window system and no state of pyplot is
involved.
"""

import io
import os
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.map import AnomalyMap
from magtwin.files import output
from magtwin.names import RefusedError
from magtwin.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DPI = 110
PATH_SEGMENTS = 3000
"""Pieces that a driven path is drawn in: more cannot be told apart."""

INK, MAP_INK, LIDAR_INK, PLAN_INK = "#1f2430", "#e08214", "#d9e6f2", "#d6336c"


def plot_map(
    field: AnomalyMap,
    out: str | os.PathLike[str],
    *,
    headings: Sequence[float] | None = None,
    force: bool = False,
) -> None:
    """Draw a map, a panel a heading, all on one scale of colours.

    Each node is a cell around it; masked nodes are hatched. The scale leaves out the outermost 0.5 %
    of the nodes at either end, which the pointed ends of its bar tell.

    Args:
        field: The map.
        out: PNG to write.
        headings: Headings to show [rad], interpolated between layers; the map's own unless given.
        force: Whether a file that exists is replaced.

    Raises:
        RefusedError: No heading is to be shown, every node is masked, or `out` exists.
    """
    from matplotlib.ticker import MaxNLocator

    shown = field.headings_rad if headings is None else np.asarray(headings, float)
    if len(shown) == 0:
        raise RefusedError("headings must name one heading at least, got none")
    x, y = np.meshgrid(field.x_m, field.y_m)
    layers = field.lookup(np.stack([x, y], axis=-1)[None], shown[:, None, None]) / 1000
    if not np.isfinite(layers).any():
        raise RefusedError(f"map {field.name!r} has no valid node to draw")
    limits = _limits(layers, 0.5)
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    x0, x1, y0, y1 = field.extent
    tall = float(np.clip((y1 - y0) / (x1 - x0), 0.3, 2))
    figure = _figure(4.9 * columns + 1.3, (4.4 * tall + 0.55) * rows + 0.9)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, heading, layer in zip(axes, shown, layers, strict=False):
        mesh = _field_cells(ax, field, layer, limits, "viridis")
        ax.set_title(f"heading {np.degrees(heading):.4g}°", fontsize=10)
    for ax in axes[len(shown) :]:
        ax.set_axis_off()
    figure.supxlabel("x [m], east", fontsize=10)
    figure.supylabel("y [m], north", fontsize=10)
    figure.suptitle(_summary(field, 100 if columns == 2 else 52), fontsize=11)
    below, above = bool(np.nanmin(layers) < limits[0]), bool(np.nanmax(layers) > limits[1])
    extend = ("both" if above else "min") if below else ("max" if above else "neither")
    ticks = MaxNLocator(10, steps=[1, 2, 5, 10])
    bar = figure.colorbar(mesh, ax=axes.tolist(), extend=extend, ticks=ticks, shrink=0.9, pad=0.02)
    bar.set_label("total field [µT]")
    _save(figure, out, force)


def plot_run(
    run: Run,
    field: AnomalyMap | None,
    out: str | os.PathLike[str],
    planned: ArrayLike | None = None,
    *,
    force: bool = False,
) -> None:
    """Draw a run: the path over the map, and its readings, speed and battery against time.

    Args:
        run: A run with pose, field, speed and battery columns.
        field: The map below the path, as the mean over its headings; none for a bare floor.
        out: PNG to write.
        planned: The planned path in world [m], shape (M, 2); none leaves it out.
        force: Whether a file that exists is replaced.

    Raises:
        RefusedError: The run has no rows or lacks a column, or `out` exists.
    """
    if not run.rows:
        raise RefusedError("the run has no rows to draw")
    t, total = run["t"], run["b_total_nt"] / 1000
    figure = _figure(13.5, 7.0)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.15, 1))[0]
    ax = left.subplots()
    ax.set_title(_title(run), fontsize=11)
    _draw_path(ax, run["p_world_base"][:, :2], total, field, planned)
    axes = right.subplots(4, 1, sharex=True, height_ratios=(2, 2, 1, 1))
    axes[0].plot(t, run["b_map_nt"] / 1000, color=MAP_INK, lw=1.2, label="map")
    axes[0].plot(t, total, color=INK, lw=0.8, label="total")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8, frameon=False)
    axes[1].plot(t, run["b_disturbance_nt"], color=INK, lw=0.8)
    axes[1].axhline(0, color="0.7", lw=0.6, zorder=0)
    axes[2].plot(t, run["v_base"][:, 0], color=INK, lw=0.8)
    axes[3].plot(t, run["battery_v"], color=INK, lw=0.8)
    labels = ("field\n[µT]", "disturbance\n[nT]", "speed\n[m/s]", "battery\n[V]")
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylabel(label, fontsize=9)
        ax.margins(x=0)
        ax.tick_params(labelsize=8)
        _shade(ax, t, run["lidar_on"])
    right.align_ylabels(axes)
    axes[3].set_xlabel("time [s]; shaded while the LiDAR is on", fontsize=9)
    _save(figure, out, force)


def _draw_path(
    ax: "Axes", p_xy: Array, total: Array, field: AnomalyMap | None, planned: ArrayLike | None
) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    if field is not None:
        known = np.where(field.valid.all(axis=0), field.values_nt.mean(axis=0), np.nan) / 1000
        paper = LinearSegmentedColormap.from_list("paper", ["white", "0.4"])  # below any colour of the path
        mesh = _field_cells(ax, field, known, _limits(known, 0.5), paper)
        _flat_bar(ax, mesh, "map, mean over headings [µT]")
    keep = np.unique(np.linspace(0, len(p_xy) - 1, PATH_SEGMENTS + 1).astype(int))
    points, colour = p_xy[keep], total[keep]
    ax.plot(*points.T, color="white", lw=4.5, solid_capstyle="round")
    low, high = _limits(total, 0)
    driven = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        array=np.ma.masked_invalid((colour[:-1] + colour[1:]) / 2),
        cmap="viridis",
        clim=(low, high),
        lw=3,
        capstyle="round",
        zorder=3,
    )
    ax.add_collection(driven)
    if planned is not None:
        way = np.asarray(planned, float)
        ax.plot(way[:, 0], way[:, 1], color=PLAN_INK, lw=0.8, ls=(0, (4, 3)), zorder=4, label="planned")
    ax.plot(*p_xy[0], marker="o", ms=7, mfc="white", mec=INK, ls="", zorder=5, label="start")
    _flat_bar(ax, driven, "total field along the path [µT]")
    ax.set_aspect("equal")
    ax.set_xlabel("x [m], east", fontsize=9)
    ax.set_ylabel("y [m], north", fontsize=9)
    ax.tick_params(labelsize=8)
    ax.legend(loc="upper right", fontsize=8, framealpha=0.85)


def _flat_bar(ax: "Axes", mappable: "ScalarMappable", label: str) -> None:
    bar = ax.figure.colorbar(mappable, ax=ax, orientation="horizontal", pad=0.02, aspect=40, shrink=0.9)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _limits(values: Array, outer_percent: float) -> tuple[float, float]:
    """Least and greatest of the finite values, the outermost at either end left out; 0 and 1 for none."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (outer_percent, 100 - outer_percent))
    return float(low), float(high)


def _field_cells(
    ax: "Axes", field: AnomalyMap, layer_ut: Array, limits: tuple[float, float], colours: "str | Colormap"
) -> "ScalarMappable":
    """One layer, a cell a node, on hatched grey that shows where nodes are masked."""
    ax.set_facecolor("0.85")
    ax.patch.set(hatch="////", edgecolor="0.65")
    ax.set_aspect("equal")
    ax.tick_params(labelsize=8)
    layer = np.ma.masked_invalid(layer_ut)
    low, high = limits
    return ax.pcolormesh(field.x_m, field.y_m, layer, shading="nearest", cmap=colours, vmin=low, vmax=high)


def _summary(field: AnomalyMap, width: int) -> str:
    """The map's name, and its figures in lines of at most `width` characters."""
    figures = {f.name: f for f in field.report().figures}
    mean = figures["mean"]
    words = [f"mean {float(mean.value) / 1000:.2f} µT", f"sd {(mean.spread or 0) / 1000:.2f} µT"]
    if "median gradient" in figures:
        words.append(f"median gradient {float(figures['median gradient'].value):.1f} µT/m")
    if "heading amplitude" in figures:
        words.append(f"heading amplitude {float(figures['heading amplitude'].value):.0f} nT")
    masked = int(figures["masked nodes"].value)
    if masked:
        words.append(f"{masked} nodes masked")
    return "\n".join([field.name or "map", *textwrap.wrap(", ".join(words), width)])


def _title(run: Run) -> str:
    facts = [str(run.facts[key]) for key in ("scene", "path", "network") if run.facts.get(key)]
    length = np.linalg.norm(np.diff(run["p_world_base"][:, :2], axis=0), axis=1).sum()
    return f"{', '.join(facts) or 'run'}\n{run.rows:,} readings, {run.duration_s:.1f} s, {length:.1f} m"


def _shade(ax: "Axes", t: Array, on: NDArray[np.bool_]) -> None:
    """Mark the spans of time in which a flag is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    for first, last in edges.reshape(-1, 2):
        ax.axvspan(t[first], t[min(last, len(t) - 1)], color=LIDAR_INK, lw=0, zorder=-1)


def _figure(width_in: float, height_in: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")


def _save(figure: "Figure", out: str | os.PathLike[str], force: bool) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    picture = io.BytesIO()
    FigureCanvasAgg(figure).print_png(picture, metadata={"Software": None})  # no version, no date
    with output(out, force=force) as path:
        path.write_bytes(picture.getvalue())
