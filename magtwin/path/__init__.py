"""Paths: what a robot drives, and the room that it must fit into."""

from magtwin.path.curves import (
    CASES,
    PATHS,
    continuous_cycle,
    curvilinear,
    curvilinear_2,
    fast_sine,
    figure8,
    lawnmower,
    loops,
    narrow_figure8,
    path,
    path_named,
    sine,
    split_lawnmower,
)
from magtwin.path.points import path_of_points, read_path_csv, resolve_path
from magtwin.path.polyline import Path
from magtwin.path.room import Room, check_clear, check_on_floor, coverage, fit_path, path_in

__all__ = [
    "CASES",
    "PATHS",
    "Path",
    "Room",
    "check_clear",
    "check_on_floor",
    "continuous_cycle",
    "coverage",
    "curvilinear",
    "curvilinear_2",
    "fast_sine",
    "figure8",
    "fit_path",
    "lawnmower",
    "loops",
    "narrow_figure8",
    "path",
    "path_in",
    "path_named",
    "path_of_points",
    "read_path_csv",
    "resolve_path",
    "sine",
    "split_lawnmower",
]
