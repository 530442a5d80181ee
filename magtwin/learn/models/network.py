"""FieldNet: a multilayer perceptron that predicts the disturbance, with its scalers, in one file."""

import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.files.kinds import expected
from magtwin.learn.data.features import FULL
from magtwin.learn.data.inputs import Array, inputs_from, scaler_tensors
from magtwin.learn.models.perceptron import Layer, outputs
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.weights import Weights, say
from magtwin.report.report import Figure


@dataclass(kw_only=True, repr=False)
class FieldNet(Predictor):
    """Disturbance of the field magnitude [nT] from features of a Run, (N, F) -> (N,).

    A multilayer perceptron between two scalers:

        y = y_mean + y_scale * W_L relu(... relu(W_1 z + b_1) ...) + b_L,   z = (x - x_mean) / x_scale

    Inputs are scaled in float64; with the scaler in float32 weights the error rises from 0.003 to 0.1 nT.
    """

    layers: tuple[Layer, ...]
    """Linear layers, first to last."""

    y_mean: float = 0.0
    """Mean of the training labels [nT]."""

    y_scale: float = 1.0
    """Scale of the training labels [nT], above 0."""

    dropout: float = 0.3
    """Share of units dropped in training."""

    kind = "mlp"

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(len(layer.bias) for layer in self.layers[:-1])

    @property
    def parameters_count(self) -> int:
        """Number of weights and biases."""
        return sum(part.size for layer in self.layers for part in layer)

    @property
    def layers_text(self) -> str:
        """Widths from inputs to output, as 20-512-1."""
        return "-".join(str(n) for n in (len(self.features), *self.hidden, 1))

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and their standard deviations [nT], each (N,), from features in their units (N, F).

        The standard deviation is `residual_sd_nt` for every row. A row with nan gives nan. Products are
        float32; compared with float64 the released network errs by less than 0.01 nT.
        """
        y = outputs(self.layers, self.inputs, self.inputs.checked(x))[:, 0]
        return self.y_mean + self.y_scale * y, np.full(len(y), self.residual_sd_nt)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Scalers and ranges, float64, and layers, float32."""
        return {
            **self.inputs.tensors(),
            "y_mean": np.array(self.y_mean),
            "y_scale": np.array(self.y_scale),
            **{
                f"layers.{i}.{part}": value
                for i, layer in enumerate(self.layers)
                for part, value in layer._asdict().items()
            },
        }

    def settings(self) -> dict[str, Any]:
        """Widths of the hidden layers, and dropout."""
        return {"hidden": self.hidden, "dropout": self.dropout}

    def figures(self) -> list[Figure]:
        """Layers, inputs and the scale of labels."""
        return [
            Figure("layers", self.layers_text),
            Figure("parameters", self.parameters_count),
            Figure("inputs", ", ".join(self.features)),
            Figure("label mean", self.y_mean, "nT"),
            Figure("label sd", self.y_scale, "nT"),
        ]


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
    """The network of a released `.pth`, which torch reads.

    Raises:
        InputError: Not such a checkpoint.
    """
    from magtwin.learn.models.checkpoint import read_checkpoint

    path = Path(path)
    tensors, metadata = read_checkpoint(path)
    facts = {"source": path.name, "source_sha256": sha256(path), **metadata}
    about = {"features": FULL, "residual_sd_nt": None, "dropout": 0.3, "facts": facts}
    return net_of(Weights(path, "mlp", about, tensors))


def net_of(weights: Weights) -> FieldNet:
    """The network of a weights file.

    Raises:
        InputError: Its parts do not fit each other.
    """
    path, tensors = weights.path, weights.tensors
    dropout = weights.expect("dropout", float)
    count = sum(name.startswith("layers.") and name.endswith(".weight") for name in tensors)
    names = [f"layers.{i}.{part}" for i in range(max(count, 2)) for part in Layer._fields]
    missing = [name for name in (*scaler_tensors(0), "y_mean", "y_scale", *names) if name not in tensors]
    if missing:
        raise InputError(f"{path}: tensor {missing[0]!r} is missing; train or convert the network again")
    held = [tensors[f"layers.{i}.weight"] for i in range(count)]
    for i, weight in enumerate(held):
        if weight.ndim != 2:
            raise InputError(
                f"{path}: tensor 'layers.{i}.weight' is {say(weight)}; a layer's have shape (out, in)"
            )
    hidden = [len(weight) for weight in held[:-1]]
    if not all(hidden) or not 0 <= dropout < 1:
        raise InputError(
            f"{path}: a network needs hidden layers above 0 wide and dropout in 0..1, got {hidden}, {dropout}"
        )
    widths = [len(weights.features), *hidden, 1]
    one = np.ones((), np.float32)  # broadcast takes no memory before the shapes are checked
    like = scaler_tensors(len(weights.features)) | {"y_mean": np.ones(()), "y_scale": np.ones(())}
    for i, (a, b) in enumerate(itertools.pairwise(widths)):
        like |= {f"layers.{i}.weight": np.broadcast_to(one, (b, a))}
        like |= {f"layers.{i}.bias": np.broadcast_to(one, (b,))}
    state = weights.fit(like)
    inputs = inputs_from(weights.features, state, path)
    if not state["y_scale"] > 0:
        raise InputError(f"{path}: a scale of its scalers is not above 0")
    return FieldNet(
        inputs=inputs,
        layers=tuple(Layer(state[f"layers.{i}.weight"], state[f"layers.{i}.bias"]) for i in range(count)),
        y_mean=float(state["y_mean"]),
        y_scale=float(state["y_scale"]),
        dropout=dropout,
        residual_sd_nt=weights.residual_sd_nt,
        metadata=dict(weights.about["facts"]),
    )
