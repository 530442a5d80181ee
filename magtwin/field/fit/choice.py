"""Choice of a map method by evidence: how well each predicts readings that it was not fitted to."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from math import lgamma
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.fit.check import parts, predict_readings, shown
from magtwin.field.fit.covariance import Kernel
from magtwin.field.fit.fit import fit_as_given
from magtwin.field.fit.harmonic.inversion import GAIN
from magtwin.field.fit.harmonic.layers import DIPOLES_OF_DRIVE, LEAST_DEPTH_M
from magtwin.field.fit.methods import FieldModel, in_own_axes
from magtwin.field.fit.mixture import Mixture, mixed
from magtwin.field.survey.bins import means, spacing_m
from magtwin.field.survey.readings import Readings
from magtwin.report.report import Figure, Report
from magtwin.report.verdict import Z_90

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Progress = Callable[[int, int, str], Any]

LEAST_READINGS = 40  # Fewest good readings of which some are left out; below, the method is harmonic
MOST_FITTED = 400  # Most means of readings of a drive that the trials are fitted to
MOST_TESTED = 2000  # Most readings of a drive that the trials predict
NEAR = 2.0  # Only readings this near to a fitted one count, in spacings: a map is masked beyond
NODE_PARTS, NODES_LEFT_OUT = 5, (0, 2)  # Parts of a grid's nodes, and those that are left out in turn
WEIGHTS = (0.25, 0.5, 0.75)  # Weights of the harmonic fit in a mixture with a Gaussian process
# Degrees of freedom of the log score. Errors have heavy tails, and under a normal density a few readings
# beside gaps of the survey would decide.
FREEDOM = 5.0
# Options that end the learning of a trial early: more learning predicted readings left out no better. The fit
# to the whole survey continues from there.
SHORT: Mapping[str, Mapping[str, Any]] = {"harmonic": {"gain": GAIN}, "gp": {"steps": 15}}
RESUMED = ("harmonic", "gp")  # Methods whose fits start from an earlier fit
# Parameters of a map with the figures of the candidates, in the order of their names
CANDIDATES, CHOSEN, LEAD = "candidates", "chosen", "lead in log score"
RMSE, SCORE, COVERAGE = "held-out RMSE [nT]", "held-out log score", "held-out coverage [%]"


@dataclass(frozen=True)
class Candidate:
    """A method with its options."""

    name: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    magnitudes: bool = False  # Whether vectors are left out of the readings

    def fit(self, readings: Readings, like: FieldModel | None = None, **more: Any) -> FieldModel:
        """Fit the readings, from an earlier fit if there is one."""
        if like is not None and self.method in RESUMED:
            more["like"] = like
        else:
            more |= SHORT.get(self.method, {})
        own = readings.with_(b_body_nt=None) if self.magnitudes else readings
        return fit_as_given(own, self.method, **{**self.options, **more})


@dataclass(frozen=True, eq=False)
class Trial:
    """Predictions of left-out readings by a candidate, or by a mixture of several."""

    of: tuple[Candidate, ...]
    mean: Array  # Predictions [nT], shape (N,)
    variance: Array  # Their variances with noise [nT^2], shape (N,)
    off: Array  # Readings minus predictions [nT], shape (N,)
    weights: tuple[float, ...] = (1.0,)
    models: tuple[FieldModel, ...] = ()  # The fits

    @property
    def name(self) -> str:
        """Names of the candidates, with weights for a mixture."""
        if len(self.of) == 1:
            return self.of[0].name
        return " + ".join(f"{w:g} {c.name}" for w, c in zip(self.weights, self.of, strict=True))

    def joined(self, other: "Trial") -> "Trial":
        """This trial with the readings of another."""
        return replace(
            other,
            mean=np.append(self.mean, other.mean),
            variance=np.append(self.variance, other.variance),
            off=np.append(self.off, other.off),
        )

    @property
    def rmse_nt(self) -> float:
        """Root mean square error [nT]."""
        return float(np.sqrt(np.mean(self.off**2)))

    @property
    def score(self) -> float:
        """Mean log predictive density [log 1/nT], of Student's t scaled by the standard deviation."""
        half = (FREEDOM + 1) / 2
        level = lgamma(half) - lgamma(FREEDOM / 2) - np.log(FREEDOM * np.pi * self.variance) / 2
        return float(np.mean(level - half * np.log1p(self.off**2 / (FREEDOM * self.variance))))

    @property
    def coverage(self) -> float:
        """Share of readings in their 90 % intervals [%]."""
        return float(100 * np.mean(np.abs(self.off) <= Z_90 * np.sqrt(self.variance)))


