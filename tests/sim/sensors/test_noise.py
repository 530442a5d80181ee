"""Noise with a memory: against plain loops, closed forms and its own beginning."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.sim.sensors.noise import first_order, gauss_markov, random_walk


@given(decay=st.floats(0, 1), count=st.integers(1, 300), seed=st.integers(0, 99))
def test_a_first_order_process_is_what_a_plain_loop_makes(decay, count, seed):
    x = np.random.default_rng(seed).standard_normal((count, 2))
    y, state = [], np.zeros(2)
    for row in x:
        state = decay * state + row
        y.append(state)
    assert_allclose(first_order(x, decay), y, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("process", [lambda w: gauss_markov(w, 3.0, 10.0), lambda w: random_walk(w, 10.0)])
def test_a_longer_process_begins_with_a_shorter_one_to_the_bit(process):
    white = np.random.default_rng(0).standard_normal((5000, 3))
    for count in (1, 2, 777, 4096):
        assert_array_equal(process(white[:count]), process(white)[:count])


def test_a_gauss_markov_process_has_unit_spread_and_forgets_exponentially():
    y = gauss_markov(np.random.default_rng(0).standard_normal((3000, 400)), 2.0, 50.0)
    assert_allclose(y.std(axis=1)[[0, 1, 100, 2999]], 1.0, atol=0.12)  # 400 draws: one sigma is 0.035
    for lag_s in (0.5, 2.0, 4.0):
        k = round(lag_s * 50)
        assert np.mean(y[k:] * y[:-k]) == pytest.approx(np.exp(-lag_s / 2.0), abs=0.03)


def test_without_memory_it_is_white_noise_itself():
    white = np.random.default_rng(0).standard_normal(50)
    assert_array_equal(gauss_markov(white, 0.0, 50.0), white)


def test_a_random_walk_begins_at_0_and_its_variance_grows_by_1_a_second():
    walk = random_walk(np.random.default_rng(0).standard_normal((2001, 2000)), 20.0)
    assert_array_equal(walk[0], 0)
    assert_allclose(walk[[20, 400, 2000]].var(axis=1), [1.0, 20.0, 100.0], rtol=0.13)  # one sigma: 3 %
