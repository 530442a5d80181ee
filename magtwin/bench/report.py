"""Report: results of a benchmark as one page, with tables, and pictures of how errors are distributed."""

import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from magtwin.bench.leaderboard import Columns, Difference, Standing, compare_rows, letters, standings
from magtwin.bench.results import read_results
from magtwin.bench.statistics import Interval, Paired
from magtwin.bench.suite import SIMULATED, Scenario
from magtwin.figures.canvas import Chart, label, legend_above
from magtwin.figures.page import Page, Section, Table, write_pages
from magtwin.figures.style import INK, SERIES, SOFT
from magtwin.files.outputs import check_free
from magtwin.report.report import Report

Array = NDArray[np.float64]

LEAST_M, MOST_M = 0.01, 5.0  # Range of errors in figures [m]
Look = Mapping[str, Any]

NAME = "bench"
"""Name of a report's files."""


def report_results(
    folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str], *, force: bool = False
) -> None:
    """Write the report of results as a folder: bench.html, bench.json and the pictures.

    Args:
        folders: Folders of results of one suite.
        out: The folder to make.
        force: Whether to replace an existing folder.

    Raises:
        InputError: A folder holds no results or those of another suite, or `out` exists.
    """
    check_free(out, force=force)
    made = read_results(*folders)
    rows = made.rows
    pairs = dict.fromkeys(zip(rows["scenario"].tolist(), rows["localizer"].tolist(), strict=True))
    tracks = [
        {"scenario": scenario, "localizer": localizer, **track}
        for scenario, localizer in pairs
        for track in made.tracks(scenario, localizer)
    ]
    about = made.about
    origin = (
        f"Suite {about['name']}, version {about['version']}, {about['seeds']} seeds, checksum "
        f"{about['sha256'][:12]}; magtwin {about['magtwin']}."
    )
    if made.missing:
        origin += f" {made.missing:,} runs of the suite are missing."
    page = page_of_results(
        rows,
        made.times,
        tracks,
        made.suite.scenarios,
        compensated=made.compensated,
        title=f"Benchmark {about['name']}",
        origin=origin,
    )
    write_pages(page, out, NAME, force=force)


def compare_results(a: str | os.PathLike[str], b: str | os.PathLike[str]) -> Report:
    """Compare two results of one suite, run by run.

    Args:
        a: Folder of results.
        b: Folder of other results.

    Raises:
        InputError: A folder holds no results, or they share no run.
    """
    first, second = read_results(a), read_results(b)
    lines = {}
    for d in compare_rows(first.rows, second.rows):
        lines[f"{d.scenario}, {d.a}"] = (
            f"A - B [m] {_difference(d.rmse_m)}, p {d.rmse_m.p:.2g}, {_count(d.runs, 'run')}: {d.verdict}"
        )
    notes = {}
    if first.about["sha256"] != second.about["sha256"]:
        notes["note"] = "the suites differ; runs with the same scenario name and seed are compared"
    return Report(f"RMSE of {a} (A) and {b} (B)", (), {"differences": lines, **notes})


def page_of_results(
    rows: Columns,
    times: Columns | None,
    tracks: Sequence[Mapping[str, Any]],
    scenarios: Mapping[str, Scenario],
    *,
    compensated: Collection[str] = (),
    title: str,
    origin: str = "",
) -> Page:
    """The report of a benchmark.

    Args:
        rows: Rows of the results, as arrays by name.
        times: Processor times of the same runs.
        tracks: Errors over time, one mapping per run and localizer.
        scenarios: Scenarios by name.
        compensated: As for `standings`.
        title: Title of the page.
        origin: Suite, version, seeds and checksum, in one sentence.
    """
    all_of_them = standings(rows, times, compensated)
    names = list(dict.fromkeys(s.localizer for s in all_of_them))
    looks = {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)}
    sections = [Section("Leaderboard", _lead(rows), (), (_overview(all_of_them),))]
    for scenario in dict.fromkeys(s.scenario for s in all_of_them):
        here = [s for s in all_of_them if s.scenario == scenario]
        mine = [t for t in tracks if t["scenario"] == scenario]
        causal = {s.localizer for s in here} - {*compensated, *rows["localizer"][rows["smoother"]].tolist()}
        charts = [_cdf(here, rows, looks), _over_time(here, mine, looks, causal)]
        best = _best(here)
        tables = [_accuracy(here, letters(rows, here)), _reliability(here)]
        if best is not None and len(here) > 1:
            pairs = [(best.localizer, s.localizer) for s in here if s is not best]
            kept = {k: v[rows["scenario"] == scenario] for k, v in rows.items()}
            tables.append(_differences(compare_rows(kept, kept, localizers=pairs)))
        if failures := _failures(rows, scenario):
            tables.append(failures)
        sections.append(
            Section(
                scenario,
                _described(scenarios[scenario], here, rows) if scenario in scenarios else "",
                tuple(chart.picture() for chart in charts if chart is not None),
                tuple(tables),
            )
        )
    data = {"standings": [_plain(s) for s in all_of_them]}
    verdict, figures = _verdict(all_of_them), _figures(rows, all_of_them)
    return Page(title, origin, tuple(sections), data=data, verdict=verdict, figures=figures)


