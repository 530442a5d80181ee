"""Calibrate a mixed model by a short labelled drive at the start of a session."""

import datetime
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import CalibrationWarning, InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import shipped
from magtwin.frames import yaw_from_quat
from magtwin.learn.data.alignment import alignment_of
from magtwin.learn.data.features import columns_of, features
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.origin import same_map
from magtwin.learn.data.recording import Source, read, session_name
from magtwin.learn.mixed.effects import RATE_HZ, thinned_rows
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.weights import MetadataValue
from magtwin.run.run import COLUMNS, Run
from magtwin.run.thinning import newest

Array = NDArray[np.float64]

SHORT_S = 30.0
"""Length of a drive below which a warning is given [s]."""

LEAST_READINGS = 20
"""Least number of labelled readings, at most 4 a second, that a model is calibrated by."""

SECTORS, FEW_SECTORS = 12, 6
"""Sectors that headings are counted in, and the number below which a warning is given."""

MOST_SD_M = 1000.0
"""Largest standard deviation of a position [m]."""

FROM_MAP = "pose_from_map"
"""Metadata of a run whose poses were estimated on a magnetic map."""


@dataclass(frozen=True)
class LabelledDrive:
    """Readings of a drive with labels."""

    t: Array
    """Times [s], shape (N,)."""

    x: Array
    """Features, shape (N, F)."""

    y: Array
    """Labels: measured field minus the map [nT], shape (N,); nan if unknown."""

    yaw: Array
    """Headings [rad], shape (N,)."""

    gradient_nt_m: Array
    """Gradient of the map, forward and left [nT/m], shape (N, 2)."""

    def pose_variance_nt2(self, pose_sd_m: float) -> Array:
        """Variance of the labels by errors of the pose [nT^2], shape (N,): (|gradient| sd)^2."""
        return np.asarray(np.sum(self.gradient_nt_m**2, axis=1) * pose_sd_m**2)

    def part(self, rows: NDArray[np.bool_]) -> "LabelledDrive":
        """Some of its readings."""
        return LabelledDrive(*(values[rows] for values in vars(self).values()))


def labelled_drive(
    model: Predictor,
    run: Run,
    field: AnomalyMap,
    *,
    rate_hz: float | None = RATE_HZ,
    name: str = "the drive",
) -> LabelledDrive:
    """Features and labels of a drive on a map, with the lever arm and latency in a model's metadata.

    At most `rate_hz` readings a second are taken. A drive without labels on the map, with readings of a
    network, or without a column of the model is refused by its `name`.
    """
    run = read(Source(name, lambda: run))
    try:
        run = labelled(run, field, alignment_of(model.metadata, "the model"))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    for column in columns_of(model.features):
        if column not in run:
            raise InputError(f"{name} has no column {column!r}, which the model reads")
    x = features(run, model.features)
    y = np.where(np.isfinite(x).all(axis=1), run["label_nt"], np.nan)
    at = np.arange(run.rows)
    if rate_hz is not None:
        at = newest(thinned_rows(run["t"], rate_hz), np.isfinite(y))
    yaw = yaw_from_quat(run["mocap_q_xyzw"]) if "mocap_q_xyzw" in run else run["yaw"]
    return LabelledDrive(run["t"][at], x[at], y[at], yaw[at], run["b_map_gradient_nt_m"][at])


