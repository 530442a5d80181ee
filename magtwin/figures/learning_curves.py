"""The paper's Figure 6c from a training of one's own: how the error falls with the epochs."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import TYPE_CHECKING

from magtwin.figures.plots import INK, MAP_INK, new_figure, save
from magtwin.files import output
from magtwin.learn.models.descent import Epoch

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_learning_curve(
    history: Sequence[Epoch],
    out: str | os.PathLike[str],
    *,
    naive_rmse_nt: float | None = None,
    title: str = "",
    force: bool = False,
) -> None:
    """Draw the errors in training and on the validation rows over the epochs.

    Args:
        history: What `magtwin.learn.models.fit_network.train` gave.
        out: PNG or SVG to write.
        naive_rmse_nt: Error of the mean training label on the validation rows [nT], to be drawn as a line.
        title: What stands above.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: `out` is no picture or exists.
    """
    figure = new_figure(5.2, 3.4)
    ax = figure.subplots()
    numbers = [epoch.number for epoch in history]
    mark = "." if len(numbers) <= 60 else ""
    ax.plot(numbers, [e.train_rmse_nt for e in history], color="#1971c2", marker=mark, label="training")
    ax.plot(numbers, [e.val_rmse_nt for e in history], color=MAP_INK, marker=mark, label="validation")
    if naive_rmse_nt is not None:
        ax.axhline(naive_rmse_nt, color="0.5", ls="--", lw=1, label="validation, naive mean")
    kept = next(epoch for epoch in reversed(history) if epoch.best)
    ax.plot(kept.number, kept.val_rmse_nt, "o", mfc="none", mec=INK, ms=9, label=f"kept: epoch {kept.number}")
    label_epochs(ax)
    ax.set_axisbelow(True)
    if title:
        ax.set_title(title, fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    save(figure, out, force)


def label_epochs(ax: "Axes") -> None:
    """Axes, ticks and grid of errors [nT] over whole epochs."""
    from matplotlib.ticker import MaxNLocator

    ax.set_ylim(bottom=0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("epoch", fontsize=9)
    ax.set_ylabel("RMSE [nT]", fontsize=9)
    ax.tick_params(labelsize=9)
    ax.grid(color="0.9")


def write_learning_curve(
    history: Sequence[Epoch], out: str | os.PathLike[str], *, force: bool = False
) -> None:
    """Write the epochs as CSV: number, training and validation RMSE, validation MAE [nT], and whether best.

    Raises:
        InputError: `out` exists.
    """
    lines = [",".join(field.name for field in fields(Epoch))]
    lines += [",".join(repr(int(v) if isinstance(v, bool) else v) for v in astuple(e)) for e in history]
    with output(out, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")


def record_learning_curve(
    history: Sequence[Epoch],
    out: str | os.PathLike[str],
    *,
    naive_rmse_nt: float | None = None,
    title: str = "",
    force: bool = False,
) -> None:
    """Write the epochs as a Rerun recording, on a timeline of epochs, that opens as a plot.

    Args:
        history: What a training gave.
        out: The .rrd file to make.
        naive_rmse_nt: Error of the mean training label on the validation rows [nT], a line of its own.
        title: What the viewer calls the recording; the file's name unless given.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: `out` exists or cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    from magtwin.io.rerun.recording import stream

    path = Path(out)
    numbers = [epoch.number for epoch in history]
    lines = {
        "training": ([epoch.train_rmse_nt for epoch in history], (25, 113, 194)),
        "validation": ([epoch.val_rmse_nt for epoch in history], (224, 102, 13)),
        "validation_mae": ([epoch.val_mae_nt for epoch in history], (130, 130, 130)),
    }
    if naive_rmse_nt is not None:
        lines["validation_naive"] = ([naive_rmse_nt] * len(history), (180, 180, 180))
    told = repr((numbers, lines)).encode()
    plot = rrb.TimeSeriesView(
        origin="/learning",
        name="RMSE [nT] by epoch",
        axis_y=rrb.ScalarAxis(range=(0.0, 1.1 * max(max(values) for values, _ in lines.values()))),
    )
    views = rrb.Blueprint(plot, rrb.TimePanel(timeline="epoch", state="collapsed"), collapse_panels=True)
    with (
        output(path, force=force) as aside,
        stream(hashlib.sha256(told).hexdigest(), title or path.stem, views, file=aside, said=path) as rec,
    ):
        for name, (values, colour) in lines.items():
            entity = f"learning/{name}"
            said = name.replace("_", ", ").replace("mae", "MAE")
            rec.log(entity, rr.SeriesLines(names=[f"{said} [nT]"], colors=[colour]), static=True)
            columns = rr.Scalars.columns(scalars=values)
            rec.send_columns(entity, [rr.TimeColumn("epoch", sequence=numbers)], columns)
        kept = next(epoch for epoch in reversed(history) if epoch.best)
        rec.log("learning/kept", rr.SeriesPoints(names=[f"kept: epoch {kept.number}"]), static=True)
        rec.set_time("epoch", sequence=kept.number)
        rec.log("learning/kept", rr.Scalars(kept.val_rmse_nt))
