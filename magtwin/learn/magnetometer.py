"""NeuralMagnetometer: a network that gives a Run its disturbance."""

import itertools
import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin import files
from magtwin.learn.features import FEATURES, features
from magtwin.learn.model import Fact, FieldNet, load_net
from magtwin.names import RefusedError
from magtwin.run import Run

Array = NDArray[np.float64]

_CHUNK = 512
"""Rows worked on at once: layers of 512 then stay in a core's cache. 256 to 1,024 time alike."""

_TILE = 16
"""Rows of the last chunk are filled up to a multiple of this, a whole number of the rows that
matrix kernels take at once, so that a row's bytes do not depend on its neighbours."""

_FAR = 5.0
"""Scales from the mean beyond which an input is outside, where the training range is unknown."""


def in_threads(work: Callable[[], None], threads: int) -> None:
    """Do `work` once in each of some threads, with torch's products in one thread each.

    Both cores are then busy between products too, which torch's own threads leave idle.

    Args:
        work: What each thread does; it takes its share of a common supply until none is left.
        threads: How many; for one at most, it is done here, with torch as it is.

    Raises:
        BaseException: The first that a thread raised, after all have ended.
    """
    if threads <= 1:
        work()
        return
    failures: list[BaseException] = []

    def guarded() -> None:
        try:
            work()
        except BaseException as error:
            failures.append(error)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        others = [threading.Thread(target=guarded) for _ in range(threads - 1)]
        for thread in others:
            thread.start()
        guarded()
        for thread in others:
            thread.join()
    finally:
        torch.set_num_threads(before)
    if failures:
        raise failures[0]


