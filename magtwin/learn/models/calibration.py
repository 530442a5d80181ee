"""Calibration: standard deviations that hold on recordings left out of a fit."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array
from magtwin.report.verdict import Z_90

WITHIN = 0.9  # Nominal coverage of intervals
MOST_FACTOR = 3.0  # Largest factor by which few recordings change an interval
MOST_ROWS = 200_000  # Most rows that a spread is fitted to; of more, every k-th is used


@dataclass(frozen=True)
class Spread:
    """Standard deviation of an error by the distance of the inputs from their means.

        sd^2 = floor + sum_j slope_j z_j^2,   z = (x - mean) / scale,   none of them below 0

    Errors of lever arm, latency and heading grow with the map's gradient, errors of motors with the current.
    The squares model that independent of sign, and never shrink outside the training range.
    """

    floor_nt2: float
    """Variance at the means of the inputs [nT^2]."""

    slopes_nt2: Array
    """Variance per square of each scaled input [nT^2], shape (F,)."""

    def sd_nt(self, z: Array) -> Array:
        """Standard deviations [nT], shape (N,), at scaled inputs, shape (N, F); nan if an input is nan."""
        variance = np.full(len(z), self.floor_nt2)
        for j, slope in enumerate(self.slopes_nt2):  # by column, so that no row depends on others
            variance += slope * z[:, j] ** 2
        return np.sqrt(variance)

    @property
    def mean_nt(self) -> float:
        """Root mean square of the standard deviations of training rows, whose inputs have unit variance."""
        return math.sqrt(self.floor_nt2 + float(np.sum(self.slopes_nt2)))

    def scaled(self, factor: float) -> "Spread":
        """The spread with standard deviations `factor` times as large."""
        return Spread(self.floor_nt2 * factor**2, self.slopes_nt2 * factor**2)

    def tensors(self, name: str) -> dict[str, Array]:
        """It as tensors of a weights file, float64."""
        parts = (self.floor_nt2, self.slopes_nt2)
        return {f"{name}_{part}": np.array(value, float) for part, value in zip(_PARTS, parts, strict=True)}


_PARTS = ("floor_nt2", "slopes_nt2")


def spread_like(name: str, count: int) -> dict[str, Array]:
    """Tensors with the names, shapes and types of a spread of `count` inputs."""
    return Spread(1.0, np.ones(count)).tensors(name)


def spread_from(tensors: Mapping[str, NDArray[Any]], name: str, path: str | os.PathLike[str]) -> Spread:
    """The spread among the tensors of a weights file.

    Raises:
        InputError: A variance is below 0.
    """
    floor, slopes = (tensors[f"{name}_{part}"] for part in _PARTS)
    if floor <= 0 or (slopes < 0).any():
        raise InputError(f"{path}: a variance of its {name} is below 0")
    return Spread(float(floor), slopes)


def fit_spread(z: Array, error_nt: Array) -> Spread:
    """Fit a spread to squares of errors, by least squares weighted by its own variance.

    Args:
        z: Scaled inputs, shape (N, F).
        error_nt: Errors on rows left out of the fit [nT], shape (N,).
    """
    from scipy.optimize import nnls

    every = max(1, math.ceil(len(z) / MOST_ROWS))
    squares = np.column_stack([np.ones(len(z[::every])), z[::every] ** 2])
    target = error_nt[::every] ** 2
    mean = max(float(target.mean()), 1e-12)
    variance = np.full(len(target), mean)
    solution = np.zeros(squares.shape[1])
    for _ in range(3):  # the scatter of squares grows with the variance
        weight = (mean / variance)[:, None]
        # nnls of the triangle instead of all rows
        stacked = np.column_stack([weight * squares, weight[:, 0] * target / mean])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
        solution = nnls(triangle[:, :-1], triangle[:, -1])[0]
        solution[0] = max(solution[0], 1e-3)  # no interval has width 0
        variance = mean * (squares @ solution)
    return Spread(mean * float(solution[0]), mean * solution[1:])


def quantile_factor(error_nt: Array, sd_nt: Array, groups: NDArray[np.intp]) -> float:
    """Factor of standard deviations with which 90 % intervals hold 90 %.

    Every group has the same weight: recordings differ by offsets, and a long recording is still one draw.

    Args:
        error_nt: Errors [nT], shape (N,).
        sd_nt: Predicted standard deviations [nT], shape (N,), above 0.
        groups: Recording of each row, shape (N,).

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
    """Factor of standard deviations for the small number of groups.

    The common error of a group follows Student's t with one degree of freedom less than there are groups, the
    error within groups a normal distribution.

    Args:
        error_nt: Errors [nT], shape (N,).
        groups: Recording of each row, shape (N,).
    """
    from scipy.special import stdtrit

    number, counts = _numbered(groups)
    if len(counts) < 2:
        return 1.0
    means = np.bincount(number, error_nt) / counts
    whole = float(np.mean(np.bincount(number, error_nt**2) / counts))
    between = min(1.0, float(np.mean(means**2)) / whole) if whole > 0 else 0.0
    wide = min(float(stdtrit(len(counts) - 1, 0.5 + WITHIN / 2)) / Z_90, MOST_FACTOR)
    return math.sqrt(1 - between + between * wide**2)


def transferred_factor(
    error_nt: Array, sd_nt: Array, groups: NDArray[np.intp], yardstick: tuple[float, float]
) -> float:
    """Factor for a model that was compared with the validation recordings only.

    The offsets of a few recordings may by chance be all small or all large. A yardstick that was compared
    with all recordings shows which, and corrects for it.

    Args:
        error_nt: Errors on the validation rows [nT], shape (N,).
        sd_nt: Predicted standard deviations [nT], shape (N,).
        groups: Recording of each row, shape (N,).
        yardstick: Factors of a linear model on all recordings left out, and on those of validation.
    """
    luck = yardstick[0] / yardstick[1]
    return quantile_factor(error_nt, sd_nt, groups) * min(max(luck, 1 / MOST_FACTOR), MOST_FACTOR)


def yardstick(
    error_nt: Array, sd_nt: Array, groups: NDArray[np.intp], validation: NDArray[np.bool_]
) -> tuple[float, float]:
    """Factors of a linear model's standard deviations on recordings left out of its fit.

    The first is for training (each group left out in turn) and validation, with `few_groups_factor`; the
    second for validation only, whose rows `validation` marks.
    """
    everywhere = quantile_factor(error_nt, sd_nt, groups) * few_groups_factor(error_nt, groups)
    return everywhere, quantile_factor(error_nt[validation], sd_nt[validation], groups[validation])


def _numbered(groups: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Groups numbered from 0, shape (N,), and their numbers of rows."""
    _, number, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return number, counts
