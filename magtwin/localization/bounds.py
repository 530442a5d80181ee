"""Bounds: the least error that any localizer can have along a true path.

The posterior Cramer-Rao bound (Tichavsky, Muravchik and Nehorai 1998, IEEE Trans. Signal Processing 46(5))
with the models of a problem, linear about the true poses. Position error e_p, heading error e_h and scale
error s follow

    e_p' = e_p + J dp e_h + dp s + w_p,   e_h' = e_h + w_h,   J = [[0, -1], [1, 0]],

and a reading errs by g e_p + (m_yaw + g J R l) e_h + offset + c cos(yaw) + s sin(yaw) + drift + map error +
white, with g and m_yaw the gradient of the field. In terms of z = e_p - J p e_h - p s all coefficients of the
motion are 1, so that the covariance of the state with a reading does not change after it. Conditioning on all
readings up to each time then takes a single Cholesky factor of the covariance of the readings. That may have
any entries, so the map's error is correlated between all places, also those that the path visits again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.localization.problem import Array, FieldBelief, Problem

MOST = 1000
"""Most readings conditioned on together. In a longer run, drift and map error are independent between such
parts, and the smoothed bound uses no later part."""

_STATES = 7  # z (2), heading, scale, offset, c, s


@dataclass(frozen=True, eq=False)
class Bounds:
    """Least standard deviation of the position, root of that along x squared plus that along y squared [m].

    Arrays have one entry per reading, shape (N,). All use the readings so far, but for `smoothed`.
    """

    t: Array
    """Times [s]."""

    dead_reckoning: Array
    """Odometry alone."""

    exact: Array
    """Readings on an exact map."""

    white: Array
    """On a map whose error is independent from reading to reading."""

    correlated: Array
    """On a map whose error is alike at nearby places."""

    oracle: Array
    """On an exact map, with the offset, drift and iron known."""

    smoothed: Array
    """As `correlated`, from all readings."""

    heading: Array
    """Least standard deviation of the heading, as `correlated` [rad]."""

    def rms(self, name: str, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Root mean square of a bound over time, which no root-mean-square error can be below."""
        return float(np.sqrt(np.mean(np.square(getattr(self, name)[rows]))))


def map_correlation(distance_m: ArrayLike, length_m: float) -> Array:
    """Correlation of a map's errors at two places: exp(-d^2 / 2 l^2)."""
    return np.exp(-0.5 * np.square(np.asarray(distance_m, float) / length_m))


