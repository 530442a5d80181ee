"""Candidates: models with the map, lever arm and latency that they learned with."""

import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.data.alignment import Alignment, alignment_of
from magtwin.learn.data.dataset import Dataset, values_sha256
from magtwin.learn.data.features import CIRCULAR, FEATURES, features
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.origin import same_map
from magtwin.learn.data.recording import thinned
from magtwin.learn.inference.magnetometer import NeuralMagnetometer, Read
from magtwin.learn.models.linear import fit_linear
from magtwin.report.summary import Summarized
from magtwin.run.run import Run

Array = NDArray[np.float64]

NAIVE = "naive"  # Name of the naive model

TRAINED_AT_HZ = 10.0
"""Highest rate of training rows of a baseline [Hz]; nearer rows are too alike to add information."""


@dataclass(frozen=True)
class Mean:
    """The naive model: the mean training label, whatever the inputs."""

    mean_nt: float
    """Mean of the training labels [nT]."""

    sd_nt: float
    """Their standard deviation [nT]; nan if unknown."""

    features: tuple[str, ...] = ()
    """It has no inputs."""

    def read(self, runs: Sequence[Run]) -> list[Read]:
        """The mean and its standard deviation for each row."""
        counts = [run.rows for run in runs]
        return [Read(np.full(n, self.mean_nt), np.full(n, self.sd_nt), np.zeros(n, bool)) for n in counts]


@dataclass(frozen=True, eq=False, repr=False)
class NamedMap(Summarized):
    """A map of an evaluation, with the checksums by which weights refer to it."""

    name: str
    """What to call it, such as the name of its file."""

    field: AnomalyMap

    checksums: frozenset[str]
    """SHA-256 of its file and of its values."""


