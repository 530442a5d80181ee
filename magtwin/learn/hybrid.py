"""Hybrid: a linear base, and a small network for what the base leaves, where that does better."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.inputs import Array
from magtwin.learn.linear import Linear, like, linear_from
from magtwin.learn.model import FieldNet, net_of
from magtwin.learn.weights import Fact, Weights, write_weights
from magtwin.names import RefusedError
from magtwin.report import Figure, Report


@dataclass(kw_only=True)
class Hybrid:
    """A disturbance y = base(x) + net(x clipped to the training ranges), or the base alone.

    Outside the training ranges the network stays as it is at their edge, while the base goes on as a straight
    line: what is extrapolated is what physics extrapolates.
    """

    base: Linear
    net: FieldNet | None
    """What the base leaves [nT]; none where the base alone does better on recordings it never saw."""

    sd_factor: float = 1.0
    """What the spread of the base is multiplied by."""

    residual_sd_nt: float = math.nan
    facts: dict[str, Fact] = field(default_factory=dict)

    kind = "hybrid"
    context = 0
    step_s = 0.0

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.base.features

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
        of = self.base.inputs
        x = of.checked(x)
        mean, sd = self.base.predict(x)
        if self.net is not None:
            mean += self.net.predict(np.clip(x, of.low, of.high))[0]
        return mean, sd * self.sd_factor

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows; see `Inputs.outside`."""
        return self.base.outside(x)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write it to one safetensors file; the same model, the same bytes.

        Raises:
            RefusedError: The file exists and `force` was not given.
        """
        tensors = {f"base.{name}": value for name, value in self.base.tensors().items()}
        if self.net is not None:
            tensors |= {f"net.{name}": value for name, value in self.net.state_dict().items()}
        write_weights(
            path,
            self.kind,
            tensors,
            features=self.features,
            residual_sd_nt=self.residual_sd_nt,
            facts=self.facts,
            penalty=self.base.penalty,
            weighted=self.base.weighted,
            dropout=self.net.dropout if self.net else 0.0,
            sd_factor=self.sd_factor,
            force=force,
        )

    def report(self, title: str) -> Report:
        """The base's terms, the network's layers, and the spread of its errors."""
        figures = [
            Figure("kind", self.kind),
            Figure("layers", self.layers_text),
            Figure("parameters", self.parameters_count),
            Figure("constant", self.base.constant_nt, "nT", note="of the base, at the means"),
            *self.base.figures()[:-1],
            Figure("sd at the means", math.sqrt(self.base.spread.floor_nt2) * self.sd_factor, "nT"),
        ]
        if not math.isnan(self.residual_sd_nt):
            figures.append(Figure("residual sd", self.residual_sd_nt, "nT", note="on held-out recordings"))
        return Report(title, tuple(figures), dict(self.facts))


def hybrid_of(weights: Weights) -> Hybrid:
    """The hybrid that a weights file holds.

    Raises:
        RefusedError: Its parts do not fit each other.
    """
    found = {part: _part(weights.tensors, f"{part}.") for part in ("base", "net")}
    extra = [name for name in weights.tensors if not name.startswith(("base.", "net."))]
    if extra:
        raise RefusedError(f"{weights.path}: tensor {extra[0]!r} belongs to no layer of a hybrid")
    base = weights.with_tensors(found["base"]).fit(like(len(weights.features)))
    net = net_of(weights.with_tensors(found["net"])) if found["net"] else None
    return Hybrid(
        base=linear_from(weights, base),
        net=net,
        sd_factor=weights.number("sd_factor", above=0.0),
        residual_sd_nt=weights.residual_sd_nt,
        facts=dict(weights.about["facts"]),
    )


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
