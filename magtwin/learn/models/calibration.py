"""Calibration: standard deviations that errors on recordings never seen keep to."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array
from magtwin.verdict import Z_90

WITHIN = 0.9
"""Share of rows that an interval is to hold."""

MOST_FACTOR = 3.0
"""By which few recordings may widen or narrow an interval at most."""

MOST_ROWS = 200_000
"""Rows that a spread is fitted to; of more, every second, third, ... is taken."""


@dataclass(frozen=True)
class Spread:
    """Standard deviation of an error by how far the inputs are from their means.

        sd^2 = floor + sum_j slope_j z_j^2,   z = (x - mean) / scale,   none of them below 0

    What a lever arm, a latency or a heading leaves grows with the map's gradient, what a motor leaves
    with its current: the squares say so, without the sign of either, and never shrink outside the training.
    """

    floor_nt2: float
    """Variance at the means of the inputs [nT^2]."""

    slopes_nt2: Array
    """What the square of each scaled input adds [nT^2], shape (F,)."""

    def sd_nt(self, z: Array) -> Array:
        """Standard deviations [nT], shape (N,), at scaled inputs, shape (N, F); nan where one of them is."""
        found = np.full(len(z), self.floor_nt2)
        for j, slope in enumerate(
            self.slopes_nt2
        ):  # column by column: no row's sum depends on its neighbours
            found += slope * z[:, j] ** 2
        return np.sqrt(found)

    def scaled(self, factor: float) -> "Spread":
        """With every standard deviation `factor` times as large."""
        return Spread(self.floor_nt2 * factor**2, self.slopes_nt2 * factor**2)


def fit_spread(z: Array, error_nt: Array) -> Spread:
    """The spread that squares of errors follow, by least squares weighted by its own variance.

    Args:
        z: Scaled inputs, shape (N, F).
        error_nt: Errors on rows that the fit behind them had left out [nT], shape (N,).
    """
    from scipy.optimize import nnls

    every = max(1, math.ceil(len(z) / MOST_ROWS))
    squares = np.column_stack([np.ones(len(z[::every])), z[::every] ** 2])
    target = error_nt[::every] ** 2
    mean = max(float(target.mean()), 1e-12)
    variance = np.full(len(target), mean)
    found = np.zeros(squares.shape[1])
    for _ in range(
        3
    ):  # squares of normal errors scatter by their variance: near ones tell more than far ones
        weight = (mean / variance)[:, None]
        # nnls of the triangle in place of all rows; the factor of the identity is for inputs that never vary
        stacked = np.column_stack([weight * squares, weight[:, 0] * target / mean])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
        found = nnls(triangle[:, :-1], triangle[:, -1])[0]
        found[0] = max(found[0], 1e-3)  # of the mean variance: an interval is never of no width
        variance = mean * (squares @ found)
    return Spread(mean * float(found[0]), mean * found[1:])


def quantile_factor(error_nt: Array, sd_nt: Array, groups: NDArray[np.intp]) -> float:
    """Factor by which standard deviations are multiplied so that 90 % intervals hold 90 %.

    Each group counts as much as any other: recordings differ by offsets of their own, and a long one is
    still one draw of them.

    Args:
        error_nt: Errors [nT], shape (N,).
        sd_nt: Standard deviations that were told of them [nT], shape (N,), above 0.
        groups: Which recording each row is of, shape (N,).

    Raises:
        InputError: There is no row.
    """
    if not len(error_nt):
        raise InputError("no row to calibrate a standard deviation by")
    ratio = np.abs(error_nt) / sd_nt
    number, counts = _numbered(groups)
    order = np.argsort(ratio, kind="stable")
    reached = np.cumsum((1.0 / counts)[number][order])
    at = int(np.searchsorted(reached, WITHIN * reached[-1]))
    return max(float(ratio[order][min(at, len(order) - 1)]) / Z_90, 1e-6)


def few_groups_factor(error_nt: Array, groups: NDArray[np.intp]) -> float:
    """What standard deviations of a few groups are multiplied by, because few tell little of the next one.

    The part of the error that a group has in common is as uncertain as Student's t with one degree of freedom
    less than there are groups, the part within groups as a normal one.

    Args:
        error_nt: Errors [nT], shape (N,).
        groups: Which recording each row is of, shape (N,).
    """
    from scipy.stats import t

    number, counts = _numbered(groups)
    if len(counts) < 2:
        return 1.0
    means = np.bincount(number, error_nt) / counts
    whole = float(np.mean(np.bincount(number, error_nt**2) / counts))
    between = min(1.0, float(np.mean(means**2)) / whole) if whole > 0 else 0.0
    wide = min(float(t.ppf(0.5 + WITHIN / 2, len(counts) - 1)) / Z_90, MOST_FACTOR)
    return math.sqrt(1 - between + between * wide**2)


def transferred_factor(
    error_nt: Array, sd_nt: Array, groups: NDArray[np.intp], yardstick: "Yardstick"
) -> float:
    """Factor for a model that was held against the validation recordings alone.

    A few recordings have offsets of their own: by luck all small, or all large. How a yardstick that was
    held against all recordings did on these few tells which, and cancels it.

    Args:
        error_nt: Errors on the validation rows [nT], shape (N,).
        sd_nt: Standard deviations that were told of them [nT], shape (N,).
        groups: Which recording each row is of, shape (N,).
        yardstick: Of the same recordings.
    """
    luck = yardstick.everywhere / yardstick.validation
    return quantile_factor(error_nt, sd_nt, groups) * min(max(luck, 1 / MOST_FACTOR), MOST_FACTOR)


@dataclass(frozen=True)
class Yardstick:
    """Factors that a linear model's standard deviations needed on recordings that it had not seen."""

    everywhere: float
    """On those of training, each left out in turn, and of validation, with `few_groups_factor`."""

    validation: float
    """On those of validation alone."""


def yardstick(
    error_nt: Array, sd_nt: Array, groups: NDArray[np.intp], validation: NDArray[np.bool_]
) -> Yardstick:
    """Args as for `quantile_factor`, of training and validation rows; `validation` tells which are which."""
    everywhere = quantile_factor(error_nt, sd_nt, groups) * few_groups_factor(error_nt, groups)
    return Yardstick(everywhere, quantile_factor(error_nt[validation], sd_nt[validation], groups[validation]))


def _numbered(groups: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Groups numbered from 0, shape (N,), and how many rows each has."""
    _, number, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return number, counts
