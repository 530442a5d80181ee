"""Results: the rows of a benchmark in a folder of Parquet files, which shards fill together.

    suite.toml                          the suite's file
    suite.json                          name, version and checksums of suite and data, version of magtwin
    rows/SCENARIO/part-00000.parquet    one row per run and localizer; the same bytes on every machine
    times/SCENARIO/part-00000.parquet   processor times of the same runs
    tracks/SCENARIO/part-00000.parquet  their errors over time, thinned

A part holds a chunk of the suite. One that holds another selection of runs and localizers, as with fewer
runs, has a checksum of the selection in its name. Every file is written aside and renamed, the rows last, so
that a part with rows is whole.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.bench.suite import Chunk, Seeds, Suite, load_suite
from magtwin.errors import InputError, find
from magtwin.files.file import read_text
from magtwin.files.kinds import expected
from magtwin.files.outputs import output
from magtwin.localization.scores import Scores
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.tables.parquet import load_parquet

if TYPE_CHECKING:
    from magtwin.bench.leaderboard import Standing

SUITE, ABOUT = "suite.toml", "suite.json"
ROWS, TIMES, TRACKS = "rows", "times", "tracks"
_ABOUT_KINDS = {**dict.fromkeys(("name", "sha256", "seeds", "magtwin"), str), "version": int, "data": dict}
"""Kinds of the values in suite.json."""
KEY = ("scenario", "localizer", "run")

Columns = dict[str, NDArray[Any]]
Run = tuple[str, str, int]
"""Scenario, localizer and number of a run."""


@dataclass(frozen=True, repr=False, eq=False)
class Results(Summarized):
    """Rows of a benchmark, from one folder or several."""

    folders: tuple[Path, ...]
    suite: Suite
    about: Mapping[str, Any]
    """Content of suite.json."""

    rows: Columns
    """Arrays by name, of one value per run and localizer, in the order of the suite."""

    times: Columns
    """Processor times of the same runs, in the same order; nan where unknown."""

    new: int = 0
    """Runs that the call of `magtwin.benchmark` made; the others were in the folder."""

    @property
    def missing(self) -> int:
        """Runs of the suite's localizers that the rows lack."""
        done = set(zip(*(self.rows[name].tolist() for name in KEY), strict=True))
        return sum(
            (chunk.scenario, name, run) not in done
            for chunk in self.suite.chunks()
            for name in chunk.entries
            for run in runs_of(chunk)
        )

    @property
    def compensated(self) -> list[str]:
        """Localizers of the suite with a compensator."""
        return [each.name for each in self.suite.localizer if each.compensator != "none"]

    @property
    def table(self) -> pa.Table:
        """The rows as a table of pyarrow."""
        return pa.table({name: pa.array(values) for name, values in self.rows.items()})

    def tracks(
        self, scenario: str | None = None, localizer: str | None = None, run: int | None = None
    ) -> list[dict[str, Any]]:
        """Errors over time.

        Args:
            scenario: Name of a scenario. Default: all.
            localizer: Name of a localizer. Default: all.
            run: Number of a run. Default: all.

        Returns:
            A table per run and localizer, in the order of the rows: scenario, localizer, run, and the float32
            arrays t [s], error_m, bound_m and lost. [] if the benchmark kept none.

        Raises:
            InputError: There is no such scenario or localizer.
        """
        match = pc.scalar(True)
        for name, value in (("scenario", scenario), ("localizer", localizer), ("run", run)):
            if value is not None:
                find(name, str(value), dict.fromkeys(map(str, self.rows[name].tolist())))
                match &= pc.field(name) == value
        made: dict[Run, dict[str, Any]] = {}
        for name in self.suite.scenarios if scenario is None else (scenario,):
            for file in (part for folder in self.folders for part in _parts(folder, TRACKS, name)):
                part = _read_part(file, TRACKS, (*KEY, *_CURVES), match)
                if any(len(set(map(len, row))) > 1 for row in zip(*(part[c] for c in _CURVES), strict=True)):
                    raise InputError(
                        f"{file}: damaged results (curves of unequal length); remove them and "
                        "repeat magtwin bench"
                    )
                for row in map(
                    dict, zip(*([(c, v) for v in values] for c, values in part.items()), strict=True)
                ):
                    made.setdefault((row["scenario"], row["localizer"], row["run"]), row)
        keys = zip(*(self.rows[name].tolist() for name in KEY), strict=True)
        return [made[key] for key in keys if key in made]

    def report(self, standings: Sequence["Standing"]) -> Report:
        """Numbers of runs, and each localizer on each scenario in a line, worst problem first.

        Args:
            standings: What `magtwin.bench.leaderboard.standings` says of the rows.
        """
        bad = self.rows["status"] != "ok"
        lines: dict[str, str] = {}
        for each in standings:
            error = "no run finished" if each.rmse_m is None else f"RMSE {each.rmse_m.value:.3f} m"
            bound = f", bound {each.bound_m:.3f} m" if each.bound_m > 0 else ""
            said = each.verdict()
            mine = bad & (self.rows["scenario"] == each.scenario) & (self.rows["localizer"] == each.localizer)
            if mine.any():
                said += f", first: {self.rows['reason'][np.argmax(mine)]}"
            lines[f"{each.scenario}, {each.localizer}"] = error + bound + (f"; {said}" if said else "")
        figures = (
            Figure("runs", len(self.rows["run"])),
            Figure(
                "new",
                self.new,
                note="" if self.new else "all were in the folder; a changed localizer needs another",
            ),
            Figure("failed", int(np.count_nonzero(bad))),
            Figure(
                "not run", self.missing, note="runs of the whole suite that were not asked for or are left"
            ),
        )
        title = f"Suite {self.suite.name}, version {self.suite.version}, {self.suite.seeds} seeds"
        return Report(title, figures, {"localizers": lines})

    def _summary(self) -> Summary:
        rows = self.rows
        failed = int(np.count_nonzero(rows["status"] != "ok"))
        of_rows = f"{len(rows['run']):,}" + (f", {failed:,} of them failed" if failed else "")
        return Summary(
            f"Results of suite {self.suite.name}, version {self.suite.version}",
            (
                ("runs", of_rows + (f"; {self.missing:,} are missing" if self.missing else "")),
                ("scenarios", listed(list(dict.fromkeys(rows["scenario"].tolist())))),
                ("localizers", listed(list(dict.fromkeys(rows["localizer"].tolist())))),
                ("in", ", ".join(map(str, self.folders))),
            ),
        )


