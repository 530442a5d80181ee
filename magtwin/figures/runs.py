"""Runs: the path on the floor and what the map lacks along it; or the path alone, for a page."""

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.figures import canvas, style
from magtwin.figures.canvas import label
from magtwin.figures.maps import EXTEND, FloorPlan, draw_cells, draw_mean, mean_field_nt
from magtwin.report.verdict import Z_90
from magtwin.run import mapped
from magtwin.run.compare import FIELDS, POSITIONS
from magtwin.run.figures import prediction_nt
from magtwin.run.run import Run
from magtwin.run.summary import swept

MOST_OTHER = 4
"""Columns drawn of a run that has none of the usual ones."""

TRAIL_SHARE = 0.995
"""Share of the readings within the scale of a trail; its ends take the rest."""

WIDE = 1.75
"""Floors that are longer than this, by their width, are drawn above the graphs of a run."""

LETTER_IN = 0.085
"""Width of a letter of a title, with some room [inch]."""

DASHES: dict[str, Any] = {"ls": (0, (6, 1.2))}


@style.styled
def draw_run(
    run: Run, field: AnomalyMap | None = None, planned: ArrayLike | None = None, plan: FloorPlan | None = None
) -> Figure:
    """Draw a run: the path, and against time what the map lacks, what was predicted of it, and the rest.

    Args:
        run: The run. Columns that it lacks are left out; of a run with none of them, its first four columns
            of numbers are drawn.
        field: The map below the path, as the mean over its headings. None draws a bare floor.
        planned: The planned path in world [m], shape (M, 2). None leaves it out.
        plan: Walls, furniture and doors. None leaves them out.

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
    tall = 8.0 if len(panels) > 3 or not both else 6.0
    shape = np.ptp(np.reshape((0, 1, 0, 1) if field is None else field.extent, (2, 2)), axis=1)
    if both and shape[0] > WIDE * shape[1]:  # the path above the graphs
        above = 9.0 * shape[1] / shape[0] + 2.8
        figure = canvas.new_figure(10.0, above + tall)
        sides = figure.subfigures(2, 1, squeeze=False, height_ratios=(above, tall))[:, 0]
    else:
        figure = canvas.new_figure(14.0 if both else 8.0, tall)
        sides = figure.subfigures(1, 1 + both, squeeze=False, width_ratios=(1.1, 1)[: 1 + both])[0]
    if place is not None:
        if not len(_places(run, place)):
            raise InputError(f"no position is known in {place!r} of the run")
        draw_path(sides[0].subplots(), run, place, field, planned, plan)
    title = textwrap.fill(_title(run, place), int(sides[0].bbox.width / figure.dpi / LETTER_IN))
    sides[0].suptitle(title, x=0.02, ha="left")
    if panels:
        heights = [panel.height for panel in panels]
        axes = sides[-1].subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for ax, panel in zip(axes, panels, strict=True):
            panel.draw(ax, run)
        sides[-1].align_ylabels(axes)
        shaded = "; shaded while the LiDAR is on" if "lidar_on" in run and run["lidar_on"].any() else ""
        label(axes[-1], f"time [s]{shaded}")
    elif place is None:
        raise InputError("the run has neither positions nor columns of numbers to draw")
    return figure


@dataclass(frozen=True)
class Panel:
    """One graph of a run against time."""

    label: str
    """Name and unit of the quantity."""

    curves: tuple[tuple[str, canvas.Array, dict[str, Any]], ...]
    """Name, values and look of each curve."""

    height: float = 1.0
    band: tuple[canvas.Array, canvas.Array] | None = None
    """Middle and half width of the band of 90 % of what is predicted."""

    about_zero: bool = False
    """Whether to draw a line at zero."""

    def draw(self, ax: Axes, run: Run) -> None:
        """Draw the curves, with a legend if there are several; shade the time while the LiDAR is on."""
        t = run["t"]
        for name, values, look in self.curves:
            canvas.draw_line(ax, t, values, label=name, **look)
        if self.band is not None:
            rows = canvas.evenly(run.rows, canvas.POINTS // 2)
            middle, half = (values[rows] for values in self.band)
            look = {"color": style.MODEL, "alpha": 0.22, "lw": 0, "label": "its 90 % band", "zorder": 1.9}
            ax.fill_between(t[rows], middle - half, middle + half, **look)
        if self.about_zero:
            ax.axhline(0, color=style.FAINT, lw=0.7, zorder=0)
        if len(self.curves) > 1 or self.band is not None or self.about_zero:
            canvas.legend_above(ax)
        ax.margins(x=0)
        label(ax, y=self.label)
        if "lidar_on" in run:
            canvas.shade(ax, t, run["lidar_on"])


def panels_of(run: Run) -> list[Panel]:
    """The graphs that a run has columns for; of a run with none of the usual ones, its first columns."""
    panels = _residuals(run)
    grey, data, model = ({"color": ink} for ink in (style.SOFT, style.DATA, style.MODEL))
    columns = ("b_measured_nt", "b_total_nt", field_name(run))
    read = next((name for name in columns if name and _has(run, name)), "")
    first = "reading" if read == "b_measured_nt" else read
    fields = {first: (read, data), "map": ("b_map_nt", model | DASHES)}
    speeds = {"driven": ("v_base", data), "commanded": ("v_cmd", model | DASHES)}
    if not _has(run, "v_base"):
        speeds["odometry"] = ("odom_v", grey)
    for text, height, curves in (
        ("field\n[nT]", 1.5, fields),
        ("speed\n[m/s]", 0.8, speeds),
        ("battery\n[V]", 0.8, {"battery": ("battery_v", data)}),
    ):
        drawn = tuple(
            (name, run[key] if run[key].ndim == 1 else run[key][:, 0], look)
            for name, (key, look) in curves.items()
            if key and _has(run, key)
        )
        if drawn:
            panels.append(Panel(text, drawn, height))
    if panels or position_name(run) is not None:
        return panels
    others = [name for name, values in run.items() if values.ndim == 1 and values.dtype.kind in "fiub"]
    return [
        Panel(f"{name}\n[{run.spec(name).unit or '-'}]", ((name, run[name], data),))
        for name in [name for name in others if name != "t"][:MOST_OTHER]
    ]


def _residuals(run: Run) -> list[Panel]:
    """What the map lacks, measured and predicted, and the error of the prediction, each about zero."""
    if not _has(run, "b_map_nt"):
        return []
    field, grey = run["b_map_nt"], {"color": style.FAINT}
    read = next((name for name in ("b_measured_nt", "b_total_nt") if _has(run, name)), "")
    if not read:
        return []
    lacks: list[tuple[str, canvas.Array, dict[str, Any]]] = [("reading − map", run[read] - field, grey)]
    exact = run["b_truth_nt"] if _has(run, "b_truth_nt") else None
    judge, name = (run[read], "reading") if exact is None else (exact, "exact")
    told = prediction_nt(run) if "b_total_nt" in run else field
    error = told - judge
    if not (np.nan_to_num(told - field).any() and np.nan_to_num(error).any()):
        if exact is None:
            return [Panel("what the map\nlacks [nT]", tuple(lacks), 2.0, None, about_zero=True)]
        lacks[0][2]["lw"] = 4.5  # nothing is predicted, and the next line lies on it
        lacks.append(("exact − map", exact - field, {"color": style.DATA, "lw": 1.1, "ls": (0, (4, 2.5))}))
        error, sd, look, title = run[read] - exact, None, {"color": style.DATA}, "reading − exact"
    else:
        lacks.append(("predicted", told - field, {"color": style.MODEL, "lw": 1.0}))
        sd = Z_90 * run["b_sd_nt"] if _has(run, "b_sd_nt") else None
        look, title = {"color": style.MODEL}, f"prediction − {name}"
    title += f": mean size {np.nanmean(np.abs(error)):,.0f} nT" if np.isfinite(error).any() else ""
    middle = None if sd is None else (told - field, sd), None if sd is None else (0 * sd, sd)
    return [
        Panel("what the map\nlacks [nT]", tuple(lacks), 2.4, middle[0], about_zero=True),
        Panel("error\n[nT]", ((title, error, look),), 1.5, middle[1], about_zero=True),
    ]


@dataclass(frozen=True)
class Trail:
    """What colours a path: the reading less the map, about zero; or the reading if no map is known."""

    values: canvas.Array
    """Values [nT], shape (N,), nan where unknown."""

    name: str
    limits: tuple[float, float]
    colours: str

    @classmethod
    def of(cls, run: Run, limits: tuple[float, float] | None = None) -> "Trail":
        """The trail of a run; `limits` [nT] are those of the map, on whose scale a reading is drawn."""
        column = field_name(run)
        values = run[column] if column else np.full(run.rows, np.nan)
        if column in (None, "b_map_nt") or not _has(run, "b_map_nt"):
            name = f"{(column or '').removesuffix('_nt')} [nT]" if column else ""
            return cls(values, name, limits or colour_limits(values, 0), style.FIELD_COLOURS)
        values = values - run["b_map_nt"]
        size = np.abs(values[np.isfinite(values)])
        reach = float(np.quantile(size, TRAIL_SHARE)) if len(size) else 0.0
        return cls(values, "reading − map [nT]", (-reach or -1.0, reach or 1.0), style.SIGNED_COLOURS)


def draw_path(
    ax: Axes,
    run: Run,
    place: str,
    field: AnomalyMap | None,
    planned: ArrayLike | None,
    plan: FloorPlan | None = None,
) -> None:
    """Draw the path of a run, its column `place`, over the map, coloured by its `Trail`."""
    known = np.isfinite(run[place][:, :2]).all(axis=1)
    p_xy, limits = run[place][known, :2], None
    if field is not None:
        limits = draw_mean(ax, field)
    trail = Trail.of(run, limits)
    if plan is not None:
        plan.draw(ax)
    elif field is None:
        ax.margins(0.08)
    for ink, width in ((style.INK, 6.0), (style.PAPER, 5.0)):  # one of the two edges differs from the map
        ax.plot(*p_xy[canvas.evenly(len(p_xy), 3000)].T, color=ink, lw=width, solid_capstyle="round")
    line = canvas.coloured_line(ax, p_xy, trail.values[known], trail.limits, trail.colours, 3.4)
    if planned is not None:
        points = np.asarray(planned, float)[:, :2]
        ax.plot(*points.T, color=style.OTHER, lw=1.0, ls=(0, (4, 3)), zorder=4, label="planned")
    ax.plot(*p_xy[0], marker="o", ms=7, mfc=style.PAPER, mec=style.INK, ls="", zorder=5, label="start")
    if trail.name and (field is None or trail.colours == style.SIGNED_COLOURS):
        finite = trail.values[np.isfinite(trail.values)]
        ends = bool((finite < trail.limits[0]).any()), bool((finite > trail.limits[1]).any())
        canvas.colour_bar(ax.figure, line, ax, trail.name, below=True, extend=EXTEND[ends])
    ax.set_aspect("equal")
    label(ax, "x [m]", "y [m]")
    handles, names = ax.get_legend_handles_labels()
    keys = {} if plan is None else plan.keys()
    canvas.legend_above(ax, 5, handles=[*handles, *keys.values()], labels=[*names, *keys])


def field_name(*runs: Run) -> str | None:
    """The best field column that all of the runs have."""
    return next((name for name in FIELDS if all(_has(run, name) for run in runs)), None)


def position_name(*runs: Run) -> str | None:
    """The best position column that all of the runs have."""
    return next((name for name in POSITIONS if all(_has(run, name) for run in runs)), None)


def _places(run: Run, column: str) -> canvas.Array:
    """The known positions of a column along x and y [m], shape (N, 2)."""
    return run[column][np.isfinite(run[column][:, :2]).all(axis=1), :2]


def _has(run: Run, *names: str) -> bool:
    return all(name in run and np.isfinite(run[name]).any() for name in names)


@style.styled
def path_picture(run: Run, field: AnomalyMap | None, planned: ArrayLike | None) -> canvas.Picture | None:
    """The path of a run over its map, or over a bare floor; None if its places or readings are unknown."""
    position, column = position_name(run), field_name(run)
    if position is None or column is None or len(_places(run, position)) < 2:
        return None
    p_xy = _places(run, position)
    wide, tall = np.ptp(p_xy, axis=0) if field is None else np.ptp(np.reshape(field.extent, (2, 2)), axis=1)
    height = float(np.clip((canvas.WIDTH_IN - 0.8) * tall / max(wide, 1e-9), 1.5, 6.0))
    figure = canvas.new_figure(canvas.WIDTH_IN, height + (1.9 if field is not None else 1.2))
    draw_path(figure.subplots(), run, position, field, planned)
    over = "the path" if field is None else f"the path over the map {field.name}"
    what = Trail.of(run).name.removesuffix(" [nT]")
    return canvas.picture(
        figure, f"Path driven, coloured by {what}", alt=f"{over}, coloured by {what}", kind="png"
    )


@style.styled
def still_of(run: Run | None, field: AnomalyMap | None) -> canvas.Picture | None:
    """A small picture without axes: the path of a run over its map, coloured as by `draw_path`.

    None if neither the map nor a path is known. Without a run, the map alone.
    """
    place = None if run is None else position_name(run)
    known = np.isfinite(run[place][:, :2]).all(axis=1) if run is not None and place else np.zeros(0, bool)
    p_xy = run[place][known, :2] if run is not None and place else np.empty((0, 2))
    if field is None and len(p_xy) < 2:
        return None
    low, high = np.reshape(field.extent, (2, 2)).T if field else (p_xy.min(axis=0), p_xy.max(axis=0))
    wide, tall = np.maximum(high - low, 0.1)
    figure = canvas.new_figure(2.0, float(np.clip(2.0 * tall / wide, 0.8, 2.4)))
    figure.set_layout_engine("none")
    ax = figure.add_axes((0, 0, 1, 1))
    if field is not None:
        mean = mean_field_nt(field)
        draw_cells(ax, field.x_m, field.y_m, mean, style.FIELD_COLOURS, clim=colour_limits(mean))
    if run is not None and len(p_xy) > 1:
        trail = Trail.of(run)
        ax.plot(*p_xy[canvas.evenly(len(p_xy), 1000)].T, color=style.INK, lw=3.2)
        if trail.colours == style.SIGNED_COLOURS:
            canvas.coloured_line(ax, p_xy, trail.values[known], trail.limits, trail.colours, 2)
    ax.set_aspect("equal")
    ax.axis("off")
    return canvas.picture(figure, "The map" if len(p_xy) < 2 else "The path over the map", kind="png")


def _title(run: Run, place: str | None) -> str:
    """Scene, path and network of a run, and its size."""
    names = [str(run.metadata[key]) for key in ("scene", "path", "network") if run.metadata.get(key)]
    size = [f"{run.rows:,} readings", f"{run.duration_s:.1f} s"]
    if place is not None:
        steps = np.diff(_places(run, place), axis=0)
        size.append(f"{np.linalg.norm(steps, axis=1).sum():.1f} m")
    floor = swept(run.metadata).partition(",")[0]
    size += [floor] if floor else []
    return f"{', '.join(names) or 'run'}: {', '.join(size)}"
