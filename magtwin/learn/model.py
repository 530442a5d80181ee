"""FieldNet: a network that predicts the disturbance, with all it needs to be used, in one file."""

import itertools
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from magtwin.files import existing, output, sha256
from magtwin.learn.checkpoint import Checkpoint, read_checkpoint
from magtwin.learn.features import FEATURES, FULL, feature_names
from magtwin.names import RefusedError
from magtwin.report import Figure, Report

FORMAT_VERSION = 1
"""Version of the weights file; a reader refuses a later one."""

Fact = str | int | float | bool

_ZIP = b"PK\x03\x04"
_SCALERS = ("x_mean", "x_scale", "x_min", "x_max", "y_mean", "y_scale")


class FieldNet(torch.nn.Module):
    """Disturbance of the field's magnitude [nT] from features of a Run, (B, F) -> (B,).

    A multilayer perceptron between two scalers:

        y = y_mean + y_scale * W_L relu(... relu(W_1 z + b_1) ...) + b_L,   z = (x - x_mean) / x_scale

    Inputs are scaled in float64, because folding the scaler into float32 weights raises the error
    from 0.003 to 0.1 nT. In training, dropout follows every hidden layer but the last.
    """

    x_mean: torch.Tensor
    """Means of the training inputs, in the units of the features, shape (F,), float64."""
    x_scale: torch.Tensor
    """Scales of the training inputs, shape (F,), float64, above 0."""
    x_min: torch.Tensor
    """Smallest training inputs, shape (F,), float64; nan where unknown."""
    x_max: torch.Tensor
    """Largest training inputs, shape (F,), float64; nan where unknown."""
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
        facts: Mapping[str, Fact] | None = None,
    ) -> None:
        """A network with random weights and scalers that change nothing.

        Args:
            features: Names of the inputs, in order, or of a set of them.
            hidden: Widths of the hidden layers.
            dropout: Share of units dropped in training.
            residual_sd_nt: Standard deviation of label minus prediction on held-out runs [nT]; nan
                where unknown.
            facts: Provenance: on what it was trained, source, licence.
        """
        super().__init__()
        self.features = feature_names(features)
        self.dropout = dropout
        self.residual_sd_nt = residual_sd_nt
        self.facts: dict[str, Fact] = dict(facts or {})
        if not hidden or not all(width > 0 for width in hidden) or not 0 <= dropout < 1:
            raise RefusedError(
                f"a network needs hidden layers above 0 wide and dropout in 0..1, "
                f"got {tuple(hidden)} and {dropout}"
            )
        widths = [len(self.features), *hidden, 1]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(a, b) for a, b in itertools.pairwise(widths))
        ones = torch.ones(len(self.features), dtype=torch.float64)
        for name, value in (
            ("x_mean", 0 * ones),
            ("x_scale", ones),
            ("x_min", math.nan * ones),
            ("x_max", math.nan * ones),
            ("y_mean", 0 * ones[0]),
            ("y_scale", ones[0].clone()),
        ):
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

    def body(self, z: torch.Tensor) -> torch.Tensor:
        """Scaled labels, shape (B,), from scaled features, shape (B, F): what training works on."""
        *inner, last = self.linears
        for i, layer in enumerate(inner):
            z = torch.relu(layer(z))
            if i < len(inner) - 1:
                z = torch.nn.functional.dropout(z, self.dropout, self.training)
        return last(z).squeeze(-1)

    def set_scalers(self, x: ArrayLike, y: ArrayLike) -> None:
        """Take scalers and training ranges from training rows.

        Args:
            x: Features, shape (N, F). One that does not vary keeps a scale of 1.
            y: Labels [nT], shape (N,).
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        scale = x.std(axis=0)
        scale[scale < 1e-12 * np.maximum(1.0, np.abs(x).max(axis=0))] = 1.0
        for name, value in (
            ("x_mean", x.mean(axis=0)),
            ("x_scale", scale),
            ("x_min", x.min(axis=0)),
            ("x_max", x.max(axis=0)),
            ("y_mean", y.mean()),
            ("y_scale", y.std()),
        ):
            getattr(self, name).copy_(torch.as_tensor(value))

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write weights, scalers and everything else to one safetensors file; same net, same bytes.

        Raises:
            RefusedError: The file exists and `force` was not given.
        """
        about = {
            "format_version": FORMAT_VERSION,
            "features": self.features,
            "units": [FEATURES[name].unit for name in self.features],
            "hidden": self.hidden,
            "dropout": self.dropout,
            "output": "disturbance of the field's magnitude",
            "output_unit": "nT",
            "residual_sd_nt": None if math.isnan(self.residual_sd_nt) else self.residual_sd_nt,
            "facts": self.facts,
        }
        tensors = {name: value.detach().cpu().contiguous() for name, value in self.state_dict().items()}
        # One key, because safetensors orders several at random.
        metadata = {"magtwin": json.dumps(about, sort_keys=True, allow_nan=False)}
        with output(path, force=force) as aside:
            aside.write_bytes(save(tensors, metadata))  # save_file would leave it readable by its owner alone

    def report(self, title: str) -> Report:
        """What the network is, in figures."""
        figures = [
            Figure("layers", "-".join(str(n) for n in (len(self.features), *self.hidden, 1))),
            Figure("parameters", self.parameters_count),
            Figure("inputs", ", ".join(self.features)),
            Figure("label mean", float(self.y_mean), "nT"),
            Figure("label sd", float(self.y_scale), "nT"),
        ]
        if not math.isnan(self.residual_sd_nt):
            figures.append(Figure("residual sd", self.residual_sd_nt, "nT", note="on held-out runs"))
        return Report(title, tuple(figures), dict(self.facts))


