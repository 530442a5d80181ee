import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.field.sources.dipoles import dipole_field_nt

ORIGIN = np.zeros((1, 3))


def some_dipoles(count, seed=0):
    rng = np.random.default_rng(seed)
    place = rng.uniform((-3, -2, -1), (3, 2, -0.3), (count, 3))
    return place, rng.normal(scale=3, size=(count, 3))


def some_points(count, seed=1):
    return np.random.default_rng(seed).uniform((-3, -2, 0.2), (3, 2, 1), (count, 3))


def test_a_dipole_of_1_a_m2_makes_200_nt_at_1_m_on_its_axis_and_100_against_it_beside():
    got = dipole_field_nt([[0, 0, 1], [0, 0, -1], [1, 0, 0]], ORIGIN, [[0, 0, 1]])
    assert_allclose(got, [[0, 0, 200], [0, 0, 200], [0, 0, -100]], rtol=1e-9)


def test_dipoles_agree_with_magpylib_which_works_in_tesla():
    magpy = pytest.importorskip("magpylib")
    place, moment = some_dipoles(20)
    p = some_points(200)
    peer = magpy.getB(
        [magpy.misc.Dipole(moment=m, position=q) for q, m in zip(place, moment, strict=True)], p
    )
    got = dipole_field_nt(p, place, moment)
    scale = np.abs(got).max()
    assert_allclose(
        got, peer.sum(axis=0) * 1e9, rtol=0, atol=2e-9 * scale
    )  # mu_0 of 2018 against 2022: 7e-10


def gradient(p, place, moment, step=1e-3):
    """dB_j / dp_i by central differences of fourth order [nT/m], shape (N, i, j)."""
    move = step * np.eye(3)[:, None, :]
    near = dipole_field_nt(p + move, place, moment) - dipole_field_nt(p - move, place, moment)
    far = dipole_field_nt(p + 2 * move, place, moment) - dipole_field_nt(p - 2 * move, place, moment)
    return np.moveaxis((8 * near - far) / (12 * step), 0, 1)


def test_the_field_has_neither_divergence_nor_curl():
    p, dipoles = some_points(100), some_dipoles(30)
    slope = gradient(p, *dipoles)
    size = np.linalg.norm(slope, axis=(1, 2))
    divergence = np.trace(slope, axis1=1, axis2=2)
    curl = slope - np.swapaxes(slope, 1, 2)
    # the fourth-order error is (step / distance)^4 = (1e-3 / 0.5)^4 of the gradient, below rounding of 1e-9
    assert np.all(np.abs(divergence) < 1e-8 * size)
    assert np.all(np.abs(curl).max(axis=(1, 2)) < 1e-8 * size)
    assert size.min() > 1  # the bounds above mean something


def test_the_field_keeps_its_digits_a_millimetre_from_a_dipole_far_from_the_origin():
    far = np.array([300.0, -200.0, 50.0])
    place, p = np.array([far, far + 1]), far + np.array([0.0, 0.0, 1e-3])
    moments = [[0, 0, 1e-3], [1, 0, 0]]
    near = sum(dipole_field_nt(p - q, ORIGIN, [m]) for q, m in zip(place, moments, strict=True))
    off = dipole_field_nt(p, place, moments) - near
    assert np.abs(off).max() < 1e-9 * np.linalg.norm(near)  # at 300 m a millimetre is known to 4e-11


def test_at_a_dipole_itself_the_field_is_not_finite_and_no_warning_is_raised():
    assert not np.isfinite(dipole_field_nt(np.zeros(3), ORIGIN, [[0, 0, 1.0]])).any()
