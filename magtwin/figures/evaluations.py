"""Evaluations: models against recordings as one report, with Table 1 and the figures of the paper."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from magtwin.figures import canvas
from magtwin.figures.maps import draw_mean
from magtwin.figures.page import Page, Section, Table
from magtwin.figures.reports import section_of_traversals
from magtwin.figures.style import FAINT, INK, SERIES, SIGNED_COLOURS, styled
from magtwin.figures.training import draw_correlations
from magtwin.learn.data.correlation import correlations
from magtwin.learn.data.features import FEATURES, FULL, features
from magtwin.learn.evaluation.budget import TERMS, Budget
from magtwin.learn.evaluation.evaluation import PAPER, Evaluation
from magtwin.learn.evaluation.scores import COVERED, DRAWS, LEVEL
from magtwin.report.verdict import Z_90
from magtwin.run.compare import Traversals

NAME = "evaluation"
"""Name of the report's files."""

MOST_COLUMNS = 12
"""Columns of a table. One with more paths is transposed."""

MOST_PANELS = 6
"""Models or paths in one figure."""

RANKED_HZ = 10.0
"""Rate of the readings used for a rank correlation. Faster readings are nearly copies of each other."""

SHOWN_S = 90.0
"""Length of the part of a run that is shown against time [s]."""


LEAD = (
    "Mean absolute error [nT], with its ratio to that of the naive model in brackets (lower is better). "
    "The naive model adds the mean training label to the first map. Intervals are "
    f"{LEVEL:.0%} bootstrap intervals: {DRAWS:,} draws of sessions, runs within them and blocks of time "
    "within those."
)
ONE_SESSION = " With one session only runs and blocks are drawn: the intervals do not cover other sessions."


def page_of_evaluation(
    evaluation: Evaluation,
    *,
    budgets: Sequence[Budget] = (),
    both: tuple[Traversals, tuple[str, str]] | None = None,
) -> Page:
    """The report of an evaluation, with error budgets and one path driven twice, by two named runs."""
    every = evaluation.every
    against = "the exact field" if evaluation.truth else "the reading"
    verdicts = [f"{name}: {line}" for name, line in evaluation.verdicts().items()]
    best = every.scores[_best(evaluation)]
    figures = [
        ("recordings", f"{len(evaluation.judged)} of {every.sessions} sessions"),
        ("readings", f"{best.rows:,}"),
        (f"mean error, {canvas.short_name(evaluation.names[_best(evaluation)])}", f"{best.mae_nt:,.1f} nT"),
        (f"mean error, {canvas.short_name(evaluation.names[0])}", f"{every.scores[0].mae_nt:,.1f} nT"),
        ("ratio", f"{best.ratio:.3f} ({best.ratio_interval[0]:.3f} to {best.ratio_interval[1]:.3f})"),
    ]
    lead = f"Errors: total field at the sensor, predicted minus {against}; all models on the same readings."
    lost = tuple(evaluation.left_out.items())
    note = "All models are evaluated on the same readings." if lost else "None."
    left_out = Table("Readings left out", ("reason", "readings"), lost, note, folded=True)
    pictures = [chart.picture() for chart in (_path_errors(evaluation), *_time_series(evaluation))]
    pictures += [*_floor_plan(evaluation), *_rank_correlations(evaluation)]
    sections = (
        Section("Errors", "", tuple(pictures)),
        Section("Table 1", LEAD + (ONE_SESSION if every.sessions == 1 else ""), (), (_table(evaluation),)),
        *([_budgets(budgets)] if budgets else []),
        *([section_of_traversals(*both)] if both else []),
        Section("Details", "", (), (*(f(evaluation) for f in (_intervals, _models, _maps)), left_out)),
    )
    data = evaluation.summary()
    data |= {"budget": {"models": [budget.summary() for budget in budgets]}} if budgets else {}
    data |= {"traversals": both[0].summary()} if both else {}
    return Page("Evaluation", lead, sections, data=data, verdict="\n".join(verdicts), figures=figures)


