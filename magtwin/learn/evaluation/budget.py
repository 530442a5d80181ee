"""Error budget: how much of a model's error is map, lever arm, latency, platform and sensor.

On a twin everything is known, so a model's error e = map + f - measured comes apart without rest. With r the
exact field of the robot that surveyed, at rest (`magtwin.sim.survey.field_at_rest_nt`), r' that of the same
robot on the run's day, p the pose as it was seen and aligned, p* the same by the true lever arm, q the true
pose:

    map         D1 = map(p) - r(p)              what the map does not know
    lever arm   D2 = r(p) - r(p*)               the sensor taken to be elsewhere
    latency     D3 = r(p*) - r(q)               the pose late, held and noisy
    sessions    D4 = r(q) - r'(q)               the robot is not as it was on the survey's day
    platform    D5 = r'(q) - truth              what moving, motors, LiDAR and battery add
    sensor      D6 = truth - measured           noise, bandwidth and resolution

and e = f + D1 + ... + D6. But f has learned to answer what of these goes with its inputs, a map's mean error
for one. So the parts are what is left of each, Dk - E[Dk | x], the expectation a ridge over the training
recordings in heading, motion and currents, and in the map's gradient where the model reads it; of the naive
model, their mean. The platform's part has all the rest, D5 + f + the others' E: what the model makes of the
platform, right or wrong. The parts add up to e, reading by reading, whatever the model is. To close a term is
to take its part away, as an oracle for it would.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import into_base
from magtwin.learn.data.dataset import Dataset
from magtwin.learn.data.features import CARRIED, CIRCULAR, FEATURES, GRADIENT, features
from magtwin.learn.data.alignment import Alignment, placed
from magtwin.learn.data.labels import labelled
from magtwin.learn.evaluation.candidates import Candidate, Mean
from magtwin.learn.evaluation.evaluation import Evaluation
from magtwin.learn.evaluation.training_rows import aligned_runs
from magtwin.run.run import Run
from magtwin.sim.interference import level_field_nt, platform_field_nt, sensor_places
from magtwin.spec.scene import Scene
from magtwin.summary import Summarized, Summary

Array = NDArray[np.float64]

TERMS = ("map", "lever arm", "latency", "sessions", "platform", "sensor")
"""The parts of an error, in the order in which they are closed."""

CLOSED = {
    "map": "the exact field at rest in place of the map",
    "lever arm": "the true lever arm",
    "latency": "the true pose when the reading was taken",
    "sessions": "the robot of the survey's day, and no other",
    "platform": "the field of motion, motors, LiDAR and battery",
    "sensor": "a sensor without noise",
}
"""What an oracle for each tells."""

_OTHERS = tuple(term for term in TERMS if term != "platform")

PENALTY = 1e-3
"""Of the ridge that tells what a model can have learned, as a share of the rows' own curvature."""

BUDGET_HZ = 20.0
"""Readings a second that a budget is made of: their exact field takes its time."""


@dataclass(frozen=True)
class Term:
    """One term of a budget."""

    name: str

    rms_nt: float
    """Root mean square of its part of the error [nT]."""

    alone_nt: float
    """MAE with this term closed and no other [nT]."""

    after_nt: float
    """MAE with this term and those before it closed [nT]."""


@dataclass(frozen=True, repr=False)
class Budget(Summarized):
    """A model's error by what makes it."""

    name: str
    """The model."""

    rows: int
    """Readings."""

    mae_nt: float
    naive_mae_nt: float

    terms: tuple[Term, ...]
    """In the order of `TERMS`."""

    @property
    def bought(self) -> tuple[float, ...]:
        """What closing each term after those before it takes from the MAE [nT]; they add up to all of it."""
        after = [self.mae_nt, *(term.after_nt for term in self.terms)]
        return tuple(before - now for before, now in itertools.pairwise(after))

    def summary(self) -> dict[str, Any]:
        """The budget in plain figures, for JSON."""
        return {
            "model": self.name,
            "rows": self.rows,
            "mae_nt": self.mae_nt,
            "naive_mae_nt": self.naive_mae_nt,
            "terms": [
                {
                    "name": term.name,
                    "closed_by": CLOSED[term.name],
                    "rms_nt": term.rms_nt,
                    "mae_closed_alone_nt": term.alone_nt,
                    "mae_closed_in_turn_nt": term.after_nt,
                    "ratio_closed_in_turn": term.after_nt / self.naive_mae_nt,
                    "bought_nt": bought,
                }
                for term, bought in zip(self.terms, self.bought, strict=True)
            ],
        }

    def _summary(self) -> Summary:
        terms = sorted(self.terms, key=lambda term: -term.rms_nt)
        return Summary(
            f"Budget of {self.name}: MAE {self.mae_nt:.4g} nT over {self.rows:,} readings, naive "
            f"{self.naive_mae_nt:.4g} nT",
            tuple(
                (term.name, f"rms {term.rms_nt:.4g} nT, MAE {term.alone_nt:.4g} nT with it closed")
                for term in terms
            ),
        )


