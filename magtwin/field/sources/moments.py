"""Moments: volume, centroid and spread of a closed mesh."""

import numpy as np
from numpy.typing import NDArray


def mesh_moments(
    vertices: NDArray[np.float64], faces: NDArray[np.integer]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Volume [m3], centroid [m] (3,) and second moments about it per volume [m2] (3, 3) of a closed mesh.

    Sums over the tetrahedra between a centre and each triangle (Tonon 2004, for the covariance).
    """
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    corner = (vertices - middle)[faces]
    volume = np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    total = volume.sum()
    if not abs(total) > 0:
        return 0.0, middle, np.zeros((3, 3))
    whole = corner.sum(axis=1)
    centroid = volume @ whole / 4 / total
    second = np.einsum("f,fi,fj->ij", volume, whole, whole) + np.einsum(
        "f,fki,fkj->ij", volume, corner, corner
    )
    return float(total), middle + centroid, second / 20 / total - np.outer(centroid, centroid)
