"""Predictor: whatever tells a robot's disturbance from features, and how sure it is."""

import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.models.ensemble import ensemble_of
from magtwin.learn.models.hybrid import hybrid_of
from magtwin.learn.models.linear import linear_of
from magtwin.learn.models.network import net_of, net_of_checkpoint
from magtwin.learn.models.temporal import temporal_of
from magtwin.learn.models.weights import Fact, Weights, is_checkpoint, read_weights
from magtwin.report import Report

Array = NDArray[np.float64]


class Predictor(Protocol):
    """A disturbance with its standard deviation, row by row; of which kind is its own business."""

    metadata: dict[str, Fact]
    """Provenance: on what it was trained."""

    residual_sd_nt: float
    """Root mean square error on recordings it never saw [nT]; nan where unknown."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""

    @property
    def kind(self) -> str:
        """Which kind it is: "mlp", "linear", "hybrid", "ensemble" or "tcn"."""

    @property
    def context(self) -> int:
        """How many earlier rows of a run a row's prediction looks at."""

    @property
    def step_s(self) -> float:
        """Time between the rows that it looks back over [s]; 0 where `context` is 0."""

    @property
    def layers_text(self) -> str:
        """Its shape in words, as 20-512-1."""

    @property
    def parameters_count(self) -> int:
        """How many numbers were fitted."""

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and the standard deviations of their errors [nT], each (N,).

        Args:
            x: Features in their units, shape (N, F); one run's rows in time order where `context` is
                above 0.
        """

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows, shape (N,)."""

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write it to one safetensors file; the same predictor gives the same bytes."""

    def report(self, title: str) -> Report:
        """What it is, in figures."""


def load_predictor(path: str | os.PathLike[str]) -> Predictor:
    """A predictor of any kind from its file: magtwin's safetensors, or a released `.pth`.

    Raises:
        InputError: Neither of the two, damaged, or parts that do not fit each other.
    """
    if is_checkpoint(path):
        return net_of_checkpoint(path)
    weights = read_weights(path)
    return _KINDS[weights.kind](weights)


_KINDS: Mapping[str, Callable[[Weights], Predictor]] = MappingProxyType(
    {
        "mlp": net_of,
        "linear": linear_of,
        "hybrid": hybrid_of,
        "ensemble": ensemble_of,
        "tcn": temporal_of,
    }
)
