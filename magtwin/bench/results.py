"""Results: the rows of a benchmark in a folder, with what they were made of.

    suite.toml      the suite's file
    suite.json      name, version and checksums of suite and data, version of magtwin

and the tables of `magtwin.bench.store`.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from magtwin.bench.store import (
    CURVES,
    KEY,
    ONCE,
    ROWS,
    TIMES,
    TRACKS,
    TRUTHS,
    Columns,
    Order,
    read_columns,
    read_tables,
    write_file,
)
from magtwin.bench.suite import Seeds, Suite, load_suite
from magtwin.errors import InputError, find
from magtwin.files.file import read_text
from magtwin.files.kinds import expected
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed

if TYPE_CHECKING:
    from magtwin.bench.leaderboard import Standing

SUITE, ABOUT = "suite.toml", "suite.json"
_ABOUT_KINDS = {**dict.fromkeys(("name", "sha256", "seeds", "magtwin"), str), "version": int, "data": dict}
"""Kinds of the values in suite.json."""


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
        scenario, localizer, run = (self.rows[name] for name in ("scenario", "localizer", "run"))
        left = 0
        for s in self.suite.scenario:
            there = localizer[(scenario == s.name) & (run < s.runs)]
            left += sum(s.runs - int((there == name).sum()) for name in self.suite.entries_of(s))
        return left

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
        names, order = list(self.suite.scenarios) if scenario is None else [scenario], Order(self.suite)
        once = read_tables(self.folders, TRUTHS, names)
        keys = zip(once["scenario"].to_pylist(), once["run"].to_pylist(), strict=True)
        known = dict(zip(keys, zip(*(_curves(once[c]) for c in ONCE), strict=True), strict=True))
        made = order.sorted(read_tables(self.folders, TRACKS, names, match=match))
        columns = [made[c].to_pylist() for c in KEY] + [_curves(made[c]) for c in CURVES]
        found = []
        for at, who, k, error, lost in zip(*columns, strict=True):
            t, bound = known.get((at, k), (error[:0], error[:0]))
            if not len(t) == len(bound) == len(error) == len(lost):
                raise InputError(
                    f"{self.folders[0]}: damaged results (curves of unequal length); remove them and "
                    "repeat magtwin bench"
                )
            curves = {"t": t, "error_m": error, "bound_m": bound, "lost": lost}
            found.append({"scenario": at, "localizer": who, "run": k, **curves})
        return found

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
        suite = replace(suite, seeds=about["seeds"])
    order = Order(suite)
    rows = read_columns(places, ROWS, order)
    return Results(places, suite, about, rows, _aligned(read_columns(places, TIMES, order), rows))


def _aligned(times: Columns, rows: Columns) -> Columns:
    """Times in the order of the rows, nan where a run has none."""
    key, spent = {name: rows[name] for name in KEY}, np.full(len(rows["run"]), np.nan)
    if all(np.array_equal(times[name], rows[name]) for name in KEY):
        return {**key, "step_us": times["step_us"]}
    at = {key: k for k, key in enumerate(zip(*(times[name].tolist() for name in KEY), strict=True))}
    for k, key_of in enumerate(zip(*(rows[name].tolist() for name in KEY), strict=True)):
        if key_of in at:
            spent[k] = times["step_us"][at[key_of]]
    return {**key, "step_us": spent}


def _curves(column: pa.ChunkedArray) -> list[NDArray[np.float32]]:
    """Lists of numbers as arrays."""
    return [each for chunk in column.chunks for each in chunk.to_numpy(zero_copy_only=False)]


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
