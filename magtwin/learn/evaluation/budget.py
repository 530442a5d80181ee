"""Error budget: how much of a model's error is map, lever arm, latency, sessions, platform and sensor.

On a twin everything is known, so a model's error e = map + f - measured can be decomposed exactly. Let r be
the field of the surveying robot at rest (`magtwin.sim.at_rest.field_at_rest_nt`), r' that of the robot in the
run's session, p the measured and aligned pose, p* the same with the true lever arm, and q the true pose:

    map         D1 = map(p) - r(p)              error of the map
    lever arm   D2 = r(p) - r(p*)               wrong place of the sensor
    latency     D3 = r(p*) - r(q)               late, held and noisy pose
    sessions    D4 = r(q) - r'(q)               change of the robot since the survey
    platform    D5 = r'(q) - truth              field of motion, motors, LiDAR and battery
    sensor      D6 = truth - measured           noise, bandwidth and resolution

Then e = f + D1 + ... + D6. f has learned the part of these that its inputs predict, such as the map's mean
error. So the budget lists Dk - E[Dk | x]. The expectation is a ridge regression over the training recordings
on heading, motion and currents, and on the map's gradient if the model reads it; for the naive model it is
the mean. The platform's part is the rest, D5 + f + the other expectations. The parts add up to e at each
reading. Closing a term means removing its part, as an oracle would.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import into_base
from magtwin.learn.data.alignment import Alignment, placed
from magtwin.learn.data.dataset import Dataset
from magtwin.learn.data.features import CARRIED, CIRCULAR, FEATURES, GRADIENT, features
from magtwin.learn.data.labels import labelled
from magtwin.learn.evaluation.candidates import Candidate, Mean
from magtwin.learn.evaluation.evaluation import Evaluation
from magtwin.learn.evaluation.training_rows import aligned_runs
from magtwin.report.summary import Summarized
from magtwin.run.run import Run
from magtwin.sim.interference import level_field_nt, platform_field_nt, sensor_places
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

TERMS = ("map", "lever arm", "latency", "sessions", "platform", "sensor")
"""The parts of an error, in the order in which they are closed."""

CLOSED = {
    "map": "the exact field at rest in place of the map",
    "lever arm": "the true lever arm",
    "latency": "the true pose when the reading was taken",
    "sessions": "the robot as in the survey",
    "platform": "the field of motion, motors, LiDAR and battery",
    "sensor": "a sensor without noise",
}
"""Knowledge of an oracle that closes each term."""

_OTHERS = tuple(term for term in TERMS if term != "platform")

PENALTY = 1e-3  # Penalty of the ridge for the expectations, relative to the curvature of the rows
BUDGET_HZ = 20.0  # Highest rate of readings in a budget [Hz]; their exact field takes time


@dataclass(frozen=True)
class Term:
    """One term of a budget."""

    name: str

    rms_nt: float
    """RMS of its part of the error [nT]."""

    alone_nt: float
    """MAE with only this term closed [nT]."""

    after_nt: float
    """MAE with this term and all before it closed [nT]."""


@dataclass(frozen=True, repr=False)
class Budget(Summarized):
    """A model's error by its causes."""

    name: str
    """Name of the model."""

    rows: int
    """Number of readings."""

    mae_nt: float
    naive_mae_nt: float

    terms: tuple[Term, ...]
    """In the order of `TERMS`."""

    @property
    def bought(self) -> tuple[float, ...]:
        """Reduction of the MAE by closing each term after those before it [nT]; they add up to the MAE."""
        after = [self.mae_nt, *(term.after_nt for term in self.terms)]
        return tuple(before - now for before, now in itertools.pairwise(after))

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and texts."""
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


@dataclass(frozen=True)
class TrueError:
    """Error of a map for the surveying robot, on the readings of an evaluation."""

    map: str
    mae_nt: float
    rms_nt: float
    bias_nt: float


class Truth:
    """Exact fields of a twin along a run, and their parts of a model's error."""

    def __init__(self, surveyed: Scene, scene_of: Callable[[str, Run], Scene]) -> None:
        """Use a twin.

        Args:
            surveyed: The scene, with its robot as in the survey.
            scene_of: From a run's name and the run to the scene with its robot as in the run's session.
        """
        self.surveyed, self.scene_of = surveyed, scene_of
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
            name: Name of the run; a name always stands for the same run and rows.
            run: Needs the true pose p_world_base with yaw, and b_truth_nt.
            rows: Numbers of readings.
            map_nt: The map at the assumed place of the sensor, at these readings [nT].
            alignment: Lever arm and latency of that place.
            measured: The readings [nT].

        Raises:
            InputError: The run has no truth.
        """
        for column in ("p_world_base", "yaw", "b_truth_nt"):
            if column not in run or not np.isfinite(run[column]).any():
                raise InputError(
                    f"{name}: has no {column}, and an error budget needs the truth that only a twin knows; "
                    "leave --scene out"
                )
        if (name, None) not in self._exact:
            p, yaw = run["p_world_base"][rows, :2], run["yaw"][rows]
            both = [self.at_rest(p, yaw), self.at_rest(p, yaw, self.scene_of(name, run))]
            self._exact[name, None] = np.stack(both)
        if (name, alignment) not in self._exact:
            scene = self.scene_of(name, run)
            seen = {"mocap_p", "mocap_q_xyzw"} <= set(run)
            arm = Alignment(scene.robot.mocap.offset_m if seen else (0.0, 0.0), alignment.latency_s)
            poses = [placed(run, each) for each in (alignment, arm)]
            self._exact[name, alignment] = np.stack([self.at_rest(p[rows], yaw[rows]) for p, yaw, _ in poses])
        at_rest, in_session = self._exact[name, None]
        at_place, at_true_arm = self._exact[name, alignment]
        truth = run["b_truth_nt"][rows]
        return np.stack(
            [
                map_nt - at_place,
                at_place - at_true_arm,
                at_true_arm - at_rest,
                at_rest - in_session,
                in_session - truth,
                truth - measured,
            ]
        )

    def at_rest(self, p_xy: Array, yaw: Array, scene: Scene | None = None) -> Array:
        """Exact field magnitude at the magnetometer of a robot at rest with its LiDAR off [nT].

        It is that of `magtwin.sim.at_rest.field_at_rest_nt` within 1e-3 nT.

        Args:
            p_xy: Positions of base_link [m], shape (N, 2).
            yaw: Headings [rad], shape (N,).
            scene: The scene in another session. Default: as in the survey.

        Returns:
            Field magnitude [nT], shape (N,); nan if the pose is nan.
        """
        scene = scene or self.surveyed
        pose = np.column_stack([p_xy, yaw])
        known = np.isfinite(pose).all(axis=1)
        field = np.full(len(pose), np.nan)
        if known.any():
            place = sensor_places(scene.robot, pose[known])
            b = level_field_nt(scene, place[:, :2], float(place[0, 2]))[0]
            b[:, :2] = into_base(b[:, :2], pose[known, 2])
            field[known] = np.linalg.norm(platform_field_nt(scene.robot.platform, b), axis=1)
        return field


def budgets(
    evaluation: Evaluation,
    models: Sequence[int],
    truth: Truth,
    train: Dataset,
    names: Sequence[str] | None = None,
    *,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> list[Budget]:
    """Error budgets of some models of an evaluation.

    Args:
        evaluation: The evaluation.
        models: Numbers of models.
        truth: The twin that made the recordings and the training recordings.
        train: Training recordings, for the expectations.
        names: Which of them. Default: all.
        progress: Called with the models done, their number, and the name of the next.

    Raises:
        InputError: A recording has no truth, or is of another scene.
    """
    made = []
    for k, m in enumerate(models):
        progress(k, len(models), evaluation.names[m])
        made.append(_budget(evaluation, m, truth, train, names))
    progress(len(models), len(models), "")
    return made


def _budget(
    evaluation: Evaluation, m: int, truth: Truth, train: Dataset, names: Sequence[str] | None
) -> Budget:
    candidate = evaluation.candidates[m]
    inputs = _inputs(candidate, evaluation, train)
    learned = _learned(candidate, inputs, truth, train, names)
    errors, parts, naive = [], [], []
    for judged in evaluation.judged:
        rows = _thinned(judged.run, judged.kept)
        measured = judged.measured_nt[rows]
        exact = truth.parts(
            f"judged {judged.name}", judged.run, rows, judged.map_nt[m, rows], candidate.alignment, measured
        )
        run = judged.run.take(rows)
        if any(set(FEATURES[name].columns) & {"b_map_gradient_nt_m"} for name in inputs):
            run = labelled(judged.run, candidate.map.field, candidate.alignment).take(rows)
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
    return Budget(candidate.name, len(error), _mae(error), _mae(np.concatenate(naive)), tuple(terms))


def _learned(
    candidate: Candidate, inputs: Sequence[str], truth: Truth, train: Dataset, names: Sequence[str] | None
) -> "_Expectation":
    """Expectations of each term but the platform's given the inputs, from training recordings."""
    xs, ys = [], []
    for name, run in aligned_runs(train, names, candidate.map.field, candidate.alignment):
        x, rows = features(run, inputs), np.arange(run.rows)
        called, measured = f"training {name}", run["b_measured_nt"]
        exact = truth.parts(called, run, rows, run["b_map_nt"], candidate.alignment, measured)
        whole = np.isfinite(run["label_nt"]) & np.isfinite(x).all(axis=1) & np.isfinite(exact).all(axis=0)
        xs.append(x[whole])
        ys.append(exact[[TERMS.index(term) for term in _OTHERS]][:, whole].T)
    return _Expectation(np.concatenate(xs), np.concatenate(ys))


