"""Evaluate models on their maps by recordings that they never saw, as in the paper's Table 1.

Errors are of the total field at the sensor, predicted minus measured, so that models which learned on
different maps compare: each looks up its own map, with its own lever arm and latency, and adds its prediction
of the robot.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.files.settings import parse_toml
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import KEPT, MANIFEST, Dataset
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.recording import Source
from magtwin.learn.data.split import split
from magtwin.learn.evaluation.candidates import Candidate
from magtwin.learn.evaluation.evaluation import TOTALS, Case, Evaluation, Judged
from magtwin.learn.evaluation.scores import Score, scores
from magtwin.path import CASES
from magtwin.run.run import Run

Array = NDArray[np.float64]


def evaluate(
    candidates: Sequence[Candidate],
    trials: Sequence[Source],
    *,
    baseline: Candidate,
    rng: np.random.Generator,
    cases: Mapping[str, str] | None = None,
    truth: bool = False,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> Evaluation:
    """Judge models by recordings: `magtwin.evaluate` for candidates and sources.

    Raises:
        InputError: There is no recording, two models or two recordings have one name, a recording lacks a
            column of a model or lies off a map, its readings come from a model, all labels are the same, or
            no reading is left.
    """
    models = (baseline, *candidates)
    if not trials:
        raise InputError("nothing to evaluate: name weights, and recordings that they never saw")
    for noun, names in (("models", [m.name for m in models]), ("recordings", [t.name for t in trials])):
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"two {noun} are called {twice[0]!r}; rename one")
    row_of = {path: letter for letter, path in CASES.items()} | {v: k for k, v in (cases or {}).items()}
    judged: list[Judged] = []
    left_out: dict[str, int] = {}
    for k, trial in enumerate(trials):
        progress(k, len(trials), trial.name)
        recording, lost = _judge(models, trial, row_of, truth)
        judged.append(recording)
        for reason, count in lost.items():
            left_out[reason] = left_out.get(reason, 0) + count
    progress(len(trials), len(trials), "")
    left_out = {reason: count for reason, count in left_out.items() if count}
    judged = [recording for recording in judged if recording.kept.any()]
    if not judged:
        reasons = "; ".join(f"{count:,} {reason}" for reason, count in left_out.items())
        raise InputError(
            f"no reading that every model can be judged on: {reasons}; leave a model or a map out"
        )
    _check_labels(judged)
    order = [*CASES, *sorted({recording.case for recording in judged} - set(CASES))]
    judged.sort(key=lambda recording: order.index(recording.case))
    by_case, every, mean = scores([recording.errors() for recording in judged], rng=rng)
    rows = [_case(name, [each for each in judged if each.case == name], by_case[name]) for name in by_case]
    rows.append(_case("all", judged, every))
    if len(by_case) > 1:
        rows.append(_case("mean", judged, mean))
    maps = tuple(dict.fromkeys(model.map for model in models))
    return Evaluation(models, maps, tuple(rows), tuple(judged), MappingProxyType(left_out), truth)


def _case(name: str, judged: Sequence[Judged], of_models: tuple[Score, ...]) -> Case:
    return Case(name, len(judged), len({recording.session for recording in judged}), of_models)


def _judge(
    models: Sequence[Candidate], trial: Source, row_of: Mapping[str, str], truth: bool
) -> tuple[Judged, dict[str, int]]:
    """Predictions of all models for a recording, and the number of readings left out by reason."""
    run = trial.read()
    run = Run({name: run[name] for name in KEPT if name in run}, run.metadata)
    _check_readings(trial.name, run, truth)
    session, path = trial.session_and_path(run)
    measured = run["b_truth_nt" if truth else "b_measured_nt"]
    kept = np.isfinite(measured)
    lost = {"hold no field": int(np.count_nonzero(~kept))}
    on: dict[tuple[int, Alignment], Run] = {}
    shape = (len(models), run.rows)
    map_nt, map_sd, total, sd = (np.full(shape, np.nan) for _ in range(4))
    outside, intervals = np.zeros(shape, bool), []
    for m, model in enumerate(models):
        key = (id(model.map), model.alignment)
        try:
            if key not in on:
                on[key] = labelled(run, model.map.field, model.alignment)
            here = on[key]
            prediction = model.model.read([here])[0]
        except InputError as error:
            raise InputError(f"{trial.name}: {model.name}: {error}") from error
        sd[m] = prediction.stated_sd_nt
        intervals.append(prediction.intervals)
        if prediction.outside is not None:
            outside[m] = prediction.outside
        map_nt[m], map_sd[m] = here["b_map_nt"], here["label_sd_nt"]
        total[m] = map_nt[m] + prediction.disturbance_nt
        for reason, known in (
            (f"have no label on {model.map.name}", np.isfinite(here["label_nt"])),
            (f"lack an input of {model.name}", np.isfinite(total[m])),
        ):
            lost[reason] = lost.get(reason, 0) + int(np.count_nonzero(kept & ~known))
            kept = kept & known
    p = run["mocap_p"] if {"mocap_p", "mocap_q_xyzw"} <= set(run) else run["p_world_base"]
    row = row_of.get(path, path)
    if row in TOTALS:
        row = f"path {row}"
    arrays = (p[:, :2], measured, kept, map_nt, map_sd, total, sd, outside)
    judged = Judged(trial.name, session, path, row, run, *arrays, tuple(intervals))
    return judged, lost


def _check_readings(name: str, run: Run, truth: bool) -> None:
    """Refuse recordings that cannot judge a model."""
    wanted = "b_truth_nt" if truth else "b_measured_nt"
    if wanted not in run or not np.isfinite(run[wanted]).any():
        advice = "; leave --truth out" if truth else ""
        raise InputError(f"{name}: has no {wanted}, so there is nothing to judge by{advice}")
    kind = run.metadata.get("magnetometer")
    if kind in ("neural", "map-only") and not truth:
        raise InputError(
            f"{name}: its readings come from a {kind} magnetometer, which is a model itself; judge by a "
            "robot's recordings, by runs made with --magnetometer physical, or by the exact field (--truth)"
        )


def _check_labels(judged: Sequence[Judged]) -> None:
    """Refuse readings that differ from the map by a constant only."""
    label = np.concatenate([each.measured_nt[each.kept] - each.map_nt[0, each.kept] for each in judged])
    if np.ptp(label) < 1e-6:
        raise InputError(
            f"every label is {label[0]:g} nT on all {len(label):,} readings: there is nothing to predict; "
            "were the runs made by a map-only magnetometer?"
        )


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
