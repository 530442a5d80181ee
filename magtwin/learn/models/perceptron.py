"""The layers of a perceptron in blocks of rows.

A row's bytes depend neither on the other rows nor on their number. On some processors they depend, in the
last digits of float32, on its place in a block: the kernels of OpenBLAS for AVX2 treat the first and the last
six of twelve rows differently.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from magtwin.learn.data.inputs import Inputs

Array = NDArray[np.float64]

BLOCK = 512
"""Rows of a block; the last one is padded, because the rounding of a product depends on its number of rows.
Layers of 512 then stay in a core's cache."""


class Layer(NamedTuple):
    """A linear layer."""

    weight: NDArray[np.float32]
    """Shape (out, in)."""

    bias: NDArray[np.float32]
    """Shape (out,)."""


@functools.cache
def _blas() -> ThreadpoolController:
    """The libraries that compute numpy's products."""
    return ThreadpoolController().select(user_api="blas")


def threads_of_products() -> int:
    """Number of threads that numpy's products take now; 1 if that is unknown."""
    return max((library["num_threads"] for library in _blas().info()), default=1)


def in_threads(work: Callable[[], None], threads: int) -> None:
    """Run `work` in several threads, each with products in one thread.

    All cores then stay busy between products, which the threads of a product leave idle. `work` takes items
    from a shared supply until none is left. Its first exception is raised after all threads have ended.
    """
    with _blas().limit(limits=1):
        if threads <= 1:
            work()
            return
        with ThreadPoolExecutor(threads) as pool:
            for job in [pool.submit(work) for _ in range(threads)]:
                job.result()


def outputs(layers: Sequence[Layer], inputs: Inputs, x: Array) -> Array:
    """Outputs of a multilayer perceptron, shape (N, K), K the width of its last layer.

    One thread computes each block of rows in a fixed order, so the result does not depend on the number of
    threads, nor a row's on the other rows. Inputs are scaled in float64, products are
    float32; a row with a nan gives nan.

    Args:
        layers: First to last; ReLU stands between them.
        inputs: Scaler of the rows.
        x: Features in their units, shape (N, F), contiguous.
    """
    y = np.empty((len(x), len(layers[-1].bias)))
    starts = itertools.count(0, BLOCK)  # next() on it is atomic
    threads = min(threads_of_products(), math.ceil(len(x) / BLOCK))
    in_threads(lambda: _work(layers, inputs, x, y, starts), threads)
    return y


def _work(
    layers: Sequence[Layer], inputs: Inputs, x: Array, y: Array, starts: "itertools.count[int]"
) -> None:
    """Compute blocks until none is left; memory is allocated once."""
    z, first = np.zeros((BLOCK, x.shape[1])), np.empty((BLOCK, x.shape[1]), np.float32)
    widest = max(len(layer.bias) for layer in layers)
    memory = [np.empty(BLOCK * widest, np.float32) for _ in range(2)]  # in turn, to stay in the cache
    blocks = [
        memory[i % 2][: BLOCK * len(bias)].reshape(BLOCK, len(bias)) for i, (_, bias) in enumerate(layers)
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # rows beyond float32 give inf or nan
        for start in starts:
            block = x[start : start + BLOCK]
            if not len(block):
                return
            n = len(block)
            np.subtract(block, inputs.mean, out=z[:n])
            np.divide(z[:n], inputs.scale, out=z[:n])
            first[:] = z
            h = first
            for i, (weight, bias) in enumerate(layers):
                if len(bias) > 1:
                    h = np.matmul(h, weight.T, out=blocks[i])
                else:  # a product with a vector would depend on how memory is aligned
                    h = np.einsum("ij,kj->ik", h, weight, out=blocks[i])
                h += bias
                if i < len(layers) - 1:
                    np.maximum(h, 0, out=h)
            y[start : start + n] = h[:n]
