"""Descent: Adam down a loss, epoch by epoch, the best one kept, killed and resumed to the same bits."""

import copy
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import torch

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array
from magtwin.learn.models.state import load_state, save_state


@dataclass(frozen=True)
class Epoch:
    """How a network stood after one pass over the training rows."""

    number: int
    """1 is the first; 0 is how the weights stood that training went on from."""

    train_rmse_nt: float
    """Root mean square of label minus prediction in training, with dropout at work but in epoch 0 [nT]."""

    val_rmse_nt: float
    """The same on the validation rows, without dropout [nT]."""

    val_mae_nt: float
    """Mean absolute error on the validation rows [nT]."""

    best: bool
    """Whether no epoch before had a smaller val_rmse_nt; the last such epoch is kept."""


class Learner(Protocol):
    """What is to be learned: a module, a loss on some of its items, and its errors on recordings held out."""

    @property
    def module(self) -> torch.nn.Module:
        """What is trained."""

    @property
    def items(self) -> int:
        """How many items an epoch goes over: rows, or stretches of them."""

    @property
    def rows(self) -> int:
        """How many rows they are."""

    @property
    def generators(self) -> Mapping[str, torch.Generator]:
        """What it draws from beside the order of items, by name."""

    def loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean loss on items, and the sum of squares of their rows' errors [nT^2] without a gradient.

        Units are dropped while the module is in training mode.
        """

    def errors_nt(self) -> Array:
        """Errors on the validation rows as the module stands [nT], shape (M,)."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """How far and how fast a descent goes."""

    epochs: int
    batch: int
    """Items a step."""

    lr: float
    """Largest step size of Adam."""

    patience: int | None = None
    """Stop after so many epochs without a better one; None runs them all."""

    seed: int = 0
    """Of the order of items."""


def check_device(device: str) -> None:
    """Refuse a device that this torch does not have.

    Args:
        device: As torch calls it: "cpu", "cuda".

    Raises:
        InputError: It has none such.
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
    """Lead a module to the weights that do best on the validation rows.

    The step size rises over the first half epoch and then falls to 0 along half a cosine.

    Args:
        learner: What is learned.
        course: How.
        settings: What else decides the outcome, as JSON has it: a checkpoint of others is refused.
        started: Whether the module goes on from trained weights: they are an epoch 0 of their own.
        checkpoint: File that the state is written to after each epoch.
        resume: Go on from `checkpoint`.
        progress: Called after each epoch.
        advance: Called after each step with how many rows are done, and of how many in all epochs.

    Raises:
        InputError: A step size at which training diverged, nothing to train, or a checkpoint of another
            training.
    """
    if resume and checkpoint is None:
        raise InputError("there is no checkpoint to resume from; name one")
    going = _Descent(learner, course, {**asdict(course), **settings}, started)
    if resume and checkpoint is not None:
        going.load(checkpoint)
    going.run(checkpoint, progress, advance)
    return tuple(going.history)


class _Descent:
    """A module on its way, and all that its next step depends on."""

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
        """Smallest error on the validation rows so far [nT]; inf before the first epoch."""
        return min((epoch.val_rmse_nt for epoch in self.history), default=math.inf)

    def run(
        self,
        checkpoint: str | os.PathLike[str] | None,
        progress: Callable[[Epoch], None] | None,
        advance: Callable[[int, int], None] | None,
    ) -> None:
        """Train until the last epoch or the end of patience, and leave the module with its best weights."""
        if self.started and not self.history:
            self.module.eval()
            with torch.inference_mode():
                everything = torch.arange(self.learner.items).split(8 * self.course.batch)
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
        """Take the state that a checkpoint holds."""
        found, told = load_state(checkpoint, self._tensors(), self.settings)
        try:
            self.history = [Epoch(**epoch) for epoch in told]
            numbers = [epoch.number for epoch in self.history]
            sound = numbers == list(range(0 if self.started else 1, self.course.epochs + 1))[: len(told)]
            sound &= any(epoch.best for epoch in self.history) and math.isfinite(self.best)
        except TypeError:
            sound = False
        if not sound:
            raise InputError(f"{checkpoint}: its epochs are not those of a training; start anew")
        self.module.load_state_dict(_part(found, "module."))
        self.kept = _part(found, "kept.")
        for name, parameter in self.trained.items():
            state = {key: found[f"adam.{name}.{key}"].to(parameter.device) for key in _ADAM}
            self.adam.state[parameter] = state
        for name, generator in self.generators.items():
            generator.set_state(found[f"rng.{name}"])

    def _pass(self, number: int, advance: Callable[[int, int], None] | None) -> float:
        """Go over the items once; gives the sum of squares of their errors [nT^2]."""
        items, course = self.learner.items, self.course
        steps = math.ceil(items / course.batch)
        total, rise = course.epochs * steps, max(1, steps // 2)
        self.module.train()
        device = next(self.module.parameters()).device
        squares, done = torch.zeros((), dtype=torch.float64, device=device), (number - 1) * items
        order = torch.randperm(items, generator=self.order).to(device)
        for step, chosen in enumerate(order.split(course.batch), (number - 1) * steps):
            share = math.cos(math.pi * (step - rise) / max(1, total - rise))
            for group in self.adam.param_groups:
                group["lr"] = course.lr * ((step + 1) / rise if step < rise else 0.5 + 0.5 * share)
            self.adam.zero_grad(set_to_none=True)
            loss, errors = self.learner.loss(chosen)
            loss.backward()
            self.adam.step()
            squares += errors  # not asked for before the end: a GPU would be waited for
            done += len(chosen)
            if advance:
                per = self.learner.rows / items
                advance(round(done * per), round(course.epochs * items * per))
        return float(squares)

    def _note(self, number: int, squares: float, progress: Callable[[Epoch], None] | None) -> None:
        """Judge the module on the validation rows and keep it if it is the best so far."""
        self.module.eval()
        with torch.inference_mode():
            error = self.learner.errors_nt()
        rmse = float(np.sqrt(np.mean(error**2)))
        if not math.isfinite(squares + rmse):
            raise InputError(
                f"training diverged in epoch {number}; give a step size lr below {self.course.lr:g}"
            )
        better = rmse < self.best
        train_rmse = math.sqrt(squares / self.learner.rows)
        self.history.append(Epoch(number, train_rmse, rmse, float(np.abs(error).mean()), better))
        if better:
            self.kept = copy.deepcopy(self.module.state_dict())
        if progress:
            progress(self.history[-1])

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint holds, by name."""
        found = {f"module.{name}": value for name, value in self.module.state_dict().items()}
        found |= {f"kept.{name}": value for name, value in self.kept.items()}
        for name, parameter in self.trained.items():
            state = self.adam.state.get(parameter) or {}
            for key in _ADAM:
                empty = torch.zeros(()) if key == "step" else torch.zeros_like(parameter)
                found[f"adam.{name}.{key}"] = state.get(key, empty)
        return found | {f"rng.{name}": one.get_state() for name, one in self.generators.items()}


_ADAM = ("step", "exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter."""


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
