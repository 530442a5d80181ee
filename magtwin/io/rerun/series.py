"""Series: the columns of a Run in a Rerun recording and back, and its states and events.

A recording stores every column of a run exactly and at full rate, each as a component of the entity `run`:
a scalar as a float64 or a bool, a vector as a struct of its parts. Rerun's own readers thus give the run's
table, and the viewer plots it. The entity `derived` holds further lines of the plots; it is never read back.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from magtwin.errors import InputError
from magtwin.report.verdict import Z_90
from magtwin.run.arrow import check_metadata, said_of, spec_said
from magtwin.run.figures import prediction_nt
from magtwin.run.run import COLUMNS, Run, check_numbers
from magtwin.run.thinning import stretches

Array = NDArray[np.float64]

TIMELINE = "sim_time"  # Name of the timeline of a recording

BLOCK = 4096
"""Rows per chunk: few enough for the viewer to skip what it does not show, and for LZ4, with its window of
64 kB, to compress the repeated offsets of the lists."""

COLUMNS_ENTITY, DERIVED_ENTITY = "run", "derived"  # Entities of columns, and of other lines

FACTS, NAMES, NAME, ROWS = "magtwin_facts", "magtwin_columns", "magtwin_name", "magtwin_rows"
"""Components without time: metadata and columns as JSON, the name of the run among several, and the number of
rows of a complete run."""

GAP_S = 0.5  # Time that a flag must be down for its event to be over [s]


@dataclass(frozen=True)
class State:
    """The states of a flag, down and up, and the texts of its events."""

    name: str
    down: str
    up: str
    begins: str  # Text of the event when the flag is raised
    ends: str
    level: str = "WARN"  # Level in Rerun's log


STATES: Mapping[str, State] = MappingProxyType(
    {
        "lidar_on": State("LiDAR", "off", "on", "LiDAR spins up", "LiDAR stops", level="INFO"),
        "flag_bump": State("bump", "no", "bump", "bump: touches an obstacle", "clear of the obstacle"),
        "flag_outside_map": State("map", "inside", "outside", "leaves the map", "on the map again"),
        "flag_pose_lost": State(
            "mocap", "seen", "lost", "motion capture loses the robot", "motion capture sees the robot"
        ),
        "flag_out_of_distribution": State(
            "network",
            "in distribution",
            "out of distribution",
            "an input leaves the network's training range",
            "all inputs in the network's training range",
        ),
        "flag_lost_lock": State(
            "lock", "held", "lost", "magnetometer loses lock", "magnetometer has lock again"
        ),
    }
)
"""Flags with states and events."""

DERIVED = (
    *("interval_low_nt", "interval_high_nt", "error_nt", "measured_error_nt"),
    *("error_low_nt", "error_high_nt"),
    *("odom_v_error", "v_cmd_error", "gyro_error", "w_cmd_error"),
)
"""Lines of the plots that are not columns: see `derived`."""

ERRORS = ("error_nt", *DERIVED[-4:])  # Lines whose axis leaves out rare spikes


def derived(run: Run) -> dict[str, Array]:
    """Lines of the plots that follow from the columns; those that a run has no columns for are left out.

    prediction = b_total - b_unmodelled, interval = prediction -+ 1.645 b_sd, error = prediction - b_truth,
    measured_error = b_measured - b_truth, and error_low, error_high = -+ 1.645 b_sd, which contain 90 % of
    the errors if b_sd is right. The other errors are odometry, commands and gyroscope less the true motion.
    """
    made: dict[str, Array] = {}
    total = prediction_nt(run) if "b_total_nt" in run else None
    measured = run.get("b_measured_nt")
    truth, sd = (
        run[name] if name in run and np.isfinite(run[name]).any() else None
        for name in ("b_truth_nt", "b_sd_nt")
    )
    if sd is not None and total is not None:
        half = Z_90 * sd
        made |= {"interval_low_nt": total - half, "interval_high_nt": total + half}
        if truth is not None:
            made |= {"error_low_nt": -half, "error_high_nt": half}
    if total is not None and truth is not None and (error := total - truth).any():
        made["error_nt"] = error  # always 0 for a physical magnetometer
    if measured is not None and truth is not None:
        made["measured_error_nt"] = measured - truth
    for name, column, part, true in (
        ("odom_v_error", "odom_v", 0, "v_base"),
        ("v_cmd_error", "v_cmd", None, "v_base"),
        ("gyro_error", "imu_w", 2, "w_base"),
        ("w_cmd_error", "w_cmd", None, "w_base"),
    ):
        if column in run and true in run:
            values = run[column] if part is None else run[column][:, part]
            made[name] = values - run[true][:, 0 if true == "v_base" else 2]
    return made


def entity_of(entity: str, name: str) -> str:
    """The entity of one of several runs, by its name with _ for signs; `entity` for a single run."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)
    return f"{entity}/{plain}" if plain else entity


