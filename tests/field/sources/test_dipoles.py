"""Compiled sums over dipoles, and gradients made of them: laws, peers, and who adds up changes nothing."""

import magpylib as magpy
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.field.sources import compiled_dipoles as dipoles
from magtwin.field.sources import dipoles as sources
from magtwin.field.sources.bodies import Bodies
from magtwin.field.sources.compiled_dipoles import dipole_field_and_gradient_nt, dipole_field_nt


def below(count, seed=0):
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(-1, -0.3, count)])
    return place, rng.normal(0, 3, (count, 3))


def above(shape, seed=1):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-2, 2, (*shape, 2)), rng.uniform(0.1, 1, (*shape, 1))], axis=-1)


def apart(got, want):
    """Greatest length of a difference of vectors, over that of the longest."""
    return np.linalg.norm(got - want, axis=-1).max() / np.linalg.norm(want, axis=-1).max()


@given(st.integers(0, 300), st.integers(1, 600), st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_the_compiled_sum_is_the_plain_one_to_1e_12(count, points, seed):
    place, moment = below(count, seed)
    p = above((points,), seed)
    want = sources.dipole_field_nt(p, place, moment)
    assert_allclose(dipole_field_nt(p, place, moment), want, rtol=0, atol=1e-12 * (np.abs(want).max() + 1))


def test_the_compiled_sum_agrees_with_magpylib():
    place, moment = below(20)
    p = above((50,))
    tesla = sum(magpy.misc.Dipole(moment=m, position=at).getB(p) for at, m in zip(place, moment, strict=True))
    assert apart(dipole_field_nt(p, place, moment), tesla * 1e9) < 1e-9


def test_how_many_points_and_threads_there_are_changes_no_byte(monkeypatch):
    place, moment = below(30)
    p = above((1_000,))
    field, gradient = dipole_field_and_gradient_nt(p, place, moment)
    assert_array_equal(dipole_field_nt(p, place, moment), field)
    assert_array_equal(dipole_field_nt(p[300:701], place, moment), field[300:701])
    assert_array_equal(dipole_field_nt(p[7], place, moment), field[7])
    monkeypatch.setattr(dipoles, "SHARE", 3_000)
    again = dipole_field_and_gradient_nt(p, place, moment)
    assert_array_equal(again[0], field)
    assert_array_equal(again[1], gradient)


def test_the_gradient_is_what_the_field_changes_by_along_each_axis():
    place, moment = below(30)
    p = above((4, 5))
    _, gradient = dipole_field_and_gradient_nt(p, place, moment)
    assert gradient.shape == (4, 5, 3, 3)
    for axis in range(3):
        v = np.broadcast_to(np.eye(3)[axis], p.shape)
        _, rate = Bodies((), place, moment).field_and_rate_nt(p, v)
        assert apart(gradient[..., axis], rate) < 1e-11
    assert_array_equal(gradient, np.swapaxes(gradient, -1, -2))
    assert_array_equal(np.trace(gradient, axis1=-2, axis2=-1), 0.0)
    step = np.array([0, 0, 1e-5])
    pair = [dipole_field_nt(p + sign * step, place, moment) for sign in (-1, 1)]
    assert_allclose((pair[1] - pair[0])[..., 2] / 2e-5, gradient[..., 2, 2], rtol=1e-5, atol=1e-2)
