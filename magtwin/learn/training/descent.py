"""Descent: training by Adam; the best epoch is kept, and a resumed training gives the same bits."""

import copy
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array
from magtwin.learn.models.predictor import Epoch
from magtwin.learn.models.weights import tensors_below
from magtwin.learn.training.module import NetModule
from magtwin.learn.training.state import load_state, save_state


class Dropout:
    """Dropout by 16 random bits per unit, four times as fast as torch's own on a CPU."""

    def __init__(self, share: float, generator: torch.Generator) -> None:
        """Drop a share of the units, to the nearest 65,536th."""
        self.generator = generator
        dropped = min(round(share * 65_536), 65_535)
        self._least = dropped - 32_768
        """A unit is kept if its 16 bits, as a signed number, are at least this."""

        self._scale = 65_536 / (65_536 - dropped)
        self._bits = torch.empty(0, dtype=torch.int64, device=generator.device)

    def __call__(self, h: torch.Tensor) -> torch.Tensor:
        """Drop units of an array of any shape, and scale the others up."""
        if self._scale == 1:
            return h
        words = -(-h.numel() // 4)
        if len(self._bits) < words:
            self._bits = torch.empty(words, dtype=torch.int64, device=h.device)
        bits = self._bits[:words].random_(-(2**63), None, generator=self.generator)
        kept = bits.view(torch.int16)[: h.numel()].view(h.shape) >= self._least
        return h * kept.to(h.dtype).mul_(self._scale)


class Learner:
    """A network, and its scaled training rows on the device of training."""

    def __init__(
        self,
        net: NetModule,
        x: Array,
        y: Array,
        weight: Array | None,
        x_val: Array,
        y_val: Array,
        drop: Dropout,
    ) -> None:
        self.module, self.drop, device = net, drop, drop.generator.device
        self.z = ((torch.from_numpy(x) - net.x_mean) / net.x_scale).float().to(device)
        self.label = ((torch.from_numpy(y) - net.y_mean) / net.y_scale).float().to(device)
        self.weight = None if weight is None else torch.from_numpy(weight).float().to(device)
        self.x_val, self.y_val = torch.from_numpy(x_val).to(device), y_val
        self.square_nt2 = float(net.y_scale) ** 2
        self.generators = {"dropout": drop.generator}
        self.rows = len(y)
        net.to(device)

    def loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean loss on rows, and the sum of their squared errors [nT^2] without gradient."""
        z, label = self.z[chosen], self.label[chosen]
        out = self.module.body(z, self.drop if self.module.training else None)
        if self.weight is None:
            loss = torch.nn.functional.mse_loss(out, label)
            return loss, loss.detach() * (len(chosen) * self.square_nt2)
        squares = (out - label) ** 2
        return (self.weight[chosen] * squares).mean(), squares.detach().sum() * self.square_nt2

    def errors_nt(self) -> Array:
        """Errors on the validation rows [nT], shape (M,)."""
        parts = [self.module(part).cpu().numpy() for part in self.x_val.split(8192)]
        return np.concatenate(parts) - self.y_val


@dataclass(frozen=True, kw_only=True)
class Course:
    """Length and step sizes of a descent, as in `fit_network.train`, and the seed of the order of rows."""

    epochs: int
    batch: int
    lr: float
    patience: int | None = None
    seed: int = 0


def check_device(device: str) -> None:
    """Refuse a device that this torch does not have.

    Args:
        device: "cpu", "cuda", or another name of torch.

    Raises:
        InputError: There is no such device.
    """
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device {device!r}: this torch has none ({str(error).splitlines()[0]})") from error


def descend(
    learner: Learner,
    course: Course,
    settings: Mapping[str, Any],
    *,
    started: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> tuple[Epoch, ...]:
    """Train a module to the weights that do best on the validation rows.

    The step size rises over the first half epoch and then falls to 0 along half a cosine.

    Args:
        learner: What to train.
        course: Length and step sizes.
        settings: Everything else that decides the outcome, as JSON; a checkpoint with others is refused.
        started: Whether the module has trained weights, which then are epoch 0.
        checkpoint: File for the state after each epoch.
        resume: Continue from `checkpoint`.
        progress: Called after each epoch.
        advance: Called after each step with the rows done and the rows of all epochs.

    Raises:
        InputError: Training diverged, there is nothing to train, or the checkpoint is of another training.
    """
    if resume and checkpoint is None:
        raise InputError("there is no checkpoint to resume from; name one")
    descent = _Descent(learner, course, {**asdict(course), **settings}, started)
    if resume and checkpoint is not None:
        descent.load(checkpoint)
    descent.run(checkpoint, progress, advance)
    return tuple(descent.history)


class _Descent:
    """A module in training, and everything that its next step depends on."""

    def __init__(self, learner: Learner, course: Course, settings: Mapping[str, Any], started: bool) -> None:
        self.learner, self.course, self.settings, self.started = learner, course, settings, started
        self.module = learner.module
        self.trained = {name: p for name, p in self.module.named_parameters() if p.requires_grad}
        if not self.trained:
            raise InputError("every layer is frozen; there is nothing left to train")
        self.adam = torch.optim.Adam(self.trained.values(), lr=course.lr, fused=True)
        self.order = torch.Generator().manual_seed(course.seed)
        self.generators = {"order": self.order, **learner.generators}
        self.kept = copy.deepcopy(self.module.state_dict())
        self.history: list[Epoch] = []

    @property
    def best(self) -> float:
        """Smallest RMSE on the validation rows so far [nT]; inf before the first epoch."""
        return min((epoch.val_rmse_nt for epoch in self.history), default=math.inf)

    def run(
        self,
        checkpoint: str | os.PathLike[str] | None,
        progress: Callable[[Epoch], None] | None,
        advance: Callable[[int, int], None] | None,
    ) -> None:
        """Train until the last epoch or the end of patience, then load the best weights."""
        if self.started and not self.history:
            self.module.eval()
            with torch.inference_mode():
                everything = torch.arange(self.learner.rows).split(8 * self.course.batch)
                squares = sum(float(self.learner.loss(chosen)[1]) for chosen in everything)
            self._note(0, squares, progress)
        first = self.history[-1].number + 1 if self.history else 1
        for number in range(first, self.course.epochs + 1):
            since = len(self.history) - 1 - max((i for i, e in enumerate(self.history) if e.best), default=0)
            if self.course.patience is not None and since >= self.course.patience:
                break
            self._note(number, self._pass(number, advance), None)
            if checkpoint is not None:
                save_state(checkpoint, self._tensors(), self.settings, [asdict(e) for e in self.history])
            if progress:
                progress(self.history[-1])
        self.module.load_state_dict(self.kept)
        self.module.eval().cpu()

    def load(self, checkpoint: str | os.PathLike[str]) -> None:
        """Load the state of a checkpoint."""
        tensors, epochs = load_state(checkpoint, self._tensors(), self.settings)
        try:
            self.history = [Epoch(**epoch) for epoch in epochs]
            numbers = [epoch.number for epoch in self.history]
            sound = numbers == list(range(0 if self.started else 1, self.course.epochs + 1))[: len(epochs)]
            sound &= any(epoch.best for epoch in self.history) and math.isfinite(self.best)
        except TypeError:
            sound = False
        if not sound:
            raise InputError(f"{checkpoint}: its epochs are not those of a training; start anew")
        self.module.load_state_dict(tensors_below(tensors, "module."))
        self.kept = tensors_below(tensors, "kept.")
        for name, parameter in self.trained.items():
            state = {key: tensors[f"adam.{name}.{key}"].to(parameter.device) for key in _ADAM}
            self.adam.state[parameter] = state
        for name, generator in self.generators.items():
            generator.set_state(tensors[f"rng.{name}"])

    def _pass(self, number: int, advance: Callable[[int, int], None] | None) -> float:
        """One pass over the rows; returns the sum of their squared errors [nT^2]."""
        rows, course = self.learner.rows, self.course
        steps = math.ceil(rows / course.batch)
        total, rise = course.epochs * steps, max(1, steps // 2)
        self.module.train()
        device = next(self.module.parameters()).device
        squares, done = torch.zeros((), dtype=torch.float64, device=device), (number - 1) * rows
        order = torch.randperm(rows, generator=self.order).to(device)
        for step, chosen in enumerate(order.split(course.batch), (number - 1) * steps):
            share = math.cos(math.pi * (step - rise) / max(1, total - rise))
            for group in self.adam.param_groups:
                group["lr"] = course.lr * ((step + 1) / rise if step < rise else 0.5 + 0.5 * share)
            self.adam.zero_grad(set_to_none=True)
            loss, errors = self.learner.loss(chosen)
            loss.backward()
            self.adam.step()
            squares += errors  # read at the end only, not to wait for a GPU
            done += len(chosen)
            if advance:
                advance(done, course.epochs * rows)
        return float(squares)

    def _note(self, number: int, squares: float, progress: Callable[[Epoch], None] | None) -> None:
        """Record the errors of an epoch, and keep its weights if they are the best so far."""
        self.module.eval()
        with torch.inference_mode():
            error = self.learner.errors_nt()
        rmse = float(np.sqrt(np.mean(error**2)))
        if not math.isfinite(squares + rmse):
            raise InputError(
                f"training diverged in epoch {number}; give a step size lr below {self.course.lr:g}",
                parameter="lr",
            )
        better = rmse < self.best
        train_rmse = math.sqrt(squares / self.learner.rows)
        self.history.append(Epoch(number, train_rmse, rmse, float(np.abs(error).mean()), better))
        if better:
            self.kept = copy.deepcopy(self.module.state_dict())
        if progress:
            progress(self.history[-1])

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Tensors of a checkpoint by name."""
        tensors = {f"module.{name}": value for name, value in self.module.state_dict().items()}
        tensors |= {f"kept.{name}": value for name, value in self.kept.items()}
        for name, parameter in self.trained.items():
            state = self.adam.state.get(parameter) or {}
            for key in _ADAM:
                empty = torch.zeros(()) if key == "step" else torch.zeros_like(parameter)
                tensors[f"adam.{name}.{key}"] = state.get(key, empty)
        return tensors | {f"rng.{name}": each.get_state() for name, each in self.generators.items()}


_ADAM = ("step", "exp_avg", "exp_avg_sq")  # State of Adam for each parameter
