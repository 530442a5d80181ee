"""Store: the tables of a benchmark in a folder, which several programs fill together.

    rows/SCENARIO/part-00000.parquet    one row per run and localizer; the same bytes on every machine
    times/SCENARIO/part-00000.parquet   processor times of the same runs
    tracks/SCENARIO/part-00000.parquet  their errors over time, thinned
    truths/SCENARIO/part-00000.parquet  times and bounds of the tracks, once a run
    journal-NAME.log                    what a program has not yet put into parts

A program appends each finished chunk to a journal of its own, in one write, so that a journal is whole but
for its end. It puts the journal into parts, one program at a time, when it has many rows, and when it ends.
A part holds the runs of a range, of all localizers, in order; so its bytes do not depend on who made which.
"""

import contextlib
import os
import socket
import struct
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.bench.suite import Suite
from magtwin.errors import InputError
from magtwin.files.outputs import output
from magtwin.localization.scores import Scores
from magtwin.tables.parquet import load_parquet

ROWS, TIMES, TRACKS, TRUTHS = "rows", "times", "tracks", "truths"
KEY = ("scenario", "localizer", "run")
CURVES, ONCE = ("error_m", "lost"), ("t", "bound_m")
"""Curves of a run and localizer, and those of a run."""

PART_ROWS = 80_000
"""Rows of a part of a suite whose localizers all ran, and rows of a journal that goes into parts."""

Columns = dict[str, NDArray[Any]]
Tables = Mapping[str, Sequence[Mapping[str, Any]]]

_FRAME = struct.Struct("<4sBIQ")
_MAGIC = b"MTJ1"


def _schema(**columns: Any) -> pa.Schema:
    """A schema of columns that hold values like these."""
    kinds = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), list: pa.list_(pa.float32())}
    return pa.schema([(name, kinds.get(type(value), pa.float64())) for name, value in columns.items()])


_KEY = {"scenario": "", "localizer": "", "run": 0}
_RUN = {"seed": 0, "session": 0, "status": "", "reason": "", "readings": 0, "smoother": False}
_RUN |= {"global_start": False, "recovered_in_time": 0}
_SCORES = {name: value for name, value in Scores().row().items() if name not in ("failed", "step_us")}
_RATIOS = tuple(name for name in _SCORES if name.startswith("ratio_"))
SCHEMAS = {
    TIMES: _schema(**_KEY, step_us=0.0),
    TRACKS: _schema(**_KEY, **{name: [] for name in CURVES}),
    TRUTHS: _schema(scenario="", run=0, **{name: [] for name in ONCE}),
    ROWS: _schema(**_KEY, **_RUN, **{name: value for name, value in _SCORES.items() if name not in _RATIOS}),
}
"""Columns of each kind of table, in the order of writing: a run with a row is whole."""

_HOLDS = {"string": "texts", "bool": "flags", "int64": "whole numbers from 0", "double": "numbers from 0"}