def read_results(*folders: str | os.PathLike[str]) -> Results:
    """Read results, from one folder or from several of the same suite, as shards on several machines make.

    A run that is in several folders counts once.

    Raises:
        InputError: A folder is missing, holds no results or no rows yet, is damaged, or is of another suite,
            version or data than the first.
    """
    if not folders:
        raise InputError("no folder of results; give at least one")
    made = results_in(*(expected(folder, "folder of results") for folder in folders))
    if not len(made.rows["run"]):
        raise InputError(f"{folders[0]}: no rows yet; let magtwin bench go on")
    return made


def results_in(*places: Path) -> Results:
    """As `read_results`, of folders that may have no rows yet."""
    about = read_about(places[0])
    for place in places[1:]:
        check_about(place, about)
    suite = load_suite(places[0] / SUITE)
    if about["seeds"] != suite.seeds:
        suite = suite.limited(seeds=about["seeds"])
    order = _order(suite)
    rows = _read(places, ROWS, order)
    return Results(places, suite, about, rows, _aligned(_read(places, TIMES, order), rows))


def read_about(folder: Path) -> dict[str, Any]:
    """Content of the suite.json of results.

    Raises:
        InputError: The folder holds no results.
    """
    file = folder / ABOUT
    try:
        about = json.loads(read_text(file, "description of results", "JSON"))
        known = isinstance(about, dict) and all(
            isinstance(about.get(name), kind) for name, kind in _ABOUT_KINDS.items()
        )
        known = known and all(isinstance(text, str) for text in about["data"].values())
        known = known and about["seeds"] in get_args(Seeds)
    except (OSError, ValueError, RecursionError):
        known = False
    if not known or not (folder / SUITE).is_file():
        raise InputError(f"{folder}: no results of magtwin bench; give the folder that it wrote (--out)")
    return dict(about)


