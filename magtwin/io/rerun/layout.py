"""Layout: the plots and views of a recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from magtwin.io.rerun.series import (
    COLUMNS_ENTITY,
    DERIVED,
    DERIVED_ENTITY,
    ERRORS,
    STATES,
    TIMELINE,
    derived,
    entity_of,
)
from magtwin.run.arrow import without_pandas
from magtwin.run.run import COLUMNS, Run
from magtwin.spec.lab import LabSpec

Array = NDArray[np.float64]

_ROOM = 0.08  # Room beyond the values and the ticks of an axis, as a share of the range of the values

Colour = tuple[int, int, int]

RUN_COLOURS: tuple[Colour, ...] = (
    *((86, 156, 255), (255, 158, 64), (92, 200, 120), (226, 92, 160)),
    *((170, 130, 255), (224, 208, 80), (80, 210, 214), (240, 98, 82)),
)
"""Colours of runs that are compared; repeated for more runs."""


@dataclass(frozen=True)
class Series:
    """A line of a plot: a column, or one part of it."""

    column: str
    name: str
    colour: Colour
    part: str = ""  # Name of the part, such as x, of a vector column
    width: float = 1.5  # Width of the line [points]. Wide lines are drawn below narrow ones.


_BLUE, _ORANGE, _GREEN, _GREY = (86, 156, 255), (255, 158, 64), (92, 200, 120), (165, 165, 165)
_DIM = (118, 106, 150)
_NAMES = {_BLUE: "blue", _ORANGE: "orange", _GREEN: "green", _GREY: "grey", _DIM: "violet"}
"""Names of colours, which the title of a plot gives with its lines, in place of a legend over them."""

_SPIKES = 0.005  # Share of the largest and of the smallest values of an error that its axis may leave out

PLOTS: Mapping[str, Mapping[str, tuple[Series, ...]]] = {
    "": {
        "Total field [nT]": (
            Series("b_total_nt", "map + disturbance", _ORANGE, width=4.0),
            Series("b_measured_nt", "measured", _GREEN, width=1.0),
            Series("b_map_nt", "map", _BLUE),
        ),
        "Disturbance [nT]": (Series("b_disturbance_nt", "disturbance", _ORANGE),),
        "Error [nT]": (
            Series("error_nt", "prediction - truth", _ORANGE, width=3.0),
            Series("measured_error_nt", "measured - truth", _GREEN, width=1.0),
            Series("error_low_nt", "90 % interval", _DIM),
            Series("error_high_nt", "90 % interval", _DIM),
        ),
    },
    "Drive": {
        "Speed [m/s]": (Series("v_base", "true", _BLUE, "x"),),
        "Speed less the true one [m/s]": (
            Series("odom_v_error", "odometry", _GREY),
            Series("v_cmd_error", "commanded", _ORANGE),
        ),
        "Yaw rate [rad/s]": (Series("w_base", "true", _BLUE, "z"),),
        "Yaw rate less the true one [rad/s]": (
            Series("gyro_error", "gyroscope", _GREY),
            Series("w_cmd_error", "commanded", _ORANGE),
        ),
    },
    "IMU": {
        "Accelerometer [m/s2]": (
            Series("imu_a", "forward", _BLUE, "x"),
            Series("imu_a", "left", _ORANGE, "y"),
            Series("imu_a", "up", _GREY, "z"),
        ),
        "Gyroscope, tilting [rad/s]": (
            Series("imu_w", "roll", _BLUE, "x"),
            Series("imu_w", "pitch", _ORANGE, "y"),
        ),
    },
    "Battery": {
        "Battery voltage [V]": (Series("battery_v", "voltage", _GREEN),),
        "Battery current [A]": (Series("battery_a", "current", _ORANGE),),
        "Battery charge [0..1]": (Series("battery_fraction", "charge", _GREEN),),
    },
}
"""Series by the title of their plot, by the name of their tab; "" are above the tabs."""

_COMPARED = (
    ("Total field [nT]", "b_total_nt", ""),
    ("Disturbance [nT]", "b_disturbance_nt", ""),
    ("Error, prediction - truth [nT]", "error_nt", ""),
    ("Speed [m/s]", "v_base", "x"),
    ("Heading [rad]", "yaw", ""),
    ("Battery voltage [V]", "battery_v", ""),
)
"""Plots of runs that are compared: title, column, part; one line per run."""


@dataclass(frozen=True)
class Shown:
    """A run whose series are plotted."""

    run: Run  # Its columns, and those derived for the plots
    name: str = ""  # Its name among several runs; "" for a single run
    colour: Colour = _ORANGE

    @classmethod
    def of(cls, run: Run, **rest: Any) -> "Shown":
        """A run with its derived columns."""
        return cls(run.with_columns(**derived(run)), **rest)

    def values(self, series: Series) -> Array | None:
        """Values of a series, shape (N,); None if the run has none."""
        column = self.run.columns.get(series.column)
        if column is None:
            return None
        if series.part:
            column = column[:, COLUMNS[series.column].parts.index(series.part)]
        return column if np.isfinite(column).any() else None


def raised(run: Run) -> list[str]:
    """The flags with states that a run raised."""
    return [key for key in STATES if key in run and run[key].any()]


def plotted(run: Run) -> bool:
    """Whether a run has a column that is plotted."""
    shown = Shown.of(run)
    lines = (line for tab in PLOTS.values() for series in tab.values() for line in series)
    return any(shown.values(line) is not None for line in lines)


def layout(
    run: Run, lab: LabSpec | None = None, *, heading: float = 0.0, events: Sequence[str] | None = None
) -> rrb.Blueprint:
    """The views of a run: plots, states and events, and with a lab also the lab and the robot in 3D.

    `heading` is that of the map on the floor [rad], for the title; `events` are flags that get a lane of
    states, by default those that the run raised.
    """
    shown = Shown.of(run)
    axis = time_axis([run])
    stacks = {
        tab: _stacked(axis, {title: [(shown, line) for line in lines] for title, lines in plots.items()})
        for tab, plots in PLOTS.items()
    }
    series = stacks.pop("")
    tabs = [rrb.Vertical(*views, name=tab) for tab, views in stacks.items() if views]
    shares = [1.8, 1.1, 1.5][: len(series)] + [3.0] * bool(tabs)
    side = rrb.Vertical(*series, *([rrb.Tabs(*tabs)] if tabs else []), row_shares=shares)
    events = raised(run) if events is None else events
    lanes = [f"$origin/{STATES[key].name}" for key in STATES if key == "lidar_on" or key in events]
    states = rrb.StateTimelineView(origin="states", contents=lanes, name="States", time_view=axis)
    pages = rrb.Tabs(_event_view(), rrb.TextDocumentView(origin="metadata", name="Run"))
    about = rrb.Vertical(states, pages, row_shares=[1.2, 1.4])
    # from behind its left shoulder, in the robot's axes, so that it stays in view
    eye: dict[str, Any] = {"position": (-0.62, 0.42, 0.55), "target": (0.08, 0.0, 0.17)}
    robot = _view_3d("world/robot", "Robot", [""], without="world/scale", **eye)
    below = [robot, _floor_view(lab, [""])] if lab else []
    return _blueprint(lab, heading, [""], side, [*below, about], [0.9, 1.1, 1.6])


def comparison_layout(
    runs: Sequence[Shown], lab: LabSpec | None = None, *, heading: float = 0.0
) -> rrb.Blueprint:
    """The views of several runs on a common timeline; `heading` is that of the map on the floor [rad]."""
    plots = {
        title: [(shown, Series(column, shown.name, shown.colour, part)) for shown in runs]
        for title, column, part in _COMPARED
    }
    side = rrb.Vertical(*_stacked(time_axis([shown.run for shown in runs]), plots))
    names = [shown.name for shown in runs]
    metadata = [rrb.TextDocumentView(origin=entity_of("metadata", name), name=name) for name in names]
    about = rrb.Tabs(_event_view(), *metadata)
    below = [_floor_view(lab, names)] if lab else []
    return _blueprint(lab, heading, names, side, [*below, about], [1.0, 1.0])


def drive_layout(lab: LabSpec) -> rrb.Blueprint:
    """The view of a lab in which a robot is driven by hand."""
    return rrb.Blueprint(_lab_view(lab, "Lab, driven by hand", [""]), collapse_panels=True)


def _blueprint(
    lab: LabSpec | None,
    heading: float,
    names: Sequence[str],
    side: Any,
    below: list[Any],
    shares: list[float],
) -> rrb.Blueprint:
    """The plots in `side`, beside the lab with the views `below` it; without a lab, beside these views."""
    if lab is None:
        root = rrb.Horizontal(side, *below, column_shares=[3.0, 1.0])
    else:
        lower = rrb.Horizontal(*below, column_shares=shares)
        text = "readings along the path" if names == [""] else "a robot and its path for each run"
        title = f"Lab: map of the total field at heading {np.degrees(heading):.4g}°, {text}"
        left = rrb.Vertical(_lab_view(lab, title, names), lower, row_shares=[2.0, 1.0])
        root = rrb.Horizontal(left, side, column_shares=[3.0, 2.0])
    return bare(root)


def bare(root: Any) -> rrb.Blueprint:
    """Views without the viewer's panels."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
    )


