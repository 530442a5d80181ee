"""Arrow: linear systems whose matrix is block tridiagonal with a dense border.

    [ A   B ] [ x ]   [ a ]
    [ B'  C ] [ g ] = [ c ]

A has one block for each pose, coupled to the next one; g are the constants of the run. Eliminating the poses
with A = L L', Y = L^-1 B gives (C - Y'Y) g = c - Y' L^-1 a, and x from L' x = L^-1 a - Y g. The work grows
with the number of poses N and as the square of the number of constants.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.blas import dsyrk

from magtwin.compiled import Loops

Array = NDArray[np.float64]


def gram(flat: Array) -> Array:
    """Square, flat' flat, of a contiguous array, by half the products."""
    upper = dsyrk(1.0, flat.T)
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T)


LOOPS = Loops("magtwin.localization.arrow_loops", pays=0)
"""Compiled loops; plain Python would take seconds for each system."""


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric positive definite system, to be solved once."""

    diagonal: Array
    """Diagonal blocks of A, shape (N, D, D)."""

    below: Array
    """Blocks of A below them, shape (N - 1, D, D)."""

    border: Array
    """B and in its last column a, shape (N, D, G + 1)."""

    corner: Array
    """C, shape (G, G)."""

    right: Array
    """c, shape (G,)."""

    def damped(self, factor: float) -> "Arrow":
        """A copy with the diagonal of the matrix grown by a factor (Marquardt 1963)."""
        diagonal, corner = self.diagonal.copy(), self.corner.copy()
        diagonal[:, range(diagonal.shape[1]), range(diagonal.shape[1])] *= 1 + factor
        corner[range(len(corner)), range(len(corner))] *= 1 + factor
        return Arrow(diagonal, self.below.copy(), self.border.copy(), corner, self.right)

    def solve(self) -> "Solution":
        """Solve the system. It overwrites the blocks.

        Raises:
            np.linalg.LinAlgError: The matrix is not positive definite.
        """
        code = LOOPS.open()
        if code.eliminate(self.diagonal, self.below, self.border) >= 0:
            raise np.linalg.LinAlgError("the block of a pose is not positive definite")
        flat = self.border.reshape(-1, self.border.shape[2])
        square = gram(flat)
        factor = cholesky(self.corner - square[:-1, :-1], lower=True, check_finite=False)
        g = cho_solve((factor, True), self.right - square[:-1, -1], check_finite=False)
        x = (self.border[:, :, -1] - self.border[:, :, :-1] @ g)[..., None]
        x = np.ascontiguousarray(x)
        code.substitute(self.diagonal, self.below, x)
        return Solution(x[..., 0], g, self.diagonal, self.below, self.border[:, :, :-1], factor)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of an `Arrow` and the parts of its inverse."""

    x: Array
    """Poses' part, shape (N, D)."""

    g: Array
    """Constants' part, shape (G,)."""

    diagonal: Array
    """Diagonal blocks of L with inverted diagonal entries, shape (N, D, D)."""

    below: Array
    """Blocks of L below them, shape (N - 1, D, D)."""

    border: Array
    """Y, shape (N, D, G)."""

    factor: Array
    """Cholesky factor of C - Y'Y, lower, shape (G, G)."""

    def pose_covariances(self) -> Array:
        """Diagonal blocks of the poses' part of the inverse, shape (N, D, D)."""
        code = LOOPS.open()
        out = np.empty(self.diagonal.shape)
        code.covariances(self.diagonal, self.below, out)
        v = np.ascontiguousarray(self.border)
        code.substitute(self.diagonal, self.below, v)
        count, size, wide = v.shape
        half = np.linalg.inv(self.factor) @ v.reshape(-1, wide).T
        half = half.T.reshape(count, size, wide)
        return np.asarray(out + half @ half.transpose(0, 2, 1))

    def last_covariance(self) -> Array:
        """Joint covariance of the last pose and the constants, shape (D + G, D + G)."""
        lower = np.tril(self.diagonal[-1], -1) + np.diag(1 / np.diagonal(self.diagonal[-1]))
        root = np.linalg.inv(lower)
        v = root.T @ self.border[-1]
        size, wide = v.shape
        out = np.empty((size + wide, size + wide))
        inverse = np.linalg.inv(self.factor)
        out[size:, size:] = constants = inverse.T @ inverse
        out[:size, size:] = -v @ constants
        out[size:, :size] = out[:size, size:].T
        out[:size, :size] = root.T @ root + v @ constants @ v.T
        return out
