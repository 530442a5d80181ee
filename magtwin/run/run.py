"""Run: a table of what happened, on one clock, with unit and frame of every column."""

import fnmatch
import importlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.report.report import Report
from magtwin.report.summary import Summarized, Summary
from magtwin.report.verdict import OWN, Tally
from magtwin.run import mapped
from magtwin.run.figures import prediction_nt, run_report
from magtwin.run.resample import RULES, Interpolation, bracket, check_instants, grid
from magtwin.run.summary import run_summary

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Picture

Metadata = Mapping[str, str | int | float | bool]

LAST_S = 9.2e9  # Latest time of a run, and minus the earliest [s]: 64 bits of nanoseconds, as in bags
LARGEST = 1e30  # Largest finite number in a column of a file: its square and its 32-bit form are finite too


@dataclass(frozen=True)
class Column:
    """Description of a column of a Run."""

    unit: str
    """SI unit, "nT" for magnetic fields, "" for dimensionless numbers, "bool" for flags."""

    frame: str
    """Frame of its vectors, "" if none applies."""

    doc: str
    """Meaning, in one line."""

    width: int = 1
    """Numbers per row: 1 gives shape (N,), more gives (N, width)."""

    parts: tuple[str, ...] = ()
    """Names of the numbers of a row, such as x, y, z; `width` names if width > 1."""

    interpolation: Interpolation = "linear"
    """How values between two rows are found; "hold" takes the last row before."""


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
        "battery_a": Column("A", "", "battery current, above 0 while discharging", interpolation="hold"),
        "battery_fraction": Column("", "", "charge left, 0 to 1", interpolation="hold"),
        "lidar_on": Column("bool", "", "whether the LiDAR spins", interpolation="hold"),
        "b_map_nt": Column("nT", "", "anomaly map at the true pose"),
        "b_map_gradient_nt_m": Column(
            "nT/m", "base_link", "gradient of the anomaly map along the axes of base_link", 2, _PLANE
        ),
        "b_disturbance_nt": Column("nT", "", "disturbance by the network, by physics, or none"),
        "b_total_nt": Column("nT", "", "b_map_nt + b_disturbance_nt"),
        "b_model_error_nt": Column(
            "nT", "", "error drawn for a network's prediction; 0 without a network or if none is drawn"
        ),
        "b_noise_nt": Column("nT", "", "the sensor's error; nan if it gave no reading"),
        "b_measured_nt": Column(
            "nT", "", "b_total_nt + b_model_error_nt + b_noise_nt, in steps of the sensor's resolution"
        ),
        "b_sd_nt": Column("nT", "", "predicted standard deviation of b_measured_nt; nan if unknown"),
        "b_vector_nt": Column("nT", "magnetometer", "exact field vector; nan if unknown", 3, _XYZ),
        "b_vector_measured_nt": Column(
            "nT",
            "magnetometer",
            "latest reading of each vector axis; nan if there is none",
            3,
            _XYZ,
            interpolation="hold",
        ),
        "b_truth_nt": Column("nT", "", "exact field magnitude at the sensor; nan if unknown"),
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
"""Every column that magtwin writes, in the order of the table. A localizer adds `est_*`.

Errors have separate columns. Where all are known,

    b_total_nt = b_map_nt + b_disturbance_nt
    b_measured_nt = b_total_nt + b_model_error_nt + b_noise_nt
    b_truth_nt = |b_vector_nt|, and = b_total_nt of a physical magnetometer

A neural magnetometer also reads fields that its network does not know, such as a plant. Their part of
b_disturbance_nt is the column b_unmodelled_nt, which runs without such fields lack.

So b_total_nt - b_unmodelled_nt - b_truth_nt is the error of a neural or map-only magnetometer's model,
b_truth_nt - b_map_nt is what the map lacks, b_noise_nt is the sensor's error, and
b_vector_measured_nt - b_vector_nt that of its vector axes. b_model_error_nt is a random draw of a model
error, with the standard deviation that the network predicts on the robot of its training. Readings are thus
as far from the mean as the network was from held-out recordings.
"""


