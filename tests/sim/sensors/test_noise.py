"""Noise with memory: against a plain loop, closed forms and its own pieces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.sim.sensors.noise import gauss_markov, random_walk


@given(time_s=st.floats(0, 100), count=st.integers(1, 300), seed=st.integers(0, 99))
def test_a_gauss_markov_process_is_a_plain_loop(time_s, count, seed):
    white, start = np.random.default_rng(seed).standard_normal((count, 2)), np.array([0.5, -2.0])
    decay = np.exp(-1 / (time_s * 10.0)) if time_s else 0.0
    x = [start]
    for row in white:
        x.append(decay * x[-1] + np.sqrt(1 - decay * decay) * row)
    series, last = gauss_markov(white, start, time_s, 10.0)
    assert_allclose([*series, last], x, rtol=1e-12, atol=1e-12)


def test_a_gauss_markov_process_has_unit_spread_and_forgets_exponentially():
    rng = np.random.default_rng(0)
    y, _ = gauss_markov(rng.standard_normal((3000, 400)), rng.standard_normal(400), 2.0, 50.0)
    assert_allclose(y.std(axis=1)[[0, 1, 100, 2999]], 1.0, atol=0.12)  # 400 draws: one sigma is 0.035
    for lag_s in (0.5, 2.0, 4.0):
        k = round(lag_s * 50)
        assert np.mean(y[k:] * y[:-k]) == pytest.approx(np.exp(-lag_s / 2.0), abs=0.03)


def test_a_random_walk_begins_at_0_and_its_variance_grows_by_1_a_second():
    walk, _ = random_walk(np.random.default_rng(0).standard_normal((2001, 2000)), np.zeros(2000), 20.0)
    assert_array_equal(walk[0], 0)
    assert_allclose(walk[[20, 400, 2000]].var(axis=1), [1.0, 20.0, 100.0], rtol=0.13)  # one sigma: 3 %
