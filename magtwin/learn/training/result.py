"""TrainingResult: a trained model, its errors on recordings that it never saw, and its card in Markdown."""

import math
import textwrap
from dataclasses import dataclass

from magtwin.learn.data.split import PARTS, Split
from magtwin.learn.models.predictor import PREDICTORS, Epoch, Predictor
from magtwin.learn.models.weights import shown
from magtwin.learn.training.config import TrainConfig
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary
from magtwin.report.verdict import verdict

MOST_NAMES = 40  # Most paths, and most test recordings, that a card lists


@dataclass(frozen=True)
class PartErrors:
    """Errors on some rows [nT]; the naive prediction is the mean training label."""

    name: str
    """The part, or the path."""

    recordings: int
    rows: int
    mae_nt: float
    rmse_nt: float
    naive_mae_nt: float
    naive_rmse_nt: float

    ridge_mae_nt: float
    """MAE of Tolles and Lawson's terms by ridge regression, on the same rows."""

    ridge_rmse_nt: float

    coverage: float
    """Share of rows within the predicted 90 % interval."""

    @property
    def ratio(self) -> float:
        """MAE divided by the naive MAE (lower is better), as in the paper's Table 1."""
        return self.mae_nt / self.naive_mae_nt if self.naive_mae_nt else math.inf


@dataclass(frozen=True, repr=False)
class TrainingResult(Summarized):
    """A trained model with its errors and everything that reproduces it."""

    predictor: Predictor
    """The model. `residual_sd_nt` is its RMSE on the test; `metadata` reproduce it."""

    config: TrainConfig
    history: tuple[Epoch, ...]
    """Its epochs; empty if it is fitted at once."""

    split: Split

    parts: tuple[PartErrors, ...]
    """Errors on validation, which stops the training, and on the test, which nothing else uses."""

    paths: tuple[PartErrors, ...]
    """Errors on the test by path."""

    judged_on: str
    """The test recordings in words, and how many of their sessions and paths are new."""

    @property
    def best(self) -> Epoch | None:
        """The epoch whose weights are kept; None if there was no epoch."""
        return next((epoch for epoch in reversed(self.history) if epoch.best), None)

    def report(self, title: str) -> Report:
        """Rows, epochs, and errors beside the naive ones."""
        figures = [
            Figure("kind", self.predictor.kind),
            Figure("layers", self.predictor.layers_text),
            Figure("parameters", self.predictor.parameters_count),
            Figure("training rows", self.predictor.metadata["training_rows"]),
        ]
        if (best := self.best) is not None:
            figures += [
                Figure("epochs", self.history[-1].number, note=f"kept {best.number}"),
                Figure("training RMSE", best.train_rmse_nt, "nT", note=f"in epoch {best.number}"),
            ]
        if "network" in (told := self.predictor.metadata):
            figures += [
                Figure("base alone MAE", told["base_validation_mae_nt"], "nT", note="on validation"),
                Figure("with network MAE", told["whole_validation_mae_nt"], "nT", note="on validation"),
                Figure("network", told["network"]),
            ]
        for errors in self.parts:
            figures += [
                Figure(f"{errors.name} rows", errors.rows, note=f"{errors.recordings} recordings"),
                Figure(f"{errors.name} MAE", errors.mae_nt, "nT"),
                Figure(f"{errors.name} RMSE", errors.rmse_nt, "nT"),
                Figure(f"{errors.name} naive MAE", errors.naive_mae_nt, "nT", note="the mean training label"),
                Figure(f"{errors.name} ridge MAE", errors.ridge_mae_nt, "nT", note="Tolles-Lawson terms"),
                Figure(f"{errors.name} ratio", errors.ratio, note="MAE divided by naive MAE"),
                Figure(f"{errors.name} coverage", errors.coverage, note="share within intervals of 90 %"),
            ]
        metadata = {name: value for name, value in shown(self.predictor.metadata).items() if name != "config"}
        return Report(title, tuple(figures), metadata, self.verdict())

    def verdict(self) -> str:
        """Whether it is better than the naive mean on the test, in one line."""
        test = self.parts[-1]
        return verdict(
            test.mae_nt, test.naive_mae_nt, coverage=test.coverage, judged_on=f"the test, {self.judged_on}"
        )

    def _summary(self) -> Summary:
        rows = [
            (
                one.name,
                f"MAE {one.mae_nt:.4g} nT, {one.ratio:.3g} of naive, "
                f"{100 * one.coverage:.3g} % in 90 % intervals, {one.rows:,} rows",
            )
            for one in (*self.parts, *self.paths)
        ]
        return Summary(f"TrainingResult: {self.predictor.kind}, {self.predictor.layers_text}", tuple(rows))


