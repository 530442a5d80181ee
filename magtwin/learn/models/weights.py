"""Weights files: tensors and metadata as safetensors, which execute nothing."""

import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from magtwin.errors import InputError
from magtwin.files.file import existing, existing_file
from magtwin.files.kinds import expected, kind_of
from magtwin.files.outputs import output
from magtwin.learn.data.features import FEATURES, feature_names
from magtwin.learn.models.calibration import Spread, spread_from, spread_like

MetadataValue = str | int | float | bool
Tensors = Mapping[str, NDArray[Any]]
T = TypeVar("T")

VERSIONS = {"mlp": 1}
"""Version of the file by kind of predictor, `VERSION` for all others; other versions are refused."""

VERSION = 2

WIDE = "wide"
"""Name of the spread on other robots, among the tensors of a file of any kind."""

_ZIP = b"PK\x03\x04"
_TYPES = {"features": list, "units": list, "residual_sd_nt": float | None, "facts": dict}


@dataclass(frozen=True)
class Weights:
    """The content of a weights file; its kind checks the tensors."""

    path: Path
    kind: str
    """Kind of the predictor."""

    about: Mapping[str, Any]
    """Features, units, provenance, `residual_sd_nt`, and the settings of the kind."""

    tensors: Tensors
    """Its tensors, but for those of `wide`."""

    wide: Spread | None = None
    """Spread of errors on robots that it was not trained on; None if it was never learned."""

    module: Any = None
    """The user's own torch module, a class or an instance, if one was given."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(self.about["features"])

    @property
    def residual_sd_nt(self) -> float:
        """Root mean square error on held-out recordings [nT]; nan if unknown."""
        sd = self.about["residual_sd_nt"]
        return math.nan if sd is None else sd

    def expect(self, key: str, kind: Any) -> Any:
        """A setting of the file.

        Raises:
            InputError: It is missing, or of another type.
        """
        value = self.about.get(key)
        if key not in self.about or not isinstance(value, kind):
            raise InputError(f"{self.path}: {key!r} of its metadata is missing or of the wrong type")
        return value

    def number(self, key: str, *, above: float = -math.inf) -> float:
        """A finite number among the settings, above a bound.

        Raises:
            InputError: It is missing or no such number.
        """
        value = self.expect(key, int | float)
        if isinstance(value, bool) or not above < value < math.inf or abs(value) > sys.float_info.max:
            wanted = f"above {above:g} and finite" if above > -math.inf else "a finite number"
            raise InputError(f"{self.path}: {key!r} of its metadata must be {wanted}, got {str(value)[:40]}")
        return float(value)

    def fit(self, like: Tensors) -> dict[str, NDArray[Any]]:
        """The tensors, checked against others of the required names, shapes and types.

        Raises:
            InputError: A tensor is missing, unknown, of another shape or type, or not finite.
        """
        for name, wanted in like.items():
            if name not in self.tensors:
                raise InputError(f"{self.path}: tensor {name!r} is missing; train the {self.kind} again")
            tensor = self.tensors[name]
            if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
                raise InputError(
                    f"{self.path}: tensor {name!r} is {say(tensor)}, the {len(self.features)} features and "
                    f"the other layers ask for {say(wanted)}"
                )
            if name not in ("x_min", "x_max") and not bool(np.isfinite(tensor).all()):
                raise InputError(f"{self.path}: tensor {name!r} has numbers that are nan or infinite")
        if extra := sorted(set(self.tensors) - set(like)):
            noun = "FieldNet" if self.kind == "mlp" else self.kind
            raise InputError(f"{self.path}: tensor {extra[0]!r} belongs to no layer of a {noun}")
        return dict(self.tensors)


def is_checkpoint(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a PyTorch checkpoint, by its first bytes or its suffix.

    Raises:
        InputError: No such file, or a folder.
    """
    path = existing(path, "weights file")
    if path.is_dir() and kind_of(path) is None:
        raise InputError(f"{path}: a folder; give a weights file, .safetensors or .pth")
    expected(path, "weights file")
    with path.open("rb") as file:
        return file.read(4) == _ZIP or path.suffix.lower() in (".pth", ".pt")


def write_weights(
    path: str | os.PathLike[str],
    kind: str,
    tensors: Tensors,
    *,
    features: Sequence[str],
    residual_sd_nt: float,
    metadata: Mapping[str, MetadataValue],
    wide: Spread | None,
    force: bool,
    **about: Any,
) -> None:
    """Write the parts of a `Predictor`, and the settings of its kind, to a safetensors file."""
    header = {
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
        header["kind"] = kind
    tensors = {**tensors, **(wide.tensors(WIDE) if wide else {})}
    whole = {name: np.array(value, order="C") for name, value in tensors.items()}
    # One key, because safetensors writes several in random order.
    metadata_text = {"magtwin": json.dumps(header, sort_keys=True, allow_nan=False)}
    with output(path, force=force) as aside:
        aside.write_bytes(save(whole, metadata_text))  # save_file makes a file that only its owner can read


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a safetensors file that magtwin wrote, and check its metadata.

    Raises:
        InputError: No such file, no safetensors, damaged, or not written by magtwin.
    """
    path = existing_file(path, "weights file", "weights")
    with path.open("rb") as file:
        if file.read(9)[8:] != b"{":
            raise InputError(f"{path}: no weights: neither safetensors nor a PyTorch checkpoint (.pth)")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged safetensors ({error}); get the file again") from error
    about = _about(path, metadata)
    weights = Weights(path, about.get("kind", "mlp"), about, tensors)
    like = spread_like(WIDE, len(weights.features))
    own = {name: tensors.pop(name) for name in like if name in tensors}
    if not own:
        return weights
    return replace(weights, wide=spread_from(replace(weights, tensors=own).fit(like), WIDE, path))


def _about(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The metadata of a file, with the keys that all kinds have checked."""
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
            f"{path}: 'residual_sd_nt' of its metadata must be 0 nT or more and finite, got {sd}"
        )
    for key, value in about["facts"].items():
        large = isinstance(value, int) and abs(value) > sys.float_info.max
        if not isinstance(value, MetadataValue) or large:
            raise InputError(f"{path}: {key!r} of its metadata must be text, a number, true or false")
    for name, unit in zip(about["features"], about["units"], strict=False):
        if name in FEATURES and FEATURES[name].unit != unit:
            raise InputError(f"{path}: reads {name} in {unit!r}, magtwin gives it in {FEATURES[name].unit!r}")
    try:
        feature_names(about["features"])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return about


def tensors_below(tensors: Mapping[str, T], prefix: str) -> dict[str, T]:
    """The tensors whose names start with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def shown(metadata: Mapping[str, MetadataValue]) -> dict[str, MetadataValue]:
    """Metadata to show: without the map's samples."""
    return {name: value for name, value in metadata.items() if name != "map_samples_nt"}


def say(tensor: NDArray[Any]) -> str:
    """Type and shape of a tensor, for error messages."""
    return f"{tensor.dtype} {tuple(tensor.shape)}"
