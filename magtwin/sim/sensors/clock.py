"""A sensor's own clock: when samples are taken, when they arrive, and which of them a reading sees.

A sensor takes sample k at the time k / rate_hz. The sample arrives `latency_s` later, plus a random delay
with an exponential distribution of mean `jitter_s`. Samples arrive in order. A reading of the magnetometer
at time t sees the newest sample that has arrived by t, so nothing comes from the future. Before t = 0 the
robot stands at its first pose, and samples are taken there.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.sampling import Moving, check_count, moment_at
from magtwin.sim.sensors.stateful import Stateful

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

_TOLERANCE = 1e-9
"""Part of a sample's period by which rounding may shift its time."""

_PAST_END_S = 1e-6
"""How far past the last reading the motion is sampled, so that a sample at just that time is taken [s]."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a sensor."""

    t: Array
    """When each was taken [s], shape (M,)."""

    arrival: Array
    """When each arrives [s], shape (M,)."""

    columns: Columns
    """Values by column of a Run, shape (M, ...)."""


class SampleClock:
    """Samples as they are taken, arrive and are seen."""

    def __init__(
        self, rate_hz: float, latency_s: float, jitter_s: float, rng: np.random.Generator | None = None
    ) -> None:
        """Set the clock to the first sample that a reading at t = 0 can see."""
        self.rate_hz, self._latency, self._jitter, self._rng = rate_hz, latency_s, jitter_s, rng
        self._next = -math.ceil(min(latency_s * rate_hz, 1e18))
        self._first, self._last = self._next, -math.inf
        self._arrivals = np.zeros(0)
        self._columns: Columns = {}
        self._fresh: list[Samples] = []

    def due(self, until_s: float) -> Array:
        """Times of the samples before `until_s` that have not been taken yet [s], shape (M,)."""
        check_count("samples of a sensor", until_s - self._next / self.rate_hz, self.rate_hz)
        last = math.ceil(until_s * self.rate_hz - _TOLERANCE)
        stamps = np.arange(self._next, max(last, self._next)) / self.rate_hz
        self._next += len(stamps)
        return stamps

    def add(self, stamps: Array, columns: Columns) -> None:
        """Add samples that were taken at times that `due` gave."""
        if not len(stamps):
            return
        arrivals = stamps + self._latency
        if self._jitter > 0 and self._rng is not None:
            arrivals = arrivals + self._rng.exponential(self._jitter, len(stamps))
        arrivals = np.maximum.accumulate(np.concatenate([[self._last], arrivals]))[1:]
        self._last = float(arrivals[-1])
        self._fresh.append(Samples(stamps, arrivals, columns))
        self._arrivals = np.concatenate([self._arrivals, arrivals])
        for name, values in columns.items():
            before = self._columns.get(name)
            self._columns[name] = values if before is None else np.concatenate([before, values])

    def at(self, t: Array) -> Columns:
        """The newest sample that has arrived by each time [s], shape (N,); times never go back."""
        latest = np.maximum(np.searchsorted(self._arrivals, t, side="right") - 1, 0)
        seen = {name: values.take(latest, axis=0) for name, values in self._columns.items()}
        if len(latest) and (gone := int(latest[-1])):
            self._arrivals = self._arrivals[gone:]
            self._columns = {name: values[gone:] for name, values in self._columns.items()}
        return seen

    def take_fresh(self) -> list[Samples]:
        """The samples that were added since the last call."""
        fresh, self._fresh = self._fresh, []
        return fresh


class SampledSensor(Stateful):
    """A sensor that samples a motion by its own clock. Subclasses define `sample`."""

    clock: SampleClock

    def sense(self, motion: Moving, t: Array, until_s: float | None = None) -> Columns:
        """Columns at the next readings.

        One call for a whole run and a call for each step give the same bytes.

        Args:
            motion: What the robot did, known until `until_s`.
            t: Times of the readings, not before those of earlier calls [s], shape (N,).
            until_s: Time up to which samples are taken [s]. Default: just past the last reading.
        """
        stamps = self.clock.due(float(t[-1]) + _PAST_END_S if until_s is None else until_s)
        if len(stamps):
            self.clock.add(stamps, self.sample(stamps, moment_at(motion, stamps)))
        return self.clock.at(t)

    def sample(self, stamps: Array, now: Moment) -> Columns:
        """Values of the next samples.

        Args:
            stamps: Their times [s], shape (K,).
            now: What the robot did at these times; arrays (K, ...), or (K, R, ...) for R robots.
        """
        raise NotImplementedError
