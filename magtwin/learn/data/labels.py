"""Labels: measured field minus the map, and the standard deviation of the map there."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base, wrap_angle, yaw_from_quat
from magtwin.learn.data.alignment import Alignment, placed, slopes, usable
from magtwin.run.run import Column, Run

LABEL_COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "label_nt": Column("nT", "", "measured field less the map at the sensor; nan where there is none"),
        "label_sd_nt": Column("nT", "", "how well the map is known there, as a standard deviation"),
    }
)
"""Columns that `labelled` adds to a run beside those of `magtwin.run.run.COLUMNS`."""


def labelled(run: Run, field: AnomalyMap, alignment: Alignment | None = None) -> Run:
    """A run with its labels as columns: y = |B|measured - map(p(t - latency) + R(yaw) lever arm, yaw).

    label_nt and label_sd_nt are added; b_map_nt, b_map_gradient_nt_m and flag_outside_map are replaced by
    those of this map at the sensor's place, so that b_measured_nt = b_map_nt + label_nt. label_sd_nt is the
    map's own standard deviation, with its gradient times the uncertainty of the alignment. The pose is that
    of motion capture if the run has it, else the true pose; a run without yaw gets that of motion capture. A
    reading has no label off the map, on masked nodes, without lock or pose, or without a measurement.

    Raises:
        InputError: The run lacks a column, or no reading has a label.
    """
    alignment = alignment or Alignment()
    p, yaw, rates = placed(run, alignment)
    if field.variance_nt2 is None:
        (value, gradient), variance = field.lookup_with_gradient(p, yaw), np.zeros(run.rows)
    else:
        value, sd, gradient = field.lookup_all(p, yaw)
        variance = sd**2
    if any(alignment.lever_arm_sd_m) or alignment.latency_sd_s:
        sds = np.array([*alignment.lever_arm_sd_m, alignment.latency_sd_s])
        variance = variance + np.sum((sds * slopes(gradient, yaw, rates)) ** 2, axis=1)
    label = np.where(usable(run), run["b_measured_nt"], np.nan) - value
    if not np.isfinite(label).any():
        low_x, high_x, low_y, high_y = field.extent
        p = run["mocap_p"] if "mocap_p" in run else run["p_world_base"]
        seen = [f"{np.nanmin(v):.2f} to {np.nanmax(v):.2f}" for v in p[:, :2].T if np.isfinite(v).any()]
        raise InputError(
            f"none of {run.rows} readings has a label on the map {field.name!r} (x {low_x:g} to {high_x:g}, "
            f"y {low_y:g} to {high_y:g} m): the robot was at x, y {', '.join(seen) or 'unknown'} m, "
            f"{int(np.isfinite(run['b_measured_nt']).sum())} readings hold a field, "
            f"{int((~usable(run)).sum())} had no lock or no pose; name the map of its lab, in its frame"
        )
    columns: dict[str, NDArray[Any]] = {
        "b_map_nt": value,
        "b_map_gradient_nt_m": into_base(gradient[:, :2], yaw),
        "flag_outside_map": np.isnan(value),
        "label_nt": label,
        "label_sd_nt": np.where(np.isfinite(label), np.sqrt(variance), np.nan),
    }
    if "yaw" not in run:
        columns["yaw"] = wrap_angle(yaw_from_quat(run["mocap_q_xyzw"]))
    return run.with_columns(**columns).with_specs(**LABEL_COLUMNS)