def nanoseconds(t: Array) -> NDArray[Any]:
    """Times [s] in the resolution of the viewer's clock."""
    return np.rint(t * 1e9).astype("timedelta64[ns]")


def send(rec: rr.RecordingStream, entity: str, t: Array, archetype: Any, **values: Any) -> None:
    """Send columns of an archetype at times t [s], in blocks."""
    times = nanoseconds(t)
    for start in range(0, len(t), BLOCK):
        part = slice(start, start + BLOCK)
        columns = archetype.columns(**{key: array[part] for key, array in values.items()})
        rec.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=times[part])], columns)


def send_clouds(rec: rr.RecordingStream, entity: str, t: Array, clouds: list[Array], points: Any) -> None:
    """Send sets of points (P, 2 or 3) at times t [s], one set each; `points` is the archetype."""
    columns = points.columns(positions=np.concatenate(clouds).astype(np.float32))
    times = rr.TimeColumn(TIMELINE, duration=nanoseconds(t))
    rec.send_columns(entity, [times], columns.partition([len(cloud) for cloud in clouds]))


def send_metadata(rec: rr.RecordingStream, run: Run, name: str) -> None:
    """Send the metadata of a run, and its columns in their order."""
    specs = {key: said_of(run.spec(key), key) for key in run}
    texts = {FACTS: dict(run.metadata), NAMES: specs}
    as_json: dict[str, Any] = {key: [json.dumps(value, ensure_ascii=False)] for key, value in texts.items()}
    rec.log(entity_of(COLUMNS_ENTITY, name), rr.AnyValues(**as_json | {NAME: [name]}), static=True)


def send_columns(rec: rr.RecordingStream, run: Run, t: Array, name: str) -> None:
    """Send the columns of a run, or of a part of it, at times t [s]."""
    parts = {key: run.spec(key).parts for key in run}
    _send_table(rec, entity_of(COLUMNS_ENTITY, name), t, run, parts)
    lines = {key: values.astype(np.float32) for key, values in derived(run).items()}
    if lines:
        _send_table(rec, entity_of(DERIVED_ENTITY, name), t, lines)


def _send_table(
    rec: rr.RecordingStream,
    entity: str,
    t: Array,
    columns: Mapping[str, NDArray[Any]],
    parts: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> None:
    """Send columns as the components of one entity, in blocks; `parts` names the parts of vectors."""
    times, path = pa.array(nanoseconds(t)), f"/{entity}"
    for start in range(0, len(t), BLOCK):
        arrays, fields = [times.slice(start, BLOCK)], [pa.field(TIMELINE, times.type)]
        each = pa.array(np.arange(len(arrays[0]) + 1, dtype=np.int32))
        for key, values in columns.items():
            rows = _arrow(key, values[start : start + BLOCK], parts.get(key, ()))
            values_of_rows = pa.ListArray.from_arrays(each, rows)
            about = {"rerun:kind": "data", "rerun:component": key, "rerun:entity_path": path}
            arrays.append(values_of_rows)
            fields.append(pa.field(key, values_of_rows.type, metadata=about))
        batch = pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields))
        rec.send_chunks(Chunk.from_record_batch(batch, index=TIMELINE, entity_path=path))


def _arrow(name: str, values: NDArray[Any], parts: tuple[str, ...]) -> pa.Array:
    """A column as an array, or as a struct of its parts."""
    check_numbers(name, values, "be recorded")
    if values.ndim == 1:
        return pa.array(np.ascontiguousarray(values))
    return pa.StructArray.from_arrays([pa.array(row) for row in np.ascontiguousarray(values.T)], names=parts)


