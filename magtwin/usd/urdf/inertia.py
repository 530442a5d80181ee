"""Inertia: a tensor as USD has it, principal moments and the axes that they are about."""

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import canonical
from magtwin.names import RefusedError

NEAR_MISS = 0.02
"""Part of the largest moment by which it may exceed the sum of the others and still be repaired."""


def principal_axes(inertia: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Principal moments of an inertia tensor, and the rotation from its axes to the principal ones.

    I = R diag(I_1, I_2, I_3) R^T, the columns of R being the principal axes. Among the 24 ways to
    order and sign them, R is the one nearest to the identity, so that a diagonal tensor keeps its axes.
    Real bodies have I_i > 0 and I_i + I_j >= I_k (Goldstein 2002, section 5.4).

    Args:
        inertia: Tensor about the centre of mass [kg m2], shape (3, 3).

    Returns:
        Moments [kg m2], shape (3,); the quaternion xyzw of R, shape (4,); and whether a moment that
        exceeded the sum of the others by less than NEAR_MISS of itself was brought down to that sum.

    Raises:
        RefusedError: No body has such a tensor; the text gives the moments.
    """
    tensor = np.asarray(inertia, float)
    tensor = (tensor + tensor.T) / 2
    if np.count_nonzero(tensor - np.diag(np.diag(tensor))) == 0:
        moments, R = np.diag(tensor).copy(), np.eye(3)
    else:
        moments, R = np.linalg.eigh(tensor)
        best = max(permutations(range(3)), key=lambda order: np.abs(np.diag(R[:, order])).sum())
        moments, R = moments[list(best)], R[:, best]
        R = R * np.where(np.diag(R) < 0, -1, 1)
        if np.linalg.det(R) < 0:
            R[:, np.argmin(np.diag(R))] *= -1
    largest = int(np.argmax(moments))
    others = moments.sum() - moments[largest]
    text = ", ".join(f"{m:.3g}" for m in moments)
    if not (np.isfinite(moments).all() and moments.min() > 0):
        raise RefusedError(f"no body has principal moments of inertia {text} kg m2; all must be above 0")
    if moments[largest] > others * (1 + NEAR_MISS):
        raise RefusedError(
            f"no body has principal moments of inertia {text} kg m2; none may exceed the sum of the others"
        )
    repaired = bool(moments[largest] > others * (1 + 1e-6))
    moments[largest] = min(moments[largest], others)
    return moments, quaternion(R), repaired


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion xyzw of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric form (2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return canonical(np.linalg.eigh(K)[1][:, -1])
