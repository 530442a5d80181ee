"""TrainConfig: everything that decides a training, beside its data."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from magtwin.files import from_table, read_toml
from magtwin.learn.features import feature_names
from magtwin.learn.split import By
from magtwin.names import RefusedError

MODELS: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {"paper": (512, 512, 512, 512), "released": (512, 512, 512, 128)}
)
"""Widths of the hidden layers by the name of a model: as the paper has them, and as its weights have."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What a training does; the paper's network, loss and dropout unless said otherwise.

    The paper does not tell its epochs, batch, step size or split; those are magtwin's own.
    """

    model: Literal["paper", "released"] = "paper"
    """Whose layers; see `MODELS`. Says nothing where `layers` are given."""

    layers: tuple[int, ...] = ()
    """Widths of the hidden layers; the model's where empty."""

    features: str = "full"
    """A set of `magtwin.learn.features.SETS`, or names of features with commas between."""

    dropout: float = 0.3
    """Share of units dropped in training."""

    epochs: int = 20
    """Passes over the training rows."""

    batch: int = 1024
    """Rows a step."""

    lr: float = 1e-3
    """Largest step size of Adam."""

    patience: int | None = None
    """Epochs without a better one after which training stops; none stops it unless given."""

    seed: int = 0
    """Of the split, the first weights, the order of rows and dropout."""

    split: By = "session"
    """What is never on two sides of training, validation and test."""

    hold_out: tuple[str, ...] = ()
    """Sessions, runs, paths or recordings that are all in the test."""

    threads: int | None = None
    """Threads of torch; as many as it takes unless given. Another number gives other bits."""

    init: Path | None = None
    """Weights file that training goes on from, .safetensors or .pth."""

    freeze: tuple[str, ...] = ()
    """Layers that stay as `init` has them: "layers.0" is the first."""

    def __post_init__(self) -> None:
        inputs = self.inputs  # refuses what is no feature
        for name, value in (("epochs", self.epochs), ("batch", self.batch), ("lr", self.lr)):
            if not 0 < value < math.inf:
                raise RefusedError(f"{name} must be above 0, got {value!r}")
        for name, count in (("patience", self.patience), ("threads", self.threads)):
            if count is not None and count < 1:
                raise RefusedError(f"{name} must be 1 at least, got {count!r}; leave it out for none")
        if not 0 <= self.dropout < 1:
            raise RefusedError(f"dropout must lie in 0..1, 1 left out, got {self.dropout!r}")
        if self.seed < 0:
            raise RefusedError(f"seed must be 0 or more, got {self.seed!r}")
        if not all(width > 0 for width in self.layers) or not inputs:
            raise RefusedError(f"layers must be above 0 wide, got {self.layers!r}")
        if self.freeze and self.init is None:
            raise RefusedError("freeze keeps layers of trained weights: give init too")

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return self.layers or MODELS[self.model]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the features, in order.

        Raises:
            RefusedError: One is not known, or is named twice.
        """
        return feature_names(self.features)

    def to_toml(self) -> str:
        """The file that `read_config` reads this from; what is not set is left out."""
        lines = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None or value == () or (field.name == "model" and self.layers):
                continue
            value = value.as_posix() if isinstance(value, Path) else value
            text = json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)
            lines.append(f"{field.name} = {text}")
        return "\n".join(lines) + "\n"


def read_config(path: str | os.PathLike[str]) -> TrainConfig:
    """A configuration from a TOML file; what it does not say is as `TrainConfig` has it.

    Raises:
        RefusedError: No such file, not TOML, an unknown key (the near one is named), or a value that
            cannot be, each with its line.
    """
    return from_table(TrainConfig, read_toml(path), path)