def check_about(folder: Path, about: Mapping[str, Any]) -> None:
    """Refuse a folder of results that does not match.

    Args:
        folder: Folder of results.
        about: What its suite.json must have.

    Raises:
        InputError: It is of another suite, version, seeds or data, or was made by another magtwin.
    """
    found = read_about(folder)
    names = (
        ("name", "suite"),
        ("version", "version of the suite"),
        ("seeds", "seeds"),
        ("magtwin", "version of magtwin"),
        ("sha256", "content of the suite"),
    )
    remedy = "give another folder, or `force=True` to replace them"
    for key, what in names:
        if found[key] != about[key]:
            values = "" if key == "sha256" else f" ({found[key]}, not {about[key]})"
            raise InputError(f"{folder}: results with another {what}{values}; {remedy}", parameter="force")
    for name, checksum in found["data"].items():
        if about["data"].get(name, checksum) != checksum:
            raise InputError(f"{folder}: results on another content of {name!r}; {remedy}", parameter="force")


def begin_results(folder: Path, suite_text: bytes, about: Mapping[str, Any]) -> None:
    """Make a folder of results, or check the one that exists; shards may do so at the same time.

    Raises:
        InputError: The folder holds something else, or results that do not match.
    """
    if folder.exists() and not (folder.is_dir() and (folder / ABOUT).is_file()):
        if not folder.is_dir():
            raise InputError(f"{folder}: a file; give a folder")
        others = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
        if any(name != SUITE for name in others):
            raise InputError(f"{folder}: holds no results but {listed(others)}; give another folder")
    if (folder / ABOUT).is_file():
        check_about(folder, about)
        about = {**about, "data": {**read_about(folder)["data"], **about["data"]}}
    write_file(folder / SUITE, suite_text)
    write_file(folder / ABOUT, (json.dumps(about, indent=2, sort_keys=True) + "\n").encode())


def write_file(path: Path, content: bytes) -> None:
    """Write a file aside and rename it, over one that exists."""
    with output(path, force=True) as aside:
        aside.write_bytes(content)


def runs_of(chunk: Chunk) -> range:
    """Numbers of the runs of a chunk."""
    return range(chunk.first, chunk.first + chunk.runs)


def part_name(chunk: Chunk, whole: Iterable[Chunk]) -> str:
    """Name of the file of a chunk.

    Args:
        chunk: The chunk.
        whole: All chunks of the suite; the name of others has a checksum of their runs and localizers.
    """
    if chunk in whole:
        return f"part-{chunk.part:05d}.parquet"
    text = json.dumps([chunk.first, chunk.runs, chunk.entries])
    return f"part-{chunk.part:05d}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.parquet"


def write_part(
    folder: Path, scenario: str, name: str, rows: Sequence[dict[str, Any]], **more: Sequence[dict[str, Any]]
) -> None:
    """Write the rows of a chunk, and before them other tables of it by name: times, tracks."""
    for kind, part in (*more.items(), (ROWS, rows)):
        table = pa.Table.from_pylist(list(part), schema=SCHEMAS[kind])
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink, compression="zstd")
        write_file(folder / kind / scenario / name, sink.getvalue().to_pybytes())


def done_runs(folder: Path, scenarios: Iterable[str]) -> set[Run]:
    """The runs of some scenarios that a folder has rows of.

    Raises:
        InputError: A file is damaged.
    """
    done: set[Run] = set()
    for scenario in scenarios:
        for file in _parts(folder, ROWS, scenario):
            columns = _read_part(file, ROWS, KEY)
            pairs = zip(columns["localizer"].tolist(), columns["run"].tolist(), strict=True)
            done.update((scenario, *pair) for pair in pairs)
    return done


def _parts(folder: Path, kind: str, scenario: str) -> list[Path]:
    return sorted((folder / kind / scenario).glob("part-*.parquet"))


