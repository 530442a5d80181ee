"""Exports of scenes with a large map in tiles, and with a map of several epochs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_export import contents

from magtwin.author.scene import author_scene
from magtwin.author.scene_file import scene_from_toml
from magtwin.errors import InputError
from magtwin.export.package import export_scene
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.tiles import TiledMap
from magtwin.twin import open_twin
from magtwin.usd.layers import open_stage
from magtwin.usd.maps.layer import checksums, save_map, save_map_series
from magtwin.usd.maps.tiled_layer import check_tiles


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory):
    """Authors a scene without a network around a map."""

    def author(name: str, write: Callable[[AnomalyMap, Path], None]) -> tuple[Path, AnomalyMap]:
        folder = tmp_path_factory.mktemp(name)
        rng = np.random.default_rng(0)
        field = AnomalyMap(
            values_nt=rng.uniform(4e4, 5e4, (4, 41, 57)).astype("f4").astype(float),
            origin_m=(-1.4, -1.0),
            cell_m=(0.05, 0.05),
            headings_rad=np.arange(4) * np.pi / 2,
            name=name,
            created="2026-02-01",
        )
        write(field, folder / "map.usdc")
        toml = f'name = "{name}"\nmap = "map.usdc"\n[robot]\nasset = "turtlebot4"\nkind = "map-only"\n'
        (folder / "hall.toml").write_text(toml)
        return author_scene(scene_from_toml(folder / "hall.toml"), folder / name), field

    return author


AT = np.array([[0.31, 0.22], [-0.87, 0.61]]), np.array([0.4, 3.0])


def test_a_scene_with_a_map_in_tiles_is_exported_with_all_of_them(hall, tmp_path):
    scene, field = hall("tiled", lambda field, file: save_map(field, file, tile_cells=16))
    for name, profile in (("isaac", "isaac"), ("viewer.usdc", "viewer"), ("web.glb", "viewer")):
        out = export_scene(scene, tmp_path / name, profile=profile, trusted=True).root
        if name != "web.glb":
            opened = open_twin(out).field
            assert isinstance(opened, TiledMap)
            assert len(opened.tiling) == 3 * 4
            assert_array_equal(opened.lookup(*AT), field.lookup(*AT))
            stage = open_stage(out)  # held in a name: a prim does not keep its stage alive
            check_tiles(stage.GetPrimAtPath("/World/AnomalyMap"))
    said, _ = contents(tmp_path / "web.glb")
    assert all(accessor["count"] > 0 for accessor in said["accessors"])
    (told,) = (node["extras"] for node in said["nodes"] if node["name"] == "AnomalyMap")
    assert told["magtwin:anomalyMap:tileCells"] == 16
    assert "magtwin:anomalyMap:values" not in told
    assert told["colours"]["unit"] == "nT"


def test_a_folder_keeps_every_epoch_of_a_map_and_one_layer_the_selected_one(hall, tmp_path):
    early = "2026-01-01"
    scene, field = hall(
        "epochs",
        lambda field, file: save_map_series(
            [field, replace(field, values_nt=field.values_nt + 500, created=early)], file
        ),
    )
    folder = export_scene(scene, tmp_path / "omniverse", trusted=True).root
    layer = export_scene(scene, tmp_path / "viewer.usdc", trusted=True).root
    for out in (folder, layer):
        assert_array_equal(open_twin(out).field.lookup(*AT), field.lookup(*AT))
        stage = open_stage(out)  # held in a name: a prim does not keep its stage alive
        assert all(said == seen for said, seen in checksums(stage.GetPrimAtPath("/World/AnomalyMap")))
    assert_allclose(open_twin(folder, epoch=early).field.lookup(*AT), field.lookup(*AT) + 500, atol=0.01)
    with pytest.raises(InputError, match="the map has no epochs"):
        open_twin(layer, epoch=early)