@in_own_axes
def fit_auto(
    readings: Readings,
    *,
    earth_nt: Sequence[float] | None = None,
    kernel: Kernel | None = None,
    progress: Progress | None = None,
) -> FieldModel:
    """Fit the method that best predicts readings that were left out.

    Candidates are trilinear interpolation (gridded surveys), Gaussian processes with both kernels, the
    harmonic fit, the harmonic fit of magnitudes (surveys of vectors), and mixtures of the best harmonic fit
    with a Gaussian process. The harmonic fit is tried with and without a layer of dipoles above the
    sensor. Each is fitted to a part of the survey. Left out is every fifth node of a gridded survey at all
    headings; else one run of several; else every fifth block of the floor. A drive is thinned to
    `MOST_FITTED` means for the trials. For gridded surveys, the best harmonic fit and the others are tried a
    second time, with other nodes left out. The candidate with the greatest mean log predictive density of the
    readings left out, of Student's t, is fitted to the whole survey. Trials learn only until the evidence
    grows slowly, and each later fit of a candidate continues from its earlier one. Surveys with fewer than
    `LEAST_READINGS` good readings get a harmonic fit.

    Options: the Earth's field `earth_nt` in world axes [nT] for the harmonic fit, and the only `kernel` of
    the Gaussian process that is tried. The parameters of the model name the candidates, with RMSE, log score
    and coverage of each.
    """
    alone = readings.signals is not None and np.ptp(readings.run[readings.good]) == 0
    if not alone:  # several drives may differ in their signals' fields
        readings = readings.with_(signals=None, signal_names=())
    tried = _candidates(readings, earth_nt, kernel)
    held = [] if alone else _held_out(readings)
    if not held:
        model = fit_as_given(readings, "harmonic", progress=progress, earth_nt=earth_nt)
        why = "the only one that fits the robot's signals" if alone else "too few readings to leave some out"
        return _told(model, {CHOSEN: f"harmonic: {why}"})
    say, steps, turn = progress or (lambda *_: None), len(tried) + 4 * (len(held) - 1) + 2, count()
    trials, refused = list[Trial](), list[InputError]()
    for candidate in tried:
        say(next(turn), steps, f"trying {candidate.name}")
        try:
            trials.append(_try(candidate, *held[0], _like(candidate, trials)))
        except InputError as error:
            refused.append(error)
    if not trials:
        raise refused[-1]
    trials = _common(trials)
    finalists = _finalists(trials)
    for pair in held[1:]:
        more = []
        for trial in finalists:
            say(next(turn), steps, f"trying {trial.name} again")
            more.append(_try(trial.of[0], *pair, trial.models[0]))
        more = _common(more)
        finalists = [trial.joined(other) for trial, other in zip(finalists, more, strict=True)]
    finalists += _mixtures(finalists)
    best = max(finalists, key=lambda trial: trial.score)
    models = []
    for k, candidate in enumerate(best.of):
        say(next(turn), steps, f"fitting {candidate.name}")
        models.append(candidate.fit(readings, best.models[k]))
    say(steps, steps, "done")
    model = models[0] if len(models) == 1 else Mixture.of(models, best.weights)
    names = [trial.name for trial in finalists]
    trials = finalists + [trial for trial in trials if trial.name not in names]
    second = max((t.score for t in finalists if t.of != best.of), default=best.score)
    return _told(
        model,
        {
            CHOSEN: best.name,
            LEAD: round(best.score - second, 4),
            CANDIDATES: [t.name for t in trials],
            RMSE: [round(t.rmse_nt, 1) for t in trials],
            SCORE: [round(t.score, 3) for t in trials],
            COVERAGE: [round(t.coverage, 1) for t in trials],
        },
    )


