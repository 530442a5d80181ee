"""Compiled sums over dipoles: for fields computed again and again, and for gradients.

Importing this module opens numba (see `magtwin.compiled`). `magtwin.field.sources.dipoles` does not need it.
"""

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from magtwin.compiled import compiled, in_threads
from magtwin.field.sources.dipoles import MU_0_OVER_4_PI, NT_PER_T, checked

Array = NDArray[np.float64]

BLOCK = 256  # Points worked on at a time, with all dipoles: their sums stay in the first-level cache
SHARE = 262_144  # Pairs of a point and a dipole that a thread takes at a time

_IN = types.Array(types.float64, 2, "C", readonly=True)
_OUT = types.Array(types.float64, 2, "C")
_IN_3, _OUT_3 = types.Array(types.float64, 3, "C", readonly=True), types.Array(types.float64, 3, "C")


def dipole_field_nt(p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike) -> Array:
    """Field of point dipoles, faster than `magtwin.field.sources.dipoles.dipole_field_nt`, with its
    arguments.

    The dipoles are summed in their order, whatever the number of points and threads.
    """
    return _sum(p_world, p_world_dipole, m_world, gradient=False)[0]


def dipole_field_and_gradient_nt(
    p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike
) -> tuple[Array, Array]:
    """Field of point dipoles and its gradient in space.

    dB_i/dx_j = mu_0 / 4 pi * sum_d 3 / |r|^5 *
                (m_j r_i + m_i r_j + (m . r) delta_ij - 5 (m . r) r_i r_j / |r|^2),  r = p - p_d

    (Jackson, Classical Electrodynamics, 3rd ed. 1999, the derivative of eq. 5.56): symmetric, as curl B = 0,
    and of trace 0, as div B = 0.

    Shapes are those of `dipole_field_nt`. The field [nT] has the same bytes as from there; the gradient
    dB_i/dx_j [nT/m], in world axes, has shape (..., 3, 3).
    """
    field, five = _sum(p_world, p_world_dipole, m_world, gradient=True)
    xx, xy, xz, yy, yz = np.moveaxis(five, -1, 0)
    rows = [np.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, -(xx + yy)))]
    return field, np.stack(rows, axis=-2)


