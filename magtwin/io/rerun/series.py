"""Series: the columns of a Run in a Rerun recording, block by block, and back; its states and events.

A recording holds a run's every column at full rate and to the bit, each a component of the one entity
`run` under its own name: a scalar as a float64 or a bool, a vector as a struct of its parts. Rerun's own
readers thus give the Run's table, and the viewer's plots take their lines from it. What they show beyond
it, in the entity `derived`, is made from it and never read back.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from magtwin.errors import InputError
from magtwin.run.arrow import said_of, spec_said
from magtwin.run.run import COLUMNS, Column, Run

Array = NDArray[np.float64]

TIMELINE = "sim_time"
"""Name of the timeline that a recording runs on."""

BLOCK = 4096
"""Rows sent in one chunk: few enough for the viewer to skip what it does not show, and for LZ4, which looks
64 kB back, to see that every list of a chunk has the same offsets."""

COLUMNS_ENTITY, DERIVED_ENTITY = "run", "derived"
"""Entities of a run's columns, and of what plots show beside them."""

FACTS, NAMES, NAME, ROWS = "magtwin_facts", "magtwin_columns", "magtwin_name", "magtwin_rows"
"""Components beside the columns, without time: metadata and columns in JSON; the name of the run among
others;
the rows of a run that ended."""

INTERVAL = 1.645
"""Half the width of the 90 % prediction interval, in standard deviations."""

GAP_S = 0.5
"""How long a flag must be down for what it told of to be over [s]; a shorter gap is none."""


@dataclass(frozen=True)
class State:
    """A lane of states: what a flag says while it is down and while it is up."""

    name: str
    down: str
    up: str
    begins: str
    """What the event log says when it goes up."""
    ends: str
    level: str = "WARN"
    """How much it matters, in the words of Rerun's log."""


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
"""The flags that are states and, as they begin and end, events."""

DERIVED = (
    "interval_low_nt",
    "interval_high_nt",
    "error_nt",
    "measured_error_nt",
    "error_low_nt",
    "error_high_nt",
)
"""What is plotted beside the columns: see `derived`."""


def derived(run: Run) -> dict[str, Array]:
    """What plots show that follows from the columns; what a run knows nothing of is left out.

    interval = b_total -+ 1.645 b_sd, error = b_total - b_truth, measured_error = b_measured - b_truth, and
    error_low, error_high = -+ 1.645 b_sd, within which 9 of 10 errors lie if b_sd is right.
    """
    made: dict[str, Array] = {}
    total, truth, measured, sd = (
        run.columns.get(name) for name in ("b_total_nt", "b_truth_nt", "b_measured_nt", "b_sd_nt")
    )
    if truth is not None and not np.isfinite(truth).any():
        truth = None
    if sd is not None and not np.isfinite(sd).any():
        sd = None
    if sd is not None and total is not None:
        half = INTERVAL * sd
        made |= {"interval_low_nt": total - half, "interval_high_nt": total + half}
        if truth is not None:
            made |= {"error_low_nt": -half, "error_high_nt": half}
    if total is not None and truth is not None and (error := total - truth).any():
        made["error_nt"] = error  # of a physical magnetometer it is 0 throughout
    if measured is not None and truth is not None:
        made["measured_error_nt"] = measured - truth
    return made


def entity_of(entity: str, name: str) -> str:
    """The entity of one run among several, by its name; `entity` itself for a run that is alone.

    Only letters, digits, _ and - need no escape in the path of an entity; what else a name has becomes _.
    """
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)
    return f"{entity}/{plain}" if plain else entity


def nanoseconds(t: Array) -> NDArray[Any]:
    """Times [s] as the viewer's clock counts them."""
    return np.rint(t * 1e9).astype("timedelta64[ns]")


def send(rec: rr.RecordingStream, entity: str, t: Array, archetype: Any, **values: Any) -> None:
    """Columns of an archetype at times t [s], in blocks."""
    times = nanoseconds(t)
    for start in range(0, len(t), BLOCK):
        part = slice(start, start + BLOCK)
        columns = archetype.columns(**{key: array[part] for key, array in values.items()})
        rec.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=times[part])], columns)


