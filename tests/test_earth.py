import datetime
import sys

import numpy as np
import pytest

from magtwin.field.earth import earth_field_nt
from magtwin.names import RefusedError

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


def test_the_field_falls_with_height_as_a_dipoles_to_first_order():
    low, high = (np.linalg.norm(earth_field_nt(29.65, -82.35, h, "2026-11-21")) for h in (0, 10_000))
    assert high / low == pytest.approx(1 - 3 * 10 / 6371, abs=5e-4)


@pytest.mark.parametrize("day", ["1900-01-01", "2030-01-01"])
def test_the_models_first_and_last_days_are_within_it(day):
    assert 20_000 < np.linalg.norm(earth_field_nt(*GAINESVILLE, day)) < 70_000


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ((*GAINESVILLE, "2030-01-02"), "date 2030-01-02 lies beyond the IGRF-14.* 1900-01-01 to 2030-01-01"),
        ((*GAINESVILLE, "1899-12-31"), "date 1899-12-31 lies beyond"),
        ((*GAINESVILLE, "21.11.2026"), "date must be a day YYYY-MM-DD, got '21.11.2026'"),
        ((90.0, 0.0, 0.0, "2026-11-21"), "latitude must lie between -90 and 90"),
        ((np.nan, 0.0, 0.0, "2026-11-21"), "latitude must lie between -90 and 90"),
        ((0.0, np.inf, 0.0, "2026-11-21"), "longitude be a number"),
        ((0.0, 0.0, 5e6, "2026-11-21"), "height must lie in"),
        ((0.0, 0.0, np.nan, "2026-11-21"), "height must lie in"),
    ],
)
def test_places_and_days_off_the_model_are_refused(where, message):
    with pytest.raises(RefusedError, match=message):
        earth_field_nt(*where)


def test_the_module_itself_imports_no_model():
    import subprocess

    code = "import sys, magtwin.field.earth; sys.exit('ppigrf' in sys.modules or 'pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
