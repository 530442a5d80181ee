"""Comparison: two runs aligned, and their differences in pose and field."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import wrap_angle, yaw_from_quat
from magtwin.report.report import key
from magtwin.report.summary import Summarized, Summary
from magtwin.run.figures import UNMODELLED, prediction_nt
from magtwin.run.run import Run

Array = NDArray[np.float64]
Align = Literal["time", "path", "none"]

POSITIONS = ("p_world_base", "mocap_p", "odom_p")
"""Columns of position, best first; the first one in both runs is compared."""

HEADINGS = {"p_world_base": "q_world_base_xyzw", "mocap_p": "mocap_q_xyzw", "odom_p": "odom_q_xyzw"}
"""Orientation column of each."""

FIELDS = ("b_measured_nt", "b_total_nt", "b_truth_nt", "b_map_nt", "b_disturbance_nt")
"""Columns of the field that are compared if both runs have them."""

GRID = 4000
"""Grid points at which two runs are compared to find their shift."""

LEAST_OVERLAP = 0.5
"""Fraction of the shorter run that must overlap the longer one."""

SAME_M = 0.01
"""RMS distances that differ by less count as equal, and the longer overlap wins [m]."""

STEP_M = 0.01
"""Step in which driven length is measured, so that noise of a standing robot adds nothing [m]."""

GAP_S, GAP_M = 1.0, 0.25
"""Gaps between readings that are not interpolated [s], [m]."""


@dataclass(frozen=True)
class Agreement:
    """Difference of one quantity between two runs, B - A."""

    name: str
    unit: str
    count: int
    """Readings at which both are known."""
    mean: float
    rms: float
    mae: float
    """Mean absolute difference."""
    greatest: float
    """Greatest absolute difference."""
    correlation: float | None = None
    """Pearson correlation of the two quantities; None if only their difference is known."""


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Summarized):
    """Run B aligned to run A, at the readings of A that B covers."""

    align: Align
    shift: float
    """Added to B's clock [s], or driven length [m], to align it to A."""

    at: Array
    """Time on A's clock [s], or driven length of A [m], shape (N,)."""

    rows: NDArray[np.intp]
    """Rows of A, shape (N,)."""

    along_m: Array
    """B's position ahead of A's, along A's heading [m], shape (N,); empty without poses."""

    cross_m: Array
    """B's position to the left of A's [m], shape (N,); empty without poses."""

    heading_rad: Array
    """B's heading less A's, in [-pi, pi) [rad], shape (N,); empty without headings."""

    fields: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    """Columns of A and of B at these readings [nT], each of shape (N,)."""

    @property
    def unit(self) -> str:
        """Unit of `at` and `shift`."""
        return "m" if self.align == "path" else "s"

    def agreements(self) -> tuple[Agreement, ...]:
        """Differences of each quantity that is known in both runs."""
        poses = (
            ("along-track", "m", self.along_m),
            ("cross-track", "m", self.cross_m),
            ("heading", "deg", np.degrees(self.heading_rad)),
        )
        differences = [agreement(*pose) for pose in poses]
        fields = self.fields.items()
        differences += [agreement(name, "nT", b - a, _correlation(a, b)) for name, (a, b) in fields]
        return tuple(difference for difference in differences if difference is not None)

    def summary(self) -> dict[str, Any]:
        """The comparison as plain data, for JSON."""
        return {
            "align": self.align,
            "shift": self.shift,
            "shift_unit": self.unit,
            "readings": len(self.at),
            "agreements": {
                key(a.name): {k: v for k, v in vars(a).items() if k != "name" and v is not None}
                for a in self.agreements()
            },
        }

    def _summary(self) -> Summary:
        """The alignment, and the difference of each quantity."""
        agreements = [
            (a.name, f"mean {a.mean:.4g}, rms {a.rms:.4g}, largest {a.greatest:.4g} {a.unit}")
            for a in self.agreements()
        ]
        shifted = f"by {self.align}, B shifted by {self.shift:.4g} {self.unit}"
        by = "as they are" if self.align == "none" else shifted
        return Summary(f"Comparison: {len(self.at):,} readings of A, aligned {by}", tuple(agreements))


DRAWN = "b_model_error_nt"

