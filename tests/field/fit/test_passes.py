"""Passes of a drive, the noise between them, and the offset that one drive leaves open."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_gp import survey, truth

from magtwin.field.fit.fit import OFFSET_SD_NT, fit, grid_report, raster
from magtwin.field.fit.passes import by_pass
from magtwin.field.maps.map import OFFSET
from magtwin.field.maps.statistics import map_metadata
from magtwin.field.survey.readings import Readings
from magtwin.io.surveys.maps import _shared
from magtwin.localization.problem import Problem, SensorModel
from magtwin.report.verdict import Z_90

DRIFT_NT, WHITE_NT = 150.0, 10.0


def loops(turns=5, seed=0, drift=DRIFT_NT, rows=1500):
    """Loops over one floor, each a little off the others, with a disturbance that drifts along the way."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, rows)
    a = 2 * np.pi * turns * t
    reach = 0.45 + 0.35 * np.sin(2 * np.pi * 1.3 * turns * t + seed)
    p = np.column_stack([2 * reach * np.cos(a), 1.6 * reach * np.sin(a)])
    knots = rng.normal(0, drift, 10 * turns)
    drifts = np.interp(t, np.linspace(0, 1, len(knots)), knots)
    b = truth(p, np.zeros(rows)) + drifts + rng.normal(0, WHITE_NT, rows)
    return Readings(p_xy=p, yaw=np.zeros(rows), b_nt=b, t=t, name="loops", height_m=0.35)


@lru_cache(maxsize=4)
def fitted(method, drift=DRIFT_NT):
    return fit(loops(drift=drift), method)


def test_a_pass_ends_where_the_drive_comes_back():
    a = np.linspace(0, 6 * np.pi, 600, endpoint=False)  # three times round one circle
    there = np.column_stack([np.cos(a), np.sin(a)])
    drive = Readings(p_xy=there, yaw=a, b_nt=np.full(600, 4e4), t=np.arange(600.0))
    assert_array_equal(np.bincount(by_pass(drive).run), [200, 200, 200])
    order = np.random.default_rng(0).permutation(600)
    assert_array_equal(by_pass(drive.take(order)).run, by_pass(drive).run[order])


def test_a_robot_that_stands_or_drives_lanes_does_not_come_back():
    x = np.linspace(-2, 2, 100)
    lanes = np.concatenate(
        [np.column_stack([x[:: 1 - 2 * (k % 2)], np.full(100, 0.4 * k)]) for k in range(6)]
    )
    still = np.random.default_rng(0).normal(0, 1e-3, (3000, 2)) + lanes[-1]
    p = np.concatenate([lanes, still])
    drive = Readings(p_xy=p, yaw=np.zeros(len(p)), b_nt=np.full(len(p), 4e4), t=np.arange(float(len(p))))
    assert np.ptp(by_pass(drive).run) == 0


def test_runs_stay_apart_and_what_has_no_times_keeps_its_runs():
    one = loops()
    two = one.with_(run=np.arange(len(one)) // 750, runs=("a", "b"), t=one.t % 0.5)
    assert not set(by_pass(two).run[:750]) & set(by_pass(two).run[750:])
    for kept in (one.with_(t=None), survey()):
        assert by_pass(kept) is kept


@pytest.mark.parametrize("method", ["gp", "harmonic", "trilinear"])
def test_the_noise_of_a_drive_is_that_between_its_passes(method):
    assert 0.6 * DRIFT_NT < np.sqrt(fitted(method).noise_nt2) < 2 * DRIFT_NT


@pytest.mark.parametrize("method", ["gp", "harmonic"])
def test_another_drive_lies_in_the_intervals_of_the_first(method):
    other, model = loops(seed=3), fitted(method)
    value, variance = model.predict(other.p_xy, other.yaw)
    inside = np.abs(other.b_nt - value) <= Z_90 * np.sqrt(variance + model.noise_nt2)
    assert 0.8 <= inside.mean() <= 0.99


def test_a_map_of_one_drive_holds_an_offset_and_says_so():
    readings = loops()
    field = raster(fitted("gp"), readings, spacing_m=0.2)
    _, variance = fitted("gp").predict(*field.grid.poses())
    assert_allclose(field.variance_nt2, variance + OFFSET_SD_NT**2, rtol=0.05)
    assert field.parameters[OFFSET] == field.offset_sd_nt == OFFSET_SD_NT
    for report in (grid_report(field), map_metadata(field)):
        assert {f.name: f for f in report.figures}["offset sd"].value == OFFSET_SD_NT


def test_a_problem_takes_the_offset_of_a_map_once_as_a_bias():
    field = raster(fitted("gp"), loops(), spacing_m=0.2)
    problem = Problem(belief=field, extent=field.extent, sensor=SensorModel(offset_nt=300.0))
    for known in (problem, replace(problem, seed=1)):
        assert known.sensor.offset_nt == pytest.approx(np.hypot(300.0, OFFSET_SD_NT), rel=1e-12)
        assert known.belief.offset_sd_nt == 0
    assert_allclose(problem.belief.variance_nt2, field.variance_nt2 - OFFSET_SD_NT**2)
    assert field.relative().relative() == problem.belief


def test_a_fit_doubts_one_drive_and_one_that_never_comes_back():
    one, several = loops(), loops().with_(run=np.arange(1500) // 750, runs=("a", "b"))
    assert [doubt.split(":")[0] for doubt in _shared(one, "auto")] == ["one drive"]
    assert [doubt.split(":")[0] for doubt in _shared(several, "gp")] == ["readings of drives"]
    assert "never comes back" in _shared(one.take(np.arange(200)), "auto")[0]
    assert _shared(survey(), "auto") == _shared(one.with_(t=None), "auto") == []
