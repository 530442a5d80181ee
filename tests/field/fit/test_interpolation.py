"""Trilinear and cubic interpolation of surveys, on grids and scattered."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.fit.interpolation import fit_cubic, fit_trilinear
from magtwin.field.grid import Grid
from magtwin.field.survey.readings import Readings

FOUR = tuple(np.radians([0.0, 90.0, 180.0, 270.0]))
ROUNDING_NT = 1e-6
"""Values of 4e4 nT through sums of a few dozen terms: 1e-16 of them a term, generously."""


def grid_survey(field, *, headings=FOUR, cell=0.25, rows=7, columns=9, good=None):
    """Readings of a function of x, y and yaw on a grid, in shuffled order."""
    grid = Grid(
        origin_m=(-1.0, -0.75), cell_m=(cell, cell), headings_rad=headings, rows=rows, columns=columns
    )
    p, yaw = grid.poses()
    node = np.indices(grid.shape).reshape(3, -1).T
    order = np.random.default_rng(5).permutation(len(node))
    p, yaw = p.reshape(-1, 2)[order], yaw.ravel()[order]
    b = field(p[:, 0], p[:, 1], yaw)
    good = None if good is None else good(node[order])
    return Readings(p_xy=p, yaw=yaw, b_nt=b, grid=grid, node=node[order], good=good, name="made")


def scattered(field, *, count=400, seed=0, **more):
    rng = np.random.default_rng(seed)
    p, yaw = rng.uniform((-1, -0.75), (1, 0.75), (count, 2)), rng.uniform(0, 2 * np.pi, count)
    return Readings(p_xy=p, yaw=yaw, b_nt=field(p[:, 0], p[:, 1], yaw), **more)


def linear(x, y, yaw):
    return 42_000 + 1500 * x - 900 * y + 0 * yaw


def wave(x, y, yaw):
    return 42_000 + 1500 * x - 900 * y + 400 * np.cos(yaw) - 250 * np.sin(yaw) + 80 * np.cos(2 * yaw)


def cubic(x, y, yaw):
    return 42_000 + 900 * x**3 - 700 * x**2 * y**3 + 300 * y + 0 * yaw


def points(count=300, seed=2, inset=0.0):
    rng = np.random.default_rng(seed)
    corner = np.array([1.0, 0.75]) - inset
    return rng.uniform(-corner, corner, (count, 2)), rng.uniform(-10, 10, count)


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
def test_nodes_give_the_readings_to_the_last_digit_or_the_splines_rounding(fit):
    readings = grid_survey(wave)
    mean, _ = fit(readings).predict(readings.p_xy, np.asarray(FOUR)[readings.node[:, 0]])
    if fit is fit_trilinear:
        assert_array_equal(mean, readings.b_nt)
    assert_allclose(mean, readings.b_nt, rtol=0, atol=ROUNDING_NT)


def test_trilinear_reproduces_a_linear_field_between_nodes():
    p, yaw = points()
    mean, variance = fit_trilinear(grid_survey(linear)).predict(p, yaw)
    assert_allclose(mean, linear(*p.T, yaw), rtol=0, atol=ROUNDING_NT)
    assert_allclose(variance, 0, atol=ROUNDING_NT)  # a linear field is told exactly by its neighbours


def test_cubic_reproduces_a_bicubic_field_between_nodes():
    p, yaw = points()
    mean, _ = fit_cubic(grid_survey(cubic)).predict(p, yaw)
    assert_allclose(mean, cubic(*p.T, yaw), rtol=0, atol=ROUNDING_NT)


def test_trilinear_agrees_with_the_maps_own_lookup():
    from magtwin.field.survey.nodes import node_map

    readings = grid_survey(lambda x, y, yaw: cubic(x, y, yaw) + 300 * np.cos(yaw))
    p, yaw = points()
    mean, _ = fit_trilinear(readings).predict(p, yaw)
    assert_allclose(mean, node_map(readings).lookup(p, yaw), rtol=0, atol=ROUNDING_NT)


def test_cubic_is_smooth_in_heading_where_the_last_layer_meets_the_first():
    model = fit_cubic(grid_survey(wave))
    step = 1e-4
    at = [model.predict([0.1, 0.2], k * step)[0] for k in (-2, -1, 0, 1, 2)]
    before, after = (at[1] - at[0]) / step, (at[4] - at[3]) / step
    assert (
        abs(after - before) < 1.0
    )  # a second derivative of 2,000 nT/rad^2 over 3 steps; linear: a jump of 150


def test_cells_at_a_bad_node_are_unknown_and_filling_bridges_them():
    def bad(node):
        return ~((node[:, 1] == 3) & (node[:, 2] == 4))

    readings = grid_survey(linear, good=bad)
    middle, beside, far = [0.0, 0.0], [0.1, 0.1], [0.6, 0.6]
    for fit in (fit_trilinear, fit_cubic):
        mean, variance = fit(readings).predict([middle, beside, far], 0.0)
        assert_array_equal(np.isnan(mean), [True, True, False])
        assert_array_equal(np.isnan(variance), np.isnan(mean))
        filled, _ = fit(readings, fill=True).predict([middle, beside, far], 0.0)
        assert_allclose(filled, [linear(x, y, 0) for x, y in (middle, beside, far)], rtol=0, atol=1e-3)


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
def test_nothing_is_known_off_the_grid_nor_at_nan(fit):
    for readings in (grid_survey(wave), scattered(wave)):
        mean, variance = fit(readings).predict([[5.0, 0.0], [np.nan, 0.0], [0.0, 0.0]], [0.0, 0.0, np.nan])
        assert np.isnan(mean).all()
        assert np.isnan(variance).all()


def test_the_variance_is_none_at_nodes_and_covers_nine_in_ten_between_them():
    def rough(x, y, yaw):
        return 42_000 + 800 * np.sin(5 * x + 1) * np.cos(4 * y) + 0 * yaw

    model = fit_trilinear(grid_survey(rough, rows=15, columns=17))
    rng = np.random.default_rng(0)
    p = rng.uniform((-1, -0.75), (3, 2.75), (4000, 2))
    mean, variance = model.predict(p, 0.0)
    inside = np.abs(mean - rough(*p.T, 0.0)) <= 1.645 * np.sqrt(variance)
    assert 0.8 <= inside.mean() <= 0.99
    assert_allclose(model.predict([-1.0, -0.75], 0.0)[1], 0, atol=ROUNDING_NT)


def test_scattered_readings_give_back_the_wave_over_heading():
    model = fit_trilinear(scattered(lambda x, y, yaw: wave(0 * x, 0 * y, yaw), count=600))
    assert_allclose(model.wave_nt, [400, -250, 80, 0], rtol=0, atol=1e-6)
    p, yaw = points(inset=0.2)
    assert_allclose(model.predict(p, yaw)[0], wave(0, 0, yaw), rtol=0, atol=1e-5)


def test_scattered_readings_of_one_heading_have_no_wave():
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (200, 2))
    model = fit_cubic(Readings(p_xy=p, yaw=np.zeros(200), b_nt=linear(*p.T, 0.0)))
    assert_array_equal(model.wave_nt, 0)
    at, yaw = points(inset=0.3)
    assert_allclose(model.predict(at, yaw)[0], linear(*at.T, yaw), rtol=0, atol=1e-3)


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (
            {"good": np.arange(12) < 3},
            "3 good readings of 12 in made, 9 are masked as stuck",
        ),
        ({"good": np.zeros(12, bool)}, "0 good readings"),
        ({"b_nt": np.full(12, 42_000.0)}, "are 42000 nT: a stuck sensor"),
        ({"p_xy": np.column_stack([np.arange(12.0), 2 * np.arange(12.0)])}, "lie on one line"),
        ({"p_xy": np.zeros((12, 2))}, "lie on one line"),
    ],
)
def test_readings_that_make_no_map_are_refused(fit, rows, said):
    rng = np.random.default_rng(0)
    given = {"p_xy": rng.uniform(size=(12, 2)), "yaw": np.zeros(12), "b_nt": 4e4 + rng.uniform(size=12)}
    with pytest.raises(InputError, match=said):
        fit(Readings(**{**given, **rows}, name="made"))


def test_a_heading_without_three_good_nodes_is_refused_by_name():
    def good(node):
        return (node[:, 0] != 2) | ((node[:, 1] == 0) & (node[:, 2] < 2))

    with pytest.raises(InputError, match="heading 180 deg has 2 nodes"):
        fit_trilinear(grid_survey(wave, good=good))


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
def test_a_nodes_variance_is_what_headings_off_the_nominal_ones_leave_in_it(fit):
    even = grid_survey(lambda x, y, yaw: 41_000 + 400 * np.cos(yaw))
    off = np.random.default_rng(2).normal(0, 0.1, len(even))
    readings = even.with_(yaw=even.yaw + off, b_nt=41_000 + 400 * np.cos(even.yaw + off))
    model = fit(readings)
    mean, variance = model.predict(readings.p_xy, even.yaw)
    error = np.mean((mean - even.b_nt) ** 2)
    assert error > 100
    assert model.noise_nt2 == pytest.approx(error, rel=0.05)
    assert_allclose(variance.mean(), model.noise_nt2, rtol=1e-6)
    close = np.abs(mean - even.b_nt) <= 2 * np.sqrt(variance)
    assert close.mean() > 0.95


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
def test_the_intervals_hold_the_field_itself_at_nodes_and_between_them_whatever_the_noise(fit):
    def rough(x, y, yaw):
        return 42_000 + 500 * np.sin(4 * x + 1) * np.cos(3 * y) + 300 * np.cos(yaw)

    rng = np.random.default_rng(3)
    for noise in (5.0, 150.0):
        even = grid_survey(rough, rows=15, columns=17)
        model = fit(even.with_(b_nt=even.b_nt + noise * rng.standard_normal(len(even))))
        assert np.sqrt(model.noise_nt2) == pytest.approx(noise, rel=0.2)
        nodes, between = even.p_xy, rng.uniform((-1, -0.75), (3, 2.75), (4000, 2))
        for p, least in ((nodes, 0.85), (between, 0.8)):
            yaw = rng.choice(FOUR, len(p))
            mean, variance = model.predict(p, yaw)
            inside = np.mean(np.abs(mean - rough(*p.T, yaw)) <= 1.645 * np.sqrt(variance))
            assert least <= inside <= 0.99, (noise, inside)


@pytest.mark.parametrize("fit", [fit_trilinear, fit_cubic])
def test_places_of_scattered_readings_err_as_the_readings_of_the_runs_through_them(fit):
    rng = np.random.default_rng(4)
    runs, count = 4, 600
    p = rng.uniform((-1, -0.75), (1, 0.75), (count, 2))
    p, run = np.tile(p, (runs, 1)), np.repeat(np.arange(runs), count)
    b = linear(*p.T, 0.0) + 100 * rng.standard_normal(len(p))
    model = fit(Readings(p_xy=p, yaw=np.zeros(len(p)), b_nt=b, run=run, runs=tuple("abcd"), name="made"))
    assert np.sqrt(model.noise_nt2) == pytest.approx(100, rel=0.25)
    mean, variance = model.predict(model.p_xy, 0.0)
    assert variance.mean() == pytest.approx(model.noise_nt2 / runs / np.sum(model.b_nt > 0) * count, rel=0.25)
    inside = np.abs(mean - linear(*model.p_xy.T, 0.0)) <= 1.645 * np.sqrt(variance)
    assert 0.85 <= inside.mean() <= 0.99
