"""Training recordings labelled anew on a map, for baselines and error budgets."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import Dataset
from magtwin.learn.data.features import features
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.recording import thinned
from magtwin.run.run import Run

Array = NDArray[np.float64]

TRAINED_AT_HZ = 10.0
"""Highest rate of training rows of a baseline [Hz]; nearer rows are too alike to add information."""


def training_rows(
    dataset: Dataset,
    names: Sequence[str] | None,
    anomaly_map: AnomalyMap,
    inputs: Sequence[str],
    alignment: Alignment,
) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Inputs and labels of training recordings on a map, at most `TRAINED_AT_HZ` rows per second.

    Args:
        dataset: The recordings.
        names: Which of them. None: all.
        anomaly_map: The map.
        inputs: Names of features.
        alignment: Lever arm and latency of the labels.

    Returns:
        Inputs, shape (N, F), labels [nT], standard deviations of the map there [nT], and the session of each
        row, shape (N,).

    Raises:
        InputError: No row has a label and all inputs.
    """
    parts = []
    sessions = [recording.session for recording in dataset.recordings]
    for name, run in aligned_runs(dataset, names, anomaly_map, alignment):
        x, y = features(run, inputs), run["label_nt"]
        known = np.isfinite(y) & np.isfinite(x).all(axis=1)
        number = sessions.index(dataset.recording(name).session)
        parts.append((x[known], y[known], run["label_sd_nt"][known], np.full(int(known.sum()), number)))
    x, y, sd, session = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not len(y):
        raise InputError(
            f"{dataset.folder}: no training row has a label on {anomaly_map.name} and all inputs"
        )
    return x, y, sd, session


def aligned_runs(
    dataset: Dataset, names: Sequence[str] | None, anomaly_map: AnomalyMap, alignment: Alignment
) -> Iterator[tuple[str, Run]]:
    """Names and runs of training recordings, thinned and labelled on a map."""
    for recording, run in dataset.runs(names):
        try:
            yield recording.name, labelled(thinned(run, TRAINED_AT_HZ), anomaly_map, alignment)
        except InputError as error:
            raise InputError(f"{dataset.folder}, {recording.name}: {error}") from error


def alignment_on(dataset: Dataset, checksums: Collection[str]) -> Alignment:
    """Lever arm and latency of a data set, if it was labelled on a map with one of these checksums, else
    0.
    """
    if dataset.map_sha256 not in checksums:
        return Alignment()
    return Alignment(dataset.alignment.lever_arm_m, dataset.alignment.latency_s)
