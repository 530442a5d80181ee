"""Data sets and evaluations from files: `magtwin dataset build` and `magtwin evaluate` in Python.

Training is `magtwin.learn.training.train.train`.
"""

import functools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import existing, read_text, sha256
from magtwin.files.kinds import scene_file
from magtwin.files.outputs import check_free, output, transaction
from magtwin.io.formats import read_run, runs_in
from magtwin.io.map_files import map_file, open_map
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import MANIFEST, Dataset, open_dataset
from magtwin.learn.data.dataset import build_dataset as build
from magtwin.learn.data.recording import Source, sources_of
from magtwin.learn.evaluation.budget import Budget, Truth, budget
from magtwin.learn.evaluation.candidates import (
    NAIVE,
    Candidate,
    NamedMap,
    candidate_of,
    naive,
    named_map,
    tolles_lawson,
    tolles_lawson_variants,
)
from magtwin.learn.evaluation.evaluate import evaluate as judge
from magtwin.learn.evaluation.evaluate import trials_of, unlearned, unseen
from magtwin.learn.evaluation.evaluation import Evaluation
from magtwin.learn.inference.calibrate import calibrate as calibrate_model
from magtwin.learn.inference.calibrate import shipped_mixed
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.widen import widened
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.learn.training.result import TrainingResult, widened_card
from magtwin.run.run import Run
from magtwin.spec.scene import Scene
from magtwin.twin import check_scene, in_session_of, open_twin
from magtwin.usd.scene import read_scene

File = str | os.PathLike[str]
Model = File | Predictor | Candidate | TrainingResult
By = Literal["metadata", "file", "folder"]
Progress = Callable[[int, int, str], Any]


def build_dataset(
    runs: Mapping[str, Run] | Sequence[File] | File,
    *,
    out: File,
    anomaly_map: AnomalyMap | File,
    alignment: Literal["fit"] | Alignment | None = None,
    session_by: By = "metadata",
    path_by: By = "metadata",
    rate_hz: float | None = None,
    jobs: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
    **reading: Any,
) -> Dataset:
    """Label recordings and write them as a data set. A label is the measured total field minus the map.

    Args:
        runs: Runs by name, or files of any kind that `magtwin.load_run` reads. A folder of
            `magtwin sweep` gives all runs in it.
        out: Folder to make.
        anomaly_map: The map, a map layer or stage, or a folder of survey CSVs.
        alignment: Lever arm and latency of the sensor; "fit" fits them to all recordings. With None, poses
            and readings are not corrected.
        session_by: What gives the session of a file: "metadata" (or the file name if it has none), "file"
            (the file name) or "folder" (the folder name).
        path_by: What gives the driven path; takes the same values.
        rate_hz: Highest rate of readings to keep [Hz]. Default: all.
        jobs: Processes that share the recordings; they do not change the data set. Default: this process,
            with several threads.
        force: Replace an existing folder.
        progress: Called as progress(done, total, name of the next recording).
        **reading: Options of `magtwin.io.formats.read_run`: topics, unit, columns.

    Raises:
        InputError: A file cannot be read; two recordings have the same name; a recording has no poses, no
            field or no reading inside the map; all labels are equal; or the folder exists.
    """
    sources, checksum = _sources(runs, session_by=session_by, path_by=path_by, **reading), ""
    if not isinstance(anomaly_map, AnomalyMap):
        from magtwin.usd.layers import layer_sha256

        path = map_file(anomaly_map)
        anomaly_map, checksum = open_map(path), layer_sha256(path) if path.is_file() else ""
    return build(
        sources,
        anomaly_map,
        out,
        alignment=alignment,
        map_sha256=checksum,
        rate_hz=rate_hz,
        jobs=jobs,
        force=force,
        progress=progress,
    )


