"""NeuralMagnetometer: a predictor that gives a Run its disturbance."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin import files
from magtwin.errors import InputError
from magtwin.learn.data.features import columns_of, features
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.learn.models.regressor import summary_of
from magtwin.learn.models.weights import Fact
from magtwin.run.run import Run
from magtwin.sim.sensors.model_error import ModelError
from magtwin.summary import Summarized, Summary

Array = NDArray[np.float64]

STEPS_ALIKE = 0.1
"""By what share times between rows may differ, for a network that looks back over them."""


@dataclass(frozen=True, repr=False)
class Read(Summarized):
    """What a predictor says of a run, row by row."""

    disturbance_nt: Array
    """Disturbance [nT], shape (N,)."""

    sd_nt: Array
    """Standard deviation of its error [nT], shape (N,); nan where unknown."""

    outside: NDArray[np.bool_] | None
    """Whether an input left the range of the training rows, shape (N,); none where nobody asked."""


class NeuralMagnetometer(Summarized):
    """Runs a predictor of any kind on runs; what one gives does not depend on the others beside it."""

    def __init__(self, net: Predictor, *, name: str = "", sha256: str = "") -> None:
        """Use a predictor.

        Args:
            net: The predictor.
            name: Where it comes from, for the metadata of a run.
            sha256: Checksum of its file, for the metadata of a run.
        """
        self.net, self.name, self.sha256 = net, name, sha256

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, sha256: str = "") -> "NeuralMagnetometer":
        """The magnetometer of a weights file, safetensors of any kind or a released `.pth`.

        Args:
            path: The weights.
            sha256: Checksum that the file must have, lower-case hex; "" takes any.

        Raises:
            InputError: No such file, another checksum, or not a predictor.
        """
        path = files.existing(path, "weights file")
        found = files.sha256(path)
        if sha256 and found != sha256.lower():
            raise InputError(
                f"{path}: its sha256 is {found}, expected {sha256}; get the file again or change the checksum"
            )
        return cls(load_predictor(path), name=path.name, sha256=found)

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.net.features

    @property
    def columns(self) -> frozenset[str]:
        """Columns of a Run that the inputs are taken from."""
        return frozenset(columns_of(self.features))

    @property
    def residual_sd_nt(self) -> float:
        """Root mean square of label minus prediction on held-out recordings [nT]; nan where unknown."""
        return self.net.residual_sd_nt

    def model_error(self) -> ModelError | None:
        """Statistics of the error of its predictions; None where its file does not tell them.

        Raises:
            InputError: Its file tells figures that cannot be.
        """
        told = [self.net.metadata.get(name) for name in ("residual_offset_sd_nt", "residual_time_s")]
        if None in told or (self.net.kind == "mlp" and math.isnan(self.residual_sd_nt)):
            return None
        figures = [float(one) if isinstance(one, int | float) else math.nan for one in told]
        if not all(0 <= one < math.inf for one in figures):
            raise InputError(
                f"{self.name}: residual_offset_sd_nt and residual_time_s of its metadata must be finite and "
                f"not "
                f"below 0, got {told[0]!r} and {told[1]!r}"
            )
        return ModelError(*figures)

    @property
    def metadata(self) -> Mapping[str, Fact]:
        """Metadata of a run about its network: file, checksum, layers, parameters; its kind if no perceptron.

        The mean training label too, where the weights have it.
        """
        metadata: dict[str, Fact] = {
            "network": self.name,
            "network_sha256": self.sha256,
            "network_layers": self.net.layers_text,
            "network_parameters": self.net.parameters_count,
        }
        if "label_mean_nt" in self.net.metadata:
            metadata["network_label_mean_nt"] = float(self.net.metadata["label_mean_nt"])
        return metadata if self.net.kind == "mlp" else metadata | {"network_kind": self.net.kind}

    def disturbance_nt(self, run: Run) -> Array:
        """Disturbance at each reading of a run [nT], shape (N,).

        Raises:
            InputError: The run lacks a column that the network reads.
        """
        return self.read([run], outside=False)[0].disturbance_nt

    def read(self, runs: Sequence[Run], *, outside: bool = True) -> list[Read]:
        """Disturbances, their standard deviations and rows outside the training ranges, of each of many runs.

        All rows go in one stream of blocks, but where a predictor looks at earlier rows: then each run by
        itself.

        Args:
            runs: At least one, each with its rows in time order.
            outside: Whether `Read.outside` is wanted.

        Raises:
            InputError: A run lacks a column that the network reads, or has its rows at another rate than
                those that a network which looks back was trained on.
        """
        parts = [features(run, self.features) for run in runs]
        if self.net.context:
            told = [self._looking_back(run, x) for run, x in zip(runs, parts, strict=True)]
            left = [self.net.outside(x) if outside else None for x in parts]
            return [Read(*one, which) for one, which in zip(told, left, strict=True)]
        x = parts[0] if len(parts) == 1 else np.concatenate(parts)
        ends = np.cumsum([run.rows for run in runs])[:-1]
        mean, sd = (np.split(values, ends) for values in self.net.predict(x))
        flags = np.split(self.net.outside(x), ends) if outside else [None] * len(runs)
        return [Read(*one) for one in zip(mean, sd, flags, strict=True)]

    def _looking_back(self, run: Run, x: Array) -> tuple[Array, Array]:
        """As `predict_with_sd`, of a run whose rows may lie closer than those that were trained on.

        Of rows k times as close each k-th is a run of its own, so that a look back is as long as it was.
        """
        step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else self.net.step_s
        every = round(self.net.step_s / step) if step > 0 else 0
        if every < 1 or abs(every * step / self.net.step_s - 1) > STEPS_ALIKE:
            raise InputError(
                f"{self.name or 'the network'}: looks back over rows {self.net.step_s:g} s apart, the "
                f"run has them {step:g} s apart; take a rate of {1 / self.net.step_s:g} Hz, or a whole "
                "number of times that"
            )
        mean, sd = np.empty(run.rows), np.empty(run.rows)
        for first in range(every):
            mean[first::every], sd[first::every] = self.net.predict(x[first::every])
        return mean, sd

    def outside_training(self, run: Run) -> NDArray[np.bool_]:
        """Whether an input of a reading left the range of the training rows, shape (N,)."""
        return self.outside(features(run, self.features))

    def outside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """As `outside_training`, from features (N, F); see `magtwin.learn.data.inputs.Inputs.outside`."""
        return self.net.outside(x)

    def predict(self, x: ArrayLike) -> Array:
        """Disturbances [nT], (N,), from features in their units, (N, F), one run's rows in time order."""
        return self.net.predict(x)[0]

    def predict_with_sd(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and the standard deviations of their errors [nT], each (N,); `x` as for `predict`."""
        return self.net.predict(x)

    def _summary(self) -> Summary:
        return summary_of(self.net, f"NeuralMagnetometer {self.name}".rstrip())
