"""Baselines: what any network must beat, the mean label and a ridge in Tolles and Lawson's manner."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError

Array = NDArray[np.float64]

PENALTIES = np.logspace(-6, 2, 17)
"""Ridge penalties that are tried, relative to the mean square of a standardised column."""

MOST_FOLDS = 8
"""Parts into which recordings are dealt, each held out once to choose the penalty."""


@dataclass(frozen=True)
class Mean:
    """The naive model: the mean training label, whatever is read."""

    mean_nt: float
    """Mean of the training labels [nT]."""

    sd_nt: float
    """Their standard deviation [nT]; nan where unknown."""

    features: tuple[str, ...] = ()
    """It reads nothing."""

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Means and standard deviations [nT], each (N,), of N rows."""
        return np.full(len(x), self.mean_nt), np.full(len(x), self.sd_nt)

    def outside(self, x: Array) -> NDArray[np.bool_]:
        """Nothing is beyond the training ranges of a model that reads nothing."""
        return np.zeros(len(x), bool)


@dataclass(frozen=True, eq=False)
class Ridge:
    """A linear model of features, b = w . (x - m) / s + c, whose weights w are held small."""

    features: tuple[str, ...]
    """Names of the inputs."""

    mean: Array
    """m, shape (F,)."""

    scale: Array
    """s, above 0, shape (F,)."""

    weights_nt: Array
    """w [nT], shape (F,), or (F, T) of a model of T figures at once."""

    offset_nt: Array
    """c [nT], shape () or (T,)."""

    low: Array
    """Least training inputs, shape (F,)."""

    high: Array
    """Greatest training inputs, shape (F,)."""

    sd_nt: float
    """Root mean square error on recordings that were held out [nT]; of all T figures together."""

    penalty: float
    """The penalty that was chosen."""

    def figures(self, x: Array) -> Array:
        """What it makes of rows (N, F), shape (N,) or (N, T) [nT]."""
        return np.asarray((x - self.mean) / self.scale @ self.weights_nt + self.offset_nt)

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Means and standard deviations [nT], each (N,), of rows (N, F)."""
        return self.figures(x), np.full(len(x), self.sd_nt)

    def outside(self, x: Array) -> NDArray[np.bool_]:
        """Whether an input of a row is beyond the training ranges, shape (N,); nan is."""
        slack = 1e-9 * np.maximum(np.abs(self.low), np.abs(self.high))
        return np.asarray(~np.all((x >= self.low - slack) & (x <= self.high + slack), axis=1))


def fit_ridge(x: Array, y: Array, recording: NDArray[np.intp], features: Sequence[str]) -> Ridge:
    """Ridge regression, its penalty chosen on recordings that are held out in turn (Hoerl and Kennard 1970).

    Minimises sum |y - c - w z|^2 + N lambda |w|^2 with z = (x - m) / s. Rows of one recording are alike, so
    that a penalty chosen on rows would be too small.

    Args:
        x: Inputs, shape (N, F), all finite; F may be 0, which gives the mean.
        y: Labels [nT], shape (N,) or (N, T).
        recording: Which recording each row is of, shape (N,).
        features: Names of the inputs.

    Raises:
        RefusedError: There is no row.
    """
    if not len(y):
        raise RefusedError("no row to fit a linear model to")
    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale[scale <= 1e-12 * np.maximum(1.0, np.abs(mean))] = 1.0
    z = np.column_stack([np.ones(len(x)), (x - mean) / scale])
    targets = y.reshape(len(y), -1)
    number = np.unique(recording, return_inverse=True)[1]
    fold = number % min(MOST_FOLDS, int(number.max()) + 1)
    folds = int(fold.max()) + 1
    grams = np.stack([z[fold == k].T @ z[fold == k] for k in range(folds)])
    alongs = np.stack([z[fold == k].T @ targets[fold == k] for k in range(folds)])
    gram, along = grams.sum(axis=0), alongs.sum(axis=0)
    penalty, error = float(PENALTIES[0]), np.nan
    if folds > 1:
        errors = np.zeros(len(PENALTIES))
        for i, tried in enumerate(PENALTIES):
            for k in range(folds):
                w = _solved(gram - grams[k], along - alongs[k], float(tried))
                errors[i] += float(np.sum((targets[fold == k] - z[fold == k] @ w) ** 2))
        best = int(np.argmin(errors))
        penalty, error = float(PENALTIES[best]), float(np.sqrt(errors[best] / targets.size))
    w = _solved(gram, along, penalty).reshape(z.shape[1], *y.shape[1:])
    low, high = (x.min(axis=0), x.max(axis=0)) if x.shape[1] else (np.empty(0), np.empty(0))
    return Ridge(tuple(features), mean, scale, w[1:], w[0], low, high, error, penalty)


def _solved(gram: Array, along: Array, penalty: float) -> Array:
    """Weights of the normal equations with a penalty on all but the constant."""
    ridge = penalty * gram[0, 0] * np.eye(len(gram))
    ridge[0, 0] = 0.0
    return np.linalg.lstsq(gram + ridge, along, rcond=1e-12)[0]
