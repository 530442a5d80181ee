"""Own networks: a `torch.nn.Module` of the user's as a predictor.

The module gets standardised features and gives the standardised disturbance:

    z = (x - x_mean) / x_scale,  shape (N, F), float32, in the order of the features' names
    net(z) -> (N,) or (N, 1):    y = y_mean + y_scale * net(z)                          [nT]
    net(z) -> (N, 2):            the same of column 0; sd = y_scale * exp(column 1)     [nT]

The loss of the first kind is the mean square, of the second the negative log-likelihood of a normal law.
A weights file holds the module's numbers and the name of its class. Code is never loaded from a file: the
class is given once in this process, was trained in it, or is registered with `magtwin.extend.network`.
"""

import copy
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array, Inputs, inputs_from, inputs_of, scaler_tensors
from magtwin.learn.models.calibration import quantile_factor
from magtwin.learn.models.predictor import NETWORKS, OWN_MODULE, Fit, FitTask, Predictor
from magtwin.learn.models.weights import Weights, tensors_below
from magtwin.learn.training.fit_network import Descent, Dropout
from magtwin.learn.training.kinds import DESCENT, TORCH
from magtwin.report.report import Figure

ROWS = 512
"""Rows that go through a module at once, so that the bytes of a row do not depend on how many there are."""

WIDEST = 8.0
"""Largest size of the logarithm of a standardised standard deviation."""

_TRAINED: dict[str, Any] = {}
"""Classes that were trained or given in this process, and copies of instances, by name."""

Net = torch.nn.Module
Make = Callable[..., Net]


@dataclass(kw_only=True, repr=False)
class OwnModule(Predictor):
    """A predictor around a `torch.nn.Module` of the user's; see the module's docstring for its contract."""

    net: Net
    """The module, on the CPU, in evaluation."""

    name: str
    """Name of its class: "package.module:Class", or that under which it is registered."""

    y_mean: float
    """Mean of the training labels [nT]."""

    y_scale: float
    """Standard deviation of the training labels [nT]."""

    sd_factor: float | None = None
    """Factor of the module's own standard deviations. None if it gives none."""

    kind = OWN_MODULE

    @property
    def layers_text(self) -> str:
        """Name of the class, number of inputs, and what it gives."""
        return (
            f"{self.name}, {len(self.features)} inputs, {'mean' if self.sd_factor is None else 'mean and sd'}"
        )

    @property
    def parameters_count(self) -> int:
        """Number of the module's parameters."""
        return sum(part.numel() for part in self.net.parameters())

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F).

        A row with nan gives nan. The standard deviation is `residual_sd_nt` for a module that gives none.
        """
        x = self.inputs.checked(x)
        z = np.zeros((-(-len(x) // ROWS) * ROWS, len(self.features)), np.float32)
        z[: len(x)] = self.inputs.scaled(x)
        means, sds = [np.zeros(0)], [np.zeros(0)]
        with torch.inference_mode(), _one_thread():
            for block in torch.from_numpy(z).split(ROWS):
                mean_of, log_sd = outputs(self.net, block, self.name)
                means.append(mean_of.double().numpy())
                sds.append(np.ones(ROWS) if log_sd is None else log_sd.double().exp().numpy())
        mean = np.concatenate(means)[: len(x)]
        mean = np.where(np.isfinite(x).all(axis=1), self.y_mean + self.y_scale * mean, np.nan)
        if self.sd_factor is None:
            return mean, np.full(len(x), self.residual_sd_nt)
        return mean, self.sd_factor * self.y_scale * np.concatenate(sds)[: len(x)]

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Scaler and ranges, the scale of the labels, and the module's state."""
        state = {f"net.{name}": value for name, value in _state(self.net).items()}
        return {
            **self.inputs.tensors(),
            "y_mean": np.array(self.y_mean),
            "y_scale": np.array(self.y_scale),
        } | state

    def settings(self) -> dict[str, Any]:
        """Name of the class, and the factor of its standard deviations."""
        return {"class": self.name, "sd_factor": self.sd_factor}

    def figures(self) -> list[Figure]:
        """Class, parameters, inputs and the scale of labels."""
        return [
            Figure("class", self.name),
            Figure("parameters", self.parameters_count),
            Figure("inputs", ", ".join(self.features)),
            Figure("label mean", self.y_mean, "nT"),
            Figure("label sd", self.y_scale, "nT"),
        ]


