"""Training: learning curves and input correlations, as in Figures 6c and 2 of the paper."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from magtwin.figures.canvas import WIDTH_IN, label, new_figure
from magtwin.figures.style import DATA, FAINT, INK, MODEL, SOFT, styled
from magtwin.learn.data.correlation import PAPER, Correlations
from magtwin.learn.models.predictor import Epoch


@styled
def draw_learning_curve(
    history: Sequence[Epoch], *, naive_rmse_nt: float | None = None, title: str = ""
) -> Figure:
    """Draw the errors on the training and the validation rows over the epochs.

    `naive_rmse_nt` is the error of the mean training label on the validation rows [nT], drawn as a line.
    """
    figure = new_figure(WIDTH_IN, 3.4)
    ax = figure.subplots()
    numbers = [epoch.number for epoch in history]
    mark = "." if len(numbers) <= 60 else ""
    ax.plot(numbers, [e.train_rmse_nt for e in history], color=DATA, marker=mark, label="training")
    look: dict[str, Any] = {"color": MODEL, "ls": (0, (6, 1.2)), "marker": mark, "label": "validation"}
    ax.plot(numbers, [e.val_rmse_nt for e in history], **look)
    if naive_rmse_nt is not None:
        ax.axhline(naive_rmse_nt, color=SOFT, ls=":", label="validation, naive mean")
    kept = next(epoch for epoch in reversed(history) if epoch.best)
    ax.plot(kept.number, kept.val_rmse_nt, "o", mfc="none", mec=INK, ms=9, label=f"kept: epoch {kept.number}")
    ax.set_ylim(bottom=0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    label(ax, "epoch", "RMSE [nT]")
    ax.grid()
    ax.set_title(title)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


@styled
def draw_correlations(correlations: Correlations) -> Figure:
    """Draw the correlation of each input with the disturbance, beside the paper's values."""
    names, count = correlations.features, len(correlations.features)
    figure = new_figure(WIDTH_IN, 1.9 + 0.24 * count)
    ax = figure.subplots()
    y, rho, sd = np.arange(count), np.nan_to_num(correlations.rho), correlations.sd
    ax.barh(y, rho, 0.7, color=DATA, alpha=0.6, label=f"{correlations.rows:,} readings")
    known = np.isfinite(sd)
    if known.any():
        look: dict[str, Any] = {"fmt": "none", "ecolor": INK, "elinewidth": 1, "capsize": 2}
        text = f"standard deviation over {correlations.groups} groups"
        ax.errorbar(rho[known], y[known], xerr=sd[known], label=text, **look)
    paper = [(PAPER[name], i) for i, name in enumerate(names) if name in PAPER]
    if paper:
        ax.plot(*zip(*paper, strict=True), "D", color=MODEL, ms=5, label="the paper's Figure 2")
    for i in np.flatnonzero(np.isnan(correlations.rho)).tolist():
        ax.text(0.01, i, "never varies", va="center", color=SOFT)
    reach = min(1.1 * np.nanmax(np.abs(np.append(rho, 0.4)) + np.nan_to_num(np.append(sd, 0.0))), 1.05)
    ax.set(xlim=(-reach, reach), ylim=(count - 0.4, -0.6))
    ax.set_yticks(y, names)
    ax.axvline(0, color=FAINT, lw=0.8)
    label(ax, "Spearman's correlation with the disturbance")
    ax.grid(axis="x")
    figure.legend(loc="outside lower center", ncols=1)
    return figure
