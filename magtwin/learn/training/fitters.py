"""Recipes: how a model of each kind is made from the material of a training."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from magtwin.errors import InputError, find
from magtwin.learn.data.inputs import Array
from magtwin.learn.models.calibration import transferred_factor
from magtwin.learn.models.descent import Epoch
from magtwin.learn.models.ensemble import Ensemble, fit_ensemble
from magtwin.learn.models.fit_network import train
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Fitted, Linear, fit_linear
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.temporal import Temporal, fit_temporal
from magtwin.learn.training.config import TrainConfig
from magtwin.learn.training.training_data import Material


@dataclass(frozen=True)
class Choice:
    """Whether a hybrid keeps its network, and why: mean absolute errors on the validation rows [nT]."""

    base_mae_nt: float
    whole_mae_nt: float
    """With the network."""

    @property
    def kept(self) -> bool:
        """Whether the network does better than the base alone."""
        return self.whole_mae_nt < self.base_mae_nt

    def text(self) -> str:
        """What was chosen and why, in a sentence."""
        said = "is kept" if self.kept else "is left out, the base alone remains"
        return (
            f"on the validation recordings the base alone errs by {self.base_mae_nt:.1f} nT, with the "
            f"network by {self.whole_mae_nt:.1f} nT: the network {said}"
        )


@dataclass(frozen=True)
class Made:
    """A model, and how it came about."""

    model: Predictor
    history: tuple[Epoch, ...] = ()
    """Its epochs; none of a model that is fitted at once."""

    choice: Choice | None = None
    """Of a hybrid."""

    held_out_nt: Array | None = None
    """Disturbance at each training row by a fit without its group [nT], shape (N,); that of a hybrid's base.
    None for a kind that is fitted once."""


Going = Mapping[str, Any]
"""What a descent reports to and resumes from: `checkpoint`, `resume`, `progress`, `advance`."""


def make(
    config: TrainConfig, material: Material, init: Predictor | None, going: Going, rng: np.random.Generator
) -> Made:
    """Make the model that a configuration asks for.

    Args:
        config: What to do.
        material: What to learn from.
        init: Predictor of the same kind that is gone on from.
        going: As `Going` has it.
        rng: Source of the first weights, the order of rows and dropout.

    Raises:
        InputError: `init` is of another kind, or what the fit of the kind refuses.
    """
    if init is not None and init.kind != config.kind:
        raise InputError(
            f"{config.init}: holds a {init.kind}, and the training is of a {config.kind}; go on from one of "
            f"those, or train with --model {'paper' if init.kind == 'mlp' else init.kind}"
        )
    if config.kind == "linear" and going.get("resume"):
        raise InputError("a linear model is fitted at once; there is no checkpoint to resume from")
    return _RECIPES[config.kind](config, material, init, going, rng)


def device_of(config: TrainConfig) -> str:
    """Where torch trains: "cpu" or "cuda".

    Raises:
        InputError: A GPU is asked for and torch sees none.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: this torch sees no GPU; install one that does, or give --device cpu or auto"
        )
    return "cuda" if config.device != "cpu" and torch.cuda.is_available() else "cpu"


_COURSE = ("epochs", "batch", "lr", "patience")


def _mlp(config: TrainConfig, material: Material, init: Any, going: Going, rng: np.random.Generator) -> Made:
    learned, stops = material.rows["train"], material.rows["validation"]
    net, history = train(
        learned.x,
        learned.y,
        stops.x,
        stops.y,
        rng=rng,
        features=config.inputs,
        device=device_of(config),
        init=init,
        **config.options("layers", "dropout", "freeze", *_COURSE),
        **going,
    )
    return Made(net, history)


def _linear(
    config: TrainConfig, material: Material, init: Any, going: Going, rng: np.random.Generator
) -> Made:
    fitted = _ridge(config, material, init)
    model = fitted.model
    known = material.yardstick_of(fitted, *model.predict(material.rows["validation"].x))
    model = replace(model, spread=model.spread.scaled(known.everywhere))
    return Made(model, held_out_nt=_left_out(fitted))


