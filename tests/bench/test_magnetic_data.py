"""Cases from magnetic-data: on recordings made by formula, and on the real ones."""

import math

import magpylib as magpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.bench.magnetic_data import ARM_M, IRON_NT, magnetic_data_case, read_recording
from magtwin.errors import InputError
from magtwin.localization.bounds import bounds
from magtwin.localization.localizers import load_localizer
from magtwin.localization.readings import ONBOARD
from magtwin.localization.scores import score
from magtwin.localization.track import track

HELD_OUT = (2, 4)


def drive(seed, n=2500):
    """A drive of 50 s at 50 Hz over 3 x 3 m, either way round: positions [m] and headings [rad]."""
    rng = np.random.default_rng(seed)
    s = np.arange(n) / 50
    angle = rng.choice([-1, 1]) * 0.4 * s + rng.uniform(0, 6)
    far = 0.9 + 0.5 * np.sin(rng.uniform(0.1, 0.25) * s + rng.uniform(0, 6))
    p = far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    way = np.gradient(p, axis=0)
    return s + 3, p, np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five recordings above magnets of magpylib, by a robot with iron and a sensor behind its middle."""
    made = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(0)
    magnets = magpy.Collection(
        *(
            magpy.misc.Dipole(moment=rng.normal(0, 8, 3), position=(*rng.uniform(-2, 2, 2), -0.7))
            for _ in range(25)
        )
    )
    for number in range(1, 6):
        t, p, yaw = drive(number)
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.column_stack([p + ARM_M * np.column_stack([c, s]), np.zeros(len(p))])
        field = 1e6 * magnets.getB(at) + (18.0, 0.0, -42.0)
        ahead, left = 1e-3 * np.array(IRON_NT)
        field[:, :2] += np.column_stack([c * ahead - s * left, s * ahead + c * left])
        field += rng.normal(0, 0.1, field.shape)
        for what, table in (("time", t), ("loc", p), ("mag", field)):
            np.savetxt(made / f"{number}-{what}.csv", table, delimiter=",")
    return made


def test_a_case_tells_a_localizer_no_truth(folder):
    case = magnetic_data_case(folder, 2, 7)
    assert set(case.readings) <= set(ONBOARD)
    assert not case.readings.metadata
    assert case.truth.pose.shape == (case.readings.rows, 3)
    assert_allclose(np.diff(case.readings["t"]), 0.2, atol=0.021)
    assert_allclose(case.readings["odom_p"][0], 0)
    again = magnetic_data_case(folder, 2, 7)
    assert again.readings["odom_p"].tobytes() == case.readings["odom_p"].tobytes()
    assert again.problem.prior == case.problem.prior
    other = magnetic_data_case(folder, 2, 8)
    assert not np.array_equal(other.readings["odom_p"], case.readings["odom_p"])
    assert np.array_equal(other.readings["b_measured_nt"], case.readings["b_measured_nt"])


def test_a_robot_is_followed_on_a_map_of_other_drives(folder):
    # of these recordings the map is better than of real ones: only 0.1 uT of noise
    for number in HELD_OUT:
        case = magnetic_data_case(folder, number, 0)
        made = track(load_localizer("rbpf"), case.problem, case.readings)
        scores = score(made, case.truth.pose, bounds=bounds(case.problem, case.truth.pose, case.truth.t))
        assert scores.rmse_m < 0.1
        assert scores.rmse_m < 0.3 * scores.bound_m["dead_reckoning"]


def test_wrong_files_and_runs_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"run 3 is one of the map's \(1, 3, 5\)"):
        magnetic_data_case(folder, 3, 0)
    with pytest.raises(InputError, match=r"9-time.csv: no such file of magnetic-data"):
        read_recording(folder, 9)
    for what, columns in (("time", 1), ("loc", 2), ("mag", 3)):
        np.savetxt(tmp_path / f"1-{what}.csv", np.ones((5 + columns, columns)), delimiter=",")
    with pytest.raises(InputError, match=r"1-loc.csv: has shape \(7, 2\)"):
        read_recording(tmp_path, 1)


@pytest.mark.slow
def test_real_runs_are_followed_within_7_cm(real_data):
    squares, bound = [], []
    for number in HELD_OUT:
        for seed in range(3):
            case = magnetic_data_case(real_data / "magnetic-data", number, seed)
            algorithm = load_localizer("rbpf", {"kappa": 8.0, "map_correlated": 1.0})
            made = track(algorithm, case.problem, case.readings)
            limits = bounds(case.problem, case.truth.pose, case.truth.t)
            scores = score(made, case.truth.pose, bounds=limits)
            squares.append(scores.rmse_m**2)
            bound.append(scores.bound_m["correlated"] ** 2)
            assert not scores.diverged
    rmse = math.sqrt(np.mean(squares))
    assert rmse < 0.07
    assert rmse < 1.6 * math.sqrt(np.mean(bound))
