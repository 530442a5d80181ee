"""Resampling: a signal at other times.

A rule takes the values at known times, and the position of each wanted time between them as found by
`bracket`. At a known time it gives the known value to the bit. Between a value and nan it gives nan.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import wrap_angle
from magtwin.run import mapped

Array = NDArray[np.float64]
Interpolation = Literal["linear", "hold", "angle", "quaternion"]

MOST_ROWS = 50_000_000  # Largest number of times in a grid


def bracket(t: Array, at: Array) -> tuple[NDArray[np.intp], Array]:
    """Position of times among known times.

    Args:
        t: Known times, ascending [s], shape (N,).
        at: Wanted times within them [s], shape (M,).

    Returns:
        Index of the last known time not after each wanted one, and the fraction of the way to the next, in
        [0, 1); both of shape (M,).
    """
    before = np.searchsorted(t, at, side="right") - 1
    step = t[np.minimum(before + 1, len(t) - 1)] - t[before]
    return before, np.divide(at - t[before], step, out=np.zeros(len(at)), where=step > 0)


def hold(values: NDArray[Any], before: NDArray[np.intp], share: Array) -> NDArray[Any]:
    """The last value before each time, for flags, commands and slow sensors."""
    return values[before]


def linear(values: NDArray[Any], before: NDArray[np.intp], share: Array) -> Array:
    """Linear interpolation."""
    a, b, s = _neighbours(values, before, share)
    with np.errstate(invalid="ignore"):  # inf - inf
        return np.where(s > 0, a + s * (b - a), a)


def angle(values: NDArray[Any], before: NDArray[np.intp], share: Array) -> Array:
    """Angles along the shorter arc, in [-pi, pi) [rad]."""
    a, b, s = _neighbours(values, before, share)
    return np.where(s > 0, wrap_angle(a + s * wrap_angle(b - a)), a)


def quaternion(values: NDArray[Any], before: NDArray[np.intp], share: Array) -> Array:
    """Slerp along the shorter arc (Shoemake 1985).

    q(s) = (sin((1 - s) a) q0 + sin(s a) q1) / sin(a), cos(a) = q0 . q1

    where a is half the angle between them; the sign of q1 makes a at most pi / 2.
    """
    q0, q1, s = _neighbours(values, before, share)
    dot = np.sum(q0 * q1, axis=-1, keepdims=True)
    q1, dot = np.where(dot < 0, -q1, q1), np.clip(np.abs(dot), 0, 1)
    a = np.arccos(dot)
    small = a < 1e-6  # sin(a) = a here, so the arc is a line
    sin_a = np.where(small, 1.0, np.sin(a))
    w0 = np.where(small, 1 - s, np.sin((1 - s) * a) / sin_a)
    w1 = np.where(small, s, np.sin(s * a) / sin_a)
    q = w0 * q0 + w1 * q1
    return np.where(s > 0, q / np.linalg.norm(q, axis=-1, keepdims=True), q0)


RULES: Mapping[str, Callable[[NDArray[Any], NDArray[np.intp], Array], NDArray[Any]]] = MappingProxyType(
    {"linear": linear, "hold": hold, "angle": angle, "quaternion": quaternion}
)
"""Rules by name."""


def grid(start_s: float, end_s: float, rate_hz: float) -> Array:
    """Times from `start_s` to at most `end_s` [s], at a rate [Hz].

    Raises:
        InputError: The rate is not above 0, not finite, or gives more than `MOST_ROWS`.
    """
    if not 0 < rate_hz < np.inf:
        raise InputError(f"rate_hz must be above 0 Hz and finite, got {rate_hz!r}")
    count = (end_s - start_s) * rate_hz
    if count > MOST_ROWS:
        raise InputError(
            f"rate_hz {rate_hz:g} gives {count:.3g} rows in {end_s - start_s:g} s; at most {MOST_ROWS:,}"
        )
    return np.minimum(start_s + np.arange(int(count + 1e-9) + 1) / rate_hz, end_s)


def check_instants(t: ArrayLike, what: str) -> Array:
    """`t` as an array of shape (N,), if it is finite and strictly ascending.

    Raises:
        InputError: It is not; the message names the first wrong row.
    """
    t = np.asarray(t)
    if t.ndim != 1 or t.dtype.kind not in "fiu":
        raise InputError(f"{what}: t must be numbers of shape (N,), got {t.dtype} of shape {t.shape}")
    t = t.astype(float, copy=False)
    if not all(np.isfinite(t[rows]).all() for rows in mapped.parts(len(t))):
        row = int(np.argmin(np.isfinite(t)))
        raise InputError(f"{what}: t must be finite, got {t[row]} in row {row}")
    steps = (np.diff(t[max(rows.start - 1, 0) : rows.stop]) for rows in mapped.parts(len(t)))
    if any((step <= 0).any() for step in steps):
        row = int(np.argmax(np.diff(t) <= 0)) + 1
        raise InputError(
            f"{what}: t must ascend from row to row, but row {row} has {t[row]:.9g} s "
            f"after {t[row - 1]:.9g} s; sort the rows, or drop those that repeat"
        )
    return t


def _neighbours(values: NDArray[Any], before: NDArray[np.intp], share: Array) -> tuple[Array, Array, Array]:
    """The values before and after, and the fraction with their number of axes."""
    values = np.asarray(values, float)
    a, b = values[before], values[np.minimum(before + 1, len(values) - 1)]
    return a, b, share.reshape(-1, *(1,) * (values.ndim - 1))
