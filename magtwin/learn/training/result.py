"""Trained: a network from a data set, how it does on recordings that it never saw, and what repeats it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.files import sha256
from magtwin.learn.data.dataset import MANIFEST, Dataset
from magtwin.learn.data.origin import ROBOT_FACTS
from magtwin.learn.data.residuals import Held, held_of, residuals
from magtwin.learn.data.split import PARTS, Part, Split
from magtwin.learn.models.descent import Epoch
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.learn.models.weights import Fact, shown
from magtwin.learn.training.config import TrainConfig
from magtwin.learn.training.fitters import Choice, Made, device_of, make
from magtwin.learn.training.model_card import card_of
from magtwin.learn.training.training_data import Material, material
from magtwin.report import Figure, Report
from magtwin.summary import Summarized, Summary
from magtwin.verdict import SEPARATOR, coverage, recordings_text, verdict
from magtwin.version import __version__

Array = NDArray[np.float64]

ORIGIN = (
    *("map_method", "map_height_m", "map_extent_m", "map_samples_nt", "alignment", "poses"),
    *ROBOT_FACTS,
)
"""Metadata of a data set that weights keep."""


@dataclass(frozen=True)
class Judged:
    """Errors on some rows [nT]; naive is the mean training label on every row."""

    name: str
    """The part, or the path."""

    recordings: int
    rows: int
    mae_nt: float
    rmse_nt: float
    naive_mae_nt: float
    naive_rmse_nt: float

    ridge_mae_nt: float
    """Of Tolles and Lawson's terms by ridge regression, on the same rows."""

    ridge_rmse_nt: float

    coverage: float
    """Share of rows within the predicted interval of 90 %."""

    before_mae_nt: float
    """Of the network that was gone on from; nan where there was none."""

    @property
    def ratio(self) -> float:
        """The network's mean absolute error by the naive one, as in the paper's Table 1."""
        return self.mae_nt / self.naive_mae_nt if self.naive_mae_nt else math.inf


@dataclass(frozen=True, repr=False)
class Trained(Summarized):
    """A network with all that its card tells."""

    net: Predictor
    """`residual_sd_nt` is its error on the test, `metadata` repeat it."""

    config: TrainConfig
    history: tuple[Epoch, ...]
    """Its epochs; none of a model that is fitted at once."""

    choice: Choice | None
    """Whether a hybrid keeps its network."""

    split: Split

    parts: tuple[Judged, ...]
    """Validation, which ended the training, and test, which nothing else has looked at."""

    paths: tuple[Judged, ...]
    """The test by path."""

    label_mean_nt: float
    """Mean of the training labels [nT]: the naive prediction."""

    label_sd_nt: float
    """Their standard deviation [nT]."""

    rows: int
    """Training rows."""

    judged_on: str
    """What the test is of, and how much of it was not in the training."""

    @property
    def best(self) -> Epoch | None:
        """The epoch whose weights were kept; none where there was no epoch."""
        return next((epoch for epoch in reversed(self.history) if epoch.best), None)

    def report(self, title: str) -> Report:
        """Rows, epochs, and errors against the naive ones."""
        figures = [
            Figure("kind", self.net.kind),
            Figure("layers", self.net.layers_text),
            Figure("parameters", self.net.parameters_count),
            Figure("training rows", self.rows),
        ]
        if (best := self.best) is not None:
            figures += [
                Figure("epochs", self.history[-1].number, note=f"kept {best.number}"),
                Figure("training RMSE", best.train_rmse_nt, "nT", note=f"in epoch {best.number}"),
            ]
        if self.choice:
            figures += [
                Figure("base alone MAE", self.choice.base_mae_nt, "nT", note="on validation"),
                Figure("with network MAE", self.choice.whole_mae_nt, "nT", note="on validation"),
                Figure("network", "kept" if self.choice.kept else "left out: the base alone does better"),
            ]
        for one in self.parts:
            figures += [
                Figure(f"{one.name} rows", one.rows, note=f"{one.recordings} recordings"),
                Figure(f"{one.name} MAE", one.mae_nt, "nT"),
                Figure(f"{one.name} RMSE", one.rmse_nt, "nT"),
                Figure(f"{one.name} naive MAE", one.naive_mae_nt, "nT", note="the mean training label"),
                Figure(f"{one.name} ridge MAE", one.ridge_mae_nt, "nT", note="Tolles-Lawson terms"),
                Figure(f"{one.name} ratio", one.ratio, note="MAE by naive MAE"),
                Figure(f"{one.name} coverage", one.coverage, note="share within intervals of 90 %"),
            ]
            if not math.isnan(one.before_mae_nt):
                figures.append(Figure(f"{one.name} MAE before", one.before_mae_nt, "nT"))
        metadata = {name: fact for name, fact in shown(self.net.metadata).items() if name != "config"}
        return Report(title, tuple(figures), metadata, self.verdict())

    def verdict(self) -> str:
        """Whether it is better than the naive mean on the test, in one line."""
        test = self.parts[-1]
        return verdict(
            test.mae_nt, test.naive_mae_nt, coverage=test.coverage, judged_on=f"the test, {self.judged_on}"
        )

    def card(self, name: str, checksum: str) -> str:
        """The model card, in Markdown; see `magtwin.learn.training.model_card`."""
        return card_of(self, name, checksum)

    def _summary(self) -> Summary:
        """The model, what it was trained on, and its errors."""
        scores = [
            (
                one.name,
                f"MAE {one.mae_nt:.4g} nT, {one.ratio:.3g} of naive, "
                f"{100 * one.coverage:.3g} % in 90 % intervals, "
                f"{one.rows:,} rows of {one.recordings:,} recordings",
            )
            for one in self.parts
        ]
        return Summary(
            f"Trained: {self.net.kind}, {self.net.layers_text}, {self.rows:,} training rows",
            (("split", f"by {self.split.by}"), *scores),
            ("path", "MAE", "of naive", "rows"),
            [(one.name, f"{one.mae_nt:.4g} nT", f"{one.ratio:.3g}", f"{one.rows:,}") for one in self.paths],
        )


