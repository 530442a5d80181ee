"""What tests of commands share: a file of each kind, and the one line with which a command is refused."""

import os
import pickle
import shutil
import zipfile
from functools import partial

import numpy as np
import pytest
from refusing import refused

from magtwin.files.file import shipped
from magtwin.run.run import Run

TEXTS = {
    "room.toml": 'name = "room"\n[lab]\nfloor_m = [4.0, 3.0]\n',
    "suite.toml": '[[scenario]]\nname = "a"\n',
    "settings.toml": "[drive]\nwheel_radius_m = 0.03\n",
    "training.toml": 'model = "linear"\n',
    "robot.urdf": '<robot name="r"><link name="a"/></robot>',
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
    "cart/cart.usda": "#usda 1.0\n",
    "drives/runs.csv": "file\n",
    "set/dataset.json": "{}",
    "results/suite.json": "{}",
    "survey/0_map.csv": "x,y\n",
    "room/room.usda": "#usda 1.0\n",
}


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """A folder with a small file of each kind, which no test changes."""
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "cart" / "payloads").mkdir(parents=True)
    for name, text in TEXTS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    for name in ("picture.png", "net.safetensors", "net.pth", "net.onnx"):
        (folder / name).write_bytes(b"abcdefghij")
    shutil.copy(shipped("maps", "lab", "lab.usdc"), folder / "map.usdc")
    run = Run({"t": np.arange(20) * 0.1, "b_total_nt": np.full(20, 5e4)}, {"seed": 1})
    for name in ("run.npz", "run.parquet", "run.csv"):
        run.save(folder / name)
    return folder


class Evil:
    """Unpickled, it would make a file."""

    def __reduce__(self):
        return open, ("executed", "w")


@pytest.fixture(scope="session")
def odd(files, tmp_path_factory):
    """A copy of that folder with files that are refused for what is in them, a pipe and a circle of links."""
    folder = shutil.copytree(files, tmp_path_factory.mktemp("odd") / "here")
    for name, text in {
        "far.csv": "0,0\n1,0\n4.75,0\n",
        "points.csv": "x,y,heading,field\n"
        + "".join(f"{x},{y},0,{50000 + 90 * x + 40 * y * y}\n" for x in range(5) for y in range(5)),
        "key.toml": shipped("scenes", "lab.toml").read_text().replace("[lab]", "[labb]", 1),
        "empty.toml": "",
        "a.txt": "",
    }.items():
        (folder / name).write_text(text)
    with zipfile.ZipFile(folder / "evil.pth", "w") as archive:
        archive.writestr("evil/data.pkl", pickle.dumps(Evil(), protocol=2))
        archive.writestr("evil/version", "3\n")
    (folder / "taken.png").mkdir()
    os.mkfifo(folder / "pipe.parquet")
    (folder / "loop").symlink_to("loop")
    return folder


@pytest.fixture
def refusal(capsys):
    """A function that gives the one line with which a command is refused."""
    return partial(refused, capsys)
