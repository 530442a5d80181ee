"""Trained: a network from a data set, how it does on recordings that it never saw, and what repeats it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.files import sha256
from magtwin.learn.config import TrainConfig
from magtwin.learn.dataset import MANIFEST, Dataset
from magtwin.learn.magnetometer import NeuralMagnetometer
from magtwin.learn.model import Fact, FieldNet, load_net
from magtwin.learn.recording import Rows
from magtwin.learn.split import PARTS, Split
from magtwin.learn.train import Epoch, train
from magtwin.names import RefusedError
from magtwin.report import Figure, Report
from magtwin.version import __version__

Array = NDArray[np.float64]

MOST_PATHS = 40
"""Paths that a card tells of one by one."""


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

    before_mae_nt: float
    """Of the network that was gone on from; nan where there was none."""

    @property
    def ratio(self) -> float:
        """The network's mean absolute error by the naive one, as in the paper's Table 1."""
        return self.mae_nt / self.naive_mae_nt if self.naive_mae_nt else math.inf


@dataclass(frozen=True)
class Trained:
    """A network with all that its card tells."""

    net: FieldNet
    """In evaluation mode; `residual_sd_nt` is its error on the test, `facts` repeat it."""

    config: TrainConfig
    history: tuple[Epoch, ...]
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

    @property
    def best(self) -> Epoch:
        """The epoch whose weights were kept."""
        return next(epoch for epoch in reversed(self.history) if epoch.best)

    def report(self, title: str) -> Report:
        """Rows, epochs, and errors against the naive ones."""
        figures = [
            Figure("layers", "-".join(str(n) for n in (len(self.net.features), *self.net.hidden, 1))),
            Figure("parameters", self.net.parameters_count),
            Figure("training rows", self.rows),
            Figure("epochs", self.history[-1].number, note=f"kept {self.best.number}"),
            Figure("training RMSE", self.best.train_rmse_nt, "nT", note=f"in epoch {self.best.number}"),
        ]
        for one in self.parts:
            figures += [
                Figure(f"{one.name} rows", one.rows, note=f"{one.recordings} recordings"),
                Figure(f"{one.name} MAE", one.mae_nt, "nT"),
                Figure(f"{one.name} RMSE", one.rmse_nt, "nT"),
                Figure(f"{one.name} naive MAE", one.naive_mae_nt, "nT", note="the mean training label"),
                Figure(f"{one.name} ratio", one.ratio, note="MAE by naive MAE"),
            ]
            if not math.isnan(one.before_mae_nt):
                figures.append(Figure(f"{one.name} MAE before", one.before_mae_nt, "nT"))
        facts = {name: fact for name, fact in self.net.facts.items() if name != "config"}
        return Report(title, tuple(figures), facts)

    def card(self, name: str, checksum: str) -> str:
        """The model card, in Markdown.

        Args:
            name: Of the weights file.
            checksum: Its SHA-256.
        """
        facts = self.net.facts
        layers = "-".join(str(n) for n in (len(self.net.features), *self.net.hidden, 1))
        before = self.config.init is not None
        heads = ["rows of", "recordings", "rows", "MAE", "RMSE", "naive MAE", "naive RMSE", "MAE / naive"]
        heads += ["MAE before"] if before else []
        table = [_line(heads), _line(["---"] * len(heads))]
        shown = self.paths[:MOST_PATHS] if len(self.paths) > 1 else ()
        for one in (*self.parts, *shown):
            errors = (one.mae_nt, one.rmse_nt, one.naive_mae_nt, one.naive_rmse_nt)
            cells = [one.name, f"{one.recordings:,}", f"{one.rows:,}", *(f"{e:.1f}" for e in errors)]
            table.append(
                _line([*cells, f"{one.ratio:.3f}", *([f"{one.before_mae_nt:.1f}"] if before else [])])
            )
        if len(self.paths) > MOST_PATHS:
            table.append(f"\nThe first {MOST_PATHS} of {len(self.paths)} paths are shown.")
        counts = ", ".join(f"{len(self.split.names(part))} in {part}" for part in PARTS)
        names = ", ".join(self.split.test[:MOST_PATHS])
        names += f" and {len(self.split.test) - MOST_PATHS} more" if len(self.split.test) > MOST_PATHS else ""
        warning = f"\n**Warning: {self.split.leak}.**\n" if self.split.leak else ""
        gone_on = ""
        if before:
            kept = ", ".join(self.config.freeze) or "no layer"
            gone_on = (
                f"\nIt goes on from `{facts['init']}` (SHA-256 `{facts['init_sha256']}`), {kept} frozen."
            )
        return f"""# {name}

Predicts what a robot adds to a map of the magnetic field at its magnetometer [nT]. A multilayer perceptron
{layers}, {self.net.parameters_count:,} parameters, float32. SHA-256 `{checksum}`.{gone_on}
Inputs: {", ".join(self.net.features)}.
{warning}
## Data

* Data set `{_plain(str(facts["dataset"]))}`, SHA-256 of its manifest `{facts["dataset_sha256"]}`.
* Labelled on the map `{_plain(str(facts["map"]))}`, SHA-256 `{facts["map_sha256"]}`: what was measured less
  the map, at a lever arm of {facts["lever_arm_m"]} m and a latency of {facts["latency_s"]:g} s.
