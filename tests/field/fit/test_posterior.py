"""The linear posterior, held against its textbook form by plain inverses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.field.fit.harmonic.posterior import Posterior


def problem(readings, unknowns, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(readings, unknowns)), rng.normal(size=readings)


@pytest.mark.parametrize("shape", [(7, 12), (12, 7), (9, 9)])
def test_both_forms_are_the_textbooks(shape):
    rows, target = problem(*shape)
    found = Posterior.of(rows)
    assert found.dual == (shape[0] <= shape[1])
    covariance = np.linalg.inv(rows.T @ rows + np.eye(shape[1]))
    assert_allclose(found.mean(target), covariance @ rows.T @ target, rtol=1e-10, atol=1e-12)
    assert_allclose(found.known(), 1 - np.diag(covariance), atol=1e-12)
    assert_allclose(found.fitted(), np.diag(rows @ covariance @ rows.T), atol=1e-12)
    assert_allclose(found.half_log_det(), np.linalg.slogdet(covariance)[1] / -2, rtol=1e-12)
    columns = found.directions()
    assert_allclose(np.eye(shape[1]) - columns @ columns.T, covariance, atol=1e-2)


@pytest.mark.parametrize("shape", [(8, 12), (12, 5)])
def test_groups_left_out_are_as_if_they_had_never_been_read(shape):
    rows, target = problem(*shape)
    groups = [np.array([0, 3]), np.array([1]), np.array([2, *range(4, shape[0])])]
    whole = Posterior.of(rows)
    error, variance = whole.left_out(target, groups)
    lost = whole.changes(target, groups)
    for k, group in enumerate(groups):
        kept = np.setdiff1d(np.arange(shape[0]), group)
        covariance = np.linalg.inv(rows[kept].T @ rows[kept] + np.eye(shape[1]))
        without = covariance @ rows[kept].T @ target[kept]
        assert_allclose(lost[:, k], whole.mean(target) - without, rtol=1e-8, atol=1e-10)
        want = target[group] - rows[group] @ without
        assert_allclose(error[group], want, rtol=1e-9, atol=1e-10)
        assert_allclose(variance[group], np.diag(rows[group] @ covariance @ rows[group].T), rtol=1e-8)
