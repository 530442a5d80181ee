"""Localization of runs from files: `magtwin localize` in Python."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.io.formats import read_run
from magtwin.io.surveys.maps import open_map
from magtwin.localize.localizers import load_localizer
from magtwin.localize.problem import (
    FieldBelief,
    Localizer,
    OdometryModel,
    Prior,
    Problem,
    SensorModel,
    Smoother,
)
from magtwin.localize.track import EST_COLUMNS, track
from magtwin.run.run import Run

RATE_HZ = 5.0
"""Default rate of readings that a localizer gets [Hz]."""


def localize(
    run: Run | str | os.PathLike[str],
    anomaly_map: FieldBelief | str | os.PathLike[str] | None,
    *,
    method: str | Localizer | Smoother = "rbpf",
    options: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
    sensor: SensorModel | None = None,
    odometry: OdometryModel | None = None,
    map_length_m: float = 0.3,
    rate_hz: float | None = RATE_HZ,
    seed: int = 0,
    progress: Callable[[int, int], Any] | None = None,
) -> Run:
    """Estimate the pose of a robot along a run from its magnetometer and odometry.

    Args:
        run: A run with the columns `b_measured_nt`, `odom_p` and `odom_q_xyzw`, or its file.
        anomaly_map: The map, its layer or stage, or any `FieldBelief`. None: no map (SLAM).
        method: A name in `magtwin.localize.localizers.LOCALIZERS`, "module:Class", or an object.
        options: Keyword arguments of the method's class.
        prior: The pose at the first reading. Default: the true pose of the run, known to 0.1 m and 5 deg.
        sensor: Noise model of the magnetometer. Default: `SensorModel()`, with the lever arm in the run's
            metadata.
        odometry: Noise model of the odometry.
        map_length_m: Correlation length of the map's error [m].
        rate_hz: Readings per second that the method gets [Hz]. None: all.
        seed: Seed of the method.
        progress: Called as progress(readings done, all readings).

    Returns:
        The run at `rate_hz` with the columns `EST_COLUMNS`.

    Raises:
        InputError: A file or a column is missing, there is no prior and no true pose, or the method fails.
    """
    if not isinstance(run, Run):
        run = read_run(Path(run))
    if isinstance(anomaly_map, str | os.PathLike):
        anomaly_map = open_map(Path(anomaly_map))
    if rate_hz is not None and run.rows > 1 and 1.01 * rate_hz < (run.rows - 1) / run.duration_s:
        run = thinned(run, rate_hz)
    algorithm = load_localizer(method, options) if isinstance(method, str) else method
    problem = Problem(
        belief=anomaly_map,
        extent=extent_of(run, anomaly_map),
        prior=prior or prior_of(run),
        sensor=sensor or SensorModel(lever_arm_m=lever_arm_of(run)),
        odometry=odometry or OdometryModel(),
        map_length_m=map_length_m,
        rate_hz=rate_hz or (run.rows - 1) / run.duration_s,
        seed=seed,
    )
    made = track(algorithm, problem, run, progress=progress)
    name = method if isinstance(method, str) else type(method).__name__
    estimated = run.with_columns(**made.columns()).with_specs(**EST_COLUMNS)
    return estimated.with_metadata(localizer=name, localizer_seed=seed)


def thinned(run: Run, rate_hz: float) -> Run:
    """The latest row of a run at each tick of a slower clock, which starts at its first row."""
    t = run["t"]
    ticks = t[0] + np.arange(int((t[-1] - t[0]) * rate_hz + 1e-9) + 1) / rate_hz
    return run.take(np.unique(np.searchsorted(t, ticks + 1e-9, side="right") - 1))


def prior_of(run: Run) -> Prior:
    """The first true pose of a run, known to 0.1 m and 5 deg.

    Raises:
        InputError: The run has no true pose.
    """
    if "p_world_base" not in run or "yaw" not in run or not np.isfinite(run["p_world_base"][0]).all():
        raise InputError("the run has no true pose to start from; give `prior`", parameter="prior")
    x, y = run["p_world_base"][0, :2].tolist()
    return Prior(mean=(x, y, float(run["yaw"][0])))


def lever_arm_of(run: Run) -> tuple[float, float]:
    """Place of the magnetometer in base_link from the metadata of a run; (0, 0) if it is not there."""
    words = str(run.metadata.get("sensor_m", "")).split(",")
    return (float(words[0]), float(words[1])) if len(words) == 3 else (0.0, 0.0)


def extent_of(run: Run, belief: FieldBelief | None) -> tuple[float, float, float, float]:
    """Extent of a map; else that of the true poses, or of the odometry, with 1 m around it."""
    if isinstance(belief, AnomalyMap):
        return belief.extent
    p = run["p_world_base" if "p_world_base" in run else "odom_p"][:, :2]
    (x0, y0), (x1, y1) = np.nanmin(p, axis=0) - 1.0, np.nanmax(p, axis=0) + 1.0
    return float(x0), float(x1), float(y0), float(y1)