@dataclass(frozen=True)
class TrueError:
    """What a map misses of the field of the robot that surveyed, on the readings of an evaluation."""

    map: str
    mae_nt: float
    rms_nt: float
    bias_nt: float


class Truth:
    """The exact fields of a twin along a run, and what of a model's error each makes."""

    def __init__(self, surveyed: Scene, day_of: Callable[[str, Run], Scene]) -> None:
        """Use a twin.

        Args:
            surveyed: The scene, its robot as on the day of the survey.
            day_of: From a run's name and the run to the scene with its robot as on the run's day.
        """
        self.surveyed, self.day_of = surveyed, day_of
        self._exact: dict[tuple[str, Alignment | None], Array] = {}

    def parts(
        self,
        name: str,
        run: Run,
        rows: NDArray[np.intp],
        map_nt: Array,
        alignment: Alignment,
        measured: Array,
    ) -> Array:
        """D1 to D6 of the module, by `TERMS`, shape (6, len(rows)) [nT].

        Args:
            name: What to call the run; one name, one run, and always the same rows.
            run: Needs the true pose p_world_base with yaw, and b_truth_nt.
            rows: Which of its readings.
            map_nt: The map where the sensor is taken to be, at these readings [nT].
            alignment: By which that is.
            measured: What was read there [nT].

        Raises:
            InputError: The run does not tell the truth.
        """
        for column in ("p_world_base", "yaw", "b_truth_nt"):
            if column not in run or not np.isfinite(run[column]).any():
                raise InputError(
                    f"{name}: tells no {column}, and an error budget needs the truth that only a twin knows; "
                    "leave --scene out"
                )
        if (name, None) not in self._exact:
            p, yaw = run["p_world_base"][rows, :2], run["yaw"][rows]
            both = [self.at_rest(p, yaw), self.at_rest(p, yaw, self.day_of(name, run))]
            self._exact[name, None] = np.stack(both)
        if (name, alignment) not in self._exact:
            day = self.day_of(name, run)
            seen = {"mocap_p", "mocap_q_xyzw"} <= set(run)
            arm = Alignment(day.robot.mocap.offset_m if seen else (0.0, 0.0), alignment.latency_s)
            found = [placed(run, one) for one in (alignment, arm)]
            self._exact[name, alignment] = np.stack([self.at_rest(p[rows], yaw[rows]) for p, yaw, _ in found])
        at_rest, on_day = self._exact[name, None]
        at_place, at_true_arm = self._exact[name, alignment]
        truth = run["b_truth_nt"][rows]
        return np.stack(
            [
                map_nt - at_place,
                at_place - at_true_arm,
                at_true_arm - at_rest,
                at_rest - on_day,
                on_day - truth,
                truth - measured,
            ]
        )

    def at_rest(self, p_xy: Array, yaw: Array, scene: Scene | None = None) -> Array:
        """Exact field magnitude at the magnetometer of a robot that stands with its LiDAR off [nT].

        That of `magtwin.sim.survey.field_at_rest_nt`, looked up to 1e-3 nT.

        Args:
            p_xy: Positions of base_link [m], shape (N, 2).
            yaw: Headings [rad], shape (N,).
            scene: The scene on another day than the survey's.

        Returns:
            Field magnitude [nT], shape (N,); nan where the pose is.
        """
        scene = scene or self.surveyed
        pose = np.column_stack([p_xy, yaw])
        known = np.isfinite(pose).all(axis=1)
        found = np.full(len(pose), np.nan)
        if known.any():
            place = sensor_places(scene.robot, pose[known])
            b = level_field_nt(scene, place[:, :2], float(place[0, 2]))[0]
            b[:, :2] = into_base(b[:, :2], pose[known, 2])
            found[known] = np.linalg.norm(platform_field_nt(scene.robot.platform, b), axis=1)
        return found