def named_map(name: str, anomaly_map: AnomalyMap, *checksums: str) -> NamedMap:
    """A map with its checksums: the SHA-256 of its file, if it has one, and that of its values."""
    return NamedMap(name, anomaly_map, frozenset({*filter(None, checksums), values_sha256(anomaly_map)}))


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Summarized):
    """A model with the map, lever arm and latency that it learned with."""

    name: str
    model: NeuralMagnetometer | Mean
    map: NamedMap
    alignment: Alignment = field(default_factory=Alignment)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Metadata of its file, or how it was fitted."""


def candidate_of(
    model: NeuralMagnetometer | str | os.PathLike[str],
    maps: Sequence[NamedMap],
    *,
    any_map: bool = False,
    name: str = "",
) -> Candidate:
    """A magnetometer or weights file, with the map that it was trained on, its lever arm and its latency.

    Args:
        model: The magnetometer, or weights of any kind.
        maps: The maps at hand. Weights that name no map, such as the released ones, use the first.
        any_map: Use the first map if the right one is not at hand.
        name: What to call it. Default: the name of the file.

    Raises:
        InputError: Not a weights file, or it was trained on a map that is not at hand.
    """
    magnetometer = model if isinstance(model, NeuralMagnetometer) else NeuralMagnetometer.load(model)
    metadata = dict(magnetometer.net.metadata)
    wanted = str(metadata.get("map_sha256", ""))
    fits = [known for known in maps if wanted in known.checksums]
    fits = fits or [known for known in maps if wanted and same_map(metadata, known.field)]
    if wanted and not fits and not any_map:
        held = "; ".join(f"{known.name} has {', '.join(sorted(known.checksums))}" for known in maps)
        raise InputError(
            f"{magnetometer.name}: was trained on the map {metadata.get('map', '')!r} of sha256 {wanted}, "
            f"and {held}; name its own map with --map, or use the first one all the same with --any-map"
        )
    used = fits[0] if fits else maps[0]
    about = {"sha256": magnetometer.sha256, **metadata} if magnetometer.sha256 else metadata
    name = name or magnetometer.name or magnetometer.net.kind
    return Candidate(name, magnetometer, used, alignment_of(metadata, name), about)


def naive(
    named: NamedMap,
    *,
    dataset: Dataset | None = None,
    names: Sequence[str] | None = None,
    weights: Sequence[Candidate] = (),
) -> Candidate:
    """The naive model: a map and the mean training label on every row.

    Args:
        named: The map; in the paper the trilinear one.
        dataset: Training recordings, which are labelled on this map.
        names: Which of them. Default: all.
        weights: Without a data set, models that were trained on this map; the mean label of the first is
            used.

    Raises:
        InputError: The mean is not known.
    """
    if dataset is not None:
        alignment = _alignment_on(dataset, named.checksums)
        labels = _training_rows(dataset, names, named.field, (), alignment)[1]
        model = Mean(float(labels.mean()), float(labels.std()))
        return Candidate(NAIVE, model, named, alignment, {"fitted to": dataset.folder.name})
    for candidate in weights:
        mean = candidate.metadata.get("label_mean_nt")
        fits = candidate.metadata.get("map_sha256") in named.checksums or same_map(
            candidate.metadata, named.field
        )
        if fits and isinstance(mean, int | float):
            sd = candidate.metadata.get("label_sd_nt", math.nan)
            about = {"mean label of": candidate.name}
            return Candidate(NAIVE, Mean(float(mean), float(sd)), named, candidate.alignment, about)
    raise InputError(
        f"the mean training label on the map {named.name}, which the naive model needs, is not known: give "
        "the training recordings (--train SET), or weights trained on it, with that map first"
    )


def tolles_lawson(
    named: NamedMap,
    dataset: Dataset,
    names: Sequence[str] | None = None,
    *,
    alignment: Alignment | None = None,
) -> Candidate:
    """A ridge regression of Tolles and Lawson's kind, on heading, motion and currents.

    It is fitted to recordings of a data set, labelled on a map with a lever arm and latency; default: those
    of the data set if it was labelled on this map, else 0.
    """
    given = alignment is not None
    alignment = alignment or _alignment_on(dataset, named.checksums)
    able = set(dataset.columns) | {"yaw"}
    inputs = tuple(name for name in CIRCULAR if set(FEATURES[name].columns) <= able)
    x, y, sd, session = _training_rows(dataset, names, named.field, inputs, alignment)
    model = fit_linear(x, y, session, features=inputs, sd=sd).model
    about = {"fitted to": dataset.folder.name, "penalty": model.penalty, "training rows": len(y)}
    name = f"Tolles-Lawson, {named.name}{' aligned' * given}"
    return Candidate(name, NeuralMagnetometer(model, name=name), named, alignment, about)


def tolles_lawson_variants(
    maps: Sequence[NamedMap],
    candidates: Sequence[Candidate],
    dataset: Dataset,
    names: Sequence[str] | None = None,
) -> list[Candidate]:
    """Tolles and Lawson's ridge on each map: plain, and with the alignment of the first candidate on it."""
    variants = []
    for named in maps:
        fitted = [each.alignment for each in candidates if each.map is named]
        fitted = [alignment for alignment in fitted if alignment != Alignment()]
        variants.append(tolles_lawson(named, dataset, names))
        if fitted and variants[-1].alignment == Alignment():
            variants.append(tolles_lawson(named, dataset, names, alignment=fitted[0]))
    return variants


def _training_rows(
    dataset: Dataset,
    names: Sequence[str] | None,
    anomaly_map: AnomalyMap,
    inputs: Sequence[str],
    alignment: Alignment,
) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Inputs (N, F), labels and standard deviations of the map [nT], and sessions (N,) of recordings."""
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
    """Names and runs of training recordings, at most `TRAINED_AT_HZ` rows a second, labelled on a map."""
    for recording, run in dataset.runs(names):
        try:
            yield recording.name, labelled(thinned(run, TRAINED_AT_HZ), anomaly_map, alignment)
        except InputError as error:
            raise InputError(f"{dataset.folder}, {recording.name}: {error}") from error


def _alignment_on(dataset: Dataset, checksums: Collection[str]) -> Alignment:
    """Lever arm and latency of a data set that was labelled on a map with one of these checksums, else 0."""
    if dataset.map_sha256 not in checksums:
        return Alignment()
    return Alignment(dataset.alignment.lever_arm_m, dataset.alignment.latency_s)
