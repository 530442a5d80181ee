"""Evaluations: models against recordings as one report, the paper's Table 1 and its figures drawn anew."""

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.charts import WIDTH_IN, Picture, short_name, thinned
from magtwin.figures.correlations import figure_of_correlations
from magtwin.figures.learning_curves import label_epochs
from magtwin.figures.pages import WRITERS, Page, Section, Table
from magtwin.figures.plots import INK, drawn, new_figure
from magtwin.files import output
from magtwin.learn.data.correlation import correlations
from magtwin.learn.data.features import FEATURES, FULL, features
from magtwin.learn.evaluation.evaluation import PAPER, Case, Evaluation, Judged
from magtwin.learn.evaluation.scores import COVERED, DRAWS, LEVEL
from magtwin.verdict import Z_90

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

NAME, PICTURES = "evaluation", "figures"
"""What the report's files are called, and the folder of its pictures."""

INKS = (
    *("0.55", "#1971c2", "#e08214", "#2f9e44", "#9c36b5", "#d6336c", "#0c8599", "#5c4813"),
    *("#74c0fc", "#ffc078", "#8ce99a", "#e599f7", "#faa2c1", "#66d9e8", "#c5a880"),
)
"""Colours of the models, the naive one's first."""

MOST_PANELS = 6
"""Models, or paths, that a figure shows."""

RANKED_HZ = 10.0
"""Readings a second that a rank correlation is taken from: more are too alike to tell more."""

MOST_COLUMNS = 12
"""Of a table; one with more paths is turned."""

SHOWN_S = 90.0
"""How much of a run is shown against time [s]."""

EPOCH, CURVES = "number", {"train_rmse_nt": ("training", "--"), "val_rmse_nt": ("validation", "-")}
"""Columns of a learning curve as `magtwin train` writes it."""


def page_of_evaluation(
    found: Evaluation,
    *,
    title: str = "Evaluation",
    curves: Mapping[str, Sequence[Mapping[str, float]]] | None = None,
    more: Sequence[Section] = (),
    data: Mapping[str, Any] | None = None,
) -> Page:
    """The report.

    Args:
        found: What `magtwin.learn.evaluation.evaluate.evaluate` gave.
        title: What stands above.
        curves: Learning curves by the name of a model, epoch by epoch, as `read_curve` gives them.
        more: Sections of what was done beside, such as an error budget.
        data: What these say to scripts.
    """
    every = found.every
    against = "the exact field" if found.truth else "the reading"
    lead = (
        f"{len(found.judged)} recordings of {every.sessions} sessions, {every.scores[0].rows:,} readings "
        "on which every model was evaluated. Errors: total field at the sensor, predicted minus "
        f"{against}."
    )
    lead = " ".join([*(f"{name}: {line}" for name, line in found.verdicts().items()), lead])
    sections = [
        Section("Table 1", _lead_of_table(found), (), (_table(found),)),
        Section("Models and maps", "", (), (_models(found), _maps(found), _left_out(found))),
        Section("Inputs and the disturbance", "", pictured([_ranks(found)])),
        Section("A run", "", pictured([_band(found), _floor_plan(found)])),
        Section("Errors by path", "", pictured([_bars(found), _curves(found, curves or {})])),
        *more,
        Section("Every score", "", (), (_intervals(found),)),
    ]
    kept = tuple(one for one in sections if one.tables or one.pictures)
    return Page(title, lead, kept, data={**found.summary(), **(data or {})})