* {self.rows:,} training rows, labels {self.label_mean_nt:.1f} +- {self.label_sd_nt:.1f} nT.
* Recordings split by {self.split.by}: {counts}.
* Test: {names}.

## Errors

Of the total field at the sensor [nT]. Naive: the mean training label on every row. Validation chose the
epoch that was kept, {self.best.number} of {self.history[-1].number}; the test was looked at once.

{chr(10).join(table)}

The file keeps the RMSE of the test as `residual_sd_nt`; it is the `b_sd_nt` of a Run. Rows of a recording are
alike: the spread of these errors is that between recordings, not between rows.

## To repeat it

magtwin {facts["magtwin"]}, torch {facts["torch"]}, with --threads {facts["threads"]}, and as `F.toml` in
`magtwin train {_plain(str(facts["dataset"]))} --config F.toml --out {name}`:

```toml
{str(facts["config"]).rstrip()}
```
"""


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
    """Train a network on a part of a data set, stop by another, judge by the third.

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
        RefusedError: A part without rows, a data set without a column that a feature is made of, or what
            `train` refuses.
    """
    for part in PARTS:
        if not split.names(part):
            raise RefusedError(f"no recording is in {part}; record more, or hold out fewer")
    init = None if config.init is None else load_net(config.init)
    of = {part: dataset.rows(config.inputs, split=split, part=part) for part in PARTS}
    learned, stops = of["train"], of["validation"]
    before = torch.get_num_threads()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    try:
        net, history = train(
            learned.x,
            learned.y,
            stops.x,
            stops.y,
            rng=rng,
            features=config.inputs,
            layers=config.hidden,
            dropout=config.dropout,
            epochs=config.epochs,
            batch=config.batch,
            lr=config.lr,
            patience=config.patience,
            facts=_facts(config, dataset, split, len(learned.y)),
            init=init,
            freeze=config.freeze,
            checkpoint=checkpoint,
            resume=resume,
            progress=progress,
            advance=advance,
        )
    finally:
        torch.set_num_threads(before)
    mean = float(learned.y.mean())
    models = [NeuralMagnetometer(one) for one in (net, init) if one is not None]
    parts = tuple(_judged(part, of[part], models, mean)[0] for part in PARTS[1:])
    path_of = {one.name: one.path for one in dataset.recordings}
    _, *paths = _judged("test", of["test"], models, mean, [path_of[name] for name in of["test"].names])
    net.residual_sd_nt = parts[-1].rmse_nt
    kept = next(epoch for epoch in reversed(history) if epoch.best)
    net.facts |= {"epochs_run": history[-1].number, "epoch_kept": kept.number}
    for one in parts:
        net.facts |= {f"{one.name}_mae_nt": one.mae_nt, f"{one.name}_naive_mae_nt": one.naive_mae_nt}
    sd = float(learned.y.std())
    return Trained(net, config, history, split, parts, tuple(paths), mean, sd, len(learned.y))


def _judged(
    name: str, rows: Rows, models: Sequence[NeuralMagnetometer], mean: float, paths: Sequence[str] = ()
) -> list[Judged]:
    """Errors on all rows, and on those of each path: `paths` of the recordings of `rows`."""
    naive = mean - rows.y
    errors = [model.predict(rows.x) - rows.y for model in models]
    masks = {name: np.ones(len(rows.y), bool)}
    for path in dict.fromkeys(paths):
        on_it = np.array([one == path for one in paths])[rows.recording]
        if on_it.any():
            masks[f"{name}, path {path}"] = on_it
    return [
        Judged(
            what,
            len(np.unique(rows.recording[mask])),
            int(mask.sum()),
            _mae(errors[0][mask]),
            _rmse(errors[0][mask]),
            _mae(naive[mask]),
            _rmse(naive[mask]),
            _mae(errors[1][mask]) if len(errors) > 1 else math.nan,
        )
        for what, mask in masks.items()
    ]


def _facts(config: TrainConfig, dataset: Dataset, split: Split, rows: int) -> dict[str, Fact]:
    """What repeats a training, for the weights file."""
    lever = dataset.alignment
    told = config if config.init is None else replace(config, init=Path(config.init.name))
    facts: dict[str, Fact] = {"warning": split.leak} if split.leak else {}
    facts |= {
        "dataset": dataset.folder.resolve().name,
        "dataset_sha256": sha256(dataset.folder / MANIFEST),
        "map": dataset.map_name,
        "map_sha256": dataset.map_sha256,
        "lever_arm_m": ", ".join(f"{c:g}" for c in lever.lever_arm_m),
        "latency_s": lever.latency_s,
        "config": told.to_toml(),
        "seed": config.seed,
        "split": split.by,
        "training_rows": rows,
        "threads": config.threads or torch.get_num_threads(),
        "torch": str(torch.__version__),
        "magtwin": __version__,
    }
    if config.init is not None:
        facts |= {"init": config.init.name, "init_sha256": sha256(config.init)}
    return facts


def _mae(error: Array) -> float:
    return float(np.mean(np.abs(error)))


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _plain(text: str) -> str:
    """A name from a data set, without what would end a cell, a line or a code of Markdown."""
    return "".join(" " if c in "|`<>" or not c.isprintable() else c for c in text)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(map(_plain, cells))} |"
