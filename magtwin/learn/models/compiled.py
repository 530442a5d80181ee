"""Layers of a perceptron as machine code, compiled with numba: what `sparse.py` and `reading.py` open.

A sum over units is cut into chunks, each summed from its first unit to its last by fused multiplications and
added to what stands, the bias at first: the order of BLAS kernels. A unit that is 0 adds nothing to such a
sum and is left out; one that is nan stays in, so that nan comes out. Multiplications may be fused, sums are
never reordered, nor is anything taken to be finite. Machine code is kept where numba keeps it, in
`__pycache__` beside this file or, where that cannot be written to, in the user's cache folder; where neither
can, each process compiles anew.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Figures = NDArray[np.float64]

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}

MASK = 64
"""Units whose zeros are found at a time."""

AT_ONCE = 8
"""Units that are added in one go over a row: the sums are then fetched and put back an eighth as often."""

_UNIT = np.uint64(1)  # unsigned: numba would else look for indices from the end, and not vectorise
_NONE = np.float32(0)


def compiled(*signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile for one signature, at import, or take the machine code that was kept."""

    def compile_or_take(function: Callable[..., Any]) -> Any:
        try:
            return njit(signature, cache=True, **OPTIONS)(function)
        except (RuntimeError, OSError):  # nowhere to keep it, or no room there
            return njit(signature, **OPTIONS)(function)

    return compile_or_take


