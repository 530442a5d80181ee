"""Checkpoints as the paper's authors released theirs: a `.pth` of weights and two scalers.

Such a file is a zip written by `torch.save`: `data.pkl`, a pickle of a dict with `model_state_dict`
(linear layers in order), `scaler_X` and `scaler_y` (scikit-learn StandardScalers), and one stored
member a tensor. It is read here as data, without torch and without scikit-learn; nothing of it runs.
"""

import math
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files import existing
from magtwin.learn.models.pickled import Global, Made, Outside, read_pickle

_ORDERED = "collections.OrderedDict"
_TENSOR = "torch._utils._rebuild_tensor_v2"
_SCALER = "sklearn.preprocessing._data.StandardScaler"
_DTYPE = "numpy.dtype"
_NDARRAY = "numpy.ndarray"
_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_SCALAR = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
_STORAGES = {
    "torch.FloatStorage": "f4",
    "torch.DoubleStorage": "f8",
    "torch.HalfStorage": "f2",
    "torch.LongStorage": "i8",
}
ADMITTED = frozenset(
    {_ORDERED, _TENSOR, _SCALER, "_codecs.encode", _DTYPE, _NDARRAY, *_RECONSTRUCT, *_SCALAR, *_STORAGES}
)
"""The globals that a checkpoint may name; each is only a word to us."""

_DTYPES = ("f4", "f8", "i4", "i8")
_MAX_MEMBERS = 1000
_MAX_PICKLE = 1 << 20  # the released one has 2,764 bytes
_MAX_BYTES = 1 << 30

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]


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
    """Rows that the input scaler was fitted to; 0 where the file does not say."""

    written_by: str
    """What wrote the scalers, such as "scikit-learn 1.5.2"."""


def read_checkpoint(path: str | os.PathLike[str], inputs: int | None = None) -> Checkpoint:
    """Read a released checkpoint as data.

    Args:
        path: A `.pth` as `torch.save` writes it.
        inputs: How many inputs the network must have; None takes any number.

    Raises:
        InputError: Not such a file, damaged, or one whose pickle names anything that a network does
            not need; or layers and scalers that do not fit each other.
    """
    path = existing(path, "checkpoint")
    where = str(path)
    members = _Members(path)
    saved = _items(read_pickle(members.read("data.pkl", _MAX_PICKLE), ADMITTED, where))
    if saved is None:
        raise InputError(f"{where}: its pickle holds no dict; a checkpoint has {_KEYS}")
    for key in ("model_state_dict", "scaler_X", "scaler_y"):
        if key not in saved:
            held = ", ".join(_show(k) for k in list(saved)[:8]) or "nothing"
            raise InputError(f"{where}: no {key!r} in it, only {held}; a checkpoint has {_KEYS}")
    reader = _Reader(members, where)
    layers = reader.layers(saved["model_state_dict"])
    x_mean, x_scale, samples, version = reader.scaler("scaler_X", saved["scaler_X"])
    y_mean, y_scale, _, _ = reader.scaler("scaler_y", saved["scaler_y"])
    width = layers[0][0].shape[1]
    if inputs is not None and width != inputs:
        raise InputError(
            f"{where}: its first layer takes {width} inputs; the released format has {inputs}, unnamed"
        )
    if len(x_mean) != width:
        raise InputError(f"{where}: scaler_X is for {len(x_mean)} inputs, the first layer for {width}")
    if len(y_mean) != 1:
        raise InputError(f"{where}: scaler_y is for {len(y_mean)} labels; a magnetometer has 1")
    return Checkpoint(layers, x_mean, x_scale, float(y_mean[0]), float(y_scale[0]), samples, version)


_KEYS = "model_state_dict, scaler_X and scaler_y"


