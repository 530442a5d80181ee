"""Residuals: offset, remainder and correlation time of errors that are drawn with known ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.learn.data.residuals import PRIOR_SHARE, HeldOut, _autocovariance, residuals
from magtwin.sim.sensors.noise import gauss_markov

OFFSET, WITHIN, TIME_S, RATE_HZ = 100.0, 60.0, 3.0, 10.0


def drawn(sessions, recordings, *, seconds=60.0, offset=OFFSET, within=WITHIN, time_s=TIME_S, seed=0):
    """Errors of sessions with so many recordings each."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    held = []
    for k in range(sessions):
        constant = offset * rng.standard_normal()
        for _ in range(recordings):
            white = rng.standard_normal(len(t))
            process = np.append(*gauss_markov(white[1:], white[0], time_s, RATE_HZ))
            held.append(HeldOut(str(k), t, constant + within * process))
    return held


@pytest.mark.parametrize("recordings", [1, 2, 5])
def test_known_figures_are_found_whether_or_not_sessions_have_several_recordings(recordings):
    found = residuals(drawn(200, recordings))
    # 200 sessions tell a standard deviation to 1 / sqrt(400) = 5 %
    assert found["residual_offset_sd_nt"] == pytest.approx(OFFSET, rel=0.1)
    assert found["residual_within_sd_nt"] == pytest.approx(WITHIN, rel=0.1)
    assert found["residual_time_s"] == pytest.approx(TIME_S, rel=0.2)
    assert found["residual_sessions"] == 200


@pytest.mark.parametrize("time_s", [0.5, 2.0, 8.0])
def test_the_time_is_that_of_the_process(time_s):
    assert residuals(drawn(100, 2, time_s=time_s))["residual_time_s"] == pytest.approx(time_s, rel=0.25)


def test_errors_without_an_offset_and_errors_that_are_offsets_alone():
    assert residuals(drawn(200, 2, offset=0.0))["residual_offset_sd_nt"] < 0.2 * WITHIN
    constant = residuals(drawn(200, 2, within=1e-6))
    assert constant["residual_within_sd_nt"] < 0.1 * constant["residual_offset_sd_nt"]


def test_the_share_of_a_single_session_stays_near_the_guess():
    shares = []
    for seed in range(20):
        found = residuals(drawn(1, 2, seed=seed))
        shares.append(
            found["residual_offset_sd_nt"] ** 2
            / (found["residual_offset_sd_nt"] ** 2 + found["residual_within_sd_nt"] ** 2)
        )
    # one session counts for one, the guess for two
    assert min(shares) > 2 / 3 * PRIOR_SHARE - 1e-9
    assert max(shares) < 2 / 3 * PRIOR_SHARE + 1 / 3 + 1e-9


def test_a_long_gap_takes_no_memory_and_parts_the_recording_in_two():
    first, second = drawn(2, 1)
    joined = HeldOut("0", np.append(first.t, second.t + 1e12), np.append(first.error_nt, second.error_nt))
    expected, found = (_autocovariance(held) for held in ([first, second], [joined]))
    count = len(expected[0])
    assert_allclose(found[0][:count], expected[0])
    assert_allclose(found[1][:count], expected[1])


def test_a_clock_beyond_all_numbers_of_slots_is_read():
    held = drawn(2, 1)
    held[0] = HeldOut("0", held[0].t * 1e300, held[0].error_nt)
    assert residuals(held)
