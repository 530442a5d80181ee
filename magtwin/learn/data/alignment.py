"""Alignment: the place and time of a reading relative to the pose with its stamp, and its fit to a map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base, wrap_angle, yaw_from_quat
from magtwin.report.report import Figure
from magtwin.report.summary import Summarized
from magtwin.run.run import Run
from magtwin.run.thinning import newest

Array = NDArray[np.float64]

UNUSABLE = ("flag_lost_lock", "flag_pose_lost")  # Flags of a run whose readings have no label
BLOCK_S = 5.0  # Length of blocks of readings with correlated errors [s]
TILES = 4  # Number of tiles along each side of the driven area; errors of the map and platform stay in place
LATENCIES_S = np.arange(-0.4, 0.41, 0.02)  # Latencies that are tried before the best are refined [s]
END_S = 0.5  # Time at each end of a run that a latency is not fitted to [s]; no pose may lie beyond
LEAST_ROWS = 200  # Least number of labelled readings for a fit
PRIOR = np.array([0.05, 0.05, 0.1]) ** 2  # Prior variances of the lever arm [m^2] and the latency [s^2]
FIT_RATE_HZ = 20.0  # Highest rate of readings in the fit [Hz]

SLOPE_S = 0.2
"""Time over which rates of speed and turning are taken [s]; a motor's torque lasts about as long."""

LIMITS = (
    ("lever_arm_m", 100.0, "m"),
    ("latency_s", 60.0, "s"),
    ("lever_arm_sd_m", 100.0, "m"),
    ("latency_sd_s", 60.0, "s"),
)
"""Largest size of each figure of an alignment, with its unit."""

STARTS, ROUNDS = 3, 20  # Number of best latencies that are refined, and most linearisations of each


