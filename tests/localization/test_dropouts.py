"""Localization of recordings whose magnetometer drops readings."""

import json

import numpy as np
import pytest

import magtwin as mt
from magtwin.figures.localization import draw_localization
from magtwin.localization.odometry import Odometry
from magtwin.localization.track import track
from magtwin.tasks.localizing import localization, thinned

WITHOUT_VERDICT = ("Consistent", "TOO CONFIDENT", "cautious", "ost.", "LOST", "better", "Better")


@pytest.fixture(scope="module")
def run():
    twin = mt.in_session(mt.open_twin("lab"), 2)
    return mt.simulate(twin, "lawnmower", seed=2, duration_s=60)


@pytest.fixture(scope="module")
def whole(run):
    return localization(run, "lab")


def dropped(run, lost):
    return run.with_columns(b_measured_nt=np.where(lost, np.nan, run["b_measured_nt"]))


def bursts(rows):
    """Dropouts of 0.15 s, 40 a minute."""
    lost = np.zeros(rows, bool)
    for first in np.random.default_rng(1).integers(rows, size=40):
        lost[first : first + 20] = True
    return lost


LOST = {
    "two of three": lambda rows: np.arange(rows) % 3 != 1,
    "bursts": bursts,
    "half at random": lambda rows: np.random.default_rng(0).random(rows) < 0.5,
}


@pytest.mark.parametrize(("lost", "flagged"), zip(LOST.values(), (False, True, True), strict=True), ids=LOST)
def test_dropouts_shorter_than_an_interval_cost_no_readings(run, whole, lost, flagged):
    lost = lost(run.rows)
    with_gaps = run.with_columns(flag_lost_lock=lost) if flagged else dropped(run, lost)
    made = localization(with_gaps, "lab")
    assert made.intervals == whole.intervals == 300
    assert made.read_share >= 299 / 300  # the first interval is the first row alone
    # errors of one drive by one filter, on other rows of the same readings: 25 % is their scatter
    assert made.scores.rmse_m == pytest.approx(whole.scores.rmse_m, rel=0.25)
    assert made.report().verdict.startswith("Better than dead reckoning: ")
    assert made.scores.bound_m["correlated"] == pytest.approx(whole.scores.bound_m["correlated"], rel=0.02)
    names = [figure.name for figure in made.report().figures]
    assert ("with a reading" in names) is (made.read_share < 1)


def test_a_run_without_a_reading_is_dead_reckoning_and_is_not_judged(run):
    made = localization(dropped(run, np.ones(run.rows, bool)), "lab")
    report = made.report()
    assert report.verdict.startswith("Dead reckoning: no row of the run holds a reading of the field")
    assert not any(word in report.verdict for word in WITHOUT_VERDICT)
    printed = json.loads(report.to_json())
    assert printed["verdict"] == report.verdict
    assert printed["figures"]["with_a_reading"] == 0
    assert printed["metadata"]["readings"].startswith("0 in ")
    judged = {"anees_per_state", "in_the_90_percent_ellipse", "flagged_lost", "bound_m", "bound_exact_map_m"}
    assert not judged & set(printed["figures"])
    assert "Dead reckoning: no row" in draw_localization(made).get_suptitle()
    error = np.sqrt(np.mean(np.sum((made.track.pose - made.truth)[:, :2] ** 2, axis=1)))
    assert printed["figures"]["position_error_rmse_m"] == pytest.approx(error)
    bare = run.select("b_measured_nt", "odom_p", "odom_q_xyzw")
    blind = localization(dropped(bare, np.ones(run.rows, bool)), "lab", prior="0,0,0.8")
    assert blind.report().verdict == report.verdict
    assert "Dead reckoning: no row" in draw_localization(blind).get_suptitle()


def test_a_reading_without_lock_is_not_given_to_the_method(run):
    class Listener(Odometry):
        def step(self, reading):
            heard.append(reading.b_nt)
            return super().step(reading)

    heard = []
    some = thinned(run, 5.0)
    lost = np.arange(some.rows) % 4 == 2
    result = localization(some.with_columns(flag_lost_lock=lost), "lab", method="odometry")
    track(Listener(), result.problem, result.run)
    np.testing.assert_array_equal(np.isnan(heard), lost)
    assert result.read_share == pytest.approx(1 - lost.mean())