class _Expectation:
    """E[y | x] of several y by ridge regression."""

    def __init__(self, x: Array, y: Array) -> None:
        """Fit to rows (N, F) and targets (N, T)."""
        self.mean, self.scale, self.offset = x.mean(axis=0), x.std(axis=0), y.mean(axis=0)
        self.scale[self.scale <= 1e-12 * np.maximum(1.0, np.abs(self.mean))] = 1.0
        z = (x - self.mean) / self.scale
        curvature = z.T @ z + PENALTY * len(z) * np.eye(z.shape[1])
        self.weights = np.linalg.solve(curvature, z.T @ (y - self.offset))

    def __call__(self, x: Array) -> Array:
        """Expectations at rows (N, F), shape (N, T)."""
        return np.asarray(self.offset + (x - self.mean) / self.scale @ self.weights)


def _inputs(candidate: Candidate, evaluation: Evaluation, train: Dataset) -> tuple[str, ...]:
    """Inputs by which a model can have learned a term; none for the naive model."""
    if isinstance(candidate.model, Mean):
        return ()
    able = set(train.columns).intersection(*(set(judged.run) for judged in evaluation.judged))
    able |= {"yaw", "b_map_gradient_nt_m"}
    reads = set(candidate.model.features) & {*GRADIENT, *CARRIED}
    wanted = (*CIRCULAR, *(name for name in (*GRADIENT, *CARRIED) if name in reads))
    return tuple(name for name in wanted if set(FEATURES[name].columns) <= able)


