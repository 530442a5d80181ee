"""The kinds of predictors that magtwin has: multilayer perceptron, linear model and hybrid of the two."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from magtwin.learn.models.calibration import transferred_factor, yardstick
from magtwin.learn.models.hybrid import Hybrid, hybrid_of
from magtwin.learn.models.linear import FittedLinear, Linear, fit_linear, linear_of
from magtwin.learn.models.network import FieldNet, net_of
from magtwin.learn.models.predictor import Array, Epoch, Fit, FitTask

DESCENT: Mapping[str, Any] = MappingProxyType({"epochs": 20, "batch": 1024, "lr": 1e-3, "patience": None})
TORCH: Mapping[str, Any] = MappingProxyType({"threads": None, "device": "auto"})
RIDGE: Mapping[str, Any] = MappingProxyType({"penalty": None, "weighting": "auto"})


class Perceptrons:
    """The paper's multilayer perceptron."""

    description = "A multilayer perceptron, float32"
    options = MappingProxyType(
        {"features": "full", "layers": (512, 512, 512, 512), "dropout": 0.3, **DESCENT, **TORCH}
    )
    load = staticmethod(net_of)

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit by Adam; the best epoch on the validation rows is kept."""
        learned, stops = task.train, task.validation
        return Fit(*_train(task, learned.x, learned.y, stops.x, stops.y, init=task.init))


class Linears:
    """Tolles and Lawson's terms by ridge regression."""

    description = "A linear model by ridge regression"
    options = MappingProxyType({"features": "circular", **RIDGE})
    load = staticmethod(linear_of)

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit by ridge regression and calibrate the spread."""
        fitted = _ridge(task, task.init)
        model = fitted.model
        scale = _yardstick(task, fitted, *model.predict(task.validation.x))[0]
        model = replace(model, spread=model.spread.scaled(scale))
        return Fit(model, held_out_nt=_left_out(fitted))


class Hybrids:
    """A linear base and a small network for its residual, kept only if it does better on validation."""

    description = "A linear base by ridge regression and a small network for what it leaves"
    options = MappingProxyType(
        {"features": "platform", **RIDGE, "layers": (64, 64), "dropout": 0.1, **DESCENT, **TORCH}
    )
    load = staticmethod(hybrid_of)

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit the base, then the network to what the base leaves."""
        learned, stops, init = task.train, task.validation, task.init
        base = _ridge(task, None if init is None else init.base)
        inputs = base.model.inputs
        residual = learned.y - base.model.predict(learned.x)[0]
        base_mean, base_sd = base.model.predict(stops.x)
        model = Hybrid(base=base.model, net=None)
        history: tuple[Epoch, ...] = ()
        if residual.std() > 1e-9:
            net, history = _train(
                task,
                learned.x,
                residual,
                np.clip(stops.x, inputs.low, inputs.high),
                stops.y - base_mean,
                weight=base.weight,
                init=None if init is None else init.net,
            )
            whole = Hybrid(base=base.model, net=net)
            predictions = (base_mean, whole.predict(stops.x)[0])
            of_base, of_whole = (float(np.mean(np.abs(mean - stops.y))) for mean in predictions)
            kept = of_whole < of_base
            model = whole if kept else model
            model.metadata = {
                "network": "kept" if kept else "left out",
                "base_validation_mae_nt": of_base,
                "whole_validation_mae_nt": of_whole,
            }
        error = model.predict(stops.x)[0] - stops.y
        reference = _yardstick(task, base, base_mean, base_sd)
        model.sd_factor = transferred_factor(error, base_sd, task.validation_groups, reference)
        return Fit(model, history, _left_out(base))


def _train(
    task: FitTask, x: Array, y: Array, x_val: Array, y_val: Array, **options: Any
) -> tuple[FieldNet, tuple[Epoch, ...]]:
    from magtwin.learn.training.fit_network import train  # imports torch, which predictions do without

    names = ("layers", "dropout", "epochs", "batch", "lr", "patience")
    return train(
        x,
        y,
        x_val,
        y_val,
        rng=task.rng,
        features=task.features,
        device=task.device,
        progress=task.progress,
        advance=task.advance,
        **{name: task.options[name] for name in names},
        **options,
    )


def _ridge(task: FitTask, start: Linear | None) -> FittedLinear:
    return fit_linear(
        task.train.x,
        task.train.y,
        task.train_groups,
        features=task.features,
        sd=task.train.sd,
        start=start,
        penalty=task.options["penalty"],
        weighting=task.options["weighting"],
    )


def _yardstick(task: FitTask, fitted: FittedLinear, mean_nt: Array, sd_nt: Array) -> tuple[float, float]:
    """How well the standard deviations of a linear model held on unseen recordings."""
    learned, stops = task.train, task.validation
    error = np.concatenate([fitted.held_out_nt - learned.y, mean_nt - stops.y])
    sd = np.concatenate([fitted.model.predict(learned.x)[1], sd_nt])
    groups = np.concatenate([task.train_groups, task.validation_groups])
    return yardstick(error, sd, groups, np.arange(len(error)) >= len(learned.y))


def _left_out(fitted: FittedLinear) -> Array | None:
    """Predictions by fits without each row's group; None if there is only one group."""
    return fitted.held_out_nt if len(np.unique(fitted.groups)) > 1 else None