def _table(evaluation: Evaluation) -> Table:
    """The paper's Table 1, transposed: one row per model."""
    cases = evaluation.cases
    head = ["model"]
    for case in cases:  # with its path if that differs
        path = next((one.path for one in evaluation.judged if one.case == case.name), case.name)
        head.append(case.name if path == case.name else f"{case.name} ({path})")
    rows = [["readings", *(case.scores[0].rows for case in cases)]]
    for m, name in enumerate(evaluation.names):
        scores = [case.scores[m] for case in cases]
        rows.append([name, *(f"{s.mae_nt:.1f}" + (f" ({s.ratio:.3f})" if m else "") for s in scores)])
    paper = [PAPER.get(case.name) for case in cases]
    if any(paper):
        rows.append(["the paper's naive", *("" if p is None else f"{p[1]:.1f}" for p in paper)])
        network = ("" if p is None else f"{p[0]:.1f} ({p[2]:.3f})" for p in paper)
        rows.append(["the paper's network", *network])
    if len(head) > MOST_COLUMNS:
        head, *rows = (list(line) for line in zip(head, *rows, strict=True))
    note = "" if len(cases) < 3 else "mean: over the paths, with equal weights."
    return Table("Mean absolute errors", tuple(head), tuple(map(tuple, rows)), note)


def _intervals(evaluation: Evaluation) -> Table:
    """Every score with its interval, one row per model and case."""
    rows = tuple(
        (
            case.name,
            name,
            score.mae_nt,
            *score.mae_interval_nt,
            score.ratio,
            *score.ratio_interval,
            score.rmse_nt,
            score.bias_nt,
            f"{score.coverage:.1%}" if np.isfinite(score.coverage) else "no sd",
            f"{score.outside:.1%}",
        )
        for case in evaluation.cases
        for name, score in zip(evaluation.names, case.scores, strict=True)
    )
    head = ("path", "model", "MAE [nT]", "from", "to", "ratio", "from", "to", "RMSE [nT]", "bias [nT]")
    note = (
        f"from, to: {LEVEL:.0%} interval. coverage: share of the readings within the predicted "
        f"{COVERED:.0%} interval. out of distribution: share with an input outside the training ranges."
    )
    return Table(
        "Every score, with intervals", (*head, "coverage", "out of distribution"), rows, note, folded=True
    )


def _budgets(budgets: Sequence[Budget]) -> Section:
    lead = (
        "On a twin the exact value of every part of the error is known. The mean absolute error [nT] that "
        "remains when the terms are closed one after the other, from left to right. Closing a term removes "
        "its part of the error, less what the model learned of it in training."
    )
    rows = tuple((budget.name, budget.mae_nt, *budget.left_nt) for budget in budgets)
    head = ("model", "all", *(f"without {term}" for term in TERMS))
    return Section("Error budget", lead, (), (Table("Errors that remain", head, rows),))


def _models(evaluation: Evaluation) -> Table:
    rows = tuple(
        (
            one.name,
            one.map.name,
            len(one.model.features),
            ", ".join(f"{1000 * part:.1f}" for part in one.alignment.lever_arm_m),
            1000 * one.alignment.latency_s,
            str(one.metadata.get("sha256", ""))[:12],
        )
        for one in evaluation.candidates
    )
    head = ("model", "map", "inputs", "lever arm [mm]", "latency [ms]", "SHA-256")
    return Table("Models", head, rows, folded=True)


def _maps(evaluation: Evaluation) -> Table:
    rows = []
    for named in evaluation.maps:
        mae, rms = evaluation.floor(named)
        expected = ("unknown", "unknown") if np.isnan(mae) else (mae, rms)
        m = next(i for i, one in enumerate(evaluation.candidates) if one.map.field is named.field)
        errors = [one.map_nt[m, one.kept] - one.measured_nt[one.kept] for one in evaluation.judged]
        error = np.concatenate(errors)
        alone = (float(np.mean(np.abs(e))) for e in (error, error - error.mean()))
        rows.append((named.name, named.field.method, *expected, *alone))
    head = ("map", "method", "expected MAE [nT]", "expected RMS [nT]", "map alone, MAE [nT]")
    note = (
        "expected: the map's error on these readings, according to its own variances; the noise floor of its "
        "labels. map alone: the map without a model of the robot, before and after its mean error is removed."
    )
    return Table("Maps", (*head, "less its mean [nT]"), tuple(rows), note, folded=True)


