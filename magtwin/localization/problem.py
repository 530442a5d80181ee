"""Problem: what an algorithm under test is told, and the protocols that it follows.

A localizer gets a `Problem` once and a `Reading` per step, and returns an `Estimate`. Neither holds the true
pose, the true field or a later reading. Poses are x, y [m] and yaw [rad] of base_link in world.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.run.run import Run

Array = NDArray[np.float64]
Extent = tuple[float, float, float, float]
"""Least x, greatest x, least y, greatest y in world [m]."""

MOST = 1e9
"""Largest figure of a noise model; squares of it stay finite."""

HEADING_WITHIN = math.radians(10) / math.sqrt(3)
"""Standard deviation of a heading that is known within 10 deg, uniformly [rad]."""


@dataclass(frozen=True, kw_only=True)
class OdometryModel:
    """Errors of odometry, as random walks over distance, angle and time, and a constant scale.

    Over a step of length d, turn a and time dt, the increment in the robot's frame has the variances
    position_std^2 d + position_std_s^2 dt on x and on y, and yaw_std^2 d + turn_std^2 |a| + yaw_std_s^2 dt on
    the yaw. Its length is wrong by a factor 1 + s, with s constant in a run and of standard deviation
    `scale_std`.
    """

    position_std: float = 0.02
    """Random walk of the position, each axis [m/sqrt(m)]."""

    yaw_std: float = math.radians(1.0)
    """Random walk of the yaw with distance [rad/sqrt(m)]."""

    turn_std: float = 0.01
    """Random walk of the yaw with the turned angle [rad/sqrt(rad)]."""

    position_std_s: float = 0.0
    """Random walk of the position with time, each axis [m/sqrt(s)]."""

    yaw_std_s: float = 1e-4
    """Random walk of the yaw with time [rad/sqrt(s)]."""

    scale_std: float = 0.02
    """Relative error of the distance, constant in a run."""

    def __post_init__(self) -> None:
        _not_negative(self)

    def scaled(self, factor: float) -> "OdometryModel":
        """The model with all standard deviations multiplied."""
        return OdometryModel(**{name: factor * value for name, value in vars(self).items()})

    def variances(self, distance_m: ArrayLike, turn: ArrayLike, dt_s: ArrayLike) -> Array:
        """Variances of the increments x, y [m^2] and yaw [rad^2], without the scale, shape (..., 3)."""
        d, a, dt = np.abs(distance_m), np.abs(turn), np.asarray(dt_s, float)
        position = self.position_std**2 * d + self.position_std_s**2 * dt
        yaw = self.yaw_std**2 * d + self.turn_std**2 * a + self.yaw_std_s**2 * dt
        return np.stack(np.broadcast_arrays(position, position, yaw), axis=-1)


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """The magnetometer and what the robot adds to its reading.

        b = B(p + R(yaw) l, yaw) + offset + c cos(yaw) + s sin(yaw) + drift + white

    with l = `lever_arm_m`, constant offset, c and s, and a drift that is a first-order Gauss-Markov process
    (FOGM) of standard deviation `drift_nt` and correlation time `drift_s`.
    """

    lever_arm_m: tuple[float, float] = (0.0, 0.0)
    """Position of the sensor in base_link [m]."""

    white_nt: float = 20.0
    """Standard deviation of the white noise of one reading [nT]."""

    drift_nt: float = 100.0
    """Standard deviation of the drift [nT]."""

    drift_s: float = 5.0
    """Correlation time of the drift [s]."""

    offset_nt: float = 500.0
    """Prior standard deviation of the offset of a run [nT]."""

    iron_nt: float = 0.0
    """Prior standard deviation of c and of s [nT]: iron that the session has added to the robot."""

    def __post_init__(self) -> None:
        _not_negative(self)
        if not (self.drift_s > 0 and self.white_nt > 0):
            raise InputError(
                f"white_nt and drift_s of SensorModel must be above 0, got {self.white_nt}, {self.drift_s}"
            )


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Where the robot may be at the first reading: Gaussian; uniform in each part whose sd is infinite."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y [m] and yaw [rad]; ignored where `sd` is infinite."""

    sd: tuple[float, float, float] = (0.1, 0.1, math.radians(5))
    """Standard deviation of x, y [m] and yaw [rad]. x and y are both finite or both infinite."""

    def __post_init__(self) -> None:
        if not (all(s > 0 for s in self.sd) and math.isinf(self.sd[0]) == math.isinf(self.sd[1])):
            raise InputError(
                f"sd of Prior must be above 0, with x and y both finite or both infinite, got {self.sd}"
            )

    @property
    def is_global(self) -> bool:
        """Whether the position is unknown."""
        return math.isinf(self.sd[0])


