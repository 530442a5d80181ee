"""A map and the sources of a scene agree or contradict each other, in nT."""

from dataclasses import replace

import numpy as np
import pytest

import magtwin
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.sim.contradiction import contradiction_nt
from magtwin.sim.survey import survey
from magtwin.usd.maps.layer import save_map


@pytest.fixture(scope="module")
def lab():
    return magtwin.scene_from_toml(shipped("scenes", "lab.toml"))


@pytest.fixture(scope="module")
def field(lab):
    return survey(lab, rng=np.random.default_rng(0), readings=135)


def test_the_map_of_a_scene_agrees_with_its_sources(lab, field):
    found = contradiction_nt(lab, field)
    assert found.agrees
    assert found.rms_nt < 0.1
    assert found.nodes == field.values_nt.size


def test_a_known_difference_is_told_in_nt_with_its_place_and_heading(lab, field):
    values = field.values_nt + 300.0
    values[2, 4, 7] -= 9000.0
    found = contradiction_nt(lab, replace(field, values_nt=values))
    rms = np.sqrt((300.0**2 * (values.size - 1) + 8700.0**2) / values.size)
    assert found.rms_nt == pytest.approx(rms, abs=0.1)
    assert found.largest_nt == pytest.approx(-8700.0, abs=0.1)
    assert (found.x_m, found.y_m) == pytest.approx((field.x_m[7], field.y_m[4]))
    assert found.yaw == field.headings_rad[2]
    assert f"{rms:,.0f} nT rms over 1,500 nodes, at most 8,700 nT, at x -1.25 m, y -0.75 m" in str(found)


def test_another_map_keeps_earth_sources_and_furniture_or_is_refused(lab, field, tmp_path):
    toml = shipped("scenes", "lab.toml")
    near = tmp_path / "near.usdc"
    save_map(replace(field, values_nt=field.values_nt + 100.0, name="near"), near)
    scene = magtwin.scene_from_toml(toml, map_layer=near)
    assert (scene.earth, scene.sources, scene.furniture) == (lab.earth, lab.sources, lab.furniture)
    far = tmp_path / "far.usdc"
    save_map(replace(field, values_nt=field.values_nt[:, ::-1, :], name="far"), far)
    with pytest.raises(InputError, match=r"lab\.toml with .*far\.usdc: the map differs .* nT rms"):
        magtwin.scene_from_toml(toml, map_layer=far)
