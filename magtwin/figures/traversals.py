"""Traversals: the paper's Figure 8, one path driven twice, as a section of an evaluation's report."""

from magtwin.figures.charts import OTHER_INK, WIDTH_IN, field_name, position_name, thinned
from magtwin.figures.evaluations import Drawing, pictured
from magtwin.figures.pages import Section, Table
from magtwin.figures.plots import INK, new_figure
from magtwin.run.compare import Comparison, Traversals
from magtwin.run.run import Metadata

ALIGNED = {
    "recorded": "by time from each start",
    "timed": "by time, clocks aligned",
    "placed": "by distance driven",
}
"""How the two runs are aligned."""


def section_of_traversals(found: Traversals, names: tuple[str, str]) -> Section:
    """The experiment's section: fields with and without alignment, and how far apart the robots were.

    Args:
        found: What `magtwin.run.compare.traversals` gave.
        names: What to call the two runs.
    """
    told = [f"{name}: {_told(run.metadata)}" for name, run in zip(names, (found.a, found.b), strict=True)]
    rows = []
    for how, words in ALIGNED.items():
        comparison: Comparison = getattr(found, how)
        for one in comparison.agreements():
            correlation = "" if one.correlation is None else f"{one.correlation:.4f}"
            rows.append((words, one.name, one.unit, one.mean, one.rms, one.mae, one.greatest, correlation))
    head = ("aligned", "quantity", "unit", "mean", "RMS", "MAE", "maximum", "correlation")
    note = f"{names[1]} minus {names[0]}. Along-track: ahead of the first run; cross-track: to its left."
    table = Table("One path, driven twice", head, tuple(rows), note)
    return Section(
        "One path, driven twice", "; ".join(told) + ".", pictured([_drawing(found, names)]), (table,)
    )


def _told(metadata: Metadata) -> str:
    """What a run's metadata say of how it was driven."""
    words = [str(metadata.get("path", "a path of its own")), f"engine {metadata.get('engine', 'kinematic')}"]
    words += [f"seed {metadata['seed']}"] if "seed" in metadata else ["recorded"]
    return ", ".join(words)


def _drawing(found: Traversals, names: tuple[str, str]) -> Drawing | None:
    column, position = field_name(found.a, found.b), position_name(found.a, found.b)
    if column is None or position is None:
        return None
    figure = new_figure(WIDTH_IN, 8.6)
    axes = figure.subplots(4, 1, height_ratios=[1.0, 1.0, 1.0, 0.8])
    for ax, (how, words) in zip(axes, ALIGNED.items(), strict=False):
        comparison: Comparison = getattr(found, how)
        a, b = comparison.fields[column]
        for values, name, colour, width in ((a, names[0], INK, 1.6), (b, names[1], OTHER_INK, 0.9)):
            ax.plot(*thinned(comparison.at, values / 1000), color=colour, lw=width, label=name)
        one = next(one for one in comparison.agreements() if one.name == column)
        shift = f" ({comparison.shift:+.3f} {comparison.unit})" if how != "recorded" else ""
        alike = "" if one.correlation is None else f", corr. {one.correlation:.3f}"
        ax.set_title(f"{words}{shift}: MAE {one.mae:,.0f} nT{alike}", fontsize=9, loc="left")
        ax.set_xlabel("distance driven [m]" if comparison.align == "path" else "time [s]", fontsize=9)
        ax.set_ylabel("field [µT]", fontsize=9)
    clocks = found.recorded
    for values, name, colour in (
        (clocks.along_m, "along-track", INK),
        (clocks.cross_m, "cross-track", OTHER_INK),
    ):
        axes[3].plot(*thinned(clocks.at, values), color=colour, lw=1.0, label=name)
    axes[3].axhline(0, color="0.7", lw=0.6)
    axes[3].set_title("distance between the two, by time from each start", fontsize=9, loc="left")
    axes[3].set_xlabel("time [s]", fontsize=9)
    axes[3].set_ylabel("distance [m]", fontsize=9)
    for ax in axes:
        ax.margins(x=0)
        ax.tick_params(labelsize=9)
    for ax in (axes[0], axes[3]):
        ax.legend(fontsize=9, loc="best", framealpha=0.85)
    title = f"Figure 8: {column} of one path, driven twice, with and without alignment"
    return Drawing("figure_8", title, title, figure)