def send_metadata(rec: rr.RecordingStream, run: Run, name: str) -> None:
    """What is known of a run before its first row: metadata, and the columns in their order."""
    told = {key: said_of(run.spec(key), key) for key in run}
    texts = {FACTS: dict(run.metadata), NAMES: told}
    as_json: dict[str, Any] = {key: [json.dumps(value, ensure_ascii=False)] for key, value in texts.items()}
    rec.log(entity_of(COLUMNS_ENTITY, name), rr.AnyValues(**as_json | {NAME: [name]}), static=True)


def send_rows(rec: rr.RecordingStream, rows: int, name: str) -> None:
    """That a run ended, after so many rows."""
    rec.log(entity_of(COLUMNS_ENTITY, name), rr.AnyValues(**cast(Any, {ROWS: [rows]})), static=True)


def send_columns(rec: rr.RecordingStream, run: Run, t: Array, name: str) -> None:
    """The columns of a run, or of a part of it, at times t [s]."""
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
    """Columns as the components of one entity, in blocks; `parts` names those of vectors."""
    times, path = pa.array(nanoseconds(t)), f"/{entity}"
    for start in range(0, len(t), BLOCK):
        arrays, fields = [times.slice(start, BLOCK)], [pa.field(TIMELINE, times.type)]
        each = pa.array(np.arange(len(arrays[0]) + 1, dtype=np.int32))
        for key, values in columns.items():
            rows = _arrow(key, values[start : start + BLOCK], parts.get(key, ()))
            one = pa.ListArray.from_arrays(each, rows)
            about = {"rerun:kind": "data", "rerun:component": key, "rerun:entity_path": path}
            arrays.append(one)
            fields.append(pa.field(key, one.type, metadata=about))
        batch = pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields))
        rec.send_chunks(Chunk.from_record_batch(batch, index=TIMELINE, entity_path=path))


def _arrow(name: str, values: NDArray[Any], parts: tuple[str, ...]) -> pa.Array:
    """A column, or a struct of the parts of one."""
    if values.ndim > 2 or values.dtype.kind not in "bfiu" or 0 in values.shape[1:]:
        raise InputError(
            f"column {name!r} cannot be recorded: numbers or flags of shape (N,) or (N, width) can, "
            f"got {values.dtype} of shape {values.shape}"
        )
    if values.ndim == 1:
        return pa.array(np.ascontiguousarray(values))
    return pa.StructArray.from_arrays([pa.array(row) for row in np.ascontiguousarray(values.T)], names=parts)


def table_of(chunks: list[pa.RecordBatch], what: str) -> tuple[str, Run, int | None]:
    """The run that chunks of its entity hold: its name, itself, and the rows that it ended with, if it did.

    Args:
        chunks: Every chunk of the entity, in any order.
        what: What they are of, for refusals.

    Raises:
        InputError: They hold no run.
    """
    told: dict[str, Any] = {}
    tables = []
    for batch in chunks:
        if TIMELINE in batch.schema.names:
            tables.append(batch)
        else:
            known = [key for key in (FACTS, NAMES, NAME, ROWS) if key in batch.schema.names]
            told |= {key: batch.column(key)[0][0].as_py() for key in known}
    try:
        metadata, names = (json.loads(told[key]) for key in (FACTS, NAMES))
        rows = int(told[ROWS]) if ROWS in told else None
        whole = all(isinstance(one, dict) for one in (metadata, names))
        if not whole or not all(isinstance(fact, str | int | float | bool) for fact in metadata.values()):
            raise ValueError("metadata and columns must be tables of plain values")
        order = np.argsort([table.column(TIMELINE)[0].value for table in tables], kind="stable")
        columns = {
            name: np.concatenate([_values(tables[k].column(name)) for k in order])
            for name in (names if tables else ())
        }
        own = {name: _spec(tables[0].column(name), names[name]) for name in columns if name not in COLUMNS}
        run = Run(columns, metadata, own)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, pa.ArrowException) as error:
        raise InputError(
            f"{what}: a Rerun recording, but not one of a run that magtwin can read "
            f"({type(error).__name__}: {error}); read the run's Parquet, or record it again"
        ) from error
    return str(told.get(NAME) or COLUMNS_ENTITY), run, rows


