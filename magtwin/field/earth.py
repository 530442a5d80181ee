"""The Earth's main field at a place and a day, by the IGRF."""

import datetime
from functools import cache

import numpy as np

from magtwin.names import RefusedError


def earth_field_nt(
    latitude_deg: float, longitude_deg: float, height_m: float, date: str | datetime.date
) -> tuple[float, float, float]:
    """The field of the IGRF-14 (Alken et al. 2021 and its 2024 revision), to degree 13, by ppigrf.

    Args:
        latitude_deg: Geodetic latitude [deg], -90 to 90, the poles themselves left out.
        longitude_deg: Longitude [deg], east of Greenwich.
        height_m: Height above the WGS 84 ellipsoid [m].
        date: The day, or its name YYYY-MM-DD.

    Returns:
        East, north and up parts [nT]: world axes of a lab whose x points east.

    Raises:
        RefusedError: The day is none, or the model does not reach it; the place is none on Earth.
    """
    import ppigrf  # its pandas takes 0.3 s

    try:
        day = datetime.date.fromisoformat(date) if isinstance(date, str) else date
    except ValueError as error:
        raise RefusedError(f"date must be a day YYYY-MM-DD, got {date!r}") from error
    first, last = _span()
    if not first <= day <= last:
        raise RefusedError(f"date {day} lies beyond the IGRF-14, which holds from {first} to {last}")
    if not (abs(latitude_deg) < 90 and np.isfinite(longitude_deg)):
        raise RefusedError(
            f"latitude must lie between -90 and 90 deg, both left out, and longitude be a number, "
            f"got {latitude_deg!r}, {longitude_deg!r}"
        )
    if not -10e3 <= height_m <= 1000e3:
        raise RefusedError(f"height must lie in -10,000..1,000,000 m above the ellipsoid, got {height_m!r}")
    noon = datetime.datetime.combine(day, datetime.time())
    east, north, up = ppigrf.igrf(longitude_deg, latitude_deg, height_m / 1000, noon)
    return float(east[0]), float(north[0]), float(up[0])


@cache
def _span() -> tuple[datetime.date, datetime.date]:
    """First and last day of the model's coefficients."""
    from ppigrf.ppigrf import read_shc

    days = read_shc()[0].index
    return days[0].date(), days[-1].date()
