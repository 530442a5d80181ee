"""Files of the wrong kind, empty files, odd names and huge numbers: every command answers in one line."""

import os
from pathlib import Path

import pytest

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
    "net.pth": "magtwin model convert net.pth",
    "net.onnx": ".safetensors",
    "model.json": "magtwin model compensate apply",
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
    "drive.bag": "magtwin info drive.bag",
}
"""What the refusal of each file names."""

RARE = {"run.csv", "cart", "controllers.yaml", "floor.yaml", "metadata.yaml", "mesh.stl", "world.sdf"}
RARE |= {"data.zip", "drive.bag"}
"""Files that are tried with a few commands only: what they are decides, not the command."""

FEW = ("run FILE", "scene FILE --out new", "robot FILE --out new", "info FILE")
"""Those commands."""

RUNS = {"run.npz", "run.parquet", "run.csv", "map.usdc", "model.json", "drive.bag"}
"""Files that a reader of runs opens: stages and JSON may hold one."""

TABLES = {"run.npz", "run.parquet", "run.csv", "commands.csv", "path.csv", "drive.bag"}
SLOTS = {
    "run FILE": {"map.usdc", "room", "cart"},
    "sweep FILE --out new": {"map.usdc", "room", "cart"},
    "map import FILE --out new.parquet": TABLES | {"survey", "drives"},
    "map survey FILE --out new.usdc": {"map.usdc", "room", "cart"},
    "export FILE --out new": {"map.usdc", "room", "cart"},
    "run lab --path FILE --out new": RUNS | {"path.csv", "commands.csv"},
    "scene FILE --out new": {"room.toml"},
    "scene --urdf FILE --out new": {"robot.urdf", "map.usdc"},
    "robot FILE --out new": {"robot.urdf"},
    "robot robot.urdf --settings FILE --out new": {"settings.toml"},
    "info FILE": RUNS | {"room", "cart", "net.safetensors", "net.pth", "net.onnx", "survey"},
    "convert FILE new.csv": RUNS,
    "compare FILE run.npz": RUNS,
    "compare run.npz FILE": RUNS,
    "reproduce FILE": RUNS,
    "plot FILE --out new.gif": RUNS,
    "localize FILE --map lab --out new": RUNS,
    "model compensate fit FILE --out new.json": RUNS,
    "model compensate apply run.parquet FILE --out new.parquet": {"model.json"},
    "dataset info FILE": {"set"},
    "train FILE --out new.safetensors": {"set"},
    "train set --config FILE --out new.safetensors": {"training.toml"},
    "model export FILE --out new.onnx": {"net.safetensors", "net.pth"},
    "model convert FILE --out new.safetensors": {"net.safetensors", "net.pth"},
    "model widen FILE --runs run.npz --map map.usdc --out new.safetensors": {"net.safetensors", "net.pth"},
    "evaluate FILE --runs run.npz --map map.usdc --out new": {"net.safetensors", "net.pth"},
    "bench FILE --out new": {"suite.toml"},
    "bench report FILE --out new": {"results"},
    "bench compare FILE results": {"results"},
    "validate FILE --against core": {"map.usdc", "room", "cart"},
}
"""Commands, each with the files that it may open."""


@pytest.mark.parametrize("slot", SLOTS)
def test_a_file_of_another_kind_is_refused_with_what_takes_it(slot, files, refusal, monkeypatch):
    monkeypatch.chdir(files)
    before = sorted(os.listdir())
    for name in TAKES.keys() - SLOTS[slot] - (set() if slot in FEW else RARE):
        line = refusal(*slot.replace("FILE", name).split())
        assert name in line, (slot, line)
        answers = TAKES[name], "magtwin ", "give ", "name "
        assert any(answer in line for answer in answers), (slot, line)
        if name.endswith((".toml", ".urdf")):
            assert TAKES[name] in line or "author it first" in line or "--out" in line, (slot, line)
    assert sorted(os.listdir()) == before


@pytest.mark.parametrize("slot", SLOTS)
def test_an_empty_file_is_refused_as_empty(slot, files, refusal, monkeypatch, tmp_path):
    monkeypatch.chdir(files)
    accepted = sorted(name for name in SLOTS[slot] if (files / name).is_file())
    empty = tmp_path / f"empty{Path(accepted[0]).suffix if accepted else '.txt'}"
    empty.touch()
    line = refusal(*slot.replace("FILE", str(empty)).split())
    assert "empty" in line
