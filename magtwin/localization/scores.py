"""Scores: how well a track follows the truth.

Trajectories are never aligned: the frame of a map is absolute.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.localization.bounds import Bounds
from magtwin.localization.problem import Array
from magtwin.localization.track import Track
from magtwin.report.verdict import EVEN
from magtwin.run.thinning import stretches

Flags = NDArray[np.bool_]

NEAR_M = 0.25
"""Error below which a track has converged, once it stays so for `HELD_S` [m]."""

HELD_S = 10.0
"""Time that the error must stay below `NEAR_M` [s]."""

FAR_M = 0.5
"""Error above which a track has diverged, once it stays so for longer than `AWAY_S` [m]."""

AWAY_S = 5.0
"""Time that the error must stay above `FAR_M` [s]."""

SCALE_M = 0.6
"""Distance over which the field of a room changes, for which `NEAR_M` and `FAR_M` hold [m]."""

COVERED = 0.9
"""Probability of the ellipses whose coverage is counted."""

BOUNDS = ("dead_reckoning", "exact", "white", "correlated", "oracle", "smoothed")


@dataclass(frozen=True, kw_only=True, eq=False)
class Scores:
    """Scores of one run. A failed run has nan in all of them.

    Errors count from the first reading if the start was known, else from convergence on; after a kidnapping,
    from recovery on. Where there is no convergence all readings count.
    """

    rmse_m: float = math.nan
    """Root mean square of the position error."""

    median_m: float = math.nan
    """Median of the position error."""

    p95_m: float = math.nan
    """95th percentile of the position error."""

    end_m: float = math.nan
    """Position error at the last reading."""

    heading_rad: float = math.nan
    """Root mean square of the heading error."""

    anees: float = math.nan
    """Average normalised squared error of x, y and yaw per state: 1 if the covariance is right. Lost readings
    do not count."""

    anees_low: float = math.nan
    """Lower end of the central 95 % of `anees` if the covariance is right (`anees_interval`)."""

    anees_high: float = math.nan
    """Upper end of the same."""

    anees_position: float = math.nan
    """As `anees`, of x and y."""

    coverage: float = math.nan
    """Share of true positions within the 90 % ellipse; lost readings do not count."""

    converged_s: float = math.nan
    """Time from the first reading until the error is below 0.25 m for 10 s; nan if never."""

    diverged: bool = False
    """Whether the error that counts was above 0.5 m for more than 5 s."""

    diverged_unflagged: bool = False
    """The same, counting only readings that were not flagged as lost."""

    recovery_s: tuple[float, ...] = ()
    """Time from each kidnapping until the error is below 0.25 m for 10 s; nan if never."""

    false_lost: int = 0
    """How often the track was flagged as lost while its error was below 0.5 m, after convergence."""

    lost_share: float = math.nan
    """Share of readings flagged as lost."""

    step_us: float = math.nan
    """Mean processor time of a step [us]."""

    bound_m: Mapping[str, float] = field(default_factory=dict)
    """Root mean square of each of the `BOUNDS` over the readings that count [m]."""

    failed: str = ""
    """Why the run has no scores; "" if it has."""

    @property
    def ratio(self) -> dict[str, float]:
        """RMSE divided by each bound."""
        return {name: self.rmse_m / bound if bound > 0 else math.nan for name, bound in self.bound_m.items()}

    @property
    def recovered(self) -> int:
        """Number of kidnappings after which the track recovered."""
        return sum(map(math.isfinite, self.recovery_s))

    def row(self) -> dict[str, float | int | bool | str]:
        """All scores by name, as a row of a table. `recovery_s` is the longest, nan if one never ended."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        del plain["bound_m"]
        plain["recovery_s"] = max(self.recovery_s, key=_nan_last, default=math.nan)
        plain |= {"kidnapped": len(self.recovery_s), "recovered": self.recovered}
        plain |= {f"bound_{name}_m": self.bound_m.get(name, math.nan) for name in BOUNDS}
        return plain | {f"ratio_{name}": self.ratio.get(name, math.nan) for name in BOUNDS}


