"""Readings: the on-board columns of a run, one row at a time."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import yaw_from_quat
from magtwin.localization.problem import Reading
from magtwin.run.run import Run
from magtwin.run.thinning import field_known

ONBOARD = (
    "t",
    "v_cmd",
    "w_cmd",
    "odom_p",
    "odom_q_xyzw",
    "odom_v",
    "odom_w",
    "imu_q_xyzw",
    "imu_w",
    "imu_a",
    "battery_v",
    "battery_a",
    "battery_fraction",
    "lidar_on",
    "b_measured_nt",
    "b_vector_measured_nt",
    "flag_lost_lock",
    "disturbance_nt",
    "disturbance_sd_nt",
)
"""Columns that a robot knows. `disturbance_nt` and its sd come from a compensator."""

NEEDED = ("t", "b_measured_nt", "odom_p", "odom_q_xyzw")


def onboard(run: Run) -> Run:
    """A copy of the on-board columns of a run, without its other columns and its metadata.

    `b_measured_nt` is nan where the magnetometer had lost lock.

    Raises:
        InputError: A column that localization needs is missing, or the clock does not ascend.
    """
    for name in NEEDED:
        if name not in run:
            raise InputError(f"the run has no column {name!r}, which localization needs")
    t = run["t"]
    if not len(t) or not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise InputError("the run has no time that ascends from row to row")
    if not (np.isfinite(run["odom_p"]).all() and np.isfinite(run["odom_q_xyzw"]).all()):
        row = int(
            np.argmin(np.isfinite(run["odom_p"]).all(axis=1) & np.isfinite(run["odom_q_xyzw"]).all(axis=1))
        )
        raise InputError(f"the odometry of row {row} is not finite; cut the run with `magtwin convert`")
    kept = {name: np.array(run[name]) for name in ONBOARD if name in run}
    kept["b_measured_nt"][~field_known(run)] = np.nan
    return Run(kept, specs={name: run.spec(name) for name in kept})


Layout = tuple[tuple[str, int, str], ...]
"""Name, width (0 for plain numbers) and kind of numpy of each column, in the order of a packed row."""

_FIRST = 7  # t, b_nt, the odometry, the disturbance and its sd stand before the columns
_PLAIN = {"b": bool, "i": int, "u": int}


def packed(run: Run) -> tuple[Layout, NDArray[np.float64]]:
    """The readings of a run as numbers alone, one row per reading, and what is where in a row.

    Args:
        run: A run with the columns `NEEDED`. Columns that are not on board are not passed on.

    Raises:
        InputError: As for `onboard`.
    """
    run = onboard(run)
    known, zero = np.ones(run.rows, bool), np.zeros(run.rows)
    if "disturbance_nt" in run:
        known = np.isfinite(run["disturbance_nt"])
    disturbance, sd = (
        np.where(known & np.isfinite(values), values, 0.0)
        for values in (run.get(name, zero) for name in ("disturbance_nt", "disturbance_sd_nt"))
    )
    yaw = np.unwrap(yaw_from_quat(run["odom_q_xyzw"]))
    first = run["t"], run["b_measured_nt"], run["odom_p"][:, :2], yaw, disturbance, sd
    layout = tuple((name, v.shape[1] if v.ndim > 1 else 0, v.dtype.str) for name, v in run.items())
    return layout, np.column_stack([*first, *run.values()]).astype(float)


def unpacked(layout: Layout, row: Sequence[float]) -> Reading:
    """The reading of a packed row."""
    signals: dict[str, Any] = {}
    at = _FIRST
    for name, width, kind in layout:
        if width:
            signals[name] = np.array(row[at : at + width], kind)
        else:
            signals[name] = _PLAIN.get(kind[1], float)(row[at])
        at += width or 1
    t, b, x, y, yaw, disturbance, sd = row[:_FIRST]
    return Reading(t, b, (x, y, yaw), disturbance, sd, signals)


def readings_of(run: Run) -> Iterator[Reading]:
    """The readings of a run, one per row, in order; the argument and refusals are those of `packed`."""
    layout, rows = packed(run)
    for row in rows.tolist():
        yield unpacked(layout, row)
