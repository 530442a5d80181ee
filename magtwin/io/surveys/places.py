"""Places: latitudes and longitudes as positions on a plane, and values between the times that have them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AXIS_M, FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84 (NIMA TR8350.2, table 3.1)


def on_tangent_plane(lat_deg: Array, lon_deg: Array) -> tuple[Array, str]:
    """Positions east and north of their middle on the plane that touches WGS 84 there, and that in words.

    Geodetic latitudes and longitudes [deg], shape (N,), nan where unknown, become [m], shape (N, 2). The
    plane shortens a distance d from the middle by about d^3 / (6 R^2): 6 cm in 25 km.
    """
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    turn = np.exp(1j * np.radians(lon_deg[known])).mean() if known.any() else 1.0
    lat0 = round(float(np.mean(lat_deg[known])), 5) if known.any() else 0.0
    lon0 = round(float(np.degrees(np.angle(turn))), 5)
    away = _geocentric(lat_deg, lon_deg - lon0) - _geocentric(np.array([lat0]), np.zeros(1))
    slope = np.radians(lat0)
    north = -np.sin(slope) * away[:, 0] + np.cos(slope) * away[:, 2]
    return np.column_stack([away[:, 1], north]), f"tangent plane of WGS 84 at {lat0:g}, {lon0:g} deg"


def between(t: Array, at: Array, values: Array, period: float | None = None) -> Array:
    """Values at times t (N,), linear between those at times `at` (K,), in any order; nan outside of them.

    `period` is that of angles, such as 360.
    """
    known = np.isfinite(at) & np.isfinite(values)
    order = np.flatnonzero(known)[np.argsort(at[known], kind="stable")]
    if not len(order):
        return np.full(len(t), np.nan)
    along = values[order] if period is None else np.unwrap(values[order], period=period)
    return np.interp(t, at[order], along, np.nan, np.nan)


def _geocentric(lat_deg: Array, lon_deg: Array) -> Array:
    """Points of the ellipsoid in axes through its centre [m], shape (N, 3)."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    squared = FLATTENING * (2 - FLATTENING)
    radius = AXIS_M / np.sqrt(1 - squared * np.sin(lat) ** 2)
    level = radius * np.cos(lat)
    return np.column_stack([level * np.cos(lon), level * np.sin(lon), radius * (1 - squared) * np.sin(lat)])
