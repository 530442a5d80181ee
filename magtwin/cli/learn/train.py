"""`magtwin train`: a neural magnetometer from a data set."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force, Names, Whole
from magtwin.cli.terminal import Done, check_suffix, progress
from magtwin.errors import InputError
from magtwin.files.kinds import SWEEP, kind_of

if TYPE_CHECKING:
    from magtwin.learn.models.predictor import Epoch


@app.command
def train(
    dataset: Path,
    *,
    out: Path,
    config: Path | None = None,
    model: str | None = None,
    layers: str | None = None,
    features: str | None = None,
    penalty: float | None = None,
    weighting: Literal["auto", "label_sd", "none"] | None = None,
    dropout: float | None = None,
    epochs: Whole | None = None,
    batch: Whole | None = None,
    lr: float | None = None,
    patience: Whole | None = None,
    seed: Whole | None = None,
    licence: str | None = None,
    split: Literal["session", "run", "path", "row"] | None = None,
    hold_out: Names = None,
    threads: Whole | None = None,
    device: Literal["cpu", "cuda", "auto"] | None = None,
    init: Path | None = None,
    freeze: Names = None,
    resume: Flag = False,
    rrd: Path | None = None,
    force: Force = False,
) -> Done:
    """Train a model on a data set and measure its errors on recordings that it never saw.

    Beside F.safetensors it writes the model card F.md and, for a model trained in epochs, the learning curve
    F.png and F.csv. After each epoch the state is written to F.checkpoint, which is removed at the end.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    out
        Weights to write, .safetensors.
    config
        TOML of the options below, with _ for -. Options on the command line override it.
    model
        paper: 20-512-512-512-512-1 (default); released: 20-512-512-512-128-1; linear: Tolles-Lawson terms by
        ridge regression; hybrid: a linear base and a small network for its residual, kept only if it does
        better on validation; mixed: a linear model whose coefficients differ between sessions, for
        `magtwin calibrate`; or a predictor kind of an installed package.
    layers
        Widths of the hidden layers, such as 256,256.
    features
        Set of inputs, or names separated by commas. Default: full (the paper's 20); circular for a linear
        model, platform for a hybrid, session for a mixed model.
    penalty
        Ridge penalty of a linear model or a hybrid. Default: chosen by cross-validation over recordings.
    weighting
        Weights of rows in the ridge: label_sd by how well the map is known, none, or auto (default), the
        better of the two on recordings left out.
    dropout
        Share of units dropped in training. Default: 0.3; 0.1 for a hybrid.
    epochs
        Passes over the training rows. Default: 20.
    batch
        Rows per step. Default: 1024.
    lr
        Largest step size of Adam. Default: 0.001.
    patience
        Stop after this many epochs without improvement on the validation recordings.
    seed
        Seed of the split, the initial weights, the order of rows and dropout. Default: 0.
    licence
        Licence of the weights, an SPDX identifier such as MIT.
    split
        Unit kept whole when splitting into training, validation and test: session (default), run or path;
        row leaks between them, and is for comparison only.
    hold_out
        Sessions, runs or paths to put into the test.
    threads
        Threads of torch and numpy. Default: 1. More are faster, and another number gives other bits.
    device
        Where to train: cpu, cuda, or auto (default: a GPU if torch sees one).
    init
        Weights to continue from, .safetensors or a released .pth, of the same kind, inputs and layers.
    freeze
        Layers that stay as they are: layers.0 is the first; base is that of a hybrid.
    resume
        Continue from F.checkpoint of an interrupted training; the weights are the same as without the
        interruption.
    rrd
        Rerun recording of the learning curve to write, .rrd.
    """
    given: dict[str, Any] = dict(locals())
    from dataclasses import fields

    from magtwin.figures.canvas import save
    from magtwin.figures.training import draw_learning_curve, write_learning_curve
    from magtwin.files.outputs import check_free, transaction
    from magtwin.io.rerun.learning import record_learning_curve
    from magtwin.learn.training.config import TrainConfig, read_config
    from magtwin.learn.training.train import train as train_model

    check_suffix(out, (".safetensors",), "a network")
    if dataset.is_dir() and kind_of(dataset) in (None, SWEEP):
        build = f"magtwin dataset build {dataset} --map MAP --out SET"
        raise InputError(f"{dataset}: is no data set; build one from the runs first: {build}")
    picture, table = (out.with_suffix(end) for end in (".png", ".csv"))
    given |= {"layers": None if layers is None else _widths(layers)}
    given |= {name: given[name] and tuple(given[name]) for name in ("hold_out", "freeze")}
    if model in ("paper", "released") and layers is not None:
        raise InputError("--model and --layers both set the widths; give one of them")
    base = TrainConfig() if config is None else read_config(config)
    names = [field.name for field in fields(base) if given.get(field.name) is not None]
    options = base.with_options(**{name: given[name] for name in names})
    curves = () if options.model in ("linear", "mixed") else (picture, table)
    if rrd is not None:
        check_suffix(rrd, (".rrd",), "a Rerun recording")
        if not curves:
            raise InputError(f"--rrd: a {options.model} model is fitted at once and has no learning curve")
    for path in (*curves, *([rrd] if rrd else [])):
        check_free(path, force=force)
    with transaction():
        with progress("Training", "rows") as show:
            pace = _Pace(show, options.epochs)
            result = train_model(
                dataset,
                out=out,
                config=options,
                force=force,
                resume=resume,
                progress=pace.epoch,
                advance=pace.rows,
            )
        if result.history:
            naive = result.parts[0].naive_rmse_nt
            curve = draw_learning_curve(result.history, naive_rmse_nt=naive, title=out.name)
            save(curve, picture, force=force)
            write_learning_curve(result.history, table, force=force)
            if rrd is not None:
                record_learning_curve(result.history, rrd, naive_rmse_nt=naive, title=out.name, force=force)
    shown = [path.name for path in curves if result.history]
    return Done(result.report(str(out)), (out, out.with_suffix(".md").name, *shown))


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


def _widths(text: str) -> tuple[int, ...]:
    """Widths of layers from text such as 256,256."""
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"--layers takes whole numbers separated by commas, got {text!r}") from None
