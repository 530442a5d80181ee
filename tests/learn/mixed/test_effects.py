"""The algebra of session effects, against independent computations."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.learn.mixed.effects import (
    CORRELATION_S,
    Effects,
    effects_of_drive,
    fit_effects,
    posterior,
    shares,
    sums_of,
)
from magtwin.learn.mixed.followed import MEMORY_S, FollowedEffects, followed

P = 5


def a_prior(seed=0, size=40.0):
    rng = np.random.default_rng(seed)
    root = size * rng.normal(size=(P, P))
    return Effects(rng.normal(0, 100, P), root @ root.T + np.eye(P))


def a_session(prior, rows, seed, noise_nt=20.0):
    rng = np.random.default_rng(seed)
    beta = rng.multivariate_normal(prior.mean, prior.covariance)
    phi = np.column_stack([np.ones(rows), rng.normal(size=(rows, P - 1))])
    variance = noise_nt**2 * np.exp(0.5 * rng.normal(size=rows))
    return phi, phi @ beta + np.sqrt(variance) * rng.normal(size=rows), variance


def dense(prior, phi, y, noise, at):
    """Gaussian process regression in the space of readings: k = phi' Lambda phi (Rasmussen, eq. 2.25-26)."""
    cross = at @ prior.covariance @ phi.T
    whole = phi @ prior.covariance @ phi.T + np.diag(noise)
    mean = at @ prior.mean + cross @ np.linalg.solve(whole, y - phi @ prior.mean)
    return mean, np.diag(at @ prior.covariance @ at.T - cross @ np.linalg.solve(whole, cross.T))


def test_the_posterior_is_that_of_regression_in_the_space_of_readings():
    prior = a_prior()
    phi, y, variance = a_session(prior, 30, 1)
    at = np.random.default_rng(2).normal(size=(7, P))
    found = posterior(prior, sums_of(phi, y, variance, 0.1)).predict(at)
    mean, spread = dense(prior, phi, y, variance / 0.1, at)
    assert_allclose(found[0], mean, rtol=1e-8)
    assert_allclose(found[1], spread, rtol=1e-7)


def test_a_prediction_does_not_depend_on_other_rows_to_the_bit():
    effects, phi = a_prior(), np.random.default_rng(3).normal(size=(600, P))
    mean, variance = effects.predict(phi)
    alone = [effects.predict(phi[k : k + 1]) for k in (0, 255, 256, 599)]
    assert_array_equal([float(m[0]) for m, _ in alone], mean[[0, 255, 256, 599]])
    assert_array_equal([float(v[0]) for _, v in alone], variance[[0, 255, 256, 599]])


def test_em_recovers_the_spread_between_sessions_and_the_noise():
    prior, sessions = a_prior(size=30.0), []
    for seed in range(400):
        phi, y, variance = a_session(prior, 40, seed)
        sessions.append(sums_of(phi, y, variance / 400.0))  # shape known, the factor 400 nT^2 unknown
    found, factor = fit_effects(sessions, prior.mean, start_nt2=np.full(P, 50.0))
    assert factor == pytest.approx(400.0, rel=0.03)  # 16,000 readings: 1.1 % (one sd)
    size = np.linalg.norm(prior.covariance)
    assert np.linalg.norm(found.covariance - prior.covariance) < 0.2 * size  # 400 draws: 7 % an entry


def test_em_never_lowers_the_likelihood():
    """Of sessions whose readings are independent, up to the shrinkage of correlations."""
    prior = a_prior(size=10.0)
    data = [a_session(prior, 12, seed) for seed in range(60)]
    sessions = [sums_of(phi, y, variance / 400.0) for phi, y, variance in data]

    def likelihood(rounds):
        found, factor = fit_effects(sessions, prior.mean, start_nt2=np.full(P, 1e4), rounds=rounds)
        total = 0.0
        for phi, y, variance in data:
            whole = phi @ found.covariance @ phi.T + np.diag(factor * variance / 400.0)
            left = y - phi @ prior.mean
            total -= 0.5 * (np.linalg.slogdet(whole)[1] + left @ np.linalg.solve(whole, left))
        return total

    found = [likelihood(rounds) for rounds in (1, 2, 4, 8)]
    assert all(after > before for before, after in itertools.pairwise(found))


def test_a_drive_in_blocks_has_the_posterior_of_all_its_readings():
    prior, t = a_prior(), np.arange(240) / 4
    phi, y, variance = a_session(prior, 240, 5)
    drive = effects_of_drive(prior, phi, y, variance, t)
    assert shares(t) == pytest.approx(0.25 / CORRELATION_S)
    expected = posterior(prior, sums_of(phi, y, variance, shares(t)))
    assert_allclose(drive.effects.mean, expected.mean, rtol=1e-9)
    assert drive.left_out_nt == pytest.approx(20.0, rel=0.4)


def kernel_of_time(prior, phi, t, at, t_at):
    """Covariance of phi' beta at two times: beta is an Ornstein-Uhlenbeck process about mu."""
    return (at @ prior.covariance @ phi.T) * np.exp(-np.abs(t_at[:, None] - t) / MEMORY_S)


