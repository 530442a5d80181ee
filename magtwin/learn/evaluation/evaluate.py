"""Evaluation: models on their maps against recordings that they never saw, as in the paper's Table 1.

Every error is of the total field at the sensor, predicted less measured, so that models which learned on
different maps compare: each looks up its own map, with its own lever arm and latency, and adds what it
predicts of the robot. The naive model is the paper's: the first map and the mean training label, on every
row.
"""

import math
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import sha256
from magtwin.learn.data.dataset import KEPT, MANIFEST, Dataset, values_sha256
from magtwin.learn.data.features import CARRIED, CIRCULAR, FEATURES, GRADIENT, features
from magtwin.learn.data.labels import Alignment, labelled
from magtwin.learn.data.recording import thinned
from magtwin.learn.data.split import split
from magtwin.learn.evaluation.scores import Errors, Score, scores
from magtwin.learn.inference.magnetometer import NeuralMagnetometer, Read
from magtwin.learn.models.linear import fit_linear
from magtwin.path import CASES
from magtwin.run.run import Run
from magtwin.summary import Summarized, Summary, listed
from magtwin.verdict import SEPARATOR, recordings_text, verdict

Array = NDArray[np.float64]

PAPER: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "A": (217.6, 225.2, 0.966),
        "B": (307.9, 407.1, 0.756),
        "C": (267.0, 381.4, 0.700),
        "D": (284.6, 333.1, 0.855),
        "E": (323.6, 409.3, 0.791),
    }
)
"""Table 1 of the paper (Penumarti et al. 2025): MAE and naive MAE [nT], and their ratio."""

TOTALS = ("all", "mean")
"""Rows of the table that are of no path."""

NAIVE = "naive"
"""Name of the naive model."""

TRAINED_AT_HZ = 10.0
"""Training rows a second that a baseline is fitted to: more are too alike to tell more."""

GAUSSIAN_MAE = math.sqrt(2 / math.pi)
"""Mean absolute error of a normal distribution, in standard deviations."""


class Model(Protocol):
    """What predicts a disturbance; a `NeuralMagnetometer` does."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of its inputs."""

    def read(self, runs: Sequence[Run]) -> list[Read]:
        """Disturbances, their standard deviations, and rows beyond the training ranges, of each run."""


@dataclass(frozen=True)
class Mean:
    """The naive model: the mean training label, whatever is read."""

    mean_nt: float
    """Mean of the training labels [nT]."""

    sd_nt: float
    """Their standard deviation [nT]; nan where unknown."""

    features: tuple[str, ...] = ()
    """It reads nothing."""

    def read(self, runs: Sequence[Run]) -> list[Read]:
        """The mean, its standard deviation, and that nothing is beyond what it knows."""
        counts = [run.rows for run in runs]
        return [Read(np.full(n, self.mean_nt), np.full(n, self.sd_nt), np.zeros(n, bool)) for n in counts]


@dataclass(frozen=True, eq=False, repr=False)
class Chart(Summarized):
    """A map that models are judged on."""

    name: str
    """What to call it; the name of its file."""

    field: AnomalyMap

    checksums: frozenset[str]
    """Those that may name it: of its file, and of its values."""

    def _summary(self) -> Summary:
        return Summary(f"Chart {self.name}", self.field._summary().rows)


@dataclass(frozen=True, eq=False, repr=False)
class Contender(Summarized):
    """A model with the map, lever arm and latency that it learned with."""

    name: str
    model: Model
    chart: Chart
    alignment: Alignment = field(default_factory=Alignment)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """What its file tells, or how it was made."""

    def _summary(self) -> Summary:
        (x, y), latency = self.alignment.lever_arm_m, self.alignment.latency_s
        return Summary(
            f"Contender {self.name}: on map {self.chart.name}",
            (
                ("inputs", f"{len(self.model.features)}: {listed(self.model.features)}"),
                ("alignment", f"lever arm ({x:.3g}, {y:.3g}) m, latency {latency:.3g} s"),
            ),
        )


@dataclass(frozen=True)
class Trial:
    """A recording to judge by."""

    name: str
    read: Callable[[], Run]
    session: str = ""
    """What was switched on and off with it; what its run says, else its name, unless given."""
    path: str = ""
    """What was driven; what its run says, else its name, unless given."""


