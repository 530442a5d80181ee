"""What a magnetometer makes of a field: one of the optically pumped kind, scalar, with vector axes in turn.

A scalar reading goes through, in this order: heading error, the clock's offset, a first-order low-pass,
white and 1/f noise, rounding to the resolution; where lock is lost a value that stays; and what is dropped
is missing. All that differs from the field put in is the sensor's own doing, so

    b_noise_nt = b_measured_nt - b_total_nt

holds by construction. Noise is drawn reading by reading, so a longer run begins with the same numbers as
a shorter one.
"""

import copy
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.sensors.noise import first_order, gauss_markov
from magtwin.spec.sensors import MagnetometerSpec

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Columns = dict[str, NDArray[Any]]

LOCK_RATE_HZ = 5.0
"""How often it is seen whether the field is too steep [Hz]: every 6 cm at the TurtleBot 4's top speed, over
which fields of things that lie half a metre away hardly change."""

FLICKER_LOWEST_HZ = 1e-3
"""Frequency below which 1/f noise is flat: a run of a quarter of an hour [Hz]."""

FLICKER_STEP = 5.0
"""Ratio of the corners of the processes that make up 1/f noise; their sum is off it by under 1 %."""


def sense_magnetometer(
    spec: MagnetometerSpec,
    b_total_nt: ArrayLike,
    b_vector_nt: ArrayLike,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    steep: ArrayLike = False,
    axes: bool = True,
) -> Columns:
    """Scalar and vector readings of a field.

    Args:
        spec: The sensor.
        b_total_nt: Field magnitude at each reading [nT], shape (N,); nan stays nan.
        b_vector_nt: Field in the sensor's axes [nT], shape (N, 3); nan where it is not known, and then
            neither heading error nor dead zones.
        rng: Source of noise.
        rate_hz: Readings a second [Hz].
        steep: Whether lock is lost to the gradient, shape (N,); see `lost_in`.
        axes: Whether the vector's readings are wanted too.

    Returns:
        b_measured_nt, b_noise_nt, flag_lost_lock, and b_vector_measured_nt where it is wanted.
    """
    noise, vector_noise, latch, drop = rng.spawn(4)
    true, vector = np.asarray(b_total_nt, float), np.asarray(b_vector_nt, float)
    along = along_axis(vector) if feels_direction(spec) else np.full(len(true), np.nan)
    lost = np.broadcast_to(np.asarray(steep, bool), true.shape) | in_dead_zone(spec, along)
    known = np.isfinite(true)
    b = true
    if spec.heading_error_nt:
        b = b + spec.heading_error_nt * np.nan_to_num(along)
    if spec.clock_offset_s or spec.bandwidth_hz:
        b = _low_passed(_late(_filled(b), spec.clock_offset_s * rate_hz), spec.bandwidth_hz / rate_hz)
    read = b + sensor_noise_nt(spec, len(b), rate_hz, noise)
    if lost.any():
        read[lost] = latched_nt(spec, lost, latch)[lost]
    read = rounded(read, spec.resolution_nt)
    read[~known] = np.nan
    columns: Columns = {}
    if axes:
        columns["b_vector_measured_nt"] = sense_vector(spec, vector, vector_noise, rate_hz=rate_hz, lost=lost)
    if spec.dropout_share:
        dropped = drop.random(len(read)) < spec.dropout_share
        for dropping in (read, *columns.values()):
            dropping[dropped] = np.nan
    return columns | {"b_measured_nt": read, "b_noise_nt": read - true, "flag_lost_lock": lost}


def sense_axes(
    spec: MagnetometerSpec,
    b_vector_nt: ArrayLike,
    rng: np.random.Generator,
    *,
    rate_hz: float,
    steep: ArrayLike = False,
) -> Array:
    """The b_vector_measured_nt that `sense_magnetometer` will give from the same generator, which is kept.

    The axes read the field whatever the magnitude is thought to be, so a network that predicts that may
    read them first. The arguments are those of `sense_magnetometer`.
    """
    _, noise, _, drop = copy.deepcopy(rng).spawn(4)
    vector = np.asarray(b_vector_nt, float)
    along = along_axis(vector) if feels_direction(spec) else np.full(len(vector), np.nan)
    lost = np.broadcast_to(np.asarray(steep, bool), along.shape) | in_dead_zone(spec, along)
    read = sense_vector(spec, vector, noise, rate_hz=rate_hz, lost=lost)
    if spec.dropout_share:
        read[drop.random(len(read)) < spec.dropout_share] = np.nan
    return read


def sense_vector(
    spec: MagnetometerSpec, b_vector_nt: ArrayLike, rng: np.random.Generator, *, rate_hz: float, lost: Flags
) -> Array:
    """Readings of three axes that are measured in turn, each every third time and held until its next.

    Axis i reads (1 + s_i) u_i . b + c_i and white noise, u_i the unit vector along e_i plus row i of
    `vector_misalignment`. Before the first reading the sensor has been where that is. While lock is lost
    nothing is measured.

    Args:
        spec: The sensor.
        b_vector_nt: Field in the sensor's axes [nT], shape (N, 3); nan where unknown.
        rng: Source of noise.
        rate_hz: Readings a second [Hz].
        lost: Whether lock is lost, shape (N,).

    Returns:
        The latest reading of each axis [nT], shape (N, 3); nan before there is one.
    """
    b = np.asarray(b_vector_nt, float)
    if np.isnan(b).all():
        return np.full(b.shape, np.nan)
    measured = np.concatenate([b[:1], b[:1], b])  # two readings ago to now
    axis = np.arange(len(measured)) % 3
    gain, bias = vector_gain(spec), np.array(spec.vector_bias_nt)
    read = np.einsum("ni,ni->n", measured, gain[axis]) + bias[axis]
    std = spec.vector_noise_density_nt * math.sqrt(rate_hz / 3 / 2)
    read = rounded(read + std * rng.standard_normal(len(read)), spec.resolution_nt)
    fine = np.isfinite(read) & ~np.concatenate([lost[:1], lost[:1], lost])
    held = np.empty(measured.shape)
    for k in range(3):
        latest = np.maximum.accumulate(np.where(fine & (axis == k), np.arange(len(read)), -1))
        held[:, k] = np.where(latest >= 0, read[latest], np.nan)
    return held[2:]


