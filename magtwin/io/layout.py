"""Layout: which plots and views a recording opens with, and what they show."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magtwin.run import Run
from magtwin.spec import LabSpec

TIMELINE = "sim_time"
"""Name of the timeline that a recording runs on."""


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
    plots = [
        rrb.TimeSeriesView(
            origin=panel.entity,
            name=panel.title,
            axis_x=whole,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=len(series) > 1),
        )
        for panel in PANELS
        if (series := known_series(run, panel))
    ]
    wide, narrow = plots[:4], plots[4:]
    column: list[Any] = [*wide, *([rrb.Horizontal(*narrow)] if narrow else [])]
    shares = [2.6, 1.5, 1.5, 1.5, 1.2]
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


def _lab_view(lab: LabSpec, heading: float) -> rrb.Spatial3DView:
    """The lab seen whole, so steeply that the near rail of the capture frame stays off the floor."""
    x, y = lab.floor_m
    away = max(x, 1.7 * y)
    return _view_3d(
        "world",
        f"Lab: map of the total field at heading {np.degrees(heading):.4g}°, readings along the path",
        position=(0, -0.37 * away, 0.85 * away),
        look_target=(0, -0.05 * away, 0),
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
