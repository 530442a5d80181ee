"""Learning: a learning curve as a Rerun recording."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from magtwin.files.outputs import output
from magtwin.io.rerun.recording import stream
from magtwin.learn.models.predictor import Epoch


def record_learning_curve(
    history: Sequence[Epoch],
    out: str | os.PathLike[str],
    *,
    naive_rmse_nt: float | None = None,
    title: str = "",
    force: bool = False,
) -> None:
    """Write the epochs of a training as a recording that opens as a plot, on a timeline of epochs.

    Args:
        history: Result of `magtwin.learn.training.fit_network.train`.
        out: The .rrd file to make.
        naive_rmse_nt: Error of the mean training label on the validation rows [nT], drawn as a line.
        title: Name of the recording in the viewer. Default: the file's name.
        force: Whether to replace an existing file.

    Raises:
        InputError: `out` exists or cannot be written.
    """
    path = Path(out)
    numbers = [epoch.number for epoch in history]
    lines = {
        "training": ([epoch.train_rmse_nt for epoch in history], (25, 113, 194)),
        "validation": ([epoch.val_rmse_nt for epoch in history], (224, 102, 13)),
        "validation_mae": ([epoch.val_mae_nt for epoch in history], (130, 130, 130)),
    }
    if naive_rmse_nt is not None:
        lines["validation_naive"] = ([naive_rmse_nt] * len(history), (180, 180, 180))
    recording_id = hashlib.sha256(repr((numbers, lines)).encode()).hexdigest()
    most = max(max(values) for values, _ in lines.values())
    axis = rrb.ScalarAxis(range=(0.0, 1.1 * most))
    plot = rrb.TimeSeriesView(origin="/learning", name="RMSE [nT] by epoch", axis_y=axis)
    views = rrb.Blueprint(plot, rrb.TimePanel(timeline="epoch", state="collapsed"), collapse_panels=True)
    with (
        output(path, force=force) as aside,
        stream(recording_id, title or path.stem, views, file=aside, final=path) as rec,
    ):
        for name, (values, colour) in lines.items():
            entity, text = f"learning/{name}", name.replace("_", ", ").replace("mae", "MAE")
            rec.log(entity, rr.SeriesLines(names=[f"{text} [nT]"], colors=[colour]), static=True)
            columns = rr.Scalars.columns(scalars=values)
            rec.send_columns(entity, [rr.TimeColumn("epoch", sequence=numbers)], columns)
        kept = next(epoch for epoch in reversed(history) if epoch.best)
        rec.log("learning/kept", rr.SeriesPoints(names=[f"kept: epoch {kept.number}"]), static=True)
        rec.set_time("epoch", sequence=kept.number)
        rec.log("learning/kept", rr.Scalars(kept.val_rmse_nt))