def _look(m: int) -> dict[str, Any]:
    """Colour and dashes of a model by its index; the naive one is grey."""
    return SERIES[(m - 1) % len(SERIES)] if m else {"color": FAINT, "ls": "-"}


def _trained(evaluation: Evaluation) -> list[int]:
    """Indices of at most `MOST_PANELS` models from weights files; if there are none, of all but the naive."""
    own = [i for i, one in enumerate(evaluation.candidates) if "sha256" in one.metadata]
    own = own or list(range(1, len(evaluation.candidates))) or [0]
    return own if len(own) <= MOST_PANELS else [own[0], *own[1 - MOST_PANELS :]]


def _best(evaluation: Evaluation) -> int:
    return min(_trained(evaluation), key=lambda m: evaluation.every.scores[m].mae_nt)


def _rank_correlations(evaluation: Evaluation) -> tuple[canvas.Picture, ...]:
    """Figure 2: correlation of each input with the disturbance, on the first map."""
    judged = evaluation.judged
    able = [name for name in FULL if all(one.run.keys() >= set(FEATURES[name].columns) for one in judged)]
    if not able:
        return ()
    sessions = list(dict.fromkeys(one.session for one in judged))
    xs, ys, groups = [], [], []
    for one in judged:
        step_s = float(np.median(np.diff(one.run["t"]))) if one.run.rows > 1 else 1.0
        rows = np.flatnonzero(one.kept)[:: max(1, round(1 / (step_s * RANKED_HZ)))]
        x, y = features(one.run.take(rows), able), (one.measured_nt - one.map_nt[0])[rows]
        known = np.isfinite(x).all(axis=1)
        xs.append(x[known])
        ys.append(y[known])
        groups.append(np.full(int(known.sum()), sessions.index(one.session)))
    x, y = np.concatenate(xs), np.concatenate(ys)
    if len(y) < 3 or not np.ptp(y):
        return ()
    title = "Figure 2: Spearman's correlation of each input with the disturbance, beside the paper's"
    figure = draw_correlations(correlations(x, y, able, np.concatenate(groups)))
    return (canvas.picture(figure, title, file="figure_2"),)


