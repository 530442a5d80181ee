"""A stage with two labs, whose map has two epochs: every way to open it takes the lab and the epoch."""

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
from magtwin.io.formats import read_run
from magtwin.io.provenance import map_of
from magtwin.ros.simulate import Simulator
from magtwin.usd.maps.layer import load_epochs, save_map_series
from magtwin.usd.scene import open_scene

EARLY, LATE = "2026-01-01", "2026-02-01"
LAB = "/Building/LabB"
TOML = """
name = "hall"
map = "epochs.usdc"
[robot]
asset = "turtlebot4"
kind = "map-only"
"""


@pytest.fixture(scope="module")
def building(tmp_path_factory) -> Path:
    """A building that references a hall twice, the second time moved and turned."""
    folder = tmp_path_factory.mktemp("building")
    x, y = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-2, 2, 9))
    values = np.stack([45_000 + 300 * x + 200 * y] * 4)
    early = magtwin.AnomalyMap(
        values_nt=values,
        origin_m=(-3.0, -2.0),
        cell_m=(0.5, 0.5),
        headings_rad=np.arange(4) * np.pi / 2,
        name="hall",
        created=EARLY,
    )
    save_map_series([early, replace(early, values_nt=values + 1000, created=LATE)], folder / "epochs.usdc")
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


@pytest.fixture(scope="module")
def maps(building):
    return load_epochs(building.parent / "epochs.usdc")


def of_lab_b(run) -> str:
    """Epoch of a run in the second lab."""
    assert run.metadata["lab"] == LAB
    assert run.metadata["lab_pose"].startswith("12.0 ")
    return run.metadata["map_epoch"]


def test_a_twin_reads_the_epoch_that_is_named_or_else_the_one_that_the_stage_selects(building, maps):
    assert_array_equal(magtwin.open_twin(building, lab=LAB).field.values_nt, maps[1].values_nt)
    early = magtwin.open_twin(building, lab=LAB, epoch=EARLY)
    assert early.field.created == EARLY
    runs = [
        magtwin.simulate(twin, "sine", duration_s=2.0)
        for twin in (early, magtwin.open_twin(building, lab=LAB))
    ]
    assert [of_lab_b(run) for run in runs] == [EARLY, LATE]
    np.testing.assert_allclose(runs[1]["b_map_nt"] - runs[0]["b_map_nt"], 1000, atol=0.01)
    assert_array_equal(map_of(runs[0]).values_nt, maps[0].values_nt)


@pytest.mark.usefixtures("allow_neighbours")
def test_what_a_stage_selects_is_what_it_reads(building, maps, tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "before.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.GetRootLayer().subLayerPaths = [str(building)]
    stage.OverridePrim(f"{LAB}/AnomalyMap").GetVariantSets().SetSelection("epoch", EARLY)
    stage.Save()
    for options, field in (
        ({"lab": LAB}, maps[0]),
        ({"lab": "LabA"}, maps[1]),
        ({"lab": LAB, "epoch": LATE}, maps[1]),
    ):
        opened = open_scene(tmp_path / "before.usda", **options)
        assert opened.epoch == field.created
        assert_array_equal(opened.map.values_nt, field.values_nt)


@pytest.mark.parametrize(
    ("epoch", "said"),
    [
        ("2026-01-02", r"</Building/LabB/AnomalyMap>: no epoch of the map '2026-01-02'; did you mean '2026-"),
        ("before", "no epoch of the map 'before'; known: 2026-01-01, 2026-02-01"),
    ],
)
def test_an_epoch_that_the_map_lacks_is_refused_with_those_that_it_has(building, epoch, said):
    with pytest.raises(InputError, match=said):
        magtwin.open_twin(building, lab=LAB, epoch=epoch)


def test_an_epoch_of_a_map_without_epochs_is_refused(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["run", "lab", "--epoch", EARLY, "--out", str(tmp_path / "run")])
    assert "AnomalyMap>: the map has no epochs; leave out --epoch" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_run_names_both_is_reproduced_and_its_usd_shows_the_epoch_on_its_own_timeline(
    building, tmp_path, capsys
):
    options = ["--lab", LAB, "--epoch", EARLY, "--path", "sine", "--duration-s", "2"]
    files = [tmp_path / name for name in ("run.parquet", "run.usda")]
    main(["run", str(building), *options, *(f"--out={file}" for file in files)])
    run = read_run(files[0])
    assert of_lab_b(run) == EARLY
    main(["reproduce", str(files[0])])
    assert "equal" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(files[1]))
    assert stage.GetPrimAtPath(f"{LAB}/AnomalyMap").GetVariantSet("epoch").GetVariantSelection() == EARLY
    assert stage.GetStartTimeCode() == 0.0
    assert stage.GetEndTimeCode() == pytest.approx(60, abs=1)


def test_sweep_and_drive_and_ros_sim_take_both(building, tmp_path, capsys, monkeypatch):
    where = ["--lab", "LabB", "--epoch", EARLY]
    main(["sweep", str(building), *where, "--count=1", "--duration-s=1", "--out", str(tmp_path / "sweep")])
    assert of_lab_b(read_run(tmp_path / "sweep" / "run_00000.parquet")) == EARLY
    (tmp_path / "keys").write_bytes(b"wq")
    with (tmp_path / "keys").open() as keys:
        monkeypatch.setattr(sys, "stdin", keys)
        main(["drive", str(building), *where, "--no-live", "--out", str(tmp_path / "drive")])
    assert of_lab_b(read_run(tmp_path / "drive" / "run.parquet")) == EARLY
    assert f"--lab LabB --epoch {EARLY}" in capsys.readouterr().out
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    seen = []
    monkeypatch.setattr(
        "magtwin.ros.simulate.Simulator",
        lambda twin, bus, **options: seen.append(twin) or Simulator(twin, bus, **options),
    )
    main(["ros", "sim", str(building), *where, "--duration-s", "0.1"])
    assert of_lab_b(seen[0]) == EARLY


def test_gym_and_a_benchmark_take_both(building, maps):
    pytest.importorskip("gymnasium")
    from magtwin.gym import MagNavVectorEnv

    options = {"path": "sine", "lab": LAB, "epoch": EARLY, "signals": ["b_map_nt"]}
    first, second = (
        float(MagNavVectorEnv(1, scene=building, **options | {"epoch": epoch}).reset(seed=0)[0][0, 0])
        for epoch in (EARLY, LATE)
    )
    assert second - first == pytest.approx(1000, abs=0.1)
    twin = magtwin.open_twin(building, lab=LAB)
    with pytest.raises(InputError, match="give `network`, `lab`, `epoch` and `magnetometer` to open_twin"):
        MagNavVectorEnv(1, scene=twin, **options)
    scenario = Scenario(name="hall", duration_s=2.0, lab=LAB, epoch=EARLY)
    case = twin_case(scenario, str(building), 0, 0)
    assert_array_equal(case.truth.field.values_nt, maps[0].values_nt)