def test_followed_effects_are_regression_with_the_kernel_of_their_process():
    """A peer without recursion: all readings at once, with the covariance of the process between times."""
    prior, t = a_prior(), np.cumsum(np.random.default_rng(0).uniform(0.25, 40.0, 60))
    phi, y, variance = a_session(prior, 60, 7)
    filtered = FollowedEffects(prior)
    for k in range(60):
        assert filtered.update(t[k], phi[k], y[k], variance[k])
    weight = np.minimum(np.diff(t, prepend=t[0] - 0.25), CORRELATION_S) / CORRELATION_S
    at, later = np.random.default_rng(8).normal(size=(4, P)), np.full(4, t[-1] + 100.0)
    cross = kernel_of_time(prior, phi, t, at, later)
    whole = kernel_of_time(prior, phi, t, phi, t) + np.diag(variance / weight)
    mean = at @ prior.mean + cross @ np.linalg.solve(whole, y - phi @ prior.mean)
    spread = at @ prior.covariance @ at.T - cross @ np.linalg.solve(whole, cross.T)
    found = filtered.predict(later, at)
    assert_allclose(found[0], mean, rtol=1e-6)
    assert_allclose(found[1], np.diag(spread), rtol=1e-6)


def test_readings_that_are_too_close_late_or_unknown_are_skipped():
    filtered = FollowedEffects(a_prior())
    one = np.ones(P)
    assert filtered.update(0.0, one, 100.0, 400.0)
    assert not filtered.update(0.1, one, 100.0, 400.0)
    assert not filtered.update(-5.0, one, 100.0, 400.0)
    assert not filtered.update(1.0, one, np.nan, 400.0)
    assert not filtered.update(1.0, one * np.nan, 100.0, 400.0)
    assert not filtered.update(1.0, one, 100.0, np.nan)
    assert filtered.update(1.0, one, 100.0, 400.0)
    assert filtered.count == 2


def test_errors_larger_than_thought_widen_what_follows():
    prior, rng = a_prior(size=1.0), np.random.default_rng(0)

    def widening(noise_nt):
        filtered = FollowedEffects(prior)
        for k in range(800):
            phi = np.append(1.0, rng.normal(size=P - 1))
            filtered.update(k / 4, phi, phi @ prior.mean + noise_nt * rng.normal(), 400.0)
        return filtered.widening

    assert widening(20.0) == pytest.approx(1.0, abs=0.15)
    assert widening(60.0) == pytest.approx(2.7, abs=0.5)  # a prior of 30 s pulls towards 1


WAYS = (0, 1, 2)
"""Columns of the constant, cosine and sine of the heading in `a_turning_drive`."""


def a_turning_drive(prior, hidden_nt, seconds=300.0, noise_nt=20.0, seed=0):
    """Rows at 4 Hz of a robot that turns, with a hidden field, (N, 3), that is fixed to it."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 0.25)
    yaw = np.cumsum(0.3 * rng.normal(size=len(t)))
    phi = np.column_stack([np.ones(len(t)), np.cos(yaw), np.sin(yaw), rng.normal(size=(len(t), P - 3))])
    y = phi @ prior.mean + np.sum(phi[:, WAYS] * hidden_nt(t), axis=1) + noise_nt * rng.normal(size=len(t))
    return phi, y, np.full(len(t), noise_nt**2), t


def tilting(t):
    """A part that swings every 33 s, a period between those of the hypotheses, and rests at both ends."""
    swing = np.clip(1.4 * np.sin(2 * np.pi * t / 33.0 + 1.0), -1, 1)
    return swing[:, None] * [150.0, 60.0, -80.0]


def test_a_part_that_swings_is_predicted_from_its_past():
    prior = a_prior(size=10.0)
    phi, y, variance, t = a_turning_drive(prior, tilting)
    late = t > 120
    (blind, _), (seen, sd) = (
        followed(FollowedEffects(prior, ways=ways), phi, y, variance, t) for ways in ((), WAYS)
    )
    error, without = (float(np.sqrt(np.mean((m - y)[late] ** 2))) for m in (seen, blind))
    assert error < 0.55 * without  # without it the last ten seconds are a third of a swing behind
    assert 0.85 < np.mean(np.abs((seen - y)[late]) < 1.645 * sd[late]) <= 1.0


def test_without_a_hidden_part_none_is_found():
    prior = a_prior(size=10.0)
    phi, y, variance, t = a_turning_drive(prior, lambda t: np.zeros((len(t), 3)))
    filtered = FollowedEffects(prior, ways=WAYS)
    followed(filtered, phi, y, variance, t)
    assert np.argmax(filtered.probabilities) == 0
    assert effects_of_drive(prior, phi, y, variance, t, ways=WAYS).hidden_nt2 < 20.0**2 / 4


def test_a_drive_tells_period_and_size_of_a_field_that_no_signal_explains():
    prior = a_prior(size=10.0)
    phi, y, variance, t = a_turning_drive(prior, tilting, seconds=120.0)
    drive = effects_of_drive(prior, phi, y, variance, t, ways=WAYS)
    assert drive.period_s == pytest.approx(33.0, rel=0.08)  # the hypotheses are 7 % apart
    truth = np.sqrt(np.mean(np.sum(phi[:, WAYS] * tilting(t), axis=1) ** 2))
    assert np.sqrt(drive.hidden_nt2) == pytest.approx(truth, rel=0.35)


def test_a_field_that_jumps_at_no_period_widens_the_intervals():
    prior, rng = a_prior(size=10.0), np.random.default_rng(4)
    jumps = np.repeat(rng.normal(size=(40, 3)), 60, axis=0)
    phi, y, variance, t = a_turning_drive(prior, lambda t: 120.0 * jumps[: len(t)])
    mean, sd = followed(FollowedEffects(prior, ways=WAYS), phi, y, variance, t)
    late = t > 60
    assert 0.8 < np.mean(np.abs((mean - y)[late]) < 1.645 * sd[late]) < 0.98