@dataclass(frozen=True, repr=False)
class Run(Summarized, Mapping[str, NDArray[Any]]):
    """A table of columns of equal length, and metadata.

    A mapping from column name to array: `run["b_total_nt"]` has shape (N,), `run["p_world_base"]` has shape
    (N, 3). `bool` columns have dtype bool, all others float64. Runs are immutable: methods return a new Run,
    which shares unchanged arrays.
    """

    columns: Mapping[str, NDArray[Any]]
    """Arrays by column name, in the order of the table; all (N,) or (N, width)."""

    metadata: Metadata = field(default_factory=dict)
    """Origin of the run: scene, path, seed, network, map, versions."""

    specs: Mapping[str, Column] = field(default_factory=dict)
    """Descriptions of custom columns, which are not in `COLUMNS`."""

    def __post_init__(self) -> None:
        arrays = {name: _column(name, values) for name, values in self.columns.items()}
        rows = {name: len(values) for name, values in arrays.items()}
        if len(set(rows.values())) > 1:
            raise InputError(f"columns of a Run must be equally long, got {rows}")
        object.__setattr__(self, "columns", MappingProxyType(arrays))
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))
        custom = {name: spec for name, spec in self.specs.items() if name in arrays and name not in COLUMNS}
        for name, spec in custom.items():
            parts = arrays[name].shape[1] if arrays[name].ndim == 2 else 0
            if len(spec.parts) != parts:
                raise InputError(
                    f"column {name!r} has rows of {parts or 'no'} parts, but its spec names {len(spec.parts)}"
                )
        object.__setattr__(self, "specs", MappingProxyType(custom))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self.columns), dict(self.metadata), dict(self.specs))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return find("column", name, self.columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        """Number of columns, as for any mapping; see also `rows`."""
        return len(self.columns)

    def _ipython_key_completions_(self) -> list[str]:
        """Column names, for completion in IPython and Jupyter."""
        return list(self.columns)

    @property
    def rows(self) -> int:
        """Number of readings, N."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def duration_s(self) -> float:
        """Time between the first and the last reading [s]."""
        return float(self["t"][-1] - self["t"][0]) if self.rows else 0.0

    def spec(self, name: str) -> Column:
        """Description of a column; guessed from name and values if the column has none."""
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
        """This run with columns added or replaced."""
        return Run({**self.columns, **columns}, self.metadata, self.specs)

    def with_metadata(self, **metadata: str | int | float | bool) -> "Run":
        """This run with metadata added or replaced."""
        return Run(self.columns, {**self.metadata, **metadata}, self.specs)

    def with_specs(self, **specs: Column) -> "Run":
        """This run with descriptions of custom columns added or replaced."""
        return Run(self.columns, self.metadata, {**self.specs, **specs})

    def take(self, rows: "slice | NDArray[Any]") -> "Run":
        """Some rows, by a slice, indices, or a mask of shape (N,)."""
        taken = {}
        for name, values in self.items():
            taken[name] = values[rows]
            if self.rows > mapped.LONG and not isinstance(rows, slice):
                mapped.release()  # else the pages of all columns stay in memory
        return Run(taken, self.metadata, self.specs)

    def select(self, *names: str) -> "Run":
        """Some columns in the given order, after the clock `t`, which is always kept.

        Args:
            names: Names, or patterns such as "b_*".

        Raises:
            UnknownNameError: No column has that name or matches the pattern.
        """
        kept = dict.fromkeys(["t"])
        for name in names:
            if name not in self and (matches := fnmatch.filter(self, name)):
                kept |= dict.fromkeys(matches)
            else:
                find("column", name, self.columns)
                kept[name] = None
        return self._derived(f"select({', '.join(names)})", {name: self[name] for name in kept})

    def between(self, start_s: float | None = None, end_s: float | None = None) -> "Run":
        """The rows with start_s <= t < end_s. Default: the start and the end of the run.

        Raises:
            InputError: `start_s` is not before `end_s`, or no row lies between them.
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
        """The run at other times, each column by its `Column.interpolation`.

        Poses, fields and speeds are interpolated linearly, yaw along the shorter arc, orientations by slerp.
        Flags, commands and sensors slower than the magnetometer hold their last value. These are values at
        instants, not averages: filter a signal first to sample it below twice its bandwidth.

        Args:
            t: Times [s], shape (M,); or
            rate_hz: Rate from the first row on [Hz].
            interpolation: Other rules by column name: "linear", "hold", "angle" or "quaternion".

        Raises:
            InputError: Neither or both of `t` and `rate_hz` are given; times do not ascend or lie outside of
                the run (nothing is extrapolated); or a rule does not fit its column.
        """
        if (t is None) == (rate_hz is None):
            raise InputError("resample needs either t or rate_hz")
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

    @staticmethod
    def concat(runs: "Sequence[Run]", *, offset: bool = False) -> "Run":
        """Concatenate runs; only metadata that are equal in all of them are kept.

        Args:
            runs: At least one run, all with the same columns.
            offset: Shift each run to begin one step after the previous one. Otherwise each must begin after
                the previous one ends.

        Raises:
            InputError: There is no run, their columns differ, or times overlap.
        """
        if not runs:
            raise InputError("concat needs at least one run")
        first = runs[0]
        clocks: list[NDArray[Any]] = []
        for i, run in enumerate(runs):
            if set(run) != set(first):
                name = sorted(set(run) ^ set(first))[0]
                raise InputError(
                    f"runs 0 and {i}: column {name!r} is in only one of them; select the shared columns"
                )
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
        """Scalar columns of shape (N,) by name; a vector is split into `odom_p_x`, `odom_p_y`, ...

        Raises:
            InputError: A column does not hold numbers or flags, or two columns would have the same name.
        """
        return {name: values for name, (_, _, values) in self.members().items()}

    def members(self) -> dict[str, tuple[str, str, NDArray[Any]]]:
        """For each name in `flat`: its column, its part ("" for a scalar), and its values."""
        flat: dict[str, tuple[str, str, NDArray[Any]]] = {}
        for name, values in self.items():
            check_numbers(name, values, "stand in a table")
            parts = self.spec(name).parts if values.ndim == 2 else ()
            rows = {f"{name}_{part}": (name, part, values[:, i]) for i, part in enumerate(parts)}
            for key, (column, part, array) in (rows or {name: (name, "", values)}).items():
                if key in flat:
                    raise InputError(f"columns {flat[key][0]!r} and {column!r} would both be called {key!r}")
                flat[key] = (column, part, np.ascontiguousarray(array))
        return flat

    def to_pandas(self) -> "pd.DataFrame":
        """A DataFrame with the columns of `flat`, one row per reading.

        `attrs["units"]` and `attrs["frames"]` hold the unit and the frame of every column,
        `attrs["metadata"]` the run's metadata.

        Raises:
            InputError: pandas is not installed, or a column cannot stand in a table.
        """
        try:
            import pandas as pd
        except ImportError as error:
            text = "pandas is not installed; install it with: pip install 'magtwin[pandas]'"
            raise InputError(text) from error
        frame = pd.DataFrame(self.flat())
        specs = {name: self.spec(column) for name, (column, _, _) in self.members().items()}
        frame.attrs = {
            "units": {name: spec.unit for name, spec in specs.items()},
            "frames": {name: spec.frame for name, spec in specs.items()},
            "metadata": dict(self.metadata),
        }
        return frame

    def plot(self, anomaly_map: Any = None, *, scene: Any = None) -> "Picture":
        """Draw the path over map, walls and furniture, and the readings against time; see `magtwin.plot`.

        Args:
            anomaly_map: An `AnomalyMap` to draw below the path. Default: that of the scene.
            scene: Twin or scene of the run. Default: that of its metadata, if it is there and has not
                changed; otherwise the floor is bare.

        Returns:
            A matplotlib figure. A notebook shows it; `figure.savefig("run.png")` writes it.

        Raises:
            InputError: The run has no rows, or no column that can be drawn.
        """
        plot = importlib.import_module("magtwin").plot  # loads io when called
        return plot(self, anomaly_map=anomaly_map, scene=scene)  # type: ignore[no-any-return]

    def view(self, scene: "str | os.PathLike[str] | None" = None, *, height: int = 800) -> Any:
        """The run in its lab in 3D, with charts, in a notebook: the page of `magtwin report`.

        Args:
            scene: Scene of the run. None: the one of its metadata; without it, charts and map are shown.
            height: Height of the frame [pixels].

        Returns:
            What a notebook shows, at most about 1 MB. `page` is its HTML.

        Raises:
            InputError: The run has no rows or no clock, or `scene` cannot be read.
        """
        return importlib.import_module("magtwin.figures.reporting").embedded(self, scene, height)

    def save(self, path: "str | os.PathLike[str]", **options: Any) -> None:
        """Write the run to a file in the format of its suffix; `magtwin.load_run` gives it back.

        Args:
            path: The file to make, such as run.parquet, .mcap, .rrd, .csv, .npz or .usdc. A name without a
                suffix is the folder of a bag.
            options: `twin`, `scans`, `planned`, `force` and options of single formats, as for
                `magtwin.save_run`.

        Raises:
            InputError: The suffix is unknown, the run's clock does not ascend, or the file exists and `force`
                is not set.
        """
        importlib.import_module("magtwin").save_run(self, path, **options)  # loads io when called

    def report(self, title: str = "Run") -> Report:
        """The run in a few figures; missing columns are skipped."""
        return run_report(self, title)

    def add_to(self, tally: Tally) -> None:
        """Add the errors of a simulated run's network against the exact field, if it has both."""
        wanted = {"b_sd_nt", "b_total_nt", "b_map_nt", "b_truth_nt"}
        if self.metadata.get("magnetometer") != "neural" or not wanted <= set(self):
            return
        (mean,) = numbers_in(self.metadata, "network_label_mean_nt") or (0.0,)
        tally.than = "the map plus the mean disturbance in the training data" if mean else "the map alone"
        for rows in mapped.parts(self.rows):
            level, truth, sd = (self[name][rows] for name in ("b_map_nt", "b_truth_nt", "b_sd_nt"))
            whose = str(self.metadata.get("network_intervals", OWN))
            tally.add(prediction_nt(self, rows) - truth, level + mean - truth, sd, whose)

    def _derived(self, step: str, columns: Mapping[str, NDArray[Any]] | None = None) -> "Run":
        """This run after a step, which is noted in its metadata."""
        derived = "; ".join(filter(None, (str(self.metadata.get("derived", "")), step)))
        columns = self.columns if columns is None else columns
        return Run(columns, {**self.metadata, "derived": derived}, self.specs)

    def _summary(self) -> Summary:
        return run_summary(
            self.columns,
            self.metadata,
            [(name, *(getattr(self.spec(name), part) for part in ("unit", "frame", "doc"))) for name in self],
        )

    def _span(self) -> str:
        """Its time span, for error messages."""
        t = self["t"]
        return f"the run goes from {t[0]:g} to {t[-1]:g} s" if len(t) else "the run has no rows"


def check_numbers(name: str, values: NDArray[Any], use: str) -> None:
    """Refuse a column of other than numbers or flags in rows; `use` is what it cannot do."""
    if values.ndim not in (1, 2) or values.dtype.kind not in "bfiu" or 0 in values.shape[1:]:
        raise InputError(
            f"column {name!r} cannot {use}: it needs numbers or flags of shape (N,) or (N, width), "
            f"got {values.dtype} of shape {values.shape}"
        )


def check_clock(run: Run, what: str) -> None:
    """Refuse a run without a clock or whose clock does not ascend; `what` names it in the message."""
    if "t" not in run.columns:
        known = ", ".join(list(run.columns)[:5]) or "none"
        raise InputError(f"{what}: not a Run: column 't' is missing (columns: {known}, ...)")
    t = check_instants(run["t"], what)
    if len(t) and max(-t[0], t[-1]) > LAST_S:
        far = t[-1] if t[-1] > LAST_S else t[0]
        raise InputError(f"{what}: t must be seconds, from {-LAST_S:g} to {LAST_S:g}, got {far:g}")


def numbers_in(metadata: Metadata, key: str, count: int = 1) -> tuple[float, ...]:
    """The numbers of a metadata entry, such as "0.1, 0, 0.4"; none if it is missing.

    Raises:
        InputError: They are not `count` finite numbers.
    """
    if key not in metadata:
        return ()
    try:
        numbers = tuple(float(word) for word in str(metadata[key]).split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(abs(number) < LARGEST for number in numbers):
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"metadata {key!r} must be {wanted}, got {str(metadata[key])[:60]!r}")
    return numbers


def check_size_of_numbers(run: Run, what: str) -> None:
    """Refuse a run with finite numbers beyond `LARGEST` in `COLUMNS`; `what` names it in the message."""
    for name in (name for name, column in COLUMNS.items() if name in run.columns and column.unit != "bool"):
        for rows in mapped.parts(run.rows):
            values = run[name][rows]
            if (wrong := np.isfinite(values) & (np.abs(values) > LARGEST)).any():
                row = rows.start + int(np.argmax(wrong.reshape(len(values), -1).any(axis=1)))
                text = f"{values[wrong][0]:g} is beyond {LARGEST:g}; write nan for unknown values"
                raise InputError(f"{what}: column {name!r}, row {row}: {text}")


def _resampled(run: Run, at: NDArray[Any], rules: Mapping[str, str]) -> dict[str, NDArray[Any]]:
    """Columns of a run at times within it [s], shape (M,)."""
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


def _column(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Values in the dtype and shape of `COLUMNS`; custom columns are unchanged."""
    spec = COLUMNS.get(name)
    if spec is None:
        return np.asarray(values)
    array = np.asarray(values, bool if spec.unit == "bool" else float)
    shape = (len(array),) if spec.width == 1 else (len(array), spec.width)
    if array.shape != shape:
        raise InputError(f"column {name!r} must have shape {shape}, got {array.shape}")
    return array
