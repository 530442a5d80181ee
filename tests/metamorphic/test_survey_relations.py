"""Relations between fits: the field moves and turns with its survey, and its rows have no order."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from relations import SHIFT, doubled, later, moved, permuted, room, rotation, split, turned

from magtwin.errors import InputError
from magtwin.field.fit.check import check
from magtwin.field.fit.choice import CANDIDATES, CHOSEN, RMSE
from magtwin.field.fit.fit import fit, raster
from magtwin.field.grid import Grid
from magtwin.field.survey.axes import in_own_axes
from magtwin.field.survey.readings import Readings

SHARE = 0.1  # Largest difference of two fields, in standard deviations
METHODS = ("trilinear", "cubic", "gp", "harmonic")
# What is done to a survey, how far that turns it [deg] and moves it [m]
CHANGES = {
    "moved and permuted": (lambda survey: permuted(moved(survey)), 0, SHIFT),
    "doubled and turned by 90 deg": (lambda survey: turned(doubled(survey), 90), 90, 0 * SHIFT),
    "turned by 30 deg": (lambda survey: turned(survey, 30), 30, 0 * SHIFT),
    "cut in two on another clock": (lambda survey: split(later(survey)), 0, 0 * SHIFT),
}
QUARTERS = ("moved and permuted", "doubled and turned by 90 deg")


def drive(*, times=True):
    """Lanes 0.4 m apart along x and y, there and back: four headings."""
    rng, p, yaw = np.random.default_rng(1), [], []
    lanes = [((-1.1, y), (1.1, y)) for y in np.linspace(-0.9, 0.9, 5)]
    lanes += [((x, -0.9), (x, 0.9)) for x in np.linspace(-1.1, 1.1, 6)]
    for k, lane in enumerate(lanes):
        begin, end = np.array(lane[:: 1 if k % 2 else -1])
        steps = np.linspace(0, 1, 15)[:, None]
        p.append(begin + steps * (end - begin))
        yaw.append(np.full(15, np.arctan2(*(end - begin)[::-1])))
    p, yaw = np.concatenate(p), np.concatenate(yaw) + rng.normal(0, 0.02, 15 * len(lanes))
    at = p + rng.normal(0, 0.005, p.shape)
    b = room().magnitude_nt(at, yaw) + rng.normal(0, 15, len(p))
    return Readings(
        p_xy=p, yaw=yaw, b_nt=b, t=0.5 * np.arange(len(p)) if times else None, height_m=0.4, name="drive"
    )


def nodes():
    grid = Grid(
        origin_m=(-1.1, -0.9),
        cell_m=(0.44, 0.45),
        headings_rad=tuple(np.pi / 2 * np.arange(4)),
        rows=5,
        columns=6,
    )
    rng = np.random.default_rng(2)
    node = np.stack(np.unravel_index(np.arange(120), grid.shape), axis=-1)
    places, yaw = (part.reshape(120, -1).squeeze() for part in grid.poses())
    p = places + rng.normal(0, 0.01, places.shape)
    yaw = yaw + rng.normal(0, 0.03, 120)
    b = room().magnitude_nt(p, yaw) + rng.normal(0, 5, 120)
    return Readings(p_xy=p, yaw=yaw, b_nt=b, grid=grid, node=node, height_m=0.4, name="nodes")


SURVEYS = {"drive": drive, "drive without times": lambda: drive(times=False), "nodes": nodes}


@pytest.fixture(scope="session")
def fitted():
    """Fits by survey and method, each made once."""
    known = {}

    def of(name, method):
        if (name, method) not in known:
            known[name, method] = fit(SURVEYS[name](), method)
        return known[name, method]

    return of


def places():
    rng = np.random.default_rng(3)
    return rng.uniform((-1.0, -0.8), (1.0, 0.8), (200, 2)), rng.uniform(0, 2 * np.pi, 200)


def assert_same_field(model, other, degrees, shift, share=SHARE):
    """The fields differ by less than a share of their standard deviation."""
    p, yaw = places()
    angle = np.radians(degrees)
    value, variance = model.predict(p, yaw)
    again, spread = other.predict(p @ rotation(angle).T + shift, yaw + angle)
    assert_array_equal(np.isnan(again), np.isnan(value))
    known = np.isfinite(value)
    assert known.mean() > 0.9
    sd = np.sqrt(variance[known])
    assert np.all(np.abs(again - value)[known] < share * sd)
    assert_allclose(np.sqrt(spread[known]), sd, rtol=share)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("method", METHODS)
def test_the_field_of_a_drive_follows_it(fitted, method, change):
    function, degrees, shift = CHANGES[change]
    assert_same_field(fitted("drive", method), fit(function(drive()), method), degrees, shift)


@pytest.mark.parametrize("method", METHODS)
def test_without_times_the_order_of_a_drives_rows_does_not_matter(fitted, method):
    other = fit(permuted(drive(times=False)), method)
    assert_same_field(fitted("drive without times", method), other, 0, 0 * SHIFT)


@pytest.mark.parametrize("change", QUARTERS)
@pytest.mark.parametrize("method", METHODS)
def test_the_field_of_a_gridded_survey_follows_it(fitted, method, change):
    function, degrees, shift = CHANGES[change]
    assert_same_field(fitted("nodes", method), fit(function(nodes()), method), degrees, shift)


def test_the_choice_of_a_method_follows_the_survey(fitted):
    model = fitted("nodes", "auto")
    other = fit(permuted(doubled(turned(moved(nodes()), 90))), "auto")
    assert_same_field(model, other, 90, rotation(np.pi / 2) @ SHIFT)
    for name in (CHOSEN, CANDIDATES, RMSE):
        assert other.parameters[name] == model.parameters[name]


def test_vectors_and_the_earths_field_turn_with_the_survey():
    survey = drive()
    p = np.column_stack([survey.p_xy, np.full(len(survey), 0.4)])
    b = room().field_nt(p)
    c, s = np.cos(survey.yaw), np.sin(survey.yaw)
    body = np.column_stack([c * b[:, 0] + s * b[:, 1], c * b[:, 1] - s * b[:, 0], b[:, 2]])
    survey = survey.with_(b_nt=np.linalg.norm(body, axis=1), b_body_nt=body)
    survey = survey.with_(earth_nt=room().b_uniform_nt)
    known = {"hard_iron_nt": (0.0, 0.0, 0.0), "above": False}
    model, other = (fit(given, "harmonic", **known) for given in (survey, turned(survey, 30)))
    assert_same_field(model, other, 30, 0 * SHIFT)
    at = np.column_stack([places()[0], np.full(200, 0.6)])
    turn = np.eye(3)
    turn[:2, :2] = rotation(np.radians(30))
    (value, _), (again, _) = model.predict_vector(at), other.predict_vector(at @ turn.T)
    assert_allclose(again, value @ turn.T, rtol=0, atol=1e-3)
    uniform = [m.parameters["uniform field [nT]"] for m in (model, other)]
    assert_allclose(uniform[1], turn @ uniform[0], rtol=0, atol=0.2)  # each is rounded to 0.1 nT
    assert_allclose(model.field.field_nt(at), value, rtol=1e-9)


@pytest.mark.parametrize("method", ["cubic", "gp"])
def test_a_maps_nodes_and_headings_move_and_turn_by_quarters_with_the_survey(fitted, method):
    model = fitted("drive", method)
    field = raster(model, drive(), spacing_m=0.2 if method == "gp" else None)
    change = turned(moved(drive()), 90)
    other = raster(fit(change, method), change, spacing_m=0.2 if method == "gp" else None)
    assert other.grid.rows == field.grid.columns
    assert len(other.headings_rad) == len(field.headings_rad)
    p, yaw = places()
    value, sd = field.lookup_with_sd(p, yaw)
    again = other.lookup((p + SHIFT) @ rotation(np.pi / 2).T, yaw + np.pi / 2)
    known = np.isfinite(value)
    assert known.mean() > 0.8
    assert_array_equal(np.isnan(again), ~known)
    assert_allclose(((again - value) / sd)[known], 0, atol=SHARE)


def test_the_headings_of_a_map_are_those_of_the_survey_in_whole_degrees(fitted):
    survey = turned(drive(), 30)
    headings = np.degrees(raster(fit(survey, "cubic"), survey).headings_rad)
    step = 360 / len(headings)
    assert_allclose(headings, np.rint(headings), atol=1e-9)
    assert_allclose(np.mod(headings - 30 + step / 2, step) - step / 2, 0, atol=1.0)


def test_the_scores_of_a_check_do_not_depend_on_rows_place_or_turn():
    figures = [
        check(survey, ["cubic"], split="block").figures for survey in (drive(), turned(moved(drive()), 90))
    ]
    assert [(f.name, f.value) for f in figures[0]] == [(f.name, f.value) for f in figures[1]]


def test_a_bias_of_all_readings_is_a_bias_of_the_field(fitted):
    model = fitted("drive", "gp")
    other = fit(drive().with_(b_nt=drive().b_nt + 1_000.0), "gp")
    p, yaw = places()
    assert_allclose(other.predict(p, yaw)[0] - model.predict(p, yaw)[0], 1_000.0, atol=1e-3)


@pytest.mark.parametrize("degrees", [0, 90])
def test_a_refusal_names_the_heading_in_world(degrees):
    survey = nodes()
    survey = survey.with_(good=(survey.node[:, 0] != 2) | (survey.node[:, 1:].sum(axis=1) == 0))
    given = turned(survey, degrees) if degrees else survey
    with pytest.raises(InputError, match=f"heading {180 + degrees} deg has 1 nodes"):
        fit(given, "trilinear")


@pytest.mark.parametrize("method", ["gp", "harmonic"])
def test_a_fit_that_continues_from_another_has_its_axes(fitted, method):
    model = fitted("drive", method)
    part = drive().take(drive().p_xy[:, 0] < 0.6)
    assert in_own_axes(part)[1] != model.axes
    again = fit(part, method, like=model)
    assert again.axes == model.axes
    p, yaw = (part[places()[0][:, 0] < 0.3] for part in places())
    value, variance = model.predict(p, yaw)
    assert np.median(np.abs(again.predict(p, yaw)[0] - value) / np.sqrt(variance)) < 1.0


def test_runs_that_are_apart_in_time_stay_apart():
    survey = split(drive())
    apart = survey.with_(t=survey.t + 60.0 * survey.run)
    assert len(in_own_axes(survey)[0].runs) == 1
    assert in_own_axes(apart)[0].runs == ("first", "second")