def table_of(chunks: list[pa.RecordBatch], what: str) -> tuple[str, Run, int | None]:
    """The run in all chunks of its entity: its name, the run, and its number of rows if it is complete."""
    static: dict[str, Any] = {}
    tables = []
    for batch in chunks:
        if TIMELINE in batch.schema.names:
            tables.append(batch)
        else:
            keys = [key for key in (FACTS, NAMES, NAME, ROWS) if key in batch.schema.names]
            static |= {key: batch.column(key)[0][0].as_py() for key in keys}
    try:
        metadata, names = (json.loads(static[key]) for key in (FACTS, NAMES))
        rows = int(static[ROWS]) if ROWS in static else None
        check_metadata(metadata)
        order = np.argsort([table.column(TIMELINE)[0].value for table in tables], kind="stable")
        known = names if tables else ()
        columns = {n: np.concatenate([_values(tables[k].column(n)) for k in order]) for n in known}
        own = {}
        for name in [name for name in columns if name not in COLUMNS]:
            kind = tables[0].column(name).type.value_type  # the fields of a struct are the parts
            parts = tuple(member.name for member in kind) if pa.types.is_struct(kind) else ()
            own[name] = spec_said({key: str(text) for key, text in names[name].items()}, parts)
        run = Run(columns, metadata, own)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, pa.ArrowException) as error:
        text = (
            f"a Rerun recording, but not one of a run that magtwin can read ({type(error).__name__}: {error})"
        )
        raise InputError(f"{what}: {text}; read the run's Parquet, or record it again") from error
    return str(static.get(NAME) or COLUMNS_ENTITY), run, rows


def _values(column: pa.Array) -> NDArray[Any]:
    """The column of a component, shape (N,) or (N, parts)."""
    flat = column.flatten()
    if len(flat) != len(column) or flat.null_count:
        raise ValueError("each row must have one value")
    if pa.types.is_struct(flat.type):
        return np.column_stack([part.to_numpy(zero_copy_only=False) for part in flat.flatten()])
    return flat.to_numpy(zero_copy_only=False)


@dataclass
class Flags:
    """Sends the states and events of a run that comes block by block."""

    rec: rr.RecordingStream
    name: str = ""

    _before: dict[str, bool] = field(default_factory=dict)
    # Open events by column: time of the start and of the last raised row [s], and place of the latter
    _open: dict[str, tuple[float, float, str]] = field(default_factory=dict)

    def append(self, run: Run) -> None:
        """Add the next rows."""
        events: list[tuple[float, str, str]] = []
        for column, state in STATES.items():
            if column not in run.columns:
                continue
            flag = run[column]
            before = self._before.get(column)
            rows = np.flatnonzero(np.append(flag[0] != before, flag[1:] != flag[:-1]))  # the first one always
            if before is None and not self.name:
                values = [state.down, state.up]
                style = rr.StateConfiguration(values=values, colors=[(70, 70, 76), (255, 158, 64)])
                self.rec.log(f"states/{state.name}", style, static=True)
            self._before[column] = bool(flag[-1])
            if not self.name:
                words = np.where(flag[rows], state.up, state.down).tolist()
                send(self.rec, f"states/{state.name}", run["t"][rows], rr.StateChange, state=words)
            if column in self._open or flag.any():
                events += self._episodes(column, run)
        self._send(events)

    def close(self) -> None:
        """End the open events; no rows can follow."""
        self._send([self._end(column) for column in sorted(self._open) if not self._before[column]])

    def _episodes(self, column: str, run: Run) -> Iterator[tuple[float, str, str]]:
        """Starts and ends of the events of a flag."""
        flag, t = run[column], run["t"]
        for first, last in stretches(flag.astype(bool)) - [0, 1]:
            since = float(t[first])
            if column in self._open and since - self._open[column][1] > GAP_S:
                yield self._end(column)
            if column not in self._open:
                yield since, STATES[column].level, f"{STATES[column].begins}{_place(run, first)}"
            since = self._open[column][0] if column in self._open else since
            self._open[column] = since, float(t[last]), _place(run, last)
        if column in self._open and t[-1] - self._open[column][1] > GAP_S:
            yield self._end(column)

    def _end(self, column: str) -> tuple[float, str, str]:
        since, until, place = self._open.pop(column)
        return until, "INFO", f"{STATES[column].ends}{place}, after {until - since:.2f} s"

    def _send(self, events: list[tuple[float, str, str]]) -> None:
        if not events:
            return
        events.sort(key=lambda event: event[0])
        t, levels, texts = zip(*events, strict=True)
        named = [f"{self.name}: {text}" for text in texts] if self.name else list(texts)
        send(self.rec, "events", np.array(t), rr.TextLog, text=named, level=list(levels))


def _place(run: Run, row: np.intp) -> str:
    """Position of the robot at a row, as text."""
    if "p_world_base" not in run.columns:
        return ""
    x, y = run["p_world_base"][row, :2]
    return f" at x, y = {x:+.2f}, {y:+.2f} m"
