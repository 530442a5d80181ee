"""Converted robots in Newton (extra `physics`): they go where they are told.

The first run of a machine compiles Newton's kernels, about a minute; later ones take seconds.
"""

import importlib.util
import json
import subprocess
import sys

import pytest
from made import urdf
from numpy.testing import assert_allclose
from places import TESTS

from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.options import Options

LACKING = [
    name for name in ("newton", "newton_usd_schemas", "mujoco_warp") if importlib.util.find_spec(name) is None
]

pytestmark = [
    pytest.mark.physics,
    pytest.mark.skipif(
        bool(LACKING), reason=f"{', '.join(LACKING)} not installed: pip install magtwin[physics]"
    ),
]

RADIUS, SEPARATION = 0.03575, 0.233
"""Of the TurtleBot 4's wheels, by create3's control.yaml [m]."""


def simulate(stage_file, folder, **job):
    """What `newton_drive.py` sees of a job."""
    job = {"rate_hz": 240, "settle_s": 0.5, "height_m": 0.006, "ground_friction": 0.05} | job
    (folder / "job.json").write_text(json.dumps(job))
    script = TESTS / "newton_drive.py"
    done = subprocess.run(
        [sys.executable, script, stage_file, folder / "job.json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def wheel_speeds(v, w):
    """Speeds of the wheels that make a twist of v [m/s] and w [rad/s]."""
    left, right = (v - w * SEPARATION / 2) / RADIUS, (v + w * SEPARATION / 2) / RADIUS
    return {"left_wheel_joint": left, "right_wheel_joint": right}


@pytest.mark.parametrize("merge", [False, True])
def test_the_real_robot_goes_as_far_and_turns_as_much_as_it_is_told(tmp_path, real_data, merge):
    stage_file = convert_urdf(
        real_data / "turtlebot4" / "turtlebot4.urdf",
        tmp_path / "turtlebot4.usda",
        options=Options(profile="diff-drive", merge_fixed=merge),
    )
    seen = simulate(
        stage_file,
        tmp_path,
        trials=[
            {"seconds": 2, "speeds": wheel_speeds(0.306, 0)},
            {"seconds": 2, "speeds": wheel_speeds(0, 1)},
            {"seconds": 1, "speeds": {}},
        ],
    )
    ahead, turn, still = seen["trials"]
    assert_allclose(seen["mass_kg"], 5.39, rtol=1e-5)
    assert seen["dofs"] == 6 + 2
    assert seen["bodies"] == (3 if merge else 41)
    assert_allclose(ahead["forward_m"], 0.612, rtol=0.03)
    assert abs(ahead["turned_rad"]) < 0.02
    assert_allclose(turn["turned_rad"], 2.0, rtol=0.08)
    assert turn["forward_m"] < 0.02
    for trial in (ahead, turn, still):
        assert abs(trial["rise_m"]) < 1e-3  # nothing sinks, hops or tips
    assert still["forward_m"] < 1e-3
    for name, speed in wheel_speeds(0.306, 0).items():
        assert_allclose(ahead["rates"][name], speed, rtol=0.01)


GRIPPER = """<link name="palm">{BODY}</link><link name="left">{BODY}</link><link name="right">{BODY}</link>
<joint name="turn" type="revolute"><parent link="palm"/><child link="left"/><origin xyz="0 0.5 0"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="200" velocity="9"/></joint>
<joint name="follow" type="revolute"><parent link="palm"/><child link="right"/><origin xyz="0 -0.5 0"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="200" velocity="9"/>
  <mimic joint="turn" multiplier="-0.5" offset="0.1"/></joint>"""


def test_a_bolted_base_stays_and_a_mimic_follows_its_leader(tmp_path):
    path = urdf(tmp_path, GRIPPER, "gripper")
    stage_file = convert_urdf(path, tmp_path / "gripper.usda", options=Options(fix_base=True))
    seen = simulate(
        stage_file,
        tmp_path,
        ground_friction=None,
        height_m=1.0,
        trials=[{"seconds": 3, "speeds": {}, "positions": {"turn": 0.6}}],
    )
    (trial,) = seen["trials"]
    assert seen["dofs"] == 2
    assert abs(trial["rise_m"]) < 1e-4
    assert_allclose(trial["positions"]["turn"], 0.6, atol=0.02)  # two bodies on a drive of 100 N m/rad
    assert_allclose(trial["positions"]["follow"], 0.1 - 0.5 * trial["positions"]["turn"], atol=0.01)


SLED = """<link name="rail"/><link name="sled">{BODY}</link><link name="free">{BODY}</link>
<joint name="glide" type="planar"><parent link="rail"/><child link="sled"/><origin xyz="0 0 1"/>
  <axis xyz="0 0 1"/></joint>
<joint name="fly" type="floating"><parent link="sled"/><child link="free"/><origin xyz="0 0 3"/></joint>"""


def test_a_planar_joint_holds_against_gravity_and_a_floating_one_falls(tmp_path):
    path = urdf(tmp_path, SLED, "sled")
    stage_file = convert_urdf(path, tmp_path / "sled.usda", options=Options())
    seen = simulate(
        stage_file,
        tmp_path,
        settle_s=0,
        ground_friction=None,
        height_m=0.0,
        trials=[{"seconds": 0.2, "speeds": {}}],
    )
    assert seen["dofs"] == 3 + 6
    assert abs(seen["trials"][0]["rise_m"]) < 1e-4  # the sled, which is the first body
