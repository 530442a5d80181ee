"""Temporal: a small network that looks at the last rows of a run too, never at later ones."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array, inputs_from, inputs_of, scaler_tensors
from magtwin.learn.models import heads
from magtwin.learn.models.descent import Course, Epoch, check_device, descend
from magtwin.learn.models.perceptron import CHUNK, in_threads
from magtwin.learn.models.state import digest
from magtwin.learn.models.weights import Weights
from magtwin.report import Figure

STRETCH = 64
"""Rows of a run that are learned from together."""

MOST_CONTEXT = 100_000
"""Earlier rows that a network read from a file may look at."""


class Convolutions(torch.nn.Module):
    """Causal convolutions, each twice as far apart as the one before, then two outputs.

        h_0 = z,   h_i[t] = relu(W_i (h[t - (k - 1) d], ..., h[t - d], h[t]) + b_i),   d = 2^(i - 1)

    A layer as wide as the one before adds what it was given.
    """

    def __init__(self, inputs: int, channels: Sequence[int], kernel: int) -> None:
        """Weights drawn as torch draws those of a linear layer.

        Args:
            inputs: How many features.
            channels: Widths of the layers.
            kernel: How many rows each layer looks at, the row itself among them.
        """
        super().__init__()
        if not channels or not all(width > 0 for width in channels) or kernel < 2:
            raise InputError(
                f"a temporal network needs layers above 0 wide and a kernel of 2 rows at least, got "
                f"{tuple(channels)} and {kernel}"
            )
        self.kernel = kernel
        pairs = itertools.pairwise((inputs, *channels))
        self.layers = torch.nn.ModuleList(torch.nn.Linear(kernel * a, b) for a, b in pairs)
        self.last = torch.nn.Linear(channels[-1], 2)

    @property
    def channels(self) -> tuple[int, ...]:
        """Widths of the layers."""
        return tuple(layer.out_features for layer in self.layers)  # type: ignore[misc]

    @property
    def context(self) -> int:
        """How many earlier rows an output looks at."""
        return (self.kernel - 1) * (2 ** len(self.layers) - 1)

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Two outputs of each row but the first `context`, (..., T - context, 2), from (..., T, F)."""
        for i, layer in enumerate(self.layers):
            apart = 2**i
            span = z.shape[-2] - (self.kernel - 1) * apart
            taps = [z[..., k * apart : k * apart + span, :] for k in range(self.kernel)]
            h = torch.relu(layer(torch.cat(taps, dim=-1)))
            z = h + taps[-1] if h.shape == taps[-1].shape else h
        return self.last(z)