@dataclass(frozen=True, eq=False, repr=False)
class Judged(Summarized):
    """What every model made of a recording; M models, N readings."""

    name: str
    session: str
    path: str
    case: str
    """Row of the table that it belongs to."""

    run: Run
    """The recording, of the columns that a data set keeps."""

    p_xy: Array
    """Where the robot was seen [m], shape (N, 2)."""

    measured_nt: Array
    """Total field at the sensor [nT], shape (N,): the reading, or the exact field where asked for."""

    kept: NDArray[np.bool_]
    """Readings that all models are judged on, shape (N,)."""

    map_nt: Array
    """Each model's map where it takes the sensor to be [nT], shape (M, N)."""

    map_sd_nt: Array
    """How well that is known [nT], shape (M, N)."""

    total_nt: Array
    """Predicted total field [nT], shape (M, N)."""

    sd_nt: Array
    """Its predicted standard deviation [nT], shape (M, N); nan where there is none."""

    outside: NDArray[np.bool_]
    """Whether an input was beyond the training ranges, shape (M, N)."""

    def errors(self) -> Errors:
        """Errors on the readings that all are judged on."""
        kept = self.kept
        return Errors(
            self.session,
            self.case,
            self.run["t"][kept],
            self.total_nt[:, kept] - self.measured_nt[kept],
            self.sd_nt[:, kept],
            self.outside[:, kept],
        )

    def _summary(self) -> Summary:
        kept = int(self.kept.sum())
        error = np.abs(self.total_nt - self.measured_nt)[:, self.kept]
        return Summary(
            f"Judged {self.name}: {kept:,} of {len(self.kept):,} readings, case {self.case}",
            (
                ("from", f"session {self.session}, path {self.path}"),
                (
                    "MAE",
                    listed([f"{mae:.4g}" for mae in error.mean(axis=1)]) + " nT, one per model"
                    if kept
                    else "",
                ),
            ),
        )


