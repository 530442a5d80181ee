"""Exports in Blender: everything that is shown arrives with its material, lit, and nothing else arrives.

Needs a Python with bpy, which MAGTWIN_BLENDER names: `make blender`.
"""

import json
import os
import subprocess
from pathlib import Path

import pytest
from looking import assert_lit, assert_looks_alike, assert_within_room, bounds, shown_gprims
from numpy.testing import assert_allclose
from pxr import Usd

from magtwin.author.scene import author_scene
from magtwin.author.scene_file import scene_from_toml
from magtwin.export.package import export_scene
from magtwin.field.survey.nodes import read_survey
from magtwin.files.file import shipped
from magtwin.spec.lab import LabSpec
from magtwin.urdf.convert import convert_urdf
from magtwin.usd.maps.layer import save_map

BLENDER = os.environ.get("MAGTWIN_BLENDER", "")
SCRIPT = Path(__file__).resolve().parents[1] / "in_blender.py"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BLENDER, reason="MAGTWIN_BLENDER names no Python with bpy; run make blender"),
]


def in_blender(stage: Path) -> dict:
    """What Blender imports of a stage."""
    done = subprocess.run(
        [BLENDER, SCRIPT, "report", stage], capture_output=True, check=True, text=True, cwd=stage.parent
    )
    return json.loads(done.stdout.splitlines()[-1])


def assert_arrives(root: Path) -> dict:
    """Blender has as many meshes as are shown, each with its material, within the same box."""
    seen, stage = in_blender(root), Usd.Stage.Open(str(root))
    shown = shown_gprims(stage)
    assert seen["without_material"] == []
    assert seen["meshes"] == len(shown)
    low, high = bounds(shown)
    assert_allclose(seen["low"], low, atol=2e-3)  # a turned cylinder's box differs
    assert_allclose(seen["high"], high, atol=2e-3)
    return seen


@pytest.fixture(scope="module")
def aprilab(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The APRILab lab with its own map."""
    home = tmp_path_factory.mktemp("aprilab")
    save_map(read_survey(real_data / "aprilab" / "maps", name="aprilab", licence="MIT")[0], home / "map.usdc")
    scene = scene_from_toml(shipped("scenes", "aprilab.toml"), map_layer=home / "map.usdc")
    return author_scene(scene, home / "aprilab")


@pytest.mark.parametrize(
    ("out", "profile"),
    [("a", "omniverse"), ("a.usdz", "omniverse"), ("a", "isaac"), ("a", "newton"), ("a.usdc", "viewer")],
)
@pytest.mark.parametrize("which", ["lab", "aprilab"])
def test_blender_imports_an_export_as_it_is(which, out, profile, request, tmp_path):
    lab = shipped("scenes", "lab", "lab.usda") if which == "lab" else request.getfixturevalue("aprilab")
    root = export_scene(lab, tmp_path / out, profile=profile, trusted=True).root
    stage = assert_looks_alike(root)
    assert_lit(stage)
    if which == "lab":
        assert_within_room(stage, LabSpec(floor_m=(6.0, 3.5), apron_m=2.0), top_m=3.0)
    seen = assert_arrives(root)
    assert len(seen["lamps_w"]) == 4
    assert all(5 <= power <= 100 for power in seen["lamps_w"])
    assert 0.1 <= seen["sky"] <= 2


def test_blender_imports_the_converted_turtlebot4_as_it_is(real_data, tmp_path):
    robot = convert_urdf(real_data / "turtlebot4" / "turtlebot4.urdf", tmp_path / "turtlebot4.usda")
    assert_looks_alike(robot)
    assert_arrives(robot)
