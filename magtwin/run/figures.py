"""Figures: a run in a few numbers, computed block by block if it is long."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.report.report import Figure, Report
from magtwin.report.verdict import HOLDS_ONE, Tally
from magtwin.run import mapped

if TYPE_CHECKING:
    from magtwin.run.run import Run


UNMODELLED = "b_unmodelled_nt"
"""Column of a neural run with fields that its network does not know: their part of b_disturbance_nt."""

PLAIN = ("nominal", "drawn")
"""Families of plants that add no field of their own: runs of these need no `UNMODELLED`."""


def prediction_nt(run: "Run", rows: slice = slice(None)) -> NDArray[Any]:
    """What the model of a run predicts, b_total_nt without `UNMODELLED` [nT], shape (N,).

    The true field contains the plant too, so with it a prediction would be judged by a part of the truth. nan
    in runs of earlier versions that read a plant and do not tell its part.
    """
    total = run["b_total_nt"][rows]
    if UNMODELLED in run:
        return np.asarray(total - run[UNMODELLED][rows])
    plant = str(run.metadata.get("plant", "nominal")).partition(":")[0]
    untold = run.metadata.get("magnetometer") == "neural" and plant not in PLAIN
    return np.full(len(total), np.nan) if untold else total


def run_report(run: "Run", title: str) -> Report:
    """Duration, distance, fields, errors and flags of a run; missing columns are skipped."""
    figures = [Figure("duration", run.duration_s, "s"), Figure("readings", run.rows)]
    if "p_world_base" in run:
        figures.append(Figure("distance driven", _length(run["p_world_base"]), "m"))
    for name in ("b_total_nt", "b_map_nt", "b_disturbance_nt"):
        if name in run and (field := _statistics(run[name])):
            least, most, mean, sd = field
            figures.append(Figure(name, mean, "nT", sd, f"{least:.0f} to {most:.0f}"))
    if {"b_total_nt", "b_truth_nt"} <= set(run) and (error := _mean_error(run)) > 0:
        note = "mean absolute difference of the prediction from b_truth_nt"
        figures.append(Figure("error", error, "nT", None, note))
    for name in run:
        if name.startswith("flag_") and run[name].any():
            note = run.spec(name).doc
            figures.append(Figure(name, int(run[name].sum()), "readings", None, note))
    tally = Tally()  # how well a network predicted the exact field, if there was one
    run.add_to(tally)
    verdict = tally.verdict("the exact field of this run, one session", holds=HOLDS_ONE)
    return Report(title, tuple(figures), dict(run.metadata), verdict)


def _length(p: NDArray[Any]) -> float:
    """Length of a track [m], from positions of shape (N, 3)."""
    length = 0.0
    for rows in mapped.parts(len(p)):
        steps = np.diff(p[max(rows.start - 1, 0) : rows.stop, :2], axis=0)
        length += float(np.hypot(*steps.T).sum())
    return length


def _statistics(values: NDArray[Any]) -> tuple[float, float, float, float] | None:
    """Least, greatest, mean and standard deviation of finite values; None if there are none.

    Means and squares of blocks are combined by the formula of Chan, Golub and LeVeque (1983).
    """
    count, mean, squares, least, most = 0, 0.0, 0.0, math.inf, -math.inf
    for rows in mapped.parts(len(values)):
        part = values[rows]
        part = part[np.isfinite(part)]
        if not len(part):
            continue
        total, off = count + len(part), float(part.mean()) - mean
        squares += float(part.var()) * len(part) + off * off * count * len(part) / total
        mean, count = mean + off * (len(part) / total), total
        least, most = min(least, float(part.min())), max(most, float(part.max()))
    return (least, most, mean, math.sqrt(squares / count)) if count else None


def _mean_error(run: "Run") -> float:
    """Mean absolute difference of the prediction from b_truth_nt [nT]; 0 if neither is known."""
    count, total = 0, 0.0
    for rows in mapped.parts(run.rows):
        error = np.abs(prediction_nt(run, rows) - run["b_truth_nt"][rows])
        known = np.isfinite(error)
        count, total = count + int(known.sum()), total + float(error[known].sum())
    return total / count if count else 0.0