@intrinsic
def _lowest_of(context: Any, mask: Any) -> Any:
    """Number of the lowest bit that is set."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], context.get_constant(types.boolean, 1))

    return types.uint64(types.uint64), code


_lowest: Any = _lowest_of
"""As compiled code calls it, without the context."""


@njit(**OPTIONS)
def _alive(row: Floats, start: int, stop: int, units: NDArray[np.uint64], values: Floats) -> Any:
    """Which units of a chunk are not 0, and their values; filled up with zeros to a multiple of AT_ONCE."""
    count = np.uint64(0)
    end = np.uint64(stop)
    for first in range(np.uint64(start), end, np.uint64(MASK)):
        mask = np.uint64(0)
        if first + np.uint64(MASK) <= end:  # of a fixed length, so that it is vectorised
            for bit in range(np.uint64(MASK)):
                mask |= np.uint64(row[first + bit] != _NONE) << bit
        else:
            for bit in range(end - first):
                mask |= np.uint64(row[first + bit] != _NONE) << bit
        while mask:
            unit = first + _lowest(mask)
            mask &= mask - _UNIT
            units[count], values[count] = unit, row[unit]
            count += _UNIT
    while count % np.uint64(AT_ONCE):
        units[count], values[count] = np.uint64(start), _NONE
        count += _UNIT
    return count


@njit(**OPTIONS)
def _layer(
    row: Floats,
    weight: Floats,
    bias: Floats,
    chunk: int,
    out: Floats,
    units: NDArray[np.uint64],
    values: Floats,
    sums: Floats,
) -> None:
    """A row of a layer, out = bias + row @ weight; the last three are memory to work in."""
    inputs, width = row.shape[0], np.uint64(out.shape[0])
    for j in range(width):
        out[j] = bias[j]
    for start in range(0, inputs, chunk):
        count = _alive(row, start, min(inputs, start + chunk), units, values)
        if count == 0:
            continue
        for j in range(width):
            sums[j] = _NONE
        for i in range(0, count, AT_ONCE):
            k0, k1, k2, k3 = (
                units[i] * width,
                units[i + 1] * width,
                units[i + 2] * width,
                units[i + 3] * width,
            )
            k4, k5, k6 = units[i + 4] * width, units[i + 5] * width, units[i + 6] * width
            k7 = units[i + 7] * width
            x0, x1, x2, x3 = values[i], values[i + 1], values[i + 2], values[i + 3]
            x4, x5, x6, x7 = values[i + 4], values[i + 5], values[i + 6], values[i + 7]
            for j in range(width):
                s = sums[j] + x0 * weight[k0 + j]
                s = s + x1 * weight[k1 + j]
                s = s + x2 * weight[k2 + j]
                s = s + x3 * weight[k3 + j]
                s = s + x4 * weight[k4 + j]
                s = s + x5 * weight[k5 + j]
                s = s + x6 * weight[k6 + j]
                sums[j] = s + x7 * weight[k7 + j]
        for j in range(width):
            out[j] += sums[j]


_ROWS = types.Array(types.float32, 2, "C")
_FLAT = types.Array(types.float32, 1, "C", readonly=True)
_ROW = types.Array(types.float32, 1, "C")
_FIGURES = types.Array(types.float64, 1, "C")
_RANGES = types.Array(types.float64, 2, "C", readonly=True)


@compiled(_ROWS, _FLAT, _FLAT, types.int64, _ROWS)
def forward(h: Floats, weight: Floats, bias: Floats, chunk: int, out: Floats) -> None:
    """A layer with its ReLU on a block of rows: out = max(0, bias + h @ weight).

    Args:
        h: Rows, shape (N, K).
        weight: Weights, those of a unit of `h` together, shape (K M,).
        bias: Biases, shape (M,).
        chunk: Units of `h` that are summed up on their own.
        out: Takes the rows that come out, shape (N, M).
    """
    units, values = np.empty(chunk + AT_ONCE, np.uint64), np.empty(chunk + AT_ONCE, np.float32)
    sums = np.empty(out.shape[1], np.float32)
    for n in range(h.shape[0]):
        row = out[n]
        _layer(h[n], weight, bias, chunk, row, units, values, sums)
        for j in range(row.shape[0]):
            row[j] = _NONE if row[j] < _NONE else row[j]  # nan stays


@compiled(_FIGURES, _RANGES, _FIGURES)
def scaled(x: Figures, ranges: Figures, z: Figures) -> bool:
    """Scale a row, z = (x held within bounds - mean) / scale; gives whether one left the training's range.

    Args:
        x: Features, shape (F,); nan stays nan, and is outside.
        ranges: Means, scales, bounds that inputs are held within, and training ranges: shape (6, F).
        z: Takes the scaled row, shape (F,).
    """
    outside = False
    for i in range(x.shape[0]):
        value = x[i]
        outside |= not (ranges[4, i] <= value <= ranges[5, i])
        value = ranges[2, i] if value < ranges[2, i] else ranges[3, i] if value > ranges[3, i] else value
        z[i] = (value - ranges[0, i]) / ranges[1, i]
    return outside


@compiled(_FIGURES, _RANGES, types.Array(types.int64, 1, "C", readonly=True), _FLAT, _FIGURES, _ROW, _FIGURES)
def perceptron(
    x: Figures,
    ranges: Figures,
    widths: NDArray[np.int64],
    table: Floats,
    z: Figures,
    work: Floats,
    out: Figures,
) -> bool:
    """Scale a row and take it through all layers of a perceptron; gives what `scaled` gives.

    Args:
        x: As for `scaled`, and so the next one.
        ranges: Of the inputs.
        widths: Numbers of inputs, of each hidden layer's units, and of what comes out, shape (L + 1,).
        table: Weights, those of a unit together, and biases of each layer, one layer after the other.
        z: Takes the scaled row, shape (F,).
        work: Memory for two of the widest rows.
        out: Takes the scaled outputs, shape (O,).
    """
    outside: bool = scaled(x, ranges, z)
    most = work.shape[0] // 2
    units, values = np.empty(most + AT_ONCE, np.uint64), np.empty(most + AT_ONCE, np.float32)
    sums = np.empty(most, np.float32)
    row, other = work[:most], work[most:]
    for i in range(z.shape[0]):
        row[i] = np.float32(z[i])
    at = 0
    for layer in range(widths.shape[0] - 1):
        inputs, outputs = widths[layer], widths[layer + 1]
        weight = table[at : at + inputs * outputs]
        bias = table[at + inputs * outputs : at + (inputs + 1) * outputs]
        at += (inputs + 1) * outputs
        _layer(row[:inputs], weight, bias, inputs, other[:outputs], units, values, sums)
        if layer < widths.shape[0] - 2:
            for j in range(outputs):
                other[j] = _NONE if other[j] < _NONE else other[j]
        row, other = other, row
    for j in range(out.shape[0]):
        out[j] = row[j]
    return outside
