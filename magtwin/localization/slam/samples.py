"""Samples: readings as arrays of odometry's increments and of field readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtwin.localization.problem import Reading

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Samples:
    """Readings in the order of time."""

    t: Array
    """[s], shape (N,)."""

    p_odom: Array
    """Position of base_link in odom [m], shape (N, 3)."""

    R_odom: Array
    """Rotation from base_link to odom, shape (N, 3, 3)."""

    y_nt: Array
    """Field in base_link's axes, or its magnitude less the predicted disturbance [nT], shape (N, m); nan
    where there is no reading."""

    extra_nt2: Array
    """Variance of the predicted disturbance [nT^2], shape (N,)."""

    def take(self, rows: slice) -> "Samples":
        """Some of the samples."""
        return Samples(
            self.t[rows], self.p_odom[rows], self.R_odom[rows], self.y_nt[rows], self.extra_nt2[rows]
        )


def followed_by(parts: Sequence[Samples]) -> Samples:
    """Consecutive samples as one."""
    names = Samples.__dataclass_fields__
    return Samples(*[np.concatenate([getattr(part, name) for part in parts]) for name in names])


def has_vector(reading: Reading) -> bool:
    """Whether a reading has all three axes of the field."""
    b = reading.signals.get("b_vector_measured_nt")
    return b is not None and bool(np.isfinite(b).all())


def samples_of(readings: Sequence[Reading], vector: bool) -> Samples:
    """Readings as arrays: all of odometry's pose for three axes, the planar part for the magnitude."""
    t = np.array([r.t for r in readings])
    count = len(readings)
    if vector:
        p = np.array([r.signals["odom_p"] for r in readings], float)
        R = Rotation.from_quat(np.array([r.signals["odom_q_xyzw"] for r in readings], float)).as_matrix()
        y = np.array([r.signals["b_vector_measured_nt"] for r in readings], float)
        return Samples(t, p, R, y, np.zeros(count))
    pose = np.array([r.odometry for r in readings], float)
    p = np.column_stack([pose[:, :2], np.zeros(count)])
    b = np.array([r.b_nt - r.disturbance_nt for r in readings])
    extra = np.array([r.disturbance_sd_nt for r in readings]) ** 2
    return Samples(t, p, about_z(pose[:, 2]), b[:, None], extra)


def about_z(yaw: Array) -> Array:
    """Rotation matrices about z, shape (N, 3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.zeros((*np.shape(yaw), 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = c
    R[..., 1, 0], R[..., 0, 1], R[..., 2, 2] = s, -s, 1.0
    return R
