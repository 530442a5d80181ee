"""What a robot reads over dipoles, held against the field's own evaluation and finite differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.field.fit.harmonic.forward import Forward

P, YAW = np.array([[0.2, -0.1], [-0.7, 0.4], [0.5, 0.6]]), np.array([0.3, 2.0, -1.2])
SIGNALS = np.array([[1.0, -0.3], [0.0, 2.0], [0.5, 0.1]])


def some(signals=0):
    rng = np.random.default_rng(0)
    forward = Forward(rng.uniform((-1, -1, -0.9), (1, 1, -0.3), (6, 3)), 0.2, signals=signals)
    unknowns = rng.normal(size=forward.size)
    unknowns[18:34] = [-2e3, 2.4e4, -3.8e4, 300, -200, 500, *(0.02 * rng.normal(size=8)), 0.03, -0.02]
    unknowns[34:] *= 300
    return forward, unknowns


def test_magnitudes_are_those_of_the_harmonic_field():
    forward, unknowns = some()
    read = forward.read(unknowns, P, YAW, vectors=False)
    assert_allclose(read.values_nt[:, 0], forward.field(unknowns).magnitude_nt(P, YAW), rtol=1e-12)
    vectors = forward.read(unknowns, P, YAW, vectors=True).values_nt
    assert_allclose(np.linalg.norm(vectors, axis=1), read.values_nt[:, 0], rtol=1e-12)


def test_a_signal_adds_its_field_in_the_robots_axes():
    forward, unknowns = some(signals=2)
    still = forward.read(unknowns, P, YAW, vectors=True).values_nt
    moving = forward.read(unknowns, P, YAW, SIGNALS, vectors=True).values_nt
    assert_allclose(moving - still, SIGNALS @ unknowns[34:].reshape(2, 3), atol=1e-9)


@pytest.mark.parametrize("vectors", [False, True])
@pytest.mark.parametrize("signals", [None, SIGNALS])
def test_derivatives_are_those_by_finite_differences(vectors, signals):
    forward, unknowns = some(signals=0 if signals is None else 2)
    read = forward.read(unknowns, P, YAW, signals, vectors=vectors)

    def slope(change, step):
        return (change(step) - change(-step)) / (2 * step)

    def value(u, p=P, yaw=YAW):
        return forward.read(u, p, yaw, signals, vectors=vectors).values_nt

    for k, unit in enumerate(np.eye(forward.size)):
        step = 1e-5 * max(1.0, abs(unknowns[k]))
        got = slope(lambda s, unit=unit: value(unknowns + s * unit), step)
        # central differences of 4e4 nT: rounding 1e-11 / 1e-5, curvature step^2
        assert_allclose(read.jacobian[:, :, k], got, rtol=1e-4, atol=1e-4 * np.abs(got).max() + 1e-6)
    for k, unit in enumerate(np.eye(2)):
        got = slope(lambda s, unit=unit: value(unknowns, P + s * unit), 1e-5)
        assert_allclose(read.by_place[:, :, k], got, rtol=1e-5, atol=1e-3)
    assert_allclose(read.by_yaw, slope(lambda s: value(unknowns, P, YAW + s), 1e-6), rtol=1e-5, atol=1e-2)


def test_vectors_are_linear_in_the_unknowns_with_the_derivatives_given():
    forward, unknowns = some()
    points = np.array([[0.1, 0.2, 0.5], [-0.4, 0.3, 0.1]])
    assert_allclose(forward.vectors(points) @ unknowns, forward.field(unknowns).field_nt(points), rtol=1e-12)
