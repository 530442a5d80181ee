"""Labels: what a magnetometer read beyond the map, and how well that is known."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.map import AnomalyMap
from magtwin.frames import wrap_angle, yaw_from_quat
from magtwin.names import RefusedError
from magtwin.report import Figure, Report
from magtwin.run import Run

Array = NDArray[np.float64]

UNUSABLE = ("flag_lost_lock", "flag_pose_lost")
"""Flags of a run whose readings have no label."""

BLOCK_S = 5.0
"""Readings this near in time err alike: the spread of an estimate is taken from blocks of them [s]."""

LATENCIES_S = np.arange(-0.4, 0.41, 0.02)
"""Latencies that are tried before the best one is refined [s]."""

LEAST_ROWS = 200
"""Fewer readings with a label do not tell an alignment."""


@dataclass(frozen=True)
class Alignment:
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
            raise RefusedError(f"an alignment must be finite, got {self}")

    def report(self, title: str = "Alignment") -> Report:
        """Lever arm and latency, with their spreads."""
        arm = [
            Figure(f"lever arm, {way}", value, "m", sd)
            for way, value, sd in zip(("forward", "left"), self.lever_arm_m, self.lever_arm_sd_m, strict=True)
        ]
        return Report(title, (*arm, Figure("latency", self.latency_s, "s", self.latency_sd_s)))


@dataclass(frozen=True)
class Labels:
    """What each reading of a run says of the disturbance."""

    value_nt: Array
    """Measured field less the map [nT], shape (N,); nan where there is no label."""

    sd_nt: Array
    """How well the map is known there [nT], shape (N,): its own standard deviation, and its gradient times
    what the alignment is uncertain by; 0 of a map without variances."""

    map_nt: Array
    """Map at the sensor's place [nT], shape (N,)."""

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
        RefusedError: The run lacks a column.
    """
    alignment = alignment or Alignment()
    p, yaw, rates = _placed(run, alignment)
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
    return Labels(measured - value, np.sqrt(variance), value)


def fit_alignment(
    runs: Sequence[Run], field: AnomalyMap, *, lever_arm: bool = True, latency: bool = True, rounds: int = 20
) -> Alignment:
    """Lever arm and latency that make readings agree best with a map.

    Least squares on label = c + heading terms + speed + LiDAR + gradient terms, where the gradient terms
    are the first order of the map in both,

        map(p(t - tau) + R l) = map(p) + (R^T grad B) . l - tau dB/dt,

    relinearised until they stay, from the latency of `LATENCIES_S` that leaves least. The other terms
    (cos and sin of the heading and of twice it) stand for the platform, so that its hard iron is not taken
    for a place. Spreads are those of blocks of `BLOCK_S`.

    Args:
        runs: Runs of one robot, as for `labels`; they should turn, and drive at more than one speed: along a
            straight line at one speed a lever arm forward and a latency are the same.
        field: The map.
        lever_arm: Whether the lever arm is fitted; otherwise it is 0.
        latency: Whether the latency is fitted; otherwise it is 0.
        rounds: Relinearisations at most.

    Raises:
        RefusedError: Fewer than `LEAST_ROWS` readings have a label, the runs do not tell the one from the
            other, or nothing is to be fitted.
    """
    if not (lever_arm or latency):
        raise RefusedError("neither the lever arm nor the latency is to be fitted; name one")
    free = np.array([lever_arm, lever_arm, latency])
    known = sum(int(labels(run, field).known.sum()) for run in runs)
    if known < LEAST_ROWS:
        raise RefusedError(
            f"{known} readings have a label on the map {field.name!r}, too few to fit lever arm and latency: "
            f"it takes {LEAST_ROWS}; do the runs lie on the map?"
        )
    start = np.zeros(3)
    if latency:
        left = [_round(runs, field, np.array([0.0, 0.0, tau]), free)[2] for tau in LATENCIES_S]
        start[2] = LATENCIES_S[int(np.argmin(left))]
    found, best = start, np.inf
    for _ in range(rounds):
        step, sd, left_over = _round(runs, field, found, free)
        if not np.all(np.isfinite(step)):
            raise RefusedError(
                "the runs do not tell lever arm and latency apart: they do not turn, or keep one speed; "
                "add a run that does, or fit one of the two"
            )
        if np.abs(step / np.where(sd > 0, sd, 1.0)).max() < 1e-3 or left_over > best * (1 + 1e-9):
            break
        best, found = left_over, found + step
    return Alignment(
        (float(found[0]), float(found[1])), float(found[2]), (float(sd[0]), float(sd[1])), float(sd[2])
    )


def _placed(run: Run, alignment: Alignment) -> tuple[Array, Array, Array]:
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
    gx, gy, gyaw = gradient.T
    c, s = np.cos(yaw), np.sin(yaw)
    late = -(gx * rates[:, 0] + gy * rates[:, 1] + gyaw * rates[:, 2])
    return np.column_stack([c * gx + s * gy, c * gy - s * gx, late])


def _round(
    runs: Sequence[Run], field: AnomalyMap, at: Array, free: NDArray[np.bool_]
) -> tuple[Array, Array, float]:
    """A Gauss-Newton step from lever arm and latency, its standard deviations, and the mean square left."""
    alignment = Alignment((float(at[0]), float(at[1])), float(at[2]))
    blocks, parts_x, parts_y = [], [], []
    for run in runs:
        p, yaw, rates = _placed(run, alignment)
        gradient = field.gradient(p, yaw)
        label = labels(run, field, alignment).value_nt
        kept = np.isfinite(label) & np.isfinite(gradient).all(axis=1)
        slopes = _slopes(gradient, yaw, rates)[:, free]
        terms = [np.ones(run.rows), np.cos(yaw), np.sin(yaw), np.cos(2 * yaw), np.sin(2 * yaw)]
        terms += [run["odom_v"][:, 0]] if "odom_v" in run else []
        terms += [run["lidar_on"].astype(float)] if "lidar_on" in run else []
        parts_x.append(np.column_stack([slopes, *terms])[kept])
        parts_y.append(label[kept])
        start = (blocks[-1][-1] + 1) if blocks and len(blocks[-1]) else 0
        blocks.append(start + ((run["t"][kept] - run["t"][0]) // BLOCK_S).astype(int))
    x, y, block = np.vstack(parts_x), np.concatenate(parts_y), np.concatenate(blocks)
    scale = np.sqrt(np.mean(x**2, axis=0))
    x = x[:, scale > 0] / scale[scale > 0]
    step, sd = np.zeros(3), np.zeros(3)
    count = int(free.sum())
    if not np.all(scale[:count] > 0):
        return np.full(3, np.nan), sd, np.inf
    normal = x.T @ x
    if np.linalg.cond(normal[:count, :count]) > 1e10:
        return np.full(3, np.nan), sd, np.inf
    inverse = np.linalg.pinv(normal, hermitian=True)
    solved = inverse @ (x.T @ y)
    error = y - x @ solved
    score = np.zeros((int(block.max()) + 1, x.shape[1]))
    np.add.at(score, block, x * error[:, None])
    spread = inverse @ (score.T @ score) @ inverse
    step[free] = solved[:count] / scale[:count]
    sd[free] = np.sqrt(np.diag(spread)[:count]) / scale[:count]
    return step, sd, float(np.mean(error**2))