def choice_report(parameters: Mapping[str, Any]) -> Report:
    """The candidates of a choice, from the parameters of a map; empty if none was made."""
    if CHOSEN not in parameters:
        return Report("choice")
    figures = [Figure("chosen method", str(parameters[CHOSEN]), note=_lead(parameters))]
    for name, rmse, score, coverage in zip(
        *(parameters.get(key, []) for key in (CANDIDATES, RMSE, SCORE, COVERAGE)), strict=True
    ):
        note = f"log score {score:.3f}, {coverage:g} % in 90 % intervals"
        figures.append(Figure(f"held out, {name}", rmse, "nT", note=note))
    return Report("choice", tuple(figures))


def _lead(parameters: Mapping[str, Any]) -> str:
    lead = parameters.get(LEAD)
    return "" if lead is None else f"leads the next by {lead:.3f} of log score per left-out reading"


def _candidates(readings: Readings, earth_nt: Any, kernel: Kernel | None) -> list[Candidate]:
    found = list[Candidate]()
    common = {"earth_nt": earth_nt, "most_dipoles": DIPOLES_OF_DRIVE if readings.grid is None else None}
    for above in (False, True):
        layer = ", layer above" * above
        found.append(Candidate(f"harmonic{layer}", "harmonic", {**common, "above": above}))
    if readings.b_body_nt is not None:
        options = {**common, "above": False}
        found.append(Candidate("harmonic of magnitudes", "harmonic", options, magnitudes=True))
    kernels: tuple[Kernel, ...] = ("poisson", "matern") if kernel is None else (kernel,)
    found += [Candidate(f"gp {name}", "gp", {"kernel": name}) for name in kernels]
    if readings.grid is not None:
        found.append(Candidate("trilinear", "trilinear"))
    return found


