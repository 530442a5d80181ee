"""Run: what happened, one table on one clock, with unit and frame on every column."""

import fnmatch
import importlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.report import Figure, Report
from magtwin.run.resample import RULES, Interpolation, bracket, check_instants, grid
from magtwin.run.summary import run_summary
from magtwin.summary import Summarized, Summary
from magtwin.verdict import HOLDS_ONE, Tally

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import xarray as xr
    from matplotlib.figure import Figure as Picture

Metadata = Mapping[str, str | int | float | bool]


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

    interpolation: Interpolation = "linear"
    """How it is read between two rows; "hold" where only what was known by then counts."""


_XYZ, _XYZW = ("x", "y", "z"), ("x", "y", "z", "w")
_SIDES, _PLANE = ("left", "right"), ("forward", "left")

COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "t": Column("s", "", "simulation time of the magnetometer reading"),
        "p_world_base": Column("m", "world", "true position of base_link", 3, _XYZ),
        "q_world_base_xyzw": Column(
            "", "world", "true orientation of base_link", 4, _XYZW, interpolation="quaternion"
        ),
        "yaw": Column("rad", "world", "true heading of base_link, in [-pi, pi)", interpolation="angle"),
        "v_base": Column("m/s", "base_link", "true linear velocity", 3, _XYZ),
        "w_base": Column("rad/s", "base_link", "true angular velocity", 3, _XYZ),
        "v_cmd": Column("m/s", "base_link", "commanded forward speed", interpolation="hold"),
        "w_cmd": Column("rad/s", "base_link", "commanded yaw rate", interpolation="hold"),
        "wheel_angle": Column("rad", "", "angle turned by each wheel", 2, _SIDES),
        "odom_p": Column("m", "odom", "odometry's position", 3, _XYZ, interpolation="hold"),
        "odom_q_xyzw": Column("", "odom", "odometry's orientation", 4, _XYZW, interpolation="hold"),
        "odom_v": Column("m/s", "base_link", "odometry's linear velocity", 3, _XYZ, interpolation="hold"),
        "odom_w": Column("rad/s", "base_link", "odometry's angular velocity", 3, _XYZ, interpolation="hold"),
        "imu_q_xyzw": Column("", "imu_link", "IMU's orientation, w >= 0", 4, _XYZW, interpolation="hold"),
        "imu_w": Column("rad/s", "imu_link", "gyroscope", 3, _XYZ, interpolation="hold"),
        "imu_a": Column("m/s2", "imu_link", "accelerometer, gravity removed", 3, _XYZ, interpolation="hold"),
        "mocap_p": Column(
            "m", "world", "motion capture's position of base_link", 3, _XYZ, interpolation="hold"
        ),
        "mocap_q_xyzw": Column(
            "", "world", "motion capture's orientation of base_link, w >= 0", 4, _XYZW, interpolation="hold"
        ),
        "battery_v": Column("V", "", "battery voltage", interpolation="hold"),
        "battery_a": Column("A", "", "battery current, above 0 when it is discharged", interpolation="hold"),
        "battery_fraction": Column("", "", "charge left, 0 to 1", interpolation="hold"),
        "lidar_on": Column("bool", "", "whether the LiDAR spins", interpolation="hold"),
        "b_map_nt": Column("nT", "", "anomaly map at the true pose"),
        "b_map_gradient_nt_m": Column(
            "nT/m", "base_link", "what the anomaly map changes by along base_link's axes", 2, _PLANE
        ),
        "b_disturbance_nt": Column("nT", "", "disturbance by the network, by physics, or none"),
        "b_total_nt": Column("nT", "", "b_map_nt + b_disturbance_nt"),
        "b_model_error_nt": Column(
            "nT", "", "error drawn for a network's prediction; 0 without a network, or where none is drawn"
        ),
        "b_noise_nt": Column("nT", "", "the sensor's own error; nan where it gave no reading"),
        "b_measured_nt": Column(
            "nT", "", "b_total_nt + b_model_error_nt + b_noise_nt, in steps of the sensor's resolution"
        ),
        "b_sd_nt": Column("nT", "", "predicted standard deviation of b_measured_nt; nan where unknown"),
        "b_vector_nt": Column("nT", "magnetometer", "exact field vector; nan where unknown", 3, _XYZ),
        "b_vector_measured_nt": Column(
            "nT",
            "magnetometer",
            "latest reading of each vector axis; nan where there is none",
            3,
            _XYZ,
            interpolation="hold",
        ),
        "b_truth_nt": Column("nT", "", "exact field magnitude at the sensor; nan where unknown"),
        "flag_bump": Column("bool", "", "the footprint touched an obstacle", interpolation="hold"),
        "flag_outside_map": Column(
            "bool", "", "the pose lies outside the map, or on masked nodes", interpolation="hold"
        ),
        "flag_pose_lost": Column(
            "bool", "", "motion capture had lost the robot; its last pose is held", interpolation="hold"
        ),
        "flag_out_of_distribution": Column(
            "bool", "", "an input left the network's training range", interpolation="hold"
        ),
        "flag_lost_lock": Column("bool", "", "the magnetometer lost lock", interpolation="hold"),
    }
)
"""Every column that magtwin itself writes, in the order of the table. A localizer adds `est_*`.

Every error has an address, as where all are known

    b_total_nt = b_map_nt + b_disturbance_nt
    b_measured_nt = b_total_nt + b_model_error_nt + b_noise_nt
    b_truth_nt = |b_vector_nt|, and = b_total_nt of a physical magnetometer

So b_total_nt - b_truth_nt is the error of a neural or a map-only magnetometer's model, b_truth_nt - b_map_nt
what the map does not know, b_noise_nt the sensor's, and b_vector_measured_nt - b_vector_nt its vector axes'.
b_model_error_nt is a draw of such an error, with the standard deviation that the network gives: a reading is
as far from the mean as the network was from recordings that it never saw.
"""


