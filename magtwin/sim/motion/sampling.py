"""Sampling: motions at the times of samples, in the axes of sensors."""

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

MOST_SAMPLES = 20_000_000
"""Most samples of one sensor in a run: some GB of noise."""


class Moving(Protocol):
    """The motion of a robot, from any engine."""

    def at(self, t: ArrayLike) -> Moment:
        """Pose, speeds and wheels at times from 0 [s], shape (N,)."""


def check_count(what: str, duration_s: float, rate_hz: float) -> None:
    """Refuse more than `MOST_SAMPLES` of something in a run."""
    if not duration_s * rate_hz <= MOST_SAMPLES:
        raise InputError(
            f"{what} of {rate_hz:g} Hz would be {duration_s * rate_hz:.3g} in {duration_s:g} s, more than "
            f"{MOST_SAMPLES:,}; make the rate lower, or the time shorter"
        )


def moment_at(motion: Moving, stamps: Array) -> Moment:
    """The motion at the times of samples [s], shape (N,); before 0 the robot stands."""
    moment = motion.at(np.maximum(stamps, 0.0))
    before = int(np.searchsorted(stamps, 0.0))
    if not before:
        return moment
    going = np.ones(len(stamps))
    going[:before] = 0.0
    return replace(moment, v=moment.v * going, w=moment.w * going, a=moment.a * going)


def into_sensor(v_base: Array, q_base_sensor_xyzw: Quat) -> Array:
    """Vectors (..., 3) turned from base_link's axes into those of a sensor."""
    # For so few columns einsum is faster than `@`, which wakes the threads of a BLAS.
    return np.einsum("...i,ij->...j", v_base, axes_in_base(tuple(q_base_sensor_xyzw)))


@lru_cache(maxsize=64)
def axes_in_base(q_base_sensor_xyzw: Quat) -> Array:
    """Read-only matrix from a sensor's axes to base_link's, shape (3, 3)."""
    matrix = matrix_from_quat(q_base_sensor_xyzw)
    matrix.flags.writeable = False
    return matrix
