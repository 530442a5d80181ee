"""Fit a FieldNet to features and labels."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Inputs, inputs_of
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.predictor import Epoch
from magtwin.learn.training.descent import Descent, Dropout
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

    The step size rises over the first half epoch and then falls to 0 along half a cosine. The weights of the
    epoch with the smallest error on the validation rows are kept. Validation rows must come from other runs,
    because rows of one run are correlated and a network can recognise a run by its battery.

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
        patience: Stop after this many epochs without improvement; None runs all epochs.
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
    counts = None if weight is None else np.array(weight, float) / np.mean(weight)
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
    if init.features != inputs.features or init.hidden != hidden:
        raise InputError(
            f"the network to continue from has inputs {', '.join(init.features)} and layers of "
            f"{init.hidden}, this training {', '.join(inputs.features)} and {hidden}; give it the same "
            "features and layers"
        )
    return replace(init, inputs=init.inputs.grown(inputs), dropout=dropout)
