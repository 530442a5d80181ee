"""Scripts for other engines: in Newton's own loop, with nothing of magtwin, one reads what the twin reads."""

import ast
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import TESTS

from magtwin.export.package import export_scene
from magtwin.path import figure8
from magtwin.run.run import Run
from magtwin.sim.motion.follow import follow
from magtwin.twin import open_twin, simulate

SCRIPTS = Path(importlib.util.find_spec("magtwin.export").origin).parent / "scripts"

LACKING = [
    name
    for name in ("newton", "newton_usd_schemas", "mujoco", "onnx", "onnxruntime")
    if importlib.util.find_spec(name) is None
]

lacking = pytest.mark.skipif(
    bool(LACKING), reason=f"{', '.join(LACKING)} not installed: pip install 'magtwin[physics,onnx]'"
)


@pytest.mark.parametrize("script", ["magnetometer.py", "newton_magnetometer.py", "isaac_magnetometer.py"])
def test_scripts_need_nothing_of_magtwin(script):
    tree = ast.parse((SCRIPTS / script).read_text())
    names = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not any(name.split(".")[0] in ("magtwin", "torch") for name in names)


def test_the_script_for_isaac_sim_is_sound_beside_stand_ins_for_isaac_sims_classes(lab_scene, tmp_path):
    pytest.importorskip("onnxruntime")
    from magtwin.learn.inference.onnx import export_onnx

    twin = open_twin(lab_scene)
    export_onnx(twin.scene.robot.magnetometer.network, tmp_path / "lab.onnx")
    stand_in, script = TESTS / "isaac_stand_in.py", SCRIPTS / "isaac_magnetometer.py"
    arguments = [lab_scene, tmp_path / "lab.onnx", tmp_path / "readings.csv"]
    done = subprocess.run(
        [sys.executable, stand_in, script, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    seen = np.genfromtxt(tmp_path / "readings.csv", delimiter=",", names=True)
    _, aside = figure8().nearest(np.column_stack([seen["x"], seen["y"]]))
    assert np.abs(aside).max() < 0.02
    assert abs(seen["t"][-1] * 0.2 - figure8().length) < 0.1
    at = np.column_stack([seen["x"], seen["y"]])
    assert np.allclose(seen["b_map_nt"], twin.field.lookup(at, seen["yaw"]), atol=0.1)
    assert np.ptp(seen["b_disturbance_nt"]) > 1000
    assert np.allclose(seen["b_total_nt"], seen["b_map_nt"] + seen["b_disturbance_nt"], atol=1e-5)


@pytest.fixture(scope="module")
def driven(lab_scene, tmp_path_factory):
    """The exported stage's own script run in its folder, and what it wrote."""
    from magtwin.learn.inference.onnx import export_onnx

    folder = tmp_path_factory.mktemp("newton") / "lab"
    export_scene(lab_scene, folder, profile="newton", to_onnx=export_onnx, trusted=True)
    shutil.rmtree(folder / "plugin")  # needs no schema of magtwin's either
    (network,) = folder.rglob("*.onnx")
    done = subprocess.run(
        [sys.executable, "newton_magnetometer.py", f"{lab_scene.stem}.usda", network, "readings.csv"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "readings in" in done.stdout.splitlines()[-1]
    return np.genfromtxt(folder / "readings.csv", delimiter=",", names=True)


def rms(error):
    return float(np.sqrt(np.mean(np.square(error))))


@pytest.mark.physics
@lacking
def test_the_robot_in_newton_is_where_the_kinematic_one_is_within_5_cm_at_equal_times(driven, lab_scene):
    drive = open_twin(lab_scene, network="none").scene.robot.drive
    motion = follow(figure8(), drive, speed=0.2)
    assert abs(motion.duration_s - driven["t"][-1]) < 1.0
    t = driven["t"][driven["t"] < motion.duration_s]
    seen = motion.at(t)
    apart = np.hypot(seen.pose[:, 0] - driven["x"][: len(t)], seen.pose[:, 1] - driven["y"][: len(t)])
    assert rms(apart) < 0.03  # the requirement is 0.05


@pytest.mark.physics
@lacking
@pytest.mark.parametrize("seed", [1, 2])
def test_map_and_network_in_newton_are_the_kinematic_simulators_within_150_nt_at_equal_poses(
    driven, lab_scene, seed
):
    zero = np.zeros(len(driven))
    poses = {
        "t": driven["t"],
        "p_world_base": np.column_stack([driven["x"], driven["y"], zero]),
        "yaw": driven["yaw"],
        "v_cmd": driven["v_cmd"],
        "w_cmd": driven["w_cmd"],
    }
    twin = open_twin(lab_scene)
    # the stage is the robot of the survey; its readings are at those poses, to rounding
    run = simulate(twin, Run(poses), seed=seed, session="survey", rate_hz=50)
    assert len(run["t"]) == len(driven)
    assert rms(run["b_map_nt"] - driven["b_map_nt"]) < 0.1
    assert np.ptp(driven["b_disturbance_nt"]) > 1000
    assert rms(run["b_total_nt"] - driven["b_total_nt"]) < 80  # the requirement is 150
    assert np.allclose(driven["b_total_nt"], driven["b_map_nt"] + driven["b_disturbance_nt"], atol=1e-5)
    assert (driven["b_sd_nt"] > 0).all()
