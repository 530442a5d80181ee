"""Predictors: models of the disturbance that a robot adds to the map, and the registry of their kinds.

To add a kind, write a subclass of `Predictor` and a `PredictorKind`, and register the latter under the
predictor's `kind`:

    @PREDICTORS.register("forest")
    class ForestKind:
        description = "A random forest"
        options = {"features": "circular"}

        @staticmethod
        def fit(task: FitTask) -> Fit: ...

        @staticmethod
        def load(weights: Weights) -> Forest: ...

A package registers it by an entry point of the group `magtwin.predictors`. Then `magtwin train --model
forest` trains it, and every command reads its weights.
"""

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.learn.data.inputs import Array, Inputs
from magtwin.learn.data.recording import Recording, Rows
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.weights import (
    MetadataValue,
    Weights,
    is_checkpoint,
    read_weights,
    shown,
    write_weights,
)
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed


@dataclass(kw_only=True, repr=False)
class Predictor(Summarized, ABC):
    """Predicts a disturbance and its standard deviation, row by row. It is saved as tensors and settings."""

    inputs: Inputs
    """Names, scaler and training ranges of the inputs."""

    residual_sd_nt: float = math.nan
    """Root mean square error on held-out recordings [nT]; nan if unknown."""

    metadata: dict[str, MetadataValue] = field(default_factory=dict)
    """Provenance: what it was trained on."""

    wide: Spread | None = None
    """Spread of errors on robots that it was not trained on; None if it was never learned."""

    kind: ClassVar[str]
    """Name of its kind in `PREDICTORS`."""

    @property
    @abstractmethod
    def layers_text(self) -> str:
        """Its shape in words, as 20-512-1."""

    @property
    @abstractmethod
    def parameters_count(self) -> int:
        """Number of fitted parameters."""

    @abstractmethod
    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F)."""

    @abstractmethod
    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, by name."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Other values to save, as JSON."""

    @abstractmethod
    def figures(self) -> list[Figure]:
        """Its parts, for the report."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.inputs.features

    @property
    def judged_on(self) -> str:
        """What `residual_sd_nt` was measured on."""
        return "held-out recordings"

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows; see `Inputs.outside`."""
        return self.inputs.outside(x)

    def wide_sd_nt(self, x: ArrayLike) -> Array | None:
        """Standard deviations on robots that it was not trained on [nT], (N,), from features (N, F), or None.

        None if it learned none, or predicts for the session of a drive.
        """
        return None if self.wide is None else self.wide.sd_nt(self.inputs.scaled(self.inputs.checked(x)))

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

    def report(self, title: str) -> Report:
        """Its kind, its parts, and its error on held-out recordings if known."""
        figures = [Figure("kind", self.kind), *self.figures()]
        if self.wide is not None:
            note = "of training rows, on robots that it was not trained on"
            figures.append(Figure("sd, other robots", self.wide.mean_nt, "nT", note=note))
        if not math.isnan(self.residual_sd_nt):
            figures.append(Figure("residual sd", self.residual_sd_nt, "nT", note=f"on {self.judged_on}"))
        return Report(title, tuple(figures), shown(self.metadata))

    def summary(self, title: str) -> Summary:
        """Kind, layers, inputs, error and provenance under a title."""
        known = ("dataset", "map", "created", "licence", "source")
        trained = [f"{name} {self.metadata[name]}" for name in known if name in self.metadata]
        error = f"{self.residual_sd_nt:.4g} nT rms on {self.judged_on}"
        return Summary(
            f"{title}: {self.kind}, {self.parameters_count:,} parameters",
            (
                ("layers", self.layers_text),
                ("inputs", f"{len(self.features)}: {listed(self.features)}"),
                ("error", "unknown" if math.isnan(self.residual_sd_nt) else error),
                ("metadata", ", ".join(trained) or listed(tuple(self.metadata))),
            ),
            ("fact", "value"),
            [(name, str(value)) for name, value in self.metadata.items()],
        )

    def _summary(self) -> Summary:
        return self.summary(type(self).__name__)


@dataclass(frozen=True)
class Epoch:
    """Errors of a network after one pass over the training rows."""

    number: int
    """1 is the first; 0 are the initial weights of a continued training."""

    train_rmse_nt: float
    """RMSE in training [nT], with dropout except in epoch 0."""

    val_rmse_nt: float
    """RMSE on the validation rows, without dropout [nT]."""

    best: bool
    """Whether no earlier epoch has a smaller val_rmse_nt; the last such epoch is kept."""


