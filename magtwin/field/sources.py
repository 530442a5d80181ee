"""Magnetised things, seen as point dipoles."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.names import RefusedError

Array = NDArray[np.float64]

MU_0_OVER_4_PI = 1.00000000055e-7
"""Magnetic constant over 4 pi [T m/A] (CODATA 2018)."""

NT_PER_T = 1e9

PAIRS = 16_384
"""Point-dipole pairs worked on at a time: seven arrays of them stay in the second-level cache."""


def dipole_field_nt(p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike) -> Array:
    """Field of point dipoles (Jackson, Classical Electrodynamics, 3rd ed. 1999, eq. 5.56).

    B(p) = mu_0 / 4 pi * sum_d (3 (m_d . u) u - m_d) / |r|^3,  r = p - p_d,  u = r / |r|

    Args:
        p_world: Observation points [m], shape (..., 3).
        p_world_dipole: Dipole positions [m], shape (D, 3).
        m_world: Dipole moments [A m^2], shape (D, 3).

    Returns:
        Field in world axes [nT], shape (..., 3); not finite at a dipole itself, zero for no dipoles.

    Raises:
        RefusedError: A shape is not as above.
    """
    p = np.asarray(p_world, float)
    place, moment = np.asarray(p_world_dipole, float), np.asarray(m_world, float)
    if p.ndim == 0 or p.shape[-1] != 3:
        raise RefusedError(f"p_world must have shape (..., 3), got {p.shape}")
    if place.ndim != 2 or place.shape[1] != 3 or moment.shape != place.shape:
        raise RefusedError(
            f"p_world_dipole and m_world must have one shape (D, 3), got {place.shape} and {moment.shape}"
        )
    points = p.reshape(-1, 3)
    field = np.zeros(points.shape)
    block = max(1, PAIRS // max(1, len(place)))
    for start in range(0, len(points), block):
        field[start : start + block] = _dipoles(points[start : start + block], place, moment)
    return field.reshape(p.shape)


def _dipoles(p: Array, place: Array, moment: Array) -> Array:
    """Field [nT] at p (N, 3), with arrays of shape (N, D)."""
    rx, ry, rz = (p[:, axis, None] - place[:, axis] for axis in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (rx * rx + ry * ry + rz * rz)
        cubed = inverse * np.sqrt(inverse)
        along = 3 * inverse * (moment[:, 0] * rx + moment[:, 1] * ry + moment[:, 2] * rz)
        parts = [((along * r - moment[:, axis]) * cubed).sum(axis=1) for axis, r in enumerate((rx, ry, rz))]
    return MU_0_OVER_4_PI * NT_PER_T * np.stack(parts, axis=-1)