@dataclass(kw_only=True, repr=False)
class Temporal(heads.Headed):
    """A disturbance with its standard deviation from a row and those before it."""

    net: Convolutions
    step_s: float
    """Time between the rows that it was trained on [s]."""

    kind = "tcn"

    @property
    def context(self) -> int:
        """How many earlier rows of a run a row's prediction looks at."""
        return self.net.context

    @property
    def layers_text(self) -> str:
        """Widths, kernel, and how far back it looks."""
        widths = "-".join(str(n) for n in (len(self.features), *self.net.channels, 2))
        return f"{widths}, kernel {self.net.kernel}, {self.context} rows back"

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from one run's rows (N, F).

        Before its first row a run is taken to have stood as in it. A row with a nan gives nan; to the rows
        after it, it is as the last one whole.
        """
        x = self.inputs.checked(x)
        found = np.full((len(x), 2), np.nan)
        whole = rows_whole(x)
        if not whole.any():
            return found[:, 0], found[:, 1]
        z = padded(self.inputs.scaled(x), whole, self.context).astype(np.float32)
        starts = itertools.count(0, CHUNK)  # next() on it is atomic
        threads = min(torch.get_num_threads(), math.ceil(len(x) / CHUNK))
        in_threads(lambda: self._work(z, found, starts), threads)
        found[~whole] = np.nan
        mean, variance = heads.moments(found, self.y_mean_nt, self.y_scale_nt)
        return mean, self.sd_factor * np.sqrt(variance)

    def _work(self, z: NDArray[np.float32], found: Array, starts: "itertools.count[int]") -> None:
        """Go through chunks of rows until none is left."""
        with torch.inference_mode():
            for start in starts:
                rows = min(CHUNK, len(found) - start)
                if rows <= 0:
                    return
                block = np.zeros((CHUNK + self.context, z.shape[1]), np.float32)
                block[: rows + self.context] = z[start : start + rows + self.context]
                found[start : start + rows] = self.net(torch.from_numpy(block)).numpy()[:rows]

    def settings(self) -> dict[str, Any]:
        """Widths, kernel, time between rows, and what turns outputs into nT."""
        own = {"channels": self.net.channels, "kernel": self.net.kernel, "step_s": self.step_s}
        return own | super().settings()

    def figures(self) -> list[Figure]:
        """What it is, in figures."""
        layers, parameters, inputs, *scales = super().figures()
        return [layers, parameters, inputs, Figure("rows apart", self.step_s, "s"), *scales]


@dataclass(frozen=True)
class Track:
    """A recording, whole: rows that are not learned from are looked back at all the same."""

    x: Array
    """Features, shape (N, F); nan where unknown."""

    y: Array
    """Labels [nT], shape (N,); nan in rows that are not learned from, or judged by."""

    @property
    def learned(self) -> NDArray[np.bool_]:
        """Rows that have a label, and inputs, shape (N,)."""
        return np.isfinite(self.y) & rows_whole(self.x)


def rows_whole(x: Array) -> NDArray[np.bool_]:
    """Whether every number of a row is finite, shape (N,)."""
    return np.asarray(np.isfinite(x).all(axis=1))


def padded(z: Array, whole: NDArray[np.bool_], context: int) -> Array:
    """Scaled rows with a context before the first, (context + N, F), each hole as the last whole row."""
    at = np.maximum.accumulate(np.where(whole, np.arange(len(z)), -1))
    at = np.where(at < 0, int(np.argmax(whole)), at)
    return z[np.concatenate([np.full(context, at[0]), at])]


def fit_temporal(
    tracks: Sequence[Track],
    held_out: Sequence[Track],
    *,
    rng: np.random.Generator,
    features: str | Sequence[str],
    step_s: float,
    layers: Sequence[int] = (32, 32, 32, 32),
    kernel: int = 3,
    epochs: int = 20,
    batch: int = 1024,
    lr: float = 1e-3,
    patience: int | None = None,
    device: str = "cpu",
    init: Temporal | None = None,
    **going: Any,
) -> tuple[Temporal, tuple[Epoch, ...]]:
    """Fit a temporal network to recordings, each by itself.

    Args:
        tracks: Recordings to learn from.
        held_out: Others, which choose the epoch that is kept.
        rng: Source of the first weights and the order of stretches.
        features: Names of the features, in order, or of a set of them.
        step_s: Time between rows [s].
        layers: Widths of the convolutions.
        kernel: How many rows each of them looks at.
        epochs: As `Course` has it, and so the next three.
        batch: Rows a step, in stretches of `STRETCH`.
        lr: Largest step size of Adam.
        patience: Epochs without a better one after which it stops.
        device: Where it is trained, as torch calls it.
        init: Temporal network of the same inputs, layers and kernel that is gone on from.
        going: `checkpoint`, `resume`, `progress` and `advance` of `descend`.

    Raises:
        InputError: A label that never varies, an `init` of another shape, or what `descend` refuses.
    """
    learned = [track.learned for track in tracks]
    x = np.concatenate([track.x[rows] for track, rows in zip(tracks, learned, strict=True)])
    y = np.concatenate([track.y[rows] for track, rows in zip(tracks, learned, strict=True)])
    if not len(y) or y.std() < 1e-9:
        told = f"{y[0]:g} nT in every training row" if len(y) else "not there in any row"
        raise InputError(f"the label is {told}; there is nothing to learn")
    of, seed = inputs_of(x, features), int(rng.integers(2**62))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Convolutions(len(of.features), layers, kernel)
    y_mean, y_scale = float(y.mean()), float(y.std())
    if init is not None:
        ours, its = (net.channels, kernel), (init.net.channels, init.net.kernel)
        if ours != its:
            raise InputError(
                f"the network to go on from has layers of {its[0]} and a kernel of {its[1]}, this training "
                f"{ours[0]} and {ours[1]}; give it the same"
            )
        of, y_mean, y_scale = init.inputs.grown(of), init.y_mean_nt, init.y_scale_nt
        net.load_state_dict(init.net.state_dict())
    model = Temporal(inputs=of, net=net, y_mean_nt=y_mean, y_scale_nt=y_scale, step_s=step_s)
    check_device(device)
    net.to(device)
    course = Course(epochs=epochs, batch=max(1, batch // STRETCH), lr=lr, patience=patience, seed=seed)
    settings = {
        "kind": "tcn",
        "features": list(of.features),
        "layers": list(layers),
        "kernel": kernel,
        "first seed": seed,
        "threads": torch.get_num_threads(),
        "device": device,
        "torch": str(torch.__version__),
        "rows": digest(*(array for track in (*tracks, *held_out) for array in (track.x, track.y))),
        "init": digest(*init.net.state_dict().values()) if init else "",
    }
    learner = _Stretches(model, tracks, held_out, device)
    history = descend(learner, course, settings, started=init is not None, **going)
    model.residual_sd_nt = min(epoch.val_rmse_nt for epoch in history)
    return model, history


def temporal_of(weights: Weights) -> Temporal:
    """The temporal network that a weights file holds.

    Raises:
        InputError: Its parts do not fit each other.
    """
    channels, kernel = weights.widths("channels"), weights.expect("kernel", int)
    count = len(weights.features)
    if not 2 <= kernel <= MOST_CONTEXT or (kernel - 1) * (2 ** min(len(channels), 64) - 1) > MOST_CONTEXT:
        raise InputError(
            f"{weights.path}: {len(channels)} layers with a kernel of {kernel} rows; at most "
            f"{MOST_CONTEXT:,} rows are looked back at"
        )
    weights.check_size(sum(kernel * a * b for a, b in itertools.pairwise((count, *channels))))
    net = Convolutions(count, channels, kernel)
    tensors = weights.fit(scaler_tensors(count) | net.state_dict())
    net.load_state_dict({name: tensors[name] for name in net.state_dict()})
    return Temporal(
        inputs=inputs_from(weights.features, tensors, weights.path),
        net=net.eval(),
        y_mean_nt=weights.number("y_mean_nt"),
        y_scale_nt=weights.number("y_scale_nt", above=0.0),
        step_s=weights.number("step_s", above=0.0),
        sd_factor=weights.number("sd_factor", above=0.0),
        residual_sd_nt=weights.residual_sd_nt,
        metadata=dict(weights.about["facts"]),
    )


class _Stretches:
    """Stretches of recordings as a temporal network learns them; none reaches over the end of its own."""

    def __init__(
        self, model: Temporal, tracks: Sequence[Track], held_out: Sequence[Track], device: str
    ) -> None:
        self.model, self.module, self.device = model, model.net, device
        self.held_out = [self._tensors(track) for track in held_out if track.learned.any()]
        starts, zs, labels, first = [], [], [], 0
        for track in tracks:
            if not track.learned.any():
                continue
            z, label = self._tensors(track)
            tail = -len(label) % STRETCH
            zs.append(torch.cat([z, z[-1:].expand(tail, -1)]))
            labels.append(torch.cat([label, label.new_full((tail,), math.nan)]))
            here = torch.arange(0, len(label), STRETCH)
            some = torch.isfinite(labels[-1]).reshape(-1, STRETCH).any(dim=1).cpu()
            starts.append(first + here[some])
            labels[-1] = torch.cat([label.new_full((model.context,), math.nan), labels[-1]])
            first += len(zs[-1])
        self.z, self.label, self.starts = torch.cat(zs), torch.cat(labels), torch.cat(starts).to(device)
        self.offsets = torch.arange(model.context + STRETCH, device=device)
        self.rows = int(torch.isfinite(self.label).sum())

    @property
    def items(self) -> int:
        return len(self.starts)

    def loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rows = self.starts[chosen][:, None] + self.offsets
        label = self.label[rows[:, self.model.context :]]
        known = torch.isfinite(label)
        label = torch.where(known, label, 0.0)
        out = self.module(self.z[rows])
        weight = known / known.float().mean()
        squares = ((out[..., 0].detach() - label) ** 2 * known).sum() * self.model.y_scale_nt**2
        return heads.loss(out, label, weight), squares

    @property
    def generators(self) -> dict[str, torch.Generator]:
        return {}

    def errors_nt(self) -> Array:
        errors = []
        for z, label in self.held_out:
            known = torch.isfinite(label)
            errors.append((self.module(z)[:, 0] - label)[known].double().cpu().numpy())
        return self.model.y_scale_nt * np.concatenate(errors)

    def _tensors(self, track: Track) -> tuple[torch.Tensor, torch.Tensor]:
        """Scaled rows with their context, (context + N, F); scaled labels, (N,), nan where not learned."""
        model, learned = self.model, track.learned
        z = padded(model.inputs.scaled(track.x), rows_whole(track.x), model.context)
        label = np.where(learned, (track.y - model.y_mean_nt) / model.y_scale_nt, np.nan)
        rows, labels = (torch.from_numpy(values).float().to(self.device) for values in (z, label))
        return rows, labels
