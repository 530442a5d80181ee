"""A step of the filters of `magtwin.learn.mixed.followed`, compiled with numba."""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled

Array = NDArray[np.float64]

_NUMBER, _ROW, _ROWS, _BLOCKS = types.float64, *(types.Array(types.float64, n, "C") for n in (1, 2, 3))


@compiled(_ROWS, _BLOCKS, _ROW, _ROW, _ROWS, _ROWS, _ROWS, _ROWS, _NUMBER, _NUMBER)
def step(
    mean: Array,
    covariance: Array,
    log: Array,
    about: Array,
    own: Array,
    hidden: Array,
    a: Array,
    x: Array,
    y: float,
    variance_nt2: float,
) -> None:
    """Let K filters age and use one reading, in place.

    Args:
        mean: Means, shape (K, D).
        covariance: Covariances, shape (K, D, D).
        log: Logarithms of probabilities, shape (K,), to which those of the reading are added.
        about: Means that the coefficients return to, shape (D,).
        own: Covariance that the first P coefficients return to, shape (P, P).
        hidden: Variances that the others return to, shape (K, D - P).
        a: Factors by which they keep their difference, shape (K, D).
        x: Regressors, shape (K, D).
        y: The reading.
        variance_nt2: Variance of its error.
    """
    kinds, count = mean.shape
    first = own.shape[0]
    turned = np.empty(count)
    for k in range(kinds):
        turned[:] = 0.0
        left, spread = y, variance_nt2
        for i in range(count):
            mean[k, i] = about[i] + a[k, i] * (mean[k, i] - about[i])
            left -= x[k, i] * mean[k, i]
            for j in range(count):
                covariance[k, i, j] *= a[k, i] * a[k, j]
            if i < first:
                for j in range(first):
                    covariance[k, i, j] += (1.0 - a[k, i] * a[k, j]) * own[i, j]
            else:
                covariance[k, i, i] += (1.0 - a[k, i] * a[k, i]) * hidden[k, i - first]
            for j in range(count):  # the matrix is symmetric
                turned[j] += covariance[k, i, j] * x[k, i]
        for i in range(count):
            spread += x[k, i] * turned[i]
        log[k] -= 0.5 * (left * left / spread + math.log(spread))
        for i in range(count):
            mean[k, i] += turned[i] * left / spread
        turned /= math.sqrt(spread)
        for i in range(count):
            for j in range(count):
                covariance[k, i, j] -= turned[i] * turned[j]
