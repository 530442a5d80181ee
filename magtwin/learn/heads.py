"""Heads: a mean and a logarithm of a variance for each row, and how they are learned."""

import numpy as np
import torch

from magtwin.learn.inputs import Array

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