class Modules:
    """A torch module of the user's own."""

    description = "A torch module of its author's own"
    options = MappingProxyType({"features": "full", **DESCENT, **TORCH})

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit by Adam; the best epoch on the validation rows is kept."""
        learned, stops, given = task.train, task.validation, task.options["module"]
        if learned.y.std() < 1e-9:
            raise InputError(
                f"the label is {learned.y[0]:g} nT in every training row; there is nothing to learn"
            )
        seed = int(task.rng.integers(2**62))
        inputs = inputs_of(learned.x, task.features)
        with torch.random.fork_rng(devices=None if task.device == "cuda" else []):
            torch.manual_seed(seed)
            net, name = made(given, inputs), name_of(given)
            _remember(name, given)
            whole = _Scaled(net, inputs, float(learned.y.mean()), float(learned.y.std()), name)
            _probe(whole, learned.x)
            descent = _OwnDescent(
                *(whole, learned.x, learned.y, None, stops.x, stops.y),  # type: ignore[arg-type]
                drop=Dropout(0.0, torch.Generator(task.device)),
                seed=seed,
                **{option: task.options[option] for option in ("epochs", "batch", "lr")},
            )
            history = descent.run(
                started=False,
                patience=task.options["patience"],
                progress=task.progress,
                advance=task.advance,
            )
        model = OwnModule(
            inputs=inputs,
            net=net.requires_grad_(False).eval(),
            name=name,
            y_mean=whole.label_mean,
            y_scale=whole.label_scale,
            residual_sd_nt=min(epoch.val_rmse_nt for epoch in history),
        )
        if whole.two:
            model.sd_factor = 1.0
            mean, sd = model.predict(stops.x)
            model.sd_factor = quantile_factor(mean - stops.y, sd, task.validation_groups)
        return Fit(model, history)

    @staticmethod
    def load(weights: Weights) -> OwnModule:
        """The module of a weights file, if its class is known."""
        path, name = weights.path, weights.expect("class", str)
        given = weights.module if weights.module is not None else _known(name, path)
        count = len(weights.features)
        plain = Inputs(weights.features, *(np.ones(count) for _ in range(4)))
        try:
            net = made(given, plain)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        like = {f"net.{key}": value for key, value in _state(net).items()}
        state = weights.fit({**scaler_tensors(count), "y_mean": np.ones(()), "y_scale": np.ones(()), **like})
        held = {key: torch.from_numpy(value.copy()) for key, value in tensors_below(state, "net.").items()}
        net.load_state_dict({key: held[key] for key in net.state_dict()})
        _remember(name, given)
        inputs = inputs_from(weights.features, state, path)
        if not state["y_scale"] > 0:
            raise InputError(f"{path}: the scale of its labels is not above 0")
        factor = weights.about.get("sd_factor")
        return OwnModule(
            inputs=inputs,
            net=net.requires_grad_(False).eval(),
            name=name,
            y_mean=float(state["y_mean"]),
            y_scale=float(state["y_scale"]),
            sd_factor=None if factor is None else weights.number("sd_factor", above=0.0),
        )


def made(given: Any, inputs: Inputs) -> Net:
    """The module: a copy of an instance, or what its class makes of the number of features.

    Raises:
        InputError: It is no `torch.nn.Module`, or its class cannot be called.
    """
    if isinstance(given, Net):
        net = copy.deepcopy(given)
    elif (isinstance(given, type) and not issubclass(given, Net)) or not callable(given):
        what = given.__name__ if isinstance(given, type) else type(given).__name__
        raise InputError(
            f"model must be a torch.nn.Module, its class, or a name, got {what}", parameter="model"
        )
    else:
        count, name = len(inputs.features), name_of(given)
        takes = _positional(given)
        call = f"{name}({count if takes else ''})"
        try:
            net = given(count) if takes else given()
        except Exception as error:
            raise InputError(
                f"model: {call} fails: {type(error).__name__}: {error}; the class is called with the number "
                "of features alone, so give other arguments a default, or give an instance",
                parameter="model",
            ) from error
        if not isinstance(net, Net):
            raise InputError(
                f"model: {call} gives {type(net).__name__}, no torch.nn.Module", parameter="model"
            )
    net = net.cpu()
    if not any(part.requires_grad for part in net.parameters()) and inputs.scale.any():
        if not list(net.parameters()):
            raise InputError(f"model: {name_of(given)} has no parameters, so there is nothing to train")
        net.requires_grad_(True)
    return net


def _positional(make: Make) -> bool:
    """Whether a class or function takes an argument by its place."""
    try:
        parameters = inspect.signature(make).parameters.values()
    except (TypeError, ValueError):
        return True
    return any(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD, p.VAR_POSITIONAL) for p in parameters)


def name_of(given: Any) -> str:
    """The name of a module's class in weights files: as registered, or "package.module:Class"."""
    of = type(given) if isinstance(given, Net) else given
    registered = next((name for name in NETWORKS if NETWORKS[name] is of), "")
    return registered or f"{of.__module__}:{of.__qualname__}"


def _remember(name: str, given: Any) -> None:
    _TRAINED[name] = copy.deepcopy(given) if isinstance(given, Net) else given


