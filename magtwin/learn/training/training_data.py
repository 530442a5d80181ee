"""TrainingData: the rows that a training reads from a data set, and the ridge that every model is compared
with.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.dataset import Dataset
from magtwin.learn.data.features import CIRCULAR, FEATURES
from magtwin.learn.data.inputs import Array
from magtwin.learn.data.recording import Recording, Rows
from magtwin.learn.data.split import PARTS, Part, Split
from magtwin.learn.models.linear import Linear, fit_linear
from magtwin.report.summary import Summarized


@dataclass(frozen=True, repr=False)
class TrainingData(Summarized):
    """Rows of training, validation and test, and the group of each row."""

    dataset: Dataset
    split: Split
    rows: Mapping[Part, Rows]
    groups: Mapping[Part, NDArray[np.intp]]
    """Session, recording or path of each row, by what the split keeps whole; shape (N,)."""

    @cached_property
    def _ridge(self) -> Linear:
        """Tolles and Lawson's terms by ridge regression on the training rows.

        The terms are heading harmonics, speed, turning, current and LiDAR, as far as the data set has them.
        An input that is nan counts as its mean.
        """
        rows, x, terms = self.rows["train"], self._ridge_inputs("train"), ridge_terms(self.dataset)
        return fit_linear(x, rows.y, self.groups["train"], features=terms, sd=rows.sd).model

    def ridge_of(self, part: Part) -> Array:
        """Disturbances that this ridge predicts for a part [nT], shape (N,)."""
        return self._ridge.predict(self._ridge_inputs(part))[0]

    def _ridge_inputs(self, part: Part) -> Array:
        """Inputs of the ridge; nan is filled with the mean of the training rows."""
        x, train = self.rows[part].beside, self.rows["train"].beside
        known = np.isfinite(train)
        count = np.maximum(known.sum(axis=0), 1)
        return np.where(np.isfinite(x), x, np.where(known, train, 0.0).sum(axis=0) / count)


def read_training_data(dataset: Dataset, split: Split, inputs: tuple[str, ...]) -> TrainingData:
    """Read the rows of a training.

    Args:
        dataset: Labelled recordings.
        split: Recordings of training, validation and test.
        inputs: Names of the features.

    Raises:
        InputError: A part has no recordings or rows, or the data set lacks a column of a feature.
    """
    for part in PARTS:
        if not split.names(part):
            raise InputError(f"no recording is in {part}; record more, or hold out fewer")
    terms = ridge_terms(dataset)
    rows = {part: dataset.rows(inputs, split=split, part=part, beside=terms) for part in PARTS}
    recordings = {recording.name: recording for recording in dataset.recordings}

    def unit(recording: Recording) -> str:
        return {"session": recording.session, "path": recording.path}.get(split.by, recording.name)

    if len({unit(recordings[name]) for name in rows["train"].names}) > 1:
        group = {name: unit(recording) for name, recording in recordings.items()}
    else:  # cross-validation needs two groups
        group = {name: name for name in recordings}
    numbers = {name: i for i, name in enumerate(sorted(set(group.values())))}
    groups = {
        part: np.array([numbers[group[name]] for name in of_part.names], np.intp)[of_part.recording]
        for part, of_part in rows.items()
    }
    return TrainingData(dataset, split, rows, groups)


def ridge_terms(dataset: Dataset) -> tuple[str, ...]:
    """Features of the comparison ridge that a data set has the columns for."""
    return tuple(name for name in CIRCULAR if set(FEATURES[name].columns) <= set(dataset.columns))