class NeuralMagnetometer:
    """Predicts disturbances in blocks of rows.

    Each block is worked on by one thread, in a fixed order, and blocks are shared out among as many
    threads as torch would use; so the result does not depend on the number of threads, nor a row's
    result on the other rows.
    """

    def __init__(self, net: FieldNet, *, name: str = "", sha256: str = "") -> None:
        """Use a network.

        Args:
            net: The network; its weights are copied.
            name: Where it comes from, for the facts of a run.
            sha256: Checksum of its file, for the facts of a run.
        """
        self.net, self.name, self.sha256 = net, name, sha256
        self._weights = [layer.weight.detach().clone().t() for layer in net.linears]
        self._biases = [layer.bias.detach().clone() for layer in net.linears]
        self._x_mean, self._x_scale = net.x_mean.numpy().copy(), net.x_scale.numpy().copy()
        self._y_mean, self._y_scale = float(net.y_mean), float(net.y_scale)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, sha256: str = "") -> "NeuralMagnetometer":
        """The magnetometer of a weights file, safetensors or a released `.pth`.

        Args:
            path: The weights.
            sha256: Checksum that the file must have, lower-case hex; "" takes any.

        Raises:
            RefusedError: No such file, another checksum, or not a network.
        """
        path = files.existing(path, "weights file")
        found = files.sha256(path)
        if sha256 and found != sha256.lower():
            raise RefusedError(
                f"{path}: its sha256 is {found}, expected {sha256}; get the file again or change the checksum"
            )
        return cls(load_net(path), name=path.name, sha256=found)

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.net.features

    @property
    def columns(self) -> frozenset[str]:
        """Columns of a Run that the inputs are taken from."""
        return frozenset(column for name in self.features for column in FEATURES[name].columns)

    @property
    def residual_sd_nt(self) -> float:
        """Standard deviation of label minus prediction on held-out runs [nT]; nan where unknown."""
        return self.net.residual_sd_nt

    @property
    def facts(self) -> Mapping[str, Fact]:
        """What a run says of its network: file, checksum, layers, parameters."""
        layers = "-".join(str(n) for n in (len(self.features), *self.net.hidden, 1))
        return {
            "network": self.name,
            "network_sha256": self.sha256,
            "network_layers": layers,
            "network_parameters": self.net.parameters_count,
        }

    def disturbance_nt(self, run: Run) -> Array:
        """Disturbance at each reading of a run [nT], shape (N,).

        Raises:
            RefusedError: The run lacks a column that the network reads.
        """
        return self.predict(features(run, self.features))

    def read(
        self, runs: Sequence[Run], *, outside: bool = True
    ) -> list[tuple[Array, NDArray[np.bool_] | None]]:
        """`disturbance_nt` and `outside_training` of each of many runs, all rows in one stream of blocks.

        Args:
            runs: At least one.
            outside: Whether `outside_training` is wanted; none is given else.

        Raises:
            RefusedError: A run lacks a column that the network reads.
        """
        parts = [features(run, self.features) for run in runs]
        x = parts[0] if len(parts) == 1 else np.concatenate(parts)
        ends = np.cumsum([run.rows for run in runs])[:-1]
        left = np.split(self.outside(x), ends) if outside else [None] * len(runs)
        return list(zip(np.split(self.predict(x), ends), left, strict=True))

    def outside_training(self, run: Run) -> NDArray[np.bool_]:
        """Whether an input of a reading left the range of the training rows, shape (N,).

        Where the weights file does not hold that range (the released one does not), an input is
        outside when it lies more than 5 scales from its mean. nan is outside.
        """
        return self.outside(features(run, self.features))

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """As `outside_training`, from features (N, F)."""
        x = self._checked(x)
        low, high = self.net.x_min.numpy(), self.net.x_max.numpy()
        low = np.where(np.isnan(low), self._x_mean - _FAR * self._x_scale, low)
        high = np.where(np.isnan(high), self._x_mean + _FAR * self._x_scale, high)
        slack = 1e-9 * np.maximum(np.abs(low), np.abs(high))  # rounding of inputs that never vary
        low, high = low - slack, high + slack
        inside = np.empty(len(x), bool)
        for start in range(0, len(x), _CHUNK):
            block = x[start : start + _CHUNK]
            np.all((block >= low) & (block <= high), axis=1, out=inside[start : start + _CHUNK])
        return ~inside

    def predict(self, x: ArrayLike) -> Array:
        """Disturbances [nT], shape (N,), from features in their units, shape (N, F).

        A row with a nan gives nan. Products are float32, scaling is float64; against float64
        throughout the released network errs by less than 0.01 nT.
        """
        x = self._checked(x)
        y = np.empty(len(x))
        starts = itertools.count(0, _CHUNK)  # next() on it is atomic
        threads = min(torch.get_num_threads(), math.ceil(len(x) / _CHUNK))
        in_threads(lambda: self._work(x, y, starts), threads)
        return y

    def _work(self, x: Array, y: Array, starts: "itertools.count[int]") -> None:
        """Predict chunks until none is left; nothing is allocated between the first and the last."""
        rows = _CHUNK if len(x) > _CHUNK else -(-len(x) // _TILE) * _TILE
        z = np.zeros((rows, x.shape[1]))
        with torch.inference_mode():
            blocks = [torch.empty(rows, x.shape[1])] + [torch.empty(rows, len(b)) for b in self._biases]
            scaled, last = torch.from_numpy(z), blocks[-1].numpy()[:, 0]
            for start in starts:
                block = x[start : start + _CHUNK]
                if not len(block):
                    return
                n = len(block)
                np.subtract(block, self._x_mean, out=z[:n])
                np.divide(z[:n], self._x_scale, out=z[:n])
                blocks[0].copy_(scaled)
                for i, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
                    torch.addmm(bias, blocks[i], weight, out=blocks[i + 1])
                    if i < len(self._biases) - 1:
                        blocks[i + 1].relu_()
                y[start : start + n] = self._y_mean + self._y_scale * last[:n].astype(float)

    def _checked(self, x: ArrayLike) -> Array:
        x = np.ascontiguousarray(x, float)
        if x.ndim != 2 or x.shape[1] != len(self.features):
            raise RefusedError(
                f"this network reads {len(self.features)} features a row, shape (N, {len(self.features)}); "
                f"got {x.shape}"
            )
        return x
