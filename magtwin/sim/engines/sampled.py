"""SampledMotion: a motion known at samples, from a physics engine or a recorded Run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.motion.drive import Moment, advance

Array = NDArray[np.float64]

SAME = 1e-9
"""Tolerance of poses [m, rad]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledMotion:
    """A motion whose position and heading between samples are cubics with the sampled velocities.

    At a sample it gives the exact sample; before the first and after the last the robot stands. If the twist
    is constant between samples h apart, the cubic is off the arc by v w^3 h^4 / 384: negligible at 135 Hz,
    0.3 mm at 2 Hz and the drive's limits. If speeds were held for control steps, each with a sample, the
    motion is exact: speeds jump between steps, and positions follow arcs.
    """

    t: Array
    """Times of the samples since the start, the first at 0, ascending [s], shape (K,), K >= 2."""

    pose: Array
    """x [m], y [m], yaw [rad] of base_link in world, shape (K, 3); yaw is not wrapped."""

    v: Array
    """Forward speed [m/s], shape (K,)."""

    w: Array
    """Yaw rate [rad/s], shape (K,)."""

    wheel_angle: Array
    """Angle turned by the left and the right wheel since the start [rad], shape (K, 2)."""

    v_cmd: Array
    """Commanded forward speed [m/s], shape (K,); nan if unknown."""

    w_cmd: Array
    """Commanded yaw rate [rad/s], shape (K,); nan if unknown."""

    bump: NDArray[np.bool_]
    """Whether an obstacle was touched, shape (K,)."""

    duration_s: float
    """Time from the start to the end [s], at least that of the last sample."""

    step_s: float | None = None
    """Length of the control steps, the first at 0, in which speeds are held [s]; None if speeds change evenly
    from sample to sample."""

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times `t`.

        Args:
            t: Times since the start, from 0 [s], shape (N,).
        """
        t = np.asarray(t, float)
        if self.step_s is not None:
            return self._held(t, self.step_s)
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        h = self.t[k + 1] - self.t[k]
        u = np.clip((t - self.t[k]) / h, 0.0, 1.0)
        v0, v1, w0, w1 = self.v[k], self.v[k + 1], self.w[k], self.w[k + 1]
        a, b = self.pose[k], self.pose[k + 1]
        da = np.column_stack([v0 * np.cos(a[:, 2]), v0 * np.sin(a[:, 2]), w0])
        db = np.column_stack([v1 * np.cos(b[:, 2]), v1 * np.sin(b[:, 2]), w1])
        s, hh = u[:, None], h[:, None]
        r = 1.0 - s
        pose = r * r * ((1 + 2 * s) * a + s * hh * da) + s * s * ((1 + 2 * r) * b - r * hh * db)
        held = np.where(u < 1.0, k, k + 1)
        moving = t <= self.t[-1]
        return Moment(
            pose=pose,
            v=(v0 + u * (v1 - v0)) * moving,
            w=(w0 + u * (w1 - w0)) * moving,
            a=np.interp(t, self.t, self.acceleration) * moving,
            wheel_angle=r * self.wheel_angle[k] + s * self.wheel_angle[k + 1],
            v_cmd=self.v_cmd[held] * moving,
            w_cmd=self.w_cmd[held] * moving,
            bump=self.bump[held],
        )

    def has_steps(self, step_s: float) -> bool:
        """Whether speeds were held for steps from 0 on, with a sample in each step.

        Args:
            step_s: Length of the steps [s].
        """
        step = _steps(self.t, step_s)
        same = np.diff(step) == 0
        if np.any(np.diff(step) > 1) or not np.any(same):
            return False
        held = all(np.all((np.diff(x) == 0)[same]) for x in (self.v, self.w))
        along = advance(self.pose[:-1], self.v[:-1], self.w[:-1], np.diff(self.t)) - self.pose[1:]
        return held and bool(np.all(np.abs(along[same]) < SAME))

    def _held(self, t: Array, step_s: float) -> Moment:
        """`at` for held speeds: each time takes the nearest sample of its step."""
        step, of = _steps(t, step_s), _steps(self.t, step_s)
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1)
        after = np.minimum(k + 1, len(self.t) - 1)
        own = np.where(step > of[k], after, k)
        moving = t <= self.t[-1]
        first = np.flatnonzero(np.diff(of, prepend=-1))
        a = np.diff(self.v[first], prepend=0.0) / step_s
        # A wheel's rate is that between two samples of a step; with one sample, the mean over both sides.
        rates = np.diff(self.wheel_angle, axis=0) / np.diff(self.t)[:, None]
        before, behind = np.vstack([rates[:1], rates]), np.vstack([rates, rates[-1:]])
        inside = np.diff(of) == 0
        with_last, with_next = np.append(False, inside)[:, None], np.append(inside, False)[:, None]
        rate = np.where(with_next, behind, np.where(with_last, before, (before + behind) / 2))
        into = np.where(moving, t - self.t[own], 0.0)
        v, w = self.v[own], self.w[own]
        return Moment(
            pose=advance(self.pose[own], v, w, into),
            v=v * moving,
            w=w * moving,
            a=a[np.clip(step, 0, len(a) - 1)] * moving,
            wheel_angle=self.wheel_angle[own] + rate[own] * into[:, None],
            v_cmd=self.v_cmd[own] * moving,
            w_cmd=self.w_cmd[own] * moving,
            bump=self.bump[own],
        )

    @property
    def acceleration(self) -> Array:
        """Forward acceleration at the samples, by central differences of the speed [m/s2], shape (K,)."""
        return np.gradient(self.v, self.t)


def _steps(t: Array, step_s: float) -> NDArray[np.intp]:
    """Control step of each time, as in `magtwin.sim.motion.drive.Motion.at`, shape (N,)."""
    starts = np.arange(int(np.max(t, initial=0.0) / step_s) + 2) * step_s
    return np.searchsorted(starts, t, side="right") - 1
