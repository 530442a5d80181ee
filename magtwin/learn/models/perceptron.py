"""The layers of a perceptron in blocks of rows; a row gives the same bytes whatever rows stand beside it."""

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.learn.data.inputs import Inputs

Array = NDArray[np.float64]
Layer = tuple[torch.Tensor, torch.Tensor]
"""Weights (out, in) and biases (out,), float32."""

CHUNK = 512  # Rows of a block: layers of 512 then stay in a core's cache

TILE = 16
"""Rows of the last block are padded to a multiple of this, a multiple of the rows that matrix kernels take at
once, so that a row's bytes do not depend on its neighbours."""


def in_threads(work: Callable[[], None], threads: int) -> None:
    """Run `work` in several threads, each with torch products in one thread.

    All cores then stay busy between products, which torch's own threads leave idle.

    Args:
        work: Takes items from a shared supply until none is left.
        threads: Number of threads; with 1 or fewer, `work` runs in the calling thread.

    Raises:
        BaseException: An exception of a thread, after all threads have ended.
    """
    if threads <= 1:
        work()
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            for job in [pool.submit(work) for _ in range(threads)]:
                job.result()
    finally:
        torch.set_num_threads(before)


def outputs(layers: Sequence[Layer], inputs: Inputs, x: Array) -> Array:
    """Outputs of a multilayer perceptron, shape (N, K), K the width of its last layer.

    One thread computes each block of rows in a fixed order, so the result does not depend on the number of
    threads, nor a row's on the other rows. Inputs are scaled in float64, products are float32; a row with a
    nan gives nan.

    Args:
        layers: First to last; ReLU stands between them.
        inputs: Scaler of the rows.
        x: Features in their units, shape (N, F), contiguous.
    """
    y = np.empty((len(x), len(layers[-1][1])))
    starts = itertools.count(0, CHUNK)  # next() on it is atomic
    threads = min(torch.get_num_threads(), math.ceil(len(x) / CHUNK))
    transposed = [(weight.t(), bias) for weight, bias in _widened(layers)]
    in_threads(lambda: _work(transposed, inputs, x, y, starts), threads)
    return y


def _widened(layers: Sequence[Layer]) -> list[Layer]:
    """Layers whose products give a row the same bytes wherever it stands in a block.

    With few outputs, and inputs that are no multiple of 4, the rounding of matrix kernels depends on a row's
    place. Such a layer gets more outputs, which are 0 and which the next layer ignores.
    """
    widened: list[Layer] = []
    for weight, bias in layers:
        if widened and (more := len(widened[-1][1]) - weight.shape[1]):
            weight = torch.nn.functional.pad(weight, (0, more))
        if len(bias) < TILE and weight.shape[1] % 4:
            more = TILE - len(bias)
            weight, bias = (
                torch.nn.functional.pad(weight, (0, 0, 0, more)),
                torch.cat([bias, bias.new_zeros(more)]),
            )
        widened.append((weight, bias))
    return widened


def _work(
    layers: Sequence[Layer],
    inputs: Inputs,
    x: Array,
    y: Array,
    starts: "itertools.count[int]",
) -> None:
    """Compute chunks until none is left; memory is allocated once."""
    rows = CHUNK if len(x) > CHUNK else -(-len(x) // TILE) * TILE
    z = np.zeros((rows, x.shape[1]))
    with torch.inference_mode():
        blocks = [torch.empty(rows, x.shape[1])] + [torch.empty(rows, len(bias)) for _, bias in layers]
        scaled, last = torch.from_numpy(z), blocks[-1].numpy()
        for start in starts:
            block = x[start : start + CHUNK]
            if not len(block):
                return
            n = len(block)
            np.subtract(block, inputs.mean, out=z[:n])
            np.divide(z[:n], inputs.scale, out=z[:n])
            blocks[0].copy_(scaled)
            for i, (weight, bias) in enumerate(layers):
                torch.addmm(bias, blocks[i], weight, out=blocks[i + 1])
                if i < len(layers) - 1:
                    blocks[i + 1].relu_()
            y[start : start + n] = last[:n, : y.shape[1]]
