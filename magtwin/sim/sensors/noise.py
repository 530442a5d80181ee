"""Noise with memory, drawn in pieces of any length: Gauss-Markov processes and random walks.

Each function takes the state after the last piece and returns the state for the next one. So the bytes of a
series do not depend on how it is cut into pieces.
"""

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.sensors.stateful import Stateful

Array = NDArray[np.float64]

FEW = 8
"""Columns up to which a recursion runs over each of them by itself."""


def gauss_markov(white: ArrayLike, start: ArrayLike, time_s: float, rate_hz: float) -> tuple[Array, Array]:
    """A stationary first-order Gauss-Markov process of standard deviation 1.

    x_0 = start and x_{k+1} = d x_k + sqrt(1 - d^2) white_k with d = exp(-1 / (time_s rate_hz)), so that the
    autocorrelation falls as exp(-|tau| / time_s) if `start` is a standard normal number too.

    Args:
        white: Standard normal numbers, one row a sample, shape (K, ...).
        start: x_0, shape (...).
        time_s: Correlation time [s]; 0 gives white noise.
        rate_hz: Samples a second [Hz].

    Returns:
        x_0 to x_{K-1}, the shape of `white`; and x_K, to continue with.
    """
    decay = correlation(time_s, rate_hz)
    driven = math.sqrt(1.0 - decay * decay) * np.asarray(white, float)
    series = decaying(np.concatenate([np.asarray(start, float)[None], driven]), decay)
    return series[:-1], series[-1]


def decaying(driven: Array, decay: float) -> Array:
    """y_0 = u_0 and y_k = u_k + decay y_{k-1} along the first axis, shape (K, ...); overwrites `driven`."""
    columns = driven.reshape(len(driven), -1)
    if columns.shape[1] <= FEW:  # Python's floats are faster than numpy's short rows, and give the same bits
        for k in range(columns.shape[1]):
            terms = itertools.accumulate(columns[:, k].tolist(), lambda y, u: u + decay * y)
            columns[:, k] = np.fromiter(terms, float, len(columns))
    else:
        for k in range(1, len(columns)):
            columns[k] += decay * columns[k - 1]
    return columns.reshape(driven.shape)


def correlation(time_s: float, rate_hz: float) -> float:
    """Correlation of successive samples of a Gauss-Markov process, exp(-1 / (time_s rate_hz))."""
    return math.exp(-1.0 / (time_s * rate_hz)) if time_s > 0 else 0.0


def random_walk(white: ArrayLike, start: ArrayLike, rate_hz: float) -> tuple[Array, Array]:
    """A random walk whose variance grows by 1 per second; arguments and results as for `gauss_markov`."""
    walk = accumulate(start, np.asarray(white, float) / math.sqrt(rate_hz))
    return walk[:-1], walk[-1]


def accumulate(start: ArrayLike, steps: ArrayLike) -> Array:
    """Start and its sums with successive steps: shapes (...) and (K, ...) give (K + 1, ...)."""
    return np.cumsum(np.concatenate([np.asarray(start, float)[None], steps]), axis=0)


class GaussMarkov(Stateful):
    """A Gauss-Markov process of standard deviation 1, continued from call to call; see `gauss_markov`."""

    def __init__(self, rng: np.random.Generator, time_s: float, rate_hz: float) -> None:
        super().__init__(rng, value=rng.standard_normal())
        self._time_s, self._rate_hz = time_s, rate_hz

    def next(self, count: int) -> Array:
        """The next samples, shape (count,), or (count, R) for R robots."""
        white = self.normal(count, 1)[..., 0]
        series, self.state["value"] = gauss_markov(white, self.state["value"], self._time_s, self._rate_hz)
        return series
