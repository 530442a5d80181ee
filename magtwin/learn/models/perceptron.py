"""Layers worked through in blocks of rows, so that a row gives the same bytes whatever stands beside it."""

import itertools
import math
import threading
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.learn.data.inputs import Inputs
from magtwin.learn.models.sparse import Skipping

Array = NDArray[np.float64]
Layer = tuple[torch.Tensor, torch.Tensor]
"""Weights (out, in) and biases (out,), float32."""

CHUNK = 512
"""Rows worked on at once: layers of 512 then stay in a core's cache. 256 to 1,024 time alike."""

TILE = 16
"""Rows of the last chunk are filled up to a multiple of this, a whole number of the rows that
matrix kernels take at once, so that a row's bytes do not depend on its neighbours."""


def in_threads(work: Callable[[], None], threads: int) -> None:
    """Do `work` once in each of some threads, with torch's products in one thread each.

    Both cores are then busy between products too, which torch's own threads leave idle.

    Args:
        work: What each thread does; it takes its share of a common supply until none is left.
        threads: How many; for one at most, it is done here, with torch as it is.

    Raises:
        BaseException: The first that a thread raised, after all have ended.
    """
    if threads <= 1:
        work()
        return
    failures: list[BaseException] = []

    def guarded() -> None:
        try:
            work()
        except BaseException as error:
            failures.append(error)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        others = [threading.Thread(target=guarded) for _ in range(threads - 1)]
        for thread in others:
            thread.start()
        guarded()
        for thread in others:
            thread.join()
    finally:
        torch.set_num_threads(before)
    if failures:
        raise failures[0]


def outputs(layers: Sequence[Layer], inputs: Inputs, x: Array) -> Array:
    """What a multilayer perceptron gives for each row, shape (N, K), K the width of its last layer.

    Each block of rows is worked on by one thread, in a fixed order, and blocks are shared out among as
    many threads as torch would use; so the result does not depend on the number of threads, nor a row's
    on the other rows. Inputs are scaled in float64, products are float32; a row with a nan gives nan.

    Args:
        layers: First to last; ReLU stands between them.
        inputs: Scaler of the rows.
        x: Features in their units, shape (N, F), contiguous.
    """
    y = np.empty((len(x), len(layers[-1][1])))
    starts = itertools.count(0, CHUNK)  # next() on it is atomic
    threads = min(torch.get_num_threads(), math.ceil(len(x) / CHUNK))
    transposed = [(weight.t(), bias) for weight, bias in _widened(layers)]
    skipping = Skipping(transposed)
    in_threads(lambda: _work(transposed, skipping, inputs, x, y, starts), threads)
    return y


def _widened(layers: Sequence[Layer]) -> list[Layer]:
    """Layers whose products give a row the same bytes wherever it stands in a block.

    Of less than a dozen outputs from inputs that are no multiple of 4 the matrix kernels round a row by its
    place; such a layer gets further outputs, which are 0 and which the next one takes as nothing.
    """
    found: list[Layer] = []
    for weight, bias in layers:
        if found and (more := len(found[-1][1]) - weight.shape[1]):
            weight = torch.nn.functional.pad(weight, (0, more))
        if len(bias) < TILE and weight.shape[1] % 4:
            more = TILE - len(bias)
            weight, bias = (
                torch.nn.functional.pad(weight, (0, 0, 0, more)),
                torch.cat([bias, bias.new_zeros(more)]),
            )
        found.append((weight, bias))
    return found


def _work(
    layers: Sequence[Layer],
    skipping: Skipping,
    inputs: Inputs,
    x: Array,
    y: Array,
    starts: "itertools.count[int]",
) -> None:
    """Go through chunks until none is left; nothing is allocated between the first and the last."""
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
                if 0 < i < len(layers) - 1 and skipping.forward(i, blocks[i], blocks[i + 1]):
                    continue
                torch.addmm(bias, blocks[i], weight, out=blocks[i + 1])
                if i < len(layers) - 1:
                    blocks[i + 1].relu_()
            y[start : start + n] = last[:n, : y.shape[1]]
