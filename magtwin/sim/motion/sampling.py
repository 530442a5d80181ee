"""What the robot's sensors share: a clock each, and the axes that they read in.

A sensor takes sample k at the time k / rate_hz. It arrives `latency_s` later, and later still by a delay
of its own, exponentially distributed with the mean `jitter_s`; samples arrive in order. A reading of
the magnetometer at time t sees the newest sample that has arrived by t, so nothing is ever from the
future. Before t = 0 the robot has long been standing at its first pose, and samples were taken of that.
Noise is drawn sample by sample, so a longer run begins with the same numbers as a shorter one.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat
from magtwin.sim.motion.drive import Moment
from magtwin.spec.base import Quat

Array = NDArray[np.float64]
Columns = dict[str, NDArray[np.float64]]


MOST_SAMPLES = 20_000_000
"""Most samples of one sensor in a run: some GB of noise."""


class Moving(Protocol):
    """Whatever tells where the robot is: any engine's motion."""

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times from 0 [s], shape (N,)."""


def held(
    t: ArrayLike,
    rate_hz: float,
    *,
    latency_s: float = 0.0,
    jitter_s: float = 0.0,
    rng: np.random.Generator | None = None,
) -> tuple[Array, NDArray[np.intp]]:
    """The samples of a sensor that readings see, held causally.

    Args:
        t: Times of the readings, ascending from 0 or later [s], shape (N,), N >= 1.
        rate_hz: Samples a second [Hz].
        latency_s: Time that each sample takes to arrive [s].
        jitter_s: Mean of the further delay of each sample [s].
        rng: Source of the delays, a number a sample; not needed where `jitter_s` is 0.

    Returns:
        Times of the samples, k / rate_hz from the first that a reading can see up to the last that there
        was [s], shape (M,); and for each reading the index of the newest sample that has arrived by
        then, shape (N,). The first sample, of time 0 or before, has always arrived.

    Raises:
        InputError: There are more samples than memory could hold.
    """
    t = np.asarray(t, float)
    check_count("samples of a sensor", t[-1] + latency_s, rate_hz)
    first = -math.ceil(latency_s * rate_hz)
    stamps = np.arange(first, int(t[-1] * rate_hz) + 2) / rate_hz
    stamps = stamps[: int(np.searchsorted(stamps, t[-1], side="right"))]
    arrivals = stamps + latency_s if latency_s else stamps
    if jitter_s > 0 and rng is not None:
        arrivals = np.maximum.accumulate(arrivals + rng.exponential(jitter_s, len(stamps)))
    return stamps, np.maximum(np.searchsorted(arrivals, t, side="right") - 1, 0)


def check_count(what: str, duration_s: float, rate_hz: float) -> None:
    """Refuse more of something in a run than memory could hold: `MOST_SAMPLES`."""
    if not duration_s * rate_hz <= MOST_SAMPLES:
        raise InputError(
            f"{what} of {rate_hz:g} Hz would be {duration_s * rate_hz:.3g} in {duration_s:g} s, more than "
            f"{MOST_SAMPLES:,}; make the rate lower, or the time shorter"
        )


def moment_at(motion: Moving, stamps: Array) -> Moment:
    """What the robot did at the times of samples [s], shape (N,); before 0 it stands."""
    moment = motion.at(np.maximum(stamps, 0.0))
    before = int(np.searchsorted(stamps, 0.0))
    if not before:
        return moment
    going = np.ones(len(stamps))
    going[:before] = 0.0
    return replace(moment, v=moment.v * going, w=moment.w * going, a=moment.a * going)


def into_sensor(v_base: Array, q_base_sensor_xyzw: Quat) -> Array:
    """Vectors (..., 3) turned from base_link's axes into those of a sensor."""
    # einsum, as a product of so few columns is no work for the threads of a BLAS that `@` wakes.
    return np.einsum("...i,ij->...j", v_base, axes_in_base(tuple(q_base_sensor_xyzw)))


@lru_cache(maxsize=64)
def axes_in_base(q_base_sensor_xyzw: Quat) -> Array:
    """Matrix from a sensor's axes to base_link's, shape (3, 3), not to be written to."""
    matrix = matrix_from_quat(q_base_sensor_xyzw)
    matrix.flags.writeable = False
    return matrix
