"""Inputs: the features of a predictor, their scaler and their training ranges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.features import feature_names
from magtwin.report.summary import Summarized

Array = NDArray[np.float64]

SCALERS = ("x_mean", "x_scale", "x_min", "x_max")  # Tensors of a weights file that hold scaler and ranges
FAR = 5.0  # Scales from the mean beyond which an input is outside if the training range is unknown
MANY = 0.05  # Share of readings outside the training range from which that is told
SLACK = 0.1  # Share of the range by which they must be outside
WORST = 3  # Inputs that are named
_BLOCK = 512  # Rows compared at once, to stay in the cache of a core


@dataclass(frozen=True, repr=False)
class Inputs(Summarized):
    """The features of a row in order, with the scaler and the ranges of the training rows."""

    features: tuple[str, ...]
    """Names, of `magtwin.learn.data.features.FEATURES`."""

    mean: Array
    """Means of the training inputs, in the units of the features, shape (F,)."""

    scale: Array
    """Scales of the training inputs, shape (F,), above 0."""

    low: Array
    """Smallest training inputs, shape (F,); nan if unknown."""

    high: Array
    """Largest training inputs, shape (F,); nan if unknown."""

    def tensors(self) -> dict[str, Array]:
        """Scaler and ranges as tensors of a weights file, by name, float64."""
        return dict(zip(SCALERS, (self.mean, self.scale, self.low, self.high), strict=True))

    def take(self, kept: NDArray[np.bool_]) -> "Inputs":
        """Some of the features, shape (F,)."""
        names = tuple(name for name, keep in zip(self.features, kept.tolist(), strict=True) if keep)
        return Inputs(names, *(values[kept] for values in (self.mean, self.scale, self.low, self.high)))

    def grown(self, other: "Inputs") -> "Inputs":
        """The same scaler, with ranges extended by those of other rows; unknown ranges stay unknown.

        Raises:
            InputError: The features differ.
        """
        if other.features != self.features:
            raise InputError(
                f"the model to continue from has inputs {', '.join(self.features)}, this training "
                f"{', '.join(other.features)}; give it the same features"
            )
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        return Inputs(self.features, self.mean, self.scale, low, high)

    def checked(self, x: ArrayLike) -> Array:
        """`x` as float64 rows of one column per feature.

        Raises:
            InputError: `x` has another shape.
        """
        x = np.ascontiguousarray(x, float)
        wanted = len(self.features)
        if x.ndim != 2 or x.shape[1] != wanted:
            raise InputError(
                f"this network reads {wanted} features a row, shape (N, {wanted}); got {x.shape}"
            )
        return x

    def scaled(self, x: ArrayLike) -> Array:
        """Rows (x - mean) / scale, shape (N, F)."""
        return (np.asarray(x, float) - self.mean) / self.scale

    @property
    def within(self) -> tuple[Array, Array]:
        """Smallest and largest inputs that are not outside, each (F,).

        If the training range is unknown, as in the released weights, they lie 5 scales from the mean.
        """
        low = np.where(np.isnan(self.low), self.mean - FAR * self.scale, self.low)
        high = np.where(np.isnan(self.high), self.mean + FAR * self.scale, self.high)
        slack = 1e-9 * np.maximum(np.abs(low), np.abs(high))  # rounding of inputs that never vary
        return low - slack, high + slack

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row is not `within` the training range, shape (N,); nan is outside."""
        x = self.checked(x)
        low, high = self.within
        inside = np.empty(len(x), bool)
        for start in range(0, len(x), _BLOCK):
            block = x[start : start + _BLOCK]
            np.all((block >= low) & (block <= high), axis=1, out=inside[start : start + _BLOCK])
        return ~inside

    def worst(self, x: ArrayLike) -> str:
        """The inputs that most rows have outside of the training range; "" if few rows have.

        Each with the value that is furthest outside, and the range.
        """
        x = self.checked(x)
        low, high = self.within
        beyond = np.maximum(np.maximum(low - x, x - high), 0) / np.where(high > low, high - low, 1.0)
        outside = (beyond > SLACK) | np.isnan(x)
        rows = np.count_nonzero(outside.any(axis=1))
        if rows <= MANY * len(x):
            return ""
        shares = np.mean(outside, axis=0)
        named = []
        for k in np.argsort(-shares, kind="stable")[:WORST].tolist():
            if shares[k] > 0:
                row = int(np.nanargmax(np.where(np.isnan(beyond[:, k]), -1.0, beyond[:, k])))
                value, ends = x[row, k], f"{low[k]:.3g} to {high[k]:.3g}"
                named.append(f"{self.features[k]} {value:.3g} (trained on {ends}) in {shares[k]:.0%}")
        return (
            f"{rows / len(x):.0%} of {len(x):,} readings are outside the training range: {', '.join(named)}"
        )


def inputs_of(x: ArrayLike, features: str | Sequence[str]) -> Inputs:
    """Scaler and ranges of training rows.

    Args:
        x: Features, shape (N, F). One that does not vary keeps a scale of 1.
        features: Their names, or the name of a set.
    """
    x = np.asarray(x, float)
    scale = x.std(axis=0)
    scale[scale < 1e-12 * np.maximum(1.0, np.abs(x).max(axis=0))] = 1.0
    return Inputs(feature_names(features), x.mean(axis=0), scale, x.min(axis=0), x.max(axis=0))


def scaler_tensors(count: int) -> dict[str, Array]:
    """Tensors with the names, shapes and types of the scaler and ranges of `count` inputs."""
    return dict.fromkeys(SCALERS, np.ones(count))


def inputs_from(features: Sequence[str], tensors: Mapping[str, NDArray[Any]], path: Path) -> Inputs:
    """Scaler and ranges of a weights file.

    Args:
        features: Names of the inputs.
        tensors: Tensors of the file.
        path: The file, for error messages.

    Raises:
        InputError: A scale is not above 0.
    """
    mean, scale, low, high = (tensors[name] for name in SCALERS)
    if not (scale > 0).all():
        raise InputError(f"{path}: a scale of its scalers is not above 0")
    return Inputs(tuple(features), mean, scale, low, high)