def write_evaluation(page: Page, folder: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a report to a folder: evaluation.html with its pictures inside, .md beside them, and .json.

    Raises:
        InputError: The folder exists and `force` was not given.
    """
    with output(folder, force=force) as aside:
        (aside / PICTURES).mkdir(parents=True)
        sections = []
        for section in page.sections:
            placed: list[Picture] = []
            for picture in section.pictures:
                end = "svg" if picture.kind.startswith("svg") else picture.kind
                file = f"{PICTURES}/{picture.file or f'picture_{len(placed)}'}.{end}"
                (aside / file).write_bytes(picture.data)
                placed.append(replace(picture, file=file))
            sections.append(replace(section, pictures=tuple(placed)))
        whole = replace(page, sections=tuple(sections))
        for end, writer in WRITERS.items():
            (aside / f"{NAME}{end}").write_text(writer(whole), encoding="utf-8")


def read_curve(weights: str | os.PathLike[str]) -> tuple[Mapping[str, float], ...]:
    """The learning curve that `magtwin train` wrote beside weights, epoch by epoch; none where there is none.

    Raises:
        InputError: The table beside them is none.
    """
    path = Path(weights).with_suffix(".csv")
    if not path.is_file():
        return ()
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        if not rows or EPOCH not in rows[0]:
            return ()
        told = [EPOCH, *(name for name in CURVES if name in rows[0])]
        return tuple({name: float(row[name]) for name in told} for row in rows)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: not a learning curve as `magtwin train` writes it ({error}); move it away"
        ) from error


@dataclass(frozen=True)
class Drawing:
    """A figure on its way to a page."""

    file: str
    title: str
    alt: str
    figure: "Figure"
    kind: str = "svg"


def pictured(drawings: Sequence[Drawing | None]) -> tuple[Picture, ...]:
    """Figures as pictures of a page, without those that there was nothing to draw of."""
    made = []
    for one in drawings:
        if one is None:
            continue
        one.figure.set_dpi(160)
        kind = "svg+xml" if one.kind == "svg" else one.kind
        made.append(Picture(one.title, one.alt, kind, drawn(one.figure, f".{one.kind}"), one.file))
    return tuple(made)


def _lead_of_table(found: Evaluation) -> str:
    sessions = found.every.sessions
    one = " With one session only runs and blocks are drawn: the intervals do not cover other sessions." * (
        sessions == 1
    )
    return (
        "Mean absolute error [nT], with its ratio to that of the naive model in brackets (lower is better). "
        "The naive model adds the mean training label to the first map. Intervals are "
        f"{LEVEL:.0%} bootstrap intervals: {DRAWS:,} draws of sessions, runs within them and blocks of time "
        f"within those.{one}"
    )


def _table(found: Evaluation) -> Table:
    """The paper's Table 1, turned so that a line is a model."""
    head = ["model", *(_named(found, case) for case in found.cases)]
    rows = [["readings", *(case.scores[0].rows for case in found.cases)]]
    for m, name in enumerate(found.names):
        told = [(case.scores[m].mae_nt, case.scores[m].ratio) for case in found.cases]
        rows.append([name, *(f"{mae:.1f} ({ratio:.3f})" if m else f"{mae:.1f}" for mae, ratio in told)])
    paper = [PAPER.get(case.name) for case in found.cases]
    if any(paper):
        rows.append(["the paper's naive", *("" if one is None else f"{one[1]:.1f}" for one in paper)])
        network = ("" if one is None else f"{one[0]:.1f} ({one[2]:.3f})" for one in paper)
        rows.append(["the paper's network", *network])
    if len(head) > MOST_COLUMNS:
        head, *rows = (list(line) for line in zip(head, *rows, strict=True))
    note = "" if len(found.cases) < 3 else "mean: over the paths, with equal weights."
    return Table("Mean absolute errors", tuple(head), tuple(tuple(row) for row in rows), note)


def _named(found: Evaluation, case: Case) -> str:
    """A case with the path that it is of, where it has a letter."""
    path = next((one.path for one in found.judged if one.case == case.name), case.name)
    return case.name if path == case.name else f"{case.name} ({path})"


def _intervals(found: Evaluation) -> Table:
    """Every score with its interval, a row a model and case."""
    rows = []
    for case in found.cases:
        for name, score in zip(found.names, case.scores, strict=True):
            low, high = score.mae_interval_nt
            least, most = score.ratio_interval
            known = np.isfinite(score.coverage)
            rows.append(
                (
                    case.name,
                    name,
                    score.mae_nt,
                    low,
                    high,
                    score.ratio,
                    least,
                    most,
                    score.rmse_nt,
                    score.bias_nt,
                    f"{score.coverage:.1%}" if known else "no sd",
                    f"{score.outside:.1%}",
                )
            )
    head = ("path", "model", "MAE [nT]", "from", "to", "ratio", "from", "to", "RMSE [nT]", "bias [nT]")
    note = (
        f"from, to: {LEVEL:.0%} interval. coverage: share of the readings within the predicted {COVERED:.0%} "
    )
    note += "interval. out of distribution: share with an input outside the training ranges."
    return Table("With intervals", (*head, "coverage", "out of distribution"), tuple(rows), note)


def _models(found: Evaluation) -> Table:
    rows = []
    for one in found.candidates:
        arm = ", ".join(f"{1000 * part:.1f}" for part in one.alignment.lever_arm_m)
        inputs = len(one.model.features)
        checksum = str(one.metadata.get("sha256", ""))[:12]
        rows.append((one.name, one.map.name, inputs, arm, 1000 * one.alignment.latency_s, checksum))
    head = ("model", "map", "inputs", "lever arm [mm]", "latency [ms]", "SHA-256")
    return Table("Models", head, tuple(rows))


def _maps(found: Evaluation) -> Table:
    rows = []
    for named in found.maps:
        mae, rms = found.floor(named)
        alone, centred = _alone(found, named.field)
        own = ("unknown", "unknown") if np.isnan(mae) else (mae, rms)
        rows.append((named.name, named.field.method, *own, alone, centred))
    head = (
        "map",
        "method",
        "expected MAE [nT]",
        "expected RMS [nT]",
        "map alone, MAE [nT]",
        "less its mean [nT]",
    )
    note = (
        "expected: the map's error on these readings, according to its own variances; the noise floor of its "
        "labels. map alone: the map without a model of the robot, before and after its mean error is removed."
    )
    return Table("Maps", head, tuple(rows), note)


def _alone(found: Evaluation, field_: AnomalyMap) -> tuple[float, float]:
    """MAE of a map without a model, as it is and less the mean error of these very readings [nT]."""
    m = next(i for i, one in enumerate(found.candidates) if one.map.field is field_)
    error = np.concatenate([one.map_nt[m, one.kept] - one.measured_nt[one.kept] for one in found.judged])
    return float(np.mean(np.abs(error))), float(np.mean(np.abs(error - error.mean())))


def _left_out(found: Evaluation) -> Table:
    rows = tuple(found.left_out.items())
    note = "All models are evaluated on the same readings." if rows else "None."
    return Table("Readings left out", ("reason", "readings"), rows, note)


def _ranks(found: Evaluation) -> Drawing | None:
    """The paper's Figure 2 of these runs, on the first map."""
    able = [
        name
        for name in FULL
        if all(column in one.run for column in FEATURES[name].columns for one in found.judged)
    ]
    if not able:
        return None
    sessions = list(dict.fromkeys(one.session for one in found.judged))
    xs, ys, groups = [], [], []
    for one in found.judged:
        rows = np.flatnonzero(one.kept)[:: _every(one, RANKED_HZ)]
        x, y = features(one.run.take(rows), able), (one.measured_nt - one.map_nt[0])[rows]
        known = np.isfinite(x).all(axis=1)
        xs.append(x[known])
        ys.append(y[known])
        groups.append(np.full(int(known.sum()), sessions.index(one.session)))
    x, y = np.concatenate(xs), np.concatenate(ys)
    if len(y) < 3 or not np.ptp(y):
        return None
    ranked = correlations(x, y, able, np.concatenate(groups))
    title = "Figure 2: Spearman's correlation of each input with the disturbance, beside the paper's"
    return Drawing("figure_2", title, title, figure_of_correlations(ranked))


def _every(one: Judged, rate_hz: float) -> int:
    """Every how many rows make about so many a second."""
    step = float(np.median(np.diff(one.run["t"]))) if one.run.rows > 1 else 1.0
    return max(1, round(1 / (step * rate_hz)))


def of_weights(found: Evaluation) -> list[int]:
    """Models that came from weights files, or all but the naive one; `MOST_PANELS` of them at most."""
    own = [i for i, one in enumerate(found.candidates) if "sha256" in one.metadata]
    own = own or list(range(1, len(found.candidates))) or [0]
    return own if len(own) <= MOST_PANELS else [own[0], *own[1 - MOST_PANELS :]]


def _best(found: Evaluation) -> int:
    """The one of them that errs least."""
    return min(of_weights(found), key=lambda m: found.every.scores[m].mae_nt)


def _middle(found: Evaluation) -> Judged:
    """The recording in which the best of the models errs as much as in most."""
    best = _best(found)
    size = [float(np.mean(np.abs(one.errors().error_nt[best]))) for one in found.judged]
    return found.judged[int(np.argsort(size, kind="stable")[(len(size) - 1) // 2])]


def _band(found: Evaluation) -> Drawing:
    """The paper's Figure 5: what was measured, the map alone, and each model; below, errors in its band."""
    one, shown = _middle(found), of_weights(found)
    t = one.run["t"] - one.run["t"][0]
    seen = t <= SHOWN_S
    t, kept = t[seen], one.kept[seen]
    measured = np.where(kept, one.measured_nt[seen], np.nan)
    rows = np.unique(np.linspace(0, len(t) - 1, 900).astype(int))
    figure = new_figure(WIDTH_IN, 0.9 + 2.6 * len(shown))
    heights = [1.5, 1.0] * len(shown)
    axes = figure.subplots(2 * len(shown), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for k, m in enumerate(shown):
        field_ax, error_ax = axes[2 * k : 2 * k + 2]
        total, alone = (np.where(kept, values[m, seen], np.nan) for values in (one.total_nt, one.map_nt))
        half = Z_90 * one.sd_nt[m, seen]
        _line(field_ax, t, measured / 1000, color=INK, lw=1.8, label="measured")
        _line(field_ax, t, alone / 1000, color="0.55", lw=1.0, label="map alone")
        _line(field_ax, t, total / 1000, color=ink(m), lw=1.0, label="map and model")
        error = total - measured
        if np.isfinite(half).any():
            band = {"color": ink(m), "alpha": 0.18, "lw": 0, "label": f"its {COVERED:.0%} interval"}
            error_ax.fill_between(t[rows], -half[rows], half[rows], **band)
        _line(error_ax, t, alone - measured, color="0.55", lw=0.8)
        _line(error_ax, t, error, color=ink(m), lw=0.9)
        error_ax.axhline(0, color=INK, lw=0.6)
        mae = np.nanmean(np.abs(error)) if np.isfinite(error).any() else np.nan
        field_ax.set_title(f"{short_name(found.names[m], 40)}: MAE {mae:.0f} nT", fontsize=9, loc="left")
        field_ax.set_ylabel("field [µT]", fontsize=9)
        error_ax.set_ylabel("error [nT]", fontsize=9)
        for ax in (field_ax, error_ax):
            ax.margins(x=0)
            ax.tick_params(labelsize=9)
    axes[-1].set_xlabel("time [s]", fontsize=9)
    told = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(told.values(), told.keys(), loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    title = f"Figure 5: total field of {one.name} ({one.path}), measured and predicted, and the errors"
    return Drawing("figure_5", title, title, figure)


def _floor_plan(found: Evaluation) -> Drawing | None:
    """The paper's Figure 7: paths over the map, coloured by the field and by the best model's error."""
    from matplotlib.collections import LineCollection

    cases = list(dict.fromkeys(one.case for one in found.judged))[:MOST_PANELS]
    shown = [next(one for one in found.judged if one.case == case) for case in cases]
    best = _best(found)
    chart = found.candidates[best].map.field
    known = np.where(chart.valid.all(axis=0), chart.values_nt.mean(axis=0), np.nan) / 1000
    x0, x1, y0, y1 = chart.extent
    height = np.clip(2.2 * (y1 - y0) / (x1 - x0), 0.9, 5.0)
    figure = new_figure(WIDTH_IN, 1.0 + (height + 0.35) * len(shown))
    axes = figure.subplots(len(shown), 2, sharex=True, sharey=True, squeeze=False)
    fields = [np.where(one.kept, one.measured_nt, np.nan) / 1000 for one in shown]
    sizes = [np.where(one.kept, np.abs(one.total_nt[best] - one.measured_nt), np.nan) for one in shown]
    for column, (values, colours, label) in enumerate(
        (
            (fields, "viridis", "total field [µT]"),
            (sizes, "magma_r", f"|error| of {short_name(found.names[best], 16)} [nT]"),
        )
    ):
        every = np.concatenate(values)
        low, high = np.nanquantile(every, [0.01, 0.99])
        line = None
        for ax, one, colour in zip(axes[:, column], shown, values, strict=True):
            ax.pcolormesh(chart.x_m, chart.y_m, known, shading="nearest", cmap="Greys", alpha=0.35)
            rows = np.unique(np.linspace(0, len(colour) - 1, 1500).astype(int))
            p, c = one.p_xy[rows], colour[rows]
            whole = np.isfinite(p).all(axis=1)
            p, c = p[whole], c[whole]
            line = LineCollection(
                list(np.stack([p[:-1], p[1:]], axis=1)),
                array=np.ma.masked_invalid((c[:-1] + c[1:]) / 2),
                cmap=colours,
                clim=(0.0 if column else low, high),
                lw=2.2,
            )
            ax.add_collection(line)
            ax.set_aspect("equal")
            ax.set_title(one.case if one.case == one.path else f"{one.case} ({one.path})", fontsize=9)
            ax.tick_params(labelsize=9)
        assert line is not None
        bar = figure.colorbar(
            line, ax=axes[:, column].tolist(), orientation="horizontal", aspect=30, pad=0.02
        )
        bar.set_label(label, fontsize=9)
        bar.ax.tick_params(labelsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("y [m]", fontsize=9)
    title = f"Figure 7: paths over the map {found.candidates[best].map.name} (grey, mean over headings)"
    return Drawing("figure_7", title, title, figure, "png")


def _bars(found: Evaluation) -> Drawing:
    """The paper's Figure 6 a and b: errors by path, with their intervals."""
    cases = [case for case in found.cases if case.name != "all"]
    count = len(found.candidates)
    figure = new_figure(WIDTH_IN, 2.9 + 0.13 * count)
    ax = figure.subplots()
    width = 0.84 / count
    for m, name in enumerate(found.names):
        at = np.arange(len(cases)) + (m - (count - 1) / 2) * width
        mae = np.array([case.scores[m].mae_nt for case in cases])
        low, high = np.array([case.scores[m].mae_interval_nt for case in cases]).T
        ax.bar(at, mae, 0.92 * width, color=ink(m), label=name)
        spread = np.nan_to_num(np.stack([mae - low, high - mae]).clip(0))
        ax.errorbar(at, mae, yerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
    ax.set_xticks(np.arange(len(cases)), [case.name for case in cases], fontsize=9)
    ax.set_ylabel("mean absolute error [nT]", fontsize=9)
    ax.set_ylim(bottom=0)
    ax.tick_params(axis="y", labelsize=9)
    ax.grid(axis="y", color="0.9")
    ax.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    title = f"Figure 6 a, b: errors by path, with {LEVEL:.0%} intervals"
    return Drawing("figure_6ab", title, title, figure)


def _curves(found: Evaluation, curves: Mapping[str, Sequence[Mapping[str, float]]]) -> Drawing | None:
    """The paper's Figure 6 c: learning curves, of the weights that have one beside them."""
    shown = {m: curves[name] for m, name in enumerate(found.names) if curves.get(name)}
    if not shown:
        return None
    figure = new_figure(WIDTH_IN, 3.4)
    ax = figure.subplots()
    for m, rows in shown.items():
        for column, (what, style) in CURVES.items():
            points = [(row[EPOCH], row[column]) for row in rows if column in row]
            if points:
                label = f"{found.names[m]}, {what}"
                ax.plot(*zip(*points, strict=True), ls=style, color=ink(m), label=label)
    label_epochs(ax)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    title = "Figure 6 c: error in training and on validation recordings over the epochs"
    return Drawing("figure_6c", title, title, figure)


def ink(m: int) -> str:
    """Colour of a model by its number."""
    return INKS[m % len(INKS)]


def _line(ax: "Axes", t: Array, values: Array, **look: Any) -> None:
    ax.plot(*thinned(t, values), **look)
