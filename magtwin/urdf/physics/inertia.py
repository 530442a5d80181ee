"""Inertia: mass properties of bodies, and inertia tensors as principal moments and axes."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import canonical

NEAR_MISS = 0.02
"""Relative excess of the largest moment over the sum of the others that is still repaired."""


@dataclass(frozen=True)
class MassProperties:
    """Mass, centre of mass and inertia of a body in some frame."""

    mass: float
    """Mass [kg]."""

    centre: NDArray[np.float64]
    """Centre of mass [m], shape (3,)."""

    inertia: NDArray[np.float64]
    """Tensor about the centre of mass, in the frame's axes [kg m2], shape (3, 3)."""

    def moved(self, T: ArrayLike) -> "MassProperties":
        """The body in another frame, in which its present frame has pose T, shape (4, 4)."""
        T = np.asarray(T, float)
        R = T[:3, :3]
        return MassProperties(self.mass, R @ self.centre + T[:3, 3], R @ self.inertia @ R.T)


def combined(bodies: Sequence[MassProperties]) -> MassProperties:
    """Bodies in one frame joined to one, by the parallel axis theorem (Goldstein 2002, section 5.3).

    I = sum_b I_b + m_b (|d_b|^2 1 - d_b d_b^T), d_b = c_b - c, c the common centre.
    """
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.centre for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        d = body.centre - centre
        inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return MassProperties(mass, centre, inertia)


def principal_axes(inertia: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Principal moments of an inertia tensor, and the rotation to its principal axes.

    I = R diag(I_1, I_2, I_3) R^T, with the principal axes as columns of R. Of the 24 orders and signs, R is
    the one nearest to the identity, so that a diagonal tensor keeps its axes. Real bodies have I_i > 0
    and I_i + I_j >= I_k (Goldstein 2002, section 5.4).

    Args:
        inertia: Tensor about the centre of mass [kg m2], shape (3, 3).

    Returns:
        Moments [kg m2], shape (3,); the quaternion xyzw of R, shape (4,); and whether a moment was
        reduced to the sum of the others, which it exceeded by less than NEAR_MISS.

    Raises:
        InputError: No body has such a tensor; the message gives the moments.
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
    start = f"no body has principal moments of inertia {', '.join(f'{m:.3g}' for m in moments)} kg m2"
    if not (np.isfinite(moments).all() and moments.min() > 0):
        raise InputError(f"{start}; all must be above 0")
    if moments[largest] > others * (1 + NEAR_MISS):
        raise InputError(f"{start}; none may exceed the sum of the others")
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