def time_axis(runs: Sequence[Run]) -> rrb.TimeAxis:
    """The axis that covers all of the runs."""
    ends = [run["t"][[0, -1]] for run in runs]
    first, last = (rrb.TimeRangeBoundary.absolute(seconds=float(k(ends))) for k in (np.min, np.max))
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))


def _stacked(
    whole: rrb.TimeAxis, plots: Mapping[str, Sequence[tuple[Shown, Series]]]
) -> list[rrb.TimeSeriesView]:
    """One plot, by its title, for each that has a line with values."""
    views = []
    for title, lines in plots.items():
        known = [(*line, values) for line in lines if (values := line[0].values(line[1])) is not None]
        if known:
            views.append(_plot(title, known, whole))
    return views


def _plot(
    title: str, lines: Sequence[tuple[Shown, Series, Array]], whole: rrb.TimeAxis
) -> rrb.TimeSeriesView:
    """Lines of one unit."""
    share = _SPIKES if any(series.column in ERRORS for _, series, _ in lines) else 0.0
    ends = np.array([np.nanquantile(values, (share, 1 - share)) for _, _, values in lines])
    overrides: dict[Any, list[rrb.Visualizer]] = {}
    for shown, series, _ in lines:
        entity = entity_of(DERIVED_ENTITY if series.column in DERIVED else COLUMNS_ENTITY, shown.name)
        source = VisualizerComponentMapping(
            "Scalars:scalars",
            ComponentSourceKind.SourceComponent,
            source_component=series.column,
            selector=f".{series.part}" if series.part else None,
        )
        style = rr.SeriesLines(names=[series.name], colors=[series.colour], widths=[series.width])
        overrides.setdefault(f"/{entity}", []).append(style.visualizer(mappings=[source]))
    each = [series for _, series, _ in lines]
    names = dict.fromkeys(f"{line.name} ({_NAMES[line.colour]})" for line in each if line.colour in _NAMES)
    named = all(series.colour in _NAMES and not shown.name for shown, series, _ in lines)  # by the title
    title = f"{title}: {', '.join(names)}" if len(names) > 1 else title
    return plot_view(
        title, [*overrides], ends, whole, legend=len(lines) > 1 and not named, overrides=overrides
    )


