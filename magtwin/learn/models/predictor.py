"""Predictors: models of the disturbance that a robot adds to the map, and the registry of their kinds.

To add a kind, write a `Predictor` (subclass `magtwin.learn.models.regressor.Regressor`) and a
`PredictorKind`, and register the latter under the predictor's `kind`:

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

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.learn.data.inputs import Inputs
from magtwin.learn.data.recording import Recording, Rows
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.network import net_of_checkpoint
from magtwin.learn.models.weights import MetadataValue, Weights, is_checkpoint, read_weights
from magtwin.report.report import Report

Array = NDArray[np.float64]


class Predictor(Protocol):
    """Predicts a disturbance and its standard deviation, row by row."""

    metadata: dict[str, MetadataValue]
    """Provenance: what it was trained on."""

    residual_sd_nt: float
    """Root mean square error on held-out recordings [nT]; nan if unknown."""

    wide: Spread | None
    """Spread of errors on robots that it was not trained on; None if it was never learned."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""

    @property
    def inputs(self) -> Inputs:
        """Scaler and training ranges of the inputs."""

    @property
    def kind(self) -> str:
        """Name of its kind in `PREDICTORS`."""

    @property
    def layers_text(self) -> str:
        """Its shape in words, as 20-512-1."""

    @property
    def parameters_count(self) -> int:
        """Number of fitted parameters."""

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F)."""

    def wide_sd_nt(self, x: ArrayLike) -> Array | None:
        """Standard deviations on robots that it was not trained on [nT], (N,), from features (N, F), or None.

        None if it learned none, or predicts for the session of a drive.
        """

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows, shape (N,)."""

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write it to one safetensors file; the same predictor gives the same bytes."""

    def report(self, title: str) -> Report:
        """Its kind, shape and errors."""


@dataclass(frozen=True)
class Epoch:
    """Errors of a network after one pass over the training rows."""

    number: int
    """1 is the first; 0 are the initial weights of a continued training."""

    train_rmse_nt: float
    """RMSE in training [nT], with dropout except in epoch 0."""

    val_rmse_nt: float
    """RMSE on the validation rows, without dropout [nT]."""

    val_mae_nt: float
    """Mean absolute error on the validation rows [nT]."""

    best: bool
    """Whether no earlier epoch has a smaller val_rmse_nt; the last such epoch is kept."""


@dataclass(frozen=True)
class Choice:
    """Whether a hybrid keeps its network, by mean absolute errors on the validation rows [nT]."""

    base_mae_nt: float
    """Of the base alone."""

    whole_mae_nt: float
    """Of base and network."""

    @property
    def kept(self) -> bool:
        """Whether the network lowers the error."""
        return self.whole_mae_nt < self.base_mae_nt

    def text(self) -> str:
        """The decision and its reason, in a sentence."""
        decision = "is kept" if self.kept else "is left out, the base alone remains"
        return (
            f"on the validation recordings the base alone errs by {self.base_mae_nt:.1f} nT, with the "
            f"network by {self.whole_mae_nt:.1f} nT: the network {decision}"
        )


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

    freeze: tuple[str, ...] = ()
    """Layers that stay as in `init`."""

    device: str = "cpu"
    """Where torch trains."""

    checkpoint: str | os.PathLike[str] | None = None
    """File for the state after each epoch."""

    resume: bool = False
    """Whether to continue from `checkpoint`."""

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

    choice: Choice | None = None
    """Of a hybrid."""

    held_out_nt: Array | None = None
    """Disturbance at each training row by a fit without its group [nT], shape (N,); of a hybrid, by its base.
    None for a kind that is fitted once."""


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
    },
)
"""Kinds of predictors by name."""


def load_predictor(path: str | os.PathLike[str]) -> Predictor:
    """Load a predictor of any kind: magtwin's safetensors, or a released `.pth`.

    Raises:
        InputError: Neither of the two, damaged, or its parts do not fit each other.
    """
    if is_checkpoint(path):
        return net_of_checkpoint(path)
    weights = read_weights(path)
    try:
        kind = PREDICTORS[weights.kind]
    except InputError as error:
        raise InputError(f"{path}: {error}; update magtwin, or install the package of this kind") from error
    predictor = kind.load(weights)
    if weights.wide is not None:
        predictor.wide = weights.wide
    return predictor
