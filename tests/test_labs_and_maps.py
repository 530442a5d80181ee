"""A stage with two labs, and a later map of them: every way to open it takes the lab and the map."""

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pxr import Gf, Usd, UsdGeom

import magtwin
from magtwin.bench.suite import Scenario
from magtwin.bench.twin_case import twin_case
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.io.formats import read_run
from magtwin.io.provenance import map_of
from magtwin.ros.simulate import Simulator

LAB = "/Building/LabB"
TOML = """
name = "hall"
map = "early.usdc"
[robot]
asset = "turtlebot4"
kind = "map-only"
"""


@pytest.fixture(scope="module")
def maps() -> tuple[magtwin.AnomalyMap, magtwin.AnomalyMap]:
    """The hall on two days, its field 1,000 nT higher on the second one."""
    x, y = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-2, 2, 9))
    values = np.stack([45_000 + 300 * x + 200 * y] * 4)
    early = magtwin.AnomalyMap(
        values_nt=values,
        origin_m=(-3.0, -2.0),
        cell_m=(0.5, 0.5),
        headings_rad=np.arange(4) * np.pi / 2,
        name="hall",
        created="2026-01-01",
    )
    return early, replace(early, values_nt=values + 1000, created="2026-02-01")


@pytest.fixture(scope="module")
def building(maps, tmp_path_factory) -> Path:
    """A building that references a hall twice, the second time moved and turned, beside `late.usdc`."""
    folder = tmp_path_factory.mktemp("building")
    maps[0].save(folder / "early.usdc")
    maps[1].save(folder / "late.usdc")
    (folder / "hall.toml").write_text(TOML)
    hall = magtwin.author_scene(folder / "hall.toml", folder / "hall")
    stage = Usd.Stage.CreateNew(str(folder / "building.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Building").GetPrim())
    for name, x in (("LabA", 0.0), ("LabB", 12.0)):
        xform = UsdGeom.Xform.Define(stage, f"/Building/{name}")
        xform.GetPrim().GetReferences().AddReference(f"./{hall.relative_to(folder).as_posix()}")
        xform.AddTranslateOp().Set(Gf.Vec3d(x, 0, 0))
        xform.AddRotateZOp().Set(10 * x)
    stage.Save()
    return folder / "building.usda"


@pytest.fixture
def late(building) -> Path:
    return building.with_name("late.usdc")


def of_lab_b(run) -> str:
    """Map that a run in the second lab names."""
    assert run.metadata["lab"] == LAB
    assert run.metadata["lab_pose"].startswith("12.0 ")
    return run.metadata.get("map_file", "")


def test_a_twin_reads_the_map_that_is_named_or_else_that_of_the_stage(building, late, maps):
    twins = magtwin.open_twin(building, lab=LAB), magtwin.open_twin(building, lab=LAB, map_layer=late)
    for twin, field in zip(twins, maps, strict=True):
        assert_array_equal(twin.field.values_nt, field.values_nt)
    runs = [magtwin.simulate(twin, "sine", duration_s=2.0) for twin in twins]
    assert [of_lab_b(run) for run in runs] == ["", late.as_posix()]
    assert runs[1].metadata["map_sha256"] == sha256(late)
    np.testing.assert_allclose(runs[1]["b_map_nt"] - runs[0]["b_map_nt"], 1000, atol=0.01)
    for run, field in zip(runs, maps, strict=True):
        assert_array_equal(map_of(run).values_nt, field.values_nt)


def test_what_is_no_map_layer_is_refused_with_the_option(building, tmp_path, capsys):
    with pytest.raises(InputError, match=r"building\.usda: is no map layer; give the layer of a map"):
        magtwin.open_twin(building, lab=LAB, map_layer=building)
    with pytest.raises(SystemExit):
        main(["run", str(building), "--lab", LAB, "--map", "gone.usdc", "--out", str(tmp_path / "run")])
    assert "gone.usdc: no such USD file" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_map_that_was_made_from_another_room_is_told(tmp_path):
    room = magtwin.open_twin("lab", network="none")
    other = replace(room.field.made_from, bodies={"press": "12"})
    replace(room.field, made_from=other).save(tmp_path / "other.usdc")
    with pytest.warns(magtwin.MismatchWarning, match="has changed since its map 'lab' was made"):
        magtwin.open_twin("lab", map_layer=tmp_path / "other.usdc", network="none")


def test_a_run_that_names_both_is_reproduced_and_refused_once_its_map_changed(
    building, late, tmp_path, capsys
):
    own = tmp_path / "own.usdc"
    own.write_bytes(late.read_bytes())
    file = tmp_path / "run.parquet"
    options = ["--lab", LAB, "--map", str(own), "--path", "sine", "--duration-s", "2", "--out", str(file)]
    main(["run", str(building), *options])
    assert of_lab_b(read_run(file)) == own.as_posix()
    main(["reproduce", str(file)])
    assert "equal" in capsys.readouterr().out
    own.write_bytes(building.with_name("early.usdc").read_bytes())
    with pytest.raises(InputError, match="is not the map of the run"):
        map_of(read_run(file))


def test_sweep_and_drive_and_ros_sim_take_both(building, late, tmp_path, capsys, monkeypatch):
    where = ["--lab", "LabB", "--map", str(late)]
    monkeypatch.setenv("MAGTWIN_SWEEP_LAB", "LabB")
    out = ["--out", str(tmp_path / "sweep")]
    main(["sweep", str(building), *where[2:], "--count=1", "--duration-s=1", *out])
    assert of_lab_b(read_run(tmp_path / "sweep" / "run_00000.parquet")) == late.as_posix()
    (tmp_path / "keys").write_bytes(b"wq")
    with (tmp_path / "keys").open() as keys:
        monkeypatch.setattr(sys, "stdin", keys)
        main(["drive", str(building), *where, "--no-live", "--out", str(tmp_path / "drive")])
    assert of_lab_b(read_run(tmp_path / "drive" / "run.parquet")) == late.as_posix()
    assert f"--lab LabB --map {late}" in capsys.readouterr().out
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    seen = []
    monkeypatch.setattr(
        "magtwin.ros.simulate.Simulator",
        lambda twin, bus, **options: seen.append(twin) or Simulator(twin, bus, **options),
    )
    main(["ros", "sim", str(building), *where, "--duration-s", "0.1"])
    assert of_lab_b(seen[0]) == late.as_posix()


def test_gym_and_a_benchmark_take_the_lab(building, late, maps):
    pytest.importorskip("gymnasium")
    from magtwin.gym import MagNavVectorEnv

    options = {"path": "sine", "signals": ["b_map_nt"]}
    twin = magtwin.open_twin(building, lab=LAB, map_layer=late)
    first, second = (
        float(MagNavVectorEnv(1, **options, **where).reset(seed=0)[0][0, 0])
        for where in ({"scene": building, "lab": LAB}, {"scene": twin})
    )
    assert second - first == pytest.approx(1000, abs=0.1)
    with pytest.raises(InputError, match="give `network`, `lab` and `magnetometer` to open_twin"):
        MagNavVectorEnv(1, scene=twin, lab=LAB, **options)
    case = twin_case(Scenario(name="hall", duration_s=2.0, lab=LAB), str(building), 0, 0)
    assert_array_equal(case.truth.field.values_nt, maps[0].values_nt)
