"""Holes: fill the masked nodes of a map from the nodes around them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap


def filled(field: AnomalyMap) -> AnomalyMap:
    """Fill the masked nodes of a map.

    A filled value is the mean of its four neighbours (the discrete Laplace equation), so it lies between the
    least and the greatest value on the hole's edge. Its standard deviation is the spread of the values on the
    edges of all holes of its heading.
    """
    holes = ~field.valid
    if not holes.any():
        return field
    values = np.array(field.values_nt, float)
    variance = None if field.variance_nt2 is None else np.array(field.variance_nt2, float)
    for h in range(len(values)):
        if holes[h].all():
            raise InputError(f"map {field.name!r}: no node of heading {h} could be measured")
        if holes[h].any():
            edge = _fill(values[h], holes[h])
            if variance is not None:
                variance[h][holes[h]] = np.var(edge) if len(edge) > 1 else 0.0
    return replace(field, values_nt=values, variance_nt2=variance, valid=np.ones(holes.shape, bool))


def _fill(values: NDArray[np.float64], hole: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fill a layer (Y, X) in place; returns the values on the edges of its holes."""
    from scipy.sparse import lil_array
    from scipy.sparse.linalg import spsolve

    number = np.full(hole.shape, -1)
    number[hole] = np.arange(np.count_nonzero(hole))
    at = np.argwhere(hole)
    total, degree, matrix = np.zeros(len(at)), np.zeros(len(at)), lil_array((len(at), len(at)))
    edge = np.zeros(hole.shape, bool)
    for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        near = at + step
        row = np.flatnonzero(np.all((near >= 0) & (near < hole.shape), axis=1))
        j, i = near[row].T
        degree[row] += 1
        known = ~hole[j, i]
        total[row[known]] += values[j, i][known]
        edge[j[known], i[known]] = True
        matrix[row[~known], number[j, i][~known]] = -1
    matrix.setdiag(degree)
    values[hole] = spsolve(matrix.tocsc(), total)
    return values[edge]
