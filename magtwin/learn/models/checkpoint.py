"""Checkpoints as the paper's authors released theirs: a `.pth` with a network and two scalers.

`torch.save` wrote a dict with `model_state_dict` (linear layers in order), `scaler_X` and `scaler_y`
(scikit-learn StandardScalers). It is loaded with `weights_only=True`, which executes nothing; scikit-learn is
not needed.
"""

import codecs
import os
import pickletools
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy._core import multiarray
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_decoded
from magtwin.files.file import check_zip, existing_file

PICKLE = 4_000_000
"""Largest pickle of a checkpoint [bytes]; tensors are beside it."""

KEYS = ("model_state_dict", "scaler_X", "scaler_y")


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


def read_checkpoint(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, str | int]]:
    """Read a released checkpoint without executing anything in it.

    Args:
        path: A `.pth` as `torch.save` writes it.

    Returns:
        Tensors by the names of a FieldNet, not yet checked against each other, and metadata: what wrote the
        scalers, and the rows that they were fitted to (0 if unknown).

    Raises:
        InputError: Not a checkpoint, damaged, or its pickle names a global that no network needs.
    """
    path = existing_file(path, "checkpoint", "checkpoint")
    saved = _load(path)
    try:
        tensors = _layers(saved["model_state_dict"], path)
        for name in ("x", "y"):
            mean, scale = _scaler(f"scaler_{'X' if name == 'x' else name}", saved)
            tensors |= {f"{name}_mean": mean, f"{name}_scale": scale}
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    tensors |= {name: np.full_like(tensors["x_mean"], np.nan) for name in ("x_min", "x_max")}
    scaler = vars(saved["scaler_X"])
    rows, version = scaler.get("n_samples_seen_"), scaler.get("_sklearn_version")
    known = isinstance(version, str) and re.fullmatch(r"[\w.+-]{1,40}", version)
    return tensors, {
        "scalers_by": f"scikit-learn {version}" if known else "scikit-learn",
        "training_rows": int(rows) if isinstance(rows, int | np.integer) else 0,
    }


def _load(path: Path) -> dict[str, Any]:
    """The dict that a checkpoint holds, its keys checked."""
    try:
        with zipfile.ZipFile(path) as archive:
            check_zip(path, archive, "checkpoint", "members")
            for name in archive.namelist():
                if name.endswith("data.pkl"):
                    if archive.getinfo(name).file_size > PICKLE:
                        raise InputError(f"{path}: its pickle is too large for a network (over 4 MB)")
                    _check_encodings(archive.read(name), path)
            if damaged := archive.testzip():  # torch itself tests no checksum
                raise InputError(f"{path}: member {ascii(damaged)[:60]} is damaged; get the file again")
    except InputError:
        raise
    except (
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        OSError,
        EOFError,
        RuntimeError,
        ValueError,
    ) as error:
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


def _check_encodings(content: bytes, path: Path) -> None:
    """Refuse a pickle that names encodings other than Latin-1, that of bytes: each can double a text.

    Raises:
        InputError: It names another, or it is no pickle.
    """
    try:
        texts = [text for _, text, _ in pickletools.genops(content) if isinstance(text, str)]
    except ValueError as error:
        raise InputError(f"{path}: damaged checkpoint ({error}); get the file again") from error
    for text in texts:
        if len(text) < 40 and _is_codec(text):
            raise InputError(f"{path}: its pickle asks for the encoding {text!r}, which no network needs")


def _is_codec(text: str) -> bool:
    try:
        return codecs.lookup(text).name != "iso8859-1"
    except (LookupError, ValueError):
        return False


def _layers(state: Any, path: Path) -> dict[str, NDArray[Any]]:
    """Linear layers of a state dict `name.weight`, `name.bias`, numbered in the order of the file."""
    if not isinstance(state, dict) or not state:
        raise InputError("model_state_dict holds no tensors")
    numbers: dict[str, int] = {}
    tensors: dict[str, NDArray[Any]] = {}
    held = 0
    for name, tensor in state.items():
        layer, _, part = str(name).rpartition(".")
        if not isinstance(tensor, torch.Tensor) or part not in ("weight", "bias"):
            raise InputError(f"{ascii(name)[:60]} is neither weight nor bias of a linear layer")
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise InputError(f"tensor {name!r} is larger than what the file stores for it")
        held += 4 * tensor.numel()  # tensors can share what is stored
        check_decoded(path, path.stat().st_size, held)
        number = numbers.setdefault(layer, len(numbers))
        tensors[f"layers.{number}.{part}"] = tensor.float().contiguous().numpy()
    return tensors


def _scaler(name: str, saved: dict[str, Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mean and scale of a StandardScaler, each (F,), or () for one column."""
    if not isinstance(saved[name], StoredScaler):
        raise InputError(f"{name} is not a StandardScaler")
    values = vars(saved[name])
    try:
        mean, scale = (np.asarray(values.get(key), float).squeeze() for key in ("mean_", "scale_"))
    except (TypeError, ValueError):
        raise InputError(f"{name} has a mean or a scale that is no array of numbers") from None
    if max(mean.size, scale.size) > BUDGETS["checkpoint"].count:
        raise InputError(f"{name} has {max(mean.size, scale.size):,} columns")
    mean = np.zeros_like(mean) if values.get("with_mean") is False else mean
    scale = np.ones_like(mean) if values.get("with_std") is False else scale
    return mean, scale
