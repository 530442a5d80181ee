"""Eigenfunctions on a box, and the Gaussian process that they make."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.localization.slam.hilbert import basis

LOW, HIGH = [-1.0, 0.5, -0.3], [2.0, 2.0, 0.7]


def test_no_function_with_a_lower_eigenvalue_is_left_out():
    functions = basis(LOW, HIGH, 60)
    grid = np.stack(np.meshgrid(*[np.arange(1, 30)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    every = np.sort(((np.pi * grid / (np.subtract(HIGH, LOW))) ** 2).sum(axis=1))
    assert_allclose(functions.eigenvalues, every[:60], rtol=1e-12)


def test_many_functions_approach_the_squared_exponential_kernel_inside_the_box():
    functions = basis([-3.0, -3.0], [3.0, 3.0], 600)
    p = np.random.default_rng(3).uniform(-1, 1, (20, 2))
    variances = functions.variances(sd=2.0, length_m=0.7)
    near = (functions.values(p) * variances) @ functions.values(p).T
    r2 = ((p[:, None] - p) ** 2).sum(axis=-1)
    assert_allclose(near, 4 * np.exp(-r2 / (2 * 0.7**2)), atol=1e-4)


def test_regression_on_functions_approaches_the_full_curl_free_process():
    """Field of a potential with kernel k: cov(B_a(p), B_b(q)) = (delta_ab / l^2 - r_a r_b / l^4) k(r)."""
    length, sd, noise, rng = 0.8, 1.0, 0.1, np.random.default_rng(4)
    p, at = rng.uniform(-0.6, 0.6, (12, 3)), rng.uniform(-0.6, 0.6, (5, 3))

    def covariance(x, y):
        r = x[:, None] - y
        k = sd**2 * np.exp(-(r**2).sum(axis=-1) / (2 * length**2))
        blocks = np.eye(3) / length**2 - r[..., :, None] * r[..., None, :] / length**4
        return (blocks * k[..., None, None]).transpose(0, 2, 1, 3).reshape(3 * len(x), 3 * len(y))

    y = rng.standard_normal(36)
    full = covariance(at, p) @ np.linalg.solve(covariance(p, p) + noise**2 * np.eye(36), y)
    functions = basis([-2.6] * 3, [2.6] * 3, 2500)
    h = functions.gradients(p).reshape(36, -1)
    variances = functions.variances(sd=sd, length_m=length)
    weights = variances * (h.T @ np.linalg.solve((h * variances) @ h.T + noise**2 * np.eye(36), y))
    assert_allclose((functions.gradients(at) @ weights).ravel(), full, atol=0.02 * np.abs(full).max())


@pytest.mark.parametrize("axes", [2, 3])
def test_derivatives_agree_with_finite_differences(axes):
    functions, rng = basis(LOW[:axes], HIGH[:axes], 25), np.random.default_rng(1)
    p, w, step = rng.uniform(LOW[:axes], HIGH[:axes], (6, axes)), rng.standard_normal(25), 1e-5
    compiled = functions.derivatives(p, w) if axes == 3 else None
    for a in range(axes):
        d = step * np.eye(axes)[a]
        slope = (functions.values(p + d) - functions.values(p - d)) / (2 * step)
        assert_allclose(functions.gradients(p)[:, a], slope, atol=1e-6)
        if compiled is not None:
            bend = (functions.gradients(p + d) - functions.gradients(p - d)) @ w / (2 * step)
            assert_allclose(compiled[2][:, a], bend, atol=1e-4)
    if compiled is not None:
        assert_allclose(compiled[0], functions.gradients(p), atol=1e-10)
        assert_allclose(compiled[1], functions.gradients(p) @ w, atol=1e-10)
        assert_allclose(functions.slopes(p, w), compiled[1], atol=1e-12)
        laplacian = np.trace(compiled[2], axis1=1, axis2=2)
        assert_allclose(laplacian, functions.values(p) @ (-functions.eigenvalues * w), atol=1e-9)


def test_a_wrong_box_is_refused():
    with pytest.raises(InputError, match="box"):
        basis([0, 0], [1, 0], 5)