def load_net(path: str | os.PathLike[str]) -> FieldNet:
    """A network from its file: magtwin's safetensors, or a released `.pth`; in evaluation mode.

    Raises:
        RefusedError: Neither of the two, damaged, or parts that do not fit each other.
    """
    path = existing(path, "weights file")
    if path.is_dir():
        raise RefusedError(f"{path}: a folder; give a weights file, .safetensors or .pth")
    with path.open("rb") as file:
        head = file.read(9)
    if head[:4] == _ZIP or path.suffix in (".pth", ".pt"):
        return _from_checkpoint(read_checkpoint(path, len(FULL)), path)
    if head[8:9] != b"{":
        raise RefusedError(f"{path}: no weights: neither safetensors nor a PyTorch checkpoint (.pth)")
    return _from_safetensors(path)


def convert(
    checkpoint: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False
) -> FieldNet:
    """Turn a released `.pth` into safetensors, once; its inputs are the paper's 20.

    Args:
        checkpoint: The `.pth`, read as data (see `magtwin.learn.checkpoint`).
        out: The safetensors file to write.
        force: Whether one that exists is replaced.

    Raises:
        RefusedError: Not such a checkpoint, or `out` exists.
    """
    path = existing(checkpoint, "checkpoint")
    net = _from_checkpoint(read_checkpoint(path, len(FULL)), path)
    net.save(out, force=force)
    return net


def _from_checkpoint(saved: Checkpoint, path: Path) -> FieldNet:
    net = FieldNet(
        FULL,
        [len(bias) for _, bias in saved.layers[:-1]],
        facts={
            "source": path.name,
            "source_sha256": sha256(path),
            "scalers_by": saved.written_by,
            "training_rows": saved.samples,
        },
    )
    state: dict[str, Any] = {}
    for i, (weight, bias) in enumerate(saved.layers):
        state |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
    nan = np.full(len(FULL), math.nan)
    state |= {"x_mean": saved.x_mean, "x_scale": saved.x_scale, "x_min": nan, "x_max": nan}
    state |= {"y_mean": np.float64(saved.y_mean), "y_scale": np.float64(saved.y_scale)}
    net.load_state_dict({name: torch.tensor(value) for name, value in state.items()})
    return net.eval()


