"""Roughness: the error of interpolation, estimated from readings that are left out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.report.verdict import Z_90

Array = NDArray[np.float64]
# Gives values at positions (third) from positions (first) and values (second); nan outside
Interpolation = Callable[[Array, Array, Array], Array]

FOLDS = 5  # Parts left out in turn: cell (i, j) is in part (i + 2 j) mod 5, unlike the eight cells around it
NEIGHBOURS = 16  # Residuals per local mean square
PRIOR = 4  # Weight of the survey's mean square in a local one, as a number of residuals


@dataclass(frozen=True, eq=False)
class Roughness:
    """Squared residuals of readings that were left out, with their positions and distances.

    Linear interpolation errs by f'' d g / 2 at distances d and g from the readings on either side (de Boor
    1978, chapter 3). So the variance at a point is the mean square of the residuals around it times (d g)^2
    there over (d g)^2 where they were left out. d is the distance to the nearest reading and g = max(cell -
    d, d) that to the next. Since residuals have heavy tails, the variance is scaled so that 90 % of them lie
    in their 90 % intervals, including the readings' errors.
    """

    tree: Any  # Positions of the readings, a scipy cKDTree
    left_out: Any  # Positions of the residuals, a scipy cKDTree
    scaled: Array  # Squared residual minus the readings' variance, over (d g)^2 [nT^2 / m^4], shape (R,)
    cell_m: float  # Typical distance between readings [m]

    @classmethod
    def of(
        cls, p_xy: Array, b_nt: Array, noise_nt2: Array, cell_m: float, interpolate: Interpolation
    ) -> "Roughness":
        """Leave out each fifth of the positions in turn, and interpolate them from the rest.

        A residual contains the errors of the reading left out and of those beside it, 1.5 times the variance
        of a reading, which are not roughness. `cell_m` is the side of the cells that are left out.
        """
        from scipy.spatial import cKDTree

        cell = np.floor((p_xy - p_xy.min(axis=0)) / cell_m + 0.5).astype(np.int64)
        part = (cell[:, 0] + 2 * cell[:, 1]) % FOLDS
        square, away = np.full(len(p_xy), np.nan), np.full(len(p_xy), np.nan)
        for k in range(FOLDS):
            out, kept = part == k, part != k
            if not out.any() or np.count_nonzero(kept) < 3:
                continue
            square[out] = (b_nt[out] - interpolate(p_xy[kept], b_nt[kept], p_xy[out])) ** 2
            away[out] = _between(np.maximum(cKDTree(p_xy[kept]).query(p_xy[out])[0], cell_m / 2), cell_m)
        known = np.isfinite(square)
        if not known.any():
            return cls(cKDTree(p_xy), None, square[known], cell_m)
        left_out, square, away, noise = cKDTree(p_xy[known]), square[known], away[known], noise_nt2[known]
        scaled = (square - 1.5 * noise) / away
        rough = np.maximum(local_mean(left_out, scaled, left_out.data, skip=1) * away, 0)
        return cls(cKDTree(p_xy), left_out, scaled * _stretch(square, rough, 1.5 * noise), cell_m)

    @classmethod
    def joined(cls, parts: "Sequence[Roughness]") -> "Roughness":
        """Roughness of several layers over one floor."""
        from scipy.spatial import cKDTree

        known = [part for part in parts if part.left_out is not None]
        left_out = cKDTree(np.vstack([part.left_out.data for part in known])) if known else None
        scaled = np.concatenate([part.scaled for part in parts])
        return cls(cKDTree(np.vstack([part.tree.data for part in parts])), left_out, scaled, parts[0].cell_m)

    def variance_nt2(self, p_xy: ArrayLike) -> Array:
        """Variance of the interpolation at points [nT^2], shape (...); nan if no residuals are known."""
        p = np.asarray(p_xy, float)
        if self.left_out is None:
            return np.full(p.shape[:-1], np.nan)
        away = _between(self.tree.query(p)[0], self.cell_m)
        return np.asarray(np.maximum(local_mean(self.left_out, self.scaled, p), 0) * away)


def _between(d: Array, cell_m: float) -> Array:
    """(d g)^2 at distances d from the nearest reading [m^4]."""
    return np.asarray((d * np.maximum(cell_m - d, d)) ** 2)


def local_mean(tree: Any, squares: Array, p_xy: Array, *, skip: int = 0) -> Array:
    """Mean of the squares nearest to each point, drawn towards the mean of all, shape (...).

    `tree` has the positions of the squares, shape (R,). The nearest `skip` positions are ignored.
    """
    count = min(NEIGHBOURS, len(squares) - skip)
    if count < 1:
        return np.full(p_xy.shape[:-1], squares.mean())
    _, near = tree.query(p_xy, k=[*range(1 + skip, count + skip + 1)])
    return np.asarray((squares[near].sum(axis=-1) + PRIOR * squares.mean()) / (count + PRIOR))


def _stretch(square: Array, rough: Array, noise: Array) -> float:
    """Factor on `rough` with which 90 % of the squares lie in the 90 % intervals of rough and noise."""
    known = rough > 0
    if not known.any():
        return 1.0
    factor = (square[known] / Z_90**2 - noise[known]) / rough[known]
    missed = np.count_nonzero(square[~known] > Z_90**2 * noise[~known])  # whatever the factor
    inside = (0.9 * len(square) - (np.count_nonzero(~known) - missed)) / np.count_nonzero(known)
    return max(float(np.quantile(factor, min(max(inside, 0.0), 1.0))), 0.0)


def tail(tree: Any, squares: Array, each: Array, place: NDArray[np.intp]) -> float:
    """Factor on a local variance with which its 90 % intervals hold 90 % of the residuals.

    `squares` are the mean square residuals at the positions of `tree`, shape (R,); `each` the squares of
    single residuals at the positions `place`, both of shape (E,).
    """
    variance = local_mean(tree, squares, np.asarray(tree.data), skip=1)
    return tail_of(each / np.maximum(variance[place], np.finfo(float).tiny))


def tail_of(ratio: Array, weights: Array | None = None) -> float:
    """Factor on variances with which their 90 % intervals hold 90 % of the residuals, (R,).

    `ratio` are the squares of the residuals over the variances, `weights` how much each counts.
    """
    if weights is None:
        return float(np.quantile(ratio, 0.9)) / Z_90**2
    order = np.argsort(ratio)
    share = np.cumsum(weights[order])
    return float(ratio[order][np.searchsorted(share, 0.9 * share[-1])]) / Z_90**2
