"""Compiled loops of `hilbert`: the potential's gradient and second derivatives at points in space."""

import numpy as np
from numba import types
from numpy.typing import NDArray

from magtwin.compiled import compiled

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_CUBE = types.Array(types.float64, 3, "C")
_FLAT = types.Array(types.float64, 2, "C")
_LINE = types.Array(types.float64, 1, "C")
_ORDER = types.Array(types.int64, 2, "C")


@compiled(_FLAT, _LINE, _LINE, _ORDER, _LINE, _CUBE, _FLAT, _CUBE)
def potential(
    p: Array,
    low: Array,
    sides: Array,
    order: Numbers,
    weights: Array,
    gradients: Array,
    slope: Array,
    hessian: Array,
) -> None:
    """Gradients of the functions, and gradient and second derivatives of their weighted sum.

    Args:
        p: Points, shape (N, 3).
        low: Lower corner of the box, shape (3,).
        sides: Its sides, shape (3,).
        order: Half waves of each function, shape (M, 3).
        weights: Shape (M,).
        gradients: Takes the gradients, shape (N, 3, M); of shape (0, 3, M) to leave them out.
        slope: Takes the gradient of the sum, shape (N, 3).
        hessian: Takes its second derivatives, shape (N, 3, 3); of shape (0, 3, 3) to leave them out.
    """
    count, wanted, curved = order.shape[0], gradients.shape[0] > 0, hessian.shape[0] > 0
    most = 0
    for j in range(count):
        for a in range(3):
            most = max(most, order[j, a])
    s, c, w = np.empty((3, most + 1)), np.empty((3, most + 1)), np.empty((3, most + 1))
    for n in range(p.shape[0]):
        for a in range(3):
            unit = np.pi / sides[a]
            height = np.sqrt(2.0 / sides[a])
            angle = unit * (p[n, a] - low[a])
            twice = 2.0 * np.cos(angle)
            s[a, 0], c[a, 0], w[a, 0] = 0.0, height, 0.0
            if most:
                s[a, 1], c[a, 1], w[a, 1] = height * np.sin(angle), height * np.cos(angle), unit
            for k in range(2, most + 1):  # sin(k x) = 2 cos(x) sin((k - 1) x) - sin((k - 2) x)
                s[a, k] = twice * s[a, k - 1] - s[a, k - 2]
                c[a, k] = twice * c[a, k - 1] - c[a, k - 2]
                w[a, k] = k * unit
        gx = gy = gz = 0.0
        xx = yy = zz = xy = xz = yz = 0.0
        for j in range(count):
            ix, iy, iz = order[j, 0], order[j, 1], order[j, 2]
            sx, sy, sz = s[0, ix], s[1, iy], s[2, iz]
            wx, wy, wz = w[0, ix], w[1, iy], w[2, iz]
            dx, dy, dz = wx * c[0, ix], wy * c[1, iy], wz * c[2, iz]
            m = weights[j]
            ax, ay, az = dx * sy * sz, sx * dy * sz, sx * sy * dz
            gx += m * ax
            gy += m * ay
            gz += m * az
            if wanted:
                gradients[n, 0, j], gradients[n, 1, j], gradients[n, 2, j] = ax, ay, az
            if curved:
                value = m * sx * sy * sz
                xx -= value * wx * wx
                yy -= value * wy * wy
                zz -= value * wz * wz
                xy += m * dx * dy * sz
                xz += m * dx * sy * dz
                yz += m * sx * dy * dz
        slope[n, 0], slope[n, 1], slope[n, 2] = gx, gy, gz
        if curved:
            hessian[n, 0, 0], hessian[n, 1, 1], hessian[n, 2, 2] = xx, yy, zz
            hessian[n, 0, 1] = hessian[n, 1, 0] = xy
            hessian[n, 0, 2] = hessian[n, 2, 0] = xz
            hessian[n, 1, 2] = hessian[n, 2, 1] = yz
