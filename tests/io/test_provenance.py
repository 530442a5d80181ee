"""What a run says of how it came about, and that it can be made once more from that."""

import json
import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files import file
from magtwin.files.file import git_revision, sha256
from magtwin.io.provenance import differences, repeat, repeat_of
from magtwin.io.tables import read_parquet, write_parquet
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.motion.commands import Commands
from magtwin.twin import open_twin, simulate, twin_of
from magtwin.usd.layers import stage_sha256

BRIEF = {"duration_s": 2.0, "rate_hz": 20.0}


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, magnetometer="map-only")


@pytest.fixture(scope="module")
def run(twin):
    return simulate(twin, "figure8", seed=5, **BRIEF)


def test_a_run_names_its_files_with_checksums(run, lab_scene, twin):
    metadata = run.metadata
    assert metadata["scene_file"] == lab_scene.as_posix()
    assert metadata["scene_sha256"] == stage_sha256(lab_scene)
    assert metadata["map_sha256"] == sha256(twin.scene.map_layer)
    assert metadata["asked_duration_s"] == 2.0
    assert "path_file" not in metadata


def _chain(folder):
    """A stage that references a layer that references another, and names a file."""
    folder.mkdir(parents=True)
    for name, below in (("mesh.usdc", None), ("middle.usda", "./mesh.usdc"), ("root.usda", "./middle.usda")):
        stage = Usd.Stage.CreateNew(str(folder / name))
        prim = stage.DefinePrim("/mesh")
        stage.SetDefaultPrim(prim)
        if below:
            prim.GetReferences().AddReference(below)
        if name == "root.usda":
            prim.CreateAttribute("weights", Sdf.ValueTypeNames.Asset).Set("./weights.bin")
        stage.Save()
    (folder / "weights.bin").write_bytes(b"weights")


@pytest.mark.usefixtures("allow_neighbours")
def test_the_stages_checksum_follows_content_in_any_layer_and_not_the_place(lab_scene, tmp_path):
    for name in ("a", "b/deeper"):
        _chain(tmp_path / name)
    a, b = tmp_path / "a" / "root.usda", tmp_path / "b" / "deeper" / "root.usda"
    whole = stage_sha256(a)
    assert stage_sha256(b) == whole
    shutil.move(tmp_path / "b" / "deeper" / "mesh.usdc", tmp_path / "b" / "other.usdc")
    middle = Sdf.Layer.FindOrOpen(str(b.with_name("middle.usda")))
    middle.UpdateCompositionAssetDependency("./mesh.usdc", "../other.usdc")
    middle.Save()
    assert stage_sha256(b) == whole
    (tmp_path / "a" / "weights.bin").write_bytes(b"other")
    assert stage_sha256(a) != whole
    deepest = Usd.Stage.Open(str(tmp_path / "b" / "other.usdc"))
    deepest.GetPrimAtPath("/mesh").SetDocumentation("changed")
    deepest.Save()
    assert stage_sha256(b) != whole


def test_the_commit_is_that_of_the_checkout_or_worktree(tmp_path, monkeypatch):
    def git(*words):
        user = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        command = ["git", *user, "-C", tmp_path / "main", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    inside = tmp_path / "main" / "scenes" / "lab"
    inside.mkdir(parents=True)
    assert git_revision(inside) == ""  # no checkout
    git("init")
    assert git_revision(inside) == ""  # no commit yet
    git("commit", "--allow-empty", "-m", "first")
    git("worktree", "add", tmp_path / "tree")
    git("commit", "--allow-empty", "-m", "second")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "gone"))
    assert git_revision(tmp_path / "tree") != git_revision(inside)
    monkeypatch.delenv("GIT_DIR")
    assert git_revision(inside) == git("rev-parse", "HEAD")
    monkeypatch.setenv("PATH", "")
    assert git_revision(inside) == ""  # no git


@pytest.mark.parametrize("pipe", ["config", "include"])
def test_git_does_not_wait_for_a_pipe(pipe, tmp_path, monkeypatch):
    monkeypatch.setattr(file, "_GIT_S", 0.3)
    for name in ("refs", "objects"):
        (tmp_path / ".git" / name).mkdir(parents=True)
    (tmp_path / ".git" / "HEAD").write_text("ref: refs/heads/x\n")
    os.mkfifo(tmp_path / ".git" / ("config" if pipe == "config" else "pipe"))
    if pipe == "include":
        (tmp_path / ".git" / "config").write_text("[include]\n\tpath = pipe\n")
    assert git_revision(tmp_path) == ""


def test_a_run_of_every_kind_comes_out_again_to_the_bit(twin, tmp_path):
    (tmp_path / "way.csv").write_text("-1,0\n0,0.5\n1,0\n")
    (tmp_path / "drive.csv").write_text("t,v,w\n0,0.2,0\n0.4,0.1,0.5\n0.8,0.2,0\n1.2,0,0\n")
    from magtwin.sim.motion.commands import read_commands

    runs = [
        simulate(twin, "sine", seed=1, speed=0.15, controller="release", lidar="on", **BRIEF),
        simulate(twin, "A", seed=2, outside="clamp", **BRIEF),
        simulate(twin, tmp_path / "way.csv", seed=3, **BRIEF),
        simulate(twin, read_commands(tmp_path / "drive.csv"), seed=4, rate_hz=20.0),
        simulate(twin, "random", seed=5, **BRIEF),
    ]
    for original in runs:
        found = repeat(original)
        assert found.equal, found.report("differs")
        assert found.causes == ()
        assert dict(found.again.metadata) == dict(original.metadata)