@dataclass(frozen=True, repr=False)
class Case(Summarized):
    """A row of the table."""

    name: str
    recordings: int
    sessions: int
    scores: tuple[Score, ...]
    """One a model, the naive one first."""

    def _summary(self) -> Summary:
        return Summary(
            f"Case {self.name}: {self.recordings:,} recordings, {self.sessions:,} sessions",
            (
                (
                    "MAE",
                    listed([f"{one.mae_nt:.4g}" for one in self.scores]) + " nT, one per model, naive first",
                ),
                ("of naive", listed([f"{one.ratio:.3g}" for one in self.scores])),
            ),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Summarized):
    """Models against recordings."""

    contenders: tuple[Contender, ...]
    """The naive model first."""

    charts: tuple[Chart, ...]
    """Maps, the first that of the naive model."""

    cases: tuple[Case, ...]
    """Paths, in the order of the paper's cases and then by name; "all", every reading; and where there are
    several paths "mean", the mean of the rows above."""

    judged: tuple[Judged, ...]
    """Recordings, one by one."""

    left_out: Mapping[str, int]
    """Readings that not all models can be judged on, by the reason that was first found."""

    truth: bool = False
    """Whether errors are against the exact field, not the reading."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the models."""
        return tuple(one.name for one in self.contenders)

    @property
    def every(self) -> Case:
        """The row of all readings."""
        return next(case for case in self.cases if case.name == "all")

    def verdicts(self) -> dict[str, str]:
        """Whether each model from a weights file is better than the naive one, in one line a model."""
        every, sessions = self.every, {one.session for one in self.judged}
        naive, paths = every.scores[0].mae_nt, {one.path for one in self.judged}
        found = {}
        for one, score in zip(self.contenders[1:], every.scores[1:], strict=True):
            if "sha256" not in one.metadata:
                continue
            learned = [
                None if fact not in one.metadata else str(one.metadata[fact]).split(SEPARATOR)
                for fact in ("training_sessions", "training_paths")
            ]
            found[one.name] = verdict(
                score.mae_nt,
                naive,
                than=f"the naive mean on the map {self.contenders[0].chart.name}",
                interval=score.ratio_interval,
                coverage=score.coverage,
                judged_on=recordings_text(len(self.judged), sessions, paths, *learned),
            )
        return found

    def floor(self, chart: Chart) -> tuple[float, float]:
        """What a map's own variances say that its error is: MAE and RMS over the readings judged on [nT].

        No model of the robot gets below, as nothing that it reads tells the map's error at a place. nan of a
        map without variances.
        """
        m = next(i for i, one in enumerate(self.contenders) if one.chart is chart)
        sd = np.concatenate([one.map_sd_nt[m, one.kept] for one in self.judged])
        if chart.field.variance_nt2 is None:
            return math.nan, math.nan
        return GAUSSIAN_MAE * float(np.mean(sd)), float(np.sqrt(np.mean(sd**2)))

    def summary(self) -> dict[str, Any]:
        """Everything in plain figures, for JSON."""
        return {
            "verdicts": self.verdicts(),
            "errors_against": "b_truth_nt" if self.truth else "b_measured_nt",
            "models": [
                {
                    "name": one.name,
                    "map": one.chart.name,
                    "features": list(one.model.features),
                    "lever_arm_m": list(one.alignment.lever_arm_m),
                    "latency_s": one.alignment.latency_s,
                    "metadata": dict(one.metadata),
                }
                for one in self.contenders
            ],
            "maps": [
                {
                    "name": chart.name,
                    "sha256": sorted(chart.checksums),
                    "method": chart.field.method,
                    "own_mae_nt": self.floor(chart)[0],
                    "own_rms_nt": self.floor(chart)[1],
                }
                for chart in self.charts
            ],
            "cases": [
                {
                    "name": case.name,
                    "recordings": case.recordings,
                    "sessions": case.sessions,
                    "rows": case.scores[0].rows,
                    "models": {
                        name: {key: value for key, value in vars(score).items() if key != "rows"}
                        for name, score in zip(self.names, case.scores, strict=True)
                    },
                }
                for case in self.cases
            ],
            "recordings": [
                {
                    "name": one.name,
                    "session": one.session,
                    "path": one.path,
                    "case": one.case,
                    "rows": int(one.kept.sum()),
                }
                for one in self.judged
            ],
            "left_out": dict(self.left_out),
        }

    def _summary(self) -> Summary:
        """Every model over all readings; a notebook also shows them case by case."""
        every = self.every
        models = [
            (name, f"MAE {one.mae_nt:.4g} nT, {one.ratio:.3g} of naive, {_covered(one)}")
            for name, one in zip(self.names, every.scores, strict=True)
        ]
        return Summary(
            f"Evaluation: {len(self.names) - 1} models, {every.recordings:,} recordings, "
            f"{every.sessions:,} sessions, {every.scores[0].rows:,} readings",
            (*models[1:4], models[0], *models[4:]),
            ("case", *self.names),
            [(case.name, *(f"{one.mae_nt:.4g} nT" for one in case.scores)) for case in self.cases],
        )


def _covered(score: Score) -> str:
    """Share of the readings in the predicted intervals, in words."""
    return "no interval" if math.isnan(score.coverage) else f"{100 * score.coverage:.3g} % in 90 % intervals"


