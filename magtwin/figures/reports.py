"""Reports: one run or several as a page; two runs compared; and one path driven twice."""

from collections.abc import Callable, Sequence
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
    INK,
    MAP_INK,
    OTHER_INK,
    POINTS,
    WIDTH_IN,
    Picture,
    draw_line,
    evenly,
    label,
    legend_above,
    new_figure,
    picture,
    short_pair,
)
from magtwin.figures.page import Page, Section, Table
from magtwin.figures.player import player_of
from magtwin.figures.runs import field_name, path_picture, position_name
from magtwin.report.verdict import HOLDS_ONE, Tally
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
        sections.append(_section(named))
        advance(k + 1)
    if _together([named.run for named in runs]):
        first, every = runs[0], [named.run for named in runs]
        still = path_picture(first.run, first.field, first.planned) if pictures else None
        data = b"" if still is None else still.data
        player = player_of(every, first.field, first.stage, still=data) if pictures else None
        title, lead = _title(first), first.run.report().verdict or _sentence(first.run)
        if len(runs) > 1:
            title = f"{len(runs)} robots in {first.run.metadata.get('scene', 'a scene')}"
            lead = (
                _verdict(every) or f"{', '.join(str(run.metadata['robot']) for run in every)} drove together."
            )
        return Page(title, lead, tuple(sections), player=player)
    overview = replace(OVERVIEW, rows=tuple(map(overview_of, runs)))
    lead = f"{sum(named.run.rows for named in runs):,} readings in all."
    return Page(f"{len(runs)} runs", lead, tuple(sections), overview)


def _together(runs: Sequence[Run]) -> bool:
    """Whether runs are those of different robots that drove in one scene at the same time, or only one."""
    facts = {tuple(run.metadata.get(name) for name in ("scene_sha256", "seed", "lab")) for run in runs}
    robots = {run.metadata.get("robot") for run in runs} - {None}
    return len(runs) == 1 or (len(facts) == 1 and len(robots) == len(runs))


def _verdict(runs: Sequence[Run]) -> str:
    """The verdict on the models of several robots; "" without one."""
    tally = Tally()
    for run in runs:
        run.add_to(tally)
    return tally.verdict(f"the exact field of {len(runs)} robots, one session", holds=HOLDS_ONE)


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


def _section(named: NamedRun) -> Section:
    run = named.run
    rows: tuple[tuple[Any, ...], ...] = tuple(
        (f.name, f.value, "" if f.spread is None else f.spread, f.unit, f.note) for f in run.report().figures
    )
    tables = [Table("Figures", ("quantity", "value", "standard deviation", "unit", "note"), rows)]
    errors = errors_of(run)
    if errors:
        rows = tuple((name, ERRORS[name][2], *_measures(row), row.count) for name, row in errors.items())
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
    rows = tuple(run.metadata.items())
    tables.append(Table("Provenance", ("metadata", ""), rows, "" if rows else "No metadata.", exact=True))
    lead = f"{named.name}: {_sentence(run)} {named.note}".strip()
    return Section(_title(named), lead, (), tuple(tables))


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


def draw_comparison(a: NamedRun, b: NamedRun, comparison: Comparison) -> Figure:
    """Draw two runs by their own clocks, and aligned, as `magtwin.run.compare.compare` compared them."""
    panels = _panels(a, b, comparison)
    heights = [height for _, height, _ in panels]
    figure = new_figure(9.0, 2.3 * sum(heights))
    axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (title, _, draw) in zip(axes, panels, strict=True):
        draw(ax)
        ax.set_title(title, fontsize=10, loc="right")
    return figure


def section_of_traversals(both: Traversals, names: tuple[str, str]) -> Section:
    """A section of a report: one path driven twice, with and without alignment.

    Args:
        both: Result of `magtwin.run.compare.traversals`.
        names: Names of the two runs.
    """
    runs = [f"{name}: {_driven(run.metadata)}" for name, run in zip(names, (both.a, both.b), strict=True)]
    rows = tuple(
        (text, row.name, row.unit, *_measures(row), _correlation(row))
        for key, text in ALIGNED.items()
        for row in getattr(both, key).agreements()
    )
    head = ("aligned", "quantity", "unit", "mean", "RMS", "MAE", "maximum", "correlation")
    note = f"{names[1]} minus {names[0]}. Along-track: ahead of the first run; cross-track: to its left."
    title = "One path, driven twice"
    drawing = _traversals_picture(both, names)
    pictures = () if drawing is None else (drawing,)
    return Section(title, "; ".join(runs) + ".", pictures, (Table(title, head, rows, note),))