def _verdict(every: Sequence[Standing]) -> str:
    """The best localizer of each scenario, in a line each."""
    lines = []
    for scenario in dict.fromkeys(s.scenario for s in every):
        best = _best([s for s in every if s.scenario == scenario])
        if best is None or best.rmse_m is None:
            lines.append(f"{scenario}: no localizer has a result.")
            continue
        bound = f", {best.ratio:.2f} times its bound" if math.isfinite(best.ratio) else ""
        lines.append(f"{scenario}: {best.localizer} has the least RMSE, {_interval(best.rmse_m)} m{bound}.")
    return "\n".join(lines)


def _figures(rows: Columns, every: Sequence[Standing]) -> list[tuple[str, str]]:
    """The benchmark in five figures."""
    failed, sessions = np.count_nonzero(rows["status"] != "ok"), len(np.unique(rows["session"]))
    kinds = len({s.localizer for s in every}), len({s.scenario for s in every})
    names = ("runs", "failed", "localizers", "scenarios", "sessions")
    counts = (len(rows["run"]), failed, *kinds, sessions)
    return [(name, f"{count:,}") for name, count in zip(names, counts, strict=True)]


def _described(scenario: Scenario, here: Sequence[Standing], rows: Columns) -> str:
    """A scenario in words, with the runs and sessions that are in the results."""
    counts = [s.runs for s in here]
    sessions = len(np.unique(rows["session"][rows["scenario"] == scenario.name]))
    text = describe(replace(scenario, runs=max(counts), sessions=sessions))
    if min(counts) < max(counts):
        text += f" Some localizers have fewer runs, {min(counts):,} at least: see the column runs."
    return text


def describe(scenario: Scenario) -> str:
    """A scenario in words: its size, and the keys of a suite that differ from their defaults."""
    size = f"{_count(scenario.runs, 'run')} of recorded data."
    if scenario.source in SIMULATED:
        sessions = _count(min(scenario.runs, scenario.sessions), "session")
        size = f"{_count(scenario.runs, 'run')} of {scenario.duration_s:g} s in {sessions}."
    keys = [key for key in _changed(scenario) if key[0] not in ("name", "runs", "sessions", "duration_s")]
    return size + (f" Set: {', '.join(f'{name} {value}' for name, value in keys)}." if keys else "")


