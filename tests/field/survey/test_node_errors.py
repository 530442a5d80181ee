"""What a gridded survey tells of its own errors: places, headings and noise."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.field.grid import Grid
from magtwin.field.survey.node_errors import node_errors
from magtwin.field.survey.readings import Readings

FOUR = (0.0, 90.0, 180.0, 270.0)
TWO, THREE, FIVE = (0.0, 180.0), (0.0, 120.0, 240.0), tuple(72.0 * k for k in range(5))
EIGHT = tuple(45.0 * k for k in range(8))


def field(p, yaw):
    """A lab's field [nT]: hills of 1,500 nT, and a platform whose share differs from place to place."""
    x, y = p[..., 0], p[..., 1]
    hills = 1500 * np.sin(2.6 * x + 0.4) * np.cos(2.2 * y)
    iron = (400 + 60 * np.sin(x)) * np.cos(yaw - 0.6) + 60 * np.cos(0.7 * y) * np.cos(2 * yaw)
    return 41_000 + hills + iron


def surveyed(headings=FOUR, *, place_m=0.0, noise_nt=0.0, turned_deg=0.0, off_deg=0.0, seed=0):
    """Readings of a robot that stands off its nodes, looks off its headings, and of a noisy sensor."""
    rng = np.random.default_rng(seed)
    grid = Grid(
        origin_m=(-3, -1.75),
        cell_m=(0.25, 0.25),
        headings_rad=tuple(np.radians(headings)),
        rows=15,
        columns=25,
    )
    p, nominal = grid.poses()
    yaw = nominal + np.radians(off_deg + turned_deg * rng.standard_normal(nominal.shape))
    b = field(p + place_m * rng.standard_normal(p.shape), yaw) + noise_nt * rng.standard_normal(yaw.shape)
    readings = Readings(
        p_xy=p.reshape(-1, 2),
        yaw=yaw.ravel(),
        b_nt=b.ravel(),
        grid=grid,
        node=np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3),
    )
    return readings, b, b - field(p, nominal)


def told(readings, values):
    return node_errors(readings, readings.grid, values, np.isfinite(values))


@pytest.mark.parametrize("headings", [TWO, THREE, FOUR, FIVE, EIGHT], ids=lambda h: str(len(h)))
@pytest.mark.parametrize("place_m", [0.005, 0.01, 0.02])
def test_the_survey_tells_how_far_its_robot_stood_off_its_nodes(headings, place_m):
    readings, values, off = surveyed(headings, place_m=place_m)
    found = told(readings, values)
    assert found.estimated
    assert found.place_m == pytest.approx(place_m, rel=0.12)
    assert found.mean_nt2 == pytest.approx(np.mean(off**2), rel=0.15)
    z = off / np.sqrt(found.variance_nt2)
    assert 0.87 <= np.mean(np.abs(z) < 1.645) <= 0.94


@pytest.mark.parametrize(("turned_deg", "off_deg"), [(4.0, 0.0), (1.0, 8.0)])
def test_recorded_headings_tell_what_turning_off_the_nominal_ones_does(turned_deg, off_deg):
    readings, values, off = surveyed(turned_deg=turned_deg, off_deg=off_deg)
    found = told(readings, values)
    assert np.sqrt(np.mean(off**2)) > 15
    assert found.mean_nt2 == pytest.approx(np.mean(off**2), rel=0.25)


def test_gross_errors_of_a_few_readings_are_not_taken_for_noise_of_all():
    readings, values, _ = surveyed(place_m=0.01)
    fine = told(readings, values)
    values = values.copy()
    values[1, 5, 5] += 8000
    values[3, 9, 17] -= 8000
    assert told(readings, values).mean_nt2 < 2 * fine.mean_nt2  # unguarded, 60 times


def test_nodes_without_a_reading_have_the_mean_and_spoil_no_other():
    readings, values, _ = surveyed(place_m=0.01)
    whole = told(readings, values)
    values = values.copy()
    values[:, 3:6, 7:9] = np.nan
    found = told(readings, values)
    assert_allclose(found.variance_nt2[:, 3:6, 7:9], found.mean_nt2)
    assert found.mean_nt2 == pytest.approx(whole.mean_nt2, rel=0.1)
    assert np.isfinite(found.variance_nt2).all()


def test_the_real_survey_stood_within_a_centimetre(real_data):
    from magtwin.field.survey.folder import read_grid
    from magtwin.field.survey.nodes import node_map
    from magtwin.field.survey.stuck import mask_stuck

    readings, _ = mask_stuck(read_grid(real_data / "aprilab" / "maps"))
    field_map = node_map(readings)
    found = told(readings, np.where(field_map.valid, field_map.values_nt, np.nan))
    assert 0.003 < found.place_m < 0.01
    # beside what headings do, the residual of permanent, induced and lever-arm fields is 79 nT a node
    assert np.hypot(found.noise_nt, found.place_m * 8_000) < 79