@dataclass(frozen=True, repr=False)
class Run(Summarized, Mapping[str, NDArray[Any]]):
    """A table of equally long columns, and the metadata under which it came about.

    A mapping from column name to array: `run["b_total_nt"]` has shape (N,), `run["p_world_base"]`
    has shape (N, 3). `bool` columns have dtype bool, all others float64. Runs are not changed in
    place: every method that changes something gives a new one, which shares the arrays that it can.
    """

    columns: Mapping[str, NDArray[Any]]
    """Arrays by column name, in the order of the table; all (N,) or (N, width)."""

    metadata: Metadata = field(default_factory=dict)
    """What produced the run: scene, path, seed, network, map, versions."""

    specs: Mapping[str, Column] = field(default_factory=dict)
    """What columns of the user's own hold, of those that `COLUMNS` does not know."""

    def __post_init__(self) -> None:
        arrays = {name: _column(name, values) for name, values in self.columns.items()}
        rows = {name: len(values) for name, values in arrays.items()}
        if len(set(rows.values())) > 1:
            raise InputError(f"columns of a Run must be equally long, got {rows}")
        object.__setattr__(self, "columns", MappingProxyType(arrays))
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))
        own = {name: spec for name, spec in self.specs.items() if name in arrays and name not in COLUMNS}
        for name, spec in own.items():
            parts = arrays[name].shape[1] if arrays[name].ndim == 2 else 0
            if len(spec.parts) != parts:
                raise InputError(
                    f"column {name!r} has rows of {parts or 'no'} parts, and its spec names {len(spec.parts)}"
                )
        object.__setattr__(self, "specs", MappingProxyType(own))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return find("column", name, self.columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        """Number of columns, as for any mapping; rows are counted by `rows`."""
        return len(self.columns)

    def _ipython_key_completions_(self) -> list[str]:
        """Names of the columns, which IPython and Jupyter offer after `run["`."""
        return list(self.columns)

    @property
    def rows(self) -> int:
        """Number of readings, N."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last [s]."""
        return float(self["t"][-1] - self["t"][0]) if self.rows else 0.0

    def spec(self, name: str) -> Column:
        """What a column holds; for one that nobody described, what its values and its name tell."""
        values = self[name]
        known = COLUMNS.get(name) or self.specs.get(name)
        if known is not None:
            return known
        width = values.shape[1] if values.ndim > 1 else 1
        if name.endswith("_xyzw") and width == 4:
            return Column("", "", "", 4, _XYZW, interpolation="quaternion")
        parts = tuple(map(str, range(width))) if values.ndim > 1 else ()
        unit = "bool" if values.dtype.kind == "b" else ""
        whole = values.dtype.kind in "biu"
        return Column(unit, "", "", width, parts, interpolation="hold" if whole else "linear")

    def with_columns(self, **columns: NDArray[Any]) -> "Run":
        """This run with columns added, or replaced in their place."""
        return Run({**self.columns, **columns}, self.metadata, self.specs)

    def with_metadata(self, **metadata: str | int | float | bool) -> "Run":
        """This run with metadata added or replaced."""
        return Run(self.columns, {**self.metadata, **metadata}, self.specs)

    def with_specs(self, **specs: Column) -> "Run":
        """This run with columns of the user's own described."""
        return Run(self.columns, self.metadata, {**self.specs, **specs})

    def take(self, rows: "slice | NDArray[Any]") -> "Run":
        """Some of the rows: a slice, indices, or a mask of shape (N,)."""
        return Run({name: values[rows] for name, values in self.items()}, self.metadata, self.specs)

    def select(self, *names: str) -> "Run":
        """The columns of these names, in this order, behind the clock `t`, which always stays.

        Args:
            names: Names, or patterns such as "b_*".

        Raises:
            UnknownNameError: No column has the name, or fits the pattern.
        """
        kept = dict.fromkeys(["t"])
        for name in names:
            if name not in self and (found := fnmatch.filter(self, name)):
                kept |= dict.fromkeys(found)
            else:
                find("column", name, self.columns)
                kept[name] = None
        return self._derived(f"select({', '.join(names)})", {name: self[name] for name in kept})

    def between(self, start_s: float | None = None, end_s: float | None = None) -> "Run":
        """The rows from `start_s` on and before `end_s` [s of `t`]; none is the run's own start or end.

        As the end is left out, slices that follow each other hold every row once.

        Raises:
            InputError: The times are not ascending numbers, or no row lies between them.
        """
        t = check_instants(self["t"], "the run")
        start, end = -math.inf if start_s is None else start_s, math.inf if end_s is None else end_s
        if not start < end:
            raise InputError(f"start_s must be before end_s, got {start_s!r} and {end_s!r}")
        first, last = np.searchsorted(t, [start, end])
        if first == last:
            raise InputError(f"no row from {start:g} to {end:g} s; {self._span()}")
        columns = {name: values[first:last] for name, values in self.items()}
        return self._derived(f"between({start_s}, {end_s})", columns)

    def resample(
        self,
        t: ArrayLike | None = None,
        *,
        rate_hz: float | None = None,
        interpolation: Mapping[str, Interpolation] | None = None,
    ) -> "Run":
        """The run at other instants, each column read as its `Column.interpolation` says.

        Poses, fields and speeds are linear, yaw goes the shorter way round, orientations are slerped; flags,
        commands and sensors slower than the magnetometer hold what was known by then. These are values at
        instants, not averages: fewer a second than a signal swings needs a filter before.

        Args:
            t: Instants [s], shape (M,); or
            rate_hz: how many a second, from the first row on [Hz].
            interpolation: For columns by name, another rule: "linear", "hold", "angle" or "quaternion".

        Raises:
            InputError: Neither or both of `t` and `rate_hz` are given, instants do not ascend, lie outside
                the run (nothing is extrapolated), or a rule does not fit its column.
        """
        if (t is None) == (rate_hz is None):
            raise InputError("resample needs t or rate_hz, one of the two")
        clock = check_instants(self["t"], "the run")
        if not len(clock):
            raise InputError("a run of no rows cannot be resampled")
        at = grid(clock[0], clock[-1], rate_hz) if rate_hz is not None else check_instants(t, "resample")  # type: ignore[arg-type]
        outside = (at < clock[0]) | (at > clock[-1])
        if outside.any():
            raise InputError(f"t = {at[np.argmax(outside)]:g} s lies outside the run; {self._span()}")
        rules: dict[str, str] = {name: self.spec(name).interpolation for name in self}
        for name, rule in (interpolation or {}).items():
            find("column", name, rules)
            rules[name] = rule
        columns = _resampled(self, at, rules)
        how = f"rate_hz={rate_hz:g}" if rate_hz is not None else f"{len(at)} instants"
        return self._derived(f"resample({how})", columns)

    def join(self, other: "Run", suffix: str = "_2") -> "Run":
        """The columns of another run beside this one's, causally on this one's clock.

        Each row gets the latest that the other knew by then. Metadata of the other get the suffix too.

        Args:
            other: A run that begins no later, and ends no more than one of its own steps earlier; see
                `between`, and `with_columns` to shift its `t`.
            suffix: What the other's names get at their end.

        Raises:
            InputError: It does not cover this run, or a name would be there twice.
        """
        clock, theirs = check_instants(self["t"], "the run"), check_instants(other["t"], "the run to join")
        if not len(clock) or not len(theirs):
            raise InputError("a run of no rows cannot be joined")
        step = float(np.diff(theirs).max(initial=0.0))
        if clock[0] < theirs[0] or clock[-1] > theirs[-1] + step:
            raise InputError(
                f"the run to join goes from {theirs[0]:g} to {theirs[-1]:g} s and does not cover this one; "
                f"{self._span()}; take what they share with between, or shift its t"
            )
        at = np.minimum(clock, theirs[-1])
        held = _resampled(other, at, dict.fromkeys(other, "hold"))
        named = {f"{name}{suffix}": values for name, values in held.items() if name != "t"}
        if twice := sorted(named.keys() & self.columns.keys()):
            raise InputError(f"column {twice[0]!r} is in both runs; give another suffix")
        specs = {**self.specs, **{f"{name}{suffix}": other.spec(name) for name in held}}
        metadata = {**{f"{key}{suffix}": value for key, value in other.metadata.items()}, **self.metadata}
        return Run({**self.columns, **named}, metadata, specs)._derived(f"join({suffix})")

    @staticmethod
    def concat(runs: "Sequence[Run]", *, offset: bool = False) -> "Run":
        """Runs one after the other, as one; metadata in which they differ are left out.

        Args:
            runs: At least one, all of the same columns.
            offset: Whether each is shifted to begin one step after the last one ended. Otherwise their
                times must run on.

        Raises:
            InputError: There is none, their columns differ, or times do not run on.
        """
        if not runs:
            raise InputError("concat needs at least one run")
        first = runs[0]
        clocks: list[NDArray[Any]] = []
        for i, run in enumerate(runs):
            if set(run) != set(first):
                name = sorted(set(run) ^ set(first))[0]
                raise InputError(f"runs 0 and {i}: column {name!r} is in one alone; select what they share")
            for name in first:
                if run[name].shape[1:] != first[name].shape[1:]:
                    shapes = f"{first[name].shape[1:]} and {run[name].shape[1:]}"
                    raise InputError(f"runs 0 and {i}: rows of column {name!r} have shapes {shapes}")
            t = check_instants(run["t"], f"run {i}")
            before = next((c for c in reversed(clocks) if len(c)), None)
            if before is not None and len(t):
                if offset:
                    step = before[-1] - before[-2] if len(before) > 1 else t[1] - t[0] if len(t) > 1 else 1.0
                    t = t - t[0] + before[-1] + step
                elif t[0] <= before[-1]:
                    raise InputError(
                        f"run {i} begins at {t[0]:g} s, and the one before it ends at {before[-1]:g} s; "
                        "order them, or give offset to shift them"
                    )
            clocks.append(t)
        columns = {name: np.concatenate([run[name] for run in runs]) for name in first}
        columns["t"] = np.concatenate(clocks)
        shared = {k: v for k, v in first.metadata.items() if all(r.metadata.get(k) == v for r in runs)}
        return Run(columns, shared, first.specs)._derived(f"concat({len(runs)} runs)")

    def flat(self) -> dict[str, NDArray[Any]]:
        """Every number of a row on its own: columns (N,) by name, a vector's as `odom_p_x`, `odom_p_y`, ...

        Raises:
            InputError: A column has other shapes or kinds than numbers and flags, or two come to one name.
        """
        return {name: values for name, (_, _, values) in self.members().items()}

    def members(self) -> dict[str, tuple[str, str, NDArray[Any]]]:
        """Of each name in `flat`: the column that it comes from, its part ("" for a scalar), the values."""
        flat: dict[str, tuple[str, str, NDArray[Any]]] = {}
        for name, values in self.items():
            if values.ndim not in (1, 2) or values.dtype.kind not in "bfiu":
                raise InputError(
                    f"column {name!r} cannot stand in a table: numbers or flags of shape (N,) or (N, width) "
                    f"can, got {values.dtype} of shape {values.shape}"
                )
            parts = self.spec(name).parts if values.ndim == 2 else ()
            rows = {f"{name}_{part}": (name, part, values[:, i]) for i, part in enumerate(parts)}
            for key, (column, part, array) in (rows or {name: (name, "", values)}).items():
                if key in flat:
                    raise InputError(f"columns {flat[key][0]!r} and {column!r} would both be called {key!r}")
                flat[key] = (column, part, np.ascontiguousarray(array))
        return flat

    def to_pandas(self) -> "pd.DataFrame":
        """A DataFrame with the columns of `flat`, one row a reading.

        `attrs["units"]` and `attrs["frames"]` give the unit and the frame of every column,
        `attrs["metadata"]` the run's metadata.

        Raises:
            InputError: pandas is not installed, or a column cannot stand in a table.
        """
        frame = _optional("pandas").DataFrame(self.flat())
        specs = {name: self.spec(column) for name, (column, _, _) in self.members().items()}
        frame.attrs = {
            "units": {name: spec.unit for name, spec in specs.items()},
            "frames": {name: spec.frame for name, spec in specs.items()},
            "metadata": dict(self.metadata),
        }
        return frame

    def to_polars(self) -> "pl.DataFrame":
        """A polars DataFrame with the columns of `flat`, one row a reading.

        Raises:
            InputError: polars is not installed, or a column cannot stand in a table.
        """
        return _optional("polars").DataFrame(self.flat())

    def to_xarray(self) -> "xr.Dataset":
        """A Dataset along the coordinate `t` [s]; vectors keep a second dimension of named parts.

        The dimensions of parts are called after them (`x_y_z`, `left_right`); `units`, `frame` and
        `long_name` are attributes of each variable, the run's metadata those of the dataset.

        Raises:
            InputError: xarray is not installed, or the run has no column `t`.
        """
        xarray = _optional("xarray")
        variables: dict[str, Any] = {}
        coords: dict[str, Any] = {"t": None}
        for name, values in self.items():
            spec = self.spec(name)
            attrs = {"units": spec.unit, "frame": spec.frame, "long_name": spec.doc}
            dims: tuple[str, ...] = ("t",)
            if values.ndim > 1:
                dims = ("t", "_".join(spec.parts))
                coords[dims[1]] = list(spec.parts)
            variables[name] = (dims, values, {key: text for key, text in attrs.items() if text})
        self["t"]  # refuses
        coords["t"] = variables.pop("t")
        return xarray.Dataset(variables, coords, dict(self.metadata))

    def plot(self, anomaly_map: Any = None) -> "Picture":
        """Draw the path over the floor and the readings against time; see `magtwin.plot`.

        Args:
            anomaly_map: An `AnomalyMap` to draw below the path; None draws a bare floor.

        Returns:
            A matplotlib figure. A notebook shows it; `figure.savefig("run.png")` writes it.

        Raises:
            InputError: The run has no rows, or no column that can be drawn.
        """
        return importlib.import_module("magtwin").plot(self, anomaly_map=anomaly_map)  # loads io when called

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
        return Report(title, tuple(figures), dict(self.metadata), self._verdict())

    def _verdict(self) -> str:
        """How well a network predicted the exact field of a simulated run; "" where none did."""
        tally = Tally()
        self.add_to(tally)
        return tally.verdict("the exact field of this run, one session", holds=HOLDS_ONE)

    def add_to(self, tally: Tally) -> None:
        """Add the errors of a simulated run's network against the exact field, where it has both."""
        wanted = {"b_sd_nt", "b_total_nt", "b_map_nt", "b_truth_nt"}
        if self.metadata.get("magnetometer") != "neural" or not wanted <= set(self):
            return
        truth, mean = self["b_truth_nt"], float(self.metadata.get("network_label_mean_nt", 0.0))
        tally.than = "the map plus the mean training label" if mean else "the map alone"
        tally.add(self["b_total_nt"] - truth, self["b_map_nt"] + mean - truth, self["b_sd_nt"])

    def _derived(self, step: str, columns: Mapping[str, NDArray[Any]] | None = None) -> "Run":
        """What a step made of this run, and the fact that it did."""
        told = "; ".join(text for text in (str(self.metadata.get("derived", "")), step) if text)
        return Run(
            self.columns if columns is None else columns, {**self.metadata, "derived": told}, self.specs
        )

    def _summary(self) -> Summary:
        return run_summary(
            self.columns,
            self.metadata,
            [(name, *(getattr(self.spec(name), part) for part in ("unit", "frame", "doc"))) for name in self],
        )

    def _span(self) -> str:
        """From when to when it goes, for refusals."""
        t = self["t"]
        return f"the run goes from {t[0]:g} to {t[-1]:g} s" if len(t) else "the run has no rows"


def check_clock(run: Run, what: str) -> None:
    """Refuse a run without a clock, or with one that does not ascend; `what` says whose it is."""
    if "t" not in run.columns:
        known = ", ".join(list(run.columns)[:5]) or "none"
        raise InputError(f"{what}: not a Run: column 't' is missing (columns: {known}, ...)")
    check_instants(run["t"], what)


def _resampled(run: Run, at: NDArray[Any], rules: Mapping[str, str]) -> dict[str, NDArray[Any]]:
    """Columns of a run at instants that it covers [s], shape (M,)."""
    before, share = bracket(run["t"], at)
    columns = {}
    for name, values in run.items():
        rule = find("interpolation", rules[name], RULES)
        if values.dtype.kind == "b" and rules[name] != "hold":
            raise InputError(f"column {name!r} holds flags, which are held, not {rules[name]}")
        if rules[name] == "quaternion" and values.shape[1:] != (4,):
            raise InputError(f"column {name!r} has rows of shape {values.shape[1:]}, not quaternions")
        columns[name] = rule(values, before, share)
    return {**columns, "t": at}


def _optional(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{module} is not installed; install it with: pip install 'magtwin[{module}]'"
        ) from error


def _column(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """`values` in the dtype and shape that COLUMNS gives `name`; names unknown to it stay as they are."""
    spec = COLUMNS.get(name)
    if spec is None:
        return np.asarray(values)
    array = np.asarray(values, bool if spec.unit == "bool" else float)
    shape = (len(array),) if spec.width == 1 else (len(array), spec.width)
    if array.shape != shape:
        raise InputError(f"column {name!r} must have shape {shape}, got {array.shape}")
    return array