def _from_safetensors(path: Path) -> FieldNet:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise RefusedError(f"{path}: damaged safetensors ({error}); get the file again") from error
    about = _about(path, metadata)
    layers = sum(name.startswith("layers.") and name.endswith(".weight") for name in tensors)
    missing = [name for name in _SCALERS if name not in tensors]
    missing += [f"layers.{i}.{p}" for i in range(max(layers, 2)) for p in ("weight", "bias")
                if f"layers.{i}.{p}" not in tensors]  # fmt: skip
    if missing:
        raise RefusedError(f"{path}: tensor {missing[0]!r} is missing; train or convert the network again")
    weights = [tensors[f"layers.{i}.weight"] for i in range(layers)]
    for i, weight in enumerate(weights):
        if weight.ndim != 2:
            raise RefusedError(
                f"{path}: tensor 'layers.{i}.weight' is {_say(weight)}; a layer's have shape (out, in)"
            )
    try:
        net = FieldNet(
            about["features"],
            [len(weight) for weight in weights[:-1]],
            dropout=about["dropout"],
            residual_sd_nt=math.nan if about["residual_sd_nt"] is None else about["residual_sd_nt"],
            facts=about["facts"],
        )
    except RefusedError as error:
        raise RefusedError(f"{path}: {error}") from error
    for name, expected in net.state_dict().items():
        found = tensors[name]
        if found.shape != expected.shape or found.dtype != expected.dtype:
            raise RefusedError(
                f"{path}: tensor {name!r} is {_say(found)}, the {len(net.features)} features and the "
                f"other layers ask for {_say(expected)}"
            )
        if name not in ("x_min", "x_max") and not bool(torch.isfinite(found).all()):
            raise RefusedError(f"{path}: tensor {name!r} has numbers that are nan or infinite")
    if extra := sorted(set(tensors) - set(net.state_dict())):
        raise RefusedError(f"{path}: tensor {extra[0]!r} belongs to no layer of a FieldNet")
    if not (bool((tensors["x_scale"] > 0).all()) and bool(tensors["y_scale"] > 0)):
        raise RefusedError(f"{path}: a scale of its scalers is not above 0")
    net.load_state_dict(tensors)
    return net.eval()


def _about(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """What the file says of the network, every key there and of its type."""
    if "magtwin" not in metadata:
        raise RefusedError(f"{path}: safetensors without magtwin's metadata; not a network of magtwin's")
    try:
        about = json.loads(metadata["magtwin"])
    except ValueError as error:
        raise RefusedError(f"{path}: its metadata is not JSON ({error})") from error
    version = about.get("format_version") if isinstance(about, dict) else None
    if version != FORMAT_VERSION:
        raise RefusedError(
            f"{path}: format version {version!r}, this magtwin reads {FORMAT_VERSION}; update magtwin"
        )
    types = {"features": list, "units": list, "dropout": float, "residual_sd_nt": float | None, "facts": dict}
    for key, kind in types.items():
        if key not in about or not isinstance(about[key], kind):
            raise RefusedError(f"{path}: {key!r} of its metadata is missing or of the wrong type")
    if not about["features"] or not all(isinstance(name, str) for name in about["features"]):
        raise RefusedError(f"{path}: 'features' of its metadata must be names, one at least")
    sd = about["residual_sd_nt"]
    if sd is not None and not 0 <= sd < math.inf:
        raise RefusedError(
            f"{path}: 'residual_sd_nt' of its metadata must be from 0 nT up and finite, got {sd}"
        )
    for key, value in about["facts"].items():
        if not isinstance(value, Fact):
            raise RefusedError(f"{path}: fact {key!r} of its metadata must be text, a number, true or false")
    for name, unit in zip(about["features"], about["units"], strict=False):
        if name in FEATURES and FEATURES[name].unit != unit:
            raise RefusedError(
                f"{path}: reads {name} in {unit!r}, magtwin gives it in {FEATURES[name].unit!r}"
            )
    return about


def _say(tensor: torch.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"
