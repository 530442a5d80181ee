import datetime
import math

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
