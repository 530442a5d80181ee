"""Files of the wrong kind, empty files, odd names and huge numbers: every command answers in one line."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.files.file import shipped
from magtwin.files.kinds import ACCEPTED, kind_of
from magtwin.run.run import Run

URDF = '<robot name="r"><link name="a"/></robot>'


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a file of each kind, small."""
    folder = tmp_path_factory.mktemp("kinds")
    for name, text in {
        "room.toml": 'name = "room"\n[lab]\nfloor_m = [4.0, 3.0]\n',
        "suite.toml": '[[scenario]]\nname = "a"\n',
        "settings.toml": "[drive]\nwheel_radius_m = 0.03\n",
        "training.toml": 'model = "linear"\n',
        "robot.urdf": URDF,
        "path.csv": "x,y\n0,0\n1,0\n",
        "commands.csv": "t,v,w\n0,0.1,0\n1,0,0\n",
        "localizer.py": "class A: pass\n",
        "page.html": "<html></html>",
        "model.json": '{"terms": [], "coefficients": []}',
        "controllers.yaml": "wheels: 2\n",
        "floor.yaml": "image: floor.pgm\nresolution: 0.05\n",
        "metadata.yaml": "rosbag2_bagfile_information: {}\n",
        "mesh.stl": "solid a\nendsolid a\n",
        "world.sdf": "<sdf version='1.9'/>",
        "data.zip": "PK",
        "drive.bag": "#ROSBAG V2.0\n",
    }.items():
        (folder / name).write_text(text)
    for name in ("picture.png", "net.safetensors", "net.pth", "net.onnx"):
        (folder / name).write_bytes(b"abcdefghij")
    shutil.copy(shipped("maps", "lab", "lab.usdc"), folder / "map.usdc")
    run = Run({"t": np.arange(20) * 0.1, "b_total_nt": np.full(20, 5e4)}, {"seed": 1})
    for name in ("run.npz", "run.parquet", "run.csv"):
        run.save(folder / name)
    for name in ("drives", "set", "results", "survey", "room", "cart/payloads"):
        (folder / name).mkdir(parents=True)
    (folder / "cart" / "cart.usda").write_text("#usda 1.0\n")
    (folder / "drives" / "runs.csv").write_text("file\n")
    (folder / "set" / "dataset.json").write_text("{}")
    (folder / "results" / "suite.json").write_text("{}")
    (folder / "survey" / "0_map.csv").write_text("x,y\n")
    (folder / "room" / "room.usda").write_text("#usda 1.0\n")
    return folder


TAKES = {
    "room.toml": "magtwin scene room.toml",
    "suite.toml": "magtwin bench suite.toml",
    "settings.toml": "--settings settings.toml",
    "training.toml": "--config training.toml",
    "robot.urdf": "--urdf robot.urdf",
    "map.usdc": "magtwin ",
    "run.npz": "magtwin ",
    "run.parquet": "magtwin ",
    "run.csv": "magtwin ",
    "path.csv": "--path path.csv",
    "commands.csv": "--path commands.csv",
    "localizer.py": "magtwin localize",
    "page.html": "made from",
    "picture.png": "drawn from",
    "net.safetensors": "magtwin evaluate",
    "net.pth": "magtwin network convert net.pth",
    "net.onnx": ".safetensors",
    "model.json": "magtwin compensate apply",
    "drives": "magtwin dataset build",
    "set": "magtwin train set",
    "results": "magtwin bench report results",
    "survey": "magtwin map import survey",
    "room": "magtwin run room",
    "cart": "name the stage inside",
    "controllers.yaml": "--controllers",
    "floor.yaml": "magtwin map occupancy",
    "metadata.yaml": "give the folder",
    "mesh.stl": "magtwin robot",
    "world.sdf": "give the URDF or the stage",
    "data.zip": "unpack it",
    "drive.bag": "rosbags-convert --src drive.bag",
}
"""What the refusal of each file names."""

RARE = {
    "run.csv",
    "cart",
    "controllers.yaml",
    "floor.yaml",
    "metadata.yaml",
    "mesh.stl",
    "world.sdf",
    "data.zip",
    "drive.bag",
}
"""Files that are tried with a few commands only: what they are decides, not the command."""

FEW = (
    "run FILE",
    "scene FILE --out new",
    "robot FILE --out new",
    "info FILE",
    "map import FILE --out new.parquet",
)
"""Those commands."""

RUNS = {"run.npz", "run.parquet", "run.csv", "map.usdc", "model.json"}
"""Files that a reader of runs opens: stages and JSON may hold one."""

SLOTS = {
    "run FILE": {"map.usdc", "room", "cart"},
    "sweep FILE --out new": {"map.usdc", "room", "cart"},
    "map import FILE --out new.parquet": {
        "run.npz",
        "run.parquet",
        "run.csv",
        "survey",
        "drives",
        "commands.csv",
        "path.csv",
    },
    "map survey FILE --out new.usdc": {"map.usdc", "room", "cart"},
    "export FILE --out new": {"map.usdc", "room", "cart"},
    "run lab --path FILE --out new": RUNS | {"path.csv", "commands.csv"},
    "scene FILE --out new": {"room.toml"},
    "scene --urdf FILE --out new": {"robot.urdf", "map.usdc"},
    "robot FILE --out new": {"robot.urdf"},
    "robot robot.urdf --settings FILE --out new": {"settings.toml"},
    "info FILE": RUNS | {"net.safetensors", "net.pth", "net.onnx", "survey"},
    "convert FILE new.csv": RUNS,
    "compare FILE run.npz": RUNS,
    "compare run.npz FILE": RUNS,
    "reproduce FILE": RUNS,
    "film FILE --out new.gif": RUNS,
    "localize FILE --map lab --out new": RUNS,
    "compensate fit FILE --out new.json": RUNS,
    "compensate apply run.parquet FILE --out new.parquet": {"model.json"},
    "dataset info FILE": {"set"},
    "dataset correlate FILE": {"set"},
    "train FILE --out new.safetensors": {"set"},
    "train set --config FILE --out new.safetensors": {"training.toml"},
    "network export FILE --out new.onnx": {"net.safetensors", "net.pth"},
    "network convert FILE --out new.safetensors": {"net.safetensors", "net.pth"},
    "network widen FILE --runs run.npz --map map.usdc --out new.safetensors": {"net.safetensors", "net.pth"},
    "evaluate FILE --runs run.npz --map map.usdc --out new": {"net.safetensors", "net.pth"},
    "bench FILE --out new": {"suite.toml"},
    "bench report FILE --out new": {"results"},
    "bench compare FILE results": {"results"},
    "validate FILE --against core": {"map.usdc", "room", "cart"},
}
"""Commands, each with the files that it may open."""


