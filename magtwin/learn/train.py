"""Training: from features and labels to a FieldNet, judged on runs that it never saw."""

import copy
import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.learn.features import feature_names
from magtwin.learn.model import Fact, FieldNet
from magtwin.learn.state import load_state, save_state
from magtwin.names import RefusedError, find

Array = NDArray[np.float64]


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
    init: FieldNet | None = None,
    freeze: Sequence[str] = (),
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    device: str = "cpu",
    progress: Callable[[Epoch], None] | None = None,
    advance: Callable[[int, int], None] | None = None,
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
        rng: Source of the first weights, the order of rows and dropout. One state, one machine, one device
            and one number of threads give the same weights, bit for bit.
        features: Names of the features, in order, or of a set of them.
        layers: Widths of the hidden layers.
        dropout: Share of units dropped in training, to the nearest 65,536th.
        epochs: Passes over the training rows.
        batch: Rows a step.
        lr: Largest step size of Adam.
        patience: Stop after so many epochs without a better one; None runs them all.
        facts: Provenance to keep in the weights file.
        init: Network of the same inputs and layers whose weights and scalers are gone on from. It is an
            epoch 0 of its own, so that what is kept is never worse on the validation rows than it was.
        freeze: Names of layers that stay as `init` has them: "layers.0" is the first.
        checkpoint: File that the state of the training is written to after each epoch.
        resume: Go on from `checkpoint`; the weights are those of a training that was never stopped.
        device: Where it is trained, as torch calls it: "cpu", "cuda". The network comes back to the CPU.
        progress: Called after each epoch.
        advance: Called after each step with how many rows are done, and of how many in all epochs.

    Returns:
        The network, in evaluation mode, its `residual_sd_nt` the root mean square error on the
        validation rows, and how each epoch went.

    Raises:
        RefusedError: Rows that are nan or of the wrong shape, a label that never varies, a step size at
            which training diverged, a device that is not there, an `init` of other inputs or layers, or a
            checkpoint of another training.
    """
    names = feature_names(features)
    x, y = _rows("training", x, y, names)
    x_val, y_val = _rows("validation", x_val, y_val, names)
    if y.std() < 1e-9:
        raise RefusedError(f"the label is {y[0]:g} nT in every training row; there is nothing to learn")
    if not (epochs > 0 and batch > 0 and lr > 0):
        raise RefusedError(f"epochs, batch and lr must be above 0, got {epochs}, {batch} and {lr}")
    if patience is not None and patience < 1:
        raise RefusedError(f"patience must be 1 epoch at least, got {patience}; leave it out to run them all")
    if resume and checkpoint is None:
        raise RefusedError("there is no checkpoint to resume from; name one")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise RefusedError(
            f"device {device!r}: this torch has none ({str(error).splitlines()[0]})"
        ) from error
    seed = int(rng.integers(2**62))
    with torch.random.fork_rng(devices=[]):  # first weights are drawn from torch's own generator
        torch.manual_seed(seed)
        net = FieldNet(names, layers, dropout=dropout, facts=facts)
    if init is None:
        net.set_scalers(x, y)
    else:
        _go_on_from(net, init, x)
    _freeze(net, freeze, init)
    settings = {
        "features": list(names),
        "layers": list(net.hidden),
        "dropout": dropout,
        "epochs": epochs,
        "batch": batch,
        "lr": lr,
        "patience": patience,
        "freeze": sorted(freeze),
        "seed": seed,
        "device": device,
        "threads": torch.get_num_threads(),
        "torch": str(torch.__version__),
    }
    training = _Training(net, x, y, x_val, y_val, settings, started=init is not None)
    if checkpoint is not None:
        settings["rows"] = _digest(x, y, x_val, y_val)
        settings["init"] = _digest(*init.state_dict().values()) if init is not None else ""
    if resume and checkpoint is not None:
        training.load(checkpoint)
    training.run(checkpoint, progress, advance)
    net.requires_grad_(True)
    net.residual_sd_nt = training.best
    return net.eval(), tuple(training.history)


class _Training:
    """A network on its way, and all that its next step depends on."""

    def __init__(
        self,
        net: FieldNet,
        x: Array,
        y: Array,
        x_val: Array,
        y_val: Array,
        settings: dict[str, Any],
        *,
        started: bool,
    ) -> None:
        self.net, self.settings, self.started = net, settings, started
        device = settings["device"]
        self.z = ((torch.from_numpy(x) - net.x_mean) / net.x_scale).float().to(device)
        self.label = ((torch.from_numpy(y) - net.y_mean) / net.y_scale).float().to(device)
        self.x_val, self.y_val = torch.from_numpy(x_val).to(device), y_val
        net.to(device)
        self.order = torch.Generator().manual_seed(settings["seed"])
        self.drop = Dropout(settings["dropout"], torch.Generator(device).manual_seed(settings["seed"] + 1))
        self.trained = {name: p for name, p in net.named_parameters() if p.requires_grad}
        self.adam = torch.optim.Adam(self.trained.values(), lr=settings["lr"], fused=True)
        self.kept = copy.deepcopy(net.state_dict())
        self.history: list[Epoch] = []

    @property
    def best(self) -> float:
        """Smallest error on the validation rows so far [nT]; inf before the first epoch."""
        return min((epoch.val_rmse_nt for epoch in self.history), default=math.inf)

    @property
    def ended(self) -> bool:
        """Whether as many epochs as patience admits have passed since the best one."""
        patience = self.settings["patience"]
        last = max((i for i, epoch in enumerate(self.history) if epoch.best), default=0)
        return patience is not None and len(self.history) - 1 - last >= patience

    def run(
        self,
        checkpoint: str | os.PathLike[str] | None,
        progress: Callable[[Epoch], None] | None,
        advance: Callable[[int, int], None] | None,
    ) -> None:
        """Train until the last epoch or the end of patience, and leave the network with its best weights."""
        if self.started and not self.history:
            self._note(0, self._train_error(), progress)
        first = self.history[-1].number + 1 if self.history else 1
        for number in range(first, self.settings["epochs"] + 1):
            if self.ended:
                break
            self._note(number, self._pass(number, advance), None)
            if checkpoint is not None:
                save_state(checkpoint, self._tensors(), self.settings, [asdict(e) for e in self.history])
            if progress:
                progress(self.history[-1])
        self.net.load_state_dict(self.kept)
        self.net.cpu()

    def load(self, checkpoint: str | os.PathLike[str]) -> None:
        """Take the state that a checkpoint holds."""
        found, told = load_state(checkpoint, self._tensors(), self.settings)
        try:
            self.history = [Epoch(**epoch) for epoch in told]
            numbers = [epoch.number for epoch in self.history]
            sound = numbers == list(range(0 if self.started else 1, self.settings["epochs"] + 1))[: len(told)]
            sound &= any(epoch.best for epoch in self.history) and math.isfinite(self.best)
        except TypeError:
            sound = False
        if not sound:
            raise RefusedError(f"{checkpoint}: its epochs are not those of a training; start anew")
        self.net.load_state_dict(_part(found, "net."))
        self.kept = _part(found, "kept.")
        for name, parameter in self.trained.items():
            state = {key: found[f"adam.{name}.{key}"].to(parameter.device) for key in _ADAM}
            self.adam.state[parameter] = state
        self.order.set_state(found["rng.order"])
        self.drop.generator.set_state(found["rng.dropout"])

    def _pass(self, number: int, advance: Callable[[int, int], None] | None) -> float:
        """Go over the training rows once; gives the error in training, with dropout at work [nT]."""
        rows, batch, lr = len(self.z), self.settings["batch"], self.settings["lr"]
        steps = math.ceil(rows / batch)
        schedule = _Schedule(self.settings["epochs"] * steps, max(1, steps // 2))
        device, done = self.z.device, (number - 1) * rows
        squares = torch.zeros((), dtype=torch.float64, device=device)
        order = torch.randperm(rows, generator=self.order).to(device)
        for step, chosen in enumerate(order.split(batch), (number - 1) * steps):
            for group in self.adam.param_groups:
                group["lr"] = lr * schedule(step)
            self.adam.zero_grad(set_to_none=True)
            loss = torch.nn.functional.mse_loss(self._forward(self.z[chosen]), self.label[chosen])
            loss.backward()
            self.adam.step()
            squares += loss.detach() * len(chosen)
            done += len(chosen)
            if advance:
                advance(done, self.settings["epochs"] * rows)
        return self._in_nt(float(squares))

    def _forward(self, z: torch.Tensor) -> torch.Tensor:
        """Scaled labels, shape (B,), from scaled features, shape (B, F), units dropped."""
        *inner, last = self.net.linears
        for i, layer in enumerate(inner):
            z = torch.relu(layer(z))
            if i < len(inner) - 1:
                z = self.drop(z)
        return last(z).squeeze(-1)

    def _train_error(self) -> float:
        """Error on the training rows as the network stands, without dropout [nT]."""
        self.net.eval()
        with torch.inference_mode():
            parts = zip(self.z.split(8192), self.label.split(8192), strict=True)
            return self._in_nt(sum(float(((self.net.body(z) - y) ** 2).sum()) for z, y in parts))

    def _in_nt(self, squares: float) -> float:
        return float(self.net.y_scale) * math.sqrt(squares / len(self.z)) if squares >= 0 else math.nan

    def _note(self, number: int, train_rmse: float, progress: Callable[[Epoch], None] | None) -> None:
        """Judge the network on the validation rows and keep it if it is the best so far."""
        self.net.eval()
        with torch.inference_mode():
            parts = [self.net(part).cpu().numpy() for part in self.x_val.split(8192)]
        error = np.concatenate(parts) - self.y_val
        rmse = float(np.sqrt(np.mean(error**2)))
        if not math.isfinite(train_rmse + rmse):
            lr = self.settings["lr"]
            raise RefusedError(f"training diverged in epoch {number}; give a step size lr below {lr:g}")
        better = rmse < self.best
        self.history.append(Epoch(number, train_rmse, rmse, float(np.abs(error).mean()), better))
        if better:
            self.kept = copy.deepcopy(self.net.state_dict())
        if progress:
            progress(self.history[-1])

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint holds, by name."""
        found = {f"net.{name}": value for name, value in self.net.state_dict().items()}
        found |= {f"kept.{name}": value for name, value in self.kept.items()}
        for name, parameter in self.trained.items():
            state = self.adam.state.get(parameter) or {}
            for key in _ADAM:
                empty = torch.zeros(()) if key == "step" else torch.zeros_like(parameter)
                found[f"adam.{name}.{key}"] = state.get(key, empty)
        return found | {"rng.order": self.order.get_state(), "rng.dropout": self.drop.generator.get_state()}


