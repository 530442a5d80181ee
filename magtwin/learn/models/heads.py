"""Heads: a mean and a logarithm of a variance for each row, how they are learned, and a model of the two."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from magtwin.learn.data.inputs import Array
from magtwin.learn.models.regressor import Regressor
from magtwin.report import Figure

LIMIT = 10.0
"""Logarithms of variances stay within this of 0: between e^-5 and e^5 of the labels' own spread."""

BETA = 0.5
"""Power of its own variance that a row's loss is weighted by."""


def loss(out: torch.Tensor, label: torch.Tensor, weight: torch.Tensor | float = 1.0) -> torch.Tensor:
    """Mean negative log-likelihood of labels under normal distributions, each row weighted by its variance.

        L = mean w v^beta / 2 (log v + (y - m)^2 / v),   v^beta held constant in the gradient

    Without the weight (Seitzer et al. 2022, "On the pitfalls of heteroscedastic uncertainty estimation")
    rows that are hard are given up early, and their means are never learned.

    Args:
        out: Means and logarithms of variances, shape (..., 2), of scaled labels.
        label: Scaled labels, shape (...).
        weight: What each row counts, shape (...).
    """
    log = out[..., 1].clamp(-LIMIT, LIMIT)
    variance = log.exp()
    each = 0.5 * (log + (label - out[..., 0]) ** 2 / variance)
    return (weight * variance.detach() ** BETA * each).mean()


def moments(out: Array, y_mean: float, y_scale: float) -> tuple[Array, Array]:
    """Means [nT] and variances [nT^2], shape (...), of what the two heads give, shape (..., 2)."""
    log = np.clip(out[..., 1], -LIMIT, LIMIT)
    return y_mean + y_scale * out[..., 0], y_scale**2 * np.exp(log)


@dataclass(kw_only=True, repr=False)
class Headed(Regressor):
    """A network with the two heads, of labels scaled to a mean of 0 and a standard deviation of 1."""

    net: torch.nn.Module
    y_mean_nt: float
    y_scale_nt: float
    sd_factor: float = 1.0
    """What the standard deviation is multiplied by, so that it holds on recordings never seen."""

    @property
    @abstractmethod
    def layers_text(self) -> str:
        """Its layers in words."""

    @property
    def parameters_count(self) -> int:
        """Weights and biases."""
        return sum(p.numel() for p in self.net.parameters())

    def tensors(self) -> dict[str, torch.Tensor]:
        """Scaler and ranges of the inputs, weights and biases."""
        return self.inputs.tensors() | self.net.state_dict()

    def settings(self) -> dict[str, Any]:
        """What turns the heads' outputs into nT."""
        return {"y_mean_nt": self.y_mean_nt, "y_scale_nt": self.y_scale_nt, "sd_factor": self.sd_factor}

    def figures(self) -> list[Figure]:
        """Layers, inputs, and scales of the labels."""
        return [
            Figure("layers", self.layers_text),
            Figure("parameters", self.parameters_count),
            Figure("inputs", ", ".join(self.features)),
            Figure("label mean", self.y_mean_nt, "nT"),
            Figure("label sd", self.y_scale_nt, "nT"),
            Figure("sd factor", self.sd_factor, note="calibrated on validation recordings"),
        ]