@dataclass(frozen=True, kw_only=True)
class FitTask:
    """Everything that fitting a predictor needs."""

    features: tuple[str, ...]
    """Names of the inputs."""

    train: Rows
    """Rows to fit to."""

    validation: Rows
    """Rows of other recordings, to stop by and to calibrate by."""

    train_groups: NDArray[np.intp]
    """Session, recording or path of each training row, shape (N,)."""

    validation_groups: NDArray[np.intp]
    """Session, recording or path of each validation row, shape (M,)."""

    options: Mapping[str, Any]
    """Values of the options that the kind reads."""

    rng: np.random.Generator
    """Source of all randomness."""

    recordings: Mapping[str, Recording] = field(default_factory=dict)
    """Recordings of the rows by name, with their sessions and plants."""

    init: Any = None
    """Predictor of the same kind to continue from, or None."""

    device: str = "cpu"
    """Where torch trains."""

    progress: Callable[[Epoch], None] | None = None
    """Called after each epoch."""

    advance: Callable[[int, int], None] | None = None
    """Called after each step with the rows done and the rows of all epochs."""


@dataclass(frozen=True)
class Fit:
    """A fitted predictor."""

    model: Predictor

    history: tuple[Epoch, ...] = ()
    """Its epochs; empty if it is fitted at once."""

    held_out_nt: Array | None = None
    """Disturbance at each training row by a fit without its group [nT], shape (N,); of a hybrid, by its base.
    None for a kind that is fitted once."""


OWN_MODULE = "module"
"""Kind of a predictor around a torch module of the user's own."""


class PredictorKind(Protocol):
    """How predictors of one kind are fitted and loaded."""

    description: str
    """What it is, for the model card: "A multilayer perceptron, float32"."""

    options: Mapping[str, Any]
    """Options of `magtwin.learn.training.config.TrainConfig` that it reads, with their defaults; at least
    `features`."""

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit a predictor to training rows and calibrate it by validation rows.

        Raises:
            InputError: The task cannot be fitted.
        """

    @staticmethod
    def load(weights: Weights) -> Predictor:
        """The predictor of a weights file.

        Raises:
            InputError: The parts of the file do not fit each other.
        """


PREDICTORS: Registry[PredictorKind] = Registry(
    "predictor kind",
    "predictors",
    {
        "mlp": "magtwin.learn.training.kinds:Perceptrons",
        "linear": "magtwin.learn.training.kinds:Linears",
        "hybrid": "magtwin.learn.training.kinds:Hybrids",
        "mixed": "magtwin.learn.mixed.fit_mixed:Mixeds",
        OWN_MODULE: "magtwin.learn.training.own:Modules",
    },
)
"""Kinds of predictors by name."""

NETWORKS: Registry[Any] = Registry("network of your own", "networks")
"""Classes of own torch modules, or functions that make one, by the name that a weights file has of them."""


def load_predictor(path: str | os.PathLike[str], *, module: Any = None) -> Predictor:
    """Load a predictor of any kind: magtwin's safetensors, or a released `.pth`.

    A file of your own torch module holds its numbers and the name of its class, and no code. Its class must
    be given once in this process, have been trained in it, or be registered (`magtwin.extend.network`).

    Args:
        path: The weights.
        module: Class or instance of your own `torch.nn.Module` that the weights are of. Default: by its name.

    Raises:
        InputError: Neither of the two, damaged, its parts do not fit each other, or an own module is unknown.
    """
    if is_checkpoint(path):
        from magtwin.learn.models.network import net_of_checkpoint

        return net_of_checkpoint(path)
    weights = read_weights(path)
    try:
        kind = PREDICTORS[weights.kind]
    except InputError as error:
        raise InputError(f"{path}: {error}; update magtwin, or install the package of this kind") from error
    if module is not None and weights.kind != OWN_MODULE:
        raise InputError(f"{path}: holds a {weights.kind}, no module of your own; leave `module` out")
    predictor = kind.load(replace(weights, module=module))
    predictor.residual_sd_nt, predictor.metadata = weights.residual_sd_nt, dict(weights.about["facts"])
    predictor.wide = weights.wide
    return predictor
