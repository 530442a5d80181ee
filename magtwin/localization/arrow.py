"""Arrow: linear systems whose matrix is block tridiagonal with a dense border.

    [ T   C ] [ x ]   [ a ]
    [ C'  G ] [ g ] = [ c ]

T has one block for each pose, coupled to the next one; g are the constants of the run. With the banded
Cholesky factor T = L L' and Y = L^-1 C, (G - Y'Y) g = c - Y' L^-1 a, and x from L' x = L^-1 a - Y g. The work
grows with the number of poses N and as the square of the number of constants.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky_banded
from scipy.linalg.lapack import dtbtrs

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric positive definite system."""

    diagonal: Array
    """Diagonal blocks of T, shape (N, D, D)."""

    below: Array
    """Blocks of T below them, shape (N - 1, D, D)."""

    border: Array
    """C and in its last column a, shape (N, D, M + 1)."""

    corner: Array
    """G, shape (M, M)."""

    right: Array
    """c, shape (M,)."""

    def damped(self, factor: float) -> "Arrow":
        """A copy with the diagonal of the matrix grown by a factor (Marquardt 1963)."""
        diagonal, corner = self.diagonal.copy(), self.corner.copy()
        diagonal[:, range(diagonal.shape[1]), range(diagonal.shape[1])] *= 1 + factor
        corner[range(len(corner)), range(len(corner))] *= 1 + factor
        return Arrow(diagonal, self.below, self.border, corner, self.right)

    def solve(self) -> "Solution":
        """Solve the system.

        Raises:
            np.linalg.LinAlgError: The matrix is not positive definite.
        """
        n, b, wide = self.border.shape
        band = np.zeros((2 * b, n * b))  # T in the lower banded form of LAPACK
        for i in range(b):
            for j in range(b):
                if i >= j:
                    band[i - j, j::b] = self.diagonal[:, i, j]
                band[b + i - j, j : (n - 1) * b : b] = self.below[:, i, j]
        factor = cholesky_banded(band, lower=True, check_finite=False)
        y = dtbtrs(factor, np.asfortranarray(self.border.reshape(n * b, wide)), uplo="L")[0]
        square = y.T @ y
        schur = cho_factor(self.corner - square[:-1, :-1], check_finite=False)
        g = cho_solve(schur, self.right - square[:-1, -1], check_finite=False)
        x = dtbtrs(factor, y[:, -1] - y[:, :-1] @ g, uplo="L", trans="T")[0]
        return Solution(x.reshape(n, b), g, self, factor, y[:, :-1], schur)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of an `Arrow` and the parts of its inverse."""

    x: Array
    """Poses' part, shape (N, D)."""

    g: Array
    """Constants' part, shape (M,)."""

    arrow: Arrow
    """The system."""

    factor: Array
    """L in the lower banded form of LAPACK."""

    y: Array
    """Y, shape (N D, M)."""

    schur: tuple[Array, bool]
    """Factor of G - Y'Y."""

    def pose_covariances(self) -> Array:
        """Diagonal blocks of the poses' part of the inverse, shape (N, D, D).

        Forward, the Schur complements S_k = D_k - L_k-1 S_k-1^-1 L_k-1'. Backward, the selected inverse of T,
        P_k = S_k^-1 + S_k^-1 L_k' P_k+1 L_k S_k^-1 (Takahashi, Fagan and Chen 1973).
        """
        diagonal, below = self.arrow.diagonal, self.arrow.below
        inverses = self._schur_inverses()
        made = inverses.copy()
        for k in range(len(diagonal) - 2, -1, -1):
            gain = inverses[k] @ below[k].T
            made[k] += gain @ made[k + 1] @ gain.T
        w = dtbtrs(self.factor, self.y, uplo="L", trans="T")[0].reshape(*diagonal.shape[:2], -1)
        made += w @ self._constants() @ w.transpose(0, 2, 1)
        return np.asarray(0.5 * (made + made.transpose(0, 2, 1)))

    def last_covariance(self) -> Array:
        """Joint covariance of the last pose and the constants, shape (D + M, D + M)."""
        size, corner = self.x.shape[1], self._constants()
        last = np.zeros((2 * size, size))
        last[:size] = self.factor[:size, -size:]  # of the last block alone
        w = dtbtrs(last, self.y[-size:], uplo="L", trans="T")[0]
        across = -w @ corner
        pose = self._schur_inverses()[-1] - across @ w.T
        made = np.block([[pose, across], [across.T, corner]])
        return np.asarray(0.5 * (made + made.T))

    def _constants(self) -> Array:
        return np.asarray(cho_solve(self.schur, np.eye(len(self.g)), check_finite=False))

    def _schur_inverses(self) -> Array:
        diagonal, below = self.arrow.diagonal, self.arrow.below
        made = np.empty_like(diagonal)
        made[0] = np.linalg.inv(diagonal[0])
        for k in range(1, len(diagonal)):
            made[k] = np.linalg.inv(diagonal[k] - below[k - 1] @ made[k - 1] @ below[k - 1].T)
        return made