def _read_part(file: Path, kind: str, names: Sequence[str], filters: pc.Expression | None = None) -> Columns:
    """Some columns of a part of a kind.

    Raises:
        InputError: The file is damaged, or a column is missing or holds other values.
    """
    try:
        table = load_parquet(file, partial(pq.read_table, columns=list(names), filters=filters))
        for name in names:
            if table.column_names.count(name) != 1 or not _fits(table[name], SCHEMAS[kind].field(name).type):
                raise InputError(f"{file}: column {name!r} does not hold {_WORDS[kind, name]}")
    except InputError as error:
        reason = str(error).removeprefix(f"{file}: ").partition(";")[0]
        text = f"{file}: damaged results ({reason}); remove them and repeat magtwin bench"
        raise InputError(text) from error
    return {name: table[name].to_numpy(zero_copy_only=False) for name in names}


def _fits(column: pa.ChunkedArray, kind: pa.DataType) -> bool:
    """Whether a column has values of a type, none of which is missing or below 0."""
    if column.type != kind or column.null_count:
        return False
    if pa.types.is_list(kind):
        return not column.combine_chunks().flatten().null_count
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
    return not (number and pc.any(pc.less(column, 0)).as_py())


def _order(suite: Suite) -> tuple[dict[str, int], dict[str, int]]:
    """Places of scenarios and localizers in a suite."""
    return (
        {name: k for k, name in enumerate(suite.scenarios)},
        {name: k for k, name in enumerate(suite.localizers)},
    )


def _read(folders: Sequence[Path], kind: str, order: tuple[dict[str, int], dict[str, int]]) -> Columns:
    """All rows of a kind, each run once, in the order of the suite: scenario, localizer, run."""
    scenarios, localizers = order
    parts = [
        _read_part(file, kind, SCHEMAS[kind].names)
        for folder in folders
        for name in scenarios
        for file in _parts(folder, kind, name)
    ]
    if not parts:
        return {name: np.empty(0, object) for name in (*KEY, "status")}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in SCHEMAS[kind].names}
    if unknown := set(columns["scenario"].tolist()) - scenarios.keys():
        raise InputError(
            f"{folders[0] / kind}: rows of scenario {min(unknown)!r}, which the suite does not have; remove "
            "them and repeat magtwin bench"
        )
    names = {name: k for k, name in enumerate(sorted(set(columns["localizer"].tolist()) - localizers.keys()))}
    place = localizers | {name: len(localizers) + k for name, k in names.items()}
    keys = [
        (scenarios[s], place[entry], run)
        for s, entry, run in zip(*(columns[name].tolist() for name in KEY), strict=True)
    ]
    first = {key: row for row, key in reversed(list(enumerate(keys)))}
    picked = [first[key] for key in sorted(first)]
    return {name: values[picked] for name, values in columns.items()}


def _schema(**columns: Any) -> pa.Schema:
    """A schema of columns that hold values like these."""
    kinds = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), list: pa.list_(pa.float32())}
    return pa.schema([(name, kinds.get(type(value), pa.float64())) for name, value in columns.items()])


_KEY = {"scenario": "", "localizer": "", "run": 0}
_RUN = {"seed": 0, "session": 0, "status": "", "reason": "", "readings": 0, "smoother": False}
_RUN |= {"global_start": False, "recovered_in_time": 0}
_SCORES = {name: value for name, value in Scores().row().items() if name not in ("failed", "step_us")}
_CURVES = ("t", "error_m", "bound_m", "lost")
SCHEMAS = {
    ROWS: _schema(**_KEY, **_RUN, **_SCORES),
    TIMES: _schema(**_KEY, step_us=0.0),
    TRACKS: _schema(**_KEY, **{name: [] for name in _CURVES}),
}
"""Columns of each kind of table."""

_HOLDS = {"string": "texts", "bool": "flags", "int64": "whole numbers from 0", "double": "numbers from 0"}
_WORDS = {
    (kind, each.name): _HOLDS.get(str(each.type), "lists of numbers")
    for kind, schema in SCHEMAS.items()
    for each in schema
}


def _aligned(times: Columns, rows: Columns) -> Columns:
    """Times in the order of the rows, nan where a run has none."""
    at = {key: k for k, key in enumerate(zip(*(times[name].tolist() for name in KEY), strict=True))}
    picked = [at.get(key, -1) for key in zip(*(rows[name].tolist() for name in KEY), strict=True)]
    spent = np.append(times["step_us"].astype(float), np.nan) if at else np.full(1, np.nan)
    return {**{name: rows[name] for name in KEY}, "step_us": spent[picked]}