def fit(
    config: TrainConfig,
    dataset: Dataset,
    split: Split,
    *,
    rng: np.random.Generator,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> Trained:
    """Train a model on a part of a data set, stop and calibrate by another, judge by the third.

    Args:
        config: What to do.
        dataset: Labelled recordings.
        split: Which of them are for what.
        rng: Source of the first weights, the order of rows and dropout.
        checkpoint: File that the state of the training is written to after each epoch.
        resume: Go on from `checkpoint`.
        progress: Called after each epoch.
        advance: Called after each step with how many rows are done, and of how many in all epochs.

    Raises:
        InputError: A part without rows, a data set without a column that a feature is made of, or what
            the fit of the model refuses.
    """
    of = material(dataset, split, config.inputs)
    init = None if config.init is None else load_predictor(config.init)
    device = device_of(config)
    going = {"checkpoint": checkpoint, "resume": resume, "progress": progress, "advance": advance}
    before = torch.get_num_threads()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    try:
        made = make(config, of, init, going, rng)
    finally:
        torch.set_num_threads(before)
    net, learned = made.model, of.rows["train"]
    mean, sd = float(learned.y.mean()), float(learned.y.std())
    models = [net] if init is None else [net, init]
    parts = tuple(_judged(of, part, models, mean)[0] for part in PARTS[1:])
    path_of = {one.name: one.path for one in dataset.recordings}
    _, *paths = _judged(of, "test", models, mean, [path_of[name] for name in of.rows["test"].names])
    net.residual_sd_nt = parts[-1].rmse_nt
    net.metadata.update(_metadata(config, dataset, split, len(learned.y), device))
    net.metadata.update(label_mean_nt=mean, label_sd_nt=sd)
    if made.history:
        kept = next(epoch for epoch in reversed(made.history) if epoch.best)
        net.metadata.update(epochs_run=made.history[-1].number, epoch_kept=kept.number)
    if made.choice:
        net.metadata.update(
            network="kept" if made.choice.kept else "left out",
            base_validation_mae_nt=made.choice.base_mae_nt,
            whole_validation_mae_nt=made.choice.whole_mae_nt,
        )
    for one in parts:
        told = {"mae_nt": one.mae_nt, "naive_mae_nt": one.naive_mae_nt, "ridge_mae_nt": one.ridge_mae_nt}
        net.metadata.update({f"{one.name}_{key}": value for key, value in told.items()})
        if math.isfinite(one.coverage):
            net.metadata[f"{one.name}_coverage_90"] = one.coverage
    if (found := residuals(_held_out(of, made))) is not None:
        net.metadata.update(found.metadata())
    known = {one.name: one for one in dataset.recordings}
    mine, tested = ([known[name] for name in split.names(part)] for part in ("train", "test"))
    sessions, driven = ({one.session: None for one in mine}, {one.path: None for one in mine})
    net.metadata.update(training_sessions=SEPARATOR.join(sessions), training_paths=SEPARATOR.join(driven))
    judged_on = recordings_text(
        len(tested), [one.session for one in tested], [one.path for one in tested], sessions, driven
    )
    return Trained(
        net,
        config,
        made.history,
        made.choice,
        split,
        parts,
        tuple(paths),
        mean,
        sd,
        len(learned.y),
        judged_on,
    )


def _held_out(of: Material, made: Made) -> list[Held]:
    """Errors on recordings that the model was not fitted to: those of validation and test, and those of
    training where it was fitted without each of them in turn.
    """
    found = []
    for part in PARTS:
        rows = of.rows[part]
        if part != "train":
            told = of.told(made.model, part)[0]
        elif made.held_out_nt is not None:
            told = made.held_out_nt
        else:
            continue
        found += held_of(rows, told - rows.y, of.dataset.recordings)
    return found


def _judged(
    of: Material, part: Part, models: Sequence[Predictor], mean: float, paths: Sequence[str] = ()
) -> list[Judged]:
    """Errors on all rows of a part, and on those of each path: `paths` of its recordings."""
    rows = of.rows[part]
    naive = mean - rows.y
    ridge = of.ridge_of(part)[0] - rows.y
    told = [of.told(model, part) for model in models]
    errors = [found - rows.y for found, _ in told]
    masks = {str(part): np.ones(len(rows.y), bool)}
    for path in dict.fromkeys(paths):
        on_it = np.array([one == path for one in paths])[rows.recording]
        if on_it.any():
            masks[f"{part}, path {path}"] = on_it
    return [
        Judged(
            what,
            len(np.unique(rows.recording[mask])),
            int(mask.sum()),
            _mae(errors[0][mask]),
            _rmse(errors[0][mask]),
            _mae(naive[mask]),
            _rmse(naive[mask]),
            _mae(ridge[mask]),
            _rmse(ridge[mask]),
            coverage(errors[0][mask], told[0][1][mask]),
            _mae(errors[1][mask]) if len(errors) > 1 else math.nan,
        )
        for what, mask in masks.items()
    ]


def _metadata(config: TrainConfig, dataset: Dataset, split: Split, rows: int, device: str) -> dict[str, Fact]:
    """What repeats a training, for the weights file."""
    lever = dataset.alignment
    told = config if config.init is None else replace(config, init=Path(config.init.name))
    metadata: dict[str, Fact] = {"warning": split.leak} if split.leak else {}
    metadata |= {
        "dataset": dataset.folder.resolve().name,
        "dataset_sha256": sha256(dataset.folder / MANIFEST),
        "map": dataset.map_name,
        "map_sha256": dataset.map_sha256,
        "lever_arm_m": ", ".join(f"{c:g}" for c in lever.lever_arm_m),
        "latency_s": lever.latency_s,
        **{name: dataset.metadata[name] for name in ORIGIN if name in dataset.metadata},
        "config": told.to_toml(),
        "seed": config.seed,
        "split": split.by,
        "training_rows": rows,
        "magtwin": __version__,
    }
    if config.kind != "linear":
        threads = config.threads or torch.get_num_threads()
        metadata |= {"threads": threads, "torch": str(torch.__version__), "device": device}
    if config.licence:
        metadata["licence"] = config.licence
    if config.init is not None:
        metadata |= {"init": config.init.name, "init_sha256": sha256(config.init)}
    return metadata


def _mae(error: Array) -> float:
    return float(np.mean(np.abs(error)))


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))