def model_card(result: TrainingResult, name: str, checksum: str) -> str:
    """The card of a trained model, whose weights file has a name and a SHA-256."""
    predictor, metadata = result.predictor, result.predictor.metadata
    what = (
        "Predicts what a robot adds to a map of the magnetic field at its magnetometer [nT]. "
        f"{PREDICTORS[predictor.kind].description}: {predictor.layers_text}, "
        f"{predictor.parameters_count:,} parameters. SHA-256 `{checksum}`."
    )
    if result.config.licence:
        what += f" Licence: {result.config.licence}."
    if result.config.init is not None:
        what += f" It continues from `{metadata['init']}` (SHA-256 `{metadata['init_sha256']}`)."
    parts = [
        f"# {name}",
        _wrapped(what),
        _wrapped(f"Inputs: {', '.join(predictor.features)}."),
        _wrapped(f"**Warning: {result.split.leak}.**") if result.split.leak else "",
        "## Data",
        _data(result),
        "## Errors",
        _wrapped(f"**{result.verdict()}**"),
        _wrapped(_how(result)),
        _table(result),
        _wrapped(_spread(predictor.kind)),
        "## To reproduce it",
        _reproduce(result, name),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def widened_card(card: str, before: str, after: str, predictor: Predictor) -> str:
    """The card of a model that `magtwin model widen` made of another: its card with the new SHA-256."""
    robots, readings = (predictor.metadata[f"wide_{name}"] for name in ("robots", "readings"))
    sd = 0.0 if predictor.wide is None else predictor.wide.mean_nt
    text = (
        f"On robots other than that of its training the standard deviation is {sd:.0f} nT (root mean square "
        f"of training rows). `magtwin model widen` learned it from {readings:,} readings of {robots} "
        "robots."
    )
    return f"{card.replace(before, after)}\n## On other robots\n\n{_wrapped(text)}\n"


def _data(result: TrainingResult) -> str:
    metadata, split = result.predictor.metadata, result.split
    counts = ", ".join(f"{len(split.names(part))} in {part}" for part in PARTS)
    names = ", ".join(split.test[:MOST_NAMES])
    names += f" and {len(split.test) - MOST_NAMES} more" if len(split.test) > MOST_NAMES else ""
    dataset, field = (_plain(str(metadata[key])) for key in ("dataset", "map"))
    label = f"{metadata['label_mean_nt']:.1f} +- {metadata['label_sd_nt']:.1f} nT"
    points = (
        f"Data set `{dataset}`, SHA-256 of its manifest `{metadata['dataset_sha256']}`.",
        f"Labelled on the map `{field}`, SHA-256 `{metadata['map_sha256']}`: measured field minus map, "
        f"at a lever arm of {metadata['lever_arm_m']} m and a latency of {metadata['latency_s']:g} s "
        f"(standard deviations {metadata['lever_arm_sd_m']} m and {metadata['latency_sd_s']:g} s).",
        f"{metadata['training_rows']:,} training rows, labels {label}.",
        f"Recordings split by {split.by}: {counts}.",
        f"Test: {names}.",
    )
    return "\n".join(_wrapped(point, bullet=True) for point in points)


def _how(result: TrainingResult) -> str:
    """The columns of the table, and what validation was used for."""
    told, chosen = result.predictor.metadata, "Validation calibrated the intervals; "
    if result.history:
        chosen = f"Validation chose the epoch, {told['epoch_kept']} of {told['epochs_run']}; "
    if "network" in told:
        decision = "is kept" if told["network"] == "kept" else "is left out, the base alone remains"
        chosen += (
            f"on the validation recordings the base alone errs by {told['base_validation_mae_nt']:.1f} nT, "
            f"with the network by {told['whole_validation_mae_nt']:.1f} nT: the network {decision}; "
        )
    return (
        "Of the total field at the sensor [nT]. Naive: the mean training label on every row. Ridge: Tolles "
        "and Lawson's terms (heading harmonics, speed, turning, current, LiDAR) by ridge regression on the "
        "same training rows. Within 90 %: the share of rows inside the predicted interval of 90 %. "
        f"{chosen}the test was used once."
    )


COLUMNS = {
    "MAE": "mae_nt",
    "RMSE": "rmse_nt",
    "naive MAE": "naive_mae_nt",
    "naive RMSE": "naive_rmse_nt",
    "MAE / naive": "ratio",
    "ridge MAE": "ridge_mae_nt",
    "ridge RMSE": "ridge_rmse_nt",
    "within 90 %": "coverage",
}
"""Columns of a card's table, and what of `PartErrors` they show."""


def _table(result: TrainingResult) -> str:
    """Errors by part, and on the test by path."""
    heads = ["rows of", "recordings", "rows", *COLUMNS]
    lines = [_line(heads), _line(["---"] * len(heads))]
    shown = result.paths[:MOST_NAMES] if len(result.paths) > 1 else ()
    for errors in (*result.parts, *shown):
        values = {name: getattr(errors, name) for name in COLUMNS.values()}
        cells = [f"{value:.{1 if name.endswith('nt') else 3}f}" for name, value in values.items()]
        lines.append(_line([errors.name, f"{errors.recordings:,}", f"{errors.rows:,}", *cells]))
    if len(result.paths) > MOST_NAMES:
        lines.append(f"\nThe first {MOST_NAMES} of {len(result.paths)} paths are shown.")
    return "\n".join(lines)


def _spread(kind: str) -> str:
    """Where the width of the intervals comes from."""
    own = (
        "Each row has its own standard deviation, scaled so that 90 % intervals hold 90 % on recordings left "
        "out of the fit, none of them in the test."
    )
    alike = (
        "The intervals in this table come from the RMSE on validation, `b_sd_nt` of a Run from the test's."
    )
    return (
        f"{alike if kind == 'mlp' else own} The file keeps the RMSE on the test as `residual_sd_nt`. Rows of "
        "a recording are correlated: judge these errors by the number of recordings, not of rows."
    )


def _reproduce(result: TrainingResult, name: str) -> str:
    metadata = result.predictor.metadata
    by = f"magtwin {metadata['magtwin']}"
    if "torch" in metadata:
        by += f", torch {metadata['torch']}, on {metadata['device']} with threads = {metadata['threads']}"
    command = f"magtwin train {_plain(str(metadata['dataset']))} --config F.toml --out {name}"
    text = _wrapped(f"{by}, and as `F.toml` in `{command}`:")
    return f"{text}\n\n```toml\n{str(metadata['config']).rstrip()}\n```"


def _wrapped(text: str, *, bullet: bool = False) -> str:
    """Text in lines of 110 characters."""
    first, later = ("* ", "  ") if bullet else ("", "")
    return textwrap.fill(
        text,
        110,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _plain(text: str) -> str:
    """A name without characters that Markdown would interpret."""
    return "".join(" " if c in "|`<>" or not c.isprintable() else c for c in text)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(map(_plain, cells))} |"
