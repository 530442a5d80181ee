"""Statistics of benchmarks, against scipy and closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from magtwin.bench.statistics import bootstrap, paired, rate, rms


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (20, 20), (7, 20), (297, 300)])
def test_intervals_of_rates_are_scipys(successes, trials):
    made = rate(successes, trials)
    peer = stats.binomtest(successes, trials).proportion_ci(0.95, method="exact")
    assert_allclose(made, [successes / trials, peer.low, peer.high], rtol=1e-9, atol=1e-15)


def test_the_bootstrap_of_single_runs_is_scipys():
    values = np.random.default_rng(0).gamma(2, size=80)
    made = bootstrap(values, range(80), rms, resamples=10000)
    peer = stats.bootstrap(
        (values,),
        lambda v, axis: np.sqrt(np.mean(v**2, axis=axis)),
        method="percentile",
        n_resamples=10000,
        rng=1,
    ).confidence_interval
    spread = peer.high - peer.low
    assert_allclose(made[1:], peer, atol=0.03 * spread)  # two draws of 10,000 differ by about 1 % of it
    assert made.value == pytest.approx(np.sqrt(np.mean(values**2)))


def test_runs_of_one_session_have_its_interval_and_one_run_has_none():
    values = np.random.default_rng(3).gamma(2, size=20)
    alone, one = bootstrap(values, range(20), np.mean), bootstrap(values, np.zeros(20), np.mean)
    assert one == alone
    assert one.low < one.value < one.high
    assert paired(values, values + 0.1, np.zeros(20)).p < 1e-2
    single = bootstrap(values[:1], [0], np.mean)
    assert (single.value, np.isnan(single.low), np.isnan(single.high)) == (values[0], True, True)
    assert paired(values[:1], values[:1] + 0.1, [0]).p == 1


def test_paired_differences_have_the_p_value_of_scipys_permutation_test():
    rng = np.random.default_rng(4)
    a = rng.normal(0.4, 1, size=11)
    b = rng.normal(0, 1, size=11)
    made = paired(a, b, range(11))
    peer = stats.permutation_test(
        (a, b), lambda x, y: np.mean(x - y), permutation_type="samples", n_resamples=np.inf
    )
    assert made.p == pytest.approx(peer.pvalue)
    assert made.difference == pytest.approx(np.mean(a - b))
    assert made.low < made.difference < made.high


def test_paired_differences_of_many_sessions_draw_their_swaps():
    rng = np.random.default_rng(5)
    sessions = np.repeat(np.arange(40), 5)
    shared = rng.normal(size=40)[sessions]
    b = rng.normal(size=200)
    a = b + 0.3 + shared
    by_session = paired(a, b, sessions)
    peer = stats.ttest_1samp((a - b).reshape(40, 5).mean(axis=1), 0).pvalue
    assert by_session.p == pytest.approx(peer, abs=0.03)
    assert paired(a, b, range(200)).p < by_session.p  # runs of a session are no independent evidence
    assert paired(b, b, range(200)).p == 1
    assert paired(b + 1, b, range(200)).p == pytest.approx(1 / 4001)
