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

    Args:
        field: The map; values at masked nodes are ignored.

    Returns:
        The map with every node valid.

    Raises:
        InputError: A heading has no valid node.
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
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import spsolve

    number = np.full(hole.shape, -1)
    number[hole] = np.arange(np.count_nonzero(hole))
    rows, columns, weights = [], [], []
    total, degree = np.zeros(number.max() + 1), np.zeros(number.max() + 1)
    edge = np.zeros(hole.shape, bool)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        there = np.roll(number, -step, axis)
        near = np.roll(values, -step, axis)
        open_there = np.roll(hole, -step, axis)
        within = np.ones(hole.shape, bool)
        border = [slice(None), slice(None)]
        border[axis] = slice(-1, None) if step == 1 else slice(0, 1)
        within[tuple(border)] = False
        inner = hole & within
        degree += np.bincount(number[inner], minlength=len(degree))
        known = inner & ~open_there
        np.add.at(total, number[known], near[known])
        edge |= np.roll(known, step, axis)
        unknown = inner & open_there
        rows.append(number[unknown])
        columns.append(there[unknown])
        weights.append(np.full(np.count_nonzero(unknown), -1.0))
    diagonal = np.arange(len(degree))
    matrix = csr_array(
        (
            np.concatenate([degree, *weights]),
            (np.concatenate([diagonal, *rows]), np.concatenate([diagonal, *columns])),
        ),
        shape=(len(degree), len(degree)),
    )
    values[hole] = spsolve(matrix.tocsc(), total)
    return values[edge & ~hole]
