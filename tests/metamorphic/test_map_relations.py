"""Relations between maps: saved, cropped, moved, turned and scaled."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from relations import SHIFT, rotation, turned_map

from magtwin.field.maps.difference import difference
from magtwin.field.maps.map import AnomalyMap
from magtwin.usd.maps.layer import load_map, save_map


@pytest.fixture(scope="session")
def field():
    rng = np.random.default_rng(0)
    valid = rng.uniform(size=(4, 9, 12)) > 0.02
    return AnomalyMap(
        values_nt=41_000 + 800 * rng.standard_normal((4, 9, 12)),
        valid=valid,
        variance_nt2=rng.uniform(50, 100, (4, 9, 12)),
        origin_m=(-1.4, -0.8),
        cell_m=(0.25, 0.2),
        headings_rad=np.pi / 2 * np.arange(4),
        name="made",
    )


def places(count=500):
    rng = np.random.default_rng(1)
    return rng.uniform((-1.3, -0.75), (1.3, 0.75), (count, 2)), rng.uniform(0, 2 * np.pi, count)


def test_a_map_that_was_saved_and_opened_is_the_same(field, tmp_path):
    save_map(field, tmp_path / "map.usdc")
    again = load_map(tmp_path / "map.usdc")
    for one, other in zip(again.lookup_with_sd(*places()), field.lookup_with_sd(*places()), strict=True):
        assert_allclose(one, other, rtol=1e-6)
    save_map(again, tmp_path / "again.usdc")
    assert load_map(tmp_path / "again.usdc") == again


def test_a_cropped_map_is_the_same_inside(field):
    part = (slice(None), slice(2, 8), slice(3, 11))
    x, y = field.x_m[3], field.y_m[2]
    crop = replace(
        field,
        values_nt=field.values_nt[part],
        valid=field.valid[part],
        variance_nt2=field.variance_nt2[part],
        origin_m=(float(x), float(y)),
    )
    p, yaw = places()
    inside = crop.contains(p)
    assert 50 < inside.sum() < 450
    assert_allclose(crop.lookup(p, yaw)[inside], field.lookup(p, yaw)[inside], rtol=1e-12)
    assert np.isnan(crop.lookup(p, yaw)[~inside]).all()


def test_a_moved_map_is_read_at_moved_places(field):
    x, y = np.array(field.origin_m) + SHIFT
    p, yaw = places()
    other = replace(field, origin_m=(float(x), float(y)))
    assert_allclose(other.lookup(p + SHIFT, yaw), field.lookup(p, yaw), rtol=1e-10)
    assert_allclose(other.gradient(p + SHIFT, yaw), field.gradient(p, yaw), rtol=1e-7, atol=1e-6)


def test_a_turned_map_is_read_at_turned_poses(field):
    p, yaw = places()
    turn = rotation(np.pi / 2)
    other = turned_map(field)
    assert_allclose(other.lookup(p @ turn.T, yaw + np.pi / 2), field.lookup(p, yaw), rtol=1e-10)
    slope, again = field.gradient(p, yaw), other.gradient(p @ turn.T, yaw + np.pi / 2)
    assert_allclose(again[:, :2], slope[:, :2] @ turn.T, rtol=1e-7, atol=1e-6)
    assert turned_map(turned_map(turned_map(other))) == replace(field, between_nt2=None)


def test_a_map_is_linear_in_its_values(field):
    p, yaw = places()
    other = replace(field, values_nt=3 * field.values_nt - 1_000)
    assert_allclose(other.lookup(p, yaw), 3 * field.lookup(p, yaw) - 1_000, rtol=1e-12)


def test_a_map_differs_from_itself_by_nothing_and_from_a_shifted_one_by_the_shift(field):
    for shift in (0.0, 250.0):
        off = difference(field, replace(field, values_nt=field.values_nt + shift))
        known = np.isfinite(off.change_nt)
        assert_array_equal(known, field.valid)
        assert_allclose(np.abs(off.change_nt[known]), shift, atol=1e-6)
        assert_allclose(off.local_nt[known], 0, atol=1e-6)
