"""A closed triangle mesh, as a magnetised body must be."""

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError


def check_mesh(vertices: NDArray[np.float64], faces: NDArray[np.intp], what: str) -> None:
    """Refuse a mesh that encloses no volume: open, inconsistently wound, inside out or flat.

    Args:
        vertices: Vertices [m], shape (V, 3).
        faces: Corners of the triangles, counter-clockwise from outside, shape (F, 3).
        what: How the text of a refusal begins: "source 'desk'".
    """
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
        shapes = f"{vertices.shape} and {faces.shape}"
        raise InputError(f"{what} needs vertices (V, 3) and triangles (F, 3), got {shapes}")
    if len(wrong := vertices[~np.isfinite(vertices).all(axis=1)]):
        raise InputError(f"{what} must have finite vertices, got {wrong[0]}")
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        beyond = f"beyond its {len(vertices)} vertices"
        raise InputError(f"{what} has {len(faces)} triangles that name corners {beyond}")
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, seen = np.unique(edges @ [len(vertices), 1], return_counts=True)
    back = np.unique(edges[:, ::-1] @ [len(vertices), 1])
    lone = np.setxor1d(there, back)
    if len(lone) or seen.max() > 1:
        edge = int(lone[0]) if len(lone) else int(there[seen.argmax()])
        a, b = (np.round(vertices[k], 6).tolist() for k in divmod(edge, len(vertices)))
        raise InputError(
            f"{what} is not a closed mesh: the edge from {a} to {b} has not one triangle on either side; "
            "close its holes, merge its doubled vertices and make its faces look outwards"
        )
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    a, b, c = np.moveaxis((vertices - (low + high) / 2)[faces], 1, 0)
    volume, side = float(np.sum(a * np.cross(b, c)) / 6), float((high - low).max())
    if not volume > 1e-9 * max(side**3, np.finfo(float).tiny):
        raise InputError(f"{what} encloses no volume: {volume:g} m3; its faces must look outwards")
