"""Run: what happened, one table on one clock, with unit and frame on every column."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError, find
from magtwin.report import Figure, Report


@dataclass(frozen=True)
class Column:
    """What a column of a Run holds."""

    unit: str
    """SI unit, "nT" for fields, "" for numbers without one, "bool" for flags."""

    frame: str
    """Frame its vectors are given in, "" where none applies."""

    doc: str
    """What it is, in a line."""

    width: int = 1
    """Numbers a row: 1 gives an array of shape (N,), more gives (N, width)."""

    parts: tuple[str, ...] = ()
    """Names of the numbers of a row, such as x, y, z; as many as `width` where width > 1."""


_XYZ, _XYZW, _SIDES = ("x", "y", "z"), ("x", "y", "z", "w"), ("left", "right")

COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "t": Column("s", "", "simulation time of the magnetometer reading"),
        "p_world_base": Column("m", "world", "true position of base_link", 3, _XYZ),
        "q_world_base_xyzw": Column("", "world", "true orientation of base_link", 4, _XYZW),
        "yaw": Column("rad", "world", "true heading of base_link, in [-pi, pi)"),
        "v_base": Column("m/s", "base_link", "true linear velocity", 3, _XYZ),
        "w_base": Column("rad/s", "base_link", "true angular velocity", 3, _XYZ),
        "v_cmd": Column("m/s", "base_link", "commanded forward speed"),
        "w_cmd": Column("rad/s", "base_link", "commanded yaw rate"),
        "wheel_angle": Column("rad", "", "angle turned by each wheel", 2, _SIDES),
        "odom_p": Column("m", "odom", "odometry's position", 3, _XYZ),
        "odom_q_xyzw": Column("", "odom", "odometry's orientation", 4, _XYZW),
        "odom_v": Column("m/s", "base_link", "odometry's linear velocity", 3, _XYZ),
        "odom_w": Column("rad/s", "base_link", "odometry's angular velocity", 3, _XYZ),
        "imu_q_xyzw": Column("", "imu_link", "IMU's orientation, w >= 0", 4, _XYZW),
        "imu_w": Column("rad/s", "imu_link", "gyroscope", 3, _XYZ),
        "imu_a": Column("m/s2", "imu_link", "accelerometer, gravity removed", 3, _XYZ),
        "mocap_p": Column("m", "world", "motion capture's position of base_link", 3, _XYZ),
        "mocap_q_xyzw": Column("", "world", "motion capture's orientation of base_link, w >= 0", 4, _XYZW),
        "battery_v": Column("V", "", "battery voltage"),
        "battery_a": Column("A", "", "battery current, above 0 when it is discharged"),
        "battery_fraction": Column("", "", "charge left, 0 to 1"),
        "lidar_on": Column("bool", "", "whether the LiDAR spins"),
        "b_map_nt": Column("nT", "", "anomaly map at the true pose"),
        "b_disturbance_nt": Column("nT", "", "disturbance by the network, by physics, or none"),
        "b_total_nt": Column("nT", "", "b_map_nt + b_disturbance_nt"),
        "b_noise_nt": Column("nT", "", "the sensor's own error; nan where it gave no reading"),
        "b_measured_nt": Column("nT", "", "b_total_nt + b_noise_nt, in steps of the sensor's resolution"),
        "b_sd_nt": Column("nT", "", "predicted standard deviation of b_measured_nt; nan where unknown"),
        "b_vector_nt": Column("nT", "magnetometer", "exact field vector; nan where unknown", 3, _XYZ),
        "b_vector_measured_nt": Column(
            "nT", "magnetometer", "latest reading of each vector axis; nan where there is none", 3, _XYZ
        ),
        "b_truth_nt": Column("nT", "", "exact field magnitude at the sensor; nan where unknown"),
        "flag_bump": Column("bool", "", "the footprint touched an obstacle"),
        "flag_outside_map": Column("bool", "", "the pose lies outside the map, or on masked nodes"),
        "flag_pose_lost": Column("bool", "", "motion capture had lost the robot; its last pose is held"),
        "flag_out_of_distribution": Column("bool", "", "an input left the network's training range"),
        "flag_lost_lock": Column("bool", "", "the magnetometer lost lock"),
    }
)
"""Every column that magtwin itself writes, in the order of the table. A localizer adds `est_*`.