@runtime_checkable
class FieldBelief(Protocol):
    """What is known of the field. `magtwin.AnomalyMap` is one."""

    def mean(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """Expected field magnitude of the surveying robot [nT], shape (...); nan where unknown."""
        ...

    def gradient(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """d/dx, d/dy [nT/m] and d/dyaw [nT/rad] of `mean`, shape (..., 3)."""
        ...

    def variance(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """Variance of the error of `mean` [nT^2], shape (...)."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """What a localizer is told before the first reading. It holds no truth."""

    belief: FieldBelief | None
    """Map of the field. None: simultaneous localization and mapping. The `offset_sd_nt` of a map becomes part
    of the sensor's `offset_nt`."""

    extent: Extent
    """The floor on which the robot drives."""

    prior: Prior = field(default_factory=Prior)
    """The pose at the first reading."""

    sensor: SensorModel = field(default_factory=SensorModel)
    """Noise model of the magnetometer. The noise need not follow it."""

    odometry: OdometryModel = field(default_factory=OdometryModel)
    """Noise model of the odometry. The noise need not follow it."""

    map_length_m: float = 0.3
    """Correlation length of the map's error [m]."""

    rate_hz: float = 5.0
    """Readings per second [Hz]."""

    calibration: Run | None = None
    """A drive earlier in the session with its true poses and on-board columns. None if there was none."""

    seed: int = 0
    """Seed of the algorithm's random numbers."""

    def __post_init__(self) -> None:
        if offset := getattr(self.belief, "offset_sd_nt", 0.0):  # once, as an error of the offset
            sensor = replace(self.sensor, offset_nt=math.hypot(self.sensor.offset_nt, offset))
            object.__setattr__(self, "sensor", sensor)
            object.__setattr__(self, "belief", self.belief.relative())  # type: ignore[union-attr]
        for name in ("map_length_m", "rate_hz"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"`{name}` must be above 0, got {getattr(self, name)}", parameter=name)

    @property
    def start(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Mean and standard deviation of the prior, or where that is infinite, of a uniform pose."""
        (x0, x1, y0, y1), prior = self.extent, self.prior
        wide = (x1 - x0) / math.sqrt(12), (y1 - y0) / math.sqrt(12), math.pi / math.sqrt(3)
        x, y, yaw = (s if math.isfinite(s) else w for s, w in zip(prior.sd, wide, strict=True))
        mean = ((x0 + x1) / 2, (y0 + y1) / 2, prior.mean[2]) if prior.is_global else prior.mean
        return mean, (x, y, yaw)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One row of the on-board columns."""

    t: float
    """Time [s]."""

    b_nt: float
    """Measured field magnitude [nT]; nan if the sensor gave no reading."""

    odometry: tuple[float, float, float]
    """x, y [m] and yaw [rad] of base_link in the frame `odom`."""

    disturbance_nt: float = 0.0
    """The robot's own field as predicted by a compensator [nT]; 0 without one. Not yet subtracted."""

    disturbance_sd_nt: float = 0.0
    """Its standard deviation [nT]."""

    signals: Mapping[str, Any] = field(default_factory=dict)
    """All on-board columns by name, numbers or arrays (width,): see
    `magtwin.localization.readings.ONBOARD`."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """An estimate of the pose of base_link in world."""

    t: float
    """Time [s]: that of the reading."""

    x: float
    """[m]."""

    y: float
    """[m]."""

    yaw: float
    """[rad]; any turn."""

    covariance: Array | None = None
    """Covariance of x, y [m] and yaw [rad], shape (3, 3). None if unknown."""

    bias_nt: float | None = None
    """Estimated offset of the magnetometer [nT]. None if unknown."""

    lost: bool = False
    """Whether the algorithm knows that its pose is not to be trusted, as before a global start converges."""


@runtime_checkable
class Localizer(Protocol):
    """A causal algorithm. A new object is made for each run.

    It may also have a method `particles()`, which returns x, y, yaw and weight of its samples, shape (P, 4);
    they are drawn in recordings.
    """

    def reset(self, problem: Problem) -> None:
        """Begin a run."""
        ...

    def step(self, reading: Reading) -> Estimate:
        """Use one reading, in the order of time, and return the estimate at its time."""
        ...


@runtime_checkable
class Smoother(Protocol):
    """An algorithm that uses all readings for every estimate."""

    def run(self, problem: Problem, readings: Run) -> Sequence[Estimate]:
        """Estimates at the times of all readings; `readings` has only on-board columns."""
        ...


def _not_negative(model: object) -> None:
    for name, value in vars(model).items():
        numbers = [abs(number) for number in value] if isinstance(value, tuple) else [value]
        if not all(0 <= number <= MOST for number in numbers):
            wanted = f"must be finite and not negative, at most {MOST:g}"
            text = f"{name} of {type(model).__name__} {wanted}, got {value}"
            raise InputError(text, parameter=name)
