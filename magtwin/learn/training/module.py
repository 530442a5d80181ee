"""NetModule: the layers of a FieldNet as a module of torch, which trains them."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from magtwin.learn.data.inputs import SCALERS, Inputs
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.perceptron import Layer


class NetModule(torch.nn.Module):
    """A `FieldNet` in torch, differentiable: (B, F) -> (B,).

    In training, dropout follows every hidden layer but the last.
    """

    x_mean: torch.Tensor
    x_scale: torch.Tensor
    x_min: torch.Tensor
    x_max: torch.Tensor
    y_mean: torch.Tensor
    y_scale: torch.Tensor

    def __init__(
        self,
        inputs: Inputs,
        hidden: Sequence[int],
        *,
        dropout: float = 0.3,
        y_mean: float = 0.0,
        y_scale: float = 1.0,
    ) -> None:
        """Make a module with random weights; the arguments are those of a `FieldNet`."""
        super().__init__()
        self.features, self.dropout = inputs.features, dropout
        widths = [len(inputs.features), *hidden, 1]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(a, b) for a, b in itertools.pairwise(widths))
        labels = {"y_mean": np.array(y_mean), "y_scale": np.array(y_scale)}
        for name, value in (inputs.tensors() | labels).items():
            self.register_buffer(name, torch.tensor(value))

    @classmethod
    def of(cls, net: FieldNet) -> "NetModule":
        """The module with the scalers and weights of a network."""
        module = cls(net.inputs, net.hidden, dropout=net.dropout)
        module.load_state_dict({name: torch.tensor(value) for name, value in net.tensors().items()})
        return module.eval()

    def net(self, *, residual_sd_nt: float = math.nan) -> FieldNet:
        """The network with its scalers and weights."""
        count = len(self.layers)
        held = {name: value.detach().cpu().numpy().copy() for name, value in self.state_dict().items()}
        return FieldNet(
            inputs=Inputs(self.features, *(held[name] for name in SCALERS)),
            layers=tuple(
                Layer(*(held[f"layers.{i}.{part}"] for part in Layer._fields)) for i in range(count)
            ),
            y_mean=float(held["y_mean"]),
            y_scale=float(held["y_scale"]),
            dropout=self.dropout,
            residual_sd_nt=residual_sd_nt,
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Disturbances [nT], shape (B,), float64, from features in their units, shape (B, F)."""
        z = ((x - self.x_mean) / self.x_scale).to(next(self.parameters()).dtype)
        return self.y_mean + self.y_scale * self.body(z).to(self.y_mean.dtype)

    def body(
        self, z: torch.Tensor, drop: Callable[[torch.Tensor], torch.Tensor] | None = None
    ) -> torch.Tensor:
        """Scaled labels, shape (B,), from scaled features, shape (B, F); `drop` replaces torch's dropout."""
        *inner, last = self.layers
        for i, layer in enumerate(inner):
            z = torch.relu(layer(z))
            if i < len(inner) - 1:
                z = drop(z) if drop else torch.nn.functional.dropout(z, self.dropout, self.training)
        scaled: torch.Tensor = last(z).squeeze(-1)
        return scaled
