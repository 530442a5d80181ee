"""Budgets: the parts of a model's error on a twin, as a section of an evaluation's report."""

from collections.abc import Sequence
from textwrap import fill
from typing import Any

from magtwin.figures.canvas import WIDTH_IN, Picture, label, new_figure, open_frame, picture
from magtwin.figures.evaluations import MOST_PANELS, ink, trained_models
from magtwin.figures.page import Section, Table
from magtwin.learn.evaluation.budget import CLOSED, TERMS, Budget, TrueError
from magtwin.learn.evaluation.evaluation import Evaluation

SAVED, LOST = "#40916c", "#c92a2a"
"""Colours of a step that reduces an error, and of one that increases it."""


def section_of_budget(
    evaluation: Evaluation, budgets: Sequence[Budget], map_errors: Sequence[TrueError], order: Sequence[int]
) -> Section:
    """The error budget of a twin, for `page_of_evaluation`.

    Args:
        evaluation: The evaluation.
        budgets: Budgets of some of its models.
        map_errors: Errors of its maps.
        order: Indices of its models, step by step from the paper's configuration on.
    """
    lead = (
        "On a twin the exact value of every part of the error is known. Closing a term removes its part of "
        "the error, less what the model learned of it in training. In turn: with all terms to its left "
        "closed too. Sessions: the robot's iron differs from that in the survey and from the mean of the "
        "training sessions. Platform: the field of motion, motors, LiDAR and battery, less what the model "
        "predicts of it."
    )
    rows = tuple((b.name, *(term.rms_nt for term in b.terms)) for b in budgets)
    note = "Root mean square of each part of the error [nT]; at each reading, the parts add up to the error."
    sizes = Table("How large each part is", ("model", *TERMS), rows, note)
    rows = tuple((e.map, e.mae_nt, e.rms_nt, e.bias_nt) for e in map_errors)
    note = "Map minus the exact field of the surveying robot at rest, along the recorded paths."
    maps = Table("Errors of the maps", ("map", "MAE [nT]", "RMS [nT]", "mean [nT]"), rows, note)
    tables = (_steps_table(evaluation, order), _budget_table(budgets), sizes, maps)
    return Section("Error budget", lead, (_waterfall(evaluation, budgets),), tables)


def _steps_table(evaluation: Evaluation, order: Sequence[int]) -> Table:
    scores = evaluation.every.scores
    rows: list[tuple[Any, ...]] = []
    for k, m in enumerate(order):
        score, before = scores[m], scores[order[max(k - 1, 0)]]
        gain = (before.mae_nt - score.mae_nt, before.ratio - score.ratio) if k else ("", "")
        chart = evaluation.candidates[m].map.name
        rows.append((evaluation.names[m], chart, score.mae_nt, score.ratio, *gain))
    head = ("model", "map", "MAE [nT]", "ratio to naive", "gain [nT]", "gain in ratio")
    note = "gain: improvement over the row above; negative where the row above was better."
    return Table("Steps", head, tuple(rows), note)


def _budget_table(budgets: Sequence[Budget]) -> Table:
    rows: list[tuple[Any, ...]] = []
    for budget in budgets:
        turn = [budget.mae_nt, *(term.after_nt for term in budget.terms)]
        alone = [term.alone_nt for term in budget.terms]
        rows.append((budget.name, "MAE closed in turn", *(round(nt, 1) for nt in turn)))
        rows.append((budget.name, "ratio to naive MAE", *(round(nt / budget.naive_mae_nt, 3) for nt in turn)))
        rows.append((budget.name, "gain", "", *(round(nt, 1) for nt in budget.bought)))
        rows.append((budget.name, "MAE closed alone", "", *(round(nt, 1) for nt in alone)))
    closed = "; ".join(f"{term}, {text}" for term, text in CLOSED.items())
    note = f"In nT, except ratios. Closed: {closed}."
    return Table("Closing each term", ("model", "figure", "as it is", *TERMS), tuple(rows), note)


def _waterfall(evaluation: Evaluation, budgets: Sequence[Budget]) -> Picture:
    """Each model's error, and how much closing one term after another reduces it."""
    models = (0, *trained_models(evaluation))
    shown = [b for b in budgets if evaluation.names.index(b.name) in models][:MOST_PANELS]
    shown = shown or list(budgets[:MOST_PANELS])
    figure = new_figure(WIDTH_IN, 0.5 + 1.9 * len(shown))
    axes = figure.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    most = max(budget.mae_nt for budget in shown)
    style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 9}
    for ax, budget in zip(axes, shown, strict=True):
        mae = [budget.mae_nt, *(term.after_nt for term in budget.terms)]
        ax.bar(0, mae[0], 0.7, color=ink(evaluation.names.index(budget.name)))
        ax.text(0, mae[0] + 0.02 * most, f"{mae[0]:.0f}", **style)
        for k, gain in enumerate(budget.bought, start=1):
            now, before = mae[k], mae[k - 1]
            ax.bar(k, abs(gain), 0.7, bottom=min(now, before), color=SAVED if gain >= 0 else LOST)
            ax.plot([k - 1.35, k + 0.35], [before, before], color="0.6", lw=0.7)
            ax.text(k, max(now, before) + 0.02 * most, f"{round(-gain):+d}" if round(gain) else "0", **style)
        title = f"{budget.name}: {budget.mae_nt / budget.naive_mae_nt:.3f} of naive"
        label(ax, y="MAE [nT]", title=title)
        ax.set_ylim(0, 1.18 * most)
        open_frame(ax)
    axes[-1].set_xticks(range(len(TERMS) + 1), ["as it is", *(fill(term, 8) for term in TERMS)], fontsize=9)
    title = "Error budget: how much closing each term in turn reduces the mean absolute error"
    return picture(figure, title, file="budget")