def _held_out(readings: Readings) -> list[tuple[Readings, Readings]]:
    """For each turn, readings to fit and those to predict; empty if there are too few."""
    good = readings.take(readings.good) if not readings.good.all() else readings
    if len(good) < LEAST_READINGS:
        return []
    if good.node is not None:
        part = (good.node[:, 1] + 2 * good.node[:, 2]) % NODE_PARTS
        left_out: Sequence[int] = NODES_LEFT_OUT
    else:
        part, _ = parts(good, "run" if len(np.unique(good.run)) > 1 else "block")
        names = np.unique(part)
        left_out = [int(names[len(names) // 2])]
    turns = []
    for name in left_out:
        out = part == name
        if not out.any() or np.count_nonzero(~out) < LEAST_READINGS // 2:
            continue
        rest, test = shown(good, np.flatnonzero(~out)), good.take(np.flatnonzero(out))
        if good.node is None:
            rest = _thinned(rest)
            test = test.take(_near(rest, test))
        if len(test):
            turns.append((rest, test))
    return turns


def _thinned(readings: Readings) -> Readings:
    """Means of consecutive readings, evenly drawn if they are more than `MOST_FITTED`."""
    cell, _ = means(readings, max(spacing_m(readings), LEAST_DEPTH_M))
    size = np.bincount(cell)
    mean = lambda values: np.bincount(cell, values) / size  # noqa: E731
    body = readings.b_body_nt
    yaw = np.arctan2(mean(np.sin(readings.yaw)), mean(np.cos(readings.yaw)))
    first = np.unique(cell, return_index=True)[1]
    made = readings.with_(
        p_xy=np.column_stack([mean(part) for part in readings.p_xy.T]),
        yaw=yaw,
        b_nt=mean(readings.b_nt),
        b_body_nt=None if body is None else np.column_stack([mean(part) for part in body.T]),
        run=readings.run[first],
        t=None if readings.t is None else mean(readings.t),
        good=np.ones(len(size), bool),
    )
    rows = np.linspace(0, len(size) - 1, min(len(size), MOST_FITTED)).astype(np.intp)
    return made.take(np.unique(rows))


def _near(rest: Readings, test: Readings) -> Rows:
    """Rows of `test` near a reading of `rest`, at most `MOST_TESTED`, evenly drawn."""
    from scipy.spatial import cKDTree

    far = cKDTree(rest.p_xy).query(test.p_xy)[0]
    near = np.flatnonzero(far <= NEAR * spacing_m(rest))
    rows = np.linspace(0, len(near) - 1, min(len(near), MOST_TESTED)).astype(np.intp)
    return near[np.unique(rows)] if len(near) else near


def _like(candidate: Candidate, trials: Sequence[Trial]) -> FieldModel | None:
    """The fit that a candidate's can start from: the same without a layer above."""
    if candidate.options.get("above"):
        for trial in trials:
            if trial.of[0].method == candidate.method:
                return trial.models[0]
    return None


def _try(candidate: Candidate, rest: Readings, test: Readings, like: FieldModel | None) -> Trial:
    """Fit a candidate to `rest` and predict `test`."""
    more: dict[str, Any] = {"fill": True} if candidate.method == "trilinear" else {}
    model = candidate.fit(rest, like, **more)
    mean, variance = predict_readings(model, test, candidate.method)
    variance = np.maximum(variance, np.finfo(float).tiny)
    return Trial((candidate,), mean, variance, test.b_nt - mean, models=(model,))


def _common(trials: Sequence[Trial]) -> list[Trial]:
    """The trials on the readings that all of them predict; a trial that predicts under 90 % is dropped."""
    known = [np.isfinite(trial.mean) & np.isfinite(trial.variance) for trial in trials]
    kept = [k for k, rows in enumerate(known) if rows.mean() >= 0.9]
    if not kept:
        raise InputError("no map method predicts 90 % of the readings left out; give a method")
    rows = np.logical_and.reduce([known[k] for k in kept])
    some = [trials[k] for k in kept]
    return [replace(t, mean=t.mean[rows], variance=t.variance[rows], off=t.off[rows]) for t in some]


def _finalists(trials: Sequence[Trial]) -> list[Trial]:
    """The best trial of each method but all Gaussian processes, in the order of their scores."""
    best: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda trial: -trial.score):
        method = trial.of[0].method
        best.setdefault(trial.name if method == "gp" else method, trial)
    return list(best.values())


def _mixtures(trials: Sequence[Trial]) -> list[Trial]:
    """The best mixture of the harmonic fit with a Gaussian process, if there are both."""
    found = []
    for one in (trial for trial in trials if trial.of[0].method == "harmonic"):
        for other in (trial for trial in trials if trial.of[0].method == "gp"):
            for weight in WEIGHTS:
                weights = (weight, 1 - weight)
                mean, variance = mixed(weights, [one.mean, other.mean], [one.variance, other.variance])
                off = one.off + one.mean - mean
                pair, models = (one.of[0], other.of[0]), (one.models[0], other.models[0])
                found.append(Trial(pair, mean, variance, off, weights, models))
    return [max(found, key=lambda trial: trial.score)] if found else []


def _told(model: FieldModel, more: Mapping[str, Any]) -> FieldModel:
    """A model whose parameters hold more."""
    return replace(model, parameters={**model.parameters, **more})  # type: ignore[type-var, no-any-return]