class _Members:
    """The members of the zip that `torch.save` writes, all stored, under one folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        size = path.stat().st_size
        try:
            with zipfile.ZipFile(path) as archive:
                infos = archive.infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError, EOFError) as error:
            raise InputError(self._not_a_zip(error)) from error
        if len(infos) > _MAX_MEMBERS or size > _MAX_BYTES:
            raise self.refused(f"{len(infos)} members in {size} bytes; a checkpoint is smaller")
        self.infos: dict[str, zipfile.ZipInfo] = {}
        folders = set()
        for info in infos:
            folder, _, name = info.filename.partition("/")
            folders.add(folder)
            if (
                not (folder and name)
                or ".." in info.filename.split("/")
                or "\\" in info.filename
                or name in self.infos
            ):
                raise self.refused(f"member {_show(info.filename)} has a name that torch.save does not give")
            if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 0x1:
                raise self.refused(
                    f"member {_show(info.filename)} is packed or locked; torch.save stores them"
                )
            self.infos[name] = info
        if len(folders) > 1:
            raise self.refused("its members lie in several folders; torch.save makes one")
        if sum(info.file_size for info in infos) > size:
            raise self.refused(f"its members claim more bytes than the {size} of the file")
        order = self.read("byteorder", 16) if "byteorder" in self.infos else b"little"
        if order not in (b"little", b"big"):
            raise self.refused(f"byteorder is {_show(order)}; known: little, big")
        self.order = "<" if order == b"little" else ">"

    def read(self, name: str, limit: int = _MAX_BYTES) -> bytes:
        """All bytes of a member, its checksum tested."""
        info = self.infos.get(name)
        if info is None:
            raise self.refused(f"no member {name}; torch.save writes one")
        if info.file_size > limit:
            raise self.refused(f"member {name} has {info.file_size} bytes, at most {limit} are read")
        try:
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(info)
        except (
            zipfile.BadZipFile,
            NotImplementedError,
            ValueError,
            OSError,
            EOFError,
            RuntimeError,
        ) as error:
            raise self.refused(f"member {name} is damaged ({error}); get the file again") from error

    def refused(self, text: str) -> InputError:
        return InputError(f"{self.path}: {text}")

    def _not_a_zip(self, error: Exception) -> str:
        head = self.path.read_bytes()[:4] if self.path.is_file() else b""
        if head == b"PK\x03\x04":
            return f"{self.path}: a zip that is cut short or damaged ({error}); get the file again"
        if head[:1] == b"\x80":
            return f"{self.path}: a bare pickle, not the zip that torch.save writes since 1.6; save it anew"
        return f"{self.path}: not a checkpoint: torch.save writes a zip, this begins with {_show(head)}"


class _Reader:
    """Gives meaning to what the pickle said; every claim of it is tested before it is used."""

    def __init__(self, members: _Members, where: str) -> None:
        self.members, self.where = members, where

    def refused(self, text: str) -> InputError:
        return InputError(f"{self.where}: {text}")

    def layers(self, saved: Any) -> tuple[Layer, ...]:
        """Linear layers from a state dict `name.weight`, `name.bias`, in the order of the file."""
        state = _items(saved)
        if not state:
            raise self.refused("model_state_dict holds no tensors")
        tensors = {str(name): self.tensor(str(name), value) for name, value in state.items()}
        names = []
        for name in tensors:
            layer, _, part = name.rpartition(".")
            if part not in ("weight", "bias"):
                raise self.refused(f"tensor {_show(name)} is neither weight nor bias of a linear layer")
            if layer not in names:
                names.append(layer)
        layers = []
        width = None
        for name in names:
            weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
            if weight is None or bias is None:
                raise self.refused(f"layer {_show(name)} has no {'weight' if weight is None else 'bias'}")
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or not weight.size:
                raise self.refused(
                    f"layer {_show(name)} is not linear: weight {weight.shape}, bias {bias.shape}"
                )
            if width is not None and weight.shape[1] != width:
                raise self.refused(
                    f"layer {_show(name)} takes {weight.shape[1]} numbers, the one before gives {width}"
                )
            width = weight.shape[0]
            layers.append((weight, bias))
        if width != 1:
            raise self.refused(f"its last layer gives {width} numbers; a magnetometer gives 1")
        return tuple(layers)

    def tensor(self, name: str, value: Any) -> NDArray[np.float32]:
        """A tensor of finite numbers, rebuilt from its storage."""
        match value:
            case Made(
                args=(
                    Outside(key=("storage", Global(name=kind), str(member), _, _)),
                    int(offset),
                    tuple(shape),
                    tuple(stride),
                    *_,
                ),
            ) if value.name == _TENSOR and kind in _STORAGES and re.fullmatch("[0-9]{1,9}", member):
                pass
            case _:
                raise self.refused(f"{_show(name)} is not a tensor of numbers")
        data = np.frombuffer(
            self._whole(f"data/{member}", _STORAGES[kind]), self.members.order + _STORAGES[kind]
        )
        fits = (
            len(shape) == len(stride) <= 2
            and all(type(n) is int and 0 <= n <= len(data) for n in (offset, *shape, *stride))
            and math.prod(shape) <= len(data)
            and offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True)) < len(data)
        )
        if not fits:
            raise self.refused(
                f"tensor {_show(name)} reaches beyond the {len(data)} numbers of data/{member}"
            )
        strides = tuple(step * data.itemsize for step in stride)
        view = np.lib.stride_tricks.as_strided(data[offset:], shape, strides, writeable=False)
        with np.errstate(over="ignore"):
            tensor = np.ascontiguousarray(view.reshape(shape), np.float32)
        if not np.isfinite(tensor).all():
            bad = int(np.sum(~np.isfinite(tensor)))
            raise self.refused(f"tensor {_show(name)} has {bad} numbers that are nan or infinite")
        return tensor

    def _whole(self, member: str, kind: str) -> bytes:
        data = self.members.read(member)
        if not data or len(data) % np.dtype(kind).itemsize:
            raise self.refused(f"member {member} has {len(data)} bytes, not a whole number of {kind}")
        return data

    def scaler(self, key: str, value: Any) -> tuple[NDArray[np.float64], NDArray[np.float64], int, str]:
        """Mean and scale of a StandardScaler, rows that it saw, what wrote it."""
        if not (isinstance(value, Made) and value.name == _SCALER and isinstance(value.state, Mapping)):
            raise self.refused(f"{key} is not a StandardScaler")
        state = value.state
        mean, scale = (
            self.array(f"{key}.mean_", state.get("mean_")),
            self.array(f"{key}.scale_", state.get("scale_")),
        )
        if mean.ndim != 1 or mean.shape != scale.shape or not mean.size:
            raise self.refused(f"{key} has {mean.shape} means and {scale.shape} scales")
        if not (np.isfinite(mean).all() and np.isfinite(scale).all() and (scale > 0).all()):
            raise self.refused(f"{key} has a mean that is not finite, or a scale that is not above 0")
        if state.get("with_mean") is False:
            mean = np.zeros_like(mean)
        if state.get("with_std") is False:
            scale = np.ones_like(scale)
        version = state.get("_sklearn_version")
        seen = self.count(state.get("n_samples_seen_"))
        known = isinstance(version, str) and re.fullmatch(r"[\w.+-]{1,40}", version)
        return mean, scale, seen, f"scikit-learn {version}" if known else "scikit-learn"

    def array(self, name: str, value: Any) -> NDArray[np.float64]:
        """A numpy array of numbers."""
        match value:
            case Made(args=(Global(name=kind), *_), state=(_, tuple(shape), dtype, bool(fortran), raw)) if (
                value.name in _RECONSTRUCT and kind == _NDARRAY
            ):
                data = self.numbers(name, dtype, raw)
            case _:
                raise self.refused(f"{name} is missing or no array; was the scaler fitted?")
        if not all(type(n) is int and 0 <= n <= len(data) for n in shape) or math.prod(shape) != len(data):
            raise self.refused(f"{name} has {len(data)} numbers, which is not its shape")
        return data.reshape(shape, order="F" if fortran else "C")

    def count(self, value: Any) -> int:
        """A whole number, or a numpy scalar of one; 0 for anything else."""
        match value:
            case Made(args=(dtype, raw)) if value.name in _SCALAR:
                data = self.numbers("n_samples_seen_", dtype, raw)
                return int(data[0]) if len(data) == 1 and 0 <= data[0] < 1e15 else 0
            case int() if 0 <= value < 10**15:
                return value
        return 0

    def numbers(self, name: str, dtype: Any, raw: Any) -> NDArray[np.float64]:
        """Numbers from a numpy dtype and bytes, which protocol 2 spells as latin-1 text to encode."""
        match dtype:
            case Made(args=(str(kind), *_), state=(_, ("<" | ">") as order, *_)) if (
                dtype.name == _DTYPE and kind in _DTYPES
            ):
                kind = order + kind
            case _:
                raise self.refused(f"{name} is of a type that is not {', '.join(_DTYPES)}")
        match raw:
            case bytes():
                data = raw
            case Made(name="_codecs.encode", args=(str(text), "latin1")) if max(text, default="") < "\u0100":
                data = text.encode("latin1")
            case _:
                raise self.refused(f"{name} holds no bytes")
        if len(data) % np.dtype(kind).itemsize:
            raise self.refused(f"{name} has {len(data)} bytes, not a whole number of {kind}")
        return np.frombuffer(data, kind).astype(float)


def _items(value: Any) -> dict[str | int, Any] | None:
    """The entries of a dict or an OrderedDict; None for anything else."""
    if isinstance(value, Made) and value.name == _ORDERED and not value.args:
        return value.items
    return value if isinstance(value, dict) else None


def _show(value: Any) -> str:
    """A name from the file, in quotes, escaped and cut, so that a refusal stays one line."""
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
