"""Budgets: what makes a model's error on a twin, as a section of an evaluation's report."""

from collections.abc import Sequence
from textwrap import fill

import numpy as np

from magtwin.figures.charts import WIDTH_IN
from magtwin.figures.evaluations import MOST_PANELS, Drawing, ink, of_weights, pictured
from magtwin.figures.pages import Section, Table
from magtwin.figures.plots import INK, new_figure
from magtwin.learn.evaluation.budget import CLOSED, TERMS, Budget, TrueError
from magtwin.learn.evaluation.evaluation import Evaluation

SAVED, LOST = "#40916c", "#c92a2a"
"""Colours of what a step takes from an error, and of what it adds to it."""


def section_of_budget(
    found: Evaluation, made: Sequence[Budget], missed: Sequence[TrueError], order: Sequence[int]
) -> Section:
    """The error budget of a twin, for `page_of_evaluation`.

    Args:
        found: The evaluation.
        made: Budgets of some of its models.
        missed: What its maps miss.
        order: Its models, step by step from the paper's configuration on.
    """
    lead = (
        "On a twin the exact value of every part of the error is known. Closing a term removes its part of "
        "the error, less what the model learned of it in training. In turn: with all terms to its left "
        "closed too. Sessions: the robot's iron differs from that in the survey and from the mean of the "
        "training sessions. Platform: the field of motion, motors, LiDAR and battery, less what the model "
        "predicts of it."
    )
    drawings = [_waterfall(found, made), _ladder(found, order)]
    tables = (_steps_table(found, order), _budget_table(made), _rms_table(made), _true_table(missed))
    return Section("Error budget", lead, pictured(drawings), tables)


def _steps_table(found: Evaluation, order: Sequence[int]) -> Table:
    rows, scores = [], found.every.scores
    for k, m in enumerate(order):
        score, before = scores[m], scores[order[max(k - 1, 0)]]
        bought = (before.mae_nt - score.mae_nt, before.ratio - score.ratio) if k else ("", "")
        rows.append((found.names[m], found.candidates[m].map.name, score.mae_nt, score.ratio, *bought))
    head = ("model", "map", "MAE [nT]", "ratio to naive", "gain [nT]", "gain in ratio")
    note = "gain: improvement over the row above; negative where the row above was better."
    return Table("Steps", head, tuple(rows), note)


def _budget_table(made: Sequence[Budget]) -> Table:
    rows = []
    for one in made:
        turn = [one.mae_nt, *(term.after_nt for term in one.terms)]
        rows.append((one.name, "MAE closed in turn", *(round(nt, 1) for nt in turn)))
        rows.append((one.name, "ratio to naive MAE", *(round(nt / one.naive_mae_nt, 3) for nt in turn)))
        rows.append((one.name, "gain", "", *(round(nt, 1) for nt in one.bought)))
        rows.append((one.name, "MAE closed alone", "", *(round(term.alone_nt, 1) for term in one.terms)))
    note = (
        "In nT, except ratios. Closed: " + "; ".join(f"{term}, {what}" for term, what in CLOSED.items()) + "."
    )
    return Table("Closing each term", ("model", "figure", "as it is", *TERMS), tuple(rows), note)


def _rms_table(made: Sequence[Budget]) -> Table:
    rows = tuple((one.name, *(term.rms_nt for term in one.terms)) for one in made)
    note = "Root mean square of each part of the error [nT]; at each reading, the parts add up to the error."
    return Table("How large each part is", ("model", *TERMS), rows, note)


def _true_table(missed: Sequence[TrueError]) -> Table:
    rows = tuple((one.map, one.mae_nt, one.rms_nt, one.bias_nt) for one in missed)
    note = "Map minus the exact field of the surveying robot at rest, along the recorded paths."
    return Table("Errors of the maps", ("map", "MAE [nT]", "RMS [nT]", "mean [nT]"), rows, note)


def _waterfall(found: Evaluation, made: Sequence[Budget]) -> Drawing:
    """Each model's error, and what closing one term after the other takes from it."""
    shown = [one for one in made if found.names.index(one.name) in (0, *of_weights(found))][:MOST_PANELS]
    shown = shown or list(made[:MOST_PANELS])
    figure = new_figure(WIDTH_IN, 0.5 + 1.9 * len(shown))
    axes = figure.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    most = max(one.mae_nt for one in shown)
    for ax, one in zip(axes, shown, strict=True):
        colour = ink(found.names.index(one.name))
        before = [one.mae_nt, *(term.after_nt for term in one.terms)]
        ax.bar(0, one.mae_nt, 0.7, color=colour)
        ax.text(0, one.mae_nt + 0.02 * most, f"{one.mae_nt:.0f}", ha="center", va="bottom", fontsize=9)
        for k, bought in enumerate(one.bought, start=1):
            now, then = before[k], before[k - 1]
            ax.bar(k, abs(bought), 0.7, bottom=min(now, then), color=SAVED if bought >= 0 else LOST)
            ax.plot([k - 1.35, k + 0.35], [then, then], color="0.6", lw=0.7)
            ax.text(k, max(now, then) + 0.02 * most, _signed(-bought), ha="center", va="bottom", fontsize=9)
        ax.set_title(f"{one.name}: {one.mae_nt / one.naive_mae_nt:.3f} of naive", fontsize=9, loc="left")
        ax.set_ylabel("MAE [nT]", fontsize=9)
        ax.set_ylim(0, 1.18 * most)
        ax.tick_params(labelsize=9)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    axes[-1].set_xticks(range(len(TERMS) + 1), ["as it is", *(fill(term, 8) for term in TERMS)], fontsize=9)
    title = "Error budget: how much closing each term in turn reduces the mean absolute error"
    return Drawing("budget", title, title, figure)


def _ladder(found: Evaluation, order: Sequence[int]) -> Drawing:
    """Errors of all models, step by step from the paper's configuration on."""
    scores = found.every.scores
    figure = new_figure(WIDTH_IN, 1.0 + 0.4 * len(order))
    ax = figure.subplots()
    for k, m in enumerate(order):
        low, high = scores[m].mae_interval_nt
        mae = scores[m].mae_nt
        ax.barh(k, mae, 0.66, color=ink(m))
        if np.isfinite(low + high):
            spread = [[max(mae - low, 0.0)], [max(high - mae, 0.0)]]
            ax.errorbar(mae, k, xerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=2)
        step = "" if not k else f", {_signed(mae - scores[order[k - 1]].mae_nt)}"
        words = f"{mae:.0f} nT ({scores[m].ratio:.3f}{step})"
        at = high if np.isfinite(high) else mae
        end = (max(at, mae), k)
        ax.annotate(words, end, xytext=(6, 0), textcoords="offset points", va="center", fontsize=9)
    ax.set_yticks(range(len(order)), [fill(found.names[m], 20) for m in order], fontsize=9)
    ax.invert_yaxis()
    ax.set_xlim(0, 2.0 * max(max(scores[m].mae_interval_nt[1], scores[m].mae_nt) for m in order))
    ax.set_xlabel("mean absolute error [nT]", fontsize=9)
    ax.tick_params(axis="x", labelsize=9)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    title = "Steps: each model's error (ratio to naive, change from the line above)"
    return Drawing("steps", title, title, figure)


def _signed(change: float) -> str:
    """A change in whole nT, with its sign where it is not 0."""
    return f"{round(change):+d}" if round(change) else "0"