def evaluate(
    contenders: Sequence[Contender],
    trials: Sequence[Trial],
    *,
    rng: np.random.Generator,
    cases: Mapping[str, str] | None = None,
    truth: bool = False,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> Evaluation:
    """Judge models by recordings.

    Args:
        contenders: The models, the naive one first.
        trials: The recordings.
        rng: Source of the draws of intervals.
        cases: Rows of the table by the path that they are of; the paper's A to E and every other path by its
            own name unless given. What is given goes before.
        truth: Whether errors are against the exact field b_truth_nt in place of the reading.
        progress: Told of recordings done, of how many, and which.

    Raises:
        InputError: There is no recording or model, two have one name, a recording lacks a column that a
            model reads or lies off a map, its readings are a network's own, all labels are the same, or no
            reading is left.
    """
    if not trials or not contenders:
        raise InputError("nothing to evaluate: name weights, and recordings that they never saw")
    for what, called in (
        ("models", [one.name for one in contenders]),
        ("recordings", [t.name for t in trials]),
    ):
        if twice := sorted({name for name in called if called.count(name) > 1}):
            raise InputError(f"two {what} are called {twice[0]!r}; rename one")
    row_of = {path: letter for letter, path in CASES.items()} | {v: k for k, v in (cases or {}).items()}
    judged: list[Judged] = []
    left_out: dict[str, int] = {}
    for k, trial in enumerate(trials):
        progress(k, len(trials), trial.name)
        one, lost = _judge(contenders, trial, row_of, truth)
        judged.append(one)
        for why, count in lost.items():
            left_out[why] = left_out.get(why, 0) + count
    progress(len(trials), len(trials), "")
    told = {why: count for why, count in left_out.items() if count}
    some = [one for one in judged if one.kept.any()]
    if not some:
        said = "; ".join(f"{count:,} {why}" for why, count in told.items())
        raise InputError(f"no reading that every model can be judged on: {said}; leave a model or a map out")
    _check_labels(some)
    order = [*CASES, *sorted({one.case for one in some} - set(CASES))]
    some.sort(key=lambda one: order.index(one.case))
    by_case, every, mean = scores([one.errors() for one in some], rng=rng)
    rows = [_case(name, [one for one in some if one.case == name], by_case[name]) for name in by_case]
    rows.append(_case("all", some, every))
    if len(by_case) > 1:
        rows.append(_case("mean", some, mean))
    charts = tuple(dict.fromkeys(one.chart for one in contenders))
    return Evaluation(tuple(contenders), charts, tuple(rows), tuple(some), MappingProxyType(told), truth)


def _case(name: str, own: Sequence[Judged], found: tuple[Score, ...]) -> Case:
    return Case(name, len(own), len({one.session for one in own}), found)


def _judge(
    contenders: Sequence[Contender], trial: Trial, row_of: Mapping[str, str], truth: bool
) -> tuple[Judged, dict[str, int]]:
    """What every model makes of a recording, and why readings are left out."""
    run = trial.read()
    run = Run({name: run[name] for name in KEPT if name in run}, run.metadata)
    _check_readings(trial.name, run, truth)
    session, path = told_by(run, trial)
    measured = run["b_truth_nt" if truth else "b_measured_nt"]
    kept = np.isfinite(measured)
    lost = {"hold no field": int(np.count_nonzero(~kept))}
    on: dict[tuple[int, Alignment], Run] = {}
    shape = (len(contenders), run.rows)
    map_nt, map_sd, total, sd = (np.full(shape, np.nan) for _ in range(4))
    outside = np.zeros(shape, bool)
    for m, one in enumerate(contenders):
        key = (id(one.chart), one.alignment)
        try:
            if key not in on:
                on[key] = labelled(run, one.chart.field, one.alignment)
            here = on[key]
            told = one.model.read([here])[0]
        except InputError as error:
            raise InputError(f"{trial.name}: {one.name}: {error}") from error
        sd[m] = told.sd_nt
        if told.outside is not None:
            outside[m] = told.outside
        map_nt[m], map_sd[m] = here["b_map_nt"], here["label_sd_nt"]
        total[m] = map_nt[m] + told.disturbance_nt
        for why, known in (
            (f"have no label on {one.chart.name}", np.isfinite(here["label_nt"])),
            (f"lack an input of {one.name}", np.isfinite(total[m])),
        ):
            lost[why] = lost.get(why, 0) + int(np.count_nonzero(kept & ~known))
            kept = kept & known
    p = run["mocap_p"] if {"mocap_p", "mocap_q_xyzw"} <= set(run) else run["p_world_base"]
    row = row_of.get(path, path)
    if row in TOTALS:
        row = f"path {row}"
    found = Judged(
        trial.name, session, path, row, run, p[:, :2], measured, kept, map_nt, map_sd, total, sd, outside
    )
    return found, lost


def told_by(run: Run, trial: Trial) -> tuple[str, str]:
    """Session and path of a recording: as given, as its run says, else its name."""
    session, metadata = trial.session, run.metadata
    if not session and "session" in metadata:
        session = f"{metadata['session_seed']}-" if "session_seed" in metadata else ""
        session += str(metadata["session"])
    return session or trial.name, trial.path or str(metadata.get("path", "")) or trial.name


def _check_readings(name: str, run: Run, truth: bool) -> None:
    """Refuse what cannot judge a model."""
    wanted = "b_truth_nt" if truth else "b_measured_nt"
    if wanted not in run or not np.isfinite(run[wanted]).any():
        advice = "; leave --truth out" if truth else ""
        raise InputError(f"{name}: tells no {wanted}, so there is nothing to judge by{advice}")
    kind = run.metadata.get("magnetometer")
    if kind in ("neural", "map-only") and not truth:
        raise InputError(
            f"{name}: its readings are those of a {kind} magnetometer, a model's own; judge by a robot's "
            "recordings, by runs made with --magnetometer physical, or by the exact field (--truth)"
        )


def _check_labels(judged: Sequence[Judged]) -> None:
    """Refuse readings that do not differ from the map but by a constant."""
    label = np.concatenate([one.measured_nt[one.kept] - one.map_nt[0, one.kept] for one in judged])
    if np.ptp(label) < 1e-6:
        raise InputError(
            f"every label is {label[0]:g} nT on all {len(label):,} readings: there is nothing to predict; "
            "were the runs made by a map-only magnetometer?"
        )


def chart_of(name: str, found: AnomalyMap, *checksums: str) -> Chart:
    """A map under the checksums that weights may name it by.

    Args:
        name: What to call it.
        found: The map.
        checksums: Of its file, where it has one; that of its values is added.
    """
    return Chart(name, found, frozenset({*filter(None, checksums), values_sha256(found)}))


def contender(
    path: str | os.PathLike[str], charts: Sequence[Chart], *, any_map: bool = False, name: str = ""
) -> Contender:
    """A weights file with the map that it was trained on, its lever arm and its latency.

    Weights that name no map, as the released ones, take the first.

    Args:
        path: The weights, of any kind that magtwin reads.
        charts: The maps at hand.
        any_map: Whether the first map is taken where none is the right one.
        name: What to call it; the name of the file unless given.

    Raises:
        InputError: Not a weights file, or it was trained on a map that is not at hand.
    """
    magnetometer = NeuralMagnetometer.load(path)
    metadata = dict(magnetometer.net.metadata)
    wanted = str(metadata.get("map_sha256", ""))
    fits = [chart for chart in charts if wanted in chart.checksums]
    if wanted and not fits and not any_map:
        held = "; ".join(f"{chart.name} has {', '.join(sorted(chart.checksums))}" for chart in charts)
        raise InputError(
            f"{path}: was trained on the map {metadata.get('map', '')!r} of sha256 {wanted}, and {held}; "
            f"name "
            "its own map with --map, or take the first one all the same with --any-map"
        )
    chart = fits[0] if fits else charts[0]
    told = {"sha256": magnetometer.sha256, **metadata}
    return Contender(name or magnetometer.name, magnetometer, chart, alignment_of(metadata, path), told)


def alignment_of(metadata: Mapping[str, Any], where: object = "") -> Alignment:
    """Lever arm and latency as weights tell them; none where they do not.

    Raises:
        InputError: They are no numbers.
    """
    try:
        arm = [float(part) for part in str(metadata.get("lever_arm_m", "0, 0")).split(",")]
        forward, left = arm
        return Alignment((forward, left), float(metadata.get("latency_s", 0.0)))
    except ValueError as error:
        raise InputError(
            f"{where}: lever_arm_m {metadata.get('lever_arm_m')!r} and latency_s "
            f"{metadata.get('latency_s')!r} of "
            f"its metadata are no lengths and time ({error}); train it again"
        ) from error


def naive(
    chart: Chart,
    *,
    dataset: Dataset | None = None,
    names: Sequence[str] | None = None,
    weights: Sequence[Contender] = (),
) -> Contender:
    """The naive model: a map and the mean training label on every row.

    Args:
        chart: The map, the paper's trilinear one.
        dataset: Training recordings, which are labelled on this map.
        names: Which of them; all unless given.
        weights: Without a data set, models that were trained on this map and tell its mean label.

    Raises:
        InputError: Nothing tells the mean.
    """
    if dataset is not None:
        rows = training_rows(dataset, names, chart, ())
        model = Mean(float(rows.y.mean()), float(rows.y.std()))
        alignment = _alignment(dataset, chart)
        return Contender(NAIVE, model, chart, alignment, {"fitted to": dataset.folder.name})
    for one in weights:
        mean = one.metadata.get("label_mean_nt")
        if one.metadata.get("map_sha256") in chart.checksums and isinstance(mean, int | float):
            sd = one.metadata.get("label_sd_nt", math.nan)
            told = {"mean label of": one.name}
            return Contender(NAIVE, Mean(float(mean), float(sd)), chart, one.alignment, told)
    raise InputError(
        f"nothing tells the mean training label on the map {chart.name}, which the naive model takes: give "
        "the training recordings (--train SET), or weights trained on it, with that map first"
    )


def tolles_lawson(
    chart: Chart,
    dataset: Dataset,
    names: Sequence[str] | None = None,
    *,
    gradient: bool = False,
    alignment: Alignment | None = None,
) -> Contender:
    """A ridge in Tolles and Lawson's manner on a map: heading, motion, currents; and the map's gradient.

    Args:
        chart: The map.
        dataset: Training recordings, which are labelled on it.
        names: Which of them; all unless given.
        gradient: Whether the terms of a lever arm and a latency are among the inputs.
        alignment: Lever arm and latency; the data set's own where it was labelled on this map, else none.

    Raises:
        InputError: A recording has no label on the map.
    """
    given = alignment is not None
    alignment = alignment or _alignment(dataset, chart)
    wanted = (*CIRCULAR, *GRADIENT, *CARRIED) if gradient else CIRCULAR
    able = set(dataset.columns) | {"yaw", "b_map_gradient_nt_m"}
    inputs = tuple(name for name in wanted if set(FEATURES[name].columns) <= able)
    rows = training_rows(dataset, names, chart, inputs, alignment)
    model = fit_linear(rows.x, rows.y, rows.session, features=inputs, sd=rows.sd).model
    what = "Tolles-Lawson and gradient" if gradient else "Tolles-Lawson"
    told = {"fitted to": dataset.folder.name, "penalty": model.penalty, "training rows": len(rows.y)}
    name = f"{what}, {chart.name}{' aligned' * given}"
    return Contender(name, NeuralMagnetometer(model, name=name), chart, alignment, told)


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Training recordings on a map."""

    x: Array
    """Inputs, shape (N, F)."""
    y: Array
    """Labels [nT], shape (N,)."""
    sd: Array
    """How well the map is known there [nT], shape (N,)."""
    session: NDArray[np.intp]
    """Which session each row is of, shape (N,)."""


def training_rows(
    dataset: Dataset,
    names: Sequence[str] | None,
    chart: Chart,
    inputs: Sequence[str],
    alignment: Alignment | None = None,
) -> TrainingRows:
    """Inputs (N, F) and labels (N,) of training recordings on a map, at most `TRAINED_AT_HZ` rows a second.

    The arguments are those of `aligned_runs`.
    """
    parts = []
    sessions = [one.session for one in dataset.recordings]
    for name, run in aligned_runs(dataset, names, chart, alignment):
        x, y = features(run, inputs), run["label_nt"]
        known = np.isfinite(y) & np.isfinite(x).all(axis=1)
        session = sessions.index(dataset.recording(name).session)
        parts.append((x[known], y[known], run["label_sd_nt"][known], np.full(int(known.sum()), session)))
    rows = TrainingRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(rows.y):
        raise InputError(f"{dataset.folder}: no training row has a label on {chart.name} and all inputs")
    return rows


def aligned_runs(
    dataset: Dataset, names: Sequence[str] | None, chart: Chart, alignment: Alignment | None = None
) -> Iterator[tuple[str, Run]]:
    """Training recordings, thinned and labelled on a map, with their names.

    Args:
        dataset: The recordings.
        names: Which of them; all unless given.
        chart: The map.
        alignment: Lever arm and latency; the data set's own where it was labelled on this map, else none.
    """
    alignment = alignment or _alignment(dataset, chart)
    for one, run in dataset.runs(names):
        try:
            yield one.name, labelled(thinned(run, TRAINED_AT_HZ), chart.field, alignment)
        except InputError as error:
            raise InputError(f"{dataset.folder}, {one.name}: {error}") from error


def _alignment(dataset: Dataset, chart: Chart) -> Alignment:
    """That of a data set which was labelled on a map; of another it says nothing of this one."""
    if dataset.map_sha256 not in chart.checksums:
        return Alignment()
    return Alignment(dataset.alignment.lever_arm_m, dataset.alignment.latency_s)


def unseen(dataset: Dataset, contenders: Sequence[Contender]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Recordings of a data set that no model learned from, and those that each of them may have.

    Of a set that weights were trained on, what is left is their test recordings, by the split that their
    metadata repeat; of any other set, all of it.

    Raises:
        InputError: Nothing is left, or weights were trained on rows of every recording.
    """
    checksum = sha256(dataset.folder / MANIFEST)
    names, learned = list(dataset.names), list(dataset.names)
    for one in contenders:
        if one.metadata.get("dataset_sha256") != checksum:
            continue
        try:
            config = tomllib.loads(str(one.metadata.get("config", "")))
            by, seed, hold_out = config["split"], int(config["seed"]), tuple(config.get("hold_out", ()))
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{one.name}: was trained on {dataset.folder}, and its metadata do not say how that was "
                f"split "
                f"({error}); judge it by recordings of another set"
            ) from error
        if by == "row":
            raise InputError(
                f"{one.name}: was trained on rows of every recording of {dataset.folder}; judge it by others"
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


def trials_of(dataset: Dataset, names: Sequence[str]) -> list[Trial]:
    """Recordings of a data set, to judge by."""

    def read(name: str) -> Run:
        return next(run for _, run in dataset.runs([name]))

    told = [dataset.recording(name) for name in names]
    return [Trial(one.name, partial(read, one.name), one.session, one.path) for one in told]


def unlearned(trials: Sequence[Trial], dataset: Dataset, names: Sequence[str] | None = None) -> list[Trial]:
    """Recordings that refuse to be read if a training set holds them, whatever they are called there.

    Args:
        trials: Recordings to judge by.
        dataset: Training recordings, of which some rows may have been left out.
        names: Which of them; all unless given.
    """
    learned: dict[tuple[bytes, bytes], list[tuple[str, Array, Array]]] = {}
    for one, run in dataset.runs(names):
        t, b = run["t"], run["b_measured_nt"]
        learned.setdefault(_first(t, b), []).append((one.name, t, b))

    def read(trial: Trial) -> Run:
        run = trial.read()
        t, b = run["t"], run.get("b_measured_nt")
        if b is None or not run.rows:
            return run
        for name, its_t, its_b in learned.get(_first(t, b), []):
            at = np.minimum(np.searchsorted(t, its_t), run.rows - 1)
            common = t[at] == its_t
            if common.sum() > 1 and np.array_equal(b[at][common], its_b[common], equal_nan=True):
                raise InputError(
                    f"{trial.name}: is {name!r} of {dataset.folder}, which was learned from; judge by others"
                )
        return run

    return [replace(one, read=partial(read, one)) for one in trials]


def _first(t: Array, b: Array) -> tuple[bytes, bytes]:
    """When a recording begins, and what it read first; thinning keeps both."""
    return t[:1].tobytes(), np.nan_to_num(b[:1], nan=np.inf).tobytes()


def check_apart(train: Dataset, names: Sequence[str], judged: Dataset, of: Sequence[str]) -> None:
    """Refuse to judge baselines by recordings that they are fitted to.

    Raises:
        InputError: A recording is on both sides: of one name, session, path and length.
    """

    def known(dataset: Dataset, kept: Sequence[str]) -> dict[tuple[Any, ...], str]:
        told = [dataset.recording(name) for name in kept]
        return {(one.name, one.session, one.path, one.rows, one.duration_s): one.name for one in told}

    both = known(train, names).keys() & known(judged, of).keys()
    if both:
        name = sorted(one[0] for one in both)[0]
        raise InputError(
            f"{name!r} and {len(both) - 1} more recordings of {judged.folder} are in {train.folder} too, "
            "which baselines learn from; judge by others"
        )
