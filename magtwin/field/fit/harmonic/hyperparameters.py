"""Figures: noise, errors of poses and strengths of dipoles, which a harmonic fit learns beside the field."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.fit.harmonic.forward import Reading

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Figures:
    """What a fit learns beside the field itself."""

    noise_nt: float
    """Noise of a reading, or of a mean of several [nT]."""

    position_m: float
    """Error of a recorded place, each way [m]."""

    heading_rad: float
    """Error of a recorded heading [rad]."""

    freedom: float
    """Degrees of freedom of Student's t."""

    strength: Array
    """Prior standard deviation of each part of each dipole's moment [A m^2], shape (D,)."""

    def change(self, before: "Figures") -> float:
        """How far the figures are from others, as a logarithm: the noise's, or the strengths' in the mean."""
        moved = np.sqrt(np.mean(np.log(self.strength / before.strength) ** 2))
        return float(max(abs(np.log(self.noise_nt / before.noise_nt)), moved))

    def variance(self, reading: Reading) -> Array:
        """Squared scale of each part of readings [nT^2], shape (N, C)."""
        return np.asarray(self.terms(reading).sum(axis=-1))

    def terms(self, reading: Reading) -> Array:
        """The parts of `variance` that come from noise, place and heading [nT^2], shape (N, C, 3)."""
        place = self.position_m**2 * np.sum(reading.by_place**2, axis=-1)
        heading = self.heading_rad**2 * reading.by_yaw**2
        return np.stack([np.full_like(place, self.noise_nt**2), place, heading], axis=-1)
