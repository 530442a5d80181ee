"""Belief: a map of the field as flat tables, for compiled filters."""

from typing import NamedTuple

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.localize.problem import Array, Extent, FieldBelief

CELL_M = 0.05
"""Distance between nodes at which a belief that is not a map is tabulated [m]."""

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