class Order:
    """The order of rows: scenarios and localizers as in a suite, other localizers by name, then runs."""

    def __init__(self, suite: Suite) -> None:
        self.scenarios = list(suite.scenarios)
        self.localizers = list(suite.localizers)
        self.runs = max(1, PART_ROWS // max(1, len(self.localizers)))
        """Runs of a part."""

    def sorted(self, table: pa.Table) -> pa.Table:
        """A table with each run once, of several the first, in order."""
        run, first = table["run"].to_numpy(), np.zeros(len(table), np.int64)
        keys = [run]
        for name, known in (("localizer", self.localizers), ("scenario", self.scenarios)):
            keys.append(first)
            if name in table.column_names:
                names, codes = coded(table[name])
                places = {each: k for k, each in enumerate([*known, *sorted(set(names) - set(known))])}
                keys[-1] = np.array([places[each] for each in names], np.int64)[codes]
        at = np.lexsort(keys)  # stable
        same = np.logical_and.reduce([np.diff(key[at]) == 0 for key in keys])
        kept = at[np.concatenate([[True], ~same])] if len(at) else at
        return table if np.array_equal(kept, np.arange(len(table))) else table.take(pa.array(kept))


def coded(column: pa.ChunkedArray) -> tuple[list[str], NDArray[np.int64]]:
    """The texts of a column, each once, and which of them is where."""
    whole = column.combine_chunks().dictionary_encode()
    if isinstance(whole, pa.ChunkedArray):
        whole = whole.combine_chunks()
    return whole.dictionary.to_pylist(), whole.indices.to_numpy().astype(np.int64)


def write_file(path: Path, content: bytes) -> None:
    """Write a file aside and rename it, over one that exists."""
    with output(path, force=True) as aside:
        aside.write_bytes(content)


class Journal:
    """What a program appends to, until it puts it into parts. Use it as a context.

    Args:
        folder: Folder of results.
        order: Order of its rows.
    """

    def __init__(self, folder: Path, order: Order) -> None:
        self._folder, self._order = folder, order
        self._file: IO[bytes] | None = None
        self._rows = 0

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
        merge(self._folder, self._order)

    def add(self, tables: Tables) -> None:
        """Append a finished chunk: rows by kind of table."""
        if self._rows >= PART_ROWS:
            self._close()
            merge(self._folder, self._order)
        if self._file is None:
            name = f"journal-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.log"
            with alone(self._folder):  # or another program takes the new file for one that is left
                self._file = open(self._folder / name, "xb", 0)  # noqa: SIM115  until it is closed
                _lock(self._file.fileno(), wait=False)
        frames = b""
        for number, kind in enumerate(SCHEMAS):
            if tables.get(kind):
                table = pa.Table.from_pylist(list(tables[kind]), schema=SCHEMAS[kind])
                sink = pa.BufferOutputStream()
                with pa.ipc.new_stream(sink, table.schema) as stream:
                    stream.write_table(table)
                data = sink.getvalue().to_pybytes()
                frames += _FRAME.pack(_MAGIC, number, zlib.crc32(data), len(data)) + data
        self._file.write(frames)
        self._rows += len(tables[ROWS])

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file, self._rows = None, 0


def _lock(file: int, *, wait: bool) -> bool:
    """Lock a file or folder until it is closed; whether that worked. Elsewhere than on Unix nothing locks."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # no locks on this file system: then let one program write at a time
        return True
    return True


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Wait until no other program changes the parts of a folder or its receipt, and keep it so."""
    if os.name == "nt":  # folders cannot be opened there
        yield
        return
    at = os.open(folder, os.O_RDONLY)
    try:
        _lock(at, wait=True)
        yield
    finally:
        os.close(at)


def merge(folder: Path, order: Order) -> None:
    """Put the journals that no program writes any more into parts, and remove them."""
    with alone(folder):
        for file in sorted(folder.glob("journal-*.log")):
            with contextlib.suppress(FileNotFoundError), open(file, "rb") as journal:
                if not _lock(journal.fileno(), wait=False):
                    continue
                for kind, table in _journal(file).items():
                    _into_parts(folder, kind, table, order)
                file.unlink()


def _into_parts(folder: Path, kind: str, table: pa.Table, order: Order) -> None:
    names, codes = coded(table["scenario"])
    parts = table["run"].to_numpy() // order.runs
    for number, scenario in enumerate(names):
        for part in np.unique(parts[codes == number]).tolist():
            path = folder / kind / scenario / f"part-{part:05d}.parquet"
            new = table.filter(pa.array((codes == number) & (parts == part)))
            old = [_part(path, kind)] if path.is_file() else []
            sink = pa.BufferOutputStream()
            whole = order.sorted(pa.concat_tables([*old, new])).combine_chunks()
            # without a schema of Arrow, which tells how a table was made
            pq.write_table(whole, sink, compression="zstd", store_schema=False)
            write_file(path, sink.getvalue().to_pybytes())


def _journal(file: Path) -> dict[str, pa.Table]:
    """Tables of a journal, up to its first frame that is not whole."""
    found: dict[str, list[pa.Table]] = {kind: [] for kind in SCHEMAS}
    data = file.read_bytes()
    at = 0
    while at + _FRAME.size <= len(data):
        magic, number, checksum, size = _FRAME.unpack_from(data, at)
        content = data[at + _FRAME.size : at + _FRAME.size + size]
        if (
            magic != _MAGIC
            or number >= len(SCHEMAS)
            or len(content) < size
            or zlib.crc32(content) != checksum
        ):
            break
        kind = list(SCHEMAS)[number]
        try:
            table = pa.ipc.open_stream(content).read_all()
            table.validate(full=True)
        except (pa.ArrowException, OSError) as error:
            raise _damaged(file, str(error).splitlines()[0]) from error
        _check(file, kind, table, SCHEMAS[kind].names)
        found[kind].append(table)
        at += _FRAME.size + size
    return {kind: pa.concat_tables(tables) for kind, tables in found.items() if tables}


def read_tables(
    folders: Sequence[Path],
    kind: str,
    scenarios: Sequence[str],
    names: Sequence[str] = (),
    match: pc.Expression | None = None,
) -> pa.Table:
    """Rows of a kind, as they are found: those of journals, then those of parts.

    Args:
        folders: Folders of results.
        kind: Kind of table.
        scenarios: Names of scenarios.
        names: Columns. Default: all.
        match: Which rows. Default: all.

    Raises:
        InputError: A file is damaged.
    """
    names = list(names or SCHEMAS[kind].names)
    found = [pa.table({name: pa.array([], SCHEMAS[kind].field(name).type) for name in names})]
    for folder in folders:
        for file in sorted(folder.glob("journal-*.log")):  # before the parts into which they are put
            with contextlib.suppress(FileNotFoundError):
                table = _journal(file).get(kind)
                if table is not None:
                    found.append((table if match is None else table.filter(match)).select(names))
        for scenario in scenarios:
            files = sorted((folder / kind / scenario).glob("part-*.parquet"))
            found += [_part(file, kind, names, match) for file in files]
    return pa.concat_tables(found)


def read_columns(folders: Sequence[Path], kind: str, order: Order) -> Columns:
    """All columns of a kind, each run once, in order; rows have the ratios of error and bound too.

    Raises:
        InputError: A file is damaged, or has a scenario that the suite does not have.
    """
    table = order.sorted(read_tables(folders, kind, order.scenarios))
    columns: Columns = {}
    for name in table.column_names:
        if pa.types.is_string(table[name].type):
            texts, codes = coded(table[name])
            if name == "scenario" and (unknown := set(texts) - set(order.scenarios)):
                raise InputError(
                    f"{folders[0] / kind}: rows of scenario {min(unknown)!r}, which the suite does not have; "
                    "remove them and repeat magtwin bench"
                )
            columns[name] = np.array(texts, object)[codes]
        else:
            columns[name] = table[name].to_numpy()
    if kind == ROWS:
        for name in _RATIOS:
            bound = columns[f"bound_{name.removeprefix('ratio_')}_m"]
            with np.errstate(all="ignore"):
                columns[name] = np.where(bound > 0, columns["rmse_m"] / bound, np.nan)
    return columns


def done_runs(folder: Path, suite: Suite) -> dict[tuple[str, str], NDArray[np.bool_]]:
    """Flags of the runs that a folder has rows of, by scenario and localizer.

    Raises:
        InputError: A file is damaged.
    """
    done = {}
    table = read_tables([folder], ROWS, list(suite.scenarios), KEY)
    (scenarios, of), (localizers, by) = coded(table["scenario"]), coded(table["localizer"])
    runs = table["run"].to_numpy()
    for k, scenario in enumerate(scenarios):
        here = of == k
        for j, localizer in enumerate(localizers):
            flags = np.zeros(suite.scenarios[scenario].runs if scenario in suite.scenarios else 0, bool)
            mine = runs[here & (by == j)]
            flags[mine[mine < len(flags)]] = True
            done[scenario, localizer] = flags
    return done


def _part(
    file: Path, kind: str, names: Sequence[str] | None = None, match: pc.Expression | None = None
) -> pa.Table:
    """Some columns of a part of a kind.

    Raises:
        InputError: The file is damaged, or a column is missing or holds other values.
    """
    names = list(names or SCHEMAS[kind].names)
    load: Callable[[Path], pa.Table] = partial(_scanned, names=names, match=match)
    try:
        table = load_parquet(file, load)
    except InputError as error:
        raise _damaged(file, str(error).removeprefix(f"{file}: ").partition(";")[0]) from error
    _check(file, kind, table, names)
    return table


def _scanned(file: Path, names: list[str], match: pc.Expression | None) -> pa.Table:
    from pyarrow.dataset import dataset

    whole = dataset(file, format="parquet")
    return whole.to_table(columns=[name for name in names if name in whole.schema.names], filter=match)


def _check(file: Path, kind: str, table: pa.Table, names: Sequence[str]) -> None:
    for name in names:
        wanted = SCHEMAS[kind].field(name).type
        if table.column_names.count(name) != 1 or not _fits(table[name], wanted):
            raise _damaged(
                file, f"column {name!r} does not hold {_HOLDS.get(str(wanted), 'lists of numbers')}"
            )


def _damaged(file: Path, reason: str) -> InputError:
    return InputError(f"{file}: damaged results ({reason}); remove them and repeat magtwin bench")


def _fits(column: pa.ChunkedArray, kind: pa.DataType) -> bool:
    """Whether a column has values of a type, none of which is missing or below 0."""
    if column.type != kind or column.null_count:
        return False
    if pa.types.is_list(kind):
        return not any(chunk.flatten().null_count for chunk in column.chunks)
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
    return not (number and pc.any(pc.less(column, 0)).as_py())
