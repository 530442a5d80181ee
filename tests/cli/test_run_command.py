"""`magtwin run`: every output that it is asked for, each written once, all or none."""

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.io.formats import read_run
from magtwin.io.rerun.file import read_run as read_rrd
from magtwin.io.rerun.file import write_rrd
from magtwin.path import path_named
from magtwin.run.run import Run
from magtwin.twin import open_twin


@pytest.fixture(scope="module")
def written(lab_scene, tmp_path_factory):
    """Everything that one run can leave."""
    patch = pytest.MonkeyPatch()
    patch.setenv("MAGTWIN_RUN_USD_FPS", "0")
    patch.setenv("MAGTWIN_RUN_OUT_UNIT", "nT")
    folder = tmp_path_factory.mktemp("all")
    arguments = ["run", str(lab_scene), "--network", "none", "--duration-s", "3", "--seed", "5", "--json"]
    files = {kind: folder / f"a{end}" for kind, end in (("rrd", ".rrd"), ("bag", ".mcap"), ("csv", ".csv"))}
    files |= {"usd": folder / "deep" / "a.usda", "parquet": folder / "a.parquet"}
    files["npz"] = folder / "a.npz"
    named = [text for file in files.values() for text in ("--out", str(file))]
    main([*arguments, "--out", str(folder / "out"), *named])
    patch.undo()
    return folder, files


def test_every_file_of_one_run_holds_that_run(written):
    folder, files = written
    run = read_run(folder / "out")
    assert run.rows == 405
    assert run.metadata["seed"] == 5
    for kind, file in files.items():
        back = read_run(file)
        assert dict(back.metadata) == dict(run.metadata), kind
        for name in ("t", "p_world_base", "b_total_nt", "b_map_nt", "flag_bump"):
            assert np.array_equal(back[name], run[name]), (kind, name)


def test_one_kind_in_two_places_is_written_once(written):
    folder, files = written
    for kind in ("rrd", "parquet"):  # two recordings that were each written would differ in Rerun's stamps
        assert files[kind].read_bytes() == (folder / "out" / f"run.{kind}").read_bytes()
    assert {path.name for path in folder.iterdir()} == {
        "out",
        "deep",
        "a.rrd",
        "a.mcap",
        "a.csv",
        "a.parquet",
        "a.npz",
    }


def test_the_layer_names_its_scene_from_where_it_lies(written, lab_scene):
    from pxr import Sdf, Usd

    _, files = written
    layer = Sdf.Layer.FindOrOpen(str(files["usd"]))
    assert [layer.ComputeAbsolutePath(path) for path in layer.subLayerPaths] == [str(lab_scene.resolve())]
    assert Usd.Stage.Open(layer).GetDefaultPrim()


def test_a_run_that_lacks_columns_is_shown_in_its_lab_all_the_same(lab_scene, tmp_path):
    twin = open_twin(lab_scene, network="none")
    t = np.arange(200) / 50
    posed = {
        "p_world_base": np.column_stack([t / 10, t / 20, 0 * t]),
        "q_world_base_xyzw": np.tile([0.0, 0, 0, 1], (200, 1)),
    }
    for number, columns in enumerate(({}, posed, posed | {"b_total_nt": 4e4 + t})):
        run = Run({"t": t, **columns})
        write_rrd(run, tmp_path / f"{number}.rrd", twin, planned=path_named("sine"))
        assert list(read_rrd(tmp_path / f"{number}.rrd")) == list(run)
