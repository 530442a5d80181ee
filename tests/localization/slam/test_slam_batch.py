"""The arrow system against a dense one, and the batch solution against scipy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oval import first_readings, oval
from scipy.optimize import least_squares

from magtwin.localization.arrow import Arrow
from magtwin.localization.slam.batch import Batch
from magtwin.localization.slam.model import Model
from magtwin.localization.slam.samples import samples_of
from magtwin.localization.slam.settings import Settings


def dense_and_arrow(count=7, size=3, constants=4, seed=0):
    """A positive definite matrix of the arrow's form, a right-hand side, and the arrow."""
    rng = np.random.default_rng(seed)
    poses = count * size
    dense = np.zeros((poses + constants, poses + constants))
    for k in range(count):
        rows = [*range(k * size, min(poses, (k + 2) * size)), *range(poses, poses + constants)]
        j = rng.standard_normal((len(rows) + 2, len(rows)))
        dense[np.ix_(rows, rows)] += j.T @ j
    right = rng.standard_normal(poses + constants)
    blocks = dense[:poses, :poses].reshape(count, size, count, size)
    border = np.concatenate([dense[:poses, poses:], right[:poses, None]], axis=1)
    arrow = Arrow(
        np.ascontiguousarray(np.stack([blocks[k, :, k] for k in range(count)])),
        np.array([blocks[k + 1, :, k] for k in range(count - 1)]).reshape(count - 1, size, size),
        border.reshape(count, size, constants + 1).copy(),
        dense[poses:, poses:],
        right[poses:],
    )
    return dense, right, arrow


@pytest.mark.parametrize(("count", "size", "constants"), [(7, 3, 4), (1, 6, 5), (12, 9, 20), (5, 4, 1)])
def test_an_arrow_is_solved_as_the_dense_matrix(count, size, constants):
    dense, right, arrow = dense_and_arrow(count, size, constants)
    solution, inverse, poses = arrow.solve(), np.linalg.inv(dense), count * size
    expected = np.linalg.solve(dense, right)
    assert_allclose(solution.x.ravel(), expected[:poses], rtol=1e-8, atol=1e-10)
    assert_allclose(solution.g, expected[poses:], rtol=1e-8, atol=1e-10)
    blocks = inverse[:poses, :poses].reshape(count, size, count, size)
    last = [*range(poses - size, poses), *range(poses, poses + constants)]
    assert_allclose(solution.last_covariance(), inverse[np.ix_(last, last)], rtol=1e-7, atol=1e-10)
    assert_allclose(
        solution.pose_covariances(), [blocks[k, :, k] for k in range(count)], rtol=1e-7, atol=1e-10
    )


@pytest.mark.parametrize("vector", [True, False])
def test_the_solution_is_that_of_scipy(vector):
    problem, run, _ = oval(rows=60, seed=1, vector=vector)
    run = run.with_columns(b_measured_nt=np.where(np.arange(60) == 4, np.nan, run["b_measured_nt"]))
    samples = samples_of(first_readings(run, 9), vector)
    settings = Settings(functions=6, soft_iron_sd=0.05, velocity_sd_m_s=0.01, sd_nt=8_000.0)
    model = Model(problem, settings, samples.take(slice(0, 1)), vector)
    batch = Batch(model, samples)
    start = batch.fit_constants(batch.dead_reckoning())
    found, cost, _ = batch.solved(start, 60)
    spread = np.sqrt(model.constants_variance)

    def residuals(x):
        state = model.add(start, x[: 9 * model.size].reshape(9, -1), spread * x[9 * model.size :])
        r = batch.residuals(state)
        return np.concatenate([part.ravel() for part in vars(r).values()])

    peer = least_squares(
        residuals, np.zeros(9 * model.size + len(spread)), x_scale="jac", xtol=1e-12, ftol=1e-14
    )
    assert cost == pytest.approx(peer.cost, abs=2e-3)  # iterations end at a fall of 1e-3
    best = model.add(start, peer.x[: 9 * model.size].reshape(9, -1), spread * peer.x[9 * model.size :])
    solution = batch.linearised(found)[0].solve()
    sd = np.sqrt(np.diagonal(solution.pose_covariances(), axis1=1, axis2=2))
    assert (np.abs(model.difference(found, best)) < 0.1 * sd).all()  # 1e-3 of cost is 0.045 sd
    dense = np.linalg.inv(peer.jac.T @ peer.jac)[: 9 * model.size, : 9 * model.size]
    assert_allclose(sd.ravel(), np.sqrt(np.diag(dense)), rtol=0.05)
