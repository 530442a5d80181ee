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
from magtwin.learn.evaluation.candidates import Candidate, Mean, aligned_runs
from magtwin.learn.evaluation.evaluation import Evaluation
from magtwin.report.summary import Summarized
from magtwin.run.run import Run
from magtwin.sim.interference import level_field_nt, platform_field_nt, sensor_places
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

TERMS = ("map", "lever arm", "latency", "sessions", "platform", "sensor")
"""The parts of an error, in the order in which they are closed."""

_OTHERS = [k for k, term in enumerate(TERMS) if term != "platform"]

PENALTY = 1e-3  # Penalty of the ridge for the expectations, relative to the curvature of the rows
BUDGET_HZ = 20.0  # Highest rate of readings in a budget [Hz]; their exact field takes time


@dataclass(frozen=True, repr=False)
class Budget(Summarized):
    """A model's error by its causes."""

    name: str
    """Name of the model."""

    mae_nt: float

    left_nt: tuple[float, ...]
    """MAE with each of `TERMS` closed, and all before it [nT]."""

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and texts."""
        terms = [
            {"name": name, "mae_closed_in_turn_nt": left}
            for name, left in zip(TERMS, self.left_nt, strict=True)
        ]
        return {"model": self.name, "mae_nt": self.mae_nt, "terms": terms}


class Truth:
    """Exact fields of a twin along a run, and their parts of a model's error."""

    def __init__(self, surveyed: Scene, scene_of: Callable[[str, Run], Scene]) -> None:
        """Use a scene with its robot as in the survey, and that with its robot as in the session of a run."""
        self.surveyed, self.scene_of = surveyed, scene_of
        self._exact: dict[tuple[str, Alignment | None], Array] = {}

    def parts(
        self, name: str, run: Run, rows: NDArray[np.intp], map_nt: Array, alignment: Alignment, b_nt: Array
    ) -> Array:
        """D1 to D6 of the module, by `TERMS`, shape (6, len(rows)) [nT].

        `map_nt` and `b_nt` are the map at the assumed place of the sensor, and the readings, at these rows. A
        name always stands for the same run and rows. A run without the truth is refused.
        """
        for column in ("p_world_base", "yaw", "b_truth_nt"):
            if column not in run or not np.isfinite(run[column]).any():
                raise InputError(
                    f"{name}: has no {column}, and an error budget needs the truth that only a twin knows; "
                    "leave --scene out"
                )
        if (name, None) not in self._exact:
            pose = run["p_world_base"][rows, :2], run["yaw"][rows]
            both = [at_rest_nt(scene, *pose) for scene in (self.surveyed, self.scene_of(name, run))]
            self._exact[name, None] = np.stack(both)
        if (name, alignment) not in self._exact:
            seen = {"mocap_p", "mocap_q_xyzw"} <= set(run)
            offset = self.scene_of(name, run).robot.mocap.offset_m if seen else (0.0, 0.0)
            poses = [placed(run, each) for each in (alignment, Alignment(offset, alignment.latency_s))]
            fields = [at_rest_nt(self.surveyed, p[rows], yaw[rows]) for p, yaw, _ in poses]
            self._exact[name, alignment] = np.stack(fields)
        places, here = self._exact[name, alignment], self._exact[name, None]
        steps = (map_nt, *places, *here, run["b_truth_nt"][rows], b_nt)
        return np.array([before - after for before, after in itertools.pairwise(steps)])


def at_rest_nt(scene: Scene, p_xy: Array, yaw: Array) -> Array:
    """Exact field magnitude at the magnetometer of a robot at rest with its LiDAR off [nT], shape (N,).

    It is that of `magtwin.sim.at_rest.field_at_rest_nt` within 1e-3 nT; nan if the pose of base_link, (N, 2)
    [m] and (N,) [rad], is nan.
    """
    pose = np.column_stack([p_xy, yaw])
    known = np.isfinite(pose).all(axis=1)
    field = np.full(len(pose), np.nan)
    if known.any():
        place = sensor_places(scene.robot, pose[known])
        b = level_field_nt(scene, place[:, :2], float(place[0, 2]))[0]
        b[:, :2] = into_base(b[:, :2], pose[known, 2])
        field[known] = np.linalg.norm(platform_field_nt(scene.robot.platform, b), axis=1)
    return field


