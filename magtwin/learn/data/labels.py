"""Labels: what a magnetometer read beyond the map, and how well that is known."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base, wrap_angle, yaw_from_quat
from magtwin.report import Figure, Report
from magtwin.run.run import Column, Run
from magtwin.summary import Summarized, Summary

Array = NDArray[np.float64]

UNUSABLE = ("flag_lost_lock", "flag_pose_lost")
"""Flags of a run whose readings have no label."""

BLOCK_S = 5.0
"""Readings this near in time err alike: the spread of an estimate is taken from blocks of them [s]."""

LATENCIES_S = np.arange(-0.4, 0.41, 0.02)
"""Latencies that are tried before the best one is refined [s]."""

LEAST_ROWS = 200
"""Fewer readings with a label do not tell an alignment."""

LEVER_ARM_PRIOR_M = 0.05
"""How far a sensor is off its place before any run tells, as a standard deviation of each axis [m]."""

LATENCY_PRIOR_S = 0.1
"""How late a reading is before any run tells, as a standard deviation [s]."""

FIT_RATE_HZ = 20.0
"""Readings a second that an alignment is fitted to; more are too alike to tell more."""

SLOPE_S = 0.2
"""Over how long the rates of speed and turning are taken [s]: a motor's torque lasts about so long."""

STARTS = 3
"""Latencies, of those that leave least, that are refined."""

LABEL_COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "label_nt": Column("nT", "", "measured field less the map at the sensor; nan where there is none"),
        "label_sd_nt": Column("nT", "", "how well the map is known there, as a standard deviation"),
    }
)
"""Columns that `labelled` adds to a run beside those that `magtwin.run.run.COLUMNS` has."""


@dataclass(frozen=True, repr=False)
class Alignment(Summarized):
    """Where and when a reading was taken, seen from the pose that bears its stamp."""

    lever_arm_m: tuple[float, float] = (0.0, 0.0)
    """Sensor's place forward and left of where the map has it [m], in base_link's axes."""

    latency_s: float = 0.0
    """How much older the reading is than its stamp, beside the pose's own age [s]."""

    lever_arm_sd_m: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of `lever_arm_m` [m]; 0 where it was given."""

    latency_sd_s: float = 0.0
    """Standard deviation of `latency_s` [s]; 0 where it was given."""

    def __post_init__(self) -> None:
        figures = (*self.lever_arm_m, self.latency_s, *self.lever_arm_sd_m, self.latency_sd_s)
        if not np.all(np.isfinite(figures)):
            raise InputError(f"an alignment must be finite, got {figures}")

    def report(self, title: str = "Alignment") -> Report:
        """Lever arm and latency, with their spreads."""
        arm = [
            Figure(f"lever arm, {way}", value, "m", sd)
            for way, value, sd in zip(("forward", "left"), self.lever_arm_m, self.lever_arm_sd_m, strict=True)
        ]
        return Report(title, (*arm, Figure("latency", self.latency_s, "s", self.latency_sd_s)))

    def _summary(self) -> Summary:
        (x, y), (sx, sy) = self.lever_arm_m, self.lever_arm_sd_m
        return Summary(
            "Alignment",
            (
                ("lever arm", f"{x:.4g} +- {sx:.2g} m forward, {y:.4g} +- {sy:.2g} m left"),
                ("latency", f"{self.latency_s:.4g} +- {self.latency_sd_s:.2g} s"),
            ),
        )


@dataclass(frozen=True, repr=False)
class Labels(Summarized):
    """What each reading of a run says of the disturbance."""

    value_nt: Array
    """Measured field less the map [nT], shape (N,); nan where there is no label."""

    sd_nt: Array
    """How well the map is known there [nT], shape (N,): its own standard deviation, and its gradient times
    what the alignment is uncertain by; 0 of a map without variances."""

    map_nt: Array
    """Map at the sensor's place [nT], shape (N,)."""

    gradient_nt_m: Array
    """What the map changes by there, forward and to the left of base_link [nT/m], shape (N, 2)."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Readings that have a label, shape (N,)."""
        return np.isfinite(self.value_nt)