def test_a_run_of_a_data_set_comes_out_again_in_its_session(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_SWEEP_KEEP", "p_world_base b_total_nt battery_v")
    out = tmp_path / "runs"
    options = ["--duration-s", "1", "--rate-hz", "20"]
    options += ["--count", "3", "--sessions", "2", "--seed", "7"]
    main(["sweep", str(lab_scene), "--out", str(out), *options])
    capsys.readouterr()
    main(["reproduce", str(out / "run_00002.parquet"), "--json"])
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["equal"] == "yes, to the bit"
    assert figures["equal_columns"] == 4
    a, b = (read_parquet(out / f"run_0000{k}.parquet").metadata["config_sha256"] for k in (0, 2))
    assert a != b


@pytest.mark.parametrize("name", ["run.csv", "run.npz", "run.rrd", "run.usdc", "run.mcap", "bag"])
def test_a_run_comes_out_again_from_a_file_of_any_format(run, twin, tmp_path, name):
    from magtwin.io.formats import write_run

    write_run(run, tmp_path / name, twin)
    found = repeat_of(tmp_path / name)
    assert found.causes == ()
    assert found.equal, found.report(name)


def test_a_run_that_was_resampled_says_so(run):
    found = repeat(run.resample(rate_hz=10.0))
    assert found.causes[0].startswith("the run was made from another: resample")
    assert not found.equal


def test_what_changed_is_named_and_the_columns_that_differ(lab_scene, tmp_path, run, capsys):
    file = tmp_path / "run.parquet"
    total = run["b_total_nt"].copy()
    total[7:] += 12.5
    claims = {"map_sha256": "0" * 64, "magtwin": "0.0.1"}
    write_parquet(run.with_columns(b_total_nt=total).with_metadata(**claims), file)
    with pytest.raises(SystemExit) as stop:
        main(["reproduce", str(file)])
    lines = capsys.readouterr().out.splitlines()
    assert stop.value.code == 1
    assert lines[1].startswith("DIFFERENT: ")
    causes = [
        "another version of magtwin: magtwin was 0.0.1, is ",
        f"the map changed: map_sha256 was {'0' * 64}, is ",
    ]
    first = next(k for k, line in enumerate(lines) if line.startswith(causes[0]))
    assert lines[first + 1].startswith(causes[1])
    column = next(line for line in lines if line.startswith("b_total_nt"))
    assert "12.5" in column
    assert f"{run.rows - 7} of {run.rows} rows, from row 8 on" in column


def test_a_run_is_found_beside_its_scene_when_both_have_moved(run, lab_scene, tmp_path, monkeypatch):
    there = tmp_path / "there"
    moved = there / "scene" / lab_scene.name
    there.mkdir()
    moved.parent.symlink_to(lab_scene.parent)
    monkeypatch.chdir(tmp_path)
    told = run.with_metadata(scene_file=f"scene/{lab_scene.name}")
    with pytest.raises(InputError, match="the scene of the run is missing; name it"):
        repeat(told)
    assert repeat(told, near=there / "run.parquet").equal
    assert repeat(told, near=there).equal
    assert repeat(told, moved).equal


def test_a_twin_is_opened_as_the_run_had_it_or_refused(run, lab_scene):
    assert twin_of(run).scene.robot.magnetometer.kind == "map-only"
    changed = run.with_metadata(scene_sha256="0" * 64)
    with pytest.raises(InputError, match="the scene changed since the run: scene_sha256 is "):
        twin_of(changed)
    assert twin_of(changed, check=False).scene_file == lab_scene


@pytest.mark.parametrize(
    ("way", "name"),
    [
        (Path("mine", [[-1, 0], [1, 0]]), "'mine'"),
        (Commands("script", np.array([[0.0, 0.1, 0.0], [0.3, 0.0, 0.0]])), "'script'"),
    ],
)
def test_what_was_driven_from_no_file_is_not_repeated(twin, way, name):
    with pytest.raises(InputError, match=f"drove .*{name}, which is in no file"):
        repeat(simulate(twin, way, duration_s=0.5, rate_hz=20.0))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": None}, "no seed"),
        ({"scene_file": None}, "does not name its scene"),
        ({"rate_hz": "often"}, "incomplete: could not convert"),
        ({"path_file": "/dev/null"}, "/dev/null: the file that the run drove is missing"),
        ({"engine": "wings"}, "a custom engine, 'wings'"),
    ],
)
def test_metadata_that_no_run_can_be_made_from_are_refused(run, changes, words):
    told = {k: v for k, v in (run.metadata | changes).items() if v is not None}
    with pytest.raises(InputError, match=words):
        repeat(replace(run, metadata=told))


def test_a_missing_column_and_missing_rows_count_as_differences():
    a = Run({"t": np.arange(4.0), "battery_v": np.array([1.0, np.nan, 3.0, 4.0])})
    b = Run({"t": np.arange(3.0), "battery_v": np.array([1.0, np.nan, 3.5])})
    t, volts = differences(a, b)
    assert (t.column, t.rows, t.first) == ("t", 1, 3)
    assert (volts.rows, volts.first, volts.greatest) == (2, 2, 0.5)
    (lost,) = differences(a, Run({"t": np.arange(4.0)}))
    assert (lost.column, lost.rows) == ("battery_v", 4)
    assert differences(a, a) == ()
