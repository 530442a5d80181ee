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
from magtwin.field.maps.statistics import map_metadata
from magtwin.figures import canvas
from magtwin.figures.maps import FloorPlan, map_charts
from magtwin.figures.page import Page, Section, Table, text_of
from magtwin.figures.player import player_of
from magtwin.figures.runs import field_name, path_picture, position_name
from magtwin.figures.style import DATA, MODEL, styled
from magtwin.report.report import Report
from magtwin.report.verdict import HOLDS_ONE, Tally
from magtwin.run.compare import ERRORS, Agreement, Comparison, Traversals, errors_of, terms_of
from magtwin.run.figures import prediction_nt
from magtwin.run.run import COLUMNS, Metadata, Run
from magtwin.run.thinning import stretches

MOST_FIGURES = 14
"""Figures above which their table is folded."""

MOST_SPANS = 12
"""Times of a flag that a page lists. More are counted."""

ALIGNED = {
    "recorded": "by time from each start",
    "timed": "by time, clocks aligned",
    "placed": "by distance driven",
}
"""How two traversals of a path are aligned."""

MOST_DRAWN = 12  # Runs of a page whose paths are drawn

OVERVIEW = Table(
    "Overview",
    ("run", "path", "seed", "readings", "duration [s]", "distance [m]", "MAE [nT]", "RMS [nT]", "events"),
    (),
    "MAE and RMS: error of b_measured_nt against the exact field, where that is known.",
)
"""One row per run, without its rows."""

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


