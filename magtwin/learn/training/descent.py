"""Descent: training of a network by Adam; the best epoch is kept."""

import copy
import math
from collections.abc import Callable

import numpy as np
import torch

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array
from magtwin.learn.models.predictor import Epoch
from magtwin.learn.training.module import NetModule


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


class Descent:
    """A network in training, with its scaled rows on the device of training.

    The step size rises over the first half epoch and then falls to 0 along half a cosine.
    """

    def __init__(
        self,
        net: NetModule,
        x: Array,
        y: Array,
        weight: Array | None,
        x_val: Array,
        y_val: Array,
        *,
        drop: Dropout,
        epochs: int,
        batch: int,
        lr: float,
        seed: int,
    ) -> None:
        self.module, self.drop, device = net, drop, drop.generator.device
        self.epochs, self.batch, self.lr = epochs, batch, lr
        self.z = ((torch.from_numpy(x) - net.x_mean) / net.x_scale).float().to(device)
        self.label = ((torch.from_numpy(y) - net.y_mean) / net.y_scale).float().to(device)
        self.weight = None if weight is None else torch.from_numpy(weight).float().to(device)
        self.x_val, self.y_val = torch.from_numpy(x_val).to(device), y_val
        self.square_nt2 = float(net.y_scale) ** 2
        net.to(device)
        self.adam = torch.optim.Adam(net.parameters(), lr=lr, fused=True)
        self.order = torch.Generator().manual_seed(seed)
        self.kept = copy.deepcopy(net.state_dict())
        self.history: list[Epoch] = []

    def run(
        self,
        *,
        started: bool,
        patience: int | None,
        progress: Callable[[Epoch], None] | None,
        advance: Callable[[int, int], None] | None,
    ) -> tuple[Epoch, ...]:
        """Train until the last epoch or the end of patience, then load the best weights.

        Args:
            started: Whether the module has trained weights, which then are epoch 0.
            patience: Stop after this many epochs without improvement; None runs all epochs.
            progress: Called after each epoch.
            advance: Called after each step with the rows done and the rows of all epochs.

        Raises:
            InputError: Training diverged.
        """
        if started:
            self.module.eval()
            with torch.inference_mode():
                everything = torch.arange(len(self.z)).split(8 * self.batch)
                squares = sum(float(self._loss(chosen)[1]) for chosen in everything)
            self._note(0, squares, progress)
        for number in range(1, self.epochs + 1):
            since = len(self.history) - 1 - max((i for i, e in enumerate(self.history) if e.best), default=0)
            if patience is not None and since >= patience:
                break
            self._note(number, self._pass(number, advance), progress)
        self.module.load_state_dict(self.kept)
        self.module.eval().cpu()
        return tuple(self.history)

    def _loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean loss on rows, and the sum of their squared errors [nT^2] without gradient."""
        z, label = self.z[chosen], self.label[chosen]
        out = self.module.body(z, self.drop if self.module.training else None)
        if self.weight is None:
            loss = torch.nn.functional.mse_loss(out, label)
            return loss, loss.detach() * (len(chosen) * self.square_nt2)
        squares = (out - label) ** 2
        return (self.weight[chosen] * squares).mean(), squares.detach().sum() * self.square_nt2

    def _pass(self, number: int, advance: Callable[[int, int], None] | None) -> float:
        """One pass over the rows; returns the sum of their squared errors [nT^2]."""
        rows = len(self.z)
        steps = math.ceil(rows / self.batch)
        total, rise = self.epochs * steps, max(1, steps // 2)
        self.module.train()
        device = self.z.device
        squares, done = torch.zeros((), dtype=torch.float64, device=device), (number - 1) * rows
        order = torch.randperm(rows, generator=self.order).to(device)
        for step, chosen in enumerate(order.split(self.batch), (number - 1) * steps):
            share = math.cos(math.pi * (step - rise) / max(1, total - rise))
            for group in self.adam.param_groups:
                group["lr"] = self.lr * ((step + 1) / rise if step < rise else 0.5 + 0.5 * share)
            self.adam.zero_grad(set_to_none=True)
            loss, errors = self._loss(chosen)
            loss.backward()
            self.adam.step()
            squares += errors  # read at the end only, not to wait for a GPU
            done += len(chosen)
            if advance:
                advance(done, self.epochs * rows)
        return float(squares)

    def _note(self, number: int, squares: float, progress: Callable[[Epoch], None] | None) -> None:
        """Record the errors of an epoch, and keep its weights if they are the best so far."""
        self.module.eval()
        with torch.inference_mode():
            parts = [self.module(part).cpu().numpy() for part in self.x_val.split(8192)]
        error = np.concatenate(parts) - self.y_val
        rmse = float(np.sqrt(np.mean(error**2)))
        if not math.isfinite(squares + rmse):
            raise InputError(
                f"training diverged in epoch {number}; give a step size lr below {self.lr:g}",
                parameter="lr",
            )
        better = rmse < min((epoch.val_rmse_nt for epoch in self.history), default=math.inf)
        train_rmse = math.sqrt(squares / len(self.z))
        self.history.append(Epoch(number, train_rmse, rmse, float(np.abs(error).mean()), better))
        if better:
            self.kept = copy.deepcopy(self.module.state_dict())
        if progress:
            progress(self.history[-1])
