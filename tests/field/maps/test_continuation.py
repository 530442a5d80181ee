"""Maps of other heights, against the closed form of the dipoles below them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.continuation import at_height
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField

EARTH_NT = (-2_700.0, 24_000.0, -38_000.0)
HEIGHT_M = 0.35


def a_sheet(moment: float) -> HarmonicField:
    """Dipoles 0.6 m below a floor of 8 x 8 m, their moments drawn with this standard deviation [A m2]."""
    rng = np.random.default_rng(0)
    return HarmonicField(
        p_world_dipole=np.column_stack([rng.uniform(-4, 4, (300, 2)), np.full(300, -0.6)]),
        m_world=rng.normal(0, moment, (300, 3)),
        b_uniform_nt=EARTH_NT,
        hard_iron_nt=(300.0, -200.0, 100.0),
        soft_iron=np.full((3, 3), 0.003),
        p_base_sensor=(0.02, -0.01, HEIGHT_M),
    )


def a_map(sheet: HarmonicField, spacing=0.25, headings=(0.0, np.pi / 2), **more) -> AnomalyMap:
    """The sheet's field on a grid of 6 x 6 m, the map without its harmonic field."""
    grid = Grid.over((-3, 3, -3, 3), spacing, headings)
    given = {
        "values_nt": sheet.magnitude_nt(*grid.poses()),
        "origin_m": grid.origin_m,
        "cell_m": grid.cell_m,
        "headings_rad": grid.headings_rad,
        "height_m": HEIGHT_M,
        "name": "sheet",
        "method": "drawn",
    }
    return AnomalyMap(**{**given, **more})


def inside(values, field, margin_m=1.0):
    """Values at nodes a margin away from the border."""
    n = round(margin_m / field.cell_m[0])
    return values[:, n:-n, n:-n]


@pytest.mark.parametrize("moment", [0.3, 3.0], ids=["anomaly 1 % of the field", "anomaly 10 % of the field"])
@pytest.mark.parametrize("height", [0.45, 0.6, 1.0])
def test_a_dipole_sheet_goes_up_as_its_closed_form_does(moment, height):
    """A metre from the border: to 3 % of what the step changes, and to 10 % with the offset of the whole."""
    sheet = a_sheet(moment)
    field = a_map(sheet)
    exact = sheet.magnitude_nt(*field.grid.poses(), height_m=height)
    error = inside(at_height(field, height).values_nt - exact, field)
    moved = np.sqrt(np.mean(inside(field.values_nt - exact, field) ** 2))
    assert error.std() < 0.03 * moved
    assert np.sqrt(np.mean(error**2)) < 0.10 * moved


def test_a_wave_shrinks_by_exp_of_its_wavenumber_times_the_step():
    grid = Grid.over((-3, 3, -3, 3), 0.1, [0.0])
    x = grid.poses()[0][..., 0]
    k = 2 * np.pi / 1.2  # its crests lie on the border, where mirroring goes on with it
    wave = 100 * np.cos(k * x)
    field = AnomalyMap(
        values_nt=41_000 + wave, origin_m=grid.origin_m, cell_m=(0.1, 0.1), headings_rad=[0.0], height_m=0.0
    )
    up = at_height(field, 0.2).values_nt - 41_000
    assert_allclose(inside(up, field, 1.5), inside(wave * np.exp(-0.2 * k), field, 1.5), atol=0.5)


def test_a_harmonic_field_gives_every_height_exactly_and_leads_back():
    sheet = a_sheet(3.0)
    field = a_map(sheet, harmonic=sheet)
    for height in (0.0, 0.1, 2.0):  # the dipoles lie 0.6 m below the floor
        there = at_height(field, height)
        assert_array_equal(there.values_nt, sheet.magnitude_nt(*field.grid.poses(), height_m=height))
        assert there.height_m == there.harmonic.height_m == height
        assert_array_equal(at_height(there, HEIGHT_M).values_nt, field.values_nt)


def test_the_error_left_at_the_border_and_beside_masked_nodes_is_within_three_deviations():
    sheet = a_sheet(3.0)
    plain = a_map(sheet)
    valid = np.ones(plain.values_nt.shape, bool)
    valid[:, 8:13, 4:9] = False
    values = np.where(valid, plain.values_nt, np.nan)
    field = replace(plain, values_nt=values, valid=valid, variance_nt2=np.ones_like(values))
    up = at_height(field, 0.6)
    assert_array_equal(up.valid, valid)
    assert np.isfinite(up.values_nt).all()
    error = up.values_nt - sheet.magnitude_nt(*field.grid.poses(), height_m=0.6)
    assert np.all(np.abs(error[valid]) < 3 * np.sqrt(up.variance_nt2[valid]))
    beside, amid = np.sqrt(up.variance_nt2[0, 10, 10]), np.sqrt(up.variance_nt2[0, 10, 18])
    assert beside > 1.5 * amid


