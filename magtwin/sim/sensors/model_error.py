"""Model error: the error of a network's prediction in the reading of a neural magnetometer.

A network gives the mean of the disturbance and the standard deviation of its error. A reading is a draw from
that distribution. The error has a part that is constant in a session and a part that changes over seconds, as
on held-out recordings.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.sensors.noise import GaussMarkov

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelError:
    """Statistics of the error of a network's predictions."""

    offset_sd_nt: float
    """Standard deviation of the part that is constant in a session [nT]."""

    time_s: float
    """Correlation time of the rest [s]."""

    offset: float = 0.0
    """Standard normal number of the session; see `in_session`."""

    def in_session(self, rng: np.random.Generator) -> "ModelError":
        """The same statistics with the number of one session drawn."""
        return replace(self, offset=float(rng.standard_normal()))

    def error_nt(self, sd_nt: ArrayLike, process: ArrayLike, offset: ArrayLike | None = None) -> Array:
        """Errors of readings from normal numbers of unit variance.

            e_t = c_t o + sqrt(sd_t^2 - c_t^2) u_t,   c_t = min(offset_sd, sd_t)

        so that e_t has the variance sd_t^2, and a constant offset wherever sd_t is above offset_sd.

        Args:
            sd_nt: Predicted standard deviations [nT], shape (N,); the error is 0 where it is nan.
            process: u at each reading, shape (N,).
            offset: o of each reading, shape (N,), if readings belong to several sessions. Default: `offset`.

        Returns:
            Errors [nT], shape (N,).
        """
        sd = np.nan_to_num(np.asarray(sd_nt, float))
        constant = np.minimum(self.offset_sd_nt, sd)
        rest = np.sqrt(np.maximum(sd * sd - constant * constant, 0.0))
        o = self.offset if offset is None else np.asarray(offset, float)
        return np.asarray(constant * o + rest * np.asarray(process, float))

    def process(self, rng: np.random.Generator, rate_hz: float) -> GaussMarkov:
        """The process u of successive readings, of correlation time `time_s`."""
        return GaussMarkov(rng, self.time_s, rate_hz)
