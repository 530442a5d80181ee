"""The state of an unfinished training in a safetensors file: tensors, settings and the history of epochs."""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from magtwin.errors import InputError
from magtwin.files.budget import check_size
from magtwin.files.file import existing
from magtwin.files.outputs import output

FORMAT_VERSION = 1  # Version of the file; other versions are refused

Tensors = Mapping[str, torch.Tensor]


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of arrays, to recognise the data of a checkpoint."""
    checksum = hashlib.sha256()
    for array in arrays:
        checksum.update(np.ascontiguousarray(array).data)
    return checksum.hexdigest()


def save_state(
    path: str | os.PathLike[str],
    tensors: Tensors,
    settings: Mapping[str, Any],
    history: list[dict[str, Any]],
) -> None:
    """Write the state of a training, replacing the previous one atomically.

    Args:
        path: The file.
        tensors: Tensors that training continues from.
        settings: Everything that decides the outcome, as JSON.
        history: Finished epochs.
    """
    about = {"format_version": FORMAT_VERSION, "settings": settings, "history": history}
    metadata = {"magtwin training": json.dumps(about, sort_keys=True, allow_nan=False)}
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with output(path, force=True, at_once=True) as aside:
        aside.write_bytes(save(whole, metadata))


def load_state(
    path: str | os.PathLike[str], like: Tensors, settings: Mapping[str, Any]
) -> tuple[dict[str, torch.Tensor], list[dict[str, Any]]]:
    """Read the state of a training with the same settings.

    Args:
        path: A file that `save_state` wrote.
        like: Tensors of the required names, shapes and types.
        settings: Settings of the training to resume.

    Returns:
        Its tensors, and the finished epochs.

    Raises:
        InputError: No such file, damaged, or of another training; the text names the difference.
    """
    path = existing(path, "checkpoint")
    if path.is_dir():
        raise InputError(f"{path}: a folder; give the checkpoint of a training")
    check_size(path, "weights")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about = json.loads(metadata["magtwin training"])
        version, stored, history = (about[key] for key in ("format_version", "settings", "history"))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not the checkpoint of a training, or damaged; start anew") from error
    if version != FORMAT_VERSION:
        raise InputError(f"{path}: format version {version!r}, this magtwin reads {FORMAT_VERSION}")
    if not isinstance(stored, dict) or not isinstance(history, list):
        raise InputError(f"{path}: its settings or epochs are missing; start anew")
    for key, now in settings.items():
        if stored.get(key) != now:
            raise InputError(
                f"{path}: the checkpoint of another training: its {key} is {stored.get(key)!r}, here "
                f"{now!r}; resume with the same settings, or start anew"
            )
    for name in sorted({*like, *tensors}):
        if name not in tensors or name not in like:
            raise InputError(
                f"{path}: tensor {name!r} is {'missing' if name in like else 'unknown'}; start anew"
            )
        if tensors[name].shape != like[name].shape or tensors[name].dtype != like[name].dtype:
            raise InputError(f"{path}: tensor {name!r} has another shape or type; start anew")
    return tensors, history
