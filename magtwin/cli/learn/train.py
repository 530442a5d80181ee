"""`magtwin train`: a neural magnetometer from a data set."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json, Whole
from magtwin.cli.terminal import check_suffix, print_report, progress, say, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.learn.models.descent import Epoch
    from magtwin.learn.training.config import TrainConfig

Flag = Annotated[bool, Parameter(negative="")]
Names = Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)]


@app.command
def train(
    dataset: Path,
    *,
    out: Path,
    config: Path | None = None,
    model: Literal["paper", "released", "linear", "hybrid", "ensemble", "tcn"] | None = None,
    layers: str | None = None,
    features: str | None = None,
    members: Whole | None = None,
    kernel: Whole | None = None,
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
    json: Json = False,
) -> None:
    """Train a model on a data set and judge it on recordings that it never saw.

    Beside F.safetensors it writes F.md, the model card, and, of what is trained in epochs, the learning
    curve as F.png and F.csv. After each epoch the state goes to F.checkpoint, which is removed at the end.
    An option that the model does not read is refused.

    Parameters
    ----------
    dataset
        Folder that `magtwin dataset build` made.
    out
        Weights to write, .safetensors.
    config
        TOML of the options below, with _ for -; options given here go first.
    model
        paper: 20-512-512-512-512-1, the default; released: 20-512-512-512-128-1; linear: Tolles-Lawson terms
        by ridge regression; hybrid: a linear base and a small network for what it leaves, kept only where it
        does better on validation; ensemble: small networks with a mean and a variance each; tcn: a small
        temporal network that looks back over rows.
    layers
        Widths of the hidden layers in place of the model's, as 256,256.
    features
        Set of inputs, or names with commas between; full, the paper's 20, unless given, circular of a linear
        model, platform of a hybrid, gradient of an ensemble and a tcn.
    members
        Networks of an ensemble; 5 unless given.
    kernel
        Rows that each layer of a tcn looks at, each twice as far apart as in the one before; 3 unless given.
    penalty
        Of the ridge of a linear model or a hybrid; chosen by cross-validation over recordings unless given.
    weighting
        Whether the ridge weighs rows by how well the map is known there: label_sd, none, or auto, unless
        given: what does better on recordings left out.
    dropout
        Share of units dropped in training; 0.3 unless given, 0.1 of a hybrid.
    epochs
        Passes over the training rows; 20 unless given.
    batch
        Rows a step; 1024 unless given.
    lr
        Largest step size of Adam; 0.001 unless given.
    patience
        Stop after so many epochs without a better one on the validation recordings.
    seed
        Of the split, the first weights, the order of rows and dropout; 0 unless given.
    licence
        Licence of the weights, an SPDX identifier such as MIT.
    split
        Unit kept whole when splitting into training, validation and test: session (default), run or path;
        row leaks between them, and is for comparison only.
    hold_out
        Sessions, runs or paths that are all in the test.
    threads
        Threads to train with; another number gives other bits.
    device
        Where to train: cpu, cuda, or auto, unless given: a GPU where torch sees one.
    init
        Weights to go on from, .safetensors or a released .pth, of the same kind, inputs and layers.
    freeze
        Layers that stay as they are: layers.0 is the first; base that of a hybrid.
    resume
        Go on from F.checkpoint, which a training that was killed left; the weights are those of one that
        was not.
    rrd
        Rerun recording of the learning curve to write, .rrd.
    force
        Replace what exists, an unfinished training too.
    json
        Print the figures as JSON.
    """
    import numpy as np

    from magtwin.figures.learning_curves import (
        plot_learning_curve,
        record_learning_curve,
        write_learning_curve,
    )
    from magtwin.files import check_free, output, sha256
    from magtwin.learn.data.dataset import open_dataset
    from magtwin.learn.data.split import split as split_of
    from magtwin.learn.training.config import TrainConfig, read_config
    from magtwin.learn.training.result import fit

    check_suffix(out, (".safetensors",), "a network")
    card, picture, table, checkpoint = (
        out.with_suffix(end) for end in (".md", ".png", ".csv", ".checkpoint")
    )
    for path in (out, card):
        check_free(path, force=force)
    if checkpoint.exists() and not (resume or force):
        raise InputError(
            f"{checkpoint}: an unfinished training; give --resume to go on with it, or --force to start anew"
        )
    given = {
        "model": model,
        "layers": None if layers is None else _widths(layers),
        "features": features,
        "members": members,
        "kernel": kernel,
        "penalty": penalty,
        "weighting": weighting,
        "dropout": dropout,
        "epochs": epochs,
        "batch": batch,
        "lr": lr,
        "patience": patience,
        "seed": seed,
        "licence": licence,
        "split": split,
        "hold_out": None if hold_out is None else tuple(hold_out),
        "threads": threads,
        "device": device,
        "init": init,
        "freeze": None if freeze is None else tuple(freeze),
    }
    options = _given(TrainConfig() if config is None else read_config(config), given)
    curves = () if options.model == "linear" else (picture, table)
    if rrd is not None:
        check_suffix(rrd, (".rrd",), "a Rerun recording")
        if not curves:
            raise InputError("--rrd: a linear model is fitted at once and has no learning curve")
    for path in (*curves, *([rrd] if rrd else [])):
        check_free(path, force=force)
    step("Reading the data set")
    found = open_dataset(dataset)
    deals, draws = np.random.default_rng(options.seed).spawn(2)
    parts = split_of(found.recordings, options.split, hold_out=options.hold_out, rng=deals)
    with progress("Training", "rows") as show:
        pace = _Pace(show, options.epochs)
        trained = fit(
            options,
            found,
            parts,
            rng=draws,
            checkpoint=checkpoint,
            resume=resume,
            progress=pace.epoch,
            advance=pace.rows,
        )
    step("Writing the model")
    if trained.history:
        naive = trained.parts[0].naive_rmse_nt
        plot_learning_curve(trained.history, picture, naive_rmse_nt=naive, title=out.name, force=force)
        write_learning_curve(trained.history, table, force=force)
        if rrd is not None:
            record_learning_curve(trained.history, rrd, naive_rmse_nt=naive, title=out.name, force=force)
    trained.net.save(out, force=force)
    with output(card, force=force) as aside:
        aside.write_text(trained.card(out.name, sha256(out)), encoding="utf-8")
    checkpoint.unlink(missing_ok=True)
    print_report(trained.report(str(out)), json)
    if not json:
        say(f"Wrote {', '.join([str(out), card.name, *(path.name for path in curves if trained.history)])}")


class _Pace:
    """What is reported of a training: rows that are done, and the last epoch's error on validation."""

    def __init__(self, show: Any, epochs: int | None) -> None:
        self.show, self.epochs, self.ended, self.begun = show, epochs, "", 1

    def rows(self, done: int, total: int) -> None:
        """Rows that are done, of those of all epochs."""
        epochs = "" if self.epochs is None else f" of {self.epochs}"
        self.show(done, total, f"epoch {self.begun}{epochs}{self.ended}")

    def epoch(self, epoch: "Epoch") -> None:
        """An epoch that has ended."""
        self.begun = epoch.number + (self.epochs is None or epoch.number < self.epochs)
        self.ended = f", validation {epoch.val_rmse_nt:.1f} nT RMS"


def _widths(text: str) -> tuple[int, ...]:
    """Widths of layers from words such as 256,256."""
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"--layers are whole numbers with commas between, got {text!r}") from None


def _given(config: "TrainConfig", options: dict[str, Any]) -> "TrainConfig":
    """A configuration with the options that were given in place of its own."""
    found = {name: value for name, value in options.items() if value is not None}
    if {"model", "layers"} <= set(found) and found["model"] in ("paper", "released"):
        raise InputError("--model and --layers both say the widths; give one of them")
    return config.with_options(**found)
