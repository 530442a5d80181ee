"""Weights files: tensors and what they say of themselves, as safetensors, of which nothing is executed."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from magtwin.errors import InputError
from magtwin.files import existing, output
from magtwin.learn.data.features import FEATURES, feature_names

MetadataValue = str | int | float | bool

VERSIONS = {"mlp": 1}
"""Version of the file by kind of predictor, `VERSION` for all others; other versions are refused."""

VERSION = 2

_ZIP = b"PK\x03\x04"
_TYPES = {"features": list, "units": list, "residual_sd_nt": float | None, "facts": dict}


@dataclass(frozen=True)
class Weights:
    """A weights file that was read; whether its tensors fit the rest shows when its kind takes them."""

    path: Path
    kind: str
    """"mlp", "linear", "hybrid", "ensemble" or "tcn"."""

    about: Mapping[str, Any]
    """Features, units, metadata, `residual_sd_nt`, and what the kind keeps beside them."""

    tensors: Mapping[str, torch.Tensor]

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(self.about["features"])

    @property
    def residual_sd_nt(self) -> float:
        """Root mean square error on held-out recordings [nT]; nan where unknown."""
        sd = self.about["residual_sd_nt"]
        return math.nan if sd is None else sd

    def with_tensors(self, tensors: Mapping[str, torch.Tensor]) -> "Weights":
        """The same file with a part of its tensors alone, under names of their own."""
        return replace(self, tensors=tensors)

    def expect(self, key: str, kind: Any) -> Any:
        """What the file says of itself under a key, if it is of a type.

        Raises:
            InputError: It is not there, or of another type.
        """
        value = self.about.get(key)
        if key not in self.about or not isinstance(value, kind):
            raise InputError(f"{self.path}: {key!r} of its metadata is missing or of the wrong type")
        return value

    def number(self, key: str, *, above: float = -math.inf) -> float:
        """A finite number that the file says of itself, above another.

        Raises:
            InputError: It is not there, no number, or not above.
        """
        value = self.expect(key, int | float)
        if isinstance(value, bool) or not above < value < math.inf:
            wanted = f"above {above:g} and finite" if above > -math.inf else "a finite number"
            raise InputError(f"{self.path}: {key!r} of its metadata must be {wanted}, got {value}")
        return float(value)

    def widths(self, key: str) -> tuple[int, ...]:
        """Whole numbers above 0 that the file says of itself, no more of them than its tensors hold numbers.

        Raises:
            InputError: They are not there, or none such.
        """
        values = self.expect(key, list)
        held = sum(tensor.numel() for tensor in self.tensors.values())
        if not values or not all(type(value) is int and 0 < value <= held for value in values):
            raise InputError(f"{self.path}: {key!r} of its metadata must be widths of layers, got {values}")
        return tuple(values)

    def check_size(self, count: int) -> None:
        """Refuse a file whose metadata ask for more numbers than its tensors hold, before room is made.

        Raises:
            InputError: They do.
        """
        held = sum(tensor.numel() for tensor in self.tensors.values())
        if count > held:
            raise InputError(
                f"{self.path}: its metadata ask for {count:,} weights, its tensors hold {held:,} numbers"
            )

    def fit(
        self, like: Mapping[str, torch.Tensor], *, unknown: Sequence[str] = ("x_min", "x_max")
    ) -> dict[str, torch.Tensor]:
        """The tensors, each held against the one of its name.

        Args:
            like: Tensors of the names, shapes and types that there must be.
            unknown: Names of those that may hold nan.

        Raises:
            InputError: One is missing or one too many, of another shape or type, or not finite.
        """
        for name, expected in like.items():
            if name not in self.tensors:
                raise InputError(f"{self.path}: tensor {name!r} is missing; train the {self.kind} again")
            found = self.tensors[name]
            if found.shape != expected.shape or found.dtype != expected.dtype:
                raise InputError(
                    f"{self.path}: tensor {name!r} is {say(found)}, the {len(self.features)} features and "
                    f"the other layers ask for {say(expected)}"
                )
            if name not in unknown and not bool(torch.isfinite(found).all()):
                raise InputError(f"{self.path}: tensor {name!r} has numbers that are nan or infinite")
        if extra := sorted(set(self.tensors) - set(like)):
            noun = "FieldNet" if self.kind == "mlp" else self.kind
            raise InputError(f"{self.path}: tensor {extra[0]!r} belongs to no layer of a {noun}")
        return dict(self.tensors)


def is_checkpoint(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a PyTorch checkpoint, by its first bytes or its name.

    Raises:
        InputError: No such file, or a folder.
    """
    path = existing(path, "weights file")
    if path.is_dir():
        raise InputError(f"{path}: a folder; give a weights file, .safetensors or .pth")
    with path.open("rb") as file:
        return file.read(4) == _ZIP or path.suffix in (".pth", ".pt")