def labels(run: Run, field: AnomalyMap, alignment: Alignment | None = None) -> Labels:
    """Labels of a run on a map: y = |B|measured - map(p(t - latency) + R(yaw) lever arm, yaw).

    The pose is motion capture's where the run has it, else the true one. A reading has no label off the map
    or on its masked nodes, without lock, without a pose, and where nothing was measured.

    Args:
        run: Needs t, b_measured_nt, and mocap_p with mocap_q_xyzw or p_world_base with yaw.
        field: The map; it need not be the one that the run was simulated with.
        alignment: Lever arm and latency; none where pose and reading belong together as they stand.

    Raises:
        InputError: The run lacks a column.
    """
    alignment = alignment or Alignment()
    p, yaw, rates = placed(run, alignment)
    value, gradient = field.lookup_with_gradient(p, yaw)
    variance = np.zeros(run.rows)
    if field.variance_nt2 is not None:
        spread = dataclasses.replace(
            field, values_nt=np.where(field.valid, field.variance_nt2, 0.0), variance_nt2=None, harmonic=None
        )
        variance = spread.lookup(p, yaw)
    if any(alignment.lever_arm_sd_m) or alignment.latency_sd_s:
        forward, left, late = _slopes(gradient, yaw, rates).T
        sds = (*alignment.lever_arm_sd_m, alignment.latency_sd_s)
        variance = variance + sum((s * g) ** 2 for s, g in zip(sds, (forward, left, late), strict=True))
    usable = np.isfinite(value)
    for flag in UNUSABLE:
        if flag in run:
            usable &= ~run[flag]
    measured = np.where(usable, run["b_measured_nt"], np.nan)
    return Labels(measured - value, np.sqrt(variance), value, into_base(gradient[:, :2], yaw))


def labelled(run: Run, field: AnomalyMap, alignment: Alignment | None = None) -> Run:
    """A run with its labels as columns, and the map that they were made on: one table to learn from.

    label_nt and label_sd_nt are added; b_map_nt, b_map_gradient_nt_m and flag_outside_map become those of
    this map at the sensor's place, so that b_measured_nt = b_map_nt + label_nt. Where motion capture alone
    tells the pose, yaw is taken from it. The arguments are those of `labels`.

    Raises:
        InputError: The run lacks a column, or no reading of it has a label.
    """
    found = labels(run, field, alignment)
    if not found.known.any():
        low_x, high_x, low_y, high_y = field.extent
        p = run["mocap_p"] if "mocap_p" in run else run["p_world_base"]
        lost = np.zeros(run.rows, bool)
        for flag in UNUSABLE:
            lost |= run.get(flag, False)
        seen = [f"{np.nanmin(v):.2f} to {np.nanmax(v):.2f}" for v in p[:, :2].T if np.isfinite(v).any()]
        raise InputError(
            f"none of {run.rows} readings has a label on the map {field.name!r} (x {low_x:g} to {high_x:g}, "
            f"y {low_y:g} to {high_y:g} m): the robot was at x, y {', '.join(seen) or 'unknown'} m, "
            f"{int(np.isfinite(run['b_measured_nt']).sum())} readings hold a field, {int(lost.sum())} had no "
            "lock or no pose; name the map of its lab, in its frame"
        )
    columns: dict[str, NDArray[Any]] = {
        "b_map_nt": found.map_nt,
        "b_map_gradient_nt_m": found.gradient_nt_m,
        "flag_outside_map": np.isnan(found.map_nt),
        "label_nt": found.value_nt,
        "label_sd_nt": np.where(found.known, found.sd_nt, np.nan),
    }
    if "yaw" not in run:
        columns["yaw"] = wrap_angle(yaw_from_quat(run["mocap_q_xyzw"]))
    return run.with_columns(**columns).with_specs(**LABEL_COLUMNS)