def score(
    track: Track,
    truth_pose: ArrayLike,
    *,
    global_start: bool = False,
    kidnapped_s: Sequence[float] = (),
    bounds: Bounds | None = None,
    scale_m: float = SCALE_M,
) -> Scores:
    """Score a track.

    Args:
        track: Estimates at the readings of a run.
        truth_pose: True x, y [m] and yaw [rad] at the same readings, in the frame of the map, shape (N, 3).
        global_start: Whether the start was unknown.
        kidnapped_s: Times of the first readings after the robot was put elsewhere [s].
        bounds: Bounds of the run.
        scale_m: Distance over which the field changes; errors are near and far in proportion to it.

    Raises:
        InputError: The truth has another shape than the track, or is not finite.
    """
    truth = np.asarray(truth_pose, float)
    if truth.shape != track.pose.shape or not np.isfinite(truth).all():
        raise InputError(f"truth_pose must be finite and of shape {track.pose.shape}, got {truth.shape}")
    near_m, far_m = NEAR_M * (scale_m / SCALE_M), FAR_M * (scale_m / SCALE_M)
    t, off = track.t, track.pose - truth
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    error = np.hypot(off[:, 0], off[:, 1])
    moved = np.unique(np.searchsorted(t, sorted(kidnapped_s))).tolist()
    counted, settled, times = np.zeros(len(t), bool), np.zeros(len(t), bool), []
    for begin, end in pairwise([0, *(k for k in moved if 0 < k < len(t)), len(t)]):
        near = _converged(t[begin:end], error[begin:end], near_m)
        times.append(math.nan if near is None else float(t[begin + near] - t[begin]))
        known = begin == 0 and not global_start
        counted[begin + (0 if known or near is None else near) : end] = True
        settled[begin:end] = counted[begin:end] & (known or near is not None)
    trusted = counted & ~track.lost & np.isfinite(track.covariance).all(axis=(1, 2))
    all_of_it = nees(off, track.covariance, trusted)
    position = nees(off[:, :2], track.covariance[:, :2, :2], trusted)
    low, high = anees_interval(all_of_it, 3)
    begins = track.lost & ~np.concatenate([[False], track.lost[:-1]])
    return Scores(
        rmse_m=_rms(error[counted]),
        median_m=float(np.median(error[counted])),
        p95_m=float(np.percentile(error[counted], 95)),
        end_m=float(error[-1]),
        heading_rad=_rms(off[counted, 2]),
        anees=float(all_of_it.mean()) / 3 if len(all_of_it) else math.nan,
        anees_low=low,
        anees_high=high,
        anees_position=float(position.mean()) / 2 if len(position) else math.nan,
        coverage=float(np.mean(position <= -2 * math.log(1 - COVERED))) if len(position) else math.nan,
        converged_s=times[0],
        diverged=_stays(t, (error > far_m) & counted, AWAY_S),
        diverged_unflagged=_stays(t, (error > far_m) & counted & ~track.lost, AWAY_S),
        recovery_s=tuple(times[1:]),
        false_lost=int(np.count_nonzero(begins & settled & (error < far_m))),
        lost_share=float(track.lost.mean()),
        step_us=1e6 * track.step_s,
        bound_m={} if bounds is None else {name: bounds.rms(name, counted) for name in BOUNDS},
    )


