"""Layout: which plots and views a recording opens with, and what they show."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from magtwin.run import Run
from magtwin.spec import LabSpec, Vec3

Array = NDArray[np.float64]

TIMELINE = "sim_time"
"""Name of the timeline that a recording runs on."""

_ROOM = 0.08
"""Room beyond the values and the ticks of an axis, as a share of the values' range."""

_LEGEND_ROW, _LEGEND_MOST = 0.1, 0.6
"""Height of a legend's row, as a share of the tall first plot, and the most that a legend may take."""

_LEGEND_WIDTH, _LEGEND_LETTER = 0.07, 0.01
"""Width of a legend without text, and of a letter, as shares of a plot's."""


@dataclass(frozen=True)
class Series:
    """A line of a plot: one part of a column."""

    column: str
    name: str
    colour: tuple[int, int, int]
    part: int = 0
    width: float = 1.5
    """Width of the line [points]; wide ones stand under narrow ones that they would hide."""


@dataclass(frozen=True)
class Panel:
    """A plot: series of one unit, in one entity of the recording."""

    entity: str
    title: str
    series: tuple[Series, ...]


_BLUE, _ORANGE, _GREEN, _GREY = (86, 156, 255), (255, 158, 64), (92, 200, 120), (165, 165, 165)

PANELS = (
    Panel(
        "series/field",
        "Total field [nT]",
        (
            Series("b_total_nt", "total = map + disturbance", _ORANGE, width=4.0),
            Series("b_measured_nt", "measured", _GREEN, width=1.0),
            Series("b_map_nt", "map", _BLUE),
            Series("b_truth_nt", "truth", _GREY),
        ),
    ),
    Panel("series/disturbance", "Disturbance [nT]", (Series("b_disturbance_nt", "disturbance", _ORANGE),)),
    Panel(
        "series/speed",
        "Speed [m/s]",
        (
            Series("odom_v", "odometry", _GREY, 0, width=3.0),
            Series("v_base", "true", _BLUE, 0),
            Series("v_cmd", "commanded", _ORANGE),
        ),
    ),
    Panel(
        "series/yaw_rate",
        "Yaw rate [rad/s]",
        (
            Series("imu_w", "gyroscope", _GREY, 2, width=3.0),
            Series("w_base", "true", _BLUE, 2),
            Series("w_cmd", "commanded", _ORANGE),
        ),
    ),
    Panel("series/battery_voltage", "Battery voltage [V]", (Series("battery_v", "voltage", _GREEN),)),
    Panel("series/battery_charge", "Battery charge [0..1]", (Series("battery_fraction", "charge", _GREEN),)),
)
"""Every plot of the recording; series that a run has not got, or that are nan throughout, are left out."""

STATES = {
    "lidar_on": ("LiDAR", "off", "on"),
    "flag_bump": ("bump", "no", "bump"),
    "flag_outside_map": ("map", "inside", "outside"),
    "flag_pose_lost": ("mocap", "seen", "lost"),
    "flag_out_of_distribution": ("network", "in distribution", "out of distribution"),
    "flag_lost_lock": ("lock", "held", "lost"),
}
"""Lanes of states: column, name, and what false and true are called."""


def known_series(run: Run, panel: Panel) -> list[Series]:
    """The series of a panel that the run has."""
    return [s for s in panel.series if s.column in run.columns and np.isfinite(run[s.column]).any()]


def layout(run: Run, lab: LabSpec | None = None, *, heading: float = 0.0) -> rrb.Blueprint:
    """The views of a run, on its timeline; the lab and the robot in 3D first, where a lab is given.

    Args:
        run: What its plots show.
        lab: The room; none for plots only.
        heading: Heading of the map on its floor [rad], for the title.
    """
    whole = rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=rrb.TimeRangeBoundary.absolute(seconds=float(run["t"][0])),
            end=rrb.TimeRangeBoundary.absolute(seconds=float(run["t"][-1])),
        )
    )
    plots = [_plot(run, panel, series, whole) for panel in PANELS if (series := known_series(run, panel))]
    wide, narrow = plots[:4], plots[4:]
    column: list[Any] = [*wide, *([rrb.Horizontal(*narrow)] if narrow else [])]
    shares = [2.6, 1.3, 1.7, 1.7, 1.0]
    side = rrb.Vertical(*column, row_shares=shares[: len(column)])
    raised = [name for key, (name, *_) in STATES.items() if key == "lidar_on" or _raised(run, key)]
    states = rrb.StateTimelineView(
        origin="states", contents=[f"$origin/{name}" for name in raised], name="States", time_view=whole
    )
    about = rrb.Vertical(states, rrb.TextDocumentView(origin="facts", name="Run"), row_shares=[1.0, 1.5])
    if lab is None:
        root = rrb.Horizontal(side, about, column_shares=[3.0, 1.0])
    else:
        below = rrb.Horizontal(_robot_view(), about)
        left = rrb.Vertical(_lab_view(lab, heading), below, row_shares=[2.2, 1.0])
        root = rrb.Horizontal(left, side, column_shares=[3.0, 2.0])
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
    )


