"""Trials: recordings that models are judged by, and checks that no model learned from them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.files.settings import parse_toml
from magtwin.learn.data.dataset import MANIFEST, Dataset
from magtwin.learn.data.recording import Source
from magtwin.learn.data.split import split
from magtwin.learn.evaluation.candidates import Candidate
from magtwin.run.run import Run

Array = NDArray[np.float64]


def trials_of(dataset: Dataset, names: Sequence[str]) -> list[Source]:
    """Recordings of a data set, to judge by."""

    def read(name: str) -> Run:
        return next(run for _, run in dataset.runs([name]))

    recordings = [dataset.recording(name) for name in names]
    return [
        Source(recording.name, partial(read, recording.name), recording.session, recording.path)
        for recording in recordings
    ]


def unseen(dataset: Dataset, candidates: Sequence[Candidate]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Recordings that no candidate learned from, and recordings that each of them may have learned from.

    If weights were trained on this data set, the first are their test recordings, by the split in their
    metadata. Otherwise both are all recordings.

    Raises:
        InputError: Nothing is left, or weights were trained on rows of every recording.
    """
    checksum = sha256(dataset.folder / MANIFEST)
    names, learned = list(dataset.names), list(dataset.names)
    for candidate in candidates:
        if candidate.metadata.get("dataset_sha256") != checksum:
            continue
        try:
            config = parse_toml(str(candidate.metadata.get("config", "")), candidate.name)
            by, seed, hold_out = config["split"], int(config["seed"]), tuple(config.get("hold_out", ()))
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{candidate.name}: was trained on {dataset.folder}, and its metadata lack the split "
                f"({error}); judge it by recordings of another set"
            ) from error
        if by == "row":
            raise InputError(
                f"{candidate.name}: was trained on rows of every recording of {dataset.folder}; judge it by "
                "others"
            )
        deals = np.random.default_rng(seed).spawn(2)[0]
        parts = split(dataset.recordings, by, hold_out=hold_out, rng=deals)
        names = [name for name in names if name in parts.test]
        learned = [name for name in learned if name in parts.train]
    if not names:
        raise InputError(
            f"{dataset.folder}: the models learned from every recording of it; judge them by others"
        )
    return tuple(names), tuple(learned)


def unlearned(trials: Sequence[Source], dataset: Dataset, names: Sequence[str]) -> list[Source]:
    """Recordings that refuse to be read if a training set holds them, under any name.

    Args:
        trials: Recordings to judge by.
        dataset: Training recordings, possibly thinned.
        names: Which of them.
    """
    learned: dict[tuple[bytes, bytes], list[tuple[str, Array, Array]]] = {}
    for recording, run in dataset.runs(names):
        t, b = run["t"], run["b_measured_nt"]
        learned.setdefault(_first(t, b), []).append((recording.name, t, b))

    def read(trial: Source) -> Run:
        run = trial.read()
        t, b = run["t"], run.get("b_measured_nt")
        if b is None or not run.rows:
            return run
        for name, learned_t, learned_b in learned.get(_first(t, b), []):
            at = np.minimum(np.searchsorted(t, learned_t), run.rows - 1)
            common = t[at] == learned_t
            if common.sum() > 1 and np.array_equal(b[at][common], learned_b[common], equal_nan=True):
                raise InputError(
                    f"{trial.name}: is {name!r} of {dataset.folder}, which was learned from; judge by others"
                )
        return run

    return [replace(trial, read=partial(read, trial)) for trial in trials]


def _first(t: Array, b: Array) -> tuple[bytes, bytes]:
    """First time and first reading of a recording; thinning keeps both."""
    return t[:1].tobytes(), np.nan_to_num(b[:1], nan=np.inf).tobytes()
