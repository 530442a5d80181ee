"""A motion that is known at samples: what a physics engine did, or what a Run recorded."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.names import RefusedError
from magtwin.sim.drive import Moment

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledMotion:
    """A motion between whose samples position and heading are cubics with the sampled velocities.

    At a sample it gives what was sampled, to the last bit; before the first and after the last the robot
    stands. Where the twist is constant between samples h apart, a cubic is v w^3 h^4 / 384 off the arc:
    nothing to speak of at 135 Hz, 0.3 mm at 2 Hz and the drive's limits.
    """

    t: Array
    """Times of the samples since the start, the first at 0, ascending [s], shape (K,), K >= 2."""

    pose: Array
    """x [m], y [m], yaw [rad] of base_link in world, shape (K, 3); yaw without jumps."""

    v: Array
    """Forward speed [m/s], shape (K,)."""

    w: Array
    """Yaw rate [rad/s], shape (K,)."""

    wheel_angle: Array
    """Angle turned by the left and the right wheel since the start [rad], shape (K, 2)."""

    v_cmd: Array
    """Commanded forward speed [m/s], shape (K,); nan where it is not known."""

    w_cmd: Array
    """Commanded yaw rate [rad/s], shape (K,); nan where it is not known."""

    bump: NDArray[np.bool_]
    """Whether an obstacle was touched, shape (K,)."""

    duration_s: float
    """Time from the start to the end [s], at least that of the last sample."""

    def __post_init__(self) -> None:
        count = len(self.t)
        shapes = {"pose": (count, 3), "wheel_angle": (count, 2)}
        for name in ("t", "pose", "v", "w", "wheel_angle", "v_cmd", "w_cmd", "bump"):
            array = np.asarray(getattr(self, name), bool if name == "bump" else float)
            if array.shape != shapes.get(name, (count,)):
                raise RefusedError(
                    f"{name} of a motion of {count} samples must have shape {shapes.get(name, (count,))}, "
                    f"got {array.shape}"
                )
            object.__setattr__(self, name, array)
        if count < 2 or self.t[0] != 0 or not np.all(np.diff(self.t) > 0):
            raise RefusedError("a motion needs two samples or more, the first at 0 s, in order of time")
        for name in ("t", "pose", "v", "w", "wheel_angle"):
            if not np.isfinite(getattr(self, name)).all():
                raise RefusedError(f"{name} of a motion is not finite")

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times `t`.

        Args:
            t: Times since the start, from 0 [s], shape (N,).
        """
        t = np.asarray(t, float)
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

    @property
    def acceleration(self) -> Array:
        """Forward acceleration at the samples, by central differences of the speed [m/s2], shape (K,)."""
        return np.gradient(self.v, self.t)
