"""A run as USD playback."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Gf, Usd, UsdGeom
from test_run import assert_same, every_column
from validators import assert_valid

from magtwin.author.scene import author_scene
from magtwin.errors import InputError
from magtwin.run.run import COLUMNS, Column, Run
from magtwin.spec.robot import PlacedRobot
from magtwin.twin import open_twin, simulate
from magtwin.usd import trial
from magtwin.usd.animation import read_animation, write_animation
from magtwin.usd.geometry import read_links
from magtwin.usd.layers import open_stage

MAGNETOMETER = "/World/turtlebot4/magnetometer_link/magnetometer"


@pytest.fixture(scope="module")
def run(lab_scene):
    """Six seconds along the figure of eight, with a bump and a lost lock put in."""
    run = simulate(open_twin(lab_scene, magnetometer="physical"), "figure8", seed=3, duration_s=6.0)
    bump, lock = np.zeros((2, run.rows), bool)
    bump[100:103], lock[[7, 400]] = True, True
    return run.with_columns(flag_bump=bump, flag_lost_lock=lock)


@pytest.fixture(scope="module")
def played(run, lab_scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("played") / "run.usd"
    write_animation(run, path, lab_scene)
    return path


def world_pose(stage, path, code):
    matrix = UsdGeom.XformCache(code).GetLocalToWorldTransform(stage.GetPrimAtPath(path))
    q = matrix.RemoveScaleShear().ExtractRotationQuat()
    return np.array(matrix.ExtractTranslation()), np.array([*q.GetImaginary(), q.GetReal()])


def test_the_stage_shows_base_link_where_the_run_has_it_at_every_frame(run, played):
    stage = Usd.Stage.Open(str(played))
    frames = run.resample(rate_hz=30)
    for code in range(0, frames.rows, 7):
        p, q = world_pose(stage, "/World/turtlebot4/base_link", code)
        assert_allclose(p, frames["p_world_base"][code], atol=1e-12)
        assert_allclose(abs(q @ frames["q_world_base_xyzw"][code]), 1, atol=1e-12)


@pytest.mark.usefixtures("allow_neighbours")
def test_wheels_turn_about_their_axles_by_the_runs_angles(run, played):
    stage, links = Usd.Stage.Open(str(played)), read_links(str(played))
    frames = run.resample(rate_hz=30)
    for side, name in enumerate(("left_wheel", "right_wheel")):
        prim = stage.GetPrimAtPath(f"/World/turtlebot4/{name}")
        rest = UsdGeom.Xformable(prim).GetLocalTransformation(Usd.TimeCode(0))
        rest = Gf.Matrix4d(Gf.Rotation(Gf.Vec3d(links[name].axis_link), 0), Gf.Vec3d(0)) * rest
        for code in (0, 50, 170):
            now = UsdGeom.Xformable(prim).GetLocalTransformation(Usd.TimeCode(code))
            turn = np.rad2deg(frames["wheel_angle"][code, side] - frames["wheel_angle"][0, side])
            wanted = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(links[name].axis_link), turn)) * rest
            assert_allclose(np.array(now), np.array(wanted), atol=1e-9)
        assert abs(frames["wheel_angle"][170, side]) > 1


def test_the_magnetometers_prim_gives_its_readings_over_time(run, played):
    stage = Usd.Stage.Open(str(played))
    prim = stage.GetPrimAtPath(MAGNETOMETER)
    frames = run.resample(rate_hz=30)
    for name in ("b_total_nt", "b_measured_nt", "b_map_nt", "b_disturbance_nt"):
        words = name.removesuffix("_nt").split("_")
        attribute = prim.GetAttribute(f"magtwin:magnetometer:b{words[1].capitalize()}Nt")
        assert attribute.Get(40) == frames[name][40]
        assert attribute.GetMetadata("customData")["unit"] == "nT"
        assert attribute.GetDocumentation() == COLUMNS[name].doc
    vector = prim.GetAttribute("magtwin:magnetometer:bVectorNt").Get(40)
    assert_allclose(vector, frames["b_vector_nt"][40])


@pytest.mark.parametrize(("name", "fps"), [("a.usd", 30.0), ("a.usda", 10.0), ("a.usdc", None)])
def test_a_run_comes_back_to_the_last_bit_at_whatever_frame_rate(name, fps, lab_scene, tmp_path):
    spec = Column("K", "", "temperature of the head")
    run = every_column(start_s=1.7e9).with_columns(est_n=np.arange(40), head_k=np.arange(40.0))
    run = run.with_specs(head_k=spec).with_metadata(network="größe", seed=2**70, quick=True, speed=0.1)
    run["v_cmd"][:4] = [np.inf, -np.inf, -0.0, 5e-324]
    write_animation(run, tmp_path / name, lab_scene, fps=fps)
    again = read_animation(tmp_path / name)
    assert_same(run, again)
    assert dict(again.metadata) == dict(run.metadata)
    assert again.spec("head_k") == spec
    stage = Usd.Stage.Open(str(tmp_path / name))
    assert 0 < stage.GetEndTimeCode() < 100  # counted from the run's own start, not from 1970


def test_the_run_is_read_without_its_scene_and_plays_without_one(run, lab_scene, tmp_path):
    write_animation(run, tmp_path / "far" / "run.usdc", lab_scene)
    (tmp_path / "far" / "run.usdc").rename(tmp_path / "run.usdc")  # its sublayer is not there now
    assert_same(read_animation(tmp_path / "run.usdc"), run)
    write_animation(run, tmp_path / "bare.usda")
    stage = Usd.Stage.Open(str(tmp_path / "bare.usda"))
    p, _ = world_pose(stage, "/World/robot/magnetometer", 60)
    assert_allclose(p, run.resample(rate_hz=30)["p_world_base"][60], atol=1e-12)
    assert (
        stage.GetPrimAtPath("/World/robot/magnetometer").GetAttribute("magtwin:magnetometer:bTotalNt").Get(3)
    )


def test_a_recording_without_the_truth_is_played_by_motion_capture(run, lab_scene, tmp_path):
    kept = run.select("mocap_p", "mocap_q_xyzw", "b_measured_nt")
    holes = kept["mocap_p"].copy()
    holes[:100] = np.nan
    kept = kept.with_columns(mocap_p=holes)
    write_animation(kept, tmp_path / "run.usdc", lab_scene)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    p, _ = world_pose(stage, "/World/turtlebot4/base_link", 120)
    assert_allclose(p, kept["mocap_p"][540], atol=1e-3)
    samples = stage.GetPrimAtPath("/World/turtlebot4").GetAttribute("xformOp:translate").GetTimeSamples()
    assert samples[0] == np.ceil(kept["t"][100] * 30)
    assert_same(read_animation(tmp_path / "run.usdc"), kept)


def test_the_validators_find_nothing(played, tmp_path):
    assert_valid(played, tmp_path)


def test_bare_usd_core_opens_it_where_magtwin_was_never_imported(run, played):
    code = f"""