def sources_of_files(
    files: Sequence[File] | File, *, session_by: By = "metadata", path_by: By = "metadata", **reading: Any
) -> list[Source]:
    """Files of recordings as sources of a data set; the arguments are those of `build_dataset`.

    A folder stands for all of its runs.

    A recording has the name of its file, preceded by that of its folder if two files have one name.
    """

    def named(word: str) -> str:
        return re.sub(r"\.\.+", ".", re.sub(r"[^A-Za-z0-9_.+-]", "_", word)).lstrip(".+-")[:180] or "_"

    given = map(Path, [files] if isinstance(files, str | os.PathLike) else files)
    paths = [inside for path in given for inside in runs_in(path)]
    short = [named(existing(path, "recording").resolve().stem) for path in paths]
    long = [named(f"{path.resolve().parent.name}_{path.resolve().stem}") for path in paths]
    names = [name if short.count(name) == 1 else other for name, other in zip(short, long, strict=True)]
    by: dict[str, Callable[[Path, str], str]] = {
        "metadata": lambda path, name: "",
        "file": lambda path, name: name,
        "folder": lambda path, name: path.resolve().parent.name or name,
    }
    session, driven = find("source of sessions", session_by, by), find("source of paths", path_by, by)
    return [
        Source(name, partial(read_run, path, **reading), session(path, name), driven(path, name))
        for path, name in zip(paths, names, strict=True)
    ]


def evaluate(
    models: Sequence[Model] | Model,
    recordings: Dataset | Mapping[str, Run] | Sequence[File] | File,
    *,
    anomaly_map: Sequence[AnomalyMap | File] | AnomalyMap | File,
    baseline: Literal["naive", "tolles-lawson"] | Candidate = "naive",
    train: Dataset | File | None = None,
    cases: Mapping[str, str] | None = None,
    any_map: bool = False,
    truth: bool = False,
    seed: int = 0,
    progress: Progress = lambda done, total, what: None,
) -> Evaluation:
    """Measure the errors of models on recordings that they never saw.

    Args:
        models: Weights files, predictors, candidates, or what `magtwin.train` gives.
        recordings: A data set or its folder, a mapping of runs by name, or files of runs. If it is a data
            set, only those recordings are used that were not in the training data of any model.
        anomaly_map: Maps that the models were trained on. The map of each model is identified by its
            checksum. The first map is used for the baseline, and for weights that name no map.
        baseline: The model that others are compared with: the mean training label, Tolles and Lawson's ridge
            regression, or a candidate.
        train: Data set that baselines are fitted to. If given, the Tolles-Lawson regression is also
            evaluated on each map. Without it, the mean label is taken from weights that were trained on the
            first map.
        cases: Further rows of the table: from the name of a row to the path that the robot drives. If the
            name is one of A to E, this path is used instead of the paper's, as in {"D": "lawnmower.csv"}.
        any_map: Use the first map for weights whose own map is not among those given.
        truth: Compare with the exact field of simulated runs instead of the reading.
        seed: Seed of the random resampling that gives the confidence intervals.
        progress: Called as progress(recordings done, total, name of the next recording).

    Raises:
        InputError: A file cannot be read; the map of a model is not given; a model was trained on one of
            these recordings; or a recording lacks a column that a model or the evaluation needs.
    """
    if seed < 0:
        raise InputError(f"seed must be a whole number from 0 up, got {seed!r}")
    maps = _named_maps([anomaly_map] if _single(anomaly_map) else anomaly_map)  # type: ignore[arg-type,list-item]
    alone = _single(models) or isinstance(models, Candidate | Predictor | TrainingResult)
    given: list[Any] = [models] if alone else list(models)  # type: ignore[arg-type]
    given = [model.predictor if isinstance(model, TrainingResult) else model for model in given]
    files = iter(short_names([Path(model) for model in given if _single(model)]))
    candidates = []
    for model in given:
        if _single(model):
            candidates.append(candidate_of(model, maps, any_map=any_map, name=next(files)))
        elif isinstance(model, Candidate):
            candidates.append(model)
        else:
            candidates.append(candidate_of(NeuralMagnetometer(model), maps, any_map=any_map))
    learning = None if train is None else _dataset(train)
    trials, learned = _trials(recordings, learning, candidates)
    if isinstance(baseline, Candidate):
        first = baseline
    elif find("baseline", baseline, {NAIVE: True, "tolles-lawson": False}):
        first = naive(maps[0], dataset=learning, names=learned, weights=candidates)
    elif learning is not None:
        first = tolles_lawson(maps[0], learning, learned)
    else:
        raise InputError("the baseline tolles-lawson is fitted to training recordings; give `train`")
    if learning is not None:
        variants = tolles_lawson_variants(maps, candidates, learning, learned)
        candidates += [variant for variant in variants if variant.name != first.name]
    evaluation = judge(
        candidates,
        trials,
        baseline=first,
        rng=np.random.default_rng(seed),
        cases=cases,
        truth=truth,
        progress=progress,
    )
    return replace(evaluation, learned=tuple(learned))


