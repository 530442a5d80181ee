"""The differential drive: exact integration of twists, wheels, limits."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.names import RefusedError
from magtwin.spec import DriveSpec

Array = NDArray[np.float64]
Pose = tuple[float, float, float]
"""x [m], y [m], yaw [rad] in world."""


def advance(pose: ArrayLike, v: ArrayLike, w: ArrayLike, duration: ArrayLike) -> Array:
    """Poses of a unicycle after a constant twist, without Euler's error.

    The way is an arc of angle a = w t; its chord, v t sin(a/2) / (a/2), points halfway between the
    headings at its ends.

    Args:
        pose: x [m], y [m], yaw [rad] before, in world, shape (..., 3).
        v: Forward speeds [m/s], shape (...).
        w: Yaw rates [rad/s], shape (...).
        duration: How long each twist lasts, t [s], shape (...).

    Returns:
        x, y, yaw after, shape (..., 3); yaw goes on beyond pi.
    """
    pose = np.asarray(pose, float)
    half = np.asarray(w, float) * duration / 2
    chord = np.asarray(v, float) * duration * np.sinc(half / np.pi)
    mid = pose[..., 2] + half
    return np.stack(
        [pose[..., 0] + chord * np.cos(mid), pose[..., 1] + chord * np.sin(mid), mid + half], axis=-1
    )


def integrate_twist(v: ArrayLike, w: ArrayLike, dt: float, pose0: Pose = (0.0, 0.0, 0.0)) -> Array:
    """Poses of a unicycle under piecewise constant twists; each step as in `advance`.

    Args:
        v: Forward speeds [m/s], shape (K,).
        w: Yaw rates [rad/s], shape (K,).
        dt: Length of a step [s].
        pose0: First x [m], y [m], yaw [rad] in world.

    Returns:
        x, y, yaw at the start and after each step, shape (K + 1, 3).
    """
    turn = np.asarray(w, float) * dt
    yaw = pose0[2] + np.concatenate([[0.0], np.cumsum(turn)])
    start = np.zeros((len(turn), 3))
    start[:, 2] = yaw[:-1]
    steps = advance(start, v, w, dt)[:, :2]
    xy = np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]) + pose0[:2]
    return np.column_stack([xy, yaw])


def wheel_rates(v: ArrayLike, w: ArrayLike, drive: DriveSpec) -> Array:
    """Rates of the left and the right wheel [rad/s]: (v -+ w b / 2) / r, shape (...) -> (..., 2)."""
    v, w = np.asarray(v, float), np.asarray(w, float)
    side = w * drive.wheel_separation_m / 2
    return np.stack([v - side, v + side], axis=-1) / drive.wheel_radius_m


def twist_from_wheels(rates: ArrayLike, drive: DriveSpec) -> tuple[Array, Array]:
    """Forward speed [m/s] and yaw rate [rad/s] from wheel rates [rad/s], shape (..., 2) -> (...)."""
    left, right = np.moveaxis(np.asarray(rates, float) * drive.wheel_radius_m, -1, 0)
    return (left + right) / 2, (right - left) / drive.wheel_separation_m


def limiter(drive: DriveSpec, dt: float) -> Callable[[float, float, float, float], tuple[float, float]]:
    """What a drive makes of a command: a function of scalars, to be called at each control step.

    Returns:
        `limit(v_wanted, w_wanted, v, w) -> (v, w)`: the twist nearest to the wanted one that keeps
        v_max and w_max and differs from the last one by at most a_max dt and alpha_max dt.
    """
    v_max, w_max, dv, dw = drive.v_max, drive.w_max, drive.a_max * dt, drive.alpha_max * dt

    def limit(v_wanted: float, w_wanted: float, v: float, w: float) -> tuple[float, float]:
        low, high = v - dv, v + dv
        if low < -v_max:
            low = -v_max
        if high > v_max:
            high = v_max
        v = low if v_wanted < low else high if v_wanted > high else v_wanted
        low, high = w - dw, w + dw
        if low < -w_max:
            low = -w_max
        if high > w_max:
            high = w_max
        return v, low if w_wanted < low else high if w_wanted > high else w_wanted

    return limit


@dataclass(frozen=True, eq=False)
class Moment:
    """A motion at given times; arrays of shape (N,) unless said."""

    pose: Array
    """x [m], y [m], yaw [rad] of base_link in world, shape (N, 3); yaw goes on beyond pi."""

    v: Array
    """Forward speed [m/s]."""

    w: Array
    """Yaw rate [rad/s]."""

    a: Array
    """Forward acceleration [m/s2]: the change of speed that began the step, over the step."""

    wheel_angle: Array
    """Angle turned by the left and the right wheel since the start [rad], shape (N, 2)."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What a differential drive did: a twist for each control step, from rest at `pose0`."""

    drive: DriveSpec

    dt: float
    """Length of a control step [s]."""

    v: Array
    """Forward speed in each step [m/s], shape (K,)."""

    w: Array
    """Yaw rate in each step [rad/s], shape (K,)."""

    pose0: Pose = (0.0, 0.0, 0.0)
    """First x [m], y [m], yaw [rad] in world."""

    poses: Array = field(init=False, repr=False)
    """x, y, yaw at the start and after each step, shape (K + 1, 3); yaw goes on beyond pi."""

    acceleration: Array = field(init=False, repr=False)
    """Change of speed that begins each step, over the step [m/s2], shape (K,)."""

    wheel_angles: Array = field(init=False, repr=False)
    """Angle turned by left and right wheel at the start and after each step [rad], shape (K + 1, 2)."""

    def __post_init__(self) -> None:
        v, w = np.asarray(self.v, float), np.asarray(self.w, float)
        if v.ndim != 1 or v.shape != w.shape or not len(v):
            raise RefusedError(f"v and w of a Motion must have one shape (K,), got {v.shape} and {w.shape}")
        if not (np.isfinite(v).all() and np.isfinite(w).all()):
            raise RefusedError("a commanded speed or yaw rate is not finite")
        rates = np.cumsum(wheel_rates(v, w, self.drive), axis=0) * self.dt
        for name, array in (
            ("v", v),
            ("w", w),
            ("poses", integrate_twist(v, w, self.dt, self.pose0)),
            ("wheel_angles", np.vstack([[0.0, 0.0], rates])),
            ("acceleration", np.diff(v, prepend=0.0) / self.dt),
        ):
            object.__setattr__(self, name, array)

    @property
    def duration_s(self) -> float:
        """Time from the start to the end of the last step [s]."""
        return len(self.v) * self.dt

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times `t`, exact within the steps; after the last it stands.

        Args:
            t: Times since the start, from 0 [s], shape (N,).
        """
        t = np.asarray(t, float)
        starts = np.arange(len(self.v)) * self.dt
        k = np.searchsorted(starts, t, side="right") - 1
        into = np.clip(t - starts[k], 0.0, self.dt)
        v, w = self.v[k], self.w[k]
        pose = advance(self.poses[k], v, w, into)
        turned = self.wheel_angles[k] + wheel_rates(v, w, self.drive) * into[..., None]
        moving = t < self.duration_s
        return Moment(pose, v * moving, w * moving, self.acceleration[k] * moving, turned)