def _time_series(evaluation: Evaluation) -> list[canvas.Chart]:
    """Figure 5: field as measured and by the map alone, and the errors of each model with their interval."""
    best = _best(evaluation)
    size = [float(np.mean(np.abs(one.errors().error_nt[best]))) for one in evaluation.judged]
    one = evaluation.judged[int(np.argsort(size, kind="stable")[(len(size) - 1) // 2])]  # the median
    t = one.run["t"] - one.run["t"][0]
    seen = t <= SHOWN_S
    t, kept = t[seen], one.kept[seen]
    measured, alone = (np.where(kept, values[seen], np.nan) for values in (one.measured_nt, one.map_nt[0]))
    rows, where = canvas.evenly(len(t), 900), f"{one.name} ({one.path})"

    def field(ax: Axes) -> None:
        canvas.draw_line(ax, t, measured, **SERIES[0], label="measured")
        canvas.draw_line(ax, t, alone, **SERIES[1], label="map alone")
        finish(ax, "total field [nT]")

    def errors(m: int) -> Callable[[Axes], None]:
        error = np.where(kept, one.total_nt[m, seen], np.nan) - measured
        lacks = np.where(kept, one.map_nt[m, seen], np.nan) - measured
        half = Z_90 * one.sd_nt[m, seen][rows]

        def draw(ax: Axes) -> None:
            canvas.draw_line(ax, t, lacks, color=FAINT, label="map alone")
            canvas.draw_line(ax, t, error, **_look(m), label="map and model")
            if np.isfinite(half).any():
                band = {"color": _look(m)["color"], "alpha": 0.2, "lw": 0}
                ax.fill_between(t[rows], -half, half, label=f"its {COVERED:.0%} interval", **band)
            ax.axhline(0, color=FAINT, lw=0.7, zorder=0)
            finish(ax, "error [nT]")

        return draw

    def finish(ax: Axes, y: str) -> None:
        ax.margins(x=0)
        canvas.label(ax, "time [s]", y)
        canvas.legend_above(ax, 2)

    charts = [canvas.Chart(f"Figure 5: total field of {where}", field, file="figure_5_field")]
    for m in _trained(evaluation):
        off = np.abs(one.total_nt[m, seen] - one.measured_nt[seen])[kept]
        mae = np.nanmean(off) if np.isfinite(off).any() else np.nan
        title = f"Figure 5: errors of {canvas.short_name(evaluation.names[m], 40)} on {where}"
        charts.append(canvas.Chart(f"{title}: mean size {mae:.0f} nT", errors(m), file=f"figure_5_{m}"))
    return charts


@styled
def _floor_plan(evaluation: Evaluation) -> list[canvas.Picture]:
    """Figure 7: paths over the map, coloured by the error of the best model."""
    cases = list(dict.fromkeys(one.case for one in evaluation.judged))[:MOST_PANELS]
    shown = [next(one for one in evaluation.judged if one.case == case) for case in cases]
    best = _best(evaluation)
    named = evaluation.candidates[best].map
    x0, x1, y0, y1 = named.field.extent
    height = float(np.clip((canvas.WIDTH_IN - 0.8) * (y1 - y0) / (x1 - x0), 1.2, 6.0))
    errors = [np.where(one.kept, one.total_nt[best] - one.measured_nt, np.nan) for one in shown]
    reach = float(np.nanquantile(np.abs(np.concatenate(errors)), 0.99))
    pictures = []
    for k, (one, error) in enumerate(zip(shown, errors, strict=True)):
        figure = canvas.new_figure(canvas.WIDTH_IN, height + 1.9)
        ax, place = figure.subplots(), np.isfinite(one.p_xy).all(axis=1)
        draw_mean(ax, named.field)
        ax.plot(*one.p_xy[place][canvas.evenly(int(place.sum()), 3000)].T, color=INK, lw=3.8)
        line = canvas.coloured_line(ax, one.p_xy[place], error[place], (-reach, reach), SIGNED_COLOURS, 2.6)
        canvas.colour_bar(figure, line, ax, "error [nT]", below=True, extend="both")
        canvas.label(ax, "x [m]", "y [m]")
        case = one.case if one.case == one.path else f"{one.case} ({one.path})"
        model = canvas.short_name(evaluation.names[best])
        title = f"Figure 7: {case}, error of {model} over the map {named.name}"
        pictures.append(canvas.picture(figure, title, file=f"figure_7_{k}"))
    return pictures


def _path_errors(evaluation: Evaluation) -> canvas.Chart:
    """Figure 6 a and b: errors by path, with their intervals."""
    cases = [case for case in evaluation.cases if case.name != "all"]
    count = len(evaluation.candidates)
    width = 0.84 / count

    def draw(ax: Axes) -> None:
        for m, name in enumerate(evaluation.names):
            at = np.arange(len(cases)) + (m - (count - 1) / 2) * width
            mae = np.array([case.scores[m].mae_nt for case in cases])
            low, high = np.array([case.scores[m].mae_interval_nt for case in cases]).T
            hatch = ("", "//", "..")[(m - 1) // 7 % 3] if m else ""
            ax.bar(at, mae, 0.92 * width, color=_look(m)["color"], hatch=hatch, label=canvas.short_name(name))
            spread = np.nan_to_num(np.stack([mae - low, high - mae]).clip(0))
            ax.errorbar(at, mae, yerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
        ax.set_xticks(np.arange(len(cases)), [canvas.short_name(case.name, 12) for case in cases])
        ax.set_ylim(bottom=0)
        canvas.label(ax, y="mean absolute error [nT]")
        ax.grid(axis="y")
        canvas.legend_above(ax, 1 if max(map(len, evaluation.names)) > 18 else 2)

    rows = count if max(map(len, evaluation.names)) > 18 else -(-count // 2)
    title = f"Figure 6 a, b: errors by path, with {LEVEL:.0%} intervals"
    return canvas.Chart(title, draw, 2.6 + 0.19 * rows, "figure_6ab")