def _spec(column: pa.Array, said: dict[str, str]) -> Column:
    """What a column of the user's own holds; the fields of its struct are its parts."""
    kind = column.type.value_type
    parts = tuple(field.name for field in kind) if pa.types.is_struct(kind) else ()
    return spec_said({key: str(text) for key, text in said.items()}, parts)


def _values(column: pa.Array) -> NDArray[Any]:
    """The column that a component holds, shape (N,) or (N, parts)."""
    flat = column.flatten()
    if len(flat) != len(column) or flat.null_count:
        raise ValueError("one value a row is wanted")
    if pa.types.is_struct(flat.type):
        return np.column_stack([part.to_numpy(zero_copy_only=False) for part in flat.flatten()])
    return flat.to_numpy(zero_copy_only=False)


@dataclass
class Flags:
    """The states and events of a run that comes block by block."""

    rec: rr.RecordingStream
    name: str = ""
    offset_s: float = 0.0

    _before: dict[str, bool] = field(default_factory=dict)
    _open: dict[str, tuple[float, float, str]] = field(default_factory=dict)
    """What goes on, or may: since when, until when it was last seen, and where that was."""

    def append(self, run: Run) -> None:
        """The next rows."""
        events: list[tuple[float, str, str]] = []
        for column, state in STATES.items():
            if column not in run.columns:
                continue
            flag = run[column]
            before = self._before.get(column)
            first = flag[0] != before  # a first row always is a change, from nothing
            rows = np.flatnonzero(np.append(first, flag[1:] != flag[:-1]))
            if before is None and not self.name:
                values = [state.down, state.up]
                style = rr.StateConfiguration(values=values, colors=[(70, 70, 76), (255, 158, 64)])
                self.rec.log(f"states/{state.name}", style, static=True)
            self._before[column] = bool(flag[-1])
            if not self.name:
                words = np.where(flag[rows], state.up, state.down).tolist()
                t = run["t"][rows] + self.offset_s
                send(self.rec, f"states/{state.name}", t, rr.StateChange, state=words)
            if column in self._open or flag.any():
                events += self._episodes(column, run)
        self._send(events)

    def close(self) -> None:
        """No rows come any more."""
        self._send([self._end(column) for column in sorted(self._open) if not self._before[column]])

    def _episodes(self, column: str, run: Run) -> Iterator[tuple[float, str, str]]:
        """Beginnings and ends of what a flag tells of."""
        flag, t = run[column], run["t"]
        edges = np.diff(flag.astype(np.int8), prepend=0, append=0)
        begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
        apart = t[begins[1:]] - t[ends[:-1]] > GAP_S
        begins, ends = (
            begins[np.append(True, apart)[: len(begins)]],
            ends[np.append(apart, True)[: len(ends)]],
        )
        for first, last in zip(begins, ends, strict=True):
            since = float(t[first])
            if column in self._open and since - self._open[column][1] > GAP_S:
                yield self._end(column)
            if column in self._open:
                since = self._open[column][0]
            else:
                yield since, STATES[column].level, f"{STATES[column].begins}{_place(run, first)}"
            self._open[column] = since, float(t[last]), _place(run, last)
        if column in self._open and t[-1] - self._open[column][1] > GAP_S:
            yield self._end(column)

    def _end(self, column: str) -> tuple[float, str, str]:
        since, until, place = self._open.pop(column)
        text = f"{STATES[column].ends}{place}, after {until - since:.2f} s"
        return until, "INFO", text

    def _send(self, events: list[tuple[float, str, str]]) -> None:
        if not events:
            return
        events.sort(key=lambda event: event[0])
        t, levels, texts = zip(*events, strict=True)
        named = [f"{self.name}: {text}" for text in texts] if self.name else list(texts)
        at = np.array(t) + self.offset_s
        send(self.rec, "events", at, rr.TextLog, text=named, level=list(levels))


def _place(run: Run, row: int) -> str:
    """Where the robot was at a row, in words."""
    if "p_world_base" not in run.columns:
        return ""
    x, y = run["p_world_base"][row, :2]
    return f" at x, y = {x:+.2f}, {y:+.2f} m"
