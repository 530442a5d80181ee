"""Reports: one run or several as a page; two runs compared; and one path driven twice."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import (
    POINTS,
    Chart,
    draw_line,
    evenly,
    label,
    legend_above,
    new_figure,
    short_pair,
)
from magtwin.figures.page import Page, Section, Table
from magtwin.figures.player import Player, player_of
from magtwin.figures.runs import field_name, path_picture, position_name
from magtwin.figures.style import DATA, MODEL, styled
from magtwin.report.report import Report
from magtwin.run.compare import ERRORS, Agreement, Comparison, Traversals, errors_of, terms_of
from magtwin.run.figures import prediction_nt
from magtwin.run.run import COLUMNS, Metadata, Run

MOST_SPANS = 12
"""Times of a flag that a page lists. More are counted."""

ALIGNED = {
    "recorded": "by time from each start",
    "timed": "by time, clocks aligned",
    "placed": "by distance driven",
}
"""How two traversals of a path are aligned."""

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

    stage: Path | None = None
    """Its scene, or None."""


def page_of_runs(
    runs: Sequence[NamedRun], *, pictures: bool = True, advance: Callable[[int], None] = lambda done: None
) -> Page:
    """A page about one run or several.

    Args:
        runs: The runs.
        pictures: Whether to draw pictures.
        advance: Called with the number of runs that are drawn.

    Raises:
        InputError: There is no run, or one has no rows.
    """
    if not runs:
        raise InputError("no run to report on; name one or more")
    for named in runs:
        if not named.run.rows or "t" not in named.run:
            raise InputError(f"{named.name}: has no readings to report on")
    sections = []
    for k, named in enumerate(runs):
        sections.append(_section(named, pictures and len(runs) > 1))
        advance(k + 1)
    if len(runs) == 1:
        lead = runs[0].run.report().verdict or _sentence(runs[0].run)
        player = _player(runs[0]) if pictures else None
        return Page(_title(runs[0]), lead, (sections[0],), player=player)
    head = ("run", "path", "seed", "readings", "duration [s]", "distance [m]", "MAE [nT]", "RMS [nT]")
    note = "MAE and RMS: error of b_measured_nt against the exact field, where that is known."
    overview = Table("Overview", (*head, "events"), tuple(map(_overview, runs)), note)
    lead = f"{sum(named.run.rows for named in runs):,} readings in all."
    return Page(f"{len(runs)} runs", lead, tuple(sections), overview)


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
    tables = [figures_table(run.report())]
    errors = errors_of(run)
    if errors:
        rows: tuple[tuple[Any, ...], ...] = tuple(
            (name, ERRORS[name][2], *_measures(row), row.count) for name, row in errors.items()
        )
        terms = (f"{name} = {' - '.join(terms_of(run, name))}" for name in errors)
        note = f"Each error is the difference of columns: {'; '.join(terms)}"
        coverage = _coverage(run)
        if coverage is not None:
            note += f". {100 * coverage:.1f} % of the predictions lie within 2 of their standard deviations"
        head = ("source", "meaning", *(f"{name} [nT]" for name in MEASURES), "readings")
        tables.append(Table("Errors by source", head, rows, note + "."))
    events = tuple(
        (name, COLUMNS[name].doc if name in COLUMNS else "", count, _times(spans))
        for name, count, spans in _events(run)
    )
    head = ("flag", "meaning", "readings", "times [s]")
    tables.append(Table("Events", head, events, "" if events else "None."))
    tables.append(provenance_table(run.metadata))
    drawn = path_picture(run, named.field, named.planned) if pictures else None
    lead = f"{named.name}: {_sentence(run)} {named.note}".strip()
    return Section(_title(named), lead, () if drawn is None else (drawn,), tuple(tables))


def page_of_report(
    report: Report, title: str, lead: str = "", charts: Sequence[Chart] = (), tables: Sequence[Table] = ()
) -> Page:
    """A report as a page: its verdict, first figures, charts, and tables, its source folded."""
    shown = [
        (f.name, f"{f.value:,.5g} {f.unit}".strip())
        for f in report.figures
        if isinstance(f.value, float | int)
    ]
    tables = (*tables, figures_table(report), provenance_table(report.metadata))
    section = Section(title, "", tuple(chart.picture() for chart in charts), tables)
    data = json.loads(report.to_json())
    return Page(title, lead, (section,), verdict=report.verdict, figures=shown[:5], data=data)


def figures_table(report: Report) -> Table:
    """The figures of a report."""
    rows = tuple(
        (f.name, f.value, "" if f.spread is None else f.spread, f.unit, f.note) for f in report.figures
    )
    return Table("Figures", ("quantity", "value", "standard deviation", "unit", "note"), rows)


def provenance_table(metadata: Mapping[str, Any], title: str = "Provenance") -> Table:
    """Where something comes from."""
    rows = tuple(metadata.items())
    return Table(title, ("metadata", ""), rows, "" if rows else "No metadata.", exact=True)


def _player(named: NamedRun) -> Player:
    """What plays a run; its charts and map alone if its scene cannot be shown, and why."""
    still = path_picture(named.run, named.field, named.planned)
    options: Any = {"still": b"" if still is None else still.data}
    try:
        return player_of(named.run, named.field, named.stage, **options)
    except InputError as error:
        player = player_of(named.run, named.field, None, **options)
        return replace(player, note=f"The scene is not shown: {error}. {player.note}".strip())


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


def _distance_m(run: Run) -> float | None:
    figure = next((f for f in run.report().figures if f.name == "distance driven"), None)
    return None if figure is None else float(figure.value)


def _coverage(run: Run) -> float | None:
    """Share of the predictions whose error lies within twice its predicted standard deviation."""
    if not {"b_sd_nt", "b_total_nt", "b_truth_nt"} <= set(run):
        return None
    error, sd = prediction_nt(run) - run["b_truth_nt"], run["b_sd_nt"]
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


def _measures(agreement: Agreement) -> tuple[float, float, float, float]:
    """Mean, RMS, mean absolute and greatest difference."""
    return agreement.mean, agreement.rms, agreement.mae, agreement.greatest


def _correlation(agreement: Agreement) -> str:
    """Correlation to four digits; "" if there is none."""
    return "" if agreement.correlation is None else f"{agreement.correlation:.4f}"


@styled
def draw_comparison(a: NamedRun, b: NamedRun, comparison: Comparison) -> Figure:
    """Draw two runs by their own clocks, and aligned, as `magtwin.run.compare.compare` compared them."""
    charts = _charts(a, b, comparison)
    heights = [chart.height_in for chart in charts]
    figure = new_figure(9.0, 0.95 * sum(heights))
    axes = figure.subplots(len(charts), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, chart in zip(axes, charts, strict=True):
        chart.draw(ax)
        ax.set_title(chart.title, loc="right")
    return figure


def page_of_comparison(a: NamedRun, b: NamedRun, comparison: Comparison) -> Page:
    """Two runs compared, as `magtwin.run.compare.compare` did: how far they are apart, and where."""
    rows = comparison.agreements()
    field = next((row for row in rows if row.unit == "nT"), None)
    apart = [row for row in rows if row.unit == "m"]
    words = [f"{field.name} by {field.rms:,.1f} nT (RMS)"] if field else []
    words += [f"{row.name} by {row.rms:.3g} m (RMS)" for row in apart]
    moved = f"moved by {comparison.shift:+.3f} {comparison.unit}"
    how = "clocks as recorded" if comparison.align == "none" else moved
    figures = [("readings compared", f"{len(comparison.at):,}"), ("alignment", how)]
    figures += [(f"{row.name}, RMS", f"{row.rms:,.4g} {row.unit}") for row in rows[:3]]
    pictures = tuple(chart.picture() for chart in _charts(a, b, comparison))
    head = ("quantity", "unit", *MEASURES, "correlation", "readings")
    cells = tuple((row.name, row.unit, *_measures(row), _correlation(row), row.count) for row in rows)
    tables = [Table("Differences", head, cells, f"{b.name} minus {a.name}.")]
    tables += [provenance_table(one.run.metadata, f"Provenance of {one.name}") for one in (a, b)]
    verdict = f"{b.name} differs from {a.name}: {', '.join(words) or 'nothing can be compared'}, {how}."
    section = Section("Differences", "", pictures, tuple(tables))
    return Page(
        "Two runs compared", "", (section,), verdict=verdict, figures=figures, data=comparison.summary()
    )


def section_of_traversals(both: Traversals, names: tuple[str, str]) -> Section:
    """A section of a report: one path driven twice, with and without alignment.

    Args:
        both: Result of `magtwin.run.compare.traversals`.
        names: Names of the two runs.
    """
    a, b = (NamedRun(name, run) for name, run in zip(names, (both.a, both.b), strict=True))
    rows, pictures = [], []
    for key, text in ALIGNED.items():
        comparison: Comparison = getattr(both, key)
        wanted = ("aligned", "distance") if key == "recorded" else ("aligned",)
        for chart in _charts(a, b, comparison):
            if chart.file in wanted:
                title, file = f"Figure 8: {text}: {chart.title}", f"figure_8_{key}_{chart.file}"
                pictures.append(replace(chart, title=title, file=file).picture())
        rows += [
            (text, row.name, row.unit, *_measures(row), _correlation(row)) for row in comparison.agreements()
        ]
    head = ("aligned", "quantity", "unit", *MEASURES, "correlation")
    note = f"{names[1]} minus {names[0]}. Along-track: ahead of the first run; cross-track: to its left."
    title, runs = "One path, driven twice", [f"{one.name}: {_driven(one.run.metadata)}" for one in (a, b)]
    return Section(title, "; ".join(runs) + ".", tuple(pictures), (Table(title, head, tuple(rows), note),))


def _charts(a: NamedRun, b: NamedRun, comparison: Comparison) -> list[Chart]:
    """The field as recorded and aligned, the distance, and both paths, as far as they are known."""
    column, position = field_name(a.run, b.run), position_name(a.run, b.run)
    names = short_pair((a.name, b.name))
    along = "distance driven [m]" if comparison.align == "path" else "time [s]"
    looks: tuple[dict[str, Any], ...] = (
        {"color": DATA, "lw": 2.2, "alpha": 0.6},
        {"color": MODEL, "lw": 1.1},
    )

    def lines(
        x: str, y: str, *curves: tuple[Any, Any], names: Sequence[str] = names
    ) -> Callable[[Axes], None]:
        def draw(ax: Axes) -> None:
            for (at, values), name, look in zip(curves, names, looks, strict=True):
                draw_line(ax, at, values, label=name, **look)
            ax.margins(x=0)
            label(ax, x, y)
            legend_above(ax, 2)

        return draw

    def paths(ax: Axes) -> None:
        for run, name, look in zip((a.run, b.run), names, looks, strict=True):
            ax.plot(*run[str(position)][evenly(run.rows, POINTS), :2].T, label=name, **look)
        ax.set_aspect("equal")
        ax.margins(0.05)
        label(ax, "x [m]", "y [m]")
        legend_above(ax, 2)

    charts = []
    if column is not None:
        match = next((row for row in comparison.agreements() if row.name == column), None)
        title = "aligned" if comparison.align != "none" else "clocks unchanged"
        if match is not None:
            title += f": RMS {match.rms:,.0f} nT"
            title += "" if match.correlation is None else f", correlation {match.correlation:.3f}"
        clocks = [(run["t"] - run["t"][0], run[column]) for run in (a.run, b.run)]
        x, y = "time from the start of each run [s]", f"{column.removesuffix('_nt')} [nT]"
        charts.append(Chart("as recorded", lines(x, y, *clocks), file="recorded"))
        values = [(comparison.at, part) for part in comparison.fields[column]]
        charts.append(Chart(title, lines(along, y, *values), file="aligned"))
    if position is not None:
        apart = [(comparison.at, part) for part in (comparison.along_m, comparison.cross_m)]
        draw = lines(along, "distance [m]", *apart, names=("along-track", "cross-track"))
        charts.append(Chart(f"distance of {names[1]} from {names[0]}", draw, file="distance"))
        charts.append(Chart("paths", paths, 4.0, "paths"))
    return charts


def _driven(metadata: Metadata) -> str:
    """How a run was driven, by its metadata."""
    path, engine = metadata.get("path", "a custom path"), metadata.get("engine", "kinematic")
    seed = f"seed {metadata['seed']}" if "seed" in metadata else "recorded"
    return f"{path}, engine {engine}, {seed}"
