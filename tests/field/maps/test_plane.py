"""Plane: the field at one height as a table has it, against sums over what makes it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.field.maps import lookup, plane
from magtwin.field.maps.lookup import LOOPS
from magtwin.field.maps.plane import CLEAR_M, ERROR, HALF_M, SLOPE_ERROR, Plane
from magtwin.field.sources.bodies import CELL_M, Bodies, Body
from magtwin.field.sources.compiled_dipoles import dipole_field_and_gradient_nt

HEIGHT_M = 0.41


def above(p):
    return np.column_stack([p, np.full(len(p), HEIGHT_M)])


def direct(bodies, p):
    """Field and slopes, summed up point by point."""
    parts = [bodies.field_and_rate_nt(above(p), np.tile(np.eye(3)[k], (len(p), 1))) for k in (0, 1)]
    return parts[0][0], np.stack([rate for _, rate in parts], axis=1)


def box(p_world, size=(0.1, 0.2, 0.3)):
    turn = np.array([0.1, -0.2, 0.3, 0.4])
    return Body(
        shape="cuboid",
        size_m=np.array(size),
        p_world=np.array(p_world),
        q_world_xyzw=turn / np.linalg.norm(turn),
        magnetization=np.array([1e3, -2e3, 3e3]),
    )


@pytest.fixture(scope="module")
def room():
    """Boxes and dipoles under the floor, beside it, and in the way."""
    rng = np.random.default_rng(0)
    places = rng.uniform((-3, -2, -1), (3, 2, -0.2), (40, 3))
    places[:3, 2] = 0.3
    boxes = [box(rng.uniform((-3, -2, -1), (3, 2, -0.4))) for _ in range(10)]
    boxes += [box((0.6, 0.4, 0.3)), box((-0.9, 0.1, 0.9))]
    return Bodies(boxes, places, rng.normal(scale=3.0, size=(40, 3)))


@pytest.fixture(scope="module")
def floor():
    return np.random.default_rng(1).uniform((-1.5, -1.2), (1.5, 1.2), (2_000, 2))


@pytest.fixture
def in_numpy(monkeypatch):
    monkeypatch.setattr(LOOPS, "code", None)
    monkeypatch.setattr(LOOPS, "pays", np.inf)


def test_interpolation_errs_by_less_than_is_stated_wherever_its_source_stands():
    rng = np.random.default_rng(2)
    middle, reach = np.array([HALF_M, HALF_M, HEIGHT_M]), 1.000001 * (CLEAR_M + np.sqrt(2) * HALF_M)
    p = np.concatenate([rng.uniform(0, CELL_M, (50, 2)), CELL_M * 0.999999 * rng.integers(0, 2, (50, 2))])
    off, steeper = [], []
    for k in range(100):
        away = rng.normal(size=3) * ((1, 1, 1), (1, 1, 0), (1, 0, 0))[k % 3]
        place = middle + reach * away / np.linalg.norm(away)
        moment = rng.normal(size=3)
        field, slopes = Plane(Bodies((), [place], [moment]), HEIGHT_M).field_and_slopes_nt(p)
        want, gradient = dipole_field_and_gradient_nt(above(p), [place], [moment])
        strongest = 200 * np.linalg.norm(moment) / CLEAR_M**3  # along a moment of 1 A m2 at 1 m [nT]
        off.append(np.abs(field - want).max() / strongest)
        change = np.swapaxes(gradient, 1, 2)[:, :2]
        steeper.append(np.abs(slopes - change).max() / (3 * strongest / CLEAR_M))
    assert ERROR / 10 < max(off) < ERROR
    assert SLOPE_ERROR / 10 < max(steeper) < SLOPE_ERROR


def test_near_sources_and_far_from_them_it_is_the_sum_over_them(room, floor):
    table = Plane(room, HEIGHT_M)
    field, slopes = table.field_and_slopes_nt(floor)
    want, change = direct(room, floor)
    assert table._close  # some are near
    size = np.linalg.norm(want, axis=1)
    assert size.max() > 50_000
    off = np.linalg.norm(field - want, axis=1)
    assert (
        off.max() < 0.01 + 1e-4 * size.max()
    )  # what `Bodies` allows where it goes over from exact to dipoles
    assert np.quantile(off, 0.9) < 0.01
    steepness = np.linalg.norm(change, axis=(1, 2))
    assert np.all(np.linalg.norm(slopes - change, axis=(1, 2)) < 1 + 1e-3 * steepness)


def test_only_dipoles_far_and_near_are_exact_to_a_hundredth_of_a_nanotesla(floor):
    rng = np.random.default_rng(3)
    places = rng.uniform((-3, -2, -1), (3, 2, 0.3), (200, 3))
    some = Bodies((), places, rng.normal(scale=3.0, size=(200, 3)))
    field, slopes = Plane(some, HEIGHT_M).field_and_slopes_nt(floor)
    want, change = direct(some, floor)
    assert np.abs(want).max() > 100_000
    assert_allclose(field, want, rtol=0, atol=0.01)
    assert_allclose(slopes, change, rtol=1e-9, atol=1.0)


def test_slopes_are_those_of_the_field_that_is_given(room, floor):
    p = floor[:200]
    p = p[np.abs(p / CELL_M - np.rint(p / CELL_M)).min(axis=1) > 1e-3]  # squares meet to ERROR alone
    table, step = Plane(room, HEIGHT_M), 1e-5
    _, slopes = table.field_and_slopes_nt(p)
    for k, along in enumerate(np.eye(2)):
        ahead, behind = (table.field_and_slopes_nt(p + sign * step * along)[0] for sign in (1, -1))
        want = (ahead - behind) / (2 * step)
        assert_allclose(slopes[:, k], want, rtol=1e-5, atol=1e-4 * np.abs(want).max())


def test_what_a_point_is_told_does_not_depend_on_company_order_or_memory(room, floor, monkeypatch):
    far = Bodies(room.bodies[:9], *(part[5:] for part in room._dipoles))
    field, slopes = Plane(far, HEIGHT_M).field_and_slopes_nt(floor)
    assert np.isfinite(field).all()
    backwards = Plane(far, HEIGHT_M).field_and_slopes_nt(floor[::-1])
    assert_array_equal(backwards[0][::-1], field)
    assert_array_equal(backwards[1][::-1], slopes)
    alone = Plane(far, HEIGHT_M)
    for k in (0, 7, 1_999):
        assert_array_equal(alone.field_and_slopes_nt(floor[k : k + 1])[0][0], field[k])
    monkeypatch.setattr(plane, "MOST_SQUARES", 30)
    monkeypatch.setattr(plane, "BLOCK", 25)
    small = Plane(far, HEIGHT_M)
    assert_array_equal(small.field_and_slopes_nt(floor)[0], field)
    assert len(small._slots) <= 30
    assert len(small._table) <= 64


def test_compiled_code_gives_the_bytes_of_numpy(room, floor, in_numpy, monkeypatch):
    table = Plane(room, HEIGHT_M)
    field, slopes = table.field_and_slopes_nt(floor)
    assert LOOPS.code is None
    lookup.warm_up()
    assert LOOPS.code is not None
    compiled = table.field_and_slopes_nt(floor)
    assert compiled[0].tobytes() == field.tobytes()
    assert compiled[1].tobytes() == slopes.tobytes()


def test_threads_that_ask_at_once_are_told_the_same(room, floor):
    want, _ = Plane(room, HEIGHT_M).field_and_slopes_nt(floor)
    table = Plane(room, HEIGHT_M)
    parts = np.array_split(np.arange(len(floor)), 16)
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda rows: table.field_and_slopes_nt(floor[rows])[0], parts))
    assert_allclose(np.concatenate(got), want, rtol=1e-12, atol=1e-9)
