"""A perceptron on one row, compiled with numba, for live readings.

A unit that is 0 after ReLU adds nothing to the next layer and is skipped; nan stays nan. Sums are float32 and
may use fused multiplications.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

FUSED = {"contract"}  # Allows fused multiplications

_ARRAY = types.Array(types.float64, 1, "C")
_RANGES = types.Array(types.float64, 2, "C", readonly=True)
_WIDTHS = types.Array(types.int64, 1, "C", readonly=True)
_TABLE = types.Array(types.float32, 1, "C", readonly=True)
_WORK = types.Array(types.float32, 1, "C")


@compiled(_ARRAY, _RANGES, _ARRAY, fastmath=FUSED)
def scaled(x: Array, ranges: Array, z: Array) -> bool:
    """Scale a row, z = (x clipped to bounds - mean) / scale.

    Args:
        x: Features, shape (F,); nan stays nan and is outside.
        ranges: Means, scales, lower and upper bounds, lower and upper training range, shape (6, F).
        z: Output: the scaled row, shape (F,).

    Returns:
        Whether an input left the training range.
    """
    outside = False
    for i in range(x.shape[0]):
        value = x[i]
        outside |= not (ranges[4, i] <= value <= ranges[5, i])
        value = ranges[2, i] if value < ranges[2, i] else ranges[3, i] if value > ranges[3, i] else value
        z[i] = (value - ranges[0, i]) / ranges[1, i]
    return outside


@compiled(_ARRAY, _RANGES, _WIDTHS, _TABLE, _ARRAY, _WORK, _ARRAY, fastmath=FUSED)
def perceptron(
    x: Array, ranges: Array, widths: NDArray[np.int64], table: Floats, z: Array, work: Floats, out: Array
) -> bool:
    """Scale a row and pass it through all layers of a perceptron.

    Args:
        x: Features, shape (F,).
        ranges: As for `scaled`.
        widths: Number of inputs, hidden units of each layer, and outputs, shape (L + 1,).
        table: Weights (in, out) and biases of each layer, one layer after the other.
        z: Memory for the scaled row, shape (F,).
        work: Memory for two of the widest rows.
        out: Output: the scaled outputs, shape (O,).

    Returns:
        Whether an input left the training range.
    """
    outside: bool = scaled(x, ranges, z)
    most = work.shape[0] // 2
    row, sums = work[:most], work[most:]
    for i in range(z.shape[0]):
        row[i] = np.float32(z[i])
    at = np.uint64(0)  # unsigned, because numba would not vectorise with indices that may be negative
    layers = widths.shape[0] - 1
    for layer in range(layers):
        inputs, outputs = np.uint64(widths[layer]), np.uint64(widths[layer + 1])
        bias = at + inputs * outputs
        for j in range(outputs):
            sums[j] = table[bias + j]
        for i in range(inputs):
            value = row[i]
            if value == 0:
                continue
            first = at + i * outputs
            for j in range(outputs):
                sums[j] += value * table[first + j]
        if layer < layers - 1:
            for j in range(outputs):
                sums[j] = np.float32(0) if sums[j] < 0 else sums[j]
        at = bias + outputs
        row, sums = sums, row
    for j in range(out.shape[0]):
        out[j] = row[j]
    return outside