ERRORS: Mapping[str, tuple[str, tuple[str, ...], str]] = MappingProxyType(
    {
        "map": ("b_map_nt", ("b_truth_nt",), "error of the map at the sensor"),
        "disturbance": (
            "b_total_nt",
            (UNMODELLED, "b_truth_nt"),
            "error of the prediction, map plus network",
        ),
        "model error": (DRAWN, (), "error drawn for the network's prediction"),
        "noise": ("b_measured_nt", ("b_total_nt", DRAWN), "noise of the sensor"),
        "total": ("b_measured_nt", ("b_truth_nt",), "error of the reading"),
    }
)
"""Errors by source: a column, the columns subtracted from it, and the meaning. Runs may lack
`b_model_error_nt` and `b_unmodelled_nt`, which are then 0."""


def terms_of(run: Run, name: str) -> tuple[str, ...]:
    """The column of an error of `ERRORS`, and the columns that are subtracted from it in a run."""
    seen, others, _ = ERRORS[name]
    return seen, *(other for other in others if other not in (DRAWN, UNMODELLED) or other in run)


def errors_of(run: Run) -> dict[str, Agreement]:
    """The known errors of a run, by the names of `ERRORS`."""
    errors = {}
    for name in ERRORS:
        seen, *others = terms_of(run, name)
        if not {seen, *others} <= set(run) or (seen == DRAWN and not run[DRAWN].any()):
            continue
        first = run[seen]
        if name == "disturbance":
            first, others = prediction_nt(run), [other for other in others if other != UNMODELLED]
        error = agreement(name, "nT", sum((-run[other] for other in others), first))
        if error is not None:
            errors[name] = error
    return errors


def compare(a: Run, b: Run, *, align: Align = "time") -> Comparison:
    """Align run B to run A and take their differences.

    By time, B's clock is shifted by the offset tau that minimises the mean square distance of the positions,
    sum |p_A(t) - p_B(t - tau)|^2 / n over the overlap: first by cross-correlation on a grid, then by
    Gauss-Newton steps. By path, driven length takes the place of time, so that runs of different speeds are
    compared place by place. B is interpolated linearly.

    Args:
        a: The reference run; differences are given at its readings and in its axes.
        b: The other run.
        align: "time", "path", or "none" for unshifted clocks.

    Raises:
        InputError: A run has fewer than two readings, nothing can be compared, or the runs do not overlap.
    """
    for name, run in (("first", a), ("second", b)):
        if run.rows < 2:
            raise InputError(f"the {name} run has {run.rows} readings; two or more are needed to compare")
        if "t" not in run or not (np.diff(run["t"]) > 0).all():
            raise InputError(f"the {name} run has no time that ascends from reading to reading")
    position = next((name for name in POSITIONS if _known(a, name) and _known(b, name)), None)
    if position is None and align != "none":
        raise InputError(
            f"runs are aligned by their positions, and no column of {', '.join(POSITIONS)} is known in both; "
            "compare them with unshifted clocks (align none)"
        )
    fields = [name for name in FIELDS if name in a and name in b]
    if position is None and not fields:
        raise InputError(
            f"nothing to compare: neither a position nor a field of {', '.join(FIELDS)} is in both"
        )
    track_a, track_b = _Track.of(a, position, align, "first"), _Track.of(b, position, align, "second")
    shift = 0.0 if position is None or align == "none" else _shift(track_a, track_b)
    wanted = track_a.place - shift
    over = (wanted >= track_b.place[0]) & (wanted <= track_b.place[-1])
    after = np.clip(np.searchsorted(track_b.place, wanted), 1, len(track_b.place) - 1)
    over &= np.diff(track_b.place)[after - 1] <= (GAP_M if align == "path" else GAP_S)
    if np.count_nonzero(over) < 2:
        unit = "m" if align == "path" else "s"
        spans = [f"{track.place[0]:g} to {track.place[-1]:g} {unit}" for track in (track_a, track_b)]
        advice = "; align them by time, which finds the offset" if align == "none" else ""
        raise InputError(f"the runs do not overlap: {spans[0]} and {spans[1]}{advice}")
    rows, wanted = track_a.rows[over], wanted[over]
    along = cross = heading = np.empty(0)
    if position is not None:
        x, y = (track_b.at(wanted, b[position][:, k]) - a[position][rows, k] for k in (0, 1))
        yaw_a, yaw_b = _yaw(a, position), _yaw(b, position)
        if yaw_a is not None and yaw_b is not None:
            turned = np.interp(wanted, track_b.place, np.unwrap(yaw_b[track_b.rows]))
            heading = wrap_angle(turned - yaw_a[rows])
        facing = _direction(a, position)[rows] if yaw_a is None else yaw_a[rows]
        along, cross = (x * np.cos(facing) + y * np.sin(facing), y * np.cos(facing) - x * np.sin(facing))
    seen = {name: (a[name][rows], track_b.at(wanted, b[name])) for name in fields}
    return Comparison(align, shift, track_a.place[over], rows, along, cross, heading, seen)


