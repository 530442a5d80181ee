"""TrainConfig: everything that decides a training, except its data."""

import itertools
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from magtwin.errors import InputError, find, hint
from magtwin.files.kinds import expected
from magtwin.files.settings import from_table, read_toml, value_of
from magtwin.learn.data.features import feature_names
from magtwin.learn.data.split import By
from magtwin.learn.models.linear import Weighting
from magtwin.learn.models.predictor import OWN_MODULE, PREDICTORS

Device = Literal["cpu", "cuda", "auto"]

PAPER = "paper"
"""Name of the kind "mlp" as a model; all other models are named by their kind."""

MOST_WEIGHTS = 100_000_000  # Largest network; with gradients and Adam's moments it takes 1.6 GB
BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "epochs": (1, 100_000),
        "batch": (1, 1_000_000_000),
        "lr": (1e-12, 1e3),
        "patience": (1, 100_000),
        "threads": (1, 1024),
        "penalty": (0, 1e12),
        "dropout": (0, 0.999),
        "seed": (0, math.inf),
    }
)
"""Least and largest value of each number."""

COMMON = ("model", "seed", "split", "hold_out", "init", "licence")  # Options that every model reads


def models() -> list[str]:
    """Names of all models, those of installed packages included; not that of own modules, which are given."""
    return [PAPER, *(kind for kind in PREDICTORS if kind not in ("mlp", OWN_MODULE))]


def options_of(model: str) -> dict[str, Any]:
    """Options that a model reads beside `COMMON`, with their defaults.

    Raises:
        InputError: No such model.
    """
    if model != OWN_MODULE:
        find("model", model, dict.fromkeys(models()))
    return dict(PREDICTORS["mlp" if model == PAPER else model].options)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A model and its options. An option that is not given has the default of the model's kind.

    An option that the model does not read is refused; its value is None. The paper does not state its epochs,
    batch size, step size or split; these defaults are magtwin's.
    """

    model: str = "paper"
    """The model: "paper" (multilayer perceptron), "linear" (Tolles-Lawson by ridge regression), "hybrid",
    "mixed" (coefficients that differ between sessions), or another kind of
    `magtwin.learn.models.predictor.PREDICTORS`."""

    layers: tuple[int, ...] = ()
    """Widths of the hidden layers."""

    features: str = ""
    """A set of `magtwin.learn.data.features.SETS`, or names of features separated by commas."""

    dropout: float | None = None
    """Share of units dropped in training."""

    penalty: float | None = None
    """Ridge penalty, relative to the curvature of the rows; None chooses it by cross-validation."""

    weighting: Weighting | None = None
    """Weights of rows in the ridge: "label_sd" by how well the map is known there, "none", or "auto", the
    better of the two on recordings left out."""

    epochs: int | None = None
    """Passes over the training rows."""

    batch: int | None = None
    """Rows per step."""

    lr: float | None = None
    """Largest step size of Adam."""

    patience: int | None = None
    """Stop after this many epochs without improvement; None runs all epochs."""

    seed: int = 0
    """Seed of the split, the initial weights, the order of rows and dropout."""

    split: By = "session"
    """Unit kept whole when splitting into training, validation and test."""

    hold_out: tuple[str, ...] = ()
    """Sessions, runs, paths or recordings to put into the test."""

    threads: int | None = None
    """Threads of torch and of numpy's products. None: one, whatever the number of processors. Another number
    gives other bits."""

    device: Device | None = None
    """Where torch trains: "cpu", "cuda", or "auto" (a GPU if torch sees one)."""

    init: Path | None = None
    """Weights file to continue from, .safetensors or .pth, of the same kind and features."""

    licence: str = ""
    """Licence of the weights, an SPDX identifier such as MIT."""

    def __post_init__(self) -> None:
        known = options_of(self.model)
        for field in fields(self):
            given = getattr(self, field.name)
            if field.name in COMMON or given is None or given in ((), "") or field.name in known:
                continue
            able = [name for name in models() if field.name in options_of(name)]
            raise InputError(
                f"{field.name} is no option of {self.model!r}; leave it out, or choose {', '.join(able)}"
            )
        for name, default in known.items():
            if getattr(self, name) in (None, (), ""):
                object.__setattr__(self, name, default)
        self._check()

    def _check(self) -> None:
        for name, (least, most) in BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise InputError(f"{name} must be between {least:,} and {most:,}, got {value!r}")
        if not all(width > 0 for width in self.layers):
            raise InputError(f"layers must be above 0 wide, got {self.layers!r}")
        weights = sum(a * b for a, b in itertools.pairwise((len(self.inputs), *self.layers, 1)))
        if weights > MOST_WEIGHTS:
            raise InputError(
                f"layers must be narrower: {self.layers!r} make {weights:,} weights, at most {MOST_WEIGHTS:,}"
            )

    @property
    def kind(self) -> str:
        """Kind of the predictor, a name of `PREDICTORS`."""
        return "mlp" if self.model == PAPER else self.model

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the features, in order.

        Raises:
            InputError: One is not known, or is named twice.
        """
        return feature_names(self.features)

    @property
    def options(self) -> dict[str, Any]:
        """Values of the options that the model reads beside `COMMON`."""
        return {name: getattr(self, name) for name in options_of(self.model)}

    def with_options(self, **options: Any) -> "TrainConfig":
        """The configuration with other options. Another `model` drops the options that it does not read.

        Raises:
            InputError: An option is unknown, has the wrong type, or is not read by the model.
        """
        names = [field.name for field in fields(self)]
        for name, value in options.items():
            if name not in names:
                raise InputError(f"{name} is no option of a training; {hint(name, names)}", parameter=name)
            if name == "features" and isinstance(value, list | tuple):
                value = ",".join(map(str, value))
            options[name] = value_of(TrainConfig, name, value)
        keep = {field.name: getattr(self, field.name) for field in fields(self)}
        if options.get("model", self.model) != self.model:
            default, known = options_of(self.model), options_of(options["model"])
            keep = {
                name: value
                for name, value in keep.items()
                if name in COMMON or (name in known and name != "layers" and value != default.get(name))
            }
        return TrainConfig(**{**keep, **options})

    def to_toml(self) -> str:
        """The configuration as TOML for `read_config`; options that are not set are left out."""
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
    """Read a configuration from a TOML file; missing options have their defaults.

    Raises:
        InputError: No such file, not TOML, an unknown key (the nearest one is named), an option that the
            model does not read, or an invalid value, each with its line.
    """
    return from_table(TrainConfig, read_toml(expected(path, "settings of a training")), path)
