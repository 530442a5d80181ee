"""The check on readings that were left out, and what it says of the real surveys."""

import numpy as np
import pytest
from test_fit import drive
from test_gp import survey

from magtwin.errors import InputError
from magtwin.field.fit.check import check
from magtwin.field.fit.interpolation import fit_trilinear
from magtwin.field.fit.methods import METHODS


class Told:
    """A method that knows the readings' mean, off by 100 nT, with an sd that it is told."""

    method, parameters, noise_nt2 = "told", {}, 0.0

    def __init__(self, readings, sd):
        self.mean, self.sd = readings.b_nt.mean(), sd

    def predict(self, p_xy, yaw):
        return np.full(len(p_xy), self.mean + 100), np.full(len(p_xy), self.sd**2)


def figures(report):
    return {f.name: f.value for f in report.figures}


def flat(spread=10.0):
    readings = survey()
    return readings.with_(b_nt=42_000 + spread * np.random.default_rng(0).standard_normal(len(readings)))


def test_errors_coverage_and_score_are_those_of_a_method_whose_errors_are_known(monkeypatch):
    monkeypatch.setitem(METHODS._loaded, "told", lambda readings: Told(readings, 100.0))
    found = figures(check(flat(), ["told"], split="checkerboard"))
    assert abs(found["told RMSE"] - 100.5) < 1  # sqrt(100^2 + 10^2)
    assert abs(found["told MAE"] - 100) < 2
    assert found["told coverage"] == 100  # 100 lies in 1.645 x 100
    assert abs(found["told log score"] - (-0.5 * np.log(2 * np.pi * 100**2) - 0.505)) < 0.02
    assert found["told predicted"] == 100
    monkeypatch.setitem(METHODS._loaded, "told", lambda readings: Told(readings, 50.0))
    assert figures(check(flat(), ["told"]))["told coverage"] < 5


def test_the_naive_mean_is_always_there_and_is_the_training_mean():
    found = figures(check(flat(), ["trilinear"]))
    assert 8 < found["naive RMSE"] < 12
    assert 85 < found["naive coverage"] < 95
    assert "naive RMSE at 90 deg" in found


def test_a_checkerboard_leaves_nodes_out_at_all_headings_and_predicts_each_once(monkeypatch):
    seen = []

    def spy(readings, *, fill=False):
        seen.append(readings)
        return fit_trilinear(readings, fill=fill)

    monkeypatch.setitem(METHODS._loaded, "trilinear", spy)
    readings = survey()
    report = check(readings, ["trilinear"], split="checkerboard")
    parity = [np.unique(part.node[:, 1:].sum(axis=1) % 2).tolist() for part in seen]
    assert parity == [[1], [0]]
    assert figures(report)["readings predicted"] == len(readings)


def test_runs_are_left_out_one_at_a_time():
    readings = drive(count=300)
    run = (readings.p_xy[:, 0] > 0).astype(int)  # two halves of the floor: no reading near the other half's
    readings = readings.with_(run=run, runs=("west", "east"))
    found = figures(check(readings, ["trilinear"], split="run"))
    assert (found["readings predicted"], found["turns"]) == (300, 2)


def test_a_heading_is_left_out_whole_and_told_by_the_others(monkeypatch):
    seen = []

    def spy(readings, *, fill=False):
        seen.append(readings)
        return fit_trilinear(readings, fill=fill)

    monkeypatch.setitem(METHODS._loaded, "trilinear", spy)
    readings = survey(rows=4, columns=4)
    found = figures(check(readings, ["trilinear"], split="heading"))
    assert [np.degrees(part.grid.headings_rad).round().tolist() for part in seen] == [
        [90, 180, 270],
        [0, 180, 270],
        [0, 90, 270],
        [0, 90, 180],
    ]
    assert found["readings predicted"] == len(readings)
    assert found["trilinear predicted"] == 100
    with pytest.raises(InputError, match="split 'heading' needs the nodes of a gridded survey"):
        check(drive(count=50), ["trilinear"], split="heading")


def test_a_split_that_the_survey_does_not_allow_is_refused():
    with pytest.raises(InputError, match="needs the nodes of a gridded survey"):
        check(drive(count=50), ["trilinear"], split="checkerboard")
    with pytest.raises(InputError, match="leaves nothing out"):
        check(drive(count=50), ["trilinear"], split="run")
    with pytest.raises(InputError, match="no split 'runs'; did you mean 'run'"):
        check(drive(count=50), ["trilinear"], split="runs")
    with pytest.raises(InputError, match="no method 'kubic'"):
        check(drive(count=50), ["kubic"])
    with pytest.raises(InputError, match="each once"):
        check(drive(count=50), ["cubic", "cubic"])


@pytest.fixture(scope="module")
def real_survey(real_data):
    from magtwin.field.survey.folder import read_grid

    readings = read_grid(real_data / "aprilab" / "maps")
    stuck = (readings.b_nt > 35_544) & (readings.b_nt < 35_751)  # the level that FACTS reads off the files
    return readings.with_(good=~stuck)


def test_on_the_real_survey_a_gp_errs_a_quarter_of_what_trilinear_does(real_survey):
    found = figures(check(real_survey, ["trilinear", "cubic", "gp"]))
    assert found["trilinear predicted"] > 98
    assert 700 < found["trilinear RMSE"] < 760
    assert 430 < found["cubic RMSE"] < 490
    assert found["gp RMSE"] < 200
    assert 85 <= found["gp coverage"] <= 96
    assert 85 <= found["trilinear coverage"] <= 95
    assert found["gp log score"] > found["cubic log score"] > found["trilinear log score"]
