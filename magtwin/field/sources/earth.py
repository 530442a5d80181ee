"""The Earth's main field at a place and a day, from the IGRF."""

import datetime

import numpy as np

from magtwin.errors import InputError
from magtwin.field.days import parse_day
from magtwin.frames import quat_from_yaw, rotate
from magtwin.spec.magnetics import MODEL, SPAN


def earth_field_nt(
    latitude_deg: float,
    longitude_deg: float,
    height_m: float,
    date: str | datetime.date,
    *,
    north_deg: float = 0.0,
) -> tuple[float, float, float]:
    """The field of the IGRF-14 (Alken et al. 2021 and its 2024 revision), to degree 13, by ppigrf.

    The latitude is geodetic, the longitude positive east of Greenwich, the height above the WGS 84 ellipsoid.
    The day's field is that of 00:00 UTC, as in tables of the IGRF; within a day it changes by some tenths of
    a nT. `north_deg` is the angle from world +y to true north about world +z, counter-clockwise seen from
    above. The result is in world axes [nT]: east, north and up if true north is along +y.
    """
    import ppigrf  # its pandas takes 0.3 s

    day = parse_day(date)
    first, last = SPAN
    if not first <= day <= last:
        raise InputError(f"date {day} lies beyond {MODEL}, which holds from {first} to {last}")
    if not (abs(latitude_deg) < 90 and np.isfinite(longitude_deg)):
        text = "latitude must lie between -90 and 90 deg, both left out, and longitude be a number"
        raise InputError(f"{text}, got {latitude_deg!r}, {longitude_deg!r}")
    if not np.isfinite(north_deg):
        raise InputError(f"north_deg must be a number, got {north_deg!r}")
    if not -10e3 <= height_m <= 1000e3:
        raise InputError(f"height must lie in -10,000..1,000,000 m above the ellipsoid, got {height_m!r}")
    midnight = datetime.datetime.combine(day, datetime.time())
    east, north, up = ppigrf.igrf(longitude_deg, latitude_deg, height_m / 1000, midnight)
    x, y, z = rotate(quat_from_yaw(np.radians(north_deg)), [float(east[0]), float(north[0]), float(up[0])])
    return float(x), float(y), float(z)
