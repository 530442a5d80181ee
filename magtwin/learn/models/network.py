"""FieldNet: a multilayer perceptron that predicts the disturbance, with its scalers, in one file."""

import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.files import sha256
from magtwin.kinds import expected
from magtwin.learn.data.features import FULL, feature_names
from magtwin.learn.data.inputs import Inputs, inputs_of
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.checkpoint import read_checkpoint
from magtwin.learn.models.perceptron import outputs
from magtwin.learn.models.regressor import summary_of, wide_figures, wide_sd_nt
from magtwin.learn.models.weights import (
    MetadataValue,
    Weights,
    is_checkpoint,
    read_weights,
    say,
    shown,
    write_weights,
)
from magtwin.report import Figure, Report
from magtwin.summary import Summarized, Summary

Array = NDArray[np.float64]

_SCALERS = ("x_mean", "x_scale", "x_min", "x_max", "y_mean", "y_scale")


class FieldNet(Summarized, torch.nn.Module):
    """Disturbance of the field magnitude [nT] from features of a Run, (B, F) -> (B,).

    A multilayer perceptron between two scalers:

        y = y_mean + y_scale * W_L relu(... relu(W_1 z + b_1) ...) + b_L,   z = (x - x_mean) / x_scale

    Inputs are scaled in float64; with the scaler in float32 weights the error rises from 0.003 to 0.1 nT. In
    training, dropout follows every hidden layer but the last.
    """

    kind = "mlp"

    x_mean: torch.Tensor
    """Means of the training inputs, in the units of the features, shape (F,), float64."""
    x_scale: torch.Tensor
    """Scales of the training inputs, shape (F,), float64, above 0."""
    x_min: torch.Tensor
    """Smallest training inputs, shape (F,), float64; nan if unknown."""
    x_max: torch.Tensor
    """Largest training inputs, shape (F,), float64; nan if unknown."""
    y_mean: torch.Tensor
    """Mean of the training labels [nT], shape (), float64."""
    y_scale: torch.Tensor
    """Scale of the training labels [nT], shape (), float64, above 0."""

    def __init__(
        self,
        features: str | Sequence[str] = "full",
        hidden: Sequence[int] = (512, 512, 512, 512),
        *,
        dropout: float = 0.3,
        residual_sd_nt: float = math.nan,
        metadata: Mapping[str, MetadataValue] | None = None,
        device: str | None = None,
    ) -> None:
        """Make a network with random weights and identity scalers.

        Args:
            features: Names of the inputs, in order, or the name of a set.
            hidden: Widths of the hidden layers.
            dropout: Share of units dropped in training.
            residual_sd_nt: Root mean square error on held-out runs [nT]; nan if unknown.
            metadata: Provenance: training data, source, licence.
            device: Where the layers are; "meta" takes no memory.
        """
        super().__init__()
        self.features = feature_names(features)
        self.dropout = dropout
        self.residual_sd_nt = residual_sd_nt
        self.metadata: dict[str, MetadataValue] = dict(metadata or {})
        self.wide: Spread | None = None
        if not hidden or not all(width > 0 for width in hidden) or not 0 <= dropout < 1:
            raise InputError(
                f"a network needs hidden layers above 0 wide and dropout in 0..1, "
                f"got {tuple(hidden)} and {dropout}"
            )
        widths = [len(self.features), *hidden, 1]
        self.layers = torch.nn.ModuleList(
            torch.nn.Linear(a, b, device=device) for a, b in itertools.pairwise(widths)
        )
        ones = torch.ones(len(self.features), dtype=torch.float64)
        start = (0 * ones, ones, math.nan * ones, math.nan * ones, 0 * ones[0], ones[0].clone())
        for name, value in zip(_SCALERS, start, strict=True):
            self.register_buffer(name, value)

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(layer.out_features for layer in self.linears[:-1])

    @property
    def linears(self) -> list[torch.nn.Linear]:
        """The linear layers, first to last."""
        return [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]

    @property
    def parameters_count(self) -> int:
        """Number of weights and biases."""
        return sum(p.numel() for p in self.parameters())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Disturbances [nT], shape (B,), float64, from features in their units, shape (B, F)."""
        h = ((x - self.x_mean) / self.x_scale).to(self.linears[0].weight.dtype)
        return self.y_mean + self.y_scale * self.body(h).to(self.y_mean.dtype)

    def body(
        self, z: torch.Tensor, drop: Callable[[torch.Tensor], torch.Tensor] | None = None
    ) -> torch.Tensor:
        """Scaled labels, shape (B,), from scaled features, shape (B, F); `drop` replaces torch's dropout."""
        *inner, last = self.linears
        for i, layer in enumerate(inner):
            z = torch.relu(layer(z))
            if i < len(inner) - 1:
                z = drop(z) if drop else torch.nn.functional.dropout(z, self.dropout, self.training)
        return last(z).squeeze(-1)

    @property
    def layers_text(self) -> str:
        """Widths from inputs to output, as 20-512-1."""
        return "-".join(str(n) for n in (len(self.features), *self.hidden, 1))

    @property
    def inputs(self) -> Inputs:
        """Scaler and ranges of the inputs."""
        scalers = (self.x_mean, self.x_scale, self.x_min, self.x_max)
        return Inputs(self.features, *(value.detach().cpu().numpy() for value in scalers))

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and their standard deviations [nT], each (N,), from features in their units (N, F).

        The standard deviation is `residual_sd_nt` for every row. A row with nan gives nan. Products are
        float32; compared with float64 the released network errs by less than 0.01 nT.
        """
        inputs = self.inputs
        layers = [(layer.weight.detach(), layer.bias.detach()) for layer in self.linears]
        y = outputs(layers, inputs, inputs.checked(x))[:, 0]
        return float(self.y_mean) + float(self.y_scale) * y, np.full(len(y), self.residual_sd_nt)

    def wide_sd_nt(self, x: ArrayLike) -> Array | None:
        """As `Regressor.wide_sd_nt`."""
        return wide_sd_nt(self.wide, self.inputs, x)

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether an input of a row left the range of the training rows; see `Inputs.outside`."""
        return self.inputs.outside(x)

    def set_scalers(self, x: ArrayLike, y: ArrayLike) -> None:
        """Set scalers and training ranges from training rows.

        Args:
            x: Features, shape (N, F). A constant feature gets a scale of 1.
            y: Labels [nT], shape (N,).
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        of = inputs_of(x, self.features)
        values = (of.mean, of.scale, of.low, of.high, y.mean(), y.std())
        for name, value in zip(_SCALERS, values, strict=True):
            getattr(self, name).copy_(torch.as_tensor(value))

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write it to a safetensors file; the same network gives the same bytes.

        Raises:
            InputError: The file exists and `force` was not given.
        """
        write_weights(
            path,
            self.kind,
            self.state_dict(),
            features=self.features,
            residual_sd_nt=self.residual_sd_nt,
            metadata=self.metadata,
            hidden=self.hidden,
            dropout=self.dropout,
            wide=self.wide,
            force=force,
        )

    def report(self, title: str) -> Report:
        """Layers, inputs, scales and error."""
        figures = [
            Figure("layers", self.layers_text),
            Figure("parameters", self.parameters_count),
            Figure("inputs", ", ".join(self.features)),
            Figure("label mean", float(self.y_mean), "nT"),
            Figure("label sd", float(self.y_scale), "nT"),
        ]
        if not math.isnan(self.residual_sd_nt):
            figures.append(Figure("residual sd", self.residual_sd_nt, "nT", note="on held-out runs"))
        return Report(title, (*figures, *wide_figures(self.wide)), shown(self.metadata))

    def _summary(self) -> Summary:
        return summary_of(self, "FieldNet")


