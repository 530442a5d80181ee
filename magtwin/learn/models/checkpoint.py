"""Checkpoints as the paper's authors released theirs: a `.pth` with a network and two scalers.

`torch.save` wrote a dict with `model_state_dict` (linear layers in order), `scaler_X` and `scaler_y`
(scikit-learn StandardScalers). It is loaded with `weights_only=True`, which executes nothing; scikit-learn is
not needed.
"""

import codecs
import os
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy._core import multiarray
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files import existing

MOST_BYTES = 1 << 30  # Largest checkpoint that is read, unpacked

KEYS = ("model_state_dict", "scaler_X", "scaler_y")

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]


class StoredScaler:
    """Stands in for scikit-learn's StandardScaler: its attributes and nothing else."""


SAFE_GLOBALS: list[Any] = [
    (StoredScaler, "sklearn.preprocessing._data.StandardScaler"),
    *(
        (function, f"numpy.{package}.multiarray.{function.__name__}")
        for package in ("core", "_core")
        for function in (multiarray._reconstruct, multiarray.scalar)
    ),
    *(np.ndarray, np.dtype, np.dtypes.Float64DType, np.dtypes.Int64DType, codecs.encode),
]
"""What a checkpoint may name beside tensors."""


@dataclass(frozen=True)
class Checkpoint:
    """A multilayer perceptron with its scalers: y = y_mean + y_scale net((x - x_mean) / x_scale)."""

    layers: tuple[Layer, ...]
    """Weight (out, in) and bias (out,) of each linear layer, first to last; ReLU between them."""

    x_mean: NDArray[np.float64]
    """Means of the inputs, in their units, shape (F,)."""

    x_scale: NDArray[np.float64]
    """Scales of the inputs, above 0, shape (F,)."""

    y_mean: float
    """Mean of the label [nT]."""

    y_scale: float
    """Scale of the label [nT]."""

    samples: int
    """Rows that the input scaler was fitted to; 0 if unknown."""

    written_by: str
    """What wrote the scalers, such as "scikit-learn 1.5.2"."""


def read_checkpoint(path: str | os.PathLike[str], inputs: int | None = None) -> Checkpoint:
    """Read a released checkpoint without executing anything in it.

    Args:
        path: A `.pth` as `torch.save` writes it.
        inputs: Number of inputs that the network must have. `None` accepts any number.

    Raises:
        InputError: Not a checkpoint, damaged, or its pickle names a global that no network needs; or layers
            and scalers that do not fit each other.
    """
    path = existing(path, "checkpoint")
    saved = _load(path)
    try:
        layers = _layers(saved["model_state_dict"])
        x_mean, x_scale = _scaler("scaler_X", saved["scaler_X"])
        y_mean, y_scale = _scaler("scaler_y", saved["scaler_y"])
        width = layers[0][0].shape[1]
        if inputs is not None and width != inputs:
            raise InputError(f"its first layer takes {width} inputs; the released format has {inputs}")
        for name, mean, count in (("scaler_X", x_mean, width), ("scaler_y", y_mean, 1)):
            if len(mean) != count:
                raise InputError(f"{name} is for {len(mean)} columns, the network has {count}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    scaler = vars(saved["scaler_X"])
    seen, version = scaler.get("n_samples_seen_"), scaler.get("_sklearn_version")
    known = isinstance(version, str) and re.fullmatch(r"[\w.+-]{1,40}", version)
    return Checkpoint(
        layers,
        x_mean,
        x_scale,
        float(y_mean[0]),
        float(y_scale[0]),
        int(seen) if isinstance(seen, int | np.integer) else 0,
        f"scikit-learn {version}" if known else "scikit-learn",
    )


def _load(path: Path) -> dict[str, Any]:
    """The dict that a checkpoint holds, its keys checked."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > MOST_BYTES:
                raise InputError(f"{path}: {size:,} bytes unpacked; at most {MOST_BYTES:,} are read")
            if damaged := archive.testzip():  # torch itself tests no checksum
                raise InputError(f"{path}: member {ascii(damaged)[:60]} is damaged; get the file again")
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, OSError, EOFError, RuntimeError) as error:
        raise InputError(
            f"{path}: not the zip that torch.save writes, or damaged ({error}); get the file again"
        ) from error
    try:
        with torch.serialization.safe_globals(SAFE_GLOBALS):
            saved = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds on damaged files
        text = str(error)
        if match := re.search(r"(?:GLOBAL|function|class) ([\w.]+)", text):
            raise InputError(
                f"{path}: its pickle asks for {match[1]}, which no network needs; nothing of it was "
                "executed, do not load this file with other programs"
            ) from None
        reason = next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")
        raise InputError(f"{path}: damaged checkpoint ({ascii(reason)[:120]}); get the file again") from None
    missing = [key for key in KEYS if not (isinstance(saved, dict) and key in saved)]
    if missing:
        raise InputError(f"{path}: no {missing[0]!r} in it; a checkpoint has {', '.join(KEYS)}")
    return dict(saved)


def _layers(state: Any) -> tuple[Layer, ...]:
    """Linear layers of a state dict `name.weight`, `name.bias`, in the order of the file."""
    if not isinstance(state, dict) or not state:
        raise InputError("model_state_dict holds no tensors")
    tensors: dict[str, NDArray[np.float32]] = {}
    for name, tensor in state.items():
        if not isinstance(tensor, torch.Tensor) or not str(name).endswith((".weight", ".bias")):
            raise InputError(f"{ascii(name)[:60]} is neither weight nor bias of a linear layer")
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise InputError(f"tensor {name!r} is larger than what the file stores for it")
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"tensor {name!r} has numbers that are nan or infinite")
        tensors[name] = tensor.float().contiguous().numpy()
    layers: list[Layer] = []
    for name in dict.fromkeys(name.rpartition(".")[0] for name in tensors):
        weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
        if weight is None or bias is None:
            raise InputError(f"layer {name!r} has no {'weight' if weight is None else 'bias'}")
        if weight.ndim != 2 or bias.shape != weight.shape[:1] or not weight.size:
            raise InputError(f"layer {name!r} is not linear: weight {weight.shape}, bias {bias.shape}")
        if layers and weight.shape[1] != len(layers[-1][1]):
            raise InputError(
                f"layer {name!r} takes {weight.shape[1]} numbers, the one before gives {len(layers[-1][1])}"
            )
        layers.append((weight, bias))
    if len(layers[-1][1]) != 1:
        raise InputError(f"its last layer gives {len(layers[-1][1])} numbers; a magnetometer gives 1")
    return tuple(layers)


def _scaler(name: str, scaler: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and scale of a StandardScaler, each (F,)."""
    if not isinstance(scaler, StoredScaler):
        raise InputError(f"{name} is not a StandardScaler")
    values = vars(scaler)
    try:
        mean, scale = (np.asarray(values.get(key), float) for key in ("mean_", "scale_"))
    except (TypeError, ValueError):
        raise InputError(f"{name} has a mean or a scale that is no array of numbers") from None
    if mean.ndim != 1 or mean.shape != scale.shape or not mean.size:
        raise InputError(f"{name} has {mean.shape} means and {scale.shape} scales; was it fitted?")
    if values.get("with_mean") is False:
        mean = np.zeros_like(mean)
    if values.get("with_std") is False:
        scale = np.ones_like(scale)
    if not (np.isfinite(mean).all() and np.isfinite(scale).all() and (scale > 0).all()):
        raise InputError(f"{name} has a mean that is not finite, or a scale that is not above 0")
    return mean, scale