def page_of_runs(runs: Sequence[NamedRun], *, advance: Callable[[int], None] = lambda done: None) -> Page:
    """A page about one run or several; `advance` is called with the number of runs that are drawn.

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
        sections.append(_section(named))
        advance(k + 1)
    if together([named.run for named in runs]):
        first, every = runs[0], [named.run for named in runs]
        still = path_picture(first.run, first.field, first.planned)
        data = b"" if still is None else still.data
        player = player_of(every, first.field, first.stage, still=data)
        title, verdict, lead = _title(first), first.run.report().verdict, _sentence(first.run)
        if len(runs) > 1:
            tally = Tally()
            for run in every:
                run.add_to(tally)
            verdict = tally.verdict(f"the exact field of {len(runs)} robots, one session", holds=HOLDS_ONE)
            title = f"{len(runs)} robots in {first.run.metadata.get('scene', 'a scene')}"
            lead = f"{', '.join(str(run.metadata['robot']) for run in every)} drove together."
        return Page(title, "" if verdict else lead, tuple(sections), player=player, verdict=verdict)
    for k, named in enumerate(runs[:MOST_DRAWN]):
        path = path_picture(named.run, named.field, named.planned)
        sections[k] = replace(sections[k], pictures=() if path is None else (path,))
    overview = replace(OVERVIEW, rows=tuple(map(overview_of, runs)))
    lead = f"{sum(named.run.rows for named in runs):,} readings in all."
    return Page(f"{len(runs)} runs", lead, tuple(sections), overview)


def together(runs: Sequence[Run]) -> bool:
    """Whether runs are those of different robots that drove in one scene at the same time, or only one."""
    facts = {tuple(run.metadata.get(name) for name in ("scene_sha256", "seed", "lab")) for run in runs}
    robots = {run.metadata.get("robot") for run in runs} - {None}
    return len(runs) == 1 or (len(facts) == 1 and len(robots) == len(runs))


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
            pair = (name, str(run.metadata[name]))
            words.append(" ".join(pair[::-1] if name == "magnetometer" else pair))
    return ", ".join(words) + "."


def _section(named: NamedRun) -> Section:
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
    events = tuple(_events(run))
    head = ("flag", "meaning", "readings", "times [s]")
    tables.append(Table("Events", head, events, "" if events else "None."))
    tables.append(provenance_table(run.metadata))
    lead = f"{named.name}: {_sentence(run)} {named.note}".strip()
    return Section(_title(named), lead, (), tuple(tables))


def page_of_report(
    report: Report,
    title: str,
    lead: str = "",
    charts: Sequence[canvas.Chart] = (),
    tables: Sequence[Table] = (),
) -> Page:
    """A report as a page: its verdict, first figures, charts, and tables, its source folded."""
    shown = list(_numbers(report).items())
    tables = (*tables, figures_table(report), provenance_table(report.metadata))
    section = Section(title, "", tuple(chart.picture() for chart in charts), tables)
    data = json.loads(report.to_json())
    return Page(title, lead, (section,), verdict=report.verdict, figures=shown[:5], data=data)


def _numbers(report: Report) -> dict[str, str]:
    """The numbers of a report with their units, by name."""
    numbers = (f for f in report.figures if isinstance(f.value, float | int))
    return {f.name: f"{text_of(f.value)} {f.unit}".strip() for f in numbers}


def page_of_maps(fields: Sequence[AnomalyMap], plan: FloorPlan | None = None) -> Page:
    """Maps as a page: each in a line; its mean, heading effect, spread and slope, on common scales."""
    reports = [_in_nt(map_metadata(field)) for field in fields]
    verdicts = [_map_verdict(field, report) for field, report in zip(fields, reports, strict=True)]
    charts = map_charts(fields, plan)
    if len(fields) == 1:
        page = page_of_report(replace(reports[0], verdict=verdicts[0]), f"Map {fields[0].name}", "", charts)
        return replace(page, figures=_map_figures(reports[0]))
    tables = [
        replace(table, title=f"{table.title} of {field.name}", folded=True)
        for field, report in zip(fields, reports, strict=True)
        for table in (figures_table(report), provenance_table(report.metadata))
    ]
    section = Section("Maps", "", tuple(chart.picture() for chart in charts), tuple(tables))
    data = {"maps": [json.loads(report.to_json()) for report in reports]}
    return Page(f"{len(fields)} maps", "", (section,), data=data, verdict="\n".join(verdicts))


def _in_nt(report: Report) -> Report:
    """A report in which slopes have the unit of the fields."""
    figures = [
        replace(f, value=1000 * f.value, unit="nT/m")
        if f.unit == "uT/m" and isinstance(f.value, float)
        else f
        for f in report.figures
    ]
    return replace(report, figures=tuple(figures))


def _map_figures(report: Report) -> list[tuple[str, str]]:
    """Five figures of a map."""
    found = _numbers(report)
    names = ("mean", "median gradient", "heading amplitude", "standard deviation", "masked nodes")
    return [(name, found[name]) for name in names if name in found]


def _map_verdict(field: AnomalyMap, report: Report) -> str:
    """What a map is, in a line."""
    figures = dict(_map_figures(report))
    words = [f"{figures['mean']} on average"] if "mean" in figures else ["no field is known"]
    sd = figures.get("standard deviation")
    words.append(f"known to {sd} (median)" if sd else "with unknown uncertainty")
    if "heading amplitude" in figures:
        words.append(f"the heading changes it by {figures['heading amplitude']} (amplitude)")
    return f"Map {field.name}: {', '.join(words)}."


def page_of_check(report: Report) -> Page:
    """How well methods predict readings that were left out of their fit, as a page: the best one first."""
    values = {f.name: f for f in report.figures}
    methods = [name.removesuffix(" RMSE") for name in values if name.endswith(" RMSE")]
    measures = [name.removeprefix(f"{methods[0]} ") for name in values if name.startswith(f"{methods[0]} ")]

    def value(method: str, measure: str) -> Any:
        return values[f"{method} {measure}"].value if f"{method} {measure}" in values else ""

    order = sorted(methods, key=lambda name: (float(100 - value(name, "predicted")) > 1, value(name, "RMSE")))
    head = ("method", *(f"{name} [{values[f'{methods[0]} {name}'].unit or '-'}]" for name in measures))
    rows = tuple((name, *(value(name, measure) for measure in measures)) for name in order)

    def draw(ax: Axes) -> None:
        for measure, ink, marker in (("RMSE", DATA, "o"), ("MAE", MODEL, "D")):
            sizes = [value(name, measure) for name in order]
            ax.plot(sizes, range(len(order)), color=ink, marker=marker, ls="", ms=7, label=measure)
        ax.set_yticks(range(len(order)), order)
        ax.set(ylim=(len(order) - 0.5, -0.5), xlim=(0, None))
        ax.grid(axis="both")
        canvas.label(ax, "error on left-out readings [nT]")
        canvas.legend_above(ax)

    best = order[0]
    verdict = f"{best} predicts left-out readings best: RMSE {value(best, 'RMSE'):,.0f} nT"
    if best != "naive" and "naive" in methods:
        verdict += f", against {value('naive', 'RMSE'):,.0f} nT of their mean"
    if value(best, "coverage"):
        verdict += f"; its 90 % intervals hold {value(best, 'coverage'):.0f} % of them"
    title, table = "Errors of each method on readings left out of its fit", Table("Methods", head, rows)
    charts = (canvas.Chart(title, draw, 1.4 + 0.3 * len(order), "errors"),)
    page = page_of_report(replace(report, verdict=f"{verdict}."), report.title, "", charts, (table,))
    figures = [("readings", f"{values['readings predicted'].value:,}")]
    figures += [(f"{name}, RMSE", f"{value(name, 'RMSE'):,.0f} nT") for name in order[:4]]
    return replace(page, figures=figures)


def figures_table(report: Report) -> Table:
    """The figures of a report."""
    head = ("quantity", "value", "standard deviation", "unit", "note")
    rows = [(f.name, f.value, "" if f.spread is None else f.spread, f.unit, f.note) for f in report.figures]
    return Table("Figures", head, tuple(rows), folded=len(rows) > MOST_FIGURES)


def provenance_table(metadata: Mapping[str, Any], title: str = "Provenance") -> Table:
    """Where something comes from."""
    rows = tuple(metadata.items())
    return Table(title, ("metadata", ""), rows, "" if rows else "No metadata.", exact=True)


def overview_of(named: NamedRun) -> tuple[Any, ...]:
    """The row of a run in `OVERVIEW`."""
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


def _events(run: Run) -> list[tuple[str, str, int, str]]:
    """Flags that were raised: name, meaning, number of readings, and the time of each stretch [s]."""
    events = []
    for name, on in run.items():
        if name.startswith("flag_") and on.dtype == bool and on.any():
            ends = [(run["t"][first], run["t"][after - 1]) for first, after in stretches(on)]
            text = ", ".join(f"{a:.2f}–{b:.2f}" if b > a else f"{a:.2f}" for a, b in ends[:MOST_SPANS])
            text += f" and {len(ends) - MOST_SPANS:,} more" if len(ends) > MOST_SPANS else ""
            events.append((name, COLUMNS[name].doc if name in COLUMNS else "", int(on.sum()), text))
    return events


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
    figure = canvas.new_figure(9.0, 0.95 * sum(heights))
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
    sections, data = (Section("Differences", "", pictures, tuple(tables)),), comparison.summary()
    return Page("Two runs compared", "", sections, verdict=verdict, figures=figures, data=data)


def section_of_traversals(both: Traversals, names: tuple[str, str]) -> Section:
    """A section of a report: one path driven twice by two runs of these names, with and without alignment."""
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


def _charts(a: NamedRun, b: NamedRun, comparison: Comparison) -> list[canvas.Chart]:
    """The field as recorded and aligned, the distance, and both paths, as far as they are known."""
    column, position = field_name(a.run, b.run), position_name(a.run, b.run)
    names = tuple(canvas.short_name(one.name) for one in (a, b))
    names = names if names[0] != names[1] else (f"A: {names[0]}", f"B: {names[1]}")
    along = "distance driven [m]" if comparison.align == "path" else "time [s]"
    looks: Any = ({"color": DATA, "lw": 2.2, "alpha": 0.6}, {"color": MODEL, "lw": 1.1})

    def lines(
        x: str, y: str, *curves: tuple[Any, Any], names: Sequence[str] = names
    ) -> Callable[[Axes], None]:
        def draw(ax: Axes) -> None:
            for (at, values), name, look in zip(curves, names, looks, strict=True):
                canvas.draw_line(ax, at, values, label=name, **look)
            ax.margins(x=0)
            canvas.label(ax, x, y)
            canvas.legend_above(ax, 2)

        return draw

    def paths(ax: Axes) -> None:
        for run, name, look in zip((a.run, b.run), names, looks, strict=True):
            ax.plot(*run[str(position)][canvas.evenly(run.rows, canvas.POINTS), :2].T, label=name, **look)
        ax.set_aspect("equal")
        ax.margins(0.05)
        canvas.label(ax, "x [m]", "y [m]")
        canvas.legend_above(ax, 2)

    charts = []
    if column is not None:
        match = next((row for row in comparison.agreements() if row.name == column), None)
        title = "aligned" if comparison.align != "none" else "clocks unchanged"
        if match is not None:
            title += f": RMS {match.rms:,.0f} nT"
            title += "" if match.correlation is None else f", correlation {match.correlation:.3f}"
        clocks = [(run["t"] - run["t"][0], run[column]) for run in (a.run, b.run)]
        x, y = "time from the start of each run [s]", f"{column.removesuffix('_nt')} [nT]"
        charts.append(canvas.Chart("as recorded", lines(x, y, *clocks), file="recorded"))
        values = [(comparison.at, part) for part in comparison.fields[column]]
        charts.append(canvas.Chart(title, lines(along, y, *values), file="aligned"))
    if position is not None:
        apart = [(comparison.at, part) for part in (comparison.along_m, comparison.cross_m)]
        draw = lines(along, "distance [m]", *apart, names=("along-track", "cross-track"))
        charts.append(canvas.Chart(f"distance of {names[1]} from {names[0]}", draw, file="distance"))
        wide, tall = np.ptp(np.vstack([run[position][:, :2] for run in (a.run, b.run)]), axis=0)
        height = float(np.clip((canvas.WIDTH_IN - 0.8) * tall / max(wide, 1e-9), 1.4, 5.0)) + 1.0
        charts.append(canvas.Chart("paths", paths, height, "paths"))
    return charts


def _driven(metadata: Metadata) -> str:
    """How a run was driven, by its metadata."""
    path, engine = metadata.get("path", "a custom path"), metadata.get("engine", "kinematic")
    seed = f"seed {metadata['seed']}" if "seed" in metadata else "recorded"
    return f"{path}, engine {engine}, {seed}"