def load_net(path: str | os.PathLike[str]) -> FieldNet:
    """Load a network, safetensors or a released `.pth`, in evaluation mode.

    Raises:
        InputError: Neither of the two, another kind, damaged, or its parts do not fit each other.
    """
    if is_checkpoint(path):
        return net_of_checkpoint(path)
    weights = read_weights(path)
    if weights.kind != "mlp":
        raise InputError(f"{path}: holds a {weights.kind}, no multilayer perceptron; give one of those")
    net = net_of(weights)
    net.wide = weights.wide
    return net


def convert(
    checkpoint: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    licence: str = "",
    force: bool = False,
) -> FieldNet:
    """Convert a released `.pth` to safetensors; its inputs are the paper's 20.

    Args:
        checkpoint: The `.pth`.
        out: The safetensors file to write.
        licence: Licence of the weights, for their metadata.
        force: Replace an existing file.

    Raises:
        InputError: Not such a checkpoint, or `out` exists.
    """
    checkpoint = expected(checkpoint, "weights file")
    if checkpoint.suffix.lower() == ".safetensors":
        raise InputError(f"{checkpoint}: is a .safetensors already; magtwin info {checkpoint} describes it")
    net = net_of_checkpoint(checkpoint)
    if licence:
        net.metadata["licence"] = licence
    net.save(out, force=force)
    return net


def net_of_checkpoint(path: str | os.PathLike[str]) -> FieldNet:
    """The network of a released `.pth`, in evaluation mode.

    Raises:
        InputError: Not such a checkpoint.
    """
    path = Path(path)
    tensors, metadata = read_checkpoint(path)
    facts = {"source": path.name, "source_sha256": sha256(path), **metadata}
    about = {"features": FULL, "residual_sd_nt": None, "dropout": 0.3, "facts": facts}
    return net_of(Weights(path, "mlp", about, tensors))


def net_of(weights: Weights) -> FieldNet:
    """The network of a weights file, in evaluation mode.

    Raises:
        InputError: Its parts do not fit each other.
    """
    path, tensors = weights.path, weights.tensors
    dropout = weights.expect("dropout", float)
    layers = sum(name.startswith("layers.") and name.endswith(".weight") for name in tensors)
    missing = [name for name in _SCALERS if name not in tensors]
    missing += [f"layers.{i}.{p}" for i in range(max(layers, 2)) for p in ("weight", "bias")
                if f"layers.{i}.{p}" not in tensors]  # fmt: skip
    if missing:
        raise InputError(f"{path}: tensor {missing[0]!r} is missing; train or convert the network again")
    held = [tensors[f"layers.{i}.weight"] for i in range(layers)]
    for i, weight in enumerate(held):
        if weight.ndim != 2:
            raise InputError(
                f"{path}: tensor 'layers.{i}.weight' is {say(weight)}; a layer's have shape (out, in)"
            )
    try:
        net = FieldNet(
            weights.features,
            [len(weight) for weight in held[:-1]],
            dropout=dropout,
            residual_sd_nt=weights.residual_sd_nt,
            metadata=weights.about["facts"],
            device="meta",  # no memory before the shapes are checked
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    state = weights.fit(net.state_dict())
    if not (bool((tensors["x_scale"] > 0).all()) and bool(tensors["y_scale"] > 0)):
        raise InputError(f"{path}: a scale of its scalers is not above 0")
    net.load_state_dict(state, assign=True)
    return net.eval()