@dataclass(frozen=True, eq=False)
class Traversals:
    """One path driven twice, as in Figure 8 of the paper, with and without alignment."""

    a: Run
    b: Run
    """Both start at 0 s."""

    recorded: Comparison
    """Compared by time since the start."""

    timed: Comparison
    """B's clock shifted so that the positions are closest."""

    placed: Comparison
    """Compared place by place."""

    def summary(self) -> dict[str, Any]:
        """The three comparisons as plain data, for JSON."""
        return {name: getattr(self, name).summary() for name in ("recorded", "timed", "placed")}


def traversals(a: Run, b: Run) -> Traversals:
    """Compare two drives of one path, with and without alignment.

    Two robots at different speeds drift apart, so their fields differ at equal times even if each is right at
    its place. Alignment by path compares them place by place.
    """
    a, b = (run.with_columns(t=run["t"] - run["t"][0]) if run.rows else run for run in (a, b))
    recorded, timed = compare(a, b, align="none"), compare(a, b, align="time")
    return Traversals(a, b, recorded, timed, compare(a, b, align="path"))


@dataclass(frozen=True, eq=False)
class _Track:
    """The readings of a run that can be aligned, in order of their place."""

    rows: NDArray[np.intp]
    place: Array
    """Time [s] or driven length [m] of each, ascending."""
    p_xy: Array
    """Position of each [m], shape (N, 2), or (N, 0) without positions."""

    @classmethod
    def of(cls, run: Run, position: str | None, align: Align, which: str) -> "_Track":
        if position is None:
            return cls(np.arange(run.rows), run["t"], np.empty((run.rows, 0)))
        p_xy = run[position][:, :2]
        rows = np.flatnonzero(np.isfinite(p_xy).all(axis=1))
        place = run["t"][rows]
        if align == "path":
            place = driven_m(p_xy[rows])
            on = np.diff(place, prepend=-1.0) > 0
            rows, place = rows[on], place[on]
        if len(rows) < 2:
            still = f"its robot moves no {STEP_M:g} m; align by time"
            what = still if align == "path" else "its positions are unknown"
            raise InputError(f"the {which} run cannot be aligned: {what}")
        return cls(rows, place, p_xy[rows])

    def at(self, place: Array, values: NDArray[Any]) -> Array:
        """A column, interpolated linearly."""
        return np.interp(place, self.place, values[self.rows])


def driven_m(p_xy: Array) -> Array:
    """Driven length at each position, measured in steps of `STEP_M`.

    Args:
        p_xy: Positions in order of time [m], shape (N, 2).

    Returns:
        Length [m], shape (N,); interpolated over the readings of a step.
    """
    corners, (x0, y0) = [0], p_xy[0].tolist()
    for i, (x, y) in enumerate(p_xy.tolist()):
        if (x - x0) ** 2 + (y - y0) ** 2 >= STEP_M**2:
            corners.append(i)
            x0, y0 = x, y
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p_xy[corners], axis=0).T))])
    return np.interp(np.arange(len(p_xy)), corners, length)