def bounds(
    problem: Problem,
    truth_pose: ArrayLike,
    t: ArrayLike,
    field: FieldBelief | None = None,
    *,
    map_error_nt: float | None = None,
    used: ArrayLike | None = None,
    kidnapped_s: Sequence[float] = (),
) -> Bounds:
    """Bounds of a problem along a true path.

    An unknown start counts as Gaussian, with the variance of a uniform one; so do the poses after a
    kidnapping. The information that a varying variance of the map adds is left out: it is 1e-5 of that of the
    field on the shipped map.

    Args:
        problem: Noise models, prior, and correlation length of the map's error.
        truth_pose: True x, y [m] and yaw [rad] of base_link in world at the readings, shape (N, 3).
        t: Times of the readings [s], shape (N,).
        field: The true field, whose gradient counts. Default: the belief of the problem.
        map_error_nt: Standard deviation of the belief's error [nT]. Default: that of the belief along the
            path.
        used: Readings that carry information, shape (N,); default: all. One off the map carries none.
        kidnapped_s: Times of the first readings after the robot was put elsewhere [s].

    Raises:
        InputError: The poses or times have a wrong shape or are not finite, or there is no field.
    """
    pose, t = np.asarray(truth_pose, float), np.asarray(t, float)
    if pose.ndim != 2 or pose.shape[1] != 3 or t.shape != pose.shape[:1] or not len(t):
        raise InputError(f"truth_pose must have shape (N, 3) and t (N,), got {pose.shape} and {t.shape}")
    if not (np.isfinite(pose).all() and np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise InputError("truth_pose and t of bounds must be finite, and t ascend")
    field = field if field is not None else problem.belief
    if field is None:
        raise InputError("the bounds need the field; the problem has no belief", parameter="field")
    rows = np.ones(len(t), bool) if used is None else np.asarray(used, bool)
    path = _Path(problem, field, pose, t, map_error_nt, rows)
    starts = {0, *np.searchsorted(t, kidnapped_s).tolist()} - {len(t)}
    edges = sorted(starts | set(range(0, len(t), MOST)) | {len(t)})
    out = {name: np.empty(len(t)) for name in ("dead_reckoning", "exact", "white", "correlated", "oracle")}
    out |= {"smoothed": np.empty(len(t)), "heading": np.empty(len(t))}
    ends: dict[str, Array | None] = {"exact": None, "white": None, "correlated": None, "oracle": None}
    alone = None
    for begin, end in pairwise(edges):
        part, anew = slice(begin, end), begin in starts
        spread, drift, h = path.walked(part), path.drift(part), path.rows[part]
        first = path.first(begin, anew, alone)
        free = first + spread
        alone = free[-1]
        out["dead_reckoning"][part] = path.position(free, part)
        for name, last in ends.items():
            prior = path.first(begin, anew, last, known=name == "oracle") + spread
            factor, gains, seen = path.conditioned(prior, h, part, name, drift)
            left = prior - np.cumsum(_outer(gains, gains), axis=0)
            out[name][part] = path.position(left, part)
            ends[name] = left[-1]
            if name == "correlated":
                out["heading"][part] = np.sqrt(left[:, 2, 2])
                out["smoothed"][part] = path.position(_smoothed(prior, h * seen[:, None], factor), part)
    return Bounds(t, **out)


class _Path:
    """Coefficients of the readings and covariances of the noise along a true path."""

    def __init__(
        self,
        problem: Problem,
        field: FieldBelief,
        pose: Array,
        t: Array,
        error_nt: float | None,
        used: NDArray[np.bool_],
    ) -> None:
        self.problem, self.t, self.yaw = problem, t, pose[:, 2]
        self.p = pose[:, :2] - pose[:, :2].mean(axis=0)  # from the middle, for the sake of rounding
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        arm = problem.sensor.lever_arm_m
        out = np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])
        self.sensor = self.p + out
        at = pose[:, :2] + out
        gradient = np.asarray(field.gradient(at, self.yaw), float)
        self.seen = used & np.isfinite(gradient).all(axis=1)
        gradient = np.where(self.seen[:, None], gradient, 0.0)
        if error_nt is None:
            belief = problem.belief if problem.belief is not None else field
            error = np.nan_to_num(np.asarray(belief.variance(at, self.yaw), float))
            self.error = np.sqrt(np.maximum(error, 0.0))
        else:
            self.error = np.full(len(t), float(error_nt))
        g, ones = gradient[:, :2], np.ones(len(t))
        turned = gradient[:, 2] + _across(g, out)
        along = np.einsum("ij,ij->i", g, self.p)
        self.rows = np.column_stack([g, turned + _across(g, self.p), along, ones, c, s])
        """Coefficients of the state in each reading, shape (N, 7)."""

        dp, turn = np.diff(self.p, axis=0), np.diff(self.yaw)
        turn = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
        self.noise = problem.odometry.variances(np.hypot(dp[:, 0], dp[:, 1]), turn, np.diff(t))

    def _to_state(self, k: int) -> Array:
        """Matrix from e_p, e_h and s to z, e_h and s at a reading."""
        x, y = self.p[k]
        matrix = np.eye(4)
        matrix[:2, 2:] = [[y, -x], [-x, -y]]
        return matrix

    def first(self, begin: int, anew: bool, last: Array | None, known: bool = False) -> Array:
        """Covariance of the state before the reading `begin`, shape (7, 7).

        `last` is that after the reading before, None at the start; `anew` at a start or kidnapping.
        """
        sensor, scale = self.problem.sensor, self.problem.odometry.scale_std
        x0, x1, y0, y1 = self.problem.extent
        unknown = ((x1 - x0) / math.sqrt(12), (y1 - y0) / math.sqrt(12), math.pi / math.sqrt(3))
        start = np.zeros((_STATES, _STATES))
        if last is None:
            sd = self.problem.start[1]
            turn = self._to_state(begin)
            start[:4, :4] = turn @ np.diag(np.square([*sd, scale])) @ turn.T
            if not known:
                rest = [sensor.offset_nt, sensor.iron_nt, sensor.iron_nt]
                start[4:, 4:] = np.diag(np.square(rest))
        elif anew:
            turn = self._to_state(begin)
            start[3:, 3:] = last[3:, 3:]
            pose = np.diag([*np.square(unknown), start[3, 3]])
            start[:4, :4] = turn @ pose @ turn.T
        else:
            start[:4, :4] = self._step(begin)
            start += last
        return start

    def _step(self, k: int) -> Array:
        """Covariance that the motion to reading k > 0 adds to z, e_h and s."""
        turn = self._to_state(k)
        return np.asarray(turn @ np.diag([*self.noise[k - 1], 0.0]) @ turn.T)

    def walked(self, part: slice) -> Array:
        """Covariance that odometry adds to the state from the first reading of a part on, shape (n, 7, 7)."""
        q = self.noise[part.start : part.stop - 1]
        x, y = self.p[part.start + 1 : part.stop].T
        out = np.zeros((part.stop - part.start, _STATES, _STATES))
        yaw = q[:, 2]
        step = out[1:]
        step[:, 0, 0], step[:, 1, 1] = q[:, 0] + y * y * yaw, q[:, 1] + x * x * yaw
        step[:, 0, 1] = step[:, 1, 0] = -x * y * yaw
        step[:, 0, 2] = step[:, 2, 0] = y * yaw
        step[:, 1, 2] = step[:, 2, 1] = -x * yaw
        step[:, 2, 2] = yaw
        return np.cumsum(out, axis=0)

    def conditioned(
        self, prior: Array, h: Array, part: slice, name: str, drift: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Cholesky factor L of the readings' covariance, L^-1 times that with the state, readings that count.

        The covariance of the state with reading j, and with what is left of it after reading i < j, is that
        at the time of reading j; so the gains' squares add up over time.
        """
        from scipy.linalg import cholesky, solve_triangular

        seen = self.seen[part]
        across = np.einsum("nij,nj->ni", prior, h)
        lower = h @ across.T  # entry (i, j), j <= i, is h_i' P_j h_j
        lower.flat[:: len(lower) + 1] += self.problem.sensor.white_nt**2
        if name != "oracle":
            lower += drift
        if name == "white":
            lower.flat[:: len(lower) + 1] += self.error[part] ** 2
        if name == "correlated":
            lower += self._map_error(part)
        if not seen.all():  # an independent reading of nothing takes the place of one that is not used
            lower[~seen], lower[:, ~seen] = 0.0, 0.0
            lower[~seen, ~seen] = 1.0
            across[~seen] = 0.0
        factor = cholesky(lower, lower=True, overwrite_a=True, check_finite=False)
        return factor, solve_triangular(factor, across, lower=True, check_finite=False), seen

    def drift(self, part: slice) -> Array:
        """Covariance of the drift at the readings of a part, shape (n, n)."""
        sensor, t = self.problem.sensor, self.t[part]
        return np.asarray(sensor.drift_nt**2 * np.exp(-np.abs(t[:, None] - t) / sensor.drift_s))

    def _map_error(self, part: slice) -> Array:
        x, y = self.sensor[part].T
        far = np.hypot(x[:, None] - x, y[:, None] - y)
        sd = self.error[part]
        return sd[:, None] * map_correlation(far, self.problem.map_length_m) * sd

    def position(self, state: Array, part: slice) -> Array:
        """Root of the summed variances of e_p = z + J p e_h + p s, shape (n,)."""
        x, y = self.p[part].T
        total = np.zeros(len(x))
        for axis, (by_turn, by_scale) in enumerate(((-y, x), (x, y))):
            total += state[:, axis, axis] + by_turn**2 * state[:, 2, 2] + by_scale**2 * state[:, 3, 3]
            total += 2 * (by_turn * state[:, axis, 2] + by_scale * state[:, axis, 3])
            total += 2 * by_turn * by_scale * state[:, 2, 3]
        return np.sqrt(np.maximum(total, 0.0))


def _across(g: Array, p: Array) -> Array:
    """Products g J p, shape (N,)."""
    return np.asarray(g[:, 1] * p[:, 0] - g[:, 0] * p[:, 1])


def _smoothed(prior: Array, h: Array, factor: Array) -> Array:
    """Covariance of the state at each reading given all readings, shape (n, 7, 7).

    The state at k has the covariance P_j h_j with reading j <= k and P_k h_j with reading j > k. With W the
    inverse of the readings' covariance, the three sums over pairs of readings, both up to k, one on each side
    and both after k, are accumulated from k to k + 1.
    """
    from scipy.linalg.lapack import dpotri

    n = len(prior)
    weights = np.tril(dpotri(factor, lower=1)[0])
    own = weights.diagonal().copy()[:, None, None]
    weights.flat[:: n + 1] = 0.0
    a = np.einsum("nij,nj->ni", prior, h)
    early, late = weights @ a, weights.T @ h  # sums of W_kj a_j over j < k, and of W_kj h_j over j > k
    before = np.cumsum(own * _outer(a, a) + _outer(a, early) + _outer(early, a), axis=0)
    after = own * _outer(h, h) + _outer(h, late) + _outer(late, h)
    after = np.cumsum(after[::-1], axis=0)[::-1] - after
    across = (
        np.cumsum(_outer(a, late) - _outer(early, h), axis=0) @ prior
    )  # k leaves one side, joins the other
    return np.asarray(prior - before - across - across.transpose(0, 2, 1) - prior @ after @ prior)


def _outer(u: Array, v: Array) -> Array:
    return u[:, :, None] * v[:, None, :]
