"""Runs and maps as matplotlib figures: what `magtwin.plot`, `run.plot()` and `anomaly_map.plot()` give."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.charts import field_name, position_name
from magtwin.figures.plots import INK, MAP_INK, draw_map, draw_path, drawn, new_figure, save, shade
from magtwin.run.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

MOST_OWN = 4
"""Columns that are drawn of a run without any that magtwin knows how to draw."""


def plot(
    what: Run | AnomalyMap,
    *,
    anomaly_map: AnomalyMap | None = None,
    quantity: str = "field",
    headings: Sequence[float] | None = None,
) -> "Figure":
    """Draw a run or a map.

    Of a run: the path over the floor, coloured by the field, and field, disturbance, speed and battery
    against time; columns that it does not have are left out. Of a map: filled contours, a panel per heading.

    Args:
        what: A `Run` or an `AnomalyMap`.
        anomaly_map: For a run: the map to draw below the path, as the mean over its headings. None draws a
            bare floor.
        quantity: For a map: "field", "gradient", "variance", "mask" or "headings"; see
            `magtwin.figures.plots.draw_map`.
        headings: For a map: headings to show [rad]. None shows the map's own, of more than eight four.

    Returns:
        A matplotlib figure, which no state of pyplot holds. A notebook shows it; `savefig` writes it.

    Raises:
        InputError: `what` is neither, or holds nothing that can be drawn.
    """
    from matplotlib.text import Text

    if isinstance(what, Run):
        figure = draw_run(what, anomaly_map)
    elif isinstance(what, AnomalyMap):
        figure = draw_map(what, what=quantity, headings=headings)
    else:
        raise InputError(f"plot draws a Run or an AnomalyMap, got {type(what).__name__}")
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # type: ignore[attr-defined]  # a name may hold dollars; none is a formula
    figure._repr_png_ = partial(drawn, figure, ".png")  # type: ignore[attr-defined]  # what notebooks ask for
    return figure


def plot_run(
    run: Run,
    field: AnomalyMap | None,
    out: str | os.PathLike[str],
    planned: ArrayLike | None = None,
    *,
    force: bool = False,
) -> None:
    """Write the picture of a run that `draw_run` makes.

    Args:
        run: As for `draw_run`, and so `field` and `planned`.
        field: The map below the path.
        out: PNG or SVG to write.
        planned: The planned path.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: As for `draw_run`; or `out` is no picture or exists.
    """
    save(draw_run(run, field, planned), out, force)


def draw_run(run: Run, field: AnomalyMap | None = None, planned: ArrayLike | None = None) -> "Figure":
    """Draw a run: the path over the map, and its readings, speed and battery against time.

    Args:
        run: What happened. Columns that it does not have are left out; of a run with none of them, its first
            four columns of numbers are drawn.
        field: The map below the path, as the mean over its headings. None draws a bare floor.
        planned: The planned path in world [m], shape (M, 2). None leaves it out.

    Raises:
        InputError: The run has no rows, no clock, or no column of numbers.
    """
    if not run.rows:
        raise InputError("the run has no rows to draw")
    where = position_name(run)
    total = "b_total_nt" if "b_total_nt" in run else field_name(run)
    panels = _panels(run, total)
    both = where is not None and bool(panels)
    figure = new_figure(13.5 if both else 8.0, 7.0 if len(panels) > 2 or not both else 5.5)
    sides = figure.subfigures(1, 1 + both, squeeze=False, width_ratios=(1.15, 1)[: 1 + both])[0]
    if where is not None:
        p_xy = run[where][:, :2]
        known = np.isfinite(p_xy).all(axis=1)
        if not known.any():
            raise InputError(f"no position is known in {where!r} of the run")
        colour = run[total] / 1000 if total else np.full(run.rows, np.nan)
        ax = sides[0].subplots()
        ax.set_title(_title(run, p_xy[known]), fontsize=11)
        draw_path(ax, p_xy[known], colour[known], field, planned)
    else:
        sides[0].suptitle(_title(run), fontsize=11)
    if panels:
        _draw_panels(sides[-1], run, panels)
    return figure


@dataclass(frozen=True)
class _Panel:
    """One graph against time."""

    label: str
    """What is drawn, with its unit."""

    curves: tuple[tuple[str, Array, str], ...]
    """Name, values and colour of each; names are shown where there are several."""

    height: float = 1.0
    about_zero: bool = False
    """Whether zero is drawn as a line."""


def _panels(run: Run, total: str | None) -> list[_Panel]:
    """What a run has to draw against time; of a run of other columns, the first few of numbers."""
    panels = []
    curves = [("map", run["b_map_nt"] / 1000, MAP_INK)] if "b_map_nt" in run and total != "b_map_nt" else []
    if total is not None:
        name = total.removeprefix("b_").removesuffix("_nt")
        panels.append(
            _Panel(
                "field\n[µT]" if curves else f"{name} field\n[µT]",
                (*curves, (name, run[total] / 1000, INK)),
                2.0,
            )
        )
    if "b_disturbance_nt" in run:
        curve = ("disturbance", run["b_disturbance_nt"], INK)
        panels.append(_Panel("disturbance\n[nT]", (curve,), 2.0, about_zero=True))
    speed = next((name for name in ("v_base", "odom_v") if name in run), None)
    if speed is not None:
        panels.append(_Panel("speed\n[m/s]", (("speed", run[speed][:, 0], INK),)))
    if "battery_v" in run:
        panels.append(_Panel("battery\n[V]", (("battery", run["battery_v"], INK),)))
    if panels or position_name(run) is not None:
        return panels
    own = [
        name
        for name, values in run.items()
        if name != "t" and values.ndim == 1 and values.dtype.kind in "fiub"
    ]
    if not own:
        raise InputError("the run has neither positions nor columns of numbers to draw")
    return [
        _Panel(f"{name}\n[{run.spec(name).unit or '-'}]", ((name, run[name], INK),))
        for name in own[:MOST_OWN]
    ]


def _draw_panels(side: Any, run: Run, panels: Sequence[_Panel]) -> None:
    """Graphs above each other on one axis of time."""
    t = run["t"]
    axes = side.subplots(
        len(panels), 1, sharex=True, squeeze=False, height_ratios=[panel.height for panel in panels]
    )[:, 0]
    for ax, panel in zip(axes, panels, strict=True):
        for k, (name, values, colour) in enumerate(panel.curves):
            ax.plot(t, values, color=colour, lw=0.8 if k or len(panel.curves) == 1 else 1.2, label=name)
        if len(panel.curves) > 1:
            ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8, frameon=False)
        if panel.about_zero:
            ax.axhline(0, color="0.7", lw=0.6, zorder=0)
        ax.set_ylabel(panel.label, fontsize=9)
        ax.margins(x=0)
        ax.tick_params(labelsize=8)
        if "lidar_on" in run:
            shade(ax, t, run["lidar_on"])
    side.align_ylabels(axes)
    shaded = "; shaded while the LiDAR is on" if "lidar_on" in run else ""
    axes[-1].set_xlabel(f"time [s]{shaded}", fontsize=9)


def _title(run: Run, p_xy: Array | None = None) -> str:
    """Scene, path and network of a run, and its size."""
    metadata = [str(run.metadata[key]) for key in ("scene", "path", "network") if run.metadata.get(key)]
    size = [f"{run.rows:,} readings", f"{run.duration_s:.1f} s"]
    if p_xy is not None:
        size.append(f"{np.linalg.norm(np.diff(p_xy, axis=0), axis=1).sum():.1f} m")
    return f"{', '.join(metadata) or 'run'}\n{', '.join(size)}"
