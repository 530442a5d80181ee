"""Leaderboard: what the rows of a benchmark say of each localizer on each scenario, with intervals."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.bench.row import WITHIN_S
from magtwin.bench.statistics import Interval, Paired, bootstrap, paired, rate, rms
from magtwin.errors import InputError

Columns = Mapping[str, NDArray[Any]]
"""Rows of results, as arrays of equal length by name."""

CONSISTENT = (0.8, 1.3)
"""Median ANEES per state that counts as consistent."""

BOUNDS_OF = {
    (False, False): "bound_correlated_m",
    (True, False): "bound_smoothed_m",
    (False, True): "bound_oracle_m",
}
"""Column of the bound that holds for a method, by whether it smooths and whether it has a compensator."""

SHOWN = 0.05
"""p-value below which a difference counts as shown."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A localizer on a scenario, over all runs. Failed runs count in `failed` and in no error."""

    scenario: str
    localizer: str
    runs: int
    failed: int
    rmse_m: Interval | None
    """Root mean square over runs of their RMSE; runs that never converged included."""

    median_m: float
    """Median of the runs' RMSE."""

    median: Interval | None
    """The same with its interval."""

    p95_m: float
    """95th percentile of the runs' RMSE."""

    heading_rad: float
    """Root mean square of the heading error."""

    bound_m: float
    """Root mean square of the bound in `BOUNDS_OF` over the same runs; nan if no bound holds."""

    median_bound_m: float
    """Median of the same bound over the runs."""

    anees: Interval
    """Median over runs of the ANEES per state, with the quartiles: one lost run would carry a mean."""

    anees_inside: float
    """Share of runs whose ANEES lies in its own central 95 % interval (`Scores.anees_low`, `anees_high`)."""

    coverage: float
    """Mean over runs of the share of true positions within the 90 % ellipse."""

    diverged: Interval
    """Rate of runs that diverged, failed runs included."""

    converged: Interval | None
    """Rate of runs converged within `WITHIN_S`; None if the start was known."""

    first_fix_s: float
    """Median time to convergence of the runs that converged [s]; nan if none did or the start was known."""

    recovered: Interval | None
    """Rate of kidnappings after which the localizer recovered; None without kidnappings."""

    lost_share: float
    """Mean share of readings that were flagged as lost."""

    step_us: float
    """Median processor time of a step [us]; nan if unknown."""

    @property
    def ratio(self) -> float:
        """RMSE divided by the bound."""
        return self.rmse_m.value / self.bound_m if self.rmse_m and self.bound_m > 0 else math.nan

    def verdict(self) -> str:
        """What a reader must know before trusting the numbers; "" if nothing."""
        parts = []
        if self.failed:
            parts.append(f"{self.failed} of {self.runs} runs failed")
        if self.diverged.value > 0.01 and self.failed < self.runs:
            parts.append(f"diverges in {100 * self.diverged.value:.0f} % of runs")
        low, high = CONSISTENT
        ratio = math.sqrt(self.anees.value)
        if self.anees.value > high:
            parts.append(f"too sure of itself: errors are {ratio:.1f} times its sd (median run)")
        elif self.anees.value < low:
            parts.append(f"too cautious: errors are {ratio:.2f} of its sd (median run)")
        return "; ".join(parts)


def standings(
    rows: Columns, times: Columns | None = None, compensated: Collection[str] = ()
) -> list[Standing]:
    """The standing of every localizer on every scenario, in the order of the rows.

    Args:
        rows: Rows of results.
        times: Processor times of the same runs.
        compensated: Localizers with a compensator: they know more than the bound of the others assumes.
    """
    made = []
    for scenario in dict.fromkeys(rows["scenario"].tolist()):
        here = rows["scenario"] == scenario
        for localizer in dict.fromkeys(rows["localizer"][here].tolist()):
            mine = here & (rows["localizer"] == localizer)
            cost = math.nan
            if times is not None:
                spent = times["step_us"][(times["scenario"] == scenario) & (times["localizer"] == localizer)]
                cost = float(np.nanmedian(spent)) if np.isfinite(spent).any() else math.nan
            own = {k: v[mine] for k, v in rows.items()}
            made.append(_standing(scenario, localizer, own, cost, localizer in compensated))
    return made


