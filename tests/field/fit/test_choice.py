"""The choice of a method by readings left out, and mixtures of two."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_fit import drive
from test_gp import survey

from magtwin.field.fit import choice
from magtwin.field.fit.choice import CANDIDATES, CHOSEN, RMSE, SCORE, fit_auto
from magtwin.field.fit.fit import fit
from magtwin.field.fit.methods import METHODS, FittedModel
from magtwin.field.fit.mixture import Mixture, mixed


class Told(FittedModel):
    """Predicts a constant with a given sd."""

    def __init__(self, method, value, sd, noise=0.0):
        self.method, self.value, self.sd = method, value, sd
        self.noise_nt2, self.parameters = noise, {"value": value}

    def predict(self, p_xy, yaw):
        shape = np.broadcast_shapes(np.shape(p_xy)[:-1], np.shape(yaw))
        return np.full(shape, self.value), np.full(shape, self.sd**2)


@pytest.fixture(scope="module")
def chosen():
    readings = survey(rows=6, columns=7)
    return readings, fit_auto(readings)


def test_the_best_at_left_out_readings_is_fitted_to_all_of_them(chosen):
    readings, model = chosen
    told = model.parameters
    names, score, rmse = told[CANDIDATES], told[SCORE], told[RMSE]
    assert {"harmonic", "harmonic, layer above", "gp poisson", "gp matern"} <= set(names)
    assert len(names) == len(score) == len(rmse)
    assert len([name for name in names if "+" in name]) == 1
    finalists = [score[k] for k, name in enumerate(names) if "+" in name or name == told[CHOSEN]]
    assert max(finalists) == score[names.index(told[CHOSEN])]
    assert rmse[names.index(told[CHOSEN])] < 100
    assert model.parameters["readings"] == readings.good.sum()


def test_a_choice_is_repeated_to_the_last_bit(chosen):
    readings, model = chosen
    again = fit_auto(readings)
    assert again.parameters == model.parameters
    for a, b in zip(*(m.predict(readings.p_xy, readings.yaw) for m in (again, model)), strict=True):
        assert_array_equal(a, b)


def test_few_readings_get_a_harmonic_fit():
    readings = drive(30)
    model = fit(readings, "auto")
    assert model.method == "harmonic"
    assert "too few readings" in model.parameters[CHOSEN]


def test_vectors_are_tried_with_and_without_directions():
    readings = survey()
    body = np.column_stack([0 * readings.b_nt, 0 * readings.b_nt, -readings.b_nt])
    names = [c.name for c in choice._candidates(readings.with_(b_body_nt=body), None, "matern")]
    assert "harmonic of magnitudes" in names
    assert "gp poisson" not in names


def test_a_method_that_refuses_the_survey_is_left_out_of_the_choice(monkeypatch):
    from magtwin.errors import InputError

    def refuse(readings, *, earth_nt=None, above=None, kernel=None, fill=False):
        raise InputError("no")

    monkeypatch.setitem(METHODS._loaded, "harmonic", refuse)
    model = fit_auto(survey(rows=5, columns=5), kernel="matern")
    assert model.parameters[CHOSEN] == "gp matern"
    monkeypatch.setitem(METHODS._loaded, "gp", refuse)
    monkeypatch.setitem(METHODS._loaded, "trilinear", refuse)
    with pytest.raises(InputError, match="no"):
        fit_auto(survey(rows=5, columns=5))


def test_a_mixture_is_the_weighted_mean_with_the_sd_of_fully_correlated_errors():
    mean, variance = mixed(
        (0.25, 0.75), [np.array([100.0]), np.array([200.0])], [np.array([16.0]), np.array([4.0])]
    )
    assert_allclose(mean, 175)
    assert_allclose(variance, (0.25 * 4 + 0.75 * 2) ** 2)
    model = Mixture.of([Told("one", 100.0, 4.0, 9.0), Told("two", 200.0, 2.0, 1.0)], (0.25, 0.75))
    value, variance = model.predict(np.zeros((3, 2)), np.zeros(3))
    assert_allclose(value, 175)
    assert_allclose(variance, 6.25)
    assert_allclose(model.noise_nt2, (0.25 * 3 + 0.75) ** 2)
    assert (model.method, model.field) == ("one + two", None)
    assert model.parameters == {"value": 100.0, "two value": 200.0, "weights": [0.25, 0.75]}
    value, _ = model.predict_nodes(np.zeros((2, 4, 2)), 0.5)
    assert value.shape == (2, 4)
