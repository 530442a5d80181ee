"""Polygon: polygons, strips and fans cut into triangles."""

import numpy as np
from numpy.typing import NDArray


def cut_polygons(points: NDArray, corners: NDArray, counts: NDArray) -> NDArray[np.int64]:
    """Triangles of polygons with the same winding: fans, or ears where a fan would fold over.

    A fan from the first corner is correct if all its triangles turn the same way as the polygon, whose normal
    is Newell's, the sum of p_i x p_i+1 over its edges. This holds for all convex polygons.

    Args:
        points: Vertices, shape (V, 3).
        corners: Vertex at each corner of all polygons in sequence, shape (C,).
        counts: Number of corners of each polygon, 3 or more, shape (P,).

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
    a, b, c = (points[corners[triangles[:, i]]] for i in range(3))
    areas = np.cross(b - a, c - a)
    polygon = np.repeat(np.arange(len(counts)), cuts)
    whole = np.column_stack([np.bincount(polygon, areas[:, axis], len(counts)) for axis in range(3)])
    folded = np.bincount(polygon, np.sum(areas * whole[polygon], axis=1) < 0, len(counts)) > 0
    for index in np.flatnonzero(folded):
        own = slice(start[index], start[index] + counts[index])
        triangles[polygon == index] = start[index] + _ears(points[corners[own]], whole[index])
    return triangles


def strips(counts: NDArray, *, fans: bool = False) -> NDArray[np.int64]:
    """Triangles of strips or fans with so many corners each, as indices of corners, shape (F, 3)."""
    made, start = [np.empty((0, 3), np.int64)], 0
    for count in counts:
        i = np.arange(max(count - 2, 0))
        rows = (np.zeros_like(i), i + 1, i + 2) if fans else (i, i + 1 + i % 2, i + 2 - i % 2)
        made.append(start + np.column_stack(rows))
        start += count
    return np.concatenate(made)


def _ears(points: NDArray, normal: NDArray) -> NDArray[np.int64]:
    """Triangles of one polygon with N corners by ear clipping (Meisters 1975), shape (N - 2, 3)."""
    drop = int(np.argmax(np.abs(normal)))  # project along the axis nearest to the normal
    flat = np.delete(points, drop, axis=1) * ((1, 1) if (normal[drop] > 0) == (drop != 1) else (-1, 1))
    left, triangles = list(range(len(points))), []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(flat, left, i)), 0)
        triangles.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.array([*triangles, left])


def _is_ear(flat: NDArray, left: list[int], i: int) -> bool:
    """Whether a corner is convex and no other lies in its triangle; counter-clockwise, shape (N, 2)."""
    a, b, c = (flat[left[(i + k) % len(left)]] for k in (-1, 0, 1))
    if _turn(a, b, c) <= 0:
        return False
    others = flat[[k for k in left if k not in (left[i - 1], left[i], left[(i + 1) % len(left)])]]
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    return not inside.any()


def _turn(a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    """Twice the area of triangles a, b, c in the plane, positive counter-clockwise; c of shape (..., 2)."""
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])
