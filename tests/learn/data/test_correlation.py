import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import spearmanr

from magtwin.errors import InputError
from magtwin.learn.data.correlation import correlations


def some(rows=400, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(rows, 4))
    x[:, 1] = np.round(x[:, 1])  # ties
    x[:, 3] = 2.5
    return x, np.exp(x[:, 0]) + 3 * x[:, 1] + rng.normal(size=rows), np.arange(rows) * 8 // rows


NAMES = ("yaw_deg", "lidar_on", "odom_v_x", "battery_v")


def test_it_is_scipys_with_ties_too_and_an_input_that_never_varies_has_none():
    x, y, groups = some()
    found = correlations(x, y, NAMES, groups)
    assert_allclose(found.rho[:3], [spearmanr(x[:, i], y).statistic for i in range(3)], atol=1e-12)
    assert np.isnan(found.rho[3])


def test_the_spread_is_that_between_groups_not_that_of_so_many_alike_rows():
    """Eight runs repeated tenfold know no more than eight runs."""
    x, y, groups = some()
    once = correlations(x, y, NAMES, groups)
    often = correlations(np.tile(x, (10, 1)), np.tile(y, 10), NAMES, np.tile(groups, 10))
    assert_allclose(often.sd[:3], once.sd[:3], rtol=0.02)
    assert 0.5 < once.sd[2] * np.sqrt(len(y)) < 2  # independent rows, for once
    assert np.isnan(correlations(x, y, NAMES, 0 * groups).sd).all()


def test_labels_that_never_vary_are_refused():
    x, _, groups = some()
    with pytest.raises(InputError, match="nothing correlates with them"):
        correlations(x, np.ones(400), NAMES, groups)