def calibrate(
    model: File | Predictor | None,
    run: Run | File,
    *,
    anomaly_map: AnomalyMap | File,
    duration_s: float | None = None,
    pose_sd_m: float = 0.0,
    pose_from_map: bool = False,
    out: File | None = None,
    force: bool = False,
    **reading: Any,
) -> Mixed:
    """Calibrate a mixed model by a labelled drive at the start of a session.

    The effects of the session get the posterior given the labels of the drive: measured total field minus the
    map. A minute of curves in all directions suffices. The result is a predictor of the session; its metadata
    record the drive, its session and date, the residuals and the checksum of the model.

    A `magtwin.errors.CalibrationWarning` is given if the drive is shorter than 30 s, has few headings, or has
    poses that were estimated on the map.

    Args:
        model: A mixed model or its weights file (`magtwin train --model mixed`). None: that which
            ships, of sessions and plants of the TurtleBot 4.
        run: The drive or its file, with poses from another source than the map.
        anomaly_map: The map that the model was trained on: a map layer, a stage, or a folder of survey CSVs.
        duration_s: Length of the part to use, from the start [s]. Default: all.
        pose_sd_m: Standard deviation of the drive's positions, each axis [m]. It adds (gradient x sd)^2 to
            the variance of the labels.
        pose_from_map: Whether the poses were estimated on the map. Default: as in the run's metadata.
        out: Weights file to write, .safetensors.
        force: Replace an existing file.
        **reading: Options of `magtwin.io.formats.read_run`: topics, unit, columns.

    Raises:
        InputError: A file cannot be read, the model is of another kind, the drive has fewer than 20 labelled
            readings (at most 4 a second), or the file exists.
    """
    if out is not None:
        check_free(out, force=force)
    name, parent = str(getattr(run, "metadata", {}).get("name", "")), {}
    own_map = model is not None
    model = shipped_mixed() if model is None else model
    if isinstance(model, str | os.PathLike):
        path = existing(model, "weights file")
        model, parent = load_predictor(path), {"parent": path.name, "parent_sha256": sha256(path)}
    if not isinstance(run, Run):
        name, run = Path(run).name, read_run(Path(run), **reading)
    field = anomaly_map if isinstance(anomaly_map, AnomalyMap) else open_map(anomaly_map)
    calibrated = calibrate_model(
        model,
        run,
        field,
        duration_s=duration_s,
        pose_sd_m=pose_sd_m,
        pose_from_map=pose_from_map,
        parent=parent,
        name=name,
        own_map=own_map,
    )
    if out is not None:
        calibrated.save(out, force=force)
    return calibrated


def widen(
    model: File | Predictor,
    recordings: Mapping[str, Run] | Sequence[File] | File,
    *,
    anomaly_map: AnomalyMap | File,
    out: File | None = None,
    force: bool = False,
) -> Predictor:
    """Learn a model's intervals on robots that it was not trained on, from recordings of such robots.

    `run`, `evaluate` and the ROS node then use these intervals on every robot but that of the training.
    Predictions do not change; see `magtwin.learn.inference.widen`.

    Args:
        model: A model, or its weights file. If a model card is beside the file, `out` gets one too.
        recordings: Runs by name, or files of runs, of at least 4 robots or plants.
        anomaly_map: The map that the model was trained on: a map layer, a stage, or a folder of survey CSVs.
        out: Weights file to write, .safetensors.
        force: Replace existing files.

    Raises:
        InputError: A file cannot be read, the model is a mixed one, which learns this in its training, the
            map is another, there are too few robots, or a file exists.
    """
    if out is not None:
        check_free(out, force=force)
    card, before = None, ""
    if isinstance(model, str | os.PathLike):
        path = existing(model, "weights file")
        model, card, before = load_predictor(path), path.with_suffix(".md"), sha256(path)
    field = anomaly_map if isinstance(anomaly_map, AnomalyMap) else open_map(anomaly_map)
    wide = widened(model, _sources(recordings), field)
    if out is not None:
        with transaction():
            with output(out, force=force) as weights:
                wide.save(weights)
                after = sha256(weights)
            if card is not None and card.is_file():
                text = widened_card(read_text(card, "model card", "text"), before, after, wide)
                with output(Path(out).with_suffix(".md"), force=force) as copied:
                    copied.write_text(text, encoding="utf-8")
    return wide


