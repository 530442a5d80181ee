"""The paper's Figure 2 from data of one's own: how each input goes with the disturbance."""

import os
from typing import TYPE_CHECKING

import numpy as np

from magtwin.figures.plots import INK, MAP_INK, new_figure, save
from magtwin.learn.data.correlation import PAPER, Correlations

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_correlations(
    found: Correlations, out: str | os.PathLike[str], *, title: str = "", force: bool = False
) -> None:
    """Draw correlations as bars with their standard deviations, beside the paper's.

    Args:
        found: The correlations.
        out: PNG or SVG to write.
        title: What stands above.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: `out` is no picture or exists.
    """
    save(figure_of_correlations(found, title=title), out, force)


def figure_of_correlations(found: Correlations, *, title: str = "") -> "Figure":
    """The same as a figure, for a page."""
    count = len(found.features)
    figure = new_figure(5.2, 1.5 + 0.24 * count)
    ax = figure.subplots()
    y = np.arange(count)
    rho = np.nan_to_num(found.rho)
    ax.barh(y, rho, 0.7, color="#8fb3d9", label=f"{found.rows:,} readings")
    known = np.isfinite(found.sd)
    if known.any():
        label = f"standard deviation over {found.groups} groups"
        ax.errorbar(
            rho[known],
            y[known],
            xerr=found.sd[known],
            fmt="none",
            ecolor=INK,
            elinewidth=1,
            capsize=2,
            label=label,
        )
    paper = [(PAPER[name], i) for i, name in enumerate(found.features) if name in PAPER]
    if paper:
        ax.plot(*zip(*paper, strict=True), "D", color=MAP_INK, ms=4.5, label="the paper's Figure 2")
    for i in np.flatnonzero(np.isnan(found.rho)).tolist():
        ax.text(0.01, i, "never varies", va="center", fontsize=9, color="0.4")
    reach = np.nanmax(np.abs(np.append(rho, 0.4)) + np.nan_to_num(np.append(found.sd, 0.0)))
    reach = min(1.1 * reach, 1.05)
    ax.set_xlim(-reach, reach)
    ax.set_yticks(y, found.features, fontsize=9)
    ax.set_ylim(count - 0.4, -0.6)
    ax.axvline(0, color=INK, lw=0.8)
    ax.set_xlabel("Spearman's correlation with the disturbance", fontsize=9)
    ax.tick_params(axis="x", labelsize=9)
    ax.grid(axis="x", color="0.9")
    ax.set_axisbelow(True)
    if title:
        ax.set_title(title, fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure
