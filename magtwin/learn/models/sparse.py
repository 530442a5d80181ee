"""Skipping: units that ReLU has zeroed are left out of the next layer's sums, and no bit changes by it.

In the deeper layers of a trained network most units are 0 in most rows: of the released one's hidden layers
.33, .10, .06 and .01 are not. Adding up what is not 0 gives the sum of all for a fraction of the work.
Compiled code does that in the order in which this machine's matrix products add. That it does is seen on
rows of each shape of layer before it is used; where no order gives their bits, products stay dense. So a row
has the same bytes whatever works on it, and which it is is a matter of time alone.
"""

import math
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

SPARSE = 0.25
"""Share of units that are not 0 below which it is faster to leave the others out than a dense product."""

LARGE = 128 * 128
"""Weights of a layer from which on it is so; of a smaller one, finding what is not 0 takes as long."""

LOOKED_AT = 16
"""Rows of a block that this share is estimated from."""

PAYS = 1e11
"""Multiplications left out that take as long as opening the compiled code; who had as many has more."""

NUMBA = 20
"""How much less that is where numba is open already, for lookups of fields or for courses."""

PROBE = 64
"""Rows on which the order of sums is looked for."""

STEP = 16
"""Chunks of sums are tried in multiples of this."""


def warm_up() -> None:
    """Leave out zeros from now on, as pays before some 100,000 rows.

    Takes a second where the machine code has been kept from an earlier time, else some. It gives the same
    bits.

    Raises:
        ImportError: numba does not work here. Products stay dense then.
    """
    from magtwin.learn.models import compiled

    Skipping.compiled = compiled


class Skipping:
    """Layers of a perceptron of which some blocks of rows are worked on without their zeros.

    Several threads may use it at once.
    """

    compiled: ClassVar[ModuleType | None] = None
    """The compiled code, once opened."""

    left_out: ClassVar[float] = 0.0
    """Multiplications that might have been left out before it was."""

    chunks: ClassVar[dict[tuple[int, int], int | None]] = {}
    """Units that this machine's products sum up on their own, by inputs and outputs of a layer; none where no
    order gives their bits."""

    def __init__(self, layers: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
        """Layers, first to last: weights (in, out) and biases (out,), float32 on the CPU, not copied."""
        self._layers = layers
        self._flat: dict[int, NDArray[np.float32]] = {}

    def forward(self, layer: int, h: torch.Tensor, out: torch.Tensor) -> bool:
        """Work on a block of rows without its zeros, if that is faster and gives the bits of the product.

        Args:
            layer: Which layer; one that ReLU stands before and behind.
            h: What the layer before gave, (N, K), contiguous.
            out: Takes what this layer gives, (N, M), contiguous.

        Returns:
            Whether it did; else `out` is as it was.
        """
        if h.shape[1] * out.shape[1] < LARGE:
            return False
        rows = h.numpy()
        some = rows[:: max(1, len(rows) // LOOKED_AT)]
        share = np.count_nonzero(some) / some.size
        if share >= SPARSE or not self._opened((1 - share) * h.numel() * out.shape[1]):
            return False
        weight, bias = self._layers[layer]
        chunk = self.chunk_of(*weight.shape)
        if chunk is None or self.compiled is None:
            return False
        if layer not in self._flat:
            self._flat[layer] = weight.contiguous().numpy().reshape(-1)
        self.compiled.forward(rows, self._flat[layer], bias.numpy(), chunk, out.numpy())
        return True

    @classmethod
    def chunk_of(cls, inputs: int, outputs: int) -> int | None:
        """Units that products of such a layer sum up on their own here; none where no order gives their bits.

        Args:
            inputs: Units of the layer before.
            outputs: Units of the layer.
        """
        if cls.compiled is None:
            return None
        shape = inputs, outputs
        if shape not in cls.chunks:
            cls.chunks[shape] = _order(cls.compiled, inputs, outputs)
        return cls.chunks[shape]

    @classmethod
    def _opened(cls, products: float) -> bool:
        """Whether the compiled code is open, or it pays to open it now for so many more multiplications."""
        if cls.compiled is None:
            cls.left_out += products
            if cls.left_out >= PAYS / (NUMBA if "numba" in sys.modules else 1):
                try:
                    warm_up()
                except ImportError:
                    cls.left_out = -math.inf
        return cls.compiled is not None


def _order(code: ModuleType, inputs: int, outputs: int) -> int | None:
    """The chunk whose sums have the bits of a dense product, on rows half of which are 0."""
    wave = np.sin(np.arange(PROBE * inputs + (inputs + 1) * outputs)).astype(np.float32)
    h, weight, bias = np.split(wave, [PROBE * inputs, (PROBE + outputs) * inputs])
    h = np.maximum(h.reshape(PROBE, inputs), 0)
    tensors = (torch.from_numpy(part) for part in (bias, h, weight.reshape(inputs, outputs)))
    dense = torch.addmm(*tensors).relu_().numpy()
    found = np.empty_like(dense)
    for chunk in range(-(-inputs // STEP) * STEP, 0, -STEP):
        for rows in (1, PROBE):
            code.forward(h[:rows], weight, bias, chunk, found[:rows])
            if not np.array_equal(found[:rows], dense[:rows]):
                break
        else:
            return chunk
    return None