def error_budget(
    evaluation: Evaluation,
    scene: File,
    train: Dataset | File,
    *,
    progress: Progress = lambda done, total, what: None,
) -> tuple[Budget, ...]:
    """How much of the error of each model is map, lever arm, latency, sessions, platform and sensor.

    Args:
        evaluation: An evaluation on runs of a twin.
        scene: Stage of the twin that made the recordings and the training recordings.
        train: Data set that the baselines are fitted to.
        progress: Called with the models done, their number, and the name of the next.

    Raises:
        InputError: A recording has no truth, or is of another scene.
    """
    opened = functools.cache(lambda kind: open_twin(Path(scene), magnetometer=kind))

    def scene_in_session(name: str, run: Run) -> Scene:
        of_session = in_session_of(opened(run.metadata.get("magnetometer")), run.metadata).scene
        check_scene(of_session, run.metadata, name)
        return of_session

    truth, train = Truth(opened("physical").scene, scene_in_session), _dataset(train)
    made = []
    for m, name in enumerate(evaluation.names):
        progress(m, len(evaluation.names), name)
        made.append(budget(evaluation, m, truth, train, evaluation.learned or None))
    progress(len(made), len(made), "")
    return tuple(made)


def map_of_scene(scene: File) -> Path:
    """File of the map of a scene."""
    return Path(read_scene(scene_file(Path(scene)), check_network=False).map_layer)


def short_names(files: Sequence[Path]) -> list[str]:
    """Names of files: their stems, or more of their paths if two are alike.

    Raises:
        InputError: A file is named twice.
    """
    for name_of in (lambda path: path.stem, lambda path: path.name, str):
        names = [name_of(path) for path in files]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in files if list(files).count(path) > 1)
    raise InputError(f"{twice} is named twice; name each file once")


def _single(value: Any) -> bool:
    return isinstance(value, str | os.PathLike | AnomalyMap)


def _dataset(dataset: Dataset | File) -> Dataset:
    return dataset if isinstance(dataset, Dataset) else open_dataset(dataset)


def _named_maps(maps: Sequence[AnomalyMap | File]) -> list[NamedMap]:
    from magtwin.usd.layers import layer_sha256

    files = iter(short_names([Path(each) for each in maps if not isinstance(each, AnomalyMap)]))
    named = []
    for each in maps:
        if isinstance(each, AnomalyMap):
            named.append(named_map(each.name, each))
        else:
            path = map_file(each)
            checksum = [layer_sha256(path)] if path.is_file() else []
            named.append(named_map(next(files), open_map(path), *checksum))
    if not named:
        raise InputError(
            "no map: name those that the weights were trained on (--map), or the scene (--scene)"
        )
    return named


def _trials(
    recordings: Dataset | Mapping[str, Run] | Sequence[File] | File,
    learning: Dataset | None,
    candidates: Sequence[Candidate],
) -> tuple[list[Source], Sequence[str]]:
    """Recordings to judge by, and the training recordings that baselines are fitted to."""
    learned: Sequence[str] = () if learning is None else learning.names
    is_set = isinstance(recordings, str | os.PathLike) and (Path(recordings) / MANIFEST).is_file()
    if isinstance(recordings, Dataset) or is_set:
        judged = _dataset(recordings)  # type: ignore[arg-type]
        names, rest = unseen(judged, candidates)
        if learning is not None and learning.folder.resolve() == judged.folder.resolve():
            learned = tuple(name for name in rest if name not in names)
        trials = trials_of(judged, names)
    else:
        trials = _sources(recordings)
    return trials if learning is None else unlearned(trials, learning, learned), learned


def _sources(recordings: Mapping[str, Run] | Sequence[File] | File, **options: Any) -> list[Source]:
    return (
        sources_of(recordings) if isinstance(recordings, Mapping) else sources_of_files(recordings, **options)
    )
