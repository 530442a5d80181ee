"""Train a model on a data set and measure its errors on recordings that it never saw."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.files.outputs import check_free, output, transaction
from magtwin.learn.data.dataset import MANIFEST, Dataset, open_dataset
from magtwin.learn.data.features import CIRCULAR, FEATURES
from magtwin.learn.data.origin import NOMINAL, ROBOT_METADATA
from magtwin.learn.data.recording import Rows
from magtwin.learn.data.residuals import HeldOut, held_out_errors, residuals
from magtwin.learn.data.split import PARTS, Part, Split
from magtwin.learn.data.split import split as split_recordings
from magtwin.learn.models.linear import fit_linear
from magtwin.learn.models.predictor import (
    OWN_MODULE,
    PREDICTORS,
    Epoch,
    Fit,
    FitTask,
    Predictor,
    load_predictor,
)
from magtwin.learn.models.weights import MetadataValue
from magtwin.learn.training.config import TrainConfig
from magtwin.learn.training.result import PartErrors, TrainingResult, model_card
from magtwin.report.verdict import SEPARATOR, coverage, recordings_text
from magtwin.version import __version__

Array = NDArray[np.float64]

ORIGIN = (
    *("map_method", "map_height_m", "map_extent_m", "map_samples_nt", "alignment", "poses"),
    *ROBOT_METADATA,
)
"""Metadata of a data set that weights keep."""

RowsOf = Mapping[Part, Rows]
Groups = Mapping[Part, NDArray[np.intp]]


def train(
    dataset: Dataset | str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    config: TrainConfig | None = None,
    force: bool = False,
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
    **options: Any,
) -> TrainingResult:
    """Train a model and measure its errors on recordings that it never saw.

    Args:
        dataset: Labelled recordings, or the folder of a data set.
        out: Weights file to write, .safetensors. The model card is written beside it as .md.
        config: Model and options. Default: the paper's network.
        force: Replace existing files.
        progress: Called after each epoch.
        advance: Called after each step with the rows done and the rows of all epochs.
        **options: Fields of `TrainConfig`, such as model="hybrid" or seed=3. They override `config`. `model`
            may also be a `torch.nn.Module` of your own: its class, which is called with the number of
            features, or an instance. It gets standardised features, shape (N, F), and gives the standardised
            disturbance, shape (N,) or (N, 1), or (N, 2) with the logarithm of its standard deviation; see
            `magtwin.learn.training.own`.

    Raises:
        InputError: The recordings do not suffice, the data set lacks a column of a feature, an option does
            not fit the model, or a file exists.
    """
    module = options.get("model")
    if isinstance(module, str | None):
        module = None
        if options.get("model", config and config.model) == OWN_MODULE:
            raise InputError("model 'module' is a torch module of your own: give its class, `model=MyModule`")
    else:
        options["model"] = OWN_MODULE
    config = (config or TrainConfig()).with_options(**options)
    for path in () if out is None else (Path(out), Path(out).with_suffix(".md")):
        check_free(path, force=force)
    dataset = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    deals, draws = np.random.default_rng(config.seed).spawn(2)
    parts = split_recordings(dataset.recordings, config.split, hold_out=config.hold_out, rng=deals)
    result = fit(config, dataset, parts, rng=draws, module=module, progress=progress, advance=advance)
    if out is not None:
        out = Path(out)
        with (
            transaction(),
            output(out, force=force) as weights,
            output(out.with_suffix(".md"), force=force) as card,
        ):
            result.predictor.save(weights)
            card.write_text(model_card(result, out.name, sha256(weights)), encoding="utf-8")
    return result


def fit(
    config: TrainConfig,
    dataset: Dataset,
    split: Split,
    *,
    rng: np.random.Generator,
    module: Any = None,
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> TrainingResult:
    """Train on one part of a data set, stop and calibrate by another, judge by the third.

    Of `config`, `seed`, `split` and `hold_out` are not read; `rng` draws initial weights, order and dropout.
    `module` is the user's own torch module, if the kind is that.
    """
    threads, before = config.threads or 1, torch.get_num_threads()
    with threadpool_limits(threads):  # the products of numpy and scipy
        torch.set_num_threads(threads)
        try:
            return _fit(config, dataset, split, rng, module, progress, advance)
        finally:
            torch.set_num_threads(before)


def _fit(
    config: TrainConfig,
    dataset: Dataset,
    split: Split,
    rng: np.random.Generator,
    module: Any,
    progress: Callable[[Epoch], None] | None,
    advance: Callable[[int, int], None] | None,
) -> TrainingResult:
    """As `fit`, with threads set."""
    rows, groups = _read(dataset, split, config.inputs)
    init = None if config.init is None else load_predictor(config.init)
    if init is not None and init.kind != config.kind:
        raise InputError(
            f"{config.init}: holds a {init.kind}, but the training is of a {config.kind}; continue from "
            f"another file, or train with --model {'paper' if init.kind == 'mlp' else init.kind}"
        )
    device = device_of(config)
    recordings = {recording.name: recording for recording in dataset.recordings}
    task = FitTask(
        features=config.inputs,
        train=rows["train"],
        validation=rows["validation"],
        train_groups=groups["train"],
        validation_groups=groups["validation"],
        options=config.options if module is None else {**config.options, "module": module},
        rng=rng,
        recordings=recordings,
        init=init,
        device=device,
        progress=progress,
        advance=advance,
    )
    fitted = PREDICTORS[config.kind].fit(task)
    predictor, labels = fitted.model, task.train.y
    mean = float(labels.mean())
    ridge = _ridge(dataset, rows, groups["train"])
    parts = tuple(_errors(part, rows[part], ridge[part], predictor, mean)[0] for part in PARTS[1:])
    driven = [recordings[name].path for name in rows["test"].names]
    _, *paths = _errors("test", rows["test"], ridge["test"], predictor, mean, driven)
    learned, tested = ([recordings[name] for name in split.names(part)] for part in ("train", "test"))
    sessions = dict.fromkeys(recording.session for recording in learned)
    ways = dict.fromkeys(recording.path for recording in learned)
    plants = dict.fromkeys(recording.plant or NOMINAL for recording in learned)
    predictor.residual_sd_nt = parts[-1].rmse_nt
    predictor.metadata.update(_provenance(config, dataset, split, len(labels), device))
    predictor.metadata.update(_outcome(fitted, parts))
    predictor.metadata.update(
        label_mean_nt=mean,
        label_sd_nt=float(labels.std()),
        training_sessions=SEPARATOR.join(sessions),
        training_paths=SEPARATOR.join(ways),
    )
    predictor.metadata.update(residuals(_held_out(rows, dataset, fitted)))
    if config.kind != "mixed" and set(plants) != {NOMINAL}:  # the mean of a mixed model is that of NOMINAL
        predictor.metadata["training_plants"] = SEPARATOR.join(plants)
    return TrainingResult(
        predictor=predictor,
        config=config,
        history=fitted.history,
        split=split,
        parts=parts,
        paths=tuple(paths),
        judged_on=recordings_text(
            len(tested), [test.session for test in tested], [test.path for test in tested], sessions, ways
        ),
    )


def _outcome(fitted: Fit, parts: Sequence[PartErrors]) -> dict[str, MetadataValue]:
    """Metadata about epochs and errors."""
    metadata: dict[str, MetadataValue] = {}
    if fitted.history:
        kept = next(epoch for epoch in reversed(fitted.history) if epoch.best)
        metadata |= {"epochs_run": fitted.history[-1].number, "epoch_kept": kept.number}
    for part in parts:
        names = ("mae_nt", "naive_mae_nt", "ridge_mae_nt")
        metadata |= {f"{part.name}_{name}": getattr(part, name) for name in names}
        if math.isfinite(part.coverage):
            metadata[f"{part.name}_coverage_90"] = part.coverage
    return metadata


def device_of(config: TrainConfig) -> str:
    """Where torch trains: "cpu" or "cuda"; a GPU that torch does not see is refused."""
    if config.device == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: this torch sees no GPU; install one that does, or take `device=auto`")
    return "cuda" if config.device != "cpu" and torch.cuda.is_available() else "cpu"


def _read(dataset: Dataset, split: Split, inputs: tuple[str, ...]) -> tuple[RowsOf, Groups]:
    """Rows of each part, and the session, recording or path of each row, by what the split keeps whole."""
    for part in PARTS:
        if not split.names(part):
            raise InputError(f"no recording is in {part}; record more, or hold out fewer")
    terms = _ridge_terms(dataset)
    rows = {part: dataset.rows(inputs, split=split, part=part, beside=terms) for part in PARTS}
    unit = {
        recording.name: {"session": recording.session, "path": recording.path}.get(split.by, recording.name)
        for recording in dataset.recordings
    }
    if len({unit[name] for name in rows["train"].names}) == 1:  # cross-validation needs two groups
        unit = {name: name for name in unit}
    numbers = {name: i for i, name in enumerate(sorted(set(unit.values())))}
    groups = {
        part: np.array([numbers[unit[name]] for name in of.names], np.intp)[of.recording]
        for part, of in rows.items()
    }
    return rows, groups


def _ridge_terms(dataset: Dataset) -> tuple[str, ...]:
    """Features of the comparison ridge that a data set has the columns for."""
    return tuple(name for name in CIRCULAR if set(FEATURES[name].columns) <= set(dataset.columns))


def _ridge(dataset: Dataset, rows: RowsOf, groups: NDArray[np.intp]) -> dict[Part, Array]:
    """Disturbances [nT] by Tolles and Lawson's terms, as far as the data set has them, for each part.

    They are fitted to the training rows. An input that is nan counts as its mean.
    """
    known = np.isfinite(rows["train"].beside)
    mean = np.where(known, rows["train"].beside, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    x = {part: np.where(np.isfinite(of.beside), of.beside, mean) for part, of in rows.items()}
    y, sd = rows["train"].y, rows["train"].sd
    model = fit_linear(x["train"], y, groups, features=_ridge_terms(dataset), sd=sd).model
    return {part: model.predict(of)[0] for part, of in x.items()}


def _held_out(rows: RowsOf, dataset: Dataset, fitted: Fit) -> list[HeldOut]:
    """Errors on validation and test, and on training if each of its groups was left out of a fit in turn."""
    errors = []
    for part, of in rows.items():
        predicted = fitted.held_out_nt if part == "train" else fitted.model.predict(of.x)[0]
        if predicted is not None:
            errors += held_out_errors(of, predicted - of.y, dataset.recordings)
    return errors


def _errors(
    part: Part, rows: Rows, ridge: Array, model: Predictor, mean: float, paths: Sequence[str] = ()
) -> list[PartErrors]:
    """Errors on all rows of a part, then on those of each path; `paths` are those of its recordings."""
    predicted, sd = model.predict(rows.x)
    errors = (predicted - rows.y, mean - rows.y, ridge - rows.y)
    masks = {str(part): np.ones(len(rows.y), bool)}
    for path in dict.fromkeys(paths):
        on_path = np.array([name == path for name in paths])[rows.recording]
        if on_path.any():
            masks[f"{part}, path {path}"] = on_path
    return [
        PartErrors(
            name,
            len(np.unique(rows.recording[mask])),
            int(mask.sum()),
            *_sizes(errors[0][mask]),
            *_sizes(errors[1][mask]),
            *_sizes(errors[2][mask]),
            coverage(errors[0][mask], sd[mask]),
        )
        for name, mask in masks.items()
    ]


def _provenance(
    config: TrainConfig, dataset: Dataset, split: Split, rows: int, device: str
) -> Mapping[str, MetadataValue]:
    """Metadata that reproduce a training."""
    stored = config if config.init is None else replace(config, init=Path(config.init.name))
    metadata: dict[str, MetadataValue] = {"warning": split.leak} if split.leak else {}
    metadata |= {
        "dataset": dataset.folder.resolve().name,
        "dataset_sha256": sha256(dataset.folder / MANIFEST),
        "map": dataset.map_name,
        "map_sha256": dataset.map_sha256,
        "lever_arm_m": ", ".join(f"{c:g}" for c in dataset.alignment.lever_arm_m),
        "lever_arm_sd_m": ", ".join(f"{c:g}" for c in dataset.alignment.lever_arm_sd_m),
        "latency_s": dataset.alignment.latency_s,
        "latency_sd_s": dataset.alignment.latency_sd_s,
        **{name: dataset.metadata[name] for name in ORIGIN if name in dataset.metadata},
        "config": stored.to_toml(),
        "seed": config.seed,
        "split": split.by,
        "training_rows": rows,
        "magtwin": __version__,
    }
    if config.kind not in ("linear", "mixed"):
        metadata |= {"threads": config.threads or 1, "torch": str(torch.__version__), "device": device}
    if config.licence:
        metadata["licence"] = config.licence
    if config.init is not None:
        metadata |= {"init": config.init.name, "init_sha256": sha256(config.init)}
    return metadata


def _sizes(error: Array) -> tuple[float, float]:
    """Mean absolute and root mean square error."""
    return float(np.mean(np.abs(error))), float(np.sqrt(np.mean(error**2)))
