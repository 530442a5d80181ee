"""Compiled loops of `arrow`: block elimination of the poses, and the blocks of their covariance."""

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled, inlined

Array = NDArray[np.float64]

_CUBE = types.Array(types.float64, 3, "C")
_FLAT = types.Array(types.float64, 2, "C")


@inlined
def _factor(a: Array, n: int) -> bool:
    """Cholesky factor in the lower triangle, in place, with inverted diagonal; False if not definite."""
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                a[i, i] = 1.0 / np.sqrt(s)
            else:
                a[i, j] = s * a[j, j]
    return True


@compiled(_CUBE, _CUBE, _CUBE)
def eliminate(diagonal: Array, below: Array, right: Array) -> int:
    """Factor A = L L' and replace `right` by L^-1 right, in place.

    Args:
        diagonal: Diagonal blocks, shape (N, D, D); becomes those of L, with inverted diagonal entries.
        below: Blocks below them, shape (N - 1, D, D); becomes those of L.
        right: Right-hand sides, shape (N, D, M).

    Returns:
        The row of the first block that is not positive definite, or -1.
    """
    count, n, wide = right.shape
    for row in range(count):
        if row:
            low, last = below[row - 1], diagonal[row - 1]
            for i in range(n):  # low L' = below
                for j in range(n):
                    s = low[i, j]
                    for k in range(j):
                        s -= low[i, k] * last[j, k]
                    low[i, j] = s * last[j, j]
            for i in range(n):
                for j in range(i + 1):
                    s = 0.0
                    for k in range(n):
                        s += low[i, k] * low[j, k]
                    diagonal[row, i, j] -= s
                for k in range(n):
                    f = low[i, k]
                    for m in range(wide):
                        right[row, i, m] -= f * right[row - 1, k, m]
        if not _factor(diagonal[row], n):
            return row
        block = diagonal[row]
        for i in range(n):
            for k in range(i):
                f = block[i, k]
                for m in range(wide):
                    right[row, i, m] -= f * right[row, k, m]
            f = block[i, i]
            for m in range(wide):
                right[row, i, m] *= f
    return -1


@compiled(_CUBE, _CUBE, _CUBE)
def substitute(diagonal: Array, below: Array, right: Array) -> None:
    """Replace `right` by L'^-1 right, in place; L is that of `eliminate`."""
    count, n, wide = right.shape
    for back in range(count):
        row = count - 1 - back
        if back:
            low = below[row]
            for i in range(n):
                for k in range(n):
                    f = low[k, i]
                    for m in range(wide):
                        right[row, i, m] -= f * right[row + 1, k, m]
        block = diagonal[row]
        for down in range(n):
            i = n - 1 - down
            for k in range(i + 1, n):
                f = block[k, i]
                for m in range(wide):
                    right[row, i, m] -= f * right[row, k, m]
            f = block[i, i]
            for m in range(wide):
                right[row, i, m] *= f


@compiled(_CUBE, _CUBE, _CUBE)
def covariances(diagonal: Array, below: Array, out: Array) -> None:
    """Diagonal blocks of A^-1, shape (N, D, D), by Z_kk = L_kk^-T (I + L_k' Z_k+1 L_k) L_kk^-1.

    L_k is the block of L below the diagonal block L_kk.
    """
    count, n = out.shape[0], out.shape[1]
    inverse, mixed = np.zeros((n, n)), np.zeros((n, n))
    for back in range(count):
        row = count - 1 - back
        block = diagonal[row]
        for j in range(n):  # inverse of L_kk
            for i in range(j):
                inverse[i, j] = 0.0
            inverse[j, j] = block[j, j]
            for i in range(j + 1, n):
                s = 0.0
                for k in range(j, i):
                    s -= block[i, k] * inverse[k, j]
                inverse[i, j] = s * block[i, i]
        for i in range(n):
            for j in range(n):
                mixed[i, j] = 1.0 if i == j else 0.0
        if back:
            low = below[row]
            for i in range(n):
                for j in range(n):
                    s = 0.0
                    for k in range(n):
                        for m in range(n):
                            s += low[k, i] * out[row + 1, k, m] * low[m, j]
                    mixed[i, j] += s
        for i in range(n):
            for j in range(n):
                s = 0.0
                for k in range(i, n):
                    for m in range(j, n):
                        s += inverse[k, i] * mixed[k, m] * inverse[m, j]
                out[row, i, j] = s
