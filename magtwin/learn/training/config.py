"""TrainConfig: everything that decides a training, beside its data."""

import itertools
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from magtwin.errors import InputError
from magtwin.files import from_table, read_toml
from magtwin.learn.data.features import feature_names
from magtwin.learn.data.split import By
from magtwin.learn.models.linear import Weighting

Model = Literal["paper", "released", "linear", "hybrid", "ensemble", "tcn"]
Device = Literal["cpu", "cuda", "auto"]

_DESCENT: Mapping[str, Any] = MappingProxyType({"epochs": 20, "batch": 1024, "lr": 1e-3, "patience": None})
_TORCH: Mapping[str, Any] = MappingProxyType({"threads": None, "device": "auto", "freeze": ()})
_PAPER: Mapping[str, Any] = MappingProxyType({"features": "full", "dropout": 0.3, **_DESCENT, **_TORCH})
_RIDGE: Mapping[str, Any] = MappingProxyType({"penalty": None, "weighting": "auto"})

MODELS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": {"layers": (512, 512, 512, 512), **_PAPER},
        "released": {"layers": (512, 512, 512, 128), **_PAPER},
        "linear": {"features": "circular", **_RIDGE},
        "hybrid": {
            "features": "platform",
            **_RIDGE,
            "layers": (64, 64),
            "dropout": 0.1,
            **_DESCENT,
            **_TORCH,
        },
        "ensemble": {"features": "gradient", "members": 5, "layers": (64, 64), **_DESCENT, **_TORCH},
        "tcn": {
            "features": "gradient",
            "layers": (32, 32, 32, 32),
            "kernel": 3,
            **_DESCENT,
            "threads": None,
            "device": "auto",
        },
    }
)
"""Models by name: the options that each reads beside those that all do, and what they are unless given."""

MOST_WEIGHTS = 100_000_000
"""Of a network: with its gradients and Adam's moments they take 1.6 GB."""

ALL_READ = ("model", "seed", "split", "hold_out", "init", "licence")
"""Options that every model reads."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What a training does: a model and its options, those that are not given as `MODELS` has them.

    An option that the model does not read is refused; it is None here. The paper does not tell its epochs,
    batch, step size or split; those are magtwin's own.
    """

    model: Model = "paper"
    """Which model: the multilayer perceptron as the paper has it ("paper") or as its weights have
    ("released"), "linear" (Tolles-Lawson by ridge regression), "hybrid", "ensemble" or "tcn"."""

    layers: tuple[int, ...] = ()
    """Widths of the hidden layers; of a tcn, of its convolutions."""

    features: str = ""
    """A set of `magtwin.learn.data.features.SETS`, or names of features with commas between."""

    dropout: float | None = None
    """Share of units dropped in training."""

    members: int | None = None
    """Networks of an ensemble."""

    kernel: int | None = None
    """Rows that each convolution of a tcn looks at."""

    penalty: float | None = None
    """Of the ridge, as a share of the rows' own curvature; None chooses it by cross-validation."""

    weighting: Weighting | None = None
    """Whether a ridge weighs rows by how well the map is known there: "label_sd", "none", or "auto",
    whichever does better on recordings left out."""

    epochs: int | None = None
    """Passes over the training rows."""

    batch: int | None = None
    """Rows a step."""

    lr: float | None = None
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

    device: Device | None = None
    """Where torch trains: "cpu", "cuda", or "auto", a GPU where torch sees one."""

    init: Path | None = None
    """Weights file that training goes on from, .safetensors or .pth, of the same kind and features."""

    licence: str = ""
    """Licence of the weights, an SPDX identifier such as MIT."""

    freeze: tuple[str, ...] = ()
    """Layers that stay as `init` has them: "layers.0" is the first; of a hybrid, "base" too."""

    def __post_init__(self) -> None:
        known = MODELS[self.model]
        for field in fields(self):
            given = getattr(self, field.name)
            if field.name in ALL_READ or given is None or given in ((), ""):
                continue
            if field.name not in known:
                able = [name for name, options in MODELS.items() if field.name in options]
                raise InputError(
                    f"{field.name} is nothing to {self.model!r}; leave it out, or take one that reads it: "
                    f"{', '.join(able)}"
                )
        for name, usual in known.items():
            if getattr(self, name) in (None, (), ""):
                object.__setattr__(self, name, usual)
        self._check()

    def _check(self) -> None:
        inputs = self.inputs  # refuses what is no feature
        for name in ("epochs", "batch", "lr", "members"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name} must be above 0, got {value!r}")
        for name, count in (("patience", self.patience), ("threads", self.threads)):
            if count is not None and count < 1:
                raise InputError(f"{name} must be 1 at least, got {count!r}; leave it out for none")
        if self.kernel is not None and self.kernel < 2:
            raise InputError(f"kernel must be 2 rows at least, got {self.kernel!r}")
        if self.penalty is not None and not 0 <= self.penalty < math.inf:
            raise InputError(f"penalty must be from 0 up and finite, got {self.penalty!r}")
        if self.dropout is not None and not 0 <= self.dropout < 1:
            raise InputError(f"dropout must lie in 0..1, 1 left out, got {self.dropout!r}")
        if self.seed < 0:
            raise InputError(f"seed must be 0 or more, got {self.seed!r}")
        if not all(width > 0 for width in self.layers) or not inputs:
            raise InputError(f"layers must be above 0 wide, got {self.layers!r}")
        widths = (len(inputs), *self.layers, 1)
        weights = sum(a * b for a, b in itertools.pairwise(widths)) * (self.members or 1) * (self.kernel or 1)
        if weights > MOST_WEIGHTS:
            raise InputError(
                f"layers {self.layers!r} make {weights:,} weights; take {MOST_WEIGHTS:,} at most"
            )
        if self.freeze and self.init is None:
            raise InputError("freeze keeps layers of trained weights: give init too")

    @property
    def kind(self) -> str:
        """Kind of the predictor: "mlp", "linear", "hybrid", "ensemble" or "tcn"."""
        return "mlp" if self.model in ("paper", "released") else self.model

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers; none of a linear model."""
        return self.layers

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the features, in order.

        Raises:
            InputError: One is not known, or is named twice.
        """
        return feature_names(self.features)

    def options(self, *names: str) -> dict[str, Any]:
        """Some of the options by name, such as a model's fit takes them."""
        return {name: getattr(self, name) for name in names}

    def with_options(self, **options: Any) -> "TrainConfig":
        """With other options; those of another model are left behind where `model` is one of them."""
        keep = {field.name: getattr(self, field.name) for field in fields(self)}
        if options.get("model", self.model) != self.model:
            usual, known = MODELS[self.model], MODELS[options["model"]]
            keep = {
                name: value
                for name, value in keep.items()
                if name in ALL_READ or (name in known and name != "layers" and value != usual.get(name))
            }
        return TrainConfig(**{**keep, **options})

    def to_toml(self) -> str:
        """The file that `read_config` reads this from; what is not set is left out."""
        lines = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None or value in ((), ""):
                continue
            value = value.as_posix() if isinstance(value, Path) else value
            text = json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)
            lines.append(f"{field.name} = {text}")
        return "\n".join(lines) + "\n"


def read_config(path: str | os.PathLike[str]) -> TrainConfig:
    """A configuration from a TOML file; what it does not say is as `MODELS` has it.

    Raises:
        InputError: No such file, not TOML, an unknown key (the near one is named), an option that the model
            does not read, or a value that cannot be, each with its line.
    """
    return from_table(TrainConfig, read_toml(path), path)