def plot_view(
    title: str, contents: list[str], values: Array, whole: rrb.TimeAxis, *, legend: bool, **rest: Any
) -> rrb.TimeSeriesView:
    """A plot of entities against time, whose axis covers some values."""
    ends = value_range(values)
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=title,
        axis_x=whole,
        axis_y=rrb.ScalarAxis(range=ends) if ends else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        **rest,
    )


def value_range(values: Array) -> tuple[float, float] | None:
    """Ends of an axis with room beyond the values and every tick; nan is ignored. None if all are alike."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        return None
    room = _ROOM * (high - low)
    tick = 10.0 ** math.floor(math.log10(high - low))
    return (
        min(low - room, math.ceil((low - room) / tick) * tick - room),
        max(high + room, math.floor((high + room) / tick) * tick + room),
    )


def _lab_view(lab: LabSpec, title: str, names: Sequence[str]) -> rrb.Spatial3DView:
    """A whole lab, from above the near edge of its floor."""
    x0, x1, y0, y1 = lab.extent_m
    x, y, at_x, at_y = x1 - x0, y1 - y0, (x0 + x1) / 2, (y0 + y1) / 2
    height = max(0.9 * max(x, 1.7 * y), 1.5 * lab.post_height_m)
    position, target = (at_x, at_y - 0.45 * y, height), (at_x, at_y - 0.09 * y, 0.0)
    return _view_3d("world", title, names, without="world/robot/sensors", position=position, target=target)


def _floor_view(lab: LabSpec, names: Sequence[str]) -> rrb.Spatial2DView:
    """The map and the paths from above, x to the right and y up, in metres."""
    x0, x1, y0, y1 = lab.extent_m
    more = lab.wall_thickness_m
    return rrb.Spatial2DView(
        origin="floor",
        name="Map from above [m]",
        background=(24, 26, 31),
        visual_bounds=rrb.VisualBounds2D(x_range=(x0 - more, x1 + more), y_range=(y0 - more, y1 + more)),
        overrides={entity_of("floor/paths/driven", name): UP_TO_NOW for name in names},
    )


def _event_view() -> rrb.TextLogView:
    shown = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="events", name="Events", columns=shown)


with without_pandas():
    UP_TO_NOW = rrb.VisibleTimeRanges(
        rrb.VisibleTimeRange(
            TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
    )
"""Visible part of what accumulates: all up to the time shown."""


def _view_3d(
    origin: str,
    title: str,
    names: Sequence[str],
    *,
    without: str,
    position: tuple[float, ...],
    target: tuple[float, ...],
) -> rrb.Spatial3DView:
    """The world in the axes of `origin`, from a position [m]; readings appear with time."""
    ends = ("world/driven", "world/readings")
    piling_up: dict[Any, Any] = {entity_of(end, name): UP_TO_NOW for end in ends for name in names}
    return rrb.Spatial3DView(
        origin=origin,
        contents=["/world/**", f"- /{without}/**"],
        name=title,
        background=(24, 26, 31),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1)),
        overrides=piling_up,
    )
