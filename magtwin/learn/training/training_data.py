"""Material: what a training takes from a data set, and the ridge that every model is held against."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.dataset import Dataset
from magtwin.learn.data.features import CIRCULAR, FEATURES, features
from magtwin.learn.data.inputs import Array
from magtwin.learn.data.recording import Recording, Rows
from magtwin.learn.data.split import PARTS, Part, Split
from magtwin.learn.inference.magnetometer import STEPS_ALIKE
from magtwin.learn.models.calibration import Yardstick, yardstick
from magtwin.learn.models.linear import Fitted, fit_linear
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.temporal import Track
from magtwin.summary import Summarized


@dataclass(frozen=True, repr=False)
class Material(Summarized):
    """Rows of training, validation and test, and of which group each of them is."""

    dataset: Dataset
    split: Split
    rows: Mapping[Part, Rows]
    groups: Mapping[Part, NDArray[np.intp]]
    """Which session, recording or path each row is of, by what the split keeps together; shape (N,)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features."""
        return self.rows["train"].features

    @cached_property
    def ridge(self) -> Fitted:
        """Tolles and Lawson's terms by ridge regression on the training rows.

        Heading harmonics, speed, turning, current and LiDAR, as far as the data set has them; an input that
        is nan counts as its mean.
        """
        x, rows = self._beside("train"), self.rows["train"]
        return fit_linear(x, rows.y, self.groups["train"], features=self._terms, sd=rows.sd)

    def ridge_of(self, part: Part) -> tuple[Array, Array]:
        """What the ridge says of a part: disturbances and standard deviations [nT], each (N,)."""
        return self.ridge.model.predict(self._beside(part))

    def yardstick_of(self, fitted: Fitted, mean_nt: Array, sd_nt: Array) -> Yardstick:
        """How the standard deviations of a linear model held on all recordings, none of which it had seen.

        Args:
            fitted: A fit of the material's own features to the training rows.
            mean_nt: What its model says of the validation rows [nT].
            sd_nt: The standard deviations that it tells of them [nT].
        """
        train, validation = self.rows["train"], self.rows["validation"]
        error = np.concatenate([fitted.held_out_nt - train.y, mean_nt - validation.y])
        sd = np.concatenate([fitted.model.predict(train.x)[1], sd_nt])
        groups = np.concatenate([self.groups["train"], self.groups["validation"]])
        return yardstick(error, sd, groups, np.arange(len(error)) >= len(train.y))

    def told(self, predictor: Predictor, part: Part) -> tuple[Array, Array]:
        """What a predictor says of a part: disturbances and standard deviations [nT], each (N,)."""
        rows = self.rows[part]
        if not predictor.context:
            return predictor.predict(rows.x)
        mean, sd = np.empty(len(rows.y)), np.empty(len(rows.y))
        for number, track in enumerate(self.tracks(part)):
            here = rows.recording == number
            of_run = predictor.predict(track.x)
            mean[here], sd[here] = (values[rows.row[here]] for values in of_run)
        return mean, sd

    def tracks(self, part: Part) -> list[Track]:
        """Recordings of a part, whole, with labels in its rows alone."""
        rows, found = self.rows[part], []
        for number, (_, run) in enumerate(self.dataset.runs(rows.names)):
            here = rows.recording == number
            label = np.full(run.rows, np.nan)
            label[rows.row[here]] = rows.y[here]
            found.append(Track(features(run, self.names), label))
        return found

    @cached_property
    def step_s(self) -> float:
        """Time between rows [s].

        Raises:
            InputError: It is not about the same in all recordings.
        """
        steps = [
            float(np.median(np.diff(run["t"])))
            for _, run in self.dataset.runs(name for part in PARTS for name in self.rows[part].names)
            if run.rows > 1
        ]
        least, most = min(steps, default=math.nan), max(steps, default=math.nan)
        if not 0 < most <= (1 + STEPS_ALIKE) * least:
            raise InputError(
                f"rows of the recordings lie {least:g} to {most:g} s apart, and a tcn looks back over rows: "
                "build the data set anew with --rate-hz"
            )
        return float(np.median(steps))

    @property
    def _terms(self) -> tuple[str, ...]:
        return _terms_of(self.dataset)

    def _beside(self, part: Part) -> Array:
        """The ridge's inputs; nan filled with the means of the training rows."""
        x, train = self.rows[part].beside, self.rows["train"].beside
        known = np.isfinite(train)
        count = np.maximum(known.sum(axis=0), 1)
        return np.where(np.isfinite(x), x, np.where(known, train, 0.0).sum(axis=0) / count)


def material(dataset: Dataset, split: Split, inputs: tuple[str, ...]) -> Material:
    """Read what a training needs.

    Args:
        dataset: Labelled recordings.
        split: Which of them are for what.
        inputs: Names of the features.

    Raises:
        InputError: A part without recordings or rows, or a data set without a column that a feature is
            made of.
    """
    for part in PARTS:
        if not split.names(part):
            raise InputError(f"no recording is in {part}; record more, or hold out fewer")
    terms = _terms_of(dataset)
    rows = {part: dataset.rows(inputs, split=split, part=part, beside=terms) for part in PARTS}
    of = {one.name: one for one in dataset.recordings}
    key: Callable[[Recording], str] = lambda one: one.name  # noqa: E731
    if split.by in ("session", "path"):
        by: Callable[[Recording], str] = lambda one: one.session if split.by == "session" else one.path  # noqa: E731
        if len({by(of[name]) for name in rows["train"].names}) > 1:  # one that is left out leaves another
            key = by
    numbers = {name: i for i, name in enumerate(sorted({key(one) for one in dataset.recordings}))}
    groups = {
        part: np.array([numbers[key(of[name])] for name in one.names], np.intp)[one.recording]
        for part, one in rows.items()
    }
    return Material(dataset, split, rows, groups)


def _terms_of(dataset: Dataset) -> tuple[str, ...]:
    return tuple(name for name in CIRCULAR if set(FEATURES[name].columns) <= set(dataset.columns))
