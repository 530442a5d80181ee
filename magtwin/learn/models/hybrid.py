"""Hybrid: a linear base, and a small network for its residual if that does better."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array, Inputs
from magtwin.learn.models.linear import Linear, like, linear_from
from magtwin.learn.models.network import FieldNet, net_of
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.weights import Weights, tensors_below
from magtwin.report.report import Figure


@dataclass(kw_only=True, repr=False)
class Hybrid(Predictor):
    """A disturbance y = base(x) + net(x clipped to the training ranges), or the base alone.

    Outside the training ranges the network keeps its value at their edge, while the base extrapolates
    linearly.
    """

    inputs: Inputs = field(init=False)
    """Inputs of the base."""

    base: Linear
    net: FieldNet | None
    """Residual of the base [nT]; None if the base alone does better on validation."""

    sd_factor: float = 1.0
    """Factor of the base's standard deviation."""

    kind = "hybrid"

    def __post_init__(self) -> None:
        self.inputs = self.base.inputs

    @property
    def layers_text(self) -> str:
        """Terms of the base, and layers of the network."""
        return self.base.layers_text + (f" + {self.net.layers_text}" if self.net else "")

    @property
    def parameters_count(self) -> int:
        """Coefficients of the base, weights and biases of the network."""
        return self.base.parameters_count + (self.net.parameters_count if self.net else 0)

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F)."""
        x = self.inputs.checked(x)
        mean, sd = self.base.predict(x)
        if self.net is not None:
            mean += self.net.predict(np.clip(x, self.inputs.low, self.inputs.high))[0]
        return mean, sd * self.sd_factor

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Tensors of the base and of the network, prefixed."""
        tensors = {f"base.{name}": value for name, value in self.base.tensors().items()}
        if self.net is not None:
            tensors |= {f"net.{name}": value for name, value in self.net.tensors().items()}
        return tensors

    def settings(self) -> dict[str, Any]:
        """Settings of the base, dropout of the network, and the factor of the spread."""
        dropout = self.net.dropout if self.net else 0.0
        return {**self.base.settings(), "dropout": dropout, "sd_factor": self.sd_factor}

    def figures(self) -> list[Figure]:
        """The network's layers, the base's terms, and the spread of its errors."""
        return [
            Figure("layers", self.layers_text),
            Figure("parameters", self.parameters_count),
            Figure("constant", self.base.constant_nt, "nT", note="of the base, at the means"),
            *self.base.terms(),
            Figure("sd at the means", math.sqrt(self.base.spread.floor_nt2) * self.sd_factor, "nT"),
        ]


def hybrid_of(weights: Weights) -> Hybrid:
    """The hybrid of a weights file.

    Raises:
        InputError: Its parts do not fit each other.
    """
    parts = {part: tensors_below(weights.tensors, f"{part}.") for part in ("base", "net")}
    extra = [name for name in weights.tensors if not name.startswith(("base.", "net."))]
    if extra:
        raise InputError(f"{weights.path}: tensor {extra[0]!r} belongs to no layer of a hybrid")
    base = replace(weights, tensors=parts["base"]).fit(like(len(weights.features)))
    net = net_of(replace(weights, tensors=parts["net"])) if parts["net"] else None
    return Hybrid(
        base=linear_from(weights, base),
        net=net,
        sd_factor=weights.number("sd_factor", above=0.0),
    )
