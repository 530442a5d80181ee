"""Fits that continue from an earlier one, and what is computed at some nodes only."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from test_gp import survey

from magtwin.field.fit.gp import fit_gp
from magtwin.field.fit.harmonic.inversion import fit_harmonic
from magtwin.field.fit.nodes import variance_at_nodes


def counted(fit, readings, **options):
    """A fit, and how often it reported."""
    seen = []
    model = fit(readings, progress=lambda *args: seen.append(args), **options)
    assert seen[-1][0] == seen[-1][1]
    return model, len(seen)


def test_a_fit_that_continues_from_an_earlier_one_finds_the_same_field_in_fewer_steps():
    whole = survey(noise=5.0)
    part = whole.take(np.flatnonzero((whole.node[:, 1] + 2 * whole.node[:, 2]) % 5 != 0))
    for fit, options in ((fit_gp, {}), (fit_harmonic, {"above": False, "earth_nt": (0.0, 2e4, -4e4)})):
        like = fit(part, **options)
        cold, many = counted(fit, whole, **options)
        warm, few = counted(fit, whole, like=like, **options)
        assert few < many
        off = warm.predict(whole.p_xy, whole.yaw)[0] - cold.predict(whole.p_xy, whole.yaw)[0]
        sd = np.sqrt(cold.predict(whole.p_xy, whole.yaw)[1] + cold.noise_nt2)
        assert np.sqrt(np.mean(off**2)) < 0.5 * np.mean(sd)


def test_nodes_of_a_gaussian_process_have_its_values_and_nearly_its_sd():
    readings = survey(noise=5.0)
    model = fit_gp(readings)
    axes = np.linspace(-0.9, 0.9, 25)
    p = np.stack(np.meshgrid(axes, axes), axis=-1)
    value, variance = model.predict_nodes(p, 0.3)
    exact = model.predict(p, 0.3)
    assert_allclose(value, exact[0], rtol=1e-9)
    assert abs(np.median(np.sqrt(variance / exact[1])) - 1) < 0.1


def test_a_linear_sd_is_interpolated_exactly_and_wide_nodes_are_all_computed():
    axes = np.linspace(0, 1, 11)
    p = np.stack(np.meshgrid(axes, axes), axis=-1)
    asked = []

    def variance_of(q):
        asked.append(len(q))
        return (1 + q[:, 0] + 2 * q[:, 1]) ** 2

    assert_allclose(variance_at_nodes(p, 0.3, variance_of), variance_of(p.reshape(-1, 2)).reshape(11, 11))
    assert asked[0] == 25
    assert_array_equal(variance_at_nodes(p, 0.05, variance_of).shape, (11, 11))
    assert asked[-1] == 121
