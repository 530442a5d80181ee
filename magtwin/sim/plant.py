"""Plant: the field of a robot that its linear platform model leaves out.

    B = H sum_i w_i P_i[b] + sum_j (1 - exp(-(t + t0) / tau_j)) (h_j + s_j b)
        + m_1 sum |T| + m_2 sum T^2 + on (l_v |v| + l_i i) + B_dipole(r(t), m(t))

with b the ambient field in base_link axes.

* Hysteresis: the Prandtl-Ishlinskii model, a weighted sum of play operators (Brokate and Sprekels,
  Hysteresis and Phase Transitions, 1996, ch. 2; Kuhnen, European Journal of Control 9, 2003), for each
  component of b: P_i[b](t_k) = max(b_k - r_i, min(b_k + r_i, P_i[b](t_{k-1}))). Demagnetised iron begins with
  P_i = 0. Between two readings b is taken as monotone.
* Warm-up: remanence and permeability change with temperature, which rises exponentially.
* Nonlinear currents: |T| and T^2 of the wheels' torques T, and the LiDAR's supply with speed v and current i.
* Moving part: a dipole that pans about the vertical; see `magtwin.field.sources.dipoles`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.sources.dipoles import MU_0_OVER_4_PI, NT_PER_T
from magtwin.spec.plant import PlantSpec

Array = NDArray[np.float64]

BLOCK = 2048
"""Readings whose play is computed at a time: their arrays stay in the cache."""


class Plant:
    """A robot's plant in a run, continued from call to call."""

    def __init__(self, spec: PlantSpec) -> None:
        """Begin a run with the plant as it is in its session."""
        self.spec = spec
        self.needs_torques = any(spec.motor_abs_nt_nm) or any(spec.motor_square_nt_nm2)
        self._played = play(np.array([spec.start_field_nt]), spec.play_thresholds_nt)[-1]

    def field_nt(
        self,
        t: ArrayLike,
        b_base: Array,
        *,
        torques_nm: ArrayLike = (0.0, 0.0),
        speed: ArrayLike = 0.0,
        lidar_on: ArrayLike = False,
        supply_a: ArrayLike = 0.0,
    ) -> Array:
        """The field at the next readings; one call for a run and many for its pieces give the same bytes.

        Args:
            t: Times since the start of the run [s], shape (N,).
            b_base: Ambient field in base_link axes [nT], shape (N, 3); a row with nan keeps the hysteresis.
            torques_nm: Torques of left and right wheel [N m], shape (N, 2).
            speed: Forward speed [m/s], shape (N,).
            lidar_on: Whether the LiDAR is on, shape (N,).
            supply_a: Supply current above that at rest [A], shape (N,).

        Returns:
            Field in base_link axes [nT], shape (N, 3); nan where hysteresis or warm-up meets a nan.
        """
        spec, b = self.spec, np.asarray(b_base, float)
        field, t = np.zeros(b.shape), np.asarray(t, float)
        if any(spec.hysteresis):
            played = play(b, spec.play_thresholds_nt, self._played)
            if len(played):
                self._played = played[-1]
            weighted = sum(w * played[..., i, :] for i, w in enumerate(spec.play_weights))
            field += _turned(np.reshape(spec.hysteresis, (3, 3)), weighted + 0.0 * b)
        for j, tau in enumerate(spec.warm_up_s):
            warm = -np.expm1(-(t + spec.warm_up_age_s) / tau)[:, None]
            field += warm * np.array(spec.warm_up_nt[3 * j : 3 * j + 3])
            field += warm * spec.warm_up_soft_iron[j] * b
        torques, on = np.asarray(torques_nm, float), np.asarray(lidar_on, bool)
        for name, amount in (
            ("motor_abs_nt_nm", np.abs(torques[..., 0]) + np.abs(torques[..., 1])),
            ("motor_square_nt_nm2", torques[..., 0] ** 2 + torques[..., 1] ** 2),
            ("lidar_speed_nt_s_m", on * np.abs(speed)),
            ("lidar_supply_nt_a", on * np.asarray(supply_a, float)),
        ):
            if any(getattr(spec, name)):
                field += np.asarray(amount)[..., None] * np.array(getattr(spec, name))
        if any(spec.moving_moment):
            field += self._moving_nt(t)
        return field

    def _moving_nt(self, t: Array) -> Array:
        """Field of the panning dipole: mu_0 / 4 pi (3 (m . u) u - m) / |r|^3."""
        spec, angle = self.spec, self.pan(t)
        cos, sin = np.cos(angle), np.sin(angle)
        x, y, z = spec.moving_moment
        m = np.stack([cos * x - sin * y, sin * x + cos * y, z + 0.0 * cos], axis=-1)
        arm = spec.moving_arm_m
        px, py, pz = spec.p_magnetometer_moving
        r = -np.stack([px + arm * cos, py + arm * sin, pz + 0.0 * cos], axis=-1)
        d = np.sqrt(np.sum(r * r, axis=-1, keepdims=True))
        along = 3 * np.sum(m * r, axis=-1, keepdims=True) * r / d**5
        return np.asarray(NT_PER_T * MU_0_OVER_4_PI * (along - m / d**3))

    def pan(self, t: ArrayLike) -> Array:
        """Pan angle of the moving part: a triangle over time whose tips are cut off where it rests [rad]."""
        spec = self.spec
        cycles = np.asarray(t, float) / spec.pan_period_s + spec.pan_phase
        triangle = 4 * np.abs(cycles - np.floor(cycles) - 0.5) - 1
        return np.asarray(spec.pan_range * np.clip(triangle / (1 - spec.pan_dwell), -1, 1))


def play(u: ArrayLike, thresholds: ArrayLike, before: ArrayLike | None = None) -> Array:
    """Play operators: w_k = max(u_k - r, min(u_k + r, w_{k-1})).

    A step limits w to [u_k - r, u_k + r], and a limit after a limit is one too. So the steps of a block are
    combined in log2 K passes (Hillis and Steele, 1986). Limits are exact, so the result has the bytes of the
    loop.

    Args:
        u: Input, shape (K, ...); a nan leaves w as it is.
        thresholds: r of each operator, shape (P,).
        before: w before the first sample, shape (..., P, C) for inputs (K, ..., C). Default: 0.

    Returns:
        w after each sample, shape (K, ..., P, C).
    """
    inputs, r = np.asarray(u, float), np.asarray(thresholds, float)
    played = np.empty((*inputs.shape[:-1], len(r), inputs.shape[-1]))
    last = 0.0 if before is None else np.asarray(before, float)
    for first in range(0, len(inputs), BLOCK):
        rows = slice(first, first + BLOCK)
        played[rows] = _play_block(inputs[rows, ..., None, :], r[:, None], last)
        last = played[rows][-1]
    return played


def _play_block(u: Array, r: Array, before: ArrayLike) -> Array:
    """`play` of a block, in log2 K passes."""
    low = np.where(np.isnan(u), -np.inf, u - r)
    high = np.where(np.isnan(u), np.inf, u + r)
    step = 1
    while step < len(low):
        first, then = slice(None, -step), slice(step, None)
        lower = np.maximum(low[then], np.minimum(high[then], low[first]))
        high[then] = np.maximum(low[then], np.minimum(high[then], high[first]))
        low[then] = lower
        step *= 2
    return np.asarray(np.maximum(low, np.minimum(high, before)))


def _turned(matrix: Array, vectors: Array) -> Array:
    """A matrix (3, 3) times vectors (..., 3)."""
    return np.stack([sum(row[k] * vectors[..., k] for k in range(3)) for row in matrix], axis=-1)
