"""Training: from features and labels to a FieldNet, judged on runs that it never saw."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.features import feature_names
from magtwin.learn.model import Fact, FieldNet
from magtwin.names import RefusedError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Epoch:
    """How a network stood after one pass over the training rows."""

    number: int
    """1 is the first."""

    train_rmse_nt: float
    """Root mean square of label minus prediction in training, with dropout at work [nT]."""

    val_rmse_nt: float
    """The same on the validation rows, without dropout [nT]."""

    val_mae_nt: float
    """Mean absolute error on the validation rows [nT]."""

    best: bool
    """Whether no epoch before had a smaller val_rmse_nt; the last such epoch is kept."""


def train(
    x: ArrayLike,
    y: ArrayLike,
    x_val: ArrayLike,
    y_val: ArrayLike,
    *,
    rng: np.random.Generator,
    features: str | Sequence[str] = "full",
    layers: Sequence[int] = (512, 512, 512, 512),
    dropout: float = 0.3,
    epochs: int = 20,
    batch: int = 1024,
    lr: float = 1e-3,
    patience: int | None = None,
    facts: Mapping[str, Fact] | None = None,
    progress: Callable[[Epoch], None] | None = None,
) -> tuple[FieldNet, tuple[Epoch, ...]]:
    """Fit a network by Adam to the mean squared error of scaled labels.

    The step size rises over the first half epoch and then falls to 0 along half a cosine. The weights of the
    epoch that did best on the validation rows are kept; these have to come from other runs than the
    training rows, because rows of one run are alike and a network can know a run by its battery.

    Args:
        x: Training features, in the units of `magtwin.learn.features`, shape (N, F).
        y: Training labels: true or measured field minus map [nT], shape (N,).
        x_val: Features of other runs, shape (M, F).
        y_val: Their labels [nT], shape (M,).
        rng: Source of the first weights, the order of rows and dropout. One state, one machine and one
            number of threads give the same weights, bit for bit.
        features: Names of the features, in order, or of a set of them.
        layers: Widths of the hidden layers.
        dropout: Share of units dropped in training.
        epochs: Passes over the training rows.
        batch: Rows a step.
        lr: Largest step size of Adam.
        patience: Stop after so many epochs without a better one; None runs them all.
        facts: Provenance to keep in the weights file.
        progress: Called after each epoch.

    Returns:
        The network, in evaluation mode, its `residual_sd_nt` the root mean square error on the
        validation rows, and how each epoch went.

    Raises:
        RefusedError: Rows that are nan or of the wrong shape, a label that never varies, or a step
            size at which training diverged.
    """
    names = feature_names(features)
    x, y = _rows("training", x, y, names)
    x_val, y_val = _rows("validation", x_val, y_val, names)
    if y.std() < 1e-9:
        raise RefusedError(f"the label is {y[0]:g} nT in every training row; there is nothing to learn")
    if not (epochs > 0 and batch > 0 and lr > 0):
        raise RefusedError(f"epochs, batch and lr must be above 0, got {epochs}, {batch} and {lr}")
    with torch.random.fork_rng(devices=[]):  # first weights and dropout draw from torch's own generator
        torch.manual_seed(int(rng.integers(2**62)))
        net = FieldNet(names, layers, dropout=dropout, facts=facts)
        net.set_scalers(x, y)
        history = _fit(net, x, y, x_val, y_val, epochs, batch, lr, patience, progress)
    net.residual_sd_nt = min(epoch.val_rmse_nt for epoch in history)
    return net.eval(), tuple(history)


def _fit(
    net: FieldNet,
    x: Array,
    y: Array,
    x_val: Array,
    y_val: Array,
    epochs: int,
    batch: int,
    lr: float,
    patience: int | None,
    progress: Callable[[Epoch], None] | None,
) -> list[Epoch]:
    """Train `net` in place and leave it with the weights of its best epoch."""
    scale = float(net.y_scale)
    z = ((torch.from_numpy(x) - net.x_mean) / net.x_scale).float()
    label = ((torch.from_numpy(y) - net.y_mean) / net.y_scale).float()
    val = torch.from_numpy(x_val)
    steps = math.ceil(len(z) / batch)
    optimizer = torch.optim.Adam(net.parameters(), lr=lr, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, _Schedule(epochs * steps, max(1, steps // 2)))
    history: list[Epoch] = []
    best, kept = math.inf, copy.deepcopy(net.state_dict())
    since = 0
    for number in range(1, epochs + 1):
        net.train()
        squares = 0.0
        for rows in torch.randperm(len(z)).split(batch):
            optimizer.zero_grad(set_to_none=True)
            loss = torch.nn.functional.mse_loss(net.body(z[rows]), label[rows])
            loss.backward()
            optimizer.step()
            schedule.step()
            squares += float(loss.detach()) * len(rows)
        net.eval()
        with torch.inference_mode():
            error = np.concatenate([net(part).numpy() for part in val.split(8192)]) - y_val
        rmse = float(np.sqrt(np.mean(error**2)))
        if not math.isfinite(squares + rmse):
            raise RefusedError(f"training diverged in epoch {number}; give a step size lr below {lr:g}")
        better = rmse < best
        history.append(
            Epoch(number, scale * math.sqrt(squares / len(z)), rmse, float(np.abs(error).mean()), better)
        )
        if progress:
            progress(history[-1])
        if better:
            best, kept, since = rmse, copy.deepcopy(net.state_dict()), 0
        else:
            since += 1
        if patience is not None and since >= patience:
            break
    net.load_state_dict(kept)
    return history


@dataclass(frozen=True)
class _Schedule:
    """Factor of the step size: a straight rise, then half a cosine down to 0."""

    total: int
    rise: int

    def __call__(self, step: int) -> float:
        if step < self.rise:
            return (step + 1) / self.rise
        return 0.5 + 0.5 * math.cos(math.pi * (step - self.rise) / max(1, self.total - self.rise))


def _rows(kind: str, x: ArrayLike, y: ArrayLike, names: Sequence[str]) -> tuple[Array, Array]:
    """Features and labels as float64 arrays that fit each other and hold no nan."""
    x, y = np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)
    if x.ndim != 2 or y.shape != x.shape[:1] or x.shape[1] != len(names) or not len(y):
        raise RefusedError(
            f"{kind} rows must be features (N, {len(names)}) and labels (N,), got {x.shape} and {y.shape}"
        )
    bad = ~(np.isfinite(x).all(axis=1) & np.isfinite(y))
    if bad.any():
        row = int(np.argmax(bad))
        column = next((n for n, v in zip(names, x[row], strict=True) if not math.isfinite(v)), "label")
        raise RefusedError(
            f"{int(bad.sum())} {kind} rows hold nan or inf, first row {row} in {column}; leave them out"
        )
    return x, y
