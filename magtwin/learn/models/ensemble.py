"""Ensemble: several small networks with a mean and a variance each; where they differ nobody knows."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.learn.data.inputs import Array, inputs_from, inputs_of, scaler_tensors
from magtwin.learn.models import heads
from magtwin.learn.models.descent import Course, Epoch, check_device, descend
from magtwin.learn.models.perceptron import outputs
from magtwin.learn.models.state import digest
from magtwin.learn.models.weights import Weights


class Members(torch.nn.Module):
    """Perceptrons of one shape that stand side by side, each with two outputs, (B, F) -> (M, B, 2)."""

    def __init__(self, inputs: int, hidden: Sequence[int], members: int) -> None:
        """Weights drawn as torch draws those of a linear layer.

        Args:
            inputs: How many features.
            hidden: Widths of the hidden layers.
            members: How many perceptrons.
        """
        super().__init__()
        if not hidden or not all(width > 0 for width in hidden) or members < 1:
            raise InputError(
                f"an ensemble needs hidden layers above 0 wide and a member at least, got {tuple(hidden)} "
                f"and {members}"
            )
        self.weights, self.biases = torch.nn.ParameterList(), torch.nn.ParameterList()
        for a, b in itertools.pairwise((inputs, *hidden, 2)):
            bound = 1 / math.sqrt(a)
            self.weights.append(torch.nn.Parameter(torch.empty(members, b, a).uniform_(-bound, bound)))
            self.biases.append(torch.nn.Parameter(torch.empty(members, b).uniform_(-bound, bound)))

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(weight.shape[1] for weight in list(self.weights)[:-1])

    @property
    def members(self) -> int:
        """How many perceptrons."""
        return int(self.weights[0].shape[0])

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Two outputs of each member, shape (M, B, 2), from scaled features, shape (B, F)."""
        h = z.expand(self.members, *z.shape)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.baddbmm(bias[:, None, :], h, weight.transpose(1, 2))
            h = torch.relu(h) if i < last else h
        return h