def vector_gain(spec: MagnetometerSpec) -> Array:
    """What each axis of the vector magnetometer reads of the field, (1 + s_i) u_i by rows, shape (3, 3)."""
    axes = np.eye(3) + np.reshape(spec.vector_misalignment, (3, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.asarray(axes * (1 + np.array(spec.vector_scale))[:, None])


def sensor_noise_nt(spec: MagnetometerSpec, count: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """White and 1/f noise of readings, of one-sided power density d^2 (1 + f_c / f) up to half the rate.

    White readings of density d have the variance d^2 rate / 2. The 1/f part is a sum of first-order
    Gauss-Markov processes whose corners f_i ascend by a ratio r, each of variance d^2 f_c ln r: where the
    corners lie dense, sum_i 2 d^2 f_c ln r / (pi f_i) / (1 + (f / f_i)^2) = d^2 f_c / f (van der Ziel 1950).

    Args:
        spec: Density d and corner f_c.
        count: Readings.
        rate_hz: Readings a second [Hz].
        rng: Source of noise.

    Returns:
        Noise [nT], shape (count,).
    """
    white, slow = rng.spawn(2)
    noise = spec.noise_density_nt * math.sqrt(rate_hz / 2) * white.standard_normal(count)
    if spec.noise_density_nt and spec.flicker_corner_hz:
        std = spec.noise_density_nt * math.sqrt(spec.flicker_corner_hz * math.log(FLICKER_STEP))
        for corner, own in zip(corners := flicker_corners_hz(rate_hz), slow.spawn(len(corners)), strict=True):
            noise += std * gauss_markov(own.standard_normal(count), 1 / (2 * math.pi * corner), rate_hz)
    return noise


def flicker_corners_hz(rate_hz: float) -> list[float]:
    """Corners of the processes that make up 1/f noise [Hz], ascending to half the rate of the readings."""
    steps = math.log(max(rate_hz / 2 / FLICKER_LOWEST_HZ, 1.0)) / math.log(FLICKER_STEP)
    return [FLICKER_LOWEST_HZ * FLICKER_STEP**k for k in range(int(steps) + 1)]


def lost_in(spec: MagnetometerSpec, gradient_nt_m: ArrayLike) -> Flags:
    """Whether lock is lost as the gradient goes up and down.

    It is lost above `gradient_max_nt_m` and found again below `gradient_relock_nt_m`; in between it stays
    as it was, at first found.

    Args:
        spec: The two limits.
        gradient_nt_m: Gradient of the field's magnitude in the order of time [nT/m], shape (N,); nan where
            it is not known, which changes nothing.

    Returns:
        Flags, shape (N,).
    """
    gradient = np.asarray(gradient_nt_m, float)
    if not spec.gradient_max_nt_m:
        return np.zeros(gradient.shape, bool)
    lost, found = gradient > spec.gradient_max_nt_m, gradient < spec.gradient_relock_nt_m
    latest = np.maximum.accumulate(np.where(lost | found, np.arange(len(gradient)), -1))
    return np.asarray(lost[latest] & (latest >= 0))


def latched_nt(spec: MagnetometerSpec, lost: Flags, rng: np.random.Generator) -> Array:
    """What is read while lock is lost: a value of its own for each time that it is.

    Args:
        spec: Its mean and spread.
        lost: Whether lock is lost, in the order of time, shape (N,).
        rng: Source of the values.

    Returns:
        Readings [nT], shape (N,); of use where lock is lost.
    """
    begins = lost & ~np.concatenate([[False], lost[:-1]])
    values = spec.stuck_nt + spec.stuck_std_nt * rng.standard_normal(int(begins.sum()) + 1)
    return np.asarray(values[np.cumsum(begins)])


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


def _filled(b: Array) -> Array:
    """Readings with the last known one where there is none, so that what follows a gap is not lost too."""
    known = np.isfinite(b)
    if known.all() or not known.any():
        return b
    latest = np.maximum.accumulate(np.where(known, np.arange(len(b)), -1))
    return np.asarray(b[np.where(latest >= 0, latest, int(np.argmax(known)))])


def _late(b: Array, readings: float) -> Array:
    """Readings as they were some readings ago, not whole ones neither; the ends are held."""
    if not readings:
        return b
    now = np.arange(len(b), dtype=float)
    return np.interp(now - readings, now, b)


def _low_passed(b: Array, bandwidth: float) -> Array:
    """Readings through tau dy/dt = b - y, tau = 1 / (2 pi bandwidth) in readings; from its own settled state.

    Exact for a field that is linear between readings: it lags behind a ramp by tau.
    """
    if not bandwidth:
        return b
    tau = 1 / (2 * math.pi * bandwidth)
    decay = math.exp(-1 / tau)
    share = -math.expm1(-1 / tau) * tau  # of the earlier of two readings, and what has decayed of it
    put_in = b.copy()
    put_in[1:] = (1 - share) * b[1:] + (share - decay) * b[:-1]
    return first_order(put_in, decay)
