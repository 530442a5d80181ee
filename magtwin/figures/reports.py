"""Reports: one run, several runs, or two runs compared, as a page."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import short_names
from magtwin.figures.comparisons import correlation_text, measures, pictures_of_comparison
from magtwin.figures.page import Page, Section, Table
from magtwin.figures.runs import pictures_of_run
from magtwin.run.compare import ERRORS, Comparison, errors_of
from magtwin.run.run import COLUMNS, Run

MOST_SPANS = 12
"""Times of a flag that a page lists. More are counted."""

MEASURES = ("mean", "RMS", "mean absolute", "maximum")


@dataclass(frozen=True)
class NamedRun:
    """A run of a report."""

    name: str
    """Its name on the page, usually that of its file."""

    run: Run
    field: AnomalyMap | None = None
    """The map to show below its path, or None."""

    planned: ArrayLike | None = None
    """Its planned path in world [m], shape (M, 2), or None."""

    note: str = ""
    """A remark for the reader, such as why its map is not shown."""


def page_of_runs(
    runs: Sequence[NamedRun], *, pictures: bool = True, advance: Callable[[int], None] = lambda done: None
) -> Page:
    """A page about one run or several.

    Args:
        runs: The runs.
        pictures: Whether to draw pictures, which only HTML shows.
        advance: Called with the number of runs that are drawn.

    Raises:
        InputError: There is no run, or one has no rows.
    """
    if not runs:
        raise InputError("no run to report on; name one or more")
    for named in runs:
        if not named.run.rows or "t" not in named.run:
            raise InputError(f"{named.name}: has no readings to report on")
    sections, data = [], []
    for k, named in enumerate(runs):
        sections.append(_section(named, pictures))
        data.append(_data(named))
        advance(k + 1)
    if len(runs) == 1:
        return Page(_title(runs[0]), _sentence(runs[0].run), (sections[0],), data=data[0])
    head = ("run", "path", "seed", "readings", "duration [s]", "distance [m]", "MAE [nT]", "RMS [nT]")
    note = "MAE and RMS: error of b_measured_nt against the exact field, where that is known."
    overview = Table("Overview", (*head, "events"), tuple(map(_overview, runs)), note)
    lead = f"{sum(named.run.rows for named in runs):,} readings in all."
    return Page(f"{len(runs)} runs", lead, tuple(sections), overview, {"runs": data})


def page_of_comparison(a: NamedRun, b: NamedRun, comparison: Comparison) -> Page:
    """A page about two runs laid over each other.

    Args:
        a: The first run.
        b: The second run.
        comparison: Result of `magtwin.run.compare.compare` for the two.
    """
    how = {
        "time": f"{b.name} is shifted by {comparison.shift:+.4f} s, which brings the positions closest.",
        "path": f"Aligned by distance driven; {b.name} is shifted by {comparison.shift:+.4f} m.",
        "none": "Aligned by the clocks of the runs, unchanged.",
    }[comparison.align]
    rows = tuple(
        (row.name, row.unit, *measures(row), row.count, correlation_text(row))
        for row in comparison.agreements()
    )
    head = ("quantity", "unit", *MEASURES, "readings", "correlation")
    note = "Along-track: ahead of the first run; cross-track: to its left."
    tables = [Table(f"{b.name} minus {a.name}", head, rows, note)]
    one, other = a.run.metadata, b.run.metadata
    names = [*sorted(one), *sorted(other.keys() - one.keys())]
    differ = tuple(
        (name, one.get(name, ""), other.get(name, "")) for name in names if one.get(name) != other.get(name)
    )
    if differ:
        tables.append(Table("Metadata that differ", ("metadata", a.name, b.name), differ, exact=True))
    pictures = tuple(pictures_of_comparison(a.run, b.run, comparison, (a.name, b.name)))
    return Page(
        " and ".join(short_names((a.name, b.name))),
        f"{a.name} and {b.name}: {len(comparison.at):,} readings compared. {how}",
        (Section("Comparison", "", pictures, tuple(tables)),),
        data={"a": a.name, "b": b.name, **comparison.summary(), "metadata": [dict(one), dict(other)]},
    )


def _title(named: NamedRun) -> str:
    metadata = named.run.metadata
    title = f"Run: {metadata['path']}" if metadata.get("path") else f"Run {named.name}"
    return f"{title} in {metadata['scene']}" if metadata.get("scene") else title


def _sentence(run: Run) -> str:
    """The run in one line."""
    words, distance = [f"{run.rows:,} readings in {run.duration_s:,.1f} s"], _distance_m(run)
    if distance is not None:
        words.append(f"{distance:,.1f} m driven")
    for name in ("controller", "engine", "magnetometer", "network", "map", "seed"):
        if name in run.metadata:
            text = (
                f"{run.metadata[name]} {name}" if name == "magnetometer" else f"{name} {run.metadata[name]}"
            )
            words.append(text)
    return ", ".join(words) + "."


def _section(named: NamedRun, pictures: bool) -> Section:
    run = named.run
    rows: tuple[tuple[Any, ...], ...] = tuple(
        (f.name, f.value, "" if f.spread is None else f.spread, f.unit, f.note) for f in run.report().figures
    )
    tables = [Table("Figures", ("quantity", "value", "standard deviation", "unit", "note"), rows)]
    errors = errors_of(run)
    if errors:
        rows = tuple((name, ERRORS[name][2], *measures(row), row.count) for name, row in errors.items())
        terms = (f"{name} = {' - '.join((ERRORS[name][0], *ERRORS[name][1]))}" for name in errors)
        note = f"Each error is the difference of columns: {'; '.join(terms)}"
        coverage = _coverage(run)
        if coverage is not None:
            note += f". {100 * coverage:.1f} % of the total errors lie within 2 predicted standard deviations"
        head = ("source", "meaning", *(f"{name} [nT]" for name in MEASURES), "readings")
        tables.append(Table("Errors by source", head, rows, note + "."))
    events = tuple(
        (name, COLUMNS[name].doc if name in COLUMNS else "", count, _times(spans))
        for name, count, spans in _events(run)
    )
    head = ("flag", "meaning", "readings", "times [s]")
    tables.append(Table("Events", head, events, "" if events else "None."))
    rows = tuple(run.metadata.items())
    tables.append(Table("Provenance", ("metadata", ""), rows, "" if rows else "No metadata.", exact=True))
    drawn = pictures_of_run(run, named.field, named.planned) if pictures else []
    return Section(_title(named), f"{named.name}. {named.note}".strip(), tuple(drawn), tuple(tables))


def _overview(named: NamedRun) -> tuple[Any, ...]:
    run = named.run
    distance, total = _distance_m(run), errors_of(run).get("total")
    events = sum(int(run[name].any()) for name in run if name.startswith("flag_"))
    return (
        named.name,
        run.metadata.get("path", ""),
        run.metadata.get("seed", ""),
        run.rows,
        round(run.duration_s, 1),
        "" if distance is None else round(distance, 1),
        "" if total is None else total.mae,
        "" if total is None else total.rms,
        f"{events} flag{'s' * (events > 1)} raised" if events else "none",
    )


def _data(named: NamedRun) -> dict[str, Any]:
    run = named.run
    errors = {
        name: {key: value for key, value in vars(row).items() if key not in ("name", "correlation")}
        for name, row in errors_of(run).items()
    }
    events = [
        {"flag": name, "readings": count, "spans_s": [list(span) for span in spans]}
        for name, count, spans in _events(run)
    ]
    figures = json.loads(run.report(named.name).to_json())["figures"]
    return {
        "name": named.name,
        "figures": figures,
        "errors": errors,
        "events": events,
        "metadata": dict(run.metadata),
    }


def _distance_m(run: Run) -> float | None:
    figure = next((f for f in run.report().figures if f.name == "distance driven"), None)
    return None if figure is None else float(figure.value)


def _coverage(run: Run) -> float | None:
    """Share of the predictions whose error lies within twice its predicted standard deviation."""
    if not {"b_sd_nt", "b_total_nt", "b_truth_nt"} <= set(run):
        return None
    error, sd = run["b_total_nt"] - run["b_truth_nt"], run["b_sd_nt"]
    known = np.isfinite(error) & np.isfinite(sd)
    return float(np.mean(np.abs(error[known]) <= 2 * sd[known])) if known.any() else None


def _events(run: Run) -> list[tuple[str, int, list[tuple[float, float]]]]:
    """Flags that were raised: name, number of readings, and first and last time of each stretch [s]."""
    events, t = [], run["t"]
    for name in run:
        if name.startswith("flag_") and run[name].dtype == bool and run[name].any():
            edges = np.flatnonzero(np.diff(np.concatenate([[False], run[name], [False]]).astype(int)))
            spans = [(float(t[first]), float(t[after - 1])) for first, after in edges.reshape(-1, 2)]
            events.append((name, int(run[name].sum()), spans))
    return events


def _times(spans: Sequence[tuple[float, float]]) -> str:
    text = ", ".join(f"{a:.2f}–{b:.2f}" if b > a else f"{a:.2f}" for a, b in spans[:MOST_SPANS])
    return text + (f" and {len(spans) - MOST_SPANS:,} more" if len(spans) > MOST_SPANS else "")