import sys
from pxr import Usd
stage = Usd.Stage.Open({str(played)!r})
values = stage.GetPrimAtPath("/World/Run").GetAttribute("magtwin:run:b_total_nt").Get()
prim = stage.GetPrimAtPath({MAGNETOMETER!r})
first = prim.GetAttribute("magtwin:magnetometer:bTotalNt").Get(0.0)
print(len(values), values[5], first, "magtwin" in sys.modules)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rows, value, first, imported = said.stdout.split()
    assert (int(rows), imported) == (run.rows, "False")
    assert float(value) == run["b_total_nt"][5]
    assert float(first) == run["b_total_nt"][0]


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ({"b_total_nt": np.zeros(2)}, {}, "has no pose of the robot; it needs p_world_base and"),
        ({"t": [1.0, 1.0]}, {}, "row 1 has 1 s after 1 s"),
        ({"t": []}, {}, "no rows, there is nothing to play"),
        (
            {"odom_p": np.zeros((2, 3)), "odom_q_xyzw": np.ones((2, 4)), "a b": np.zeros(2)},
            {},
            "'a b' cannot",
        ),
        ({}, {"fps": 0.0}, "fps must be above 0"),
        ({}, {"fps": float("nan")}, "fps must be above 0"),
    ],
)
def test_a_run_that_cannot_be_played_is_refused_and_nothing_is_written(columns, options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_animation(Run({"t": [0.0, 1.0], **columns}), tmp_path / "run.usd", **options)
    assert not list(tmp_path.iterdir())


def test_a_part_of_the_scene_is_never_replaced_by_what_plays_in_it(run, lab_scene):
    before = lab_scene.read_bytes()
    for part in (lab_scene, lab_scene.with_name("room.usda")):
        with pytest.raises(InputError, match="is a part of the scene; give another name"):
            write_animation(run, part, lab_scene, force=True)
    assert lab_scene.read_bytes() == before


def test_files_that_play_nothing_or_are_damaged_are_refused(played, lab_scene, tmp_path):
    with pytest.raises(InputError, match="plays no run: it has no prim /World/Run"):
        read_animation(lab_scene)
    (tmp_path / "cut.usdc").write_bytes(played.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"cut\.usdc: cannot be opened as USD"):
        read_animation(tmp_path / "cut.usdc")
    (tmp_path / "text.usda").write_text("#usda 1.0\nnonsense\n")
    with pytest.raises(InputError, match=r"text\.usda: cannot be opened as USD"):
        read_animation(tmp_path / "text.usda")
    with pytest.raises(InputError, match="no such USD file"):
        read_animation(tmp_path / "none.usd")


def test_a_file_that_ends_the_process_of_usds_own_reader_is_refused_in_a_line(played, tmp_path, monkeypatch):
    (tmp_path / "crash.py").write_text("import os; os.abort()")
    monkeypatch.setattr(trial, "PROGRAM", tmp_path / "crash.py")
    monkeypatch.setattr(trial, "_TRIAL", trial._Trial())
    with pytest.raises(InputError, match="damaged: USD crashes on it"):
        read_animation(played)
    assert open_stage(played, own=True).GetRootLayer().realPath == str(played.resolve())


T2 = "double[] magtwin:run:t = [0, 1]\n"
P1 = 'double[] magtwin:run:odom_p = [0] (customData = {string parts = "x,y,z"})'


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (f'{T2}string magtwin:run:yaw = "x"', "an array of numbers, got string"),
        ("double[] magtwin:run:yaw = [0, 1]", "not a Run: column 't' is missing"),
        ("double[] magtwin:run:t = [1, 0]", "row 1 has 0 s after 1 s"),
        (f"{T2}double[] magtwin:run:yaw = [0]", "damaged run: columns"),
        (f"{T2}{P1}", "has 1 numbers in rows of 3"),
    ],
)
def test_runs_that_contradict_themselves_are_refused(body, words, tmp_path):
    text = f'#usda 1.0\n(defaultPrim = "World")\ndef "World"\n{{\ndef "Run"\n{{\n{body}\n}}\n}}\n'
    (tmp_path / "run.usda").write_text(text)
    with pytest.raises(InputError, match=words):
        read_animation(tmp_path / "run.usda")


def test_two_robots_play_in_one_stage_a_layer_each(lab_scene, run, tmp_path):
    """The second layer is over the first one's, which goes on playing below it."""
    scene = open_twin(lab_scene, magnetometer="physical").scene
    second = PlacedRobot(robot=replace(scene.robot, name="second"), start=(1.0, -0.5, 0.0))
    both = author_scene(replace(scene, others=(second,)), tmp_path / "two")
    shifted = run.with_columns(p_world_base=run["p_world_base"] + (0.3, 0.2, 0)).with_metadata(robot="second")
    write_animation(run, tmp_path / "one.usdc", both)
    write_animation(shifted, tmp_path / "two.usdc", tmp_path / "one.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "two.usdc"))
    for name, ran in (("turtlebot4", run), ("second", shifted)):
        p, _ = world_pose(stage, f"/World/{name}/base_link", 90)
        assert_allclose(p, ran.resample([3.0])["p_world_base"][0], atol=1e-12)
    assert_same(read_animation(tmp_path / "two.usdc"), shifted)
    with pytest.raises(InputError, match="no robot 'secnd'; did you mean 'second'"):
        write_animation(run.with_metadata(robot="secnd"), tmp_path / "no.usdc", both)
