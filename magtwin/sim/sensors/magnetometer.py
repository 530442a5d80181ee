"""Magnetometer: the readings that an optically pumped sensor makes of a field, scalar and by axis.

A scalar reading goes through, in this order: heading error, the clock's offset, a first-order low-pass, white
and 1/f noise, and rounding to the resolution. While lock is lost, the reading is a stuck value. Readings that
drop out are missing. All that differs from the field is the sensor's error, so by construction

    b_noise_nt = b_measured_nt - b_total_nt
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.sensors.noise import gauss_markov
from magtwin.sim.sensors.stateful import Stateful
from magtwin.spec.sensors import MagnetometerSpec

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Columns = dict[str, NDArray[Any]]

LOCK_RATE_HZ = 5.0
"""Rate at which the steepness of the field is checked [Hz]: every 6 cm at the TurtleBot 4's top speed. Fields
of things half a metre away hardly change over that."""

FLICKER_LOWEST_HZ = 1e-3
"""Frequency below which 1/f noise is flat [Hz]: one period in a quarter of an hour."""

FLICKER_STEP = 5.0
"""Ratio of the corners of the processes that make up 1/f noise; their sum is off by under 1 %."""


class Magnetometer(Stateful):
    """A magnetometer that reads a field in pieces of any length.

    For each piece call `axes`, then `read`. If the clock is behind (`clock_offset_s` below 0), a reading is
    of a later field: the last of a piece stands for all that follow.
    """

    def __init__(self, spec: MagnetometerSpec, rate_hz: float, rng: np.random.Generator) -> None:
        """Switch the sensor on."""
        noise, self._vector_rng, self._stuck_rng, self._drop_rng = rng.spawn(4)
        noisy = bool(spec.noise_density_nt and spec.flicker_corner_hz)
        self._corners_hz = flicker_corners_hz(rate_hz) if noisy else []
        super().__init__(noise, flicker=noise.standard_normal(len(self._corners_hz)))
        self._spec, self._rate = spec, rate_hz
        self._turn = 0
        self._held_axes = np.full(3, np.nan)
        self._was_lost, self._stuck = False, math.nan
        self._past: Array | None = None
        self._last_known = math.nan
        self._low_pass: float | None = None
        self._lost, self._dropped = np.zeros(0, bool), np.zeros(0, bool)

    def axes(self, b_vector_nt: ArrayLike, *, steep: ArrayLike = False) -> Array:
        """The next readings of three axes that are measured in turn, each every third time, and held.

        Axis i reads (1 + s_i) u_i . b + c_i and white noise, u_i the unit vector along e_i plus row i of
        `vector_misalignment`. Before the first reading the sensor stood still. While lock is lost nothing is
        measured.

        Args:
            b_vector_nt: Field in the sensor's axes [nT], shape (N, 3); nan if unknown.
            steep: Whether lock is lost to the gradient, shape (N,); see `lost_in`.

        Returns:
            The latest reading of each axis [nT], shape (N, 3); nan before the first.
        """
        spec, b = self._spec, np.asarray(b_vector_nt, float)
        self._find_lost(b, steep)
        before = 2 if self._turn == 0 and len(b) else 0
        measured = np.concatenate([b[:1]] * before + [b])
        lost = np.concatenate([self._lost[:1]] * before + [self._lost])
        axis = (self._turn + np.arange(len(measured))) % 3
        self._turn += len(measured)
        gain, bias = vector_gain(spec)[axis], np.array(spec.vector_bias_nt)[axis]
        read = gain[:, 0] * measured[:, 0] + gain[:, 1] * measured[:, 1] + gain[:, 2] * measured[:, 2] + bias
        std = spec.vector_noise_density_nt * math.sqrt(self._rate / 3 / 2)
        read = rounded(read + std * self._vector_rng.standard_normal(len(read)), spec.resolution_nt)
        fine = np.isfinite(read) & ~lost
        held = np.empty(measured.shape)
        for k in range(3):
            held[:, k] = _hold(np.where(fine & (axis == k), read, np.nan), self._held_axes[k])
        self._held_axes = held[-1].copy() if len(held) else self._held_axes
        held = held[before:]
        held[self._dropped] = np.nan
        return held

    def skip_axes(self, b_vector_nt: ArrayLike, *, steep: ArrayLike = False) -> None:
        """In place of `axes`, if nobody reads the vector: find only where lock is lost."""
        self._find_lost(np.asarray(b_vector_nt, float), steep)

    def read(self, b_total_nt: ArrayLike, b_vector_nt: ArrayLike) -> Columns:
        """The scalar readings of the piece whose axes were read last.

        Args:
            b_total_nt: Field magnitude at each reading [nT], shape (N,); nan stays nan.
            b_vector_nt: Field in the sensor's axes [nT], shape (N, 3). If it is nan, there is neither heading
                error nor a dead zone.

        Returns:
            b_measured_nt, b_noise_nt, flag_lost_lock.
        """
        spec, true, lost = self._spec, np.asarray(b_total_nt, float), self._lost
        known, b = np.isfinite(true), true
        if spec.heading_error_nt:
            b = b + spec.heading_error_nt * np.nan_to_num(along_axis(np.asarray(b_vector_nt, float)))
        if spec.clock_offset_s or spec.bandwidth_hz:
            b = self._low_passed(self._late(self._filled(b)))
        read = b + self._noise_nt(len(b))
        if len(lost):
            stuck = stuck_nt(spec, lost, self._stuck_rng, was_lost=self._was_lost, before=self._stuck)
            read = np.where(lost, stuck, read)
            self._was_lost, self._stuck = bool(lost[-1]), float(stuck[-1])
        read = rounded(read, spec.resolution_nt)
        read[~known] = np.nan
        read[self._dropped] = np.nan
        return {"b_measured_nt": read, "b_noise_nt": read - true, "flag_lost_lock": lost}

    def noisy(self, b_total_nt: Array) -> Array:
        """The next readings with white and 1/f noise and rounding alone [nT], shape (N,), or (N, R)."""
        return rounded(b_total_nt + self._noise_nt(len(b_total_nt)), self._spec.resolution_nt)

    def _find_lost(self, b_vector_nt: Array, steep: ArrayLike) -> None:
        spec, count = self._spec, len(b_vector_nt)
        along = along_axis(b_vector_nt) if feels_direction(spec) else np.full(count, np.nan)
        self._lost = np.broadcast_to(np.asarray(steep, bool), count) | in_dead_zone(spec, along)
        share = spec.dropout_share
        self._dropped = self._drop_rng.random(count) < share if share else np.zeros(count, bool)

    def _noise_nt(self, count: int) -> Array:
        """White and 1/f noise, of one-sided power density d^2 (1 + f_c / f) up to half the rate [nT].

        White readings of density d have the variance d^2 rate / 2. The 1/f part is a sum of first-order
        Gauss-Markov processes whose corners f_i ascend by a ratio r, each of variance d^2 f_c ln r. If the
        corners lie dense, sum_i 2 d^2 f_c ln r / (pi f_i) / (1 + (f / f_i)^2) = d^2 f_c / f (van der Ziel
        1950).
        """
        density = self._spec.noise_density_nt
        white = self.normal(count, 1 + len(self._corners_hz))
        noise = density * math.sqrt(self._rate / 2) * white[..., 0]
        std = density * math.sqrt(self._spec.flicker_corner_hz * math.log(FLICKER_STEP))
        flicker = self.state["flicker"].copy()
        for k, corner in enumerate(self._corners_hz):
            time_s = 1 / (2 * math.pi * corner)
            process, flicker[..., k] = gauss_markov(white[..., 1 + k], flicker[..., k], time_s, self._rate)
            noise += std * process
        self.state["flicker"] = flicker
        return noise

    def _filled(self, b: Array) -> Array:
        """The last known reading in place of an unknown one, so that a gap spoils nothing after it."""
        known = np.isfinite(b)
        if not math.isfinite(self._last_known):
            if not known.any():
                return b
            self._last_known = float(b[np.argmax(known)])
        b = _hold(b, self._last_known)
        self._last_known = float(b[-1]) if len(b) else self._last_known
        return b

    def _late(self, b: Array) -> Array:
        """Readings as they were some readings before; linear between them, the ends are held."""
        late = self._spec.clock_offset_s * self._rate
        if not late or not len(b) or not np.isfinite(b[-1]):
            return b
        whole, part = math.floor(late), late - math.floor(late)
        if late < 0:
            b = np.concatenate([b, np.full(-whole, b[-1])])
            return (1 - part) * b[-whole:] + part * b[-whole - 1 : -1]
        past = np.full(whole + 1, b[0]) if self._past is None else self._past
        b = np.concatenate([past, b])
        self._past = b[len(b) - len(past) :]
        return (1 - part) * b[1 : len(b) - whole] + part * b[: len(b) - whole - 1]

    def _low_passed(self, b: Array) -> Array:
        """Readings through tau dy/dt = b - y, tau = 1 / (2 pi bandwidth), from its settled state.

        Exact for a field that is linear between readings: it lags behind a ramp by tau.
        """
        if not self._spec.bandwidth_hz or not len(b) or not np.isfinite(b[-1]):
            return b
        tau = self._rate / (2 * math.pi * self._spec.bandwidth_hz)
        decay, share = math.exp(-1 / tau), -math.expm1(-1 / tau) * tau
        if self._low_pass is None:
            self._low_pass = share * float(b[0])
        filtered, carried = np.empty(len(b)), self._low_pass
        for k, reading in enumerate(b.tolist()):
            filtered[k] = out = (1 - share) * reading + carried
            carried = (share - decay) * reading + decay * out
        self._low_pass = carried
        return filtered


def vector_gain(spec: MagnetometerSpec) -> Array:
    """What each axis of the vector magnetometer reads of the field, (1 + s_i) u_i by rows, shape (3, 3)."""
    axes = np.eye(3) + np.reshape(spec.vector_misalignment, (3, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.asarray(axes * (1 + np.array(spec.vector_scale))[:, None])


def flicker_corners_hz(rate_hz: float) -> list[float]:
    """Corners of the processes that make up 1/f noise [Hz], ascending to half the rate of the readings."""
    steps = math.log(max(rate_hz / 2 / FLICKER_LOWEST_HZ, 1.0)) / math.log(FLICKER_STEP)
    return [FLICKER_LOWEST_HZ * FLICKER_STEP**k for k in range(int(steps) + 1)]


def lost_in(spec: MagnetometerSpec, gradient_nt_m: ArrayLike, *, before: bool = False) -> Flags:
    """Whether lock is lost as the gradient goes up and down.

    It is lost above `gradient_max_nt_m` and found again below `gradient_relock_nt_m`. In between it stays as
    it was.

    Args:
        spec: The two limits.
        gradient_nt_m: Gradient of the field's magnitude in the order of time [nT/m], shape (N,); nan if
            unknown, which changes nothing.
        before: Whether it was lost before the first.

    Returns:
        Flags, shape (N,).
    """
    gradient = np.asarray(gradient_nt_m, float)
    if not spec.gradient_max_nt_m:
        return np.zeros(gradient.shape, bool)
    found = np.where(gradient < spec.gradient_relock_nt_m, 0.0, np.nan)
    return _hold(np.where(gradient > spec.gradient_max_nt_m, 1.0, found), float(before)) > 0


def stuck_nt(
    spec: MagnetometerSpec,
    lost: Flags,
    rng: np.random.Generator,
    *,
    was_lost: bool = False,
    before: float = math.nan,
) -> Array:
    """The value at which readings are stuck, drawn anew each time that lock is lost.

    Returns:
        Readings [nT], shape (N,); meaningful if lock is lost.
    """
    begins = lost & ~np.concatenate([[was_lost], lost[:-1]])
    drawn = spec.stuck_nt + spec.stuck_std_nt * rng.standard_normal(np.count_nonzero(begins))
    return np.concatenate([[before], drawn])[np.cumsum(begins)]


def rounded(b_nt: Array, resolution_nt: float) -> Array:
    """The nearest multiples of a step [nT]; as they are where it is 0."""
    return np.rint(b_nt / resolution_nt) * resolution_nt if resolution_nt else b_nt


def feels_direction(spec: MagnetometerSpec) -> bool:
    """Whether a scalar reading depends on the direction of the field: by heading error or dead zones."""
    return bool(spec.heading_error_nt or spec.dead_zone_axis or spec.dead_zone_plane)


def along_axis(b_vector_nt: Array) -> Array:
    """Cosine of the angle between the field and the sensor's own z, its optical axis, shape (N,)."""
    size = np.sqrt(np.sum(b_vector_nt * b_vector_nt, axis=1))
    return np.divide(b_vector_nt[:, 2], size, out=np.full(len(size), np.nan), where=size > 0)


def in_dead_zone(spec: MagnetometerSpec, along: Array) -> Flags:
    """Whether the field is too near to the optical axis, or to the plane across it."""
    off_plane = np.arcsin(np.abs(np.clip(along, -1, 1)))  # nan is in none
    return (np.pi / 2 - off_plane < spec.dead_zone_axis) | (off_plane < spec.dead_zone_plane)


def _hold(values: Array, before: float) -> Array:
    """The latest value that is not nan at each place, `before` until there is one; shape (N,)."""
    latest = np.maximum.accumulate(np.where(np.isnan(values), 0, np.arange(1, len(values) + 1)))
    return np.concatenate([[before], values])[latest]
