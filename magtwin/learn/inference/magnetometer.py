"""NeuralMagnetometer: a predictor that gives a Run its disturbance."""

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, MismatchWarning
from magtwin.files import file
from magtwin.files.kinds import expected
from magtwin.learn.data.features import columns_of, features
from magtwin.learn.data.inputs import MANY
from magtwin.learn.data.origin import same_robot
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.learn.models.weights import MetadataValue
from magtwin.report.summary import Summarized, Summary
from magtwin.report.verdict import OF_DRIVE, ONLY_OWN, OTHERS, OWN
from magtwin.run.run import Run
from magtwin.sim.sensors.model_error import ModelError

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Read(Summarized):
    """Predictions for the rows of a run."""

    disturbance_nt: Array
    """Disturbance [nT], shape (N,)."""

    sd_nt: Array
    """Standard deviation of its error on the robot of its training [nT], shape (N,); nan if unknown."""

    outside: NDArray[np.bool_] | None
    """Whether an input left the range of the training rows, shape (N,); None if not computed."""

    wide_sd_nt: Array | None = None
    """Standard deviation on a robot that it was not trained on [nT], shape (N,). None if the run is of the
    robot of its training, or if it learned none."""

    intervals: str = OWN
    """Which of the two `stated_sd_nt` is, in words."""

    @property
    def stated_sd_nt(self) -> Array:
        """Standard deviation of its error on the robot of the run [nT], shape (N,)."""
        return self.sd_nt if self.wide_sd_nt is None else self.wide_sd_nt


class NeuralMagnetometer(Summarized):
    """Runs a predictor of any kind on runs."""

    def __init__(self, net: Predictor, *, name: str = "", sha256: str = "") -> None:
        """Use a predictor.

        Args:
            net: The predictor.
            name: Name of its file, kept in the metadata of runs.
            sha256: Checksum of its file, kept in the metadata of runs.
        """
        self.net, self.name, self.sha256 = net, name, sha256

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, sha256: str = "") -> "NeuralMagnetometer":
        """Load a weights file: safetensors of any kind, or a released `.pth`.

        Args:
            path: The weights.
            sha256: SHA-256 that the file must have; "" accepts any.

        Raises:
            InputError: No such file, another checksum, or not a predictor.
        """
        path = expected(path, "weights file")
        checksum = file.sha256(path)
        if sha256 and checksum != sha256.lower():
            raise InputError(
                f"{path}: its sha256 is {checksum}, expected {sha256}; get the file again "
                "or change the checksum"
            )
        return cls(load_predictor(path), name=path.name, sha256=checksum)

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
        """Root mean square error on held-out recordings [nT]; nan if unknown."""
        return self.net.residual_sd_nt

    def model_error(self) -> ModelError | None:
        """Statistics of the error of its predictions; None if its metadata lack them.

        Raises:
            InputError: The statistics in the metadata are invalid.
        """
        values = [self.net.metadata.get(name) for name in ("residual_offset_sd_nt", "residual_time_s")]
        if None in values or (self.net.kind == "mlp" and math.isnan(self.residual_sd_nt)):
            return None
        figures = [float(value) if isinstance(value, int | float) else math.nan for value in values]
        if not all(0 <= figure < math.inf for figure in figures):
            raise InputError(
                f"{self.name}: residual_offset_sd_nt and residual_time_s of its metadata must be finite and "
                f"not below 0, got {values[0]!r} and {values[1]!r}"
            )
        return ModelError(*figures)

    @property
    def metadata(self) -> Mapping[str, MetadataValue]:
        """Metadata of a run about its network: file, checksum, layers and parameters.

        The mean training label is included if known, and the kind if it is not a perceptron.
        """
        metadata: dict[str, MetadataValue] = {
            "network": self.name,
            "network_sha256": self.sha256,
            "network_layers": self.net.layers_text,
            "network_parameters": self.net.parameters_count,
        }
        if "label_mean_nt" in self.net.metadata:
            metadata["network_label_mean_nt"] = float(self.net.metadata["label_mean_nt"])
        return metadata if self.net.kind == "mlp" else metadata | {"network_kind": self.net.kind}

    def knows(self, metadata: Mapping[str, MetadataValue]) -> bool:
        """Whether it was trained on the robot of a run, by the run's metadata; see `same_robot`."""
        return same_robot(self.net.metadata, metadata)

    def read(
        self, runs: Sequence[Run], *, outside: bool = True, known: Sequence[bool] | None = None
    ) -> list[Read]:
        """Disturbances, their standard deviations and rows outside the training ranges of each run.

        Args:
            runs: At least one. The result of a run does not depend on the other runs.
            outside: Whether to compute `Read.outside`.
            known: Whether each run is of the robot of its training. Default: by `knows`.

        Raises:
            InputError: A run lacks a column that the network reads.
        """
        made = []
        for run, own in zip(runs, [None] * len(runs) if known is None else known, strict=True):
            own = self.knows(run.metadata) if own is None else own
            x = features(run, self.features)
            mean, sd = self.net.predict(x)
            wide = None if own else self.net.wide_sd_nt(x)
            flags = self.net.outside(x) if outside else None
            if flags is not None and flags.mean() > MANY and (worst := self.net.inputs.worst(x)):
                warnings.warn(worst, MismatchWarning, stacklevel=3)
            made.append(Read(mean, sd, flags, wide, self._intervals(own, wide is not None)))
        return made

    def _intervals(self, known: bool, wide: bool) -> str:
        """Which robots the intervals of a run hold for, in words."""
        if isinstance(self.net, Mixed) and self.net.intervals != "nominal":
            return OF_DRIVE if self.net.intervals == "calibrated" else OTHERS
        return OWN if known else OTHERS if wide else ONLY_OWN

    def _summary(self) -> Summary:
        return self.net.summary(f"NeuralMagnetometer {self.name}".rstrip())