def _standing(scenario: str, localizer: str, rows: Columns, step_us: float, compensated: bool) -> Standing:
    good = (rows["status"] == "ok") & np.isfinite(rows["rmse_m"])
    count = len(good)
    errors, sessions = rows["rmse_m"][good], rows["session"][good]
    diverged = int(np.count_nonzero(rows["diverged"] | ~good))
    unknown_start = bool(rows["global_start"].any())
    kidnaps = int(rows["kidnapped"].sum())
    converged = int(np.count_nonzero(good & (rows["converged_s"] <= WITHIN_S)))
    bound = BOUNDS_OF.get((bool(rows["smoother"].any()), compensated))
    anees, known = rows["anees"][good], ~np.isnan(rows["anees"][good])
    inside = (rows["anees_low"][good] <= anees) & (anees <= rows["anees_high"][good])
    return Standing(
        scenario=scenario,
        localizer=localizer,
        runs=count,
        failed=int(np.count_nonzero(rows["status"] != "ok")),
        rmse_m=bootstrap(errors, sessions, rms, resamples=1000) if len(errors) else None,
        median_m=float(np.median(errors)) if len(errors) else math.nan,
        median=bootstrap(errors, sessions, _median, resamples=1000) if len(errors) else None,
        p95_m=float(np.percentile(errors, 95)) if len(errors) else math.nan,
        heading_rad=_rms(rows["heading_rad"][good]),
        bound_m=math.nan if bound is None else _rms(rows[bound][good]),
        median_bound_m=math.nan if bound is None else _median(rows[bound][good]),
        anees=_quartiles(anees),
        anees_inside=_mean(inside[known]),
        coverage=_mean(rows["coverage"][good]),
        diverged=rate(diverged, count),
        converged=rate(converged, count) if unknown_start else None,
        first_fix_s=_median(rows["converged_s"][good]) if unknown_start else math.nan,
        recovered=rate(int(rows["recovered_in_time"].sum()), kidnaps) if kidnaps else None,
        lost_share=_mean(rows["lost_share"][good]),
        step_us=step_us,
    )


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Two localizers, or one in two results, on the same runs of a scenario."""

    scenario: str
    a: str
    b: str
    runs: int
    """Runs that both finished."""

    failed_a: int
    failed_b: int
    rmse_m: Paired
    """RMSE of a minus that of b."""

    @property
    def verdict(self) -> str:
        """Which is better, in words."""
        if self.rmse_m.p >= SHOWN:
            return "no difference shown"
        better, worse = ("B", "A") if self.rmse_m.difference > 0 else ("A", "B")
        if self.a != self.b:
            better, worse = {"A": self.a, "B": self.b}[better], {"A": self.a, "B": self.b}[worse]
        return f"{better} is better than {worse}"


def compare_rows(
    a: Columns, b: Columns, *, localizers: Sequence[tuple[str, str]] | None = None
) -> list[Difference]:
    """Paired differences between results on the same runs.

    Args:
        a: Rows of results.
        b: Rows of other results of the same suite and seeds, or the same rows.
        localizers: Pairs of names, of a and of b. Default: each name that is in both.

    Raises:
        InputError: They share no run.
    """
    if localizers is None:
        shared = [
            name for name in dict.fromkeys(a["localizer"].tolist()) if name in set(b["localizer"].tolist())
        ]
        localizers = [(name, name) for name in shared]
    made = []
    for scenario in dict.fromkeys(a["scenario"].tolist()):
        for first, second in localizers:
            one, other = (_by_seed(rows, scenario, name) for rows, name in ((a, first), (b, second)))
            seeds = sorted(one.keys() & other.keys())
            if not seeds:
                continue
            values = np.array([(one[s][0], other[s][0]) for s in seeds])
            good = np.isfinite(values).all(axis=1)
            sessions = np.array([one[s][1] for s in seeds])
            if not good.any():
                continue
            made.append(
                Difference(
                    scenario=scenario,
                    a=first,
                    b=second,
                    runs=int(good.sum()),
                    failed_a=int(np.isnan(values[:, 0]).sum()),
                    failed_b=int(np.isnan(values[:, 1]).sum()),
                    rmse_m=paired(values[good, 0], values[good, 1], sessions[good]),
                )
            )
    if not made:
        raise InputError("the results share no scenario, localizer and seed; run both with the same suite")
    return made


def _by_seed(rows: Columns, scenario: str, localizer: str) -> dict[int, tuple[float, int]]:
    mine = (rows["scenario"] == scenario) & (rows["localizer"] == localizer)
    return {
        int(seed): (float(error), int(session))
        for seed, error, session in zip(
            rows["seed"][mine], rows["rmse_m"][mine], rows["session"][mine], strict=True
        )
    }


def letters(rows: Columns, here: Sequence[Standing]) -> dict[str, str]:
    """Letters by localizer of a scenario: two share one if no difference of their RMSE was shown.

    In the order of their medians, each letter is a stretch of localizers of which no two differ.

    Args:
        rows: Rows of results.
        here: Standings of one scenario.
    """
    known = [s for s in here if s.rmse_m is not None]
    names = [s.localizer for s in sorted(known, key=lambda s: s.median_m)]
    if not names:
        return {}
    pairs = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :]]
    mine = {name: values[rows["scenario"] == here[0].scenario] for name, values in rows.items()}
    found = compare_rows(mine, mine, localizers=pairs) if pairs else []
    differ = {(d.a, d.b) for d in found if d.rmse_m.p < SHOWN}
    made, last = dict.fromkeys(names, ""), 0
    for k in range(len(names)):
        end = k + 1
        while end < len(names) and not any((a, names[end]) in differ for a in names[k:end]):
            end += 1
        if end > last:  # not within the stretch before
            letter = chr(ord("a") + len(set("".join(made.values()))))
            for name in names[k:end]:
                made[name] += letter
            last = end
    return made


def _median(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _rms(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def _mean(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


def _quartiles(values: NDArray[Any]) -> Interval:
    """Median and quartiles of the finite values."""
    known = values[np.isfinite(values)]
    return Interval(*np.percentile(known, (50, 25, 75)).tolist()) if len(known) else Interval(*[math.nan] * 3)