def budget(
    evaluation: Evaluation, m: int, truth: Truth, train: Dataset, names: Sequence[str] | None = None
) -> Budget:
    """Error budget of model `m` of an evaluation: `magtwin.error_budget` for one model.

    The expectations are fitted to the recordings `names` of `train`, by default to all.
    """
    candidate = evaluation.candidates[m]
    inputs = _inputs(candidate, evaluation, train)
    xs, ys = [], []
    for name, run in aligned_runs(train, names, candidate.map.field, candidate.alignment):
        x, rows, b_nt = features(run, inputs), np.arange(run.rows), run["b_measured_nt"]
        exact = truth.parts(f"training {name}", run, rows, run["b_map_nt"], candidate.alignment, b_nt)
        whole = np.isfinite(run["label_nt"]) & np.isfinite(x).all(axis=1) & np.isfinite(exact).all(axis=0)
        xs.append(x[whole])
        ys.append(exact[_OTHERS][:, whole].T)
    expected = _expectation(np.concatenate(xs), np.concatenate(ys))
    errors, parts = [], []
    for judged in evaluation.judged:
        rows = _thinned(judged.run, judged.kept)
        name, map_nt, b_nt = f"judged {judged.name}", judged.map_nt[m, rows], judged.measured_nt[rows]
        part = truth.parts(name, judged.run, rows, map_nt, candidate.alignment, b_nt)
        run = judged.run.take(rows)
        if any("b_map_gradient_nt_m" in FEATURES[name].columns for name in inputs):
            run = labelled(judged.run, candidate.map.field, candidate.alignment).take(rows)
        part[_OTHERS] -= expected(features(run, inputs)).T
        error = judged.total_nt[m, rows] - b_nt
        part[TERMS.index("platform")] = error - part[_OTHERS].sum(axis=0)
        errors.append(error)
        parts.append(part)
    error = np.concatenate(errors)
    left = error - np.cumsum(np.concatenate(parts, axis=1), axis=0)
    return Budget(candidate.name, _mae(error), tuple(map(_mae, left)))


def _expectation(x: Array, y: Array) -> Callable[[Array], Array]:
    """E[y | x] by ridge regression, from rows (N, F) and targets (N, T)."""
    mean, scale, offset = x.mean(axis=0), x.std(axis=0), y.mean(axis=0)
    scale[scale <= 1e-12 * np.maximum(1.0, np.abs(mean))] = 1.0
    z = (x - mean) / scale
    curvature = z.T @ z + PENALTY * len(z) * np.eye(z.shape[1])
    weights = np.linalg.solve(curvature, z.T @ (y - offset))
    return lambda x: np.asarray(offset + (x - mean) / scale @ weights)


def _inputs(candidate: Candidate, evaluation: Evaluation, train: Dataset) -> tuple[str, ...]:
    """Inputs by which a model can have learned a term; none for the naive model."""
    if isinstance(candidate.model, Mean):
        return ()
    able = set(train.columns).intersection(*(set(judged.run) for judged in evaluation.judged))
    able |= {"yaw", "b_map_gradient_nt_m"}
    reads = set(candidate.model.features) & {*GRADIENT, *CARRIED}
    wanted = (*CIRCULAR, *(name for name in (*GRADIENT, *CARRIED) if name in reads))
    return tuple(name for name in wanted if set(FEATURES[name].columns) <= able)


def _thinned(run: Run, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Numbers of kept readings, at most `BUDGET_HZ` per second."""
    step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else 1.0
    return np.flatnonzero(kept)[:: max(1, round(1 / (step * BUDGET_HZ)))]


def _mae(error: Array) -> float:
    return float(np.mean(np.abs(error)))