def refusal(capsys, command):
    """The one line with which magtwin refuses a command."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in command])
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if not line.startswith("  ")]
    assert stop.value.code in (1, 2), error
    assert len(lines) == 1, error
    assert "a fault in magtwin" not in lines[0]
    return lines[0]


@pytest.mark.parametrize("slot", SLOTS)
def test_a_file_of_another_kind_is_refused_with_what_takes_it(slot, files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    before = sorted(os.listdir())
    for name in TAKES.keys() - SLOTS[slot] - (set() if slot in FEW else RARE):
        line = refusal(capsys, slot.replace("FILE", name).split())
        assert name in line, (slot, line)
        answers = TAKES[name], "magtwin ", "give ", "name "
        assert any(answer in line for answer in answers), (slot, line)
        if name.endswith((".toml", ".urdf")):
            assert TAKES[name] in line or "author it first" in line or "--out" in line, (slot, line)
    assert sorted(os.listdir()) == before


def test_each_kind_is_recognised_and_taken_by_a_reader(files):
    known = {name: kind_of(files / name) for name in TAKES}
    assert None not in known.values()
    taken = {kind for kinds in ACCEPTED.values() for kind in kinds}
    made = {known[name] for name in TAKES} - taken
    assert {kind.noun for kind in made} == {
        "a Python file",
        "a bag of ROS 1",
        "a page",
        "a picture or film",
        "a network as ONNX, which runs without magtwin",
        "the folder of a scene",
        "the folder of a robot",
        "a YAML",
        "an occupancy map of map_server",
        "the description of a bag",
        "a mesh",
        "a world or model of Gazebo",
        "an archive",
    }


@pytest.mark.parametrize("slot", SLOTS)
def test_an_empty_file_is_refused_as_empty(slot, files, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(files)
    accepted = sorted(name for name in SLOTS[slot] if (files / name).is_file())
    empty = tmp_path / f"empty{Path(accepted[0]).suffix if accepted else '.txt'}"
    empty.touch()
    line = refusal(capsys, slot.replace("FILE", str(empty)).split())
    assert "empty" in line


LONG, BYTES = "n" * 300, os.fsdecode(b"b\xff\xfe")


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["new", f"{LONG}.toml"], "305 characters is too long for a file; shorten it"),
        (["convert", "run.npz", f"{LONG}.csv"], "too long for a file; shorten it"),
        (["run", LONG], "too long for a file; shorten it"),
        (["scene", LONG, "--out", "new"], "too long for a file; shorten it"),
        (["train", LONG, "--out", "new.safetensors"], "too long for a file; shorten it"),
        (["info", f"{LONG}.usda"], "File name too long"),
        (
            ["info", "-x.npz"],
            "-x.npz: begins with a dash, so it is read as an option; for a file write ./-x.npz",
        ),
        (["convert", "run.npz", "--out", "-y.csv"], "for a file write ./-y.csv"),
        (["new", f"{BYTES}.toml"], "its name is not UTF-8"),
        (["convert", "run.npz", f"{BYTES}.parquet"], "its name is not UTF-8"),
        (["robot", "robot.urdf", "--out", BYTES], "its name is not UTF-8"),
        (["convert", "run.npz", "page.html/new.csv"], "page.html/new.csv: cannot be written"),
        (
            ["convert", "run.npz", "path.csv"],
            "path.csv: exists already; give --force to replace it, or another name",
        ),
        (
            ["run", "lab", "--out", "new.json"],
            "new.json: a released package is read, not written; give one of",
        ),
        (
            ["convert", "run.npz", "new.json"],
            "new.json: a released package is read, not written; give one of",
        ),
        (["robot", "robot.urdf", "--out", "set"], "set: exists already; give --force"),
        (["run", "lab", "--duration-s", "nan", "--out", "new"], "--duration-s must be above 0 s and finite"),
        (
            ["run", "lab", "--speed", "1e9", "--out", "new"],
            "--speed must be above 0 m/s and at most the drive's",
        ),
        (["sweep", "lab", "--count", "1e12", "--out", "new"], "a whole number is wanted, got '1e12'"),
        (
            ["sweep", "lab", "--count", "1000000000000", "--out", "new"],
            "too many for one sweep (at most 1,000,000)",
        ),
        (
            ["picture", "map.usdc", "--size", "1000000x1000000", "--out", "new.png"],
            "must lie in 16..16384 pixels",
        ),
    ],
    ids=lambda value: None if isinstance(value, list) else value[:30],
)
def test_odd_names_and_huge_numbers_are_refused_with_the_remedy(command, text, files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    before = sorted(os.listdir())
    assert text in refusal(capsys, command)
    assert sorted(os.listdir()) == before
