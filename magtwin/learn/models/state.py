"""The state of a training on its way, in one file, so that one that was killed goes on as if it had not been.

A safetensors file: tensors by name, and JSON of the settings that they belong to and how each epoch
went. Nothing of it is executed, and every tensor is held against the one that it is to replace.
"""

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
from magtwin.files import existing, output

FORMAT_VERSION = 1
"""Version of the file; a reader refuses another."""

Tensors = Mapping[str, torch.Tensor]


def digest(*arrays: NDArray[Any] | torch.Tensor) -> str:
    """SHA-256 of the numbers of arrays, by which a checkpoint knows what it was trained on."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def save_state(
    path: str | os.PathLike[str],
    tensors: Tensors,
    settings: Mapping[str, Any],
    history: list[dict[str, Any]],
) -> None:
    """Write the state of a training in place of the one before; a kill leaves one of the two, whole.

    Args:
        path: The file.
        tensors: What training goes on from.
        settings: What decides the outcome, as JSON has it.
        history: The epochs that are done.
    """
    about = {"format_version": FORMAT_VERSION, "settings": settings, "history": history}
    metadata = {"magtwin training": json.dumps(about, sort_keys=True, allow_nan=False)}
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with output(path, force=True) as aside:
        aside.write_bytes(save(whole, metadata))


def load_state(
    path: str | os.PathLike[str], like: Tensors, settings: Mapping[str, Any]
) -> tuple[dict[str, torch.Tensor], list[dict[str, Any]]]:
    """Read the state of a training, if it is one of these settings.

    Args:
        path: A file that `save_state` wrote.
        like: Tensors of the names, shapes and types that it must have.
        settings: Those of the training that is to go on, as JSON has them.

    Returns:
        Its tensors, and the epochs that are done.

    Raises:
        InputError: No such file, damaged, or the state of another training; the text says what differs.
    """
    path = existing(path, "checkpoint")
    if path.is_dir():
        raise InputError(f"{path}: a folder; give the checkpoint of a training")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about = json.loads(metadata["magtwin training"])
        version, told, history = (about[key] for key in ("format_version", "settings", "history"))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not the checkpoint of a training, or damaged; start anew") from error
    if version != FORMAT_VERSION:
        raise InputError(f"{path}: format version {version!r}, this magtwin reads {FORMAT_VERSION}")
    if not isinstance(told, dict) or not isinstance(history, list):
        raise InputError(f"{path}: its settings or epochs are missing; start anew")
    for key, now in settings.items():
        if told.get(key) != now:
            raise InputError(
                f"{path}: the checkpoint of another training: its {key} is {told.get(key)!r}, here {now!r}; "
                "go on with what it was begun with, or start anew"
            )
    for name in sorted({*like, *found}):
        if name not in found or name not in like:
            raise InputError(
                f"{path}: tensor {name!r} is {'missing' if name in like else 'unknown'}; start anew"
            )
        if found[name].shape != like[name].shape or found[name].dtype != like[name].dtype:
            raise InputError(f"{path}: tensor {name!r} has another shape or type; start anew")
    return found, history