def calibrate(
    model: Predictor,
    run: Run,
    field: AnomalyMap,
    *,
    duration_s: float | None = None,
    pose_sd_m: float = 0.0,
    pose_from_map: bool = False,
    parent: Mapping[str, MetadataValue] | None = None,
    name: str = "",
    own_map: bool = True,
) -> Mixed:
    """Calibrate a mixed model by a labelled drive: `magtwin.calibrate` for a model and a run.

    `parent` is metadata about the file of the model, `name` that of the drive. With `own_map` another map
    than that of the training is warned of.
    """
    what = name or "the drive"
    whole = mixed_of_kind(model)
    model = whole.reading(known_columns(run))
    check_pose_sd(pose_sd_m)
    if duration_s is not None and not 0 < duration_s < math.inf:
        raise InputError(f"duration_s must be above 0 s and finite, got {duration_s!r}")
    drive = labelled_drive(model, run, field, name=what)
    end = math.inf if duration_s is None else drive.t[0] + duration_s
    drive = drive.part(np.isfinite(drive.y) & (drive.t <= end))
    if len(drive.t) < LEAST_READINGS:
        longer = "" if duration_s is None else ", or raise `duration_s`"
        raise InputError(
            f"{what}: {len(drive.t)} labelled readings at most 4 a second, and {LEAST_READINGS} are needed; "
            f"drive for a minute on the map, in curves{longer}"
        )
    cautions = _cautions(drive, run, pose_from_map=pose_from_map)
    if absent := [c for c in columns_of(whole.features) if c not in columns_of(model.features)]:
        cautions.append(f"it has no {', '.join(absent)}; what they would show counts as error")
    if own_map and "map_samples_nt" in model.metadata and not same_map(model.metadata, field):
        cautions.append(
            f"the model was trained on the map {model.metadata.get('map', '')!r} and is calibrated on "
            f"another, {field.name!r}; use its own map"
        )
    for text in cautions:
        warnings.warn(f"{what}: {text}", CalibrationWarning, stacklevel=2)
    extra = drive.pose_variance_nt2(pose_sd_m)
    calibrated = model.calibrated(model.regressors(drive.x), drive.y, drive.t, extra)
    before = model.open_loop().predict(drive.x)[0] - drive.y
    metadata: dict[str, MetadataValue] = {
        **calibrated.metadata,
        **(parent or {}),
        "calibration_drive": name,
        "calibration_session": session_name(run.metadata),
        "calibration_date": _date(run),
        "calibration_start_s": float(drive.t[0]),
        "calibration_duration_s": float(drive.t[-1] - drive.t[0]),
        "calibration_readings": len(drive.t),
        "calibration_pose_sd_m": pose_sd_m,
        "calibration_map": field.name,
        "calibration_residual_before_nt": float(np.sqrt(np.mean(before**2))),
        "calibration_residual_nt": calibrated.residual_sd_nt,
        "calibration_warnings": "; ".join(cautions),
    }
    known = {key: value for key, value in metadata.items() if value != "" and value == value}  # not nan
    calibrated.metadata = known
    return calibrated


def known_columns(run: Run) -> set[str]:
    """Columns of a run with numbers in them, and those that labels add."""
    known = {name for name, column in run.columns.items() if name in COLUMNS and _known(column)}
    return known | {"yaw", "b_map_gradient_nt_m"}


def _known(column: NDArray[Any]) -> bool:
    return column.dtype.kind != "f" or bool(np.isfinite(column).any())


def _date(run: Run) -> str:
    """Date of a recorded bag, or that in the metadata; "" if neither is known."""
    start = str(run.metadata.get("start_ns", ""))
    if start.isdigit():
        return datetime.datetime.fromtimestamp(int(start) // 10**9, datetime.UTC).date().isoformat()
    return str(run.metadata.get("date", ""))


def shipped_mixed() -> Path:
    """The weights of the mixed model that ships, trained on sessions and plants of the TurtleBot 4."""
    return shipped("weights", "turtlebot4_mixed.safetensors")


def mixed_of_kind(model: Predictor) -> Mixed:
    """The model, if it is a mixed one.

    Raises:
        InputError: It is of another kind.
    """
    if not isinstance(model, Mixed):
        raise InputError(
            f"a model of the kind {model.kind!r} has no effects of a session; take the one that ships, "
            "turtlebot4_mixed.safetensors, or train one with --model mixed"
        )
    return model


def check_pose_sd(pose_sd_m: float) -> None:
    """Refuse a standard deviation of positions below 0, or above `MOST_SD_M`."""
    if not 0 <= pose_sd_m <= MOST_SD_M:
        raise InputError(f"pose_sd_m must be between 0 and {MOST_SD_M:g} m, got {pose_sd_m!r}")


def _cautions(drive: LabelledDrive, run: Run, *, pose_from_map: bool) -> list[str]:
    """Reasons why a calibration may be poor."""
    cautions = []
    seconds = float(drive.t[-1] - drive.t[0])
    if seconds < SHORT_S:
        cautions.append(f"it lasts {seconds:.0f} s, and {SHORT_S:.0f} s are needed; drive for a minute")
    sectors = len(np.unique(np.floor(drive.yaw / (2 * np.pi / SECTORS)) % SECTORS))
    if sectors < FEW_SECTORS:
        cautions.append(
            f"its headings lie in {sectors} of {SECTORS} sectors of {360 // SECTORS} deg; "
            "turn to all sides, because iron on the robot shows only by its heading"
        )
    if pose_from_map or str(run.metadata.get(FROM_MAP, "")).lower() in ("true", "1", "yes"):
        cautions.append(
            "its poses were estimated on the magnetic map, so the calibration is circular: an error of the "
            "disturbance moves the poses and hides; use poses of another source"
        )
    return cautions
