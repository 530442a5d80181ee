"""Polygon: polygons, strips and fans cut into triangles."""

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.meshes.reading import Reading

AXES = np.array([[[1, 2], [2, 0], [0, 1]], [[2, 1], [0, 2], [1, 0]]])
"""Axes of the plane across each axis, as seen from its positive and from its negative side."""

MOST_CORNERS = 5_000
"""Most corners of a concave polygon, whose triangulation may take time by their square."""


def cut_polygons(
    points: NDArray, corners: NDArray, counts: NDArray, reading: Reading | None = None
) -> NDArray[np.int64]:
    """Triangles of polygons with the same winding: fans, or ears where a fan would fold over.

    A fan from the first corner is correct if all its triangles turn the same way as the polygon, whose normal
    is Newell's, the sum of p_i x p_i+1 over its edges. This holds for all convex polygons.

    Args:
        points: Vertices, shape (V, 3).
        corners: Vertex at each corner of all polygons in sequence, shape (C,).
        counts: Number of corners of each polygon, 3 or more, shape (P,).
        reading: Takes a note on concave polygons of over `MOST_CORNERS`, which stay fans. Default: no note.

    Returns:
        Indices into `corners` of the triangles' corners, shape (C - 2 P, 3).
    """
    cuts = counts - 2
    start = np.cumsum(counts) - counts
    first = np.repeat(start, cuts)
    step = np.arange(cuts.sum()) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    triangles = np.column_stack([first, first + step + 1, first + step + 2])
    if (counts == 3).all():
        return triangles
    from manifold3d import triangulate  # by ears, in C++

    a, b, c = (points[corners[triangles[:, i]]] for i in range(3))
    areas = np.cross(b - a, c - a)
    polygon = np.repeat(np.arange(len(counts)), cuts)
    whole = np.column_stack([np.bincount(polygon, areas[:, axis], len(counts)) for axis in range(3)])
    folded = np.bincount(polygon, np.sum(areas * whole[polygon], axis=1) < 0, len(counts)) > 0
    drop = np.abs(whole).argmax(axis=1)  # project along the axis nearest to the normal
    back = np.take_along_axis(whole, drop[:, None], axis=1)[:, 0] < 0
    axes = np.repeat(AXES[back.astype(int), drop], counts, axis=0)
    flat = np.take_along_axis(points[corners].astype(float), axes, axis=1)
    for index in np.flatnonzero(folded):
        first, count = start[index], counts[index]
        if count > MOST_CORNERS:
            if reading is not None:
                reading.note(f"a concave face of {count} corners is too large to cut: shown as a fan")
            continue
        own = first - 2 * index  # of its triangles
        triangles[own : own + count - 2] = first + triangulate([flat[first : first + count]])
    return triangles


def strip(count: int, *, fan: bool = False) -> NDArray[np.int64]:
    """Triangles of a strip or fan with so many corners, as indices of corners, shape (F, 3)."""
    i = np.arange(max(count - 2, 0))
    return np.column_stack((np.zeros_like(i), i + 1, i + 2) if fan else (i, i + 1 + i % 2, i + 2 - i % 2))
