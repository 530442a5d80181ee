"""Settings: options that all methods of magnetic SLAM share."""

import math
from dataclasses import dataclass
from typing import Literal

from magtwin.errors import InputError


@dataclass(kw_only=True)
class Settings:
    """Prior of the field, and what `Problem` does not say of odometry and magnetometer."""

    functions: int = 100
    """Number of eigenfunctions."""

    length_m: float = 0.8
    """Length scale of the field [m]."""

    sd_nt: float = 10_000.0
    """Prior standard deviation of the field's variation, each axis [nT]."""

    uniform_sd_nt: float = 50_000.0
    """Prior standard deviation of the uniform part of the field, each axis [nT]."""

    odometry_axes: Literal["body", "world"] = "body"
    """Axes in which odometry's increments are right: those of the robot, or of the world.

    Wheels measure in the robot's axes: an error of the heading turns all later increments. An odometry with
    an absolute heading of its own measures in world axes.
    """

    velocity_sd_m_s: float = 0.0
    """Prior standard deviation of a constant error of odometry's velocity, along each of two axes [m/s]."""

    calibrate: bool = True
    """Estimate the magnetometer's offset and iron, with the prior of `Problem.sensor`."""

    soft_iron_sd: float = 0.0
    """Prior standard deviation of each entry of the soft-iron matrix W, for three axes. 0: no W."""

    vertical_std_s: float = 1e-3
    """Random walk of odometry's height [m/sqrt(s)], for three axes."""

    tilt_std_s: float = 1e-3
    """Random walk of odometry's roll and pitch [rad/sqrt(s)], for three axes."""

    def __post_init__(self) -> None:
        above = ("length_m", "sd_nt", "uniform_sd_nt", "vertical_std_s", "tilt_std_s")
        for name in (*above, "velocity_sd_m_s", "soft_iron_sd"):
            value = getattr(self, name)
            if not (
                isinstance(value, int | float) and 0 <= value < math.inf and (value or name not in above)
            ):
                word = "above" if name in above else "at least"
                text = f"{name} must be a finite number {word} 0, got {value!r}"
                raise InputError(text, parameter=name)
        if isinstance(self.functions, bool) or self.functions != int(self.functions) or self.functions < 1:
            text = f"functions must be a whole number from 1, got {self.functions}"
            raise InputError(text, parameter="functions")
        if self.odometry_axes not in ("body", "world"):
            text = f"odometry_axes must be body or world, got {self.odometry_axes!r}"
            raise InputError(text, parameter="odometry_axes")
