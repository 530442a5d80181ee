"""The differential drive: exact integration of twists, wheels, limits."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.run import mapped
from magtwin.sim.motion.loop import Drive, limited
from magtwin.spec.drive import DriveSpec

Array = NDArray[np.float64]
Pose = tuple[float, float, float]
"""x [m], y [m], yaw [rad] in world."""


def advance(pose: ArrayLike, v: ArrayLike, w: ArrayLike, duration: ArrayLike) -> Array:
    """Poses of a unicycle after a constant twist, without Euler's error.

    The robot drives an arc of angle a = w t. Its chord, v t sin(a/2) / (a/2), points halfway between the
    headings at its ends.

    Args:
        pose: x [m], y [m], yaw [rad] before, in world, shape (..., 3).
        v: Forward speeds [m/s], shape (...).
        w: Yaw rates [rad/s], shape (...).
        duration: Duration t of each twist [s], shape (...).

    Returns:
        x, y, yaw after, shape (..., 3); yaw is not wrapped.
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


def limits(drive: DriveSpec, dt: float) -> Drive:
    """Limits of a drive for steps of `dt` [s], without motors and wheels."""
    return Drive(
        dt=dt,
        v_max=drive.v_max,
        w_max=drive.w_max,
        dv=drive.a_max * dt,
        dw=drive.alpha_max * dt,
        rim=drive.wheel_rate_max * drive.wheel_radius_m,
        half=drive.wheel_separation_m / 2,
        bend=1 / drive.turning_radius_m if drive.turning_radius_m else math.inf,
    )


def limiter(drive: DriveSpec, dt: float) -> Callable[[float, float, float, float], tuple[float, float]]:
    """The function `limit(v_wanted, w_wanted, v, w) -> (v, w)` of a drive, for each control step.

    It gives the nearest twist to the wanted one that keeps v_max, w_max and the highest rate of a wheel, and
    differs from the last twist by at most a_max dt and alpha_max dt; see `magtwin.sim.motion.loop.limited`.
    """
    return partial(limited, limits(drive, dt))


def draw_wheel_errors(drive: DriveSpec, rng: np.random.Generator) -> tuple[float, float]:
    """Relative errors of the wheels' radius and separation in one run: the session's, plus a draw."""
    radius, separation = rng.standard_normal(2).tolist()
    radius *= drive.wheel_radius_error_std
    separation *= drive.wheel_separation_error_std
    return drive.wheel_errors[0] + radius, drive.wheel_errors[1] + separation


