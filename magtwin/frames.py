"""Rotations and frames: world is ENU, bodies are forward-left-up, quaternions are xyzw.

Written on plain numpy, because these few lines run on every row of every run and importing
`scipy.spatial.transform` costs more than they do.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

IDENTITY_XYZW = (0.0, 0.0, 0.0, 1.0)


def wrap_angle(angle: ArrayLike) -> Array:
    """Angles brought into [-pi, pi) [rad], any shape."""
    return (np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi


def quat_from_yaw(yaw: ArrayLike) -> Array:
    """Quaternions xyzw of turns by `yaw` [rad] about z, shape (...) -> (..., 4)."""
    half = np.asarray(yaw, float) / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def into_base(v_xy: ArrayLike, yaw: ArrayLike) -> Array:
    """World vectors along the floor in the axes of a base that heads for `yaw` [rad], forward and left.

    Args:
        v_xy: Vectors along world x and y, shape (N, 2).
        yaw: Headings [rad], shape (N,).

    Returns:
        The same vectors forward and to the left, shape (N, 2).
    """
    (x, y), c, s = np.asarray(v_xy, float).T, np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * x + s * y, c * y - s * x])


def quat_from_rpy(rpy: ArrayLike) -> Array:
    """Quaternions xyzw of fixed-axis roll, pitch, yaw [rad] (URDF's rpy), shape (..., 3) -> (..., 4)."""
    half = np.ascontiguousarray(np.moveaxis(np.asarray(rpy, float), -1, 0)) / 2
    (sr, sp, sy), (cr, cp, cy) = np.sin(half), np.cos(half)
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def quat_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Hamilton products `a b` of quaternions xyzw, shapes (..., 4): first turn by b, then by a."""
    ax, ay, az, aw = np.moveaxis(np.asarray(a, float), -1, 0)
    bx, by, bz, bw = np.moveaxis(np.asarray(b, float), -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def enu_from_ned(q_ned_frd: ArrayLike) -> Array:
    """Orientations xyzw from axes north, east, down to east, north, up, shape (..., 4).

    The axes of the body become forward, left, up; they were forward, right, down.
    """
    enu = np.array([1.0, 1.0, 0.0, 0.0]) / np.sqrt(2.0)  # half a turn about x + y
    return quat_multiply(quat_multiply(enu, q_ned_frd), np.array([1.0, 0.0, 0.0, 0.0]))


def quat_conjugate(q: ArrayLike) -> Array:
    """Inverses of unit quaternions xyzw, shape (..., 4)."""
    return np.asarray(q, float) * (-1.0, -1.0, -1.0, 1.0)


def canonical(q: ArrayLike) -> Array:
    """The same rotations with w >= 0, shape (..., 4): q and -q differ to a network, not to a robot."""
    q = np.asarray(q, float)
    return np.where(q[..., 3:] < 0, -q, q)


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Vectors (..., 3) turned by unit quaternions xyzw (..., 4): v + 2 q_v x (q_v x v + w v)."""
    q, v = np.asarray(q, float), np.asarray(v, float)
    u, w = q[..., :3], q[..., 3:]
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def matrix_from_quat(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions xyzw (..., 4); columns are the turned axes."""
    q = np.asarray(q, float)
    return np.ascontiguousarray(np.swapaxes(rotate(q[..., None, :], np.eye(3)), -1, -2))


def yaw_from_quat(q: ArrayLike) -> Array:
    """Heading of each rotated x axis about world z [rad], in [-pi, pi], shape (..., 4) -> (...).

    Quaternions of another length than 1 count by their direction. That of a quaternion of 0, which motion
    capture gives when it loses a robot, is nan.
    """
    x, y, z, w = np.moveaxis(np.asarray(q, float), -1, 0)
    size = x * x + y * y + z * z + w * w
    size = np.where(np.abs(size - 1) < 1e-6, 1.0, np.where(size > 0, size, np.nan))
    return np.arctan2(2 * (w * z + x * y), size - 2 * (y * y + z * z))


def wxyz_from_xyzw(q: ArrayLike) -> Array:
    """Real-first order, which USD's `Gf.Quat` uses, shape (..., 4)."""
    return np.roll(np.asarray(q, float), 1, axis=-1)


def xyzw_from_wxyz(q: ArrayLike) -> Array:
    """Real-last order, magtwin's, from USD's real-first, shape (..., 4)."""
    return np.roll(np.asarray(q, float), -1, axis=-1)
