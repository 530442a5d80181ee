"""Belief: a map of the field as flat tables, for compiled filters."""

from typing import NamedTuple

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.trilinear import planes
from magtwin.localization.problem import Array, Extent, FieldBelief

CELL_M = 0.05
"""Distance between nodes at which a belief that is not a map is tabulated [m]."""

BETWEEN_CELLS, BETWEEN_TURNS = 2 * 6 / 30 + 4 / 36, 16 / 30
"""Means over a cell of the weights of the errors of interpolation in `trilinear.spread`."""

HEADINGS = 24
"""Headings at which it is tabulated."""


class Table(NamedTuple):
    """A map and its variance as flat arrays; `magtwin.field.maps.trilinear` has their layout and formulas."""

    field: Array
    """The field [nT]."""

    variance: Array
    """Its variance [nT^2], for `trilinear.sd_at`; of length 0 if the map has none."""


def as_map(belief: FieldBelief, extent: Extent) -> AnomalyMap:
    """A belief as a map: itself if it is one, else tabulated every 5 cm and 15 deg.

    Args:
        belief: The belief.
        extent: Least x, greatest x, least y, greatest y of the table, in world [m].

    Raises:
        InputError: The belief is not finite anywhere on the extent.
    """
    if isinstance(belief, AnomalyMap):
        return belief
    x0, x1, y0, y1 = extent
    columns, rows = (max(2, round((b - a) / CELL_M) + 1) for a, b in ((x0, x1), (y0, y1)))
    x, y = np.linspace(x0, x1, columns), np.linspace(y0, y1, rows)
    headings = np.linspace(0.0, 2 * np.pi, HEADINGS, endpoint=False)
    yaw, gy, gx = np.meshgrid(headings, y, x, indexing="ij")
    p = np.stack([gx, gy], axis=-1)
    values, variance = np.asarray(belief.mean(p, yaw), float), np.asarray(belief.variance(p, yaw), float)
    valid = np.isfinite(values) & np.isfinite(variance)
    if not valid.any():
        raise InputError("the belief of the field is finite nowhere on the floor")
    return AnomalyMap(
        values_nt=values,
        origin_m=(x0, y0),
        cell_m=((x1 - x0) / (columns - 1), (y1 - y0) / (rows - 1)),
        headings_rad=headings,
        valid=valid,
        variance_nt2=np.where(valid, variance, 0.0),
        name="belief",
    )


def table_of(belief: FieldBelief, extent: Extent) -> Table:
    """Flat tables of a belief; the arguments are those of `as_map`."""
    anomaly_map = as_map(belief, extent)
    return Table(*anomaly_map.tables())


def known_values(table: Table) -> Array:
    """Values of the valid nodes [nT], shape (K,)."""
    begin, end, _, _ = planes(table.field)
    values = table.field[begin:end]
    good = np.isfinite(values)
    if len(table.field) > end:
        good &= table.field[end:] == 0
    return values[good]


def mean_variance(table: Table) -> Array:
    """Variance at the nodes with the mean error of interpolation around them [nT^2].

    Returns:
        Laid out as the values of the table; of length 0 if the map has no variance, or 0 everywhere.
    """
    nodes, between = _variances(table)
    total = nodes + between
    return total if total.any() else total[:0]


def tempering(table: Table, white_nt: float) -> float:
    """Divisor of a log likelihood whose errors of the map depend on each other more than their model.

    Readings at a place that is passed again have the same error, which no filter over time knows. The larger
    the map's error against the noise, the more this counts, and most for errors of interpolation, which are
    far from Gaussian: small near the nodes, large in a few cells.

        kappa = max(min(4, 1 + rms / (10 white)), min(3, 1 + rms_between / (5 white))),

    with rms of the whole error and rms_between of interpolation alone. It was chosen so that the covariances
    fit the errors on maps with a random error of 150 nT over 0.3 m, and on trilinear maps of nodes 0.25 and
    0.5 m apart.

    Args:
        table: A map and its variance.
        white_nt: Standard deviation of the sensor's white noise [nT].
    """
    nodes, between = _variances(table)
    if not len(nodes):
        return 1.0
    rms, rms_between = (float(np.sqrt(v.mean())) for v in (nodes + between, between))
    return max(min(4.0, 1 + rms / (10 * white_nt)), min(3.0, 1 + rms_between / (5 * white_nt)))


def _variances(table: Table) -> tuple[Array, Array]:
    """Variance at the nodes, and that of interpolation around them, 0 where unknown [nT^2]."""
    begin, end, _, _ = planes(table.field)
    plane, spreads = end - begin, table.variance
    nodes = spreads[:plane]
    between = np.zeros_like(nodes)
    if len(spreads) > plane:
        between = BETWEEN_CELLS * spreads[plane : 2 * plane] + BETWEEN_TURNS * spreads[2 * plane : 3 * plane]
    known = np.isfinite(nodes + between)
    return np.where(known, nodes, 0.0), np.where(known, between, 0.0)
