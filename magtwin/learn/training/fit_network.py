"""Fit a FieldNet to features and labels by Adam; the best epoch is kept."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Inputs, inputs_of
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.predictor import Epoch
from magtwin.learn.training.module import NetModule
from magtwin.parallel import check_room

Array = NDArray[np.float64]

BYTES_PER_UNIT = 24
"""Memory of a hidden unit for each row of a batch: values, gradients and dropout."""


def train(
    x: ArrayLike,
    y: ArrayLike,
    x_val: ArrayLike,
    y_val: ArrayLike,
    *,
    rng: np.random.Generator,
    weight: ArrayLike | None = None,
    features: str | Sequence[str] = "full",
    layers: Sequence[int] = (512, 512, 512, 512),
    dropout: float = 0.3,
    epochs: int = 20,
    batch: int = 1024,
    lr: float = 1e-3,
    patience: int | None = None,
    init: FieldNet | None = None,
    device: str = "cpu",
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> tuple[FieldNet, tuple[Epoch, ...]]:
    """Fit a network by Adam to the mean squared error of scaled labels.

    The weights of the epoch with the smallest error on the validation rows are kept. Validation rows must
    come from other runs, because rows of one run are correlated and a network can recognise a run by its
    battery. Options are those of `TrainConfig`.

    Args:
        x: Training features, in the units of `magtwin.learn.data.features`, shape (N, F); none is nan.
        y: Training labels [nT], shape (N,).
        x_val: Features of other runs, shape (M, F).
        y_val: Their labels [nT], shape (M,).
        rng: Source of the initial weights, the order of rows and dropout. The same state, machine, device and
            number of threads give the same bits.
        weight: Weight of each training row, shape (N,), above 0, on any scale. Default: all alike.
        features: Names of the features, in order, or the name of a set.
        layers: Widths of the hidden layers.
        dropout: Share of units dropped in training, to the nearest 65,536th.
        epochs: Passes over the training rows.
        batch: Rows per step.
        lr: Largest step size of Adam.
        patience: Epochs without improvement to stop after.
        init: Network of the same inputs and layers to continue from, with its scalers. It is epoch 0, so that
            the result is never worse on the validation rows.
        device: Where torch trains, "cpu" or "cuda". The result is on the CPU.
        progress: Called after each epoch.
        advance: Called after each step with the rows done and the rows of all epochs.

    Returns:
        The network, with `residual_sd_nt` the RMSE on the validation rows, and its epochs.

    Raises:
        InputError: Constant labels, training diverged, or an `init` of other inputs or layers.
    """
    x, y, x_val, y_val = (np.ascontiguousarray(part, float) for part in (x, y, x_val, y_val))
    counts = None if weight is None else np.array(weight, float)
    counts = None if counts is None else counts / counts.mean()
    if y.std() < 1e-9:
        raise InputError(f"the label is {y[0]:g} nT in every training row; there is nothing to learn")
    if device == "cpu":
        check_room(
            BYTES_PER_UNIT * min(batch, len(x)) * sum(layers),
            f"a batch of {min(batch, len(x)):,} rows through layers {', '.join(map(str, layers))}",
            "take a smaller `batch` or narrower `layers`",
            "layers",
        )
    seed = int(rng.integers(2**62))
    inputs = inputs_of(x, features)
    with torch.random.fork_rng(devices=[]):  # torch draws initial weights from its global generator
        torch.manual_seed(seed)
        if init is None:
            module = NetModule(inputs, layers, dropout=dropout, y_mean=y.mean(), y_scale=y.std())
        else:
            module = NetModule.of(_continued(init, inputs, tuple(layers), dropout))
    drop = Dropout(dropout, torch.Generator(device).manual_seed(seed + 1))
    history = Descent(
        *(module, x, y, counts, x_val, y_val), drop=drop, epochs=epochs, batch=batch, lr=lr, seed=seed
    ).run(started=init is not None, patience=patience, progress=progress, advance=advance)
    return module.net(residual_sd_nt=min(epoch.val_rmse_nt for epoch in history)), history


def _continued(init: FieldNet, inputs: Inputs, hidden: tuple[int, ...], dropout: float) -> FieldNet:
    """The network to start from, its training ranges extended by the new rows, or unknown as before."""
    if init.hidden != hidden:
        raise InputError(
            f"the network to continue from has layers of {init.hidden}, this training {hidden}; give it the "
            "same layers"
        )
    return replace(init, inputs=init.inputs.grown(inputs), dropout=dropout)


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
                f"training diverged in epoch {number}; give a step size lr below {self.lr:g}, or look for a "
                "nan in what the model makes of some inputs",
                parameter="lr",
            )
        better = rmse < min((epoch.val_rmse_nt for epoch in self.history), default=math.inf)
        train_rmse = math.sqrt(squares / len(self.z))
        self.history.append(Epoch(number, train_rmse, rmse, better))
        if better:
            self.kept = copy.deepcopy(self.module.state_dict())
        if progress:
            progress(self.history[-1])
