"""Layers of the equivalent dipoles of a harmonic fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.bins import means, spacing_m
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]

# Depths of the layers below the sensor, in that of the first; each represents sources twice as large. The
# second set has a layer above the sensor, for iron beside it. The set with the greater evidence is used.
LADDERS = ((1.0, 2.0, 4.0), (1.0, 2.0, 4.0, -2.0))
# Depth of the first layer in spacings of the survey: a layer nearer than about one represents waves that the
# readings do not resolve (Dampney 1969)
DEPTH_SPACINGS = 1.8
DRIVE_SPACINGS = 0.9  # The same for a drive, whose readings are dense along it
LEAST_DEPTH_M = 0.3  # Least depth of the first layer below the sensor [m]
# Distance between the dipoles of a layer, in its depth: the ripple is e^(-2 pi / 0.6) = 3e-5 of their field
SHEET = 0.6
MARGIN = 1.2  # Width by which a layer extends beyond the readings, in its depth
REACH = 0.6  # Distance over which dipoles share one strength, in their layer's depth
MOST_DIPOLES = 1500  # Most dipoles; larger layers are thinned
FEW_ROWS = 2700  # Most reading components whose matrix is factored; beyond, that of the unknowns is
DIPOLES_OF_MANY = 800  # Most dipoles if there are more rows than `FEW_ROWS`
# Most dipoles for the magnitudes of a drive: more took 15 times as long and predicted no better
DIPOLES_OF_DRIVE = 500


@dataclass(frozen=True, eq=False)
class Layers:
    """Positions of the dipoles."""

    p_world_dipole: Array  # Positions [m], shape (D, 3)
    area_m2: Array  # Area per dipole [m^2], shape (D,)
    layer: NDArray[np.intp]  # Layer of each dipole, shape (D,)
    depths: tuple[float, ...]  # Depth of each layer below the sensor, negative above it [m]

    def shares(self) -> list[Array]:
        """Weights with which dipoles of a layer share their strengths, one matrix per layer."""
        shares = []
        for k, depth in enumerate(self.depths):
            p = self.p_world_dipole[self.layer == k, :2]
            apart = np.sum((p[:, None] - p[None]) ** 2, axis=-1)
            shares.append(np.exp(-apart / (2 * (REACH * depth) ** 2)))
        return shares


def ladders(good: Readings, height_m: float) -> list[tuple[float, ...]]:
    """Sets of depths to try [m]: `LADDERS` for the survey's spacing."""
    spacings = DRIVE_SPACINGS if good.grid is None else DEPTH_SPACINGS
    first = max(spacings * spacing_m(good), LEAST_DEPTH_M, height_m)
    return [tuple(first * step for step in ladder) for ladder in LADDERS]


def layers_below(
    good: Readings, depths: tuple[float, ...], height_m: float, most: int | None = None
) -> Layers:
    """Layers below (and above) the bounding box of the readings, thinned to at most `most` dipoles."""
    low, high = good.p_xy.min(axis=0), good.p_xy.max(axis=0)
    part = SHEET
    if most is None and good.node is None and good.b_body_nt is None:
        most = DIPOLES_OF_DRIVE
    elif most is None:
        rows = 1 + int(means(good, min(map(abs, depths)))[0].max())
        rows *= 1 if good.b_body_nt is None else 3
        most = MOST_DIPOLES if rows <= FEW_ROWS else DIPOLES_OF_MANY
    while True:
        places, areas, layer = [], [], []
        for k, depth in enumerate(depths):
            margin, step = MARGIN * abs(depth), part * abs(depth)
            counts = np.ceil((high - low + 2 * margin) / step).astype(int) + 1
            x, y = (np.linspace(a - margin, b + margin, n) for a, b, n in zip(low, high, counts, strict=True))
            grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            places.append(np.column_stack([grid, np.full(len(grid), height_m - depth)]))
            areas.append(np.full(len(grid), (x[1] - x[0]) * (y[1] - y[0])))
            layer.append(np.full(len(grid), k))
        count = sum(map(len, places))
        if count <= most:
            return Layers(np.concatenate(places), np.concatenate(areas), np.concatenate(layer), depths)
        part *= max(np.sqrt(count / most), 1.02)
