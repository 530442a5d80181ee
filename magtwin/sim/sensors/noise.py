"""Noise that remembers: first-order processes and random walks, of white noise drawn sample by sample.

A longer series begins with the same numbers as a shorter one, to the bit.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_NOTHING = 1e-17
"""A share of the past that no double precision sum feels."""


def first_order(x: ArrayLike, decay: float) -> Array:
    """y_k = decay y_{k-1} + x_k, along the first axis.

    Done by doubling (Hillis and Steele 1986): after the pass of stride s, y_k holds the last 2 s terms. It
    takes few passes over whole arrays, and is as exact for a short memory as for a long one.

    Args:
        x: What comes in, shape (N, ...).
        decay: Share that is left of the last value, 0 to 1.

    Returns:
        y, the shape of `x`; y_0 = x_0.
    """
    y = np.array(x, float)
    stride, share = 1, float(decay)
    while stride < len(y) and share > _NOTHING:
        y[stride:] += share * y[:-stride]
        stride, share = 2 * stride, share * share
    return y


def gauss_markov(white: ArrayLike, time_s: float, rate_hz: float) -> Array:
    """A stationary first-order Gauss-Markov process of standard deviation 1.

    Its autocorrelation falls as exp(-|tau| / time_s).

    Args:
        white: Standard normal numbers, a sample a row, shape (N, ...).
        time_s: Correlation time [s]; 0 gives `white` back.
        rate_hz: Samples a second [Hz].

    Returns:
        The process, the shape of `white`.
    """
    x = np.array(white, float)
    decay = math.exp(-1.0 / (time_s * rate_hz)) if time_s > 0 else 0.0
    x[1:] *= math.sqrt(1.0 - decay * decay)
    return first_order(x, decay)


def random_walk(white: ArrayLike, rate_hz: float) -> Array:
    """A random walk from 0 whose variance grows by 1 a second.

    Args:
        white: Standard normal numbers, a sample a row, shape (N, ...); the first row is not used.
        rate_hz: Samples a second [Hz].

    Returns:
        The walk, the shape of `white`.
    """
    steps = np.array(white, float) / math.sqrt(rate_hz)
    steps[:1] = 0.0
    return np.cumsum(steps, axis=0)
