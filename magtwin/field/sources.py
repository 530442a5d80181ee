"""Magnetised things, seen as point dipoles."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.names import RefusedError

Array = NDArray[np.float64]

MU_0_OVER_4_PI = 1.00000000055e-7
"""Magnetic constant over 4 pi [T m/A] (CODATA 2018)."""

NT_PER_T = 1e9

SHARED = 16
"""Blocks from which on a second thread is worth its start; which thread works on a row changes no byte."""

PAIRS = 32_768
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
    p, place, moment = _checked(p_world, p_world_dipole, m_world)
    points = p.reshape(-1, 3)
    field = np.zeros(points.shape)

    def work(rows: slice) -> None:
        field[rows], _ = _dipoles(points[rows], None, place, moment)

    _in_blocks(work, len(points), len(place))
    return field.reshape(p.shape)


def dipole_field_and_rate_nt(
    p_world: ArrayLike, v_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike
) -> tuple[Array, Array]:
    """Field of point dipoles at points that move, and how fast it changes there.

    dB/dt = (v . grad) B = mu_0 / 4 pi * sum_d 3 / |r|^5 *
            ((m_d . v) r + (m_d . r) v + (v . r) m_d - 5 (m_d . r) (v . r) r / |r|^2),  r = p - p_d

    which is the derivative of `dipole_field_nt`'s sum along v.

    Args:
        p_world: Observation points [m], shape (..., 3).
        v_world: Their velocities [m/s], shape (..., 3).
        p_world_dipole: Dipole positions [m], shape (D, 3).
        m_world: Dipole moments [A m^2], shape (D, 3).

    Returns:
        Field in world axes [nT], the same bytes as `dipole_field_nt` gives, and its rate of change at
        the moving point [nT/s], each of shape (..., 3).

    Raises:
        RefusedError: A shape is not as above.
    """
    p, place, moment = _checked(p_world, p_world_dipole, m_world)
    v = np.asarray(v_world, float)
    if v.shape != p.shape:
        raise RefusedError(f"v_world must have the shape of p_world, {p.shape}, got {v.shape}")
    points, velocities = p.reshape(-1, 3), v.reshape(-1, 3)
    field, rate = np.zeros(points.shape), np.zeros(points.shape)

    def work(rows: slice) -> None:
        field[rows], rate[rows] = _dipoles(points[rows], velocities[rows], place, moment)

    _in_blocks(work, len(points), len(place))
    return field.reshape(p.shape), rate.reshape(p.shape)


def _checked(p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike) -> tuple[Array, Array, Array]:
    p = np.asarray(p_world, float)
    place, moment = np.asarray(p_world_dipole, float), np.asarray(m_world, float)
    if p.ndim == 0 or p.shape[-1] != 3:
        raise RefusedError(f"p_world must have shape (..., 3), got {p.shape}")
    if place.ndim != 2 or place.shape[1] != 3 or moment.shape != place.shape:
        raise RefusedError(
            f"p_world_dipole and m_world must have one shape (D, 3), got {place.shape} and {moment.shape}"
        )
    return p, place, moment


def _in_blocks(work: Callable[[slice], None], points: int, dipoles: int) -> None:
    """Have all rows worked on, a block at a time; many blocks are shared out among two threads."""
    block = max(1, PAIRS // max(1, dipoles))
    blocks = [slice(start, start + block) for start in range(0, points, block)]

    def several(some: list[slice]) -> None:
        for rows in some:
            work(rows)

    if len(blocks) < SHARED:
        several(blocks)
        return
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(several, (blocks[::2], blocks[1::2])))


def _dipoles(p: Array, v: Array | None, place: Array, moment: Array) -> tuple[Array, Array]:
    """Field [nT] at p (N, 3), with arrays of shape (N, D), and its rate [nT/s] for velocities v (N, 3)."""
    r = [p[:, axis, None] - place[:, axis] for axis in range(3)]
    scale = MU_0_OVER_4_PI * NT_PER_T
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / _dot(r, r)
        cubed = inverse * np.sqrt(inverse)
        along = 3 * inverse * _dot(moment.T, r)
        field = [((along * r[axis] - moment[:, axis]) * cubed).sum(axis=1) for axis in range(3)]
        if v is None:
            return scale * np.stack(field, axis=-1), np.empty((0, 3))
        towards = _dot(v.T[:, :, None], r)
        radial = _dot(v.T[:, :, None], moment.T) - 5 / 3 * along * towards
        fifth = 3 * inverse * cubed
        radial, towards = radial * fifth, towards * fifth
        turned = [
            np.einsum("nd,nd->n", radial, r[axis]) + np.einsum("nd,d->n", towards, moment[:, axis])
            for axis in range(3)
        ]
        rate = np.array(turned) + np.einsum("nd,nd->n", along, cubed) * v.T
    return scale * np.stack(field, axis=-1), scale * np.stack(rate, axis=-1)


def _dot(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> Array:
    """Scalar products of vectors given axis by axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
