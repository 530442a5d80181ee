"""Posterior of a linear problem whose unknowns and noise have unit variance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST = 0.01  # Directions with less information than this, relative to the prior, are left out


@dataclass(frozen=True, eq=False)
class Posterior:
    """Unknowns x ~ N(0, 1), observed as t = rows x + noise, noise ~ N(0, 1).

    The smaller matrix is factored: the readings' covariance rows rows^T + 1, or the unknowns' precision
    rows^T rows + 1 (Rasmussen & Williams 2006, section 2.1.2, eqs. 2.8 and 2.12).
    """

    rows: Array  # Shape (R, P)
    lower: Array  # Cholesky factor of that matrix

    @classmethod
    def of(cls, rows: Array) -> "Posterior":
        """Factor the matrix of a problem."""
        whole = rows @ rows.T if len(rows) <= rows.shape[1] else rows.T @ rows
        whole[np.diag_indices(len(whole))] += 1
        return cls(rows, np.asarray(np.linalg.cholesky(whole)))

    @property
    def dual(self) -> bool:
        """Whether the readings' matrix was factored."""
        return len(self.rows) <= self.rows.shape[1]

    def mean(self, target: Array) -> Array:
        """Most likely unknowns for readings, (R,) -> (P,)."""
        from scipy.linalg import cho_solve

        if self.dual:
            return np.asarray(self.rows.T @ cho_solve((self.lower, True), target))
        return np.asarray(cho_solve((self.lower, True), self.rows.T @ target))

    def half_log_det(self) -> float:
        """Half the log determinant, equal for both matrices."""
        return float(np.log(np.diag(self.lower)).sum())

    def known(self) -> Array:
        """Information on each unknown: 1 - its variance, (P,)."""
        if self.dual:
            return np.sum(self._whitened() ** 2, axis=0)
        return 1 - np.sum(self._inverse() ** 2, axis=0)

    def fitted(self) -> Array:
        """Variance of each predicted reading, (R,)."""
        if self.dual:
            return 1 - np.sum(self._inverse() ** 2, axis=0)
        return np.sum(self._whitened() ** 2, axis=0)

    def left_out(self, target: Array, groups: Sequence[NDArray[np.intp]]) -> tuple[Array, Array]:
        """Readings minus their prediction from the other groups, and its variance without noise, (R,) each.

        In closed form (Rasmussen & Williams 2006, eq. 5.12, by blocks).
        """
        off = target - self.rows @ self.mean(target)
        half = self._inverse() if self.dual else self._whitened()
        error, field = np.empty(len(target)), np.empty(len(target))
        for group in groups:
            inner = half[:, group].T @ half[:, group]
            covariance = np.linalg.inv(inner if self.dual else np.eye(len(group)) - inner)
            error[group] = covariance @ off[group]
            field[group] = np.maximum(np.diag(covariance) - 1, 0)
        return error, field

    def changes(self, target: Array, groups: Sequence[NDArray[np.intp]]) -> Array:
        """What the most likely unknowns lose with each group of readings, in closed form, (P, groups)."""
        from scipy.linalg import cho_solve

        error, _ = self.left_out(target, groups)
        each = np.zeros((len(target), len(groups)))
        for k, group in enumerate(groups):
            each[group, k] = error[group]
        if self.dual:
            return np.asarray(self.rows.T @ cho_solve((self.lower, True), each))
        return np.asarray(cho_solve((self.lower, True), self.rows.T @ each))

    def directions(self) -> Array:
        """Information on the unknowns as columns (P, K): their covariance is 1 - columns columns^T.

        Directions with almost no information are left out, so variances come out slightly larger.
        """
        from scipy.linalg import eigh

        rows = self.rows
        size, ways = eigh(rows @ rows.T if self.dual else rows.T @ rows, overwrite_a=True, check_finite=False)
        kept = size > LEAST
        size, ways = size[kept], ways[:, kept]
        if self.dual:
            return np.asarray(rows.T @ (ways / np.sqrt(1 + size)))
        return np.asarray(ways * np.sqrt(size / (1 + size)))

    def _inverse(self) -> Array:
        from scipy.linalg import lapack

        return np.asarray(lapack.dtrtri(self.lower, lower=1)[0])

    def _whitened(self) -> Array:
        from scipy.linalg import solve_triangular

        side = self.rows if self.dual else self.rows.T
        return np.asarray(solve_triangular(self.lower, side, lower=True, check_finite=False))