@dataclass(frozen=True, repr=False)
class Alignment(Summarized):
    """The place and time of a reading relative to the pose with its stamp."""

    lever_arm_m: tuple[float, float] = (0.0, 0.0)
    """Place of the sensor forward and left of the map's reference [m], in base_link axes."""

    latency_s: float = 0.0
    """Age of the reading at its stamp, beside the age of the pose [s]."""

    lever_arm_sd_m: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of `lever_arm_m` [m], robust to errors of places and recordings; 0 if given."""

    latency_sd_s: float = 0.0
    """Standard deviation of `latency_s` [s]; 0 if it was given."""

    def __post_init__(self) -> None:
        for name, most, unit in LIMITS:
            if not np.all(np.abs(getattr(self, name)) <= most):
                raise InputError(f"{name} must be within {most:g} {unit} of 0, got {getattr(self, name)}")

    def figures(self) -> tuple[Figure, ...]:
        """Lever arm and latency, with their standard deviations, for a report."""
        (forward, left), (forward_sd, left_sd) = self.lever_arm_m, self.lever_arm_sd_m
        return (
            Figure("lever arm, forward", forward, "m", forward_sd),
            Figure("lever arm, left", left, "m", left_sd),
            Figure("latency", self.latency_s, "s", self.latency_sd_s),
        )


def alignment_of(metadata: Mapping[str, Any], where: object = "") -> Alignment:
    """Lever arm and latency in the metadata of weights; 0 if they have none.

    Raises:
        InputError: They are no numbers.
    """
    try:
        arm = [float(part) for part in str(metadata.get("lever_arm_m", "0, 0")).split(",")]
        forward, left = arm
        return Alignment((forward, left), float(metadata.get("latency_s", 0.0)))
    except ValueError as error:
        raise InputError(
            f"{where}: lever_arm_m {metadata.get('lever_arm_m')!r} and latency_s "
            f"{metadata.get('latency_s')!r} of its metadata are no lengths and time ({error}); train it again"
        ) from error


def placed(run: Run, alignment: Alignment) -> tuple[Array, Array, Array]:
    """Sensor's place (N, 2), heading (N,) and their rates of change (N, 3) at the time of each reading.

    The pose is that of motion capture if the run has it, else the true pose. A place without heading is nan.
    """
    if {"mocap_p", "mocap_q_xyzw"} <= set(run):
        yaw = yaw_from_quat(run["mocap_q_xyzw"])
        p, yaw = np.where(np.isfinite(yaw)[:, None], run["mocap_p"][:, :2], np.nan), np.unwrap(_filled(yaw))
    else:
        p, yaw = run["p_world_base"][:, :2], np.unwrap(run["yaw"])
    t = run["t"]
    pose = np.column_stack([p, yaw])
    rates = np.gradient(pose, t, axis=0) if len(t) > 1 else np.zeros_like(pose)
    if alignment.latency_s:
        then = t - alignment.latency_s
        pose, rates = (
            np.column_stack([np.interp(then, t, column, np.nan, np.nan) for column in columns.T])
            for columns in (pose, rates)
        )
    forward, left = alignment.lever_arm_m
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.column_stack([c * forward - s * left, s * forward + c * left])
    place = pose[:, :2] + arm
    rates[:, :2] += rates[:, 2:] * np.column_stack([-arm[:, 1], arm[:, 0]])
    return place, wrap_angle(pose[:, 2]), rates


def usable(run: Run) -> NDArray[np.bool_]:
    """Readings with lock and a pose, shape (N,)."""
    good = np.ones(run.rows, bool)
    for flag in UNUSABLE:
        if flag in run:
            good &= ~run[flag]
    return good


def slopes(gradient: Array, yaw: Array, rates: Array) -> Array:
    """Change of the map per metre forward, metre left, and second of latency, shape (N, 3)."""
    late = -np.sum(gradient * rates, axis=1)
    return np.column_stack([into_base(gradient[:, :2], yaw), late])


def fit_alignment(
    runs: Sequence[Run],
    field: AnomalyMap,
) -> Alignment:
    """Lever arm and latency with which readings agree best with a map.

    Least squares on label = c + platform + gradient terms. c is a constant of each run, and the gradient
    terms are the map's first order in both,

        map(p(t - tau) + R l) = map(p) + (R^T grad B) . l - tau dB/dt,

    linearised again until they converge, from the `STARTS` best of `LATENCIES_S`; the likeliest result is
    returned. The platform terms are fixed to the robot and depend on its heading: iron, turning, speed, their
    rates, LiDAR and battery current. Without them iron would pass for a lever arm, and the motors' torque
    before a turn for a latency. A robot whose iron has changed since the survey also adds a field that varies
    with the direction of the lab's field, so both coordinates of the place, times constant, sine and cosine
    of the heading, are fitted too. On a straight line at one speed a forward lever arm and a
    latency are the same, so both have a weak prior of covariance P around 0. The estimate is G times that of
    least squares, G = P (P + V)^-1, with V from blocks of `BLOCK_S` with correlated errors.

    The standard deviations include errors that more readings do not reduce. Errors of the map and of the
    platform's terms are the same whenever the robot comes to a place, and those of a session last a whole
    recording. So their covariance W is the sum of the sandwich estimates for errors correlated within each
    of `TILES`^2 tiles of the driven area, and within each recording (Cameron, Gelbach and Miller 2011,
    without the subtraction of the part that both have). With one recording its blocks take the recordings'
    place. Few tiles or recordings widen it by Student's t. The reported covariance is G W G^T +
    (I - G) P (I - G)^T.

    Args:
        runs: Runs of one robot that turns and drives at several speeds, as for `magtwin.learn.data.labels`.
        field: The map.

    Raises:
        InputError: Fewer than `LEAST_ROWS` readings have a label.
    """
    known = 0
    for run in runs:
        p, yaw, _ = placed(run, Alignment())
        known += int(np.isfinite(field.lookup(p, yaw) + run["b_measured_nt"])[usable(run)].sum())
    if known < LEAST_ROWS:
        raise InputError(
            f"{known} readings have a label on the map {field.name!r}, too few to fit lever arm and latency: "
            f"it takes {LEAST_ROWS}; do the runs lie on the map?"
        )
    fit = _Fit(runs, field)
    tried = np.zeros((len(LATENCIES_S), 3))
    tried[:, 2] = LATENCIES_S
    starts = [tried[i] for i in np.argsort([fit.at(place).promised for place in tried])[:STARTS]]
    fit.alike = fit.at(starts[0]).alike
    best = min((_descend(fit, start) for start in starts), key=lambda result: result.cost)
    sd = np.sqrt(np.diag(fit.at(best.place, robust=True).covariance))
    forward, left, late = best.place.tolist()
    return Alignment((forward, left), late, (float(sd[0]), float(sd[1])), float(sd[2]))


@dataclass(frozen=True)
class _Linearised:
    """The least squares of an alignment around a place (forward, left, latency)."""

    place: Array
    wanted: Array
    """Solution of least squares and prior, shape (3,)."""
    covariance: Array
    """Posterior covariance, shape (3, 3)."""
    cost: float
    """Twice the negative logarithm of the posterior of the place, up to a constant."""
    promised: float
    """Mean square residual of the solution [nT^2]."""
    alike: float
    """Number of readings that err as one."""


def _descend(fit: "_Fit", start: Array) -> _Linearised:
    """Iterate from a start; a step that raises the cost is halved."""
    here = fit.at(start)
    for _ in range(ROUNDS):
        step = here.wanted - here.place
        sd = np.sqrt(np.diag(here.covariance))
        if np.all(np.abs(step) < 1e-3 * sd):
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
    """Thinned readings and a map."""

    def __init__(self, runs: Sequence[Run], field: AnomalyMap) -> None:
        self.field = field
        self.alike, self.readings = 1.0, 0
        self.runs = []
        self.corners = np.full((2, 2), np.nan)
        for run in runs:
            p = placed(run, Alignment())[0][usable(run)]
            p = p[field.contains(p)]
            if len(p):
                self.corners[0] = np.fmin(self.corners[0], p.min(axis=0))
                self.corners[1] = np.fmax(self.corners[1], p.max(axis=0))
            step = float(np.median(np.diff(run["t"]))) if run.rows > 1 else 1.0
            every = max(1, round(1 / (step * FIT_RATE_HZ)))
            rows = newest(np.arange(0, run.rows, every), usable(run) & np.isfinite(run["b_measured_nt"]))
            # the same readings whatever the latency; else the cost favours those with fewer
            t = run["t"]
            rows = rows[(t[rows] >= t[0] + END_S) & (t[rows] <= t[-1] - END_S)]
            self.runs.append((run, rows, usable(run)))

    def at(self, place: Array, robust: bool = False) -> _Linearised:
        """The least squares around a place; the covariance is that of blocks, or of tiles and recordings."""
        alignment = Alignment((float(place[0]), float(place[1])), float(place[2]))
        parts_x, parts_y, parts_block, parts_tile, blocks = [], [], [], [], 0
        for run, rows, good in self.runs:
            p, yaw, rates = (values[rows] for values in placed(run, alignment))
            value, gradient = self.field.lookup_with_gradient(p, yaw)
            label = run["b_measured_nt"][rows] - value
            unit = (p - self.corners[0]) / np.maximum(np.ptp(self.corners, axis=0), 1e-9)
            matrix = np.column_stack(
                [
                    slopes(gradient, yaw, rates),
                    _platform(run, rows, yaw, rates),
                    _over_the_area(2 * unit - 1, yaw),
                ]
            )
            kept = good[rows] & np.isfinite(label) & np.isfinite(gradient).all(axis=1)
            kept &= np.isfinite(matrix).all(axis=1)
            if not kept.any():
                continue
            matrix = matrix[kept]
            parts_x.append(matrix - matrix.mean(axis=0))
            parts_y.append(label[kept] - label[kept].mean())
            block = ((run["t"][rows][kept] - run["t"][0]) // BLOCK_S).astype(int)
            parts_block.append(blocks + np.unique(block, return_inverse=True)[1])
            blocks = int(parts_block[-1][-1]) + 1
            parts_tile.append(np.clip(unit[kept] * TILES, 0, TILES - 1).astype(int) @ [TILES, 1])
        if not parts_x:
            return _Linearised(place, place, np.diag(PRIOR), np.inf, np.inf, 1.0)
        x, y, block = np.vstack(parts_x), np.concatenate(parts_y), np.concatenate(parts_block)
        left = _residual(x[:, 3:], np.column_stack([x[:, :3], y]))
        groups: list[NDArray[np.intp]] = []
        if robust:
            alike = parts_block if len(parts_y) == 1 else [np.full(len(y), k) for k, y in enumerate(parts_y)]
            groups = [
                np.unique(np.concatenate(parts), return_inverse=True)[1] for parts in (parts_tile, alike)
            ]
        return self._solved(place, left[:, :-1], left[:, -1], block, groups)

    def _solved(
        self,
        place: Array,
        x: Array,
        y: Array,
        block: NDArray[np.intp],
        groups: Sequence[NDArray[np.intp]],
    ) -> _Linearised:
        scale = np.sqrt(np.mean(x**2, axis=0))
        scale[scale == 0] = 1.0  # on a constant map all places are alike
        x = x / scale
        normal = x.T @ x
        inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
        solved = inverse @ (x.T @ y)
        error = y - x @ solved
        promised = max(float(np.mean(error**2)), 1e-12)
        score = np.zeros((int(block.max()) + 1, x.shape[1]))
        np.add.at(score, block, x * error[:, None])
        # few blocks underestimate their own scatter
        few = len(score) / max(len(score) - x.shape[1], 1)
        blocked = few * (inverse @ (score.T @ score) @ inverse)
        alike = np.trace(blocked) / max(promised * np.trace(inverse), 1e-300)
        # the pseudo-inverse has variance 0 in directions without information; there the prior holds
        values, vectors = np.linalg.eigh(normal)
        blind = vectors[:, values <= 1e-10 * values[-1]]
        unknown = 1e12 * blind @ blind.T
        prior = np.diag(PRIOR)

        def gain(known: NDArray[Any]) -> Array:
            return prior @ np.linalg.inv(prior + (known + unknown) / np.outer(scale, scale))

        shrunk = gain(self.alike * promised * inverse)
        wanted = shrunk @ (place + solved / scale)
        if groups:
            spread = np.sum([_sandwich(inverse, x, error, group) for group in groups], axis=0)
            missed = np.eye(3) - shrunk
            covariance = shrunk @ (spread / np.outer(scale, scale)) @ shrunk.T + missed @ prior @ missed.T
        else:
            covariance = prior - gain(blocked) @ prior
        left = max(float(np.mean(y**2)), 1e-12)
        self.readings = self.readings or len(y)
        cost = self.readings / self.alike * np.log(left) + float(np.sum(place**2 / PRIOR))
        return _Linearised(place, wanted, (covariance + covariance.T) / 2, cost, promised, max(alike, 1.0))


def _sandwich(inverse: NDArray[Any], x: Array, error: Array, group: NDArray[np.intp]) -> Array:
    """Covariance of least squares whose errors are correlated within groups; 0 for one group.

    g / (g - 1) N^-1 (sum over groups of s s^T) N^-1, with s = X^T e of a group (Liang and Zeger 1986), scaled
    so that normal intervals of 90 % are as wide as those of Student's t with g - 1 degrees of freedom.
    """
    from scipy.special import ndtri, stdtrit  # slow import

    groups = int(group.max()) + 1
    if groups < 2:
        return np.zeros_like(inverse)
    score = np.zeros((groups, x.shape[1]))
    np.add.at(score, group, x * error[:, None])
    wider = float(stdtrit(groups - 1, 0.95) / ndtri(0.95))
    return np.asarray(wider**2 * groups / (groups - 1) * inverse @ (score.T @ score) @ inverse)


def _filled(yaw: Array) -> Array:
    """Headings with gaps filled by the last known one, so that they can be unwrapped."""
    known = np.isfinite(yaw)
    if known.all() or not known.any():
        return yaw
    held = np.maximum.accumulate(np.where(known, np.arange(len(yaw)), -1))
    return np.where(held >= 0, yaw[np.maximum(held, 0)], yaw[np.argmax(known)])


def _platform(run: Run, rows: NDArray[np.intp], yaw: Array, rates: Array) -> Array:
    """Columns (M, K) for fields fixed to the platform, by heading.

    The currents are a constant, speed and turning (eddy currents, drag), their rates (motor torque), LiDAR
    and battery.
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


def _over_the_area(unit: Array, yaw: Array) -> Array:
    """Columns (M, K) for fields that vary slowly with the place, -1 to 1 along each axis, by heading."""
    ways = (np.ones(len(yaw)), np.cos(yaw), np.sin(yaw))
    return np.column_stack([shape * way for shape in (unit[:, 1], unit[:, 0]) for way in ways])


def _slope(values: Array, t: Array, at: Array) -> Array:
    """Rate of a signal, over `SLOPE_S` around each instant."""
    early, late = (np.interp(at + way * SLOPE_S / 2, t, values) for way in (-1, 1))
    return (late - early) / SLOPE_S


def _residual(platform: Array, values: Array) -> Array:
    """Columns (N, M) less their fit by platform terms (N, K); 0 if the terms explain a column fully."""
    scale = np.sqrt(np.mean(platform**2, axis=0))
    platform = platform[:, scale > 0] / scale[scale > 0]
    left = values - platform @ np.linalg.lstsq(platform, values, rcond=1e-10)[0]
    explained = np.sum(left**2, axis=0) <= 1e-16 * np.sum(values**2, axis=0)
    return np.where(explained, 0.0, left)