def _panels(
    a: NamedRun, b: NamedRun, comparison: Comparison
) -> list[tuple[str, float, Callable[[Axes], None]]]:
    """Title, height and drawing of the field as recorded and aligned, the distance, and both paths."""
    column, position = field_name(a.run, b.run), position_name(a.run, b.run)
    names = short_pair((a.name, b.name))
    along = "distance driven [m]" if comparison.align == "path" else "time [s]"
    lines = tuple(zip((a.run, b.run), names, (INK, OTHER_INK), strict=True))

    def recorded(ax: Axes) -> None:
        for run, name, ink in lines:
            draw_line(ax, run["t"] - run["t"][0], run[str(column)] / 1000, color=ink, label=name)
        _finish(ax, "time from the start of each run [s]", "field [µT]")

    def aligned(ax: Axes) -> None:
        for values, (_, name, ink) in zip(comparison.fields[str(column)], lines, strict=True):
            draw_line(ax, comparison.at, values / 1000, color=ink, label=name)
        _finish(ax, along, "field [µT]")

    def paths(ax: Axes) -> None:
        looks: tuple[dict[str, Any], ...] = ({"lw": 2.6, "alpha": 0.45}, {"lw": 1.0})
        for (run, name, ink), look in zip(lines, looks, strict=True):
            rows = evenly(run.rows, POINTS)
            ax.plot(*run[str(position)][rows, :2].T, label=name, color=ink, **look)
        ax.set_aspect("equal")
        ax.margins(0.05)
        label(ax, "x [m]", "y [m]")
        legend_above(ax)

    panels: list[tuple[str, float, Callable[[Axes], None]]] = []
    if column is not None:
        match = next((row for row in comparison.agreements() if row.name == column), None)
        title = f"{names[1]} moved by {comparison.shift:+.3f} {comparison.unit}"
        if comparison.align == "none":
            title = "clocks unchanged"
        if match is not None:
            title += f": RMS {match.rms:,.0f} nT"
            title += "" if match.correlation is None else f", correlation {match.correlation:.3f}"
        panels += [(f"{column} as recorded", 1.0, recorded), (title, 1.0, aligned)]
    if position is not None:
        title = f"Distance of {names[1]} from {names[0]}"
        panels.append((title, 1.0, lambda ax: _draw_distance(ax, comparison, along)))
        panels.append(("Paths", 1.5, paths))
    return panels


def _draw_distance(ax: Axes, comparison: Comparison, along: str) -> None:
    for values, name, ink in (
        (comparison.along_m, "along-track", MAP_INK),
        (comparison.cross_m, "cross-track", INK),
    ):
        draw_line(ax, comparison.at, values, color=ink, label=name)
    ax.axhline(0, color="0.7", lw=0.6, zorder=0)
    _finish(ax, along, "distance [m]")


def _finish(ax: Axes, x: str, y: str) -> None:
    ax.margins(x=0)
    label(ax, x, y)
    legend_above(ax)


def _driven(metadata: Metadata) -> str:
    """How a run was driven, by its metadata."""
    path, engine = metadata.get("path", "a custom path"), metadata.get("engine", "kinematic")
    seed = f"seed {metadata['seed']}" if "seed" in metadata else "recorded"
    return f"{path}, engine {engine}, {seed}"


def _traversals_picture(both: Traversals, names: tuple[str, str]) -> Picture | None:
    column, position = field_name(both.a, both.b), position_name(both.a, both.b)
    if column is None or position is None:
        return None
    figure = new_figure(WIDTH_IN, 8.6)
    axes = figure.subplots(4, 1, height_ratios=[1.0, 1.0, 1.0, 0.8])
    for ax, (key, text) in zip(axes, ALIGNED.items(), strict=False):
        comparison: Comparison = getattr(both, key)
        for values, name, ink, width in zip(
            comparison.fields[column], names, (INK, OTHER_INK), (1.6, 0.9), strict=True
        ):
            draw_line(ax, comparison.at, values / 1000, color=ink, lw=width, label=name)
        match = next(row for row in comparison.agreements() if row.name == column)
        shift = f" ({comparison.shift:+.3f} {comparison.unit})" if key != "recorded" else ""
        alike = "" if match.correlation is None else f", corr. {match.correlation:.3f}"
        x = "distance driven [m]" if comparison.align == "path" else "time [s]"
        label(ax, x, "field [µT]", title=f"{text}{shift}: MAE {match.mae:,.0f} nT{alike}")
        ax.margins(x=0)
    axes[0].legend(fontsize=9, loc="best", framealpha=0.85)
    _draw_distance(axes[3], both.recorded, "time [s]")
    axes[3].set_title("distance between the two, by time from each start", fontsize=9, loc="right")
    title = f"Figure 8: {column} of one path, driven twice, with and without alignment"
    return picture(figure, title, file="figure_8")
