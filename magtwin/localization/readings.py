"""Readings: the on-board columns of a run, one row at a time."""

import math
from collections.abc import Iterator

import numpy as np

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


def readings_of(run: Run) -> Iterator[Reading]:
    """The readings of a run, one per row, in order.

    Args:
        run: A run with the columns `NEEDED`. Columns that are not on board are not passed on.

    Raises:
        InputError: As for `onboard`.
    """
    run = onboard(run)
    t, b, p = run["t"].tolist(), run["b_measured_nt"].tolist(), run["odom_p"][:, :2].tolist()
    yaw = np.unwrap(yaw_from_quat(run["odom_q_xyzw"])).tolist()
    rows = run.rows
    disturbance = run["disturbance_nt"].tolist() if "disturbance_nt" in run else [0.0] * rows
    sd = run["disturbance_sd_nt"].tolist() if "disturbance_sd_nt" in run else [0.0] * rows
    columns = [
        (name, values.tolist() if values.ndim == 1 else list(values.copy())) for name, values in run.items()
    ]
    for k in range(rows):
        signals = {
            name: values[k].copy() if isinstance(values[k], np.ndarray) else values[k]
            for name, values in columns
        }
        known = math.isfinite(disturbance[k])
        yield Reading(
            t[k],
            b[k],
            (p[k][0], p[k][1], yaw[k]),
            disturbance[k] if known else 0.0,
            sd[k] if known and math.isfinite(sd[k]) else 0.0,
            signals,
        )
