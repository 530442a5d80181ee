"""`magtwin map info`, `diff`, `upward`, and the card that `info` prints."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from refusing import refused

from magtwin.cli import main
from magtwin.field.grid import Grid
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.usd.maps.layer import load_map, save_map

SHA = "0123456789abcdef" * 4


def a_field(height_m=0.35) -> HarmonicField:
    return HarmonicField(
        p_world_dipole=[[0.5, 0.2, -0.5], [-1.0, 0.0, -0.8]],
        m_world=[[0, 0, 4.0], [2.0, 0, 0]],
        b_uniform_nt=(-3_000.0, 24_000.0, -38_000.0),
        hard_iron_nt=(300.0, 0.0, -400.0),
        soft_iron=np.diag([0.01, 0.0, 0.02]),
        p_base_sensor=(0.01, 0.0, height_m),
    )


def a_map(harmonic=None, **more) -> AnomalyMap:
    """The dipoles' field on 4 headings x 7 x 9 nodes, in numbers that a layer holds."""
    grid = Grid.over((-2, 2, -1.5, 1.5), 0.5, np.radians([0, 90, 180, 270]))
    values = a_field().magnitude_nt(*grid.poses()).astype(np.float32).astype(float)
    given = {
        "values_nt": values,
        "variance_nt2": np.full(values.shape, 25.0),
        "origin_m": grid.origin_m,
        "cell_m": grid.cell_m,
        "headings_rad": grid.headings_rad,
        "name": "hall",
        "method": "harmonic",
        "source": f"0_map.csv sha256:{SHA}; 90_map.csv sha256:{SHA[::-1]}",
        "licence": "MIT",
        "created": "2026-01-01",
        "frame": "world",
        "datum": "the door",
        "height_m": 0.35,
        "parameters": {"depth_m": 0.5, "notes": ["a", 1]},
        "harmonic": harmonic,
    }
    return AnomalyMap(**{**given, **more})


@pytest.fixture
def layer(tmp_path):
    save_map(a_map(a_field()), tmp_path / "m.usdc")
    return tmp_path / "m.usdc"


def told(capsys, *arguments):
    """What a command says as JSON."""
    main([*map(str, arguments), "--json"])
    return json.loads(capsys.readouterr().out)


def test_info_tells_everything_that_a_map_knows(layer, capsys):
    said = told(capsys, "map", "info", layer)
    figures, metadata = said["figures"], said["metadata"]
    assert figures["valid_share_percent"] == 100
    assert figures["standard_deviation_nt"] == 5
    assert (figures["height_m"], said["notes"]["height_m"]) == (0.35, "of the sensor above the floor")
    assert (figures["dipoles"], said["notes"]["dipoles"]) == (2, "0.5 to 0.8 m below the floor")
    assert figures["hard_iron_nt"] == 500
    assert figures["soft_iron_nt_nt"] == pytest.approx(0.02)
    assert figures["extent_m"] == [-2, 2, -1.5, 1.5]
    assert metadata["files"] == {"0_map.csv": SHA, "90_map.csv": SHA[::-1]}
    assert metadata["parameters"] == {"depth_m": 0.5, "notes": ["a", 1]}
    about = {"method": "harmonic", "frame": "world", "datum": "the door", "created": "2026-01-01"}
    assert metadata["headings_deg"] == [0, 90, 180, 270]
    assert (
        about.items() | {("licence", "MIT")}
        <= {name: value for name, value in metadata.items() if isinstance(value, str)}.items()
    )


def test_info_works_on_a_folder_of_csvs_and_tells_their_checksums(real_data, capsys):
    from magtwin.files.file import sha256

    folder = real_data / "aprilab" / "maps"
    said = told(capsys, "map", "info", folder)
    assert said["metadata"]["files"] == {p.name: sha256(p) for p in folder.glob("*_map.csv")}
    assert said["figures"]["valid_share_percent"] < 97


def test_continue_writes_the_map_of_another_height(tmp_path, layer, capsys):
    said = told(capsys, "map", "upward", layer, "--height-m", "1.0", "--out", tmp_path / "up.usdc")
    assert said["figures"]["height_m"] == 1.0
    up = load_map(tmp_path / "up.usdc")
    exact = a_field().magnitude_nt(*up.grid.poses(), height_m=1.0)
    assert np.abs(up.values_nt - exact).max() < 0.004
    assert up.method.endswith("continued from 0.35 to 1 m by its harmonic field")
    assert "--height-m is a height above the floor, 0 m or more, got -1.0" in refused(
        capsys, "map", "upward", layer, "--height-m", "-1", "--out", tmp_path / "down.usdc"
    )
    assert not (tmp_path / "down.usdc").exists()


def test_diff_tells_and_draws_what_changed(tmp_path, layer, capsys):
    changed = a_map()
    values = changed.values_nt + 30.0
    values[:, 2, 3] += 400.0
    save_map(replace(changed, values_nt=values, created="2026-02-01"), tmp_path / "b.usdc")
    said = told(capsys, "map", "diff", layer, tmp_path / "b.usdc", "--out", tmp_path / "d.svg")
    assert said["figures"]["common_bias_nt"] == pytest.approx(30, abs=0.01)
    assert said["figures"]["changed_nodes"] == 4
    (region,) = said["metadata"]["regions"]
    assert region["centre_m"] == [-0.5, -0.5]
    assert region["peak_nt"] == pytest.approx(400, abs=0.01)
    where = "z 56.6, about (-0.50, -0.50) m, x -0.5..-0.5, y -0.5..-0.5 m, 1 node"
    assert said["notes"]["region_1_nt"] == where
    words = "".join(ElementTree.parse(tmp_path / "d.svg").getroot().itertext())
    assert "hall 2026-01-01 to hall 2026-02-01" in words


def test_a_picture_of_another_kind_is_refused_before_anything_is_read(tmp_path, capsys):
    said = refused(capsys, "plot", tmp_path / "gone.usdc", "--out", tmp_path / "a.bmp")
    assert "a picture ends in .png, .svg or .jpg, and a film in" in said
    assert "no such run, stage, map" in refused(
        capsys, "plot", tmp_path / "gone.usdc", "--out", tmp_path / "a.png"
    )