def _shift(a: _Track, b: _Track) -> float:
    """Shift of B's places that aligns its positions to A's."""
    span = max(a.place[-1] - a.place[0], b.place[-1] - b.place[0])
    step = span / GRID
    curve_a, curve_b = (_on_grid(track, step) for track in (a, b))
    lag = _best_lag(curve_a, curve_b, math.hypot(*np.ptp(a.p_xy, axis=0)))
    shift = float(a.place[0] - b.place[0]) + lag * step
    for _ in range(8):
        wanted = a.place - shift
        over = (wanted >= b.place[0]) & (wanted <= b.place[-1])
        if np.count_nonzero(over) < 2:
            break
        behind, there, ahead = (
            np.column_stack([np.interp(wanted[over] + d, b.place, b.p_xy[:, k]) for k in (0, 1)])
            for d in (-step, 0.0, step)
        )
        slope = (ahead - behind) / (2 * step)
        steepness = float((slope**2).sum())
        if steepness < 1e-12:
            break
        move = float(((there - a.p_xy[over]) * slope).sum()) / steepness
        shift += float(np.clip(move, -2 * step, 2 * step))
        if abs(move) < 1e-9 * span:
            break
    return shift


def _on_grid(track: _Track, step: float) -> Array:
    """Positions at equal steps, shape (N, 2)."""
    count = int((track.place[-1] - track.place[0]) / step + 1e-9) + 1
    places = track.place[0] + step * np.arange(count)
    return np.column_stack([np.interp(places, track.place, track.p_xy[:, k]) for k in (0, 1)])


def _best_lag(a: Array, b: Array, size_m: float) -> int:
    """Lag of B in grid points at which the mean square distance is least.

    sum |a_i - b_(i-k)|^2 = sum |a_i|^2 + sum |b_j|^2 - 2 sum a_i . b_(i-k), the last by FFT.
    """
    from scipy import signal  # takes half a second

    centre = a.mean(axis=0)  # avoids cancellation
    a, b = a - centre, b - centre
    lags = np.arange(-(len(b) - 1), len(a))
    cross = sum(signal.correlate(a[:, k], b[:, k], method="fft") for k in (0, 1))
    first, last = np.maximum(lags, 0), np.minimum(lags + len(b), len(a))  # rows of A under B
    squares = [np.concatenate([[0.0], np.cumsum((curve**2).sum(axis=1))]) for curve in (a, b)]
    total = squares[0][last] - squares[0][first] + squares[1][last - lags] - squares[1][first - lags]
    count = last - first
    rms = np.sqrt(np.maximum(total - 2 * cross, 0.0) / count)
    rms[count < LEAST_OVERLAP * min(len(a), len(b))] = np.inf
    good = np.flatnonzero(rms <= rms.min() + min(SAME_M, 0.01 * size_m))
    best = good[count[good] == count[good].max()]
    return int(lags[best[np.argmin(rms[best])]])


def _yaw(run: Run, position: str) -> Array | None:
    """Heading [rad], shape (N,); None if unknown."""
    if position == "p_world_base" and _known(run, "yaw"):
        return run["yaw"]
    name = HEADINGS[position]
    return yaw_from_quat(run[name]) if _known(run, name) else None


def _direction(run: Run, position: str) -> Array:
    """Direction of travel [rad], shape (N,), for runs without a heading."""
    step = np.gradient(run[position][:, :2], axis=0)
    return np.arctan2(step[:, 1], step[:, 0])


def _known(run: Run, name: str) -> bool:
    """Whether a column exists and is finite in some row."""
    return name in run and bool(np.isfinite(run[name]).reshape(run.rows, -1).all(axis=1).any())


def agreement(name: str, unit: str, difference: Array, correlation: float | None = None) -> Agreement | None:
    """Statistics of a difference; None if it is nowhere known."""
    known = difference[np.isfinite(difference)]
    if not len(known):
        return None
    size = np.abs(known)
    mean, rms = float(known.mean()), float(np.sqrt(np.mean(known**2)))
    return Agreement(name, unit, len(known), mean, rms, float(size.mean()), float(size.max()), correlation)


def _correlation(a: Array, b: Array) -> float | None:
    """Pearson correlation where both are known; None if one is constant."""
    known = np.isfinite(a) & np.isfinite(b)
    if np.count_nonzero(known) < 3 or min(np.ptp(a[known]), np.ptp(b[known])) == 0:
        return None
    return float(np.corrcoef(a[known], b[known])[0, 1])