def _changed(settings: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Names and values of the fields that differ from their defaults."""
    found = []
    for each in fields(settings):
        value = getattr(settings, each.name)
        default = each.default_factory() if each.default_factory is not MISSING else each.default
        if is_dataclass(value):
            found += _changed(value, f"{each.name}.")
        elif value != default:
            found.append((prefix + each.name, value))
    return found


def _lead(rows: Columns) -> str:
    failed = int(np.count_nonzero(rows["status"] != "ok"))
    runs = _count(len(rows["run"]), "run")
    localizers = _count(len(np.unique(rows["localizer"])), "localizer")
    return (
        f"{runs} of {localizers} in all, {failed:,} of which failed. RMSE of the position [m], pooled over "
        "runs; trajectories are not aligned. Each row has its own bound, over its own runs: Cramer-Rao with "
        "the map's error as correlated; for smoothers, of all readings; with a compensator, on an exact map "
        "with the robot's own field known. It holds for methods that know only what the problem tells. In "
        "few runs, luck can beat it. Intervals: 95 %, by bootstrap over sessions, or over runs where all are "
        "of one session."
    )


def _best(here: Sequence[Standing]) -> Standing | None:
    """The localizer with the least RMSE among those that seldom diverge, else among all."""
    known = [s for s in here if s.rmse_m is not None]
    sound = [s for s in known if s.diverged.value <= 0.05 and not s.failed]
    return min(sound or known, key=lambda s: s.rmse_m.value if s.rmse_m else math.inf, default=None)


def _overview(every: Sequence[Standing]) -> Table:
    scenarios = list(dict.fromkeys(s.scenario for s in every))
    names = list(dict.fromkeys(s.localizer for s in every))
    by = {(s.localizer, s.scenario): s for s in every}
    rows = []
    for name in names:
        cells = []
        for scenario in scenarios:
            s = by.get((name, scenario))
            if s is None or s.rmse_m is None:
                cells.append("" if s is None else "failed")
            else:
                bound = f" ({s.median_bound_m:.3f})" if s.bound_m > 0 else ""
                cells.append(f"{s.median_m:.3f}{bound}")
        rows.append((name, *cells))
    return Table("Median RMSE of a run, and median bound [m]", ("localizer", *scenarios), tuple(rows))


def _accuracy(here: Sequence[Standing], same: Mapping[str, str]) -> Table:
    head = (
        "localizer",
        "runs",
        "median [m]",
        "RMSE [m]",
        "95th percentile [m]",
        "bound [m]",
        "RMSE / bound",
        "heading [deg]",
        "us a step",
    )
    rows = [
        (
            s.localizer,
            s.runs,
            f"{_interval(s.median)} {same.get(s.localizer, '')}".strip(),
            _interval(s.rmse_m),
            _number(s.p95_m),
            _number(s.bound_m),
            _number(s.ratio, 2),
            _number(math.degrees(s.heading_rad), 1),
            _number(s.step_us, 0),
        )
        for s in here
    ]
    note = "Localizers with a letter in common could not be told apart (paired runs, p 0.05)."
    return Table("Accuracy", head, tuple(rows), note)


def _reliability(here: Sequence[Standing]) -> Table:
    unknown_start = any(s.converged is not None for s in here)
    kidnapped = any(s.recovered is not None for s in here)
    head = ["localizer", "ANEES per state", "runs consistent", "in 90 % ellipse", "diverged [%]"]
    head += ["found in 30 s [%]", "first fix [s]"] if unknown_start else []
    head += ["recovered in 30 s [%]"] if kidnapped else []
    head += ["lost", "failed", "remarks"]
    rows = []
    for s in here:
        row = [s.localizer, _interval(s.anees, 2), _percent(s.anees_inside), _percent(s.coverage)]
        row += [_rate(s.diverged)]
        row += [_rate(s.converged), _number(s.first_fix_s, 1)] if unknown_start else []
        row += [_rate(s.recovered)] if kidnapped else []
        row += [_percent(s.lost_share), str(s.failed), s.verdict()]
        rows.append(tuple(row))
    note = (
        "ANEES per state: median of runs (quartiles); 1 if the covariance is right, above 1 if it is too "
        "small. runs consistent: share of runs whose ANEES is in its 95 % chi-square interval. A start "
        "counts as found, and a kidnapping as recovered from, once the error stays below 0.25 m for 10 s. "
        "diverged: above 0.5 m for more than 5 s after that, or failed. lost: share of readings that were "
        "flagged."
    )
    return Table("Reliability", tuple(head), tuple(rows), note)


def _differences(found: Sequence[Difference]) -> Table:
    rows = tuple(
        (d.scenario, d.a, d.b, d.runs, _difference(d.rmse_m), f"{d.rmse_m.p:.3g}", d.verdict) for d in found
    )
    head = ("scenario", "A", "B", "runs of both", "RMSE of A - B [m] (95 %)", "p", "verdict")
    return Table("Paired differences", head, rows, "Mean over runs; p by permutation of sessions.")


def _failures(rows: Columns, scenario: str) -> Table | None:
    mine = (rows["scenario"] == scenario) & (rows["status"] != "ok")
    if not mine.any():
        return None
    counted: dict[tuple[str, str], int] = {}
    for name, reason in zip(rows["localizer"][mine].tolist(), rows["reason"][mine].tolist(), strict=True):
        counted[name, reason] = counted.get((name, reason), 0) + 1
    found = sorted(counted.items(), key=lambda item: -item[1])[:20]
    return Table("Failures", ("localizer", "runs", "reason"), tuple((k[0], n, k[1]) for k, n in found))


def _cdf(here: Sequence[Standing], rows: Columns, looks: Mapping[str, Look]) -> Chart | None:
    found = {}
    for s in here:
        mine = (rows["scenario"] == s.scenario) & (rows["localizer"] == s.localizer)
        found[s.localizer] = np.sort(rows["rmse_m"][mine & (rows["status"] == "ok")])
    bounds = any(s.bound_m > 0 and len(found[s.localizer]) for s in here)

    def draw(ax: Axes) -> None:
        for s in here:
            errors, look = found[s.localizer], looks[s.localizer]
            if not len(errors):
                continue
            x = np.clip(np.append(errors[:1], errors), LEAST_M, MOST_M)
            ax.step(x, np.arange(len(errors) + 1) / s.runs, where="post", **look, label=s.localizer)
            if s.bound_m > 0:
                ax.axvline(max(s.bound_m, LEAST_M), color=look["color"], lw=1, ls=":", zorder=1)
        if bounds:
            ax.plot([], [], color=SOFT, lw=1, ls=":", label="its bound")
        ax.set_xscale("log")
        _error_axis(ax.xaxis)
        ax.set_ylim(0, 1.02)
        label(ax, "RMSE of a run [m]", "share of runs")
        legend_above(ax, 2)

    if not any(map(len, found.values())):
        return None
    scenario = here[0].scenario
    text = f"{scenario}: share of runs below an RMSE, and the bound of each localizer's pooled RMSE (dots)"
    return Chart(text, draw, 3.0 + 0.1 * len(here), f"{scenario}_cdf")


def _over_time(
    here: Sequence[Standing],
    tracks: Sequence[Mapping[str, Any]],
    looks: Mapping[str, Look],
    causal: Collection[str],
) -> Chart | None:
    """Errors over time; the bound is that of the localizers in `causal`, over all runs."""
    if not tracks:
        return None
    runs = list({t["run"]: t for t in tracks if t["localizer"] in causal}.values())
    bound = _stacked(runs, "bound_m")
    bounded = bound is not None and bool(np.isfinite(bound).any())

    def draw(ax: Axes) -> None:
        for s in here:
            mine, look = [t for t in tracks if t["localizer"] == s.localizer], looks[s.localizer]
            errors = _stacked(mine, "error_m")
            if errors is None or not np.isfinite(errors).any():
                continue
            t = max((m["t"] for m in mine), key=len)
            ax.plot(t, _middle(errors, 50), **look, label=s.localizer)
            ax.plot(t, _middle(errors, 95), **look, lw=0.7, alpha=0.6)
        if bound is not None and bounded:
            t = max((run["t"] for run in runs), key=len)
            ax.plot(t, np.sqrt(np.nanmean(bound**2, axis=0)), color=INK, lw=1.2, ls=":", label="bound, RMS")
        ax.set_yscale("log")
        ax.set_ylim(LEAST_M, MOST_M)
        _error_axis(ax.yaxis)
        label(ax, "time [s]", "position error [m]")
        legend_above(ax, 2)

    text = f"{here[0].scenario}: position error over time, median of runs and 95th percentile (thin)"
    if bounded:
        text += (
            "; bound of the RMS of causal methods without a compensator (dots): a median of 0.83 of it "
            "reaches it"
        )
    return Chart(text, draw, 3.0 + 0.1 * len(here), f"{here[0].scenario}_time")


def _stacked(tracks: Sequence[Mapping[str, Any]], name: str) -> Array | None:
    """Values over time of all runs, shape (runs, N), nan after the end of shorter ones."""
    if not tracks:
        return None
    longest = max(len(t[name]) for t in tracks)
    out = np.full((len(tracks), longest), np.nan)
    for row, t in zip(out, tracks, strict=True):
        row[: len(t[name])] = t[name]
    return out


def _middle(values: Array, percent: float) -> Array:
    known = np.isfinite(values).any(axis=0)
    out = np.full(values.shape[1], np.nan)
    out[known] = np.nanpercentile(values[:, known], percent, axis=0)
    return np.clip(out, LEAST_M, MOST_M)


def _error_axis(axis: Any) -> None:
    ticks = [0.01, 0.03, 0.1, 0.3, 1, 3]
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _interval(value: Interval | None, digits: int = 3) -> str:
    if value is None or not math.isfinite(value.low):
        return "" if value is None else _number(value.value, digits)
    return f"{value.value:.{digits}f} ({value.low:.{digits}f} to {value.high:.{digits}f})"


def _difference(value: Paired) -> str:
    if not math.isfinite(value.low):
        return f"{value.difference:+.4f}"
    return f"{value.difference:+.4f} ({value.low:+.4f} to {value.high:+.4f})"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}"


def _rate(value: Interval | None) -> str:
    if value is None:
        return ""
    return f"{100 * value.value:.1f} ({100 * value.low:.1f} to {100 * value.high:.1f})"


def _number(value: float, digits: int = 3) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.0f} %"


def _plain(value: Standing) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, entry in vars(value).items():
        out[name] = entry._asdict() if hasattr(entry, "_asdict") else entry
    return out
