"""Evaluations: models against recordings as one report, with Table 1 and the figures of the paper."""

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.figures.canvas import (
    INK,
    WIDTH_IN,
    Picture,
    colour_bar,
    coloured_line,
    draw_line,
    evenly,
    label,
    legend_below,
    new_figure,
    picture,
    short_name,
)
from magtwin.figures.maps import mean_field_ut
from magtwin.figures.page import Page, Section, Table, write_pages
from magtwin.figures.training import draw_correlations, label_epochs
from magtwin.files.file import read_text
from magtwin.learn.data.correlation import correlations
from magtwin.learn.data.features import FEATURES, FULL, features
from magtwin.learn.evaluation.evaluation import PAPER, Evaluation, Judged
from magtwin.learn.evaluation.scores import COVERED, DRAWS, LEVEL
from magtwin.report.verdict import Z_90

NAME = "evaluation"
"""Name of the report's files."""

MOST_COLUMNS = 12
"""Columns of a table. One with more paths is transposed."""

INKS = (
    *("0.55", "#1971c2", "#e08214", "#2f9e44", "#9c36b5", "#d6336c", "#0c8599", "#5c4813"),
    *("#74c0fc", "#ffc078", "#8ce99a", "#e599f7", "#faa2c1", "#66d9e8", "#c5a880"),
)
"""Colours of the models, that of the naive one first."""

MOST_PANELS = 6
"""Models or paths in one figure."""

RANKED_HZ = 10.0
"""Rate of the readings used for a rank correlation. Faster readings are nearly copies of each other."""

SHOWN_S = 90.0
"""Length of the part of a run that is shown against time [s]."""

EPOCH, CURVES = "number", {"train_rmse_nt": ("training", "--"), "val_rmse_nt": ("validation", "-")}
"""Columns of a learning curve as `magtwin train` writes it."""


def page_of_evaluation(
    evaluation: Evaluation,
    *,
    title: str = "Evaluation",
    curves: Mapping[str, Sequence[Mapping[str, float]]] | None = None,
    more: Sequence[Section] = (),
    data: Mapping[str, Any] | None = None,
) -> Page:
    """The report of an evaluation.

    Args:
        evaluation: Result of `magtwin.learn.evaluation.evaluate.evaluate`.
        title: Title of the page.
        curves: Learning curves by model name, as `read_curve` gives them.
        more: Further sections, such as an error budget.
        data: Figures of these sections for the JSON form.
    """
    every = evaluation.every
    against = "the exact field" if evaluation.truth else "the reading"
    lead = (
        f"{len(evaluation.judged)} recordings of {every.sessions} sessions, {every.scores[0].rows:,} "
        "readings on which every model was evaluated. Errors: total field at the sensor, predicted minus "
        f"{against}."
    )
    verdicts = [f"{name}: {line}" for name, line in evaluation.verdicts().items()]
    tables = (_models(evaluation), _maps(evaluation), _left_out(evaluation))
    a_run = _known(_time_series(evaluation), _floor_plan(evaluation))
    by_path = _known(_path_errors(evaluation), _learning_curves(evaluation, curves or {}))
    sections = (
        Section("Table 1", _lead_of_table(evaluation), (), (_table(evaluation),)),
        Section("Models and maps", "", (), tables),
        Section("Inputs and the disturbance", "", _known(_rank_correlations(evaluation))),
        Section("A run", "", a_run),
        Section("Errors by path", "", by_path),
        *more,
        Section("Every score", "", (), (_intervals(evaluation),)),
    )
    sections = tuple(section for section in sections if section.tables or section.pictures)
    return Page(title, " ".join([*verdicts, lead]), sections, data={**evaluation.summary(), **(data or {})})


