"""Steps: a drive's readings of a sensor that rounds coarsely, made smooth within its steps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REPEATED = 0.5
"""Share of values that repeat the one before, from which a sensor is coarse."""

LEAST = 200
"""Fewest readings of a drive."""

WHOLE = 0.02
"""Largest distance of a rounded value from a whole number of steps, in steps."""

ROUNDS = 60
SMOOTH = 100.0
"""Rounds, and weight of the second differences: it makes changes smooth over some ten readings."""

LEFT = 0.12
"""Standard deviation of what is left of the rounding, in steps; a single reading has 1 / sqrt(12). Measured
on simulated walks past dipoles."""


def smooth_within_steps(values: Array) -> tuple[Array, float]:
    """Values that are as smooth as the steps of the sensor allow.

    A sensor with the step q reads a value within q/2 of the field. Where the field changes slowly, errors of
    readings that follow each other are alike, and no mean removes them. The result is smooth (E. T.
    Whittaker, "On a new method of graduation", 1923) and within q/2 of the readings, by projecting on both
    in turn (POCS: Youla & Webb, 1982).

    Args:
        values: Readings in the order of time, shape (N,).

    Returns:
        The values, and the step; the readings and 0 if the sensor is not coarse.
    """
    from scipy.linalg import solveh_banded

    coarse = len(values) >= LEAST and np.mean(np.diff(values) == 0) >= REPEATED
    if not (coarse and (step := step_of(values))):
        return values, 0.0
    n = len(values)
    bands = np.zeros((3, n))
    for k, weight in enumerate((1.0, -2.0, 1.0)):
        bands[0, k : n - 2 + k] += weight**2
    bands[1, : n - 2] += -2.0
    bands[1, 1 : n - 1] += -2.0
    bands[2, : n - 2] += 1.0
    bands *= SMOOTH
    bands[0] += 1.0
    low, high, smooth = values - step / 2, values + step / 2, values
    for _ in range(ROUNDS):
        smooth = solveh_banded(bands, np.clip(smooth, low, high), lower=True)
    return np.clip(smooth, low, high), step


def step_of(values: Array, share: float = 1.0) -> float:
    """The step by whole numbers of which a share of the values, shape (N,), differ; 0 if there is none."""
    gaps = np.diff(np.unique(np.round(values, 6)))
    if not len(gaps):
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    whole = (values - values[0]) / step
    size = 1e-6 * float(np.abs(values).max())  # of rounding in a text of seven digits
    near = np.abs(whole - np.round(whole)) < WHOLE + size / step
    return step if step > size and near.mean() >= share else 0.0
