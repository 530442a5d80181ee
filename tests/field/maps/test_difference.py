"""Two surveys of one floor: the bias that they share, the nodes that changed, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.maps.difference import FALSE_SHARE, difference
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.dipoles import dipole_field_nt

FOUR = np.radians([0.0, 90.0, 180.0, 270.0])
NOISE_NT = 20.0


def a_map(rng, shape=(4, 15, 25), noise_nt=NOISE_NT, cell=0.25, **more) -> AnomalyMap:
    """A smooth field on a floor about the origin, read with noise."""
    _, rows, columns = shape
    x, y = np.meshgrid((np.arange(columns) - columns // 2) * cell, (np.arange(rows) - rows // 2) * cell)
    heading = FOUR[: shape[0]]
    smooth = 41_000 + 900 * np.sin(x) * np.cos(1.3 * y) + 300 * np.cos(heading)[:, None, None]
    given = {
        "values_nt": smooth + noise_nt * rng.standard_normal(shape),
        "origin_m": (x[0, 0], y[0, 0]),
        "cell_m": (cell, cell),
        "headings_rad": heading,
        "variance_nt2": np.full(shape, noise_nt**2),
        "name": "a",
    }
    return AnomalyMap(**{**given, **more})


def with_a_magnet(field: AnomalyMap, p=(1.0, -0.5, 0.0), m=(0.0, 0.0, 0.2)) -> AnomalyMap:
    """The field with a dipole 0.35 m below the sensor, along a vertical main field."""
    x, y = np.meshgrid(field.x_m, field.y_m)
    at = np.stack([x, y, np.full_like(x, 0.35)], axis=-1)
    return replace(field, values_nt=field.values_nt + dipole_field_nt(at, [p], [m])[..., 2], name="b")


def pair(seed=0, **more):
    rng = np.random.default_rng(seed)
    return a_map(rng, **more), a_map(rng, **more)


def figures(found):
    return {f.name: f for f in found.report().figures}


def test_a_magnet_that_was_laid_down_is_found_where_it_lies():
    before, after = pair()
    found = difference(before, with_a_magnet(after))
    region = found.regions[0]
    assert_allclose(region.centre_m, (1.0, -0.5), atol=0.05)
    assert region.peak_m == (1.0, -0.5)
    # 2 mu_0 / 4 pi m / z^3 above a vertical dipole, 933 nT, and four standard deviations of two readings
    assert region.peak_nt == pytest.approx(0.2 * 2e-7 / 0.35**3 * 1e9, abs=4 * NOISE_NT * np.sqrt(2))
    assert region.peak_z == pytest.approx(region.peak_nt / (NOISE_NT * np.sqrt(2)), rel=1e-9)
    x0, x1, y0, y1 = region.extent_m
    assert x0 <= 0.75 < 1.25 <= x1
    assert y0 <= -0.75 < -0.25 <= y1
    assert sum(r.nodes for r in found.regions[1:]) <= 3


def test_the_bias_of_each_heading_is_told_apart_from_what_changed():
    before, after = pair()
    bias = np.array([120.0, -40.0, 300.0, 0.0])
    shifted = replace(with_a_magnet(after), values_nt=with_a_magnet(after).values_nt + bias[:, None, None])
    found, plain = difference(before, shifted), difference(before, with_a_magnet(after))
    assert_allclose(found.bias_nt - plain.bias_nt, bias, atol=1e-9)
    assert_allclose(found.bias_nt, bias, atol=6)  # of 375 nodes of 28 nT, and a magnet's skirt
    assert_allclose(found.local_nt, plain.local_nt, atol=1e-9)
    assert_array_equal(found.changed, plain.changed)


def test_where_nothing_changed_hardly_ever_a_node_is_called_changed():
    """With no change at all the false-discovery rate is how often any node is called changed."""
    runs = 400
    alarms = sum(difference(*pair(seed, shape=(1, 12, 12))).changed.any() for seed in range(runs))
    assert alarms / runs < FALSE_SHARE + 3 * np.sqrt(FALSE_SHARE * (1 - FALSE_SHARE) / runs)


def test_of_the_nodes_called_changed_few_kept_their_field():
    false, called = 0, 0
    for seed in range(60):
        before, after = pair(seed, shape=(1, 15, 25))
        moved = np.zeros(after.values_nt.shape, bool)
        moved[:, 4:9, 10:16] = True
        found = difference(before, replace(after, values_nt=after.values_nt + 120.0 * moved))
        false += np.count_nonzero(found.changed & ~moved)
        called += np.count_nonzero(found.changed)
    assert called > 60 * 20  # of 30 that did change
    assert false / called < 1.3 * FALSE_SHARE


def test_without_variance_it_says_so_and_takes_the_robust_spread():
    before, after = pair()
    known = difference(before, with_a_magnet(after))
    found = difference(replace(before, variance_nt2=None), with_a_magnet(after))
    assert known.from_variance
    assert not found.from_variance
    assert "a map has no variance: from the robust spread" in figures(found)["expected spread"].note
    assert "from both maps' variances" in figures(known)["expected spread"].note
    assert "spread of z" not in figures(found)
    assert_allclose(found.sd_nt, NOISE_NT * np.sqrt(2), rtol=0.15)
    assert found.regions[0].peak_m == (1.0, -0.5)


def test_a_variance_that_is_too_small_shows_in_the_spread_of_z():
    before, after = pair()
    assert figures(difference(before, after))["spread of z"].value == pytest.approx(1, abs=0.1)
    low = replace(before, variance_nt2=before.variance_nt2 / 100)
    assert figures(difference(low, low_again(after)))["spread of z"].value == pytest.approx(10, rel=0.1)


def low_again(field):
    return replace(field, variance_nt2=field.variance_nt2 / 100)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_turned_about_it_tells_the_opposite(seed, variance):
    before, after = pair(seed, shape=(2, 6, 7))
    after = with_a_magnet(after, p=(0.0, 0.0, 0.0))
    if not variance:
        before = replace(before, variance_nt2=None)
    there, back = difference(before, after), difference(after, before)
    assert_allclose(there.change_nt, -back.change_nt)
    assert_allclose(there.z, -back.z, rtol=1e-6, atol=1e-6)
    assert [r.nodes for r in there.regions] == [r.nodes for r in back.regions]


def test_nodes_masked_in_either_survey_and_off_either_grid_are_left_out():
    before, after = pair()
    valid = np.ones(before.values_nt.shape, bool)
    valid[:, 3, 10] = False
    moved = replace(after, origin_m=(after.origin_m[0] + 1.0, after.origin_m[1]))
    found = difference(replace(before, valid=valid), moved)
    assert np.isnan(found.z[:, 3, 10]).all()
    assert np.isnan(found.z[:, :, :4]).all()
    assert np.isfinite(found.z[:, 4:, 4:]).all()
    assert figures(found)["compared nodes"].value == np.isfinite(found.z).sum() == 4 * (15 * 21 - 1)
    assert not found.changed[:, 3, 10].any()


def test_surveys_on_other_grids_meet_on_the_coarser_one_in_the_fewer_headings():
    rng = np.random.default_rng(0)
    fine = a_map(rng, (4, 61, 101), cell=0.0625, noise_nt=1.0)
    coarse = a_map(rng, (1, 15, 25), noise_nt=1.0)
    found = difference(fine, coarse)
    assert found.grid == coarse.grid
    assert difference(coarse, fine).grid == coarse.grid
    assert np.isfinite(found.z).all()
    assert_allclose(found.local_nt, 0, atol=6 * np.sqrt(2))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"origin_m": (100.0, 0.0)}, "maps 'a' and 'a' have no valid node in common"),
        ({"valid": np.zeros((4, 15, 25), bool)}, "no valid node in common"),
        ({"frame": "map"}, "map 'a' has the frame 'world' and 'a' 'map', so that one x and y are two places"),
        ({"datum": "the door"}, "has the datum 'the wall' and 'a' 'the door', .* with one --datum"),
        ({"height_m": 0.5}, r"'a' is of 0\.35 m above the floor and 'a' of 0\.5 m; .*magtwin map upward"),
    ],
)
def test_surveys_that_cannot_be_compared_are_refused(change, said):
    before, after = pair(height_m=0.35, frame="world", datum="the wall")
    with pytest.raises(InputError, match=said):
        difference(before, replace(after, **change))
