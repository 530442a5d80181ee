"""Hilbert: a Gaussian process as a weighted sum of the Laplace operator's eigenfunctions on a box.

On a box with sides L_a, the functions that vanish on its border and their eigenvalues are

    phi_j(p) = prod_a sqrt(2 / L_a) sin(w_ja (p_a - low_a)),  w_ja = pi n_ja / L_a,  lambda_j = sum_a w_ja^2

A Gaussian process with the isotropic spectral density S is near sum_j m_j phi_j with independent weights m_j
of variance S(sqrt(lambda_j)) (Solin and Sarkka 2020, Hilbert space methods for reduced-rank Gaussian process
regression, eq. 20). A magnetic field without sources is curl-free: it is the gradient of a scalar potential
of this form (Solin et al. 2018, Modeling and interpolation of the ambient magnetic field by Gaussian
processes, eq. 20).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.compiled import Loops
from magtwin.errors import InputError

Array = NDArray[np.float64]

LOOPS = Loops("magtwin.localization.slam.hilbert_loops", pays=0)
"""Compiled loops: a solution takes a quarter of the time of that with numpy."""


@dataclass(frozen=True, eq=False)
class Basis:
    """Eigenfunctions on a box, in the order of their eigenvalues."""

    low: Array
    """Lower corner of the box [m], shape (d,)."""

    sides: Array
    """Sides of the box [m], shape (d,)."""

    order: NDArray[np.int64]
    """Half waves n of each function along each axis, from 1, shape (M, d)."""

    @property
    def count(self) -> int:
        """Number of functions."""
        return len(self.order)

    @property
    def frequency(self) -> Array:
        """Angular frequency along each axis [rad/m], shape (M, d)."""
        return np.asarray(np.pi * self.order / self.sides)

    @property
    def eigenvalues(self) -> Array:
        """Eigenvalues of minus the Laplace operator [1/m^2], shape (M,)."""
        return np.asarray((self.frequency**2).sum(axis=1))

    def values(self, p: ArrayLike) -> Array:
        """The functions at points.

        Args:
            p: Points [m], shape (..., d). Outside of the box the functions continue as odd waves.

        Returns:
            Values [m^(-d/2)], shape (..., M).
        """
        return np.asarray(self._waves(p)[0].prod(axis=-1))

    def gradients(self, p: ArrayLike) -> Array:
        """Gradients of the functions, shape (..., d, M); the arguments are those of `values`."""
        sines, cosines = self._waves(p)
        axes = range(len(self.low))
        parts = [np.prod([cosines[..., a] if a == b else sines[..., b] for b in axes], axis=0) for a in axes]
        return np.stack(parts, axis=-2)

    def slopes(self, p: Array, weights: Array) -> Array:
        """Gradient of sum_j weights_j phi_j in space, compiled; shape (N, 3)."""
        slope = np.empty(p.shape)
        none = np.empty((0, 3, self.count)), np.empty((0, 3, 3))
        LOOPS.open().potential(p, self.low, self.sides, self.order, weights, none[0], slope, none[1])
        return slope

    def derivatives(self, p: Array, weights: Array) -> tuple[Array, Array, Array]:
        """`gradients`, `slopes` and second derivatives, compiled; shapes (N, 3, M), (N, 3) and (N, 3, 3)."""
        gradients, hessian = np.empty((len(p), 3, self.count)), np.empty((len(p), 3, 3))
        slope = np.empty(p.shape)
        LOOPS.open().potential(p, self.low, self.sides, self.order, weights, gradients, slope, hessian)
        return gradients, slope, hessian

    def variances(self, *, sd: float, length_m: float) -> Array:
        """Prior variances of the weights, by the squared exponential kernel (Rasmussen and Williams 2006).

            S(w) = sd^2 (2 pi)^(d/2) l^d exp(-l^2 w^2 / 2),  w = sqrt(lambda)

        Args:
            sd: Standard deviation of the process.
            length_m: Length scale l [m].

        Returns:
            Variances [sd^2 m^d], shape (M,).
        """
        volume = (math.sqrt(2 * math.pi) * length_m) ** len(self.low)
        return np.asarray(sd**2 * volume * np.exp(-((length_m * np.sqrt(self.eigenvalues)) ** 2) / 2))

    def _waves(self, p: ArrayLike) -> tuple[Array, Array]:
        """sqrt(2 / L) sin(w x) and its derivative, shapes (..., M, d)."""
        x = np.asarray(p, float) - self.low
        angle = x[..., None, :] * self.frequency
        height = np.sqrt(2 / self.sides)
        return height * np.sin(angle), height * self.frequency * np.cos(angle)


def basis(low: Sequence[float], high: Sequence[float], count: int) -> Basis:
    """The functions with the least eigenvalues on a box.

    An isotropic spectral density that falls with frequency gives these weights the greatest variance.

    Args:
        low: Lower corner of the box [m], shape (d,).
        high: Upper corner [m].
        count: Number of functions.

    Raises:
        InputError: The box is empty or the count is not positive.
    """
    corner, sides = np.asarray(low, float), np.asarray(high, float) - np.asarray(low, float)
    if not (np.isfinite(sides).all() and (sides > 0).all()):
        raise InputError(f"the box of the field model must not be empty, got sides of {sides.tolist()} m")
    if count < 1:
        raise InputError(f"functions must be 1 or more, got {count}", parameter="functions")
    reach = math.pi * math.sqrt((1 / sides**2).sum())
    while True:
        most = [int(reach * side / math.pi) for side in sides]
        grid = np.stack(np.meshgrid(*[np.arange(1, n + 1) for n in most], indexing="ij"), axis=-1)
        order = grid.reshape(-1, len(sides))
        eigenvalues = ((np.pi * order / sides) ** 2).sum(axis=1)
        order, eigenvalues = order[eigenvalues <= reach**2], eigenvalues[eigenvalues <= reach**2]
        if len(order) >= count:
            kept = np.argsort(eigenvalues, kind="stable")[:count]
            return Basis(corner, sides, order[kept].astype(np.int64))
        reach *= 1.25
