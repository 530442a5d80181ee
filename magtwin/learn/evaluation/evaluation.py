"""Evaluation: errors of several models on recordings that they never saw."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.files.outputs import output
from magtwin.learn.evaluation.candidates import Candidate, NamedMap
from magtwin.learn.evaluation.scores import Errors, Score
from magtwin.report.summary import Summarized, Summary
from magtwin.report.verdict import SEPARATOR, recordings_text, verdict
from magtwin.run.run import Run

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

TOTALS = ("all", "mean")  # Rows of the table that are not paths
GAUSSIAN_MAE = math.sqrt(2 / math.pi)  # Mean absolute error of a normal distribution, in standard deviations


@dataclass(frozen=True, eq=False, repr=False)
class Judged(Summarized):
    """Predictions of M models for a recording of N readings."""

    name: str
    session: str
    path: str
    case: str
    """Row of the table."""

    run: Run
    """The recording, with the columns that a data set keeps."""

    p_xy: Array
    """Measured position of the robot [m], shape (N, 2)."""

    measured_nt: Array
    """Total field at the sensor [nT], shape (N,): the reading, or the exact field if asked for."""

    kept: NDArray[np.bool_]
    """Readings that every model is judged on, shape (N,)."""

    map_nt: Array
    """Each model's map at the place where it assumes the sensor [nT], shape (M, N)."""

    map_sd_nt: Array
    """Standard deviation of the map there [nT], shape (M, N)."""

    total_nt: Array
    """Predicted total field [nT], shape (M, N)."""

    sd_nt: Array
    """Its predicted standard deviation [nT], shape (M, N); nan if there is none."""

    outside: NDArray[np.bool_]
    """Whether an input is outside the training ranges, shape (M, N)."""

    intervals: tuple[str, ...]
    """Which robots the intervals of each model hold for, M texts."""

    def errors(self) -> Errors:
        """Errors on the readings that every model is judged on."""
        kept = self.kept
        return Errors(
            self.session,
            self.case,
            self.run["t"][kept],
            self.total_nt[:, kept] - self.measured_nt[kept],
            self.sd_nt[:, kept],
            self.outside[:, kept],
        )


@dataclass(frozen=True, repr=False)
class Case(Summarized):
    """A row of the table."""

    name: str
    recordings: int
    sessions: int
    scores: tuple[Score, ...]
    """One per model, the baseline first."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Summarized):
    """Errors of several models on recordings that they never saw."""

    candidates: tuple[Candidate, ...]
    """The models, the baseline first."""

    maps: tuple[NamedMap, ...]
    """Their maps, that of the baseline first."""

    cases: tuple[Case, ...]
    """One per path, in the order of the paper's cases and then by name; then "all" readings, and with several
    paths their "mean"."""

    judged: tuple[Judged, ...]
    """One per recording."""

    left_out: Mapping[str, int]
    """Number of readings that not every model can be judged on, by reason."""

    truth: bool = False
    """Whether errors are against the exact field instead of the reading."""

    learned: tuple[str, ...] = ()
    """Training recordings that the baselines are fitted to."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the models."""
        return tuple(candidate.name for candidate in self.candidates)

    @property
    def every(self) -> Case:
        """The case of all readings."""
        return next(case for case in self.cases if case.name == "all")

    def verdicts(self) -> dict[str, str]:
        """One line for each model from a weights file: whether it is better than the baseline."""
        every, sessions = self.every, {recording.session for recording in self.judged}
        naive, paths = every.scores[0].mae_nt, {recording.path for recording in self.judged}
        lines = {}
        for m, (candidate, score) in enumerate(zip(self.candidates, every.scores, strict=True)):
            if m == 0 or "sha256" not in candidate.metadata:
                continue
            learned = [
                None if key not in candidate.metadata else str(candidate.metadata[key]).split(SEPARATOR)
                for key in ("training_sessions", "training_paths")
            ]
            lines[candidate.name] = verdict(
                score.mae_nt,
                naive,
                than=f"the naive model, which uses the map {self.candidates[0].map.name!r}",
                interval=score.ratio_interval,
                coverage=score.coverage,
                intervals=[recording.intervals[m] for recording in self.judged],
                judged_on=recordings_text(len(self.judged), sessions, paths, *learned),
            )
        return lines

    def floor(self, named: NamedMap) -> tuple[float, float]:
        """Error of a map by its own variances: MAE and RMS over the readings judged on [nT].

        No model of the robot can do better, because its inputs do not tell the map's error at a place. nan if
        the map has no variances.
        """
        if named.field.variance_nt2 is None:
            return math.nan, math.nan
        m = next(i for i, candidate in enumerate(self.candidates) if candidate.map is named)
        sd = np.concatenate([recording.map_sd_nt[m, recording.kept] for recording in self.judged])
        return GAUSSIAN_MAE * float(np.mean(sd)), float(np.sqrt(np.mean(sd**2)))

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and texts."""
        return {
            "verdicts": self.verdicts(),
            "errors_against": "b_truth_nt" if self.truth else "b_measured_nt",
            "models": [
                {
                    "name": candidate.name,
                    "map": candidate.map.name,
                    "features": list(candidate.model.features),
                    "lever_arm_m": list(candidate.alignment.lever_arm_m),
                    "latency_s": candidate.alignment.latency_s,
                    "metadata": dict(candidate.metadata),
                }
                for candidate in self.candidates
            ],
            "maps": [
                {
                    "name": named.name,
                    "sha256": sorted(named.checksums),
                    "method": named.field.method,
                    "own_mae_nt": self.floor(named)[0],
                    "own_rms_nt": self.floor(named)[1],
                }
                for named in self.maps
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
                {name: getattr(recording, name) for name in ("name", "session", "path", "case")}
                | {"rows": int(recording.kept.sum())}
                for recording in self.judged
            ],
            "left_out": dict(self.left_out),
        }

    def to_json(self) -> str:
        """`summary` as JSON; numbers that are not finite are null."""
        return json.dumps(_finite(self.summary()), indent=2) + "\n"

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write `to_json` to a file. `magtwin.figures.evaluations` writes a report with pictures.

        Raises:
            InputError: The file exists and `force` was not given.
        """
        with output(path, force=force) as aside:
            aside.write_text(self.to_json(), encoding="utf-8")

    def _summary(self) -> Summary:
        every = self.every
        models = [
            (name, f"MAE {one.mae_nt:.4g} nT, {one.ratio:.3g} of naive, {one.coverage:.0%} in 90 % intervals")
            for name, one in zip(self.names, every.scores, strict=True)
        ]
        return Summary(
            f"Evaluation: {len(self.names) - 1} models, {every.recordings:,} recordings, "
            f"{every.sessions:,} sessions, {every.scores[0].rows:,} readings",
            (*models[1:4], models[0], *models[4:]),
            ("case", *self.names),
            [(case.name, *(f"{score.mae_nt:.4g} nT" for score in case.scores)) for case in self.cases],
        )


def _finite(value: Any) -> Any:
    """The value with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