class Dropout:
    """Drops a share of units and scales the others up, by 16 random bits a unit.

    torch's own draws a number for each unit, which takes a fourth of all time of a training on a CPU; these
    bits take a fortieth.
    """

    def __init__(self, share: float, generator: torch.Generator) -> None:
        """A dropout of a share of the units, to the nearest 65,536th, by the bits of a generator."""
        self.generator = generator
        dropped = min(round(share * 65_536), 65_535)
        self._least = dropped - 32_768
        """Least of 16 bits, read as a number from -32,768 up, that a unit is kept by."""

        self._scale = 65_536 / (65_536 - dropped)
        self._bits = torch.empty(0, dtype=torch.int64, device=generator.device)

    def __call__(self, h: torch.Tensor) -> torch.Tensor:
        """The units with some of them dropped, shape as they have."""
        if self._scale == 1:
            return h
        words = -(-h.numel() // 4)
        if len(self._bits) < words:
            self._bits = torch.empty(words, dtype=torch.int64, device=h.device)
        bits = self._bits[:words].random_(-(2**63), None, generator=self.generator)
        kept = bits.view(torch.int16)[: h.numel()].view(h.shape) >= self._least
        return h * kept.to(h.dtype).mul_(self._scale)


_ADAM = ("step", "exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter."""


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _go_on_from(net: FieldNet, init: FieldNet, x: Array) -> None:
    """Take over weights and scalers; the training ranges grow by the new rows, or stay unknown."""
    if init.features != net.features or init.hidden != net.hidden:
        raise RefusedError(
            f"the network to go on from has inputs {', '.join(init.features)} and layers of {init.hidden}, "
            f"this training {', '.join(net.features)} and {net.hidden}; give it the same features and layers"
        )
    net.load_state_dict(init.state_dict())
    net.x_min.copy_(torch.from_numpy(np.minimum(net.x_min.numpy(), x.min(axis=0))))
    net.x_max.copy_(torch.from_numpy(np.maximum(net.x_max.numpy(), x.max(axis=0))))


def _freeze(net: FieldNet, names: Sequence[str], init: FieldNet | None) -> None:
    """Leave layers out of the training."""
    if names and init is None:
        raise RefusedError("freeze keeps layers of trained weights: give init too")
    layers = {f"layers.{i}": layer for i, layer in enumerate(net.linears)}
    for name in names:
        find("layer", name, layers).requires_grad_(False)
    if set(names) == set(layers):
        raise RefusedError("every layer is frozen; there is nothing left to train")


def _digest(*arrays: Array | torch.Tensor) -> str:
    """SHA-256 of the numbers of arrays."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


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
