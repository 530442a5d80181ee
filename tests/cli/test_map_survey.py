"""`magtwin map survey`: the twin surveyed as it stands, from the command line."""

import json

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.files.file import sha256
from magtwin.usd.maps.layer import load_map


def run(*arguments):
    main(["map", "survey", *map(str, arguments)])


def test_a_survey_becomes_a_map_that_knows_where_it_comes_from(lab_scene, tmp_path, capsys):
    out = tmp_path / "coarse.usdc"
    run(lab_scene, "--out", out, "--spacing-m", 0.5, "--headings-deg", "0,120,240", "--seed", 3, "--json")
    field = load_map(out)
    assert field.values_nt.shape == (3, 8, 13)
    assert np.degrees(field.headings_rad) == pytest.approx([0, 120, 240])
    assert f"lab.usda sha256:{sha256(lab_scene)}" in field.source
    assert f"furniture.usda sha256:{sha256(lab_scene.parent / 'furniture.usda')}" in field.source
    assert "lab.usdc" not in field.source, "the map that the scene had before has no part in it"
    assert (field.name, field.created) == ("coarse", "2026-11-21")
    assert field.parameters["seed"] == 3
    assert field.parameters["readings"] == 135
    assert field.frame == "world: x east, y north, z up"
    assert field.height_m == pytest.approx(0.405, abs=0.002)
    assert json.loads(capsys.readouterr().out)["figures"]["nodes"] == 104


def test_a_survey_of_the_shipped_scene_finds_the_shipped_map_but_for_its_error(lab_scene, tmp_path):
    out = tmp_path / "again.usdc"
    run(lab_scene, "--out", out, "--position-error-m", 0, "--heading-error-deg", 0)
    again, shipped = load_map(out), load_map(lab_scene.parent / "map" / "lab.usdc")
    _, rows, columns = again.values_nt.shape
    x, y = (again.origin_m[k] + again.cell_m[k] * np.arange(count) for k, count in ((0, columns), (1, rows)))
    yaw, y, x = np.meshgrid(again.headings_rad, y, x, indexing="ij")
    off = shipped.lookup(np.stack([x, y], axis=-1), yaw, outside="clamp") - again.values_nt
    # the shipped map is fitted to a survey of which each node is read 1.5 cm and 7 deg off
    assert 5 < np.sqrt(np.mean(off**2)) < 80


def test_one_seed_gives_one_file_with_any_jobs_and_another_another(lab_scene, tmp_path):
    for name, *more in (("a", "--seed", 0), ("b", "--seed", 0, "--jobs", 2), ("c", "--seed", 1)):
        folder = tmp_path / name
        folder.mkdir()
        run(lab_scene, "--out", folder / "m.usdc", "--spacing-m", 1, "--readings", 1, *more)
    a, b, c = ((tmp_path / name / "m.usdc").read_bytes() for name in "abc")
    assert a == b
    assert a != c