@dataclass(kw_only=True, repr=False)
class Ensemble(heads.Headed):
    """The mean of the members' means, with what each says of its error and how far they differ."""

    net: Members

    kind = "ensemble"
    context = 0
    step_s = 0.0

    @property
    def layers_text(self) -> str:
        """How many members, and their layers."""
        widths = "-".join(str(n) for n in (len(self.features), *self.net.hidden, 2))
        return f"{self.net.members} x {widths}"

    def member(self, i: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Layers of a member: weights (out, in) and biases (out,), first to last."""
        pairs = zip(self.net.weights, self.net.biases, strict=True)
        return [(weight.detach()[i], bias.detach()[i]) for weight, bias in pairs]

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F).

        mean = mean_m(mean_m),   sd^2 = factor^2 (mean_m(sd_m^2) + var_m(mean_m))
        """
        x = self.inputs.checked(x)
        total, squares, variance = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
        for i in range(self.net.members):
            out = outputs(self.member(i), self.inputs, x)
            mean, own = heads.moments(out, 0.0, self.y_scale_nt)
            total += mean
            squares += mean**2
            variance += own
        count = self.net.members
        mean = total / count
        sd = np.sqrt(variance / count + np.maximum(squares / count - mean**2, 0.0))
        return self.y_mean_nt + mean, self.sd_factor * sd

    def settings(self) -> dict[str, Any]:
        """Members, widths of their layers, and what turns outputs into nT."""
        return {"members": self.net.members, "hidden": self.net.hidden, **super().settings()}


def fit_ensemble(
    x: Array,
    y: Array,
    groups: NDArray[np.intp],
    x_val: Array,
    y_val: Array,
    *,
    rng: np.random.Generator,
    features: str | Sequence[str],
    members: int = 5,
    layers: Sequence[int] = (64, 64),
    epochs: int = 20,
    batch: int = 1024,
    lr: float = 1e-3,
    patience: int | None = None,
    device: str = "cpu",
    init: Ensemble | None = None,
    freeze: Sequence[str] = (),
    **going: Any,
) -> tuple[Ensemble, tuple[Epoch, ...]]:
    """Fit the members side by side, each to recordings that count differently.

    Each member draws its own first weights and, for every group of recordings, its own weight from the
    exponential distribution (the Bayesian bootstrap of Rubin 1981): members then differ as much as other
    recordings would have made them, which is what is not known on the next one.

    Args:
        x: Training features, shape (N, F).
        y: Labels [nT], shape (N,).
        groups: Which session, recording or path each row is of, shape (N,).
        x_val: Features of other recordings, shape (M, F).
        y_val: Their labels [nT], shape (M,).
        rng: Source of the first weights, the groups' weights and the order of rows.
        features: Names of the features, in order, or of a set of them.
        members: How many networks.
        layers: Widths of their hidden layers.
        epochs: As `Course` has it, and so the next three.
        batch: Rows a step.
        lr: Largest step size of Adam.
        patience: Epochs without a better one after which it stops.
        device: Where it is trained, as torch calls it.
        init: Ensemble of the same inputs, layers and members that is gone on from.
        freeze: Layers that stay as `init` has them: "layers.0" is the first.
        going: `checkpoint`, `resume`, `progress` and `advance` of `descend`.

    Raises:
        InputError: A label that never varies, an `init` of another shape, or what `descend` refuses.
    """
    if y.std() < 1e-9:
        raise InputError(f"the label is {y[0]:g} nT in every training row; there is nothing to learn")
    of, seed = inputs_of(x, features), int(rng.integers(2**62))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Members(len(of.features), layers, members)
    numbers = np.unique(groups, return_inverse=True)[1]
    weights = rng.exponential(size=(members, int(numbers.max()) + 1))
    weights /= weights[:, numbers].mean(axis=1, keepdims=True)
    y_mean, y_scale = float(y.mean()), float(y.std())
    if init is not None:
        _check_like(init, of.features, net)
        of = init.inputs.grown(of)
        net.load_state_dict(init.net.state_dict())
        y_mean, y_scale = init.y_mean_nt, init.y_scale_nt
    for name in freeze:
        i = find("layer", name, {f"layers.{i}": i for i in range(len(net.weights))})
        net.weights[i].requires_grad_(False)
        net.biases[i].requires_grad_(False)
    model = Ensemble(inputs=of, net=net, y_mean_nt=y_mean, y_scale_nt=y_scale)
    check_device(device)
    net.to(device)
    course = Course(epochs=epochs, batch=batch, lr=lr, patience=patience, seed=seed)
    settings = {
        "kind": "ensemble",
        "features": list(of.features),
        "layers": list(layers),
        "members": members,
        "freeze": sorted(freeze),
        "first seed": seed,
        "threads": torch.get_num_threads(),
        "device": device,
        "torch": str(torch.__version__),
        "rows": digest(x, y, x_val, y_val),
        "init": digest(*init.net.state_dict().values()) if init else "",
    }
    learner = _Rows(model, x, y, weights[:, numbers], x_val, y_val, device)
    history = descend(learner, course, settings, started=init is not None, **going)
    net.requires_grad_(True)
    model.residual_sd_nt = min(epoch.val_rmse_nt for epoch in history)
    return model, history


def ensemble_of(weights: Weights) -> Ensemble:
    """The ensemble that a weights file holds.

    Raises:
        InputError: Its parts do not fit each other.
    """
    hidden, members = weights.widths("hidden"), weights.expect("members", int)
    if not 0 < members <= MOST_MEMBERS:
        raise InputError(f"{weights.path}: has {members} members; 1 to {MOST_MEMBERS} are read")
    widths = (len(weights.features), *hidden, 2)
    weights.check_size(members * sum(a * b for a, b in itertools.pairwise(widths)))
    net = Members(len(weights.features), hidden, members)
    count = len(weights.features)
    tensors = weights.fit(scaler_tensors(count) | net.state_dict())
    inputs = inputs_from(weights.features, tensors, weights.path)
    net.load_state_dict({name: tensors[name] for name in net.state_dict()})
    return Ensemble(
        inputs=inputs,
        net=net.eval(),
        y_mean_nt=weights.number("y_mean_nt"),
        y_scale_nt=weights.number("y_scale_nt", above=0.0),
        sd_factor=weights.number("sd_factor", above=0.0),
        residual_sd_nt=weights.residual_sd_nt,
        metadata=dict(weights.about["facts"]),
    )


MOST_MEMBERS = 1000
"""Members of an ensemble that is read from a file."""


class _Rows:
    """Rows as an ensemble learns them."""

    def __init__(
        self, model: Ensemble, x: Array, y: Array, weights: Array, x_val: Array, y_val: Array, device: str
    ) -> None:
        self.model, self.module, self.x_val, self.y_val = model, model.net, x_val, y_val
        self.z = torch.from_numpy(model.inputs.scaled(x)).float().to(device)
        self.label = torch.from_numpy((y - model.y_mean_nt) / model.y_scale_nt).float().to(device)
        self.weights = torch.from_numpy(weights).float().to(device)
        self.z_val = torch.from_numpy(model.inputs.scaled(x_val)).float().to(device)

    @property
    def items(self) -> int:
        return len(self.z)

    rows = items

    def loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out, label = self.module(self.z[chosen]), self.label[chosen]
        error = out[..., 0].detach().mean(dim=0) - label
        squares = (error**2).sum() * self.model.y_scale_nt**2
        return heads.loss(out, label, self.weights[:, chosen]) * self.module.members, squares

    @property
    def generators(self) -> dict[str, torch.Generator]:
        return {}

    def errors_nt(self) -> Array:
        means = [self.module(part)[..., 0].mean(dim=0) for part in self.z_val.split(8192)]
        found = torch.cat(means).double().cpu().numpy()
        return self.model.y_mean_nt + self.model.y_scale_nt * found - self.y_val


def _check_like(init: Ensemble, features: Sequence[str], net: Members) -> None:
    ours = (tuple(features), net.hidden, net.members)
    its = (init.features, init.net.hidden, init.net.members)
    if ours != its:
        raise InputError(
            f"the ensemble to go on from has inputs {', '.join(its[0])}, layers of {its[1]} and {its[2]} "
            f"members, this training {', '.join(ours[0])}, {ours[1]} and {ours[2]}; give it the same"
        )
