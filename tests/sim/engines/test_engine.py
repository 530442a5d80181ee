"""Engines: kinematic, Newton and replay move one robot alike; scripts of commands; the human-like driver."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pxr import Gf, Usd, UsdGeom

from magtwin.cli import main
from magtwin.errors import InputError, RepairWarning
from magtwin.files.file import shipped
from magtwin.files.folders import allow
from magtwin.io.tables import read_parquet
from magtwin.path import figure8, path_named, sine
from magtwin.run.run import Run
from magtwin.sim.engines.newton import Newton
from magtwin.sim.engines.replay import replayed
from magtwin.sim.motion.commands import Commands, read_commands
from magtwin.sim.motion.controllers import guide_by_commands
from magtwin.sim.motion.driver import Driver
from magtwin.sim.motion.engine import KINEMATIC, Kinematic
from magtwin.sim.motion.follow import STAND, follow, loop_along, loop_by_commands, play
from magtwin.spec.drive import DriveSpec
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.twin import open_twin, simulate
from magtwin.twin.twin import without_tracking_error

DRIVE = DriveSpec()
NS = 1_700_000_000_000_000_000


def test_a_run_that_is_replayed_has_the_poses_of_the_run_to_the_last_bit(twin):
    path = figure8(half_length_m=0.6, half_width_m=0.3)
    first = simulate(twin, path, seed=3)
    again = simulate(twin, first, seed=3)
    assert_allclose(again["yaw"], first["yaw"], atol=1e-15)  # unwrapped, and wrapped again
    for name in ("t", "p_world_base", "v_base", "w_base", "v_cmd", "w_cmd", "flag_bump"):
        assert_array_equal(again[name], first[name], err_msg=name)
    assert again.metadata["engine"] == "replay"
    # what is computed from between the rows is the same too, to rounding, though torques jump there
    assert np.ptp(first["b_truth_nt"]) > 1000
    assert_allclose(again["b_truth_nt"], first["b_truth_nt"], atol=1e-8)
    for name in ("b_vector_nt", "imu_a", "imu_w", "odom_p", "odom_v", "mocap_p", "battery_v"):
        assert_allclose(again[name], first[name], atol=1e-9, err_msg=name)


def test_a_run_without_commands_is_not_replayed_for_a_network_that_reads_them(lab_scene):
    neural = open_twin(lab_scene)
    assert "lag_v" in neural.magnetometer.features
    t = np.arange(200) / 20.0
    p = np.column_stack([0.2 * t - 1, 0 * t, 0.05 + 0 * t])
    told = Run({"t": t, "p_world_base": p, "yaw": 0 * t})
    with pytest.raises(InputError, match="no column 'v_cmd', which the network turtlebot4_hybrid"):
        simulate(neural, told)
    paper = open_twin(lab_scene, network=shipped("weights", "turtlebot4_paper.safetensors"))
    assert np.isfinite(simulate(paper, told)["b_total_nt"]).all()


def test_a_replay_between_its_samples_is_the_drive_itself():
    motion = follow(figure8(half_length_m=0.6, half_width_m=0.3), DRIVE, speed=0.2)
    t = np.arange(0, motion.duration_s, 1 / 135)
    seen = motion.at(t)
    zero = np.zeros(len(t))
    run = Run(
        {
            "t": t,
            "p_world_base": np.column_stack([seen.pose[:, :2], zero]),
            "yaw": (seen.pose[:, 2] + np.pi) % (2 * np.pi) - np.pi,
            "v_base": np.column_stack([seen.v, zero, zero]),
            "w_base": np.column_stack([zero, zero, seen.w]),
            "wheel_angle": seen.wheel_angle,
        }
    )
    between = (t[:-1] + t[1:]) / 2
    got, want = replayed(run, DRIVE).at(between), motion.at(between)
    assert_allclose(got.pose, want.pose, atol=1e-4)
    assert_allclose(got.wheel_angle, want.wheel_angle, atol=1e-3)
    bare = Run({name: run[name] for name in ("t", "p_world_base", "yaw")})
    guessed = replayed(bare, DRIVE).at(between)
    assert_allclose(guessed.pose, want.pose, atol=2e-4)
    assert_allclose(guessed.wheel_angle, want.wheel_angle, atol=0.3)  # of 80 rad, by speeds of differences


@pytest.mark.parametrize(
    ("t", "x", "what"),
    [([0, 1, 1], [0, 1, 2], "row 3"), ([0, 1, 2], [0, np.nan, 2], "row 2"), ([0], [0], "at least two rows")],
)
def test_a_run_that_cannot_be_replayed_is_refused(t, x, what):
    zero = np.zeros(len(t))
    run = Run({"t": np.array(t, float), "p_world_base": np.column_stack([x, zero, zero]), "yaw": zero})
    with pytest.raises(InputError, match=what):
        replayed(run, DRIVE)


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ("t [ms],v [mm/s],w [deg/s]\n0,100,0\n500,200,90\n", "by the units in their names"),
        ("t_ms,v_mps,yaw_rate_dps\n0,.1,0\n500,.2,90\n", "t_ms, v_mps and yaw_rate_dps as t, v and w"),
        ("angular.z,linear.x,linear.y,time\n0,.1,0,0\n%r,.2,0,.5\n" % (np.pi / 2), "left out linear.y"),
        ("t,v,w [\u00b0/s]\n1.7e9,.1,0\n1700000000.5,.2,90\n", "counted from the first line"),
        (f"%time,v,w\n{NS},.1,0\n{NS + 500_000_000},.2,{np.pi / 2}\n", "in ns since 1970"),
        (";w [deg/s];v;t\n0;0,0;0,1;0,0\n1;90,0;0,2;0,5\n", "decimal commas"),
    ],
)
def test_commands_are_read_by_their_names_and_units_and_from_any_clock(tmp_path, text, note):
    (tmp_path / "c.csv").write_text(text, encoding="utf-8")
    with pytest.warns(RepairWarning, match=note):
        commands = read_commands(tmp_path / "c.csv")
    assert_allclose(commands.rows, [[0, 0.1, 0], [0.5, 0.2, np.pi / 2]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,left,right\n0,1,1\n", "no column of v .*wheel speeds"),
        ("t,v,steering\n0,1,1\n", "no column of w"),
        ("t,v [knots],w\n0,1,1\n", "in no unit of v"),
        ("t,v,w,w\n0,1,1,1\n", "2 columns are called 'w'"),
        ("t,v,w\n0,0.1,0\n0.5,0.1,0\n0.4,0.1,0\n", ":4: times must ascend"),
        ("0,nan,0\n", ":1: a command is three finite numbers"),
        ("0,0.1\n", ":1: a command is three numbers"),
        ("t,v,w\nx,y,z\n", ":2: t must be a number"),
        ("-1,0.1,0\n", ":1: times must ascend"),
        ("t,v,w\n", "no rows"),
    ],
)
def test_commands_that_make_no_sense_are_refused_with_their_line(tmp_path, text, words):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_commands(tmp_path / "c.csv")


def test_what_is_beyond_a_drive_is_said_and_limited():
    rows = np.array([[0, 0.5, 0], [0.1, 0.2, -3.0], [3.0, 0.9, 0.0]])
    said = Commands("fast.csv", rows).beyond(DRIVE)
    assert "2 of 3 commands have |v| above 0.306" in said
    assert "1 of 3 commands have |w| above 1.9" in said
    assert Commands("slow.csv", rows * [1, 0.1, 0.1]).beyond(DRIVE) == ""
    motion = play(rows, DRIVE)
    assert np.abs(motion.v).max() <= DRIVE.v_max
    assert np.abs(motion.w).max() <= DRIVE.w_max


def test_the_commands_of_a_drive_drive_it_again_to_the_last_bit():
    motion = follow(sine(x_first_m=-0.5, x_last_m=0.5, amplitude_m=0.2), DRIVE, speed=0.2)
    rows = np.column_stack([np.arange(len(motion.v)) * motion.dt, motion.v_cmd, motion.w_cmd])
    again = play(rows, DRIVE, start=motion.pose0, duration_s=motion.duration_s)
    assert_array_equal(again.poses[: len(motion.poses)], motion.poses)


def box(name, x, y, half):
    return name, [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]


def drive_about(seed, *, duration_s=300.0, obstacles, wheel_errors=(0.0, 0.0)):
    driver = Driver(
        DRIVE,
        np.random.default_rng(seed),
        lab=LabSpec(floor_m=(6.0, 3.5)),
        obstacles=obstacles,
        footprint_radius_m=0.171,
        start=(0.0, 0.0, 0.0),
        duration_s=duration_s,
    )
    loop = loop_by_commands(
        STAND, DRIVE, duration_s=duration_s, footprint_radius_m=0.171, wheel_errors=wheel_errors
    )
    return KINEMATIC.drive(loop, driver, obstacles)


ROOM = (box("desk", 1.5, 0.9, 0.4), box("chair", -1.2, -0.6, 0.2), box("cabinet", -2.7, 1.5, 0.25))
OBSTACLES = Obstacles(tuple(n for n, _ in ROOM), tuple(np.array(o) for _, o in ROOM))


@pytest.mark.parametrize("seed", range(3))
def test_a_driver_covers_the_floor_and_never_bumps(seed):
    errors = np.random.default_rng(seed).normal(0, [0.004, 0.006]).tolist()
    motion = drive_about(seed, obstacles=OBSTACLES, wheel_errors=tuple(errors))
    assert not motion.bump.any()
    distance, _ = OBSTACLES.clearance(motion.poses[:, :2])
    wall = np.min(np.array([3.0, 1.75]) - np.abs(motion.poses[:, :2]), axis=1)
    assert min(distance.min(), wall.min()) > 0.171
    cells = {tuple(c) for c in np.floor(motion.poses[:, :2] / 0.5).astype(int).tolist()}
    assert len(cells) >= 40  # of 84, of which it cannot come into those in the corners, and at obstacles
    going = motion.v[motion.v > 0.02]
    assert 0.4 < len(going) / len(motion.v) < 0.98  # it stands, too
    assert 0.1 < going.mean() < 0.25
    assert going.std() > 0.03
    assert np.abs(motion.w).max() <= DRIVE.w_max
    assert -0.4 < motion.w.mean() < 0.4
    assert motion.w.std() > 0.2


def test_run_drives_at_random_by_commands_and_by_replay(lab_scene, tmp_path, capsys):
    arguments = ["run", str(lab_scene), "--network", "none", "--json"]
    once, again = tmp_path / "a.parquet", tmp_path / "b.parquet"
    main([*arguments, "--path", "random", "--duration-s", "5", "--out", str(once)])
    main([*arguments, "--path", str(once), "--out", str(again)])
    assert_array_equal(read_parquet(once)["p_world_base"], read_parquet(again)["p_world_base"])
    (tmp_path / "c.csv").write_text("t,v,w\n0,0.5,0\n0.4,0,0\n")
    capsys.readouterr()
    main([*arguments[:-1], "--path", str(tmp_path / "c.csv"), "--out", str(tmp_path / "c.parquet")])
    assert "|v| above 0.306 m/s" in capsys.readouterr().err
    run = read_parquet(tmp_path / "c.parquet")
    assert 0.05 < run["p_world_base"][-1, 0] - run["p_world_base"][0, 0] < 0.2


PHYSICS = [
    pytest.mark.physics,
    pytest.mark.skipif(
        importlib.util.find_spec("newton") is None or importlib.util.find_spec("mujoco") is None,
        reason="newton is not installed: pip install magtwin[physics]",
    ),
]


def physics(test):
    for mark in PHYSICS:
        test = mark(test)
    return test


def by_equal_commands(twin, path, wheel_errors=(0.0, 0.0)):
    """What both engines make of the commands of a drive without slip, at the same times."""
    drive = replace(twin.scene.robot.drive, slip_s2_m=0.0, yaw_slip=0.0)
    course = replace(loop_along(path, drive, speed=0.2), wheel_errors=wheel_errors)
    want = Kinematic().drive(course, None, None)
    rows = np.column_stack([np.arange(len(want.v)) * course.dt, want.v_cmd, want.w_cmd])
    scripted = replace(course, guide=guide_by_commands(rows, drive), steps=len(want.v))
    got = Newton(twin.scene_file, twin.scene.robot).drive(scripted, None, None)
    t = np.arange(0, want.duration_s, 0.02)
    return want.at(t), got.at(t)


def rms_apart_m(a, b):
    return np.sqrt(np.mean(np.sum((a.pose - b.pose)[:, :2] ** 2, axis=1)))


@physics
@pytest.mark.parametrize("name", ["sine", "figure8", "lawnmower"])  # of 11, 15 and 38 m
def test_kinematic_and_newton_go_the_same_way_by_the_same_commands_within_5_cm(twin, name):
    a, b = by_equal_commands(twin, path_named(name))
    assert rms_apart_m(a, b) < 0.02  # the requirement is 0.05
    assert_allclose(b.pose[:, 2], a.pose[:, 2], atol=0.02)
    assert_allclose(b.wheel_angle, a.wheel_angle, atol=2e-4 * a.wheel_angle.max() + 0.05)


@physics
def test_newton_follows_a_path_and_gives_the_same_bits_again_in_a_lab_that_is_moved_and_turned(
    twin, tmp_path
):
    path = sine(x_first_m=-0.3, x_last_m=0.3, amplitude_m=0.15)
    stage = Usd.Stage.CreateNew(str(tmp_path / "building.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    for name, x in (("LabA", 0.0), ("LabB", 12.0)):
        lab = UsdGeom.Xform.Define(stage, f"/Building/{name}")
        lab.GetPrim().GetReferences().AddReference(str(twin.scene_file))
        lab.AddTranslateOp().Set(Gf.Vec3d(x, 0, 3))
        lab.AddRotateZOp().Set(40 + x)
    stage.Save()
    with allow(twin.scene_file.parent):
        placed = open_twin(tmp_path / "building.usda", lab="LabB", network="none")
        runs = [
            simulate(without_tracking_error(each), path, engine="newton", seed=1)
            for each in (open_twin(twin.scene_file, network="none"), placed)
        ]
    for name in runs[0]:
        assert_array_equal(runs[0][name], runs[1][name], err_msg=name)
    _, aside = path.nearest(runs[0]["p_world_base"][:, :2])
    assert np.abs(aside).max() < 0.02
    assert runs[0].metadata["engine"] == "newton"


@physics
def test_newton_stops_at_a_wall_and_says_so(twin):
    drive = twin.scene.robot.drive
    commands = [[t, 0.3, 0.0] for t in np.arange(0.0, 2.0, 0.1)]
    motion = play(
        commands,
        drive,
        start=(2.5, 0.0, 0.0),
        obstacles=twin.obstacles,
        footprint_radius_m=twin.scene.robot.footprint_radius_m,
        engine=Newton(twin.scene_file, twin.scene.robot),
    )
    end = motion.at([motion.duration_s])
    assert abs(end.pose[0, 0] + twin.scene.robot.footprint_radius_m - 3.0) < 0.02  # the wall's face
    assert end.bump[0]
    assert not motion.at([0.5]).bump[0]