def true_errors(evaluation: Evaluation, truth: Truth) -> list[TrueError]:
    """Error of each map for the surveying robot at rest, on the readings judged on."""
    errors = []
    for named in evaluation.maps:
        m = next(i for i, candidate in enumerate(evaluation.candidates) if candidate.map is named)
        missed = []
        for judged in evaluation.judged:
            rows = _thinned(judged.run, judged.kept)
            place, yaw, _ = placed(judged.run, evaluation.candidates[m].alignment)
            exact = truth.at_rest(place[rows], yaw[rows])
            missed.append(judged.map_nt[m, rows] - exact)
        error = np.concatenate(missed)
        errors.append(
            TrueError(named.name, _mae(error), float(np.sqrt(np.mean(error**2))), float(np.mean(error)))
        )
    return errors


def steps(evaluation: Evaluation) -> list[int]:
    """Order of models from the paper's configuration on.

    Maps come in order, and on each of them Tolles and Lawson's, the same with gradient terms, then weights.
    On the first map the weights come first.
    """

    def rank(m: int) -> tuple[int, ...]:
        candidate = evaluation.candidates[m]
        place = evaluation.maps.index(candidate.map)
        own = "sha256" in candidate.metadata
        gradient = bool(set(candidate.model.features) & set(GRADIENT))
        aligned = candidate.alignment != Alignment()
        return (place, int(own) if place else int(not own), int(gradient), int(aligned), m)

    return [0, *sorted(range(1, len(evaluation.candidates)), key=rank)]


def _thinned(run: Run, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Numbers of kept readings, at most `BUDGET_HZ` per second."""
    step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else 1.0
    return np.flatnonzero(kept)[:: max(1, round(1 / (step * BUDGET_HZ)))]


def _mae(error: Array) -> float:
    return float(np.mean(np.abs(error)))
