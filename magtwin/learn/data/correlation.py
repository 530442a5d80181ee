"""Rank correlation of each input with the disturbance, as in the paper's Figure 2."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.report.summary import Summarized

Array = NDArray[np.float64]

PAPER: Mapping[str, float] = MappingProxyType(
    {"yaw_deg": 0.31, "odom_v_x": -0.09, "imu_q_x": -0.13, "imu_q_y": -0.28, "imu_q_z": 0.31, "imu_q_w": 0.37}
)
"""Correlations in the paper's Figure 2; those of all other inputs are within 0.04 of 0."""


@dataclass(frozen=True, repr=False)
class Correlations(Summarized):
    """Spearman's rank correlations of inputs with labels."""

    features: tuple[str, ...]
    """Inputs, in their order."""

    rho: Array
    """Correlation of each with the label, -1 to 1, shape (F,); nan for an input that never varies."""

    sd: Array
    """Jackknife standard deviation of each over groups, shape (F,); nan for one group."""

    rows: int
    """Readings."""

    groups: int
    """Number of recordings or sessions."""


def correlations(x: ArrayLike, y: ArrayLike, features: Sequence[str], groups: ArrayLike) -> Correlations:
    """Spearman's correlation of each input with the label: Pearson's of their ranks (Spearman 1904).

    Readings of a run are correlated, so the spread is the jackknife's over groups:
    sd^2 = (G - 1) / G sum over g of (rho_-g - mean)^2, with rho_-g from the rows outside group g, which keep
    their ranks among all rows.

    Rows are inputs (N, F) with F names, labels [nT], and recordings or sessions as whole numbers. Fewer than
    three rows, and labels that never vary, are refused.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    group, b = np.unique(groups, return_inverse=True)[1], _ranks(y)
    if len(y) < 3 or not b.any():
        raise InputError(
            f"{len(y)} labels of {y[0]:g} nT and more: too few or all alike, so nothing correlates with them"
        )
    count = int(group.max()) + 1
    rho, sd = np.full(len(features), np.nan), np.full(len(features), np.nan)
    n, sum_b, sum_bb = (np.bincount(group, w, count) for w in (np.ones(len(b)), b, b * b))
    for i, column in enumerate(x.T):
        a = _ranks(column)
        if not a.any():
            continue
        sum_a, sum_aa, sum_ab = (np.bincount(group, w, count) for w in (a, a * a, a * b))
        sums = np.stack([n, sum_a, sum_b, sum_aa, sum_bb, sum_ab])
        total = sums.sum(axis=1, keepdims=True)
        rho[i] = _pearson(total)[0]
        if count > 1:
            without = _pearson(total - sums)
            sd[i] = np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2))
    return Correlations(tuple(features), rho, sd, len(y), count)


def _ranks(values: Array) -> Array:
    """Centred ranks divided by N, ties at their mean rank, shape (N,)."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    rank = np.cumsum(count) - (count - 1) / 2
    return (rank[place] - (len(values) + 1) / 2) / len(values)


def _pearson(sums: Array) -> Array:
    """Pearson's correlation from sums of 1, a, b, a^2, b^2, ab, shape (6, G); nan if one does not vary."""
    n, a, b, aa, bb, ab = sums
    spread = np.maximum(n * aa - a * a, 0) * np.maximum(n * bb - b * b, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((n * ab - a * b) / np.sqrt(spread))