def _sum(
    p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike, *, gradient: bool
) -> tuple[Array, Array]:
    """Field, shape (..., 3), and its gradient's xx, xy, xz, yy, yz, shape (..., 5), or empty."""
    p, place, moment = (
        np.require(array, requirements=["C", "A"]) for array in checked(p_world, p_world_dipole, m_world)
    )
    points = p.reshape(-1, 3)
    field = np.empty(points.shape)
    five = np.empty((len(points) if gradient else 0, 5))

    def work(rows: slice) -> None:
        _dipoles(points[rows], place, moment, field[rows], five[rows])

    in_threads(work, len(points), max(1, SHARE // max(1, len(place))))
    scale = MU_0_OVER_4_PI * NT_PER_T
    field *= scale
    five *= scale
    return field.reshape(p.shape), five.reshape(*p.shape[:-1], 5) if gradient else five


def moment_rows(p_world: Array, p_world_dipole: Array, ways: Array, out: Array) -> None:
    """Derivatives of components of the field by every dipole's moment.

    w . dB/dm = mu_0 / 4 pi * (3 (w . r) r / |r|^5 - w / |r|^3),  r = p - p_d

    `ways` are the directions w of each point's components, shape (N, C, 3). `out` takes the derivatives
    [nT/(A m^2)], dipole by dipole, in its first 3 D columns, shape (N, C, P).
    """
    _moment_rows(p_world, p_world_dipole, np.ascontiguousarray(ways), MU_0_OVER_4_PI * NT_PER_T, out)


@compiled(_IN, _IN, _IN_3, types.float64, _OUT_3)
def _moment_rows(p: Array, place: Array, ways: Array, factor: float, out: Array) -> None:
    """See `moment_rows`; coordinates of the dipoles are separated so that the inner loop has stride 1."""
    count = place.shape[0]
    rx, ry, rz, cubed = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    px, py, pz = place[:, 0].copy(), place[:, 1].copy(), place[:, 2].copy()
    for n in range(p.shape[0]):
        x, y, z = p[n, 0], p[n, 1], p[n, 2]
        for d in range(count):
            rx[d], ry[d], rz[d] = x - px[d], y - py[d], z - pz[d]
            inverse = 1 / (rx[d] * rx[d] + ry[d] * ry[d] + rz[d] * rz[d])
            root = np.sqrt(inverse)
            cubed[d] = factor * inverse * root
            rx[d], ry[d], rz[d] = rx[d] * root, ry[d] * root, rz[d] * root
        for c in range(ways.shape[1]):
            wx, wy, wz = ways[n, c, 0], ways[n, c, 1], ways[n, c, 2]
            row = out[n, c]
            for d in range(count):
                along = 3 * (wx * rx[d] + wy * ry[d] + wz * rz[d])
                row[3 * d] = (along * rx[d] - wx) * cubed[d]
                row[3 * d + 1] = (along * ry[d] - wy) * cubed[d]
                row[3 * d + 2] = (along * rz[d] - wz) * cubed[d]


@compiled(_IN, _IN, _IN, _OUT, _OUT)
def _dipoles(p: Array, place: Array, moment: Array, field: Array, gradient: Array) -> None:
    """Sums at p (N, 3) over dipoles (D, 3) without their factor; `gradient` is (N, 5), or (0, 5) for none."""
    x, y, z = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    b, g = np.empty((3, BLOCK)), np.empty((5, BLOCK))
    for start in range(0, p.shape[0], BLOCK):
        count = min(BLOCK, p.shape[0] - start)
        for n in range(count):
            x[n], y[n], z[n] = p[start + n, 0], p[start + n, 1], p[start + n, 2]
        b[:] = 0
        g[:] = 0
        bx, by, bz = b[0, :count], b[1, :count], b[2, :count]
        xx, xy, xz, yy, yz = g[0, :count], g[1, :count], g[2, :count], g[3, :count], g[4, :count]
        for d in range(place.shape[0]):
            px, py, pz = place[d, 0], place[d, 1], place[d, 2]
            mx, my, mz = moment[d, 0], moment[d, 1], moment[d, 2]
            for n in range(count):
                rx, ry, rz = x[n] - px, y[n] - py, z[n] - pz
                inverse = 1 / (rx * rx + ry * ry + rz * rz)
                cubed = inverse * np.sqrt(inverse)
                along = 3 * inverse * (mx * rx + my * ry + mz * rz)
                bx[n] += (along * rx - mx) * cubed
                by[n] += (along * ry - my) * cubed
                bz[n] += (along * rz - mz) * cubed
            if gradient.shape[0] == 0:
                continue
            for n in range(count):
                rx, ry, rz = x[n] - px, y[n] - py, z[n] - pz
                inverse = 1 / (rx * rx + ry * ry + rz * rz)
                fifth = 3 * inverse * inverse * np.sqrt(inverse)
                radial = mx * rx + my * ry + mz * rz
                twice = 5 * radial * inverse
                xx[n] += (2 * mx * rx + radial - twice * rx * rx) * fifth
                xy[n] += (my * rx + mx * ry - twice * rx * ry) * fifth
                xz[n] += (mz * rx + mx * rz - twice * rx * rz) * fifth
                yy[n] += (2 * my * ry + radial - twice * ry * ry) * fifth
                yz[n] += (mz * ry + my * rz - twice * ry * rz) * fifth
        for n in range(count):
            for axis in range(3):
                field[start + n, axis] = b[axis, n]
            if gradient.shape[0] > 0:
                for k in range(5):
                    gradient[start + n, k] = g[k, n]