Every error has an address, as where all are known

    b_total_nt = b_map_nt + b_disturbance_nt
    b_measured_nt = b_total_nt + b_noise_nt
    b_truth_nt = |b_vector_nt|, and = b_total_nt of a physical magnetometer

So b_total_nt - b_truth_nt is the error of a neural or a map-only magnetometer's model, b_truth_nt - b_map_nt
what the map does not know, b_noise_nt the sensor's, and b_vector_measured_nt - b_vector_nt its vector axes'.
"""


@dataclass(frozen=True)
class Run(Mapping[str, NDArray[Any]]):
    """A table of equally long columns, and the facts under which it came about.

    A mapping from column name to array: `run["b_total_nt"]` has shape (N,), `run["p_world_base"]`
    has shape (N, 3). `bool` columns have dtype bool, all others float64. Runs are not changed in
    place: `with_columns` gives a new one that shares the other arrays.
    """

    columns: Mapping[str, NDArray[Any]]
    """Arrays by column name, in the order of the table; all (N,) or (N, width)."""

    facts: Mapping[str, str | int | float | bool] = field(default_factory=dict)
    """What produced the run: scene, path, seed, network, map, versions."""

    def __post_init__(self) -> None:
        arrays = {name: _column(name, values) for name, values in self.columns.items()}
        rows = {name: len(values) for name, values in arrays.items()}
        if len(set(rows.values())) > 1:
            raise RefusedError(f"columns of a Run must be equally long, got {rows}")
        object.__setattr__(self, "columns", MappingProxyType(arrays))
        object.__setattr__(self, "facts", MappingProxyType(dict(self.facts)))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return find("column", name, self.columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        """Number of columns, as for any mapping; rows are counted by `rows`."""
        return len(self.columns)

    @property
    def rows(self) -> int:
        """Number of readings, N."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last [s]."""
        return float(self["t"][-1] - self["t"][0]) if self.rows else 0.0

    def with_columns(self, **columns: NDArray[Any]) -> "Run":
        """This run with columns added, or replaced in their place."""
        return Run({**self.columns, **columns}, self.facts)

    def with_facts(self, **facts: str | int | float | bool) -> "Run":
        """This run with facts added or replaced."""
        return Run(self.columns, {**self.facts, **facts})

    def report(self, title: str = "Run") -> Report:
        """What happened, in a few figures; columns that the run does not have are passed over."""
        figures = [Figure("duration", self.duration_s, "s"), Figure("readings", self.rows)]
        if "p_world_base" in self:
            steps = np.diff(self["p_world_base"][:, :2], axis=0)
            figures.append(Figure("distance driven", float(np.hypot(*steps.T).sum()), "m"))
        for name in ("b_total_nt", "b_map_nt", "b_disturbance_nt"):
            values = self.columns.get(name, np.array([]))
            values = values[np.isfinite(values)]
            if len(values):
                note = f"{values.min():.0f} to {values.max():.0f}"
                figures.append(Figure(name, float(values.mean()), "nT", float(values.std()), note))
        error = (
            self["b_total_nt"] - self["b_truth_nt"]
            if {"b_total_nt", "b_truth_nt"} <= set(self)
            else np.array([])
        )
        if np.nanmax(np.abs(error), initial=0.0) > 0:
            note = "mean absolute difference of b_total_nt from b_truth_nt"
            figures.append(Figure("error", float(np.nanmean(np.abs(error))), "nT", None, note))
        raised = [name for name in self if name.startswith("flag_") and self[name].any()]
        figures += [
            Figure(n, int(self[n].sum()), "readings", None, COLUMNS[n].doc if n in COLUMNS else "")
            for n in raised
        ]
        return Report(title, tuple(figures), dict(self.facts))


def _column(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """`values` in the dtype and shape that COLUMNS gives `name`; names unknown to it stay as they are."""
    spec = COLUMNS.get(name)
    if spec is None:
        return np.asarray(values)
    array = np.asarray(values, bool if spec.unit == "bool" else float)
    shape = (len(array),) if spec.width == 1 else (len(array), spec.width)
    if array.shape != shape:
        raise RefusedError(f"column {name!r} must have shape {shape}, got {array.shape}")
    return array