def _raised(run: Run, column: str) -> bool:
    return column in run.columns and bool(run[column].any())


def _plot(run: Run, panel: Panel, series: list[Series], whole: rrb.TimeAxis) -> rrb.TimeSeriesView:
    """The series of a panel, its legend in the corner where it needs least room of its own."""
    values = np.column_stack([run[s.column].reshape(run.rows, -1)[:, s.part] for s in series])
    legend = len(series) > 1
    corner, ends = rrb.Corner2D.LeftTop, value_range(values)
    if legend and ends:
        height = min(_LEGEND_MOST, len(series) * _LEGEND_ROW * (1.0 if panel is PANELS[0] else 1.6))
        width = _LEGEND_WIDTH + _LEGEND_LETTER * max(len(s.name) for s in series)
        corner, ends = legend_corner(values, run["t"], ends, (width, height))
    return rrb.TimeSeriesView(
        origin=panel.entity,
        name=panel.title,
        axis_x=whole,
        axis_y=rrb.ScalarAxis(range=ends) if ends else None,
        plot_legend=rrb.PlotLegend(corner, visible=legend),
    )


def value_range(values: Array) -> tuple[float, float] | None:
    """Ends of a plot's axis: room beyond the values, and beyond every tick, so that no label is cut.

    Args:
        values: What is plotted, any shape; nan is not.

    Returns:
        Least and greatest value of the axis; none for values that do not vary, where the viewer's own
        choice is as good.
    """
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


def legend_corner(
    values: Array, t: Array, ends: tuple[float, float], size: tuple[float, float]
) -> tuple[rrb.Corner2D, tuple[float, float]]:
    """The corner in which a legend hides no line, and the axis that this takes.

    Args:
        values: Series of a plot, shape (N, S).
        t: Their times, ascending [s], shape (N,).
        ends: Ends of the axis that all values fit in.
        size: Width and height of the legend, as shares of the plot.

    Returns:
        The corner for which the axis grows least, and the ends of the axis then. A hundredth of the
        readings beside the legend may be under it: the ramp with which a run begins.
    """
    low, high = ends
    width, height = size
    span = (t[-1] - t[0]) * width
    found = []
    for corner, beside in (
        (rrb.Corner2D.LeftTop, t <= t[0] + span),
        (rrb.Corner2D.RightTop, t >= t[-1] - span),
        (rrb.Corner2D.LeftBottom, t <= t[0] + span),
        (rrb.Corner2D.RightBottom, t >= t[-1] - span),
    ):
        part = values[beside]
        part = part[np.isfinite(part)]
        if corner in (rrb.Corner2D.LeftTop, rrb.Corner2D.RightTop):
            most = float(np.quantile(part, 0.99)) if part.size else low
            grown = (low, max(high, (most - height * low) / (1 - height)))
        else:
            least = float(np.quantile(part, 0.01)) if part.size else high
            grown = (min(low, (least - height * high) / (1 - height)), high)
        found.append((grown[1] - grown[0], corner, grown))
    _, corner, grown = min(found, key=lambda f: f[0])
    return corner, grown


def lab_eye(lab: LabSpec) -> tuple[Vec3, Vec3]:
    """Position and target of the eye that sees a lab whole [m], in world.

    It is above the near edge of the floor, inside the capture frame, so that no rail crosses the floor.
    """
    x, y = lab.floor_m
    height = max(0.9 * max(x, 1.7 * y), 1.5 * lab.post_height_m)
    return (0, -0.45 * y, height), (0, -0.09 * y, 0)


def _lab_view(lab: LabSpec, heading: float) -> rrb.Spatial3DView:
    """The lab seen whole."""
    position, target = lab_eye(lab)
    return _view_3d(
        "world",
        f"Lab: map of the total field at heading {np.degrees(heading):.4g}°, readings along the path",
        position=position,
        look_target=target,
    )


def _robot_view() -> rrb.Spatial3DView:
    """The robot from behind its left shoulder; the view's axes are the robot's, so that it stays in sight."""
    return _view_3d("world/robot", "Robot", position=(-0.62, 0.42, 0.55), look_target=(0.08, 0, 0.17))


def _view_3d(
    origin: str, name: str, *, position: tuple[float, ...], look_target: tuple[float, ...]
) -> rrb.Spatial3DView:
    """The world in the axes of `origin`, from a position [m]; readings appear as time goes on."""
    so_far = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial3DView(
        origin=origin,
        contents="/world/**",
        name=name,
        background=(24, 26, 31),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=look_target, eye_up=(0, 0, 1)),
        overrides={"world/readings": rrb.VisibleTimeRanges(so_far)},
    )