@pytest.mark.parametrize("step", [0.2, -0.06])
def test_errors_of_the_readings_stay_within_the_variance_that_is_carried(step):
    rng = np.random.default_rng(1)
    field = a_map(a_sheet(1.0), headings=(0.0,), variance_nt2=np.full((1, 25, 25), 100.0))
    clean, carried = (
        at_height(field, HEIGHT_M + step).values_nt,
        at_height(field, HEIGHT_M + step).variance_nt2,
    )
    noisy = [
        at_height(replace(field, values_nt=field.values_nt + rng.normal(0, 10, (1, 25, 25))), HEIGHT_M + step)
        for _ in range(200)
    ]
    assert np.all(np.mean([(n.values_nt - clean) ** 2 for n in noisy], axis=0) < carried)
    common = at_height(replace(field, values_nt=field.values_nt + 10), HEIGHT_M + step).values_nt - clean
    assert_allclose(common, 10)  # an error that all nodes share does not shrink on the way
    assert np.all(common**2 < 1.0001 * carried)


def test_dipoles_of_a_survey_whose_height_is_unknown_are_not_taken_to_a_height_above_the_floor():
    sheet = a_sheet(0.0)
    with pytest.raises(InputError, match=r"height of map 'sheet' is unknown.*\(--height-m\)"):
        at_height(a_map(sheet, harmonic=sheet, height_m=None), 0.5)


@pytest.mark.parametrize(
    ("change", "height", "said"),
    [
        ({}, np.nan, r"height_m must be a length \[m\], got nan"),
        ({"height_m": None}, 1.0, "the height of map 'sheet' is unknown"),
        ({}, 0.28, "lies 0.07 m below the map 'sheet'; a grid of 0.25 m goes down by 0.0625 m at most"),
        ({"valid": np.zeros((2, 25, 25), bool)}, 1.0, "a heading without a valid node"),
    ],
)
def test_heights_that_a_grid_cannot_give_are_refused(change, height, said):
    with pytest.raises(InputError, match=said):
        at_height(a_map(a_sheet(1.0), **change), height)


def test_a_height_below_the_floor_or_among_the_dipoles_is_refused():
    sheet = a_sheet(1.0)
    with pytest.raises(InputError, match="height_m is a height above the floor, 0 m or more"):
        at_height(a_map(sheet, harmonic=sheet), -0.1)
    x, y = np.meshgrid(np.arange(-3, 3.1, 0.25), np.arange(-3, 3.1, 0.25))
    layer = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -0.05)])
    near = replace(sheet, p_world_dipole=layer, m_world=np.tile([0, 0, 0.1], (x.size, 1)))
    with pytest.raises(InputError, match=r"below 0\.2 m is the floor, or its dipoles are so near"):
        at_height(a_map(sheet, harmonic=near), 0.19)
    assert at_height(a_map(sheet, harmonic=near), 0.21).height_m == 0.21
    low = replace(near, p_base_sensor=(0.0, 0.0, 0.1))
    assert (
        at_height(a_map(low, harmonic=low, height_m=0.1), 0.15).height_m == 0.15
    )  # up from where it was fitted


def test_between_a_layer_below_and_one_above_a_field_goes_both_ways_and_through_neither():
    sheet = a_sheet(1.0)
    x, y = (c.ravel() for c in np.meshgrid(np.arange(-3, 3.1, 0.25), np.arange(-3, 3.1, 0.25)))
    layers = np.concatenate([np.column_stack([x, y, np.full(x.size, z)]) for z in (-0.2, 1.5)])
    both = replace(
        sheet,
        p_world_dipole=layers,
        m_world=np.tile([0, 0, 0.1], (len(layers), 1)),
        p_base_sensor=(0, 0, 0.5),
    )
    field = a_map(both, harmonic=both, height_m=0.5)
    for height in (0.06, 1.24):
        there = at_height(field, height)
        assert_allclose(there.values_nt, both.magnitude_nt(*field.grid.poses(), height_m=height))
    with pytest.raises(InputError, match=r"lies too low .* below 0\.05 m"):
        at_height(field, 0.04)
    for height in (1.26, 1.5, 2.0):
        with pytest.raises(InputError, match=r"lies too high .* above 1\.25 m are dipoles"):
            at_height(field, height)


@pytest.mark.parametrize(
    ("height", "said"),
    [
        (-0.1, "height_m is a height above the floor, 0 m or more, got -0.1"),
        (1e9, "farther above than it is long, what lies beside it makes the field"),
    ],
)
def test_heights_below_the_floor_and_far_above_the_map_are_refused(height, said):
    values = 41_000 + np.random.default_rng(0).normal(0, 100, (1, 6, 8))
    field = AnomalyMap(
        values_nt=values, origin_m=(0, 0), cell_m=(0.25, 0.25), headings_rad=[0.0], height_m=0.4
    )
    with pytest.raises(InputError, match=said):
        at_height(field, height)