def write_weights(
    path: str | os.PathLike[str],
    kind: str,
    tensors: Mapping[str, torch.Tensor],
    *,
    features: Sequence[str],
    residual_sd_nt: float,
    metadata: Mapping[str, MetadataValue],
    force: bool = False,
    **about: Any,
) -> None:
    """Write a predictor to one safetensors file; the same one gives the same bytes.

    Args:
        path: The file.
        kind: A key of `VERSIONS`.
        tensors: By name.
        features: Names of the inputs, in order.
        residual_sd_nt: Root mean square error on held-out recordings [nT]; nan where unknown.
        metadata: Provenance.
        force: Whether a file that exists is replaced.
        about: What else the file says of itself, as JSON has it.

    Raises:
        InputError: The file exists and `force` was not given.
    """
    told = {
        "format_version": VERSIONS.get(kind, VERSION),
        "features": features,
        "units": [FEATURES[name].unit for name in features],
        "output": "disturbance of the field's magnitude",
        "output_unit": "nT",
        "residual_sd_nt": None if math.isnan(residual_sd_nt) else residual_sd_nt,
        "facts": metadata,
        **about,
    }
    if kind != "mlp":
        told["kind"] = kind
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    # One key, because safetensors orders several at random.
    header = {"magtwin": json.dumps(told, sort_keys=True, allow_nan=False)}
    with output(path, force=force) as aside:
        aside.write_bytes(save(whole, header))  # save_file would leave it readable by its owner alone


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """What a safetensors file of magtwin's holds, its metadata checked.

    Raises:
        InputError: No such file, no safetensors, damaged, or not of magtwin's; the text says what.
    """
    path = existing(path, "weights file")
    with path.open("rb") as file:
        if file.read(9)[8:] != b"{":
            raise InputError(f"{path}: no weights: neither safetensors nor a PyTorch checkpoint (.pth)")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: damaged safetensors ({error}); get the file again") from error
    about = _about(path, metadata)
    return Weights(path, about.get("kind", "mlp"), about, tensors)


def _about(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """What the file says of itself, every key that all kinds have there and of its type."""
    if "magtwin" not in metadata:
        raise InputError(f"{path}: safetensors without magtwin's metadata; not a network of magtwin's")
    try:
        about = json.loads(metadata["magtwin"])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its metadata is not JSON ({error})") from error
    version = about.get("format_version") if isinstance(about, dict) else None
    kind = about.get("kind", "mlp") if isinstance(about, dict) else "mlp"
    if not isinstance(kind, str):
        raise InputError(f"{path}: 'kind' of its metadata must be text, got {kind!r}")
    if version != (known := VERSIONS.get(kind, VERSION)):
        raise InputError(f"{path}: format version {version!r}, this magtwin reads {known}; update magtwin")
    for key, of in _TYPES.items():
        if key not in about or not isinstance(about[key], of):
            raise InputError(f"{path}: {key!r} of its metadata is missing or of the wrong type")
    if not about["features"] or not all(isinstance(name, str) for name in about["features"]):
        raise InputError(f"{path}: 'features' of its metadata must be names, one at least")
    sd = about["residual_sd_nt"]
    if sd is not None and not 0 <= sd < math.inf:
        raise InputError(
            f"{path}: 'residual_sd_nt' of its metadata must be from 0 nT up and finite, got {sd}"
        )
    for key, value in about["facts"].items():
        if not isinstance(value, MetadataValue):
            raise InputError(f"{path}: fact {key!r} of its metadata must be text, a number, true or false")
    for name, unit in zip(about["features"], about["units"], strict=False):
        if name in FEATURES and FEATURES[name].unit != unit:
            raise InputError(f"{path}: reads {name} in {unit!r}, magtwin gives it in {FEATURES[name].unit!r}")
    try:
        feature_names(about["features"])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return about


def shown(metadata: Mapping[str, MetadataValue]) -> dict[str, MetadataValue]:
    """Metadata for people: without the map's samples, which are for comparing maps."""
    return {name: fact for name, fact in metadata.items() if name != "map_samples_nt"}


def say(tensor: torch.Tensor) -> str:
    """Type and shape of a tensor, for refusals."""
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"
