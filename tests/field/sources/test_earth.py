import datetime
import math
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.field.sources.earth import earth_field_nt

GAINESVILLE = (29.65, -82.35, 50.0)


def test_gainesville_in_november_2026_reads_45418_nt():
    field = earth_field_nt(*GAINESVILLE, "2026-11-21")
    assert np.linalg.norm(field) == pytest.approx(45_418, abs=1)  # WMM2025, another model, says 45,424
    assert field[1] > 0 > field[2]  # northward, and down into the ground
    assert earth_field_nt(*GAINESVILLE, datetime.date(2026, 11, 21)) == field


def test_the_field_at_the_time_of_the_survey_has_the_published_angles():
    # 45,682 nT, inclination 57.95 deg, declination -6.37 deg; the day is known to some months only
    east, north, up = earth_field_nt(*GAINESVILLE, "2024-10-01")
    assert np.linalg.norm((east, north, up)) == pytest.approx(45_682, abs=30)
    assert np.degrees(np.arctan2(-up, np.hypot(east, north))) == pytest.approx(57.95, abs=0.05)
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(-6.37, abs=0.05)


def coefficients(day):
    """Gauss coefficients of the IGRF-14 on a day [nT], linear between its five-yearly tables."""
    from ppigrf.ppigrf import read_shc

    tables = read_shc()
    when = np.datetime64(day)
    days = tables[0].index.to_numpy()
    k = min(int(np.searchsorted(days, when, side="right")) - 1, len(days) - 2)
    part = (when - days[k]) / (days[k + 1] - days[k])
    return [t.iloc[k] + part * (t.iloc[k + 1] - t.iloc[k]) for t in tables]


def synthesis(latitude_deg, longitude_deg, height_m, day):
    """East, north, up by another way: differences of the potential over 200 m."""
    g, h = coefficients(day)

    def potential(p):
        """V / a [nT] at geocentric places p [m], by the recursion of Schmidt's functions."""
        r = np.linalg.norm(p, axis=-1)
        cos, sin = p[..., 2] / r, np.hypot(p[..., 0], p[..., 1]) / r
        lon = np.arctan2(p[..., 1], p[..., 0])
        legendre = {(0, 0): np.ones_like(r)}
        total = np.zeros_like(r)
        for n in range(1, 14):
            for m in range(n + 1):
                if n == m:
                    grow = 1.0 if n == 1 else math.sqrt((2 * n - 1) / (2 * n))
                    legendre[n, n] = grow * sin * legendre[n - 1, n - 1]
                else:
                    before = legendre.get((n - 2, m), 0.0) * math.sqrt((n - 1) ** 2 - m * m)
                    legendre[n, m] = ((2 * n - 1) * cos * legendre[n - 1, m] - before) / math.sqrt(
                        n * n - m * m
                    )
                wave = g[n, m] * np.cos(m * lon) + h[n, m] * np.sin(m * lon)
                total += (6371.2e3 / r) ** (n + 1) * wave * legendre[n, m]
        return total * 6371.2e3

    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    a, squared = 6378137.0, 6.69437999014e-3
    normal = a / math.sqrt(1 - squared * math.sin(lat) ** 2)
    place = np.array(
        [
            (normal + height_m) * math.cos(lat) * math.cos(lon),
            (normal + height_m) * math.cos(lat) * math.sin(lon),
            (normal * (1 - squared) + height_m) * math.sin(lat),
        ]
    )
    east = np.array([-math.sin(lon), math.cos(lon), 0])
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    axes = np.array([east, north, np.cross(east, north)])
    step = 100.0
    return -(potential(place + step * axes) - potential(place - step * axes)) / (2 * step)


@pytest.mark.parametrize(
    ("where", "day"),
    [
        (GAINESVILLE, "2026-11-21"),
        ((60.39, 5.32, 0.0), "2021-03-28"),
        ((-33.9, 151.2, 1_000.0), "1985-07-02"),
        ((0.0, 180.0, 400e3), "2029-12-31"),
    ],
)
def test_the_field_is_that_of_the_coefficients_summed_another_way(where, day):
    # differences over 200 m err by (100 / 6.4e6 * 13)^2 / 6 of the field, 3e-4 nT; days are whole
    assert_allclose(earth_field_nt(*where, day), synthesis(*where, day), rtol=0, atol=0.05)


def test_a_day_is_its_first_moment_utc():
    import ppigrf

    latitude, longitude, height = GAINESVILLE
    first, noon = (
        [float(v.item()) for v in ppigrf.igrf(longitude, latitude, height / 1000, datetime.datetime(*when))]
        for when in ((2026, 11, 21), (2026, 11, 21, 12))
    )
    assert_allclose(earth_field_nt(*GAINESVILLE, "2026-11-21"), first, rtol=0, atol=1e-9)
    assert abs(first[2] - noon[2]) > 0.1  # so that one can tell
    assert earth_field_nt(*GAINESVILLE, datetime.datetime(2026, 11, 21, 12)) == tuple(first)


def test_the_field_turns_with_the_worlds_north():
    east, north, up = earth_field_nt(*GAINESVILLE, "2026-11-21")
    assert_allclose(earth_field_nt(*GAINESVILLE, "2026-11-21", north_deg=90), (-north, east, up), atol=1e-9)
    turned = earth_field_nt(*GAINESVILLE, "2026-11-21", north_deg=30)
    # true north, at 30 deg from +y towards -x, sees the same northward part
    assert turned[0] * -math.sin(math.radians(30)) + turned[1] * math.cos(math.radians(30)) == pytest.approx(
        north
    )
    with pytest.raises(InputError, match="north_deg must be a number, got nan"):
        earth_field_nt(*GAINESVILLE, "2026-11-21", north_deg=math.nan)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ((*GAINESVILLE, "2030-01-02"), "date 2030-01-02 lies beyond the IGRF-14.* 1900-01-01 to 2030-01-01"),
        ((*GAINESVILLE, "1899-12-31"), "date 1899-12-31 lies beyond"),
        ((*GAINESVILLE, "21.11.2026"), "date must be a day YYYY-MM-DD, got '21.11.2026'"),
        ((*GAINESVILLE, "20261121"), "date must be a day YYYY-MM-DD, got '20261121'"),
        ((90.0, 0.0, 0.0, "2026-11-21"), "latitude must lie between -90 and 90"),
        ((np.nan, 0.0, 0.0, "2026-11-21"), "latitude must lie between -90 and 90"),
        ((0.0, np.inf, 0.0, "2026-11-21"), "longitude be a number"),
        ((0.0, 0.0, 5e6, "2026-11-21"), "height must lie in"),
        ((0.0, 0.0, np.nan, "2026-11-21"), "height must lie in"),
    ],
)
def test_places_and_days_off_the_model_are_refused(where, message):
    with pytest.raises(InputError, match=message):
        earth_field_nt(*where)


def test_the_module_itself_imports_no_model():
    import subprocess

    code = (
        "import sys, magtwin.field.sources.earth; "
        "sys.exit('ppigrf' in sys.modules or 'pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
