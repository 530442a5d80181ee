"""`magtwin train`: a neural magnetometer from a data set."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from magtwin.cli.app import app
from magtwin.cli.options import Force, Names, Weights, Whole
from magtwin.cli.terminal import Done, named, progress
from magtwin.errors import InputError
from magtwin.files.kinds import SWEEP, kind_of

if TYPE_CHECKING:
    from magtwin.learn.models.predictor import Epoch


@app.command
def train(
    dataset: Path,
    *,
    out: Weights,
    config: Path | None = None,
    model: str | None = None,
    features: str | None = None,
    dropout: float | None = None,
    epochs: Whole | None = None,
    lr: float | None = None,
    seed: Whole | None = None,
    licence: str | None = None,
    split: Literal["session", "run", "path", "row"] | None = None,
    hold_out: Names = None,
    init: Path | None = None,
    force: Force = False,
) -> Done:
    """Train a model on a data set and measure its errors on recordings that it never saw.

    Beside F.safetensors it writes the model card F.md and, for a model trained in epochs, the learning curve
    F.png.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    config
        TOML of the options below, with _ for -, and of layers, batch, patience, threads, device, penalty and
        weighting. Options on the command line override it.
    model
        paper: 20-512-512-512-512-1 (default); linear: Tolles-Lawson terms by ridge regression; hybrid: a
        linear base and a small network for its residual, kept only if it does better on validation; mixed: a
        linear model whose coefficients differ between sessions, for `magtwin model calibrate`; or a predictor
        kind of an installed package.
    features
        Set of inputs, or names separated by commas. Default: full (the paper's 20); circular for a linear
        model, platform for a hybrid, session for a mixed model.
    dropout
        Share of units dropped in training. Default: 0.3; 0.1 for a hybrid.
    epochs
        Passes over the training rows. Default: 20.
    lr
        Largest step size of Adam. Default: 0.001.
    seed
        Seed of the split, the initial weights, the order of rows and dropout. Default: 0.
    licence
        Licence of the weights, an SPDX identifier such as MIT.
    split
        Unit kept whole when splitting into training, validation and test: session (default), run or path;
        row leaks between them, and is for comparison only.
    hold_out
        Sessions, runs or paths to put into the test.
    init
        Weights to continue from, .safetensors or a released .pth, of the same kind, inputs and layers.
    """
    given: dict[str, Any] = dict(locals())
    from dataclasses import fields

    from magtwin.figures.canvas import save
    from magtwin.figures.training import draw_learning_curve
    from magtwin.files.outputs import transaction
    from magtwin.learn.training.config import TrainConfig, read_config
    from magtwin.learn.training.train import train as train_model

    if dataset.is_dir() and kind_of(dataset) in (None, SWEEP):
        build = f"magtwin dataset build {dataset} --map MAP --out SET"
        raise InputError(f"{dataset}: is no data set; build one from the runs first: {build}")
    given |= {"hold_out": hold_out and tuple(hold_out)}
    base = TrainConfig() if config is None else read_config(config)
    names = [field.name for field in fields(base) if given.get(field.name) is not None]
    options = base.with_options(**{name: given[name] for name in names})
    beside = (".md",) if options.epochs is None else (".md", ".png")
    out = named(out, (".safetensors",), "a network", beside=beside, force=force)
    with transaction():
        with progress("Training", "rows") as show:
            pace = _Pace(show, options.epochs)
            result = train_model(
                dataset, out=out, config=options, force=force, progress=pace.epoch, advance=pace.rows
            )
        if result.history:
            naive = result.parts[0].naive_rmse_nt
            curve = draw_learning_curve(result.history, naive_rmse_nt=naive, title=out.name)
            save(curve, out.with_suffix(".png"), force=force)
    wrote = [out.with_suffix(ending) for ending in beside[: 1 + bool(result.history)]]
    figures = [f"test {name}" for name in ("MAE", "naive MAE", "ratio", "coverage")]
    export = ("magtwin", "model", "export", out, "--out", out.with_suffix(".onnx"))
    return Done(result.report(str(out)), (out, *wrote), figures, rest=f"magtwin info {out}", next=(export,))


class _Pace:
    """Progress of a training: rows done, and the last epoch's error on validation."""

    def __init__(self, show: Any, epochs: int | None) -> None:
        self.show, self.epochs, self.ended, self.begun = show, epochs, "", 1

    def rows(self, done: int, total: int) -> None:
        """Show the rows done, of all epochs."""
        epochs = "" if self.epochs is None else f" of {self.epochs}"
        self.show(done, total, f"epoch {self.begun}{epochs}{self.ended}")

    def epoch(self, epoch: "Epoch") -> None:
        """Note the error of a finished epoch."""
        self.begun = epoch.number + (self.epochs is None or epoch.number < self.epochs)
        self.ended = f", validation {epoch.val_rmse_nt:.1f} nT RMS"
