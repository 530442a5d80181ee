"""The name of a shipped scene stands for its stage and its map, and a missing scene is refused."""

import shutil
from pathlib import Path

import pytest

from magtwin import load_run
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.figures.drawing import draw
from magtwin.figures.reporting import report_runs
from magtwin.files.kinds import scene_file, shipped_or
from magtwin.io.convert import convert_run
from magtwin.io.formats import runs_in
from magtwin.io.map_files import map_file, open_map
from magtwin.io.provenance import repeat_of
from magtwin.tasks.learning import build_dataset, map_of_scene
from magtwin.twin import open_twin, scene_of, simulate


@pytest.fixture(scope="module")
def run(lab_scene, tmp_path_factory):
    file = tmp_path_factory.mktemp("run") / "run.parquet"
    simulate(open_twin(lab_scene, magnetometer="physical"), "figure8", duration_s=2.0, seed=0).save(file)
    return file


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A working folder without a scene in it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("scene", ["nope.usda", "nope"])
def test_a_missing_scene_that_was_named_is_refused(run, elsewhere, scene):
    for shown in (
        lambda: report_runs([run], "z.html", scene=scene),
        lambda: draw([run], "z.gif", scene=scene),
        lambda: convert_run(run, "z.rrd", scene=scene),
        lambda: repeat_of(run, scene),
    ):
        with pytest.raises(InputError, match=r"nope\.usda: no such scene|no scene 'nope'; known: lab"):
            shown()
    assert not list(elsewhere.iterdir())


def test_a_scene_whose_map_is_not_that_of_the_run_is_reported(run, elsewhere):
    load_run(run).with_metadata(map_sha256="0" * 64).save("other.parquet")
    with pytest.warns(UserWarning, match="its map is not shown: .*is not the map of the run"):
        report_runs(["other.parquet"], "z.html", scene="lab")


def test_the_name_of_a_shipped_scene_is_its_stage_and_its_map(run, elsewhere, capsys):
    stage = map_file("lab")
    assert stage.name == "lab.usda"
    assert scene_of(load_run(run), "lab") == stage
    assert map_of_scene("lab").name == "lab.usdc"
    assert open_map("lab").name == open_map(stage).name
    assert build_dataset(run, out="set", anomaly_map="lab").report().figures
    for command in (["map", "info"], ["map", "diff", "lab"], ["info"]):
        main([*command, "lab"])
    assert "lab" in capsys.readouterr().out


def test_a_file_goes_before_the_name_of_a_shipped_scene(elsewhere):
    (elsewhere / "lab").write_text("mine")
    assert map_file("lab") == (elsewhere / "lab").relative_to(elsewhere)
    with pytest.raises(InputError, match=r"labb: no map layer, .*did you mean 'lab'"):
        map_file("labb")


def test_a_folder_goes_before_the_name_of_a_shipped_scene_only_if_it_is_of_a_kind(elsewhere, lab_scene):
    (elsewhere / "lab").mkdir()
    for found in (map_file("lab"), scene_file("lab"), shipped_or("lab")):
        assert found.parts[-3:] == ("scenes", "lab", "lab.usda")
    shutil.copytree(lab_scene.parent, "lab", dirs_exist_ok=True)
    assert scene_file("lab") == shipped_or("lab") == Path("lab/lab.usda")
    with pytest.raises(InputError, match=r"author it first: magtwin scene aprilab --map MAP\.usdc"):
        scene_file("aprilab")


def test_a_folder_of_runs_in_any_format_stands_for_them(run, elsewhere):
    for name in ("a.parquet", "b.npz", "c.mcap", "c.scans.parquet"):
        load_run(run).save(name)
    Path("notes.txt").touch()
    assert [file.name for file in runs_in(Path())] == ["a.parquet", "b.npz", "c.mcap"]
    assert runs_in(run) == [run]
