"""The front door of all methods, and the maps that come out of it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_gp import survey, truth

from magtwin.errors import InputError
from magtwin.field.fit.fit import fit, grid_report, raster
from magtwin.field.fit.methods import METHODS, map_method
from magtwin.field.survey.readings import Readings

QUICK = ("trilinear", "cubic", "gp")


def drive(count=700, seed=0):
    rng = np.random.default_rng(seed)
    p = rng.uniform((-1.0, -0.8), (1.0, 0.8), (count, 2))
    yaw = rng.uniform(0, 2 * np.pi, count)
    return Readings(
        p_xy=p, yaw=yaw, b_nt=truth(p, yaw) + rng.normal(0, 10, count), name="drive", height_m=0.35
    )


def test_a_trilinear_raster_of_a_grid_is_the_survey_to_the_last_digit():
    good = np.ones(224, bool)
    good[[5, 60, 61]] = False
    readings = survey().with_(
        good=good, source="a.csv sha256:0", licence="MIT", created="2026-01-02", height_m=0.3
    )
    field = raster(fit(readings, "trilinear"), readings)
    assert field.grid == readings.grid
    assert_array_equal(field.values_nt[tuple(readings.node[good].T)], readings.b_nt[good])
    assert_array_equal(field.valid[tuple(readings.node.T)], good)
    assert (field.method, field.name, field.source) == ("trilinear", "made", "a.csv sha256:0")
    assert (field.licence, field.created, field.height_m) == ("MIT", "2026-01-02", 0.3)
    assert field.variance_nt2 is not None


@pytest.mark.parametrize("method", ["cubic", "gp"])
def test_a_smooth_raster_is_as_fine_as_its_fit_needs(method):
    readings = survey()
    model = fit(readings, method)
    field = raster(model, readings)
    assert 0.05 <= field.cell_m[0] <= 0.15
    assert 4 <= len(field.headings_rad) <= 24
    assert_allclose(np.diff(field.headings_rad), 2 * np.pi / len(field.headings_rad))
    assert_allclose(field.extent, readings.grid.extent, rtol=1e-12)
    p, yaw = field.grid.poses()
    known = field.valid
    assert known.mean() > 0.95
    assert np.sqrt(np.mean((field.values_nt[known] - truth(p, yaw)[known]) ** 2)) < 60
    figures = {f.name: f for f in grid_report(field).figures}
    assert figures["node spacing"].value == pytest.approx(max(field.cell_m), abs=1e-4)
    assert "errs by" in figures["headings apart"].note


def test_a_harmonic_raster_is_the_fit_at_its_nodes_and_on_fine_grids_nearly_its_sd():
    readings = drive()
    model = fit(readings, "harmonic")
    ratio = []
    for spacing in (0.075, 0.05):
        field = raster(model, readings, spacing_m=spacing, headings_rad=[0.0, 1.0])
        p, yaw = field.grid.poses()
        value, variance = model.predict(p, yaw)
        assert_allclose(field.values_nt, value, rtol=1e-9)
        ratio.append(np.sqrt(field.variance_nt2 / variance)[field.valid])
    assert_allclose(ratio[0], 1, rtol=1e-6)  # a difference of sums: prior less what is known
    # scattered readings 6 cm apart: as rough a variance as there is; between means of a drive it is smoother
    assert np.all(np.quantile(ratio[1], (0.1, 0.01)) > (0.95, 0.9))
    assert np.all(np.quantile(ratio[1], (0.9, 0.99)) < (1.07, 1.2))


@pytest.mark.parametrize("method", QUICK)
def test_a_drive_becomes_a_map_that_ends_where_the_readings_do(method):
    readings = drive()
    readings = readings.take(readings.p_xy.sum(axis=1) < 0.9)  # a floor without a corner
    field = raster(fit(readings, method), readings, spacing_m=0.1, headings_rad=[0.0, np.pi])
    p, yaw = field.grid.poses()
    assert field.values_nt.shape[0] == 2
    assert not field.valid[p.sum(axis=-1) > 1.3].any()
    middle = np.broadcast_to((np.abs(p).max(axis=-1) < 0.7) & (p.sum(axis=-1) < 0.5), field.valid.shape)
    assert field.valid[middle].all()
    assert np.sqrt(np.mean((field.values_nt[middle] - truth(p, yaw)[middle]) ** 2)) < 60


def test_an_unknown_method_or_option_is_refused_with_the_near_one():
    readings = survey(rows=4, columns=4)
    with pytest.raises(InputError, match="no method 'cubik'; did you mean 'cubic'"):
        fit(readings, "cubik")
    with pytest.raises(InputError, match="no option 'fil'; did you mean 'fill'"):
        fit(readings, "trilinear", fil=True)


def test_a_map_has_its_surveys_frame_and_datum_and_a_height_only_where_the_survey_has_one():
    given = drive(400).with_(frame="world: x east", datum="the door", height_m=None)
    for method in ("trilinear", "harmonic"):
        field = raster(fit(given, method), given, spacing_m=1.0, headings_rad=[0.0])
        assert (field.frame, field.datum, field.height_m) == ("world: x east", "the door", None)


def test_a_stuck_hole_is_masked_at_every_heading_and_a_node_read_at_one_is_not():
    readings = survey()
    node = readings.node
    hole = (node[:, 1] >= 2) & (node[:, 1] <= 4) & (node[:, 2] >= 3) & (node[:, 2] <= 5)
    stuck = hole | ((node[:, 0] > 0) & (node[:, 1] == 5) & (node[:, 2] == 1))
    readings = readings.with_(good=~stuck)
    field = raster(
        fit(readings, "gp"), readings, spacing_m=0.125, headings_rad=np.radians(np.arange(0, 360, 15))
    )
    assert field.values_nt.shape == (24, 13, 15)
    masked = np.zeros((13, 15), bool)
    masked[4:9, 6:11] = True  # half a spacing around its nodes, where these are the nearest
    known = field.valid
    assert not known[:, masked].any()
    assert known[:, 10, 2].all()
    assert known[:, ~masked].mean() > 0.9


def test_a_method_of_the_users_own_fits_by_its_name(monkeypatch):
    monkeypatch.setattr(METHODS, "_loaded", {})

    @map_method("plane")
    def fit_plane(readings, *, level_nt=0.0):
        return readings.name, level_nt

    assert fit(survey(), "plane", level_nt=5.0) == (survey().name, 5.0)
    with pytest.raises(InputError, match="method 'plane' has no option 'levl_nt'; did you mean 'level_nt'"):
        fit(survey(), "plane", levl_nt=1.0)
