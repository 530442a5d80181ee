"""The error of interpolation between nodes, held against fields whose error is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.maps import lookup
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.lookup import LOOPS, warm_up
from magtwin.field.maps.map import AnomalyMap
from magtwin.report.verdict import Z_90

QUARTERS = np.radians([0.0, 90.0, 180.0, 270.0])
CELL = 0.25


def wavy(p, yaw, waves):
    """A field of plane waves of about 1.5 m, and a wave of 300 nT over heading."""
    phase = p @ waves[:2] + waves[2]
    return 45_000 + 400 * np.cos(phase).sum(axis=-1) + 300 * np.cos(yaw - 0.7)


def survey(noise=0.0, seed=0, headings=QUARTERS, **changes):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, 12)
    waves = np.vstack([4.2 * np.cos(angle), 4.2 * np.sin(angle), rng.uniform(0, 2 * np.pi, 12)])
    x, y = np.meshgrid(CELL * np.arange(25), CELL * np.arange(15))
    at = np.broadcast_to(np.stack([x, y], axis=-1), (len(headings), *x.shape, 2))
    values = wavy(at, np.asarray(headings)[:, None, None], waves)
    values = values + noise * rng.standard_normal(values.shape)
    variance = np.full(values.shape, noise**2)
    valid = np.ones(values.shape, bool)
    between = interpolation_error_nt2(values, valid, headings, variance)
    about = {"origin_m": (0, 0), "cell_m": (CELL, CELL), "headings_rad": headings, "valid": valid}
    given = {"values_nt": values, "variance_nt2": variance, "between_nt2": between, **about, **changes}
    return AnomalyMap(**given), waves


def poses(count=4_000, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform((0, 0), (6, 3.5), (count, 2)), rng.uniform(0, 2 * np.pi, count)


@pytest.mark.parametrize("noise", [0.0, 20.0])
def test_90_percent_intervals_of_a_survey_hold_90_percent_between_its_nodes(noise):
    held = []
    for seed in range(4):
        field, waves = survey(noise, seed)
        p, yaw = poses()
        value, sd = field.lookup_with_sd(p, yaw)
        held.append(np.mean(np.abs(value - wavy(p, yaw, waves)) < Z_90 * sd))
    assert 0.87 < np.mean(held) < 0.94


def test_at_the_nodes_their_own_variance_is_left():
    field, _ = survey(20.0)
    p, yaw = field.grid.poses()
    assert_allclose(field.lookup_with_sd(p, yaw)[1], 20.0)


def test_a_parabola_errs_by_an_eighth_of_its_second_difference():
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0))
    values = (40_000 + 8 * x**2 + 0 * y)[None]
    error = interpolation_error_nt2(values, np.ones(values.shape, bool), [0.0])
    assert_allclose(error[0], 4.0)  # (16 / 8)^2
    assert_array_equal(error[1], np.zeros(values.shape))


@pytest.mark.parametrize("degrees", [(0, 90, 180, 270), (0, 60, 120, 180, 240, 300), (0, 180)])
def test_a_wave_over_heading_errs_by_what_it_bulges_over_its_chord(degrees):
    headings = np.radians(degrees)
    values = (40_000 + 100 * np.cos(headings - 0.25 * np.pi))[:, None, None] * np.ones((1, 4, 4))
    error = interpolation_error_nt2(values, np.ones(values.shape, bool), headings)
    gap = headings[1] - headings[0]
    assert_allclose(error[1], (100 * (1 - np.cos(gap / 2))) ** 2 / 2, rtol=1e-9)


def test_masked_nodes_count_for_nothing_and_get_an_error_from_those_around():
    field, _ = survey()
    hole = field.valid.copy()
    hole[:, 6:9, 10:12] = False
    wild = np.where(hole, field.values_nt, np.nan)
    error = interpolation_error_nt2(wild, hole, QUARTERS)
    assert np.isfinite(error).all()
    assert_allclose(
        error[0, 0, 2, 2],
        interpolation_error_nt2(field.values_nt, field.valid, QUARTERS)[0, 0, 2, 2],
        rtol=0.2,
    )
    nothing = interpolation_error_nt2(wild, np.zeros(hole.shape, bool), QUARTERS)
    assert_array_equal(nothing, np.zeros((2, *hole.shape)))


@pytest.mark.parametrize("count", [10, 500])
@pytest.mark.parametrize(("outside", "whole"), [("nan", True), ("clamp", False)])
def test_all_in_one_pass_are_the_bytes_of_two_in_each_way(monkeypatch, count, outside, whole):
    monkeypatch.setattr(LOOPS, "code", None)
    monkeypatch.setattr(lookup, "SHARE", 100)
    valid = np.random.default_rng(5).random((4, 15, 25)) > 0.05
    field, _ = survey(5.0, valid=valid, **({} if whole else {"between_nt2": None}))
    p, yaw = poses(count)
    p[::7] += 2.0
    in_numpy = field.lookup_all(p, yaw, outside=outside)
    one_by_one = [field.lookup_all(a, b, outside=outside) for a, b in zip(p, yaw, strict=True)]
    warm_up()
    in_python = [np.array(column) for column in zip(*one_by_one, strict=True)]
    for got in (in_numpy, field.lookup_all(p, yaw, outside=outside), in_python):
        assert_array_equal(got[0], field.lookup(p, yaw, outside=outside))
        assert_array_equal(got[1], field.lookup_with_sd(p, yaw, outside=outside)[1])
        assert_array_equal(got[2], field.gradient(p, yaw, outside=outside))
    assert np.isnan(in_numpy[1]).sum() == np.isnan(in_numpy[0]).sum() > 0


def test_errors_between_nodes_are_refused_below_0_or_of_another_shape_and_dropped_without_a_variance():
    field, _ = survey()
    assert survey(variance_nt2=None)[0].between_nt2 is None
    for change, text in (
        ({"between_nt2": -field.between_nt2}, "between_nt2 of AnomalyMap must not be below 0"),
        ({"between_nt2": field.between_nt2[0]}, r"must have shape \(2, 4, 15, 25\)"),
    ):
        with pytest.raises(InputError, match=text):
            survey(**change)
