"""Drawn places and drives: what is drawn by whom, that robots touch nothing, and fields that are fields."""

import hashlib
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from magtwin.bench.drawn import PLACES, RADIUS_M, drawn_case, place
from magtwin.bench.row import bounds_of, make_case
from magtwin.bench.suite import Scenario, load_suite
from magtwin.errors import InputError

TRACKING = Scenario(name="tracking", source="drawn", map_error_nt=150.0)


def test_there_are_ten_rooms_of_4_to_60_m_a_warehouse_and_an_outdoor_course():
    sizes = [max(kind.size) for kind in PLACES if kind.name not in ("warehouse", "outdoor course")]
    assert len(sizes) == 10
    assert (min(sizes), max(sizes)) == (4, 60)
    assert {"warehouse", "outdoor course"} < {kind.name for kind in PLACES}


@pytest.mark.parametrize("number", range(len(PLACES)))
def test_a_robot_keeps_clear_of_what_stands_there_and_follows_its_heading(number):
    here = place(number, "")
    for seed in (number + 120, number + 1200):
        case = drawn_case(TRACKING, seed)
        pose = case.truth.pose
        nodes = (pose[:, :2] - here.field.origin_m) / here.kind.cell
        columns, rows = np.rint(nodes).astype(int).T
        assert here.clear_m[rows, columns].min() >= RADIUS_M - here.kind.cell
        step, yaw = np.diff(pose[:, :2], axis=0), np.unwrap(pose[:, 2])
        speed = np.hypot(*step.T) * 5
        assert 0.5 * here.kind.speed[0] < np.median(speed) < 1.3 * here.kind.speed[1]
        along = np.arctan2(step[:, 1], step[:, 0]) - (yaw[1:] + yaw[:-1]) / 2
        assert np.median(np.abs(np.sin(along))) < 0.02
        assert np.std(here.field.values_nt) == pytest.approx(here.kind.sd_nt, rel=0.2)


def test_the_field_is_that_of_sources_below_it():
    """On a finer grid, as above a sheet of dipoles: Laplace's equation for each part of the field."""
    from magtwin.bench.drawn import _field

    sheet = np.zeros((3, 81, 81))
    sheet[:, 40, 40] = (0.3, -0.2, 1.0)
    low, high, middle = (_field((sheet,), (z,), 0.05) for z in (0.75, 0.85, 0.80))
    d2z = (low + high - 2 * middle) / 0.05**2
    inner = slice(20, 61)
    d2 = sum(np.gradient(np.gradient(middle, 0.05, axis=k), 0.05, axis=k) for k in (0, 1))
    off = (d2 + d2z)[inner, inner]
    assert np.abs(off).max() < 0.08 * np.abs(d2z[inner, inner]).max()
    curl = np.gradient(middle[..., 1], 0.05, axis=1) - np.gradient(middle[..., 0], 0.05, axis=0)
    assert np.abs(curl[inner, inner]).max() < 0.02 * np.abs(np.gradient(middle[..., 0], 0.05, axis=0)).max()


def test_two_runs_of_a_place_are_bounds_apart_at_equal_times():
    cases = [drawn_case(TRACKING, 2 + len(PLACES) * k) for k in range(8)]
    bound = bounds_of(cases[0]).rms("correlated", np.ones(len(cases[0].truth.t), bool))
    for a, b in combinations(cases, 2):
        apart = np.hypot(*(a.truth.pose - b.truth.pose)[:, :2].T)
        assert np.sqrt(np.mean(apart**2)) > 3 * bound


def test_a_run_is_drawn_from_its_seed_and_the_salt_and_held_out_places_are_others():
    one, again = drawn_case(TRACKING, 7), drawn_case(TRACKING, 7)
    np.testing.assert_array_equal(one.truth.pose, again.truth.pose)
    np.testing.assert_array_equal(one.readings["b_measured_nt"], again.readings["b_measured_nt"])
    salted = drawn_case(TRACKING, 7, "00ff")
    assert salted.truth.field.values_nt.shape != one.truth.field.values_nt.shape
    assert drawn_case(replace(TRACKING, places=("office",)), 7).problem.belief.name == "office"
    with pytest.raises(InputError, match="did you mean 'office'"):
        drawn_case(replace(TRACKING, places=("ofice",)), 7)


def test_the_salt_is_that_whose_hash_the_suite_has(tmp_path):
    digest = hashlib.sha256(bytes.fromhex("00ff")).hexdigest()
    file = tmp_path / "own.toml"
    text = f'name = "own"\nsalt_sha256 = "{digest}"\n[[scenario]]\nname = "a"\nsource = "drawn"\nruns = 1\n'
    file.write_text(text)
    suite = load_suite(file)
    for salt in ("", "0f", "salt"):
        with pytest.raises(InputError, match="a salt that the next release tells"):
            suite.limited(seeds="held-out", salt=salt)
    with pytest.raises(InputError, match="a salt is for held-out seeds"):
        suite.limited(salt="00ff")
    held = suite.limited(seeds="held-out", salt="00ff")
    assert held.sha256 != suite.sha256 == suite.limited().sha256
    assert "00ff" not in str(held.sha256)
    public, secret = (make_case(each, each.scenario[0], 0) for each in (suite, held))
    assert public.problem.extent != secret.problem.extent


@pytest.mark.parametrize("name", ["standard", "standard-1"])
def test_both_versions_of_the_standard_suite_have_the_same_scenarios(name):
    names = "exact tracking trilinear heading global kidnapped stale stuck offset session"
    assert list(load_suite(name).scenarios) == names.split()


def test_rows_of_version_1_are_of_the_suite_that_it_was():
    known = "8f2e5e232548e7a667795c79ade80a61ea0add57ea58fc10ea84885cba681c83"
    assert load_suite("standard-1").sha256 == known
