"""Regressor: base class of predictors: inputs, provenance, file and report."""

import math
import os
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.data.inputs import Inputs
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.weights import MetadataValue, shown, write_weights
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed


@dataclass(kw_only=True, repr=False)
class Regressor(Summarized, ABC):
    """A predictor that is saved as tensors and settings."""

    inputs: Inputs
    residual_sd_nt: float = math.nan
    metadata: dict[str, MetadataValue] = field(default_factory=dict)

    wide: Spread | None = None
    """Spread of errors on robots that it was not trained on; None if it was never learned."""

    kind: ClassVar[str]

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.inputs.features

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows; see `Inputs.outside`."""
        return self.inputs.outside(x)

    def wide_sd_nt(self, x: ArrayLike) -> NDArray[np.float64] | None:
        """Standard deviations on robots that it was not trained on [nT], (N,), from features (N, F), or None.

        None if it learned none, or predicts for the session of a drive.
        """
        return None if self.wide is None else self.wide.sd_nt(self.inputs.scaled(self.inputs.checked(x)))

    @abstractmethod
    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, by name."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Other values to save, as JSON."""

    @abstractmethod
    def figures(self) -> list[Figure]:
        """Its parts, for the report."""

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write it to a safetensors file; the same model gives the same bytes.

        Raises:
            InputError: The file exists and `force` was not given.
        """
        write_weights(
            path,
            self.kind,
            self.tensors(),
            features=self.features,
            residual_sd_nt=self.residual_sd_nt,
            metadata=self.metadata,
            wide=self.wide,
            force=force,
            **self.settings(),
        )

    @property
    def judged_on(self) -> str:
        """What `residual_sd_nt` was measured on."""
        return "held-out recordings"

    def report(self, title: str) -> Report:
        """Its kind, its parts, and its error on held-out recordings if known."""
        figures = [Figure("kind", self.kind), *self.figures()]
        if self.wide is not None:
            note = "of training rows, on robots that it was not trained on"
            figures.append(Figure("sd, other robots", self.wide.mean_nt, "nT", note=note))
        if not math.isnan(self.residual_sd_nt):
            figures.append(Figure("residual sd", self.residual_sd_nt, "nT", note=f"on {self.judged_on}"))
        return Report(title, tuple(figures), shown(self.metadata))

    def _summary(self) -> Summary:
        return summary_of(self, type(self).__name__)


def summary_of(net: Any, title: str, *metadata: tuple[str, str]) -> Summary:
    """Kind, layers, inputs, error and provenance of a predictor."""
    error = (
        "unknown"
        if math.isnan(net.residual_sd_nt)
        else f"{net.residual_sd_nt:.4g} nT rms on {getattr(net, 'judged_on', 'held-out recordings')}"
    )
    trained = [
        f"{name} {net.metadata[name]}"
        for name in ("dataset", "map", "created", "licence", "source")
        if name in net.metadata
    ]
    return Summary(
        f"{title}: {net.kind}, {net.parameters_count:,} parameters",
        (
            ("layers", net.layers_text),
            ("inputs", f"{len(net.features)}: {listed(net.features)}"),
            ("error", error),
            *metadata,
            ("metadata", ", ".join(trained) or listed(tuple(net.metadata))),
        ),
        ("fact", "value"),
        [(name, str(value)) for name, value in net.metadata.items()],
    )