def fit_alignment(
    runs: Sequence[Run],
    field: AnomalyMap,
    *,
    lever_arm: bool = True,
    latency: bool = True,
    rounds: int = 20,
    prior_sd: tuple[float, float] = (LEVER_ARM_PRIOR_M, LATENCY_PRIOR_S),
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> Alignment:
    """Lever arm and latency that make readings agree best with a map.

    Least squares on label = c + platform + gradient terms, where c is each run's own, as no day is like
    another, and the gradient terms are the first order of the map in both,

        map(p(t - tau) + R l) = map(p) + (R^T grad B) . l - tau dB/dt,

    relinearised until they stay, from each of the `STARTS` latencies of `LATENCIES_S` that leave least; of
    what they lead to the likeliest is kept. The platform is what is fixed to the robot, seen by its
    heading: iron, turning, speed, their rates, LiDAR and battery current, so that iron is not taken for a
    place, nor the motors' torque before a turn for a latency. The covariance V is that of blocks of
    `BLOCK_S`, whose readings err alike. Along a straight line at one speed a lever arm forward
    and a latency are the same, so each has a weak prior about 0 of covariance P: what is found is
    P (P + V)^-1 of the least squares', which is theirs where the runs tell the two apart, and is shared
    between them, with spreads that say so, where they do not.

    Args:
        runs: Runs of one robot, as for `labels`; they should turn, and drive at more than one speed.
        field: The map.
        lever_arm: Whether the lever arm is fitted; otherwise it is 0.
        latency: Whether the latency is fitted; otherwise it is 0.
        rounds: Relinearisations at most.
        prior_sd: Standard deviations of the prior, of a lever arm [m] and of a latency [s].
        progress: Called as progress(done, total, what), once a linearisation; `total` is the most there are.

    Raises:
        InputError: Fewer than `LEAST_ROWS` readings have a label, or nothing is to be fitted.
    """
    if not (lever_arm or latency):
        raise InputError("neither the lever arm nor the latency is to be fitted; name one")
    if not all(0 < sd < np.inf for sd in prior_sd):
        raise InputError(f"prior_sd must be above 0 and finite, got {prior_sd}")
    known = sum(int(labels(run, field).known.sum()) for run in runs)
    if known < LEAST_ROWS:
        raise InputError(
            f"{known} readings have a label on the map {field.name!r}, too few to fit lever arm and latency: "
            f"it takes {LEAST_ROWS}; do the runs lie on the map?"
        )
    free = np.array([lever_arm, lever_arm, latency])
    prior = np.array([prior_sd[0], prior_sd[0], prior_sd[1]])[free] ** 2
    fit = _Fit(runs, field, free, prior)
    starts = [np.zeros(3)]
    if latency:
        tried = np.zeros((len(LATENCIES_S), 3))
        tried[:, 2] = LATENCIES_S
        left = []
        for k, one in enumerate(tried):
            progress(k, len(tried) + STARTS * rounds, "latencies")
            left.append(fit.at(one).promised)
        starts = [tried[i] for i in np.argsort(left)[:STARTS]]
    fit.alike = fit.at(starts[0]).alike
    before, most = (len(LATENCIES_S) if latency else 0), len(starts) * rounds

    def descended(k: int, start: Array) -> _Linearised:
        done = before + k * rounds
        return _descend(fit, start, rounds, lambda j: progress(done + j, before + most, "rounds"))

    best = min((descended(k, start) for k, start in enumerate(starts)), key=lambda one: one.cost)
    progress(before + most, before + most, "rounds")
    sd = np.zeros(3)
    sd[free] = np.sqrt(np.diag(best.covariance))
    forward, left_of, late = best.place.tolist()
    return Alignment((forward, left_of), late, (float(sd[0]), float(sd[1])), float(sd[2]))


@dataclass(frozen=True)
class _Linearised:
    """The least squares of an alignment about a place (forward, left, latency)."""

    place: Array
    wanted: Array
    """Where they and the prior lead to, shape (3,)."""
    covariance: Array
    """Of the free ones, the prior's part included, from how alike the readings of a block err."""
    cost: float
    """Twice the negative logarithm of the posterior of the place, but for a constant."""
    promised: float
    """Mean square that would be left where the least squares lead to [nT^2]."""
    alike: float
    """How many readings err as one."""


def _descend(fit: "_Fit", start: Array, rounds: int, told: Callable[[int], Any]) -> _Linearised:
    """The alignment that is reached from another, step by step; a step that leads up is halved."""
    here = fit.at(start)
    for k in range(rounds):
        told(k)
        step = here.wanted - here.place
        sd = np.sqrt(np.diag(here.covariance))
        if np.all(np.abs(step[fit.free]) < 1e-3 * sd):
            break
        for share in (1.0, 0.5, 0.25, 0.125):
            there = fit.at(here.place + share * step)
            if there.cost < here.cost:
                break
        else:
            break
        here = there
    return here


class _Fit:
    """Readings, thinned to what tells, against a map."""

    def __init__(self, runs: Sequence[Run], field: AnomalyMap, free: NDArray[np.bool_], prior: Array) -> None:
        self.field, self.free, self.prior = field, free, prior
        self.alike = 1.0
        self.runs = []
        for run in runs:
            step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else 1.0
            every = max(1, round(1 / (step * FIT_RATE_HZ)))
            self.runs.append((run, np.arange(0, run.rows, every)))

    def at(self, place: Array) -> _Linearised:
        """The least squares about a place."""
        alignment = Alignment((float(place[0]), float(place[1])), float(place[2]))
        parts_x, parts_y, parts_block, blocks = [], [], [], 0
        for run, rows in self.runs:
            p, yaw, rates = (values[rows] for values in placed(run, alignment))
            value, gradient = self.field.lookup_with_gradient(p, yaw)
            usable = np.isfinite(value) & np.isfinite(gradient).all(axis=1)
            for flag in UNUSABLE:
                usable &= ~run[flag][rows] if flag in run else True
            label = run["b_measured_nt"][rows] - value
            kept = usable & np.isfinite(label)
            slopes = _slopes(gradient, yaw, rates)[:, self.free]
            platform = _platform(run, rows, yaw, rates)
            kept &= np.isfinite(platform).all(axis=1) & np.isfinite(slopes).all(axis=1)
            if not kept.any():
                continue
            matrix = np.column_stack([slopes, platform])[kept]
            parts_x.append(matrix - matrix.mean(axis=0))
            parts_y.append(label[kept] - label[kept].mean())
            block = ((run["t"][rows][kept] - run["t"][0]) // BLOCK_S).astype(int)
            parts_block.append(blocks + np.unique(block, return_inverse=True)[1])
            blocks = int(parts_block[-1][-1]) + 1
        if not parts_x:
            return _Linearised(place, place, np.diag(self.prior), np.inf, np.inf, 1.0)
        x, y, block = np.vstack(parts_x), np.concatenate(parts_y), np.concatenate(parts_block)
        count = len(self.prior)
        left = _beside(x[:, count:], np.column_stack([x[:, :count], y]))
        return self._solved(place, left[:, :-1], left[:, -1], block)

    def _solved(self, place: Array, x: Array, y: Array, block: NDArray[np.intp]) -> _Linearised:
        rows, at = len(y), place[self.free]
        scale = np.sqrt(np.mean(x**2, axis=0))
        scale[scale == 0] = 1.0  # on a level map no place differs from another
        x = x / scale
        normal = x.T @ x
        inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
        solved = inverse @ (x.T @ y)
        error = y - x @ solved
        promised = max(float(np.mean(error**2)), 1e-12)
        score = np.zeros((int(block.max()) + 1, x.shape[1]))
        np.add.at(score, block, x * error[:, None])
        # Few blocks make their own scatter small.
        few = len(score) / max(len(score) - x.shape[1], 1)
        blocked = few * (inverse @ (score.T @ score) @ inverse)
        alike = np.trace(blocked) / max(promised * np.trace(inverse), 1e-300)
        # Along what the runs do not tell, the pseudo-inverse claims a variance of 0: there the prior stands.
        values, vectors = np.linalg.eigh(normal)
        blind = vectors[:, values <= 1e-10 * values[-1]]
        unknown = 1e12 * blind @ blind.T
        prior = np.diag(self.prior)

        def shrunk(spread: NDArray[Any]) -> Array:
            spread = (spread + unknown) / np.outer(scale, scale)
            return prior @ np.linalg.inv(prior + spread)

        wanted = place.copy()
        wanted[self.free] = shrunk(self.alike * promised * inverse) @ (at + solved / scale)
        covariance = prior - shrunk(blocked) @ prior
        left = max(float(np.mean(y**2)), 1e-12)
        cost = rows / self.alike * np.log(left) + float(np.sum(at**2 / self.prior))
        return _Linearised(place, wanted, (covariance + covariance.T) / 2, cost, promised, max(alike, 1.0))


def placed(run: Run, alignment: Alignment) -> tuple[Array, Array, Array]:
    """Sensor's place (N, 2), heading (N,) and rates of x, y, yaw (N, 3) at the time of each reading."""
    if {"mocap_p", "mocap_q_xyzw"} <= set(run):
        p, yaw = run["mocap_p"][:, :2], np.unwrap(_unbroken(yaw_from_quat(run["mocap_q_xyzw"])))
    else:
        p, yaw = run["p_world_base"][:, :2], np.unwrap(run["yaw"])
    t = run["t"]
    pose = np.column_stack([p, yaw])
    rates = np.gradient(pose, t, axis=0) if len(t) > 1 else np.zeros_like(pose)
    if alignment.latency_s:
        then = t - alignment.latency_s
        pose = np.column_stack([np.interp(then, t, column, np.nan, np.nan) for column in pose.T])
    forward, left = alignment.lever_arm_m
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    place = pose[:, :2] + np.column_stack([c * forward - s * left, s * forward + c * left])
    return place, wrap_angle(pose[:, 2]), rates


def _unbroken(yaw: Array) -> Array:
    """Headings with the last known one held where there is none, so that they can be unwrapped."""
    known = np.isfinite(yaw)
    if known.all() or not known.any():
        return yaw
    held = np.maximum.accumulate(np.where(known, np.arange(len(yaw)), -1))
    return np.where(held >= 0, yaw[np.maximum(held, 0)], yaw[np.argmax(known)])


def _slopes(gradient: Array, yaw: Array, rates: Array) -> Array:
    """What the map changes by for a metre forward, a metre left, and a second of latency, shape (N, 3)."""
    late = -np.sum(gradient * rates, axis=1)
    return np.column_stack([into_base(gradient[:, :2], yaw), late])


def _platform(run: Run, rows: NDArray[np.intp], yaw: Array, rates: Array) -> Array:
    """Columns (M, K) that stand for the platform: what is fixed to it adds along the field by its heading.

    Beside what is always there: turning and speed (eddy currents, drag), their rates (the torque of the
    motors, which comes where a robot slows to turn, and so would pass for a latency), LiDAR and battery.
    """
    t, ahead = run["t"], np.cos(yaw) * rates[:, 0] + np.sin(yaw) * rates[:, 1]
    speed = run["odom_v"][:, 0] if "odom_v" in run else np.interp(t, t[rows], ahead)
    turning = run["odom_w"][:, 2] if "odom_w" in run else np.interp(t, t[rows], rates[:, 2])
    currents = [np.ones(len(rows)), speed[rows], turning[rows]]
    currents += [_slope(values, t, t[rows]) for values in (speed, turning)]
    currents += [run["lidar_on"][rows].astype(float)] if "lidar_on" in run else []
    currents += [run["battery_a"][rows]] if "battery_a" in run else []
    ways = (np.ones(len(rows)), np.cos(yaw), np.sin(yaw))
    return np.column_stack(
        [*(current * way for current in currents for way in ways), np.cos(2 * yaw), np.sin(2 * yaw)]
    )


def _slope(values: Array, t: Array, at: Array) -> Array:
    """What a signal changes by in a second, over `SLOPE_S` about each instant."""
    early, late = (np.interp(at + way * SLOPE_S / 2, t, values) for way in (-1, 1))
    return (late - early) / SLOPE_S


def _beside(platform: Array, values: Array) -> Array:
    """What the platform's terms (N, K) leave of columns (N, M); nothing of one that they explain."""
    scale = np.sqrt(np.mean(platform**2, axis=0))
    platform = platform[:, scale > 0] / scale[scale > 0]
    left = values - platform @ np.linalg.lstsq(platform, values, rcond=1e-10)[0]
    explained = np.sum(left**2, axis=0) <= 1e-16 * np.sum(values**2, axis=0)
    return np.where(explained, 0.0, left)