def _hybrid(
    config: TrainConfig, material: Material, init: Any, going: Going, rng: np.random.Generator
) -> Made:
    learned, stops = material.rows["train"], material.rows["validation"]
    for name in config.freeze:
        layers = range(len(init.net.linears) if init.net else 0)
        find("layer", name, dict.fromkeys(("base", *(f"layers.{i}" for i in layers))))
    if "base" in config.freeze:
        base = Fitted(init.base, init.base.predict(learned.x)[0], material.groups["train"])
    else:
        base = _ridge(config, material, None if init is None else init.base)
    of = base.model.inputs
    stops_x = np.clip(stops.x, of.low, of.high)
    left = learned.y - base.model.predict(learned.x)[0]
    base_mean, base_sd = base.model.predict(stops.x)
    model, choice = Hybrid(base=base.model, net=None), None
    history: tuple[Epoch, ...] = ()
    if left.std() > 1e-9:
        net, history = train(
            learned.x,
            left,
            stops_x,
            stops.y - base_mean,
            rng=rng,
            weight=base.weight,
            features=config.inputs,
            device=device_of(config),
            init=None if init is None else init.net,
            freeze=[name for name in config.freeze if name != "base"],
            **config.options("layers", "dropout", *_COURSE),
            **going,
        )
        whole = Hybrid(base=base.model, net=net)
        errors = (base_mean - stops.y, whole.predict(stops.x)[0] - stops.y)
        choice = Choice(*(float(np.mean(np.abs(error))) for error in errors))
        model = whole if choice.kept else model
    error = model.predict(stops.x)[0] - stops.y
    known = material.yardstick_of(base, base_mean, base_sd)
    model.sd_factor = transferred_factor(error, base_sd, material.groups["validation"], known)
    return Made(model, history, choice, _left_out(base) if "base" not in config.freeze else None)


def _ensemble(
    config: TrainConfig, material: Material, init: Any, going: Going, rng: np.random.Generator
) -> Made:
    learned, stops = material.rows["train"], material.rows["validation"]
    model, history = fit_ensemble(
        learned.x,
        learned.y,
        material.groups["train"],
        stops.x,
        stops.y,
        rng=rng,
        features=config.inputs,
        device=device_of(config),
        init=init,
        **config.options("members", "layers", "freeze", *_COURSE),
        **going,
    )
    return _calibrated(config, model, history, material)


def _tcn(config: TrainConfig, material: Material, init: Any, going: Going, rng: np.random.Generator) -> Made:
    model, history = fit_temporal(
        material.tracks("train"),
        material.tracks("validation"),
        rng=rng,
        features=config.inputs,
        step_s=material.step_s,
        device=device_of(config),
        init=init,
        **config.options("layers", "kernel", *_COURSE),
        **going,
    )
    return _calibrated(config, model, history, material)


def _calibrated(
    config: TrainConfig, model: Ensemble | Temporal, history: tuple[Epoch, ...], material: Material
) -> Made:
    """With a factor by which its standard deviations hold, beside those of a linear model of its inputs."""
    mean, sd = material.told(model, "validation")
    error = mean - material.rows["validation"].y
    groups = material.groups["validation"]
    learned = material.rows["train"]
    peer = fit_linear(learned.x, learned.y, material.groups["train"], features=config.inputs, sd=learned.sd)
    told = peer.model.predict(material.rows["validation"].x)
    model.sd_factor = transferred_factor(error, sd, groups, material.yardstick_of(peer, *told))
    return Made(model, history)


def _left_out(fitted: Fitted) -> Array | None:
    """What fits without each group say of it; None of one group, which no fit left out."""
    return fitted.held_out_nt if len(np.unique(fitted.groups)) > 1 else None


def _ridge(config: TrainConfig, material: Material, start: Linear | None) -> Fitted:
    learned = material.rows["train"]
    return fit_linear(
        learned.x,
        learned.y,
        material.groups["train"],
        features=config.inputs,
        sd=learned.sd,
        start=start,
        **config.options("penalty", "weighting"),
    )


_RECIPES: Mapping[str, Callable[..., Made]] = MappingProxyType(
    {"mlp": _mlp, "linear": _linear, "hybrid": _hybrid, "ensemble": _ensemble, "tcn": _tcn}
)
