"""Nodes of a map: their variances, which cost the most, are computed at some and interpolated between."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROOT = 0.5  # Power of the variance that is interpolated


def variance_at_nodes(p_xy: Array, step_m: float, variance_of: Callable[[Array], Array]) -> Array:
    """Variances at evenly spaced nodes, computed at nodes at most `step_m` apart.

    Nodes have shape (Y, X, 2), variances [nT^2] (Y, X); `variance_of` takes positions (N, 2).
    """
    cell = np.linalg.norm(p_xy[1, 0] - p_xy[0, 0]), np.linalg.norm(p_xy[0, 1] - p_xy[0, 0])
    shape = p_xy.shape[:2]
    strides = [max(1, int(step_m / step + 1e-9)) for step in cell]
    rows, columns = (
        np.unique([*range(0, n, stride), n - 1]) for n, stride in zip(shape, strides, strict=True)
    )
    coarse = p_xy[np.ix_(rows, columns)]
    root = variance_of(coarse.reshape(-1, 2)).reshape(coarse.shape[:2]) ** ROOT
    every = [np.arange(n) for n in shape]
    root = np.array([np.interp(every[1], columns, row) for row in root])
    root = np.array([np.interp(every[0], rows, column) for column in root.T]).T
    return np.asarray(root ** (1 / ROOT))
