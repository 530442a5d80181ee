"""Verdict: a judgement of a magnetometer model in one plain line."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

EVEN = 0.03
"""Relative difference of errors below which two models count as equal, if no interval is known."""

HOLDS = (0.8, 0.97)
"""Bounds of the share of readings within 90 % intervals. Beyond them, they are too narrow or too wide."""

Z_90 = 1.6448536269514722
"""Half the width of the 90 % interval of a normal distribution, in standard deviations."""

HOLDS_ONE = (0.5, 1.0)
"""The same bounds for readings of one session, whose errors share an offset: with an offset of two standard
deviations, the share is 70 %."""

OWN = "for the robot of its training"
OTHERS = "for robots that it was not trained on"
ONLY_OWN = f"{OWN}, the only ones that it has,"
OF_DRIVE = "for the session of its calibration"
"""Which robots the intervals of a model hold for."""

SEPARATOR = ", "
"""Between the names of sessions and paths in the metadata of weights."""


def coverage(error_nt: NDArray[Any], sd_nt: NDArray[Any]) -> float:
    """Share of readings whose error is within its 90 % interval; nan if no standard deviation is known."""
    known = np.isfinite(sd_nt) & np.isfinite(error_nt)
    return float(np.mean(np.abs(error_nt[known]) <= Z_90 * sd_nt[known])) if known.any() else math.nan


def verdict(
    mae_nt: float,
    naive_mae_nt: float,
    *,
    than: str = "the naive mean",
    measure: str = "mean error",
    interval: tuple[float, float] | None = None,
    coverage: float = math.nan,
    holds: tuple[float, float] = HOLDS,
    intervals: Collection[str] = (),
    judged_on: str = "",
) -> str:
    """Judge in one line whether a model is better than a naive one, and whether its intervals hold.

    Args:
        mae_nt: Mean absolute error of the model [nT].
        naive_mae_nt: Mean absolute error of the naive model on the same readings [nT].
        than: Name of the naive model.
        measure: Name of the two errors, if they are others than mean absolute ones.
        interval: Confidence interval of the ratio of the two errors. The models count as equal if it contains
            1; without an interval, if the ratio is within `EVEN` of 1.
        coverage: Share of readings within the model's 90 % intervals, 0 to 1; nan if it predicts none.
        holds: Right bounds of `coverage`: `HOLDS`, or `HOLDS_ONE` for one session. Intervals for `OTHERS`
            are meant to hold more on most robots, so they are never too wide.
        intervals: Which robots its intervals hold for, such as `OWN`.
        judged_on: The evaluated recordings, such as "3 new sessions".

    Returns:
        One line.
    """
    if not (mae_nt >= 0 and naive_mae_nt > 0):
        return "No verdict: no reading has a known error."
    ratio = mae_nt / naive_mae_nt
    least, most = ratio - EVEN, ratio + EVEN
    if interval is not None and all(map(math.isfinite, interval)):
        least, most = interval
    sizes = f"{measure} {mae_nt:,.0f} nT against {naive_mae_nt:,.0f} nT, a ratio of {ratio:.2f}"
    if most < 1:
        text = f"Better than {than}: {sizes}."
    elif least > 1:
        text = f"WORSE than {than}: {sizes}."
    else:
        text = f"No better than {than}: {sizes}."
    if not math.isnan(coverage):
        whose = " and ".join(dict.fromkeys(intervals))
        text += f" Its 90 % intervals {whose} hold" if whose else " Its 90 % intervals hold"
        text += f" {coverage:.0%} of the readings"
        if coverage < holds[0]:
            text += ": they are TOO NARROW"
        elif coverage > holds[1] and OTHERS not in intervals:
            text += ": they are too wide"
        text += "."
    return f"{text} Judged on {judged_on}." if judged_on else text


@dataclass
class Tally:
    """Sums of the errors of a model and of the naive one over runs."""

    than: str = "the naive mean"
    """Name of the naive model."""

    readings: int = 0
    error_nt: float = 0.0
    naive_nt: float = 0.0
    within: int = 0
    with_sd: int = 0
    intervals: list[str] = field(default_factory=list)
    """Which robots the model's intervals hold for, of each kind of run once."""

    def add(
        self, error_nt: NDArray[Any], naive_error_nt: NDArray[Any], sd_nt: NDArray[Any], intervals: str = OWN
    ) -> None:
        """Add the readings of a run, arrays of shape (N,); readings without a known error are left out."""
        known = np.isfinite(error_nt) & np.isfinite(naive_error_nt)
        self.intervals = list(dict.fromkeys([*self.intervals, intervals]))
        error, sd = np.abs(error_nt[known]), sd_nt[known]
        self.readings += len(error)
        self.error_nt += float(error.sum())
        self.naive_nt += float(np.abs(naive_error_nt[known]).sum())
        self.with_sd += int(np.isfinite(sd).sum())
        self.within += int(np.count_nonzero(error <= Z_90 * sd))

    def extend(self, other: "Tally") -> None:
        """Add the sums of other runs."""
        for name in ("readings", "error_nt", "naive_nt", "within", "with_sd"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.intervals = list(dict.fromkeys([*self.intervals, *other.intervals]))
        self.than = other.than if other.readings else self.than

    def verdict(self, judged_on: str, *, holds: tuple[float, float] = HOLDS) -> str:
        """The verdict; "" if no reading was added."""
        if not self.readings:
            return ""
        held = self.within / self.with_sd if self.with_sd else math.nan
        error, naive = self.error_nt / self.readings, self.naive_nt / self.readings
        options: Any = {"holds": holds, "intervals": self.intervals, "judged_on": judged_on}
        return verdict(error, naive, than=self.than, coverage=held, **options)


def recordings_text(
    recordings: int,
    sessions: Collection[str],
    paths: Collection[str],
    learned_sessions: Collection[str] | None,
    learned_paths: Collection[str] | None,
) -> str:
    """The evaluated recordings, and how many of their sessions and paths were not in the training.

    Args:
        recordings: Number of recordings.
        sessions: Their sessions.
        paths: Their paths.
        learned_sessions: Sessions of the training; None if unknown.
        learned_paths: Paths of the training; None if unknown.
    """
    sessions, paths = set(sessions), set(paths)
    text = f"{recordings} recordings"
    if learned_sessions is None or learned_paths is None:
        of = f"{len(sessions)} sessions and {len(paths)} paths"
        return f"{text} of {of}; the weights do not say what they were trained on"
    new_sessions, new_paths = len(sessions - set(learned_sessions)), len(paths - set(learned_paths))
    new = f"{new_sessions} of {len(sessions)} sessions and {new_paths} of {len(paths)} paths"
    return f"{text}; {new} are new to it"