def verdict_of(scores: Scores, dead_m: float, start: str = "") -> str:
    """Judge in one line whether an estimate is better than dead reckoning, consistent, and lost.

    Args:
        scores: Scores of the estimate.
        dead_m: RMSE of dead reckoning over the same readings [m].
        start: Where dead reckoning started, if not at the prior.
    """
    sizes = f"{100 * scores.rmse_m:.1f} cm RMSE against {100 * dead_m:.1f} cm"
    less = 1 - scores.rmse_m / dead_m if dead_m > 0 else -math.inf
    name = f"dead reckoning {start}".rstrip()
    if abs(less) <= EVEN:
        words = [f"No better than {name}: {sizes}."]
    elif less > 0:
        words = [f"Better than {name}: {sizes}, {less:.0%} less."]
    else:
        words = [f"WORSE than {name}: {sizes}."]
    size = f"{scores.anees:.2f}" if scores.anees < 1e3 else f"{scores.anees:.0e}"
    figure = f"ANEES {size} per state"
    if scores.lost_share == 1:
        words.append("It flagged all readings as lost, so its covariance is not judged.")
    elif not math.isfinite(scores.anees):
        words.append("Its covariance is unknown." if math.isnan(scores.anees) else "Its covariance is WRONG.")
    elif scores.anees > scores.anees_high:
        words.append(f"TOO CONFIDENT: {figure}, at most {scores.anees_high:.2f} expected.")
    elif scores.anees < scores.anees_low:
        words.append(f"Too cautious: {figure}, at least {scores.anees_low:.2f} expected.")
    else:
        words.append(f"Consistent: {figure}.")
    if not math.isfinite(scores.converged_s) and not scores.diverged:
        words.append(f"It never stayed within {NEAR_M:g} m for {HELD_S:g} s.")
    if scores.diverged:
        flagged = "" if scores.diverged_unflagged else ", and flagged it"
        words.append(f"LOST: its error stayed above {FAR_M:g} m for more than {AWAY_S:g} s{flagged}.")
    elif scores.lost_share > 0:
        words.append(f"Not lost, but flagged so in {scores.lost_share:.0%} of the readings.")
    else:
        words.append("Not lost.")
    return " ".join(words)


def nees(error: ArrayLike, covariance: ArrayLike, rows: Flags | None = None) -> Array:
    """Normalised squared errors e' P^-1 e (Bar-Shalom, Li and Kirubarajan 2001, eq. 5.4.2-3).

    Args:
        error: Errors, shape (N, n).
        covariance: Covariances, shape (N, n, n).
        rows: Flags of the rows to return; default: all.

    Returns:
        Shape (rows,); infinite where an error lies in a direction of no variance.
    """
    e, P = np.asarray(error, float), np.asarray(covariance, float)
    if rows is not None:
        e, P = e[rows], P[rows]
    if not len(e):
        return np.empty(0)
    variance, axes = np.linalg.eigh(P)
    along = np.einsum("nij,ni->nj", axes, e)
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = np.where(along == 0, 0.0, along**2 / np.maximum(variance, 0.0))
    return np.asarray(parts.sum(axis=1))


def anees_interval(squares: Array, states: int, level: float = 0.95) -> tuple[float, float]:
    """Central interval of the mean of normalised squared errors per state, if the covariance is right.

    The sum of M independent ones is chi-square with M n degrees of freedom. Along a track they are not
    independent: M = N / (1 + 2 sum of autocorrelations), summed while pairs of them stay positive (Geyer
    1992, Statistical Science 7(4)).

    Args:
        squares: Normalised squared errors in the order of time, shape (N,).
        states: Number n of states.
        level: Probability of the interval.

    Returns:
        Lower and upper end; nan without finite errors.
    """
    from scipy.special import gammaincinv

    if not len(squares) or not np.isfinite(squares).all():
        return math.nan, math.nan
    freedom = states * independent(squares)
    low, high = 2 * gammaincinv(freedom / 2, [(1 - level) / 2, (1 + level) / 2]) / freedom
    return float(low), float(high)


def independent(values: Array) -> float:
    """Number of independent values that have the variance of the mean of a series; 1 to N."""
    n = len(values)
    v = values - values.mean()
    power = float(v @ v)
    if n < 3 or power == 0:
        return float(n)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(v, size)
    rho = np.fft.irfft(spectrum * spectrum.conj(), size)[:n] / power
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    total = pairs[: ends[0] if len(ends) else len(pairs)].sum()
    return float(np.clip(n / max(2 * total - 1, 1e-9), 1.0, n))


def _converged(t: Array, error: Array, near_m: float) -> int | None:
    """First row from which the error stays below `near_m` for `HELD_S`."""
    for begin, end in stretches(error < near_m).tolist():
        if t[end - 1] - t[begin] >= HELD_S - 1e-9:
            return begin
    return None


def _stays(t: Array, flags: Flags, longer_s: float) -> bool:
    return any(t[end - 1] - t[begin] > longer_s for begin, end in stretches(flags))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _nan_last(value: float) -> float:
    return math.inf if math.isnan(value) else value