@dataclass(frozen=True, eq=False)
class Moment:
    """A motion at given times; arrays of shape (N,) except as noted."""

    pose: Array
    """x [m], y [m], yaw [rad] of base_link in world, shape (N, 3); yaw is not wrapped."""

    v: Array
    """Forward speed [m/s]."""

    w: Array
    """Yaw rate [rad/s]."""

    a: Array
    """Forward acceleration [m/s2]: the change of speed that began the step, over the step."""

    wheel_angle: Array
    """Angle turned by the left and the right wheel since the start [rad], shape (N, 2)."""

    v_cmd: Array
    """Commanded forward speed [m/s]; nan if unknown."""

    w_cmd: Array
    """Commanded yaw rate [rad/s]; nan if unknown."""

    bump: NDArray[np.bool_]
    """Whether the robot touches an obstacle."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a differential drive: a twist for each control step, from rest at `pose0`.

    Defaults of the other columns are those of an ideal drive: wheels roll without slip, the motion was
    commanded, and nothing was touched.
    """

    drive: DriveSpec

    dt: float
    """Length of a control step [s]."""

    v: Array
    """Forward speed in each step [m/s], shape (K,)."""

    w: Array
    """Yaw rate in each step [rad/s], shape (K,)."""

    pose0: Pose = (0.0, 0.0, 0.0)
    """First x [m], y [m], yaw [rad] in world."""

    wheel_v: Array | None = field(default=None, kw_only=True, repr=False)
    """Forward speed of the wheels at their nominal size without slip [m/s], shape (K,)."""

    wheel_w: Array | None = field(default=None, kw_only=True, repr=False)
    """Yaw rate of the wheels likewise [rad/s], shape (K,)."""

    v_cmd: Array | None = field(default=None, kw_only=True, repr=False)
    """Commanded forward speed in each step [m/s], shape (K,)."""

    w_cmd: Array | None = field(default=None, kw_only=True, repr=False)
    """Commanded yaw rate in each step [rad/s], shape (K,)."""

    bump: NDArray[np.bool_] | None = field(default=None, kw_only=True, repr=False)
    """Whether an obstacle shortened the step or is still touched, shape (K,)."""

    poses: Array | None = field(default=None, kw_only=True, repr=False)
    """x, y, yaw at the start and after each step, shape (K + 1, 3); yaw is not wrapped."""

    wheel_rates: Array = field(init=False, repr=False)
    """Rates of the left and the right wheel in each step [rad/s], shape (K, 2)."""

    acceleration: Array = field(init=False, repr=False)
    """Change of speed that begins each step, over the step [m/s2], shape (K,)."""

    wheel_angles: Array = field(init=False, repr=False)
    """Angle turned by left and right wheel at the start and after each step [rad], shape (K + 1, 2)."""

    _steps: Array = field(init=False, repr=False)
    """Columns of each step: first pose (3), wheel angles (2) and rates (2), v, w, acceleration, v_cmd, w_cmd,
    bump; shape (K, 13)."""

    def __post_init__(self) -> None:
        v, w = np.asarray(self.v, float), np.asarray(self.w, float)
        if v.ndim != 1 or v.shape != w.shape or not len(v):
            raise InputError(f"v and w of a Motion must have one shape (K,), got {v.shape} and {w.shape}")
        if not (np.isfinite(v).all() and np.isfinite(w).all()):
            raise InputError("a speed or yaw rate of a Motion is not finite")
        known = {"v": v, "w": w, "wheel_v": v, "wheel_w": w, "v_cmd": v, "w_cmd": w}
        known["bump"] = np.zeros(len(v), bool)
        for name, default in known.items():
            given = getattr(self, name)
            array = default if given is None else np.asarray(given, default.dtype)
            if array.shape != v.shape:
                raise InputError(f"{name} of a Motion must have shape {v.shape}, got {array.shape}")
            known[name] = array
        poses = integrate_twist(v, w, self.dt, self.pose0) if self.poses is None else np.asarray(self.poses)
        if poses.shape != (len(v) + 1, 3):
            raise InputError(f"poses of a Motion must have shape {(len(v) + 1, 3)}, got {poses.shape}")
        steps, angles = mapped.empty((len(v), 13)), mapped.empty((len(v) + 1, 2))
        angles[0], turned = 0.0, np.empty((0, 2))
        for rows in mapped.parts(len(v)):
            rates = wheel_rates(known["wheel_v"][rows], known["wheel_w"][rows], self.drive)
            sums = np.cumsum(np.vstack([turned, rates]), axis=0)[len(turned) :]
            angles[rows.start + 1 : rows.stop + 1], turned = sums * self.dt, sums[-1:]
            acceleration = np.diff(v[rows], prepend=v[rows.start - 1] if rows.start else 0.0) / self.dt
            speeds = (v[rows], w[rows], acceleration, *(known[n][rows] for n in ("v_cmd", "w_cmd", "bump")))
            parts = (poses[rows], angles[rows], rates, *(column[:, None] for column in speeds))
            np.concatenate(parts, axis=1, out=steps[rows], casting="unsafe")
        known |= {"poses": poses, "wheel_angles": angles, "_steps": steps}
        known |= {"wheel_rates": steps[:, 5:7], "acceleration": steps[:, 9]}
        if len(v) > mapped.LONG:  # views of the table, so that only that is kept
            places = {"v": 7, "w": 8, "v_cmd": 10, "w_cmd": 11}
            known |= {name: steps[:, place] for name, place in places.items()}
        for name, array in known.items():
            object.__setattr__(self, name, array)

    @property
    def duration_s(self) -> float:
        """Time from the start to the end of the last step [s]."""
        return len(self.v) * self.dt

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times `t`, exact within the steps; after the last step the robot stands.

        Args:
            t: Times since the start, from 0 [s], shape (N,).
        """
        t = np.asarray(t, float)
        moment = moment_in_steps(self._steps, self.dt, t)
        moving = t < self.duration_s
        if moving.all():
            return moment
        stopped = {name: getattr(moment, name) * moving for name in ("v", "w", "a", "v_cmd", "w_cmd")}
        return replace(moment, **stopped)


def moment_in_steps(steps: Array, dt: float, t: Array, *, first: int = 0) -> Moment:
    """A motion within its control steps, exact.

    Args:
        steps: Columns of each step, as `Motion` keeps them, shape (K, 13).
        dt: Length of a control step [s].
        t: Times within the steps [s], shape (N,).
        first: Number of the first of these steps since the start.
    """
    if len(t):  # only the steps around these times
        low = min(max(int(np.min(t) / dt) - first - 2, 0), len(steps) - 1)
        high = min(max(int(np.max(t) / dt) - first + 3, low + 1), len(steps))
        first, steps = first + low, steps[low:high]
    starts = np.arange(first, first + len(steps)) * dt
    k = np.maximum(np.searchsorted(starts, t, side="right") - 1, 0)
    into = np.clip(t - starts[k], 0.0, dt)
    then = steps.take(k, axis=0)
    v, w, a, v_cmd, w_cmd, bump = then[:, 7:].T
    pose = advance(then[:, :3], v, w, into)
    turned = then[:, 3:5] + then[:, 5:7] * into[:, None]
    return Moment(pose=pose, v=v, w=w, a=a, wheel_angle=turned, v_cmd=v_cmd, w_cmd=w_cmd, bump=bump > 0)
