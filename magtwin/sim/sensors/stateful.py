"""Stateful: what a simulated sensor carries from call to call, for one robot or for many at once."""

import copy
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Stateful:
    """State and random numbers of a sensor.

    Arrays of samples have time as their first axis. A sensor of one robot takes arrays of shape (K, ...). A
    sensor that `stacked` made of R robots takes (K, R, ...). Numbers are drawn sample by sample in the order
    of time, so the bytes do not depend on how the samples are cut into calls.
    """

    def __init__(self, rng: np.random.Generator, **state: ArrayLike) -> None:
        """Begin with a state."""
        self.rngs = [rng]
        self.state: dict[str, Array] = {name: np.array(value, float) for name, value in state.items()}
        self._many = False

    def normal(self, count: int, width: int) -> Array:
        """Standard normal numbers for the next samples, shape (count, width) or (count, R, width)."""
        if not self._many:
            return self.rngs[0].standard_normal((count, width))
        return np.stack([rng.standard_normal((count, width)) for rng in self.rngs], axis=1)

    @classmethod
    def stacked(cls, sensors: Sequence[Self]) -> Self:
        """One sensor for robots that differ in nothing but state and generators."""
        whole = copy.copy(sensors[0])
        whole._many = True
        whole.rngs = [sensor.rngs[0] for sensor in sensors]
        whole.state = {name: np.stack([s.state[name] for s in sensors]) for name in sensors[0].state}
        return whole

    def of(self, robots: NDArray[np.intp]) -> Self:
        """The sensor of some of the stacked robots; a copy, which `put` takes back."""
        part = copy.copy(self)
        part.rngs = [self.rngs[i] for i in robots]
        part.state = {name: values[robots] for name, values in self.state.items()}
        return part

    def put(self, robots: NDArray[np.intp], part: Self) -> None:
        """Take over the states and generators of some robots."""
        for i, rng in zip(robots, part.rngs, strict=True):
            self.rngs[i] = rng
        for name, values in part.state.items():
            self.state[name][robots] = values