def budgets(
    found: Evaluation,
    models: Sequence[int],
    truth: Truth,
    train: Dataset,
    names: Sequence[str] | None = None,
    *,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> list[Budget]:
    """Error budgets of some models of an evaluation.

    Args:
        found: The evaluation.
        models: Numbers of models.
        truth: The twin that made the recordings, those of the training too.
        train: Training recordings, from which what a model has learned of each term is taken.
        names: Which of them; all unless given.
        progress: Told of models done, of how many, and which.

    Raises:
        InputError: A recording does not tell the truth, or is of another scene.
    """
    made = []
    for k, m in enumerate(models):
        progress(k, len(models), found.names[m])
        made.append(_budget(found, m, truth, train, names))
    progress(len(models), len(models), "")
    return made


def _budget(found: Evaluation, m: int, truth: Truth, train: Dataset, names: Sequence[str] | None) -> Budget:
    one = found.candidates[m]
    inputs = _inputs(one, found, train)
    learned = _learned(one, inputs, truth, train, names)
    errors, parts, naive = [], [], []
    for judged in found.judged:
        rows = _thinned(judged.run, judged.kept)
        measured = judged.measured_nt[rows]
        exact = truth.parts(
            f"judged {judged.name}", judged.run, rows, judged.map_nt[m, rows], one.alignment, measured
        )
        run = judged.run.take(rows)
        if any(set(FEATURES[name].columns) & {"b_map_gradient_nt_m"} for name in inputs):
            run = labelled(judged.run, one.map.field, one.alignment).take(rows)
        expected = learned(features(run, inputs)).T
        part = dict(zip(TERMS, exact, strict=True))
        for term, expectation in zip(_OTHERS, expected, strict=True):
            part[term] = part[term] - expectation
        error = judged.total_nt[m, rows] - measured
        part["platform"] = error - sum(part[term] for term in _OTHERS)
        errors.append(error)
        naive.append(judged.total_nt[0, rows] - measured)
        parts.append(np.stack([part[term] for term in TERMS]))
    error, whole = np.concatenate(errors), np.concatenate(parts, axis=1)
    left, terms = error, []
    for k, term in enumerate(TERMS):
        left = left - whole[k]
        rms = float(np.sqrt(np.mean(whole[k] ** 2)))
        terms.append(Term(term, rms, _mae(error - whole[k]), _mae(left)))
    return Budget(one.name, len(error), _mae(error), _mae(np.concatenate(naive)), tuple(terms))


def _learned(
    one: Candidate, inputs: Sequence[str], truth: Truth, train: Dataset, names: Sequence[str] | None
) -> "_Expectation":
    """What the inputs tell of each term but the platform's, from training recordings."""
    xs, ys = [], []
    for name, run in aligned_runs(train, names, one.map.field, one.alignment):
        x, rows = features(run, inputs), np.arange(run.rows)
        called, measured = f"training {name}", run["b_measured_nt"]
        exact = truth.parts(called, run, rows, run["b_map_nt"], one.alignment, measured)
        whole = np.isfinite(run["label_nt"]) & np.isfinite(x).all(axis=1) & np.isfinite(exact).all(axis=0)
        xs.append(x[whole])
        ys.append(exact[[TERMS.index(term) for term in _OTHERS]][:, whole].T)
    return _Expectation(np.concatenate(xs), np.concatenate(ys))


class _Expectation:
    """E[y | x] of several y at once, by ridge regression."""

    def __init__(self, x: Array, y: Array) -> None:
        """Fit to rows (N, F) and what goes with them, (N, T)."""
        self.mean, self.scale, self.offset = x.mean(axis=0), x.std(axis=0), y.mean(axis=0)
        self.scale[self.scale <= 1e-12 * np.maximum(1.0, np.abs(self.mean))] = 1.0
        z = (x - self.mean) / self.scale
        held = z.T @ z + PENALTY * len(z) * np.eye(z.shape[1])
        self.weights = np.linalg.solve(held, z.T @ (y - self.offset))

    def __call__(self, x: Array) -> Array:
        """At rows (N, F), shape (N, T)."""
        return np.asarray(self.offset + (x - self.mean) / self.scale @ self.weights)


def _inputs(one: Candidate, found: Evaluation, train: Dataset) -> tuple[str, ...]:
    """Inputs by which a model can have learned of a term: none of the naive one's."""
    if isinstance(one.model, Mean):
        return ()
    able = set(train.columns).intersection(*(set(judged.run) for judged in found.judged))
    able |= {"yaw", "b_map_gradient_nt_m"}
    reads = set(one.model.features) & {*GRADIENT, *CARRIED}
    wanted = (*CIRCULAR, *(name for name in (*GRADIENT, *CARRIED) if name in reads))
    return tuple(name for name in wanted if set(FEATURES[name].columns) <= able)


def true_errors(found: Evaluation, truth: Truth) -> list[TrueError]:
    """What each map misses of the robot that surveyed, at rest, on the readings judged on."""
    told = []
    for named in found.maps:
        m = next(i for i, one in enumerate(found.candidates) if one.map is named)
        missed = []
        for judged in found.judged:
            rows = _thinned(judged.run, judged.kept)
            place, yaw, _ = placed(judged.run, found.candidates[m].alignment)
            exact = truth.at_rest(place[rows], yaw[rows])
            missed.append(judged.map_nt[m, rows] - exact)
        error = np.concatenate(missed)
        told.append(
            TrueError(named.name, _mae(error), float(np.sqrt(np.mean(error**2))), float(np.mean(error)))
        )
    return told


def steps(found: Evaluation) -> list[int]:
    """Models in order from the paper's configuration on: each map in turn, and on each of them Tolles and
    Lawson's, then with the gradient's terms, then the weights; on the first map the weights come first.
    """

    def rank(m: int) -> tuple[int, ...]:
        one = found.candidates[m]
        place = found.maps.index(one.map)
        own = "sha256" in one.metadata
        gradient = bool(set(one.model.features) & set(GRADIENT))
        aligned = one.alignment != Alignment()
        return (place, int(own) if place else int(not own), int(gradient), int(aligned), m)

    return [0, *sorted(range(1, len(found.candidates)), key=rank)]


def _thinned(run: Run, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Readings that are kept, at most `BUDGET_HZ` a second."""
    step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else 1.0
    return np.flatnonzero(kept)[:: max(1, round(1 / (step * BUDGET_HZ)))]


def _mae(error: Array) -> float:
    return float(np.mean(np.abs(error)))