def write_evaluation(page: Page, folder: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a report as a folder: evaluation.html and .json, and its pictures.

    Args:
        page: The report.
        folder: The folder to make.
        force: Whether to replace an existing folder.

    Raises:
        InputError: The folder exists and `force` was not given.
    """
    write_pages(page, folder, NAME, force=force)


def read_curve(weights: str | os.PathLike[str]) -> tuple[Mapping[str, float], ...]:
    """The learning curve that `magtwin train` wrote beside weights, by epoch; empty if there is none.

    Args:
        weights: The weights file.

    Raises:
        InputError: The CSV file beside the weights is not a learning curve.
    """
    path = Path(weights).with_suffix(".csv")
    if not path.is_file():
        return ()
    try:
        rows = list(csv.DictReader(read_text(path, "learning curve", "text").splitlines()))
        if not rows or EPOCH not in rows[0]:
            return ()
        names = [EPOCH, *(name for name in CURVES if name in rows[0])]
        return tuple({name: float(row[name]) for name in names} for row in rows)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: not a learning curve as `magtwin train` writes it ({error}); move it away"
        ) from error


def _known(*pictures: Picture | None) -> tuple[Picture, ...]:
    return tuple(picture for picture in pictures if picture is not None)


def _lead_of_table(evaluation: Evaluation) -> str:
    lead = (
        "Mean absolute error [nT], with its ratio to that of the naive model in brackets (lower is better). "
        "The naive model adds the mean training label to the first map. Intervals are "
        f"{LEVEL:.0%} bootstrap intervals: {DRAWS:,} draws of sessions, runs within them and blocks of time "
        "within those."
    )
    if evaluation.every.sessions == 1:
        lead += " With one session only runs and blocks are drawn: the intervals do not cover other sessions."
    return lead


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
    return Table("With intervals", (*head, "coverage", "out of distribution"), rows, note)


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
    return Table("Models", ("model", "map", "inputs", "lever arm [mm]", "latency [ms]", "SHA-256"), rows)


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
    return Table("Maps", (*head, "less its mean [nT]"), tuple(rows), note)


def _left_out(evaluation: Evaluation) -> Table:
    rows = tuple(evaluation.left_out.items())
    note = "All models are evaluated on the same readings." if rows else "None."
    return Table("Readings left out", ("reason", "readings"), rows, note)


def ink(m: int) -> str:
    """Colour of a model by its index."""
    return INKS[m % len(INKS)]


def trained_models(evaluation: Evaluation) -> list[int]:
    """Indices of at most `MOST_PANELS` models from weights files; if there are none, of all but the naive."""
    own = [i for i, one in enumerate(evaluation.candidates) if "sha256" in one.metadata]
    own = own or list(range(1, len(evaluation.candidates))) or [0]
    return own if len(own) <= MOST_PANELS else [own[0], *own[1 - MOST_PANELS :]]


def _best(evaluation: Evaluation) -> int:
    return min(trained_models(evaluation), key=lambda m: evaluation.every.scores[m].mae_nt)


def _rank_correlations(evaluation: Evaluation) -> Picture | None:
    """Figure 2: correlation of each input with the disturbance, on the first map."""
    judged = evaluation.judged
    able = [name for name in FULL if all(one.run.keys() >= set(FEATURES[name].columns) for one in judged)]
    if not able:
        return None
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
        return None
    title = "Figure 2: Spearman's correlation of each input with the disturbance, beside the paper's"
    figure = draw_correlations(correlations(x, y, able, np.concatenate(groups)))
    return picture(figure, title, file="figure_2")


def _time_series(evaluation: Evaluation) -> Picture:
    """Figure 5: field as measured, by the map alone and by each model, and the errors with their interval."""
    one, shown = _middle(evaluation), trained_models(evaluation)
    t = one.run["t"] - one.run["t"][0]
    seen = t <= SHOWN_S
    t, kept = t[seen], one.kept[seen]
    measured, rows = np.where(kept, one.measured_nt[seen], np.nan), evenly(len(t), 900)
    figure = new_figure(WIDTH_IN, 0.9 + 2.6 * len(shown))
    heights = [1.5, 1.0] * len(shown)
    axes = figure.subplots(2 * len(shown), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for k, m in enumerate(shown):
        above, below = axes[2 * k : 2 * k + 2]
        total, alone = (np.where(kept, values[m, seen], np.nan) for values in (one.total_nt, one.map_nt))
        half, error = Z_90 * one.sd_nt[m, seen], total - measured
        draw_line(above, t, measured / 1000, color=INK, lw=1.8, label="measured")
        draw_line(above, t, alone / 1000, color="0.55", lw=1.0, label="map alone")
        draw_line(above, t, total / 1000, color=ink(m), lw=1.0, label="map and model")
        if np.isfinite(half).any():
            band = {"color": ink(m), "alpha": 0.18, "lw": 0, "label": f"its {COVERED:.0%} interval"}
            below.fill_between(t[rows], -half[rows], half[rows], **band)
        draw_line(below, t, alone - measured, color="0.55", lw=0.8)
        draw_line(below, t, error, color=ink(m))
        below.axhline(0, color=INK, lw=0.6)
        mae = np.nanmean(np.abs(error)) if np.isfinite(error).any() else np.nan
        title = f"{short_name(evaluation.names[m], 40)}: MAE {mae:.0f} nT"
        label(above, y="field [µT]", title=title)
        label(below, y="error [nT]")
        above.margins(x=0)
        below.margins(x=0)
    label(axes[-1], "time [s]")
    lines = {name: line for ax in axes for line, name in zip(*ax.get_legend_handles_labels(), strict=True)}
    legend_below(figure, lines.values(), lines.keys())
    title = f"Figure 5: total field of {one.name} ({one.path}), measured and predicted, and the errors"
    return picture(figure, title, file="figure_5")


def _middle(evaluation: Evaluation) -> Judged:
    """The recording in which the error of the best model is the median."""
    best = _best(evaluation)
    size = [float(np.mean(np.abs(one.errors().error_nt[best]))) for one in evaluation.judged]
    return evaluation.judged[int(np.argsort(size, kind="stable")[(len(size) - 1) // 2])]


def _floor_plan(evaluation: Evaluation) -> Picture:
    """Figure 7: paths over the map, coloured by the field and by the error of the best model."""
    cases = list(dict.fromkeys(one.case for one in evaluation.judged))[:MOST_PANELS]
    shown = [next(one for one in evaluation.judged if one.case == case) for case in cases]
    best = _best(evaluation)
    named = evaluation.candidates[best].map
    x0, x1, y0, y1 = named.field.extent
    height = np.clip(2.2 * (y1 - y0) / (x1 - x0), 0.9, 5.0)
    figure = new_figure(WIDTH_IN, 1.0 + (height + 0.35) * len(shown))
    axes = figure.subplots(len(shown), 2, sharex=True, sharey=True, squeeze=False)
    fields = [np.where(one.kept, one.measured_nt, np.nan) / 1000 for one in shown]
    sizes = [np.where(one.kept, np.abs(one.total_nt[best] - one.measured_nt), np.nan) for one in shown]
    error = f"|error| of {short_name(evaluation.names[best], 16)} [nT]"
    for column, values, colours, text in (
        (0, fields, "viridis", "total field [µT]"),
        (1, sizes, "magma_r", error),
    ):
        low, high = np.nanquantile(np.concatenate(values), [0.01, 0.99])
        for ax, one, value in zip(axes[:, column], shown, values, strict=True):
            known, place = mean_field_ut(named.field), np.isfinite(one.p_xy).all(axis=1)
            ax.pcolormesh(
                named.field.x_m, named.field.y_m, known, shading="nearest", cmap="Greys", alpha=0.35
            )
            limits = (0.0 if column else low, high)
            line = coloured_line(ax, one.p_xy[place], value[place], limits, colours, 2.2)
            ax.set_aspect("equal")
            label(ax)
            ax.set_title(one.case if one.case == one.path else f"{one.case} ({one.path})", fontsize=9)
        flat = {"orientation": "horizontal", "aspect": 30, "shrink": 1.0}
        colour_bar(figure, line, axes[:, column].tolist(), text, **flat)
        label(axes[-1, column], "x [m]")
    for ax in axes[:, 0]:
        label(ax, y="y [m]")
    title = f"Figure 7: paths over the map {named.name} (grey, mean over headings)"
    return picture(figure, title, file="figure_7", kind="png")


def _path_errors(evaluation: Evaluation) -> Picture:
    """Figure 6 a and b: errors by path, with their intervals."""
    cases = [case for case in evaluation.cases if case.name != "all"]
    count = len(evaluation.candidates)
    figure = new_figure(WIDTH_IN, 2.9 + 0.13 * count)
    ax = figure.subplots()
    width = 0.84 / count
    for m, name in enumerate(evaluation.names):
        at = np.arange(len(cases)) + (m - (count - 1) / 2) * width
        mae = np.array([case.scores[m].mae_nt for case in cases])
        low, high = np.array([case.scores[m].mae_interval_nt for case in cases]).T
        ax.bar(at, mae, 0.92 * width, color=ink(m), label=name)
        spread = np.nan_to_num(np.stack([mae - low, high - mae]).clip(0))
        ax.errorbar(at, mae, yerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
    ax.set_xticks(np.arange(len(cases)), [case.name for case in cases], fontsize=9)
    ax.set_ylim(bottom=0)
    label(ax, y="mean absolute error [nT]")
    ax.grid(axis="y", color="0.9")
    ax.set_axisbelow(True)
    legend_below(figure)
    return picture(figure, f"Figure 6 a, b: errors by path, with {LEVEL:.0%} intervals", file="figure_6ab")


def _learning_curves(
    evaluation: Evaluation, curves: Mapping[str, Sequence[Mapping[str, float]]]
) -> Picture | None:
    """Figure 6 c: learning curves of the models that have one."""
    shown = {m: curves[name] for m, name in enumerate(evaluation.names) if curves.get(name)}
    if not shown:
        return None
    figure = new_figure(WIDTH_IN, 3.4)
    ax = figure.subplots()
    for m, rows in shown.items():
        for column, (part, style) in CURVES.items():
            points = [(row[EPOCH], row[column]) for row in rows if column in row]
            if points:
                text = f"{evaluation.names[m]}, {part}"
                ax.plot(*zip(*points, strict=True), ls=style, color=ink(m), label=text)
    label_epochs(ax)
    legend_below(figure)
    title = "Figure 6 c: error in training and on validation recordings over the epochs"
    return picture(figure, title, file="figure_6c")
