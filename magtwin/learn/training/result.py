"""TrainingResult: a trained model, its errors on recordings that it never saw, and what reproduces it."""

import math
from dataclasses import dataclass

from magtwin.learn.data.split import Split
from magtwin.learn.models.predictor import Epoch, Predictor
from magtwin.learn.models.weights import shown
from magtwin.learn.training.config import TrainConfig
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary
from magtwin.report.verdict import verdict


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
