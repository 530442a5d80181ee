import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.learn.models.linear import FALLBACK_PENALTY, fit_linear

NAMES = ("yaw_sin", "odom_v_x", "battery_v")


def rows(seed=0, groups=8, each=100, noise_nt=5.0):
    """A linear disturbance; the battery tells recordings apart and nothing else."""
    rng = np.random.default_rng(seed)
    of = np.repeat(np.arange(groups), each)
    x = np.column_stack([rng.normal(size=(len(of), 2)), rng.normal(15, 0.3, groups)[of]])
    y = 300 + 50 * x[:, 0] - 20 * x[:, 1] + rng.normal(0, noise_nt, len(of))
    return x, y, of


@pytest.fixture(scope="module")
def fitted():
    x, y, of = rows()
    return fit_linear(x, y, of, features=NAMES)


def test_without_penalty_it_is_least_squares():
    x, y, of = rows()
    model = fit_linear(x, y, of, features=NAMES, penalty=0.0).model
    peer = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), y, rcond=None)[0]
    assert_allclose(model.coefficients_nt / model.inputs.scale, peer[:3], rtol=1e-9)
    assert_allclose(model.predict(x)[0], np.column_stack([x, np.ones(len(x))]) @ peer, rtol=1e-9)


def test_a_penalty_is_that_of_the_normal_equations_and_leaves_the_mean_alone():
    x, y, of = rows()
    model = fit_linear(x, y, of, features=NAMES, penalty=0.5).model
    z = model.inputs.scaled(x)
    peer = np.linalg.solve(z.T @ z + 0.5 * len(z) * np.eye(3), z.T @ (y - y.mean()))
    assert_allclose(model.coefficients_nt, peer, rtol=1e-9)
    assert model.constant_nt == pytest.approx(y.mean())


def test_an_input_that_only_tells_recordings_apart_is_held_down_by_leaving_recordings_out():
    rng, (x, y, of) = np.random.default_rng(1), rows(groups=6)
    y = y + rng.normal(0, 300, 6)[of]  # each recording has an offset, which six levels of charge can mimic
    by_recording = fit_linear(x, y, of, features=NAMES).model
    by_row = fit_linear(x, y, np.arange(len(y)), features=NAMES).model
    assert by_recording.penalty > 10 * by_row.penalty
    assert abs(by_recording.coefficients_nt[2]) < 0.7 * abs(by_row.coefficients_nt[2])


def test_what_is_held_out_is_what_a_fit_without_the_recording_says():
    x, y, of = rows()
    whole = fit_linear(x, y, of, features=NAMES, penalty=1e-3)
    without = of != 3
    inputs = whole.model.inputs
    part = fit_linear(x[without], y[without], of[without], features=NAMES, penalty=1e-3, inputs=inputs)
    assert_allclose(whole.held_out_nt[~without], part.model.predict(x[~without])[0], rtol=1e-6)


def test_one_recording_leaves_nothing_to_cross_validate():
    x, y, _ = rows(groups=1)
    assert fit_linear(x, y, np.zeros(len(y), int), features=NAMES).model.penalty == FALLBACK_PENALTY


def test_rows_where_the_map_is_poorly_known_count_less_where_that_helps():
    rng, (x, y, of) = np.random.default_rng(2), rows(each=60)
    sd = np.where(rng.random(len(y)) < 0.5, 300.0, 0.0)
    y = y + sd * rng.normal(size=len(y))
    found = {w: fit_linear(x, y, of, features=NAMES, sd=sd, weighting=w).model for w in ("none", "auto")}
    off = {w: np.abs(m.coefficients_nt / m.inputs.scale - [50, -20, 0])[:2].max() for w, m in found.items()}
    assert (found["none"].weighted, found["auto"].weighted) == (False, True)
    assert off["auto"] < 0.5 * off["none"]
    weight = fit_linear(x, y, of, features=NAMES, sd=sd).weight
    assert weight[sd > 0].max() < 0.1 < weight[sd == 0].min() == 1.0


def test_a_rows_bytes_do_not_depend_on_its_neighbours_and_nan_stays_in_its_row(fitted):
    x = rows(seed=3)[0]
    x[7, 1] = np.nan
    mean, sd = fitted.model.predict(x)
    for part in (slice(5, 6), slice(3, 90)):
        assert_array_equal(fitted.model.predict(x[part]), (mean[part], sd[part]))
    assert np.flatnonzero(np.isnan(mean)).tolist() == np.flatnonzero(np.isnan(sd)).tolist() == [7]


def test_its_intervals_hold_on_recordings_with_offsets_of_their_own():
    x, y, of = rows(groups=40, each=40)
    y = y + np.random.default_rng(6).normal(0, 80, 40)[of]
    seen = of < 12
    model = fit_linear(x[seen], y[seen], of[seen], features=NAMES).model
    mean, sd = model.predict(x[~seen])
    assert np.mean(np.abs(mean - y[~seen]) < 1.645 * sd) == pytest.approx(0.9, abs=0.08)


def test_a_label_that_never_varies_is_refused():
    x, _, of = rows()
    with pytest.raises(InputError, match="the label is 7 nT in every training row; there is nothing to"):
        fit_linear(x, np.full(len(x), 7.0), of, features=NAMES)
