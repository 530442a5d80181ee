"""The paper's Figure 6c from a training of one's own: how the error falls with the epochs."""

import os
from collections.abc import Sequence
from dataclasses import astuple, fields

from magtwin.files import output
from magtwin.io.plots import INK, MAP_INK, new_figure, save
from magtwin.learn.train import Epoch


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
        history: What `magtwin.learn.train.train` gave.
        out: PNG or SVG to write.
        naive_rmse_nt: Error of the mean training label on the validation rows [nT], to be drawn as a line.
        title: What stands above.
        force: Whether a file that exists is replaced.

    Raises:
        RefusedError: `out` is no picture or exists.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(5.6, 3.4)
    ax = figure.subplots()
    numbers = [epoch.number for epoch in history]
    mark = "." if len(numbers) <= 60 else ""
    ax.plot(numbers, [e.train_rmse_nt for e in history], color="#1971c2", marker=mark, label="training")
    ax.plot(numbers, [e.val_rmse_nt for e in history], color=MAP_INK, marker=mark, label="validation")
    if naive_rmse_nt is not None:
        ax.axhline(naive_rmse_nt, color="0.5", ls="--", lw=1, label="validation, naive mean")
    kept = next(epoch for epoch in reversed(history) if epoch.best)
    ax.plot(kept.number, kept.val_rmse_nt, "o", mfc="none", mec=INK, ms=9, label=f"kept: epoch {kept.number}")
    ax.set_ylim(bottom=0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("epoch", fontsize=9)
    ax.set_ylabel("RMSE [nT]", fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(color="0.9")
    ax.set_axisbelow(True)
    if title:
        ax.set_title(title, fontsize=10)
    figure.legend(loc="outside lower center", ncols=4, fontsize=7.5, frameon=False)
    save(figure, out, force)


def write_learning_curve(
    history: Sequence[Epoch], out: str | os.PathLike[str], *, force: bool = False
) -> None:
    """Write the epochs as CSV: number, training and validation RMSE, validation MAE [nT], and whether best.

    Raises:
        RefusedError: `out` exists.
    """
    lines = [",".join(field.name for field in fields(Epoch))]
    lines += [",".join(repr(int(v) if isinstance(v, bool) else v) for v in astuple(e)) for e in history]
    with output(out, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