def _known(name: str, path: object) -> Any:
    """What makes the module called `name`; nothing is imported for it."""
    if name in _TRAINED:
        return _TRAINED[name]
    if name in NETWORKS:
        return NETWORKS[name]
    alone = name.rpartition(":")[2].rpartition(".")[2]
    raise InputError(
        f"{path}: holds a torch module {name!r}, and no code is loaded from a file; give its class, as in "
        f"load_predictor({str(path)!r}, module={alone}), or register it before: "
        f'@magtwin.extend.network("{name}") above class {alone}'
    )


def outputs(net: Net, z: torch.Tensor, name: str) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Standardised mean, shape (N,), and logarithm of the standard deviation or None, of features (N, F).

    Raises:
        InputError: The module fails on these features, or gives another shape or type.
    """
    rows, count = z.shape
    try:
        out = net(z)
    except (RuntimeError, ValueError, TypeError, IndexError, NotImplementedError, AttributeError) as error:
        text = " ".join(str(error).split())[:300]
        raise InputError(
            f"model: {name} fails on {rows} rows of {count} features, shape {tuple(z.shape)}: {text}; its "
            f"first layer must take {count} inputs, or choose other `features`",
            parameter="model",
        ) from error
    if (
        isinstance(out, tuple | list)
        and len(out) == 2
        and all(isinstance(part, torch.Tensor) for part in out)
    ):
        out = torch.stack(
            [part.reshape(rows, -1)[:, 0] if part.numel() == rows else part for part in out], -1
        )
    if not isinstance(out, torch.Tensor) or not out.is_floating_point():
        kind = str(out.dtype) if isinstance(out, torch.Tensor) else type(out).__name__
        raise InputError(f"model: {name} gives {kind}; it must give a tensor of floats", parameter="model")
    if out.shape in ((rows,), (rows, 1)):
        return out.reshape(rows), None
    if out.shape == (rows, 2):
        return out[:, 0], out[:, 1].clamp(-WIDEST, WIDEST)
    raise InputError(
        f"model: {name} gives shape {tuple(out.shape)} for {rows} rows of {count} features; it must be "
        f"({rows},) or ({rows}, 1), the standardised disturbance, or ({rows}, 2), that and the logarithm of "
        "its standard deviation",
        parameter="model",
    )


class _Scaled(Net):
    """A module between the scalers of features and labels, as `Descent` trains it."""

    def __init__(self, net: Net, inputs: Inputs, y_mean: float, y_scale: float, name: str) -> None:
        super().__init__()
        self.net, self.name, self.two = net, name, False
        self.label_mean, self.label_scale = y_mean, y_scale
        scalers = {"x_mean": inputs.mean, "x_scale": inputs.scale, "y_mean": y_mean, "y_scale": y_scale}
        for key, value in scalers.items():
            self.register_buffer(key, torch.tensor(value, dtype=torch.float64))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Disturbances [nT], shape (B,), float64."""
        z = ((x - self.x_mean) / self.x_scale).float()  # type: ignore[operator]
        mean: torch.Tensor = self.y_mean + self.y_scale * outputs(self.net, z, self.name)[0].double()  # type: ignore[operator]
        return mean


class _OwnDescent(Descent):
    """The descent of a module whose dropout is its own."""

    def _loss(self, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        whole: Any = self.module
        mean, log_sd = outputs(whole.net, self.z[chosen], whole.name)
        squares = (mean.float() - self.label[chosen]) ** 2
        loss = squares.mean() if log_sd is None else (squares * torch.exp(-2 * log_sd) / 2 + log_sd).mean()
        return loss, squares.detach().sum() * self.square_nt2


def _probe(whole: _Scaled, x: Array) -> None:
    """Refuse a module that does not fit the features, before it is trained."""
    z = ((torch.from_numpy(np.ascontiguousarray(x[:8])) - whole.x_mean) / whole.x_scale).float()  # type: ignore[operator]
    whole.net.eval()
    with torch.inference_mode():
        mean, log_sd = outputs(whole.net, z, whole.name)
    whole.two = log_sd is not None
    for what, values in (("output", mean), ("logarithm of the standard deviation", log_sd)):
        if values is not None and not bool(torch.isfinite(values).all()):
            row = int((~torch.isfinite(values)).nonzero()[0])
            raise InputError(
                f"model: the {what} of {whole.name} is {float(values[row])} on row {row} of finite features, "
                "before any training; look for a logarithm, a root or a division in its forward",
                parameter="model",
            )


def _state(net: Net) -> dict[str, NDArray[Any]]:
    """The state of a module as arrays."""
    state = {}
    for name, value in net.state_dict().items():
        if not isinstance(value, torch.Tensor) or value.dtype == torch.bfloat16:
            raise InputError(
                f"model: {name!r} of its state is no tensor that a weights file holds; use float32"
            )
        state[name] = value.detach().cpu().numpy().copy()
    return state


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread of torch, since their number changes the last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
